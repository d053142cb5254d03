"""The contracts of cameras and tracks over the hardware of a rig file.

    pytest -m hardware --rig my-rig.toml

The head moves only within the rig's plan; a laser is switched only where the plan switches one.
With ``driver = "manual"`` someone has to crank: add ``-s`` and read what is asked.
"""

from collections.abc import Iterator
from pathlib import Path

import pytest
from device_contract import CameraContract, TrackContract

from lscan.acquisition.scan import open_camera, open_track
from lscan.config.rig import RigFile, load_rig
from lscan.devices.api import Camera, LaserSwitch, Limited, Track
from lscan.devices.signals import interrupted_by_signals, no_suspending
from lscan.errors import InputError

pytestmark = pytest.mark.hardware

RECORDED = ("replay", "sim")
"""Drivers of cameras whose frames are the same whenever they are grabbed."""

UNSTATED_MM = 0.5
"""Tolerance of a track that states none: half a division of a scale in mm."""


@pytest.fixture(scope="module", autouse=True)
def _laser_off_before_the_end() -> Iterator[None]:
    """``kill``, Ctrl-Z and a terminal that goes end the tests as Ctrl-C does: tracks are closed."""
    with interrupted_by_signals(), no_suspending():
        yield


@pytest.fixture(scope="module")
def rig_file(rig_path: Path) -> RigFile:
    try:
        return load_rig(rig_path)
    except InputError as error:
        pytest.fail(str(error), pytrace=False)


class TestTrack(TrackContract):
    @pytest.fixture
    def track(self, rig_file: RigFile) -> Iterator[Track]:
        plan = rig_file.rig.plan
        positions_mm = plan.positions_mm()
        self.range_mm = min(positions_mm), max(positions_mm)
        self.may_light = plan.laser != "untouched"
        track = open_track(rig_file)
        if isinstance(track, Limited):
            self.limits_mm, self.tolerance_mm = track.limits_mm, track.tolerance_mm
        else:
            self.limits_mm, self.tolerance_mm = self.range_mm, UNSTATED_MM
        yield track
        track.close()

    @pytest.mark.parametrize("side", [0, 1])
    def test_beyond_a_limit_is_refused_by_name(self, track: Track, side: int) -> None:
        """Tried only where the track states a limit, so that nothing is driven against an end."""
        if not isinstance(track, Limited):
            pytest.skip("this track states no limits")
        super().test_beyond_a_limit_is_refused_by_name(track, side)


@pytest.fixture(scope="class")
def standing(rig_file: RigFile) -> Iterator[Track]:
    """The track, where the plan begins: what is before the camera stands still.

    The laser is on, where the plan switches it: in the dark pictures are black.
    """
    plan = rig_file.rig.plan
    track = open_track(rig_file)
    try:
        track.move_to(plan.start_mm)
        if plan.laser != "untouched" and isinstance(track, LaserSwitch):
            track.laser_on()
        yield track
    finally:
        track.close()


class TestCamera(CameraContract):
    @pytest.fixture
    def camera(self, rig_file: RigFile, standing: Track) -> Iterator[Camera]:
        section = rig_file.rig.camera
        self.size_px = section.width_px, section.height_px
        self.live = section.driver not in RECORDED and "file" not in section.options
        camera = open_camera(rig_file, standing)
        yield camera
        camera.close()
