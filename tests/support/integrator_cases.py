"""Scenes, renders and statistical comparisons of integrators."""

from typing import Any

import mitsuba as mi
import numpy as np
from scipy.stats import t as student
from truth_scenes import tank as scene_with

from lscan.config.documents import Document, merge
from lscan.records import Floats
from sim.render.plugins.sheet import LaserSheet
from sim.render.tank import Tank
from sim.scene import Laser, Pose, Scene
from sim.water import HenyeyGreensteinMixture, Optics

INDEX, NM = 1.33, 650.0
# A floor under a sheet so thick that chance finds it, for references to converge.
THICK_SHEET: Document = {
    "camera": {"width_px": 16, "height_px": 16},
    "lens": {"focal_px": 14.0, "centre_px": [7.5, 7.5]},
    "head": {"camera_mm": [0.0, -450.0, 150.0], "depression_deg": 35.0},
    "laser": {
        "power_mw": 10.0, "apex_mm": [0.0, 0.0, 300.0], "waist_mm": 60.0,
        "fan_half_angle_deg": 45.0,
    },
    "floor": {"z_mm": -300.0, "albedo": 0.5},
}  # fmt: skip
LEVEL = 1e-3  # chance of a false alarm in all parts of a comparison together


RUNS = 16


def one_lobe(absorption: float, scattering: float, g: float) -> Optics:
    """Water of one Henyey-Greenstein lobe, coefficients per mm."""
    lobe = HenyeyGreensteinMixture((1.0,), (g,))
    return Optics(INDEX, absorption, scattering, lobe, molecular_weight=0.0)


DRY = one_lobe(0.0, 0.0, 0.0)


def render(tank: Tank, camera: mi.Sensor, integrator: Any, samples: int, seeds: range) -> Floats:
    """(runs, H, W) independent pictures; a dictionary is a stock integrator's description."""
    if isinstance(integrator, dict):
        integrator = mi.load_dict(integrator)
    pictures = [
        np.array(
            mi.render(
                tank.mitsuba_scene, sensor=camera, integrator=integrator, spp=samples, seed=seed
            )
        )[..., 0]
        for seed in seeds
    ]
    return np.array(pictures, dtype=float)


def parts(pictures: Floats, count: int) -> Floats:
    """(runs, count) sums over strips of columns, as wide as each other."""
    columns = pictures.sum(axis=1)
    return columns.reshape(len(columns), count, -1).sum(axis=-1)


def differ(ours: Floats, theirs: Floats) -> bool:
    """Whether two sets of runs, (R, K) of K parts each, have different means in any part.

    Welch's t test, each set with its own variance, at a LEVEL that holds for all parts
    together (Sidak 1967).
    """
    a, b = ours.var(axis=0, ddof=1) / len(ours), theirs.var(axis=0, ddof=1) / len(theirs)
    assert np.all(a + b > 0), "every part must hold light"
    z = (ours.mean(axis=0) - theirs.mean(axis=0)) / np.sqrt(a + b)
    degrees = (a + b) ** 2 / (a**2 / (len(ours) - 1) + b**2 / (len(theirs) - 1))
    each = 1 - (1 - LEVEL) ** (1 / len(z))
    return bool(np.any(np.abs(z) > student.isf(each / 2, degrees)))


def make_sheet(laser: Laser, pose: Pose | None = None) -> LaserSheet:
    """The laser's only sheet, its head at ``pose``."""
    sheet = LaserSheet(mi.Properties())
    sheet.configure(laser, laser.sheets[0], INDEX, NM)
    sheet.place(pose or Pose(np.eye(3), np.zeros(3)))
    return sheet


def groove_scene() -> Scene:
    """The middle groove of the block close by, a sheet 8 mm thick across it."""
    return scene_with(
        camera={"width_px": 32, "height_px": 24},
        lens={"focal_px": 110.0, "centre_px": [15.5, 11.5]},
        head={"camera_mm": [0.0, -200.0, 130.0], "depression_deg": 50.0},
        laser={
            "power_mw": 10.0, "apex_mm": [0.0, 0.0, 200.0], "waist_mm": 4.0,
            "fan_half_angle_deg": 20.0,
        },
        workpiece={"kind": "grooved-block"},
        target={"shape": "workpiece", "position_mm": [-104.0, 0.0, -150.0], "albedo": 0.7},
    )  # fmt: skip


def floor_scene(**sections: Document) -> Scene:
    """The thick sheet over its floor with sections laid over it."""
    return scene_with(**merge(THICK_SHEET, sections))
