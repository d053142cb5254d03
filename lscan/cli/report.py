"""The commands ``lscan compare``, ``lscan report`` and ``lscan roughness``."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from rich.table import Table
from typer import Argument, Option

from lscan import roughness as rough
from lscan.acquisition.run import open_run
from lscan.cli.console import Json, Trust, note, one_of, progress_bar, require_folders, show, table
from lscan.cli.inputs import parse_numbers
from lscan.config.rig import load_rig
from lscan.errors import InputError
from lscan.files.disk import write_json
from lscan.files.meshes import MM_PER_UNIT, TWICE, load_mesh
from lscan.measure.meshes import MeshPose, compare_mesh, save_coloured_points, save_histogram
from lscan.paper import experiment as paper
from lscan.paper.published import Bars
from lscan.paper.report import results_json, write_experiment
from lscan.paper.tables import paper_tables
from lscan.records import Status, Surface, has_value
from lscan.roughness import MM_PER_CM, Roughness, ScannerResponse, Sediment, patch_of_cells
from lscan.roughness.analysis import save_figures, save_roughness
from lscan.roughness.instrument import corrected_blur_px, is_thickness_corrected
from lscan.surface import load_surface, shear

_LEFT_OUT = ("\nmm", "\n%")  # columns of the page that a terminal has no room for


def compare(
    surface: Path = Argument(help="Surface (.nc)."),
    mesh: Path = Argument(help="Mesh file (PLY, STL, OBJ or OFF)."),
    output: Path | None = Option(None, "--output", "-o", help="JSON file to write."),
    unit: str = Option("mm", help="Unit of the mesh: mm, cm, m or inch."),
    at: str = Option("0,0,0", help="x,y,z in mm of the mesh's origin, in the surface's frame."),
    turn: float = Option(0.0, help="Rotation of the mesh about z, degrees."),
    fit: bool = Option(False, "--fit", help="Fit the mesh's pose, starting from --at and --turn."),
    within: float = Option(10.0, help="Greatest distance at which points are compared, mm."),
    points: Path | None = Option(None, help="Point cloud to write, coloured by distance (.ply)."),
    histogram: Path | None = Option(None, help="Histogram of the distances to write (.png)."),
    json: Json = False,
) -> None:
    """Compare a surface with a mesh: the signed distances of its points."""
    require_folders(output, points, histogram)
    one_of(unit, MM_PER_UNIT, "--unit", "no such unit")
    if not (np.isfinite(within) and within > 0):
        raise InputError("is not a distance", where="--within", value=within, allowed="> 0 mm")
    if not np.isfinite(turn):
        raise InputError("is not an angle", where="--turn", value=turn, allowed="degrees")
    place = parse_numbers(at, 3)
    if place is None or max(map(abs, place)) > 1e6:
        raise InputError("not a point", where="--at", value=at, allowed="x,y,z in mm")
    pose = MeshPose.at((place[0], place[1], place[2]), turn)
    shape = load_mesh(mesh, MM_PER_UNIT[unit])
    found = compare_mesh(load_surface(surface), shape, pose, fit, within)
    if TWICE in shape.metadata:
        note(f"{mesh} {shape.metadata[TWICE]}")
    content = found.as_json()
    if output:
        write_json(output, content)
    if points:
        save_coloured_points(points, found)
    if histogram:
        save_histogram(histogram, found)
    low, high = content["central_95_mm"]
    rows = [
        ["points", content["points"]],
        [f"not compared: farther than {within:g} mm", content["far"]],
        ["not compared: beside the mesh", content["beside"]],
        ["mean mm", content["mean_mm"]["value"]],
        ["its sigma mm", content["mean_mm"]["sigma"]],
        ["rms mm", content["rms_mm"]],
        ["95 % between mm", f"{low:.3f} and {high:.3f}"],
        ["within 2 sigma", content["within_2_sigma"]],
    ]
    if found.pose_sigma is not None:  # where the mesh lies, as a scene file states it
        for name, numbers in (
            ("mesh at x, y, z mm", found.pose.translation_mm),
            ("their sigmas mm", found.pose_sigma[3:]),
            ("turned about x, y, z deg", found.pose.turns_deg),
            ("their sigmas deg", found.pose_sigma[:3]),
        ):
            rows.append([name, ", ".join(f"{number:.3f}" for number in numbers)])
    if found.doubt:
        note(found.doubt)
    show(content, table("distances from the mesh", ["", ""], rows), json=json)


def report(
    output: Path = Option(..., "--output", "-o", help="Folder for report.html and results.json."),
    board: Path = Option(..., help="Run folder of the board picture."),
    groove: Path | None = Option(None, help="Run folder of the grooved block."),
    sandwave: Path | None = Option(None, help="Run folder of the sandwave."),
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Evaluate the paper's experiment from its run folders and write a report."""
    with progress_bar("evaluate") as progress:
        experiment = paper.evaluate(
            open_run(board, trust),
            open_run(groove, trust) if groove else None,
            open_run(sandwave, trust) if sandwave else None,
            progress=progress,
        )
    write_experiment(output, experiment)
    page = f"{output / 'report.html'}"
    show(results_json(experiment), *chain_lines(experiment), page, json=json)


