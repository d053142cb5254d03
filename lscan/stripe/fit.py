"""Lines as Gaussians fitted to the pixels: the fit, what it leaves over, and the bound."""

from dataclasses import astuple, dataclass
from math import erfc, exp, log, pi, sqrt
from typing import TypeAlias

import numpy as np
from scipy.special import ndtr

from lscan.files.compiling import compiled, compiled_sums
from lscan.records import Floats, Ints, Mask, select
from lscan.stripe.picture import Noise, robust_variance, scatter_noise

# Fisher's scoring for one Gaussian line after another, compiled.
#
# The noise of a pixel depends on its light (picture.py), so each step weighs the pixels by the
# variance that the line fitted so far gives them.  A clipped pixel enters with the probability of
# what it says: the light was at least this (a censored observation, Tobin 1958).


CENTRE, LN_WIDTH, LN_HEIGHT, GROUND, TILT = range(5)
PARAMETERS = 5
_ROOT_TWO, _ROOT_TWO_PI, _ROOT_HALF_PI = sqrt(2), sqrt(2 * pi), sqrt(pi / 2)

_MOST_STEPS = 30
_FULL_STEPS = 10
"""Steps taken in full.  The weights follow the line, and now and then the line the weights, to
and fro: half steps end that."""

_SETTLED = 1e-4
"""A line is at rest where the step, squared, in units of the uncertainty is below this."""

_LONGEST_STEP = (1.0, 0.35, 0.7, np.inf, np.inf)
"""Farthest a parameter may go in one step: beyond, the model is nothing like its tangent."""

_LEAST = (-np.inf, log(0.25), log(1e-3), -np.inf, -np.inf)
_MOST = (np.inf, log(40.0), log(1e6), np.inf, np.inf)
"""Widths in px and heights in DN that a line can have; no picture distinguishes beyond."""

_FAR = -1e3
"""Below, in standard deviations, the terms of a clipped pixel are their limits, -z and 1, to a
millionth: computed, they are differences of numbers that agree in all their digits."""
_FINE, _FARTHEST = 256, 9
_NDTR = ndtr(np.arange(-_FARTHEST * _FINE, _FARTHEST * _FINE + 1) / _FINE)
"""Phi at steps of 1 / 256.  Half a step aside the first three terms of its Taylor series leave
(1 / 512)^4 / 24 of its fourth derivative, which is below 0.6: 4e-13."""
_MILLS = 25.0  # beyond, the first five terms of Mills' ratio are good to 1e-11
_FOLLOWED = 0.9  # a pixel that the fit follows nearly everywhere says little of the noise

FittedArrays: TypeAlias = tuple[Floats, Floats, Floats, Mask, Floats, Floats, Mask, Floats]


