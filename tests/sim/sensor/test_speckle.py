"""Speckle: the contrast from Goodman's integral, the realised one, and what it does to a line."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from sensor_scenes import EXPOSURE_MS, centroids, layers_of, line, sensor_scene

from lscan.records import Floats
from sim.scene import Scene
from sim.sensor import Webcam
from sim.sensor.radiometry import speckle_contrast, speckle_pattern


@pytest.mark.parametrize(
    ("pixel_um", "f_number", "polarised", "depolarised"),
    [
        (6.0, 2.0, 0.22, 0.15), (6.0, 2.8, 0.29, 0.21), (4.2, 2.0, 0.30, 0.21),
        (4.2, 2.8, 0.39, 0.28), (3.0, 2.0, 0.39, 0.28), (3.0, 2.8, 0.51, 0.36),
    ],
)  # fmt: skip
def test_contrast_of_webcams(
    pixel_um: float, f_number: float, polarised: float, depolarised: float
) -> None:
    """The numbers of docs/explanation/physics.md, section 4, at 650 nm, to the two digits given
    there."""
    assert round(speckle_contrast(pixel_um, f_number, 650.0, "polarised"), 2) == polarised
    assert round(speckle_contrast(pixel_um, f_number, 650.0, "depolarised"), 2) == depolarised


def test_contrast_by_counting_pairs() -> None:
    """The integral against its meaning: the mean of |mu|^2 over random pairs in the pixel.

    Bar: 4 standard errors of the mean of the pairs drawn.  The Airy amplitude is computed as
    the mean of cos over a circular pupil's chords, without a Bessel function:
    mu = (4/pi) int_0^1 sqrt(1 - t^2) cos(q t) dt.
    """
    generator = np.random.default_rng(11)
    pixel_um, f_number, nm = 6.0, 2.8, 650.0
    first, second = generator.random((2, 20000, 2)) * pixel_um
    q = np.pi * np.hypot(*(first - second).T) / (f_number * nm * 1e-3)
    t = (np.arange(400) + 0.5) / 400
    mu = 4 / np.pi * (np.sqrt(1 - t**2) * np.cos(q[:, None] * t)).mean(axis=1)
    contrast2 = speckle_contrast(pixel_um, f_number, nm, "polarised") ** 2
    assert abs((mu**2).mean() - contrast2) < 4 * (mu**2).std() / np.sqrt(len(mu))


def test_limits_of_contrast() -> None:
    """A point pixel sees 1; a large one sqrt(Ac/Ad), Ac = 4 (lambda N)^2/pi the grain's area.

    Ac = (lambda z)^2 / pupil area (Goodman sec. 4.6).  Pairs across the border are missing,
    which takes less than grain/pixel off (0.75 of it, from the wings of |mu|^2 as q^-3).
    """
    assert speckle_contrast(0.01, 4.0, 650.0, "polarised") == pytest.approx(1, abs=1e-3)
    grain_um = 0.65 * 2.0
    large = speckle_contrast(50 * grain_um, 2.0, 650.0, "polarised")
    assert large == pytest.approx(np.sqrt(4 / np.pi) / 50, rel=1 / 50)


@examples(30)
@given(pixel=st.floats(1, 12), f_number=st.floats(1, 8), nm=st.floats(450, 700))
def test_contrast_depends_on_grains_per_pixel_alone(
    pixel: float, f_number: float, nm: float
) -> None:
    contrast = speckle_contrast(pixel, f_number, nm, "polarised")
    assert 0 < contrast < 1
    assert speckle_contrast(2 * pixel, 2 * f_number, nm, "polarised") == pytest.approx(contrast)
    assert speckle_contrast(pixel, 1.1 * f_number, nm, "polarised") > contrast
    two = speckle_contrast(pixel, f_number, nm, "depolarised")
    assert two == pytest.approx(contrast / np.sqrt(2))


@pytest.mark.parametrize("contrast", [0.15, 0.5])
def test_a_pattern_has_unit_mean_and_its_contrast(contrast: float) -> None:
    """Within 3 standard errors; the variance's follows from the gamma law's kurtosis 6 C^2."""
    pattern = speckle_pattern((480, 640), contrast, np.random.default_rng(3)).astype(float)
    n = pattern.size
    assert abs(pattern.mean() - 1) < 3 * contrast / np.sqrt(n)
    error = contrast**2 * np.sqrt((2 + 6 * contrast**2) / n)
    assert abs(pattern.var() - contrast**2) < 3 * error


def quiet_scene(**sensor: object) -> Scene:
    """No dark noise, no fixed pattern, and so many electrons that shot noise hardly shows."""
    settings = {"full_well_e": 1e7, "dark_noise_e": 0.0, "prnu": 0.0, "black_level_dn": 0.0}
    return sensor_scene((640, 64), lens={"f_number": 2.0}, **{**settings, **sensor})


def test_speckle_of_a_picture_is_the_declared_one() -> None:
    """Contrast of the red channel of a flat field of laser light, 3 standard errors.

    Shot noise and rounding add 1/e and 1/12 DN^2; both are in the expectation.
    """
    scene = quiet_scene(speckle="polarised")
    layers = layers_of(scene, direct=20.0)
    red = Webcam(scene).expose(layers, EXPOSURE_MS, np.random.default_rng(2))[..., 0].astype(float)
    electrons = float(Webcam(scene).mean_electrons(layers, EXPOSURE_MS)[0, 0, 0])
    assert red.max() < 255, "nothing is clipped"
    contrast = speckle_contrast(6.0, 2.0, 650.0, "polarised")
    mean = electrons * 255 / 1e7
    variance = contrast**2 + 1 / electrons + 1 / 12 / mean**2
    error = variance * np.sqrt((2 + 6 * contrast**2) / red.size)
    assert abs(red.var() / mean**2 - variance) < 3 * error
    assert abs(red.mean() / mean - 1) < 3 * np.sqrt(variance / red.size)


@pytest.mark.parametrize("layer", ["scattered", "ambient"])
def test_only_light_from_surfaces_shows_speckle(layer: str) -> None:
    """Red is flat to the shot noise, 0.08 DN of some 200: two neighbouring grey values."""
    scene = quiet_scene(speckle="polarised")
    layers = layers_of(scene, **{layer: 50.0})
    image = Webcam(scene).expose(layers, EXPOSURE_MS, np.random.default_rng(1))
    assert image[..., 0].min() > 100 and image[..., 0].max() < 255
    assert np.ptp(image[..., 0]) <= 2


def scatter_px(scene: Scene, sigma_px: float, peak_e: float, pictures: int) -> Floats:
    """(pictures * W,) errors of the line's centroids in the red channel, px."""
    columns = scene.rig.camera.width_px
    centre = 32 + np.random.default_rng(9).uniform(-0.5, 0.5, columns)
    layers, webcam = line(scene, sigma_px, peak_e, centre), Webcam(scene)
    black = scene.tank.sensor.black_level_dn
    images = [webcam.expose(layers, EXPOSURE_MS, np.random.default_rng(k)) for k in range(pictures)]
    return np.concatenate([centroids(image, black) - centre for image in images])


