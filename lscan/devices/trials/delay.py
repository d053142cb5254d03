"""How late a camera's pictures come: from a change in view to the picture that shows it.

What a camera, its encoder, the network and the decoder hold back cannot be seen in the pictures,
nor in their time stamps, which begin at an arbitrary moment.  A change whose time is known shows
it: the laser is switched, and the first picture of it awaited.
"""

import math
import statistics
import time
from dataclasses import dataclass

import numpy as np

from lscan.devices.api import LaserSwitch, Previewing
from lscan.errors import MeasurementError
from lscan.records import Floats, Progress

SWITCHES = 10
SETTLED_S = 6.0
"""After it every picture shows the laser as it stands; an encoder that looks 40 pictures ahead at
12 a second holds back 3.3 s."""

REFERENCES = 4
SPREAD_S = 0.1
"""Over which the switchings are spread, so that they meet exposures at every phase."""

LONGEST_S = 10.0
LEAST_DN = 20.0
"""By which the laser must change the brightest pixel, of the sum of its colours."""

SHOWN = 0.9
"""Part of the change at which a picture shows it: one half exposed before it does not."""


@dataclass(frozen=True)
class Delay:
    """From the laser's switching to the picture that shows it.

    longest_ms, median_ms: of so many switches.
    flush_ms: what to state as ``camera.options.flush_ms``, the longest and a margin.  Of so few
    switches the longest alone would be exceeded by one picture in ``switches + 1``, whatever the
    distribution.  The margin is the longest time between two pictures of the hundreds taken while
    the laser stands: a picture held back by so much more than its predecessor lengthens it by as
    much, and the period that is in it too is above the tenth of an exposure that SHOWN leaves out.
    """

    longest_ms: float
    median_ms: float
    switches: int
    flush_ms: int


def picture_delay(
    camera: Previewing, laser: LaserSwitch, progress: Progress | None = None
) -> Delay:
    """How late the pictures come; the laser is off at the end.

    The time that the switch itself takes is in it, so that it is too long rather than too short.

    Parameters
    ----------
    camera : Previewing
        Which sees the laser's line, at rest.
    laser : LaserSwitch
        Of the track.
    progress : callable, optional
        Called with the number of switches done, and of all.

    Raises
    ------
    MeasurementError
        Where the pictures do not show the laser switched.
    DeviceError
        Where a device fails.
    """
    try:
        (off, gap_off_s), (on, gap_on_s) = (_settled(camera, laser, lit) for lit in (False, True))
        change = on - off
        most_dn = np.abs(change).max()
        if most_dn < LEAST_DN:
            raise MeasurementError(
                "delay: no picture shows the laser switched; let the camera see its line"
            )
        line = np.where(np.abs(change) >= most_dn / 2, change, 0.0)  # not what else changes a bit
        weight = line / (line**2).sum()
        delays_ms = []
        for number in range(SWITCHES):
            time.sleep(SPREAD_S * number / SWITCHES)
            lit = number % 2 == 1  # it stands lit at first
            delays_ms.append(1000 * _delay_s(camera, laser, lit, off, weight))
            if progress is not None:
                progress(number + 1, SWITCHES)
    finally:
        laser.laser_off()
    flush_ms = math.ceil(max(delays_ms) + 1000 * max(gap_off_s, gap_on_s))
    return Delay(max(delays_ms), statistics.median(delays_ms), SWITCHES, flush_ms)


def _delay_s(
    camera: Previewing, laser: LaserSwitch, lit: bool, off: Floats, weight: Floats
) -> float:
    began_s = time.monotonic()
    _switch(laser, lit)
    while time.monotonic() < began_s + LONGEST_S:
        part = float(((_grey(camera) - off) * weight).sum())
        if part >= SHOWN if lit else part <= 1 - SHOWN:
            return time.monotonic() - began_s
    raise MeasurementError(f"delay: the laser's switching is not shown within {LONGEST_S:g} s")


def _settled(camera: Previewing, laser: LaserSwitch, lit: bool) -> tuple[Floats, float]:
    """The mean of some pictures that show the laser so, (H, W); the longest wait for one, s."""
    _switch(laser, lit)
    came_s = [time.monotonic()]
    while came_s[-1] < came_s[0] + SETTLED_S:
        camera.preview()
        came_s.append(time.monotonic())
    mean = np.asarray(np.mean([_grey(camera) for _ in range(REFERENCES)], axis=0))
    return mean, float(np.diff(came_s).max())


def _switch(laser: LaserSwitch, lit: bool) -> None:
    laser.laser_on() if lit else laser.laser_off()


def _grey(camera: Previewing) -> Floats:
    """The sum of the colours of the next picture, (H, W)."""
    image = camera.preview().image.astype(float)
    return image if image.ndim == 2 else np.asarray(image.sum(axis=2))
