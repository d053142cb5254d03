"""From the experiment's numbers to results.json and the report."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from lscan.acquisition.run import software_versions
from lscan.board import draw_overlay
from lscan.calibration.maps.drawing import graticule_lines, ruler_conversions
from lscan.calibration.maps.graticule import Graticule
from lscan.calibration.solve import calibrate, save_calibration
from lscan.figures.reportfigure import RowFits, RulerCurve, SliceData
from lscan.files.disk import make_folder, write_atomically
from lscan.paper.evaluation import Experiment
from lscan.paper.experiment import BoardResult, SandwaveResult, lengths_json
from lscan.paper.published import CHOSEN_MAP
from lscan.paper.report import ReportInputs, write_report
from lscan.records import BoardReading, Floats
from lscan.surface import levelling_step, save_points, save_surface

FITS = ("graticule-1", "graticule-2", "graticule-bspline")  # Fig. 13


def experiment_json(experiment: Experiment) -> dict[str, Any]:
    """What results.json holds, without what only the tank's truth can tell.

    ``pictures``: each run's camera driver, and of the tank's the noise seed.  ``chain``: what
    turned them into the lengths that follow.  ``best``: the same of the best chain, with its own
    ``chain``, ``distances``, ``diameters``, ``groove`` and ``sandwave``, or, where it could not
    be followed, the reason as ``refused``.
    """
    grid = experiment.board.reading.grid
    best = experiment.best
    return {
        "scene": experiment.scene,
        "versions": software_versions(),
        "seconds": {name: round(value, 2) for name, value in experiment.seconds.items()},
        "pictures": {part: source.as_json() for part, source in experiment.sources.items()},
        "control_points": {"expected": len(grid.found), "found": int(grid.found.sum())},
        **_measures_json(experiment),
        "best": _measures_json(best) if best else {"refused": experiment.best_refused},
    }


def _measures_json(experiment: Experiment) -> dict[str, Any]:
    """What one chain measured."""
    board = experiment.board
    measures: dict[str, Any] = {
        "chain": asdict(experiment.chain),
        "distances": {name: lengths_json(found) for name, found in board.distances.items()},
        "diameters": {name: lengths_json(found) for name, found in board.diameters.items()},
    }
    if experiment.groove:
        measures["groove"] = lengths_json(experiment.groove.dimensions)
    if experiment.sandwave:
        measures["sandwave"] = sandwave_json(experiment.sandwave)
    return measures


def sandwave_json(result: SandwaveResult) -> dict[str, Any]:
    """The entry "sandwave" of results.json; the true yaw is the tank's to add.

    About a shaft there is no yaw: None.
    """
    yaw_deg = float(np.degrees(result.alignment.yaw_rad)) if result.alignment.sheared else None
    return {
        "frames": len(result.raw.position_mm),
        "step_mm": result.step_mm,
        "yaw_deg": {"estimated": yaw_deg},
        "slices": {name: errors.as_json() for name, errors in result.errors.items()},
    }


def write_experiment(
    folder: Path, experiment: Experiment, results: Mapping[str, Any] | None = None
) -> Mapping[str, Any]:
    """Write results.json, report.html, the calibrations and the surface; return the results.

    results: what results.json shall hold; ``experiment_json`` if None.
    """
    results = experiment_json(experiment) if results is None else results
    make_folder(folder)
    best = experiment.best.board.calibrations if experiment.best else {}
    for name, calibration in (experiment.board.calibrations | best).items():
        save_calibration(folder / f"calibration-{name}.json", calibration)
    if experiment.sandwave:
        save_surface(folder / "sandwave.nc", experiment.sandwave.aligned)
        save_points(folder / "sandwave.ply", experiment.sandwave.aligned)
    text = json.dumps(results, indent=2, allow_nan=False) + "\n"
    write_atomically(folder / "results.json", text.encode())
    write_report(folder / "report.html", report_inputs(experiment, results))
    return results


def report_inputs(experiment: Experiment, results: Mapping[str, Any]) -> ReportInputs:
    """What the report's page is drawn from."""
    board, groove, sandwave = experiment.board, experiment.groove, experiment.sandwave
    inputs = ReportInputs(
        results=results,
        board_image=board.image,
        board_overlay=draw_overlay(board.image, board.reading),
        reading=board.reading,
        row=_row_fits(board),
        ruler=_ruler_curve(board),
    )
    if groove:
        inputs = replace(inputs, groove_image=groove.image, groove_stripe=groove.stripe)
    return _with_sandwave(inputs, sandwave) if sandwave else inputs


