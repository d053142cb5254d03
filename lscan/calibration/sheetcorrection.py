"""A change of scale and of origin made to the points that a plane map gives."""

from typing import Annotated

import numpy as np
from pydantic import Field

from lscan.calibration.evaluate import Estimate
from lscan.calibration.stored import NotNegative, Pair, Place
from lscan.config.documents import Strict

MOST_SCALE = 0.5  # more is a picture of another board, not a rig that has changed


class SheetCorrection(Strict):
    """What a later picture of the board showed to be wrong with a map's points, and is taken off.

    Attributes
    ----------
    middle_mm : (2,) array, mm, (x, z), about which lengths are scaled
    scale, scale_sigma : float, lengths as they were mapped over true lengths, less 1; at most
        MOST_SCALE either way
    shift_mm, shift_sigma_mm : (2,) array, mm, of the middle as it was mapped from where it is
    """

    middle_mm: Place
    scale: Annotated[float, Field(ge=-MOST_SCALE, le=MOST_SCALE)] = 0.0
    scale_sigma: NotNegative = 0.0
    shift_mm: Place = np.zeros(2)
    shift_sigma_mm: Pair = np.zeros(2)

    def apply(self, estimate: Estimate) -> Estimate:
        """The estimate without those errors; the uncertainty of the correction is added.

        Parameters
        ----------
        estimate : Estimate, mm, of N pixels
        """
        factor = 1 / (1 + self.scale)
        arm = factor * (estimate.xz_mm - self.middle_mm - self.shift_mm)
        own = np.zeros((len(arm), 2, 3))
        own[:, :, 0] = -factor * self.scale_sigma * arm
        own[:, [0, 1], [1, 2]] = factor * self.shift_sigma_mm
        variance = factor**2 * estimate.variance_mm2 + (own**2).sum(axis=2)
        modes = estimate.modes_mm
        if modes is not None:
            modes = np.concatenate([factor * modes, own], axis=2)
        return Estimate(self.middle_mm + arm, variance, modes)
