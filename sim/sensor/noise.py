"""Noise of the EMVA 1288 linear model: shot and dark noise, and the pixels' fixed patterns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.scene import Sensor
from sim.sensor.normal import standard_normal

Electrons = NDArray[np.float32]

# Each fixed pattern has a stream of the sensor's seed to itself, so that switching one on
# leaves the others as they are.  Stream 1 is that of the pictures (sim.devices).
SENSITIVITY_STREAM, OFFSET_STREAM, HOT_STREAM = 0, 2, 3
# Shot noise of m electrons on dark noise of d has the skewness m/(m + d^2)^1.5.  At three sigma a
# skewness s moves the density by the share s/6 (3^3 - 3*3) = 3 s (Edgeworth): by a tenth at most.
MOST_SKEWNESS = 1 / 30
# It is largest at m = 2 d^2, 2/(27^0.5 d): from this dark noise on there is never more.
LEAST_GAUSSIAN_DARK_E = 2 / 27**0.5 / MOST_SKEWNESS


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
    expected: Electrons, sensor: Sensor, pattern: FixedPattern, generator: np.random.Generator
) -> Electrons:
    """Electrons read out of those expected, as ``gathered`` gives them, same shape.

    Shot noise is Poisson, of the dark current of hot pixels too; dark noise is Gaussian and
    may leave a pixel below zero, as reading out does.  Where their sum is skewed by no more than
    MOST_SKEWNESS, it is drawn as one Gaussian: mean and variance are exact, the skewness is lost.
    """
    dark = np.float32(sensor.dark_noise_e)
    noise = standard_normal(generator, expected.shape)
    variance = expected + dark**2
    spread = np.sqrt(variance)
    read = noise * spread
    read += expected
    if dark < LEAST_GAUSSIAN_DARK_E:
        skewed = expected > np.float32(MOST_SKEWNESS) * variance * spread
        read[skewed] = generator.poisson(expected[skewed]) + dark * noise[skewed]
    if pattern.offset_e is not None:
        read += pattern.offset_e
    return read


def gathered(electrons: Electrons, pattern: FixedPattern) -> Electrons:
    """Electrons to be expected in these very pixels: ``electrons``, changed in place."""
    electrons *= pattern.sensitivity
    if pattern.hot_e is not None:
        electrons += pattern.hot_e
    return electrons


def _stream(sensor: Sensor, stream: int) -> np.random.Generator:
    return np.random.default_rng([sensor.seed, stream])
