"""``python -m tests.validation``: what ``make validate`` runs."""

from lscan.cli.console import command_line, run_program
from tests.validation.run import validate

app = command_line("What holds the tank and the instrument to their figures.")
app.command()(validate)

if __name__ == "__main__":
    run_program(app, "validation")