def _with_sandwave(inputs: ReportInputs, sandwave: SandwaveResult) -> ReportInputs:
    alignment, raw = sandwave.alignment, sandwave.raw
    levelling = levelling_step(alignment.normal)
    unsheared = raw.xyz_mm @ alignment.rotation.T + alignment.translation_mm
    return replace(
        inputs,
        sandwave_images=sandwave.images,
        sandwave_stripe=sandwave.stripe,
        raw=raw,
        levelled=raw.xyz_mm @ levelling.T,
        corners=_levelled_corners(sandwave, levelling),
        turned=unsheared,
        aligned=sandwave.aligned,
        slices={name: _slice_data(sandwave, name) for name in sandwave.slices},
    )


def _levelled_corners(sandwave: SandwaveResult, levelling: Floats) -> tuple[Floats, Floats]:
    """W_L and W_R on the base plane, in the axes of the levelled raw data."""
    alignment = sandwave.alignment
    corners = [
        levelling @ alignment.to_raw(np.array([*corner, alignment.base_mm]))
        for corner in (alignment.left_corner_mm, alignment.right_corner_mm)
    ]
    return corners[0], corners[1]


def _slice_data(sandwave: SandwaveResult, name: str) -> SliceData:
    cut, errors = sandwave.slices[name], sandwave.errors[name]
    return SliceData(
        along_mm=cut.along_mm,
        measured_mm=cut.z_mm,
        status=cut.status,
        nominal_mm=errors.nominal_mm,
        error_mm=errors.error_mm,
        sigma_mm=cut.sigma_z_mm,
        ends_mm=cut.xy_mm[[0, -1]],
    )


def _row_fits(board: BoardResult) -> RowFits:
    """The middle row of control points with its three fits, and with one point moved by 1 px."""
    rows, columns = board.reading.shape
    row, moved = rows // 2, columns // 2
    shifted = _shift_mark(board.reading, row * columns + moved)
    fits = {name: board.calibrations[name].plane_map for name in FITS}
    again = {name: calibrate(shifted, name).plane_map for name in FITS}
    lattice = slice(row * columns, (row + 1) * columns)
    at_mm = float(board.reading.grid.board_mm[lattice][0, 1])
    return RowFits(
        points_px=board.reading.grid.image_px[lattice],
        curves={name: _latitude(plane, at_mm) for name, plane in fits.items()},
        shifted_px=shifted.grid.image_px[lattice],
        shifted_curves={name: _latitude(plane, at_mm) for name, plane in again.items()},
    )


def _shift_mark(reading: BoardReading, index: int) -> BoardReading:
    """The reading with one control point one pixel higher in the picture (Fig. 33)."""
    image_px = reading.grid.image_px.copy()
    image_px[index, 1] -= 1.0
    return replace(reading, grid=replace(reading.grid, image_px=image_px))


def _latitude(plane_map: Any, at_mm: float) -> Floats:
    """(K, 2) points in px of the latitude line at z = at_mm."""
    assert isinstance(plane_map, Graticule)
    lines = [line for line in graticule_lines(plane_map) if line.kind == "latitude"]
    return min(lines, key=lambda line: abs(line.at_mm - at_mm)).image_px


def _ruler_curve(board: BoardResult) -> RulerCurve | None:
    """The conversion curve of the last upright ruler, None where the board has none (Fig. 16)."""
    plane_map = board.calibrations[CHOSEN_MAP].plane_map
    assert isinstance(plane_map, Graticule)
    upright = [
        curve
        for curve in ruler_conversions(plane_map, board.reading)
        if curve.direction == "vertical"
    ]
    if not upright:
        return None
    chosen = upright[-1]
    return RulerCurve(
        name=f"at x = {chosen.at_mm:g} mm",
        coordinate="z",
        marks_px=chosen.marks_px,
        marks_mm=chosen.marks_mm,
        curve_px=chosen.curve_px,
        curve_mm=chosen.curve_mm,
    )
