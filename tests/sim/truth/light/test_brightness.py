"""The line's expected height and noise, held against pictures of the tank."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.special import ndtr
from truth_scenes import tank

from lscan.config.documents import merge
from lscan.files.pictures import write_picture
from lscan.records import Status
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.matter import Penumbra
from sim.sensor import Webcam
from sim.truth import StripeTruth, line_brightness, stripe_truth

POSITION_MM = 20.0
# Pictures of 160 by 120 px, 4 mm a pixel, the sheet as much thicker.  Fine enough that neither
# the samples' raster nor the pixels' shows: a line of 0.5 px on a raster of 1/12 px.
SMALL: dict[str, Any] = {
    "camera": {"width_px": 160, "height_px": 120},
    "lens": {"focal_px": 212.5, "centre_px": [79.5, 59.5]},
    "laser": {"power_mw": 40.0, "waist_mm": 6.0},
    "floor": {"z_mm": -100.0},
    "render": {"samples": 144, "fineness": 3, "scatter_samples": 0},
    "sensor": {"gain": 0.25},  # nothing clips
}
# A sheet of 3 mm standard deviation, 900 mm away, is as much wider in the picture on its near
# side: at half a pixel from its middle it is higher there by 3/900 of its height.
NEAR_SIDE = 0.004


def small(**sections: Any) -> Scene:
    return tank(**merge(SMALL, sections))


def direct_light(scene: Scene) -> Layers:
    """The render's light of the line alone, without what the water throws beside it."""
    layers = Tank(scene).render(POSITION_MM)
    return replace(layers, scattered=np.zeros_like(layers.scattered))


def true_line(scene: Scene, even: float = 0.3) -> tuple[StripeTruth, np.ndarray, np.ndarray]:
    """Its truth, the columns where it is even, and the brightest pixel's row there.

    Lens and pixels mix the light of some 4 columns: within them the line has no edge, and its
    height differs by less than ``even``.
    """
    truth = stripe_truth(scene, POSITION_MM)
    height = line_brightness(scene, [truth])[0].height_dn
    clear = (truth.status == Status.OK) & (truth.edge_px >= 4) & ~truth.multiple
    for shift in range(1, 5):
        for other in (np.roll(height, shift), np.roll(height, -shift)):
            clear &= np.abs(np.nan_to_num(other / height, nan=np.inf) - 1) < even
    columns = np.flatnonzero(clear)
    return truth, columns, np.rint(truth.centre_px[columns]).astype(int)


def red_dn(scene: Scene, layers: Layers) -> np.ndarray:
    """(H, W) mean grey values of red, not rounded."""
    electrons = Webcam(scene).mean_electrons(layers, scene.rig.camera.exposure_ms)[..., 0]
    return electrons * 255 * scene.tank.sensor.gain / scene.tank.sensor.full_well_e


def plate(folder: Path, grey: bool = False, **target: Any) -> dict[str, Any]:
    """A plate that leans, as a mesh file; grey: painted darker towards the left."""
    box = trimesh.creation.box(extents=(400.0, 200.0, 30.0))
    if grey:
        levels = np.where(box.vertices[:, 0] > 0, 200, 90)
        box.visual.vertex_colors = np.column_stack([*[levels] * 3, 255 + 0 * levels]).astype(
            np.uint8
        )
    box.export(folder / "plate.ply")
    pose = {"position_mm": [0.0, 20.0, -60.0], "turn_deg": 5.0, "tilt_x_deg": 8.0}
    shown = {"shape": "mesh", "file": str(folder / "plate.ply"), **pose, **target}
    return {"target": shown, "laser": {"power_mw": 25.0}}


