"""Loops over marks that are compiled: arrays in and arrays out, without records."""

from math import atan2, cos, exp, hypot, nan, pi, sin, sqrt
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lscan.files.compiling import compiled, compiled_sums
from lscan.records import Floats, Ints, Mask

Grey: TypeAlias = NDArray[np.floating[Any]]
Single: TypeAlias = NDArray[np.float32]


def compile_marks() -> None:
    """Compile all loops, for the processes that follow."""
    for kind in (np.float32, np.float64):
        grey, one, number = np.zeros((3, 3), kind), np.ones((1, 2)), np.ones(1, np.int64)
        fit_marks(grey, grey, one, np.ones(1), number, 1, False)
    single, some = np.zeros((3, 3), np.float32), np.zeros((1, 1, 2))
    brightest(single, np.ones((1, 2), np.int64), number)
    means_of_known(some, np.zeros((1, 6), np.int64))
    round_peaks(single, single, 0.0, 4.0)
    noise_by_level(single, np.ones(1), np.ones(1), 1.0)
    crosses(one, 1.0, 2.0, 4, 0.5)
    local_polynomials(one, one, np.zeros((1, 1), np.int64), one, 1.0)
    disc_shifts(np.ones((1, 2, 2)), np.ones((1, 2, 2, 2)), np.ones(1), np.ones(1))


# The centres of marks (picture.py).


RIDGE = 5.0  # ratio of the curvatures beyond which a mark is a ridge
TERMS = 6  # of a second-order polynomial: 1, x, y, x², xy, y²
_OF_X, _OF_Y = (0, 1, 0, 2, 1, 0), (0, 0, 1, 0, 1, 2)
_POWERS = 5  # of the distance, whose products make the normal equations
_AT_REST = 1e-7  # px: the next step is a hundredth of it


@compiled_sums
def fit_marks(
    flat: Grey, noise: Grey, start: Floats, sigma: Floats, reach: Ints, steps: int, saddles: bool
) -> tuple[Floats, Floats, Floats, Mask]:
    """The fields of ``picture.Centres``, of N marks in windows about the starts.

    The Gaussian weights separate into u and v, so all sums are products of moments.

    Parameters
    ----------
    flat, noise : (H, W) array, grey values and the standard deviation of each; 0 beyond
    start : (N, 2) array, px, of (u, v)
    sigma : (N,) array, px, of the weights
    reach : (N,) array, px, of the windows to all sides
    steps : int, of Newton's method
    saddles : bool, whether saddles are sought, not maxima
    """
    count = len(start)
    points, height, scatter = np.empty((count, 2)), np.empty(count), np.zeros(count)
    good = np.zeros(count, np.bool_)
    grey, power = np.empty((0, 0)), np.empty((2, _POWERS, 0))
    moment, left, right = np.empty((2, _POWERS)), np.empty((TERMS, TERMS)), np.empty(TERMS)
    # The ratio r of the curvatures gives trace² / determinant = (r + 1)² / r, of a saddle
    # (r - 1)² / -r.
    least = RIDGE / (RIDGE - 1) ** 2 if saddles else RIDGE / (RIDGE + 1) ** 2
    for k in range(count):
        u, v, width = int(np.rint(start[k, 0])), int(np.rint(start[k, 1])), 2 * reach[k] + 1
        if len(grey) != width:
            grey, power = np.empty((width, width)), np.empty((2, _POWERS, width))
        _window(flat, u - reach[k], v - reach[k], grey)
        away, length, wide = np.zeros(2), 0.0, sigma[k]
        for turn in range(steps + 1):
            for axis in range(2):
                _powers(away[axis], wide, power[axis], moment[axis])
            _sums(grey, power, right)
            for i in range(TERMS):
                for j in range(i, TERMS):
                    in_x, in_y = _OF_X[i] + _OF_X[j], _OF_Y[i] + _OF_Y[j]
                    left[i, j] = moment[0, in_x] * moment[1, in_y]
            _solve(left, right.reshape(TERMS, 1))
            uu, uv, vv = 2 * right[3], right[4], 2 * right[5]  # times the weights' variance
            trace, determinant = uu + vv, uu * vv - uv * uv
            wanted = -determinant > trace**2 * least
            if not saddles:
                wanted = trace < 0 and determinant > trace**2 * least
            if turn == steps or not wanted or (turn > 0 and length < _AT_REST):
                break
            step_u = wide * (uv * right[2] - vv * right[1]) / determinant
            step_v = wide * (uv * right[1] - uu * right[2]) / determinant
            whole = hypot(step_u, step_v)
            length = min(whole, wide)
            away[0] += step_u * (length / max(whole, 1e-12))
            away[1] += step_v * (length / max(whole, 1e-12))
            for axis in range(2):
                away[axis] = min(max(away[axis], -reach[k]), reach[k])
        points[k, 0], points[k, 1], height[k] = u + away[0], v + away[1], right[0]
        if not wanted:
            continue
        good[k] = hypot(away[0], away[1]) <= max(1.5, wide) and length < 0.01
        # The gradient is the sum of w d f over that of w d², w the weights, d the distances and
        # f the grey values; the inverse Hessian turns its covariance into that of the maximum.
        _window(noise, u - reach[k], v - reach[k], grey)
        for axis in range(2):
            power[axis, 0] *= power[axis, 0]
            for n in range(2):
                for i in range(width):
                    power[axis, n + 1, i] = power[axis, n, i] * (i - reach[k] - away[axis])
        _sums(grey * grey, power, right)
        spread = (vv * vv + uv * uv) * right[3] + (uu * uu + uv * uv) * right[5]
        spread = max(spread - 2 * uv * trace * right[4], 0.0) / 2
        scatter[k] = sqrt(spread) / abs(determinant * moment[0, 0] * moment[1, 0])
    return points, height, scatter, good


