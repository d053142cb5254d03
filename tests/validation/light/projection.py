"""The truth's projection against check values, the camera plugin and traced glass."""

from typing import Any

import numpy as np

from sim.truth import project
from tests.validation.light.ports import Rays, closed_form_rays, traced_rays
from tests.validation.light.refraction import tangents
from tests.validation.light.rigs import random_pixels, random_rig, reference, topic
from tests.validation.rows import Topic, row

NEAREST_MM, FARTHEST_MM = 200.0, 2500.0
PIXELS = 200
SEED = 31


def projection(rigs: int) -> Topic:
    """The truth's pixels of points on the rays of both cameras, over so many random rigs."""
    ways = {"the camera plugin": closed_form_rays, "traced glass": traced_rays}
    words: dict[str, Any] = {"seed": SEED, "rigs": rigs, "pixels": PIXELS}
    rows = [
        row("projection", max(_rig_errors(kind, rays, rigs)), name=name, kind=kind, **words)
        for kind in ("flat", "dome")
        for name, rays in ways.items()
    ]
    r, z, tangent = np.array(reference("projection")["tangents"]).T
    checked = row("projection-published", float(np.abs(tangents(r, z) - tangent).max()))
    return topic("projection", rows=(checked, *rows))


def _rig_errors(kind: str, rays_of: Rays, rigs: int) -> list[float]:
    """For each rig the largest distance in px at which the truth finds a point from its pixel.

    Infinite where the truth finds no image of the point.
    """
    generator = np.random.default_rng(SEED)
    largest = []
    for _ in range(rigs):
        scene = random_rig(generator, kind)
        pixels = random_pixels(generator, scene, PIXELS)
        reach = generator.uniform(NEAREST_MM, FARTHEST_MM, (PIXELS, 1))
        origins, directions, _ = rays_of(scene, pixels)
        errors = np.linalg.norm(project(scene, origins + reach * directions) - pixels, axis=1)
        largest.append(float(np.where(np.isfinite(errors), errors, np.inf).max()))
    return largest
