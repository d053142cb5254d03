"""Scans killed and resumed: how the figure is made, and that it can fail."""

import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import SCENES

from tests.validation.robustness import acquisition as kills
from tests.validation.robustness.acquisition import KilledRun, folder_bytes, kill_rows, kill_runs

SCENE = SCENES / "paper" / "sandwave.toml"


@pytest.mark.slow
def test_killed_scans_are_finished_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scans of direct light, which begin in half the time; those of ``make validate`` show all."""
    monkeypatch.setattr(kills, "KILLS_A_RUN", 2)
    scene = tmp_path / "direct.toml"
    scene.write_text('include = "paper/sandwave"\n[render]\nscatter_samples = 0\n')
    runs = kill_runs(scene, count=1, seed=1, frames=20)
    assert sum(len(run.kept) for run in runs) >= 1
    assert all(run.same for run in runs)
    assert all(0 <= kept <= 20 for run in runs for kept in run.kept)


def test_a_scan_that_fails_by_itself_is_no_kill() -> None:
    with pytest.raises(RuntimeError, match=r"ended with code 2: .*gone\.toml.*cannot be read"):
        kill_runs(SCENE.with_name("gone.toml"), count=1, frames=20)


class EndedMeanwhile(subprocess.Popen[str]):
    """A process that comes to its own end between the time-out and the signal."""

    def communicate(self, input: str | None = None, timeout: float | None = None) -> Any:
        if timeout is not None:
            self.wait()
            raise subprocess.TimeoutExpired(self.args, timeout)
        return super().communicate(input, timeout)


def goes_on_as(script: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> bool:
    """What becomes of a scan, to be killed at once, whose place the script takes."""
    program = folder / "program"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setattr(kills.sys, "executable", str(program))
    return kills._goes_on(SCENE, folder / "run", kill_after_s=0.01)


def test_a_scan_that_ends_before_the_signal_was_not_killed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert not goes_on_as("exec sleep 60", tmp_path, monkeypatch)
    monkeypatch.setattr(subprocess, "Popen", EndedMeanwhile)
    assert goes_on_as("exit 0", tmp_path, monkeypatch)
    with pytest.raises(RuntimeError, match="ended with code 3: no disk"):
        goes_on_as("echo no disk >&2; exit 3", tmp_path, monkeypatch)


def test_the_rows_count_kills_and_differing_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [KilledRun((0, 0, 3, 9), True)] * 4 + [KilledRun((5, 9, 9), True)]
    monkeypatch.setattr(kills, "kill_runs", lambda *_, **__: runs)
    rows = kill_rows(SCENE, count=20, frames=120)
    assert [(row.figure, row.passed) for row in rows] == [(19, False), (0, True)]
    runs.append(KilledRun((2,), False))
    rows = kill_rows(SCENE, count=20, frames=120)
    assert [(row.figure, row.passed) for row in rows] == [(20, True), (1, False)]


def test_a_byte_or_a_file_too_many_is_a_difference(tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name / "frames").mkdir(parents=True)
        (tmp_path / name / "frames" / "000000.png").write_bytes(b"picture")
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")
    (tmp_path / "b" / "frames" / ".000001.png.tmp").touch()
    assert folder_bytes(tmp_path / "a") != folder_bytes(tmp_path / "b")
    (tmp_path / "b" / "frames" / ".000001.png.tmp").unlink()
    (tmp_path / "b" / "frames" / "000000.png").write_bytes(b"picturE")
    assert folder_bytes(tmp_path / "a") != folder_bytes(tmp_path / "b")


def test_a_run_is_killed_until_it_has_come_to_its_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At most four times, each moment drawn anew within the scan's duration."""
    moments: list[float] = []

    def goes_on(scene: Path, run: Path, kill_after_s: float) -> bool:
        moments.append(kill_after_s)
        return len(moments) == 3

    monkeypatch.setattr(kills, "_goes_on", goes_on)
    generator = np.random.default_rng(1)
    assert kills._killed(SCENE, tmp_path / "run", 5.0, generator) == (0, 0)
    assert kills._killed(SCENE, tmp_path / "run", 5.0, generator) == (0, 0, 0, 0)
    assert len(set(moments)) == 7
    assert all(0 <= moment <= 5 for moment in moments)
