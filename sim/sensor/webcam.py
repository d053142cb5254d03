"""The webcam: lens, sensor and coding, one after the other.

The lens acts on layers as fine as they are; what follows acts on whole pixels: noise, colour
filter, full well, gain and coding.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from lscan.errors import InputError
from lscan.files.pictures import STEPS_PER_DN, eight_bit
from lscan.records import Bytes, Picture as RgbPicture
from sim.render.layers import binned, fineness_of, finer_lens
from sim.scene import Lens, Scene
from sim.scene.instrument import FULL_SCALE_DN, Response, Sensor
from sim.sensor.radiometry import (
    AMBIENT_NM,
    add_speckle,
    photons_per_radiance,
    speckle_contrast,
    speckle_pattern,
    vignetting,
)

if TYPE_CHECKING:
    from sim.render.layers import Layers


# Picture after picture of a place where nothing moves: only what differs is computed anew.


@dataclass(frozen=True)
class StillView:
    """Electrons that the sensor expects of one place, apart from noise.

    Attributes
    ----------
    sensor : Sensor, of the camera
    pattern : FixedPattern, fixed pattern of the pixels
    filter : ColourFilter or None, colour filter, None where every pixel sees all colours
    steady : (H, W, 3) array, or (H, W) behind a colour filter, electrons of all light without
        speckle
    direct : array, electrons of the light with speckle, only the rows that have any
    first_row : int, row of the picture at which ``direct`` begins
    contrast : float, of the speckle
    """

    sensor: Sensor
    pattern: FixedPattern
    filter: ColourFilter | None
    steady: Electrons
    direct: Electrons
    first_row: int
    contrast: float

    def picture(self, generator: np.random.Generator) -> Bytes:
        """The next picture, (H, W, 3) uint8, RGB, whatever the camera's bits.

        Parameters
        ----------
        generator : Generator, speckle and noise come from it
        """
        expected = self.steady
        if self.direct.size:
            expected = expected.copy()
            height, width = self.direct.shape[:2]
            speckle = speckle_pattern((height, width), self.contrast, generator)
            if self.direct.ndim == 3:
                speckle = speckle[..., np.newaxis]
            expected[self.first_row : self.first_row + height] += self.direct * speckle
        read = read_out(expected, self.sensor, self.pattern, generator)
        return eight_bit(digitise(read, self.sensor, self.filter))


# The lens's point spread: a core, and the glare around it.


def point_spread(picture: Picture, lens: Lens) -> Picture:
    """The picture, (H, W) of any unit, as the lens spreads it; no light is lost.

    (1 - glare) of the light stays in a Gaussian core of ``blur_px``, the rest goes into a
    Gaussian of ``glare_px``.  The picture is mirrored at its borders: what leaves it there
    stands for what would come in.  Defocus and motion are rendered, not added here.
    """
    core = _gaussian(picture, lens.blur_px)
    if lens.glare == 0:
        return core
    wide = _gaussian(picture, lens.glare_px)
    return np.float32(1 - lens.glare) * core + np.float32(lens.glare) * wide


def _gaussian(picture: Picture, sigma_px: float) -> Picture:
    if sigma_px == 0:
        return picture
    blurred = cv2.GaussianBlur(picture, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    return np.asarray(blurred, dtype=np.float32)


# The webcam: lens, sensor and coding, one after the other.


class Webcam:
    """Lens and sensor of a scene; its fixed patterns stay the same from picture to picture."""

    def __init__(self, scene: Scene) -> None:
        """Draw the fixed patterns from the sensor's seed.

        Parameters
        ----------
        scene : Scene, its lens, sensor and laser
        """
        self.lens, self.sensor = scene.tank.lens, scene.tank.sensor
        self.wavelength_nm = scene.tank.laser.wavelength_nm
        camera = scene.rig.camera
        self._shape, self._bits = (camera.height_px, camera.width_px), camera.bits
        self._fine = cache(self._fine_lens)
        self._contrast = lru_cache(1)(self._speckle_contrast)
        bayer = self.sensor.bayer
        self._filter = None if bayer == "none" else ColourFilter(bayer, self._shape)
        pixels = (*self._shape, 3) if self._filter is None else self._shape
        self._pattern = fixed_pattern(self.sensor, pixels) if self.sensor.noise else None

    def expose(
        self,
        layers: Layers,
        exposure_ms: float,
        generator: np.random.Generator,
        wavelength_nm: float | None = None,
    ) -> RgbPicture:
        """The picture of the layers, (H, W, 3), RGB, uint8, or uint16 of more than 8 bits.

        With ``noise = false`` nothing is random: no speckle, no fixed pattern either.

        Parameters
        ----------
        layers : Layers, (f H, f W) radiances, for any whole f
        exposure_ms : float, ms
        generator : Generator, all noise comes from it
        wavelength_nm : float or None, the laser's at this moment, the scene's nominal one if None

        Raises
        ------
        InputError
            The layers are no whole multiple of the picture.
        """
        nm = self.wavelength_nm if wavelength_nm is None else wavelength_nm
        if contrast := self._contrast(nm):
            # A new pattern for each picture: the head moves between them.
            laser = add_speckle(self._photons(layers.direct, exposure_ms, nm), contrast, generator)
            laser += self._photons(layers.scattered, exposure_ms, nm)
        else:
            laser = self._photons(layers.laser, exposure_ms, nm)
        electrons = self._on_pixels(self._electrons(laser, layers, exposure_ms))
        if self._pattern is not None:
            expected = with_pattern(electrons, self._pattern)
            electrons = read_out(expected, self.sensor, self._pattern, generator)
        picture = digitise(electrons, self.sensor, self._filter, self._bits)
        return through_jpeg(picture, self.sensor)

    def without_noise(self) -> Webcam:
        """The same webcam with the speckle that it has, but no noise of its own."""
        same = copy(self)
        same._pattern = None
        return same

    def taking(self, scene: Scene) -> Webcam:
        """The same webcam with the gain of one picture.

        Parameters
        ----------
        scene : Scene, the webcam's own as ``sim.scene.at_moment`` makes it
        """
        same = copy(self)
        same.sensor = self.sensor.model_copy(update={"gain": scene.tank.sensor.gain})
        return same

    def still(self, layers: Layers, exposure_ms: float) -> StillView:
        """The layers as seen again and again by a camera that stands still.

        Its pictures are those of ``expose``, the nominal wavelength's, without the scene's own
        JPEG.

        Parameters
        ----------
        layers : Layers, (f H, f W) radiances, for any whole f
        exposure_ms : float, ms

        Raises
        ------
        InputError
            The sensor has no noise, so that all pictures would be the same, or the layers are no
            whole multiple of the picture.
        """
        if self._pattern is None:
            raise InputError("sensor.noise: without it all pictures are the same", allowed="true")
        nm, sensor, pattern = self.wavelength_nm, self.sensor, self._pattern
        contrast = self._contrast(nm)
        other = self._photons(layers.scattered if contrast else layers.laser, exposure_ms, nm)
        rest = self._electrons(other, layers, exposure_ms)
        steady = with_pattern(self._on_pixels(rest), pattern)
        photons = self._photons(layers.direct, exposure_ms, nm) if contrast else 0 * other
        lit = np.flatnonzero((photons > 0).any(axis=1))
        first, end = (int(lit[0]), int(lit[-1]) + 1) if lit.size else (0, 0)
        seen = self._on_pixels(_colour_electrons(photons, sensor.laser_response))
        direct = np.ascontiguousarray((seen * pattern.sensitivity)[first:end])
        return StillView(sensor, pattern, self._filter, steady, direct, first, contrast)

    def mean_electrons(
        self, layers: Layers, exposure_ms: float, wavelength_nm: float | None = None
    ) -> Electrons:
        """Expected electrons, (H, W, 3) RGB, before colour filter, noise and full well.

        Parameters
        ----------
        layers : Layers, (f H, f W) radiances, for any whole f
        exposure_ms : float, ms
        wavelength_nm : float or None, the laser's at this moment, the scene's nominal one if None
        """
        nm = self.wavelength_nm if wavelength_nm is None else wavelength_nm
        return self._electrons(self._photons(layers.laser, exposure_ms, nm), layers, exposure_ms)

    def metered_ms(
        self,
        layers: Layers,
        target_dn: float,
        percentile: float,
        wavelength_nm: float | None = None,
    ) -> float:
        """Exposure in ms that puts the bright end of the mean picture at ``target_dn``.

        It depends on the layers alone, not on noise.

        Parameters
        ----------
        layers : Layers, (f H, f W) radiances, for any whole f
        target_dn : float, grey value, DN
        percentile : float, over the pixels, of their brightest colour: the bright end
        wavelength_nm : float or None, the laser's at this moment, the scene's nominal one if None

        Returns
        -------
        Exposure, ms; infinite where the picture is dark.
        """
        brightest = self.mean_electrons(layers, 1.0, wavelength_nm).max(axis=-1)
        per_ms = float(np.percentile(brightest, percentile))
        return electrons_of(target_dn, self.sensor) / per_ms if per_ms > 0 else float("inf")

    def _electrons(self, laser: Picture, layers: Layers, exposure_ms: float) -> Electrons:
        """(H, W, 3) electrons of the laser's photons and of the ambient light."""
        electrons = _colour_electrons(laser, self.sensor.laser_response)
        if layers.ambient.any():
            ambient = self._photons(layers.ambient, exposure_ms, AMBIENT_NM)
            electrons += _colour_electrons(ambient, self.sensor.ambient_response)
        return electrons

    def _on_pixels(self, electrons: Electrons) -> Electrons:
        """What of (H, W, 3) electrons the pixels collect: (H, W) behind a colour filter."""
        return electrons if self._filter is None else self._filter.mosaic(electrons)

    def _photons(self, radiance: Picture, exposure_ms: float, wavelength_nm: float) -> Picture:
        """(H, W) photons a pixel collects from (f H, f W) radiance in W/(m2 sr)."""
        factor = photons_per_radiance(self.lens, self.sensor, exposure_ms, wavelength_nm)
        fineness = fineness_of(radiance.shape, self._shape)
        lens, falloff = self._fine(fineness)
        return binned(point_spread(radiance * (np.float32(factor) * falloff), lens), fineness)

    def _fine_lens(self, fineness: int) -> tuple[Lens, Picture]:
        """The lens in parts of a pixel, and its (f H, f W) vignetting."""
        lens = finer_lens(self.lens, fineness)
        height, width = self._shape
        return lens, vignetting(lens, (fineness * width, fineness * height))

    def _speckle_contrast(self, laser_nm: float) -> float:
        """That of a pixel; 0 where the sensor shows no speckle."""
        light = self.sensor.speckle
        if light == "none" or not self.sensor.noise:
            return 0.0
        return speckle_contrast(self.sensor.pixel_um, self.lens.f_number, laser_nm, light)


