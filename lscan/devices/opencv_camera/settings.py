"""Setting a camera, and reading back what it made of it."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import cv2

from lscan.config.rig import CameraSection
from lscan.devices.opencv_camera.options import Capture, OpencvOptions

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
    stated = _stated(section, options, exposure)

    def set_and_read(names: Iterable[str]) -> dict[str, Setting]:
        for name in names:
            key, asked = stated[name]
            capture.set(key, to_raw.get(name, float)(asked))
        return {
            name: Setting(name, asked, to_user.get(name, _reported)(capture.get(key)))
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


def _stated(
    section: CameraSection, options: OpencvOptions, exposure: _Exposure
) -> dict[str, tuple[int, Value]]:
    """OpenCV's property and what it is set to, by name; without what the rig file leaves open.

    In the order in which they are set: the format first, automatics before their values.
    """
    automatic, focus, white = options.auto_exposure, options.focus, options.white_balance
    mode = exposure.automatic if automatic else exposure.manual
    every = {
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


def _reported(raw: float) -> float | None:
    """OpenCV's number, None for -1: it says so of what the camera does not have."""
    return None if raw == -1 else raw


def fourcc_text(raw: float) -> str | None:
    """The four letters of a pixel format in OpenCV's number; None where it is not one."""
    code = int(raw)
    letters = bytes(code >> shift & 0xFF for shift in (0, 8, 16, 24)) if code > 0 else b""
    text = letters.decode("latin-1")
    return text if len(text) == 4 and text.isprintable() else None
