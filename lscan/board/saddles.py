"""A chessboard's corners found one from another, as the dots of a board are (search.py).

Every saddle of the smoothed picture may be a corner.  One with four others about it, like the
middle of a cross, begins; the displacement from corner to corner predicts the next, where a saddle
is looked for, until none is left.  So all corners of the board are found, those that slivers of
further squares make at its rim included.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from lscan.board.centre import SMALLEST_SIGMA_PX, Centres, fit_centres
from lscan.board.picture import Image, noise_of
from lscan.board.search import Nodes, seeded, spread
from lscan.board.seeds import find_crosses
from lscan.records import Floats, Mask

SCALES_PX = (1.5, 3.0, 6.0)  # of the smoothing: squares of 8 to 200 px show in one of them
WEAKEST = 0.25  # of the ninth sharpest saddle: slanting light and noise, but not what an edge makes
FEWEST, MOST = 9, 4000  # saddles: three by three corners; more is texture
SQUARES = 5.0 * 1.26 ** np.arange(11)  # widths tried, of the smoothing: a third of an octave apart
SEEDS = 3  # tried at each scale
WINDOW = 0.15  # Gaussian sigma under which a saddle is fitted, of a square
LARGEST_SIGMA_PX = 6.0  # of it: corners are sharp, and larger windows cost more
BOX = 0.2  # of a square: how far off its place a corner may be
FAINTEST = 4.0  # times the uncertainty of those beside it: a saddle of noise has far more


def corner_lattices(grey: Image, most: int) -> Iterator[Floats]:
    """(R, C, 2) px of lattices of corners, NaN where one is missing, the likeliest first.

    Parameters
    ----------
    grey : (H, W) array, grey values
    most : int, rows and columns that a lattice may have
    """
    noise = np.full_like(grey, noise_of(grey))
    for scale in SCALES_PX:
        for seeds in _seeds(grey, scale):
            nodes = _grown(grey, noise, seeds, most)
            if nodes.found.sum() >= FEWEST:
                yield nodes.part(nodes.extent()).points


def _seeds(grey: Image, scale_px: float) -> list[Floats]:
    """Up to three (3, 2) px: a corner, the one beneath and the one to its right."""
    points, strength = _saddles(grey, scale_px)
    found = [find_crosses(points, strength, float(width * scale_px)) for width in SQUARES]
    best = max(found, key=lambda several: float(several.strength.sum()))
    order = np.argsort(best.uneven, kind="stable")[:SEEDS]
    return list(best.seeds[order])


def _saddles(grey: Image, scale_px: float) -> tuple[Floats, Floats]:
    """(N, 2) px of the saddles of the smoothed picture, and (N,) how sharp they are."""
    smooth = cv2.GaussianBlur(grey, (0, 0), scale_px)
    uu, vv = (cv2.Sobel(smooth, cv2.CV_32F, *by, ksize=3) for by in ((2, 0), (0, 2)))
    uv = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=3)
    sharp = np.sqrt(np.maximum(uv**2 - uu * vv, 0))
    peak = (sharp >= cv2.dilate(sharp, np.ones((5, 5), np.uint8))) & (sharp > 0)
    row, column = np.nonzero(peak)
    strength = sharp[row, column].astype(float)
    order = np.argsort(-strength, kind="stable")[:MOST]
    if len(order) >= FEWEST:
        order = order[strength[order] >= WEAKEST * strength[order[FEWEST - 1]]]
    return np.column_stack([column, row])[order].astype(float), strength[order]


def _grown(grey: Image, noise: Image, seeds: Floats, most: int) -> Nodes:
    """All corners that can be reached from the seeds."""
    last = np.array(grey.shape[::-1]) - 1

    def seek(expected: Floats, square: Floats, beside: Floats) -> tuple[Centres, Mask]:
        sigma = np.clip(WINDOW * square, SMALLEST_SIGMA_PX, LARGEST_SIGMA_PX)
        corners = fit_centres(grey, expected, sigma, noise, saddles=True)
        near = np.linalg.norm(corners.points - expected, axis=1) <= BOX * square + 1
        inside = ((corners.points >= 0) & (corners.points <= last)).all(axis=1)
        sharp = corners.sigma_px <= FAINTEST * beside[:, 1]
        return corners, corners.round & near & inside & sharp

    nodes = Nodes.empty(2 * most + 1, 2 * most + 1)
    where, square = seeded((most, most), seeds)
    nodes.put(where, *seek(seeds, square, np.full((3, 2), np.inf)))
    spread(nodes, seek, BOX)
    return nodes