def _colour_electrons(photons: Picture, response: Response) -> Electrons:
    """(H, W, 3) electrons, RGB, of (H, W) photons."""
    shares = response.red, response.green, response.blue
    planes = cv2.merge([photons * np.float32(share) for share in shares])
    return np.asarray(planes, dtype=np.float32)


# From electrons to the bytes of a picture: noise, colour filter, full well, gain and coding.


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


# From electrons to the bytes of a picture: full well, gain, gamma, 8 bits or more, MJPEG.


SUBSAMPLING = {
    "4:4:4": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    "4:2:2": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    "4:2:0": cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
}


def digitise(
    electrons: Picture, sensor: Sensor, colours: ColourFilter | None = None, bits: int = 8
) -> RgbPicture:
    """Digital numbers of the electrons: full well, gain, filled in colours, gamma, bits, frame.

    The same shape; (H, W, 3) RGB of the (H, W) electrons behind a colour filter.  More bits divide
    a DN further; the range ends where it ends with 8.

    Parameters
    ----------
    electrons : array, electrons read out
    sensor : Sensor, its gain, gamma, black level, full well, range and frame
    colours : ColourFilter or None, the filter before the pixels
    bits : int, of the camera, 8 to 16: from 10 on the picture is uint16
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
    if bits == 8:
        image = np.minimum(np.rint(linear, out=linear).astype(np.uint8), np.uint8(sensor.clips_dn))
        dn = 1
    else:
        np.minimum(linear, np.float32(sensor.clips_dn), out=linear)
        steps = np.rint(linear * np.float32(2 ** (bits - 8)))
        image = steps.astype(np.uint16) * np.uint16(2 ** (16 - bits))
        dn = STEPS_PER_DN
    if sensor.frame_dn is not None:
        image[[0, -1]] = image[:, [0, -1]] = dn * sensor.frame_dn
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


def through_jpeg(image: RgbPicture, sensor: Sensor) -> RgbPicture:
    """The picture coded and decoded as one of MJPEG's; unchanged without one.

    Parameters
    ----------
    image : (H, W, 3) array, RGB, uint8 where the sensor states a quality
    sensor : Sensor, its quality and subsampling
    """
    if sensor.jpeg_quality is None:
        return image
    coded = jpeg_bytes(eight_bit(image), sensor.jpeg_quality, sensor.jpeg_subsampling)
    return from_jpeg(coded)


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
