"""One step of Fisher's scoring for many lines at once.

The noise of a pixel depends on its light (noise/model.py), so each step weighs the pixels by the
variance that the line fitted so far gives them.  A clipped pixel enters with the probability of
what it says: the light was at least this (a censored observation, Tobin 1958).
"""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from lscan.records import Floats, Ints, Mask, select
from lscan.stripe.crosssection import GROUND, lines
from lscan.stripe.noise.model import Noise

_Value = TypeVar("_Value", bound=np.generic)

_FAR = -1e3
"""Below, in standard deviations, the terms of a clipped pixel are their limits, -z and 1, to a
millionth: computed, they are differences of numbers that agree in all their digits."""


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
class LineSearch:
    """What the K lines of one picture are fitted to.

    Attributes
    ----------
    view : LineWindows, px and DN, of K columns; ``steps`` lie even about 0
    start : (K, 5) array, px and DN, where the search begins (crosssection.py)
    noise : Noise, of the pixels
    prior : LinePrior, of K lines
    """

    view: LineWindows
    start: Floats
    noise: Noise
    prior: LinePrior

    def of(self, chosen: Ints) -> "LineSearch":
        """That of some of the columns alone.

        Parameters
        ----------
        chosen : (C,) array, indices among the K
        """
        view, prior = self.view, select(self.prior, chosen)
        grey, base, used = view.grey[chosen], view.base[chosen], view.used[chosen]
        part = LineWindows(view.steps, grey, base, used, view.clipped[chosen])
        return LineSearch(part, self.start[chosen], self.noise, prior)


@dataclass(frozen=True)
class LinePixels:
    """The windows of all lines, the K of a pixel together in memory: K is long, n is short.

    Attributes
    ----------
    steps : (n,) array, px, place from the middle pixel
    base : (K,) array, DN, background of the whole column
    above : (n, K) array, DN, grey values above it
    used : (n, K) array, 1 where the pixel counts, else 0
    clipped : (n, K) mask, of the used pixels that may have seen any amount of light
    noise : (3, K) array, its terms
    mean, precision : (5, K) array, of what is known beforehand
    """

    steps: Floats
    base: Floats
    above: Floats
    used: Floats
    clipped: Mask
    noise: Floats
    mean: Floats
    precision: Floats

    @staticmethod
    def of(searches: Sequence[LineSearch]) -> "LinePixels":
        """Those of the lines of several pictures.

        Parameters
        ----------
        searches : sequence of LineSearch, one or more
        """
        views, count = [search.view for search in searches], [len(s.start) for s in searches]
        steps = max((view.steps for view in views), key=len)

        def together(values: Sequence[NDArray[_Value]]) -> NDArray[_Value]:
            whole = np.zeros((len(steps), sum(count)), dtype=values[0].dtype)
            for value, last in zip(values, np.cumsum(count), strict=True):
                beside = (len(steps) - value.shape[1]) // 2
                whole[beside : len(steps) - beside, last - len(value) : last] = value.T
            return whole

        noise = np.array([astuple(search.noise) for search in searches])
        return LinePixels(
            steps=steps,
            base=np.concatenate([view.base for view in views]),
            above=together([view.grey - view.base[:, None] for view in views]),
            used=together([view.used.astype(float) for view in views]),
            clipped=together([view.clipped & view.used for view in views]),
            noise=np.repeat(noise, count, axis=0).T,
            mean=np.concatenate([search.prior.mean for search in searches]).T,
            precision=np.concatenate([search.prior.precision for search in searches]).T,
        )

    def of_lines(self, chosen: Ints) -> "LinePixels":
        """Those of some of the lines alone.

        Parameters
        ----------
        chosen : (C,) array, indices among the K
        """
        parts = {k: v.take(chosen, axis=-1) for k, v in vars(self).items() if k != "steps"}
        return replace(self, **parts)


@dataclass(frozen=True)
class WeightedLines:
    """What the pixels of K lines show.

    Attributes
    ----------
    jacobian : (5, n, K) array, derivative of the grey values by each parameter (crosssection.py)
    light : (n, K) array, DN, of the lines
    variance : (n, K) array, DN²
    weight : (n, K) array, 1/DN², of each pixel
    residual : (n, K) array, DN, what the pixels differ from the lines
    """

    jacobian: Floats
    light: Floats
    variance: Floats
    weight: Floats
    residual: Floats


