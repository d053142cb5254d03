"""The laser's plane from the line seen on boards whose poses are known.

Each line point is the place where its pixel's ray meets the board.  A plane cuts a board in a
straight line, so that a view gives two numbers: how far its line lies off
the sheet, and how it leans against it.  Errors of the board's pose and of the camera, which
all points of a view share, are counted with those two numbers, not with each point.

The plane that the most lines agree on is the start.  From it on, lines are
judged by their own uncertainties, and by how well those hold among the lines that agree.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.fft import dct
from scipy.linalg import block_diag
from scipy.optimize import brentq
from scipy.special import gammaln

from lscan.calibration.metric.views import LinePoints
from lscan.camera.posedboards import COUNT, POSE, PosedBoards, on_board_derivatives
from lscan.camera.resection import PIXEL_STEP, CameraFit, Locate, student_factor
from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask, select

# The laser line on a board: the points that lie in one straight line.


FEWEST_POINTS = 10  # of a line; a straight line has two unknowns
TRIED = 40  # points of a line that are joined in pairs to find it among outliers
WRONG_POINT = 6.0  # sigmas: beyond them a point is an outlier
MEDIAN = 0.6745  # of the magnitude of a normal variable of unit variance
MOST_SCATTER_PX = 3.0  # rms: centres anywhere within a line 10 px wide scatter by 10 / sqrt(12)
SLOW = 12  # cosines along a line, of periods of 1 down to 2/13 of it, that are its slow errors


def distance_mm(points_mm: Floats, q_per_mm: Floats) -> Floats:
    """(K,) signed distances of points from the plane q . X = 1.

    Parameters
    ----------
    points_mm : (K, 3) array, mm, camera frame
    q_per_mm : (3,) array, 1/mm, camera frame
    """
    return (points_mm @ q_per_mm - 1) / np.linalg.norm(q_per_mm)


def straight(boards: PosedBoards, line: LinePoints, board: int) -> Mask:
    """(K,) mask of the points that lie in one straight line of a board.

    Of the lines through pairs of points the one of least median distance decides.

    Parameters
    ----------
    boards : PosedBoards, camera and poses
    line : LinePoints, px, of K points
    board : int, number of the board

    References
    ----------
    Rousseeuw, "Least median of squares regression", J. Am. Stat. Assoc. 79 (1984) 871.
    """
    locate = partial(boards.locate, board=board)
    plane = locate(line.image_px)
    seen: Mask = np.asarray(np.isfinite(plane).all(axis=1))
    mask = np.zeros(len(plane), dtype=bool)
    if seen.sum() < FEWEST_POINTS:
        return mask
    places = plane[seen]
    some = places[np.unique(np.linspace(0, len(places) - 1, TRIED).astype(int))]
    first, second = np.triu_indices(len(some), 1)
    along = some[second] - some[first]
    length = np.linalg.norm(along, axis=1)
    if not length.any():
        return mask
    normal = np.column_stack([-along[:, 1], along[:, 0]])[length > 0] / length[length > 0, None]
    offset = (normal * some[first][length > 0]).sum(axis=1)
    away = np.abs(places @ normal.T - offset)
    best = np.median(away, axis=0).argmin()
    across = across_mm(locate, select(line, seen))
    sigma = np.abs(across @ normal[best]) * line.sigma_px[seen]
    usual = max(1.0, float(np.median(away[:, best] / sigma)) / MEDIAN)
    mask[seen] = away[:, best] <= WRONG_POINT * usual * sigma
    return mask


def line_scatter(boards: PosedBoards, line: LinePoints, board: int) -> tuple[float, float]:
    """Rms distance in px of points from their straight line, and how many sigmas slow errors are.

    Errors that neighbouring points share do not average as their number says.  What a line's place
    and lean may be off by is the spectrum of the residuals at long periods: the mean square of
    their slowest cosines, but for the two that the straight line takes up, over what independent
    points of their sigma would have, 1.

    Parameters
    ----------
    boards : PosedBoards, camera and poses
    line : LinePoints, px, of FEWEST_POINTS points or more that lie in one straight line
    board : int, number of the board

    References
    ----------
    U. K. Müller, "A theory of robust long-run variance estimation", J. Econometrics 141 (2007)
    1331, Sec. 4.
    """
    locate = partial(boards.locate, board=board)
    places = locate(line.image_px)
    places = places - places.mean(axis=0)
    along, normal = np.linalg.svd(places, full_matrices=False)[2]
    sigma = np.abs(across_mm(locate, line) @ normal) * line.sigma_px
    straight_line = np.column_stack([np.ones(len(places)), places @ along]) / sigma[:, None]
    off = places @ normal / sigma
    left = off - straight_line @ np.linalg.lstsq(straight_line, off)[0]
    slow = dct(left[np.argsort(places @ along)], norm="ortho")[2 : 2 + SLOW]
    rms_px = float(np.sqrt(np.mean((left * line.sigma_px) ** 2)))
    return rms_px, max(1.0, float(np.sqrt(np.mean(slow**2))))


def across_mm(locate: Locate, line: LinePoints) -> Floats:
    """(K, D) mm that a point moves when its pixel moves by one across the line.

    Parameters
    ----------
    locate : callable, (K, D) places in mm of pixels (K, 2)
    line : LinePoints, px, of K points
    """
    step = PIXEL_STEP * line.across
    return (locate(line.image_px + step) - locate(line.image_px - step)) / (2 * PIXEL_STEP)


def line_ends(points: Floats) -> Floats:
    """(2, 3) mm, the ends of the straight line of least squares through points.

    Parameters
    ----------
    points : (K, 3) array, mm, camera frame
    """
    middle = points.mean(axis=0)
    along = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    reach = (points - middle) @ along
    return middle + np.array([[reach.min()], [reach.max()]]) * along


# The laser's plane from lines on boards: two numbers a view, and their covariance.


MOST_STEPS = 20  # of Gauss and Newton; the plane's equation is nearly linear
SETTLED = 1e-12  # relative change of the plane: float64's rounding


class PlaneEquations:
    """The two numbers of each of V views, as they depend on the plane, camera and poses.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    free : (18,) mask, of the camera's parameters that were found
    lines : dict of LinePoints, px, by number of the board
    """

    def __init__(self, fit: CameraFit, free: Mask, lines: dict[int, LinePoints]) -> None:
        self._root, self._lines = fit.root, lines
        # The errors, of those that the root's columns stand for, that move the camera: (P, C).
        self._of_camera: Floats = np.linalg.qr(self._root[np.flatnonzero(free)].T)[0]
        # The root of the covariance of camera and poses, less all that moves the camera.
        self._poses_root = self._root - self._root @ self._of_camera @ self._of_camera.T
        self._points, self._across, self._by_own = {}, {}, {}
        for board, line in lines.items():
            boards = fit.boards
            self._points[board] = boards.on_board(line.image_px, board)
            self._across[board] = across_mm(partial(boards.on_board, board=board), line)
            self._by_own[board] = on_board_derivatives(boards, line.image_px, board)

    def solve(self, q: Floats, used: Mask, shared_px: float = 0.0) -> tuple[Floats, Floats]:
        """(3,) the plane of some views, and (3, 2 V) that takes the numbers' errors to those of q.

        The numbers count by the covariance of the poses and of the line points' own noise, which
        is 1.  The camera is held at what was found: boards and sheet are both seen through it, and
        a sheet that made up for the camera's error would lie beside the very lines it is fitted
        to.  What the camera's error does to the sheet is in ``joint_root``.

        Parameters
        ----------
        q : (3,) array, 1/mm, camera frame, where the search begins
        used : (V,) mask, of the views that the plane is to rest on
        shared_px : float, px, as ``shared_px`` gives it

        Raises
        ------
        MeasurementError
            Where the lines do not determine the plane.
        """
        takes, of_used = np.zeros((3, 2 * len(self._lines))), np.repeat(used, 2)
        for _ in range(MOST_STEPS):
            left, by_q, by_theta, by_line = (part[of_used] for part in self._system(q))
            carried = np.hstack([by_theta @ self._poses_root, shared_px * by_line])
            weight = np.linalg.inv(np.eye(len(left)) + carried @ carried.T)
            normal = by_q.T @ weight @ by_q
            scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
            scaled = normal / np.outer(scale, scale)
            if np.linalg.cond(scaled) > 1e15:
                raise open_plane_error()
            own = np.linalg.solve(scaled, (by_q.T @ weight) / scale[:, None]) / scale[:, None]
            takes[:, of_used], step = own, own @ left
            q = q - step
            if np.linalg.norm(step) <= SETTLED * np.linalg.norm(q):
                break
        return q, takes

    def shared_px(self, q: Floats, used: Mask) -> float:
        """What all points of a line are off by together, px, beside what is known.

        One standard uncertainty, across the line, of its place and of its lean at either end, with
        which the numbers' sum of squares is what their degrees of freedom let expect.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        used : (V,) mask, of the views that it rests on

        References
        ----------
        R. C. Paule and J. Mandel, "Consensus values and weighting factors", J. Res. Nat. Bur.
        Stand. 87 (1982) 377.
        """
        left, by_q, by_theta, by_line = (part[np.repeat(used, 2)] for part in self._system(q))
        carried = by_theta @ self._root
        known, shared = np.eye(len(left)) + carried @ carried.T, by_line @ by_line.T
        freedom = len(left) - by_q.shape[1]

        def excess(variance: float) -> float:
            lower = np.linalg.cholesky(known + variance * shared)
            design, off = np.linalg.solve(lower, by_q), np.linalg.solve(lower, left)
            rest = off - design @ np.linalg.lstsq(design, off)[0]
            return float(rest @ rest) - freedom

        most = 1.0
        while excess(most) > 0:
            most *= 4
        return float(np.sqrt(brentq(excess, 0.0, most, rtol=1e-3))) if excess(0.0) > 0 else 0.0

    def chi_squares(self, q: Floats, takes: Floats, used: Mask) -> Floats:
        """(V,) chi squared of each view's two numbers.

        What the fit leaves is counted by its own covariance, camera and poses included; for a view
        that the plane does not rest on, that is the covariance of its distance from the plane.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        used : (V,) mask, as ``solve`` took it
        """
        left, by_q, by_theta, _ = self._system(q)
        carried = by_theta @ self._root
        leaves = np.eye(len(left)) - by_q @ takes
        covariance = leaves @ (np.eye(len(left)) + carried @ carried.T) @ leaves.T
        freedom = 2 * int(used.sum()) - 3
        places = [slice(2 * k, 2 * k + 2) for k in range(len(used))]
        each = [
            _chi_square(left[at], covariance[at, at], min(2, freedom) if inside else 2)
            for at, inside in zip(places, used, strict=True)
        ]
        return np.array(each)

    def own_root(self, q: Floats, takes: Floats, shared_px: float) -> Floats:
        """(3, P) square root of the covariance of q for the camera as it is: poses and line.

        What the lines' shared error adds is found with few degrees of freedom: it is larger by
        Student's factor.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        shared_px : float, px, as ``solve`` took it
        """
        _, _, by_theta, by_line = self._system(q)
        numbers = int(takes.any(axis=0).sum())
        shared = shared_px * student_factor(numbers - 3) * by_line
        return takes @ np.hstack([by_theta @ self._poses_root, np.eye(takes.shape[1]), shared])

    def joint_root(self, q: Floats, takes: Floats, own: Floats) -> Floats:
        """(18 + 3, P) square root of the covariance of theta and q.

        Parameters
        ----------
        q : (3,) array, 1/mm, the plane
        takes : (3, 2 V) array, as ``solve`` gave it
        own : (3, P) array, as ``own_root`` gave it
        """
        by_camera = self._root @ self._of_camera
        through = -takes @ (self._system(q)[2] @ by_camera)
        theta = np.hstack([by_camera[:COUNT], np.zeros((COUNT, own.shape[1]))])
        return np.vstack([theta, np.hstack([through, own])])

    def _system(self, q: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """The numbers (2 V,), and their derivatives.

        By q (2 V, 3), by camera and poses, and by px of each line's place and lean (2 V, 2 V).
        """
        rows, by_q, by_line = [], [], []
        by_theta = np.zeros((2 * len(self._lines), len(self._root)))
        unit = q / np.linalg.norm(q)
        for k, (board, line) in enumerate(self._lines.items()):
            points = self._points[board]
            sigma = np.abs(self._across[board] @ unit) * line.sigma_px
            along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
            reach = (points - points.mean(axis=0)) @ along
            basis = np.linalg.qr(np.column_stack([np.ones(len(reach)), reach]) / sigma[:, None])[0]
            weigh = (basis / sigma[:, None]).T  # (2, K): from distances to the two numbers
            rows.append(weigh @ distance_mm(points, q))
            feet = points - np.outer(distance_mm(points, q), unit)  # on the plane
            by_q.append(weigh @ feet / np.linalg.norm(q))
            off = np.column_stack([np.ones(len(reach)), reach / np.abs(reach).max()])
            by_line.append(weigh @ (off * (self._across[board] @ unit)[:, None]))
            by_own = weigh @ (unit @ self._by_own[board])
            pose = COUNT + len(POSE) * board
            by_theta[2 * k : 2 * k + 2, :COUNT] = by_own[:, :COUNT]
            by_theta[2 * k : 2 * k + 2, pose : pose + len(POSE)] = by_own[:, COUNT:]
        return np.concatenate(rows), np.vstack(by_q), by_theta, block_diag(*by_line)


def _chi_square(left: Floats, covariance: Floats, rank: int) -> float:
    """Sum of squares of numbers (K,) over a covariance (K, K) of a known rank."""
    values, vectors = np.linalg.eigh(covariance)
    return float(((vectors[:, -rank:].T @ left) ** 2 / values[-rank:]).sum())


def open_plane_error() -> MeasurementError:
    """The error of lines that do not determine the plane."""
    return MeasurementError(
        "the laser's plane is not determined: its lines lie almost in one line of space; "
        "hold the boards nearer and farther, and at different tilts"
    )


# The plane that the most lines agree on, whatever the other lines show.
#
# Glare, a reflection or a second laser puts a line anywhere on its board.  A plane through the
# lines of two views is tried for each pair of views.  A plane near which k lines lie within a
# distance d is judged by the number of such agreements that chance alone would make among lines
# placed at random: the fewer, the better.  Neither k nor d need be known beforehand.


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
    return normal[seen] / height[seen, None]


def _off_mm(ends: Floats, planes: Floats) -> Floats:
    """(V, P) mm, distance of each line's farther end from each plane (P, 3)."""
    length = np.linalg.norm(planes, axis=1)
    return np.abs((ends @ planes.T - 1) / length).max(axis=1)


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