@pytest.mark.parametrize(
    ("sections", "bar"),
    [
        ({"laser": {"fan": "gaussian", "tilt_deg": 4.0, "aim_deg": 5.0}}, NEAR_SIDE),
        ({"laser": {"fan_rise": 0.5, "port_tilt_deg": 6.0, "m2": 300.0}}, NEAR_SIDE),
        ({"port": {"kind": "dome", "centre_mm": [3.0, 0.0, -8.0]}}, NEAR_SIDE),
        # Of the light 0.2 % more are lost per mm.
        ({"water": {"kind": "harbor"}, "laser": {"power_mw": 1000.0}}, NEAR_SIDE + 0.003),
        ({"lens": {"glare": 0.2, "glare_px": 6.0, "k1": -0.2, "vignetting": 2.0}}, NEAR_SIDE),
        ({"stripe": {"axis": "rows"}, "head": {"roll_deg": 90.0}}, NEAR_SIDE),
        # The disc of a point out of focus counts by its variance.
        ({"lens": {"focus_mm": 400.0}, "laser": {"power_mw": 20.0}}, 0.02),
    ],
)
def test_the_height_is_that_of_a_picture_without_noise(
    sections: dict[str, Any], bar: float
) -> None:
    held_against_a_picture(small(**sections), bar)


@pytest.mark.parametrize(
    ("target", "bar"),
    [
        ({}, NEAR_SIDE),
        # Mitsuba's shading is a fit that is good to 0.35 % (Walter et al. 2007), and comes twice.
        ({"finish": "wet"}, NEAR_SIDE + 0.007),
        # At 20 degrees from the glint it changes by 2 tan / roughness2, 3 per rad: 3 3/900.
        ({"finish": "mirror", "roughness": 0.5}, NEAR_SIDE + 0.007 + 0.01),
    ],
)
def test_the_finish_counts(target: dict[str, Any], bar: float, tmp_path: Path) -> None:
    held_against_a_picture(small(**plate(tmp_path, **target)), bar)


def held_against_a_picture(scene: Scene, bar: float) -> None:
    """Assert that the expected heights are a picture's, to ``bar`` of them."""
    truth, columns, rows = true_line(scene)
    assert len(columns) > 25
    expected = line_brightness(scene, [truth])[0].height_dn[columns]
    picture = red_dn(scene, direct_light(scene))
    found = picture[rows, columns] if truth.axis == "columns" else picture[columns, rows]
    assert np.median(expected) > 5
    np.testing.assert_allclose(found, expected, rtol=bar)


@pytest.mark.parametrize("papered", [True, False])
def test_the_paint_counts_where_the_line_falls(papered: bool, tmp_path: Path) -> None:
    """Where it changes within the blur the picture is the mean of it: 3 % over 4 columns."""
    stripes = np.repeat(np.array([[90, 220]], np.uint8), 8, axis=1)  # along the track
    write_picture(tmp_path / "stripes.png", stripes)
    texture = {"file": str(tmp_path / "stripes.png"), "size_mm": [200.0, 200.0]}
    target = plate(tmp_path, texture=texture) if papered else plate(tmp_path, grey=True)
    scene = small(**target)
    truth, columns, rows = true_line(scene, even=0.03)
    expected = line_brightness(scene, [truth])[0].height_dn[columns]
    assert np.ptp(expected) > 0.3 * np.median(expected)
    found = red_dn(scene, direct_light(scene))[rows, columns]
    np.testing.assert_allclose(found, expected, rtol=0.03)
    assert abs(np.median(found / expected) - 1) < 0.003


def test_the_sandwave_s_height_is_that_of_a_picture() -> None:
    """At full size, where it bends: blur averages over slopes, so single columns may be off."""
    scene = tank(
        workpiece={"kind": "sandwave"},
        target={"shape": "workpiece", "position_mm": [-75.0, -60.0, -60.0]},
        render={"samples": 36, "fineness": 2, "scatter_samples": 0},
        laser={"power_mw": 8.0},
    )
    truth, columns, rows = true_line(scene)
    expected = line_brightness(scene, [truth])[0].height_dn[columns]
    ratio = red_dn(scene, direct_light(scene))[rows, columns] / expected
    assert len(columns) > 90
    assert abs(np.median(ratio) - 1) < 0.005
    assert np.quantile(np.abs(ratio - 1), 0.9) < 0.03


