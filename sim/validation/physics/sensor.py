"""The sensor's realised noise and radiometry against what is declared for it."""

from __future__ import annotations

from dataclasses import fields
from math import pi, sqrt
from typing import Literal

import numpy as np

from lscan.records import Floats
from sim.render.tank import Layers, Tank
from sim.scene import PlanePort, Scene
from sim.sensor import Webcam
from sim.sensor.speckle import speckle_contrast
from sim.validation.physics.rigs import scene_with
from sim.validation.physics.topics import topic
from sim.validation.rows import Bar, Row, Topic
from sim.water import water_optics

SEED = 53
CONTRAST = Bar(0.005, "contrast", "half of the last digit given")
PLANE = Bar(0.01, "relative", "required of the tank; rounding to 8 bits costs 0.25 %")
EXPOSURE_MS = 20.0
FULL_SCALE_DN = 255.0
STANDARD_ERRORS = 3.0
PLANCK_J_S, LIGHT_M_S = 6.62607015e-34, 299792458.0  # exact, SI 2019
# Pixel in um, f-number: contrast of polarised and of depolarised light (Goodman 2007).
SPECKLE = (
    (6.0, 2.0, 0.22, 0.15),
    (6.0, 2.8, 0.29, 0.21),
    (4.2, 2.0, 0.30, 0.21),
    (4.2, 2.8, 0.39, 0.28),
    (3.0, 2.0, 0.39, 0.28),
    (3.0, 2.8, 0.51, 0.36),
)
LIGHTS: tuple[Literal["polarised", "depolarised"], ...] = ("polarised", "depolarised")
NM, DEEP_WELL_E = 650.0, 1e6
PLAIN_LENS = {"blur_px": 0.0, "vignetting": 0.0, "f_number": 2.8, "transmission": 0.85}


def sensor() -> Topic:
    """Mean, variance and speckle contrast of flat fields, and a Lambertian plane on paper."""
    return topic("sensor", rows=(*_noise_rows(), *_speckle_rows(), plane_row()))


def flat_field(scene: Scene, radiance: float, layer: str) -> Layers:
    """A picture that shows one radiance in W/(m2 sr) everywhere, in one layer."""
    camera = scene.rig.camera
    dark = np.zeros((camera.height_px, camera.width_px), np.float32)
    names = [field.name for field in fields(Layers)]
    return Layers(**{name: dark + np.float32(radiance * (name == layer)) for name in names})


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
    results = [noise_deviations(scene, share) for share in (0.05, 0.3, 0.7)]
    camera = scene.rig.camera
    bar = _within_errors(f"{camera.width_px * camera.height_px} pixels")
    return [
        bar.row(
            f"{name} of flat fields at 5, 30 and 70 % of the full well",
            "EMVA 1288 linear model",
            max(result[k] for result in results),
        )
        for k, name in enumerate(("mean", "variance"))
    ]


def _within_errors(of: str) -> Bar:
    return Bar(STANDARD_ERRORS, "standard errors", f"three standard errors of {of}", SEED)


def noise_deviations(scene: Scene, share: float) -> tuple[float, float]:
    """How many standard errors mean and variance lie from the model's, at a share of the well.

    Variance: shot, dark noise, PRNU, DSNU and 1/12 DN2 of rounding; standard errors of N
    pixels: sigma / sqrt(N), and sigma2 sqrt(2/N).
    """
    model = scene.tank.sensor
    wavelength = scene.tank.laser.wavelength_nm
    efficiency = model.laser_response.red
    radiance = share * model.full_well_e / (photons(scene, 1.0, wavelength) * efficiency)
    image = expose(scene, flat_field(scene, radiance, "direct"))
    electrons, gain = share * model.full_well_e, FULL_SCALE_DN / model.full_well_e
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
    for column, light in enumerate(LIGHTS):
        declared = [speckle_contrast(pixel, number, NM, light) for pixel, number, *_ in SPECKLE]
        published = [values[column] for _, _, *values in SPECKLE]
        realised = [
            contrast_errors(pixel, number, light, contrast)
            for (pixel, number, *_), contrast in zip(SPECKLE, declared, strict=True)
        ]
        rows += [
            CONTRAST.row(
                f"declared speckle contrast of six cameras, {light}",
                "Goodman's integral, published to two decimals",
                max(abs(a - b) for a, b in zip(declared, published, strict=True)),
            ),
            _within_errors("a gamma law's contrast over the picture").row(
                f"realised speckle contrast of six cameras, {light}",
                "the declared contrast",
                max(realised),
            ),
        ]
    return rows


