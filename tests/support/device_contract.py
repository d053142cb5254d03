"""What every camera and every track must do, real or simulated: tests to inherit.

    class TestMyTrack(TrackContract):
        @pytest.fixture
        def track(self) -> Iterator[Track]: ...

A camera's fixture puts the head where the camera can see something.  What a class states of its
device may also be set by the fixture, where only the opened device knows it.
"""

import math
import threading
from itertools import pairwise

import numpy as np
import pytest

from lscan.devices.api import Camera, LaserSwitch, Limited, Previewing, Track
from lscan.errors import DeviceError
from lscan.records import Bytes

PATIENCE_S = 60.0
"""For what takes milliseconds, on however busy a machine."""


class CameraContract:
    """Define a fixture ``camera``, and ``size_px``."""

    size_px: tuple[int, int]
    """(width, height) the rig asks for."""

    name = "camera"
    """What its messages call it."""

    live = True
    """A picture comes once; else the frames of a scan are the same whenever they are grabbed."""

    grabs = 4
    """Pictures taken where a test needs several."""

    bits = 8
    """Of a grey value; from 10 on the uppermost of 16."""

    def test_is_a_camera(self, camera: Camera) -> None:
        assert isinstance(camera, Camera)

    def test_pictures_are_of_the_size_it_states(self, camera: Camera) -> None:
        assert camera.size_px == self.size_px
        width, height = camera.size_px
        for _ in range(self.grabs):
            image = camera.grab().image
            assert image.dtype == (np.uint8 if self.bits == 8 else np.uint16)
            assert self.bits == 8 or not (image % 2 ** (16 - self.bits)).any()
            assert image.shape in ((height, width), (height, width, 3))

    def test_all_pictures_have_the_same_channels(self, camera: Camera) -> None:
        assert len({camera.grab().image.ndim for _ in range(self.grabs)}) == 1

    def test_its_clock_only_goes_on(self, camera: Camera) -> None:
        times_s = [camera.grab().time_s for _ in range(self.grabs)]
        assert all(math.isfinite(time_s) for time_s in times_s)
        assert all(before < after for before, after in pairwise(times_s))

    def test_exposure_is_a_time(self, camera: Camera) -> None:
        exposure_ms = camera.grab().exposure_ms
        assert math.isfinite(exposure_ms)
        assert exposure_ms > 0

    def test_a_picture_is_not_changed_by_the_next(self, camera: Camera) -> None:
        first = camera.grab().image
        kept = first.copy()
        camera.grab()
        np.testing.assert_array_equal(first, kept)

    def test_a_dark_picture_is_like_any_other(self, camera: Camera) -> None:
        """Of the same size and channels, taken after the one before, with the same exposure."""
        lit = camera.grab(0)
        dark = camera.grab(0, dark=True)
        assert dark.image.dtype == lit.image.dtype
        assert dark.image.shape == lit.image.shape
        assert dark.exposure_ms == lit.exposure_ms
        assert lit.time_s < dark.time_s < camera.grab(1).time_s

    def test_a_preview_is_a_picture_like_any_other(self, camera: Camera) -> None:
        previewing = _previewing(camera)
        shown, grabbed = previewing.preview(), camera.grab()
        assert shown.image.dtype == grabbed.image.dtype
        assert shown.image.shape == grabbed.image.shape
        assert shown.exposure_ms == grabbed.exposure_ms

    def test_previews_leave_what_is_grabbed_as_it_is(self, camera: Camera) -> None:
        """A live camera's grab is of later than the preview; any other's is what it would be."""
        previewing = _previewing(camera)
        alone = [] if self.live else self._frames(camera)
        for frame in range(self.grabs):
            shown = previewing.preview()
            kept = shown.image.copy()
            grabbed = camera.grab(frame)
            np.testing.assert_array_equal(shown.image, kept)
            if self.live:
                assert grabbed.time_s > shown.time_s
            else:
                np.testing.assert_array_equal(grabbed.image, alone[frame])

    def test_closed_it_delivers_no_picture(self, camera: Camera) -> None:
        camera.close()
        with pytest.raises(DeviceError, match=self.name):
            camera.grab()
        if isinstance(camera, Previewing):
            with pytest.raises(DeviceError, match=self.name):
                camera.preview()

    def test_closing_ends_the_grabs_of_another_thread(self, camera: Camera) -> None:
        """The one under way may still deliver; then a DeviceError comes, and nothing hangs."""
        ended: list[BaseException] = []
        grabbing = threading.Event()

        def grab_on() -> None:
            try:
                while True:
                    camera.grab(0)
                    grabbing.set()
            except BaseException as error:  # whatever it is, the test is to see it
                ended.append(error)

        thread = threading.Thread(target=grab_on, daemon=True)
        thread.start()
        assert grabbing.wait(PATIENCE_S), ended
        camera.close()
        thread.join(PATIENCE_S)
        assert [type(error) for error in ended] == [DeviceError]
        assert self.name in str(ended[0])

    def test_closing_twice_is_harmless(self, camera: Camera) -> None:
        camera.close()
        camera.close()

    def _frames(self, camera: Camera) -> list[Bytes]:
        return [camera.grab(frame).image for frame in range(self.grabs)]


