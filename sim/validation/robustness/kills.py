"""A scan killed at random moments and resumed: the same bytes as the scan that was not killed.

Each scan is the command ``lscan scan`` in a process of its own, on the simulated drivers.
"""

import os
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

import lscan
from lscan.acquisition.run import TABLE
from lscan.config.documents import Document, merge, write_toml
from sim.validation.rows import Row, row

SEED: Final = 5020
KILLS_A_RUN: Final = 4
"""A run is killed up to so often before it may come to its end."""

SMALL: Final[Document] = {
    "camera": {"width_px": 64, "height_px": 48},
    "lens": {"focal_px": 85.0, "centre_px": [31.5, 23.5]},
    "render": {"samples": 1},
}
"""The scene in pictures a tenth as wide and high, so that rendering takes next to no time."""


@dataclass(frozen=True)
class KilledRun:
    """One run.  kept: frames on disk after each kill.  same: whether, resumed, its files are
    those of the undisturbed run, byte for byte."""

    kept: tuple[int, ...]
    same: bool


def kill_runs(
    scene: Path, count: int, frames: int, render: Document | None = None, seed: int = SEED
) -> list[KilledRun]:
    """Runs of ``scene`` that were killed ``count`` times or more in all, and resumed.

    The moments are uniform over the duration of the undisturbed scan, start-up included, each
    drawn anew after a kill.  render: what replaces the scene's own settings of rendering.  Raises
    RuntimeError where a scan fails by itself.
    """
    generator = np.random.default_rng(seed)
    runs: list[KilledRun] = []
    with tempfile.TemporaryDirectory(prefix="lscan-kills-") as name:
        folder = Path(name)
        small = folder / "small.toml"
        plan = {"frames": frames, "step_mm": 0.5}
        changed = {"include": str(scene.resolve()), "plan": plan, "render": render or {}}
        write_toml(small, merge(changed, SMALL))
        _goes_on(small, folder / "first")  # the renderer keeps what it compiled
        began_s = time.monotonic()
        _goes_on(small, folder / "whole")
        whole_s = time.monotonic() - began_s
        reference = folder_bytes(folder / "whole")
        kills = 0
        while kills < count:
            run = folder / f"{len(runs):03d}"
            kept = _killed(small, run, whole_s, generator)
            _goes_on(small, run)
            runs.append(KilledRun(kept, folder_bytes(run) == reference))
            kills += len(kept)
    return runs


def kill_rows(
    scene: Path, count: int, frames: int, render: Document | None = None, seed: int = SEED
) -> list[Row]:
    """How many kills there were, and how many runs differ from the undisturbed one after them."""
    runs = kill_runs(scene, count, frames, render, seed)
    kills = sum(len(run.kept) for run in runs)
    differing = sum(not run.same for run in runs)
    return [
        row("kills", kills, bar=count, seed=seed),
        row("kills-differing", differing, seed=seed),
    ]


def folder_bytes(folder: Path) -> dict[str, bytes]:
    """Every file beneath ``folder``, hidden ones too: its path there to its content."""
    files = (file for file in sorted(folder.rglob("*")) if file.is_file())
    return {str(file.relative_to(folder)): file.read_bytes() for file in files}


def _killed(
    scene: Path, run: Path, whole_s: float, generator: np.random.Generator
) -> tuple[int, ...]:
    """Frames on disk after each of up to KILLS_A_RUN kills; fewer where a scan came first."""
    kept: list[int] = []
    for _ in range(KILLS_A_RUN):
        if _goes_on(scene, run, kill_after_s=float(generator.uniform(0, whole_s))):
            break
        kept.append(_frames_in(run))
    return tuple(kept)


def _goes_on(scene: Path, run: Path, kill_after_s: float | None = None) -> bool:
    """Begin the run or go on with it, by ``lscan scan``; False where it was killed before its end.

    The command is that of this very package, in a process of its own.
    """
    home = str(Path(lscan.__file__).parents[1])
    command = [sys.executable, "-m", "lscan.cli.app", "scan", str(scene), "-o", str(run)]
    with subprocess.Popen(
        [*command, "--resume"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": home},
    ) as scan:
        try:
            _, said = scan.communicate(timeout=kill_after_s)
        except subprocess.TimeoutExpired:
            scan.kill()  # which may come after its end: only its code tells
            _, said = scan.communicate()
    if kill_after_s is not None and scan.returncode == -signal.SIGKILL:
        return False
    if scan.returncode != 0:
        raise RuntimeError(f"a scan ended with code {scan.returncode}: {said.strip()}")
    return True


def _frames_in(run: Path) -> int:
    """Rows of the run's table that are whole."""
    table = run / TABLE
    return max(0, table.read_bytes().count(b"\n") - 1) if table.exists() else 0
