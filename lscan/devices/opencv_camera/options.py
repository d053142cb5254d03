"""``[camera.options]`` of the opencv driver: what it may say, set on a camera and read back."""

import math
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import Annotated, Any, Literal, Protocol, Self

import cv2
import numpy as np
from pydantic import Field, model_validator

from lscan.config.documents import Strict
from lscan.config.rig import CameraSection
from lscan.files.pictures import grey_dn
from lscan.records import Picture

# What ``[camera.options]`` of a rig file may say to the opencv driver, and what a capture is.

_OF_A_DEVICE = ("pixel_format", "fps", "gain", "focus", "white_balance", "auto_exposure")

Url = Annotated[
    str,
    Field(
        pattern=r"^(https?|rtsps?|rtmp|udp|tcp)://\S+$",
        description="an address that begins with http, https, rtsp, rtsps, rtmp, udp or tcp ://",
    ),
]
FourLetters = Annotated[
    str, Field(pattern=r"^[ -~]{4}$", description='four letters such as "MJPG" or "YUYV"')
]


class OpencvOptions(Strict):
    """Which camera, how it is set, and what is done with its pictures.

    One of: device, a number or a path; url, of a stream; file, of a video, whose pictures come
    one by one in their order.  A device and a stream are *live*: they go on without being asked.

    For a device only; what is left out is left as the camera has it:
    pixel_format: four letters, such as "MJPG" or "YUYV".  fps: pictures per second.
    gain, focus, white_balance: in the camera's own units (white balance mostly in kelvin);
    a stated focus or white balance switches the automatic one off.  auto_exposure: lets the
    camera choose, in place of ``camera.exposure_ms``.
    strict_settings: refuse a camera that does not do as it is set, instead of reporting it.

    For live cameras only:
    warm_up_frames: dropped after opening, while the camera settles.
    flush_frames: dropped after the call, since a picture that arrives after it may have been
    exposed before it; flush_ms: only what arrives this long after the call is looked at.  A stream
    that is not of JPEG pictures needs flush_ms stated: an encoder that codes changes holds
    pictures back (B-frames, looking ahead), by a time that only a change in view shows.
    Should the program be held up for seconds, a device's own time stamps and, on a stream of
    JPEG pictures, flush_frames of 2 keep out what queued meanwhile (see jpegstream for what is
    not guaranteed); on a stream of another codec only flush_ms or the track's settle_s do.
    retries: black, broken or repeated pictures and failed readings in a row that are passed over
    before giving up.
    repeated: what becomes of a picture that is the one before, byte for byte: "refuse" it, since
    noise makes pictures differ and a camera that repeats one is stuck, or "accept" it, where the
    camera smooths all noise away.  A stream that codes changes repeats what does not change, and
    is always accepted.
    reconnects: how often in one grab a camera that hung or vanished is opened again, each time
    after reconnect_wait_s: a cable just plugged in takes a second.

    average_frames: pictures averaged into one, pixel by pixel, rounded.
    timeout_s: how long to wait for the camera to open, and for each picture.
    black: what becomes of a picture with no pixel above black_dn: "refuse" it, "report" it
    with a warning, or "accept" it (the cap is on, the laser is off in a dark room).
    """

    device: Annotated[int, Field(ge=0, le=63)] | Annotated[str, Field(min_length=1)] | None = None
    url: Url | None = None
    file: Annotated[str, Field(min_length=1)] | None = None

    pixel_format: FourLetters | None = None
    fps: Annotated[float, Field(gt=0, le=1000)] | None = None
    gain: Annotated[float, Field(ge=0, le=1e6)] | None = None
    focus: Annotated[float, Field(ge=0, le=1e6)] | None = None
    white_balance: Annotated[float, Field(ge=0, le=1e6)] | None = None
    auto_exposure: bool = False
    strict_settings: bool = False

    warm_up_frames: Annotated[int, Field(ge=0, le=1000)] = 5
    flush_frames: Annotated[int, Field(ge=0, le=100)] = 2
    flush_ms: Annotated[float, Field(ge=0, le=60_000)] = 0.0
    retries: Annotated[int, Field(ge=0, le=1000)] = 30
    reconnects: Annotated[int, Field(ge=0, le=100)] = 2
    reconnect_wait_s: Annotated[float, Field(ge=0, le=600)] = 1.0

    average_frames: Annotated[int, Field(ge=1, le=256)] = 1
    timeout_s: Annotated[float, Field(ge=0.02, le=600)] = 5.0
    black: Literal["refuse", "report", "accept"] = "refuse"
    black_dn: Annotated[float, Field(ge=0, le=254)] = 1.0
    repeated: Literal["refuse", "accept"] = "refuse"

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        sources = (self.device, self.url, self.file)
        if sum(source is not None for source in sources) != 1:
            raise ValueError("needs exactly one of device, url and file")
        stated = sorted(self.model_fields_set & set(_OF_A_DEVICE))
        if self.device is None and stated:
            raise ValueError(f"{stated[0]} can only be set on a device, not on a url or a file")
        return self

    @property
    def live(self) -> bool:
        """Whether pictures come without being asked: a device or a stream."""
        return self.file is None

    @property
    def waits_for_change(self) -> bool:
        """Whether it is stated how long a picture that arrives may be older than the call."""
        return "flush_ms" in self.model_fields_set

    @property
    def pictures_per_grab(self) -> int:
        """How many pictures of a live camera one grab waits for."""
        return self.flush_frames + self.average_frames

    @property
    def exposure_settable(self) -> bool:
        """Whether ``exposure_ms`` is set: of a device that does not choose by itself."""
        return self.device is not None and not self.auto_exposure

    @property
    def name(self) -> str:
        """What messages call the camera."""
        if self.device is not None:
            return f"camera opencv (device {self.device})"
        return f"camera opencv ({self.url or self.file})"

    def is_black(self, image: Picture) -> bool:
        """Whether no pixel is above ``black_dn``.

        Parameters
        ----------
        image : (H, W) or (H, W, 3) array, uint8 or uint16
        """
        return bool(grey_dn(image.max()) <= self.black_dn)

    def is_stuck(self, image: Picture, last: Picture) -> bool:
        """Whether a live camera sent its last picture again.

        Black ones hold no noise to compare, and have a rule of their own.

        Parameters
        ----------
        image, last : (H, W) or (H, W, 3) array, uint8 or uint16, the picture and the one before
        """
        meant = self.repeated == "accept" or not self.live
        return not meant and np.array_equal(image, last) and not self.is_black(image)


