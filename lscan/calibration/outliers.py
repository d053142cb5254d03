"""Marks that do not lie where all the others predict them: outliers of a board reading.

A board is flat, lens and port bend its picture smoothly: a polynomial in the place where a
homography takes a mark follows the place in the picture.  (In the place on the board itself it
would have to follow the perspective too, and missed a sound corner by 0.5 px and more in one of
300 views.)  It is fitted to all marks; those that miss it by most are left out and all are judged
again, until those left out are just those that miss.  Unlike a mark's neighbours (board.lattice),
which may be wrong as it is, the whole board outvotes a group of them.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from lscan.calibration.maps.polynomial import terms
from lscan.calibration.maps.scaling import box
from lscan.calibration.readings import all_marks, found_marks, without
from lscan.calibration.region import spacing_px
from lscan.camera.fit import MEDIAN
from lscan.records import BoardReading, Floats, Mask

ORDERS = (7, 5, 3)  # of the polynomial: the first that so many marks determine well
MARKS_PER_TERM = 4
WRONG = 8.0  # times the usual miss, as for dots among their neighbours (board.lattice)
LEAST = 0.01  # of the spacing of the marks: what a printed board may be off by (board.evidence)
MOST_WRONG = 0.1  # of all marks; where more miss, it is not the marks that are wrong
LEAST_FREEDOM = 1e-6  # of a mark, which pulls the polynomial to itself: below it is rounding
ROUNDS = 40  # each halves the largest miss that counts


@dataclass(frozen=True)
class ScreenedReading:
    """A reading and the marks that were taken out of it.

    Attributes
    ----------
    reading : BoardReading, px and mm; the outliers have the status NOT_FOUND
    outliers_mm : (K, 2) array, mm, (x, z) of the outliers on the board
    """

    reading: BoardReading
    outliers_mm: Floats


def screened(reading: BoardReading) -> ScreenedReading:
    """The reading without its outliers; the reading itself where it has none.

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture

    Raises
    ------
    BoardNotFound
        Where no two neighbouring control points were found.
    """
    wrong = outliers(reading)
    board_mm = np.vstack([marks.board_mm for marks in all_marks(reading)])[wrong]
    return ScreenedReading(without(reading, wrong) if wrong.any() else reading, board_mm)


def outliers(reading: BoardReading) -> Mask:
    """(N,) mask of the outliers among all marks, control points first; none where marks are few.

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture

    Raises
    ------
    BoardNotFound
        Where no two neighbouring control points were found.
    """
    several = all_marks(reading)
    found = np.concatenate([marks.found for marks in several])
    board_mm, image_px, _ = found_marks(several)
    wrong = np.zeros(len(found), dtype=bool)
    rows = _polynomial_terms(board_mm, image_px)
    if rows is not None:
        wrong[found] = _off_the_fit(rows, image_px, LEAST * spacing_px(reading))
    return wrong


def _polynomial_terms(board_mm: Floats, image_px: Floats) -> Floats | None:
    """(N, K) terms of the highest order that N marks determine; None where they are too few."""
    homography = cv2.findHomography(board_mm, image_px)[0] if len(board_mm) > 3 else None
    if homography is None or np.linalg.matrix_rank(board_mm - board_mm[0]) < 2:
        return None  # few, or all of one row, on the board or in the picture
    seen = np.asarray(cv2.perspectiveTransform(board_mm[:, None], homography)[:, 0], dtype=float)
    scaled = box(seen).apply(seen)
    for order in ORDERS:
        rows = terms(scaled, order)[0]
        enough = len(rows) >= MARKS_PER_TERM * rows.shape[1]
        if enough and np.linalg.matrix_rank(rows) == rows.shape[1]:
            return rows
    return None


def _off_the_fit(rows: Floats, image_px: Floats, least_px: float) -> Mask:
    """(N,) mask of the marks that the polynomial through the others misses."""
    wrong = np.zeros(len(rows), dtype=bool)
    for _ in range(ROUNDS):
        miss, error = _misses(rows, image_px, ~wrong)
        usual = float(np.median((miss / error)[~wrong])) / MEDIAN
        off = (miss > WRONG * usual * error) & (miss > least_px)
        if off.mean() > MOST_WRONG:
            return np.zeros(len(rows), dtype=bool)
        # What one mark does to the fit others near it miss by: the worst go first.
        new = (miss / error)[off & ~wrong]
        before, wrong = wrong, off & (wrong | (miss / error > new.max(initial=0.0) / 2))
        if (wrong == before).all():
            break
    return wrong


def _misses(rows: Floats, image_px: Floats, used: Mask) -> tuple[Floats, Floats]:
    """(N,) px by which marks miss the fit to the used ones but themselves, and (N,) its error.

    The error is for an error of 1 px of each mark: the mark's own, and that of the fit there.
    Miss over error is what statistics call studentized: where one mark alone is wrong, no other
    has more of it, however much a corner pulls the fit to itself.
    """
    square, triangle = np.linalg.qr(rows[used])
    coefficients = np.linalg.solve(triangle, square.T @ image_px[used])
    leverage = (np.linalg.solve(triangle.T, rows.T) ** 2).sum(axis=0)
    free = np.where(used, np.maximum(1 - leverage, LEAST_FREEDOM), 1.0)
    miss = np.hypot(*(image_px - rows @ coefficients).T) / free
    return miss, np.where(used, 1 / np.sqrt(free), np.sqrt(1 + leverage))
