"""Raw scans sampled exactly from the nominal sandwave: rays of columns against the shape.

Independent of the code under test: every sample is the nearest meeting of a column's ray with
the wedges' tops, the rim, the waves or the floor; walls are thin and carry no sample.
"""

from dataclasses import dataclass

import numpy as np

from lscan.config.targets import Sandwave
from lscan.records import Floats, Mask, Status, Surface


@dataclass(frozen=True)
class Placing:
    """How the block lies in the head's axes and how the scan is made; angles in degrees.

    x_mm, y_mm, z_mm: where the middle of the block's plan at z = 0 lies.
    """

    yaw_deg: float = 0.0
    turn_deg: float = 0.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    x_mm: float = 0.0
    y_mm: float = 100.0
    z_mm: float = 0.0
    frames: int = 400
    columns: int = 320
    step_mm: float = 0.5
    pitch_mm: float = 0.9
    noise_mm: float = 0.0
    dropout: float = 0.0
    floor: bool = True
    occlusion: bool = True
    seed: int = 1

    def rotation(self) -> Floats:
        """(3, 3) from the workpiece's axes to the head's."""
        turn, roll, pitch = np.radians([self.turn_deg, self.roll_deg, self.pitch_deg])
        about_z = _rotation(turn, 0, 1)
        return _rotation(roll, 1, 2) @ _rotation(pitch, 2, 0) @ about_z


def _rotation(angle: float, first: int, second: int) -> Floats:
    matrix = np.eye(3)
    matrix[first, first] = matrix[second, second] = np.cos(angle)
    matrix[second, first], matrix[first, second] = np.sin(angle), -np.sin(angle)
    return matrix


CAMERA_ABOVE_MM = 900.0
"""Columns fan out from a point of the sheet this high above the block, as a camera's do."""


def in_wedge(piece: Sandwave, x: Floats, y: Floats) -> Mask:
    """Mask of plan points inside either wedge, closed form of the triangles."""
    half, reach = piece.wedge.base_mm / 2, piece.wedge.reach_mm
    from_side = np.minimum(x + piece.rim_mm, piece.side_mm + piece.rim_mm - x)
    return (from_side >= 0) & (from_side / reach + np.abs(y - piece.side_mm / 2) / half <= 1)


def in_waves(piece: Sandwave, x: Floats, y: Floats) -> Mask:
    """Mask of plan points in the region of eq. (4)."""
    return (x >= 0) & (x <= piece.side_mm) & (y >= 0) & (y <= piece.side_mm)


def in_block(piece: Sandwave, x: Floats, y: Floats) -> Mask:
    """Mask of plan points on the block."""
    low, high = -piece.rim_mm, piece.side_mm + piece.rim_mm
    return (x >= low) & (x <= high) & (y >= low) & (y <= high)


def top_mm(piece: Sandwave, x: Floats, y: Floats) -> Floats:
    """Height of the shape seen from above at workpiece (x, y), the floor at -body_mm."""
    z = np.where(in_waves(piece, x, y), piece.height_mm(x, y), 0.0)
    z = np.where(in_wedge(piece, x, y), piece.wedge.height_mm, z)
    return np.where(in_block(piece, x, y), z, -piece.body_mm)