def chain_lines(experiment: paper.Experiment) -> Iterator[str | Table]:
    """Where a report's pictures come from, and the errors of both chains, for ``show``.

    Of the errors and their sigmas all columns are too many for a terminal.

    Parameters
    ----------
    experiment : Experiment, as the report shows it
    """
    yield from filter(None, (paper.note(experiment.sources), paper.describe_chains(experiment)))
    names = [name.removeprefix("Ours, ") for name in paper.chain_names(experiment.chain)]
    for each in paper_tables(experiment, Bars()):
        if (block := each.chains) is None:
            continue
        groups = [("paper", block.paper_heads)]
        groups += [(name, block.our_heads) for name in (names if block.has_best else names[:1])]
        columns = [f"{name}\n{head}" for name, heads in groups for head in heads]
        kept = [k for k, column in enumerate(columns) if not column.endswith(_LEFT_OUT)]
        rows = []
        for row in block.rows:
            cells = [cell.text for cell in row.paper + row.ours + row.best]
            rows.append([row.label, *(cells[k] for k in kept)])
        headings = [block.names, *(columns[k] for k in kept)]
        yield table(f"{each.title}, mm", headings, rows)


# ``lscan roughness``.

FREQUENCIES_KHZ = (15.0, 50.0, 100.0, 300.0)
MOST_STEPS = 0.5  # of the patch's shorter side: a stone on the seabed makes fewer
GRAZING_DEG = (10.0, 20.0, 45.0, 70.0)