# The laser's plane from the line seen on boards whose poses are known.


WRONG_VIEW = 6.0  # sigmas: beyond them a view's line is an outlier
MEDIAN_CHI_SQUARE = 2 * np.log(2)  # of two degrees of freedom
MOST_BOWED = 0.005  # of what the lines span, rms off the sheet; good lasers' are straight to 0.001
BY_CHANCE = 1e-3  # agreements as good among lines at random, above which lines do not agree
ROUNDS = 20  # of deciding which lines agree; two or three suffice
LEAST_ANGLE_DEG = 10.0  # between board and sheet; the line's place on the board is unsure below
MOST_TILT_DEG = 1.0  # standard uncertainty of the sheet's tilt beyond which it is not known
TOO_FEW_LINES = "the laser's plane needs its line on two boards, usable {}"
TOO_FEW_AGREE = "too few of the {} laser lines agree on one plane"
NEAR_ENOUGH = " to {:.1f} mm rms, as those of a laser do"
SCATTERED = "the line's points scatter by {:.1f} px rms, those of a laser's by {:g} px at most"


class NoLaserPlane(MeasurementError):
    """Lines that give no plane.

    Attributes
    ----------
    faults : dict of str, by board, what is wrong with a line, as far as that is known
    """

    def __init__(self, message: str, faults: Mapping[int, str]) -> None:
        """Take the message without the faults, which name boards by number.

        Parameters
        ----------
        message : str, why there is no plane
        faults : mapping of int to str, by board
        """
        super().__init__(message)
        self.faults = dict(faults)


