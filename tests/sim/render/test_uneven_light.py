"""Ambient light with a gradient, and the laser's line on a bent board: pictures against truth."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad
from truth_scenes import tank

from lscan.config.documents import merge
from lscan.records import Floats, Status
from sim.render.plugins.arrays import vectors
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.matter import AmbientLight
from sim.truth import board_truth, line_brightness, stripe_truth
from sim.water import Optics, water_optics

GRADIENT, CENTRE_MM, UNIFORM = (1.5, -0.8, 0.6), (20.0, -30.0, 40.0), 2.0
# A board leant back under the sheet, of which 640 by 480 px show most, without a mark on the line.
LEANT: dict[str, Any] = {
    "board": {
        "grid": {"columns": 3, "rows": 3, "pitch_mm": 100.0, "dot_diameter_mm": 4.0},
        "plate": {"margin_mm": 40.0},
    },
    "target": {
        "shape": "board",
        "position_mm": [-100.0, 32.0, 40.0],
        "tilt_x_deg": -40.0,
        "albedo": 0.8,
    },
    "light": {"ambient_w_m2_sr": 0.2},
    "render": {"samples": 64, "scatter_samples": 0},
}
SMALL = {
    "camera": {"width_px": 320, "height_px": 240},
    "lens": {"focal_px": 425.0, "centre_px": [159.5, 119.5]},
}


def level(places: Floats) -> Floats:
    """The light's share of that in the middle, not yet cut off at nothing."""
    return 1 + (places - np.array(CENTRE_MM)) @ np.array(GRADIENT) / 1000


def floor_light(water: Optics, starts: Floats, along: Floats) -> Floats:
    """Radiance of ambient light along rays to a white floor at z = 0, one sample each."""
    size = mi.ScalarTransform4f().scale([4000, 4000, 1])
    matt = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": 1.0}}
    scene = mi.load_dict(
        {"type": "scene", "floor": {"type": "rectangle", "to_world": size, "bsdf": matt}}
    )
    integrator = SheetIntegrator(mi.Properties())
    light = AmbientLight(gradient_per_m=GRADIENT, centre_mm=CENTRE_MM)
    integrator.configure(water, [], UNIFORM, light)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, len(starts))
    o, d = (vectors(v.T) for v in (starts, along))
    rays = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(o), d))
    count = dr.full(mi.Bool, True, len(starts))
    value, _, _ = integrator.sample(scene, sampler, rays, None, count)
    return np.array(value[0], dtype=float)


@pytest.mark.parametrize("turbid", [0.0, 5.0])
def test_a_floor_and_the_water_before_it_are_lit_by_the_gradient(turbid: float) -> None:
    """White under L(x) it shows L(x), dimmed, and what the water sends of it: by quadrature."""
    dry = water_optics(tank(water={"kind": "air"}).tank.water, 650.0)
    given = {"kind": "given", "absorption_per_m": turbid, "scattering_per_m": turbid}
    water = water_optics(tank(water=given).tank.water, 650.0) if turbid else dry
    x_mm = np.linspace(-300.0, 300.0, 25)
    towards = np.array([0.3, 0.2, -0.9]) / np.linalg.norm([0.3, 0.2, 0.9])
    starts = np.column_stack([x_mm, 0 * x_mm, 0 * x_mm + 400])
    seen = floor_light(water, starts, np.tile(towards, (len(x_mm), 1)))
    way = 400 / -towards[2]
    loss, turned = water.extinction_per_mm, water.scattering_per_mm
    for start, light in zip(starts, seen, strict=True):
        veil, _ = quad(lambda s: turned * level(start + s * towards) * np.exp(-loss * s), 0, way)  # noqa: B023
        expected = UNIFORM * (level(start + way * towards) * np.exp(-loss * way) + veil)
        # Single precision: of the mean distance some 1e-7 / (c t), of 300 mm.
        assert light == pytest.approx(expected, rel=2e-5)


