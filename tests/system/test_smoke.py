"""Every figures command of the Makefile is run by ``make smoke``, and that by CI."""

import re

import pytest
from places import ROOT
from typer.testing import CliRunner

from sim.cli.app import app

MAKEFILE = (ROOT / "Makefile").read_text()


def recipe(target: str) -> str:
    """The commands of a target of the Makefile."""
    found = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert found is not None, target
    return found[1]


def figures_commands() -> set[str]:
    """The commands of ``lscan-sim`` that a target runs, those of ``make smoke`` aside.

    ``make suites`` renders what others judge by, and measures nothing.
    """
    runs = r"^[a-z]+:.*\n\t\$\(BIN\)/lscan-sim ([a-z]+) "
    return set(re.findall(runs, MAKEFILE, re.MULTILINE)) - {"suite"}


def test_the_figures_commands_are_those_known() -> None:
    assert figures_commands() >= {
        "demo",
        "verify",
        "accuracy",
        "field",
        "bench",
        "hardware",
        "budgets",
    }


@pytest.mark.parametrize("command", sorted(figures_commands()))
def test_smoke_runs_the_command_quickly(command: str) -> None:
    listed = re.search(r"^QUICK := (.*)$", MAKEFILE, re.MULTILINE)
    assert listed and command in listed[1].split()
    assert "$(addprefix quick-,$(QUICK))" in recipe("smoke")
    assert f"lscan-sim {command} --quick -o out/quick/{command}" in recipe(f"quick-{command}")
    assert "--quick" in CliRunner().invoke(app, [command, "--help"]).output


def test_continuous_integration_runs_the_tests_and_smoke() -> None:
    commands = (ROOT / ".ci" / "run").read_text()
    for target in ("test", "smoke"):
        assert re.search(rf"^if (! )?make {target}\b", commands, re.M)