class Capture(Protocol):
    """What the driver needs of a ``cv2.VideoCapture``; tests put a faulty one in its place."""

    def isOpened(self) -> bool: ...  # noqa: N802 - OpenCV's name

    def read(self) -> tuple[bool, Any]: ...

    def get(self, propId: int, /) -> float: ...  # noqa: N803 - OpenCV's name

    def set(self, propId: int, value: float, /) -> bool: ...  # noqa: N803 - OpenCV's name

    def release(self) -> None: ...

    def getBackendName(self) -> str: ...  # noqa: N802 - OpenCV's name


OpenCapture = Callable[[OpencvOptions], Capture]


# Setting a camera, and reading back what it made of it.


RELATIVE_TOLERANCE = 0.01
"""A number read back within one per cent counts as obeyed: cameras round to steps."""

AGAIN_TIMES, AGAIN_WAIT_S = 5, 0.2
"""How often, and after what wait, a value that was refused is set again: a camera whose automatic
is just ending (a focus that still moves) refuses the value that the automatic held."""

HELD_BY_AUTOMATICS = ("exposure_ms", "gain", "focus", "white_balance")

Value = float | str


@dataclass(frozen=True)
class Setting:
    """One setting: what was asked, and what the camera then reported (None: nothing)."""

    name: str
    asked: Value
    got: Value | None

    @property
    def obeyed(self) -> bool:
        """Whether the camera reports what was asked, numbers within 1 %."""
        if isinstance(self.asked, str) or isinstance(self.got, str) or self.got is None:
            return self.asked == self.got
        return abs(self.got - self.asked) <= RELATIVE_TOLERANCE * abs(self.asked)

    def __str__(self) -> str:
        got = "nothing" if self.got is None else f"{self.got}"
        return f"{self.name}: asked {self.asked}, got {got}"


