"""How noisy each pixel is: the scatter of grey values on the plate and inside the dots.

A sensor's noise grows with the light, so a bright plate is noisier than the dark dots on it.
On the plate it is seen directly.  A dot of few pixels is nowhere flat; there the noise is what
its odd third differences do not share with those of all other dots, which are alike.
"""

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import ndtr

from lscan.board.picture import (
    IMMERKAER,
    BoardPicture,
    Image,
    enlarge,
    rounding_of,
    shrink,
    window_sigma,
    working_reduction,
)
from lscan.board.search import Nodes, shift_by
from lscan.records import Floats, Mask

CUT = 2.5  # sigmas beyond which a difference is taken for a mark's, not for noise
# The variance of a normal so cut.
KEPT = 1 - 2 * CUT * np.exp(-(CUT**2) / 2) / np.sqrt(2 * np.pi) / (2 * ndtr(CUT) - 1)
CLEAR = 1.7  # of the dot's radius: from there on the plate
LEVELS = 8  # of the plate's brightness
FEWEST_PIXELS = 400  # per level: they give sigma to 4 %
MOST_PIXELS = 100_000  # they give the sigma of each level to 1 %
FEWEST_DOTS = 40  # two differences each, 24 coefficients: sigma to 10 %
GRAINY = 2.0  # times white noise; chance makes 1.5 of some twenty differences
GRAIN_REACH = 3  # nodes to either side
GRAIN_FEWEST = 6  # differences about a node; with fewer it is as elsewhere


def noise_image(bright: Image, nodes: Nodes, radius_px: float) -> Image:
    """(H, W) standard deviation of the noise of each pixel, in grey values.

    Between the levels at which the variance is seen it is taken as linear in the grey value, as
    shot noise is; it is at least that of rounding.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    nodes : Nodes, px, the dots found
    radius_px : float, px, about that of the dots
    """
    smooth = np.asarray(cv2.GaussianBlur(bright, (0, 0), 1.0), dtype=np.float32)
    levels, variances = _plate_levels(bright, smooth, nodes, radius_px)
    if (dot := _dot_level(bright, nodes)) is not None:
        levels, variances = np.append(levels, dot[0]), np.append(variances, dot[1])
    order = np.argsort(levels)
    some = shrink(smooth, working_reduction(bright, radius_px))
    variance = np.interp(some, levels[order], variances[order])
    noise = np.sqrt(np.maximum(variance, rounding_of(bright) ** 2)).astype(np.float32)
    return enlarge(noise, bright.shape)