@compiled
def _window(picture: Grey, left: int, top: int, window: Floats) -> None:
    """Fill a window with the picture from a pixel on, with 0 beyond the picture's edge."""
    rows, columns = picture.shape
    first = min(max(left, 0), columns)
    last = max(min(left + window.shape[1], columns), first)
    window[:] = 0.0
    for j in range(max(-top, 0), min(len(window), rows - top)):
        row, own = picture[top + j, first:last], window[j, first - left :]
        for i in range(len(row)):  # from 0 on: no index is below it
            own[i] = row[i]


@compiled
def brightest(smooth: Single, middle: Ints, half: Ints) -> Ints:
    """(N, 2) px of the brightest pixel in each box, the uppermost and leftmost where several are.

    Parameters
    ----------
    smooth : (H, W) array, grey values
    middle : (N, 2) array, px, (u, v) of the boxes; itself where a box lies beside the picture
    half : (N,) array, px, half their sides
    """
    rows, columns = smooth.shape
    found = middle.copy()
    for k in range(len(middle)):
        best = -np.inf
        u, v = middle[k]
        for row in range(max(v - half[k], 0), min(v + half[k] + 1, rows)):
            for column in range(max(u - half[k], 0), min(u + half[k] + 1, columns)):
                if smooth[row, column] > best:
                    best = smooth[row, column]
                    found[k, 0], found[k, 1] = column, row
    return found


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
    weight, by_x, by_square = power[0, 0], power[0, 1], power[0, 2]
    for j in range(len(grey)):
        row, one, x, square = grey[j], 0.0, 0.0, 0.0
        for i in range(len(row)):
            one += weight[i] * row[i]
            x += by_x[i] * row[i]
            square += by_square[i] * row[i]
        for n in range(TERMS):
            right[n] += power[1, _OF_Y[n], j] * (one, x, square)[_OF_X[n]]


@compiled
def _solve(left: Floats, right: Floats) -> float:
    """Solve symmetric, positive equations; the determinant over the product of the diagonal.

    left: (m, m), its upper half, which is spoilt.  right: (m, K), which becomes the solutions.
    """
    part = 1.0
    for i in range(len(left)):
        part /= left[i, i]
    for i in range(len(left)):
        part *= left[i, i]
        for j in range(i + 1, len(left)):
            factor = left[i, j] / left[i, i]
            for c in range(j, len(left)):
                left[j, c] -= factor * left[i, c]
            for c in range(right.shape[1]):
                right[j, c] -= factor * right[i, c]
    for i in range(len(left) - 1, -1, -1):
        for c in range(right.shape[1]):
            for j in range(i + 1, len(left)):
                right[i, c] -= left[i, j] * right[j, c]
            right[i, c] /= left[i, i]
    return part


# The walk from mark to mark (search.py).


@compiled
def means_of_known(values: Floats, guesses: Ints) -> Floats:
    """(R, C, K) means of the guesses at each node that are known; NaN where none is.

    Parameters
    ----------
    values : (R, C, K) array, NaN where nothing is known
    guesses : (G, 6) array, steps in rows and columns to three nodes: the values of the first two
        less that of the third
    """
    rows, columns, kinds = values.shape
    mean = np.full_like(values, nan)
    for r in range(rows):
        for c in range(columns):
            for k in range(kinds):
                count, total = 0, 0.0
                for up, left, down, right, far, off in guesses:
                    # The third node is farthest: the others are nodes where it is one.
                    if 0 <= r + far < rows and 0 <= c + off < columns:
                        guess = values[r + up, c + left, k] + values[r + down, c + right, k]
                        guess -= values[r + far, c + off, k]
                        if np.isfinite(guess):
                            count += 1
                            total += guess
                if count > 0:
                    mean[r, c, k] = total / count
    return mean


