"""Every figures command of the Makefile is run by ``make smoke``, and that by CI."""

import os
import re
import subprocess
from pathlib import Path

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


@pytest.mark.parametrize("failing", ["none", "lint", "pytest", "smoke"])
def test_continuous_integration_runs_checks_tests_and_smoke(failing: str, tmp_path: Path) -> None:
    """By a make that only says what it was asked for, and fails where it is asked for one target.

    All three are run to their ends, whichever fails, and CI fails with each and names it.
    """
    make = tmp_path / "make"
    make.write_text('#!/bin/sh\necho "made: $*"\ncase "$*" in "$FAILING"*) exit 2;; esac\n')
    make.chmod(0o755)
    path = os.pathsep.join([str(tmp_path), os.environ["PATH"]])
    done = subprocess.run(
        [ROOT / ".ci" / "run"],
        env={**os.environ, "PATH": path, "FAILING": failing},
        capture_output=True,
        text=True,
    )
    assert (done.returncode == 0) == (failing == "none"), done.stderr
    for target in ("lint", "pytest", "smoke"):
        assert f"made: {target}" in done.stdout
        assert (f"make {target} failed" in done.stdout) == (failing == target)
    assert 'made: pytest PYTEST=-m "not slow"' in done.stdout


def test_make_test_leaves_no_test_out() -> None:
    """What is slow runs there, though not in CI."""
    assert re.search(r"^test: lint pytest$", MAKEFILE, re.MULTILINE)
    assert re.search(r"^PYTEST \?=$", MAKEFILE, re.MULTILINE)
    assert " -m " not in recipe("pytest").split("pytest")[1]