@pytest.mark.parametrize("sigma_px", [1.0, 2.0, 3.0])
def test_speckle_scatters_the_centroid_as_published(sigma_px: float) -> None:
    """0.375 C sqrt(sigma) px (docs/explanation/physics.md, section 4), C sqrt(sigma/(4 sqrt(pi)))
    in closed form.

    3 standard errors of a standard deviation, 3/sqrt(2 N); the closed form is the first order
    in C, and what it leaves out is of the order of the relative variance of the column's sum,
    C^2/(2 sigma sqrt(pi)).  Rounding to 8 bit (1/12 DN^2 a pixel wherever there is light,
    weighed by the distance squared within 4 sigma) is added in quadrature.
    """
    scene = quiet_scene(speckle="depolarised")
    errors = scatter_px(scene, sigma_px, 5e6, pictures=8)
    contrast = speckle_contrast(6.0, 2.0, 650.0, "depolarised")
    peak_dn = 5e6 * 255 / 1e7
    rows = np.arange(-np.ceil(4 * sigma_px), np.ceil(4 * sigma_px) + 1)
    rounding = np.sqrt((rows**2).sum() / 12) / (peak_dn * sigma_px * np.sqrt(2 * np.pi))
    expected = np.hypot(0.375 * contrast * np.sqrt(sigma_px), rounding)
    second_order = contrast**2 / (2 * sigma_px * np.sqrt(np.pi))
    assert errors.std() == pytest.approx(expected, rel=3 / np.sqrt(2 * len(errors)) + second_order)
