"""What is connected to this machine, and which drivers can use it."""

import importlib
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2

from lscan.config.plugins import find_entry, find_plugin, installed
from lscan.config.rig import RigFile, drivers_of
from lscan.devices.api import CapabilityReporting, Fact
from lscan.devices.opencv_camera import Capture, OpencvOptions, open_capture
from lscan.devices.opencv_camera.options import ROOT, fourcc_text, names_by_id
from lscan.errors import InputError

SIZES_PX = ((320, 240), (640, 480), (800, 600), (1280, 720), (1920, 1080), (3840, 2160))
"""Sizes a video device is asked for: those common among webcams."""

PROBE_S = 10.0
"""A device that has not answered by then counts as hung."""

NUMBERS_TRIED = 4
"""Where the system does not name its cameras, these many numbers are tried."""


@dataclass(frozen=True, order=True)
class SerialPort:
    """A serial port: what ``track.options.port`` may name."""

    device: str
    description: str


@dataclass(frozen=True)
class VideoDevice:
    """A camera as found.  state: "ready", or why not.

    size_px, pixel_format, fps: as it stands when opened.  sizes_px: those it takes when asked,
    of the common ones.  by_id: its names in /dev/v4l/by-id, which stay when its number changes.
    """

    device: int | str
    state: str
    size_px: tuple[int, int] | None = None
    pixel_format: str | None = None
    fps: float | None = None
    sizes_px: tuple[tuple[int, int], ...] = ()
    by_id: tuple[str, ...] = ()


@dataclass(frozen=True)
class Driver:
    """A driver that is installed.  kind: "camera" or "track".  does: what it is, in a line."""

    kind: str
    name: str
    does: str


def serial_ports() -> list[SerialPort] | None:
    """The serial ports of this machine by name; None where pyserial is not installed."""
    try:
        list_ports = importlib.import_module("serial.tools.list_ports")
    except ImportError:
        return None
    return sorted(SerialPort(port.device, port.description) for port in list_ports.comports())


def video_devices(
    open_device: Callable[[OpencvOptions], Capture] = open_capture, root: Path = ROOT
) -> list[VideoDevice]:
    """The cameras of this machine, each opened for a moment and asked what it can do.

    Parameters
    ----------
    open_device : callable
        Opens a device as ``open_capture`` does.
    root : Path
        Of the file system, whose ``dev/video*`` are tried on Linux; elsewhere the first few
        numbers are.

    Returns
    -------
    list of VideoDevice
        Sizes in px; on Linux also of devices that do not open, with the reason.
    """
    if sys.platform == "linux":
        found = sorted(root.glob("dev/video*"), key=lambda path: (len(path.name), path.name))
        names = names_by_id(root)
        return [
            replace(_probe(str(path), open_device), by_id=names.get(path.resolve(), ()))
            for path in found
        ]
    tried = [_probe(number, open_device) for number in range(NUMBERS_TRIED)]
    return [device for device in tried if device.size_px is not None]


def drivers() -> list[Driver]:
    """The camera and track drivers that are installed; one that cannot be loaded says why."""
    return [
        Driver(kind, name, _what_it_does(f"lscan.{kind}s", name))
        for kind in ("camera", "track")
        for name in installed(f"lscan.{kind}s")
    ]


def rig_devices(rig_file: RigFile) -> dict[str, dict[str, Fact]]:
    """What the rig's devices can do, as known without touching them.

    Parameters
    ----------
    rig_file : RigFile, names the drivers and their options

    Returns
    -------
    dict
        "camera" and "track", each facts by names that carry the unit.

    Raises
    ------
    InputError
        A driver is unknown or refuses its options.
    """
    rig = rig_file.rig
    camera, track = drivers_of(rig, rig_file.source)
    return {
        "camera": {
            **rig.camera.model_dump(exclude={"options"}),
            "takes_dark_pictures": getattr(camera, "takes_dark", False),
            **_capabilities(camera, rig_file),
        },
        "track": {
            "driver": rig.track.driver,
            "switches_laser": getattr(track, "switches_laser", False),
            **_capabilities(track, rig_file),
        },
    }


def _capabilities(driver: object, rig_file: RigFile) -> dict[str, Fact]:
    return driver.capabilities(rig_file) if isinstance(driver, CapabilityReporting) else {}


def _what_it_does(group: str, name: str) -> str:
    """The first line of the driver's module, which says what the driver is, or why it is none."""
    try:
        find_plugin(group, name)
    except InputError as error:
        return error.what
    document = sys.modules[find_entry(group, name).module].__doc__ or ""
    return document.strip().partition("\n")[0]


def _probe(device: int | str, open_device: Callable[[OpencvOptions], Capture]) -> VideoDevice:
    """The device as found; asked in a thread, since a broken camera may never answer."""
    answer: list[VideoDevice] = []

    def ask() -> None:
        try:
            answer.append(_ask(device, open_device(OpencvOptions(device=device))))
        except cv2.error as error:
            answer.append(VideoDevice(device, f"failed: {' '.join(str(error).split())}"))

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(PROBE_S)
    return answer[0] if answer else VideoDevice(device, f"hangs: no answer in {PROBE_S:g} s")


def _ask(device: int | str, capture: Capture) -> VideoDevice:
    try:
        if not capture.isOpened():
            return VideoDevice(device, "cannot be opened as a camera, or is in use")
        size_px, fps = _size_px(capture), capture.get(cv2.CAP_PROP_FPS)
        pixel_format = fourcc_text(capture.get(cv2.CAP_PROP_FOURCC))
        taken = tuple(size for size in SIZES_PX if _takes(capture, size))
        return VideoDevice(device, "ready", size_px, pixel_format, fps if fps > 0 else None, taken)
    finally:
        capture.release()


def _takes(capture: Capture, size_px: tuple[int, int]) -> bool:
    capture.set(cv2.CAP_PROP_FRAME_WIDTH, size_px[0])
    capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size_px[1])
    return _size_px(capture) == size_px


def _size_px(capture: Capture) -> tuple[int, int]:
    width, height = cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT
    return int(capture.get(width)), int(capture.get(height))
