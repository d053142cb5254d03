"""An old calibration against a new picture of the board: does it still hold, and what corrects it?

The marks of the new picture are taken to the sheet by the old map and compared with their
nominal places.  Nobody puts a board back just where it was, so a shift and a turn in the
sheet are fitted and reported but do not speak against the calibration; a change of scale or
of shape does.  A shift does only where it is said how well the board was put back, in the frame
that the calibration took from the board; that of a metric calibration is another.

Residuals count by their covariance: each mark's own uncertainty, and the errors that the old
calibration gives to all marks in common.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.special import chdtrc, ndtr

from lscan.calibration.calibrate import Calibration, ScreenedReading, calibration_by
from lscan.calibration.calibrationfile import AnyCalibration
from lscan.calibration.maps.auto import Auto, with_chosen
from lscan.calibration.marks import all_marks, found_marks
from lscan.calibration.metric.planemap import Metric
from lscan.calibration.offsheet import Similarity, fit_similarity
from lscan.calibration.physical import PhysicalMap
from lscan.calibration.planemap import (
    MOST_SCALE,
    NOTHING_KNOWN,
    PlaneMap,
    SheetCorrection,
    SolvedMap,
)
from lscan.camera.optics import UNKNOWN_WATER, stated_port, stated_water
from lscan.camera.posedboards import LIMITS, WATER
from lscan.config.rig import OpticsSection, Rig, SinceSection
from lscan.errors import InputError, MeasurementError
from lscan.records import BoardReading, Floats, PlanePoints, Status

# The index of the water with which a physical map fits a new picture of the board best.


INDEX_STEP = 1e-4  # for differences by the index: 0.1 px, of which the second order is 1e-5 px
ROUNDS = 3  # the map is nearly linear in the index: 0.01 of it is off by 1 % after the first


@dataclass(frozen=True)
class FoundIndex:
    """The index of the water, everything else being where the calibration has it.

    Attributes
    ----------
    index, sigma : float, relative to air, and its standard uncertainty
    chi_square : float, of the residuals that it leaves
    """

    index: float
    sigma: float
    chi_square: float


def find_index(
    plane_map: PhysicalMap, nominal_mm: Floats, image_px: Floats, sigma_px: Floats
) -> tuple[FoundIndex, PhysicalMap]:
    """The index by generalised least squares, with a shift and a turn of the board beside it.

    It is sought within the camera's LIMITS.  The map in that water comes with it, whose modes know
    which errors of the old calibration the index has taken up: lengths may be known well where the
    index is not.

    Parameters
    ----------
    plane_map : PhysicalMap, behind a flat port
    nominal_mm : (N, 2) array, mm, of the marks on the board
    image_px : (N, 2) array, px, of (u, v), where the new picture has them
    sigma_px : (N,) array, px, standard uncertainties of those
    """
    index = float(plane_map.geometry.theta[WATER])
    least, most = LIMITS["water_index"]
    for _ in range(ROUNDS):
        index = float(np.clip(index, least + INDEX_STEP, most - INDEX_STEP))
        there = plane_map.in_water((index, 0.0))
        points = there.to_plane(image_px, sigma_px)
        above, below = (
            plane_map.in_water((index + step, 0.0)).locate(image_px)
            for step in (INDEX_STEP, -INDEX_STEP)
        )
        missed = (below - above) / (2 * INDEX_STEP)  # where the index is a unit more than taken
        fit = fit_similarity(nominal_mm, points.xz_mm, points.sigma_mm, points.modes_mm, missed)
        index += fit.scale
    variance = float(fit.covariance[3, 3])
    alone = np.sqrt(max(0.0, variance - float(fit.of_modes @ fit.of_modes)))
    found = FoundIndex(float(np.clip(index, least, most)), np.sqrt(variance), fit.chi_square)
    return found, there.with_index_error(fit.of_modes, alone)


# A plane map carried from the rig it was calibrated on to the rig of a scan.
#
# What the scan's rig says of its water, and of what may have changed since the calibration.


ALLOWED = "a refractive or metric map, or a calibration of the same water and rig"
SAME_INDEX = 1e-4  # a difference of a degree; it changes 300 mm by 0.02 mm


def map_for_rig(plane_map: PlaneMap, rig: Rig) -> PlaneMap:
    """The map for the pictures of a rig: in its water, with what may have changed since.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    rig : Rig, of the scan: its ``[optics]`` and ``[since_calibration]`` count

    Raises
    ------
    InputError
        For a map that does not know the physics.
    """
    plane_map, since = in_water_of(plane_map, rig.optics), rig.since_calibration
    if since is None or not any(dict(since).values()):
        return plane_map
    return with_chosen(plane_map, lambda solved: _with_changes_since(solved, since))


def in_water_of(plane_map: PlaneMap, optics: OpticsSection) -> PlaneMap:
    """The map for pictures taken in the water that an [optics] states, and its uncertainty.

    The same map where the calibration's own rig stated that water, and where none is stated.
    Where the calibration stated none, its map stays as it is, for nobody knows whether this is
    another water, and what another water would do is in its uncertainty.  So does a map that does
    not know the physics where the two indices agree within SAME_INDEX.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    optics : OpticsSection, of the scan's rig

    Raises
    ------
    InputError
        For a map that does not know the physics, and where calibration and rig state different
        ports.
    """
    return with_chosen(plane_map, lambda solved: _in_stated_water(solved, optics))


def _in_stated_water(solved: SolvedMap, optics: OpticsSection) -> SolvedMap:
    _require_same_port(solved, optics)
    water, own = stated_water(optics), solved.stated_water
    if water is None or water == own or optics.port == "none":
        return solved
    if isinstance(solved, PhysicalMap):
        return solved.beside_water(water) if own is None else solved.in_water(water)
    index, sigma = own or UNKNOWN_WATER
    differs = float(np.hypot(np.hypot(water[0] - index, water[1]), sigma))
    if own is not None and differs <= SAME_INDEX:
        return solved
    if own is None or abs(water[0] - index) <= SAME_INDEX:
        # Behind a flat port lengths go inversely with the index, but for the air before the glass.
        middle = solved.points(solved.region.outline_px.mean(axis=0)[None])[0]
        unsure = SheetCorrection(middle_mm=middle, scale_sigma=differs / index)
        return solved.model_copy(update={"corrections": (*solved.corrections, unsure)})
    raise InputError(
        f"plane map {solved.name!r} cannot be carried to other water",
        where="optics",
        value=f"index {water[0]:.5f}, calibrated at {own[0]:.5f}",
        allowed=ALLOWED,
    )


def _require_same_port(solved: SolvedMap, optics: OpticsSection) -> None:
    """Refuse a calibration in air for pictures through a port, and the reverse."""
    stated, own = stated_port(optics), solved.stated_port
    if isinstance(solved, PhysicalMap):
        own = solved.geometry.port
    if None not in (stated, own) and stated != own:
        raise InputError(
            "states another port than the calibration",
            where="optics.port",
            value=stated,
            allowed=f'"{own}", as calibrated, or a calibration through this port (one made in air '
            'through the window states port = "flat", water_index = [1.0, 0.0])',
        )


def kept_for_want_of_water(plane_map: PlaneMap, optics: OpticsSection) -> str:
    """What a user should know of a map that is not carried to the water stated; "" where it is.

    Parameters
    ----------
    plane_map : PlaneMap, as calibrated
    optics : OpticsSection, of the scan's rig
    """
    solved, water = plane_map.chosen if isinstance(plane_map, Auto) else plane_map, None
    if isinstance(solved, SolvedMap) and solved.stated_water is None and optics.port == "flat":
        water = stated_water(optics)
    if water is None:
        return ""
    return (
        f"the calibration does not say in which water it was made: its map is not carried to that "
        f"of index {water[0]:.4f} which the scan's [optics] states, and its uncertainty is that of "
        "water that may be another; calibrate with temperature_c or water_index in [optics]"
    )


def _with_changes_since(solved: SolvedMap, since: SinceSection) -> SolvedMap:
    if isinstance(solved, PhysicalMap):
        return solved.with_changes_since(since)
    what = "says of the rig what this plane map knows nothing of"
    raise InputError(what, where="since_calibration", value=solved.name, allowed=ALLOWED)


# An old calibration against a new picture of the board: does it still hold, and what corrects it?


LEVEL = 0.01
LEAST_MARKS = 6
WORST = 5  # marks named


@dataclass(frozen=True)
class CheckedMark:
    """One mark of a checked calibration.

    Attributes
    ----------
    name : str, of the mark
    residual_mm : tuple of float, mm, how far off its place, (x, z)
    ratio : float, the same in sigmas
    """

    name: str
    residual_mm: tuple[float, float]
    ratio: float


@dataclass(frozen=True)
class CalibrationCheck:
    """How an old calibration did on a new board picture.

    Attributes
    ----------
    marks : int, how many were compared
    without_value : int, found, but outside what the map covers
    raw_rms_mm, raw_max_mm : float, mm, distance of the marks from their nominal places as they are
    rms_mm, max_mm : float, mm, the same once the board's shift and turn are taken out
    shift_mm, shift_sigma_mm : tuple of float, mm, (x, z) of the middle of the marks
    turn_deg, turn_sigma_deg : float, degrees, from x to z
    scale_error, scale_sigma : float, mapped lengths over nominal lengths, less 1
    chi_square : float, of the residuals once the scale is taken out too
    degrees_of_freedom : int, of chi_square
    usual : float, chi-square a degree of freedom of the marks the map was solved from, 1 at least
    level : float, chance at which a calibration that still holds is said not to
    reasons : tuple of str, which of "scale", "shape", "shift" disagree; none where the calibration
        holds
    worst : tuple of CheckedMark, those that are the most sigmas off their places, the worst first
    index : FoundIndex or None, the index of the water that fits the picture best; None for a map
        that knows of no water
    """

    marks: int
    without_value: int
    raw_rms_mm: float
    raw_max_mm: float
    rms_mm: float
    max_mm: float
    shift_mm: tuple[float, float]
    shift_sigma_mm: tuple[float, float]
    turn_deg: float
    turn_sigma_deg: float
    scale_error: float
    scale_sigma: float
    chi_square: float
    degrees_of_freedom: int
    usual: float
    level: float
    reasons: tuple[str, ...]
    worst: tuple[CheckedMark, ...]
    index: FoundIndex | None

    @property
    def agrees(self) -> bool:
        """Whether nothing speaks against the calibration."""
        return not self.reasons


def check_calibration(
    calibration: AnyCalibration,
    reading: BoardReading,
    level: float = LEVEL,
    placed_mm: float | None = None,
    optics: OpticsSection | None = None,
) -> CalibrationCheck:
    """The calibration's score on a new reading of its board.

    Parameters
    ----------
    calibration : Calibration or MetricCalibration, the old one
    reading : BoardReading, px and mm, of a new picture
    level : float, chance of a false alarm, shared evenly by the questions asked
    placed_mm : float, optional, mm, standard uncertainty, in x and in z, with which the board was
        put back where the calibration has it; by default not known, and the shift is not judged
    optics : OpticsSection, optional, of the rig that took the picture: the water that it states; by
        default the calibration's

    Raises
    ------
    InputError
        For a picture of another size, for a level or placed_mm that makes no sense, and for a map
        that cannot be carried to the water that ``optics`` states.
    MeasurementError
        Where fewer than six marks get a value.
    """
    require_comparable(calibration, reading, placed_mm)
    if not 0 < level < 1:
        raise InputError("bad chance", where="level", value=level, allowed="between 0 and 1")
    plane_map = in_water_of(calibration.plane_map, optics or NOTHING_KNOWN)
    compared = compare(plane_map, reading)
    names, nominal, points, fit = compared.names, compared.nominal_mm, compared.points, compared.fit
    residual, usual = points.xz_mm - fit.motion.apply(nominal), _usual(calibration)
    sigma = np.sqrt(np.diag(fit.covariance))
    return CalibrationCheck(
        marks=len(nominal),
        without_value=compared.without_value,
        **_distances("raw_", points.xz_mm - nominal),
        **_distances("", residual),
        shift_mm=_pair(fit.motion.shift_mm),
        shift_sigma_mm=_pair(sigma[:2]),
        turn_deg=float(np.degrees(fit.motion.turn_rad)),
        turn_sigma_deg=float(np.degrees(sigma[2])),
        scale_error=fit.scale,
        scale_sigma=compared.scale_sigma,
        chi_square=fit.chi_square,
        degrees_of_freedom=fit.degrees_of_freedom,
        usual=usual,
        level=level,
        reasons=_reasons(compared, usual, level, placed_mm),
        worst=_worst(names, residual, points.sigma_mm),
        index=_index(plane_map, compared),
    )


def require_comparable(
    calibration: AnyCalibration, reading: BoardReading, placed_mm: float | None
) -> None:
    """Refuse a picture that cannot be compared with a calibration, and a placing without sense.

    Parameters
    ----------
    calibration : Calibration or MetricCalibration, the old one
    reading : BoardReading, px and mm, of a new picture
    placed_mm : float or None, mm, standard uncertainty with which the board was put back

    Raises
    ------
    InputError
        Says which, and what is allowed.
    """
    size = calibration.image_size
    if tuple(reading.image_size) != tuple(size):
        what = "the picture is not of the size of the calibration's"
        allowed = f"{size[0]} x {size[1]} px"
        raise InputError(what, where="image size", value=tuple(reading.image_size), allowed=allowed)
    if placed_mm is not None and not 0 <= placed_mm < np.inf:
        what = "bad uncertainty"
        raise InputError(what, where="placed_mm", value=placed_mm, allowed="0 mm or more")
    if placed_mm is not None and not isinstance(calibration, Calibration):
        what = "the frame of a metric calibration is not the board's: its shift cannot be judged"
        allowed = "a calibration from one picture of the board"
        raise InputError(what, where="placed_mm", value=placed_mm, allowed=allowed)


def _named_marks(reading: BoardReading) -> tuple[np.ndarray, Floats, Floats, Floats]:
    """Names (N,), nominal (N, 2) mm, image (N, 2) px and sigma (N,) px of all marks found."""
    columns = reading.shape[1]
    names = [
        f"control point row {k // columns + 1} column {k % columns + 1}"
        for k in np.flatnonzero(reading.grid.found)
    ]
    for ruler in reading.rulers:
        along = 1 if ruler.direction == "vertical" else 0
        names += [
            f"{ruler.direction} ruler at {ruler.at_mm:g} mm, mark {place:g} mm"
            for place in ruler.marks.board_mm[ruler.marks.found, along]
        ]
    return np.array(names, dtype=object), *found_marks(all_marks(reading))


@dataclass(frozen=True)
class ComparedMarks:
    """The N marks that got a value, and the motion and scale from nominal to mapped.

    Attributes
    ----------
    names : (N,) array of str
    nominal_mm : (N, 2) array, mm, on the board
    image_px, sigma_px : (N, 2) and (N,) arrays, px, in the picture
    points : PlanePoints, mm, mapped
    without_value : int, marks found that got none
    fit : Similarity, from nominal to mapped
    scale_sigma : float, of the scale, with what the map does not explain
    """

    names: np.ndarray
    nominal_mm: Floats
    image_px: Floats
    sigma_px: Floats
    points: PlanePoints
    without_value: int
    fit: Similarity
    scale_sigma: float


def compare(plane_map: PlaneMap, reading: BoardReading) -> ComparedMarks:
    """The marks of a reading, mapped, beside their nominal places.

    Parameters
    ----------
    plane_map : PlaneMap, of the camera that took the picture
    reading : BoardReading, px and mm

    Raises
    ------
    MeasurementError
        Where fewer than six marks get a value.
    """
    names, nominal, image, sigma_px = _named_marks(reading)
    valued = plane_map.to_plane(image, sigma_px).status == Status.OK
    if valued.sum() < LEAST_MARKS:
        raise MeasurementError(
            f"of {len(valued)} marks found the calibration covers {int(valued.sum())}; "
            f"a check needs {LEAST_MARKS}"
        )
    nominal, image, sigma_px = nominal[valued], image[valued], sigma_px[valued]
    points = plane_map.to_plane(image, sigma_px)
    fit = fit_similarity(nominal, points.xz_mm, points.sigma_mm, points.modes_mm)
    allowance = _unaveraged_scale(plane_map.to_plane(image), nominal)
    return ComparedMarks(
        names=names[valued],
        nominal_mm=nominal,
        image_px=image,
        sigma_px=sigma_px,
        points=points,
        without_value=int((~valued).sum()),
        fit=fit,
        scale_sigma=float(np.hypot(np.sqrt(fit.covariance[3, 3]), allowance)),
    )


def _unaveraged_scale(alone: PlanePoints, nominal_mm: Floats) -> float:
    """The scale error there may be in what the map states without saying how it varies.

    alone: the marks by the map alone, as if the picture were exact.  What is unexplained is
    the lack of fit, and all of the noise of a map without modes.  It need not average out
    over the marks; in the worst case all of it is a change of scale.
    """
    explained = 0.0 if alone.modes_mm is None else (alone.modes_mm**2).sum(axis=2)
    unexplained = np.maximum(alone.sigma_mm**2 - explained, 0.0)
    lever = nominal_mm - nominal_mm.mean(axis=0)
    return float(np.sqrt(unexplained.sum() / (lever**2).sum()))


def _distances(prefix: str, residual_mm: Floats) -> dict[str, Any]:
    distance = np.hypot(*residual_mm.T)
    rms = float(np.sqrt(np.mean(distance**2)))
    return {f"{prefix}rms_mm": rms, f"{prefix}max_mm": float(distance.max())}


def _pair(values: Floats) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _usual(calibration: AnyCalibration) -> float:
    """How many times the map misses by the variances it states where it was solved; 1 at least.

    What it misses there is a fault of its form and no change, so new marks may be missed as much.
    A metric calibration has added what it missed to the variances already.  Where the index was
    corrected since, the marks it was solved from were seen through another water.
    """
    if not isinstance(calibration, Calibration):
        return 1.0
    own = compare(calibration.plane_map, calibration.reading)
    index = _index(calibration.plane_map, own)
    least = min(own.fit.chi_square, np.inf if index is None else index.chi_square)
    return max(1.0, least / own.fit.degrees_of_freedom)


def _index(plane_map: PlaneMap, compared: ComparedMarks) -> FoundIndex | None:
    solved = plane_map.chosen if isinstance(plane_map, Auto) else plane_map
    if not isinstance(solved, PhysicalMap) or solved.geometry.port == "none":
        return None
    return find_index(solved, compared.nominal_mm, compared.image_px, compared.sigma_px)[0]


def _reasons(
    new: ComparedMarks, usual: float, level: float, placed_mm: float | None
) -> tuple[str, ...]:
    """The questions that a calibration which holds would fail with a chance of ``level`` in all.

    usual: as ``_usual``.
    """
    fit = new.fit
    chances: dict[str, Any] = {
        "scale": 2 * ndtr(-abs(fit.scale) / new.scale_sigma),
        "shape": chdtrc(fit.degrees_of_freedom, fit.chi_square / usual),
    }
    if placed_mm is not None:
        covariance = fit.covariance[:2, :2] + placed_mm**2 * np.eye(2)
        shift = fit.motion.shift_mm
        chances["shift"] = chdtrc(2, shift @ np.linalg.solve(covariance, shift))
    return tuple(what for what, chance in chances.items() if chance < level / len(chances))


def _worst(names: np.ndarray, residual_mm: Floats, sigma_mm: Floats) -> tuple[CheckedMark, ...]:
    sigma = np.maximum(np.hypot(*sigma_mm.T), np.finfo(float).tiny)
    ratio = np.hypot(*residual_mm.T) / sigma
    order = np.argsort(ratio)[::-1][:WORST]
    return tuple(CheckedMark(names[k], _pair(residual_mm[k]), float(ratio[k])) for k in order)


# A calibration corrected by what a new picture of the board shows: scale, shift, or index.


CorrectionKind = Literal["scale", "index", "shift"]

MENDED = 3.0  # sigmas, rms, that a correction may leave, where the map itself left 1; ours

WATER_INDEX = (1.32, 1.36)
"""Water's index is from 1.3296 (30 C, fresh, 700 nm) to 1.3505 (0 C, 35 psu, 400 nm) by Quan & Fry
1995, and 0.0015 more 100 m down; the rest is for what a calibration's port may be off."""


