"""``lscan-sim demo``: the paper's experiment in the tank, with a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lscan.cli.console import Json, print_json, print_table
from lscan.cli.measure import print_chains
from lscan.config.scenes import scenes_folder
from sim.cli.arguments import OutputFolder, PaperFolder, Quick

if TYPE_CHECKING:
    from lscan.paper.experiment import Experiment


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
