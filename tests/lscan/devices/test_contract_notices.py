"""The contracts notice what they are for: each is held against devices with one fault each."""

import math
from typing import Any

import numpy as np
import pytest
from device_contract import CameraContract, TrackContract

from lscan.devices.api import Grab
from lscan.errors import DeviceError

# ---- tracks -----------------------------------------------------------------------------


class SoundTrack:
    """0 to 10 mm, with a laser.

    off_mm: misses by this.  wanders: moves when it refuses.  moves_closed: when it is closed.
    shines_dark: is on when it was switched off.  stays_lit: when the track is closed.
    """

    limits_mm, tolerance_mm = (0.0, 10.0), 0.0
    says = "a track"
    off_mm = 0.0
    wanders = stays_lit = moves_closed = shines_dark = False

    def __init__(self) -> None:
        self.position_mm, self.lit, self._closed = 0.0, False, False

    def move_to(self, position_mm: float) -> float:
        if self._closed and not self.moves_closed:
            raise DeviceError(f"{self.says}: is closed")
        if not 0 <= position_mm <= 10:
            self.position_mm += 0.5 * self.wanders
            raise DeviceError(f"{self.says}: {position_mm:g} mm; allowed: 0 to 10 mm")
        self.position_mm = position_mm + self.off_mm
        return self.position_mm

    def laser_on(self) -> None:
        self._switch(True)

    def laser_off(self) -> None:
        self._switch(self.shines_dark)

    def _switch(self, lit: bool) -> None:
        if self._closed:
            raise DeviceError(f"{self.says}: is closed")
        self.lit = lit

    def close(self) -> None:
        self._closed = True
        self.lit = self.lit and self.stays_lit


def hold_track(name: str, faults: dict[str, Any], *arguments: Any) -> None:
    track = type("FaultyTrack", (SoundTrack,), faults)()

    class Contract(TrackContract):
        limits_mm, tolerance_mm = (0.0, 10.0), 0.0

        def is_lit(self) -> bool:
            return bool(track.lit)

    getattr(Contract(), name)(track, *arguments)


TRACK_FAULTS = [
    ("test_it_states_its_limits", {"limits_mm": (0.0, 11.0)}, ()),
    ("test_it_arrives_and_says_where", {"off_mm": 0.001}, ()),
    ("test_beyond_a_limit_is_refused_by_name", {"wanders": True}, (0,)),
    ("test_beyond_a_limit_is_refused_by_name", {"says": "something"}, (1,)),
    ("test_what_is_no_position_is_refused", {"wanders": True}, (math.nan,)),
    ("test_a_laser_is_switched_without_a_move", {"shines_dark": True}, ()),
    ("test_a_laser_is_off_once_the_track_is_closed", {"stays_lit": True}, ()),
    ("test_closed_it_does_not_move", {"moves_closed": True}, ()),
]


@pytest.mark.parametrize(("name", "faults", "arguments"), TRACK_FAULTS)
def test_of_tracks(name: str, faults: dict[str, Any], arguments: tuple[Any, ...]) -> None:
    hold_track(name, {}, *arguments)
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        hold_track(name, faults, *arguments)


# ---- cameras ----------------------------------------------------------------------------


class SoundCamera:
    """Pictures of 8 by 6 px, each brighter than the one before, that can be previewed.

    reuses: one memory for all pictures.  stands: its clock.  shows_later: previews from the
    future.  delivers_closed, raises_other: what it does when it is closed.
    """

    size_px = (8, 6)
    says = "a camera"
    shape: tuple[int, ...] = (6, 8)
    reuses = stands = shows_later = delivers_closed = raises_other = False

    def __init__(self) -> None:
        self._count, self._closed = 0, False
        self._memory = np.zeros(self.shape, np.uint8)

    def grab(self, frame: int | None = None, dark: bool = False) -> Grab:
        if self._closed and self.raises_other:
            raise RuntimeError("no such handle")
        if self._closed and not self.delivers_closed:
            raise DeviceError(f"{self.says}: is closed")
        self._count += 1
        image = self._memory if self.reuses else np.zeros(self.shape, np.uint8)
        image += self._count % 200
        return Grab(image, 1.0 if self.stands else float(self._count), 5.0)

    def preview(self) -> Grab:
        if self._closed:
            raise DeviceError(f"{self.says}: is closed")
        later_s = self._count + 9.0 * self.shows_later
        return Grab(np.zeros(self.shape, np.uint8), later_s, 5.0)

    def close(self) -> None:
        self._closed = True


def hold_camera(name: str, faults: dict[str, Any]) -> None:
    class Contract(CameraContract):
        size_px = (8, 6)

    getattr(Contract(), name)(type("FaultyCamera", (SoundCamera,), faults)())


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("test_pictures_are_of_the_size_it_states", {"shape": (8, 6)}),
        ("test_its_clock_only_goes_on", {"stands": True}),
        ("test_a_picture_is_not_changed_by_the_next", {"reuses": True}),
        ("test_a_dark_picture_is_like_any_other", {"stands": True}),
        ("test_previews_leave_what_is_grabbed_as_it_is", {"shows_later": True}),
        ("test_closed_it_delivers_no_picture", {"delivers_closed": True}),
        ("test_closed_it_delivers_no_picture", {"says": "something"}),
        ("test_closing_ends_the_grabs_of_another_thread", {"raises_other": True}),
    ],
)
def test_of_cameras(name: str, faults: dict[str, Any]) -> None:
    hold_camera(name, {})
    with pytest.raises((AssertionError, pytest.fail.Exception)):
        hold_camera(name, faults)
