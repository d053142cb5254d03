"""Energy: what the laser emits arrives, what a plane reflects is seen, nothing is made of it."""

from typing import Any

import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import floats
from sim.render.plugins.camera import fresnel_transmission
from sim.render.tank import Tank
from sim.scene import Scene
from sim.validation.physics.ports import closed_form_rays
from sim.validation.physics.rigs import scene_with
from sim.validation.physics.topics import topic
from sim.validation.rows import Topic, row

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
