"""Camera, port and pose from the marks of one board picture: weighted least squares.

What is minimised is the sum of squares of the marks' residuals in the picture over their
standard uncertainties, and of the parameters' departures from what was known of them over
theirs.  One plane does not tell all parameters apart; what was known decides where the marks
leave a choice, and the covariance says how much choice there was.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.optimize import least_squares

from lscan.calibration.boardview import COUNT, FACING, LENS, NAMES, PORT, BoardView, towards
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Mask

# With next to nothing known: as uncertain as webcams differ among themselves; ours.
FOCAL_WIDTHS = (1.2, 0.8)  # focal length and its uncertainty over the picture's width
CENTRE_WIDTHS = 0.1  # uncertainty of the axis over the picture's width

START_WIDTHS = (1.2, 0.7, 2.0)  # focal lengths to start from where none is known
LEAST_SIGMA_PX = 0.002  # a quarter of what is reached in an 8-bit picture; ours
FEWEST = 10  # control points: 20 equations for the 13 unknowns of lens and pose
START_PX = 10.0  # residuals above this count linearly while the start is sought
WRONG = 6.0  # sigmas: one good mark in 6e7 is as far off (Rayleigh)
MOST_MISSED = 0.1  # of the pitch: how far off the median mark may lie in a view that explains; ours
MOST_WRONG = 0.25  # of all marks; beyond it the fit explains nothing
MEDIAN = np.sqrt(2 * np.log(2))  # of the length of a residual of unit uncertainty (Rayleigh)
FAR_PX = 1e4  # stands for the residual of a mark that has no image at all
ROUNDS = 8
START_EVALUATIONS, MOST_EVALUATIONS = 15, 100
CONVERGED = 1e-9  # relative change of the sum of squares

# The permitted range of each parameter that has one, and steps for central differences: each
# moves the picture by 1e-3 to 0.1 px, far above rounding and far below any curvature.
LIMITS = {
    "focal_px": (1.0, np.inf),
    "gap_mm": (0.0, np.inf),
    "thickness_mm": (0.0, np.inf),
    "glass_index": (1.0, 4.0),
    "water_index": (1.0, 4.0),
    "tilt_x_deg": (-45.0, 45.0),
    "tilt_y_deg": (-45.0, 45.0),
}
STEPS = np.array(
    [
        *(0.05, 0.05, 0.05),  # focal length and centre, px
        *(1e-4, 1e-4, 1e-5, 1e-5),  # distortion
        *(0.01, 0.01, 1e-4, 1e-4, 1e-3, 1e-3),  # port: lengths, mm; indices; tilts, degrees
        *(1e-5, 1e-5, 1e-5),  # turn, rad
        *(0.01, 0.01, 1e-5),  # place seen, px; mm per px
    ]
)


@dataclass(frozen=True)
class Priors:
    """What is known of theta beforehand: (19,) each; sigma 0: held, infinite: unknown."""

    mean: Floats
    sigma: Floats

    @property
    def free(self) -> Mask:
        """(19,) mask of the parameters to be found."""
        return self.sigma > 0

    @property
    def informed(self) -> Mask:
        """(19,) mask of the free parameters of which something is known."""
        return self.free & np.isfinite(self.sigma)


@dataclass(frozen=True)
class Observations:
    """Marks to fit: board_mm (N, 2), image_px (N, 2), sigma_px (N,)."""

    board_mm: Floats
    image_px: Floats
    sigma_px: Floats

    def only(self, mask: Mask) -> Observations:
        """Those of the mask (N,)."""
        return Observations(self.board_mm[mask], self.image_px[mask], self.sigma_px[mask])


@dataclass(frozen=True)
class Fit:
    """view: the solution.  root: (19, P), the covariance of its theta is root @ root.T.

    good: (N,) mask of the observations that the solution rests on; the others are wrong.
    """

    view: BoardView
    root: Floats
    good: Mask


def observations(reading: BoardReading) -> Observations:
    """The control points and the rulers' marks that were found, in that order."""
    several = [reading.grid, *(ruler.marks for ruler in reading.rulers)]
    return Observations(
        np.vstack([marks.board_mm[marks.found] for marks in several]),
        np.vstack([marks.image_px[marks.found] for marks in several]),
        np.maximum(np.concatenate([m.sigma_px[m.found] for m in several]), LEAST_SIGMA_PX),
    )


def priors(optics: OpticsSection, image_size: tuple[int, int]) -> Priors:
    """What ``optics`` says; InputError where a value is out of its range."""
    width, height = image_size
    fallback = {
        "focal_px": (FOCAL_WIDTHS[0] * width, FOCAL_WIDTHS[1] * width),
        "centre_u_px": ((width - 1) / 2, CENTRE_WIDTHS * width),
        "centre_v_px": ((height - 1) / 2, CENTRE_WIDTHS * width),
    }
    mean, sigma = np.zeros(COUNT), np.full(COUNT, np.inf)
    for index, name in enumerate(LENS + PORT):
        mean[index], sigma[index] = getattr(optics, name) or fallback[name]
        low, high = LIMITS.get(name, (-np.inf, np.inf))
        if not low <= mean[index] <= high:
            raise InputError(
                "out of range",
                where=f"optics.{name}",
                value=float(mean[index]),
                allowed=f"{low:g} to {high:g}",
            )
    if optics.port == "none":
        sigma[len(LENS) : len(LENS) + len(PORT)] = 0.0
    return Priors(mean, sigma)


