"""Rigid motions in the sheet, and the motion and scale between two sets of points.

The sums of squares count errors by their covariance: each point's own, and modes that
displace all points in common (records.PlanePoints).
"""

from dataclasses import dataclass

import numpy as np

from lscan.errors import MeasurementError
from lscan.records import Floats

LEAST_SIGMA_MM = 1e-6  # of a point's own, so that exact data of a test do not divide by 0


@dataclass(frozen=True)
class Motion:
    """A turn about a centre, then a shift, in the sheet.

    Attributes
    ----------
    centre_mm : (2,) array, mm, (x, z)
    shift_mm : (2,) array, mm, (x, z)
    turn_rad : float, rad, x towards z
    """

    centre_mm: Floats
    shift_mm: Floats
    turn_rad: float

    def apply(self, points_mm: Floats) -> Floats:
        """(N, 2) points moved, mm.

        Parameters
        ----------
        points_mm : (N, 2) array, mm, (x, z)
        """
        cosine, sine = np.cos(self.turn_rad), np.sin(self.turn_rad)
        turned = (points_mm - self.centre_mm) @ np.array([[cosine, sine], [-sine, cosine]])
        return turned + self.centre_mm + self.shift_mm


@dataclass(frozen=True)
class Similarity:
    """The best motion and scale that take one set of points to another.

    Attributes
    ----------
    motion : Motion, mm and rad
    scale : float, lengths after over lengths before, less 1
    covariance : (4, 4) array, of the shift's x and z in mm, of the turn in rad, and of the scale
    chi_square : float, of what motion and scale leave
    degrees_of_freedom : int, of chi_square
    """

    motion: Motion
    scale: float
    covariance: Floats
    chi_square: float
    degrees_of_freedom: int


def closest_motion(before_mm: Floats, after_mm: Floats) -> Motion:
    """The motion of least squared distance from one set of points to another, unweighted.

    Parameters
    ----------
    before_mm, after_mm : (N, 2) array, mm, (x, z)

    References
    ----------
    The turn in closed form: Kanatani, IEEE PAMI 16 (1994) 543, in two dimensions.
    """
    centre, reached = before_mm.mean(axis=0), after_mm.mean(axis=0)
    (x, z), (to_x, to_z) = (before_mm - centre).T, (after_mm - reached).T
    turn = np.arctan2(np.sum(x * to_z - z * to_x), np.sum(x * to_x + z * to_z))
    return Motion(centre, reached - centre, float(turn))


def fit_similarity(
    before_mm: Floats,
    after_mm: Floats,
    sigma_mm: Floats,
    modes_mm: Floats | None,
    also_mm: Floats | None = None,
) -> Similarity:
    """The generalised least-squares motion and scale from one set of points to another.

    The unweighted motion comes first; what is left is small, and linear.

    Parameters
    ----------
    before_mm, after_mm : (N, 2) array, mm, (x, z)
    sigma_mm : (N, 2) array, mm, standard uncertainty of ``after``
    modes_mm : (N, 2, M) array or None, mm, the part of it in common, as in PlanePoints
    also_mm : (N, 2) array, optional, mm, how ``after`` moves with one unit of what is found in the
        scale's place

    Raises
    ------
    MeasurementError
        Where the points lie so that these four are not determined, as all in one place.
    """
    start = closest_motion(before_mm, after_mm)
    near = start.apply(before_mm)
    modes = np.zeros((len(near), 2, 0)) if modes_mm is None else modes_mm
    own = np.sqrt(np.maximum(sigma_mm**2 - (modes**2).sum(axis=2), LEAST_SIGMA_MM**2)).ravel()
    lever = near - (start.centre_mm + start.shift_mm)
    unknowns = np.zeros((len(near), 2, 4))
    unknowns[:, 0, 0] = unknowns[:, 1, 1] = 1.0
    unknowns[:, 0, 2], unknowns[:, 1, 2] = -lever[:, 1], lever[:, 0]
    unknowns[:, :, 3] = lever if also_mm is None else also_mm
    # The modes' strengths are unknown too, but known to be 0 with a sigma of 1.
    count = modes.shape[2]
    rows = np.concatenate([unknowns, modes], axis=2).reshape(-1, 4 + count) / own[:, None]
    known = np.hstack([np.zeros((count, 4)), np.eye(count)])
    square, triangle = np.linalg.qr(np.vstack([rows, known]))
    left = np.concatenate([(after_mm - near).ravel() / own, np.zeros(count)])
    explained = square.T @ left
    rest = left - square @ explained
    try:
        inverse = np.linalg.inv(triangle)
    except np.linalg.LinAlgError as error:
        raise MeasurementError("the map takes the marks to places that show no scale") from error
    found = inverse[:4] @ explained
    return Similarity(
        motion=Motion(start.centre_mm, start.shift_mm + found[:2], start.turn_rad + found[2]),
        scale=float(found[3]),
        covariance=inverse[:4] @ inverse[:4].T,
        chi_square=float(rest @ rest),
        degrees_of_freedom=2 * len(near) - 4,
    )
