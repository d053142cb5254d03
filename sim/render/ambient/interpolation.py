"""From samples on surfaces to other nodes of them."""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from lscan.records import Floats, Ints
from sim.render.ambient.lattice import SurfaceNodes
from sim.render.flushing import flushing

NEAREST, CANDIDATES = 8, 32  # samples for each node, and those of which they are chosen
# How much farther off, mm, a sample counts whose normal differs by 1 (60 degrees), and one of
# another part; and by how many times that it lies before or behind the node's tangent plane.
# A lit sandwave's picture changes by less than 0.1 % where the first is 150 or the last 12.
NORMAL_MM, APART_MM, ABOVE = 60.0, 1e3, 4.0
NEAR_MM = 0.5  # closer ones weigh no more
RIDGE = 1e-3  # samples in one plane do not say how the field varies across it


class Interpolation:
    """Planes fitted to the nearest samples, of which nearer ones weigh more.

    Near is what is close in space, on the same part, and has a like normal.

    Attributes
    ----------
    near : (N, K) array, the samples about each wanted node, counted among the samples
    shares : (N, K) array, of their values in the node's
    """

    def __init__(self, nodes: SurfaceNodes, samples: Ints, wanted: Ints) -> None:
        """Find what values at some nodes are made of.

        Parameters
        ----------
        nodes : SurfaceNodes, N of them
        samples, wanted : arrays, indices of those where values are known, and are wanted
        """
        count = min(CANDIDATES, len(samples))
        with flushing(False):  # the tree cuts at the next number beside 0, and must not find 0
            tree = cKDTree(like_places(nodes, samples))
            found = tree.query(like_places(nodes, wanted), np.arange(1, count + 1))
        distance, near = np.asarray(found[0]), np.asarray(found[1])
        offset = nodes.point_mm[samples][near] - nodes.point_mm[wanted, np.newaxis]
        distance += ABOVE * np.abs(np.einsum("nki,ni->nk", offset, nodes.normal[wanted]))
        nearest = np.argsort(distance, axis=1, kind="stable")[:, :NEAREST]
        self.near, distance = (np.take_along_axis(v, nearest, 1) for v in (near, distance))
        offset = np.take_along_axis(offset, nearest[..., np.newaxis], 1)
        weight = 1 / (distance + NEAR_MM) ** 2
        offset *= np.sqrt(weight.mean(axis=1))[:, np.newaxis, np.newaxis]
        self._terms = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
        weight /= weight.sum(axis=1, keepdims=True)
        self._weighted = (self._terms * weight[..., np.newaxis]).transpose(0, 2, 1)
        ridge = RIDGE * np.diag([0.0, 1.0, 1.0, 1.0])
        self._inverse = np.linalg.inv(self._weighted @ self._terms + ridge)
        self.shares = (self._inverse[:, :1] @ self._weighted)[:, 0]

    def of(self, values: Floats) -> Floats:
        """Values at the wanted nodes, none beyond those of the samples about it.

        Parameters
        ----------
        values : array, at the samples
        """
        near = values[self.near]
        fitted = np.einsum("nk,nk->n", self.shares, near)
        return np.asarray(np.clip(fitted, near.min(axis=1), near.max(axis=1)))

    def matrix(self, samples: int) -> sparse.csr_array:
        """What turns values at so many samples into those at the wanted nodes, unbounded.

        Parameters
        ----------
        samples : int, number of all of them
        """
        rows, count = self.near.shape
        start = np.arange(0, rows * count + 1, count)
        return sparse.csr_array(
            (self.shares.ravel(), self.near.ravel(), start), shape=(rows, samples)
        )

    def residual(self, values: Floats) -> Floats:
        """By how much the samples about each wanted node differ from their plane, at most.

        Parameters
        ----------
        values : array, at the samples
        """
        near = values[self.near][..., np.newaxis]
        plane = self._inverse @ (self._weighted @ near)
        return np.asarray(np.abs(self._terms @ plane - near).max(axis=(1, 2)))


def like_places(nodes: SurfaceNodes, index: Ints) -> Floats:
    """(N, 7) mm, near each other where nodes are, on the same part, and have like normals."""
    point, normal, part = nodes.point_mm[index], nodes.normal[index], nodes.part[index]
    return np.column_stack([point, NORMAL_MM * normal, APART_MM * part])
