"""The sensor against its own declaration: camera equation, EMVA noise, clipping, repeatability."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim.scene import Scene, Sensor, load_scene
from sim.sensor import Webcam, digitise, photons_per_radiance
from sim.tank import Layers

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "paper"


def scene_with(**sensor: object) -> Scene:
    scene = load_scene(SCENES / "board.toml")
    return replace(scene, tank=scene.tank.model_copy(update={"sensor": Sensor(**sensor)}))


def flat(radiance: float, scene: Scene, which: str = "ambient") -> Layers:
    camera = scene.rig.camera
    dark = [np.zeros((camera.height_px, camera.width_px), np.float32) for _ in range(3)]
    return replace(Layers(*dark), **{which: dark[0] + np.float32(radiance)})


def test_photons_on_paper() -> None:
    """1 W/(m2 sr) through f/2.8, T = 0.85, on a 6 um pixel for 20 ms at 650 nm.

    pi * 0.85 / (4 * 2.8^2) = 0.085150; * 3.6e-11 m2 * 0.02 s = 6.1308e-14 J;
    / (6.62607e-34 * 2.99792e8 / 650e-9 = 3.05607e-19 J) = 200612 photons.
    """
    scene = load_scene(SCENES / "board.toml")
    photons = photons_per_radiance(scene.tank.lens, scene.tank.sensor, 20.0, 650.0)
    assert photons == pytest.approx(200612, rel=1e-4)


@pytest.mark.parametrize("radiance", [0.02, 0.1, 0.25])
def test_mean_and_variance_are_the_declared_ones(radiance: float) -> None:
    """Over a flat field: mean and variance within 3 standard errors of EMVA's linear model.

    Variance = shot + dark + PRNU + quantisation, in DN; standard errors sigma/sqrt(N) and
    sigma2 sqrt(2/N).
    """
    scene = scene_with()
    sensor, webcam = scene.tank.sensor, Webcam(scene)
    layers = flat(radiance, scene)
    expected = float(webcam.mean_electrons(layers, 20.0)[0, 0, 1])
    image = webcam.expose(layers, 20.0, np.random.default_rng(5))[..., 1].astype(float)
    gain = 255 / sensor.full_well_e
    mean = sensor.black_level_dn + gain * expected
    variance = (
        gain**2 * (expected + sensor.dark_noise_e**2 + (sensor.prnu * expected) ** 2) + 1 / 12
    )
    n = image.size
    assert abs(image.mean() - mean) < 3 * np.sqrt(variance / n)
    assert abs(image.var() - variance) < 3 * variance * np.sqrt(2 / n)


def test_prnu_is_a_fixed_pattern() -> None:
    """The mean of many pictures keeps the pattern: its spread is PRNU, not PRNU/sqrt(N)."""
    scene = scene_with(prnu=0.03, dark_noise_e=0)
    webcam, layers = Webcam(scene), flat(0.2, scene)
    count = 16
    stack = [
        webcam.expose(layers, 20.0, np.random.default_rng(k))[..., 0].astype(float)
        for k in range(count)
    ]
    mean = np.mean(stack, axis=0) - scene.tank.sensor.black_level_dn
    electrons = float(webcam.mean_electrons(layers, 20.0)[0, 0, 0])
    expected = np.sqrt(0.03**2 + (1 / electrons) / count)
    # Relative standard error of a standard deviation: 1/sqrt(2N); quantisation adds < 1e-3.
    assert mean.std() / mean.mean() == pytest.approx(expected, rel=0.01)


def test_full_well_clips_and_black_stays_in_range() -> None:
    scene = scene_with()
    webcam = Webcam(scene)
    bright = webcam.expose(flat(50.0, scene), 20.0, np.random.default_rng(1))
    assert (bright == 255).all()
    dark = webcam.expose(flat(0.0, scene), 20.0, np.random.default_rng(1)).astype(float)
    sigma = 255 / scene.tank.sensor.full_well_e * scene.tank.sensor.dark_noise_e
    assert dark.mean() == pytest.approx(scene.tank.sensor.black_level_dn, abs=0.05 * sigma)


def test_the_laser_goes_to_the_red_channel() -> None:
    scene = scene_with(noise=False)
    image = (
        Webcam(scene)
        .expose(flat(0.15, scene, which="direct"), 20.0, np.random.default_rng(1))
        .astype(float)
        - scene.tank.sensor.black_level_dn
    )
    red, green, blue = image[0, 0]
    response = scene.tank.sensor.laser_response
    assert green / red == pytest.approx(response.green / response.red, abs=0.5 / red)
    assert blue / red == pytest.approx(response.blue / response.red, abs=0.5 / red)


def test_blur_keeps_energy_and_centre() -> None:
    """A point in the middle of the picture is spread, neither dimmed nor moved."""
    scene = scene_with(noise=False)
    layers = flat(0.0, scene)
    layers.direct[240, 320] = 0.3
    electrons = Webcam(scene).mean_electrons(layers, 20.0)[..., 0].astype(float)
    lens, sensor = scene.tank.lens, scene.tank.sensor
    photons = photons_per_radiance(lens, sensor, 20.0, scene.tank.laser.wavelength_nm)
    assert electrons.sum() == pytest.approx(0.3 * photons * sensor.laser_response.red, rel=1e-5)
    v, u = np.indices(electrons.shape)
    assert (electrons * u).sum() / electrons.sum() == pytest.approx(320, abs=1e-4)
    spread = (electrons * (v - 240) ** 2).sum() / electrons.sum()
    # The kernel is sampled and cut at 3 to 4 sigma: a few percent of its variance.
    assert spread == pytest.approx(lens.blur_px**2, rel=0.05)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(
    electrons=st.floats(0, 4e4), gain=st.floats(0.2, 4), gamma=st.floats(1, 3),
)  # fmt: skip
def test_digitising_is_monotone_and_in_range(electrons: float, gain: float, gamma: float) -> None:
    sensor = Sensor(gain=gain, gamma=gamma)
    pair = np.array([electrons, electrons * 1.1 + 1], np.float32)
    low, high = digitise(pair, sensor).astype(int)
    assert 0 <= low <= high <= 255


def test_same_seed_same_bytes() -> None:
    scene = scene_with()
    layers = flat(0.1, scene)
    first, second = (Webcam(scene).expose(layers, 20.0, np.random.default_rng(3)) for _ in range(2))
    assert first.tobytes() == second.tobytes()
    other = Webcam(scene).expose(layers, 20.0, np.random.default_rng(4))
    assert first.tobytes() != other.tobytes()
