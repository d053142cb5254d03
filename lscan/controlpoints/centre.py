"""The centre of a mark: the maximum of a second-order polynomial fitted about it.

The paper fits z = a + b x + c y + d x^2 + e x y + f y^2 to the region around the brightest
pixel and takes its maximum (Sec. III.1).  How large a region, and how weighted, decides the
accuracy.  Here the weights are a Gaussian about the maximum itself, and the fit is repeated
until the maximum stays.  With these weights b, c and d, e, f are the first and second
derivatives of the picture smoothed by the same Gaussian, so each fit is a Newton step towards
the top of the smoothed dot, which is round where the dot itself is flat.

For a disc of radius r in white noise the scatter of that top is least at sigma = r / sqrt(2),
where it is within 5 % of the Cramér-Rao bound of a dot blurred by 0.7 px (r = 2.75 px):
scatter = noise / amplitude * exp(q) / (sqrt(2 pi) 2 q), q = r^2 / (2 sigma^2), least at q = 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lscan.records import Floats, Ints, Mask

SMALLEST_SIGMA_PX = 0.9  # a narrower Gaussian is not sampled well enough by whole pixels
REACH = 4.0  # of sigma: the weights beyond are below 0.04 %
STEPS = 6  # Newton's steps; from half a pixel away four reach 1e-6 px


@dataclass(frozen=True)
class Centres:
    """Maxima of the fitted polynomials, N marks.

    points: (N, 2) of (u, v) px.  height: (N,) polynomial at its maximum, grey values.
    sigma_px: (N,) standard uncertainty of u and of v.  round: (N,) mask: the polynomial has a
    maximum, near the start, and is not a ridge.  Where not round the numbers mean nothing.
    """

    points: Floats
    height: Floats
    sigma_px: Floats
    round: Mask


def window_sigma(radius_px: Floats) -> Floats:
    """(N,) Gaussian sigma, px, of the window that fits discs of radius ``radius_px`` (N,)."""
    return np.maximum(np.asarray(radius_px) / np.sqrt(2), SMALLEST_SIGMA_PX)


def disc_height(radius_px: Floats, blur_px: float = 0.0) -> Floats:
    """(N,) height of the smoothed disc at its middle, as a part of the disc's contrast.

    The integral of a Gaussian over a disc: 1 - exp(-r^2 / (2 s^2)), where s joins the window's
    sigma and the picture's blur, both in px.
    """
    radius = np.asarray(radius_px)
    variance = window_sigma(radius) ** 2 + blur_px**2
    return 1 - np.exp(-(radius**2) / (2 * variance))


def fit_centres(flat: NDArray[np.floating], start: Floats, sigma: Floats, noise: float) -> Centres:
    """Maxima near ``start`` of second-order polynomials fitted to the picture.

    flat: (H, W) grey values, marks bright on a ground of 0; beyond its edge it counts as 0.
    start: (N, 2) of (u, v) px, the brightest pixels.  sigma: (N,) px, from ``window_sigma``.
    noise: standard deviation of a grey value, assumed independent from pixel to pixel.
    """
    if len(start) == 0:
        return Centres(np.empty((0, 2)), np.empty(0), np.empty(0), np.empty(0, bool))
    base = np.rint(start).astype(np.int64)
    reach = int(np.ceil(REACH * sigma.max())) + 1
    values = _windows(flat, base, reach)
    offset = np.zeros((len(base), 2))
    for _ in range(STEPS):
        gradient, hessian, _ = _polynomial(values, offset, sigma, reach)
        inverse, peaked = _inverse(hessian)
        step = -np.einsum("nij,nj->ni", inverse, gradient)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= np.minimum(1, sigma[:, None] / np.maximum(length, 1e-12))
        offset = np.clip(offset + step, -reach, reach)
    _, hessian, height = _polynomial(values, offset, sigma, reach)
    inverse, peaked = _inverse(hessian)
    near = np.linalg.norm(offset, axis=1) <= np.maximum(1.5, sigma)
    settled = np.linalg.norm(step, axis=1) < 0.01
    return Centres(base + offset, height, _scatter(inverse, sigma, noise), peaked & near & settled)


def _windows(flat: NDArray[np.floating], base: Ints, reach: int) -> Floats:
    height, width = flat.shape
    span = np.arange(-reach, reach + 1)
    u, v = base[:, :1] + span, base[:, 1:] + span
    inside = ((v >= 0) & (v < height))[:, :, None] & ((u >= 0) & (u < width))[:, None, :]
    rows, columns = np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)
    return np.where(inside, flat[rows[:, :, None], columns[:, None, :]], 0.0).astype(np.float64)


def _polynomial(
    values: Floats, offset: Floats, sigma: Floats, reach: int
) -> tuple[Floats, Floats, Floats]:
    """Gradient (N, 2), Hessian (N, 2, 2) and value (N,) at ``offset`` of the weighted fit.

    The Gaussian weights separate into u and v, so all sums are products of moments.
    """
    span = np.arange(-reach, reach + 1)
    distance = (span - offset[:, :, None]) / sigma[:, None, None]  # (N, 2, window)
    weight = np.exp(-(distance**2) / 2)
    powers = weight[:, None] * distance[:, None] ** np.arange(5)[:, None, None]  # (N, 5, 2, window)
    moment = powers.sum(axis=3)
    in_u, in_v = powers[:, :3, 0], powers[:, :3, 1]
    right = in_v @ values @ in_u.transpose(0, 2, 1)  # (N, power of v, power of u)
    p, q = np.array([0, 1, 0, 2, 1, 0]), np.array([0, 0, 1, 0, 1, 2])  # of u and v: a to f
    left = moment[:, p[:, None] + p, 0] * moment[:, q[:, None] + q, 1]
    a, b, c, d, e, f = np.linalg.solve(left, right[:, q, p][..., None])[..., 0].T
    gradient = np.stack([b, c], axis=1) / sigma[:, None]
    hessian = np.stack([2 * d, e, e, 2 * f], axis=1).reshape(-1, 2, 2)
    return gradient, hessian / sigma[:, None, None] ** 2, a


def _inverse(hessian: Floats) -> tuple[Floats, Mask]:
    """Inverse of each Hessian, and which have a maximum no more than five times as long as wide.

    Where there is no maximum the inverse is 0: no step is taken.
    """
    trace = hessian[:, 0, 0] + hessian[:, 1, 1]
    determinant = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    ridge = 5.0  # ratio of the curvatures; trace^2 / determinant = (ratio + 1)^2 / ratio
    peaked = (trace < 0) & (determinant > trace**2 * ridge / (ridge + 1) ** 2)
    safe = np.where(peaked, determinant, 1.0)
    adjugate = np.stack(
        [hessian[:, 1, 1], -hessian[:, 0, 1], -hessian[:, 1, 0], hessian[:, 0, 0]], axis=1
    ).reshape(-1, 2, 2)
    return np.where(peaked[:, None, None], adjugate / safe[:, None, None], 0.0), peaked


def _scatter(inverse: Floats, sigma: Floats, noise: float) -> Floats:
    """(N,) standard uncertainty of a coordinate, px, mean of u and v.

    White noise n gives the Gaussian derivative the variance n^2 / (8 pi sigma^4); the inverse
    Hessian turns a gradient into a shift.
    """
    gradient = noise / (np.sqrt(8 * np.pi) * sigma**2)
    return gradient * np.sqrt((inverse**2).sum(axis=(1, 2)) / 2)
