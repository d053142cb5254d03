"""The distance and tilt of a board from the laser sheet, from one picture of it.

A plane map gives the point M = (x, z) at which the line of sight of each mark crosses the
sheet.  With the camera's place known, the mark itself, X, lies on that line, and where it is y
behind the sheet

    M = (X_x, X_z) - s X_y,      s = (d_x, d_z) / d_y,

d being the direction of sight (derived here: the line through X along d at y = 0).  The marks
of a rigid board have six parameters between them; least squares finds them.  How large the
board appears determines its distance, how it is distorted its tilts.

Frame: the plane map's, with y the sheet's normal away from the camera; so a board behind the
sheet has positive distances.  Tilts are right-handed about x and z.
"""

from dataclasses import dataclass

import numpy as np

from lscan.camera.posedboards import rotation
from lscan.errors import MeasurementError
from lscan.records import Floats, PlanePoints, select

# Rigid motions in the sheet, and the motion and scale between two sets of points.
#
# The sums of squares count errors by their covariance: each point's own, and modes that
# displace all points in common (records.PlanePoints).


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
    of_modes : (M,) array, by how much one standard deviation of each mode puts the scale off
    chi_square : float, of what motion and scale leave
    degrees_of_freedom : int, of chi_square
    """

    motion: Motion
    scale: float
    covariance: Floats
    of_modes: Floats
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
        of_modes=inverse[3] @ square[: len(rows)].T @ rows[:, 4:],
        chi_square=float(rest @ rest),
        degrees_of_freedom=2 * len(near) - 4,
    )


# The distance and tilt of a board from the laser sheet, from one picture of it.


CAMERA_SIGMA_MM = 10.0  # of camera_mm, each coordinate: [sheet] is measured by ruler, to a cm
FEWEST_MARKS = 6
TURNS = 30
CONVERGED = 1e-10  # of the last step, in mm and in radians
UNDETERMINED = "the marks do not determine how far the board is from the sheet"


@dataclass(frozen=True)
class LinesOfSight:
    """From where N marks are seen.

    Attributes
    ----------
    slope : (N, 2) array, s of each mark's line of sight, mm of x and of z for each mm of y
    modes : (N, 2, K) array, by how much one standard deviation of each of K errors changes it
    """

    slope: Floats
    modes: Floats


@dataclass(frozen=True)
class OffSheet:
    """The pose of a board against the sheet, each number with its standard uncertainty.

    Attributes
    ----------
    distance_mm, distance_sigma_mm : float, mm, of the board's middle, + behind the sheet
    tilt_x_rad, tilt_x_sigma_rad : float, rad, about x (+: its top leans towards the camera)
    tilt_z_rad, tilt_z_sigma_rad : float, rad, about z (+: its right side stands behind)
    corners_mm, corners_sigma_mm : (4,) array, mm, distances of the corners
    residual_mm : (N, 2) array, mm, what the pose leaves of each mark's place in the sheet, NaN for
        marks that were not used
    """

    distance_mm: float
    distance_sigma_mm: float
    tilt_x_rad: float
    tilt_x_sigma_rad: float
    tilt_z_rad: float
    tilt_z_sigma_rad: float
    corners_mm: Floats
    corners_sigma_mm: Floats
    residual_mm: Floats


def seen_from(
    camera_mm: tuple[float, float, float], xz_mm: Floats, sigma_mm: float = CAMERA_SIGMA_MM
) -> LinesOfSight:
    """The lines of sight of a camera to points of the sheet.

    Parameters
    ----------
    camera_mm : tuple of float, mm, (x, y, z) in the map's frame, y below 0
    xz_mm : (N, 2) array, mm, plane frame
    sigma_mm : float, mm, standard uncertainty of each of ``camera_mm``
    """
    x, y, z = camera_mm
    slope = (xz_mm - np.array([x, z])) / -y
    modes = np.zeros((len(xz_mm), 2, 3))
    modes[:, 0, 0] = modes[:, 1, 2] = 1 / y
    modes[:, :, 1] = -slope / y
    return LinesOfSight(slope, sigma_mm * modes)


def off_sheet(
    board_mm: Floats, points: PlanePoints, sight: LinesOfSight, corners_mm: Floats
) -> OffSheet:
    """The board's pose against the sheet, by least squares from its marks.

    The uncertainties combine the marks' own, scaled up where the residuals are larger than
    it, the errors that the map gives to all marks in common, and those of the camera's place.

    Parameters
    ----------
    board_mm : (N, 2) array, mm, nominal (x, z) of the marks
    points : PlanePoints, mm, where the plane map puts them, with its uncertainty; those without a
        value are left out
    sight : LinesOfSight, from where they were seen
    corners_mm : (4, 2) array, mm, of the board, in board coordinates; their mean is its middle

    Raises
    ------
    MeasurementError
        For too few marks and for marks that do not determine the pose.

    References
    ----------
    Derived in this module's text.
    """
    used = np.asarray(np.isfinite(np.hstack([points.xz_mm, sight.slope])).all(axis=1))
    if used.sum() < FEWEST_MARKS:
        raise MeasurementError(
            f"{int(used.sum())} marks in the calibrated part of the picture, "
            f"{FEWEST_MARKS} needed to determine the board's distance from the sheet"
        )
    middle = corners_mm.mean(axis=0)
    points, sight = select(points, used), select(sight, used)
    board, corners = _in_space(board_mm[used] - middle), _in_space(corners_mm - middle)
    sigma = _own_sigma(points)
    # From the board in the sheet, by the steps of Gauss and Newton.
    flat = closest_motion(board[:, [0, 2]], points.xz_mm)
    (shift,) = flat.apply(np.zeros((1, 2)))
    place = np.array([shift[0], 0.0, shift[1]])
    turn = rotation(np.array([0.0, -flat.turn_rad, 0.0]))  # from x to z is left-handed about y
    largest_step = np.inf
    for _ in range(TURNS):
        arm = board @ turn.T
        residual, jacobian = _sheet_residuals(arm, place, points.xz_mm, sight.slope)
        jacobian /= sigma[:, None]
        if largest_step < CONVERGED:
            break
        step, _, rank, _ = np.linalg.lstsq(jacobian, -residual / sigma, rcond=1e-12)
        if rank < 6 or not np.isfinite(step).all():
            raise MeasurementError(UNDETERMINED)
        turn, place = rotation(np.asarray(step[:3], dtype=float)) @ turn, place + step[3:]
        largest_step = float(np.abs(step).max())
    else:
        raise MeasurementError(UNDETERMINED)
    weighted = residual / sigma
    scale = np.sqrt(max(1.0, float(weighted @ weighted) / (len(weighted) - 6)))
    inverse = np.linalg.pinv(jacobian)
    own = scale * np.linalg.qr(inverse.T)[1].T
    # By how much one standard deviation of each common error moves the residuals.
    common = -sight.modes * (arm + place)[:, 1, None, None]
    if points.modes_mm is not None:
        common = np.concatenate([common, -points.modes_mm], axis=2)
    of_common = inverse @ (common.reshape(len(sigma), -1) / sigma[:, None])
    root = np.hstack([own, of_common])  # root @ root.T is the covariance of the six parameters
    spread = np.linalg.norm(root, axis=1)
    to_corners, normal = corners @ turn.T, turn[:, 1]
    along = np.zeros((4, 6))  # y of w x r, and of t
    along[:, 0], along[:, 2], along[:, 4] = -to_corners[:, 2], to_corners[:, 0], 1.0
    whole = np.full_like(board_mm, np.nan)
    whole[used] = residual.reshape(-1, 2)
    return OffSheet(
        distance_mm=float(place[1]),
        distance_sigma_mm=float(spread[4]),
        tilt_x_rad=float(np.arctan2(normal[2], normal[1])),
        tilt_x_sigma_rad=float(spread[0]),
        tilt_z_rad=float(np.arctan2(-normal[0], normal[1])),
        tilt_z_sigma_rad=float(spread[2]),
        corners_mm=to_corners[:, 1] + place[1],
        corners_sigma_mm=np.linalg.norm(along @ root, axis=1),
        residual_mm=whole,
    )


def _in_space(xz_mm: Floats) -> Floats:
    return np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]])


def _sheet_residuals(
    arm: Floats, place: Floats, seen: Floats, slope: Floats
) -> tuple[Floats, Floats]:
    """(2N,) mm where marks appear in the sheet less where they are seen, and its Jacobian (2N, 6).

    Marks at the board's middle, ``place``, and its arms (N, 3) beyond.  The Jacobian is by a small
    rotation w, which moves the arm r by w x r, that is by -[r]x w, and by a shift.
    """
    x = arm + place
    by_place = np.zeros((len(arm), 2, 3))
    by_place[:, 0, 0] = by_place[:, 1, 2] = 1.0
    by_place[:, :, 1] = -slope
    by_turn = np.cross(arm[:, None, :], by_place)  # p . (w x r) = w . (r x p)
    jacobian = np.concatenate([by_turn, by_place], axis=2).reshape(-1, 6)
    return (x[:, [0, 2]] - slope * x[:, 1:2] - seen).ravel(), jacobian


def _own_sigma(points: PlanePoints) -> Floats:
    """(2N,) mm standard uncertainty of each coordinate, less what all have in common."""
    variance = points.sigma_mm**2
    if points.modes_mm is not None:
        own = variance - (points.modes_mm**2).sum(axis=2)
        variance = np.maximum(own, 1e-6 * variance)
    # A map may state none at all: then all marks count alike.
    return np.sqrt(np.where(variance > 0, variance, 1.0)).ravel()
