"""``lscan-sim demo``, ``render``, ``truth`` and ``views``: pictures, and the truth of them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.console import Json, print_json, print_table, progress_bar
from lscan.cli.measure import print_chains
from lscan.config.scenes import scenes_folder
from lscan.errors import InputError
from sim.cli.arguments import OutputFolder, PaperFolder, Quick, SceneFile, print_places

if TYPE_CHECKING:
    from lscan.paper.experiment import Experiment

# ``lscan-sim render``, ``truth`` and ``views``: pictures, and the truth of them.


def render(
    scene: SceneFile,
    output: OutputFolder,
    position: Annotated[
        float | None, typer.Option("--position", help="Track position, mm; the plan's start.")
    ] = None,
    samples: Annotated[
        int | None, typer.Option("--samples", min=1, help="Samples a pixel, a square number.")
    ] = None,
    json: Json = False,
) -> None:
    """The picture the webcam would take, and the layers of light it is made of."""
    from sim.datasets.files import write_render
    from sim.devices import load_checked

    loaded = load_checked(scene)
    place = loaded.rig.plan.start_mm if position is None else position
    files = write_render(loaded, place, output, samples)
    print_places(files, json)


def truth(
    scene: Annotated[
        Path, typer.Argument(help="Scene file or name, or a run folder of one: all its frames.")
    ],
    output: OutputFolder,
    position: Annotated[
        list[float] | None,
        typer.Option("--position", help="Track position, mm, again for more; the plan's start."),
    ] = None,
    json: Json = False,
) -> None:
    """Where everything in the picture really is: the line's centre, the board's marks."""
    from lscan.acquisition.run import open_run
    from sim.datasets.files import taken_at, taken_in, write_truth
    from sim.devices import load_checked
    from sim.truth.placement import check_placement

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
    print_places({name: table.file for name, table in tables.items()}, json)
    if not json:
        for name, table in tables.items():
            found = ", ".join(f"{count} {status}" for status, count in table.statuses.items())
            print(f"{name}: {len(taken)} pictures, {sum(table.statuses.values())} entries: {found}")


def views(
    scene: SceneFile,
    output: OutputFolder,
    poses: Annotated[int, typer.Option("--poses", min=1, max=100, help="Of the board.")] = 10,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of the poses and the noise.")] = 1,
    json: Json = False,
) -> None:
    """A board held into the sheet in many poses: what lscan calibrate-metric takes."""
    from sim.datasets.views import write_views
    from sim.devices import load_checked

    print_places(write_views(load_checked(scene), output, poses, seed), json)


# ``lscan-sim demo``: the paper's experiment in the tank, with a report.


def demo(
    output: OutputFolder = Path("out/demo"),
    scenes: PaperFolder = None,
    frames: Annotated[
        int | None, typer.Option("--frames", min=100, help="Sandwave pictures, if not 400.")
    ] = None,
    quick: Quick = False,
    json: Json = False,
) -> None:
    """The paper's experiment: calibrate, scan, measure and compare, with a report."""
    from lscan.paper.report import results_json
    from sim.demo import run_demo

    experiment = run_demo(scenes or scenes_folder() / "paper", output, frames, quick=quick)
    if json:
        print_json(results_json(experiment))
        return
    _print_experiment(experiment)
    print(f"{output / 'report.html'}\n{output / 'results.json'}")


def _print_experiment(experiment: Experiment) -> None:
    points, truth = experiment.control_points, experiment.truth
    assert truth is not None and experiment.sandwave is not None
    line = truth.render_check
    print(
        f"control points: {points.found} of {points.expected}, "
        f"{points.rms_px:.3f} px rms against the truth"
    )
    print(
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
    print_table(title, ["plane map", "rms error mm", "largest mm"], rows)
    yaw_deg = experiment.sandwave.alignment.yaw_deg
    if yaw_deg is not None:
        print(f"yaw: {yaw_deg:.3f} deg, truth {truth.yaw_deg:.3f} deg")
    print_chains(experiment)
