"""A plane map solved from a reading of the board: outliers left out, cross-validated."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Annotated

import cv2
import numpy as np
from pydantic import Field

from lscan.calibration.fields import STRICT, Count, NotNegative
from lscan.calibration.maps.polynomial import box, terms
from lscan.calibration.maps.spline import with_hidden_errors
from lscan.calibration.marks import all_marks, found_marks, joined_marks, spacing_px, without
from lscan.calibration.physical import BoardKnown, PhysicalMap
from lscan.calibration.planemap import NOTHING_KNOWN, NamedSolver, PlaneMap, SolvedMap, find_solver
from lscan.camera.posedboards import contradiction
from lscan.camera.resection import MEDIAN, pixel_derivatives
from lscan.config.plugins import others_versions
from lscan.config.rig import Known, OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Ints, Mask, Progress, html_table, plus_minus
from lscan.version import __version__

# Marks that do not lie where all the others predict them: outliers of a board reading.
#
# A board is flat, lens and port bend its picture smoothly: a polynomial in the place where a
# homography takes a mark follows the place in the picture.  (In the place on the board itself it
# would have to follow the perspective too, and missed a sound corner by 0.5 px and more in one of
# 300 views.)  It is fitted to all marks; those that miss it by most are left out and all are
# judged
# again, until those left out are just those that miss.  Unlike a mark's neighbours
# (board.lattice),
# which may be wrong as it is, the whole board outvotes a group of them.


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


def without_outliers(reading: BoardReading) -> ScreenedReading:
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
    if (both := _polynomial_terms(board_mm, image_px)) is not None:
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


# A calibration: a plane map together with the board reading it was solved from.


MANY_SIGMAS = 10.0  # of real pictures, whose noise is stated too small by up to that; ours
GROSS = 0.01  # of the spacing of the marks: a printed board is off by less (board.evidence)


@dataclass(frozen=True)
class Calibration:
    """A solved plane map and what it rests on.

    Attributes
    ----------
    name : str, full name of the map, as it was asked for
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    reading : BoardReading, the marks it was solved from, without the outliers
    residuals_mm : (N, 2) array, mm, map of each control point less its nominal place; NaN where the
        point was not found or the map gives it no value
    residuals_px : (N, 2) array, px, the same as a shift in the picture
    optics : OpticsSection, what was known of the camera beforehand
    software : str, name and version of the program that solved it
    outliers_mm : (K, 2) array, mm, (x, z) of marks that were found and left out, as they do not lie
        where all others predict them (``outliers``)

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> calibration.name, calibration.rms_mm < 0.2
    ('graticule-2', True)
    """

    name: str
    plane_map: PlaneMap
    reading: BoardReading
    residuals_mm: Floats
    residuals_px: Floats
    optics: OpticsSection
    software: str
    outliers_mm: Floats = field(default_factory=lambda: np.empty((0, 2)))

    def __repr__(self) -> str:
        return f"<Calibration {self.name}: {self._fit}>"

    def _repr_html_(self) -> str:
        known = [(name, plus_minus(*of)) for name, of in self.quantities().items()]
        return html_table([(self.name, self._fit), *known])

    @property
    def _fit(self) -> str:
        found = self.reading.grid.found
        return f"{found.sum()} of {len(found)} dots, {self.rms_mm:.3f} mm rms"

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the picture, px."""
        return self.reading.image_size

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the control points from their nominal places, mm."""
        return _rms(self.residuals_mm)

    @property
    def max_mm(self) -> float:
        """Greatest distance of a control point from its nominal place, mm."""
        return float(np.nanmax(np.hypot(*self.residuals_mm.T)))

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths in the picture, px."""
        return _rms(self.residuals_px)

    def quantities(self) -> dict[str, Known]:
        """What the map makes of the rig, by name, each number with its standard uncertainty.

        scale_mm_per_px: on the mean over the marks; by its uncertainty all lengths are off alike.
        Of a map that knows the physics also camera, port and sheet (PhysicalMap.quantities).
        """
        board_mm, image_px, _ = found_marks([self.reading.grid])
        arm, seen = board_mm - board_mm.mean(axis=0), image_px - image_px.mean(axis=0)
        scale = float(np.linalg.norm(arm) / np.linalg.norm(seen))
        points = self.plane_map.to_plane(image_px)
        modes = np.zeros((len(arm), 2, 0)) if points.modes_mm is None else points.modes_mm
        off = np.nansum(arm[:, :, None] * modes, axis=(0, 1)) / (arm**2).sum()
        known = {"scale_mm_per_px": (scale, scale * float(np.linalg.norm(off)))}
        solved = getattr(self.plane_map, "chosen", self.plane_map)  # of auto
        return known | solved.quantities() if isinstance(solved, PhysicalMap) else known

    @property
    def misfit(self) -> str:
        """What noise does not explain, of the residuals and of [optics]; "" where it does."""
        solved = getattr(self.plane_map, "chosen", self.plane_map)  # of auto
        stated = ""
        if isinstance(solved, PhysicalMap):
            stated = contradiction(solved.geometry.theta, self.optics, self.image_size)
        sigma_px = np.sqrt(2 * np.nanmean(self.reading.grid.sigma_px**2))
        ratio = self.rms_px / max(float(sigma_px), 1e-9)
        if ratio < MANY_SIGMAS or self.rms_px < GROSS * spacing_px(self.reading):
            return stated
        return f"{stated}; " * bool(stated) + (
            f"residuals of {self.rms_px:.2f} px rms are {ratio:.0f} times the uncertainty of the "
            "marks: the map is too stiff for this lens, or the board file, [optics], the board's "
            "flatness or the pixels' squareness is not as stated"
        )


