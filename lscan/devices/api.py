"""What a camera and a track must do, real or simulated.

A driver is an object registered under the entry-point group ``lscan.cameras`` or
``lscan.tracks``; its name there is what a rig file's ``driver`` key says.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, Self, TypeVar, runtime_checkable

import numpy as np
from pydantic import model_validator

from lscan.config.documents import Strict, check
from lscan.config.rig import CameraSection, RigFile
from lscan.errors import DeviceError, InputError
from lscan.records import Picture

LASER_MAY_BE_LIT = "the laser may still be lit: switch it off at its supply"
"""What is said wherever a laser could not be switched off."""

LONGEST_GRAB_S = 10.0
"""How long a grab may take of a camera that does not state it."""

Fact = str | float | bool | None
"""What is known of a device under a name that carries the unit; None: it does not say."""


class ConnectionLost(DeviceError):
    """The line or the network to a device broke, or did not come about; reaching it may help."""


@dataclass(frozen=True)
class Grab:
    """One picture as the camera delivers it.

    Attributes
    ----------
    image : (H, W) grey or (H, W, 3) RGB array, uint8, or uint16 where ``camera.bits`` says more,
        the camera's bits the uppermost
    time_s : float, s, of the camera's own clock
    exposure_ms : float, ms, as the camera reports it
    """

    image: Picture
    time_s: float
    exposure_ms: float


@runtime_checkable
class Track(Protocol):
    """A linear track.

    Examples
    --------
    >>> import lscan
    >>> from lscan.acquisition.scan import open_track
    >>> track = open_track(lscan.load_rig("paper/board"))
    >>> track.move_to(12.5)
    12.5
    >>> track.close()
    """

    @property
    def position_mm(self) -> float:
        """Where the head stands, as the track itself reports it."""

    def move_to(self, position_mm: float) -> float:
        """Move, and wait until at rest.

        Parameters
        ----------
        position_mm : float
            On the track's own scale, mm.

        Returns
        -------
        float
            The position that the track then reports, mm.

        Raises
        ------
        DeviceError
            Where the position cannot be reached, naming the limit, or the track fails.
        """

    def close(self) -> None:
        """Release the device; closing twice is harmless."""


@runtime_checkable
class Limited(Protocol):
    """A track that knows how far it goes, and how well."""

    @property
    def limits_mm(self) -> tuple[float, float]:
        """Lowest and highest position it goes to."""

    @property
    def tolerance_mm(self) -> float:
        """How far from where it was sent it may report to stand."""


@runtime_checkable
class LaserSwitch(Protocol):
    """A track whose controller also switches the laser; closed, it has switched it off."""

    def laser_on(self) -> None:
        """Switch the laser on; it is lit when this returns.  Raises DeviceError."""

    def laser_off(self) -> None:
        """Switch the laser off; it is dark when this returns.  Raises DeviceError."""


@runtime_checkable
class Describing(Protocol):
    """A device that says what it is and how it stands."""

    def describe(self) -> dict[str, Fact]:
        """Facts by their names, asked of the device now.  Raises DeviceError."""


@runtime_checkable
class PlaceChecking(Protocol):
    """A track whose zero may be lost between two sessions of a scan."""

    @property
    def zero(self) -> str | None:
        """Name of the zero that positions count from, for ``check_place`` to know it again.

        None where it is found anew on each opening, as by homing.
        """

    def check_place(self, last_mm: float, next_mm: float, zero: str | None) -> None:
        """Check that a scan can go on without a shift of its frames.

        Parameters
        ----------
        last_mm, next_mm : float
            Where the last frame was recorded, and where the next is due, mm.
        zero : str or None
            What ``zero`` was when the last frame was recorded.

        Raises
        ------
        DeviceError
            Where it cannot, saying what to do.
        """


@runtime_checkable
class Reconnecting(Protocol):
    """A track that can be reached again after ``ConnectionLost``, its zero kept."""

    def reconnect(self) -> None:
        """Reach it again: at rest, a laser it had lit switched off, positions as before.

        Raises
        ------
        ConnectionLost
            Where it is not reached.
        DeviceError
            Where its zero is lost, or that is not known.
        """


@runtime_checkable
class Camera(Protocol):
    """A camera that delivers pictures of one size.

    Examples
    --------
    >>> import lscan
    >>> from lscan.acquisition.scan import open_devices
    >>> with open_devices(lscan.load_rig("board.toml")) as (camera, track):
    ...     isinstance(camera, lscan.Camera), camera.size_px
    (True, (640, 480))
    """

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height) of every picture."""

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        """A picture exposed after this call began.

        Parameters
        ----------
        frame : int, optional
            Its index in the scan.  A simulated camera draws noise and clock from it, so that a
            resumed scan gives the same bytes; a real one ignores it.
        dark : bool
            Whether the laser is off, so that a black picture is as it should be.

        Returns
        -------
        Grab
            Of ``size_px``; its time is after that of the picture before.

        Raises
        ------
        DeviceError
            Where no picture comes.
        """

    def close(self) -> None:
        """Release the device; closing twice is harmless.

        A grab under way in another thread comes to its end, and the next raises DeviceError.
        """