def contrast_errors(pixel_um: float, f_number: float, light: str, contrast: float) -> float:
    """How many standard errors a flat field's speckle lies from its contrast.

    Of N draws of a gamma law of contrast C the sample's contrast has the relative standard
    error sqrt((1 + C2) / (2 N)): the variance's, its excess kurtosis 6 C2 counted, and the
    mean's, which goes with it.
    """
    found, count = realised_contrast(pixel_um, f_number, light)
    return abs(found / contrast - 1) / sqrt((1 + contrast**2) / (2 * count))


def realised_contrast(pixel_um: float, f_number: float, light: str) -> tuple[float, int]:
    """Standard deviation over mean of a flat field of laser light, and its count of pixels.

    A large full well leaves the light's own statistics: shot noise and the rounding are
    taken from the variance as declared.
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
    electrons = 0.1 * DEEP_WELL_E
    radiance = electrons / (photons(scene, 1.0, NM) * scene.tank.sensor.laser_response.red)
    image = expose(scene, flat_field(scene, radiance, "direct"))
    gain = FULL_SCALE_DN / DEEP_WELL_E
    return sqrt(image.var() - gain**2 * electrons - 1 / 12) / image.mean(), image.size


def plane_row() -> Row:
    """A Lambertian plane square to the fan's axis, seen on the camera's axis: DN on paper."""
    expected, found = plane_on_paper(), plane_rendered()
    return PLANE.row(
        "Lambertian plane in the laser sheet, milliwatts to digital numbers",
        "camera equation and sheet irradiance on paper",
        abs(found / expected - 1),
    )


APEX_HEIGHT_MM, CAMERA_DISTANCE_MM = 650.0, 700.0  # from the line on the plane
PLANE_ALBEDO, PLANE_ABSORPTION_PER_M, GLASS_INDEX = 0.4, 0.4, 1.49
DEPRESSION_DEG = 60.0
CENTRE = (240, 320)  # row and column of the pixel on the axis


def plane_scene() -> Scene:
    """A level floor through the origin, the fan straight above, the camera's axis on the line.

    The sheet is 20 mm wide: over the 1 mm a pixel sees it falls by 0.03 % of its peak.
    """
    lean = np.radians(DEPRESSION_DEG)
    back, height = CAMERA_DISTANCE_MM * np.cos(lean), CAMERA_DISTANCE_MM * np.sin(lean)
    return scene_with(
        lens={**PLAIN_LENS, "centre_px": list(CENTRE[::-1])},
        port={"glass_index": GLASS_INDEX},
        head={"camera_mm": [0.0, -float(back), float(height)], "depression_deg": DEPRESSION_DEG},
        floor={"z_mm": 0.0, "albedo": PLANE_ALBEDO},
        laser={
            "power_mw": 60.0, "apex_mm": [0.0, 0.0, APEX_HEIGHT_MM], "waist_mm": 20.0,
            "waist_distance_mm": APEX_HEIGHT_MM, "wavelength_nm": 650.0,
            "fan_half_angle_deg": 30.0,
        },
        water={"absorption_per_m": PLANE_ABSORPTION_PER_M, "scattering_per_m": 0.0},
        sensor={"noise": False, "black_level_dn": 0.0},
    )  # fmt: skip


def plane_on_paper() -> float:
    """Digital number of the pixel on the axis, worked out without the renderer.

    The sheet's irradiance at its middle, P / (2 phi) / rho sqrt(2/pi) / w; a Lambertian
    plane's radiance rho E / pi; both legs' absorption; Fresnel at normal incidence on both
    faces; radiance over the squared index; the camera equation.
    """
    scene = plane_scene()
    laser, port, model = scene.tank.laser, scene.tank.port, scene.tank.sensor
    assert isinstance(port, PlanePort)
    index = water_optics(scene.tank.water, laser.wavelength_nm).index
    fan = laser.power_mw / (2 * np.radians(laser.fan_half_angle_deg)) / APEX_HEIGHT_MM
    irradiance_w_m2 = 1e3 * fan * sqrt(2 / pi) / laser.waist_mm
    in_water_mm = CAMERA_DISTANCE_MM - port.gap_mm - port.thickness_mm + APEX_HEIGHT_MM
    in_water = PLANE_ALBEDO * irradiance_w_m2 / pi
    in_water *= np.exp(-PLANE_ABSORPTION_PER_M * 1e-3 * in_water_mm)
    outer = 1 - ((GLASS_INDEX - 1) / (GLASS_INDEX + 1)) ** 2
    inner = 1 - ((GLASS_INDEX - index) / (GLASS_INDEX + index)) ** 2
    in_air = float(in_water * outer * inner / index**2)
    electrons = photons(scene, in_air, laser.wavelength_nm) * model.laser_response.red
    return FULL_SCALE_DN / model.full_well_e * electrons


def plane_rendered() -> float:
    """The same pixel's digital number in the picture the tank takes."""
    scene = plane_scene()
    return float(expose(scene, Tank(scene).render(0.0))[CENTRE])
