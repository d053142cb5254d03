"""What every camera and every track must do, real or simulated: tests to inherit.

    class TestMyTrack(TrackContract):
        @pytest.fixture
        def track(self) -> Iterator[Track]: ...

A camera's fixture puts the head where the camera can see something.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from lscan.devices.api import Camera, LaserSwitch, Track
from lscan.errors import DeviceError


class CameraContract:
    """Define a fixture ``camera``, and ``size_px``."""

    size_px: tuple[int, int]
    """(width, height) the rig asks for."""

    grabs = 4
    """Pictures taken where a test needs several."""

    def test_is_a_camera(self, camera: Camera) -> None:
        assert isinstance(camera, Camera)

    def test_pictures_are_of_the_size_it_states(self, camera: Camera) -> None:
        assert camera.size_px == self.size_px
        width, height = camera.size_px
        for _ in range(self.grabs):
            image = camera.grab().image
            assert image.dtype == np.uint8
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
        assert dark.image.dtype == np.uint8
        assert dark.image.shape == lit.image.shape
        assert dark.exposure_ms == lit.exposure_ms
        assert lit.time_s < dark.time_s < camera.grab(1).time_s

    def test_closed_it_delivers_no_picture(self, camera: Camera) -> None:
        camera.close()
        with pytest.raises(DeviceError):
            camera.grab()

    def test_closing_twice_is_harmless(self, camera: Camera) -> None:
        camera.close()
        camera.close()


class TrackContract:
    """Define a fixture ``track``, ``limits_mm`` and, where it is not exact, ``tolerance_mm``."""

    limits_mm: tuple[float, float]
    """Lowest and highest position the track accepts."""

    tolerance_mm: float = 1e-9
    """How far the track may stand from where it was sent."""

    def test_is_a_track(self, track: Track) -> None:
        assert isinstance(track, Track)

    def test_it_arrives_and_says_where(self, track: Track) -> None:
        low, high = self.limits_mm
        for part in (0.0, 1.0, 0.25, 0.5):
            asked_mm = low + part * (high - low)
            reported_mm = track.move_to(asked_mm)
            assert abs(reported_mm - asked_mm) <= self.tolerance_mm
            assert track.position_mm == reported_mm

    def test_moving_to_where_it_stands_changes_nothing(self, track: Track) -> None:
        first_mm = track.move_to(self.limits_mm[1])
        assert abs(track.move_to(self.limits_mm[1]) - first_mm) <= self.tolerance_mm

    @pytest.mark.parametrize("side", [0, 1])
    def test_beyond_a_limit_is_refused_by_name(self, track: Track, side: int) -> None:
        """The line names the value, the unit and the limit, and the head stays put."""
        limit_mm = self.limits_mm[side]
        stood_mm = track.move_to(sum(self.limits_mm) / 2)
        asked_mm = limit_mm + (-1.5, 1.5)[side]
        with pytest.raises(DeviceError) as caught:
            track.move_to(asked_mm)
        line = str(caught.value)
        assert f"{asked_mm:g}" in line
        assert f"{limit_mm:g}" in line
        assert "mm" in line
        assert track.position_mm == stood_mm

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_what_is_no_position_is_refused(self, track: Track, value: float) -> None:
        stood_mm = track.position_mm
        with pytest.raises(DeviceError):
            track.move_to(value)
        assert track.position_mm == stood_mm

    def test_a_laser_is_switched_without_a_move(self, track: Track) -> None:
        """Twice the same is harmless.  A closed track switches nothing."""
        if not isinstance(track, LaserSwitch):
            pytest.skip("this track switches no laser")
        stood_mm = track.move_to(self.limits_mm[0])
        for switch in (track.laser_on, track.laser_on, track.laser_off, track.laser_off):
            switch()
            assert track.position_mm == stood_mm
        track.close()
        with pytest.raises(DeviceError):
            track.laser_on()

    def test_closed_it_does_not_move(self, track: Track) -> None:
        track.close()
        with pytest.raises(DeviceError):
            track.move_to(self.limits_mm[0])

    def test_closing_twice_is_harmless(self, track: Track) -> None:
        track.close()
        track.close()