def normal_equations(
    pixels: LinePixels, parameters: Floats
) -> tuple[Floats, Floats, WeightedLines]:
    """Fisher's information (5, 5, K), the score (5, K), and what they were made of.

    Of the information, which is symmetric, the lower half is left out.

    Parameters
    ----------
    pixels : LinePixels, px and DN, of K lines
    parameters : (5, K) array, px and DN (crosssection.py)

    References
    ----------
    Fisher's scoring; a clipped pixel is a censored observation (Tobin 1958).
    """
    model = lines(parameters.T, pixels.steps)
    light, jacobian = model.light.T, model.jacobian.transpose(1, 2, 0)
    by = jacobian[:GROUND]
    veil = model.ground.T - pixels.base
    variance = Noise(*cast(Any, pixels.noise)).variance(light, veil)
    residual = pixels.above - light
    residual -= veil
    weight = pixels.used / variance
    pull = weight * residual
    if pixels.clipped.any():
        weight, pull = _censored(pixels, residual, variance, weight, pull)
    weighted = np.empty((4, *weight.shape))
    np.multiply(by, weight, out=weighted[:-1])
    weighted[-1] = weight
    # The derivatives by ground and tilt are the same for all lines: their sums are moments.
    powers = pixels.steps ** np.arange(3)[:, None]
    moments = powers @ weighted
    information = np.empty((5, 5, len(pixels.base)))
    for i in range(GROUND):
        information[i, i:GROUND] = np.einsum("nk,jnk->jk", weighted[i], by[i:])
        information[i, GROUND:] = moments[i, :2]
    information[GROUND:, GROUND:] = moments[-1, [[0, 1], [1, 2]]]
    diagonal = np.arange(5)
    information[diagonal, diagonal] += pixels.precision
    score = pixels.precision * (pixels.mean - parameters)
    score[:GROUND] += np.einsum("ink,nk->ik", by, pull)
    score[GROUND:] += powers[:2] @ pull
    return information, score, WeightedLines(jacobian, light, variance, weight, residual)


def _censored(
    pixels: LinePixels, residual: Floats, variance: Floats, weight: Floats, pull: Floats
) -> tuple[Floats, Floats]:
    """Weight and pull (n, K) with those of the clipped pixels put in.

    Of ln Phi(z), z = (mu - limit) / sigma, the derivative by mu is lambda / sigma with
    lambda = phi(z) / Phi(z), and minus the second is lambda (lambda + z) / sigma².  The limit
    is half a grey value below the clipped one: what was rounded to it.
    """
    at = np.flatnonzero(pixels.clipped)
    sigma = np.sqrt(variance.take(at))
    z = (0.5 - residual.take(at)) / sigma
    near = np.maximum(z, _FAR)
    rate = np.exp(-0.5 * near**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(near))
    weight.flat[at] = np.where(z < _FAR, 1.0, np.maximum(rate * (rate + near), 0.0)) / sigma**2
    rate = np.where(z < _FAR, -z, rate)
    pull.flat[at] = rate / sigma
    return weight, pull


def solved_each(matrix: Floats, right: Floats) -> Floats:
    """(m, r, K) solutions of K systems of equations, all of them in each step.

    Elimination: symmetric matrices that are positive definite need no exchange of rows, and of
    them the upper half alone is read.

    Parameters
    ----------
    matrix : (m, m, K) array
    right : (m, r, K) array
    """
    size = len(matrix)
    rows = np.concatenate([matrix, right], axis=1)
    for i in range(size):
        factor = rows[i, i + 1 : size] / rows[i, i]
        for j in range(i + 1, size):
            rows[j, j:] -= factor[j - i - 1] * rows[i, j:]
    solution = rows[:, size:]
    for i in reversed(range(size)):
        solution[i] /= rows[i, i]
        solution[:i] -= rows[:i, i, None] * solution[i]
    return solution
