"""The layers of light that a picture is made of, as a picture of their logarithms."""

from dataclasses import dataclass, replace

import numpy as np

from lscan.records import Bytes, Floats

STEPS = 16  # to a factor of two: rounding makes 2.2 %
LEAST_DN = 0.25  # beneath, steps are even: rounding makes 0.006 DN at 0 and 0.01 DN there


@dataclass(frozen=True)
class LightLayers:
    """What reaches the lens from each pixel's direction, without noise, blur or clipping.

    In the unit of light that lifts a pixel on the axis from black by one digital number in that
    picture.

    Attributes
    ----------
    direct : (H, W) array, DN, laser light reflected once, by the surface the laser itself lit
    scattered : (H, W) array, DN, all other laser light: veil, halo, reflections of the line
    ambient : (H, W) array, DN, everything that is not the laser's
    """

    direct: Floats
    scattered: Floats
    ambient: Floats

    def turned(self) -> "LightLayers":
        """As a camera sees them whose columns are the other's rows."""
        return replace(self, **{name: layer.T for name, layer in vars(self).items()})


def layers_picture(layers: LightLayers) -> Bytes:
    """(H, W, 3) uint8, a channel for each layer: STEPS log2(1 + layer / LEAST_DN), rounded.

    255 stands for 15,700 DN and all above.

    Parameters
    ----------
    layers : LightLayers
    """
    light = np.stack([layers.direct, layers.scattered, layers.ambient], axis=-1)
    return np.clip(np.rint(STEPS * np.log2(1 + light / LEAST_DN)), 0, 255).astype(np.uint8)


def layers_of_picture(picture: Bytes) -> LightLayers:
    """The layers that ``layers_picture`` wrote, to its rounding.

    Parameters
    ----------
    picture : (H, W, 3) array, uint8
    """
    light = LEAST_DN * (np.exp2(np.arange(256) / STEPS) - 1)
    return LightLayers(*(light[picture[..., k]] for k in range(3)))
