"""The colour filter before the pixels, and how a webcam fills in what it hides."""

import cv2
import numpy as np
from numpy.typing import NDArray

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