def fitting_corrections(found: CalibrationCheck) -> tuple[CorrectionKind, ...]:
    """What corrects what a check found; nothing where the calibration holds.

    A wrong scale is put down to the index of the water where that leaves less of the residuals than
    a change of scale, and is one of water.  Nothing here corrects a wrong shape: where either
    leaves residuals of more than MENDED of their usual size, the picture is cropped elsewhere, say.

    Parameters
    ----------
    found : CalibrationCheck, of the picture that is to correct
    """
    kinds: list[CorrectionKind] = []
    index = found.index
    least = min(found.chi_square, np.inf if index is None else index.chi_square)
    if least > MENDED**2 * found.usual * found.degrees_of_freedom:
        return ()
    if "scale" in found.reasons:
        by_water = (
            index is not None
            and WATER_INDEX[0] <= index.index <= WATER_INDEX[1]
            and index.chi_square < found.chi_square
        )
        kinds.append("index" if by_water else "scale")
    if "shift" in found.reasons:
        kinds.append("shift")
    return tuple(kinds)


def corrected_calibration(
    calibration: AnyCalibration,
    reading: BoardReading,
    kinds: Sequence[CorrectionKind],
    placed_mm: float | None = None,
    optics: OpticsSection | None = None,
) -> AnyCalibration:
    """The calibration with its map corrected, and the uncertainty of that in the map's.

    What the corrections leave of the new marks' residuals, beyond what the map states, is added to
    its lack of fit.  It keeps the pictures it was solved from: solving it again gives the old map.

    Parameters
    ----------
    calibration : Calibration or MetricCalibration, the old one
    reading : BoardReading, px and mm, of the new picture
    kinds : sequence of str, what to correct, one after the other
    placed_mm : float, optional, mm, standard uncertainty, in x and in z, with which the board was
        put back; a shift needs it
    optics : OpticsSection, optional, of the rig that took the picture, as of ``check_calibration``

    Raises
    ------
    InputError
        For a picture of another size, an index where the map knows of no water, a shift without
        placed_mm or of a metric calibration, or a map of another package.
    MeasurementError
        Where fewer than six marks get a value, or lengths are off by more than MOST_SCALE.
    """
    require_comparable(calibration, reading, placed_mm)
    if "shift" in kinds and placed_mm is None:
        what = "a shift cannot be told from how the board was put back"
        allowed = "its standard uncertainty, of a calibration from one picture of the board"
        raise InputError(what, where="placed_mm", allowed=allowed)
    plane_map = in_water_of(calibration.plane_map, optics or NOTHING_KNOWN)
    for kind in kinds:
        plane_map = _with(plane_map, kind, compare(plane_map, reading), placed_mm or 0.0)
    marks = compare(plane_map, reading)
    missed = marks.points.xz_mm - marks.fit.motion.apply(marks.nominal_mm)
    excess = np.mean(missed**2, axis=0) - np.mean(marks.points.sigma_mm**2, axis=0)
    left_mm = np.sqrt(np.maximum(excess, 0.0))  # (2,) rms beyond what the map states
    plane_map = with_chosen(
        plane_map,
        lambda solved: solved.model_copy(
            update={"lack_of_fit_mm": np.hypot(solved.lack_of_fit_mm, left_mm)}
        ),
    )
    if isinstance(calibration, Calibration):
        sound = ScreenedReading(calibration.reading, calibration.outliers_mm)
        return calibration_by(calibration.name, plane_map, sound, calibration.optics)
    assert isinstance(plane_map, Metric)  # corrections keep the family
    return replace(calibration, plane_map=plane_map)