def roughness(
    surface: Path = Argument(help="Surface (.nc)."),
    output: Path | None = Option(None, "--output", "-o", help="Spectra to write (.nc)."),
    cell: float | None = Option(
        None, help="Side of cells to average points in, mm; without it profiles are used."
    ),
    window: tuple[float, float, float, float] | None = Option(
        None,
        metavar="X0 X1 Y0 Y1",
        help="The part of the surface that counts, mm, as its points have x and y; by default all.",
    ),
    yaw: float = Option(
        0.0, help="Yaw of the sheet against the track, degrees, of a surface that is not aligned."
    ),
    sheet: float = Option(0.0, help="Standard deviation of the light across the sheet, mm."),
    blur: float | None = Option(
        None,
        help="mm, standard deviation of the lens's blur on the seabed; by default that which "
        "the lines were corrected for, if any and with --pixel.",
    ),
    pixel: float = Option(0.0, help="Width of a pixel on the seabed, mm."),
    rig: Path | None = Option(
        None,
        help="Rig file that the surface was scanned with: says sheet, blur, pixel and how its "
        "extractor reads such lines.",
    ),
    peak: float | None = Option(
        None, help="DN, brightest grey value of a usual line above the ground; with --rig."
    ),
    stretched: bool = Option(
        False, "--stretched", help="Let the power law differ between directions."
    ),
    figures: Path | None = Option(
        None, help="Folder for the figures: spectrum, plane, rose (.png)."
    ),
    bottom: str | None = Option(
        None,
        "--sediment",
        help="Sediment whose backscatter is asked, by its name in APL-UW TR 9407, such as "
        '"medium sand"; another lists all.',
    ),
    frequency: list[float] | None = Option(None, help="Frequency of the sound, kHz; repeatable."),
    grazing: list[float] | None = Option(None, help="Grazing angle, degrees; repeatable."),
    json: Json = False,
) -> None:
    """Roughness of a surface: spectrum, power law with intervals, ripples, cutoff, backscatter."""
    require_folders(output)
    if cell is not None and not cell > 0:
        raise InputError("is not a length", where="--cell", value=cell, allowed="above 0 mm")
    for name, length in (("sheet", sheet), ("blur", blur), ("pixel", pixel)):
        if length is not None and not length >= 0:
            allowed = "0 mm or more"
            raise InputError("is not a length", where=f"--{name}", value=length, allowed=allowed)
    if not abs(yaw) < 45:
        raise InputError("is not a yaw", where="--yaw", value=yaw, allowed="-45 to 45 degrees")
    if bottom is None and (frequency or grazing):
        raise InputError("is needed with --frequency or --grazing", where="--sediment")
    ground = None if bottom is None else rough.sediment(bottom)
    scanned = load_surface(surface)
    if window is not None:
        low, high = np.reshape(window, (2, 2)).T
        plan, good = scanned.xyz_mm[..., :2], has_value(scanned.status)
        inside = good & ((plan >= low) & (plan <= high)).all(axis=-1)
        if not inside.any():
            whole = np.column_stack([plan[good].min(axis=0), plan[good].max(axis=0)]).ravel()
            allowed = "X0 X1 Y0 Y1 of a part of " + " ".join(f"{end:.0f}" for end in whole)
            raise InputError("holds no point", where="--window", value=window, allowed=allowed)
        status = np.where(inside, scanned.status, int(Status.NO_DATA))
        scanned = replace(scanned, status=status)
    if rig is None:
        response = _stated_response(scanned, sheet, blur, pixel)
    elif sheet or blur or pixel:
        raise InputError("gives sheet, blur and pixel itself", where="--rig", value=str(rig))
    else:
        response = rough.response_of(load_rig(rig).rig, scanned, peak)
    response = replace(response, cell_cm=(cell or 0.0) / MM_PER_CM)
    sheared = replace(scanned, xyz_mm=scanned.xyz_mm @ shear(np.radians(yaw)).T)
    patch = rough.patch_of_profiles(sheared) if cell is None else patch_of_cells(sheared, cell)
    if patch.steps > MOST_STEPS:
        note(
            "steps lie in the patch, such as a rim: ripples, law and intervals are not valid; "
            "--window leaves them out"
        )
    with progress_bar("roughness") as progress:
        found = rough.roughness_of(patch, response, stretched=stretched, progress=progress)
    if found.fit.lack > 1:
        note(
            "the patch does not follow the power law: its intervals, and those of the backscatter, "
            f"are {found.fit.lack:.1f} times as wide"
        )
    if output:
        save_roughness(output, patch, found)
    if figures:
        save_figures(figures, patch, found, response)
    sound = [] if ground is None else _backscatter(found, ground, frequency, grazing)
    lines = [table("roughness", ["what", "value", "95 %"], _rows(found))]
    if sound:
        headings = ["kHz", "grazing, deg", "Bragg, rad/cm", "strength, dB", "95 %", "measured"]
        rows = [
            [f"{row['frequency_khz']:g}", f"{row['grazing_deg']:g}", f"{row['bragg_per_cm']:.3g}",
             f"{row['strength_db']:.1f}", f"± {1.96 * row['sigma_db']:.1f}", _in_band(row, found)]
            for row in sound
        ]  # fmt: skip
        lines.append(table(f"backscatter of {bottom}", headings, rows))
    show(found.figures() | ({"backscatter": sound} if sound else {}), *lines, json=json)