class TrackContract:
    """Define a fixture ``track``, ``limits_mm`` and, where it is not exact, ``tolerance_mm``."""

    limits_mm: tuple[float, float]
    """Lowest and highest position the track accepts."""

    range_mm: tuple[float, float] | None = None
    """Lowest and highest position it is sent to here; None: its limits."""

    name = "track"
    """What its messages call it."""

    tolerance_mm: float = 1e-9
    """How far the track may stand from where it was sent."""

    may_light = True
    """Whether a laser may be switched on: a real one is dangerous to whom it takes unawares."""

    def is_lit(self) -> bool | None:
        """Whether the track's laser truly is on; None where nobody can see."""
        return None

    def at(self, part: float) -> float:
        """The position, in mm, at a part of the range, from 0 to 1."""
        low, high = self.range_mm or self.limits_mm
        return low + part * (high - low)

    def test_is_a_track(self, track: Track) -> None:
        assert isinstance(track, Track)

    def test_it_states_its_limits(self, track: Track) -> None:
        if not isinstance(track, Limited):
            pytest.skip("this track states no limits")
        assert track.limits_mm == self.limits_mm
        assert track.limits_mm[0] < track.limits_mm[1]
        assert 0 <= track.tolerance_mm <= self.tolerance_mm

    def test_it_arrives_and_says_where(self, track: Track) -> None:
        for part in (0.0, 1.0, 0.25, 0.5):
            asked_mm = self.at(part)
            reported_mm = track.move_to(asked_mm)
            assert abs(reported_mm - asked_mm) <= self.tolerance_mm
            assert track.position_mm == reported_mm

    def test_moving_to_where_it_stands_changes_nothing(self, track: Track) -> None:
        first_mm = track.move_to(self.at(1.0))
        assert abs(track.move_to(self.at(1.0)) - first_mm) <= self.tolerance_mm

    @pytest.mark.parametrize("side", [0, 1])
    def test_beyond_a_limit_is_refused_by_name(self, track: Track, side: int) -> None:
        """The line names device, value, unit and limit, the head stays put, and moves on."""
        limit_mm = self.limits_mm[side]
        stood_mm = track.move_to(self.at(0.5))
        asked_mm = limit_mm + (-1.5, 1.5)[side]
        with pytest.raises(DeviceError, match=self.name) as caught:
            track.move_to(asked_mm)
        line = str(caught.value)
        assert f"{asked_mm:g}" in line
        assert f"{limit_mm:g}" in line
        assert "mm" in line
        assert track.position_mm == stood_mm
        assert abs(track.move_to(self.at(0.0)) - self.at(0.0)) <= self.tolerance_mm

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_what_is_no_position_is_refused(self, track: Track, value: float) -> None:
        stood_mm = track.position_mm
        with pytest.raises(DeviceError, match=self.name):
            track.move_to(value)
        assert track.position_mm == stood_mm

    def test_a_laser_is_switched_without_a_move(self, track: Track) -> None:
        """Twice the same is harmless.  A closed track switches nothing."""
        switch = self._switch(track)
        stood_mm = track.move_to(self.at(0.0))
        for turn, lit in (
            (switch.laser_on, True),
            (switch.laser_on, True),
            (switch.laser_off, False),
            (switch.laser_off, False),
        ):
            turn()
            assert self.is_lit() in (lit, None)
            assert track.position_mm == stood_mm
        track.close()
        for turn in (switch.laser_on, switch.laser_off):
            with pytest.raises(DeviceError, match=self.name):
                turn()

    def test_a_laser_is_off_once_the_track_is_closed(self, track: Track) -> None:
        switch = self._switch(track)
        switch.laser_on()
        track.close()
        assert self.is_lit() in (False, None)

    def test_closed_it_does_not_move(self, track: Track) -> None:
        track.close()
        with pytest.raises(DeviceError, match=self.name):
            track.move_to(self.at(0.0))

    def test_closing_twice_is_harmless(self, track: Track) -> None:
        track.close()
        track.close()

    def _switch(self, track: Track) -> LaserSwitch:
        if not isinstance(track, LaserSwitch):
            pytest.skip("this track switches no laser")
        if not self.may_light:
            pytest.skip("the rig's plan leaves the laser untouched: set plan.laser to test it")
        return track


def _previewing(camera: Camera) -> Previewing:
    if not isinstance(camera, Previewing):
        pytest.skip("this camera shows no previews")
    return camera
