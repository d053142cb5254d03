"""The board's picture as the accuracy table takes it: blurred before the pixels sum it up."""

import numpy as np
import pytest
from places import SCENES

from lscan.board import read_board
from lscan.records import BoardReading, Floats
from sim.render.tank import Tank
from sim.scene import Scene, load_scene
from sim.sensor import Webcam
from sim.truth import board_truth

pytestmark = pytest.mark.xdist_group("accuracy_board")  # one worker: they share a fixture


ERRORS = {
    "scale_x_ppm": 1e4, "scale_z_ppm": -5e3, "shear_deg": 1.0, "dot_noise_mm": 0.5,
    "bend_x_mm": 5.0, "bend_z_mm": -3.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene(SCENES / "best" / "board.toml").with_tank(board_errors=ERRORS)


@pytest.fixture(scope="module")
def reading(scene: Scene) -> BoardReading:
    """Of a picture without noise and rounding."""
    layers = Tank(scene).render(scene.rig.plan.start_mm)
    camera, board = scene.rig.camera, scene.rig.board
    electrons = Webcam(scene).mean_electrons(layers, camera.exposure_ms)
    assert board is not None
    return read_board(electrons.reshape(camera.height_px, camera.width_px, -1)[..., 0], board)


def ruler_px(reading: BoardReading) -> Floats:
    return np.concatenate([ruler.marks.image_px for ruler in reading.rulers])


@pytest.mark.slow
def test_marks_of_two_pixels_are_not_displaced_by_the_pixels(
    scene: Scene, reading: BoardReading
) -> None:
    """A disc of 1 px radius, blurred after the pixels, would miss by up to 0.021 px.

    That is 0.015 px rms along each coordinate.  What is left is the raster: its 12 by 12 places
    in a pixel draw a rim of 6 px with some 75 steps of 1/12 px, each off by 1/12 / sqrt(12) px,
    0.024 / sqrt(75) = 0.0028 px; with the dots' and the plate's own as much again.
    """
    truth = board_truth(scene).centres
    assert np.sqrt(np.nanmean((ruler_px(reading) - ruler_px(truth)) ** 2)) <= 0.0056


@pytest.mark.slow
def test_the_light_is_the_scene_s(scene: Scene, reading: BoardReading) -> None:
    """The picture is neither shifted nor scaled against the one rendered pixel by pixel."""
    truth = board_truth(scene).centres
    miss = reading.grid.image_px - truth.grid.image_px
    # 100 marks of up to 0.01 px each: their mean.
    np.testing.assert_allclose(np.nanmean(miss, axis=0), 0.0, atol=1e-3)

    for axis in (0, 1):
        slope = np.polyfit(truth.grid.image_px[:, axis], reading.grid.image_px[:, axis], 1)[0]
        # 0.01 px at the picture's ends, 320 px from its middle.
        assert slope == pytest.approx(1.0, abs=3e-5)
