"""Scans of the nominal sandwave block about a shaft, sampled exactly: rays against the shape.

The rotation is scipy's, from a rotation vector, and shares no formula with the code under test.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation
from synthetic_scans import _nearest

from lscan.config.targets import Sandwave
from lscan.records import Floats, PlanePoints, Profile, Status
from lscan.surface.shaft import Shaft

ORIGIN = np.array([0.0, 0.0, 300.0])
"""Columns fan out from here in the sheet, in the head frame: 300 mm above the nominal shaft."""


def turned(shaft: Shaft, points: Floats, position_mm: float) -> Floats:
    """(..., 3) points of the head at a position in the frame of the head at position 0."""
    turn = Rotation.from_rotvec(position_mm / shaft.arc_radius_mm * shaft.direction).as_matrix()
    return (points - shaft.point_mm) @ turn.T + shaft.point_mm


@dataclass(frozen=True)
class Nodding:
    """A nodding head above the block, whose middle lies beneath it at ``place_mm``.

    positions_mm of the plan; columns over the fan's ``half_width_mm`` at the block.
    """

    frames: int = 100
    columns: int = 110
    half_width_mm: float = 125.0
    from_mm: float = -12.0
    to_mm: float = 12.0
    place_mm: tuple[float, float, float] = (4.0, -3.0, -580.0)
    turn_deg: float = 2.0
    tilt_deg: float = 1.0

    @property
    def positions_mm(self) -> Floats:
        return np.linspace(self.from_mm, self.to_mm, self.frames)

    def to_head(self, piece: Sandwave) -> tuple[Floats, Floats]:
        """(3, 3) and (3,): from the workpiece's frame to that of the head at position 0."""
        turn = Rotation.from_euler("xz", [self.tilt_deg, self.turn_deg], degrees=True).as_matrix()
        middle = np.array([piece.side_mm / 2, piece.side_mm / 2, 0.0])
        return turn, np.array(self.place_mm) - turn @ middle


def sheet_points(piece: Sandwave, nodding: Nodding, shaft: Shaft) -> Floats:
    """(F, N, 2) true (x, z) in the sheet where each column of each frame meets block or floor."""
    turn, shift = nodding.to_head(piece)
    foot = np.linspace(-nodding.half_width_mm, nodding.half_width_mm, nodding.columns)
    ends = np.column_stack([foot, 0 * foot, np.full(nodding.columns, nodding.place_mm[2])])
    start, heading = [], []
    for position in nodding.positions_mm:
        apex, end = (turned(shaft, part, position) for part in (ORIGIN, ends))
        start.append(np.broadcast_to((apex - shift) @ turn, ends.shape))
        heading.append((end - apex) @ turn)
    reach = _nearest(piece, np.stack(start), np.stack(heading), floor=True)
    return (ORIGIN + reach[..., None] * (ends - ORIGIN))[..., [0, 2]]


def profiles_of(
    xz_mm: Floats,
    positions_mm: Floats,
    noise_mm: float,
    generator: np.random.Generator,
    modes_mm: Floats | None = None,
) -> Sequence[Profile]:
    """Profiles of true points (F, N, 2) with noise, and modes (F, N, 2, M) of random amounts."""
    measured = xz_mm + noise_mm * generator.normal(size=xz_mm.shape)
    variance = np.full(xz_mm.shape, noise_mm**2)
    if modes_mm is not None:
        measured = measured + modes_mm @ generator.normal(size=modes_mm.shape[-1])
        variance = variance + (modes_mm**2).sum(axis=-1)
    seen = np.isfinite(measured).all(axis=-1)
    modes = None if modes_mm is None else np.where(seen[..., None, None], modes_mm, np.nan)
    status = np.where(seen, Status.OK, Status.NO_PEAK).astype(np.int64)
    measured[~seen] = np.nan
    variance[~seen] = np.nan
    return [
        Profile(
            position_mm=float(position),
            points=PlanePoints(
                xz_mm=measured[f],
                sigma_mm=np.sqrt(variance[f]),
                status=status[f],
                modes_mm=None if modes is None else modes[f],
            ),
            brightness=np.full(xz_mm.shape[1], np.nan),
        )
        for f, position in enumerate(positions_mm)
    ]
