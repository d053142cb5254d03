"""The commands ``lscan reconstruct`` and ``lscan measure``: thin faces over lscan.pipeline."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lscan.cli.console import (
    AlignmentFile,
    CalibrationFile,
    Json,
    RunFolder,
    ShaftFile,
    Trust,
    note,
    print_json,
    print_table,
    progress_bar,
    require_folders,
)
from lscan.errors import InputError

if TYPE_CHECKING:
    from lscan.acquisition.run import Run
    from lscan.calibration.planemap import PlaneMap
    from lscan.config.rig import Rig
    from lscan.measure.meshes import MeshPose
    from lscan.measure.shapes import ShapeMeasure
    from lscan.paper.experiment import Experiment
    from lscan.paper.tables import TableBlock
    from lscan.pipeline import Measures, Reconstruction, SandwaveMeasures
    from lscan.records import Length, Surface


LEAST_SHARE = 0.02
"""Of the columns: a line that spans less of its pictures may be no laser line at all."""
MOST_STRETCHED = 0.005
"""Of a block along the track, 1 mm over it: screws and belts that are sound are within a tenth."""
_NO_SURFACE = (
    "there is no surface to build; a run of the board is for `lscan calibrate` and `lscan measure`"
)


def reconstruct(
    run: RunFolder,
    calibration: CalibrationFile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Surface to write (.nc).")],
    points: Annotated[Path | None, typer.Option(help="Point cloud to write (.ply).")] = None,
    alignment: AlignmentFile = None,
    save_alignment: Annotated[
        Path | None, typer.Option(help="Keep the alignment found, for other scans (.json).")
    ] = None,
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Turn a run's pictures into the surface that is measured, aligned if it is a sandwave's."""
    from lscan.cli.inputs import open_calibrated
    from lscan.config.targets import Sandwave
    from lscan.errors import MeasurementError
    from lscan.pipeline import require_piece
    from lscan.records import has_value
    from lscan.surface import save_points, save_surface
    from lscan.surface.alignment import save_alignment as keep_alignment
    from lscan.surface.files import require_storable

    require_folders(output, points, save_alignment)
    if alignment and save_alignment:
        raise InputError("goes without --alignment", where="--save-alignment")
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    camera, axis = opened.rig_file.rig.camera, opened.rig_file.rig.stripe.axis
    columns = camera.width_px if axis == "columns" else camera.height_px
    require_storable(output, len(opened), columns)  # known now, not after hours
    piece = require_piece(opened, Sandwave) if save_alignment else None
    built = _reconstructed(opened, plane_map, alignment)
    surface = built.surface
    frames, columns = surface.status.shape
    yaw_deg = built.alignment.yaw_deg if built.alignment else None
    found = int(has_value(surface.status).sum())
    if found == 0:
        raise MeasurementError(
            f"{run}: no laser line in any of its {frames} pictures, so {_NO_SURFACE}"
        )
    if found < LEAST_SHARE * surface.status.size:
        note(
            f"a line in {found} of {surface.status.size} columns alone; if the pictures show the "
            f"board, {_NO_SURFACE}"
        )
    _note_doubts(built, opened.rig_file.rig)
    if alignment is None:
        _note_scale(built.surface, opened.rig_file.rig)
    save_surface(output, surface)
    if points:
        save_points(points, surface)
    if save_alignment and piece:
        assert built.raw.provenance is not None
        keep_alignment(save_alignment, built.require_alignment(), built.raw.provenance, piece)
    if json:
        print_json(
            {
                "surface": output,
                "frame": surface.frame,
                "profiles": frames,
                "columns": columns,
                "points": found,
                "yaw_deg": yaw_deg,
                "corrections": surface.corrections,
            }
        )
    else:
        aligned = ", aligned" if surface.frame == "workpiece" else ""
        aligned += "" if yaw_deg is None else f", yaw {yaw_deg:.3f} deg"
        aligned += "".join(f", corrected for {what}" for what in surface.corrections)
        print(f"{found} points in {frames} profiles{aligned}; {output}")