@dataclass(frozen=True)
class LaserPlane:
    """The laser's plane q . X = 1 in the camera frame.

    Attributes
    ----------
    q_per_mm : (3,) array, 1/mm, its normal over its distance from the pinhole
    root : (18 + 3, P) array, root @ root.T is the covariance of the camera's theta and of q
        together
    good : dict of mask, by board, of the line points it rests on
    faults : dict of str, by board, why a line was left out
    distances_mm : dict of array, mm, by board, of its line points from the plane
    """

    q_per_mm: Floats
    root: Floats
    good: dict[int, Mask]
    faults: dict[int, str]
    distances_mm: dict[int, Floats]


def find_plane(fit: CameraFit, free: Mask, lines: dict[int, LinePoints]) -> LaserPlane:
    """The plane of generalised least squares through the lines of all views but outliers.

    Half of the lines and more may be wrong: at least three, or both of two, must agree.  A view is
    an outlier where its two numbers lie more than WRONG standard uncertainties (or of
    their usual size, where all that agree are larger) from the plane of those that agree, where
    its points scatter by more than MOST_SCATTER_PX, and where it lies farther off the plane than
    MOST_BOWED of what the lines span.  What the points of a line share counts once a line.

    Parameters
    ----------
    fit : CameraFit, camera and poses
    free : (18,) mask, of the camera's parameters that were found
    lines : dict of LinePoints, px, by number of the board

    Raises
    ------
    NoLaserPlane
        Where fewer than two lines are left, where too few of them agree on a plane, or where they
        do not determine it: all in one line, or on boards nearly parallel to the sheet.
    """
    boards = fit.boards
    masks = {board: straight(boards, line, board) for board, line in lines.items()}
    faults = {
        board: f"only {int(mask.sum())} points of the line lie in one line"
        for board, mask in masks.items()
        if mask.sum() < FEWEST_POINTS
    }
    usable = {}
    for board in [board for board in lines if board not in faults]:
        line = select(lines[board], masks[board])
        scatter_px, slow = line_scatter(boards, line, board)
        if scatter_px > MOST_SCATTER_PX:
            faults[board] = SCATTERED.format(scatter_px, MOST_SCATTER_PX)
        else:
            usable[board] = replace(line, sigma_px=line.sigma_px * slow)
    start = _start(boards, usable, faults)
    agreeing = dict(zip(usable, start.agree, strict=True))
    faults |= _near_the_sheet(boards, usable, start.q_per_mm)
    usable = {board: line for board, line in usable.items() if board not in faults}
    agree = np.array([agreeing[board] for board in usable])
    ends = _ends(boards, usable)
    most_mm = MOST_BOWED * float(np.linalg.norm(np.ptp(ends.reshape(-1, 3), axis=0)))
    _require_agreement(agree, faults, most_mm)
    equations = PlaneEquations(fit, free, usable)
    q, agree = _plane_of_agreeing(equations, start.q_per_mm, agree, ends, most_mm)
    faults |= _off_the_sheet(boards, usable, q, agree)
    _require_agreement(agree, faults, most_mm)
    shared_px = equations.shared_px(q, agree)
    q, takes = equations.solve(q, agree, shared_px)
    own = equations.own_root(q, takes, shared_px)
    length = np.linalg.norm(q)
    unit = q / length
    turning = (np.eye(3) - np.outer(unit, unit)) @ own / length  # of the normal, rad
    if not np.linalg.norm(turning, 2) <= np.radians(MOST_TILT_DEG):
        raise open_plane_error()
    return LaserPlane(
        q_per_mm=q,
        root=equations.joint_root(q, takes, own),
        good={board: mask & (board not in faults) for board, mask in masks.items()},
        faults=faults,
        distances_mm={
            board: distance_mm(boards.on_board(line.image_px, board), q)
            for board, line in lines.items()
        },
    )