def require_rigs_picture(
    image: Picture, section: CameraSection, who: str, advice: Callable[[], str] = str
) -> None:
    """Refuse a picture that is none of the rig's: of another type, shape or size.

    Parameters
    ----------
    image : array, as a camera gave it
    section : CameraSection, of the rig
    who : str, the camera, for the error
    advice : callable, gives what to do about another type, for the error

    Raises
    ------
    DeviceError
    """
    wanted = np.dtype(np.uint8 if section.bits == 8 else np.uint16)
    if image.dtype != wanted or image.ndim < 2 or image.shape[2:] not in ((), (3,)):
        raise DeviceError("; ".join(filter(None, (
            f"{who}: a picture is {image.dtype} of shape {image.shape}",
            f"allowed: {wanted} for camera.bits = {section.bits}, (H, W) or (H, W, 3)",
            advice(),
        ))))  # fmt: skip
    if (size := (image.shape[1], image.shape[0])) != section.size_px:
        raise wrong_size(size, section, who)


def wrong_size(size_px: tuple[int, int], section: CameraSection, who: str) -> DeviceError:
    """The error of a camera whose pictures are not of the rig's size.

    Parameters
    ----------
    size_px : tuple of int, (width, height) of its pictures, px
    section : CameraSection, of the rig
    who : str, the camera
    """
    return DeviceError(
        f"{who}: pictures are {size_px[0]} by {size_px[1]} px; the rig says {section.width_px} by "
        f"{section.height_px} px (camera.width_px, camera.height_px)"
    )


@runtime_checkable
class Identified(Protocol):
    """A camera that may be exchanged for another at the same place, as behind a number."""

    @property
    def identity(self) -> str | None:
        """What tells it from others, such as maker, model and serial number; None if unknown."""


@runtime_checkable
class Previewing(Protocol):
    """A camera that can show what it sees without a grab, at its full rate."""

    def preview(self) -> Grab:
        """The newest picture, only looked at: no grab gives another picture because of it.

        May be called while another thread grabs.  Raises DeviceError where none comes.
        """


@runtime_checkable
class Paced(Protocol):
    """A camera that knows how long its pictures take."""

    @property
    def longest_grab_s(self) -> float:
        """How long a grab takes at most while nothing is amiss, s.

        A scan that lights the laser switches it off when a grab takes longer.  Infinite where
        nothing is lit: pictures that are computed, or were recorded.
        """


def longest_grab_s(camera: Camera) -> float:
    """How long a grab takes at most while nothing is amiss, s.

    Parameters
    ----------
    camera : Camera, what it states holds, LONGEST_GRAB_S else
    """
    return camera.longest_grab_s if isinstance(camera, Paced) else LONGEST_GRAB_S


@runtime_checkable
class CapabilityReporting(Protocol):
    """A driver that knows from a rig file what its device can do, without touching it."""

    def capabilities(self, rig_file: RigFile) -> dict[str, Fact]:
        """What the device can do.

        Parameters
        ----------
        rig_file : RigFile
            The rig, of which the driver reads its own options and sections.

        Returns
        -------
        dict of str to Fact
            By names that carry the unit.

        Raises
        ------
        InputError
            Where an option is wrong.
        """


class TrackDriver(Protocol):
    """Opens tracks of one kind.

    One whose tracks are a :class:`LaserSwitch` says so by an attribute ``switches_laser``, True;
    where it is missing, a plan that switches the laser is refused.

    An attribute ``connection_options``, a frozenset of names, says which of its options only say
    how the track is reached and waited for; they may differ where a scan is resumed.  Where it is
    missing, none may.
    """

    sections: frozenset[str]
    """Top-level sections of a rig file that this driver owns."""

    def validate(self, rig_file: RigFile) -> None:
        """Check the driver's options and sections without touching a device: InputError."""

    def open(self, rig_file: RigFile) -> Track:
        """The track, ready to move.

        Parameters
        ----------
        rig_file : RigFile
            Which ``validate`` has let pass.

        Raises
        ------
        DeviceError
            Where it does not answer.
        """


