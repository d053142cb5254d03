"""Label pictures: layers drawn by hand, and the width of the line."""

from typing import Any

import numpy as np
import pytest
from truth_scenes import tank

from lscan.errors import InputError
from lscan.records import Status
from sim.datasets.labels import (
    COLOURS,
    Label,
    colour_labels,
    core_mask,
    half_width_mm,
    label_picture,
    label_scene,
    line_sigma_px,
    one_step_w_m2_sr,
)
from sim.render.layers import Layers
from sim.scene import Scene
from sim.sensor import Webcam
from sim.truth import StripeTruth, stripe_truth


def truth(centre: list[float], axis: Any = "columns", multiple: int | None = None) -> StripeTruth:
    """A line with the given centres; NaN where there is none."""
    centre_px = np.array(centre)
    there = np.isfinite(centre_px)
    count = len(centre)
    return StripeTruth(
        position_mm=0.0,
        line=0,
        axis=axis,
        centre_px=centre_px,
        xz_mm=np.zeros((count, 2)),
        y_mm=np.zeros(count),
        lit=there,
        seen=there,
        status=np.where(there, Status.OK, Status.NO_PEAK),
        face=np.where(there, 0, -1),
        edge_px=np.where(there, 0.0, np.nan),
        continues=np.zeros(count, dtype=bool),
        multiple=np.arange(count) == multiple,
    )


def layers(direct: np.ndarray, scattered: float = 0.0, ambient: float = 0.0) -> Layers:
    base = np.zeros_like(direct, dtype=np.float32)
    return Layers(direct.astype(np.float32), base + scattered, base + ambient)


def floor(**laser: Any) -> Scene:
    return tank(floor={"z_mm": -100.0}, laser=laser)


def test_each_layer_has_its_class():
    line = truth([10.0, 10.0, np.nan, 10.0], multiple=3)
    direct = np.zeros((21, 4))
    direct[:, :] = 2.0
    picture = label_picture(layers(direct, scattered=1.0), [(line, np.full(4, 1.5))])
    # Three sigma are 4.5 px, half a pixel more: rows 5 to 15.
    expected = np.full(21, Label.REFLECTION)
    expected[5:16] = Label.LINE
    assert picture.dtype == np.uint8
    assert np.array_equal(picture[:, 0], expected)
    assert np.array_equal(picture[:, 1], expected)
    assert np.all(picture[:, 2] == Label.REFLECTION)
    assert np.all(picture[:, 3] == Label.LINE)
    for scattered, ambient, label in ((3.0, 1.0, Label.VEIL), (1.0, 3.0, Label.AMBIENT)):
        other = label_picture(layers(direct, scattered, ambient), [(line, np.full(4, 1.5))])
        assert np.all(other == label)


def test_what_is_dark_is_said():
    direct = np.array([[3.0, 2.01, 1.99], [0.0, 1.0, 3.0]])
    given = label_picture(layers(direct), [], dark_w_m2_sr=2.0)
    r, d = Label.REFLECTION, Label.DARK
    assert given.tolist() == [[r, r, d], [d, d, r]]
    assert label_picture(layers(direct), []).tolist() == [[r, r, r], [d, r, r]]


@pytest.mark.parametrize("gamma", [1.0, 2.2])
def test_one_step_lifts_the_picture_by_one_digital_number(gamma):
    """The camera equation backwards: the webcam's own picture of that radiance is 1 DN up."""
    scene = tank(
        camera={"width_px": 17, "height_px": 17},
        lens={"vignetting": 0.0, "blur_px": 0.0},
        sensor={"noise": False, "gamma": gamma, "black_level_dn": 30.0},
    )
    webcam, nothing = Webcam(scene), np.random.default_rng(0)
    exposure_ms = scene.rig.camera.exposure_ms

    def red(radiance: float) -> int:
        lit = layers(np.full((17, 17), radiance))
        return int(webcam.expose(lit, exposure_ms, nothing)[8, 8, 0])

    step = one_step_w_m2_sr(scene)
    # Behind gamma black is no whole number, but it and one more are rounded alike.
    assert red(step) - red(0.0) == 1
    assert red(0.01 * step) == red(0.0)


def test_no_light_is_bright_enough_for_a_blind_sensor():
    blind = {"red": 0.0, "green": 0.0, "blue": 0.0}
    assert one_step_w_m2_sr(tank(sensor={"laser_response": blind})) == np.inf


def test_rows_are_columns_turned():
    centre, sigma = [4.0, 5.5, np.nan, 7.0], np.array([0.5, 1.0, 1.0, 2.0])
    columns = core_mask(truth(centre), sigma, (12, 4))
    rows = core_mask(truth(centre, "rows"), sigma, (4, 12))
    assert np.array_equal(rows, columns.T)
    assert columns.sum(axis=0).tolist() == [5, 8, 0, 11]


def test_several_lines_are_all_lines():
    direct = np.ones((21, 2))
    lines = [(truth([at, at]), np.full(2, 0.5)) for at in (4.0, 16.0)]
    picture = label_picture(layers(direct), lines)
    assert np.flatnonzero(picture[:, 0] == Label.LINE).tolist() == [*range(2, 7), *range(14, 19)]


