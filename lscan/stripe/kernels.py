"""Loops that are compiled: one line after another, arrays in and arrays out, without records."""

import logging
from collections.abc import Callable
from math import atan2, cos, erfc, exp, hypot, log, pi, sin, sqrt
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from scipy.special import ndtr

from lscan.records import Floats, GreyValues, Ints, Mask, Singles

_log = logging.getLogger(__name__)

_P = ParamSpec("_P")
_R = TypeVar("_R")


class _FirstTime(event.Listener):
    """Says once why nothing happens for some seconds."""

    said = False

    def on_start(self, event: event.Event) -> None:
        """Called where something is compiled that no cache has."""
        if not self.said:
            _log.warning(
                "note: compiles what reads pictures: half a minute, once if it can be kept"
            )
            self.said = True

    def on_end(self, event: event.Event) -> None:
        """Called where that is done."""


event.register("numba:compile", _FirstTime())


def compiled(function: Callable[_P, _R], fastmath: object = False) -> Callable[_P, _R]:
    """Decorator of a loop over arrays: it runs without the interpreter, and without its lock.

    numba compiles it when it is first called, and keeps that beside the module or, where nothing
    can be written there, in the user's cache; where it cannot either, each process compiles anew.
    With ``NUMBA_DISABLE_JIT=1`` it stays Python.

    Parameters
    ----------
    function : callable, in the part of Python that numba knows
    fastmath : as ``numba.njit`` takes it
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": fastmath}
    try:
        made = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no place for it
        made = numba.njit(**options)(function)
    return cast(Callable[_P, _R], made)


def compiled_sums(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """As ``compiled``, of sums whose terms may be added in any order, several at once.

    Parameters
    ----------
    function : callable, as of ``compiled``; NaN stays what it is
    """
    return compiled(function, {"reassoc", "contract", "nsz"})


def compiled_order(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """As ``compiled``, of values that are compared, several at once; none is NaN.

    Parameters
    ----------
    function : callable, as of ``compiled``
    """
    return compiled(function, {"nnan", "nsz", "contract"})


def compile_lines() -> None:
    """Compile the loops of this module, for the processes that follow."""
    line, window, used = np.zeros((1, PARAMETERS)), np.zeros((1, 3)), np.ones((1, 3), np.bool_)
    noise, precision = np.array([1.0, 0.0, 0.0]), np.ones((1, PARAMETERS))
    fit_columns(line, -1.0, window, np.zeros(1), used, ~used, noise, line, precision)
    lines_at(line, -1.0, 3)
    one, bell = np.zeros(1, np.int64), np.ones(3, np.float32)
    for kind in (np.uint8, np.int16, np.float32, np.float64):
        columns = np.ones((1, 9), kind)
        weighted_moments(columns, one, np.array([4.0]), 1.0)
        total_profile(columns, one, one, 1)
    for kind in (np.uint8, np.int16):
        crests_of(np.ones((1, 9), kind))
        order_statistics(np.ones((1, 9), kind), 4, 0, 1)
        count_second_differences(np.ones((1, 9), kind), 4)
    for kind in (np.uint8, np.float32):
        columns = np.ones((1, 9), kind)
        find_spots(columns, columns, 1.0, 3, False, bell, 1)
    centroids(window, window, np.zeros(1), 0, 1.0, 0.0, 1.0)
    bells = np.ones((3, 3))
    ridge_crossings(np.ones((3, 3)), noise, one, 0.5, bells, bells)
    third_differences(np.zeros(1), one, 1)
    running_medians(np.ones(1), 1)
    pieces_of(used[0], np.zeros(3), 1.0)
    end_doubts(np.zeros(3, np.int64), np.zeros(3), np.zeros(3), np.zeros(3), 1, 2)
    core_variance(np.ones(1), one, 0.0, 1, 1.0)
    shot_and_speckle(np.ones(1), np.ones(1), 1.0)
    linked_runs(one, one, one, 1)
    best_path(one, np.zeros(1), np.zeros(1), 1, 1.0, 1.0, 1.0)


# Fisher's scoring for one Gaussian line after another (fit.py).
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


# The centre by the paper's rules (rules.py).


MIDDLE, CENTROID, RELATIVE = range(3)


@compiled_sums
def centroids(
    wide: Floats,
    around: Floats,
    base: Floats,
    rule: int,
    constant: float,
    per_dn: float,
    averaged: float,
) -> tuple[Floats, Floats]:
    """Offset in px, and its variance in px², of the line in K columns from the middle pixel.

    Parameters
    ----------
    wide : (K, n + 2) array, DN, the pixels that the rule sees, and one more on either side
    around : (K, m) array, DN, smoothed, where the brightest pixel might have been as well
    base : (K,) array, DN, the columns' background
    rule : int, MIDDLE pixel, CENTROID or that of RELATIVE values
    constant, per_dn : float, DN² and DN, of the pixels' noise, as in ``picture.Noise``
    averaged : float, pixels that one of ``around`` is the mean of

    References
    ----------
    Eq. (8) of the paper; ``rules.centroid`` says what the variance holds.
    """
    count, size = len(wide), wide.shape[1] - 2
    reach, far = size // 2, around.shape[1] // 2
    offsets, variances = np.empty(count), np.empty(count)
    slope, spare = np.empty(size), np.empty(size)
    for k in range(count):
        window = wide[k, 1:-1]
        offset = _centroid(window, rule, slope)
        variance = 0.0
        for p in range(size):
            variance += slope[p] ** 2 * (constant + per_dn * max(window[p] - base[k], 0.0))
        # Another brightest pixel: those that might have been it, and how far the brighter of the
        # neighbours would move the centre.
        crest = constant + per_dn * max(window[reach] - base[k], 0.0)
        least, near, first, second = around[k, far] - 2 * sqrt(crest / averaged), 0, 0.0, 0.0
        for p in range(2 * far + 1):
            if around[k, p] >= least:
                near, first, second = near + 1, first + (p - far), second + (p - far) ** 2
        spread = second / near - (first / near) ** 2 + 1 / 12  # each is a pixel wide
        step = 1 if wide[k, reach + 2] >= wide[k, reach] else -1
        moved = step + _centroid(wide[k, 1 + step : 1 + step + size], rule, spare)
        variance += _at_most_one(moved - offset) ** 2 * spread
        if rule == RELATIVE:
            for p in range(size):
                spare[p] = window[p] - base[k]
            variance += _at_most_one(_centroid(spare, CENTROID, slope) - offset) ** 2 / 6
        offsets[k], variances[k] = offset, variance
    return offsets, variances


@compiled_sums
def _centroid(window: Floats, rule: int, slope: Floats) -> float:
    """The centre by a rule, px from the middle; ``slope`` becomes its derivative by each pixel.

    NaN where the weights have no positive sum.
    """
    size = len(window)
    reach, lowest, total, moment = size // 2, 0, 0.0, 0.0
    if rule == MIDDLE:
        slope[:] = 0.0
        return 0.0
    if rule == RELATIVE:
        for p in range(size):
            lowest = p if window[p] < window[lowest] else lowest
    floor = window[lowest] if rule == RELATIVE else 0.0
    for p in range(size):
        total += window[p] - floor
        moment += (window[p] - floor) * (p - reach)
    offset = moment / total if total > 0 else np.nan
    whole = 0.0
    for p in range(size):
        slope[p] = (p - reach - offset) / total
        whole += slope[p]
    if rule == RELATIVE:  # the lowest is taken off all weights, and moves the centroid through all
        slope[lowest] -= whole
    return offset


@compiled
def _at_most_one(step: float) -> float:
    """A pixel too where it is not known."""
    return min(abs(step), 1.0) if abs(step) == abs(step) else 1.0


# The crossing of a column with a ridge (rules.py).


_STEEPEST = 0.1
"""Least share of the line's normal that lies along the column: steeper than 84 degrees, the
line has no one crossing with it."""
_DARK = 1e-9  # DN; what is not brighter has no ridge
_BESIDE = 2  # rows from where the picture bends most to its crossing


@compiled_sums
def ridge_crossings(
    light: Floats,
    noise: Floats,
    lit: Ints,
    threshold_dn: float,
    along: Floats,
    across: Floats,
) -> tuple[Floats, Floats]:
    """Row and its standard uncertainty, (K,) px each, of the ridge of a smoothed picture.

    Near the row where the picture bends most, among those whose own light or a neighbour's is above
    the threshold: a stronger line that ends beside the column is smoothed into it.  The derivative
    across the line must change its sign within two rows; NaN where it does not, and where the line
    runs along the column.

    Parameters
    ----------
    light : (W, H) array, DN, one column of the picture a row; beyond its edges there is none
    noise : (3,) array, of its pixels, constant in DN², DN of variance per DN of light, speckle
    lit : (K,) array, rising, the columns wanted
    threshold_dn : float, DN
    along, across : (3, 2 n + 1) array, a Gaussian and its first two derivatives, along the rows and
        along the columns; where the first is one pixel long each column is smoothed by itself
    """
    width, height = light.shape
    reach_u, reach_v = along.shape[1] // 2, across.shape[1] // 2
    first, last = np.full(width, height), np.full(width, -1)
    top, bottom = np.full(len(lit), height), np.full(len(lit), -1)
    for k in range(len(lit)):
        for row in range(height):
            if light[lit[k], row] > threshold_dn:
                top[k] = min(top[k], max(row - 1, 0))
                bottom[k] = min(row + 1, height - 1)
        for u in range(max(lit[k] - reach_u, 0), min(lit[k] + reach_u + 1, width)):
            first[u] = min(first[u], max(top[k] - _BESIDE, 0))
            last[u] = max(last[u], min(bottom[k] + _BESIDE, height - 1))
    down = np.empty((3, width, height))
    for u in range(width):
        for row in range(first[u], last[u] + 1):
            begin, end = max(row - reach_v, 0), min(row + reach_v + 1, height)
            grey, skipped = light[u, begin:end], begin - row + reach_v
            for order in range(3):
                bell, total = across[order, skipped:], 0.0
                for p in range(len(grey)):
                    total += bell[p] * grey[p]
                down[order, u, row] = total
    centre, sigma = np.full(len(lit), np.nan), np.full(len(lit), np.nan)
    ratio, beside = np.empty(2 * _BESIDE + 1), np.empty(2 * _BESIDE + 1, np.int64)
    for k in range(len(lit)):
        u, best, lowest = lit[k], -1, np.inf
        for row in range(top[k], bottom[k] + 1):
            near = light[u, row] > threshold_dn
            near |= row > 0 and light[u, row - 1] > threshold_dn
            near |= row + 1 < height and light[u, row + 1] > threshold_dn
            if near:
                bend = _ridge(down, u, row, along)[0]
                if bend < lowest:
                    best, lowest = row, bend
        if best < 0:
            continue
        for i in range(2 * _BESIDE + 1):
            beside[i] = min(max(best + i - _BESIDE, 0), height - 1)
            _, by_u, by_v, slope, value = _ridge(down, u, beside[i], along)
            ratio[i] = slope / max(value, _DARK)
        _, by_u, by_v, _, value = _ridge(down, u, best, along)
        nearest, apart = -1, np.inf
        for i in range(2 * _BESIDE):
            aside = abs(beside[i] + 0.5 - best)
            whole = beside[i + 1] == beside[i] + 1
            if whole and ratio[i] > 0 and ratio[i + 1] <= 0 and aside < apart:
                nearest, apart = i, aside
        if nearest < 0 or by_v < _STEEPEST:
            continue
        change = ratio[nearest + 1] - ratio[nearest]  # of the slope over the value, in px^-2
        centre[k] = beside[nearest] - ratio[nearest] / change
        variance = _slope_variance(light, noise, u, best, along, across, by_u, by_v)
        sigma[k] = sqrt(variance) / max(value, _DARK) / abs(change)
    return centre, sigma


@compiled_sums
def _ridge(
    down: Floats, u: int, row: int, along: Floats
) -> tuple[float, float, float, float, float]:
    """Second derivative across the ridge, its normal along u and v, first derivative, the picture.

    The derivatives are in DN/px² and DN/px, the first is positive towards lower rows.
    """
    reach = along.shape[1] // 2
    value = by_u = by_v = uu = uv = vv = 0.0
    for at in range(max(u - reach, 0), min(u + reach + 1, down.shape[1])):
        bell, slope, bend = (
            along[0, at - u + reach],
            along[1, at - u + reach],
            along[2, at - u + reach],
        )
        plain, first, second = down[0, at, row], down[1, at, row], down[2, at, row]
        value += bell * plain
        by_u += slope * plain
        by_v += bell * first
        uu += bend * plain
        uv += slope * first
        vv += bell * second
    if reach == 0:  # the line is taken to run square to the column
        return vv, 0.0, 1.0, by_v, value
    bent = (uu + vv) / 2 - hypot((uu - vv) / 2, uv)
    # The eigenvector to the smaller eigenvalue is square to that to the larger one; its angle
    # lies between 0 and pi, so that its part along v is never negative.
    angle = atan2(2 * uv, uu - vv) / 2 + pi / 2
    return bent, cos(angle), sin(angle), cos(angle) * by_u + sin(angle) * by_v, value


@compiled_sums
def _slope_variance(
    light: Floats,
    noise: Floats,
    u: int,
    row: int,
    along: Floats,
    across: Floats,
    by_u: float,
    by_v: float,
) -> float:
    """Variance in DN²/px² of the derivative in a direction, each pixel's noise its own."""
    reach_u, reach_v, total = along.shape[1] // 2, across.shape[1] // 2, 0.0
    for at in range(max(u - reach_u, 0), min(u + reach_u + 1, light.shape[0])):
        plain, slope = by_v * along[0, at - u + reach_u], by_u * along[1, at - u + reach_u]
        for v in range(max(row - reach_v, 0), min(row + reach_v + 1, light.shape[1])):
            grey = light[at, v]
            weight = slope * across[0, v - row + reach_v] + plain * across[1, v - row + reach_v]
            pixel = noise[0] + noise[1] * max(grey, 0.0) + (noise[2] * grey) ** 2
            total += weight * weight * pixel
    return total