def _with(
    plane_map: PlaneMap, kind: CorrectionKind, marks: ComparedMarks, placed_mm: float
) -> PlaneMap:
    """The map with one correction."""
    middle, fit = marks.points.xz_mm.mean(axis=0), marks.fit

    def correct(solved: SolvedMap) -> SolvedMap:
        if kind == "index":
            return _with_index(solved, marks)
        if kind == "scale":
            if abs(fit.scale) > MOST_SCALE:
                what = f"lengths are off by {100 * fit.scale:+.0f} %: it is another board, or file"
                raise MeasurementError(what)
            correction = SheetCorrection(
                middle_mm=middle, scale=fit.scale, scale_sigma=marks.scale_sigma
            )
        else:
            sigma = np.hypot(np.sqrt(np.diag(fit.covariance)[:2]), placed_mm)
            correction = SheetCorrection(
                middle_mm=middle, shift_mm=fit.motion.shift_mm, shift_sigma_mm=sigma
            )
        return solved.model_copy(update={"corrections": (*solved.corrections, correction)})

    changed = with_chosen(plane_map, correct)
    if changed is plane_map:
        what = "plane map of another package: it cannot be corrected here"
        raise InputError(what, where="plane map", value=plane_map.name)
    return changed


def _with_index(solved: SolvedMap, marks: ComparedMarks) -> SolvedMap:
    """The map with the index that fits.

    The water it states stays that of the calibration, so that a scan whose rig states the same is
    not carried back.
    """
    if not isinstance(solved, PhysicalMap) or solved.geometry.port == "none":
        what = "this plane map has no index of the water to correct"
        allowed = '"scale" or "shift", or a refractive or metric map behind a port'
        raise InputError(what, where="plane map", value=solved.name, allowed=allowed)
    _, there = find_index(solved, marks.nominal_mm, marks.image_px, marks.sigma_px)
    return there.model_copy(update={"stated_water": solved.stated_water})
