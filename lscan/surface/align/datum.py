"""What errors of the points do to the alignment that is found from them.

The alignment makes seven quantities of the aligned points zero: height and two slopes of the
wedges' tops, the turn of the line of the corners, the lean of the edges against that line, and
the two coordinates of the corners' middle.  Each is a linear function of a small displacement
of the points.  So is the displacement that each of the alignment's own seven parameters gives
to them.  To first order, then, a displacement common to many points, such as an error of the
calibration, is answered by the change of parameters that makes the seven zero again; and what
noise leaves in the seven is answered by errors of the parameters that all points share.

About a shaft there is no yaw, and the edges' lean is made zero in place of the line of the
corners' turn: six parameters make six quantities zero.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from lscan.records import Floats, Ints
from lscan.surface.align.edges import EdgeCrossings

PARAMETERS = 7
"""Rotations about x, y and z, yaw, shifts in x, y and z."""

YAW = 3
"""Index of the yaw among the parameters."""

TURN, LEAN = 3, 4
"""Indices, among the seven quantities, of the corners' turn and of the lean against it."""


@dataclass(frozen=True)
class Datum:
    """What an alignment is made from, in the workpiece frame.

    Attributes
    ----------
    tops : (K, 3) array, mm, points of the wedges' tops
    top_index : (K,) array, of them among all points of the surface
    top_sigma_mm : (K,) array, mm, noise of their z, each one's own
    edges : sequence of EdgeCrossings, the four of the wedges (left near, left far, right near,
        right far), then the sides
    edge_covariance : (E + 1, E + 1) array, of the lean and of each edge's place, mm
    yaw_variance : float, rad², to be added to that of the lean
    corners : (2, 2) array, mm, left and right one
    rotation : (3, 3) array, of the alignment
    yaw_rad : float, rad, of the alignment
    by_sides : bool, whether the corners are where the wedges' far edges are at the x that the two
        sides, the last two edges, say, instead of where the near and the far ones meet
    sheared : bool, False for a scan about a shaft
    """

    tops: Floats
    top_index: Ints
    top_sigma_mm: Floats
    edges: Sequence[EdgeCrossings]
    edge_covariance: Floats
    yaw_variance: float
    corners: Floats
    rotation: Floats
    yaw_rad: float
    by_sides: bool = False
    sheared: bool = True

    @property
    def index(self) -> Ints:
        """(P,) of all the points it is made from: the tops, then edge by edge."""
        return np.concatenate([self.top_index, *(edge.index for edge in self.edges)])

    @property
    def pivot(self) -> Floats:
        """(3,) mm, the middle of the corners at the height of the tops."""
        return np.array([*self.corners.mean(axis=0), self.tops[:, 2].mean()])


def parameter_modes(datum: Datum, modes: NDArray[np.floating]) -> Floats:
    """(7, M + 7) how the alignment's parameters err, in mm and rad.

    The first M columns answer the modes; the last 7 are the noise of the alignment itself.
    Without a yaw its row is zero.

    Parameters
    ----------
    datum : Datum, mm, frame of the workpiece
    modes : (P, 3, M) array, mm, displacements of the points of ``datum.index``, along the
        workpiece's axes
    """
    points = np.concatenate([datum.tops, *(edge.inside for edge in datum.edges)])
    given = displacement(points, datum.pivot, datum.rotation, datum.yaw_rad)
    noise, vectors = np.linalg.eigh(_noise(datum))
    left = np.column_stack([_conditions(datum, modes), vectors * np.sqrt(np.maximum(noise, 0.0))])
    matrix = _conditions(datum, given)
    if datum.sheared:
        return np.asarray(-np.linalg.solve(matrix, left))
    free = np.delete(np.arange(PARAMETERS), YAW)
    for rows in (left, matrix):  # the edges' lean by itself, not against the corners
        rows[LEAN] -= rows[TURN]
    left, matrix = (np.delete(rows, TURN, axis=0) for rows in (left, matrix))
    errors = np.zeros((PARAMETERS, left.shape[1]))
    errors[free] = -np.linalg.solve(matrix[:, free], left)
    return errors


