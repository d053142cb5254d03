"""Maximum likelihood of Gaussian lines under the sensor's noise, many columns at once.

The noise of a pixel depends on its light (noise/model.py), so each step of Fisher's scoring weighs
the pixels by the variance that the line fitted so far gives them.  A clipped pixel enters
with the probability of what it says: the light was at least this (a censored observation,
Tobin 1958).
"""

from dataclasses import dataclass
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from lscan.records import Floats, Ints, Mask, select
from lscan.stripe.crosssection import CENTRE, CrossSections, lines
from lscan.stripe.noise.model import Noise

_Value = TypeVar("_Value", bound=np.generic)

_MOST_STEPS = 30
_FULL_STEPS = 10
"""Steps taken in full.  The weights follow the line, and now and then the line the weights, to
and fro: half steps end that."""

_SETTLED = 1e-4
"""A line is at rest where the step, squared, in units of the uncertainty is below this."""

_LONGEST_STEP = np.array([1.0, 0.35, 0.7, np.inf, np.inf])
"""Farthest a parameter may go in one step: beyond, the model is nothing like its tangent."""

_FAR = -1e3
"""Below, in standard deviations, the terms of a clipped pixel are their limits, -z and 1, to a
millionth: computed, they are differences of numbers that agree in all their digits."""

_LEAST = np.array([-np.inf, np.log(0.25), np.log(1e-3), -np.inf, -np.inf])
_MOST = np.array([np.inf, np.log(40.0), np.log(1e6), np.inf, np.inf])
"""Widths in px and heights in DN that a line can have; no picture distinguishes beyond."""


@dataclass(frozen=True)
class LineWindows:
    """The pixels about the peak of K columns, in windows of n pixels.

    Attributes
    ----------
    steps : (n,) array, px, place from the middle pixel
    grey : (K, n) array, DN
    base : (K,) array, DN, background of the whole column
    used : (K, n) mask, of the pixels that count: of the line and its near ground, and in the
        picture
    clipped : (K, n) mask, of the pixels that may have seen any amount of light from ``grey``
        upwards
    """

    steps: Floats
    grey: Floats
    base: Floats
    used: Mask
    clipped: Mask

    def of(self, chosen: Ints) -> "LineWindows":
        """Some of the columns alone.

        Parameters
        ----------
        chosen : (C,) array, indices among the K
        """
        grey, base = _of_lines(self.grey, chosen), self.base[chosen]
        used, clipped = _of_lines(self.used, chosen), _of_lines(self.clipped, chosen)
        return LineWindows(self.steps, grey, base, used, clipped)


def _of_lines(values: NDArray[_Value], chosen: Ints) -> NDArray[_Value]:
    """Some rows of an array in which, as in crosssection.py, columns lie together in memory."""
    return values.T.take(chosen, axis=1).T


@dataclass(frozen=True)
class LinePrior:
    """What is known of K lines beforehand.

    Attributes
    ----------
    mean : (K, 5) array, px and DN, expected parameters (crosssection.py)
    precision : (K, 5) array, 1/variance, 0 for nothing
    """

    mean: Floats
    precision: Floats


@dataclass(frozen=True)
class LineFit:
    """K fitted lines.

    Attributes
    ----------
    parameters : (K, 5) array, px and DN, as in crosssection.py
    covariance : (K, 5, 5) array, of them
    gain : (K, n) array, px/DN, how far the centre moves with each pixel
    settled : (K,) mask, whether the search came to rest
    light : (K, n) array, DN, the line at each pixel
    residual : (K, n) array, DN, what the pixel differs from the fit, made larger by as much as the
        fit, which follows the pixel, makes it smaller on average
    seen : (K, n) mask, of the pixels whose residual means something: used and not clipped
    misfit : (K,) array, mean of residual² over its variance, 1 where the noise explains all
    """

    parameters: Floats
    covariance: Floats
    gain: Floats
    settled: Mask
    light: Floats
    residual: Floats
    seen: Mask
    misfit: Floats