# Round marks of one size, and crosses of them (search.py).


@compiled
def round_peaks(smooth: Single, bent: Single, floor: float, longest: float) -> Ints:
    """(N,) places of pixels about which a picture falls off in all directions alike.

    Parameters
    ----------
    smooth, bent : (H, W) array, the picture and its negative Laplacian, which is greatest there
    floor : float, what that exceeds
    longest : float, greatest ratio of the curvatures along and across
    """
    rows, columns = smooth.shape
    found = []
    least = longest / (longest + 1) ** 2
    for r in range(1, rows - 1):
        for c in range(1, columns - 1):
            here = bent[r, c]
            if here <= floor or here < bent[r, c - 1] or here < bent[r, c + 1]:
                continue
            above, under = bent[r - 1, c - 1 : c + 2], bent[r + 1, c - 1 : c + 2]
            if here < above.max() or here < under.max():
                continue
            middle = 2.0 * smooth[r, c]
            uu = smooth[r, c + 1] + smooth[r, c - 1] - middle
            vv = smooth[r + 1, c] + smooth[r - 1, c] - middle
            uv = smooth[r + 1, c + 1] + smooth[r - 1, c - 1] + 0.0
            uv = (uv - smooth[r + 1, c - 1] - smooth[r - 1, c + 1]) / 4
            if uu + vv < 0 and uu * vv - uv * uv > (uu + vv) ** 2 * least:
                found.append(r * columns + c)
    return np.array(found, np.int64)


@compiled
def crosses(points: Floats, low: float, high: float, most: int, lean: float) -> Floats:
    """(N, 8) px: steps to the nearest point right, left, beneath and above; NaN unless all are.

    Parameters
    ----------
    points : (N, 2) array, px, of (u, v)
    low, high : float, px, from and up to which a point is one beside another
    most : int, of the nearest points that are looked at
    lean : float, tangent of the most a row may lean against a column's square
    """
    found, count = np.full((len(points), 8), nan), len(points)
    order = np.argsort(points[:, 1], kind="mergesort")
    first, ranked = 0, points[order]
    squares, near = np.empty(most), np.empty((most, 2))
    for rank, k in enumerate(order):
        while ranked[first, 1] < ranked[rank, 1] - high:
            first += 1
        held = 0  # sorted by distance
        for n in range(first, count):
            u, v = ranked[n, 0] - ranked[rank, 0], ranked[n, 1] - ranked[rank, 1]
            if v >= high:
                break
            square = u * u + v * v
            if square >= high * high or n == rank or (held == most and square >= squares[-1]):
                continue
            held = min(held + 1, most)
            place = held - 1
            while place > 0 and squares[place - 1] > square:
                squares[place] = squares[place - 1]
                near[place, 0], near[place, 1] = near[place - 1, 0], near[place - 1, 1]
                place -= 1
            squares[place], near[place, 0], near[place, 1] = square, u, v
        begin = 0
        while begin < held and squares[begin] < low * low:
            begin += 1
        if held - begin < 4:
            continue
        # Turned, by 45 degrees at most, so that the nearest neighbour lies on an axis.
        angle = atan2(near[begin, 1], near[begin, 0])
        angle -= np.rint(angle / (pi / 2)) * (pi / 2)
        across, down = cos(angle), sin(angle)
        for n in range(held - 1, begin - 1, -1):  # the nearest last
            u, v = near[n]
            along, off = u * across + v * down, v * across - u * down
            if abs(off) < lean * abs(along):
                way = 0 if along > 0 else 2
            elif abs(along) < lean * abs(off):
                way = 4 if off > 0 else 6
            else:
                continue
            found[k, way], found[k, way + 1] = u, v
    return found


# The noise of pixels (reader.py) and the local map about places of the board (lattice.py).


