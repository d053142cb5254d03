"""A scene's numbers by their keys."""

import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.errors import InputError
from sim.scene import load_scene
from sim.scene.varying import number_at, with_numbers

SCENE = load_scene("paper/sandwave")
KEYS = {
    "water.salinity_psu": (0.0, 35.0),
    "head.camera_mm.1": (-900.0, -800.0),
    "head.camera_mm.2": (200.0, 400.0),
    "laser.tilt_deg": (-1.0, 1.0),
    "camera.exposure_ms": (1.0, 50.0),
    "track_errors.periodic_mm": (0.0, 1.0),
}


@examples(50)
@given(st.data())
def test_what_was_put_in_comes_out_and_the_rest_stays(data: st.DataObject) -> None:
    chosen = data.draw(st.lists(st.sampled_from(sorted(KEYS)), unique=True))
    numbers = {key: data.draw(st.floats(*KEYS[key])) for key in chosen}
    changed = with_numbers(SCENE, numbers, "test")
    for key in KEYS:
        assert number_at(changed, key) == numbers.get(key, number_at(SCENE, key))
    assert changed.tank.lens == SCENE.tank.lens
    assert changed.rig.plan == SCENE.rig.plan


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("lake.salinity_psu", "no such section.*camera, lens, head"),
        ("water.salt", "no number that can vary.*salinity_psu"),
        ("head.camera_mm", "no number.*camera_mm.0 to .2"),
        ("sensor.noise", "no number"),
        ("", "no such section"),
        ("head", "no number.*depression_deg"),
        ("head.camera_mm.3", "no number"),
        ("head.camera_mm.²", "no number"),
        ("head.camera_mm.1.7", "no number"),
    ],
)
def test_what_is_no_number_is_refused(key: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        with_numbers(SCENE, {key: 1.0}, "test")


def test_a_number_out_of_range_is_refused_where_it_was_stated() -> None:
    with pytest.raises(InputError, match=r"my study: water.salinity_psu.*36"):
        with_numbers(SCENE, {"water.salinity_psu": 36.0}, "my study")