def _start(boards: PosedBoards, lines: dict[int, LinePoints], faults: dict[int, str]) -> Agreement:
    """The plane that the most lines agree on; NoLaserPlane where they might by chance."""
    if len(lines) < 2:
        raise NoLaserPlane(TOO_FEW_LINES.format(len(lines)), faults)
    start = agreed_plane(_ends(boards, lines))
    if len(lines) >= FEWEST_AGREEING and start.by_chance > BY_CHANCE:
        off = {
            board: f"its line lies {mm:.1f} mm off the plane that the most lie near to"
            for board, mm in zip(lines, start.off_mm, strict=True)
        }
        raise NoLaserPlane(TOO_FEW_AGREE.format(len(lines)), faults | off)
    return start


def _ends(boards: PosedBoards, lines: dict[int, LinePoints]) -> Floats:
    """(V, 2, 3) mm, the ends of lines on boards, camera frame."""
    each = [line_ends(boards.on_board(line.image_px, board)) for board, line in lines.items()]
    return np.array(each).reshape(-1, 2, 3)


def _near_the_sheet(boards: PosedBoards, lines: dict[int, LinePoints], q: Floats) -> dict[int, str]:
    """The faults of the boards that lie nearly in the plane q . X = 1."""
    faults = {}
    for board in lines:
        cosine = abs(boards.axes[board][:, 1] @ q) / np.linalg.norm(q)
        angle = np.degrees(np.arccos(min(cosine, 1.0)))
        if angle < LEAST_ANGLE_DEG:
            faults[board] = f"the board lies {angle:.1f} deg from the sheet: too near it"
    return faults


