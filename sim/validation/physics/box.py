"""A closed box: light of all orders in it is a geometric series."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.plugins.arrays import vectors
from sim.render.tank import Tank
from sim.scene import Scene
from sim.validation.physics.rigs import scene_with
from sim.validation.physics.topics import topic
from sim.validation.rows import Topic, row
from sim.water import water_optics

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
    words = {"error": error, "batches": batches, "rays": rays}
    return topic("closed-box", [row("closed-box", figure, seed=SEED, **words)])


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