def calibrate(
    reading: BoardReading, map_name: str, optics: OpticsSection | None = None
) -> Calibration:
    """The plane map of a full name solved from a board reading.

    Marks that do not lie where all others predict them are left out (``outliers``).

    Parameters
    ----------
    reading : BoardReading, px and mm, the marks of one picture
    map_name : str, full name of the map, or "auto"
    optics : OpticsSection, optional, what is known of the camera beforehand; by default what an
        empty section [optics] says

    Raises
    ------
    InputError
        For an unknown name.
    BoardNotFound
        For too few marks.

    Examples
    --------
    >>> import lscan
    >>> reading = lscan.load_calibration("calibration.json").reading
    >>> lscan.calibrate(reading, "polynomial-5").plane_map.name
    'polynomial-5'
    """
    known, sound = optics or NOTHING_KNOWN, without_outliers(reading)
    solved = find_solver(map_name).solve(sound.reading, known)
    return calibration_by(map_name, with_hidden_errors(solved, sound.reading, known), sound, known)


def calibration_by(
    map_name: str, plane_map: PlaneMap, sound: ScreenedReading, optics: OpticsSection
) -> Calibration:
    """The calibration by a map that was solved from a reading.

    Parameters
    ----------
    map_name : str, full name of the map, as it was asked for
    plane_map : PlaneMap, solved from the reading of ``sound``
    sound : ScreenedReading, px and mm
    optics : OpticsSection, what was known of the camera
    """
    mm, px = residuals(plane_map, sound.reading)
    versions = {"lscan": __version__, **others_versions("lscan.planemaps", map_name)}
    software = ", ".join(f"{name} {version}" for name, version in versions.items())
    return Calibration(
        map_name, plane_map, sound.reading, mm, px, optics, software, sound.outliers_mm
    )


def resolve(calibration: Calibration) -> Calibration:
    """The same calibration solved again from the marks and the optics it holds.

    Parameters
    ----------
    calibration : Calibration, its reading, name and optics count

    Raises
    ------
    InputError, BoardNotFound
        As ``calibrate``.
    """
    again = calibrate(calibration.reading, calibration.name, calibration.optics)
    return replace(again, outliers_mm=np.vstack([calibration.outliers_mm, again.outliers_mm]))


def residuals(plane_map: PlaneMap, reading: BoardReading) -> tuple[Floats, Floats]:
    """Residuals of the control points, (N, 2) in mm and (N, 2) in px, NaN where there is none.

    In px: the shift of the mark that would make up for the residual, by the map's Jacobian.

    Parameters
    ----------
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    reading : BoardReading, px and mm, of N control points
    """
    image = reading.grid.image_px
    mm = _points(plane_map, image) - reading.grid.board_mm
    return mm, in_picture(plane_map, image, mm)