@dataclass(frozen=True)
class Settings:
    """All settings of a camera as read back, and its exposure time.

    exposure_ms: as reported by the camera; the rig file's where it reports none.
    """

    settings: tuple[Setting, ...]
    exposure_ms: float


@dataclass(frozen=True)
class _Exposure:
    """How one of OpenCV's back ends writes exposure times."""

    to_raw: Callable[[float], float]
    to_ms: Callable[[float], float | None]
    manual: float
    automatic: float


# Video4Linux: exposure_time_absolute in 100 µs; auto_exposure 1 is manual, 3 aperture priority
# (Linux kernel documentation, "Camera Control Reference").
_LINUX = _Exposure(
    to_raw=lambda ms: float(max(1, round(10 * ms))),
    to_ms=lambda raw: raw / 10 if raw > 0 else None,
    manual=1.0,
    automatic=3.0,
)
# DirectShow and Media Foundation: whole powers of two of a second (Microsoft,
# KSPROPERTY_CAMERACONTROL_EXPOSURE).
_WINDOWS = _Exposure(
    to_raw=lambda ms: float(round(math.log2(ms / 1000))),
    to_ms=lambda raw: 1000 * 2.0**raw if -30 < raw < 0 else None,
    manual=0.0,
    automatic=1.0,
)


def apply_settings(capture: Capture, section: CameraSection, options: OpencvOptions) -> Settings:
    """What the camera reports once everything the rig file states has been set.

    All is set before anything is read: one setting may change another.  Streams and files have
    nothing to set; their exposure is the rig file's.
    """
    if options.device is None:
        return Settings((), section.exposure_ms)
    exposure = _LINUX if capture.getBackendName() == "V4L2" else _WINDOWS
    to_raw: dict[str, Callable[[Any], float]] = {
        "pixel_format": lambda letters: float(cv2.VideoWriter.fourcc(*letters)),
        "exposure_ms": exposure.to_raw,
    }
    to_user = {"pixel_format": fourcc_text, "exposure_ms": exposure.to_ms}
    stated = _stated_settings(section, options, exposure)

    def set_and_read(names: Iterable[str]) -> dict[str, Setting]:
        for name in names:
            key, asked = stated[name]
            capture.set(key, to_raw.get(name, float)(asked))
        return {
            name: Setting(name, asked, to_user.get(name, _reported_value)(capture.get(key)))
            for name, (key, asked) in stated.items()
        }

    settings = set_and_read(stated)
    for _ in range(AGAIN_TIMES):
        refused = [name for name in HELD_BY_AUTOMATICS if _may_be_held(settings.get(name))]
        if not refused:
            break
        time.sleep(AGAIN_WAIT_S)
        settings = set_and_read(refused)
    exposure_ms = exposure.to_ms(capture.get(cv2.CAP_PROP_EXPOSURE))
    return Settings(tuple(settings.values()), exposure_ms or section.exposure_ms)


def _may_be_held(setting: Setting | None) -> bool:
    """Whether a value is the camera's to set, and not yet what was asked."""
    return setting is not None and setting.got is not None and not setting.obeyed


def _stated_settings(
    section: CameraSection, options: OpencvOptions, exposure: _Exposure
) -> dict[str, tuple[int, Value]]:
    """OpenCV's property and what it is set to, by name; without what the rig file leaves open.

    In the order in which they are set: the format first, automatics before their values.
    """
    automatic, focus, white = options.auto_exposure, options.focus, options.white_balance
    mode = exposure.automatic if automatic else exposure.manual
    every = {
        # What is converted to colours has 8 bits.
        "conversion": (cv2.CAP_PROP_CONVERT_RGB, None if section.bits == 8 else 0),
        "pixel_format": (cv2.CAP_PROP_FOURCC, options.pixel_format),
        "width_px": (cv2.CAP_PROP_FRAME_WIDTH, section.width_px),
        "height_px": (cv2.CAP_PROP_FRAME_HEIGHT, section.height_px),
        "fps": (cv2.CAP_PROP_FPS, options.fps),
        "auto_exposure": (cv2.CAP_PROP_AUTO_EXPOSURE, mode),
        "exposure_ms": (cv2.CAP_PROP_EXPOSURE, None if automatic else section.exposure_ms),
        "gain": (cv2.CAP_PROP_GAIN, options.gain),
        "autofocus": (cv2.CAP_PROP_AUTOFOCUS, None if focus is None else 0),
        "focus": (cv2.CAP_PROP_FOCUS, focus),
        "auto_white_balance": (cv2.CAP_PROP_AUTO_WB, None if white is None else 0),
        "white_balance": (cv2.CAP_PROP_WB_TEMPERATURE, white),
    }
    return {
        name: (key, asked if isinstance(asked, str) else float(asked))
        for name, (key, asked) in every.items()
        if asked is not None
    }


