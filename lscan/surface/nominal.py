"""The sandwave block's nominal top: height and slope at a place in plan, clear of its steps."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lscan.config.targets import Sandwave
from lscan.records import Floats, Mask


@dataclass(frozen=True)
class NominalTop:
    """The top of the block at N places in plan, workpiece frame.

    Attributes
    ----------
    height_mm : (N,) array, mm
    slope : (N, 2) array, of the height by x and by y
    clear : (N,) mask, whether the place lies on the block and away from every step: from its sides,
        the border of the waves and the edges of the wedges
    """

    height_mm: Floats
    slope: Floats
    clear: Mask

    @cached_property
    def normal(self) -> Floats:
        """(N, 3) upward unit normals."""
        upward = np.column_stack([-self.slope, np.ones(len(self.slope))])
        return upward / np.linalg.norm(upward, axis=1, keepdims=True)


def nominal_top(piece: Sandwave, plan_mm: Floats, margin_mm: float) -> NominalTop:
    """The top at places in plan: eq. (4) on the waves, flat on rims and wedges.

    Parameters
    ----------
    piece : Sandwave, the nominal shape
    plan_mm : (N, 2) array, mm, (x, y), frame of the workpiece
    margin_mm : float, mm; a place nearer than this to a step is not clear
    """
    x, y = plan_mm.T
    far = piece.side_mm
    inset = np.minimum(np.minimum(x, far - x), np.minimum(y, far - y))
    waves = inset > 0
    wedge = _into_wedge(piece, plan_mm)
    height = np.where(waves, piece.height_mm(x, y), np.where(wedge > 0, piece.wedge.height_mm, 0.0))
    slope = np.where(waves[:, None], piece.slopes(x, y), 0.0)
    clear = (np.abs(inset) > margin_mm) & (np.abs(wedge) > margin_mm)
    return NominalTop(height, slope, clear & (inset + piece.rim_mm > margin_mm))


FOOT_ROUNDS = 2
"""Of looking for the foot: 1 mm off a crest of curvature 0.2/mm, each leaves a fifth."""


def above_top(piece: Sandwave, points_mm: Floats, margin_mm: float) -> tuple[Floats, NominalTop]:
    """(N,) distance of points above the top along its normal, mm, and the top at its foot.

    The foot and not the place beneath the point: noise along the normal would else decide on
    the slope too, and what goes with the slope would be biased by it.

    Parameters
    ----------
    piece : Sandwave, the nominal shape
    points_mm : (N, 3) array, mm, frame of the workpiece
    margin_mm : float, mm; a foot nearer than this to a step is not clear
    """
    plan = points_mm[:, :2]
    for _ in range(FOOT_ROUNDS):
        distance, top = _off_tangent(piece, points_mm, plan, margin_mm)
        plan = points_mm[:, :2] - distance[:, None] * top.normal[:, :2]
    return _off_tangent(piece, points_mm, plan, margin_mm)


def _off_tangent(
    piece: Sandwave, points_mm: Floats, plan_mm: Floats, margin_mm: float
) -> tuple[Floats, NominalTop]:
    """(N,) distance of points from the planes that touch the top at (N, 2) places, and the top."""
    top = nominal_top(piece, plan_mm, margin_mm)
    offset = points_mm - np.column_stack([plan_mm, top.height_mm])
    return (offset * top.normal).sum(axis=1), top


def _into_wedge(piece: Sandwave, plan_mm: Floats) -> Floats:
    """(N,) distance in plan to the inner edges of the nearer wedge, mm; negative outside."""
    x, y = plan_mm.T
    half, reach = piece.wedge.base_mm / 2, piece.wedge.reach_mm
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    short = 1 - from_side / reach - np.abs(y - piece.side_mm / 2) / half
    return short / np.hypot(1 / reach, 1 / half)