def scan(piece: Sandwave, placing: Placing) -> Surface:
    """The raw surface, frame "head"."""
    rng = np.random.default_rng(placing.seed)
    track = (np.arange(placing.frames) * placing.step_mm)[:, None]
    yaw = np.radians(placing.yaw_deg)
    across = (np.arange(placing.columns) - (placing.columns - 1) / 2) * placing.pitch_mm
    shape = (placing.frames, placing.columns)
    origin = np.stack(
        np.broadcast_arrays(track * np.sin(yaw), track * np.cos(yaw), CAMERA_ABOVE_MM), -1
    ).reshape(placing.frames, 1, 3)
    direction = np.stack([across, 0 * across, 0 * across - CAMERA_ABOVE_MM], -1)[None]
    rotation = placing.rotation()
    middle = np.array([piece.side_mm / 2, piece.side_mm / 2, 0.0])
    place = np.array([placing.x_mm, placing.y_mm, placing.z_mm])
    start = (origin - place) @ rotation + middle
    heading = np.broadcast_to(direction @ rotation, (*shape, 3))
    start = np.broadcast_to(start, (*shape, 3))
    reach = _nearest(piece, start, heading, placing.floor)
    point = start + reach[..., None] * heading
    seen = np.isfinite(reach)
    if placing.occlusion:
        up = np.array([0.0, -np.cos(np.radians(30)), np.sin(np.radians(30))])
        seen &= ~_hidden(piece, point, up @ rotation, seen)
    seen &= rng.random(shape) >= placing.dropout
    head = (point - middle) @ rotation.T + place
    raw_x = head[..., 0] - track * np.sin(yaw)
    z = head[..., 2] + rng.normal(0.0, 1.0, shape) * placing.noise_mm
    xyz = np.stack([raw_x, np.broadcast_to(track, shape), z], -1)
    return Surface(
        xyz_mm=np.where(seen[..., None], xyz, np.nan),
        sigma_x_mm=np.where(seen, 0.01, np.nan),
        sigma_z_mm=np.where(seen, max(placing.noise_mm, 0.01), np.nan),
        status=np.where(seen, Status.OK, Status.NO_PEAK).astype(np.int64),
        position_mm=track.ravel(),
    )


def _nearest(piece: Sandwave, start: Floats, heading: Floats, floor: bool) -> Floats:
    """(F, N) ray parameter of the first meeting with the shape, NaN where there is none."""

    def meet(level: float) -> tuple[Floats, Floats, Floats]:
        t = (level - start[..., 2]) / heading[..., 2]
        return t, start[..., 0] + t * heading[..., 0], start[..., 1] + t * heading[..., 1]

    candidates = []
    t, x, y = meet(piece.wedge.height_mm)
    candidates.append(np.where(in_wedge(piece, x, y), t, np.inf))
    t, x, y = meet(0.0)
    rim = in_block(piece, x, y) & ~in_waves(piece, x, y) & ~in_wedge(piece, x, y)
    candidates.append(np.where(rim, t, np.inf))
    for _ in range(30):
        height = piece.height_mm(x, y)
        t = (height - start[..., 2]) / heading[..., 2]
        x, y = start[..., 0] + t * heading[..., 0], start[..., 1] + t * heading[..., 1]
    candidates.append(np.where(in_waves(piece, x, y), t, np.inf))
    if floor:
        t, x, y = meet(-piece.body_mm)
        candidates.append(np.where(in_block(piece, x, y), np.inf, t))
    nearest = np.min(candidates, axis=0)
    return np.where(np.isfinite(nearest), nearest, np.nan)


def _hidden(piece: Sandwave, point: Floats, towards: Floats, seen: Mask) -> Mask:
    """Mask of the points whose way to the camera is blocked by the shape."""
    hidden = np.zeros(seen.shape, dtype=bool)
    risen = piece.wedge.height_mm - point[..., 2]
    # Nothing stands higher than the wedges; the floor is of no interest here.
    ask = np.flatnonzero((seen & (point[..., 2] > -piece.body_mm / 2)).ravel())
    flat = point.reshape(-1, 3)
    longest = float(np.nanmax(risen.ravel()[ask])) / towards[2] if len(ask) else 0.0
    for distance in np.arange(0.75, longest, 1.0):
        ahead = flat[ask] + distance * towards
        blocked = top_mm(piece, ahead[:, 0], ahead[:, 1]) > ahead[:, 2]
        hidden.ravel()[ask[blocked]] = True
        ask = ask[~blocked & (ahead[:, 2] < piece.wedge.height_mm)]
    return hidden
