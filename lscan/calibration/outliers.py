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
from lscan.calibration.readings import all_marks, found_marks, joined_marks, without
from lscan.calibration.region import spacing_px
from lscan.camera.resection import MEDIAN
from lscan.records import BoardReading, Floats, Mask

ORDERS = (7, 5, 3)  # of the polynomial: the first that the marks determine
MARKS_PER_TERM = 2  # at least; a strong lens bends the corners of a board more than a cubic can
FEWEST = 40  # marks, of which some may be wrong
LEFT_OUT = 0.5  # of what the last order bends: each bends a third of the one before, 1/3 + 1/9 ...
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
    board_mm = joined_marks(reading).board_mm[wrong]
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
    found = joined_marks(reading).found
    board_mm, image_px, _ = found_marks(all_marks(reading))
    wrong = np.zeros(len(found), dtype=bool)
    both = _polynomial_terms(board_mm, image_px)
    if both is not None:
        wrong[found] = _off_the_fit(*both, image_px, LEAST * spacing_px(reading))
    return wrong


def _polynomial_terms(board_mm: Floats, image_px: Floats) -> tuple[Floats, Floats] | None:
    """(N, K) terms of the highest order that N marks determine, and (N, L) of one order less.

    None where the marks are too few.
    """
    homography = cv2.findHomography(board_mm, image_px)[0] if len(board_mm) >= FEWEST else None
    if homography is None or np.linalg.matrix_rank(board_mm - board_mm[0]) < 2:
        return None  # few, or all of one row, on the board or in the picture
    seen = np.asarray(cv2.perspectiveTransform(board_mm[:, None], homography)[:, 0], dtype=float)
    scaled = box(seen).apply(seen)
    for order in ORDERS:
        rows = terms(scaled, order)[0]
        if min(len(rows) / MARKS_PER_TERM, np.linalg.matrix_rank(rows)) >= rows.shape[1]:
            return rows, terms(scaled, order - 1)[0]
    return None


def _off_the_fit(rows: Floats, fewer: Floats, image_px: Floats, least_px: float) -> Mask:
    """(N,) mask of the marks that the polynomial through the others misses."""
    wrong = np.zeros(len(rows), dtype=bool)
    for _ in range(ROUNDS):
        miss, studentized = _misses(rows, image_px, ~wrong)
        usual = float(np.median(studentized[~wrong])) / MEDIAN
        # The orders left out bend too: a corner may miss by that, most where the marks are few.
        last_px = np.hypot(*(_fit(rows, image_px, ~wrong) - _fit(fewer, image_px, ~wrong)).T)
        off = (studentized > WRONG * usual) & (miss > least_px + LEFT_OUT * last_px)
        if off.mean() > MOST_WRONG:
            return np.zeros(len(rows), dtype=bool)
        # What one mark does to the fit others near it miss by: the worst go first.
        worst = (studentized * (off & ~wrong)).max()
        before, wrong = wrong, off & (wrong | (studentized > worst / 2))
        if (wrong == before).all():
            break
    return wrong


def _misses(rows: Floats, image_px: Floats, used: Mask) -> tuple[Floats, Floats]:
    """(N,) px by which marks miss the fit to the used ones but themselves, and (N,) studentized.

    That is over its error where each mark has one of 1 px: the mark's own, and that of the fit
    there.  Where one mark alone is wrong, none has more of it, however much the fit follows it.

    References
    ----------
    Cook and Weisberg, "Residuals and Influence in Regression", 1982, chapter 2.
    """
    leverage = (np.linalg.solve(np.linalg.qr(rows[used])[1].T, rows.T) ** 2).sum(axis=0)
    free = np.where(used, np.maximum(1 - leverage, LEAST_FREEDOM), 1.0)
    miss = np.hypot(*(image_px - _fit(rows, image_px, used)).T) / free
    return miss, miss / np.where(used, 1 / np.sqrt(free), np.sqrt(1 + leverage))


def _fit(rows: Floats, image_px: Floats, used: Mask) -> Floats:
    """(N, 2) px, where the polynomial through the used marks takes every mark."""
    return np.asarray(rows @ np.linalg.lstsq(rows[used], image_px[used], rcond=None)[0])
