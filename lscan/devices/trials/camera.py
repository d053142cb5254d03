"""Trying out a rig's camera: what it made of its settings, timing, noise, linearity."""

import time
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from scipy.special import chdtri

from lscan.config.rig import Channel
from lscan.devices.api import Camera, LaserSwitch, Previewing
from lscan.devices.opencv_camera.settings import Setting
from lscan.devices.trials.delay import Delay, picture_delay
from lscan.devices.trials.photontransfer import (
    LINEAR_DN,
    Levels,
    Linearity,
    PhotonTransfer,
    dark_level,
    flicker,
    grey_levels,
    linearity,
    photon_transfer,
)
from lscan.errors import InputError, MeasurementError
from lscan.records import Bytes, Floats, Progress

FEWEST_PICTURES = 4
"""Two pairs: one to sort pixels by grey value, one to measure them."""

FEWEST_LEVELS = 3
"""Through two levels of grey there is always a straight line: nothing shows that it is right."""

EXPOSURE_PARTS = (0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875, 1.0)
"""Parts of the rig's exposure time at which linearity is measured."""

RARE = 1e-4
"""A linear camera's chi² is above what is held against it in one trial of ten thousand."""

_COLOURS = {"red": 0, "green": 1, "blue": 2}


@runtime_checkable
class ExposureControl(Camera, Protocol):
    """A camera whose exposure time can be changed while it is open."""

    @property
    def can_set_exposure(self) -> bool:
        """Whether it can be changed as the camera is connected now."""

    def set_exposure(self, exposure_ms: float) -> float:
        """The exposure time in ms as read back.  Raises DeviceError."""


@runtime_checkable
class BlackAccepting(Protocol):
    """A camera that takes black pictures for a fault until it learns that they are meant."""

    def accept_black(self) -> None:
        """From now on black pictures are meant."""


@runtime_checkable
class SettingsReadBack(Protocol):
    """A camera that reads back what it was set to."""

    @property
    def settings(self) -> tuple[Setting, ...]:
        """Each setting with what was asked and what the camera reports."""


@dataclass(frozen=True)
class Timing:
    """How fast pictures come.  rate_hz: pictures per second, one grab after the other.

    jitter_ms: standard deviation of the time between pictures.
    latency_ms: median time from the call to its picture in hand.
    """

    rate_hz: float
    jitter_ms: float
    latency_ms: float


@dataclass(frozen=True)
class CameraTrial:
    """What a camera turned out to be.

    Attributes
    ----------
    settings : tuple, what was asked of it and what it then reported; () where it has none to set
    timing : Timing, of its pictures
    delay : Delay or None, how late they come; None where no laser was switched for it, or where
        ``remarks`` say why
    transfer : None where it could not be measured; ``remarks`` then say why
    linearity : Linearity or None, as ``transfer``
    dark_dn, dark_noise_dn : float or None, DN, mean and temporal standard deviation of a pixel with
        the cap on; None where that was not tried
    remarks : tuple, what could not be measured, and why
    doubts : tuple, why the noise and gain of ``transfer`` may not be relied on, and what to show
        instead
    """

    settings: tuple[Setting, ...]
    timing: Timing
    delay: Delay | None
    transfer: PhotonTransfer | None
    linearity: Linearity | None
    dark_dn: float | None
    dark_noise_dn: float | None
    remarks: tuple[str, ...]
    doubts: tuple[str, ...]

    @property
    def noise_section(self) -> str | None:
        """The ``[stripe.noise]`` section of a rig file; None where the noise is in doubt."""
        if self.transfer is None or self.doubts:
            return None
        return noise_section(self.transfer)


def grab_series(
    camera: Camera, pictures: int, channel: Channel, progress: Progress | None = None
) -> tuple[Bytes, Timing]:
    """Pictures of one colour, taken one after the other, and their timing.

    Parameters
    ----------
    camera : Camera
        Ready to grab.
    pictures : int
        How many, 4 or more.
    channel : str
        As in ``stripe.channel``; grey is the luma of ITU-R BT.601, rounded.
    progress : callable, optional
        Called with the number of pictures done, and of all.

    Returns
    -------
    (N, H, W) uint8, and Timing

    Raises
    ------
    InputError
        For too few pictures.
    DeviceError
        Where the camera fails.
    """
    if pictures < FEWEST_PICTURES:
        what, allowed = "too few pictures to measure noise", f"{FEWEST_PICTURES} or more"
        raise InputError(what, value=pictures, allowed=allowed)
    images, times_s, latencies_s = [], [], []
    for index in range(pictures):
        began_s = time.monotonic()
        grab = camera.grab()
        latencies_s.append(time.monotonic() - began_s)
        times_s.append(grab.time_s)
        images.append(_one_colour(grab.image, channel))
        if progress is not None:
            progress(index + 1, pictures)
    intervals_s = np.diff(times_s)
    timing = Timing(
        rate_hz=float(1 / intervals_s.mean()),
        jitter_ms=float(1000 * intervals_s.std(ddof=1)),
        latency_ms=float(1000 * np.median(latencies_s)),
    )
    return np.stack(images), timing


