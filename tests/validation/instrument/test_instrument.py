"""The accuracy table: its yardsticks are right, and it is written as it is measured."""

import numpy as np
import pytest
from places import ROOT
from scipy.stats import norm

from lscan.config.rig import NoiseSection
from sim.render.tank import Tank
from sim.scene import load_scene
from sim.sensor.radiometry import speckle_contrast
from tests.validation.exposures import (
    COVER,
    band_miss_percent,
    pictures,
    share_inside,
    with_contrast,
)
from tests.validation.instrument.stripes import cases, cell

SCENES = ROOT / "scenes"


def test_intervals_of_normal_errors_hold_95_percent() -> None:
    assert norm.cdf(COVER) - norm.cdf(-COVER) == pytest.approx(0.95, abs=1e-6)
    error = np.random.default_rng(1).normal(0.0, 2.0, 20_000)
    # A binomial share of 20,000 has a standard error of 0.0015.
    assert share_inside(error, np.full(error.shape, 2.0)) == pytest.approx(0.95, abs=0.006)
    assert share_inside(np.array([-3.0, -1.9, 0.0, 1.9]), np.ones(4)) == 0.75
    assert band_miss_percent(0.93) == pytest.approx(2.0) == band_miss_percent(0.97)


def test_speckle_of_another_contrast_keeps_the_grey_values() -> None:
    scene = load_scene(SCENES / "best" / "groove.toml")
    other = with_contrast(scene, 0.25)
    assert other.rig.stripe.noise is not None and other.rig.stripe.noise.speckle == 0.25
    lens, sensor, laser = other.tank.lens, other.tank.sensor, other.tank.laser
    found = speckle_contrast(sensor.pixel_um, lens.f_number, laser.wavelength_nm, sensor.speckle)
    assert found == pytest.approx(0.25, abs=1e-6)
    # Light on the sensor goes as power over the square of the f-number.
    before = scene.tank.laser.power_mw / scene.tank.lens.f_number**2
    assert laser.power_mw / lens.f_number**2 == pytest.approx(before)
    assert with_contrast(scene, 0.0).tank.sensor.speckle == "none"


def test_seeds_change_the_noise_and_nothing_else() -> None:
    scene = load_scene(SCENES / "paper" / "groove.toml")
    layers = Tank(scene).render(0.0, samples=1, scatter_samples=0)
    first, again, second = pictures(scene, layers, [1, 1, 2])
    assert (first == again).all() and (first != second).any()
    lit = layers.direct > 0.3 * layers.direct.max()  # by the light, which has no noise
    change = (second.astype(float) - first)[..., 0][lit]
    error = change.std() / np.sqrt(change.size)  # the pixels' noise is independent
    assert error < 0.01 * first[..., 0][lit].mean()
    assert abs(change.mean()) < 4 * error  # a false alarm has a chance of 6e-5


def test_a_bad_extractor_fails_the_bound() -> None:
    name, case = next(cases())
    likely, brightest = cell("ml", case, name, 40), cell("max", case, name, 40)
    # The brightest pixel has at least the scatter of rounding to whole pixels, 0.29 px.
    assert brightest.ratio > 2 * likely.ratio and brightest.ratio > 1.1
    silent = cell("ml", case.__class__("tap", 0.8, 20.0, NoiseSection(read_dn=1.0)), name, 4)
    assert silent.ratio == float("inf")  # beneath the threshold nothing is found
