"""Pictures of one scene taken over and over: rendered once, exposed with many seeds.

The light is the same each time; speckle, shot noise and reading noise are drawn anew.  That is
what an uncertainty speaks of, at the cost of one render.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq

from lscan.calibration.planemap import PlaneMap
from lscan.config.rig import StripeSection
from lscan.records import Floats, Picture, Profile, Stripe
from lscan.stripe import extract_stripe
from lscan.surface.surface import to_profile
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import Scene
from sim.sensor import Webcam
from sim.sensor.radiometry import speckle_contrast

STREAM = 4  # of the generators: streams 0 to 3 are the sensor's own


@dataclass(frozen=True)
class ScanReading:
    """The line of one exposure in all frames of a scan: where the head stood, and the stripes."""

    positions_mm: tuple[float, ...]
    stripes: tuple[Stripe, ...]

    def profiles(self, plane_map: PlaneMap) -> list[Profile]:
        """The stripes in the plane of the sheet, one for each position."""
        return [
            to_profile(stripe, plane_map, position)
            for stripe, position in zip(self.stripes, self.positions_mm, strict=True)
        ]


def pictures(scene: Scene, layers: Layers, seeds: Iterable[int]) -> list[Picture]:
    """One picture, (H, W, 3), of the same light for each seed."""
    return [expose(webcam_of(scene, seed), layers, scene, (seed, 0)) for seed in seeds]


def read_scan(
    scene: Scene, positions_mm: Sequence[float], seeds: Sequence[int], stripe: StripeSection
) -> list[ScanReading]:
    """The scan's stripes once for each seed; each position is rendered only once."""
    tank, webcams = Tank(scene), [webcam_of(scene, seed) for seed in seeds]
    found: list[list[Stripe]] = [[] for _ in seeds]
    for number, position in enumerate(positions_mm):
        layers = tank.render(position)
        for seed, webcam, stripes in zip(seeds, webcams, found, strict=True):
            image = expose(webcam, layers, scene, (seed, number))
            stripes.append(extract_stripe(image, stripe))
    return [ScanReading(tuple(positions_mm), tuple(stripes)) for stripes in found]


def webcam_of(scene: Scene, seed: int) -> Webcam:
    """The scene's webcam with a sensor of its own: its fixed pattern is one of many too."""
    return Webcam(scene.with_tank(sensor={"seed": seed}))


def expose(webcam: Webcam, layers: Layers, scene: Scene, stream: tuple[int, int]) -> Picture:
    generator = np.random.default_rng([STREAM, *stream])
    return webcam.expose(layers, scene.rig.camera.exposure_ms, generator)


def with_contrast(scene: Scene, contrast: float) -> Scene:
    """The scene with the aperture at which depolarised speckle has this contrast in a pixel.

    The lamps and the laser make up for the light that the aperture takes, so that grey values
    stay; 0 switches speckle off.  Where the rig states the contrast, it states this one.
    """
    tank, stripe = scene.tank, scene.rig.stripe
    if stripe.noise is not None:
        noise = stripe.noise.model_copy(update={"speckle": contrast})
        rig = scene.rig.model_copy(update={"stripe": stripe.model_copy(update={"noise": noise})})
        scene = replace(scene, rig=rig)
    if contrast == 0:
        return scene.with_tank(sensor={"speckle": "none"})

    def excess(f_number: float) -> float:
        pixel, nm = tank.sensor.pixel_um, tank.laser.wavelength_nm
        return speckle_contrast(pixel, f_number, nm, "depolarised") - contrast

    f_number = float(brentq(excess, 0.5, 32.0))
    light = (f_number / tank.lens.f_number) ** 2
    return scene.with_tank(
        lens={"f_number": f_number},
        sensor={"speckle": "depolarised"},
        laser={"power_mw": tank.laser.power_mw * light},
        light={"ambient_w_m2_sr": tank.light.ambient_w_m2_sr * light},
    )


# How often 95 % intervals contain the truth.


COVER = 1.959964  # standard deviations on either side that hold 95 % of a normal distribution


def share_inside(error: Floats, sigma: Floats) -> float:
    """Share of the errors, any shape, that lie within 1.96 of their sigmas."""
    return float(np.mean(np.abs(error) <= COVER * sigma))


def band_miss_percent(share: float) -> float:
    """How far a share is from 95 %, in percentage points: at most 2 is asked for."""
    return 100 * abs(share - 0.95)
