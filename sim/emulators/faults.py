"""Faults of the emulated hardware by name, as a command line gives them."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import get_args

from lscan.errors import InputError
from sim.emulators.grbl import Faults
from sim.emulators.webcam.camera import CameraFault

CAMERA_FAULTS: Mapping[str, CameraFault] = {
    f"camera-{fault}": fault for fault in get_args(CameraFault)
}
TRACK_FAULTS: Mapping[str, Faults] = {
    "track-silent": Faults(silent=True),
    "track-garbled": Faults(garble=0.2, seed=1),
    "track-alarm": Faults(alarm=True),  # the limit switch closes in the next motion
    "track-stuck": Faults(stuck=True),
}
UNPLUGGED, HEALED = "track-unplugged", "none"
NAMES = (*CAMERA_FAULTS, *TRACK_FAULTS, UNPLUGGED, HEALED)


@dataclass(frozen=True)
class TimedFault:
    """A fault, one of NAMES, and how long after the start it begins; "none" ends all others."""

    name: str
    after_s: float


def parse_fault(text: str) -> TimedFault:
    """The fault that a text names, and when it begins.

    Parameters
    ----------
    text : str, ``NAME@SECONDS``; at once without the seconds

    Raises
    ------
    InputError
        The text names no fault, or no time from 0 to 1e6 s.
    """
    name, at, seconds = text.partition("@")
    check_name(name)
    try:
        after_s = float(seconds) if at else 0.0
    except ValueError:
        after_s = math.nan
    if not 0 <= after_s <= 1e6:  # nor NaN
        allowed = "NAME@SECONDS, 0 to 1e6"
        raise InputError("bad time", where="--fault", value=text, allowed=allowed)
    return TimedFault(name, after_s)


def check_name(name: str) -> None:
    """Raise InputError where no fault is called so."""
    if name not in NAMES:
        raise InputError("no such fault", where="--fault", value=name, allowed=", ".join(NAMES))