def test_beyond_its_dark_end_there_is_no_light() -> None:
    dry = water_optics(tank(water={"kind": "air"}).tank.water, 650.0)
    starts = np.array([[-800.0, 0.0, 100.0], [-600.0, 0.0, 100.0]])
    seen = floor_light(dry, starts, np.tile([0.0, 0.0, -1.0], (2, 1)))
    places = starts * [1, 1, 0]
    np.testing.assert_allclose(seen, UNIFORM * np.maximum(level(places), 0), atol=1e-6)
    assert seen[0] == 0 and seen[1] > 0


def leant(**sections: Any) -> Scene:
    return tank(**merge(LEANT, sections))


def uneven(**sections: Any) -> list[Scene]:
    """The leant board under even light, and with the gradient, in small pictures."""
    light = {"gradient_per_m": list(GRADIENT), "centre_mm": list(CENTRE_MM)}
    return [leant(light=some, **SMALL, **sections) for some in ({}, light)]


def test_gathered_and_sampled_light_of_a_board_go_with_the_gradient() -> None:
    """Without water the picture is the even one's, times the light at what each pixel shows.

    That is within half a pixel, 1 mm, of the mark, over which the light differs by 1.5 per metre
    times 1 mm, along rows and along columns; where a mark ends more of one half is bright.
    """
    scenes = uneven(water={"kind": "air"}, laser={"on": False})
    marks = board_truth(scenes[1]).centres.grid
    columns, rows = np.rint(marks.image_px[marks.found]).astype(int).T
    lean = np.radians(-40.0)
    up = marks.board_mm[marks.found]
    place = np.column_stack([up[:, 0], -np.sin(lean) * up[:, 1], np.cos(lean) * up[:, 1]])
    expected = level(place + np.array(LEANT["target"]["position_mm"]))
    for sampled in (False, True):
        even, lit = (
            Tank(scene, sampled=sampled).render(0.0, 16).ambient[rows, columns] for scene in scenes
        )
        np.testing.assert_allclose(lit / even, expected, rtol=4e-3)
    assert np.ptp(expected) > 0.1


def test_the_light_beside_the_line_is_that_of_a_picture() -> None:
    """Its shot noise, the only one but rounding, goes with the light: the truth's own ratio."""
    given = {"kind": "given", "absorption_per_m": 1.0, "scattering_per_m": 2.0}
    quiet = {"prnu": 0.0, "dark_noise_e": 0.0, "dsnu_e": 0.0, "gain": 1.0}
    scenes = uneven(water=given, sensor=quiet)
    truth = stripe_truth(scenes[0], 0.0)
    columns = np.flatnonzero((truth.status == Status.OK) & (truth.edge_px > 5))
    rows = np.rint(truth.centre_px[columns]).astype(int)
    even, lit = (Tank(scene).render(0.0).ambient[rows, columns] for scene in scenes)
    variance = [
        line_brightness(scene, [truth])[0].noise_dn[columns] ** 2 - 1 / 12 for scene in scenes
    ]
    # Half a pixel, 1 mm, off the line's middle the light differs by 1.5 per metre times that.
    np.testing.assert_allclose(variance[1] / variance[0], lit / even, rtol=4e-3)
    assert np.ptp(lit / even) > 0.1


def test_the_line_on_a_bent_board_is_where_the_truth_has_it() -> None:
    """Centroids of its direct light along columns, as near as on the flat board: 0.01 px rms.

    64 samples draw each column of the line on a raster of 1/8 px, and the line is 2 px wide: the
    sums of a Gaussian sampled so are exact.  Its two sides are not seen alike: as in
    test_brightness.py, one side is nearer to laser and camera by 1/900 of its light a mm.
    """
    scene = leant(board_errors={"bend_x_mm": -3.0, "bend_z_mm": 4.0})
    truth = stripe_truth(scene, 0.0)
    columns = np.flatnonzero((truth.status == Status.OK) & (truth.edge_px > 5))
    light = Tank(scene).render(0.0).direct.astype(float)[:, columns]
    rows = np.arange(len(light))[:, np.newaxis]
    light[np.abs(rows - truth.centre_px[columns]) > 8] = 0
    miss = (light * rows).sum(axis=0) / light.sum(axis=0) - truth.centre_px[columns]
    assert len(columns) > 200
    assert np.sqrt(np.mean(miss**2)) < 0.01
