"""Noise of the EMVA 1288 linear model: shot and dark noise, and the pixels' fixed patterns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.scene import Sensor

Electrons = NDArray[np.float32]

# Each fixed pattern has a stream of the sensor's seed to itself, so that switching one on
# leaves the others as they are.  Stream 1 is that of the pictures (sim.devices).
SENSITIVITY_STREAM, OFFSET_STREAM, HOT_STREAM = 0, 2, 3
# Far above the full well the shot noise no longer shows, and Poisson has its limits.
MOST_FULL_WELLS = 1e3
# Shot noise of m electrons on dark noise of d has the skewness m/(m + d^2)^1.5, at most
# 2/(27^0.5 d), at m = 2 d^2.  At three sigma a skewness s moves the density by the share
# s/6 (3^3 - 3*3) = 3 s (Edgeworth): from this dark noise on, by a tenth at most.
LEAST_GAUSSIAN_DARK_E = 30 * 2 / 27**0.5


@dataclass(frozen=True)
class FixedPattern:
    """What makes one pixel differ from the next, in every picture the same way.

    sensitivity: the shape of the electrons, mean 1 (PRNU).  hot_e: electrons of dark current
    in the same shape, None where no pixel is hot.  offset_e: electrons (DSNU), or None.
    """

    sensitivity: NDArray[np.float32]
    hot_e: Electrons | None
    offset_e: Electrons | None


def fixed_pattern(sensor: Sensor, shape: tuple[int, ...]) -> FixedPattern:
    """The sensor's fixed pattern, drawn from its seed.

    EMVA 1288: PRNU is multiplicative, DSNU additive, both Gaussian over the pixels.
    """
    sensitivity = 1 + sensor.prnu * _stream(sensor, SENSITIVITY_STREAM).standard_normal(shape)
    hot = offset = None
    if sensor.hot_pixels > 0:
        is_hot = _stream(sensor, HOT_STREAM).random(shape) < sensor.hot_pixels
        hot = (sensor.hot_e * is_hot).astype(np.float32)
    if sensor.dsnu_e > 0:
        offset = sensor.dsnu_e * _stream(sensor, OFFSET_STREAM).standard_normal(
            shape, dtype=np.float32
        )
    return FixedPattern(np.maximum(sensitivity, 0).astype(np.float32), hot, offset)


def read_out(
    expected: Electrons,
    sensor: Sensor,
    pattern: FixedPattern,
    generator: np.random.Generator,
    *,
    quickly: bool = False,
) -> Electrons:
    """Electrons read out of those expected, as ``gathered`` gives them, same shape.

    Shot noise is Poisson, of the dark current of hot pixels too; dark noise is Gaussian and
    may leave a pixel below zero, as reading out does.

    quickly: in a third of the time, both as one Gaussian of their joint variance: mean and
    variance are exact, the skewness is lost.  Below LEAST_GAUSSIAN_DARK_E it changes nothing.
    """
    spread: Electrons | np.float32
    if quickly and sensor.dark_noise_e >= LEAST_GAUSSIAN_DARK_E:
        read = expected.copy()
        spread = np.sqrt(expected + np.float32(sensor.dark_noise_e**2))
    else:
        read = generator.poisson(expected).astype(np.float32)
        spread = np.float32(sensor.dark_noise_e)
    noise = generator.standard_normal(expected.shape, dtype=np.float32)
    noise *= spread
    read += noise
    if pattern.offset_e is not None:
        read += pattern.offset_e
    return read


def gathered(electrons: Electrons, sensor: Sensor, pattern: FixedPattern) -> Electrons:
    """Electrons to be expected in these very pixels, in the shape of the expected ``electrons``."""
    expected = electrons * pattern.sensitivity
    if pattern.hot_e is not None:
        expected += pattern.hot_e
    return np.minimum(expected, MOST_FULL_WELLS * sensor.full_well_e, out=expected)


def _stream(sensor: Sensor, stream: int) -> np.random.Generator:
    return np.random.default_rng([sensor.seed, stream])
