"""The sensor's realised noise and radiometry against what is declared for it."""

from dataclasses import fields
from math import pi, sqrt
from typing import Any, Literal

import numpy as np

from lscan.records import Floats
from sim.render.layers import Layers
from sim.render.tank import Tank
from sim.scene import PlanePort, Scene
from sim.sensor import Webcam
from sim.sensor.radiometry import speckle_contrast
from sim.water import water_optics
from tests.validation.light.rigs import reference, scene_with, topic
from tests.validation.rows import Row, Topic, row

SEED = 53
EXPOSURE_MS = 20.0
FULL_SCALE_DN = 255.0
STANDARD_ERRORS = 3.0
PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299792458.0  # exact, SI 2019
LIGHTS: tuple[Literal["polarised", "depolarised"], ...] = ("polarised", "depolarised")
NM, DEEP_WELL_E = 650.0, 1e6
PLAIN_LENS = {"blur_px": 0.0, "vignetting": 0.0, "f_number": 2.8, "transmission": 0.85}


def sensor() -> Topic:
    """Mean, variance and speckle contrast of flat fields, and a Lambertian plane on paper."""
    return topic("sensor", rows=(*_noise_rows(), *_speckle_rows(), plane_row()))


def flat_field(scene: Scene, electrons: float) -> Floats:
    """(H, W) digital numbers of even laser light that frees so many electrons in each pixel."""
    camera = scene.rig.camera
    dark = np.zeros((camera.height_px, camera.width_px), np.float32)
    layers = {field.name: dark for field in fields(Layers)}
    efficiency = scene.tank.sensor.laser_response.red
    radiance = electrons / (photons(scene, 1.0, scene.tank.laser.wavelength_nm) * efficiency)
    return expose(scene, Layers(**layers | {"direct": dark + np.float32(radiance)}))


def photons(scene: Scene, radiance: float, wavelength_nm: float) -> float:
    """Photons a pixel on the axis collects from a radiance in W/(m2 sr).

    Irradiance pi L T / (4 N2) (the camera equation, e.g. Born & Wolf sec. 4.8), times the
    pixel's area, the time and the photons in a joule.
    """
    lens, pixel_um = scene.tank.lens, scene.tank.sensor.pixel_um
    irradiance = pi * radiance * lens.transmission / (4 * lens.f_number**2)
    joules = irradiance * (pixel_um * 1e-6) ** 2 * EXPOSURE_MS * 1e-3
    return joules / (PLANCK_J_S * LIGHT_M_S / (wavelength_nm * 1e-9))


def expose(scene: Scene, layers: Layers) -> Floats:
    """(H, W) digital numbers of the red channel."""
    image = Webcam(scene).expose(layers, EXPOSURE_MS, np.random.default_rng(SEED))
    return image[..., 0].astype(float)


def _noise_rows() -> list[Row]:
    scene = scene_with(
        lens=PLAIN_LENS,
        sensor={"prnu": 0.01, "dark_noise_e": 53.0, "dsnu_e": 40.0, "full_well_e": 15000.0},
    )
    worst = np.max([noise_deviations(scene, share) for share in (0.05, 0.3, 0.7)], axis=0)
    camera = scene.rig.camera
    words: dict[str, Any] = {"pixels": camera.width_px * camera.height_px, "seed": SEED}
    return [
        row("noise-of-flat-fields", float(figure), bar=STANDARD_ERRORS, name=name, **words)
        for name, figure in zip(("mean", "variance"), worst, strict=True)
    ]


def noise_deviations(scene: Scene, share: float) -> tuple[float, float]:
    """How many standard errors mean and variance lie from the model's, at a share of the well.

    Variance: shot, dark noise, PRNU, DSNU and 1/12 DN2 of rounding; standard errors of N
    pixels: sigma / sqrt(N), and sigma2 sqrt(2/N).
    """
    model = scene.tank.sensor
    electrons, gain = share * model.full_well_e, FULL_SCALE_DN / model.full_well_e
    image = flat_field(scene, electrons)
    own = electrons + model.dark_noise_e**2 + (model.prnu * electrons) ** 2 + model.dsnu_e**2
    variance = gain**2 * own + 1 / 12
    mean = model.black_level_dn + gain * electrons
    count = image.size
    return (
        abs(image.mean() - mean) / sqrt(variance / count),
        abs(image.var() - variance) / (variance * sqrt(2 / count)),
    )