def fit_view(reading: BoardReading, optics: OpticsSection) -> Fit:
    """The camera and the board's pose that explain the marks found, wrong marks set aside.

    A mark is wrong where its residual is more than WRONG of its standard uncertainties, or,
    where residuals are altogether larger than those, WRONG of their usual size.  The
    covariance is that of the normal equations, scaled up by chi squared per degree of freedom
    where that is above 1.

    Raises InputError for a prior out of its range, BoardNotFound where fewer than FEWEST
    control points are found, more than a quarter of the marks fit no view, or none fits as the
    priors are.
    """
    found = int(reading.grid.found.sum())
    if found < FEWEST:
        raise BoardNotFound(f"a refractive map needs {FEWEST} control points, found {found}")
    known, marks = priors(optics, reading.image_size), observations(reading)
    view = _start(marks, known, reading.image_size[0], optics)
    good = np.ones(len(marks.sigma_px), dtype=bool)
    for _ in range(ROUNDS):
        view = _refine(view, marks.only(good), known)
        length = _lengths(view, marks)
        usual = max(1.0, float(np.median(length)) / MEDIAN)
        before, good = good, length <= WRONG * usual
        if (good == before).all():
            break
        if np.mean(good) < 1 - MOST_WRONG:
            raise BoardNotFound(
                f"{int((~good).sum())} of the {len(good)} marks found fit no view of the board"
            )
    _require_explained(view, marks, reading.pitch_mm)
    return Fit(view, _covariance_root(view, marks.only(good), known), good)


def _require_explained(view: BoardView, marks: Observations, pitch_mm: float) -> None:
    """Refuse a view that misses the marks by so much that what was known must be wrong."""
    miss_px = float(np.median(_lengths(view, marks) * marks.sigma_px))
    miss_mm = miss_px * float(view.theta[-1])
    if not miss_mm <= MOST_MISSED * pitch_mm:
        raise BoardNotFound(
            f"no camera as [optics] knows it explains the marks: the median one lies {miss_px:.0f} "
            f"px off, {miss_mm:.0f} mm of a pitch of {pitch_mm:g} mm; check what [optics] says"
        )


def _lengths(view: BoardView, marks: Observations) -> Floats:
    """(N,) lengths of the marks' residuals over their uncertainties."""
    residual = view.project(marks.board_mm) - marks.image_px
    return np.nan_to_num(np.hypot(*residual.T), nan=FAR_PX) / marks.sigma_px


def _start(marks: Observations, known: Priors, width: int, optics: OpticsSection) -> BoardView:
    """The best of several rough views, one for each focal length that may be.

    The first that explains the marks within their uncertainties is as good as any.
    """
    focals = [known.mean[0]] if optics.focal_px else [share * width for share in START_WIDTHS]
    centre = marks.board_mm.mean(axis=0)
    scale = START_PX / float(np.median(marks.sigma_px))
    best, least = None, np.inf
    for focal in focals:
        theta = known.mean.copy()
        theta[0] = focal
        view = BoardView(theta, centre, optics.port)
        posed = pose_of(view, marks)
        if posed is None:
            continue
        tried = _bounded(posed, marks, known, robust=scale, most=START_EVALUATIONS)
        size = float(np.median(_lengths(tried, marks)))
        if size < least:
            best, least = tried, size
        if least < WRONG:
            break
    if best is None:
        raise BoardNotFound("the marks found are no picture of the board's front")
    return best


def pose_of(view: BoardView, marks: Observations) -> BoardView | None:
    """The view with the pose of a pinhole of the same angle of view; None seen from behind.

    Behind a port, rays near the axis are those of a pinhole with water_index times the focal
    length.  The plane's homography gives the pose (Zhang, "A flexible new technique for
    camera calibration", IEEE PAMI 22 (2000), Sec. 3.1).
    """
    theta = view.theta.copy()
    apparent = view.apparent_focal_px
    plane = marks.board_mm - view.centre_mm
    homography, _ = cv2.findHomography(plane, (marks.image_px - theta[1:3]) / apparent)
    if homography is None:
        return None
    homography = homography / np.linalg.norm(homography[:, :2], axis=0).mean()
    homography *= np.sign(homography[2, 2])
    x, z, shift = homography.T
    u, _, vt = np.linalg.svd(np.column_stack([x, np.cross(z, x), z]))
    axes = u @ vt
    if np.linalg.det(axes) < 0 or axes[:, 1] @ shift <= 0:
        return None
    theta[-3:-1] = theta[1:3] + apparent * shift[:2] / shift[2]
    theta[-1] = np.linalg.norm(shift) / apparent
    sight = replace(view, theta=theta).line_of_sight.direction[0]
    if np.isnan(sight).any():
        return None
    theta[-6:-3] = cv2.Rodrigues(towards(sight).T @ axes @ FACING.T)[0][:, 0]
    return replace(view, theta=theta)


