"""``lscan-sim demo``: the paper's experiment in the tank, with a report."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from lscan.cli.console import print_json, print_table
from lscan.cli.summaries import print_chains
from lscan.config.scenes import scenes_folder
from sim.cli.arguments import Json, OutputFolder, PaperFolder, Quick


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
    from sim.demo import run_demo

    results = run_demo(scenes or scenes_folder() / "paper", output, frames, quick=quick)
    if json:
        print_json(results)
        return
    _print_summary(results)
    print(f"{output / 'report.html'}\n{output / 'results.json'}")


def _print_summary(results: Any) -> None:
    points, stripe = results["control_points"], results["render_check"]
    print(
        f"control points: {points['found']} of {points['expected']}, "
        f"{points['rms_px']:.3f} px rms against the truth"
    )
    print(
        f"noise-free line: {stripe['stripe_rms_px']:.4f} px rms, "
        f"{stripe['stripe_max_px']:.3f} px at most; with the light the target and the water "
        f"throw about, {stripe['all_orders_rms_px']:.4f} px rms"
    )
    rows = []
    for method, found in results["distances"].items():
        errors = [entry["error_mm"] for entry in found.values()]
        errors += [entry["error_mm"] for entry in results["diameters"][method].values()]
        rms = (sum(error**2 for error in errors) / len(errors)) ** 0.5
        rows.append([method, rms, max(abs(error) for error in errors)])
    title = "Tables I and II by the paper's maps and the baselines"
    print_table(title, ["plane map", "rms error mm", "largest mm"], rows)
    yaw = results["sandwave"]["yaw_deg"]
    if yaw["estimated"] is not None:
        print(f"yaw: {yaw['estimated']:.3f} deg, truth {yaw['true']:.3f} deg")
    print_chains(results)
