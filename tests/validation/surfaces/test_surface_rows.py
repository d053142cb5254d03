"""What the field table's chapter of surfaces takes for true: against the target's mesh."""

import numpy as np
from places import SCENES
from scipy.spatial.transform import Rotation

from lscan.measure.meshes import MeshSearch
from sim.scene import Pose
from tests.validation.surfaces import surface as chapter

TARGET = Pose(Rotation.from_euler("z", -2, degrees=True).as_matrix(), np.array([225.0, 60.0, -345]))
BLOCK = Pose(
    Rotation.from_euler("ZYX", [3, -1.5, 1], degrees=True).as_matrix(), np.array([154.0, 30, -330])
)
TRUTH = chapter._Truth(TARGET, BLOCK)


def test_true_places_and_heights_are_those_of_the_mesh() -> None:
    """To the chords of its facets, 0.006 mm on the dome and 0.004 mm on the rod."""
    search = MeshSearch(chapter.target_mesh())
    tops = [
        (chapter.DOME, 0.0, chapter.DOME_MM),
        (chapter.ROD, 7.0, chapter.ROD_MM),
        (chapter.EGG, 0.0, chapter.EGG_MM[2]),
        (chapter.STEP, 3.0, chapter.STEP_HEIGHT_MM),
        (-67.0, 3.0, 0.0),
    ]
    assert np.abs(search.nearest(np.array(tops)).distance_mm).max() < 0.007
    for x, y, z in tops:
        place = TRUTH.place(x, y, z)
        np.testing.assert_allclose(TARGET.invert(BLOCK.apply(place)), [x, y, z], atol=1e-9)
        assert abs(TRUTH.height(place[:2], z) - place[2]) < 1e-9


def test_what_is_wanted_is_what_is_known() -> None:
    wanted, values = TRUTH.wanted(), TRUTH.values()
    names = {entry.name for _, entries in wanted for entry in entries}
    assert names == set(values)
    (step,) = wanted.step
    assert np.mean(step.upper.x_mm) > np.mean(step.lower.x_mm)
    # The target leans by 1.8 degrees in the block's frame, over the 37 mm between the places.
    assert abs(values["up"]["height_mm"] - chapter.STEP_HEIGHT_MM) < 37 * np.tan(np.radians(1.9))


def test_the_egg_is_compared_where_the_camera_sees_it() -> None:
    """Its far flank is not: the camera looks along y."""
    a, b, c = chapter.EGG_MM
    y = np.linspace(-0.9, 0.9, 19) * b
    z = c * np.sqrt(1 - (y / b) ** 2)
    places = np.column_stack([np.full(19, chapter.EGG), y, z])
    seen = chapter._well_seen(places)
    assert seen[y < 0].all() and not seen[y > 0.5 * b].any()
    assert not chapter._well_seen(places + np.array([a, 0.0, 0.0])).any()


def test_the_target_stands_in_the_blocks_scene() -> None:
    scene = chapter._rendered(SCENES, "sandwave", chapter.FieldEffort(plain=True))
    positions = chapter._over_target(chapter.STEP_MM)
    assert scene.tank.render.samples == 1
    assert positions[0] < 60 - chapter.HALF_MM and positions[-1] > 60 + chapter.HALF_MM
