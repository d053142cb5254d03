"""The layers of light that reach the lens, as the tank renders them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lscan.errors import InputError
from sim.scene import Lens

# Pictures finer than their pixels: a lens blurs light before the pixels gather it.
#
# Light gathered by whole pixels and blurred afterwards keeps what the pixels did to it: the
# centroid of a Gaussian line of sigma px is off by exp(-2 pi² sigma²) / pi sin(2 pi u) px, u its
# place in a pixel (the derivative at one line per pixel of the line's spectrum times the
# pixel's, sinc).  That is 0.05 px at 0.3 px, the width of a thin sheet on level ground.  With a
# pixel cut into ``fineness`` parts a side, blurred, and only then gathered, sigma counts in parts
# before the blur, and in pixels behind it: both exponentials are then gone.


Picture = NDArray[np.float32]


def fineness_of(shape: tuple[int, ...], picture: tuple[int, int]) -> int:
    """How many parts a side each pixel of a picture has in an array.

    Parameters
    ----------
    shape : (f H, f W) of the array
    picture : (H, W) of the picture

    Returns
    -------
    The whole number f.

    Raises
    ------
    InputError
        There is no whole f.
    """
    fineness = shape[0] // picture[0]
    if fineness < 1 or shape != (fineness * picture[0], fineness * picture[1]):
        height, width = picture
        allowed = f"({height}, {width}) or a whole multiple of it"
        raise InputError("layers and picture differ in size", value=shape, allowed=allowed)
    return fineness


def finer_lens(lens: Lens, fineness: float) -> Lens:
    """The lens in units of a part of a pixel instead of a pixel.

    The middle of pixel c is that of its parts f c to f c + f - 1: f c + (f - 1) / 2.

    Parameters
    ----------
    lens : Lens, in units of whole pixels
    fineness : float, parts a side of each pixel, f; below 1: of several pixels
    """
    u, v = (fineness * c + (fineness - 1) / 2 for c in lens.centre_px)
    return lens.model_copy(
        update={
            "focal_px": fineness * lens.focal_px,
            "centre_px": (u, v),
            "blur_px": fineness * lens.blur_px,
            "glare_px": fineness * lens.glare_px,
        }
    )


def binned(fine: Picture, fineness: int) -> Picture:
    """Means over the parts of each pixel, (H, W) float32, in the unit of ``fine``.

    Parameters
    ----------
    fine : (f H, f W) array
    fineness : int, parts a side of each pixel, f
    """
    if fineness == 1:
        return fine
    height, width = (side // fineness for side in fine.shape)
    means = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(means, dtype=np.float32)


def pixel_parts(picture: Picture, fineness: int) -> Picture:
    """A copy of a picture, (f H, f W), each pixel's parts as the pixel.

    Parameters
    ----------
    picture : (H, W) array
    fineness : int, parts a side of each pixel, f
    """
    if fineness == 1:
        return picture.copy()
    return picture.repeat(fineness, axis=0).repeat(fineness, axis=1)


# The layers of light that reach the lens, as the tank renders them.


Radiance = NDArray[np.float32]
W_PER_M2_IN_MW_PER_MM2 = 1e3  # 1 mW/mm2 is 1000 W/m2; scenes are in mW and mm


@dataclass(frozen=True)
class Layers:
    """What reaches the lens, W/(m2 sr) in the air behind the port.

    They are (H, W) float32 each; (f H, f W) where the scene's render has a fineness f: the lens has
    yet to blur them.

    Attributes
    ----------
    direct : array, laser light reflected once, by the surface the laser itself lit
    scattered : array, all other laser light: of the veil, the halo about the line, and reflections
        of the line
    ambient : array, everything that is not the laser's
    """

    direct: Radiance
    scattered: Radiance
    ambient: Radiance

    @property
    def laser(self) -> Radiance:
        """Direct and scattered light together."""
        return self.direct + self.scattered

    def without_laser(self) -> "Layers":
        """The ambient light alone."""
        none = np.zeros_like(self.ambient)
        return Layers(none, none, self.ambient)

    def binned(self, shape: tuple[int, int]) -> "Layers":
        """The layers of whole pixels: the means over the parts of each.

        Parameters
        ----------
        shape : (H, W) of the picture

        Raises
        ------
        InputError
            The layers are not a whole multiple of it.
        """
        fineness = fineness_of(self.direct.shape, shape)
        layers = (self.direct, self.scattered, self.ambient)
        return Layers(*(binned(layer, fineness) for layer in layers))
