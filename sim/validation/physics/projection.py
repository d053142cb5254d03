"""The truth's projection against published values, the camera plugin and traced glass."""

from __future__ import annotations

import numpy as np

from lscan.records import Floats
from sim.scene import Scene
from sim.truth import project
from sim.validation.physics.ports import Rays, closed_form_rays, traced_rays
from sim.validation.physics.refraction import tangents
from sim.validation.physics.rigs import random_pixels, random_rig
from sim.validation.physics.topics import topic
from sim.validation.rows import Bar, Row, Topic

# r, z in mm and the tangent in air: 10 mm of air, 6 mm of glass, n = 1 / 1.49 / 1.3313.
PUBLISHED = np.array(
    [
        (300.0, 1000.0, 0.412659913867),
        (50.0, 1000.0, 0.066450567346),
        (400.0, 500.0, 1.454784819992),
        (800.0, 1000.0, 1.475503390053),
    ]
)
NEAREST_MM, FARTHEST_MM = 200.0, 2500.0
PIXELS = 200
SEED = 31
PIXEL = Bar(0.005, "px", "required of the tank; single precision costs up to 3e-3", SEED)
TANGENT = Bar(1e-10, "tangent", "the check values are given to twelve decimals")


def projection(rigs: int) -> Topic:
    """The truth's pixels of points on the rays of both cameras, over so many random rigs."""
    ways = {"the camera plugin": closed_form_rays, "traced glass": traced_rays}
    rows = [
        PIXEL.row(
            f"projection of points seen by {name}, {kind} port",
            f"{name}, {rigs} random rigs of {PIXELS} pixels",
            max(_rig_errors(kind, rays, rigs)),
        )
        for kind in ("flat", "dome")
        for name, rays in ways.items()
    ]
    return topic("projection", rows=(_published_row(), *rows))


def _published_row() -> Row:
    r, z, tangent = PUBLISHED.T
    return TANGENT.row(
        "tangent in air to four points behind a flat port",
        "published check values of the port's equation",
        float(np.abs(tangents(r, z) - tangent).max()),
    )


def _rig_errors(kind: str, rays_of: Rays, rigs: int) -> list[float]:
    generator = np.random.default_rng(SEED)
    errors = []
    for _ in range(rigs):
        scene = random_rig(generator, kind)
        pixels = random_pixels(generator, scene, PIXELS)
        reach = generator.uniform(NEAREST_MM, FARTHEST_MM, (PIXELS, 1))
        errors.append(_back_error(scene, pixels, rays_of, reach))
    return errors


def _back_error(scene: Scene, pixels: Floats, rays_of: Rays, reach: Floats) -> float:
    """Largest distance in px from the pixels; infinite where the truth finds no image."""
    origins, directions, _ = rays_of(scene, pixels)
    back = project(scene, origins + reach * directions)
    errors = np.linalg.norm(back - pixels, axis=1)
    return float(np.where(np.isfinite(errors), errors, np.inf).max())
