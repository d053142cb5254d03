"""Which pieces of a section make up one smooth line, without gap or crease."""

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from lscan.records import Floats, Ints, Mask

JOINED_MM = 1e-6  # ends of two pieces as near as this are one: rounding is 1e-12 mm
# A line that turns by more has an edge there, one that turns by less is a round surface in
# facets: the feature angle that mesh tools take by default lies between 20 and 40 degrees.
CREASE_DEG = 30.0


def chains(ends_mm: Floats, face: Ints, creased: Mask) -> Ints:
    """Which pieces of a section lie on one smooth line.

    Parameters
    ----------
    ends_mm
        (M, 2, 2) two ends of (x, z) of each straight piece, in the sheet's plane.
    face
        (M,) surface of each; a line does not go from one to another.
    creased
        (M,) whether an edge is seen where the piece meets the next at an angle.

    Returns
    -------
    (M,) the number of the line that each piece is part of.
    """
    count = len(ends_mm)
    if count == 0:
        return np.empty(0, dtype=int)
    pairs = cKDTree(ends_mm.reshape(-1, 2)).query_pairs(JOINED_MM, output_type="ndarray")
    away = (ends_mm[:, ::-1] - ends_mm).reshape(-1, 2)  # from either end to the other
    length = np.linalg.norm(away, axis=1)
    first, second = pairs[np.all(length[pairs] > JOINED_MM, axis=1)].T
    turn = np.einsum("ij,ij->i", away[first], away[second]) / (length[first] * length[second])
    smooth = -turn >= np.cos(np.radians(CREASE_DEG))
    a, b = first // 2, second // 2
    kept = (face[a] == face[b]) & (smooth | ~creased[a])
    links = coo_array((np.ones(kept.sum()), (a[kept], b[kept])), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], dtype=int)