def fit_lines(view: LineWindows, start: Floats, noise: Noise, prior: LinePrior) -> LineFit:
    """The most probable lines in some windows.

    Parameters
    ----------
    view : LineWindows, px and DN, of K columns
    start : (K, 5) array, px and DN, where the search begins (crosssection.py)
    noise : Noise, of the pixels
    prior : LinePrior, of K lines

    References
    ----------
    Fisher's scoring; a clipped pixel is a censored observation (Tobin 1958).
    """
    parameters = _bounded(start)
    settled = np.zeros(len(start), dtype=bool)
    moving = np.arange(len(start))
    part, known = view, prior
    for turn in range(_MOST_STEPS):
        information, score, _ = _normal_equations(part, parameters[moving], noise, known)
        step = np.linalg.solve(information, score[..., None])[..., 0]
        done = (step * score).sum(axis=1) < _SETTLED
        step = np.minimum(np.maximum(step, -_LONGEST_STEP), _LONGEST_STEP)
        step *= 1.0 if turn < _FULL_STEPS else 0.5
        parameters[moving] = _bounded(parameters[moving] + step)
        settled[moving[done]] = True
        if done.any():
            moving = moving[~done]
            part, known = view.of(moving), select(prior, moving)
        if len(moving) == 0:
            break
    return _judged(view, parameters, settled, noise, prior)


def _bounded(parameters: Floats) -> Floats:
    return np.minimum(np.maximum(parameters, _LEAST), _MOST)


@dataclass(frozen=True)
class _Weighted:
    """Lines, the variance (K, n) of their pixels and the weight (K, n) that each has."""

    model: CrossSections
    variance: Floats
    weight: Floats


def _normal_equations(
    view: LineWindows, parameters: Floats, noise: Noise, prior: LinePrior
) -> tuple[Floats, Floats, _Weighted]:
    """Fisher's information (K, 5, 5), the score (K, 5), and what they were made of."""
    model = lines(parameters, view.steps)
    variance = noise.variance(model.light, model.ground - view.base[:, None])
    residual = view.grey - model.light - model.ground
    weight = view.used / variance
    pull = weight * residual
    if view.clipped.any():
        weight, pull = _censored(view, residual, variance, weight, pull)
    by = model.jacobian.transpose(1, 2, 0)
    information = np.einsum("ink,jnk->kij", by * weight.T, by)
    diagonal = np.arange(5)
    information[:, diagonal, diagonal] += prior.precision
    score = np.einsum("ink,nk->ki", by, pull.T)
    score += prior.precision * (prior.mean - parameters)
    return information, score, _Weighted(model, variance, weight)


def _censored(
    view: LineWindows, residual: Floats, variance: Floats, weight: Floats, pull: Floats
) -> tuple[Floats, Floats]:
    """Weight and pull (K, n) with those of the clipped pixels put in.

    Of ln Phi(z), z = (mu - limit) / sigma, the derivative by mu is lambda / sigma with
    lambda = phi(z) / Phi(z), and minus the second is lambda (lambda + z) / sigma².  The limit
    is half a grey value below the clipped one: what was rounded to it.
    """
    at = np.nonzero(view.clipped & view.used)
    sigma = np.sqrt(variance[at])
    z = (0.5 - residual[at]) / sigma
    near = np.maximum(z, _FAR)
    rate = np.exp(-0.5 * near**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(near))
    weight[at] = np.where(z < _FAR, 1.0, np.maximum(rate * (rate + near), 0.0)) / sigma**2
    rate = np.where(z < _FAR, -z, rate)
    pull[at] = rate / sigma
    return weight, pull


def _judged(
    view: LineWindows, parameters: Floats, settled: Mask, noise: Noise, prior: LinePrior
) -> LineFit:
    """The fit at ``parameters`` with its covariance and how well it explains the pixels."""
    information, _, end = _normal_equations(view, parameters, noise, prior)
    covariance = cast(Floats, np.linalg.inv(information))
    along = covariance @ end.model.jacobian
    leverage = end.weight * (end.model.jacobian * along).sum(axis=1)
    # A pixel that the fit follows nearly everywhere says little of the noise.
    seen = view.used & ~view.clipped & (leverage < 0.9)
    residual = view.grey - end.model.light - end.model.ground
    residual /= np.sqrt(np.where(seen, 1 - leverage, 1.0))
    ratio = np.where(seen, residual**2 / end.variance, 0.0)
    misfit = ratio.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    gain = along[:, CENTRE] * end.weight
    return LineFit(parameters, covariance, gain, settled, end.model.light, residual, seen, misfit)
