"""The live page beside a scan of the served tank: pictures drawn a second, in a real browser."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import psutil

from lscan.acquisition.scan import open_track, scan
from lscan.calibration.calibrationfile import save_calibration
from lscan.config.documents import merge, toml_text
from lscan.config.rig import load_rig, parse_rig
from lscan.errors import MeasurementError
from lscan.files.disk import make_folder, write_atomically
from lscan.paper.experiment import measure_board
from lscan.paper.published import CHOSEN_MAP
from sim.emulators.webcam import BOUNDARY, LONG_MOVE_S
from sim.scene import load_scene
from tests.validation.browser import TIMEOUT_MS, headless_chromium, wait_for
from tests.validation.robustness.effort import HardwareEffort
from tests.validation.rows import Row, row

if TYPE_CHECKING:
    from playwright.sync_api import Page


# The project's commands, run as processes of their own beside what is measured_rows.


@contextmanager
def command_running(
    module: Sequence[str], ready: str, log: Path
) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A command of this project while it runs: the line that it got ready by, and its process.

    Parameters
    ----------
    module : sequence of str, of its module and its arguments
    ready : str, what the line begins with
    log : Path, where its stderr goes

    Raises
    ------
    MeasurementError
        It ends before it is ready.
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
        yield line, process
    finally:
        process.terminate()
        try:
            process.wait(timeout=60.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


# The live page beside a scan of the served tank: pictures drawn a second, in a real browser.


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


# Pictures of a head that moves, from the served tank, with nothing rendered beforehand.


BEGUN_S = 2 * LONG_MOVE_S  # of a move: from then on every picture is of a place that is passed
FPS = 60  # more than can be rendered
TIMEOUT_S = 60.0


def moving_rows(sandwave: Path, folder: Path, seconds: float) -> list[Row]:
    """Pictures that a client gets in a second while the head goes along the plan, and memory.

    The tank is served by a process of its own, which renders each picture where the head is.  It
    starts others at the first long move, so that the second is counted.  Memory is of all, what
    they share once.

    Parameters
    ----------
    sandwave : Path, the scene file
    folder : Path, for what is written
    seconds : float, s, that the move takes
    """
    make_folder(folder)
    rig, log = folder / "rig.toml", folder / "serve.log"
    serve = ["sim.cli.app", "serve", str(sandwave), "--fps", str(FPS), "--write-rig", str(rig)]
    with command_running(serve, "rig:", log) as (_, process):
        served = load_rig(rig)
        places_mm = served.rig.plan.positions_mm()
        feed = 60 * abs(places_mm[-1] - places_mm[0]) / seconds
        slow = {"track": {"options": {"feed_mm_min": feed}}}
        track = open_track(parse_rig(merge(served.document, slow), source=str(rig)))
        try:
            track.move_to(places_mm[0])
            for place_mm in (places_mm[-1], places_mm[0]):
                move = threading.Thread(target=track.move_to, args=(place_mm,))
                rate_hz = _rate(served.document["camera"]["options"]["url"], move)
        finally:
            track.close()
        served_by = psutil.Process(process.pid)
        everyone = [served_by, *served_by.children(recursive=True)]
        memory_gb = sum(one.memory_full_info().pss for one in everyone) / 1e9
    return [
        row("moving-pictures", rate_hz, seconds=seconds),
        row("moving-memory", memory_gb),
    ]


def _rate(url: str, move: threading.Thread) -> float:
    """Pictures a second of a stream while a move goes on, but for its beginning."""
    mark, count = b"--" + BOUNDARY.encode(), 0
    with urllib.request.urlopen(url, timeout=TIMEOUT_S) as stream:
        move.start()
        time.sleep(BEGUN_S)
        began_s = now_s = time.monotonic()
        for line in stream:
            if not move.is_alive():
                break
            if line.rstrip() == mark:
                count, now_s = count + 1, time.monotonic()
    move.join()
    return count / max(now_s - began_s, 1e-9)
