"""The lens's point spread: a core, and the glare around it."""

import cv2
import numpy as np

from sim.scene import Lens
from sim.sensor.colour import Picture


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
