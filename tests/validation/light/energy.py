"""Energy: what the laser emits arrives, what a plane reflects is seen, nothing is made of it."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats, vectors
from sim.render.plugins.camera import fresnel_transmission
from sim.render.tank import Tank
from sim.scene import Scene
from sim.water import water_optics
from tests.validation.light.ports import closed_form_rays
from tests.validation.light.rigs import scene_with, topic
from tests.validation.rows import Topic, row

POWER_MW = 7.0
FANS: dict[str, dict[str, Any]] = {
    "Powell fan": {"fan": "uniform", "fan_rise": 0.3},
    "Gaussian fan": {"fan": "gaussian"},
    "bowed sheet": {"fan": "uniform", "port_tilt_deg": 15.0},
    "three lines": {
        "lines": [{"tilt_deg": t, "share": s} for t, s in ((-8, 0.2), (0, 0.5), (8, 0.3))]
    },
}  # fmt: skip
RADIUS_MM = 600.0


def energy() -> Topic:
    """The laser's power on a cylinder, on a plane, and at the glass; a white furnace."""
    shares = {name: power_through_cylinder(fan) / POWER_MW for name, fan in FANS.items()}
    rows = [
        *(row("power-through-cylinder", abs(s - 1), name=name) for name, s in shares.items()),
        row("power-reflected", reflected_deviation()),
        row("white-furnace", furnace_deviation()),
        row("fresnel", fresnel_deviation()),
    ]
    return topic("energy", rows=rows)


def power_through_cylinder(fan: dict[str, Any]) -> float:
    """mW through a cylinder about the apex, across all sheets: the sum of E over arc and s.

    Midpoint sums of smooth functions: what is left is single precision.
    """
    scene = scene_with(laser={"power_mw": POWER_MW, "waist_mm": 1.5, **fan})
    half = np.radians(scene.tank.laser.fan_half_angle_deg)
    phi = (np.arange(800) + 0.5) * (2 * half / 800) - half
    total = 0.0
    for sheet in Tank(scene).integrator.sheets:
        slope = np.array(sheet.slope(floats(phi))) if sheet.is_bowed else 0
        s = np.linspace(-8, 8, 1601)
        p, offset = np.meshgrid(phi, s)
        rise = offset + RADIUS_MM * slope
        points = _in_sheet(sheet, RADIUS_MM * np.sin(p), rise, RADIUS_MM * np.cos(p))
        values = np.array(sheet.irradiance(points, mi.Float(0.0)), dtype=float)
        total += float(values.sum() * RADIUS_MM * (phi[1] - phi[0]) * (s[1] - s[0]))
    return total


def _in_sheet(sheet: Any, lateral: Floats, offset: Floats, depth: Floats) -> mi.Point3f:
    """World points of a sheet's coordinates, mm."""
    x, y, z = map(floats, (lateral, offset, depth))
    return sheet.apex(mi.Float(0.0)) + sheet.across * x + sheet.normal * y + sheet.axis * z


def reflected_deviation() -> float:
    """Relative deviation of the power a floor reflects from albedo times the laser's power.

    From the picture: pi L over the area each pixel sees.
    """
    scene = scene_with("floor")
    floor = scene.tank.floor
    assert floor is not None
    area, weight = _floor_areas_mm2(scene, floor.z_mm)
    in_water = Tank(scene).render(0.0).direct.astype(float) / weight  # before port and lens
    reflected_mw = float(np.pi * 1e-3 * np.sum(in_water * area))
    return abs(reflected_mw / (floor.albedo * scene.tank.laser.power_mw) - 1)


def _floor_areas_mm2(scene: Scene, z_mm: float) -> tuple[Floats, Floats]:
    """(H, W) mm2 of the floor that each pixel sees, and the weight of its ray."""
    camera = scene.rig.camera
    rows, columns = camera.height_px, camera.width_px
    v, u = np.indices((rows + 1, columns + 1)) - 0.5
    origins, directions, _ = closed_form_rays(scene, np.column_stack([u.ravel(), v.ravel()]))
    path = (z_mm - origins[:, 2]) / directions[:, 2]
    met = (origins + path[:, np.newaxis] * directions)[:, :2].reshape(rows + 1, columns + 1, 2)
    one, two = met[1:, 1:] - met[:-1, :-1], met[1:, :-1] - met[:-1, 1:]
    area = 0.5 * np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    return area, _weights(scene)


def _weights(scene: Scene) -> Floats:
    """(H, W) weights of the rays through the pixels."""
    v, u = np.indices((scene.rig.camera.height_px, scene.rig.camera.width_px), dtype=float)
    return closed_form_rays(scene, np.column_stack([u.ravel(), v.ravel()]))[2].reshape(u.shape)


