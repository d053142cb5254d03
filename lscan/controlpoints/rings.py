"""Points on the centre line of a milled circle (Figs. 18, 19), picked all around it.

The paper picks them by hand in an enlarged picture.  Here the predicted line is crossed by
radial profiles, and each profile's maximum is that of a second-order polynomial, weighted by
a Gaussian about itself, as for the dots (centre.py), in one dimension.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import map_coordinates

from lscan.board import Ring
from lscan.controlpoints.centre import window_sigma
from lscan.controlpoints.features import BLUR_PX, FAINTEST, Contrast
from lscan.controlpoints.lattice import LocalMap
from lscan.controlpoints.picture import Picture
from lscan.records import Floats, Mask

PROFILES = 72
REACH_PX = 4.0  # of a profile to either side
SAMPLE_PX = 0.5
BREADTH_PX = np.array([-1.0, 0.0, 1.0])  # places along the line averaged into one profile
NOISE_LIMIT = 5.0
STEPS = 8


def read_ring(picture: Picture, mapping: LocalMap, contrast: Contrast, ring: Ring) -> Floats:
    """(K, 2) of (u, v) px on the ring's centre line, counter-clockwise from its right.

    Only points that are seen: K is at most 72, and 0 where the ring is out of view.
    """
    middle_mm = np.array([[ring.x_mm, ring.z_mm]])
    radius_px = float(mapping.scale(middle_mm)[0]) * ring.diameter_mm / 2
    angle = 2 * np.pi * np.arange(PROFILES) / PROFILES
    # Averaged along the arc: along the tangent the line's sagitta would shrink the ring.
    fine = (angle[:, None] + BREADTH_PX / radius_px).ravel()
    outward_mm = np.column_stack([np.cos(fine), np.sin(fine)])
    board = middle_mm + outward_mm * ring.diameter_mm / 2
    middle, normal, scale = _crossings(mapping, board, outward_mm)
    offsets = _offsets(radius_px)
    profile = _averaged(_profiles(picture, middle, normal, offsets))
    board, middle, normal, scale = (array[1::3] for array in (board, middle, normal, scale))
    sigma = float(window_sigma(np.array([ring.width_mm * np.median(scale) / 2]))[0])
    centre, height, peaked = _maxima(profile, offsets, sigma)
    seen = picture.wholly_in_view(middle, REACH_PX) & peaked
    seen &= height > FAINTEST * contrast.at(board) * _line_height(ring.width_mm * scale, sigma)
    seen &= height > NOISE_LIMIT * picture.noise / np.sqrt(len(BREADTH_PX))
    seen &= _alike(centre, seen)
    return (middle + centre[:, None] * normal)[seen]


def _crossings(
    mapping: LocalMap, board_mm: Floats, outward_mm: Floats
) -> tuple[Floats, Floats, Floats]:
    """Place (N, 2) px, outward unit normal (N, 2) and px per mm across the line (N,)."""
    jacobian = mapping.jacobian(board_mm)
    along_mm = np.column_stack([-outward_mm[:, 1], outward_mm[:, 0]])
    along = np.einsum("nij,nj->ni", jacobian, along_mm)
    outward = np.einsum("nij,nj->ni", jacobian, outward_mm)
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = (outward * normal).sum(axis=1)
    return mapping(board_mm), normal * np.sign(across)[:, None], np.abs(across)


def _offsets(radius_px: float) -> Floats:
    count = int(min(REACH_PX, radius_px / 2) / SAMPLE_PX)
    return np.linspace(-count * SAMPLE_PX, count * SAMPLE_PX, 2 * count + 1)


def _profiles(picture: Picture, middle: Floats, normal: Floats, offsets: Floats) -> Floats:
    """(N, M) grey values along the normals."""
    points = middle[:, None] + offsets[:, None] * normal[:, None]
    grey = map_coordinates(picture.flat, [points[..., 1], points[..., 0]], order=3, cval=0.0)
    return grey.astype(np.float64)


def _averaged(profiles: Floats) -> Floats:
    """Each profile with its neighbours along the line: (3 N, M) to (N, M)."""
    triples = profiles.reshape(-1, len(BREADTH_PX), profiles.shape[1])
    mean: Floats = triples.mean(axis=1)
    return mean


def _maxima(profile: Floats, offsets: Floats, sigma: float) -> tuple[Floats, Floats, Mask]:
    """Offset (N,), height (N,) and whether there is a maximum, of each profile (N, M)."""
    centre = offsets[profile.argmax(axis=1)]
    for _ in range(STEPS):
        distance = offsets - centre[:, None]
        weight = np.exp(-((distance / sigma) ** 2) / 2)
        design = np.stack([np.ones_like(distance), distance, distance**2], axis=-1)
        left = np.einsum("nm,nmi,nmj->nij", weight, design, design)
        right = np.einsum("nm,nmi,nm->ni", weight, design, profile)
        height, slope, bend = np.linalg.solve(left, right[..., None])[..., 0].T
        peaked = bend < 0
        step = np.where(peaked, -slope / np.where(peaked, 2 * bend, -1.0), 0.0)
        centre = np.clip(centre + np.clip(step, -sigma, sigma), offsets[0], offsets[-1])
    inside = np.abs(centre) < offsets[-1] - SAMPLE_PX
    return centre, height, peaked & inside & (np.abs(step) < 0.01)


def _line_height(width_px: Floats, sigma: float) -> Floats:
    """(N,) height of a smoothed line of contrast 1: its width times the blurred Gaussian's top."""
    blurred = np.sqrt(sigma**2 + BLUR_PX**2)
    return np.minimum(width_px / (np.sqrt(2 * np.pi) * blurred), 1.0)


def _alike(centre: Floats, seen: Mask) -> Mask:
    """The profiles whose maximum lies off the predicted line by about as much as the others'."""
    if not seen.any():
        return seen
    apart = np.abs(centre - np.median(centre[seen]))
    return apart <= 4 * 1.4826 * np.median(apart[seen]) + 0.3
