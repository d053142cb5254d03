"""The tank's camera and track keep the contract that real devices keep."""

from collections.abc import Iterator

import pytest
from device_contract import CameraContract, TrackContract
from places import SCENES

from lscan.config.rig import RigFile, load_rig, parse_rig
from sim.devices import SimCamera, SimTrack, camera_driver, track_driver

SCENE = SCENES / "paper" / "groove.toml"
SIZE_PX = (96, 72)


def small_rig(bits: int = 8) -> RigFile:
    """The grooved block at a size that renders in a moment."""
    document = dict(load_rig(SCENE).document)
    document["camera"] = {**document["camera"], "width_px": 96, "height_px": 72, "bits": bits}
    document["lens"] = {**document["lens"], "focal_px": 127.5, "centre_px": [47.5, 35.5]}
    document["render"] = {"samples": 1, "scatter_samples": 0}
    return parse_rig(document, source="small")


class TestSimTrack(TrackContract):
    limits_mm = (-1000.0, 1000.0)
    tolerance_mm = 0.0
    name = "sim track"

    @pytest.fixture
    def track(self) -> Iterator[SimTrack]:
        self.opened = track_driver.open(small_rig())
        yield self.opened
        self.opened.close()

    def is_lit(self) -> bool:
        return self.opened.laser_is_on


class TestSimCamera(CameraContract):
    size_px = SIZE_PX
    name = "sim camera"
    live = False

    @pytest.fixture
    def camera(self) -> Iterator[SimCamera]:
        rig_file = small_rig(self.bits)
        track = track_driver.open(rig_file)
        camera = camera_driver.open(rig_file, track)
        yield camera
        camera.close()
        track.close()


class TestDeepSimCamera(TestSimCamera):
    bits = 12