@compiled_sums
def fit_columns(
    start: Floats,
    first: float,
    grey: Floats,
    base: Floats,
    used: Mask,
    clipped: Mask,
    noise: Floats,
    mean: Floats,
    precision: Floats,
) -> FittedArrays:
    """The fields of ``fit.LineFit``, of K lines in windows of n pixels.

    Parameters
    ----------
    start, mean, precision : (K, 5) array, px and DN, where the search begins, what is expected,
        and 1/variance of that
    first : float, px, place of the windows' first pixel; the others follow
    grey, used, clipped : (K, n) array, of the windows
    base : (K,) array, DN, background of each whole column
    noise : (3,) array, constant in DN², DN of variance per DN of light, speckle

    References
    ----------
    Fisher's scoring; a clipped pixel is a censored observation (Tobin 1958).
    """
    count, n = grey.shape
    parameters, settled = np.empty((count, PARAMETERS)), np.zeros(count, np.bool_)
    covariance, misfit = np.empty((count, PARAMETERS, PARAMETERS)), np.zeros(count)
    gain, light_of, residual_of = np.empty((count, n)), np.empty((count, n)), np.empty((count, n))
    seen = np.zeros((count, n), np.bool_)
    by, light, under, residual = np.empty((PARAMETERS, n)), np.empty(n), np.empty(n), np.empty(n)
    variance, weight, pull = np.empty(n), np.empty(n), np.empty(n)
    information, score = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    step, along = np.empty(PARAMETERS), np.empty(PARAMETERS)
    for k in range(count):
        here, expected, known = parameters[k], mean[k], precision[k]
        for i in range(PARAMETERS):
            here[i] = min(max(start[k, i], _LEAST[i]), _MOST[i])
        for turn in range(_MOST_STEPS + 1):
            line_at(here, first, light, under, by)
            for p in range(n):
                _weigh(p, light, under, grey[k, p], base[k], noise, residual, variance)
                weight[p] = 1 / variance[p] if used[k, p] else 0.0
                pull[p] = weight[p] * residual[p]
                if clipped[k, p] and used[k, p]:
                    weight[p], pull[p] = _at_least(residual[p], sqrt(variance[p]))
            for i in range(PARAMETERS):
                score[i] = known[i] * (expected[i] - here[i])
                for p in range(n):
                    score[i] += by[i, p] * pull[p]
                for j in range(i, PARAMETERS):
                    total = known[i] if i == j else 0.0
                    for p in range(n):
                        total += by[i, p] * weight[p] * by[j, p]
                    information[i, j] = total
            factorise(information)
            if settled[k] or turn == _MOST_STEPS:
                break
            for i in range(PARAMETERS):
                step[i] = score[i]
            solve_factorised(information, step)
            progress = 0.0
            for i in range(PARAMETERS):
                progress += step[i] * score[i]
            settled[k] = progress < _SETTLED
            for i in range(PARAMETERS):
                most = _LONGEST_STEP[i]
                move = min(max(step[i], -most), most) * (1.0 if turn < _FULL_STEPS else 0.5)
                here[i] = min(max(here[i] + move, _LEAST[i]), _MOST[i])
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                covariance[k, i, j] = 1.0 if i == j else 0.0
            solve_factorised(information, covariance[k, i])
        total, pixels = 0.0, 0
        for p in range(n):
            leverage = 0.0
            for i in range(PARAMETERS):
                along[i] = 0.0
                for j in range(PARAMETERS):
                    along[i] += covariance[k, i, j] * by[j, p]
                leverage += along[i] * by[i, p]
            leverage *= weight[p]
            gain[k, p], light_of[k, p] = along[CENTRE] * weight[p], light[p]
            residual_of[k, p] = residual[p]
            seen[k, p] = used[k, p] and not clipped[k, p] and leverage < _FOLLOWED
            if seen[k, p]:
                residual_of[k, p] /= sqrt(1 - leverage)
                total += residual_of[k, p] ** 2 / variance[p]
                pixels += 1
        misfit[k] = total / max(pixels, 1)
    return parameters, covariance, gain, settled, light_of, residual_of, seen, misfit


@compiled
def lines_at(parameters: Floats, first: float, n: int) -> tuple[Floats, Floats, Floats]:
    """The fields of ``fit.CrossSections``, of K lines at n pixels.

    Parameters
    ----------
    parameters : (K, 5) array, px and DN, as of ``fit.parameters_of``
    first : float, px, place of the first pixel; the others follow
    n : int, pixels
    """
    count = len(parameters)
    light, under = np.empty((count, n)), np.empty((count, n))
    jacobian = np.empty((count, PARAMETERS, n))
    for k in range(count):
        line_at(parameters[k], first, light[k], under[k], jacobian[k])
    return light, under, jacobian


@compiled
def line_at(parameters: Floats, first: float, light: Floats, under: Floats, by: Floats) -> None:
    """One line at n pixels: its light, its ground, and how both change with the parameters.

    Parameters
    ----------
    parameters : (5,) array, px and DN, as of ``fit.parameters_of``
    first : float, px, place of the first pixel; the others follow
    light, under : (n,) array, DN, to be filled
    by : (5, n) array, derivatives of their sum by each parameter, to be filled
    """
    width, height = exp(parameters[LN_WIDTH]), exp(parameters[LN_HEIGHT])
    distance = (first - 0.5 - parameters[CENTRE]) / width
    density = exp(-0.5 * distance * distance)
    share = _ndtr(distance, density)
    for p in range(len(light)):
        place = first + p
        beyond = (place + 0.5 - parameters[CENTRE]) / width
        thick = exp(-0.5 * beyond * beyond)
        whole = _ndtr(beyond, thick)
        light[p] = height * width * _ROOT_TWO_PI * (whole - share)
        under[p] = parameters[GROUND] + parameters[TILT] * place
        by[CENTRE, p] = height * (density - thick)
        by[LN_WIDTH, p] = height * width * (distance * density - beyond * thick) + light[p]
        by[LN_HEIGHT, p], by[GROUND, p], by[TILT, p] = light[p], 1.0, place
        distance, density, share = beyond, thick, whole


