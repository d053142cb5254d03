"""The lack of fit of a map whose marks' noise is known only roughly.

Noise differs from mark to mark; what the form of a map cannot follow varies slowly over the
board, so that neighbouring marks share it.  The mean product of neighbours' residuals is
therefore the mean square of the lack of fit, whatever the noise.
"""

import numpy as np

from lscan.calibration.solved import SolvedMap
from lscan.records import BoardReading, Floats, Marks

SURE = 2.0  # standard errors by which a mean product must exceed 0: noise does in 1 of 40


def unexplained_mm(solved: SolvedMap, reading: BoardReading) -> Floats:
    """(2,) rms in mm of what the residuals of x and of z share with their neighbours'.

    Neighbours are control points one pitch apart and adjacent marks of a ruler, all of which
    the map was fitted to.  A share that noise alone could well make is 0.

    Parameters
    ----------
    solved : SolvedMap, the map
    reading : BoardReading, px and mm, the map was solved from
    """
    grid = _residuals(solved, reading.grid).reshape(*reading.shape, 2)
    several = [grid[1:] * grid[:-1], grid[:, 1:] * grid[:, :-1]]
    for ruler in reading.rulers:
        along = _residuals(solved, ruler.marks)
        several.append(along[1:] * along[:-1])
    products = np.vstack([some.reshape(-1, 2) for some in several])
    products = products[np.isfinite(products).all(axis=1)]
    if len(products) < 2:
        return np.zeros(2)
    mean, error = products.mean(axis=0), products.std(axis=0, ddof=1) / np.sqrt(len(products))
    return np.sqrt(np.where(mean > SURE * error, mean, 0.0))


def _residuals(solved: SolvedMap, marks: Marks) -> Floats:
    """(N, 2) mm of marks; NaN of those that were not found."""
    return solved.points(marks.image_px) - marks.board_mm