def measure(
    run: Annotated[Path, typer.Argument(help="Run folder; with --shapes also a surface (.nc).")],
    calibration: Annotated[
        Path | None,
        typer.Option("--calibration", "-c", help="Calibration file (JSON), which a run needs."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write.")
    ] = None,
    shapes: Annotated[
        Path | None,
        typer.Option(help="TOML file: planes, steps, spheres, cylinders, heights to measure."),
    ] = None,
    alignment: AlignmentFile = None,
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Measure a run's board or workpiece against its nominal shape, or shapes on any surface."""
    from lscan.files.disk import write_json

    require_folders(output)
    if shapes is None:
        if alignment is not None:
            raise InputError("goes with --shapes", where="--alignment", value=str(alignment))
        measures = _measured(run, calibration, shaft, trust)
        content = measures.as_json()
    else:
        surface, found = _measured_shapes(run, calibration, shapes, alignment, shaft, trust)
        every = {one.name: one.as_json() for one in found}
        content = {"frame": surface.frame, "shapes": every}
    if output:
        write_json(output, content)
    if json:
        print_json(content)
    elif shapes is None:
        _print_measures(measures)
    else:
        _print_shapes(found)


def _measured(run: Path, calibration: Path | None, shaft: Path | None, trust: bool) -> Measures:
    """What the run shows of the piece that its rig names."""
    from lscan.cli.inputs import open_calibrated
    from lscan.pipeline import SandwaveMeasures, measure_run

    opened, plane_map = open_calibrated(run, _required(calibration, run), shaft, trust)
    with progress_bar("measure") as progress:
        measures = measure_run(opened, plane_map, progress)
    if isinstance(measures, SandwaveMeasures):
        _note_scale(measures.aligned, opened.rig_file.rig)
    return measures


def _measured_shapes(
    source: Path,
    calibration: Path | None,
    shapes: Path,
    alignment: Path | None,
    shaft: Path | None,
    trust: bool,
) -> tuple[Surface, list[ShapeMeasure]]:
    """The surface of a file or of a run, and what the shapes file asks for of it."""
    from lscan.cli.inputs import open_calibrated
    from lscan.config.targets import load_shapes
    from lscan.measure.shapes import measure_shapes
    from lscan.surface import load_surface

    wanted = load_shapes(shapes)
    if os.path.isfile(source):  # noqa: PTH113 - takes any text
        of_runs = {"--calibration": calibration, "--alignment": alignment, "--shaft": shaft}
        for option, given in of_runs.items():
            if given is not None:
                raise InputError("goes with a run folder", where=option, value=str(given))
        surface = load_surface(source)
    else:
        opened, plane_map = open_calibrated(source, _required(calibration, source), shaft, trust)
        built = _reconstructed(opened, plane_map, alignment)
        _note_doubts(built, opened.rig_file.rig)
        surface = built.surface
    return surface, measure_shapes(surface, wanted)


def _reconstructed(run: Run, plane_map: PlaneMap, alignment: Path | None) -> Reconstruction:
    """The run's surface, aligned by the alignment that a file keeps where one is named."""
    from lscan.pipeline import reconstruct as build
    from lscan.surface.alignment import load_alignment

    kept = load_alignment(alignment) if alignment else None
    with progress_bar("reconstruct") as progress:
        built = build(run, plane_map, progress, kept)
    made_from = built.raw.provenance
    if kept and made_from and made_from.calibration_sha256 != kept.provenance.calibration_sha256:
        note(
            f"yaw and level are those of {kept.source}, with another calibration: the errors of "
            "both count, as if independent"
        )
    return built


def _required(calibration: Path | None, run: Path) -> Path:
    if calibration is None:
        gone = "" if os.path.exists(run) else f", and {run} does not exist"  # noqa: PTH110 - any text
        raise InputError(
            f"is missing{gone}", where="--calibration", allowed="a file, with a run folder"
        )
    return calibration


def _note_doubts(built: Reconstruction, rig: Rig) -> None:
    """Say on stderr that a sandwave was not found, and what was assumed of the sheet."""
    if built.unaligned:
        # Too few frames show the block's edges, say: the surface itself is none the worse.
        note(f"not aligned, in the head's frame: {built.unaligned}")
    if built.alignment is None and rig.sheet is not None:
        note(
            "the sheet's thickness is corrected for as if the sheet stood square to the track: "
            "without an alignment its yaw is not known"
        )


def _note_scale(surface: Surface, rig: Rig) -> None:
    """Say on stderr that a sandwave came out longer or shorter along the track than it is."""
    from lscan.config.targets import Sandwave
    from lscan.measure import scale_along_track

    if surface.frame != "workpiece" or not isinstance(rig.workpiece, Sandwave):
        return
    scale = scale_along_track(surface, rig.workpiece)
    if abs(scale - 1) > MOST_STRETCHED:
        note(
            f"along the track the block comes out {scale:.4f} times as long as it is: the track "
            f"moves {1 / scale:.4f} of what it reports (steps per mm, a slipping belt), or the "
            "plan's positions are not where it stood"
        )


def _print_measures(measures: Measures) -> None:
    from lscan.pipeline import BoardMeasures, GrooveMeasures

    if isinstance(measures, GrooveMeasures):
        _print_lengths("groove", measures.dimensions)
    elif isinstance(measures, BoardMeasures):
        _print_lengths("distances", measures.distances)
        _print_lengths("diameters", measures.diameters)
        for name, status in measures.unmeasured.items():
            print(f"{name}: not measured, {status.name}")
    else:
        _print_slices(measures)


def _print_shapes(found: Sequence[ShapeMeasure]) -> None:
    rows = [
        [f"{one.kind} {one.name}", quantity, known.value, known.sigma]
        for one in found
        for quantity, known in one.values.items()
    ]
    print_table("shapes", ["", "", "value", "sigma"], rows)
    for one in found:
        if one.rms_mm is not None:
            print(
                f"{one.name}: {one.points} points, {one.outliers} left out, "
                f"{one.rms_mm:.3f} mm rms off the {one.kind}"
            )


def _print_lengths(title: str, lengths: Mapping[str, Length]) -> None:
    rows = [
        [name, length.nominal_mm, length.measured_mm, length.error_mm, length.sigma_mm]
        for name, length in lengths.items()
    ]
    print_table(title, ["", "nominal mm", "measured mm", "error mm", "sigma mm"], rows)


def _print_slices(measures: SandwaveMeasures) -> None:
    if measures.alignment.yaw_deg is not None:
        print(f"yaw {measures.alignment.yaw_deg:.3f} deg")
    rows = [
        [name, cut.points, cut.unseen, cut.rmse_mm, cut.min_mm, cut.max_mm]
        for name, cut in measures.errors.items()
    ]
    print_table("slices", ["", "points", "unseen", "rmse mm", "min mm", "max mm"], rows)


# The command ``lscan compare``: a thin face over lscan.measure.meshes.


def compare(
    surface: Annotated[Path, typer.Argument(help="Surface (.nc).")],
    mesh: Annotated[Path, typer.Argument(help="Mesh file: PLY, STL, OBJ or OFF.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Of the mesh: mm, cm, m or inch.")] = "mm",
    at: Annotated[
        str, typer.Option(help="x,y,z of the mesh's origin in the surface's frame, mm.")
    ] = "0,0,0",
    turn: Annotated[float, typer.Option(help="Of the mesh about z, degrees.")] = 0.0,
    fit: Annotated[
        bool, typer.Option("--fit", help="Find the pose from the points, starting from that.")
    ] = False,
    within: Annotated[
        float, typer.Option(help="mm; points farther off the mesh are not compared.")
    ] = 10.0,
    points: Annotated[
        Path | None, typer.Option(help="Points coloured by distance to write (.ply).")
    ] = None,
    histogram: Annotated[
        Path | None, typer.Option(help="Histogram of the distances to write (.png).")
    ] = None,
    json: Json = False,
) -> None:
    """Compare a surface with a mesh: the signed distances of its points."""
    from lscan.files.disk import write_json
    from lscan.files.meshes import MM_PER_UNIT, TWICE, load_mesh
    from lscan.measure.meshes import (
        MeshPose,
        compare_mesh,
        save_coloured_points,
        save_histogram,
    )
    from lscan.surface import load_surface

    require_folders(output, points, histogram)
    if unit not in MM_PER_UNIT:
        raise InputError("no such unit", where="--unit", value=unit, allowed=", ".join(MM_PER_UNIT))
    if not (np.isfinite(within) and within > 0):
        raise InputError("is not a distance", where="--within", value=within, allowed="> 0 mm")
    if not np.isfinite(turn):
        raise InputError("is not an angle", where="--turn", value=turn, allowed="degrees")
    pose = MeshPose.at(_place(at), turn)
    shape = load_mesh(mesh, MM_PER_UNIT[unit])
    found = compare_mesh(load_surface(surface), shape, pose, fit, within)
    if TWICE in shape.metadata:
        note(f"{mesh} {shape.metadata[TWICE]}")
    if output:
        write_json(output, found.as_json())
    if points:
        save_coloured_points(points, found)
    if histogram:
        save_histogram(histogram, found)
    if json:
        print_json(found.as_json())
        return
    summary = found.as_json()
    low, high = summary["central_95_mm"]
    rows = [
        ["points", summary["points"]],
        [f"not compared: farther than {within:g} mm", summary["far"]],
        ["not compared: beside the mesh", summary["beside"]],
        ["mean mm", summary["mean_mm"]["value"]],
        ["its sigma mm", summary["mean_mm"]["sigma"]],
        ["rms mm", summary["rms_mm"]],
        ["95 % between mm", f"{low:.3f} and {high:.3f}"],
        ["within 2 sigma", summary["within_2_sigma"]],
    ]
    if fit:
        rows += _pose_rows(found.pose)
    print_table("distances from the mesh", ["", ""], rows)


def _pose_rows(pose: MeshPose) -> list[list[str]]:
    """Where a mesh lies, as a scene file states it."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)
    return [
        ["mesh at x, y, z mm", ", ".join(f"{mm:.3f}" for mm in pose.translation_mm)],
        ["turned about x, y, z deg", ", ".join(f"{turn:.3f}" for turn in turns)],
    ]


def _place(text: str) -> tuple[float, float, float]:
    """(x, y, z) of "x,y,z"; InputError where it is none."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        raise InputError("not a point", where="--at", value=text, allowed="x,y,z in mm")
    return numbers[0], numbers[1], numbers[2]


# The command ``lscan report``: a thin face over lscan.paper.


_LEFT_OUT = ("\nmm", "\n%")  # columns of the page that a terminal has no room for


def report(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for report.html and results.json.")
    ],
    board: Annotated[Path, typer.Option(help="Run folder of the board picture.")],
    groove: Annotated[Path | None, typer.Option(help="Run folder of the grooved block.")] = None,
    sandwave: Annotated[Path | None, typer.Option(help="Run folder of the sandwave.")] = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Evaluate the paper's experiment from its run folders and write the page."""
    from lscan.acquisition.run import open_run
    from lscan.paper.experiment import evaluate
    from lscan.paper.report import results_json, write_experiment

    with progress_bar("evaluate") as progress:
        experiment = evaluate(
            open_run(board, trust),
            open_run(groove, trust) if groove else None,
            open_run(sandwave, trust) if sandwave else None,
            progress=progress,
        )
    write_experiment(output, experiment)
    if json:
        print_json(results_json(experiment))
    else:
        print_chains(experiment)
        print(f"{output / 'report.html'}")


def print_chains(experiment: Experiment) -> None:
    """Print where a report's pictures come from, and the errors of both chains side by side.

    Parameters
    ----------
    experiment : Experiment, as the report shows it
    """
    from lscan.paper.experiment import chain_names, describe_chains, note
    from lscan.paper.published import Bars
    from lscan.paper.tables import paper_tables

    for line in filter(None, (note(experiment.sources), describe_chains(experiment))):
        print(line)
    names = [name.removeprefix("Ours, ") for name in chain_names(experiment.chain)]
    for table in paper_tables(experiment, Bars()):
        if table.chains is not None:
            _print_block(f"{table.title}, mm", table.chains, names)


def _print_block(title: str, block: TableBlock, names: Sequence[str]) -> None:
    """The columns of errors and their sigmas: all of them are too many for a terminal."""
    groups = [("paper", block.paper_heads)]
    groups += [(name, block.our_heads) for name in (names if block.has_best else names[:1])]
    columns = [f"{name}\n{head}" for name, heads in groups for head in heads]
    kept = [k for k, column in enumerate(columns) if not column.endswith(_LEFT_OUT)]
    rows = []
    for row in block.rows:
        cells = [cell.text for cell in row.paper + row.ours + row.best]
        rows.append([row.label, *(cells[k] for k in kept)])
    print_table(title, [block.names, *(columns[k] for k in kept)], rows)
