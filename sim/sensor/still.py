"""Picture after picture of a place where nothing moves: only what differs is computed anew."""

from dataclasses import dataclass

import numpy as np

from lscan.records import Bytes
from sim.scene import Sensor
from sim.sensor.coding import digitise
from sim.sensor.colour import ColourFilter
from sim.sensor.noise import Electrons, FixedPattern, read_out
from sim.sensor.speckle import speckle_pattern


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