def try_camera(
    camera: Camera,
    pictures: int,
    channel: Channel,
    dark: Bytes | None = None,
    progress: Progress | None = None,
    laser: LaserSwitch | None = None,
) -> CameraTrial:
    """Timing, noise and linearity of a camera that looks at a still, evenly lit scene.

    The exposure time is varied where the camera allows it, and set back at the end.

    Parameters
    ----------
    camera : Camera
        Ready to grab.
    pictures : int
        How many are taken at each exposure time, 4 or more.
    channel : str
        As in ``stripe.channel``.
    dark : array, optional
        (N, H, W) uint8, pictures of the same colour taken with the cap on.
    progress : callable, optional
        Called with the number of pictures done, and of all, at the first exposure time.
    laser : LaserSwitch, optional
        Switched to see how late the pictures come, if the camera can show what it sees; off from
        then on.

    Returns
    -------
    CameraTrial
        What the pictures do not allow to be measured is named in its remarks.

    Raises
    ------
    InputError
        For too few pictures.
    DeviceError
        Where the camera fails.

    References
    ----------
    EMVA Standard 1288, "Linear camera model" and "Linearity".
    """
    remarks: list[str] = []
    settings = camera.settings if isinstance(camera, SettingsReadBack) else ()
    delay = None
    if laser is not None and isinstance(camera, Previewing):
        try:
            delay = picture_delay(camera, laser)
        except MeasurementError as error:
            remarks.append(str(error))
    series, timing = grab_series(camera, pictures, channel, progress)
    levels = grey_levels(series)
    if seen := flicker(series):
        bands = (
            "all rows alike"
            if seen.period_rows is None
            else f"bands of {seen.period_rows:.0f} rows"
        )
        remarks.append(
            f"light: it flickers by {100 * seen.share:.1f} % ({bands}), as of a lamp on the mains; "
            "taken out of the noise, not out of the linearity; use a lamp on direct current, or an "
            "exposure of a multiple of 10 ms (mains of 50 Hz) or 8.33 ms (60 Hz)"
        )
    straight = None
    if isinstance(camera, ExposureControl) and camera.can_set_exposure:
        more, exposures_ms, means_dn = _exposure_series(camera, pictures, channel)
        levels = levels + more
        try:
            straight = linearity(exposures_ms, means_dn)
        except MeasurementError as error:
            remarks.append(str(error))
    else:
        remarks.append("linearity: not measured; the exposure time of this camera cannot be set")
    dark_levels = dark_level(dark) if dark is not None else None
    transfer = None
    try:
        transfer = photon_transfer(levels, dark_levels)
    except MeasurementError as error:
        remarks.append(str(error))
    return CameraTrial(
        settings=settings,
        timing=timing,
        delay=delay,
        transfer=transfer,
        linearity=straight,
        dark_dn=None if dark_levels is None else float(dark_levels.mean_dn[0]),
        dark_noise_dn=None if dark_levels is None else float(dark_levels.variance[0] ** 0.5),
        remarks=tuple(remarks),
        doubts=() if transfer is None else _doubts(transfer),
    )


def _doubts(transfer: PhotonTransfer) -> tuple[str, ...]:
    """Why the noise found may not be relied on; empty where it may."""
    gain, doubts = transfer.dn_per_electron, []
    levels = len(transfer.levels.mean_dn)
    is_open = transfer.read_sigma_dn > transfer.read_dn or transfer.gain_sigma > abs(gain)
    if is_open or levels < FEWEST_LEVELS:
        doubts.append(
            "noise: these pictures leave it open; show a still, evenly lit scene with bright and "
            "dark parts, such as a printed sheet under a lamp, the laser off; take more "
            "--pictures, and measure the dark with --dark"
        )
    freedoms = max(levels - 2, 1)
    if gain <= 0 or transfer.chi2 > chdtri(freedoms, RARE) / freedoms:
        doubts.append(
            "noise: it does not grow in proportion to the light, so the gain is not the "
            "camera's. JPEG pictures (a stream, pixel_format MJPG) hold noise smoothed away and "
            "noise of the coding: ask for uncoded ones, such as YUYV. A laser's speckle grows "
            "faster than the light: switch it off, and light the scene by a lamp. Else look for "
            "a gamma curve, sharpening or noise reduction"
        )
    return tuple(doubts)


def noise_section(transfer: PhotonTransfer) -> str:
    """The ``[stripe.noise]`` section of a rig file that states what was measured."""
    bound = "  # of rounding alone" if transfer.read_is_rounding else ""
    return (
        "[stripe.noise]\n"
        f"read_dn = {transfer.read_dn:.4g}{bound}\n"
        f"dn_per_electron = {max(transfer.dn_per_electron, 0.0):.4g}\n"
    )


def _exposure_series(
    camera: ExposureControl, pictures: int, channel: Channel
) -> tuple[Levels, Floats, Floats]:
    """Levels of grey, exposure times (ms) and mean grey values (DN) over all exposure times.

    The grey value is that of the pixels that stay within the range judged for linearity at
    every exposure time; of all pixels, where there are none.
    """
    full_ms = camera.grab().exposure_ms
    levels, exposures_ms, means = [], [], []
    try:
        for part in EXPOSURE_PARTS:
            exposures_ms.append(camera.set_exposure(part * full_ms))
            series, _ = grab_series(camera, pictures, channel)
            levels.append(grey_levels(series))
            means.append(series.mean(axis=0))
    finally:
        camera.set_exposure(full_ms)
    stack, (low, high) = np.array(means), LINEAR_DN
    kept = ((stack >= low) & (stack <= high)).all(axis=0)
    used = stack[:, kept] if kept.any() else stack.reshape(len(stack), -1)
    return reduce(add, levels), np.array(exposures_ms), used.mean(axis=1)


def _one_colour(image: Bytes, channel: Channel) -> Bytes:
    if image.ndim == 2:
        return image
    if channel == "grey":
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
    return image[:, :, _COLOURS[channel]]