@compiled
def noise_by_level(grey: Single, levels: Floats, variances: Floats, least: float) -> Single:
    """(H, W) roots of variances that are linear in the grey value from level to level.

    Parameters
    ----------
    grey : (H, W) array
    levels, variances : (L,) array, levels rising; beyond the outermost, variances stay
    least : float, of the variance
    """
    noise = np.empty_like(grey)
    for place, value in np.ndenumerate(grey):
        n = 0
        while n < len(levels) and levels[n] < value:
            n += 1
        variance = variances[min(n, len(levels) - 1)]
        if 0 < n < len(levels):
            share = (levels[n] - value) / (levels[n] - levels[n - 1])
            variance -= share * (variance - variances[n - 1])
        noise[place] = sqrt(max(variance, least))
    return noise


@compiled_sums
def local_polynomials(
    board: Floats, image: Floats, index: Ints, places: Floats, pitch: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Second-order polynomials through the points nearest to M places.

    Parameters
    ----------
    board, image : (N, 2) array, mm and px, of the points
    index : (M, K) array, of those nearest to each place
    places : (M, 2) array, mm
    pitch : float, mm, the unit of the polynomials

    Returns
    -------
    tuple of array
        (M, 6, 6) left and (M, 6, 3) right sides of the normal equations, the last of the terms'
        own variance; (M, 6, 3) their solutions; and (M,) determinants over the diagonals' products.
    """
    count = len(places)
    left, right = np.zeros((count, TERMS, TERMS)), np.zeros((count, TERMS, 3))
    solved, free, design = np.empty((count, TERMS, 3)), np.empty(count), np.ones(TERMS)
    for m in range(count):
        for n in index[m]:
            x = (board[n, 0] - places[m, 0]) / pitch
            z = (board[n, 1] - places[m, 1]) / pitch
            design[1], design[2], design[3], design[4], design[5] = x, z, x * x, x * z, z * z
            for i in range(TERMS):
                for j in range(TERMS):
                    left[m, i, j] += design[i] * design[j]
                right[m, i, 0] += design[i] * image[n, 0]
                right[m, i, 1] += design[i] * image[n, 1]
        right[m, 0, 2] = 1.0
        for i in range(TERMS):
            for j in range(3):
                solved[m, i, j] = right[m, i, j]
        free[m] = _solve(left[m].copy(), solved[m])
    return left, right, solved, free


_RINGS, _SPOKES = 3, 8  # quadrature over a disc: exact to the fifth order in its points
_STEPS = 2  # Newton's; the shift is small beside the window, so the first is good to a percent
_NODES, _SHARES = np.polynomial.legendre.leggauss(_RINGS)  # in the area


@compiled_sums
def disc_shifts(jacobian: Floats, bend: Floats, radius: Floats, variance: Floats) -> Floats:
    """(N, 2) px from the image of each disc's centre to the maximum of its smoothed image.

    Parameters
    ----------
    jacobian, bend : (N, 2, 2) and (N, 2, 2, 2) array, px and mm, of the map about the centres
    radius : (N,) array, mm, of the discs
    variance : (N,) array, px², of the smoothing
    """
    count = len(jacobian)
    top, image = np.zeros((count, 2)), np.empty((_RINGS * _SPOKES, 2))
    mass, by, half = np.empty(len(image)), np.empty((2, 2)), np.empty((2, 2))
    for k in range(count):
        for q in range(len(image)):
            reach = radius[k] * sqrt((_NODES[q // _SPOKES] + 1) / 2)
            angle = 2 * pi * (q % _SPOKES) / _SPOKES
            x, z = reach * cos(angle), reach * sin(angle)
            for c in range(2):
                for i in range(2):
                    bent = bend[k, c, i, 0] * x + bend[k, c, i, 1] * z
                    by[c, i], half[c, i] = jacobian[k, c, i] + bent, jacobian[k, c, i] + bent / 2
                image[q, c] = half[c, 0] * x + half[c, 1] * z
            area = by[0, 0] * by[1, 1] - by[0, 1] * by[1, 0]
            mass[q] = _SHARES[q // _SPOKES] * abs(area)
        for _ in range(_STEPS):
            total, by_u, by_v, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for q in range(len(image)):
                u, v = image[q, 0] - top[k, 0], image[q, 1] - top[k, 1]
                weight = mass[q] * exp(-(u * u + v * v) / (2 * variance[k]))
                total += weight
                by_u, by_v = by_u + weight * u, by_v + weight * v
                uu, uv, vv = uu + weight * u * u, uv + weight * u * v, vv + weight * v * v
            uu, uv, vv = uu / variance[k] - total, uv / variance[k], vv / variance[k] - total
            determinant = uu * vv - uv * uv
            top[k, 0] -= (vv * by_u - uv * by_v) / determinant
            top[k, 1] -= (uu * by_v - uv * by_u) / determinant
    return top
