"""A calibration corrected by what a new picture of the board shows: scale, shift, or index."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from lscan.calibration.api import NOTHING_KNOWN, PlaneMap
from lscan.calibration.carry import in_water_of, with_chosen
from lscan.calibration.check import CalibrationCheck, ComparedMarks, compare, require_comparable
from lscan.calibration.loading import AnyCalibration
from lscan.calibration.multiview.planemap import Metric
from lscan.calibration.outliers import ScreenedReading
from lscan.calibration.physical import PhysicalMap
from lscan.calibration.sheetcorrection import MOST_SCALE, SheetCorrection
from lscan.calibration.solve import Calibration, calibration_by
from lscan.calibration.solved import SolvedMap
from lscan.calibration.waterfit import find_index
from lscan.config.rig import OpticsSection
from lscan.errors import InputError, MeasurementError
from lscan.records import BoardReading, Floats

CorrectionKind = Literal["scale", "index", "shift"]

WATER_INDEX = (1.32, 1.36)
"""Water's index is from 1.3296 (30 C, fresh, 700 nm) to 1.3505 (0 C, 35 psu, 400 nm) by Quan & Fry
1995, and 0.0015 more 100 m down; the rest is for what a calibration's port may be off."""


def proposed(found: CalibrationCheck) -> tuple[CorrectionKind, ...]:
    """What corrects what a check found; nothing where the calibration holds.

    A wrong scale is put down to the index of the water where that leaves less of the residuals than
    a change of scale, and is one of water.  Nothing here corrects a wrong shape.

    Parameters
    ----------
    found : CalibrationCheck, of the picture that is to correct
    """
    kinds: list[CorrectionKind] = []
    if "scale" in found.reasons:
        kinds.append("index" if _by_water(found) else "scale")
    if "shift" in found.reasons:
        kinds.append("shift")
    return tuple(kinds)


def _by_water(found: CalibrationCheck) -> bool:
    """Whether another index of the water explains the scale, and better than a scale does."""
    index = found.index
    if index is None or not WATER_INDEX[0] <= index.index <= WATER_INDEX[1]:
        return False
    return index.chi_square < found.chi_square


def corrected(
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
        raise InputError(
            "a shift cannot be told from how the board was put back",
            where="placed_mm",
            allowed="its standard uncertainty, of a calibration from one picture of the board",
        )
    plane_map = in_water_of(calibration.plane_map, optics or NOTHING_KNOWN)
    for kind in kinds:
        plane_map = _with(plane_map, kind, compare(plane_map, reading), placed_mm or 0.0)
    left_mm = _left_mm(compare(plane_map, reading))
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
                raise MeasurementError(
                    f"lengths are off by {100 * fit.scale:+.0f} %: it is another board, or file"
                )
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
        raise InputError(
            "plane map of another package: it cannot be corrected here",
            where="plane map",
            value=plane_map.name,
        )
    return changed


def _left_mm(marks: ComparedMarks) -> Floats:
    """(2,) rms in x and z of what the map misses of the marks, less what it states."""
    missed = marks.points.xz_mm - marks.fit.motion.apply(marks.nominal_mm)
    excess = np.mean(missed**2, axis=0) - np.mean(marks.points.sigma_mm**2, axis=0)
    return np.sqrt(np.maximum(excess, 0.0))


def _with_index(solved: SolvedMap, marks: ComparedMarks) -> SolvedMap:
    """The map with the index that fits.

    The water it states stays that of the calibration, so that a scan whose rig states the same is
    not carried back.
    """
    if not isinstance(solved, PhysicalMap) or solved.geometry.port == "none":
        raise InputError(
            "this plane map has no index of the water to correct",
            where="plane map",
            value=solved.name,
            allowed='"scale" or "shift", or a refractive or metric map behind a port',
        )
    found = find_index(solved, marks.nominal_mm, marks.image_px, marks.sigma_px)
    moved = solved.in_water((found.index, found.sigma))
    return moved.model_copy(update={"stated_water": solved.stated_water})
