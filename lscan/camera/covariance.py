"""The covariance of fitted parameters, and the modes of error that it gives to a map."""

from collections.abc import Callable

import numpy as np

from lscan.records import Floats

KEPT = 0.9999  # of the variance that the stored modes must account for
MODE_STEP = 0.01  # sigmas, for differences along a mode: rounding is 1e-9, curvature less
PIXEL_STEP = 0.01  # px, for differences of a map by the pixel

Locate = Callable[[Floats], Floats]
"""A map: (N, 2) mm of (x, z) in the sheet of pixels (N, 2); (N, 3) in space where said."""


def covariance_root(design: Floats, chi_square: float) -> Floats:
    """(P, P) square root of the covariance of P parameters.

    The design's columns are brought to one length first, for parameters of all units.  The
    covariance is scaled up by chi squared per degree of freedom where that is above 1.

    Parameters
    ----------
    design : (N, P) array, derivatives of the weighted residuals
    chi_square : float, sum of squares of the weighted residuals
    """
    scale = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    _, sizes, directions = np.linalg.svd(design / scale, full_matrices=False)
    freedom = max(design.shape[0] - design.shape[1], 1)
    root = (directions.T / np.maximum(sizes, 1e-12)) / scale[:, None]
    return root * np.sqrt(max(1.0, chi_square / freedom))


def displacements(
    map_of: Callable[[Floats], Locate], theta: Floats, modes: Floats, image_px: Floats
) -> Floats:
    """(N, 2, M) mm by which one standard deviation of each mode moves the points of a map.

    Parameters
    ----------
    map_of : callable, the map of parameters (K,)
    theta : (K,) array, the parameters
    modes : (K, M) array, changes of theta, each one standard deviation large
    image_px : (N, 2) array, px, of (u, v)
    """
    moved = np.zeros((len(image_px), 2, modes.shape[1]))
    for index, mode in enumerate(MODE_STEP * modes.T):
        after, before = (map_of(theta + way)(image_px) for way in (mode, -mode))
        moved[:, :, index] = (after - before) / (2 * MODE_STEP)
    return moved


def modes_that_matter(
    map_of: Callable[[Floats], Locate], theta: Floats, root: Floats, image_px: Floats
) -> Floats:
    """(K, M) square root of a covariance, less what does not move the map.

    The singular values of what the columns do to the points order them; those are kept that
    together make KEPT of the variance there.

    Parameters
    ----------
    map_of : callable, the map of parameters (K,)
    theta : (K,) array, the parameters
    root : (K, P) array, root @ root.T is their covariance
    image_px : (N, 2) array, px, (u, v) where it counts
    """
    sigma = np.linalg.norm(root, axis=1, keepdims=True)
    scaled = root / np.where(sigma > 0, sigma, 1.0)  # parameters of all units alike
    u, sizes, _ = np.linalg.svd(scaled, full_matrices=False)
    compact = sigma * (u * sizes)  # K columns at most, the same covariance
    moved = displacements(map_of, theta, compact, image_px)
    moved = moved[np.isfinite(moved).all(axis=(1, 2))].reshape(-1, compact.shape[1])
    _, sizes, directions = np.linalg.svd(moved, full_matrices=False)
    share = np.cumsum(sizes**2) / max(float(np.sum(sizes**2)), 1e-300)
    return compact @ directions[: int(np.searchsorted(share, KEPT)) + 1].T


def pixel_derivatives(locate: Locate, image_px: Floats) -> Floats:
    """(N, 2, 2) mm per px of a map, the last axis by u and by v.

    Parameters
    ----------
    locate : callable, the map: (N, 2) mm of (x, z) of pixels (N, 2)
    image_px : (N, 2) array, px, of (u, v)
    """
    moved = [
        (locate(image_px + step) - locate(image_px - step)) / (2 * PIXEL_STEP)
        for step in PIXEL_STEP * np.eye(2)
    ]
    return np.stack(moved, axis=2)
