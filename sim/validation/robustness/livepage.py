"""The live page beside a scan of the served tank: pictures drawn a second, in a real browser."""

from __future__ import annotations

import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

from lscan.acquisition.scan import scan
from lscan.calibration.calibrationfile import save_calibration
from lscan.config.documents import toml_text
from lscan.config.rig import load_rig
from lscan.errors import MeasurementError
from lscan.files.disk import make_folder, write_atomically
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from sim.scene import load_scene
from sim.testing.browser import TIMEOUT_MS, headless_chromium, wait_for
from sim.validation.robustness.commands import command_running
from sim.validation.robustness.effort import HardwareEffort
from sim.validation.rows import Row, row

if TYPE_CHECKING:
    from playwright.sync_api import Page

STEP_MM = 2.0
SHORTEST = 5 / 6  # of the time over which pictures are to be counted
COUNT = "[performance.now() / 1000, window.lscan.profilesDrawn]"


def livepage_rows(scenes: Path, folder: Path, effort: HardwareEffort) -> list[Row]:
    """Pictures a second that headless Chromium draws, with stripe and profile, during a scan.

    The webcam, the track, the page and the browser are processes of their own, all on this
    machine; the scan is started and stopped by clicks.  scenes: folder that holds
    paper/board.toml and paper/sandwave.toml.  folder: for what is written, replaced if it is
    there; a screenshot of the scan, page.png, stays in it.  effort: frames of the scan, over how
    long pictures are counted, and how the tank is rendered, which is done beforehand.  Raises
    BrowserMissing where there is no Chromium or no Playwright, MeasurementError where a process
    does not do its part.
    """
    with headless_chromium() as chromium:  # first: it may be missing
        page = chromium.new_page(viewport={"width": 1280, "height": 800})
        page.set_default_timeout(TIMEOUT_MS)
        shutil.rmtree(folder, ignore_errors=True)
        make_folder(folder)
        scanned = scan(load_rig(scenes / "paper" / "board.toml"), folder / "board")
        board = measure_board(scanned, (CHOSEN_MAP,))
        calibration, rig, scene = (
            folder / name for name in ("board.json", "rig.toml", "scene.toml")
        )
        save_calibration(calibration, board.calibrations[CHOSEN_MAP])
        sandwave = (scenes / "paper" / "sandwave.toml").resolve().as_posix()
        # Fewer frames than the paper's, so that it is rendered in a minute or two.
        plan = {"frames": effort.live_frames, "step_mm": STEP_MM}
        short = {"include": sandwave, "plan": plan, "render": effort.render}
        write_atomically(scene, toml_text(short).encode())
        serve = ["sim.cli.app", "serve", str(scene), "--prepare", "--write-rig", str(rig)]
        live = ["lscan.cli.app", "live", str(rig), "--calibration", str(calibration)]
        live += ["--port", "0", "--output", str(folder / "runs")]
        with (
            command_running(serve, "rig:", folder / "serve.log"),
            command_running(live, "http", folder / "live.log") as (line, _),
        ):
            page.goto(line.split()[0])
            rate_hz = _rate_while_scanning(page, effort.live_s, folder / "page.png")
    seed = load_scene(scene).tank.sensor.seed
    return [row("live-page", rate_hz, seed=seed, seconds=SHORTEST * effort.live_s)]


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
