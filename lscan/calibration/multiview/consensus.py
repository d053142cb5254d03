"""The plane that the most lines agree on, whatever the other lines show.

Glare, a reflection or a second laser puts a line anywhere on its board.  A plane through the
lines of two views is tried for each pair of views.  A plane near which k lines lie within a
distance d is judged by the number of such agreements that chance alone would make among lines
placed at random: the fewer, the better.  Neither k nor d need be known beforehand.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask

FEWEST_AGREEING = 3  # lines: two determine a plane, a third checks it
MOST_PAIRS = 1000  # of lines tried; with half of them wrong, some 250 pairs are of right ones
FINEST = 1e-3  # of a line's half length: nearer lines agree no better
CONCENTRATIONS = 10  # on ever the same lines after two or three
THROUGH_PINHOLE = 1e-6  # mm, distance of a plane from the pinhole that sees it as a line
SEED = 1


@dataclass(frozen=True)
class Agreement:
    """A plane, and the lines that agree on it.

    Attributes
    ----------
    q_per_mm : (3,) array, 1/mm; the plane is q . X = 1 of the camera frame
    agree : (V,) mask, of the lines
    off_mm : (V,) array, mm, distance from the plane of that end of each line which is farther off
    by_chance : float, number of agreements as good as this one that are to be expected among V
        lines placed at random
    """

    q_per_mm: Floats
    agree: Mask
    off_mm: Floats
    by_chance: float


def agreed_plane(ends: Floats) -> Agreement:
    """The plane on which lines agree as they would least by chance.

    The result does not depend on the lines' order.  Of more than MOST_PAIRS pairs of lines so many
    are drawn, with a fixed seed.

    Parameters
    ----------
    ends : (V, 2, 3) array, mm, camera frame, the ends of two lines or more

    Raises
    ------
    MeasurementError
        Where every plane through two of the lines goes through the pinhole.

    References
    ----------
    The number of false alarms: L. Moisan and B. Stival, "A probabilistic criterion to detect rigid
    point matches between two images and estimate the fundamental matrix", Int. J. Comput. Vision
    57 (2004) 201, Sec. 3.  Concentration: P. J. Rousseeuw and K. van Driessen, "Computing LTS
    regression for large data sets", Data Min. Knowl. Discov. 12 (2006) 29, Sec. 2.

    Examples
    --------
    >>> ends = np.array([[[x, y, 900.0 + y], [x + 50, y, 900.0 + y]] for x, y in
    ...                  ((0, 0), (10, 40), (0, -30), (-20, 20), (5, -60))], dtype=float)
    >>> ends[3, :, 2] += [9.0, 4.0]
    >>> agreed_plane(ends).agree
    array([ True,  True,  True, False,  True])
    """
    half_length = float(np.median(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1))) / 2
    first, second = _pairs(ends)
    planes = _planes(np.concatenate([ends[first], ends[second]], axis=1))
    if not len(planes):
        raise MeasurementError("the laser lines lie in no plane before the camera")
    best, count, chance = _least_by_chance(_off_mm(ends, planes), half_length)
    q = planes[best]
    for _ in range(CONCENTRATIONS):
        nearest = np.argsort(_off_mm(ends, q[None])[:, 0], kind="stable")[:count]
        again = _planes(ends[nearest].reshape(1, -1, 3))
        if not len(again):
            break
        _, count_again, chance_again = _least_by_chance(_off_mm(ends, again), half_length)
        if chance_again >= chance:
            break
        q, count, chance = again[0], count_again, chance_again
    off = _off_mm(ends, q[None])[:, 0]
    agree = off <= np.sort(off)[count - 1]
    return Agreement(q, agree, off, float(np.exp(chance)))


def _pairs(ends: Floats) -> tuple[Ints, Ints]:
    """(P,) and (P,) numbers of the lines that are tried together, from their places alone."""
    order = np.lexsort(ends.mean(axis=1).T)
    first, second = np.triu_indices(len(ends), 1)
    if len(first) > MOST_PAIRS:
        drawn = np.random.default_rng(SEED).choice(len(first), MOST_PAIRS, replace=False)
        first, second = first[drawn], second[drawn]
    return order[first], order[second]


def _planes(points: Floats) -> Floats:
    """(P, 3) q, 1/mm, of the planes of least squares through points (P, N, 3), mm.

    Those through the pinhole are left out.
    """
    middle = points.mean(axis=1)
    normal = np.linalg.svd(points - middle[:, None], full_matrices=False)[2][:, 2]
    height = (middle * normal).sum(axis=1)
    seen = np.abs(height) > THROUGH_PINHOLE
    planes: Floats = normal[seen] / height[seen, None]
    return planes


def _off_mm(ends: Floats, planes: Floats) -> Floats:
    """(V, P) mm, distance of each line's farther end from each plane (P, 3)."""
    length = np.linalg.norm(planes, axis=1)
    off: Floats = np.abs((ends @ planes.T - 1) / length).max(axis=1)
    return off


def _least_by_chance(off: Floats, half_length: float) -> tuple[int, int, float]:
    """Which of P planes, with how many of V lines, and the logarithm of the number by chance.

    off: (V, P) mm.  A line placed at random has either end within d of a plane with the
    probability d over its half length.  k lines have 2 k such numbers, of which the plane takes
    up three.  Of V lines there are V! / (k! (V - k)!) choices of k, of these k (k - 1) / 2 choices
    of the pair that made the plane.
    """
    lines = len(off)
    count = np.arange(min(FEWEST_AGREEING, lines), lines + 1)
    within = np.sort(off, axis=0)[count - 1] / half_length
    of_choices = gammaln(lines + 1) - gammaln(count + 1) - gammaln(lines - count + 1)
    tests = np.log(max(lines - 2, 1)) + of_choices + np.log(count * (count - 1) / 2)
    chance = tests[:, None] + (2 * count - 3)[:, None] * np.log(np.clip(within, FINEST, 1.0))
    # Of planes that agree alike to FINEST, the one that the lines lie nearest to.
    place = np.lexsort((within.ravel(), chance.ravel()))[0]
    k, plane = np.unravel_index(place, chance.shape)
    return int(plane), int(count[k]), float(chance[k, plane])
