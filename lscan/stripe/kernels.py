"""Loops that are compiled: one line after another, arrays in and arrays out, without records."""

import logging
from collections.abc import Callable
from math import erfc, exp, log, pi, sqrt
from typing import Any, ParamSpec, TypeAlias, TypeVar, cast

import numba
import numpy as np
from numba.core import event
from scipy.special import ndtr

from lscan.records import Floats, GreyValues, Ints, Mask

_log = logging.getLogger(__name__)

_P = ParamSpec("_P")
_R = TypeVar("_R")


class _FirstTime(event.Listener):
    """Says once why nothing happens for some seconds."""

    said = False

    def on_start(self, event: event.Event) -> None:
        """Called where something is compiled that no cache has."""
        if not self.said:
            _log.warning("note: compiles what reads pictures: some seconds, once if it can be kept")
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


def compile_all() -> None:
    """Compile all loops, for the processes that follow."""
    line, window, used = np.zeros((1, PARAMETERS)), np.zeros((1, 3)), np.ones((1, 3), np.bool_)
    noise, precision = np.array([1.0, 0.0, 0.0]), np.ones((1, PARAMETERS))
    fit_columns(line, -1.0, window, np.zeros(1), used, ~used, noise, line, precision)
    lines_at(line, -1.0, 3)
    for kind in (np.uint8, np.int16, np.float32, np.float64):
        weighted_moments(np.ones((1, 9), kind), np.zeros(1, np.int64), np.array([4.0]), 1.0)
    one = np.zeros(1, np.int64)
    linked_runs(one, one, one, 1)
    best_path(one, np.zeros(1), np.zeros(1), 1, 1.0, 1.0, 1.0)
    from lscan.board.kernels import compile_marks  # it has its decorators from here

    compile_marks()


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


# Moments of the light across a line (scatter.py).


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
