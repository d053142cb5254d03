"""The command line ``lscan-sim``: thin faces over public functions, one module a topic."""

from lscan.cli.console import before_any_command, command_line, run_program
from sim.cli.dataset import dataset, suite
from sim.cli.pictures import demo, render, truth, views
from sim.cli.serve import serve
from sim.cli.study import concavity, study

app = command_line(
    "The tank in software: demo, render, truth, views, serve, study, concavity, dataset, suite."
)
app.callback()(before_any_command)
for command in (demo, render, truth, views, serve, study, concavity, dataset):
    app.command()(command)
app.add_typer(suite, name="suite")


def main() -> None:
    """Entry point of the console script ``lscan-sim``."""
    run_program(app, "lscan-sim")


if __name__ == "__main__":
    main()
