"""Light of a line's core above the ground beside it: what shows where the line ends."""

import numpy as np

from lscan.records import Floats, GreyValues, Stripe, has_value
from lscan.stripe.peaks import windows_beside

CORE_PX = 2  # on either side of the centre: more would take in what walls beside a line throw back
GROUND_PX = (4, 6)
"""First and last pixel, on either side, that give the ground: clear of a line of 1.2 px, near
enough that a wall or a halo is as bright there as beneath the line."""


def core_flux(stripe: Stripe, *lights: GreyValues) -> Floats:
    """(N,) light within CORE_PX of the line's centre above the ground beside it, DN.

    NaN where the stripe has no value, and where no light is left above the ground.

    The ground is the mean of the pixels at GROUND_PX on both sides.  The halo of light that
    water scatters is as bright there as beneath the line; a lit wall that hangs from the line's
    end fills one half of the core and one of the two sides.  Both would otherwise fill the foot
    of the fall of light at that end, which shows where the line ends, and move it outwards.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    lights : array, DN, (N, L) with a row for each entry of the stripe; or several of one size, each
        with the rows of the next entries
    """
    flux = np.full(len(stripe.status), np.nan)
    valued = np.flatnonzero(has_value(stripe.status))
    row = np.rint(stripe.centre_px[valued]).astype(int)
    steps = np.abs(np.arange(-GROUND_PX[1], GROUND_PX[1] + 1))
    beside, core = steps >= GROUND_PX[0], steps <= CORE_PX
    weights = core * beside.sum() - beside * core.sum()  # whole: of even light nothing is left
    total = windows_beside(lights, valued, row, GROUND_PX[1]) @ weights / beside.sum()
    flux[valued] = np.where(total > 0, total, np.nan)
    return flux