class CameraDriver(Protocol):
    """Opens cameras of one kind.

    One whose cameras know the keyword ``dark`` of ``grab`` says so by an attribute
    ``takes_dark``, True; where it is missing, ``plan.laser = "pairs"`` is refused and the
    keyword never passed.

    ``connection_options`` as in :class:`TrackDriver`.
    """

    sections: frozenset[str]
    """Top-level sections of a rig file that this driver owns."""

    def validate(self, rig_file: RigFile) -> None:
        """Check the driver's options and sections without touching a device: InputError."""

    def open(self, rig_file: RigFile, track: Track) -> Camera:
        """The camera, ready to grab.

        Parameters
        ----------
        rig_file : RigFile
            Which ``validate`` has let pass.
        track : Track
            From where it stands a simulated camera sees the tank; a real one ignores it.

        Raises
        ------
        DeviceError
            Where it does not open, or not as the rig file sets it.
        """


# What tracks with a travel share: limits, as options too, and what lies outside them refused.


class TravelOptions(Strict):
    """``[track.options]`` of a track that goes from min_mm to max_mm."""

    min_mm: float
    max_mm: float

    @model_validator(mode="after")
    def _not_empty(self) -> Self:
        if self.min_mm >= self.max_mm:
            raise ValueError("min_mm must be below max_mm")
        return self


class PassiveTrack:
    """The part of a track without a controller: where it stands, how far it goes, being closed.

    Parameters
    ----------
    position_mm : float, mm, where the head stands
    limits_mm : (lowest, highest) position, mm, that it goes to
    tolerance_mm : float, mm, how far from where it was sent it may report to stand
    """

    name: str
    slack_mm = 0.0

    def __init__(
        self, position_mm: float, limits_mm: tuple[float, float], tolerance_mm: float
    ) -> None:
        self.position_mm, self.limits_mm = position_mm, limits_mm
        self.tolerance_mm = tolerance_mm
        self._closed = False

    def close(self) -> None:
        """Nothing is held open; the track can no longer be moved."""
        self._closed = True

    def _require_open(self) -> None:
        if self._closed:
            raise DeviceError(f"{self.name}: is closed")

    def _require_free_way(self, position_mm: float) -> None:
        """Raise DeviceError after closing, and for a position beyond the limits."""
        self._require_open()
        require_reachable(self.name, position_mm, self.limits_mm, self.slack_mm)


Options = TypeVar("Options", bound=TravelOptions)


class TravelDriver(Generic[Options]):
    """The part of a track's driver that checks its options and the plan.

    model: of ``[track.options]``.  slack_mm: how far beyond the travel the track still goes.
    """

    sections: frozenset[str] = frozenset()
    model: type[Options]
    slack_mm = 0.0

    def validate(self, rig_file: RigFile) -> None:
        """Check the options, and that the plan stays within the travel.

        Parameters
        ----------
        rig_file : RigFile, its track's options and its plan

        Raises
        ------
        InputError
            An option is wrong, or the plan leaves the travel.
        """
        self.options(rig_file)

    def options(self, rig_file: RigFile) -> Options:
        """The options of the rig's track.

        Parameters
        ----------
        rig_file : RigFile, its track's options and its plan

        Raises
        ------
        InputError
            An option is wrong, or the plan leaves the travel.
        """
        where, plan = rig_file.source, rig_file.rig.plan
        section = rig_file.rig.track.options
        options = check(self.model, section, where=where, prefix="track.options")
        low_mm, high_mm = options.min_mm, options.max_mm
        ends = {
            "plan.start_mm": plan.start_mm,
            "plan.start_mm + (plan.frames - 1) * plan.step_mm": plan.positions_mm()[-1],
        }
        for key, position_mm in ends.items():
            if not low_mm - self.slack_mm <= position_mm <= high_mm + self.slack_mm:
                what = f"{key}: leaves the track's travel"
                allowed = f"{low_mm:.9g} to {high_mm:.9g} mm, track.options.min_mm and max_mm"
                raise InputError(what, where=where, value=position_mm, allowed=allowed)
        return options


def require_reachable(
    name: str, position_mm: float, limits_mm: tuple[float, float], slack_mm: float = 0.0
) -> None:
    """Refuse a position that is beyond a track's limits, or NaN.

    Parameters
    ----------
    name : str
        Of the track, for the message.
    position_mm : float
        Where it is to be sent, mm.
    limits_mm : tuple of float
        Lowest and highest position, mm.
    slack_mm : float
        How far beyond them it still goes, mm.

    Raises
    ------
    DeviceError
        It names the track and its limits.
    """
    low_mm, high_mm = limits_mm
    if not low_mm - slack_mm <= position_mm <= high_mm + slack_mm:
        raise DeviceError(
            f"{name}: cannot move to {position_mm:.9g} mm; "
            f"allowed: {low_mm:.9g} mm to {high_mm:.9g} mm"
        )
