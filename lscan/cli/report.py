"""The commands ``lscan compare`` and ``lscan report``: a surface beside a mesh, a run's page."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rich.table import Table
from typer import Argument, Option

from lscan.acquisition.run import open_run
from lscan.cli.console import Json, Trust, note, one_of, progress_bar, require_folders, show, table
from lscan.cli.inputs import parse_numbers
from lscan.errors import InputError
from lscan.files.disk import write_json
from lscan.files.meshes import MM_PER_UNIT, TWICE, load_mesh
from lscan.measure.meshes import MeshPose, compare_mesh, save_coloured_points, save_histogram
from lscan.paper import experiment as paper
from lscan.paper.published import Bars
from lscan.paper.report import results_json, write_experiment
from lscan.paper.tables import paper_tables
from lscan.surface import load_surface

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