# How far values scatter along a line, and the light across it (scatter.py, picture.py).


@compiled
def third_differences(values: Floats, run: Ints, lag: int) -> tuple[Ints, Floats]:
    """Of four values ``lag`` entries apart in one piece: the first one's index, their difference.

    Parameters
    ----------
    values : (N,) array, of any unit
    run : (N,) array, number of the piece that each belongs to, -1 for none
    lag : int, entries
    """
    at, found, count = np.empty(len(run), np.int64), np.empty(len(run)), 0
    for i in range(len(run) - 3 * lag):
        one = run[i]
        if one >= 0 and run[i + lag] == one == run[i + 2 * lag] and run[i + 3 * lag] == one:
            at[count] = i
            found[count] = values[i] - values[i + 3 * lag]
            found[count] += 3 * (values[i + 2 * lag] - values[i + lag])
            count += 1
    return at[:count], found[:count]


@compiled
def _sort(values: Floats) -> None:
    """Sort a few values in place; numba's own takes seconds to compile."""
    for n in range(1, len(values)):
        value, place = values[n], n
        while place > 0 and values[place - 1] > value:
            values[place] = values[place - 1]
            place -= 1
        values[place] = value


@compiled
def running_medians(values: Floats, half: int) -> Floats:
    """(N,) median of each value and so many on either side, as ``peaks.running_median``.

    Parameters
    ----------
    values : (N,) array, of any unit, N > 0, without NaN
    half : int, values; beyond the ends the end values count
    """
    size, last = 2 * half + 1, len(values) - 1
    rising, medians = np.empty(size), np.empty(len(values))
    for k in range(size):  # those about the value before the first
        rising[k] = values[min(max(k - half - 1, 0), last)]
    _sort(rising)
    for n in range(len(values)):
        gone, new = values[max(n - 1 - half, 0)], values[min(n + half, last)]
        place = 0
        while rising[place] < gone:
            place += 1
        while place < size - 1 and rising[place + 1] < new:
            rising[place] = rising[place + 1]
            place += 1
        while place > 0 and rising[place - 1] > new:
            rising[place] = rising[place - 1]
            place -= 1
        rising[place] = new
        medians[n] = rising[half]
    return medians


