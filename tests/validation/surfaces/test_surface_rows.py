"""What the field table's chapter of surfaces takes for true: against the target's mesh."""

import numpy as np
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
