"""How wide the laser line is in a picture."""

import numpy as np

from lscan.records import Floats, GreyValues, Ints
from lscan.stripe.peaks import windows

_REACH_PX = 30
FWHM = float(2 * np.sqrt(2 * np.log(2)))
"""Full width at half height of a Gaussian, of its standard deviation."""
_NARROWEST_PX = 0.5  # a line that falls into one pixel shows half a pixel's width


def line_width(columns: GreyValues, at: Ints, crest: Ints) -> float:
    """Standard deviation in px, along the columns, of a Gaussian as wide as the line.

    The columns are laid over each other with their brightest pixels together; the width is
    that of their mean profile at half its height above its lowest value, over 2.355.  A
    clipped crest widens it, as a bright line's is to be.  Never below 0.5 px.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at : (K,) array, indices of the columns that have a line, at least one
    crest : (K,) array, px, row of the highest value of each of those
    """
    reach = min(_REACH_PX, columns.shape[1] - 1)
    profile = windows(columns, at, crest, reach).mean(axis=0)
    half = (profile[reach] + profile.min()) / 2
    fwhm = _reach(profile[reach:], half) + _reach(profile[reach::-1], half)
    return max(fwhm / FWHM, _NARROWEST_PX)


def _reach(flank: Floats, level: float) -> float:
    """Pixels from the first of a flank to where it first falls to a level, or to its end."""
    low = flank <= level
    at = int(low.argmax())
    if not low[at]:
        return float(len(flank) - 1)
    return at - float((level - flank[at]) / (flank[at - 1] - flank[at])) if at else 0.0
