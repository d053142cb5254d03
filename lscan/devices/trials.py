"""A rig's camera and track tried out: settings, timing, linearity, delay, how moves repeat."""

import math
import statistics
import time
from dataclasses import dataclass
from functools import reduce
from operator import add
from typing import Protocol, cast, get_args, runtime_checkable

import cv2
import numpy as np
from scipy.special import chdtri

from lscan.config.rig import Channel, Gamma
from lscan.devices.api import Camera, Describing, Fact, LaserSwitch, Limited, Previewing, Track
from lscan.devices.opencv_camera.options import Setting
from lscan.devices.photontransfer import (
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
from lscan.errors import DeviceError, InputError, MeasurementError
from lscan.files.pictures import colour_shift_px, grey_dn, linear_picture
from lscan.records import Axis, Floats, GreyValues, Picture, Progress

# How late a camera's pictures come: from a change in view to the picture that shows it.
#
# What a camera, its encoder, the network and the decoder hold back cannot be seen in the pictures,
# nor in their time stamps, which begin at an arbitrary moment.  A change whose time is known shows
# it: the laser is switched, and the first picture of it awaited.


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
        (off, gap_off_s), (on, gap_on_s) = (_mean_of(camera, laser, lit) for lit in (False, True))
        change = on - off
        most_dn = np.abs(change).max()
        if most_dn < LEAST_DN:
            what = "delay: no picture shows the laser switched; let the camera see its line"
            raise MeasurementError(what)
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


def _mean_of(camera: Previewing, laser: LaserSwitch, lit: bool) -> tuple[Floats, float]:
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
    image = grey_dn(camera.preview().image).astype(float)
    return image if image.ndim == 2 else np.asarray(image.sum(axis=2))


# Trying out a rig's camera: what it made of its settings, timing, noise, linearity.


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
        return None if self.transfer is None or self.doubts else noise_section(self.transfer)


def grab_series(
    camera: Camera,
    pictures: int,
    channel: Channel,
    progress: Progress | None = None,
    gamma: Gamma = 1.0,
) -> tuple[GreyValues, Timing]:
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
    gamma : float or "srgb", optional
        As ``stripe.gamma``: the curve that is undone.

    Returns
    -------
    (N, H, W) DN, uint8 or, of a camera of more bits, float32, and Timing

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
        images.append(grey_dn(_one_colour(linear_picture(grab.image, gamma), channel)))
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
    dark: GreyValues | None = None,
    progress: Progress | None = None,
    laser: LaserSwitch | None = None,
    gamma: Gamma = 1.0,
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
        (N, H, W) DN, pictures of the same colour taken with the cap on.
    progress : callable, optional
        Called with the number of pictures done, and of all, at the first exposure time.
    laser : LaserSwitch, optional
        Switched to see how late the pictures come, if the camera can show what it sees; off from
        then on.
    gamma : float or "srgb", optional
        As ``stripe.gamma``: the curve that is undone in every picture.

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
    series, timing = grab_series(camera, pictures, channel, progress, gamma)
    levels = grey_levels(series)
    if seen := flicker(series):
        rows = seen.period_rows
        bands = "all rows alike" if rows is None else f"bands of {rows:.0f} rows"
        remarks.append(
            f"light: it flickers by {100 * seen.share:.1f} % ({bands}), as of a lamp on the mains; "
            "taken out of the noise, not out of the linearity; use a lamp on direct current, or an "
            "exposure of a multiple of 10 ms (mains of 50 Hz) or 8.33 ms (60 Hz)"
        )
    image = camera.grab().image
    if shift_px := max(colour_shift_px(image, channel, axis) for axis in get_args(Axis)):
        remarks.append(
            "colours: two pixels share one (in YUYV along a row), so that a line across such pairs "
            f"lies up to {shift_px:.2f} px aside in {channel}, 0.5 in {channel}-excess, which its "
            'sigma holds; [stripe] channel = "grey" is free of it'
        )
    straight = None
    if isinstance(camera, ExposureControl) and camera.can_set_exposure:
        more, exposures_ms, means_dn = _exposure_series(camera, pictures, channel, gamma)
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
            "a gamma curve ([stripe] gamma states and undoes it), sharpening or noise reduction"
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
    camera: ExposureControl, pictures: int, channel: Channel, gamma: Gamma
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
            series, _ = grab_series(camera, pictures, channel, gamma=gamma)
            levels.append(grey_levels(series))
            means.append(series.mean(axis=0))
    finally:
        camera.set_exposure(full_ms)
    stack, (low, high) = np.array(means), LINEAR_DN
    kept = ((stack >= low) & (stack <= high)).all(axis=0)
    used = stack[:, kept] if kept.any() else stack.reshape(len(stack), -1)
    return reduce(add, levels), np.array(exposures_ms), used.mean(axis=1)


def _one_colour(image: Picture, channel: Channel) -> Picture:
    if image.ndim == 2:
        return image
    if channel == "grey":
        return cast(Picture, cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    return image[:, :, _COLOURS[channel]]


# Trying out a rig's track: moves from both sides, each timed, and how well they repeat.


FEWEST_APPROACHES = 2
"""From either side: a standard deviation needs two."""


@dataclass(frozen=True)
class Move:
    """One move of the track: sent to commanded_mm, it reports reported_mm after time_s."""

    commanded_mm: float
    reported_mm: float
    time_s: float


@dataclass(frozen=True)
class Repeatability:
    """How well a place is found again, as the track itself reports it; after ISO 230-2.

    place_mm: where it was sent to, ``approaches`` times from either side.
    deviation_mm: mean of reported less commanded, over all approaches.
    upward_sigma_mm, downward_sigma_mm: standard deviations of the position reported after an
    approach from below, and from above.  reversal_mm: mean after approaches from below less
    mean after those from above.
    What the track does not see, a motor that lost steps or a loose belt, shows in none of them.
    """

    place_mm: float
    approaches: int
    deviation_mm: float
    upward_sigma_mm: float
    downward_sigma_mm: float
    reversal_mm: float


@dataclass(frozen=True)
class TrackTrial:
    """What a track turned out to be.

    Attributes
    ----------
    facts : dict, what it says of itself after the moves; none, where it is not :class:`Describing`
    repeatability : Repeatability, of the approaches, mm
    moves : tuple, all of them in their order, the last back to where it stood, or as near as it is
        sent
    """

    facts: dict[str, Fact]
    repeatability: Repeatability
    moves: tuple[Move, ...]


def try_track(
    track: Track, approaches: int = 5, step_mm: float = 1.0, progress: Progress | None = None
) -> TrackTrial:
    """Approaches to one place from ``step_mm`` below and above it, in turn, and the way back.

    The place is where the head stands, or so near as to leave ``step_mm`` within the limits on
    either side; on a track shorter than that, its middle.  One that states no limits is tried.

    Parameters
    ----------
    track : Track
        Ready to move.
    approaches : int
        How many from either side, 2 or more.
    step_mm : float
        Length of each approach, mm, above 0.
    progress : callable, optional
        Called with the number of moves done, and of all.

    Returns
    -------
    TrackTrial
        Positions in mm as the track reports them, times in s.

    Raises
    ------
    InputError
        For too few approaches, or a step that is not above 0.
    DeviceError
        Where the track fails.
    """
    if approaches < FEWEST_APPROACHES:
        what = "too few approaches to measure how they repeat"
        raise InputError(what, value=approaches, allowed=f"{FEWEST_APPROACHES} or more")
    if not step_mm > 0:
        raise InputError("the step must be above 0 mm", value=step_mm)
    stood_mm = track.position_mm
    place_mm = _place_mm(track, stood_mm, step_mm)
    way_mm = [place_mm - step_mm, place_mm, place_mm + step_mm, place_mm] * approaches
    way_mm.append(stood_mm)
    moves: list[Move] = []
    for target_mm in way_mm:
        to_mm, began_s = _allowed_mm(track, target_mm), time.monotonic()
        reported_mm = track.move_to(to_mm)
        moves.append(Move(to_mm, reported_mm, time.monotonic() - began_s))
        if progress is not None:
            progress(len(moves), len(way_mm))
    return TrackTrial(
        facts=track.describe() if isinstance(track, Describing) else {},
        repeatability=repeatability(
            place_mm,
            [move.reported_mm for move in moves[1:-1:4]],
            [move.reported_mm for move in moves[3:-1:4]],
        ),
        moves=tuple(moves),
    )


def repeatability(
    place_mm: float, upward_mm: list[float], downward_mm: list[float]
) -> Repeatability:
    """From the positions in mm reported at one place, equally many from below and from above.

    ISO 230-2: estimators of unidirectional repeatability, with n - 1, and reversal value.
    """
    return Repeatability(
        place_mm=place_mm,
        approaches=len(upward_mm),
        deviation_mm=statistics.fmean([*upward_mm, *downward_mm]) - place_mm,
        upward_sigma_mm=statistics.stdev(upward_mm),
        downward_sigma_mm=statistics.stdev(downward_mm),
        reversal_mm=statistics.fmean(upward_mm) - statistics.fmean(downward_mm),
    )


def _place_mm(track: Track, stood_mm: float, step_mm: float) -> float:
    """The place nearest to where the head stands that has ``step_mm`` of way on either side."""
    if isinstance(track, Limited):
        return _allowed_mm(track, stood_mm, step_mm)
    for side_mm in (step_mm, -step_mm):
        try:
            track.move_to(stood_mm + side_mm)
        except DeviceError:
            return stood_mm - side_mm
    return stood_mm


def _allowed_mm(track: Track, position_mm: float, margin_mm: float = 0.0) -> float:
    """The position nearest to one, ``margin_mm`` within the limits: homing ends beyond them."""
    if not isinstance(track, Limited):
        return position_mm
    low_mm, high_mm = track.limits_mm
    margin_mm = min(margin_mm, (high_mm - low_mm) / 2)
    return min(max(position_mm, low_mm + margin_mm), high_mm - margin_mm)