def _stated_response(
    surface: Surface, sheet_mm: float, blur_mm: float | None, pixel_mm: float
) -> ScannerResponse:
    """The response that the options state, and what the surface's lines were corrected for."""
    if sheet_mm and is_thickness_corrected(surface):
        raise InputError(
            "the surface is corrected for the sheet's thickness", where="--sheet", value=sheet_mm,
            allowed="0, or a surface reconstructed without [sheet]",
        )  # fmt: skip
    corrected_px = corrected_blur_px(surface)
    if blur_mm and corrected_px and not pixel_mm:
        raise InputError(
            f"the surface is corrected for a blur of {corrected_px:g} px", where="--blur",
            value=blur_mm, allowed="0, or with --pixel",
        )  # fmt: skip
    if not pixel_mm:
        corrected_px = 0.0
    blur_mm = corrected_px * pixel_mm if blur_mm is None else blur_mm
    return ScannerResponse(
        sheet_mm / MM_PER_CM, blur_mm / MM_PER_CM, pixel_mm / MM_PER_CM, corrected_px=corrected_px
    )


def _backscatter(
    found: Roughness, ground: Sediment, frequencies: list[float] | None, angles: list[float] | None
) -> list[dict[str, float]]:
    """One row for each frequency and angle."""
    rows = []
    grazing_deg = np.array(angles or GRAZING_DEG)
    for frequency in frequencies or FREQUENCIES_KHZ:
        told = rough.predicted_backscatter(found.fit, ground, frequency, grazing_deg)
        bragg = rough.bragg_per_cm(frequency, told.grazing_deg)
        names = ("grazing_deg", "bragg_per_cm", "strength_db", "sigma_db")
        for values in zip(told.grazing_deg, bragg, told.strength_db, told.sigma_db, strict=True):
            of = dict(zip(names, map(float, values), strict=True))
            rows.append({"frequency_khz": frequency, **of})
    return rows


def _in_band(row: dict[str, float], found: Roughness) -> str:
    """Whether the wavenumber that the sound meets was measured, or the law is extended to it."""
    band = found.fit.band
    if row["bragg_per_cm"] < band.low_per_cm:
        return "no: longer than the band"
    return "yes" if row["bragg_per_cm"] <= band.high_per_cm else "no: beyond the band"


def _rows(found: Roughness) -> list[list[str]]:
    of, fit = found.figures(), found.fit
    unheld = int(np.isnan(fit.rings.low_cm4).sum())
    rows = [
        ["spectral exponent", f"{of['gamma2']:.3f}",
         f"{of['gamma2_low']:.3f} to {of['gamma2_high']:.3f}"],
        ["spectral strength, cm^4", f"{of['w2_cm4']:.4g}",
         f"{of['w2_low_cm4']:.4g} to {of['w2_high_cm4']:.4g}"],
        ["between, rad/cm", f"{fit.band.low_per_cm:.3g} to {fit.band.high_per_cm:.3g}", ""],
        ["rings without limits: leakage, folding", f"{unheld} of {len(fit.rings.low_cm4)}", ""],
        ["the instrument's cutoff, rad/cm", f"{found.cutoff_per_cm:.3g}", ""],
        ["rms height, cm", f"{of['rms_height_cm']:.4g}", ""],
        ["rms slope along x, along y", f"{of['rms_slope_x']:.3g}, {of['rms_slope_y']:.3g}", ""],
        ["correlation length, cm", f"{of['correlation_length_cm']:.3g}", ""],
        ["skewness", f"{of['skewness']:.2f}", ""],
    ]  # fmt: skip
    if "stretch_ratio" in of:
        words = f"{of['stretch_ratio']:.2f}, {of['stretch_heading_deg']:.0f} deg"
        rows.append(["roughest along, by", words, ""])
    if ripples := found.ripples:
        for name, value, sigma in (
            ("ripples: wavelength, cm", ripples.wavelength_cm, ripples.sigma_wavelength_cm),
            ("ripples: heading, deg", ripples.heading_deg, ripples.sigma_heading_deg),
            ("ripples: height, cm", ripples.height_cm, ripples.sigma_height_cm),
        ):
            rows.append([name, f"{value:.4g}", f"± {1.96 * sigma:.2g}"])
        if spread := found.spread:
            words = f"{100 * spread.relative:.2g} %, {spread.heading_deg:.2g} deg"
            rows.append(["ripples: spread of wavenumber, of heading", words, ""])
    else:
        rows.append(["ripples", "none stand out", ""])
    return rows
