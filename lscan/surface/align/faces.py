"""The samples on the faces beside each edge of the sandwave block, clear of all other edges."""

from collections.abc import Sequence

import numpy as np

from lscan.config.targets import Sandwave
from lscan.records import Floats, Ints, Mask
from lscan.surface.align.fading import REACH_MM, FaceSamples
from lscan.surface.align.features import near_level

CLEAR_MM = 3.0
"""Samples this near to another edge are dimmed by it as well."""

TIP_MM = 1.5
"""Along y, samples this near to a wedge's tip are left out; its other edge is twice as far."""

OFF_MM = 2.0
"""How far off, at most, the block is taken to be before its edges are found by their fading."""

FEWEST_SAMPLES = 40
"""Fewest on a face: its level takes three coefficients, the edge, its wall and width as many."""


def faces_beside(
    names: Sequence[str], points: Floats, brightness: Floats, piece: Sandwave
) -> list[tuple[Ints, FaceSamples]] | None:
    """For each edge named, the index (K,) of its samples among all, and the samples.

    None where a face has fewer than FEWEST_SAMPLES.  The wedges' near edges have a lower face, the
    rim; behind the far ones it is hidden, for the camera looks along y.  Of what is beyond the
    block's sides nothing is asked.

    Parameters
    ----------
    names : sequence of str, of the edges, such as "left wedge, near edge"
    points : (..., 3) array, mm, about in the workpiece frame
    brightness : (...) array, DN
    piece : Sandwave, the nominal shape
    """
    flat, light = points.reshape(-1, 3), brightness.ravel()
    valid = np.isfinite(flat).all(axis=1) & (light > 0)
    top = valid & near_level(flat[:, 2], piece.wedge.height_mm, piece)
    rim = valid & near_level(flat[:, 2], 0.0, piece)
    found = []
    for name in names:
        left, wedge, near = name.startswith("left"), "wedge" in name, "near" in name
        # Mirrored, so that each edge is one of the left half: x from the side inwards.
        inwards = flat[:, 0] + piece.rim_mm if left else piece.side_mm + piece.rim_mm - flat[:, 0]
        plan = np.column_stack([inwards, flat[:, 1] - piece.side_mm / 2])
        if wedge:
            upper, lower, slope = _beside_wedge(plan, top, rim, near, piece)
        else:
            upper, lower, slope = _beside_side(plan, top | rim, piece), np.zeros_like(top), 0.0
        if upper.sum() < FEWEST_SAMPLES or (near and lower.sum() < FEWEST_SAMPLES):
            return None
        index = np.asarray(np.flatnonzero(upper | lower), dtype=np.int64)
        slope, side = slope if left else -slope, 1 if wedge == left else -1
        samples = (flat[index, :2], light[index], lower[index])
        found.append((index, FaceSamples(slope, side, 0 if wedge else 1, *samples)))
    return found


def _beside_wedge(
    plan: Floats, top: Mask, rim: Mask, near: bool, piece: Sandwave
) -> tuple[Mask, Mask, float]:
    """Masks (K,) of the samples on top and on the rim beside an edge of the left wedge; dx/dy.

    plan: (K, 2) mm, x from the block's side, y from its middle.
    """
    inwards, y = plan.T
    slope = piece.wedge.reach_mm / (piece.wedge.base_mm / 2) * (1 if near else -1)
    along = -y if near else y
    depth = piece.wedge.reach_mm + slope * y - inwards
    beside = (along > TIP_MM) & (along < piece.wedge.base_mm / 2) & (inwards > CLEAR_MM)
    upper = top & beside & (depth > -OFF_MM) & (depth < REACH_MM + OFF_MM)
    lower = rim & beside & (depth < OFF_MM) & (depth > -REACH_MM - OFF_MM)
    lower &= inwards < piece.rim_mm - CLEAR_MM  # the waves begin there
    return upper, lower if near else np.zeros_like(lower), slope


def _beside_side(plan: Floats, top: Mask, piece: Sandwave) -> Mask:
    """Mask (K,) of the samples on top beside the left side, clear of the wedge's edges."""
    inwards, y = plan.T
    reach = piece.side_mm / 2 + piece.rim_mm - CLEAR_MM
    beside = (np.abs(y) < reach) & (np.abs(np.abs(y) - piece.wedge.base_mm / 2) > CLEAR_MM)
    return np.asarray(top & beside & (inwards > -OFF_MM) & (inwards < REACH_MM + OFF_MM))
