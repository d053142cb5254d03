"""Absolute radiometry through the whole chain: electrons on paper against a rendered tank.

The camera looks straight down through its port at a Lambertian floor in clear water.
"""

import numpy as np
import pytest
from places import SCENES

from lscan.config.rig import parse_rig
from sim.render.tank import Tank
from sim.scene import Scene, load_scene, scene_of
from sim.sensor import Webcam

PAPER = SCENES / "paper"
EXPOSURE_MS, F_NUMBER, LENS_T, PIXEL_M, FOCAL_PX = 10.0, 2.8, 0.85, 6e-6, 400.0
# Quan & Fry at 20 C, 650 nm (docs/explanation/physics.md, section 1); PMMA
WATER, GLASS = 1.331324, 1.488
DEPTH_MM, GAP_MM, GLASS_MM, ALBEDO = 600.0, 10.0, 6.0, 0.3
POWER_W, HALF_FAN_DEG = 5e-3, 30.0
JOULE_METRE = 6.62607015e-34 * 299792458  # h c


def floor_scene(laser_on: bool, lamp: float) -> Scene:
    """Camera and laser at the head's origin over the floor; no distortion, no losses in water."""
    document = dict(load_scene(PAPER / "board.toml").document)
    document["camera"] = {**document["camera"], "width_px": 41, "height_px": 61}
    document["lens"] = {
        "focal_px": FOCAL_PX, "centre_px": [20.0, 30.0], "f_number": F_NUMBER,
        "transmission": LENS_T,
    }  # fmt: skip
    document["head"] = {"camera_mm": [0.0, 0.0, 0.0], "depression_deg": 89.9999}
    document["port"] = {"gap_mm": GAP_MM, "thickness_mm": GLASS_MM, "glass_index": GLASS}
    document["laser"] = {
        "on": laser_on, "power_mw": POWER_W * 1e3, "wavelength_nm": 650.0,
        "apex_mm": [0.0, 0.0, 0.0], "fan_half_angle_deg": HALF_FAN_DEG,
    }  # fmt: skip
    document["water"] = {"absorption_per_m": 0.0, "scattering_per_m": 0.0}
    document["light"] = {"ambient_w_m2_sr": lamp}
    document["target"] = {"shape": "none"}
    document["floor"] = {"z_mm": -DEPTH_MM, "albedo": ALBEDO}
    document["render"] = {"samples": 16, "scatter_samples": 0}
    return scene_of(parse_rig(document, source="paper"))


def photons(radiance: float, wavelength_m: float) -> float:
    """Of radiance in W/(m2 sr) in front of the lens, into a pixel on the axis."""
    irradiance = np.pi * LENS_T / (4 * F_NUMBER**2) * radiance
    return irradiance * PIXEL_M**2 * EXPOSURE_MS * 1e-3 * wavelength_m / JOULE_METRE


def port_transmission() -> float:
    """Of radiance, straight through: Fresnel at both faces, over the square of the index."""
    faces = [((a - b) / (a + b)) ** 2 for a, b in ((1.0, GLASS), (GLASS, WATER))]
    return (1 - faces[0]) * (1 - faces[1]) / WATER**2


def test_a_floor_under_a_lamp() -> None:
    """Light of 0.3 W/(m2 sr) from everywhere leaves a floor of albedo 0.3 with 0.09; 1 %."""
    scene = floor_scene(laser_on=False, lamp=0.3)
    electrons = Webcam(scene).mean_electrons(Tank(scene).render(0.0), EXPOSURE_MS)
    expected = 0.33 * photons(0.3 * ALBEDO * port_transmission(), 550e-9)
    assert electrons[30, 20, 1] == pytest.approx(expected, rel=0.01)


def test_a_laser_line_on_the_floor() -> None:
    """All electrons of a column: the line's power per length, however wide it is; 1 %.

    P f/rho falls on every metre of the line, albedo/pi of it leaves per steradian.  A metre
    across the line spans f_px / D rows, D = gap + glass/n_g + water/n_w being the apparent
    distance straight ahead, where gap and glass stand before the floor's depth.
    """
    scene = floor_scene(laser_on=True, lamp=0.0)
    layers = Tank(scene).render(0.0)
    electrons = Webcam(scene).mean_electrons(layers, EXPOSURE_MS)[:, 20, 0]
    water_mm = DEPTH_MM - GAP_MM - GLASS_MM
    apparent_m = 1e-3 * (GAP_MM + GLASS_MM / GLASS + water_mm / WATER)
    fan = 1 / np.radians(2 * HALF_FAN_DEG)
    across = POWER_W * fan / (DEPTH_MM * 1e-3) * ALBEDO / np.pi  # W/(m sr), along y
    rows = FOCAL_PX / apparent_m
    expected = 0.40 * photons(across * port_transmission() * rows, 650e-9)
    assert electrons.sum() == pytest.approx(expected, rel=0.01)