def displacement(points: Floats, pivot: Floats, rotation: Floats, yaw_rad: float) -> Floats:
    """(..., 3, 7) displacement of workpiece points, mm, by each parameter's unit.

    Parameters
    ----------
    points : (..., 3) array, mm, frame of the workpiece
    pivot : (3,) array, mm, about which is turned, and where the yaw displaces nothing
    rotation : (3, 3) array, of the alignment
    yaw_rad : float, rad, of the alignment
    """
    x, y, z = np.moveaxis(points - pivot, -1, 0)
    zero = np.zeros_like(x)
    # Track position of a point relative to the pivot, from its place: the inverse of the pose.
    sine, cosine = np.sin(yaw_rad), np.cos(yaw_rad)
    track = ((points - pivot) @ rotation)[..., 1] / cosine
    about = [
        np.stack([zero, -z, y], axis=-1),
        np.stack([z, zero, -x], axis=-1),
        np.stack([-y, x, zero], axis=-1),
        track[..., None] * (rotation @ np.array([cosine, -sine, 0.0])),
    ]
    shifts = np.broadcast_to(np.eye(3), (*points.shape[:-1], 3, 3))
    return np.concatenate([np.stack(about, axis=-1), shifts], axis=-1)


def _conditions(datum: Datum, field: NDArray[np.floating]) -> Floats:
    """(7, C) the seven quantities of C displacements (P, 3, C) of the tops, then the edges."""
    count = len(datum.tops)
    plane = np.linalg.lstsq(_plane_design(datum), field[:count, 2], rcond=None)[0]
    design = _edge_design(datum)
    slope = np.repeat([edge.slope for edge in datum.edges], [len(e.index) for e in datum.edges])
    across = field[count:, 0] - slope[:, None] * field[count:, 1]
    edges = np.linalg.lstsq(design, across, rcond=None)[0]
    return np.concatenate([plane, _from_edges(datum) @ edges])


def _noise(datum: Datum) -> Floats:
    """(7, 7) covariance of the seven quantities from the points' own noise."""
    spread = np.linalg.pinv(_plane_design(datum)) * datum.top_sigma_mm
    edges = _from_edges(datum)
    of_edges = edges @ datum.edge_covariance @ edges.T
    of_edges[1, 1] += datum.yaw_variance
    return np.asarray(block_diag(spread @ spread.T, of_edges))


def _plane_design(datum: Datum) -> Floats:
    """(K, 3) of a plane through the tops."""
    return np.column_stack([np.ones(len(datum.tops)), (datum.tops - datum.pivot)[:, :2]])


def _edge_design(datum: Datum) -> Floats:
    """(K, E + 1) what the lean and each edge's place do to the crossings, as in edges.py."""
    which = np.repeat(np.arange(len(datum.edges)), [len(edge.index) for edge in datum.edges])
    y = np.concatenate([edge.inside[:, 1] for edge in datum.edges]) - datum.pivot[1]
    return np.column_stack([y, np.eye(len(datum.edges))[which]])


def _from_edges(datum: Datum) -> Floats:
    """(4, E + 1) turn, lean against the line of the corners, and middle (x, y), from the lean
    and the places of the edges."""
    size = len(datum.edges) + 1
    sides = np.where(np.arange(size) >= size - 2, 0.5, 0.0)
    corners = []
    for near, far in ((0, 1), (2, 3)):
        if datum.by_sides:  # where the far edge is at the corner's x, which the sides say
            corners.append((sides, (sides - np.eye(size)[1 + far]) / datum.edges[far].slope))
            continue
        # Where x = at + slope y of both edges agree.
        y = np.zeros(size)
        y[[1 + near, 1 + far]] = np.array([-1.0, 1.0]) / (
            datum.edges[near].slope - datum.edges[far].slope
        )
        x = datum.edges[near].slope * y
        x[1 + near] += 1.0
        corners.append((x, y))
    (left_x, left_y), (right_x, right_y) = corners
    turn = (right_y - left_y) / (datum.corners[1, 0] - datum.corners[0, 0])
    lean = np.eye(size)[0] + turn
    return np.stack([turn, lean, (left_x + right_x) / 2, (left_y + right_y) / 2])