def _reported_value(raw: float) -> float | None:
    """OpenCV's number, None for -1: it says so of what the camera does not have."""
    return None if raw == -1 else raw


def fourcc_text(raw: float) -> str | None:
    """The four letters of a pixel format in OpenCV's number; None where it is not one."""
    code = int(raw)
    letters = bytes(code >> shift & 0xFF for shift in (0, 8, 16, 24)) if code > 0 else b""
    text = letters.decode("latin-1")
    return text if len(text) == 4 and text.isprintable() else None


# Which camera is behind a number: the names that Linux gives to a video device.
#
# udev links ``/dev/v4l/by-id`` to the devices by maker, model and, where the camera has one, serial
# number; the kernel names the model in ``/sys/class/video4linux``.  A number says nothing: it goes
# to whichever camera is plugged in first.


ROOT = Path("/")


def names_by_id(root: Path = ROOT) -> dict[Path, tuple[str, ...]]:
    """The links in /dev/v4l/by-id by the device that each leads to; {} where there are none.

    root: of the file system.
    """
    found: dict[Path, tuple[str, ...]] = {}
    for link in sorted((root / "dev/v4l/by-id").glob("*")):
        device = link.resolve()
        found[device] = (*found.get(device, ()), f"/dev/v4l/by-id/{link.name}")
    return found


def device_identity(device: int | str | None, root: Path = ROOT) -> str | None:
    """What tells a video device from others as far as this system knows; None where it does not.

    Two of one model without serial numbers are not told apart.  device: as in a rig file, None for
    what is no device.
    """
    if device is None:
        return None
    path = root / f"dev/video{device}" if isinstance(device, int) else root / device.lstrip("/")
    node = path.resolve()
    if names := names_by_id(root).get(node):
        return names[0].rpartition("/")[2]
    try:
        return (root / "sys/class/video4linux" / node.name / "name").read_text().strip() or None
    except (OSError, UnicodeDecodeError):
        return None


# What an address that OpenCV cannot open as a stream answers instead.


LONGEST_WAIT_S = 2.0

NEEDED = (
    "needed: a stream, such as MJPEG over http (multipart/x-mixed-replace) or rtsp; look up its "
    "address in the camera's manual"
)


def reason_unopened(url: str | None) -> str:
    """Why a stream could not be opened, in words, and what to do; asks an http address for it.

    url: None for a device or a file.
    """
    if url is None:
        return (
            "cannot be opened; check that it is there, that no other program uses it, and the "
            "name (`lscan devices` lists what is connected)"
        )
    answer = _answer(url) if url.startswith(("http://", "https://")) else None
    if answer is None:
        return (
            "cannot be opened; check that the camera is on, that it and this computer are in one "
            "network, and camera.options.url"
        )
    if answer.startswith(("multipart/", "video/")):
        return (
            f"cannot be opened, though the address answers ({answer}); look at it in a browser, "
            "and end other programs that use the camera"
        )
    return f"what the address sends is no stream of pictures ({answer}); {NEEDED}"


def ended_early(count: int) -> str:
    """What to say of an address that gave ``count`` pictures at once, and ended."""
    if count == 0:
        return f"what the address sends is no stream of pictures; {NEEDED}"
    pictures = "1 picture" if count == 1 else f"{count} pictures"
    return f"the address gave {pictures} and ended; {NEEDED}"


def _answer(url: str) -> str | None:
    """The kind of content, or the refusal, of an http address; None where none answers."""
    try:
        with urllib.request.urlopen(url, timeout=LONGEST_WAIT_S) as answer:
            return str(answer.headers.get_content_type())
    except urllib.error.HTTPError as refusal:
        return f"{refusal.code} {refusal.reason}"
    except (OSError, ValueError, HTTPException):
        return None