@dataclass(frozen=True)
class _Problem:
    """Least squares over the free parameters of a view; ``some`` are those, in order."""

    view: BoardView
    marks: Observations
    known: Priors

    def at(self, some: Floats) -> BoardView:
        """The view with these free parameters."""
        theta = self.view.theta.copy()
        theta[self.known.free] = some
        return replace(self.view, theta=theta)

    def residuals(self, some: Floats) -> Floats:
        """(2 N + priors,) departures from marks and priors over their uncertainties."""
        view, known = self.at(some), self.known
        picture = view.project(self.marks.board_mm) - self.marks.image_px
        picture = np.nan_to_num(picture, nan=FAR_PX) / self.marks.sigma_px[:, None]
        departure = (view.theta - known.mean)[known.informed] / known.sigma[known.informed]
        return np.concatenate([picture.ravel(), departure])

    def slopes(self, some: Floats) -> Floats:
        """Their derivatives."""
        return _design(self.at(some), self.marks, self.known)


def _refine(view: BoardView, marks: Observations, known: Priors) -> BoardView:
    """The view of least squares, from ``view`` on, with all parameters in their LIMITS.

    The valley of nearly equal views is long, narrow and bent: Levenberg-Marquardt follows it
    best, but knows no limits; where it leaves them, the bounded method has the last word.
    """
    problem = _Problem(view, marks, known)
    answer = least_squares(
        problem.residuals,
        view.theta[known.free],
        jac=problem.slopes,
        method="lm",
        x_scale="jac",
        max_nfev=MOST_EVALUATIONS,
        ftol=CONVERGED,
    )
    found = problem.at(answer.x)
    low, high = parameter_limits()
    if ((found.theta >= low) & (found.theta <= high))[known.free].all():
        return found
    return _bounded(found, marks, known, robust=np.inf)


def _bounded(
    view: BoardView, marks: Observations, known: Priors, robust: float, most: int | None = None
) -> BoardView:
    """The view of least squares within LIMITS.

    robust: size of residuals, in sigmas, beyond which they count linearly.
    most: evaluations allowed.
    """
    problem, free = _Problem(view, marks, known), known.free
    low, high = parameter_limits()
    answer = least_squares(
        problem.residuals,
        np.clip(view.theta, low, high)[free],
        jac=problem.slopes,
        bounds=(low[free], high[free]),
        x_scale="jac",
        loss="soft_l1" if np.isfinite(robust) else "linear",
        f_scale=robust if np.isfinite(robust) else 1.0,
        max_nfev=most or MOST_EVALUATIONS,
        ftol=CONVERGED,
    )
    return problem.at(answer.x)


def parameter_limits() -> tuple[Floats, Floats]:
    """(19,) least and (19,) greatest values of theta."""
    low, high = np.array([LIMITS.get(name, (-np.inf, np.inf)) for name in NAMES]).T
    return low, high


def _design(view: BoardView, marks: Observations, known: Priors) -> Floats:
    """(2 N + priors, free parameters) derivatives of all weighted residuals."""
    indices = np.flatnonzero(known.free).tolist()
    picture = np.column_stack([picture_slope(view, marks.board_mm, k).ravel() for k in indices])
    picture = np.nan_to_num(picture) / np.repeat(marks.sigma_px, 2)[:, None]
    departure = np.eye(COUNT)[known.informed][:, indices] / known.sigma[known.informed, None]
    return np.vstack([picture, departure])


def picture_slope(view: BoardView, board_mm: Floats, index: int) -> Floats:
    """(N, 2) change in px of board points (N, 2) per unit of the parameter NAMES[index]."""
    step = np.zeros(COUNT)
    step[index] = STEPS[index]
    after, before = (replace(view, theta=view.theta + way * step) for way in (1, -1))
    return (after.project(board_mm) - before.project(board_mm)) / (2 * STEPS[index])


def _covariance_root(view: BoardView, marks: Observations, known: Priors) -> Floats:
    """(19, P) square root of theta's covariance, larger where the residuals are too large.

    The design's columns are brought to one length first, for parameters of all units.
    """
    design = _design(view, marks, known)
    scale = np.linalg.norm(design, axis=0)
    _, sizes, directions = np.linalg.svd(design / scale, full_matrices=False)
    departure = (view.theta - known.mean)[known.informed] / known.sigma[known.informed]
    chi2 = float((_lengths(view, marks) ** 2).sum() + (departure**2).sum())
    freedom = design.shape[0] - design.shape[1]
    root = np.zeros((COUNT, design.shape[1]))
    root[known.free] = (directions.T / sizes) / scale[:, None]
    return root * np.sqrt(max(1.0, chi2 / freedom))