def in_picture(plane_map: PlaneMap, image_px: Floats, shift_mm: Floats) -> Floats:
    """(N, 2) px: how far pixels must move for the map to move them so far, by the map's Jacobian.

    NaN where the map has none.

    Parameters
    ----------
    plane_map : PlaneMap, from pixels to the laser sheet
    image_px : (N, 2) array, px, of (u, v)
    shift_mm : (N, 2) array, mm, of (x, z) in the plane frame
    """
    jacobian = pixel_derivatives(partial(_points, plane_map), image_px)
    finite = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(shift_mm).all(axis=1)
    known = np.flatnonzero(finite)
    known = known[np.linalg.det(jacobian[known]) != 0]
    px = np.full_like(shift_mm, np.nan)
    px[known] = np.linalg.solve(jacobian[known], shift_mm[known, :, None])[:, :, 0]
    return px


def _points(plane_map: PlaneMap, image_px: Floats) -> Floats:
    """(N, 2) mm of pixels, in less time where the map need not state its uncertainty."""
    solved = getattr(plane_map, "chosen", plane_map)  # of auto
    if isinstance(solved, SolvedMap):
        return solved.locate(image_px)
    return plane_map.to_plane(image_px).xz_mm


def _rms(pairs: Floats) -> float:
    return float(np.sqrt(np.nanmean((pairs**2).sum(axis=1))))


# How well plane maps predict marks that they have not seen.
#
# The marks found are dealt to folds; each fold in turn is taken off the board, the map is solved
# from the others and judged on it.  Control points and ruler marks take part alike. What a map errs
# by on a mark held out is mostly the noise of that mark, the same for all maps: so maps are
# compared mark by mark, and those whose difference is not significant are called tied.


FOLDS = 8
FEWER_FOLDS = {"refractive": 2}
"""Families whose solution takes long: so many folds are taken off the board together."""

COMPLETE = 0.95  # of the marks that any map values, which the best must value too
SAME = 1e-6  # of the pitch: marks closer on the board are one mark and share a fold


@dataclass(frozen=True)
class Score:
    """How a map did on the marks held out of it.

    Attributes
    ----------
    name : str, full name of the map
    rms_mm, max_mm : float, mm, distance from the nominal place, over the marks that got a value
    sigma_mm : float, mm, standard uncertainty that the map states of itself at those places, the
        marks' own left out: rms of the two coordinates together
    tied : bool, whether its mean squared error is no more than one standard error above the least
    points : int, how many marks got a value
    without_value : int, how many did not, because they lie beyond what the other marks cover or
        where the map has gaps
    ms : float or None, ms, median time of one solution; None where it was not kept
    refused : str or None, why the map could not be solved; it then has no figures
    """

    __pydantic_config__ = STRICT
    name: str
    rms_mm: NotNegative | None = None
    max_mm: NotNegative | None = None
    sigma_mm: NotNegative | None = None
    tied: Annotated[bool, Field(strict=True)] = False
    points: Count = 0
    without_value: Count = 0
    ms: NotNegative | None = None
    refused: str | None = None


@dataclass(frozen=True)
class Trial:
    """How a map did, mark by mark.

    Attributes
    ----------
    score : Score, mm
    square : (N,) array, mm², squared error on each mark; NaN where it has none
    solved : PlaneMap or None, the map from all marks, where the folds' solutions began at it
    """

    score: Score
    square: Floats
    solved: PlaneMap | None = None


