"""Energy: what the laser emits arrives, what a plane reflects is seen, nothing is made of it."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.ports import fresnel_transmission
from sim.render.tank import Tank
from sim.scene import Scene
from sim.validation.physics.ports import closed_form_rays
from sim.validation.physics.rigs import scene_with
from sim.validation.physics.topics import topic
from sim.validation.rows import Bar, Topic

BAR = Bar(1e-3, "relative", "required of the tank; single precision costs 1e-6")
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
FLOOR_Z_MM = -400.0
FLOOR_ALBEDO = 0.6
AMBIENT = 2.0


def energy() -> Topic:
    """The laser's power on a cylinder, on a plane, and at the glass; a white furnace."""
    rows = [
        *(BAR.row(f"power through a cylinder, {name}", "the laser's power",
               abs(power_through_cylinder(fan) / POWER_MW - 1)) for name, fan in FANS.items()),
        BAR.row("power a Lambertian plane reflects, summed over the picture", "albedo times power",
             abs(reflected_power() / (FLOOR_ALBEDO * POWER_MW) - 1)),
        BAR.row("white furnace: convex white surface in uniform light", "the light's radiance",
             furnace_deviation()),
        BAR.row("Fresnel at a face, R + T - 1", "Mitsuba's own Fresnel reflectance",
             fresnel_deviation()),
    ]  # fmt: skip
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
        slope = np.array(sheet.slope(mi.Float(phi.astype(np.float32)))) if sheet.is_bowed else 0
        s = np.linspace(-8, 8, 1601)
        p, offset = np.meshgrid(phi, s)
        rise = offset + RADIUS_MM * slope
        points = _in_sheet(sheet, RADIUS_MM * np.sin(p), rise, RADIUS_MM * np.cos(p))
        values = np.array(sheet.irradiance(points, mi.Float(0.0)), dtype=float)
        total += float(values.sum() * RADIUS_MM * (phi[1] - phi[0]) * (s[1] - s[0]))
    return total


def _in_sheet(sheet: Any, lateral: Floats, offset: Floats, depth: Floats) -> mi.Point3f:
    """World points of a sheet's coordinates, mm."""
    x, y, z = (mi.Float(v.ravel().astype(np.float32)) for v in (lateral, offset, depth))
    return sheet.apex(mi.Float(0.0)) + sheet.across * x + sheet.normal * y + sheet.axis * z


def floor_scene() -> Scene:
    """A level floor beneath, seen from above at a slant; water that takes no light."""
    return scene_with(
        head={"camera_mm": [0.0, -700.0, 300.0], "depression_deg": 45.0},
        floor={"z_mm": FLOOR_Z_MM, "albedo": FLOOR_ALBEDO},
        laser={
            "power_mw": POWER_MW, "apex_mm": [0.0, 0.0, 250.0], "fan_half_angle_deg": 15.0,
            "waist_mm": 3.0, "waist_distance_mm": 650.0,
        },
    )  # fmt: skip


def reflected_power() -> float:
    """mW that the floor reflects, from the picture: pi L over the area each pixel sees."""
    scene = floor_scene()
    layers = Tank(scene).render(0.0)
    area, weight = _floor_areas_mm2(scene)
    in_water = layers.direct.astype(float) / weight  # W/(m2 sr), before port and lens
    return float(np.pi * 1e-3 * np.sum(in_water * area))


def _floor_areas_mm2(scene: Scene) -> tuple[Floats, Floats]:
    """(H, W) mm2 of the floor that each pixel sees, and the weight of its ray."""
    camera = scene.rig.camera
    shape = camera.height_px, camera.width_px
    v, u = np.indices((shape[0] + 1, shape[1] + 1)) - 0.5
    corners = closed_form_rays(scene, np.column_stack([u.ravel(), v.ravel()]))
    places = _on_floor(corners[0], corners[1]).reshape(shape[0] + 1, shape[1] + 1, 2)
    one, two = places[1:, 1:] - places[:-1, :-1], places[1:, :-1] - places[:-1, 1:]
    area = 0.5 * np.abs(one[..., 0] * two[..., 1] - one[..., 1] * two[..., 0])
    v, u = np.indices(shape, dtype=float)
    weight = closed_form_rays(scene, np.column_stack([u.ravel(), v.ravel()]))[2]
    return area, weight.reshape(shape)


def _on_floor(origins: Floats, directions: Floats) -> Floats:
    """(N, 2) of (x, y) mm where rays meet the floor."""
    path = (FLOOR_Z_MM - origins[:, 2]) / directions[:, 2]
    return (origins + path[:, np.newaxis] * directions)[:, :2]


def furnace_deviation() -> float:
    """Largest relative deviation of a white floor's picture from the uniform light's radiance.

    The floor reflects 1 and the water takes nothing, so each pixel shows the light's radiance
    L, weighed by its ray's transmission over the squared index.
    """
    scene = scene_with(
        head={"camera_mm": [0.0, -700.0, 300.0], "depression_deg": 45.0},
        floor={"z_mm": FLOOR_Z_MM, "albedo": 1.0},
        laser={"on": False},
        light={"ambient_w_m2_sr": AMBIENT},
    )
    seen = Tank(scene).render(0.0).ambient.astype(float)
    v, u = np.indices(seen.shape, dtype=float)
    weight = closed_form_rays(scene, np.column_stack([u.ravel(), v.ravel()]))[2]
    return float(np.abs(seen.ravel() / (AMBIENT * weight) - 1).max())


def fresnel_deviation() -> float:
    """Largest |R + T - 1| over angles and index ratios, R Mitsuba's and T the camera's."""
    cosine, ratio = np.meshgrid(np.cos(np.radians(np.arange(0, 85, 0.5))), (0.9, 1.12, 1.33, 1.49))
    cos_in, eta = (mi.Float(v.ravel().astype(np.float32)) for v in (cosine, ratio))
    reflected, cos_out, _, _ = mi.fresnel(cos_in, eta)
    there = np.array(reflected) < 1  # beyond, the ray is reflected whole and no camera's
    passed = np.array(fresnel_transmission(cos_in, abs(cos_out), eta))
    return float(np.abs(np.array(reflected) + passed - 1)[there].max())
