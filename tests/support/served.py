"""A small tank served as hardware, for the tests: quick to render, quick to move."""

import socket
import threading
import urllib.request
from typing import Any

from places import SCENES

from lscan.config.documents import merge
from lscan.config.rig import RigFile, load_rig, parse_rig
from sim.emulators import EmulatedHardware
from sim.scene import Scene, scene_of
from sim.sensor.webcam import from_jpeg

PAPER = SCENES / "paper"
LONG_S = 120.0  # only what hangs takes so long
QUICK = {25: 60_000, 110: 60_000, 120: 20_000}  # mm/min, mm/s2: a move takes milliseconds


def small_scene(**sections: Any) -> Scene:
    """The sandwave at 160 by 120 px in light of the first order, with sections laid over it."""
    rig_file = load_rig(PAPER / "sandwave.toml")
    small = {
        "camera": {"width_px": 160, "height_px": 120},
        "lens": {"focal_px": 212.5, "centre_px": [79.5, 59.5]},
        "plan": {"start_mm": 20.0, "step_mm": 25.0, "frames": 4},
        "render": {"samples": 1, "scatter_samples": 0},
    }
    return scene_of(parse_rig(merge(merge(rig_file.document, small), sections), source="small"))


def hurry(hardware: EmulatedHardware) -> None:
    """Make the machine so quick that no test waits for it."""
    hardware.controller.settings.update(QUICK)


def quick_rig(
    hardware: EmulatedHardware, camera: dict[str, Any] | None = None, **track: Any
) -> RigFile:
    """The hardware's rig, with short waits; camera, track: options laid over it.

    It moves as fast as the controller's $110 allows.
    """
    feed = hardware.controller.settings.get(110, 6_000.0)
    options = {
        "camera": {"options": {"reconnects": 0, "timeout_s": LONG_S, **(camera or {})}},
        "track": {"options": {"feed_mm_min": feed, "answer_s": 60.0, **track}},
    }
    return parse_rig(merge(hardware.rig_document(), options), source="served")


class Viewer:
    """A client of a stream that reads part by part."""

    def __init__(self, url: str, timeout_s: float = LONG_S) -> None:
        self._stream = urllib.request.urlopen(url, timeout=timeout_s)

    def picture(self) -> bytes:
        """The next part's JPEG."""
        length = 0
        while line := self._stream.readline():
            if line.lower().startswith(b"content-length:"):
                length = int(line.split(b":")[1])
            if line == b"\r\n" and length:
                return self._stream.read(length)
        raise EOFError("the stream has ended")

    def close(self) -> None:
        self._stream.close()


def stalled(url: str) -> socket.socket:
    """A client that asks for a stream and never reads."""
    host, _, rest = url.removeprefix("http://").partition(":")
    port, _, path = rest.partition("/")
    client = socket.create_connection((host, int(port)), timeout=LONG_S)
    client.sendall(f"GET /{path} HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
    return client


def snapshot(hardware: EmulatedHardware) -> Any:
    """A picture by HTTP, (H, W, 3) RGB."""
    with urllib.request.urlopen(hardware.snapshot_url, timeout=LONG_S) as answer:
        return from_jpeg(answer.read())


def threads_of_hardware() -> set[threading.Thread]:
    """The threads that served hardware runs."""
    names = ("emulated camera", "http", "serial ", "client ")
    return {thread for thread in threading.enumerate() if thread.name.startswith(names)}