def _speckle_rows() -> list[Row]:
    rows = []
    pixels, numbers, *published = np.array(reference("sensor")["speckle"]).T
    cameras = list(zip(pixels, numbers, strict=True))
    for light, rounded in zip(LIGHTS, published, strict=True):
        declared = [speckle_contrast(pixel, number, NM, light) for pixel, number in cameras]
        realised = [
            contrast_errors(*camera, light, contrast)
            for camera, contrast in zip(cameras, declared, strict=True)
        ]
        off = float(np.abs(declared - rounded).max())
        rows += [
            row("speckle-declared", off, light=light),
            row("speckle-realised", max(realised), bar=STANDARD_ERRORS, seed=SEED, light=light),
        ]
    return rows


def contrast_errors(pixel_um: float, f_number: float, light: str, contrast: float) -> float:
    """How many standard errors a flat field's speckle lies from its contrast.

    Of N draws of a gamma law of contrast C the sample's contrast has the relative standard
    error sqrt((1 + C2) / (2 N)): the variance's, its excess kurtosis 6 C2 counted, and the
    mean's, which goes with it.  A large full well leaves the light's own statistics: shot noise
    and the rounding are taken from the variance as declared.
    """
    scene = scene_with(
        lens={**PLAIN_LENS, "f_number": f_number},
        laser={"wavelength_nm": NM},
        sensor={
            "pixel_um": pixel_um, "full_well_e": DEEP_WELL_E, "dark_noise_e": 0.0, "prnu": 0.0,
            "speckle": light, "black_level_dn": 0.0,
        },
    )  # fmt: skip
    # At a tenth of the full well hardly any speckle is brighter than ten times the mean.
    electrons, gain = 0.1 * DEEP_WELL_E, FULL_SCALE_DN / DEEP_WELL_E
    image = flat_field(scene, electrons)
    found = sqrt(image.var() - gain**2 * electrons - 1 / 12) / image.mean()
    return abs(found / contrast - 1) / sqrt((1 + contrast**2) / (2 * image.size))


def plane_row() -> Row:
    """A Lambertian plane square to the fan's axis, seen on the camera's axis: DN on paper."""
    scene = plane_scene()
    found = float(expose(scene, Tank(scene).render(0.0))[CENTRE])
    return row("lambertian-plane", abs(found / plane_on_paper(scene) - 1))


CAMERA_DISTANCE_MM, DEPRESSION_DEG = 700.0, 60.0  # from the line on the plane
GLASS_INDEX = 1.49
CENTRE = (240, 320)  # row and column of the pixel on the axis


def plane_scene() -> Scene:
    """A level floor through the origin, the fan straight above, the camera's axis on the line."""
    lean = np.radians(DEPRESSION_DEG)
    back, height = CAMERA_DISTANCE_MM * np.cos(lean), CAMERA_DISTANCE_MM * np.sin(lean)
    return scene_with(
        "plane",
        lens={**PLAIN_LENS, "centre_px": list(CENTRE[::-1])},
        port={"glass_index": GLASS_INDEX},
        head={"camera_mm": [0.0, -float(back), float(height)], "depression_deg": DEPRESSION_DEG},
    )


def plane_on_paper(scene: Scene) -> float:
    """Digital number of the pixel on the axis, worked out without the renderer.

    The sheet's irradiance at its middle, P / (2 phi) / rho sqrt(2/pi) / w; a Lambertian
    plane's radiance rho E / pi; both legs' absorption; Fresnel at normal incidence on both
    faces; radiance over the squared index; the camera equation.
    """
    laser, port, model = scene.tank.laser, scene.tank.port, scene.tank.sensor
    floor, absorption_per_m = scene.tank.floor, scene.tank.water.absorption_per_m
    assert isinstance(port, PlanePort) and floor is not None and absorption_per_m is not None
    index = water_optics(scene.tank.water, laser.wavelength_nm).index
    _, _, apex_mm = laser.apex_mm
    fan = laser.power_mw / (2 * np.radians(laser.fan_half_angle_deg)) / apex_mm
    irradiance_w_m2 = 1e3 * fan * sqrt(2 / pi) / laser.waist_mm
    in_water_mm = CAMERA_DISTANCE_MM - port.gap_mm - port.thickness_mm + apex_mm
    in_water = floor.albedo * irradiance_w_m2 / pi
    in_water *= np.exp(-absorption_per_m * 1e-3 * in_water_mm)
    outer = 1 - ((GLASS_INDEX - 1) / (GLASS_INDEX + 1)) ** 2
    inner = 1 - ((GLASS_INDEX - index) / (GLASS_INDEX + index)) ** 2
    in_air = float(in_water * outer * inner / index**2)
    electrons = photons(scene, in_air, laser.wavelength_nm) * model.laser_response.red
    return FULL_SCALE_DN / model.full_well_e * electrons