def try_maps(
    reading: BoardReading,
    names: Sequence[str],
    optics: OpticsSection | None = None,
    folds: int = FOLDS,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[Trial, ...]:
    """The trial of each map named, all on the same folds, in the order of ``names``.

    A map that refuses the reading, or any part of it, is scored as refused with its reason.

    Parameters
    ----------
    reading : BoardReading, px and mm, whose marks are dealt to the folds
    names : sequence of str, full names of maps
    optics : OpticsSection, optional, what is known of the camera beforehand
    folds : int, 2 or more
    seed : int, of the generator that deals the marks
    progress : callable, optional, called with the number of maps done, and of all

    Raises
    ------
    InputError
        For fewer than two folds.

    References
    ----------
    The one-standard-error rule: Breiman, Friedman, Olshen & Stone, Classification and Regression
    Trees (1984), sec. 3.4.3.
    """
    if folds < 2:
        raise InputError("too few folds", where="folds", value=folds, allowed="2 or more")
    fold = deal(reading, folds, np.random.default_rng(seed))
    trials: list[Trial] = []
    smooth: dict[int, PlaneMap] = {}
    for done, name in enumerate(names):
        if progress is not None:
            progress(done, len(names))
        together = FEWER_FOLDS.get(name.partition("-")[0], 1) if folds > 2 else 1
        try:
            trials.append(_trial(reading, find_solver(name), optics, fold // together, smooth))
        except (InputError, BoardNotFound) as refusal:
            none = np.full(len(fold), np.nan)
            trials.append(Trial(Score(name, refused=str(refusal)), none))
    return _with_ties(trials)


def deal(reading: BoardReading, folds: int, rng: np.random.Generator) -> Ints:
    """(N,) the fold of each mark: first the grid's, then each ruler's, found or not.

    Places on the board are gone through column by column; of any ``folds`` in succession,
    each goes to another fold.  So no fold takes two neighbours or a whole border away, but
    for chance at the ends of columns.  Marks at one place share a fold: they hold the same
    error, and one would betray the other.

    Parameters
    ----------
    reading : BoardReading, of N marks
    folds : int, 2 or more
    rng : Generator, of NumPy, which deals
    """
    places = joined_marks(reading).board_mm
    steps = np.round(places / (SAME * reading.pitch_mm)).astype(np.int64)
    different, place = np.unique(steps, axis=0, return_inverse=True)
    rounds = -(-len(different) // folds)
    dealt = np.concatenate([rng.permutation(folds) for _ in range(rounds)])
    return dealt[: len(different)][place.ravel()]


def _trial(
    reading: BoardReading,
    solver: NamedSolver,
    optics: OpticsSection | None,
    fold: Ints,
    smooth: dict[int, PlaneMap],
) -> Trial:
    """smooth: the spline without each fold, kept once it is solved and set beside what follows."""
    marks, exact = joined_marks(reading), dict.fromkeys(BoardKnown.__annotations__, 0.0)
    flat = (optics or NOTHING_KNOWN).model_copy(update=exact)  # what the board does, all maps share
    error, sigma = np.full((2, len(fold), 2), np.nan)
    whole, ms = None, []
    if solver.searches:
        whole, whole_ms = _solve_timed(solver, reading, optics)
        solver = solver.near(whole)
    for number in np.unique(fold[marks.found]):
        held_out = marks.found & (fold == number)
        plane_map, fold_ms = _solve_timed(solver, without(reading, held_out), flat)
        ms.append(fold_ms if whole is None else whole_ms)
        if solver.name == "spline":
            smooth[number] = plane_map
        if number in smooth:
            plane_map = with_hidden_errors(plane_map, reading, flat, smooth[number])
        points = plane_map.to_plane(marks.image_px[held_out])
        error[held_out], sigma[held_out] = points.xz_mm - marks.board_mm[held_out], points.sigma_mm
    square, stated = (error**2).sum(axis=1), (sigma**2).sum(axis=1)
    score = _summary(solver.name, square[marks.found], stated[marks.found], float(np.median(ms)))
    return Trial(score, square, whole)


def _solve_timed(
    solver: NamedSolver, reading: BoardReading, optics: OpticsSection | None
) -> tuple[PlaneMap, float]:
    """The map solved from a reading, and the milliseconds it took."""
    start = perf_counter()
    solved = solver.solve(reading, optics)
    return solved, 1e3 * (perf_counter() - start)


def _summary(name: str, square: Floats, stated: Floats, ms: float) -> Score:
    valued = np.isfinite(square)
    if not valued.any():
        return Score(name, without_value=len(square), ms=ms, refused="gives no mark a value")
    return Score(
        name=name,
        rms_mm=float(np.sqrt(square[valued].mean())),
        max_mm=float(np.sqrt(square[valued].max())),
        sigma_mm=float(np.sqrt(stated[valued].mean())),
        points=int(valued.sum()),
        without_value=int((~valued).sum()),
        ms=ms,
    )


def _with_ties(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """The trials, those tied with the least error among the complete marked.

    The one-standard-error rule (Breiman, Friedman, Olshen & Stone, Classification and
    Regression Trees (1984), sec. 3.4.3), here with the standard error of the mean difference
    of the squared errors, mark by mark: the marks' own noise is in both and drops out.
    """
    most = max((trial.score.points for trial in trials), default=0)
    complete = [t for t in trials if t.score.points > 0 and t.score.points >= COMPLETE * most]
    if not complete:
        return tuple(trials)
    best = min(complete, key=lambda trial: trial.score.rms_mm or 0.0)
    return tuple(
        replace(t, score=replace(t.score, tied=_is_tied(t.square - best.square))) for t in trials
    )


def _is_tied(more: Floats) -> bool:
    more = more[np.isfinite(more)]
    return len(more) > 1 and bool(more.mean() <= more.std(ddof=1) / np.sqrt(len(more)))
