"""The command line ``lscan``: each command is a thin face over public functions."""

import os

# Before NumPy: its matrices here are small, and threads cost them more time than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from lscan.cli.bench import bench, leaderboard, suite
from lscan.cli.calibrate import calibrate, calibrate_metric, calibrate_shaft, check, draw_board
from lscan.cli.console import before_any_command, command_line, run_program
from lscan.cli.devices import devices
from lscan.cli.extract import extract
from lscan.cli.measure import compare, measure, reconstruct, report
from lscan.cli.roughness import roughness
from lscan.cli.scan import live, scan, scenes

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
