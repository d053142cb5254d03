"""Points of the laser line in space: where their pixels' rays meet the boards."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lscan.calibration.multiview.bundle import Bundle, camera_of
from lscan.calibration.multiview.views import LinePoints
from lscan.camera import rays
from lscan.records import Floats, Mask

FEWEST_POINTS = 10  # of a line; a straight line has two unknowns
TRIED = 40  # points of a line that are joined in pairs to find it among wrong ones
WRONG = 6.0  # sigmas: beyond them a point is wrong
MEDIAN = 0.6745  # of the magnitude of a normal variable of unit variance
PIXEL_STEP = 0.01  # px, for differences


@dataclass(frozen=True)
class Sight:
    """The line points of one view: pixels (K, 2), sigma_px (K,), across (2,) in the picture.

    view: the number of the board in the bundle.
    """

    image_px: Floats
    sigma_px: Floats
    across: Floats
    view: int

    def only(self, wanted: Mask) -> Sight:
        """Those of a mask (K,)."""
        return Sight(self.image_px[wanted], self.sigma_px[wanted], self.across, self.view)


def sight_of(line: LinePoints, view: int) -> Sight:
    """The line points of the view of that number."""
    across = np.array([0.0, 1.0]) if line.axis == "columns" else np.array([1.0, 0.0])
    return Sight(line.image_px, line.sigma_px, across, view)


def locate(
    theta: Floats, port: Literal["flat", "none"], image_px: Floats, normal: Floats, place_mm: Floats
) -> Floats:
    """(K, 3) mm, camera frame, where pixels' rays meet a plane; NaN where they do not.

    image_px: (K, 2).  normal: (3,), place_mm: (3,) of the plane, camera frame.
    """
    seen = rays(camera_of(theta, port), image_px)
    along = seen.direction @ normal
    distance = ((place_mm - seen.origin_mm) @ normal) / np.where(along != 0, along, np.nan)
    ahead = np.where(distance > 0, distance, np.nan)
    return seen.origin_mm + ahead[:, None] * seen.direction


def on_board(bundle: Bundle, image_px: Floats, view: int) -> Floats:
    """(K, 3) mm, camera frame, of pixels (K, 2) that look at the board of a view."""
    normal, place = bundle.rotation[view][:, 2], bundle.place_mm[view]
    return locate(bundle.theta, bundle.port, image_px, normal, place)


def distance_mm(points_mm: Floats, q_per_mm: Floats) -> Floats:
    """(K,) signed distances of points (K, 3) from the plane q . X = 1."""
    distances: Floats = (points_mm @ q_per_mm - 1) / np.linalg.norm(q_per_mm)
    return distances


def straight(bundle: Bundle, sight: Sight) -> Mask:
    """(K,) mask of the points that lie in one straight line of the board.

    Of the lines through pairs of points the one of least median distance (Rousseeuw, "Least
    median of squares regression", J. Am. Stat. Assoc. 79 (1984) 871) tells which.
    """
    points = on_board(bundle, sight.image_px, sight.view)
    plane = (points - bundle.place_mm[sight.view]) @ bundle.rotation[sight.view][:, :2]
    seen = np.isfinite(plane).all(axis=1)
    if seen.sum() < FEWEST_POINTS:
        return np.zeros(len(plane), dtype=bool)
    places = plane[seen]
    some = places[np.unique(np.linspace(0, len(places) - 1, TRIED).astype(int))]
    first, second = np.triu_indices(len(some), 1)
    along = some[second] - some[first]
    length = np.linalg.norm(along, axis=1)
    normal = np.column_stack([-along[:, 1], along[:, 0]])[length > 0] / length[length > 0, None]
    offset = (normal * some[first][length > 0]).sum(axis=1)
    away = np.abs(places @ normal.T - offset)
    best = np.median(away, axis=0).argmin()
    across = across_mm(bundle, sight.only(seen))
    sigma = np.abs((across[:, :2]) @ normal[best]) * sight.sigma_px[seen]
    usual = max(1.0, float(np.median(away[:, best] / sigma)) / MEDIAN)
    mask = np.zeros(len(plane), dtype=bool)
    mask[np.flatnonzero(seen)] = away[:, best] <= WRONG * usual * sigma
    return mask


def across_mm(bundle: Bundle, sight: Sight) -> Floats:
    """(K, 3) mm, board frame, that a point moves when its pixel moves by one across the line."""
    after, before = (
        on_board(bundle, sight.image_px + way * PIXEL_STEP * sight.across, sight.view)
        for way in (1, -1)
    )
    return (after - before) @ bundle.rotation[sight.view] / (2 * PIXEL_STEP)


def line_ends(points: Floats) -> Floats:
    """(2, 3) the ends of the straight line of least squares through points (K, 3)."""
    middle = points.mean(axis=0)
    along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    reach = (points - middle) @ along
    return middle + np.array([[reach.min()], [reach.max()]]) * along
