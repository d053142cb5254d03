"""Continuous integration runs the checks, the tests and every figure with the least effort."""

import os
import re
import subprocess
from pathlib import Path

import pytest
from places import ROOT

MAKEFILE = (ROOT / "Makefile").read_text()
TARGETS = "lint", "pytest", "validate", "docs", "mutants", "oldest"


def recipe(target: str) -> str:
    """The commands of a target of the Makefile."""
    found = re.search(rf"^{target}:.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)
    assert found is not None, target
    return found[1]


@pytest.mark.parametrize("failing", ["none", *TARGETS])
def test_continuous_integration_runs_checks_tests_and_figures(failing: str, tmp_path: Path) -> None:
    """By a make that only says what it was asked for, and fails where it is asked for one target.

    All are run to their ends, whichever fails, and CI fails with each and names it.
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
    for target in TARGETS:
        assert f"made: {target}" in done.stdout
        assert (f"make {target} failed" in done.stdout) == (failing == target)
    assert "made: validate QUICK=1" in done.stdout
    assert "made: pytest PYTEST=--hypothesis-profile=full\n" in done.stdout


def test_make_test_all_leaves_no_test_out() -> None:
    assert "PYTEST='-m \"not slow\" $(PYTEST)'" in recipe("test")
    assert "PYTEST='--hypothesis-profile=full $(PYTEST)'" in recipe("test-all")
    assert re.search(r"^PYTEST \?=$", MAKEFILE, re.MULTILINE)
    assert " -m " not in recipe("pytest").split("pytest")[1]
