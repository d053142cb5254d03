"""From electrons to the bytes of a picture: noise, colour filter, full well, gain and coding."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from lscan.records import Bytes
from sim.scene.instrument import FULL_SCALE_DN, Sensor

# Random numbers of the standard normal distribution, in a third of the time of NumPy's.


WORDS = 1 << 16  # as many equal parts of the distribution as a random word of 16 bits tells
# Parts on either side that are too wide for one number to stand for: the next, at 3.1, are a
# 200th wide, and a camera's rounding to whole grey values is coarser than any of them.
FAR = 64
_MIDDLES = ndtri((np.arange(WORDS) + 0.5) / WORDS).astype(np.float32)


def standard_normal(generator: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Normal numbers of mean 0 and variance 1, of the given shape.

    The distribution is cut into WORDS parts of equal probability.  One is drawn, and its middle
    taken; in the FAR parts on either side a place within the part is drawn as well.

    Parameters
    ----------
    generator : Generator, of any bits
    shape : tuple of int

    References
    ----------
    Inversion of the distribution function: Devroye, Non-Uniform Random Variate Generation (1986),
    sec. II.2.

    Examples
    --------
    >>> standard_normal(np.random.default_rng(1), (2, 3)).shape
    (2, 3)
    """
    count = int(np.prod(shape))
    word = generator.bit_generator.random_raw(-(-count // 4)).view(np.uint16)[:count]
    drawn = _MIDDLES.take(word)
    part = np.minimum(word, ~word)  # counted from the nearer end
    far = np.flatnonzero(part < FAR)
    beyond = ndtri((part[far] + generator.random(len(far))) / WORDS)
    drawn[far] = np.where(word[far] < FAR, beyond, -beyond)
    return drawn.reshape(shape)


# Noise of the EMVA 1288 linear model: shot and dark noise, and the pixels' fixed patterns.


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
    """Electrons read out of those expected, as ``with_pattern`` gives them, same shape.

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


def with_pattern(electrons: Electrons, pattern: FixedPattern) -> Electrons:
    """Electrons to be expected in these very pixels: ``electrons``, changed in place."""
    electrons *= pattern.sensitivity
    if pattern.hot_e is not None:
        electrons += pattern.hot_e
    return electrons


def _stream(sensor: Sensor, stream: int) -> np.random.Generator:
    return np.random.default_rng([sensor.seed, stream])


# The colour filter before the pixels, and how a webcam fills in what it hides.


Picture = NDArray[np.float32]

CHANNELS = "RGB"
# Weights with which a pixel's neighbours make up its colour.  A colour on every other pixel
# of every other row is interpolated along both axes; green stands on every other pixel of
# every row, where four neighbours count alike.
SPARSE = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]], np.float32) / 4
QUINCUNX = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32) / 4


class ColourFilter:
    """A Bayer filter over a sensor."""

    def __init__(self, pattern: str, shape: tuple[int, int]) -> None:
        """Lay a pattern over a sensor.

        Parameters
        ----------
        pattern : str, colours of the 2 by 2 pixels at the top left, row by row, such as "RGGB"
        shape : tuple of int, (H, W) of the sensor, px
        """
        height, width = shape
        cell = np.array([CHANNELS.index(colour) for colour in pattern]).reshape(2, 2)
        repeats = ((height + 1) // 2, (width + 1) // 2)
        self._channel = np.tile(cell, repeats)[:height, :width]
        self._masks = [(self._channel == k).astype(np.float32) for k in range(len(CHANNELS))]
        self._weights = [
            _gather(mask, colour) for mask, colour in zip(self._masks, CHANNELS, strict=True)
        ]

    def mosaic(self, picture: Picture) -> Picture:
        """(H, W): what each pixel sees through its colour.

        Parameters
        ----------
        picture : (H, W, 3) array, RGB, of any unit
        """
        return np.take_along_axis(picture, self._channel[..., None], axis=-1)[..., 0]

    def demosaic(self, mosaic: Picture) -> Picture:
        """(H, W, 3) RGB, bilinear between the pixels of each colour.

        At the border the neighbours there are share the weight of those that are not.

        Parameters
        ----------
        mosaic : (H, W) array, of any unit, as :meth:`mosaic` gives it
        """
        planes = [
            _gather(mosaic * mask, colour) / weight
            for mask, weight, colour in zip(self._masks, self._weights, CHANNELS, strict=True)
        ]
        return np.stack(planes, axis=-1)


def _gather(plane: Picture, colour: str) -> Picture:
    kernel = QUINCUNX if colour == "G" else SPARSE
    gathered = cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(gathered, dtype=np.float32)


# From electrons to the bytes of a picture: full well, gain, gamma, 8 bit, MJPEG.


SUBSAMPLING = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}


def digitise(electrons: Picture, sensor: Sensor, colours: ColourFilter | None = None) -> Bytes:
    """Digital numbers of the electrons: full well, gain, filled in colours, gamma, 8 bit, frame.

    The same shape; (H, W, 3) RGB of the (H, W) electrons behind a colour filter.

    Parameters
    ----------
    electrons : array, electrons read out
    sensor : Sensor, its gain, gamma, black level, full well, range and frame
    colours : ColourFilter or None, the filter before the pixels
    """
    linear = np.minimum(electrons, np.float32(sensor.full_well_e))
    linear *= np.float32(_gain(sensor))
    linear += np.float32(sensor.black_level_dn)
    # Dark noise may pull a pixel below zero electrons; only the black level keeps it in range.
    np.clip(linear, 0.0, FULL_SCALE_DN, out=linear)
    if colours is not None:
        linear = colours.demosaic(linear)
    if sensor.gamma != 1:
        linear = FULL_SCALE_DN * (linear / FULL_SCALE_DN) ** (1 / sensor.gamma)
    image = np.minimum(np.rint(linear, out=linear).astype(np.uint8), np.uint8(sensor.clips_dn))
    if sensor.frame_dn is not None:
        image[[0, -1]] = image[:, [0, -1]] = sensor.frame_dn
    return image


def electrons_of(dn: float, sensor: Sensor) -> float:
    """Electrons that ``digitise`` makes ``dn`` of, as far as full well and range go.

    Zero or less where ``dn`` is not above the black level.

    Parameters
    ----------
    dn : float, grey value, DN, 0 to 255
    sensor : Sensor, its gain, gamma, black level and full well
    """
    linear = FULL_SCALE_DN * (min(dn, sensor.clips_dn) / FULL_SCALE_DN) ** sensor.gamma
    return min((linear - sensor.black_level_dn) / _gain(sensor), sensor.full_well_e)


def through_jpeg(image: Bytes, sensor: Sensor) -> Bytes:
    """The picture coded and decoded as one of MJPEG's; unchanged without one.

    Parameters
    ----------
    image : (H, W, 3) uint8 array, RGB
    sensor : Sensor, its quality and subsampling
    """
    if sensor.jpeg_quality is None:
        return image
    return from_jpeg(jpeg_bytes(image, sensor.jpeg_quality, sensor.jpeg_subsampling))


def jpeg_bytes(image: Bytes, quality: int, subsampling: str) -> bytes:
    """The picture as a JPEG file.

    Parameters
    ----------
    image : (H, W, 3) uint8 array, RGB
    quality : int, 1 to 100, as libjpeg counts
    subsampling : str, of the chroma, a key of SUBSAMPLING
    """
    settings = [
        cv2.IMWRITE_JPEG_QUALITY, quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SUBSAMPLING[subsampling],
    ]  # fmt: skip
    _, coded = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)
    return coded.tobytes()


def from_jpeg(coded: bytes) -> Bytes:
    """The picture of a JPEG file that ``jpeg_bytes`` made; (H, W, 3) uint8, RGB.

    Parameters
    ----------
    coded : bytes, the whole file
    """
    decoded = cv2.imdecode(np.frombuffer(coded, np.uint8), cv2.IMREAD_COLOR)
    assert decoded is not None
    return np.asarray(cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _gain(sensor: Sensor) -> float:
    """DN per electron."""
    return sensor.gain * FULL_SCALE_DN / sensor.full_well_e
