"""The command line ``lscan``: each command is a thin face over public functions."""

import os

# Before NumPy: its matrices here are small, and threads cost them more time than they save.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from lscan.cli.console import before_any_command, command_line, run_program

COMMANDS = {
    "scan": "lscan.cli.scan:scan",
    "calibrate": "lscan.cli.calibrate:calibrate",
    "check": "lscan.cli.calibrate:check",
    "extract": "lscan.cli.extract:extract",
    "draw-board": "lscan.cli.calibrate:draw_board",
    "reconstruct": "lscan.cli.measure:reconstruct",
    "grid": "lscan.cli.measure:grid",
    "export": "lscan.cli.measure:export",
    "measure": "lscan.cli.measure:measure",
    "compare": "lscan.cli.report:compare",
    "report": "lscan.cli.report:report",
    "roughness": "lscan.cli.report:roughness",
    "calibrate-metric": "lscan.cli.calibrate:calibrate_metric",
    "calibrate-shaft": "lscan.cli.calibrate:calibrate_shaft",
    "scenes": "lscan.cli.scan:scenes",
    "schema": "lscan.cli.schema:schema",
    "init": "lscan.cli.devices:init",
    "devices": "lscan.cli.devices:devices",
    "bench": "lscan.cli.bench:bench",
    "leaderboard": "lscan.cli.bench:leaderboard",
    "live": "lscan.cli.scan:live",
}
SUITE_COMMANDS = {
    "list": "lscan.cli.suite:list_suites",
    "show": "lscan.cli.suite:show_suite",
    "verify": "lscan.cli.suite:verify",
    "wheel": "lscan.cli.suite:wheel",
}

app = command_line(
    "Laser line scanner: scan, calibrate, reconstruct, measure, report, live, bench, suite.",
    COMMANDS,
)
app.callback()(before_any_command)
app.add_typer(
    command_line(
        "Suites of rendered pictures with their truth: list, show, verify, wheel.", SUITE_COMMANDS
    ),
    name="suite",
)


def main() -> None:
    """Entry point of the console script ``lscan``."""
    run_program(app, "lscan")


if __name__ == "__main__":
    main()
