"""The live page beside a scan of the served tank: pictures drawn a second, in a real browser."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from lscan.acquisition.scan import scan
from lscan.calibration.solve import save_calibration
from lscan.config.rigfile import load_rig
from lscan.errors import MeasurementError
from lscan.files.disk import make_folder, write_atomically
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from sim.scene import load_scene
from sim.testing.browser import headless_chromium, wait_for
from sim.validation.rows import Row, row

if TYPE_CHECKING:
    from playwright.sync_api import Page

OUTPUT = Path("out/hardware/live")
STEP_MM = 2.0
SHORTEST = 5 / 6  # of the time over which pictures are to be counted
COUNT = "[performance.now() / 1000, window.lscan.profilesDrawn]"


def livepage_rows(scenes: Path, frames: int, seconds: float) -> list[Row]:
    """Pictures a second that headless Chromium draws, with stripe and profile, during a scan.

    The webcam, the track, the page and the browser are processes of their own, all on this
    machine; the scan is started and stopped by clicks.  scenes: folder that holds
    paper/board.toml and paper/sandwave.toml.  frames: of the scan.  seconds: over which pictures
    are counted.  What is written goes to OUTPUT, which is replaced if it is there; a screenshot
    of the scan, page.png, stays in it.  Raises BrowserMissing where there is no Chromium or no
    Playwright, MeasurementError where a process does not do its part.
    """
    with headless_chromium() as chromium:  # first: it may be missing
        shutil.rmtree(OUTPUT, ignore_errors=True)
        make_folder(OUTPUT)
        calibration, scene = _calibration(scenes), _short_scene(scenes, frames)
        rig = OUTPUT / "rig.toml"
        serve = ["sim.cli.app", "serve", str(scene), "--prepare", "--write-rig", str(rig)]
        live = ["lscan.cli.app", "live", str(rig), "--calibration", str(calibration)]
        live += ["--port", "0", "--output", str(OUTPUT / "runs")]
        with (
            _running(serve, "rig:", OUTPUT / "serve.log"),
            _running(live, "http", OUTPUT / "live.log") as line,
        ):
            chromium.page.goto(line.split()[0])
            rate_hz = _rate_while_scanning(chromium.page, seconds, OUTPUT / "page.png")
    seed = load_scene(scene).tank.sensor.seed
    return [row("live-page", rate_hz, seed=seed, seconds=SHORTEST * seconds)]


def _rate_while_scanning(page: Page, seconds: float, screenshot: Path) -> float:
    """Start a scan by a click, count the pictures drawn while it goes on, and stop it."""
    wait_for(page, "window.lscan?.profilesDrawn > 0")
    page.click("#start")
    wait_for(page, "document.querySelector('#progress').value > 0")
    began_s, began = page.evaluate(COUNT)
    now_s, drawn = began_s, began
    while now_s - began_s < seconds and page.is_enabled("#pause"):
        time.sleep(0.25)
        now_s, drawn = page.evaluate(COUNT)
    if now_s - began_s < SHORTEST * seconds:
        fault = page.inner_text("#alert")
        raise MeasurementError(
            f"the scan went on for {now_s - began_s:.1f} s only, {SHORTEST * seconds:.3g} s needed "
            f"({fault or 'no fault stated'})"
        )
    page.screenshot(path=screenshot)
    if page.is_enabled("#stop"):
        page.click("#stop")
        page.wait_for_selector("#stop:disabled", state="attached")
    return float((drawn - began) / (now_s - began_s))


def _calibration(scenes: Path) -> Path:
    """A calibration from the board picture of the paper's scene, by the sim drivers."""
    run = scan(load_rig(scenes / "paper" / "board.toml"), OUTPUT / "board")
    path = OUTPUT / "board.json"
    save_calibration(path, measure_board(run, (CHOSEN_MAP,)).calibrations[CHOSEN_MAP])
    return path


def _short_scene(scenes: Path, frames: int) -> Path:
    """The sandwave's scene with fewer frames, so that it is rendered in a minute or two."""
    path = OUTPUT / "scene.toml"
    included = os.path.relpath(scenes / "paper" / "sandwave.toml", OUTPUT)
    plan = f"[plan]\nframes = {frames}\nstep_mm = {STEP_MM}\n"
    write_atomically(path, f'include = "{Path(included).as_posix()}"\n\n{plan}'.encode())
    return path


@contextmanager
def _running(module: Sequence[str], ready: str, log: Path) -> Iterator[str]:
    """A command of this project while it runs; the line, begun with ``ready``, it got ready by.

    log: where its stderr goes.  MeasurementError where it ends before it is ready.
    """
    with log.open("wb") as stderr:
        process = subprocess.Popen(
            [sys.executable, "-m", *module], stdout=subprocess.PIPE, stderr=stderr, text=True
        )
    assert process.stdout is not None
    try:
        line = next((line for line in process.stdout if line.startswith(ready)), None)
        if line is None:
            said = log.read_text(errors="replace").strip().splitlines() or ["nothing on stderr"]
            raise MeasurementError(f"{' '.join(module[:2])} does not start: {said[-1]}")
        yield line
    finally:
        process.terminate()
        try:
            process.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()
