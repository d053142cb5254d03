"""Colour filter and coding: Bayer mosaic, demosaicing, gamma and MJPEG, and what they cost."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from sensor_scenes import EXPOSURE_MS, layers_of, line, sensor_scene

from sim.sensor import Webcam
from sim.sensor.webcam import ColourFilter, through_jpeg

PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_mosaic_starts_as_its_name_says(pattern: str) -> None:
    picture = np.broadcast_to(np.array([1.0, 2.0, 3.0], np.float32), (5, 7, 3))
    mosaic = ColourFilter(pattern, (5, 7)).mosaic(picture)
    assert mosaic.shape == (5, 7)
    assert ["RGB"[int(k) - 1] for k in mosaic[:2, :2].ravel()] == list(pattern)
    assert np.array_equal(mosaic[2:4, 4:6], mosaic[:2, :2])


@examples(40)
@given(
    pattern=st.sampled_from(PATTERNS), height=st.integers(4, 21), width=st.integers(4, 21),
    seed=st.integers(0, 2**31 - 1),
)  # fmt: skip
def test_planes_of_colour_come_back_exactly(
    pattern: str, height: int, width: int, seed: int
) -> None:
    """Constant pictures all over, linear ones away from the border, whatever their size.

    Bilinear interpolation is exact on them; what is left is float32's rounding of values up
    to 255.
    """
    constant, slopes = np.random.default_rng(seed).uniform(0, 4, (2, 3))
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    flat = np.broadcast_to(constant, (height, width, 3)).astype(np.float32)
    ramp = (flat + u[..., None] * slopes + v[..., None] * slopes[::-1]).astype(np.float32)
    bayer = ColourFilter(pattern, (height, width))
    np.testing.assert_allclose(bayer.demosaic(bayer.mosaic(flat)), flat, atol=1e-4)
    inside = (slice(1, -1), slice(1, -1))
    np.testing.assert_allclose(bayer.demosaic(bayer.mosaic(ramp))[inside], ramp[inside], atol=1e-4)


def test_a_pixel_keeps_the_colour_it_has_seen() -> None:
    picture = np.random.default_rng(1).random((12, 16, 3)).astype(np.float32)
    bayer = ColourFilter("GRBG", (12, 16))
    mosaic = bayer.mosaic(picture)
    np.testing.assert_allclose(bayer.mosaic(bayer.demosaic(mosaic)), mosaic, rtol=1e-6)


def test_noise_is_of_the_mosaic() -> None:
    """Red pixels keep their variance, those between have its mean over 2 or 4: 1/2 and 1/4.

    3 standard errors of each variance, for the shot and dark noise of a flat field.
    """
    scene = sensor_scene(bayer="RGGB", prnu=0.0, dark_noise_e=300.0, black_level_dn=20.0)
    layers, webcam = layers_of(scene, ambient=0.1), Webcam(scene)
    red = webcam.expose(layers, EXPOSURE_MS, np.random.default_rng(8))[..., 0].astype(float)
    electrons = float(webcam.mean_electrons(layers, EXPOSURE_MS)[0, 0, 0])
    variance = (255 / 15000) ** 2 * (electrons + 300.0**2)
    for rows, columns, share in ((0, 0, 1), (0, 1, 1 / 2), (1, 0, 1 / 2), (1, 1, 1 / 4)):
        part = red[rows + 2 : -2 : 2, columns + 2 : -2 : 2]
        expected = variance * share + 1 / 12
        # Interpolated neighbours share a red pixel: at most four times fewer are independent.
        independent = part.size * (1 if share == 1 else 1 / 4)
        assert abs(part.var() - expected) < 3 * expected * np.sqrt(2 / independent)


def test_gamma_is_the_cameras_power_law() -> None:
    """Half of full scale comes out at 255 * 0.5^(1/2.2) = 186.08 DN."""
    scene = sensor_scene((32, 24), noise=False, gamma=2.2, black_level_dn=127.5)
    image = Webcam(scene).expose(layers_of(scene), EXPOSURE_MS, np.random.default_rng(0))
    assert (image == 186).all()


def test_jpeg_is_repeatable_and_gets_better_with_quality() -> None:
    image = np.random.default_rng(2).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    errors = []
    for quality in (20, 60, 90, 100):
        sensor = sensor_scene(jpeg_quality=quality, jpeg_subsampling="4:4:4").tank.sensor
        coded = through_jpeg(image, sensor)
        assert coded.tobytes() == through_jpeg(image, sensor).tobytes()
        errors.append(np.abs(coded.astype(int) - image).mean())
    assert errors == sorted(errors, reverse=True)
    # At quality 100 every coefficient is rounded to 1: errors of uniform rounding in YCbCr.
    assert errors[-1] < 1.5


def test_subsampling_costs_colour_not_brightness() -> None:
    """Red stripes one pixel wide keep their colour at 4:4:4 and share it across at 4:2:0."""
    image = np.zeros((48, 64, 3), np.uint8)
    image[:, ::2, 0] = 200
    full, shared = (
        through_jpeg(image, sensor_scene(jpeg_quality=100, jpeg_subsampling=mode).tank.sensor)
        for mode in ("4:4:4", "4:2:0")
    )
    assert full[:, ::2, 0].mean() - full[:, 1::2, 0].mean() == pytest.approx(200, abs=5)
    assert shared[:, ::2, 0].mean() - shared[:, 1::2, 0].mean() < 100


def test_black_and_white_survive_jpeg_in_their_order() -> None:
    """Channels are not swapped on the way: a red picture stays red."""
    image = np.zeros((16, 16, 3), np.uint8)
    image[..., 0] = 180
    coded = through_jpeg(image, sensor_scene(jpeg_quality=95).tank.sensor)
    np.testing.assert_allclose(coded.reshape(-1, 3), np.tile([180, 0, 0], (256, 1)), atol=3)


def coding_error_px(sigma_px: float, reach: float = 3.0, **coding: object) -> float:
    """Standard deviation of the red centroid of a slanted noise-free line, px.

    A line of peak 200 DN with leakage .08 and .03 into green and blue crosses 13 rows over
    640 columns, so that all sub-pixel places occur; the window is the nearest row and
    ``reach`` sigma (rounded up) to either side.
    """
    scene = sensor_scene(
        (640, 64), noise=False, black_level_dn=0.0,
        laser_response={"red": 1.0, "green": 0.08, "blue": 0.03}, **coding,
    )  # fmt: skip
    centre = 32.013 + 0.02 * (np.arange(640) - 320)
    layers = line(scene, sigma_px, 200 / 255 * scene.tank.sensor.full_well_e, centre)
    image = Webcam(scene).expose(layers, EXPOSURE_MS, np.random.default_rng(0))
    rows = np.arange(64)[:, None]
    window = np.abs(rows - np.rint(centre)) <= np.ceil(reach * sigma_px)
    signal = image[..., 0] * window.astype(float)
    return float(((signal * rows).sum(axis=0) / signal.sum(axis=0) - centre).std())


@pytest.mark.parametrize(
    ("sigma_px", "bayer", "jpeg90", "jpeg75", "both"),
    [
        (0.7, 0.248, 0.068, 0.067, 0.186), (1.0, 0.028, 0.025, 0.031, 0.044),
        (1.5, 0.006, 0.018, 0.031, 0.021), (2.5, 0.007, 0.022, 0.043, 0.019),
    ],
)  # fmt: skip
def test_coding_errors_of_a_line_are_of_the_order_published(
    sigma_px: float, bayer: float, jpeg90: float, jpeg75: float, both: float
) -> None:
    """The table of docs/explanation/physics.md, section 5, whose windows and slopes are not given.

    Of its order means within a factor of sqrt(10) either way.
    """
    realised = [
        coding_error_px(sigma_px, bayer="RGGB"),
        coding_error_px(sigma_px, jpeg_quality=90),
        coding_error_px(sigma_px, jpeg_quality=75),
        coding_error_px(sigma_px, bayer="RGGB", jpeg_quality=90),
    ]
    ratio = np.array(realised) / [bayer, jpeg90, jpeg75, both]
    assert (np.abs(np.log10(ratio)) < 0.5).all(), np.round(realised, 4)


@pytest.mark.parametrize("sigma_px", [0.7, 1.0, 1.5, 2.5])
def test_eight_bits_cost_no_more_than_independent_rounding(sigma_px: float) -> None:
    """Rounding of 1/sqrt(12) DN in every row of the window, carried into the centroid.

    The window cuts nothing off, and the wings round to zero with less error than that, so it
    is an upper bound, but for 3 standard errors; docs/explanation/physics.md, section 5
    has 0.016 to 0.004 px under conditions it does not give.
    """
    half = np.ceil(5 * sigma_px)
    lever = np.sqrt((np.arange(-half, half + 1) ** 2).sum())
    bound = lever / np.sqrt(12) / (200 * sigma_px * np.sqrt(2 * np.pi))
    assert 0 < coding_error_px(sigma_px, reach=5.0) < bound * (1 + 3 / np.sqrt(2 * 640))
