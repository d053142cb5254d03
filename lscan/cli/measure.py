"""``lscan reconstruct``, ``grid``, ``export`` and ``measure``: a run's surface, and its files."""

import os
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Annotated

from rich.table import Table
from typer import Argument, Option

from lscan import pipeline
from lscan.acquisition.run import Run, open_run
from lscan.calibration.planemap import PlaneMap
from lscan.cli.console import Json, Trust, note, progress_bar, require_folders, show, table
from lscan.cli.inputs import open_calibrated, require_mcap
from lscan.config.rig import Rig
from lscan.config.targets import Sandwave, load_shapes
from lscan.errors import InputError, MeasurementError
from lscan.files.clouds import cloud_writer
from lscan.files.disk import write_json
from lscan.measure import scale_along_track
from lscan.measure.shapes import ShapeMeasure, measure_shapes
from lscan.pipeline import Reconstruction
from lscan.records import Length, Surface, has_value
from lscan.surface import (
    fitting_cell_mm,
    grid_cells,
    load_surface,
    save_grid,
    save_points,
    save_surface,
)
from lscan.surface.alignment import load_alignment, save_alignment as keep_alignment
from lscan.surface.files import GRIDS, require_storable
from lscan.surface.recording import head_camera, profiles_of, stamps_ns, write_recording

ShaftFile = Annotated[
    Path | None, Option(help="TOML file with the [shaft] found; a run folder has its own.")
]
LEAST_SHARE = 0.02
"""Of the columns: a line that spans less of its pictures may be no laser line at all."""
MOST_STRETCHED = 0.005
"""Of a block along the track, 1 mm over it: screws and belts that are sound are within a tenth."""
_NO_SURFACE = (
    "there is no surface to build; a run of the board is for `lscan calibrate` and `lscan measure`"
)


