"""The layers of light that reach the lens, as the tank renders them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.render.fineness import binned, fineness_of

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
