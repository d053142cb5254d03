"""The field table's turbid water: how its scattered light is freed of the renderer's noise."""

import cv2
import numpy as np

from sim.render.layers import Layers
from tests.validation.surfaces.harbor import HALO_PX, REST_PX, SPECK, steady

SHAPE = (60, 80)
VEIL = 0.02


def line_light() -> np.ndarray:
    """A line across the picture that ends in the middle and goes on 20 rows below."""
    direct = np.zeros(SHAPE, np.float32)
    direct[20, :40] = direct[40, 40:] = 1.0
    return direct


def halo_of(direct: np.ndarray) -> np.ndarray:
    near, far = (
        cv2.GaussianBlur(direct, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        for sigma in (HALO_PX[2], HALO_PX[5])
    )
    return 0.5 * near + 2.0 * far + VEIL


def noisy(light: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """Gamma distributed with as much noise as light has, and a speck in every hundredth pixel."""
    specks = np.where(generator.random(SHAPE) < 0.01, 50.0, 1.0)
    return (light * specks * generator.gamma(4.0, 0.25, SHAPE)).astype(np.float32)


def test_noise_of_half_the_light_is_nearly_gone() -> None:
    """Nine unknowns from 4800 pixels, each off by half, and the mean of 4 pi REST_PX² of them:
    0.5 (9 / 4800 + 1 / (4 pi 36))^(1/2) = 0.03, and twice that is allowed.  A hundredth of the
    pixels, cut off at SPECK times their light, add as many hundredths to all.
    """
    direct = line_light()
    light = halo_of(direct)
    drawn = noisy(light, np.random.default_rng(1))
    found = steady(Layers(direct, drawn, np.zeros(SHAPE, np.float32))).scattered
    expected = 0.5 * np.sqrt(9 / light.size + 1 / (4 * np.pi * REST_PX**2))
    assert (found / light).std() < 2 * expected
    assert abs((found / light).mean() - 1) < 0.01 * SPECK + expected
    assert (drawn / light).std() > 0.5