def reconstruct(
    run: Path = Argument(help="Run folder."),
    calibration: Path = Option(..., "--calibration", "-c", help="Calibration file (JSON)."),
    output: Path = Option(..., "--output", "-o", help="Surface to write (.nc)."),
    points: Path | None = Option(None, help="Point cloud to write: .ply, .e57, .las or .laz."),
    alignment: Path | None = Option(None, help="Alignment saved from a scan of the block (JSON)."),
    save_alignment: Path | None = Option(None, help="Alignment to write, for other scans (.json)."),
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Turn a run's pictures into a surface, aligned with the block if it is a sandwave's."""
    require_folders(output, points, save_alignment)
    if points:
        cloud_writer(points)  # what it refuses is known now, not after hours
    if alignment and save_alignment:
        raise InputError("goes without --alignment", where="--save-alignment")
    opened, plane_map = open_calibrated(run, calibration, shaft, trust)
    camera, axis = opened.rig_file.rig.camera, opened.rig_file.rig.stripe.axis
    columns = camera.width_px if axis == "columns" else camera.height_px
    require_storable(output, len(opened), columns)  # known now, not after hours
    piece = pipeline.require_piece(opened, Sandwave) if save_alignment else None
    built = _build_surface(opened, plane_map, alignment)
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
            f"only {found} of {surface.status.size} columns hold a line; if the pictures show the "
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
    content = {
        "surface": output,
        "frame": surface.frame,
        "profiles": frames,
        "columns": columns,
        "points": found,
        "yaw_deg": yaw_deg,
        "corrections": surface.corrections,
    }
    aligned = ", aligned" if surface.frame == "workpiece" else ""
    aligned += "" if yaw_deg is None else f", yaw {yaw_deg:.3f} deg"
    aligned += "".join(f", corrected for {what}" for what in surface.corrections)
    show(content, f"{found} points in {frames} profiles{aligned}; {output}", json=json)


def grid(
    surface: Path = Argument(help="Surface (.nc)."),
    output: Path = Option(
        ..., "--output", "-o", help="Grid to write: .nc, .tif (GeoTIFF), .asc, .x3p or .sdf."
    ),
    cell: float | None = Option(
        None, help="Side of the cells, mm; by default the least of which few lack points."
    ),
    json: Json = False,
) -> None:
    """Write a surface's heights on a regular grid, for programs of maps, images and roughness.

    Each height comes with its standard uncertainty and the number of its points; cells of too few
    points, and those whose points do not enclose their middle, stay without.
    """
    require_folders(output)
    if output.suffix.lower() not in GRIDS:
        allowed = ", ".join(GRIDS)
        raise InputError(
            "no such kind of grid", where="--output", value=str(output), allowed=allowed
        )
    scanned = load_surface(surface)
    found = grid_cells(scanned, fitting_cell_mm(scanned) if cell is None else cell)
    rows, columns = found.status.shape
    known = int(has_value(found.status).sum())
    files = save_grid(output, found, scanned)
    content = {
        "files": files,
        "frame": scanned.frame,
        "cell_mm": found.cell_mm,
        "rows": rows,
        "columns": columns,
        "heights": known,
    }
    words = f"{columns} x {rows} cells of {found.cell_mm:g} mm, {known} with a height"
    show(content, f"{words}; {', '.join(map(str, files))}", json=json)


def export(
    run: Path = Argument(help="Run folder."),
    output: Path = Option(..., "--output", "-o", help="Recording to write (.mcap)."),
    calibration: Path | None = Option(
        None, "--calibration", "-c", help="Calibration file (JSON): points of each picture as well."
    ),
    surface: Path | None = Option(None, help="Surface of the run (.nc), whose points are taken."),
    start: str | None = Option(
        None, help="When the first picture was taken, as 2026-05-04T09:30:00Z; else its own clock."
    ),
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Write a run as an MCAP file of ROS 2 messages, for Foxglove, Rerun and ROS 2.

    It holds pictures and positions.  With --calibration also the points of each picture, as it is
    reconstructed, neither aligned nor corrected for the sheet's thickness, and the camera's place
    and lens where the calibration knows them; --surface takes the points of `lscan reconstruct`.
    """
    require_mcap("--output", output)
    if calibration is None:
        opened, plane_map = open_run(run, trust), None
    else:
        opened, plane_map = open_calibrated(run, calibration, trusted=trust)
    stamps, camera = stamps_ns(opened, _point_in_time(start)), None
    if any(later <= earlier for earlier, later in pairwise(stamps)):
        note("the camera's clock went back in this run, as where it was resumed: so do the stamps")
    clouds: Iterable[Surface] | None = None
    if plane_map is not None:
        rig = opened.rig_file.rig
        profiles = pipeline.read_profiles(opened, plane_map)
        clouds = (pipeline.build_surface([profile], rig) for profile in profiles)
        camera = head_camera(plane_map, rig)
        if camera is None:
            note(f"the plane map {plane_map.name} knows no camera: there is no camera_info")
        elif camera.off_px > 0:
            note(
                "camera_info is that of a lens without a window: on the sheet it sees within "
                f"{camera.off_px:.2g} px what the camera does, and elsewhere it does not"
            )
    if surface is not None:
        clouds = profiles_of(load_surface(surface), opened, surface)
    with progress_bar("export") as progress:
        counts = write_recording(output, opened, stamps, clouds, camera, progress)
    words = ", ".join(f"{count} of {topic}" for topic, count in counts.items())
    show({"recording": output, "messages": counts}, f"{words}; {output}", json=json)


def _point_in_time(text: str | None) -> datetime | None:
    """The time that --start states, with its time zone."""
    try:
        time = None if text is None else datetime.fromisoformat(text)
    except ValueError:
        time = datetime.min
    if time is not None and time.tzinfo is None:
        allowed = "as 2026-05-04T09:30:00Z or 2026-05-04T11:30:00+02:00"
        raise InputError("no time with its zone", where="--start", value=text, allowed=allowed)
    return time


def measure(
    run: Path = Argument(help="Run folder; with --shapes also a surface file (.nc)."),
    calibration: Path | None = Option(
        None, "--calibration", "-c", help="Calibration file (JSON), needed for a run."
    ),
    output: Path | None = Option(None, "--output", "-o", help="JSON file to write."),
    shapes: Path | None = Option(
        None, help="TOML file of planes, steps, spheres, cylinders and heights to measure."
    ),
    alignment: Path | None = Option(None, help="Alignment saved from a scan of the block (JSON)."),
    shaft: ShaftFile = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Measure a run's board or workpiece against its nominal shape, or shapes on any surface."""
    require_folders(output)
    if shapes is None:
        if alignment is not None:
            raise InputError("goes with --shapes", where="--alignment", value=str(alignment))
        opened, plane_map = open_calibrated(run, calibration, shaft, trust)
        with progress_bar("measure") as progress:
            measures = pipeline.measure_run(opened, plane_map, progress)
        if isinstance(measures, pipeline.SandwaveMeasures):
            _note_scale(measures.aligned, opened.rig_file.rig)
        content, lines = measures.as_json(), _measures_lines(measures)
    else:
        wanted = load_shapes(shapes)
        if os.path.isfile(run):  # noqa: PTH113 - takes any text
            of_runs = {"--calibration": calibration, "--alignment": alignment, "--shaft": shaft}
            for option, given in of_runs.items():
                if given is not None:
                    raise InputError("goes with a run folder", where=option, value=str(given))
            surface = load_surface(run)
        else:
            opened, plane_map = open_calibrated(run, calibration, shaft, trust)
            built = _build_surface(opened, plane_map, alignment)
            _note_doubts(built, opened.rig_file.rig)
            surface = built.surface
        found = measure_shapes(surface, wanted)
        every = {one.name: one.as_json() for one in found}
        content, lines = {"frame": surface.frame, "shapes": every}, _shapes_lines(found)
    if output:
        write_json(output, content)
    show(content, *lines, json=json)


def _build_surface(run: Run, plane_map: PlaneMap, alignment: Path | None) -> Reconstruction:
    """The run's surface, aligned by the alignment that a file keeps where one is named."""
    kept = load_alignment(alignment) if alignment else None
    with progress_bar("reconstruct") as progress:
        built = pipeline.reconstruct(run, plane_map, progress, kept)
    made_from = built.raw.provenance
    if kept and made_from and made_from.calibration_sha256 != kept.provenance.calibration_sha256:
        note(
            f"yaw and level are those of {kept.source}, with another calibration: the errors of "
            "both count, as if independent"
        )
    return built


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
    if surface.frame != "workpiece" or not isinstance(rig.workpiece, Sandwave):
        return
    scale = scale_along_track(surface, rig.workpiece)
    if abs(scale - 1) > MOST_STRETCHED:
        note(
            f"along the track the block comes out {scale:.4f} times as long as it is: the track "
            f"moves {1 / scale:.4f} of what it reports (steps per mm, a slipping belt), or the "
            "plan's positions are not where it stood"
        )


def _measures_lines(measures: pipeline.Measures) -> Iterator[str | Table]:
    if isinstance(measures, pipeline.GrooveMeasures):
        yield _lengths_table("groove", measures.dimensions)
    elif isinstance(measures, pipeline.BoardMeasures):
        yield _lengths_table("distances", measures.distances)
        yield _lengths_table("diameters", measures.diameters)
        for name, status in measures.unmeasured.items():
            yield f"{name}: not measured, {status.name}"
    else:
        if measures.alignment.yaw_deg is not None:
            yield f"yaw {measures.alignment.yaw_deg:.3f} deg"
        rows = [
            [name, cut.points, cut.unseen, cut.rmse_mm, cut.min_mm, cut.max_mm]
            for name, cut in measures.errors.items()
        ]
        yield table("slices", ["", "points", "unseen", "rmse mm", "min mm", "max mm"], rows)


def _lengths_table(title: str, lengths: Mapping[str, Length]) -> Table:
    rows = [
        [name, length.nominal_mm, length.measured_mm, length.error_mm, length.sigma_mm]
        for name, length in lengths.items()
    ]
    return table(title, ["", "nominal mm", "measured mm", "error mm", "sigma mm"], rows)


def _shapes_lines(found: list[ShapeMeasure]) -> Iterator[str | Table]:
    rows = [
        [f"{one.kind} {one.name}", quantity, known.value, known.sigma]
        for one in found
        for quantity, known in one.values.items()
    ]
    yield table("shapes", ["", "", "value", "sigma"], rows)
    for one in found:
        if one.rms_mm is not None:
            yield (
                f"{one.name}: {one.points} points, {one.outliers} left out, "
                f"{one.rms_mm:.3f} mm rms off the {one.kind}"
            )
