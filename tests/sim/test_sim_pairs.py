"""The tank's laser switched off for a background: what it shows, and what it is good for."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import SCENES

from lscan.acquisition.run import Run
from lscan.acquisition.scan import scan
from lscan.config.documents import merge
from lscan.config.rig import RigFile, load_rig, parse_rig
from sim.devices import SimCamera, SimTrack, TrackOptions
from sim.scene import scene_of

# The window of the paper's picture that holds the block.
LEFT, TOP, WIDTH, HEIGHT = 170, 310, 300, 150


def rig_of(name: str = "paper/groove.toml", **sections: dict[str, Any]) -> RigFile:
    document = load_rig(SCENES / name).document
    window = {
        "camera": {"width_px": WIDTH, "height_px": HEIGHT},
        "lens": {"centre_px": [319.5 - LEFT, 239.5 - TOP]},
        "render": {"samples": 4, "scatter_samples": 0},
    }
    return parse_rig(merge(merge(document, window), sections), source="small")


def devices(rig_file: RigFile) -> tuple[SimTrack, SimCamera]:
    track = SimTrack(TrackOptions())
    return track, SimCamera(scene_of(rig_file), track)


@pytest.mark.slow
def test_a_dark_picture_is_that_of_the_tank_with_next_to_no_laser() -> None:
    """Without noise to the byte.  A laser of a picowatt adds nothing but, unlike none at all,
    leaves each random sample of the ambient light where it was."""
    lamp = {"sensor": {"noise": False}, "light": {"ambient_w_m2_sr": 0.1}}
    _, camera = devices(rig_of(**lamp))
    _, unlit = devices(rig_of(**lamp, laser={"power_mw": 1e-9}))
    lit, dark, expected = camera.grab(0), camera.grab(0, dark=True), unlit.grab(0)
    np.testing.assert_array_equal(dark.image, expected.image)
    assert lit.image[..., 0].max() > dark.image[..., 0].max() + 50


def test_a_switched_off_laser_is_off_whatever_the_camera_is_set_to() -> None:
    track, camera = devices(rig_of(sensor={"noise": False}))
    lit = camera.grab(0).image
    track.laser_off()
    dark = camera.grab(1).image
    np.testing.assert_array_equal(dark, camera.grab(1, dark=True).image)
    track.laser_on()
    np.testing.assert_array_equal(camera.grab(2).image, lit)


def test_either_picture_of_a_pair_has_noise_of_its_own() -> None:
    """Differences of two frames, lit ones and dark ones, hold noise alone: over N pixels those
    of independent noise have a correlation of standard deviation 1 / sqrt(N)."""
    _, camera = devices(rig_of(sensor={"bayer": "none"}, laser={"on": False}))
    lit, dark = (
        np.subtract(camera.grab(0, dark).image, camera.grab(1, dark).image, dtype=float).ravel()
        for dark in (False, True)
    )
    assert min(lit.std(), dark.std()) > 0.5
    assert abs(np.corrcoef(lit, dark)[0, 1]) < 5 / np.sqrt(lit.size)
    once, again = camera.grab(0, dark=True), camera.grab(0, dark=True)
    np.testing.assert_array_equal(once.image, again.image)


@pytest.mark.slow
def test_the_background_has_the_exposure_of_its_picture() -> None:
    """A camera that meters its pictures would open up in the dark, and nothing would cancel."""
    _, camera = devices(rig_of(camera={"options": {"auto_exposure": True}}))
    lit, dark = camera.grab(3), camera.grab(3, dark=True)
    assert lit.exposure_ms == dark.exposure_ms
    assert lit.time_s < dark.time_s < camera.grab(4).time_s


def folder_bytes(run: Run) -> dict[str, bytes]:
    files = (file for file in sorted(run.path.rglob("*")) if file.is_file())
    return {str(file.relative_to(run.path)): file.read_bytes() for file in files}


def test_a_paired_scan_stopped_and_resumed_gives_the_same_bytes(tmp_path: Path) -> None:
    rig_file = rig_of(plan={"frames": 3, "laser": "pairs"})

    def stop(done: int, _: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        scan(rig_file, tmp_path / "a", progress=stop)
    resumed = scan(rig_file, tmp_path / "a", resume=True)
    whole = folder_bytes(scan(rig_file, tmp_path / "b"))
    assert folder_bytes(resumed) == whole
    assert len(whole) == 2 + 2 * 3


def test_laser_on_gives_the_pictures_of_a_laser_untouched(tmp_path: Path) -> None:
    on = scan(rig_of(plan={"frames": 1, "laser": "on"}), tmp_path / "on")
    untouched = scan(rig_of(plan={"frames": 1}), tmp_path / "untouched")
    assert on.rows == untouched.rows
