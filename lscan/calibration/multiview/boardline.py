"""Which points of a stripe lie on the board."""

import cv2
import numpy as np

from lscan.calibration.multiview.views import LinePoints
from lscan.calibration.region import Region, region_around
from lscan.records import Floats, Marks, Stripe, has_value

Outline = tuple[float, float, float, float]
"""(left, right, bottom, top) of a board, mm, in the frame of its marks."""

EDGE_PX = 3.0  # from the board's edge: nearer, blur mixes the line with what lies behind the board


def line_on_board(stripe: Stripe, marks: Marks, outline_mm: Outline | None = None) -> LinePoints:
    """The points of a stripe that lie on the board: to its edge, or to its outermost marks.

    Elsewhere the line falls on what stands behind the board.  Saturated points weigh as little
    as their sigma_px says.

    Parameters
    ----------
    stripe : Stripe, px, of the picture with the line
    marks : Marks, px, of the picture of the board, from the same place
    outline_mm : tuple of float, optional, mm, frame of the marks, (left, right, bottom, top) of the
        board; where it is not known, points within the hull of the marks are taken

    Raises
    ------
    MeasurementError
        Where the marks span no area.
    """
    usable = np.flatnonzero(has_value(stripe.status))
    places = stripe.image_px[usable]
    inside = region_around(marks.image_px[marks.found]).covers(places)
    if outline_mm is not None and (board := _board_region(marks, outline_mm)) is not None:
        inside |= board.covers(places)
    kept = usable[inside]
    return LinePoints(stripe.image_px[kept], stripe.sigma_px[kept], stripe.axis)


def _board_region(marks: Marks, outline_mm: Outline) -> Region | None:
    """The board in the picture, EDGE_PX within its edge; None where that is not known.

    A homography takes the marks to the picture.  What it misses of them, by the lens's
    distortion, it may miss of the edge as well.
    """
    board_mm, seen = marks.board_mm[marks.found], marks.image_px[marks.found]
    homography = cv2.findHomography(board_mm, seen)[0] if len(seen) >= 4 else None
    if homography is None:
        return None
    left, right, bottom, top = outline_mm
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    if (np.column_stack([corners, np.ones(4)]) @ homography[2] <= 0).any():
        return None  # a corner lies behind the camera
    missed = np.linalg.norm(_mapped(homography, board_mm) - seen, axis=1).max()
    return region_around(_mapped(homography, corners), -(EDGE_PX + float(missed)))


def _mapped(homography: cv2.typing.MatLike, points: Floats) -> Floats:
    """(N, 2) points under a homography."""
    return np.asarray(cv2.perspectiveTransform(points[:, None], homography)[:, 0], dtype=float)