def furnace_deviation() -> float:
    """Largest relative deviation of a white floor's picture from the uniform light's radiance.

    The floor reflects 1 and the water takes nothing, so each pixel shows the light's radiance
    L, weighed by its ray's transmission over the squared index.
    """
    scene = scene_with("furnace")
    seen = Tank(scene).render(0.0).ambient.astype(float)
    return float(np.abs(seen / (scene.tank.light.ambient_w_m2_sr * _weights(scene)) - 1).max())


def fresnel_deviation() -> float:
    """Largest |R + T - 1| over angles and index ratios, R Mitsuba's and T the camera's."""
    cosine, ratio = np.meshgrid(np.cos(np.radians(np.arange(0, 85, 0.5))), (0.9, 1.12, 1.33, 1.49))
    cos_in, eta = map(floats, (cosine, ratio))
    reflected, cos_out, _, _ = mi.fresnel(cos_in, eta)
    there = np.array(reflected) < 1  # beyond, the ray is reflected whole and no camera's
    passed = np.array(fresnel_transmission(cos_in, abs(cos_out), eta))
    return float(np.abs(np.array(reflected) + passed - 1)[there].max())


# A closed box: light of all orders in it is a geometric series.


SEED = 83
HALF_MM = 200.0
ALBEDO = 0.5


def closed_box(rays: int, batches: int) -> Topic:
    """The power that a lit box's walls receive from each other, against the series' sum.

    rays: in each of so many batches.
    """
    scene = scene_with("box")
    received = power_from_walls(scene, rays, batches)
    expected = scene.tank.laser.power_mw * ALBEDO**2 / (1 - ALBEDO)
    error = float(received.std(ddof=1) / np.sqrt(batches)) / expected
    figure = abs(float(received.mean()) / expected - 1)
    words: dict[str, Any] = {"error": error, "batches": batches, "rays": rays}
    return topic("closed-box", [row("closed-box", figure, seed=SEED, sigma=error, **words)])


def power_from_walls(scene: Scene, rays: int, batches: int) -> Floats:
    """(batches,) mW that the walls receive by way of two and more reflections."""
    tank = Tank(scene)
    water = water_optics(tank.scene.tank.water, tank.scene.tank.laser.wavelength_nm)
    dry = replace(water, absorption_per_mm=0.0, scattering_per_mm=0.0)
    tank.higher.configure(dry, tank.sheets, 0.0)
    lit = mi.load_dict({"type": "scene", "walls": _walls(), "sheet": tank.sheets[0]})
    area = 6 * (2 * HALF_MM) ** 2
    return np.array(
        [np.pi * area * _radiance(tank, lit, rays, SEED + k).mean() for k in range(batches)]
    )


def _walls() -> dict[str, object]:
    """The six sides, in Mitsuba's description."""
    matt = {"type": "diffuse", "reflectance": {"type": "spectrum", "value": ALBEDO}}
    scale = mi.ScalarTransform4f().scale(HALF_MM)
    return {"type": "cube", "to_world": scale, "flip_normals": True, "bsdf": matt}


def _radiance(tank: Tank, scene: mi.Scene, count: int, seed: int) -> Floats:
    """(count,) mW/(mm2 sr) along rays from even places of the walls, drawn by their cosine.

    Their mean times pi is what each mm2 of the walls receives.
    """
    generator = np.random.default_rng(seed)
    side, upper = generator.integers(0, 3, count), generator.random(count) < 0.5
    a, b = generator.uniform(-HALF_MM, HALF_MM, (2, count))
    inward = np.where(upper, -1.0, 1.0)
    azimuth, squared = generator.uniform(0, 2 * np.pi, count), generator.random(count)
    start = np.column_stack([-(HALF_MM - 1e-2) * inward, a, b])
    flat = np.sqrt(squared)
    along = np.column_stack(
        [inward * np.sqrt(1 - squared), flat * np.cos(azimuth), flat * np.sin(azimuth)]
    )
    turn = (np.arange(3) - side[:, np.newaxis]) % 3  # puts the wall's normal along its axis
    origin, direction = (np.take_along_axis(v, turn, axis=1).T for v in (start, along))
    ray = dr.zeros(mi.RayDifferential3f, count)
    ray.o = mi.Point3f(vectors(origin))
    ray.d = vectors(direction)
    ray.maxt = dr.largest(mi.Float)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    _, _, layers = tank.higher.sample(scene, sampler, ray)
    return np.array(layers[0], dtype=float)
