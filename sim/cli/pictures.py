"""``lscan-sim demo``, ``render``, ``truth`` and ``views``: pictures, and the truth of them."""

from collections.abc import Iterator
from pathlib import Path

from rich.table import Table
from typer import Argument, Option

from lscan.acquisition.run import open_run
from lscan.cli.console import Json, progress_bar, require_folders, show, table
from lscan.cli.report import chain_lines
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError
from lscan.files.disk import write_atomically
from lscan.paper.experiment import Experiment
from lscan.paper.report import results_json
from sim.cli.app import OutputFolder, PaperFolder, Quick, SceneFile, show_places
from sim.datasets.files import (
    load_held_board,
    taken_at,
    taken_in,
    write_render,
    write_truth,
    write_views,
)
from sim.devices import load_checked
from sim.truth.placement import check_placement

# ``lscan-sim render``, ``truth`` and ``views``: pictures, and the truth of them.


def render(
    scene: SceneFile,
    output: OutputFolder,
    position: float | None = Option(None, help="Track position, mm; by default the plan's start."),
    samples: int | None = Option(None, min=1, help="Samples per pixel, a square number."),
    json: Json = False,
) -> None:
    """Render the picture that the webcam would take, and the layers of light in it."""
    loaded = load_checked(scene)
    place = loaded.rig.plan.start_mm if position is None else position
    show_places(write_render(loaded, place, output, samples), json)


def check(
    scene: SceneFile,
    picture: Path | None = Option(
        None, help="PNG file to write: brightness, width and uncertainty along the line."
    ),
    json: Json = False,
) -> None:
    """Say what a rig sees and how well it measures, in seconds and without a picture.

    View, scale, width and brightness of the laser's line half-way through the scan, the least
    uncertainty of its heights, the exposure that it wants, the laser's class, and what in the scene
    contradicts what.  Closed forms, which leave out the light that the water scatters.
    """
    from sim.studies.rigcheck import check_json, check_lines, check_picture, check_rig  # takes 1 s

    require_folders(picture)
    found = check_rig(load_checked(scene))
    if picture is not None:
        write_atomically(picture, check_picture(found))
    show(check_json(found), *check_lines(found), json=json)


def truth(
    scene: Path = Argument(help="Scene file or name, or for all frames of a scan its run folder."),
    output: Path = Option(..., "--output", "-o", help="Folder to write."),
    position: list[float] | None = Option(
        None, help="Track position, mm, repeatable; by default the plan's start."
    ),
    json: Json = False,
) -> None:
    """Write where everything in the picture really is: the line's centre, the board's marks."""
    if scene.is_dir():
        if position:
            raise InputError(
                "a run folder has its own positions", where="--position", value=position[0],
                allowed="none with a run folder",
            )  # fmt: skip
        loaded, taken = taken_in(open_run(scene))
        check_placement(loaded)
    else:
        loaded = load_checked(scene)
        taken = taken_at(loaded, position or [loaded.rig.plan.start_mm])
    with progress_bar("truth") as progress:
        tables = write_truth(loaded, taken, output, progress)
    counts = []
    for name, each in tables.items():
        found = ", ".join(f"{count} {status}" for status, count in each.statuses.items())
        entries = sum(each.statuses.values())
        counts.append(f"{name}: {len(taken)} pictures, {entries} entries: {found}")
    show_places({name: each.file for name, each in tables.items()}, json, *counts)


def views(
    scene: SceneFile,
    output: OutputFolder,
    poses: int = Option(10, min=1, max=100, help="Number of poses of the board."),
    seed: int = Option(1, min=0, help="Seed of the poses and the noise."),
    board: Path | None = Option(
        None,
        help="TOML file with the [board] of a views file: a chessboard, say; else the scene's.",
    ),
    json: Json = False,
) -> None:
    """Render a board held into the sheet in many poses, for lscan calibrate-metric."""
    held = None if board is None else load_held_board(board)
    show_places(write_views(load_checked(scene), output, poses, seed, held), json)


# ``lscan-sim demo``: the paper's experiment in the tank, with a report.


def demo(
    output: OutputFolder = Path("out/demo"),
    scenes: PaperFolder = None,
    frames: int | None = Option(None, min=100, help="Number of sandwave pictures; 400 by default."),
    quick: Quick = False,
    json: Json = False,
) -> None:
    """Run the paper's experiment: calibrate, scan, measure and compare, with a report."""
    from sim.demo import run_demo  # loads Mitsuba

    experiment = run_demo(scenes or scenes_folder() / "paper", output, frames, quick=quick)
    files = f"{output / 'report.html'}\n{output / 'results.json'}"
    show(results_json(experiment), *_experiment_lines(experiment), files, json=json)


def _experiment_lines(experiment: Experiment) -> Iterator[str | Table]:
    points, truth = experiment.control_points, experiment.truth
    assert truth is not None and experiment.sandwave is not None
    line = truth.render_check
    yield (
        f"control points: {points.found} of {points.expected}, "
        f"{points.rms_px:.3f} px rms against the truth"
    )
    yield (
        f"noise-free line: {line.stripe_rms_px:.4f} px rms, "
        f"{line.stripe_max_px:.3f} px at most; with the light that the target and the water "
        f"scatter, {line.all_orders_rms_px:.4f} px rms"
    )
    rows = []
    for method, board in experiment.board.measures.items():
        lengths = [*board.distances.values(), *board.diameters.values()]
        rms = (sum(length.error_mm**2 for length in lengths) / len(lengths)) ** 0.5
        rows.append([method, rms, max(abs(length.error_mm) for length in lengths)])
    title = "Tables I and II by the paper's maps and the baselines"
    yield table(title, ["plane map", "rms error mm", "largest mm"], rows)
    if (yaw_deg := experiment.sandwave.alignment.yaw_deg) is not None:
        yield (f"yaw: {yaw_deg:.3f} deg, truth {truth.yaw_deg:.3f} deg")
    yield from chain_lines(experiment)
