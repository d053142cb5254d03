"""Noise and misfit: how the pixels of neighbouring columns scatter about their lines.

No laser line is quite a Gaussian.  What it differs by is much the same in the next column, and
noise is not.  So half the squared difference of two neighbours' residuals is the variance of
the noise, and their product is the square of the misfit.  Of the misfit only the odd part, of
opposite signs on either side of the peak, moves the centre.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from lscan.records import Floats, Ints, Mask
from lscan.stripe.fit import LineFit
from lscan.stripe.noise.model import Noise, robust_variance, scatter_noise

_FEWEST = 8  # pairs of columns, some hundred pixels
_SIDEWAYS_PX = 3  # farther apart along the column, two peaks are of two lines
_FAINT = 0.005  # of the line's height: what Gaussians have beyond 3.3 standard deviations
_BEYOND_CHANCE = 4.0  # standard deviations of a variance
# Relative variance of robust_variance, times the values: 1.83 within 3 sigma, divided by
# (1 - 0.11)^2, for the cut follows what is found.  A column may be in two pairs, whose squares
# correlate by 1/4; those of second differences do by 4/9 and 1/36.
_OF_PAIRS, _OF_SECOND_DIFFERENCES = 2.32 * (1 + 2 / 4), 2.32 * (1 + 8 / 9 + 2 / 36)
_CORE = 5.0  # standard deviations within which pixels are used


@dataclass(frozen=True)
class Scatter:
    """Pixels of lines, P of each kind.

    Attributes
    ----------
    light : (P,) array, DN, that the line has there
    different : (P,) array, DN², on average the variance of the noise
    common : (P,) array, DN², on average twice the square of the misfit's odd part: of errors
        independent from pixel to pixel it would take as much to move the centre as far
    faint : (P,) mask, of the pixels nearly without light
    """

    light: Floats
    different: Floats
    common: Floats
    faint: Mask

    def noise(self, constant: float, pixels: int) -> Noise:
        """The noise, where that of the pixels far from the line is known.

        Beside the line it may be more, by more than chance: compressed pictures are noisy only
        where something is.

        Parameters
        ----------
        constant : float, DN², variance of the pixels far from the line
        pixels : int, second differences that it is known from
        """
        faint = np.sqrt(self.different[self.faint])
        beside = robust_variance(faint)
        chance = 1 + _BEYOND_CHANCE * chance_of_variances(len(faint), pixels)
        beside = beside if beside > constant * chance else constant
        return scatter_noise(self.different, self.light, beside)

    def misfit(self, noise: Noise) -> float:
        """Deviation of the lines from Gaussians, as a share of their light.

        Least squares of ``common`` on light², weighted by the inverse of its variance.

        Parameters
        ----------
        noise : Noise, of the pixels
        """
        variance = noise.variance(self.light)
        core = np.abs(self.common) <= _CORE**2 * variance
        weight = core * self.light**2 / np.maximum(variance, 1e-3 * self.light**2) ** 2
        total = float((weight * self.light**2).sum())
        square = float((weight * self.common).sum()) / total if total > 0 else 0.0
        return min(max(square, 0.0) ** 0.5, 1.0)


def chance_of_variances(pairs: int, pixels: int) -> float:
    """Relative standard deviation of a variance of pairs of columns over one of pixels afar.

    Parameters
    ----------
    pairs : int, pixels of the pairs
    pixels : int, second differences down columns
    """
    return sqrt(_OF_PAIRS / max(pairs, 1) + _OF_SECOND_DIFFERENCES / max(pixels, 1))


def scatter_of(fit: LineFit, columns: Ints, rows: Ints) -> Scatter:
    """The pixels of those fitted lines that have a neighbour, each with its neighbour's.

    With next to no neighbours all scatter counts as noise.

    Parameters
    ----------
    fit : LineFit, px and DN, of K columns
    columns, rows : (K,) array, place of the lines' middle pixels in the picture, columns rising
    """
    first = np.flatnonzero((np.diff(columns) == 1) & (np.abs(np.diff(rows)) <= _SIDEWAYS_PX))
    if len(first) < _FEWEST:
        first = second = np.arange(len(columns))
    else:
        second = first + 1
    # The windows lie even about the peaks: turned round, a pixel meets its mirror image.
    seen = fit.seen[first] & fit.seen[second]
    seen &= seen[:, ::-1]
    light = ((fit.light[first] + fit.light[second]) / 2)[seen]
    height = np.broadcast_to(fit.light[first].max(axis=1, keepdims=True), seen.shape)[seen]
    one, other = fit.residual[first], fit.residual[second]
    if first is second:
        return Scatter(light, one[seen] ** 2, np.zeros_like(light), light < _FAINT * height)
    odd = (one - one[:, ::-1]) * (other - other[:, ::-1]) / 4
    different = (one - other)[seen] ** 2 / 2
    return Scatter(light, different, 2 * odd[seen], light < _FAINT * height)
