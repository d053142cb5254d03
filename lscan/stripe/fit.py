"""Lines as Gaussians fitted to the pixels: the fit, what it leaves over, and the bound."""

from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace
from math import sqrt
from typing import Any, TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr, ndtr

from lscan.records import Floats, Ints, Mask, select
from lscan.stripe.picture import Noise, robust_variance, scatter_noise

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


# One step of Fisher's scoring for many lines at once.
#
# The noise of a pixel depends on its light (picture.py), so each step weighs the pixels by the
# variance that the line fitted so far gives them.  A clipped pixel enters with the probability of
# what it says: the light was at least this (a censored observation, Tobin 1958).


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
    mean : (K, 5) array, px and DN, expected parameters
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
    start : (K, 5) array, px and DN, where the search begins
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
    jacobian : (5, n, K) array, derivative of the grey values by each parameter
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
    parameters : (5, K) array, px and DN

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
        weight, pull = _with_clipped(pixels, residual, variance, weight, pull)
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


def _with_clipped(
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


def solve_each(matrix: Floats, right: Floats) -> Floats:
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


# Maximum likelihood of Gaussian lines under the sensor's noise, many columns at once.


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
    parameters : (K, 5) array, px and DN, as of ``parameters_of``
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
    parameters = _within_limits(np.concatenate([search.start for search in searches]).T)
    settled = np.zeros(parameters.shape[1], dtype=bool)
    moving, part = np.arange(len(settled)), every
    for turn in range(_MOST_STEPS):
        information, score, _ = normal_equations(part, parameters[:, moving])
        step = solve_each(information, score[:, None])[:, 0]
        done = (step * score).sum(axis=0) < _SETTLED
        step = np.minimum(np.maximum(step, -_LONGEST_STEP), _LONGEST_STEP)
        step *= 1.0 if turn < _FULL_STEPS else 0.5
        parameters[:, moving] = _within_limits(parameters[:, moving] + step)
        settled[moving[done]] = True
        if done.any():
            moving = moving[~done]
            part = every.of_lines(moving)
        if len(moving) == 0:
            break
    return _line_fits(searches, every, parameters, settled)


def _within_limits(parameters: Floats) -> Floats:
    return np.minimum(np.maximum(parameters, _LEAST), _MOST)


def _line_fits(
    searches: Sequence[LineSearch], pixels: LinePixels, parameters: Floats, settled: Mask
) -> list[LineFit]:
    """The fits at ``parameters`` (5, K) with their covariance and how they explain the pixels."""
    information, _, end = normal_equations(pixels, parameters)
    one = np.repeat(np.eye(5)[..., None], len(settled), axis=2)
    covariance = solve_each(information, one)
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


# Noise and misfit: how the pixels of neighbouring columns scatter about their lines; the bound.


_Number = TypeVar("_Number", bound=np.number)


# Noise and misfit: how the pixels of neighbouring columns scatter about their lines.
#
# No laser line is quite a Gaussian.  What it differs by is much the same in the next column, and
# noise is not.  So half the squared difference of two neighbours' residuals is the variance of the
# noise, and their product is the square of the misfit.  Of the misfit only the odd part, of
# opposite signs on either side of the peak, moves the centre.


_BEYOND_CHANCE = 4.0  # standard deviations of a variance
_FEWEST_PAIRS = 8  # pairs of columns, some hundred pixels
_SIDEWAYS_PX = 3  # farther apart along the column, two peaks are of two lines
_FAINT = 0.005  # of the line's height: what Gaussians have beyond 3.3 standard deviations
# Relative variance of robust_variance, times the values: 1.83 within 3 sigma, divided by
# (1 - 0.11)^2, for the cut follows what is found.  A column may be in two pairs, whose squares
# correlate by 1/4; those of second differences do by 4/9 and 1/36.
_OF_PAIRS, _OF_SECOND_DIFFERENCES = 2.32 * (1 + 2 / 4), 2.32 * (1 + 8 / 9 + 2 / 36)
_CORE = 5.0  # standard deviations within which pixels are used
_BY_CHANCE = 2.0  # standard errors; a pixel and its mirror image have the same common part


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

        Least squares of ``common`` on light², weighted by the inverse of its variance; 0 where
        that is no more than chance.  Of a line a pixel wide the fit follows every bright pixel, and
        only the skirts, which have next to no light, are left to tell.

        Parameters
        ----------
        noise : Noise, of the pixels
        """
        variance = noise.variance(self.light)
        core = np.abs(self.common) <= _CORE**2 * variance
        weight = core * self.light**2 / np.maximum(variance, 1e-3 * self.light**2) ** 2
        total = float((weight * self.light**2).sum())
        pull = weight * self.common
        square, chance = float(pull.sum()), float(2 * (pull**2).sum()) ** 0.5
        return min((square / total) ** 0.5, 1.0) if square > _BY_CHANCE * chance else 0.0


def chance_of_variances(pairs: int, pixels: int) -> float:
    """Relative standard deviation of a variance of pairs of columns over one of pixels afar.

    Parameters
    ----------
    pairs : int, pixels of the pairs
    pixels : int, second differences down columns
    """
    return sqrt(_OF_PAIRS / max(pairs, 1) + _OF_SECOND_DIFFERENCES / max(pixels, 1))


def scatter_of(fit: LineFit, columns: Ints, rows: Ints, apart: int = 1) -> Scatter:
    """The pixels of those fitted lines that have a neighbour, each with its neighbour's.

    With next to no neighbours all scatter counts as noise.

    Parameters
    ----------
    fit : LineFit, px and DN, of K columns
    columns, rows : (K,) array, place of the lines' middle pixels in the picture, columns rising
    apart : int, columns from one to the neighbour whose noise is its own
    """
    second = columns.searchsorted(columns + apart).clip(max=len(columns) - 1)
    beside = np.abs(rows[second] - rows) <= _SIDEWAYS_PX
    first = np.flatnonzero((columns[second] - columns == apart) & beside)
    second = second[first]
    if len(first) < _FEWEST_PAIRS:
        first = second = np.arange(len(columns))
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


# The Cramér-Rao bound: no unbiased extractor scatters less than this.


def centre_bound_px(
    width_px: Floats | float,
    height_dn: Floats | float,
    noise: Noise,
    phase_px: Floats | float = 0.0,
    reach_px: int | None = None,
) -> Floats:
    """Least standard deviation (K,) in px of an unbiased estimate of a line's centre.

    Centre, width, height and an even ground are unknown; the noise is known, independent from
    pixel to pixel and normal: reading, shot and speckle.  For additive noise and a line much wider
    than a pixel the bound is (sigma_n / A) sqrt(2 w / sqrt(pi)).

    Parameters
    ----------
    width_px : (K,) array or float, px, standard deviation of the Gaussian
    height_dn : (K,) array or float, DN, its height
    noise : Noise, of the pixels
    phase_px : (K,) array or float, px, place of the centre in the middle pixel
    reach_px : int, optional, px, pixels seen to either side; 8 widths by default

    References
    ----------
    The inverse of Fisher's information J^T V^-1 J: Kay, Fundamentals of Statistical Signal
    Processing I, sec. 3.9, without the little that the variance itself says of the line;
    docs/explanation/physics.md, section 4.
    """
    width, height, phase = np.broadcast_arrays(
        *(np.atleast_1d(np.asarray(value, float)) for value in (width_px, height_dn, phase_px))
    )
    reach = int(np.ceil(8 * width.max())) + 1 if reach_px is None else reach_px
    steps = np.arange(-reach, reach + 1, dtype=float)
    level = np.zeros(len(width))
    seen = lines(parameters_of(phase, width, height, level, level), steps)
    jacobian = np.delete(seen.jacobian, TILT, axis=1)
    weight = 1 / noise.variance(seen.light)
    information = (jacobian * weight[:, None]) @ jacobian.transpose(0, 2, 1)
    return np.sqrt(np.linalg.inv(information)[:, CENTRE, CENTRE])
