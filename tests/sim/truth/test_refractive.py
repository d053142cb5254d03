"""The refractive map of the paper's view against the tank's ground truth."""

from dataclasses import replace

import numpy as np
import pytest
from places import SCENES

from lscan.calibration.maps.refractive import solver
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Marks, Status
from sim.scene import head_pose, load_scene, target_pose
from sim.truth import board_truth, project

SCENE = SCENES / "paper" / "board.toml"
NOISE_PX = 0.025  # of the marks read from the tank's pictures, the rulers' included: 0.008 to 0.025


def noisy(reading: BoardReading, rng: np.random.Generator) -> BoardReading:
    """The reading with its marks shifted by NOISE_PX, and saying so."""

    def shift(marks: Marks) -> Marks:
        image = marks.image_px + rng.normal(0.0, NOISE_PX, marks.image_px.shape)
        return replace(marks, image_px=image, sigma_px=marks.sigma_px + NOISE_PX)

    rulers = tuple(replace(ruler, marks=shift(ruler.marks)) for ruler in reading.rulers)
    return replace(reading, grid=shift(reading.grid), rulers=rulers)


@pytest.mark.parametrize(
    "known", [OpticsSection(), OpticsSection(focal_px=(880.0, 43.0))], ids=["rough", "focal to 5 %"]
)
def test_map_on_the_sheet(known: OpticsSection) -> None:
    """The bars of ``make validate``: rms <= 0.03 mm, max <= 0.10 mm over all the covered sheet."""
    scene = load_scene(SCENE)
    x, z = np.meshgrid(np.linspace(0.0, 450.0, 46), np.linspace(-450.0, 0.0, 46))
    places = np.column_stack([x.ravel(), z.ravel()])
    world = target_pose(scene).apply(
        np.column_stack([places[:, 0], 0 * places[:, 0], places[:, 1]])
    )
    image = project(scene, head_pose(scene.tank.head, 0.0).invert(world))
    reading = noisy(board_truth(scene).centres, np.random.default_rng(1))
    answer = solver.solve(reading, "", known).to_plane(image)
    assert np.mean(answer.status == Status.OK) > 0.95
    distance = np.linalg.norm(answer.xz_mm - places, axis=1)
    assert np.sqrt(np.nanmean(distance**2)) <= 0.03
    assert np.nanmax(distance) <= 0.10
