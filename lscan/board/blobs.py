"""Round marks of one size anywhere in a picture: where the search may begin."""

from dataclasses import dataclass

import cv2
import numpy as np

from lscan.board.picture import WORKING_RADIUS_PX, Image, reduced
from lscan.records import Floats, Ints

NOISE_LIMIT = 6.0  # sigmas: one peak in 1e9 pixels of pure noise
LONGEST = 4.0  # ratio of the curvatures along and across a blob
FEWEST = 9  # a board shows at least three by three dots
WEAKEST = 0.45  # of the ninth strongest: admits dots in light 2:1 darker
MOST = 30_000  # blobs of one size; more is texture


@dataclass(frozen=True)
class Blobs:
    """N round marks.

    Attributes
    ----------
    points : (N, 2) array, px, (u, v) to about half a pixel
    strength : (N,) array, grey values
    """

    points: Floats
    strength: Floats


def find_blobs(bright: Image, radius_px: float, noise: float) -> Blobs:
    """The bright round marks of about one radius, strongest first.

    They are the maxima of the negative Laplacian of Gaussian with sigma = radius / sqrt(2),
    which answers most strongly to a disc of that radius; slopes of the light do not change it.

    Parameters
    ----------
    bright : (H, W) array, grey values, marks bright
    radius_px : float, px, of the marks
    noise : float, standard deviation of a grey value

    References
    ----------
    Lindeberg, "Feature detection with automatic scale selection", IJCV 30 (1998).
    """
    reduction = max(1, int(radius_px / WORKING_RADIUS_PX))
    small = reduced(bright, reduction)
    sigma = radius_px / reduction / np.sqrt(2)
    smooth = np.asarray(cv2.GaussianBlur(small, (0, 0), sigma), dtype=np.float32)
    response = -(sigma**2) * cv2.Laplacian(smooth, cv2.CV_32F, ksize=1)
    # White noise n answers with n / (sqrt(2 pi) sigma); averaging has divided it already.
    floor = NOISE_LIMIT * noise / reduction / (np.sqrt(2 * np.pi) * sigma)
    peak = (response >= cv2.dilate(response, np.ones((3, 3), np.uint8))) & (response > floor)
    peak[[0, -1], :] = peak[:, [0, -1]] = False
    row, column = np.nonzero(peak)
    row, column = _round_ones(smooth, row, column)
    strength = response[row, column].astype(float)
    order = np.argsort(-strength, kind="stable")[:MOST]
    if len(order) >= FEWEST:
        order = order[strength[order] >= WEAKEST * strength[order[FEWEST - 1]]]
    pixels = np.column_stack([column, row])[order].astype(float)
    points = (pixels + 0.5) * reduction - 0.5
    return Blobs(points, strength[order])


def _round_ones(smooth: Image, row: Ints, column: Ints) -> tuple[Ints, Ints]:
    """The peaks that fall off in all directions alike: no ridges, edges or saddles."""
    s, r, c = smooth, row, column
    uu = s[r, c + 1] + s[r, c - 1] - 2 * s[r, c]
    vv = s[r + 1, c] + s[r - 1, c] - 2 * s[r, c]
    uv = (s[r + 1, c + 1] + s[r - 1, c - 1] - s[r + 1, c - 1] - s[r - 1, c + 1]) / 4
    trace, determinant = uu + vv, uu * vv - uv**2
    is_round = (trace < 0) & (determinant > trace**2 * LONGEST / (LONGEST + 1) ** 2)
    return row[is_round], column[is_round]