@compiled
def pieces_of(valued: Mask, centre: Floats, jump_px: float) -> Ints:
    """(N,) number of the piece that ``peaks.pieces`` gives each column.

    Parameters
    ----------
    valued : (N,) mask, of the columns that have a value
    centre : (N,) array, px
    jump_px : float, px, by which a line moves to the next column at most
    """
    piece, number = np.full(len(centre), -1), -1
    for n in range(len(centre)):
        if valued[n]:
            goes_on = n > 0 and valued[n - 1] and abs(centre[n] - centre[n - 1]) <= jump_px
            number += 0 if goes_on else 1
            piece[n] = number
    return piece


@compiled
def end_doubts(
    run: Ints, centre: Floats, variance: Floats, ln_flux: Floats, near: int, reach: int
) -> Floats:
    """(N,) px, what ``scatter._end_doubt`` says, from the variance across the line in px².

    Parameters
    ----------
    run : (N,) array, number of the piece each column belongs to, -1 for none
    centre, variance, ln_flux : (N,) array, of the line, px, px² and of DN; NaN where not known
    near, reach : int, columns from an end, between which its slope and width are taken
    """
    doubt, last = np.zeros(len(run)), len(run) - 1
    inner = np.empty(reach - near)
    first = 0
    while first <= last:
        final = first
        while final < last and run[final + 1] == run[first]:
            final += 1
        size = min(reach, final - first + 1)
        for step in (1, -1):
            end = first if step == 1 else final
            if run[first] < 0 or size < 2 * near or end in (0, last):
                continue
            for i in range(near, size):
                inner[i - near] = variance[end + step * i]
            seen = inner[: size - near]
            unknown = seen.sum()  # NaN where one of them is
            _sort(seen)
            middle = (seen[(len(seen) - 1) // 2] + seen[len(seen) // 2]) / 2 + 0 * unknown
            slope = centre[end + step * (size - 1)] - centre[end + step * near]
            scale = abs(slope / (size - 1 - near)) * middle / sqrt(3)
            before = 0.0
            for i in range(size - 1):
                at = end + step * i
                fall = ln_flux[at + step] - ln_flux[at]
                fall = 0.0 if fall <= 0 else fall  # NaN stays
                mean = fall if i == 0 else (before + fall) / 2
                doubt[at] = hypot(doubt[at], scale * (fall if fall >= mean else mean))
                before = fall
        first = final + 1
    return doubt


@compiled
def count_second_differences(columns: GreyValues, most: int) -> Ints:
    """How often each size of I[i-1] - 2 I[i] + I[i+1] along the columns occurs, from 0 to ``most``.

    Parameters
    ----------
    columns : (W, H) array, whole DN, one column of the picture a row
    most : int, DN, the greatest there can be
    """
    count, other = np.zeros(most + 1, np.int64), np.zeros(most + 1, np.int64)
    for c in range(len(columns)):
        grey = columns[c]
        before, here = np.int64(grey[0]), np.int64(grey[min(1, len(grey) - 1)])
        for p in range(2, len(grey)):
            after = np.int64(grey[p])
            size = abs(before - 2 * here + after)
            if p % 2:  # most sizes are alike, and one counter would wait for itself
                count[size] += 1
            else:
                other[size] += 1
            before, here = here, after
    return count + other


@compiled
def total_profile(columns: GreyValues, at: Ints, rows: Ints, reach: int) -> Floats:
    """(2 reach + 1,) DN, sum of the pixels about a row of each of some columns.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at, rows : (K,) array, px, the columns and the middle row of each
    reach : int, px; beyond the picture its last pixel is repeated
    """
    total, last = np.zeros(2 * reach + 1), columns.shape[1] - 1
    for k in range(len(at)):
        begin = rows[k] - reach
        if begin >= 0 and begin + 2 * reach <= last:
            grey = columns[at[k], begin : begin + 2 * reach + 1]
            for p in range(2 * reach + 1):
                total[p] += grey[p]
        else:
            for p in range(2 * reach + 1):
                total[p] += columns[at[k], min(max(begin + p, 0), last)]
    return total


@compiled
def core_variance(sizes: Floats, counts: Ints, least: float, cuts: int, kept: float) -> float:
    """The variance that ``picture.robust_variance`` says, of rising sizes; 0 of none.

    Parameters
    ----------
    sizes : (N,) array, rising, of any unit
    counts : (N,) array, how often there is each
    least : float, where the search starts if most values agree
    cuts : int, turns
    kept : float, share of a normal distribution's variance that lies within 3 sigma
    """
    whole, up_to, middle = counts.sum(), 0, 0.0
    for n in range(len(sizes)):
        for rank in ((whole - 1) // 2, whole // 2):
            middle += sizes[n] / 2 if up_to <= rank < up_to + counts[n] else 0.0
        up_to += counts[n]
    variance = max((1.4826 * middle) ** 2, least) if whole else 0.0
    for _ in range(cuts):
        limit, total, inside = 3 * sqrt(variance), 0.0, 0
        for n in range(len(sizes)):
            if sizes[n] > limit:
                break
            total += counts[n] * sizes[n] ** 2
            inside += counts[n]
        if inside == 0:
            break
        variance = total / inside / kept
    return variance


_STEPS = 4  # from a pixel beside the line, to a hundredth of a pixel


@compiled_sums
def weighted_moments(columns: GreyValues, at: Ints, centre: Floats, scale: float) -> Floats:
    """(3, K) of the light about some centres, weighted with a Gaussian about its own middle.

    Its middle, px, NaN where there is none; its variance over the Gaussian's; and its sum, DN.
    The ground taken off is the mean of the two outermost pixels on either side.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    at : (K,) array, indices of the columns
    centre : (K,) array, px, where the search begins
    scale : float, px, the Gaussian's standard deviation
    """
    found = np.full((3, len(at)), np.nan)
    reach, last = int(np.ceil(3 * scale)) + 2, columns.shape[1] - 1
    light = np.empty(2 * reach + 1)
    for k in range(len(at)):
        row = round(centre[k])
        for p in range(2 * reach + 1):
            light[p] = columns[at[k], min(max(row + p - reach, 0), last)]
        ground = (light[0] + light[1] + light[-2] + light[-1]) / 4
        middle = centre[k] - row
        for _ in range(_STEPS):
            total, first, second = 0.0, 0.0, 0.0
            for p in range(2 * reach + 1):
                off = p - reach - middle
                weighted = exp(-0.5 * (off / scale) ** 2) * (light[p] - ground)
                total += weighted
                first += weighted * off
                second += weighted * off * off
            if total <= 0:
                break
            found[1, k], found[2, k] = second / total / scale**2, total
            middle += scale * min(max(2 * first / total / scale, -1.0), 1.0)
        if total > 0:
            found[0, k] = row + middle
        else:
            found[1:, k] = np.nan
    return found


# Ranks of the pixels of a column (peaks.py).


@compiled_order
def crests_of(columns: GreyValues) -> Ints:
    """(W,) row of the highest value of each column, as ``peaks.crests``, of whole numbers.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    """
    rows = np.zeros(len(columns), np.int64)
    for c in range(len(columns)):
        grey = columns[c]
        highest, p = _greatest(grey), 0
        while p + _ROWS <= len(grey) and _greatest(grey[p : p + _ROWS]) < highest:
            p += _ROWS
        while grey[p] < highest:
            p += 1
        rows[c] = p
    return rows


@compiled_order
def order_statistics(columns: GreyValues, rank: int, least: int, most: int) -> Floats:
    """(W,) DN, of each column the value that ``peaks.order_statistic`` says, of whole numbers.

    To count the pixels up to a grey value takes a thirtieth of a partial sort.  The search begins
    at the column before and goes from there in steps twice as long each.

    Parameters
    ----------
    columns : (W, H) array, DN, one column of the picture a row
    rank : int, 0 for the lowest, below H
    least, most : int, DN, of all pixels
    """
    values, middle = np.empty(len(columns)), least
    for c in range(len(columns)):
        low, high, step = least, most, 1
        while low < high:
            if _count_up_to(columns[c], middle) > rank:
                high = middle
                middle = max(middle - step, (low + high) // 2)
            else:
                low = middle + 1
                middle = min(middle + step, (low + high) // 2)
            step *= 2
        values[c] = middle = low
    return values


@compiled_order
def _count_up_to(values: GreyValues, limit: int) -> int:
    count = np.int32(0)  # a short one, so that many pixels are compared at a time
    for p in range(len(values)):
        count += np.int32(values[p] <= limit)
    return int(count)


@compiled_order
def _greatest(values: GreyValues) -> float:
    """A camera's grey values are compared many at a time, floats are not."""
    found = values[0]
    for p in range(len(values)):
        found = max(found, values[p])
    return found


@compiled_order
def _least(values: GreyValues) -> float:
    found = values[0]
    for p in range(len(values)):
        found = min(found, values[p])
    return found


# Spots across a column (peaks.py).


_ROOM_PX = 16
"""To either side of a stretch of bright pixels, where the feet of its spots are looked for.  A line
of half the threshold's light is no spot, so that few feet lie far from bright pixels."""
_ROWS = 32  # a column is searched for bright pixels so many at a time
_CLOSED_PX = 2  # speckle breaks the flanks of wide lines by so much
_HIGHEST = np.float32(np.finfo(np.float32).max)


@compiled_order
def find_spots(
    columns: GreyValues,
    opened: GreyValues,
    threshold_dn: float,
    ground_px: int,
    sharp: bool,
    bell: Singles,
    reach_px: int,
) -> tuple[Ints, Floats]:
    """Column, top and bottom (3, K), light and peak (2, K) of the spots of ``peaks.spots_of``.

    No ground lies below the least pixel of its column, so that every spot holds a pixel that
    exceeds that by the threshold.  Such pixels are brought together in stretches, and each stretch
    is looked at with all that its spots depend on.

    Parameters
    ----------
    columns : (W, H) array, uint8 or single precision, DN, one column of the picture a row
    opened : (W, H) array, DN, the same, or smoothed: of which the ground is found
    threshold_dn : float, DN, by which a spot exceeds the ground
    ground_px : int, odd, px, what is wider is ground
    sharp : bool, whether the ground is that of the columns not smoothed with ``bell``
    bell : (2 n + 1,) array, weights of a symmetric smoothing
    reach_px : int, px, a spot is where the light exceeds half of its highest value so near by
    """
    width, height = columns.shape
    half, feather = ground_px // 2, len(bell) // 2
    room = height + 4 * half + 2 * reach_px + 2 * feather + _ROWS
    smooth, ground = np.empty(room, np.float32), np.empty(room, np.float32)
    light, one, other = ground.copy(), ground.copy(), ground.copy()
    inside = np.zeros(room, np.bool_)
    place, strength, count = np.empty((3, width), np.int64), np.empty((2, width)), 0
    faint = np.float32(threshold_dn / 4)
    for c in range(width):
        grey, base = columns[c], opened[c]
        limit = _least(base) + max(threshold_dn - 1, 0.0)
        bottom, whole, before = -1, False, count
        while True:
            if whole:
                first, end = 0, height
            else:
                top, bottom = _bright_stretch(grey, bottom + 1, limit)
                if top == height:
                    break
                first, end = max(top - _ROOM_PX, 0), min(bottom + _ROOM_PX + 1, height)
            near, beyond = max(first - reach_px, 0), min(end + reach_px, height)
            outer, last = max(near - 2 * half, 0), min(beyond + 2 * half, height)
            _smoothed(base, outer, last, bell, one, smooth)
            # What the ground is the opening of: the least about each pixel, of these the highest.
            begin, after = max(near - half, 0), min(beyond + half, height)
            if sharp:
                _framed(base, 0, begin - half, after + half, 1.0, one)
            else:
                seen = smooth[: last - outer]
                _framed(seen, outer, begin - half, after + half, 1.0, one)
            least = _least_of_windows(one, other, after - begin + 2 * half, ground_px)
            _framed(least[: after - begin], begin, near - half, beyond + half, -1.0, light)
            size = beyond - near
            minus_ground = _least_of_windows(light, ground, size + 2 * half, ground_px)
            lit = smooth[near - outer : beyond - outer]
            for p in range(size):
                lit[p] += minus_ground[p]
            _framed(lit, near, first - reach_px, end + reach_px, -1.0, one)
            around = _least_of_windows(one, other, end - first + 2 * reach_px, 2 * reach_px + 1)
            here = lit[first - near : end - near]
            for p in range(end - first):
                inside[p] = (here[p] > faint) & (2 * here[p] > -around[p])
            inside[end - first] = False
            cut, begin, after = False, -1, -1
            for p in range(first, end + 1):
                if inside[p - first]:
                    begin, after = p if begin < 0 else begin, p + 1
                elif begin >= 0 and (p == end or p - after >= _CLOSED_PX):
                    begin = 0 if begin == 1 else begin
                    after = height if after == height - 1 else after
                    total, peak = 0.0, -_HIGHEST
                    for q in range(begin, after):
                        above = grey[q] + minus_ground[q - near]
                        total += above
                        peak = max(peak, above)
                    if peak > threshold_dn:
                        cut |= 0 < first >= begin - _CLOSED_PX
                        cut |= height > end <= after + _CLOSED_PX
                        if count == place.shape[1]:
                            place, strength = _doubled(place), _doubled(strength)
                        place[0, count], place[1, count], place[2, count] = c, begin, after - 1
                        strength[0, count], strength[1, count] = total, peak
                        count += 1
                    begin = -1
            if whole:
                break
            if cut:  # a spot reaches farther than was looked
                whole, count = True, before
    return place[:, :count], strength[:, :count]


@compiled_order
def _bright_stretch(grey: GreyValues, start: int, limit: float) -> tuple[int, int]:
    """First and last of the next pixels above the limit, none farther from the next than two rooms.

    The length of the column where there is none.
    """
    height, p = len(grey), start
    while p < height:
        if p + _ROWS <= height and not _greatest(grey[p : p + _ROWS]) > limit:
            p += _ROWS
        elif grey[p] > limit:
            break
        else:
            p += 1
    top = bottom = p
    while p < min(bottom + 2 * _ROOM_PX + 1, height):
        bottom = p if grey[p] > limit else bottom
        p += 1
    return top, bottom


@compiled_order
def _smoothed(
    column: GreyValues, first: int, end: int, bell: Singles, spare: Singles, out: Singles
) -> None:
    """Some pixels of a column, smoothed; it is mirrored about its end pixels."""
    half, last, count = len(bell) // 2, len(column) - 1, end - first
    _framed(column, 0, first - half, end + half, 1.0, spare)
    for p in range(first - half, 0):
        spare[p - first + half] = column[min(-p, last)]
    for p in range(last + 1, end + half):
        spare[p - first + half] = column[max(2 * last - p, 0)]
    middle = spare[half:]
    for i in range(count):
        out[i] = bell[half] * middle[i]
    for k in range(1, half + 1):
        before, after, weight = spare[half - k :], spare[half + k :], bell[half + k]
        for i in range(count):
            out[i] += weight * (before[i] + after[i])


@compiled_order
def _framed(
    values: GreyValues, begin: int, first: int, end: int, sign: float, out: Singles
) -> None:
    """Pixels from ``first`` to ``end``, of values that start at ``begin``; beyond them the highest.

    So the least of a window is that of the part of it that there is.
    """
    inner, outer = max(first, begin), min(end, begin + len(values))
    out[: inner - first] = _HIGHEST
    out[outer - first : end - first] = _HIGHEST
    here, there, factor = values[inner - begin :], out[inner - first :], np.float32(sign)
    for i in range(outer - inner):
        there[i] = factor * here[i]


@compiled_order
def _least_of_windows(values: Singles, spare: Singles, count: int, size: int) -> Singles:
    """The least of each window of ``size`` of so many values, in one of the two arrays.

    Of windows twice as long each time.
    """
    have, turned = 1, False
    while have < size:
        step = min(have, size - have)
        count -= step
        if turned:
            _lesser(spare, spare[step:], values, count)
        else:
            _lesser(values, values[step:], spare, count)
        turned, have = not turned, have + step
    return spare if turned else values


@compiled_order
def _lesser(one: Singles, other: Singles, out: Singles, count: int) -> None:
    for i in range(count):
        out[i] = one[i] if one[i] < other[i] else other[i]


@compiled
def _doubled(table: Any) -> Any:
    """A table (n, K) with room for twice as many columns."""
    longer = np.empty((len(table), 2 * table.shape[1]), table.dtype)
    for i in range(len(table)):  # to assign a slice takes six seconds to compile
        for k in range(table.shape[1]):
            longer[i, k] = table[i, k]
    return longer


# What makes pixels scatter about a fitted line (picture.py).


@compiled_sums
def shot_and_speckle(square: Floats, light: Floats, constant: float) -> tuple[float, float]:
    """DN of variance per DN of light, and speckle, that ``picture.scatter_noise`` finds.

    Parameters
    ----------
    square : (N,) array, DN², on average the variance
    light : (N,) array, DN
    constant : float, DN²
    """
    shot, speckle = 0.0, 0.0
    for turn in range(4):
        # The normal equations of square - constant = shot light + speckle² light².
        one, both, two, first, second = 0.0, 0.0, 0.0, 0.0, 0.0
        for p in range(len(light)):
            grey = light[p]
            variance = constant + shot * max(grey, 0.0) + (speckle * grey) ** 2
            # Nothing is known of the line's part yet at the first turn: all squares count.
            core = turn == 0 or square[p] <= 25 * variance
            root = 1 / max(variance, 1e-3 * grey**2) if core else 0.0
            weight, rest = (root * grey) ** 2, square[p] - constant
            one, both, two = one + weight, both + weight * grey, two + weight * grey**2
            first, second = first + root**2 * grey * rest, second + weight * rest
        shot, speckled = _non_negative(one, both, two, first, second)
        speckle = min(sqrt(speckled), 1.0)
    return shot, speckle


@compiled
def _non_negative(
    one: float, both: float, two: float, first: float, second: float
) -> tuple[float, float]:
    """The least squares solution, neither part below 0, of two normal equations."""
    found = one * two - both * both
    x, y = (first * two - second * both) / found, (second * one - first * both) / found
    if found > 0 and x >= 0 and y >= 0:
        return x, y
    x, y = max(first / one, 0.0) if one > 0 else 0.0, max(second / two, 0.0) if two > 0 else 0.0
    return (
        (x, 0.0) if x * first > y * second else (0.0, y)
    )  # what each takes off the sum of squares


# Runs of spots side by side (peaks.py).


@compiled
def linked_runs(column: Ints, top: Ints, bottom: Ints, gap: int) -> Ints:
    """(K,) number of the run each spot belongs to, as ``peaks.runs_of`` says.

    Parameters
    ----------
    column, top, bottom : (K,) array, px, of the spots, columns rising
    gap : int, most columns from a spot to the next of its run
    """
    count = len(column)
    before = np.full(count, -1)  # the spot to the left that each is linked to
    is_open = np.ones(count, np.bool_)  # to the right
    for apart in range(1, gap + 1):
        to_right, to_left = np.full(count, -1), np.full(count, -1)
        right_px, left_px = np.full(count, np.inf), np.full(count, np.inf)
        begin = 0
        for k in range(count):
            while begin < count and column[begin] < column[k] + apart:
                begin += 1
            j = begin
            while j < count and column[j] == column[k] + apart:
                distance = abs(top[k] + bottom[k] - top[j] - bottom[j]) / 2
                height = bottom[k] - top[k] + bottom[j] - top[j] + 2
                if is_open[k] and before[j] < 0 and distance <= height / 2 + apart:
                    if distance < right_px[k]:
                        right_px[k], to_right[k] = distance, j
                    if distance < left_px[j]:
                        left_px[j], to_left[j] = distance, k
                j += 1
        for k in range(count):
            j = to_right[k]
            if j >= 0 and to_left[j] == k:
                before[j], is_open[k] = k, False
    run, runs = np.empty(count, np.int64), 0
    for k in range(count):
        if before[k] < 0:
            run[k], runs = runs, runs + 1
        else:
            run[k] = run[before[k]]
    return run


# The best path through spots (returns.py).


@compiled
def best_path(
    column: Ints,
    middle: Floats,
    gain: Floats,
    gap: int,
    jump_px: float,
    begin: float,
    missed: float,
) -> Ints:
    """Indices of the spots on the path of the highest sum, by dynamic programming.

    Parameters
    ----------
    column, middle : (K,) array, px, of the spots, columns rising
    gain : (K,) array, what a path gains by each
    gap : int, most columns from a spot to the next of its path
    jump_px : float, px a column, by which a path moves at the price of 1
    begin : float, the price of another beginning, and the most that a move costs
    missed : float, the price of a column without a spot

    References
    ----------
    R. Bellman, Dynamic Programming, Princeton 1957: of the best path every beginning is best.
    """
    count = len(column)
    score, back = np.empty(count), np.full(count, -1)
    top_score, top, first, oldest = 0.0, -1, 0, 0
    while first < count:
        end = first
        while end < count and column[end] == column[first]:
            end += 1
        while column[oldest] < column[first] - gap:
            oldest += 1
        for k in range(first, end):
            best = top_score - begin
            back[k] = top
            for j in range(oldest, first):
                apart = column[k] - column[j]
                move = min(abs(middle[k] - middle[j]) / (jump_px * apart), begin)
                value = score[j] - move - missed * (apart - 1)
                if value > best:
                    best, back[k] = value, j
            score[k] = gain[k] + best
        for k in range(first, end):
            if score[k] > top_score:
                top_score, top = score[k], k
        first = end
    length, k = 0, top
    while k >= 0:
        length, k = length + 1, back[k]
    path = np.empty(length, np.int64)
    for place in range(length - 1, -1, -1):
        path[place], top = top, back[top]
    return path
