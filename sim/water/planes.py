"""What a plane surface receives of light scattered more than once, beside its vector irradiance.

A photon that leaves a sphere may come from below a surface's horizon, and light from beyond the
sphere but in front of the surface is missing: -(F . n) is short of the irradiance by

    F_r (1 - cos(beta)) (d0 + d1 cos(chi) + d2 cos(2 chi)),

n = (-cos(beta), sin(beta) cos(chi), sin(beta) sin(chi)) being the surface's normal in the radial,
the tangential and the third direction.  The d are fitted to photons at their first crossings of
planes of several tilts and distances.  They are linear between the nodes of a table over
cos(beta), the optical depth and the angle off the beam.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_array, csc_array, eye_array, kron
from scipy.sparse.linalg import spsolve

from lscan.records import Floats, Mask

# Axes of the tables of scattered light, and interpolation between their nodes.


@dataclass(frozen=True)
class LogAxis:
    """``count`` nodes from ``low`` to ``high``, evenly spaced in log(offset + x)."""

    low: float
    high: float
    count: int
    offset: float = 0.0

    @property
    def start(self) -> float:
        """The logarithm at the first node."""
        return float(np.log(self.low + self.offset))

    @property
    def scale(self) -> float:
        """Nodes per unit of the logarithm."""
        return float((self.count - 1) / (np.log(self.high + self.offset) - self.start))

    def nodes(self) -> Floats:
        """(count,) x at the nodes."""
        nodes = np.exp(self.start + np.arange(self.count) / self.scale) - self.offset
        nodes[[0, -1]] = self.low, self.high
        return nodes

    def place(self, x: Floats) -> Floats:
        """Where x lies, in nodes from the first; same shape.

        Parameters
        ----------
        x : array, between ``low`` and ``high`` or beyond
        """
        return (np.log(x + self.offset) - self.start) * self.scale


Complex = NDArray[np.complex128]
Values = TypeVar("Values", Floats, Complex)

NEAREST_RAD = 1e-6  # below, light scattered once falls as 1 / angle, and little else is left
ANGLE_AXIS = LogAxis(NEAREST_RAD, np.pi, 512)


def between_nodes(table: Values, *places: Floats) -> Values:
    """Values of a table, linear between its nodes and held at its edges; shape of the places.

    Parameters
    ----------
    table : array of as many dimensions as there are places, real or complex
    *places : arrays, each in nodes of its dimension from the first; shapes broadcast
    """
    shape = np.broadcast_shapes(*(np.shape(place) for place in places))
    flat = [np.ravel(np.broadcast_to(place, shape)) for place in places]
    return np.reshape(map_coordinates(table, flat, order=1, mode="nearest"), shape)


# What planes receive.

# Cells of a plane: angle off the beam by azimuth about it, 0 where the plane is farther away.
RINGS_FROM, RINGS_TO, RINGS, SECTORS = 0.01, 1.4, 24, 8
GAUSS = 3  # places across a cell's angle, of Gauss and Legendre
SHAPE = COSINES, DEPTHS, ANGLES, HARMONICS = 5, 6, 10, 3  # of the table
HORIZON_ANGLES = LogAxis(RINGS_FROM, RINGS_TO, ANGLES)
COSINE_AXIS = LogAxis(0.0, 1.0, COSINES, 1.0)
# Standard deviations a priori: of second differences between nodes, and of the d.
BENT, LARGE = 0.1, 1.0
STEEPEST = 0.05  # cosine of the largest angle at which a cell is used


@dataclass(frozen=True)
class PlaneCounts:
    """Photons scattered more than once, at their first crossings of planes.

    Attributes
    ----------
    photons : int, photons sent to each tilt
    tilts : (T,) rad, between the planes' normals and the beam
    distances : (K,) where the planes cross the beam, optical depths
    weight : (T, K, RINGS, SECTORS) sums of the photons' weights, over tilts, planes and cells
    """

    photons: int
    tilts: Floats
    distances: Floats
    weight: Floats


def horizon_depths(nearest: float, farthest: float) -> LogAxis:
    """The table's optical depths.

    Parameters
    ----------
    nearest, farthest : float, smallest and largest
    """
    return LogAxis(nearest, farthest, DEPTHS)


def harmonics(cosine: Floats, aside: Floats) -> Floats:
    """(HARMONICS, ...) what the d are multiplied by: 1 - cos(beta) times 1, cos(chi), cos(2 chi).

    Parameters
    ----------
    cosine : array, cos(beta)
    aside : array of the same shape, the normal's tangential part
    """
    first = aside / np.sqrt(np.maximum(1 - cosine**2, 1e-12))
    return (1 - cosine) * np.stack([np.ones_like(first), first, 2 * first**2 - 1])


def fit_planes(counts: PlaneCounts, more: Callable[[Floats, Floats], Complex]) -> Floats:
    """(COSINES, DEPTHS, ANGLES, HARMONICS) d at the table's nodes.

    Parameters
    ----------
    counts : PlaneCounts, of the water
    more : function of (theta, depth) that gives F_r + i F_t of light scattered more than once
    """
    theta, azimuth, solid = _cells()
    tilt = counts.tilts.reshape(-1, 1, 1, 1, 1)
    distance = counts.distances.reshape(-1, 1, 1, 1)
    sine, along = np.sin(theta) * np.cos(azimuth), np.cos(theta) * np.cos(azimuth)
    cosine = np.cos(theta) * np.cos(tilt) - sine * np.sin(tilt)
    aside = along * np.sin(tilt) + np.sin(theta) * np.cos(tilt)
    depth = distance * np.cos(tilt) / np.maximum(cosine, STEEPEST)
    every = np.broadcast_arrays(theta, solid, cosine, aside, depth)
    # Cells that reach beyond the plane's horizon or the spheres are left out.
    low, high = counts.distances[[0, -1]]
    whole: Mask = ((cosine > STEEPEST) & (depth >= low) & (depth <= high)).all(axis=-1)
    theta, solid, cosine, aside, depth = (values[whole] for values in every)
    light = more(theta, depth)
    # A plane's area is r2 / cos(beta) of the solid angle it is seen under.
    scale = counts.photons * solid * depth**2 * light.real / cosine
    plain = scale * (cosine - light.imag / light.real * aside)
    spread = np.sqrt(np.sum(np.maximum(plain, STEEPEST * scale), axis=1))
    places = (
        COSINE_AXIS.place(cosine),
        horizon_depths(low, high).place(depth),
        HORIZON_ANGLES.place(theta),
    )
    design = _design(places, harmonics(cosine, aside) * scale / spread[:, np.newaxis])
    missed = (counts.weight[whole] - plain.sum(axis=1)) / spread
    found = spsolve(csc_array(design.T @ design + _prior()), design.T @ missed)
    return np.reshape(found, SHAPE)


def _cells() -> tuple[Floats, Floats, Floats]:
    """Angles, azimuths and solid angles (both sides of the beam) of places in cells.

    They broadcast to (RINGS, SECTORS, GAUSS).
    """
    edges = np.log(np.geomspace(RINGS_FROM, RINGS_TO, RINGS + 1))
    node, weight = np.polynomial.legendre.leggauss(GAUSS)
    half = np.diff(edges)[0] / 2
    theta = np.exp(edges[:-1, np.newaxis, np.newaxis] + half * (1 + node))
    azimuth = (np.arange(SECTORS)[:, np.newaxis] + 0.5) * np.pi / SECTORS
    return theta, azimuth, 2 * np.pi / SECTORS * np.sin(theta) * theta * half * weight


def _design(places: tuple[Floats, ...], factors: Floats) -> csc_array:
    """(N, M) what each of the table's numbers adds to each of N cells, summed over (N, G) places.

    factors: (HARMONICS, N, G).
    """
    sizes = SHAPE[:3]
    lows = [
        np.clip(place.astype(int), 0, size - 2) for place, size in zip(places, sizes, strict=True)
    ]
    parts = [np.clip(place - low, 0, 1) for place, low in zip(places, lows, strict=True)]
    cells, numbers = factors.shape[1], int(np.prod(SHAPE))
    row = np.broadcast_to(np.arange(cells)[:, np.newaxis], factors.shape[1:])
    total = csc_array((cells, numbers))
    for corner in product((0, 1), repeat=3):
        node = np.ravel_multi_index([low + up for low, up in zip(lows, corner, strict=True)], sizes)
        share = np.prod(
            [part if up else 1 - part for part, up in zip(parts, corner, strict=True)], axis=0
        )
        for harmonic, factor in enumerate(factors):
            column = node * HARMONICS + harmonic
            entries = (share * factor).ravel(), (row.ravel(), column.ravel())
            total = total + coo_array(entries, shape=total.shape).tocsc()
    return total


def _prior() -> csc_array:
    """(M, M) inverse covariance a priori of the table's numbers."""
    total = eye_array(int(np.prod(SHAPE))) / LARGE**2
    for axis in range(3):
        second = np.diff(np.eye(SHAPE[axis]), 2, axis=0)
        before, behind = np.prod(SHAPE[:axis], dtype=int), np.prod(SHAPE[axis + 1 :], dtype=int)
        bent = kron(kron(eye_array(before), second.T @ second), eye_array(behind))
        total = total + bent / BENT**2
    return csc_array(total)