def _plane_of_agreeing(
    equations: PlaneEquations, q: Floats, agree: Mask, ends: Floats, most_mm: float
) -> tuple[Floats, Mask]:
    """The plane of the lines that agree with it, and (V,) which; as many rounds as that takes.

    q: (3,) 1/mm, the start.  agree: (V,) mask, of the lines that agree on it.  ends: (V, 2, 3) mm,
    of the lines.  most_mm: rms distance from the plane beyond which none does.
    """
    for _ in range(ROUNDS):
        q, takes = equations.solve(q, agree)
        chi = equations.chi_squares(q, takes, agree)
        usual = max(1.0, float(np.median(chi[agree])) / MEDIAN_CHI_SQUARE)
        one, other = distance_mm(ends.reshape(-1, 3), q).reshape(-1, 2).T
        near = (one**2 + one * other + other**2) / 3 <= most_mm**2  # mean square between the ends
        before, agree = agree, (chi <= WRONG_VIEW**2 * usual) & near
        if (agree == before).all() or agree.sum() < 2:
            break
    return q, agree


def _off_the_sheet(
    boards: PosedBoards, lines: dict[int, LinePoints], q: Floats, agree: Mask
) -> dict[int, str]:
    """The faults of the lines that do not agree with the plane."""
    faults = {}
    for (board, line), agrees in zip(lines.items(), agree, strict=True):
        if not agrees:
            off = distance_mm(boards.on_board(line.image_px, board), q)
            rms = np.sqrt(np.mean(off**2))
            faults[board] = f"its line lies {rms:.3f} mm rms off the sheet of the other views"
    return faults


def _require_agreement(agree: Mask, faults: dict[int, str], most_mm: float) -> None:
    """Refuse fewer than three lines, or than both of two.

    agree: (V,) mask, of the lines.  most_mm: off the plane, as ``_plane_of_agreeing`` took it.
    """
    if len(agree) < 2:
        raise NoLaserPlane(TOO_FEW_LINES.format(len(agree)), faults)
    if agree.sum() < min(FEWEST_AGREEING, len(agree)):
        message = TOO_FEW_AGREE.format(len(agree)) + NEAR_ENOUGH.format(most_mm)
        raise NoLaserPlane(message, faults)
