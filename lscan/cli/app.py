"""The command line ``lscan``: each command is a thin face over public functions."""

import os

# Before NumPy: its matrices here are small, and threads cost them more time than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from lscan.cli.benchmark import bench, leaderboard
from lscan.cli.board import draw_board
from lscan.cli.calibrate import calibrate, check
from lscan.cli.compare import compare
from lscan.cli.console import before_any_command, command_line, run_program
from lscan.cli.devices import devices
from lscan.cli.live import live
from lscan.cli.measure import measure, reconstruct
from lscan.cli.multiview import calibrate_metric
from lscan.cli.report import report
from lscan.cli.roughness import roughness
from lscan.cli.scan import scan
from lscan.cli.scenes import scenes
from lscan.cli.shaft import calibrate_shaft
from lscan.cli.stripe import extract
from lscan.cli.suites import suite

app = command_line(
    "Laser line scanner: scan, calibrate, reconstruct, measure, report, live, bench, suite."
)
app.callback()(before_any_command)
usual = (scan, calibrate, check, extract, draw_board, reconstruct, measure, compare, report)
others = (roughness, calibrate_metric, calibrate_shaft, scenes, devices, bench, leaderboard, live)
for command in (*usual, *others):
    app.command()(command)
app.add_typer(suite, name="suite")


def main() -> None:
    """Entry point of the console script ``lscan``."""
    run_program(app, "lscan")


if __name__ == "__main__":
    main()