@pytest.mark.parametrize(
    "sensor",
    [
        {"gain": 1.0, "black_level_dn": 12.0, "speckle": "depolarised", "prnu": 0.05},
        {"gain": 1.0, "black_level_dn": 40.0, "gamma": 1.6},
    ],
)
def test_the_noise_is_that_of_many_cameras(sensor: dict[str, Any]) -> None:
    """Pictures by 100 cameras: a standard deviation of 100 is good to 1/sqrt(200), 7.1 %, and the
    mean over 60 columns or more, each on its own, to 0.9 %; bar: four times that.
    """
    scene = small(
        sensor={"prnu": 0.02, **sensor}, laser={"power_mw": 60.0}, light={"ambient_w_m2_sr": 0.002}
    )
    layers = direct_light(scene)
    truth, columns, rows = true_line(scene)
    (light,) = line_brightness(scene, [truth])
    assert len(columns) > 60
    lines, besides = [], []
    for seed in range(100):
        webcam_scene = replace(
            scene,
            tank=scene.tank.model_copy(
                update={"sensor": scene.tank.sensor.model_copy(update={"seed": seed})}
            ),
        )
        image = Webcam(webcam_scene).expose(
            layers, scene.rig.camera.exposure_ms, np.random.default_rng([seed, 1])
        )
        lines.append(image[rows, columns, 0].astype(float))
        besides.append(image[rows - 12, columns, 0].astype(float))
    line, beside = np.array(lines), np.array(besides)
    assert 20 < np.median(light.height_dn[columns]) < 200
    height = (line.mean(axis=0) - beside.mean(axis=0)) / light.height_dn[columns]
    assert height.mean() == pytest.approx(1, abs=0.01)
    for values, expected in ((beside, light.noise_dn), (line, light.height_sigma_dn)):
        ratio = values.std(axis=0, ddof=1) / expected[columns]
        assert ratio.mean() == pytest.approx(1, abs=0.037)


def test_columns_of_no_line_have_no_height() -> None:
    scene = small(laser={"fan_half_angle_deg": 12.0})
    truth = stripe_truth(scene, POSITION_MM)
    (light,) = line_brightness(scene, [truth])
    for name in ("height_dn", "height_sigma_dn", "noise_dn", "snr"):
        values = getattr(light, name)
        assert np.array_equal(np.isnan(values), truth.status != Status.OK)
    none = small(laser={"on": False})
    assert np.isnan(line_brightness(none, [stripe_truth(none, 0.0)])[0].height_dn).all()


def test_height_follows_the_exposure_until_it_clips() -> None:
    scene = small(sensor={"gain": 1.0, "black_level_dn": 5.0}, laser={"power_mw": 1.0})
    truth = stripe_truth(scene, POSITION_MM)
    one, two, many = line_brightness(scene, [truth] * 3, [10.0, 20.0, 1e6])
    good = truth.status == Status.OK
    np.testing.assert_allclose(two.height_dn[good], 2 * one.height_dn[good], rtol=1e-12)
    np.testing.assert_allclose(many.height_dn[good], 250.0)
    np.testing.assert_allclose(one.snr[good], (one.height_dn / one.noise_dn)[good], rtol=1e-12)


def test_a_penumbra_takes_its_share_of_the_noise_beside_the_line() -> None:
    """Where all light beside the line is the lamps', its shot noise goes with the light's root."""
    shade = Penumbra(x_mm=40.0, width_mm=30.0, left=0.2)
    light = {"ambient_w_m2_sr": 0.2}
    quiet = {"prnu": 0.0, "dark_noise_e": 0.0, "gain": 1.0}
    dry = {"kind": "given", "absorption_per_m": 0.0, "scattering_per_m": 0.0}
    whole, shaded = (
        small(sensor=quiet, light={**light, "penumbra": some}, water=dry)
        for some in (None, shade.model_dump())
    )
    truth, columns, _ = true_line(whole)
    (bright,), (dim,) = (line_brightness(scene, [truth]) for scene in (whole, shaded))
    share = 0.2 + 0.8 * ndtr(-(truth.xz_mm[columns, 0] - 40.0) / 30.0)
    rounding = 1 / 12
    variance = (b.noise_dn[columns] ** 2 - rounding for b in (bright, dim))
    np.testing.assert_allclose(next(variance) * share, next(variance), rtol=0.01)