def _plate_levels(
    bright: Image, smooth: Image, nodes: Nodes, radius_px: float
) -> tuple[Floats, Floats]:
    """Levels and variances of up to eight parts of the plate, from the darkest to the brightest.

    The norm of Immerkær's mask (picture.noise_of) is 6.
    """
    response = cv2.filter2D(bright, cv2.CV_32F, IMMERKAER)
    plate = _clear_of(nodes, radius_px, bright.shape)
    thinning = max(1, int(plate.sum()) // MOST_PIXELS)
    values = response[plate][::thinning].astype(float)
    level = smooth[plate][::thinning].astype(float)
    count = int(np.clip(len(level) // FEWEST_PIXELS, 1, LEVELS))
    order = np.argsort(level, kind="stable")
    parts = np.array_split(order, count)
    return (
        np.array([np.median(level[part]) for part in parts]),
        np.array([_cut_variance(values[part]) / 36 for part in parts]),
    )


def _clear_of(nodes: Nodes, radius_px: float, shape: tuple[int, ...]) -> Mask:
    """(H, W) mask of the pixels well away from every dot, all inner pixels where none are."""
    clear = np.zeros(shape, np.uint8)
    clear[1:-1, 1:-1] = 1
    radius = int(np.ceil(CLEAR * radius_px))
    for u, v in np.rint(nodes.points[nodes.found]).astype(int):
        cv2.circle(clear, (int(u), int(v)), radius, 0, -1)
    if clear.sum() < FEWEST_PIXELS:
        clear[1:-1, 1:-1] = 1
    return clear.astype(bool)


def _dot_level(bright: Image, nodes: Nodes) -> tuple[float, float] | None:
    """Level and variance in the middle of the dots, None where too few were found.

    The third difference [1 -2 1] by [-1 0 1], whose squared norm is 12, vanishes in the middle
    of a symmetric dot; beside the middle it grows as an odd function of the distance from it,
    alike in all dots but for their size, which changes evenly over the board.  A regression
    over the dots takes that out.
    """
    points, contrast = nodes.points[nodes.found], nodes.height[nodes.found]
    base = np.rint(points).astype(np.int64)
    height, width = bright.shape
    inner = (base >= 1).all(axis=1) & (base <= [width - 2, height - 2]).all(axis=1)
    points, contrast, base = points[inner], contrast[inner], base[inner]
    if len(base) < FEWEST_DOTS:
        return None
    column, row = (base - 1).T
    patches = sliding_window_view(bright, (3, 3))[row, column].astype(np.float64)
    even, odd = np.array([1.0, -2.0, 1.0]), np.array([-1.0, 0.0, 1.0])
    offset = points - base
    middle = (points - points.mean(axis=0)) / points.std(axis=0)
    place = np.column_stack([np.ones(len(points)), middle])
    squares = []
    for axis in (0, 1):
        rows, columns = (odd, even) if axis == 1 else (even, odd)
        difference = np.einsum("nij,i,j->n", patches, rows, columns)
        along, across = offset[:, axis], offset[:, 1 - axis]
        odd_terms = np.stack([along, along**3, along * across**2], axis=1)
        sized = (odd_terms[:, :, None] * place[:, None]).reshape(len(base), -1)
        rest = np.stack([np.ones_like(along), across, along**5], axis=1)
        design = np.hstack([sized, rest]) * contrast[:, None]
        solved = np.linalg.lstsq(design, difference, rcond=None)[0]
        freedom = len(base) / (len(base) - design.shape[1])
        squares.append(_cut_variance(difference - design @ solved) * freedom / 12)
    return float(np.median(patches)), float(np.mean(squares))


def _cut_variance(values: Floats) -> float:
    """Variance of the normal noise in ``values``, what lies beyond 2.5 sigmas left out."""
    variance = (float(np.median(np.abs(values))) / 0.6745) ** 2
    for _ in range(10):
        kept = values[values**2 <= CUT**2 * variance]
        if len(kept) == 0 or variance == 0:
            break
        variance = float(np.mean(kept**2)) / KEPT
    return variance


def grain(picture: BoardPicture, points: Floats, radius_px: float) -> Floats:
    """(R, C) by how much noise under the marks' windows exceeds white noise of pixels; 1 or more.

    Denoising and coding leave noise that neighbouring pixels share, which smoothing hardly takes
    away.  It is seen in the middle between four dots, in the picture smoothed as for them, by
    second differences from cell to cell: slopes of the ground cancel, and the marks of a ruler
    disturb one direction only.  Below twice that of white noise it is taken for chance.

    Parameters
    ----------
    picture : BoardPicture, levelled, with the noise of its pixels
    points : (R, C, 2) array, px, (u, v) of all nodes of the grid, seen or not
    radius_px : float, px, of the control dots
    """
    middle = (points[1:, 1:] + points[1:, :-1] + points[:-1, 1:] + points[:-1, :-1]) / 4
    inside = picture.wholly_in_view(middle, radius_px)
    middle = np.where(inside[..., None], middle, 0.0)
    column, row = np.moveaxis(np.rint(middle).astype(np.int64), -1, 0)
    sigma = float(window_sigma(np.array([radius_px]))[0])
    white = picture.noise_at(middle.reshape(-1, 2)).reshape(inside.shape) / (2 * np.sqrt(np.pi))
    scaled = np.where(inside, picture.smooth[row, column] * sigma / white, np.nan)
    scaled = np.pad(scaled, ((0, 1), (0, 1)), constant_values=np.nan)  # cell beneath, right of node
    spread = [_usual(_second_difference(scaled, *way)) for way in ((1, 0), (0, 1))]
    ratio = np.fmin(*spread)
    if np.isfinite(ratio).any():
        ratio = np.where(np.isfinite(ratio), ratio, np.nanmedian(ratio))
    return np.where(ratio > GRAINY, ratio, 1.0)


def _second_difference(values: Floats, rows: int, columns: int) -> Floats:
    """(R, C) of values and those beside, over what independent ones of unit size make of it."""
    beside = shift_by(values, rows, columns) + shift_by(values, -rows, -columns)
    return (beside - 2 * values) / np.sqrt(6)


def _usual(differences: Floats) -> Floats:
    """(R, C) robust standard deviation of those within GRAIN_REACH of each; NaN where too few."""
    span = range(-GRAIN_REACH, GRAIN_REACH + 1)
    near = np.abs(np.stack([shift_by(differences, row, column) for row in span for column in span]))
    enough = np.isfinite(near).sum(axis=0) >= GRAIN_FEWEST
    usual = np.full(differences.shape, np.nan)
    usual[enough] = np.nanmedian(near[:, enough], axis=0) / 0.6745
    return usual
