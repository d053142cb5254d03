"""The command line ``lscan-sim``: thin faces over public functions, one module a topic."""

from lscan.cli.console import before_any_command, command_line, run_program

COMMANDS = {
    "demo": "sim.cli.pictures:demo",
    "render": "sim.cli.pictures:render",
    "truth": "sim.cli.pictures:truth",
    "views": "sim.cli.pictures:views",
    "serve": "sim.cli.serve:serve",
    "study": "sim.cli.study:study",
    "concavity": "sim.cli.study:concavity",
    "dataset": "sim.cli.dataset:dataset",
}
SUITE_COMMANDS = {"make": "sim.cli.dataset:make_suite"}

app = command_line(
    "The tank in software: demo, render, truth, views, serve, study, concavity, dataset, suite.",
    COMMANDS,
)
app.callback()(before_any_command)
app.add_typer(
    command_line("Suites of rendered pictures with their truth: make.", SUITE_COMMANDS),
    name="suite",
)


def main() -> None:
    """Entry point of the console script ``lscan-sim``."""
    run_program(app, "lscan-sim")


if __name__ == "__main__":
    main()