def test_a_scene_has_the_cores_of_all_its_lines():
    lines = [{"tilt_deg": tilt, "share": 0.5} for tilt in (-2.0, 2.0)]
    scene = floor(lines=lines)
    lit = layers(np.ones((480, 640)))
    labels = label_scene(scene, 0.0, lit)
    cores = []
    for line in range(2):
        truth = stripe_truth(scene, 0.0, line)
        cores.append(core_mask(truth, line_sigma_px(scene, truth), labels.shape))
    assert cores[0].any() and cores[1].any() and not (cores[0] & cores[1]).any()
    assert np.array_equal(labels == Label.LINE, cores[0] | cores[1])
    one = label_scene(floor(tilt_deg=-2.0), 0.0, lit)
    assert np.array_equal(one == Label.LINE, cores[0])
    off = label_scene(floor(lines=lines, on=False), 0.0, lit)
    assert np.all(off == Label.REFLECTION)
    dim = layers(np.full((480, 640), 0.99 * one_step_w_m2_sr(scene)))
    assert np.all(label_scene(scene, 0.0, dim) == Label.DARK)


def test_a_longer_exposure_lifts_what_was_dark():
    """The step is of the light, so that twice the exposure halves it."""
    scene = floor()
    exposure_ms = 2 * scene.rig.camera.exposure_ms
    step = one_step_w_m2_sr(scene)
    assert one_step_w_m2_sr(scene, exposure_ms) == pytest.approx(step / 2, rel=1e-12)
    dim = layers(np.full((480, 640), 0.99 * step))
    assert np.all(label_scene(scene, 0.0, dim) == Label.DARK)
    assert not np.any(label_scene(scene, 0.0, dim, exposure_ms=exposure_ms) == Label.DARK)


def test_sizes_that_differ_are_refused():
    with pytest.raises(InputError, match=r"differ in size.*\(5, 3\).*4 columns"):
        label_picture(layers(np.ones((5, 3))), [(truth([1.0] * 4), np.ones(4))])


def test_every_label_has_a_colour():
    assert list(COLOURS) == list(Label)
    assert len(set(COLOURS.values())) == len(Label)
    picture = np.array([list(Label)], dtype=np.uint8)
    assert colour_labels(picture)[0].tolist() == [list(COLOURS[label]) for label in Label]


@pytest.mark.parametrize("tilt", [0.0, 20.0])
def test_the_line_is_as_wide_as_the_sheet_looks(tilt):
    laser = {"waist_mm": 1.0, "waist_distance_mm": 600.0, "tilt_deg": tilt}
    scene = tank(floor={"z_mm": -100.0}, laser=laser, lens={"blur_px": 0.0})
    line = stripe_truth(scene, 0.0)
    sigma = line_sigma_px(scene, line)
    good = line.status == Status.OK
    assert np.array_equal(np.isfinite(sigma), good)
    # On a level floor a sheet of half width w reaches w/cos(tilt) along y, and a laser moved
    # along y takes the line along, mm for mm.
    here, there = (
        stripe_truth(floor(**laser, apex_mm=[0.0, y, 500.0]), 0.0).centre_px for y in (-0.1, 0.1)
    )
    sigma_y = half_width_mm(scene, line) / 2 / np.cos(np.radians(tilt))
    expected = np.abs(there - here) / 0.2 * sigma_y
    inner = good & np.isfinite(expected)
    # The picture's third derivative over its first is some 1/(1 m)^2: times (0.2 mm)^2,
    # nothing; the widths differ along the two ways of moving by parts in 1e4.
    assert sigma[inner] == pytest.approx(expected[inner], rel=1e-4)
    assert 0.2 < sigma[inner].mean() < 1.0


def test_the_sheet_is_thinnest_at_its_waist():
    scene = floor(waist_mm=0.3, waist_distance_mm=600.0)
    line = stripe_truth(scene, 0.0)
    middle = np.nanargmin(np.abs(line.xz_mm[:, 0]))
    width = half_width_mm(scene, line)
    assert width[middle] == pytest.approx(0.3, rel=1e-4)  # the floor is 600 mm off
    # w0 0.5 mm: 0.589 mm one metre from the waist (docs/explanation/physics.md, section 4).
    far = floor(waist_mm=0.5, waist_distance_mm=-400.0)
    assert half_width_mm(far, stripe_truth(far, 0.0))[middle] == pytest.approx(0.589, abs=1e-3)


def test_the_blur_adds_in_squares():
    sharp = tank(floor={"z_mm": -100.0}, lens={"blur_px": 0.0})
    soft = tank(floor={"z_mm": -100.0}, lens={"blur_px": 2.0})
    line = stripe_truth(sharp, 0.0)
    a, b = line_sigma_px(sharp, line), line_sigma_px(soft, line)
    assert np.nanmax(np.abs(b**2 - a**2 - 4.0)) < 1e-9
