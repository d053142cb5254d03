"""Loops over marks that are compiled: arrays in and arrays out, without records."""

from math import exp, hypot, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, Mask
from lscan.stripe.kernels import compiled, compiled_sums, factorise, solve_factorised


def compile_marks() -> None:
    """Compile all loops, for the processes that follow."""
    for kind in (np.float32, np.float64):
        fit_marks(
            np.zeros((3, 3), kind), np.zeros((3, 3), kind), np.ones((1, 2)), np.ones(1), 5, 1, False
        )


# The centres of marks (picture.py).


RIDGE = 5.0  # ratio of the curvatures beyond which a mark is a ridge
TERMS = 6  # of a second-order polynomial: 1, x, y, x², xy, y²
_OF_X, _OF_Y = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
_POWERS = 5  # of the distance, whose products make the normal equations
_AT_REST = 1e-10  # px: a step as small changes nothing more


@compiled_sums
def fit_marks(
    flat: NDArray[np.floating[Any]],
    noise: NDArray[np.floating[Any]],
    start: Floats,
    sigma: Floats,
    reach: int,
    steps: int,
    saddles: bool,
) -> tuple[Floats, Floats, Floats, Mask]:
    """The fields of ``picture.Centres``, of N marks in windows that reach so far about the starts.

    The Gaussian weights separate into u and v, so all sums are products of moments.

    Parameters
    ----------
    flat, noise : (H, W) array, grey values and the standard deviation of each; 0 beyond
    start : (N, 2) array, px, of (u, v)
    sigma : (N,) array, px, of the weights
    reach, steps : int, px; of Newton's method
    saddles : bool, whether saddles are sought, not maxima
    """
    count, width = len(start), 2 * reach + 1
    points, height, scatter = np.empty((count, 2)), np.empty(count), np.zeros(count)
    good = np.zeros(count, np.bool_)
    grey, power = np.empty((width, width)), np.empty((2, _POWERS, width))
    moment, left, right = np.empty((2, _POWERS)), np.empty((TERMS, TERMS)), np.empty(TERMS)
    # The ratio r of the curvatures gives trace² / determinant = (r + 1)² / r, of a saddle
    # (r - 1)² / -r.
    least = RIDGE / (RIDGE - 1) ** 2 if saddles else RIDGE / (RIDGE + 1) ** 2
    for k in range(count):
        u, v = int(np.rint(start[k, 0])), int(np.rint(start[k, 1]))
        _window(flat, u - reach, v - reach, grey)
        away, length, wide = np.zeros(2), 0.0, sigma[k]
        for turn in range(steps + 1):
            for axis in range(2):
                _powers(away[axis], wide, power[axis], moment[axis])
            _sums(grey, power, right)
            for i in range(TERMS):
                for j in range(i, TERMS):
                    in_x, in_y = _OF_X[i] + _OF_X[j], _OF_Y[i] + _OF_Y[j]
                    left[i, j] = moment[0, in_x] * moment[1, in_y]
            factorise(left)
            solve_factorised(left, right)
            uu, uv, vv = 2 * right[3] / wide**2, right[4] / wide**2, 2 * right[5] / wide**2
            trace, determinant = uu + vv, uu * vv - uv * uv
            wanted = -determinant > trace**2 * least
            if not saddles:
                wanted = trace < 0 and determinant > trace**2 * least
            if turn == steps or not wanted or (turn > 0 and length < _AT_REST):
                break
            by_u, by_v = right[1] / wide, right[2] / wide
            step_u = (uv * by_v - vv * by_u) / determinant
            step_v = (uv * by_u - uu * by_v) / determinant
            length = hypot(step_u, step_v)
            part = min(1.0, wide / max(length, 1e-12))
            length *= part
            away[0] = min(max(away[0] + part * step_u, -reach), reach)
            away[1] = min(max(away[1] + part * step_v, -reach), reach)
        points[k, 0], points[k, 1], height[k] = u + away[0], v + away[1], right[0]
        if not wanted:
            continue
        good[k] = hypot(away[0], away[1]) <= max(1.5, wide) and length < 0.01
        # The gradient is the sum of w d f over that of w d², w the weights, d the distances and
        # f the grey values; the inverse Hessian turns its covariance into that of the maximum.
        _window(noise, u - reach, v - reach, grey)
        for j in range(width):
            for i in range(width):
                grey[j, i] *= grey[j, i]
        for axis in range(2):
            for i in range(width):
                squared = power[axis, 0, i] ** 2
                distance = i - reach - away[axis]
                power[axis, 0, i], power[axis, 1, i] = squared, squared * distance
                power[axis, 2, i] = squared * distance**2
        _sums(grey, power, right)
        by_u, by_v, both = right[3], right[5], right[4]
        along_u = vv * (vv * by_u - uv * both) - uv * (vv * both - uv * by_v)
        along_v = uu * (uu * by_v - uv * both) - uv * (uu * both - uv * by_u)
        total = determinant * moment[0, 0] * moment[1, 0] * wide**2
        scatter[k] = sqrt(max((along_u + along_v) / 2, 0.0)) / abs(total)
    return points, height, scatter, good


@compiled
def _window(picture: NDArray[np.floating[Any]], left: int, top: int, window: Floats) -> None:
    """Fill a window with the picture from a pixel on, with 0 beyond the picture's edge."""
    rows, columns = picture.shape
    for j in range(len(window)):
        row = top + j
        if row < 0 or row >= rows:
            window[j] = 0.0
            continue
        for i in range(window.shape[1]):
            column = left + i
            inside = column >= 0 and column < columns
            window[j, i] = picture[row, column] if inside else 0.0


@compiled_sums
def _powers(away: float, sigma: float, power: Floats, moment: Floats) -> None:
    """The weights of a window's rows or columns times powers of the distance; and their sums."""
    reach = power.shape[1] // 2
    for i in range(power.shape[1]):
        distance = (i - reach - away) / sigma
        value = exp(-0.5 * distance * distance)
        for p in range(_POWERS):
            power[p, i] = value
            value *= distance
    for p in range(_POWERS):
        moment[p] = power[p].sum()


@compiled_sums
def _sums(grey: Floats, power: Floats, right: Floats) -> None:
    """The sums of a window's values times the weighted terms of the polynomial."""
    right[:] = 0.0
    for j in range(len(grey)):
        one, x, square = 0.0, 0.0, 0.0
        for i in range(grey.shape[1]):
            value = grey[j, i]
            one += power[0, 0, i] * value
            x += power[0, 1, i] * value
            square += power[0, 2, i] * value
        right[0] += power[1, 0, j] * one
        right[1] += power[1, 0, j] * x
        right[2] += power[1, 1, j] * one
        right[3] += power[1, 0, j] * square
        right[4] += power[1, 1, j] * x
        right[5] += power[1, 2, j] * one