@compiled
def _ndtr(x: float, bell: float) -> float:
    """Phi(x), from ``bell`` = exp(-x² / 2), in a fraction of the time of erfc."""
    place = min(max(round(x * _FINE), -_FARTHEST * _FINE), _FARTHEST * _FINE)
    aside = place / _FINE - x
    series = 1 - aside / 2 * (x - aside / 3 * (x * x - 1))
    return _NDTR[place + _FARTHEST * _FINE] - aside * series * bell / _ROOT_TWO_PI


@compiled
def _weigh(
    p: int,
    light: Floats,
    under: Floats,
    grey: float,
    base: float,
    noise: Floats,
    residual: Floats,
    variance: Floats,
) -> None:
    """Residual and variance of a pixel, of noise as in ``picture.Noise``."""
    veil = under[p] - base
    residual[p] = grey - base - light[p] - veil
    shot = noise[1] * max(light[p] + veil, 0.0)
    variance[p] = noise[0] + shot + (noise[2] * light[p]) ** 2


@compiled
def _at_least(residual: float, sigma: float) -> tuple[float, float]:
    """Weight and pull of a clipped pixel.

    Of ln Phi(z), z = (mu - limit) / sigma, the derivative by mu is lambda / sigma with
    lambda = phi(z) / Phi(z), and minus the second is lambda (lambda + z) / sigma².  The limit
    is half a grey value below the clipped one: what was rounded to it.
    """
    z = (0.5 - residual) / sigma
    if z < _FAR:
        return 1 / sigma**2, -z / sigma
    if z > -_MILLS:
        rate = exp(-0.5 * z * z) / (_ROOT_HALF_PI * erfc(-z / _ROOT_TWO))
    else:
        q = 1 / (z * z)
        rate = -z / (1 - q * (1 - q * (3 - q * (15 - q * 105))))
    return max(rate * (rate + z), 0.0) / sigma**2, rate / sigma


@compiled
def factorise(matrix: Floats) -> None:
    """Eliminate below the diagonal of a symmetric matrix that is positive definite.

    No rows need be exchanged.

    Parameters
    ----------
    matrix : (m, m) array, its upper half; the factors are left in it
    """
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1, size):
            factor = matrix[i, j] / matrix[i, i]
            for c in range(j, size):
                matrix[j, c] -= factor * matrix[i, c]


@compiled
def solve_factorised(matrix: Floats, right: Floats) -> None:
    """Solve a system of equations.

    Parameters
    ----------
    matrix : (m, m) array, as ``factorise`` left it
    right : (m,) array, which becomes the solution
    """
    size = len(matrix)
    for i in range(size):
        for j in range(i + 1, size):
            right[j] -= matrix[i, j] / matrix[i, i] * right[i]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            right[i] -= matrix[i, j] * right[j]
        right[i] /= matrix[i, i]


# What the loops take and give, as records.


@dataclass(frozen=True)
class CrossSections:
    """K lines as n pixels see them, and how that changes with the parameters.

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
    steps : (n,) array, px, consecutive pixels
    """
    return CrossSections(*lines_at(np.ascontiguousarray(parameters), float(steps[0]), len(steps)))


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


# Maximum likelihood of Gaussian lines under the sensor's noise.


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


def fit_lines(search: LineSearch) -> LineFit:
    """The most probable lines of a picture, each fitted by itself.

    Parameters
    ----------
    search : LineSearch, px and DN

    References
    ----------
    Fisher's scoring; a clipped pixel is a censored observation (Tobin 1958).
    """
    view, prior = search.view, search.prior
    grey, noise = view.grey.astype(float), np.array(astuple(search.noise))
    arrays = grey, view.base, view.used, view.clipped, noise, prior.mean, prior.precision
    start, *given = map(np.ascontiguousarray, (search.start, *arrays))
    return LineFit(*fit_columns(start, float(view.steps[0]), *given))


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
