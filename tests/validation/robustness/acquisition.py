"""A scan killed and resumed, and one by drivers of real devices beside the tank's own.

Each scan is the command ``lscan scan`` in a process of its own, on the simulated drivers.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

import lscan
from lscan.acquisition.run import MANIFEST, TABLE, Run
from lscan.acquisition.scan import scan
from lscan.benchmark.methods import time_call
from lscan.calibration.planemap import PlaneMap
from lscan.config.documents import Document, merge, write_toml
from lscan.config.rig import Rig, RigFile, load_rig, parse_rig
from lscan.config.targets import Sandwave
from lscan.files.disk import make_folder
from lscan.files.pictures import eight_bit
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from lscan.pipeline import build_surface, place, reconstruct
from lscan.records import Floats, Surface
from lscan.stripe import extract_stripe
from lscan.surface import Alignment, resample
from lscan.surface.surface import to_profile
from sim.emulators import EmulatedHardware, ServeOptions
from sim.scene import scene_of
from sim.sensor.webcam import from_jpeg, jpeg_bytes
from tests.validation.robustness.effort import HardwareEffort
from tests.validation.rows import Row, row

# A scan killed at random moments and resumed: the same bytes as the scan that was not killed.

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


# The same scan through the drivers of real devices and through the tank's own.


STEP_MM = 2.0


def agreement_rows(scenes: Path, folder: Path, effort: HardwareEffort) -> list[Row]:
    """Rms differences in height between scans of the sandwave, taken through different drivers.

    The opencv and grbl drivers on the served tank, the sim drivers' pictures through JPEG alone,
    and the sim drivers with other noise, each against the same scan by the sim drivers.

    Parameters
    ----------
    scenes : Path
        Folder that holds paper/board.toml and paper/sandwave.toml.
    folder : Path
        Where the runs go; it is made, and earlier runs in it are replaced.
    effort : HardwareEffort
        Frames of each scan, how they are rendered, and whether heights are compared on the
        slices, which takes a hundred frames, or where they were measured.

    Raises
    ------
    InputError
        Where a scene is wrong.
    """
    make_folder(folder)
    board_rig = _changed(load_rig(scenes / "paper" / "board.toml"), render=effort.render)
    board = _fresh(board_rig, folder / "board")
    plane_map = measure_board(board, (CHOSEN_MAP,)).calibrations[CHOSEN_MAP].plane_map
    changes = {"plan": {"frames": effort.scan_frames, "step_mm": STEP_MM}, "render": effort.render}
    rig_file = _changed(load_rig(scenes / "paper" / "sandwave.toml"), **changes)
    scene = scene_of(rig_file)
    seed = scene.tank.sensor.seed
    simulated = _fresh(rig_file, folder / "simulated")
    repeated = _fresh(_changed(rig_file, sensor={"seed": seed + 1}), folder / "repeated")
    options = ServeOptions(prepare=True)
    with EmulatedHardware(scene, options) as hardware:
        seconds, served = time_call(lambda: _fresh(hardware.rig_file(), folder / "served"))
    built = reconstruct(simulated, plane_map)
    alignment = built.require_alignment() if effort.aligned else None
    surfaces = {
        "served-scan": reconstruct(served, plane_map).raw,
        "jpeg-alone": _coded(simulated, plane_map, options),
        "noise-alone": reconstruct(repeated, plane_map).raw,
    }
    words: dict[str, Any] = {
        "seed": seed,
        "other": seed + 1,
        "where": "slices" if effort.aligned else "columns",
        "coding": f"JPEG quality {options.quality}, {options.subsampling}",
        "frames": effort.scan_frames,
        "frame_ms": 1000 * seconds / effort.scan_frames,
    }
    expected_mm = _heights_mm(built.raw, rig_file.rig, alignment)
    rows = []
    for key, raw in surfaces.items():
        difference_mm = _heights_mm(raw, rig_file.rig, alignment) - expected_mm
        rows.append(row(key, float(np.sqrt(np.nanmean(difference_mm**2))), **words))
    return rows


def _changed(rig_file: RigFile, **sections: Document) -> RigFile:
    """The rig with these sections laid over its own."""
    return parse_rig(merge(rig_file.document, sections), source=rig_file.source)


def _heights_mm(raw: Surface, rig: Rig, alignment: Alignment | None) -> Floats:
    """Heights on the sandwave's slices, placed by the alignment; without one those of all points.

    NaN where there is no value.
    """
    if alignment is None:
        return raw.xyz_mm[..., 2]
    assert isinstance(rig.workpiece, Sandwave)
    placed = place(raw, alignment, rig)
    return np.concatenate(
        [resample(placed, ends).z_mm for ends in rig.workpiece.slices_mm().values()]
    )


def _coded(run: Run, plane_map: PlaneMap, options: ServeOptions) -> Surface:
    """The raw surface of the run's pictures, each through the served camera's JPEG."""
    profiles = []
    for frame in run.frames():
        image = from_jpeg(jpeg_bytes(eight_bit(frame.image), options.quality, options.subsampling))
        stripe = extract_stripe(image, run.rig_file.rig.stripe)
        profiles.append(to_profile(stripe, plane_map, frame.position_mm))
    return build_surface(profiles, run.rig_file.rig)


def _fresh(rig_file: RigFile, folder: Path) -> Run:
    """A new run in the folder, in the place of an earlier one."""
    if (folder / MANIFEST).exists():
        shutil.rmtree(folder)
    return scan(rig_file, folder)
