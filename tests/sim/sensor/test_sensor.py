"""The sensor against its own declaration: EMVA noise, fixed patterns, clipping, repeatability."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from sensor_scenes import EXPOSURE_MS, layers_of, sensor_scene

from sim.scene import Scene, Sensor
from sim.sensor import Webcam, digitise
from sim.sensor.webcam import electrons_of, fixed_pattern, read_out


def picture(scene: Scene, seed: int = 1, **radiance: float) -> np.ndarray:
    """(H, W, 3) DN as float of a flat field of the given radiance."""
    generator = np.random.default_rng(seed)
    return Webcam(scene).expose(layers_of(scene, **radiance), EXPOSURE_MS, generator).astype(float)


@pytest.mark.parametrize("radiance", [0.02, 0.1, 0.25])
def test_mean_and_variance_are_the_declared_ones(radiance: float) -> None:
    """Over a flat field: mean and variance within 3 standard errors of EMVA's linear model.

    Variance = shot + dark + PRNU + DSNU + quantisation, in DN; standard errors sigma/sqrt(N)
    and sigma2 sqrt(2/N).
    """
    scene = sensor_scene(dsnu_e=40.0)
    sensor = scene.tank.sensor
    expected = float(
        Webcam(scene).mean_electrons(layers_of(scene, ambient=radiance), EXPOSURE_MS)[0, 0, 1]
    )
    image = picture(scene, seed=5, ambient=radiance)[..., 1]
    gain = 255 / sensor.full_well_e
    mean = sensor.black_level_dn + gain * expected
    fixed = (sensor.prnu * expected) ** 2 + sensor.dsnu_e**2
    variance = gain**2 * (expected + sensor.dark_noise_e**2 + fixed) + 1 / 12
    n = image.size
    assert abs(image.mean() - mean) < 3 * np.sqrt(variance / n)
    assert abs(image.var() - variance) < 3 * variance * np.sqrt(2 / n)


@pytest.mark.parametrize(("dark_noise_e", "mean_e"), [(0.0, 3.0), (2.0, 20.0), (5.0, 50.0)])
def test_few_electrons_are_as_skewed_as_when_counted(dark_noise_e: float, mean_e: float) -> None:
    """m/(m + d^2)^1.5, what Poisson's and Gauss's numbers add up to; 4 standard errors.

    Those of the skewness g of N numbers: about sqrt((6 + 9 g^2 + 6 k)/N),
    k the excess kurtosis, at most 1/m.
    """
    sensor = Sensor(dark_noise_e=dark_noise_e, prnu=0.0)
    expected = np.full((480, 640), mean_e, np.float32)
    pattern = fixed_pattern(sensor, expected.shape)
    read = read_out(expected, sensor, pattern, np.random.default_rng(3)).astype(float)
    skewness = mean_e / (mean_e + dark_noise_e**2) ** 1.5
    found = np.mean((read - read.mean()) ** 3) / read.std() ** 3
    error = np.sqrt((6 + 9 * skewness**2 + 6 / mean_e) / read.size)
    assert skewness > 8 * error, "a Gaussian is told from it"
    assert abs(found - skewness) < 4 * error


def test_prnu_is_a_fixed_pattern() -> None:
    """The mean of many pictures keeps the pattern: its spread is PRNU, not PRNU/sqrt(N)."""
    scene = sensor_scene((320, 240), prnu=0.03, dark_noise_e=0.0)
    count = 16
    stack = [picture(scene, seed=k, ambient=0.2)[..., 0] for k in range(count)]
    mean = np.mean(stack, axis=0) - scene.tank.sensor.black_level_dn
    layers = layers_of(scene, ambient=0.2)
    electrons = float(Webcam(scene).mean_electrons(layers, EXPOSURE_MS)[0, 0, 0])
    expected = np.sqrt(0.03**2 + (1 / electrons) / count)
    # Relative standard error of a standard deviation: 1/sqrt(2N); quantisation adds < 1e-3.
    assert mean.std() / mean.mean() == pytest.approx(expected, rel=0.01)


def test_dsnu_is_a_fixed_offset() -> None:
    """Two dark pictures share it: their covariance is its variance, in DN.

    Standard error of the covariance of N pairs of variance s2 and correlation r:
    s2 sqrt((1 + r2)/N).  Without PRNU and hot pixels nothing else is common to both.
    """
    scene = sensor_scene(prnu=0.0, dsnu_e=100.0, black_level_dn=20.0)
    sensor = scene.tank.sensor
    first, second = (picture(scene, seed=seed)[..., 1].ravel() for seed in (1, 2))
    gain = 255 / sensor.full_well_e
    shared = (gain * sensor.dsnu_e) ** 2
    total = shared + (gain * sensor.dark_noise_e) ** 2 + 1 / 12
    error = total * np.sqrt((1 + (shared / total) ** 2) / first.size)
    assert abs(np.cov(first, second)[0, 1] - shared) < 3 * error


def test_hot_pixels_are_as_many_and_as_bright_as_declared() -> None:
    """Their share is binomial, their mean within 3 standard errors; they stay where they are."""
    scene = sensor_scene(prnu=0.0, hot_pixels=0.01, hot_e=6000.0)
    sensor = scene.tank.sensor
    first, second = (picture(scene, seed=seed) for seed in (1, 2))
    gain = 255 / sensor.full_well_e
    hot = first > sensor.black_level_dn + 0.5 * gain * sensor.hot_e
    share = sensor.hot_pixels
    assert abs(hot.mean() - share) < 3 * np.sqrt(share * (1 - share) / hot.size)
    assert np.array_equal(hot, second > sensor.black_level_dn + 0.5 * gain * sensor.hot_e)
    spread = np.sqrt(gain**2 * (sensor.hot_e + sensor.dark_noise_e**2) + 1 / 12)
    mean = sensor.black_level_dn + gain * sensor.hot_e
    assert abs(first[hot].mean() - mean) < 3 * spread / np.sqrt(hot.sum())


def test_each_fixed_pattern_has_a_stream_of_its_own() -> None:
    """Switching hot pixels on leaves sensitivities and offsets as they are."""
    plain, hot = (
        fixed_pattern(Sensor(prnu=0.02, dsnu_e=10.0, hot_pixels=share), (48, 64))
        for share in (0.0, 0.1)
    )
    assert plain.hot_e is None and hot.hot_e is not None and hot.hot_e.any()
    assert np.array_equal(plain.sensitivity, hot.sensitivity)
    assert plain.offset_e is not None and hot.offset_e is not None
    assert np.array_equal(plain.offset_e, hot.offset_e)
    other = fixed_pattern(Sensor(prnu=0.02, dsnu_e=10.0, seed=2), (48, 64))
    assert other.offset_e is not None  # another camera: what both have in common is chance
    for own, others in ((plain.sensitivity, other.sensitivity), (plain.offset_e, other.offset_e)):
        assert abs(np.corrcoef(own.ravel(), others.ravel())[0, 1]) < 4 / own.size**0.5


def test_without_noise_nothing_is_random() -> None:
    scene = sensor_scene(
        (64, 48), noise=False, prnu=0.2, dsnu_e=500.0, hot_pixels=0.1, speckle="polarised"
    )
    image = picture(scene, direct=0.1)
    assert (image == image[0, 0]).all()
    assert np.array_equal(image, picture(scene, seed=2, direct=0.1))


def test_speckle_is_seen_without_noise() -> None:
    """Only light of the laser that comes straight from the surface has any."""
    scene = sensor_scene((64, 48), prnu=0.2, speckle="polarised")
    generator = np.random.default_rng(1)
    lit, day = (
        Webcam(scene).without_noise().expose(layers, EXPOSURE_MS, generator)
        for layers in (layers_of(scene, direct=0.1), layers_of(scene, ambient=0.1))
    )
    assert np.ptp(lit[..., 0]) > 0 and (day == day[0, 0]).all()


def test_full_well_clips_and_black_stays_in_range() -> None:
    scene = sensor_scene()
    assert (picture(scene, ambient=50.0) == 255).all()
    dark = picture(scene)
    sigma = 255 / scene.tank.sensor.full_well_e * scene.tank.sensor.dark_noise_e
    assert dark.mean() == pytest.approx(scene.tank.sensor.black_level_dn, abs=0.05 * sigma)


def test_the_laser_goes_to_the_red_channel() -> None:
    scene = sensor_scene((64, 48), noise=False)
    red, green, blue = picture(scene, direct=0.15)[0, 0] - scene.tank.sensor.black_level_dn
    response = scene.tank.sensor.laser_response
    assert green / red == pytest.approx(response.green / response.red, abs=0.5 / red)
    assert blue / red == pytest.approx(response.blue / response.red, abs=0.5 / red)


@examples(50)
@given(
    electrons=st.floats(0, 4e4), gain=st.floats(0.2, 4), gamma=st.floats(1, 3),
)  # fmt: skip
def test_digitising_is_monotone_and_in_range(electrons: float, gain: float, gamma: float) -> None:
    sensor = Sensor(gain=gain, gamma=gamma)
    pair = np.array([electrons, electrons * 1.1 + 1], np.float32)
    low, high = digitise(pair, sensor).astype(int)
    assert 0 <= low <= high <= 255


@examples(50)
@given(
    electrons=st.floats(0, 4e4), bits=st.sampled_from([10, 12, 14, 16]), gamma=st.floats(1, 3),
)  # fmt: skip
def test_more_bits_divide_a_dn_further(electrons: float, bits: int, gamma: float) -> None:
    """Of the same light the picture of 8 bits is the nearest whole DN, and a deep one nearer."""
    sensor = Sensor(gamma=gamma, black_level_dn=0.0)
    one = np.array([electrons], np.float32)
    exact = 255 * (min(electrons, sensor.full_well_e) / sensor.full_well_e) ** (1 / gamma)
    deep = digitise(one, sensor, bits=bits)
    assert deep.dtype == np.uint16 and int(deep[0]) % 2 ** (16 - bits) == 0
    # Half a step, and what single precision makes of 255.
    assert abs(deep[0] / 256 - exact) <= 0.5 / 2 ** (bits - 8) + 1e-4
    assert abs(digitise(one, sensor)[0] - exact) <= 0.5 + 1e-4


def test_a_deep_range_ends_where_that_of_eight_bits_does() -> None:
    bright = np.array([[1e6] * 3] * 3, np.float32)
    sensor = Sensor(clips_dn=240, frame_dn=9)
    assert digitise(bright, sensor, bits=12)[1, 1] == 240 * 256
    assert digitise(bright, sensor, bits=12)[0, 0] == 9 * 256
    assert (digitise(bright, Sensor(), bits=16) == 255 * 256).all()


@examples(50)
@given(dn=st.integers(60, 254), gain=st.floats(1, 4), gamma=st.floats(1, 3))
def test_electrons_of_undoes_digitising(dn: int, gain: float, gamma: float) -> None:
    sensor = Sensor(gain=gain, gamma=gamma, full_well_e=20000.0)
    electrons = np.array([electrons_of(dn, sensor)], np.float32)
    assert digitise(electrons, sensor)[0] == dn


def test_same_seed_same_bytes() -> None:
    scene = sensor_scene(
        (160, 120), speckle="depolarised", bayer="GBRG", jpeg_quality=90, gamma=2.2, dsnu_e=10.0
    )
    first, second = (picture(scene, seed=3, direct=0.1, ambient=0.02) for _ in range(2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, picture(scene, seed=4, direct=0.1, ambient=0.02))


@pytest.mark.parametrize(("gamma", "end"), [(1.0, 180), (2.2, 216)])
def test_a_range_that_ends_early_cuts_off_what_is_brighter(gamma: float, end: int) -> None:
    whole, cut = (
        picture(sensor_scene(gamma=gamma, clips_dn=clips), ambient=0.2) for clips in (255, end)
    )
    assert whole.max() > end > whole.min()
    np.testing.assert_array_equal(cut, np.minimum(whole, end))


def test_a_frame_lies_around_the_picture_and_nowhere_else() -> None:
    bare, framed = (picture(sensor_scene(frame_dn=dn), ambient=0.2) for dn in (None, 129))
    np.testing.assert_array_equal(framed[1:-1, 1:-1], bare[1:-1, 1:-1])
    rim = np.ones(framed.shape, dtype=bool)
    rim[1:-1, 1:-1] = False
    assert (framed[rim] == 129).all()


def test_electrons_of_a_grey_value_beyond_the_range_are_those_of_its_end() -> None:
    sensor = sensor_scene(clips_dn=180).tank.sensor
    assert electrons_of(240.0, sensor) == electrons_of(180.0, sensor)


def test_a_range_that_ends_at_black_is_refused() -> None:
    with pytest.raises(ValueError, match="clips_dn = 5 is not above black"):
        Sensor(clips_dn=5, black_level_dn=5.0)
