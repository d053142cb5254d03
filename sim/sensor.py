"""The webcam's sensor: from radiance to electrons to digital numbers (EMVA 1288, linear)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.records import Bytes, Floats
from sim.scene import Lens, Response, Scene, Sensor
from sim.tank import Layers

PLANCK_J_S = 6.62607015e-34  # exact, SI 2019
LIGHT_M_S = 299792458.0  # exact, SI 2019
AMBIENT_NM = 550.0  # photon energy of ambient light: the middle of the visible
FULL_SCALE_DN = 255.0

Electrons = NDArray[np.float32]


class Webcam:
    """Lens and sensor of a scene; its PRNU pattern stays the same from picture to picture."""

    def __init__(self, scene: Scene) -> None:
        """Draw the PRNU pattern from the sensor's seed."""
        self.lens, self.sensor = scene.tank.lens, scene.tank.sensor
        self.wavelength_nm = scene.tank.laser.wavelength_nm
        camera = scene.rig.camera
        shape = (camera.height_px, camera.width_px, 3)
        pattern = np.random.default_rng([self.sensor.seed, 0]).standard_normal(shape)
        spread = self.sensor.prnu if self.sensor.noise else 0.0
        self._sensitivity = (1 + spread * pattern).astype(np.float32)

    def expose(self, layers: Layers, exposure_ms: float, generator: np.random.Generator) -> Bytes:
        """The picture, (H, W, 3) RGB, of the layers; all noise comes from ``generator``."""
        electrons = self.mean_electrons(layers, exposure_ms)
        if self.sensor.noise:
            electrons = self._noisy(electrons, generator)
        return digitise(electrons, self.sensor)

    def mean_electrons(self, layers: Layers, exposure_ms: float) -> Electrons:
        """Expected electrons, (H, W, 3) RGB, before noise and full well."""
        laser = self._photons(layers.laser, exposure_ms, self.wavelength_nm)
        ambient = self._photons(layers.ambient, exposure_ms, AMBIENT_NM)
        to_laser = _rgb(self.sensor.laser_response)
        to_ambient = _rgb(self.sensor.ambient_response)
        electrons = laser[..., None] * to_laser + ambient[..., None] * to_ambient
        return electrons.astype(np.float32, copy=False)

    def _photons(
        self, radiance: NDArray[np.float32], exposure_ms: float, wavelength_nm: float
    ) -> NDArray[np.float32]:
        """Photons a pixel collects from radiance in W/(m2 sr), blurred by the lens."""
        factor = photons_per_radiance(self.lens, self.sensor, exposure_ms, wavelength_nm)
        sigma = self.lens.blur_px
        blurred = cv2.GaussianBlur(radiance, (0, 0), sigma) if sigma > 0 else radiance
        return (blurred * np.float32(factor)).astype(np.float32)

    def _noisy(self, electrons: Electrons, generator: np.random.Generator) -> Electrons:
        # Far above the full well the shot noise no longer shows, and Poisson has its limits.
        expected = np.minimum(electrons * self._sensitivity, 1e3 * self.sensor.full_well_e)
        shot = generator.poisson(expected).astype(np.float32)
        dark = generator.standard_normal(electrons.shape, dtype=np.float32)
        return shot + np.float32(self.sensor.dark_noise_e) * dark


def photons_per_radiance(
    lens: Lens, sensor: Sensor, exposure_ms: float, wavelength_nm: float
) -> float:
    """Photons a pixel collects for 1 W/(m2 sr) at the lens.

    Irradiance in the image of a distant surface is pi L T / (4 N^2) (the camera equation,
    e.g. Born & Wolf sec. 4.8); times pixel area, time, and the photons in a joule.
    """
    irradiance = np.pi * lens.transmission / (4 * lens.f_number**2)
    area_m2 = (sensor.pixel_um * 1e-6) ** 2
    joule_per_photon = PLANCK_J_S * LIGHT_M_S / (wavelength_nm * 1e-9)
    return irradiance * area_m2 * exposure_ms * 1e-3 / joule_per_photon


def digitise(electrons: Electrons, sensor: Sensor) -> Bytes:
    """Digital numbers of the electrons, same shape: full well, gain, gamma, 8 bit."""
    held = np.minimum(electrons, np.float32(sensor.full_well_e))
    gain = np.float32(sensor.gain * FULL_SCALE_DN / sensor.full_well_e)
    # Dark noise may pull a pixel below zero electrons; only the black level keeps it in range.
    linear = np.clip(sensor.black_level_dn + held * gain, 0.0, FULL_SCALE_DN)
    if sensor.gamma != 1:
        linear = FULL_SCALE_DN * (linear / FULL_SCALE_DN) ** (1 / sensor.gamma)
    return np.rint(linear).astype(np.uint8)


def _rgb(response: Response) -> Floats:
    return np.array([response.red, response.green, response.blue], dtype=np.float32)
