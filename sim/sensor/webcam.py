"""The webcam: lens, sensor and coding, one after the other.

The lens acts on layers as fine as they are; what follows acts on whole pixels.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes
from sim.render.layers import binned, fineness_of, finer_lens
from sim.scene import Lens, Scene, Sensor
from sim.scene.instrument import Response
from sim.sensor.noise import (
    ColourFilter,
    Electrons,
    FixedPattern,
    Picture,
    digitise,
    electrons_of,
    fixed_pattern,
    read_out,
    through_jpeg,
    with_pattern,
)
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
        """The next picture, (H, W, 3) uint8, RGB.

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
        return digitise(read, self.sensor, self.filter)


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
        self._shape = (camera.height_px, camera.width_px)
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
    ) -> Bytes:
        """The picture of the layers, (H, W, 3) uint8, RGB.

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
        return through_jpeg(digitise(electrons, self.sensor, self._filter), self.sensor)

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
