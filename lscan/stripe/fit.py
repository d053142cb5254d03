"""Maximum likelihood of Gaussian lines under the sensor's noise, many columns at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.records import Floats, Mask
from lscan.stripe.crosssection import CENTRE
from lscan.stripe.scoring import LinePixels, LineSearch, normal_equations, solved_each

_MOST_STEPS = 30
_FULL_STEPS = 10
"""Steps taken in full.  The weights follow the line, and now and then the line the weights, to
and fro: half steps end that."""

_SETTLED = 1e-4
"""A line is at rest where the step, squared, in units of the uncertainty is below this."""

_LONGEST_STEP = np.array([[1.0], [0.35], [0.7], [np.inf], [np.inf]])
"""Farthest a parameter may go in one step: beyond, the model is nothing like its tangent."""

_LEAST = np.array([[-np.inf], [np.log(0.25)], [np.log(1e-3)], [-np.inf], [-np.inf]])
_MOST = np.array([[np.inf], [np.log(40.0)], [np.log(1e6)], [np.inf], [np.inf]])
"""Widths in px and heights in DN that a line can have; no picture distinguishes beyond."""


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


def fit_lines(searches: Sequence[LineSearch]) -> list[LineFit]:
    """The most probable lines of each of several pictures.

    Each line is fitted by itself; together they take fewer and larger steps of NumPy.

    Parameters
    ----------
    searches : sequence of LineSearch, one or more

    References
    ----------
    Fisher's scoring; a clipped pixel is a censored observation (Tobin 1958).
    """
    every = LinePixels.of(searches)
    parameters = _bounded(np.concatenate([search.start for search in searches]).T)
    settled = np.zeros(parameters.shape[1], dtype=bool)
    moving, part = np.arange(len(settled)), every
    for turn in range(_MOST_STEPS):
        information, score, _ = normal_equations(part, parameters[:, moving])
        step = solved_each(information, score[:, None])[:, 0]
        done = (step * score).sum(axis=0) < _SETTLED
        step = np.minimum(np.maximum(step, -_LONGEST_STEP), _LONGEST_STEP)
        step *= 1.0 if turn < _FULL_STEPS else 0.5
        parameters[:, moving] = _bounded(parameters[:, moving] + step)
        settled[moving[done]] = True
        if done.any():
            moving = moving[~done]
            part = every.of_lines(moving)
        if len(moving) == 0:
            break
    return _judged(searches, every, parameters, settled)


def _bounded(parameters: Floats) -> Floats:
    return np.minimum(np.maximum(parameters, _LEAST), _MOST)


def _judged(
    searches: Sequence[LineSearch], pixels: LinePixels, parameters: Floats, settled: Mask
) -> list[LineFit]:
    """The fits at ``parameters`` (5, K) with their covariance and how they explain the pixels."""
    information, _, end = normal_equations(pixels, parameters)
    one = np.repeat(np.eye(5)[..., None], len(settled), axis=2)
    covariance = solved_each(information, one)
    along = np.einsum("ijk,jnk->ink", covariance, end.jacobian)
    leverage = end.weight * np.einsum("ink,ink->nk", end.jacobian, along)
    # A pixel that the fit follows nearly everywhere says little of the noise.
    seen = (pixels.used > 0) & ~pixels.clipped & (leverage < 0.9)
    residual = end.residual / np.sqrt(np.where(seen, 1 - leverage, 1.0))
    ratio = np.where(seen, residual**2 / end.variance, 0.0)
    misfit = ratio.sum(axis=0) / np.maximum(seen.sum(axis=0), 1)
    gain = along[CENTRE] * end.weight
    fits, first = [], 0
    for search in searches:
        count, width = search.view.grey.shape
        beside, part = (len(pixels.steps) - width) // 2, slice(first, first + count)
        near = np.s_[beside : beside + width, part]
        first += count
        fits.append(
            LineFit(
                parameters[:, part].T,
                covariance[..., part].transpose(2, 0, 1),
                gain[near].T,
                settled[part],
                end.light[near].T,
                residual[near].T,
                seen[near].T,
                misfit[part],
            )
        )
    return fits
