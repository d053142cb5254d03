"""Pictures of a head that moves, from the served tank, with nothing rendered beforehand."""

import threading
import time
import urllib.request
from pathlib import Path

import psutil

from lscan.acquisition.scan import open_track
from lscan.config.documents import merge
from lscan.config.rig import load_rig, parse_rig
from lscan.files.disk import make_folder
from sim.emulators.webcam import BOUNDARY, LONG_MOVE_S
from sim.validation.robustness.commands import command_running
from sim.validation.rows import Row, row

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
