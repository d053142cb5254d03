"""The line as a pixel sees it: a Gaussian averaged over the pixel, on a sloping ground.

    mu(x) = A · 1/1px · integral from x - 1/2 to x + 1/2 of exp(-(y - c)²/(2 s²)) dy + b + t x

The parameters stand in an array (K, 5), one line a row: centre c in px from the middle pixel
of the window, ln of the width s in px, ln of the height A in DN, ground b in DN, its slope t
in DN/px.  The logarithms keep width and height positive however a fit wanders.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from lscan.records import Floats

CENTRE, LN_WIDTH, LN_HEIGHT, GROUND, TILT = range(5)
_ROOT_TWO_PI = np.sqrt(2 * np.pi)

_FINE, _FARTHEST = 256, 9
_NDTR = ndtr(np.arange(-_FARTHEST * _FINE, _FARTHEST * _FINE + 1) / _FINE)
"""Phi at steps of 1 / 256.  Half a step aside the first three terms of its Taylor series leave
(1 / 512)^4 / 24 of its fourth derivative, which is below 0.6: 4e-13."""


@dataclass(frozen=True)
class CrossSections:
    """K lines as n pixels see them, and how that changes with the parameters.

    In memory the K values of a pixel lie together: K is long, n is short.

    Attributes
    ----------
    light : (K, n) array, DN, the line itself
    ground : (K, n) array, DN, what lies under it
    jacobian : (K, 5, n) array, derivative of their sum by each parameter
    """

    light: Floats
    ground: Floats
    jacobian: Floats


def lines(parameters: Floats, steps: Floats) -> CrossSections:
    """The lines of some parameters at pixels.

    Parameters
    ----------
    parameters : (K, 5) array, px and DN, see the module's text
    steps : (n,) array, px, consecutive pixels, from the middle one
    """
    centre, ln_width, ln_height, ground, tilt = np.ascontiguousarray(parameters.T)
    width, height = np.exp(ln_width), np.exp(ln_height)
    edges = np.append(steps - 0.5, steps[-1] + 0.5)[:, None]
    distance = edges - centre
    distance /= width
    density = exp(-0.5 * np.square(distance))
    below, moment = _ndtr(distance, density), distance * density
    by = np.empty((5, len(steps), len(parameters)))
    light = np.subtract(below[1:], below[:-1], out=by[LN_HEIGHT])
    light *= height * width * _ROOT_TWO_PI
    np.subtract(density[:-1], density[1:], out=by[CENTRE])
    by[CENTRE] *= height
    np.subtract(moment[:-1], moment[1:], out=by[LN_WIDTH])
    by[LN_WIDTH] *= height * width
    by[LN_WIDTH] += light
    by[GROUND] = 1.0
    by[TILT] = steps[:, None]
    under = tilt * steps[:, None]
    under += ground
    return CrossSections(light.T, under.T, by.transpose(2, 0, 1))


def exp(x: Floats) -> Floats:
    """The exponential function by OpenCV, in a fifth of the time that NumPy takes for many values.

    Parameters
    ----------
    x : array, of one dimension or two
    """
    return np.asarray(cv2.exp(x), float).reshape(x.shape) if x.size else x


def _ndtr(x: Floats, bell: Floats) -> Floats:
    """Phi(x), from ``bell`` = exp(-x² / 2): a tenth of the time that SciPy's ndtr takes."""
    place = np.rint(x * _FINE)
    aside = place * (-1 / _FINE)
    aside += x
    series = np.square(x)
    series -= 1.0
    for factor, term in ((1 / 3, x), (1 / 2, 1.0)):
        series *= aside
        series *= factor
        series += term
    aside *= 1 / _ROOT_TWO_PI
    series *= aside
    series *= bell
    place += _FARTHEST * _FINE
    series += _NDTR.take(place.astype(np.int64), mode="clip")
    return series


def parameters_of(
    centre: Floats, width: Floats, height: Floats, ground: Floats, tilt: Floats
) -> Floats:
    """The parameters (K, 5) of lines, see the module's text.

    Parameters
    ----------
    centre, width : (K,) array, px
    height, ground : (K,) array, DN
    tilt : (K,) array, DN/px
    """
    return np.column_stack([centre, np.log(width), np.log(height), ground, tilt])
