"""Straight edges located by how the line's light fades over them.

The laser sheet has a thickness and the lens blurs, so the line does not end at an edge: its
light falls off as the integral of a Gaussian, and where half is left the sheet's middle lies on
the edge.  Where light that misses the edge falls on a lower face in view, the line found in the
picture changes over to that one at about half; only samples before that are used.  A wall that
faces the camera shines beside both faces, most where the sheet's middle meets it.  So

    brightness = (c0 + c1 x + c2 y) (Phi(t) + g phi(t)),   t = d / w > BEFORE_HALF

with d the distance along x from the edge onto the face and w the width of the fading.  The wall's
share g is that of both faces of an edge, where it pulls in opposite directions: with samples of
one face alone it could not be told from the edge's place.  The level's three coefficients are
each face's own; w is shared by the edges of a group.  (Model and derivation are ours.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask
from lscan.surface.align.edges import EdgeFit, EdgeLine

BEFORE_HALF = 0.3
"""In widths: there a face has 62 % of its light and the other 38 %, which noise of 15 % a column
confuses once in a hundred times."""

REACH_MM = 9.0
"""How far from the edge samples are used: to tell the level, a few times the width."""

FIRST_WIDTH_MM, WIDTHS_MM = 1.0, (0.1, 2.5)

WALL = (-0.3, 1.0)
"""Least and greatest share of a wall: of walls lit at a grazing angle 0.2 to 0.6 was seen."""

LARGEST_STEP_MM = 1.0
SETTLED_MM = 1e-8
ROUNDS = 30

FEWEST = 40

STRAY = 4.0
"""Samples whose brightness is off by more than this many standard deviations are left out."""


@dataclass(frozen=True)
class FaceSamples:
    """The samples on the faces beside one edge.

    slope: its nominal dx/dy.  side: +1 where the upper face lies at smaller x, else -1.
    group: edges of one group fade over the same width; counted from 0.
    plan: (K, 2) in mm.  brightness: (K,) in DN.
    lower: (K,) mask of the samples on the lower face; none where it is out of sight.
    """

    slope: float
    side: int
    group: int
    plan: Floats
    brightness: Floats
    lower: Mask


def fit_fading(
    edges: Sequence[FaceSamples], start: EdgeFit, pivot_mm: float, kept: Mask | None = None
) -> EdgeFit:
    """The edges that share one lean, each at x = at + (slope + lean) (y - pivot), mm.

    start: the edges as found before, in the same order, good to about the width.
    kept: (K,) mask of the samples to use, of all edges in their order, where that is decided.

    Gauss-Newton on brightness relative to the model's, for speckle grows with the light.  The
    covariance is that of the samples' scatter.
    Raises MeasurementError where the samples do not determine the edges.
    """
    faces = _gather(edges, pivot_mm)
    state = _State(
        place=np.array([start.lean, *(line.at_mm for line in start.lines)]),
        width=np.full(int(faces.group.max()) + 1, FIRST_WIDTH_MM),
        wall=np.zeros(len(faces.walled)),
    )
    for _ in range(ROUNDS):
        used = _used(faces, state) if kept is None else kept
        solution = _solve(faces, state, used)
        if kept is None:
            scatter = 1.4826 * float(np.median(np.abs(solution.residual)))
            used[used] = np.abs(solution.residual) < STRAY * scatter
            solution = _solve(faces, state, used)
        state, moved = _advanced(state, solution.step)
        if moved < SETTLED_MM:
            break
    count = len(state.place)
    lines = tuple(
        EdgeLine(
            at_mm=float(state.place[1 + k]),
            slope=float(edge.slope + state.place[0]),
            pivot_mm=pivot_mm,
            crossings=int(np.sum(used & (faces.which == k))),
            strays=int(np.sum(~used & (faces.which == k))),
        )
        for k, edge in enumerate(edges)
    )
    return EdgeFit(lines, float(state.place[0]), solution.covariance[:count, :count], used)


@dataclass(frozen=True)
class _Faces:
    """All samples: x across the nominal edge and y from the pivot, mm; (K,) each.

    which: edge.  face: one number for each face there is.  towards: +1 or -1, such that the
    depth on the face is towards * (edge's x - x).  walled: the edges with two faces.
    """

    x: Floats
    y: Floats
    brightness: Floats
    which: Ints
    group: Ints
    face: Ints
    towards: Floats
    walled: Ints

    def depth(self, place: Floats) -> Floats:
        """(K,) mm from each sample's edge onto its face."""
        return self.towards * (place[1:][self.which] + place[0] * self.y - self.x)


@dataclass(frozen=True)
class _State:
    """place: (E + 1,) lean and each edge's x.  width: (G,) mm.  wall: (W,) share of each."""

    place: Floats
    width: Floats
    wall: Floats


@dataclass(frozen=True)
class _Solution:
    """Step of place, width and wall, their covariance, and what is left of each brightness."""

    step: Floats
    covariance: Floats
    residual: Floats


def _gather(edges: Sequence[FaceSamples], pivot_mm: float) -> _Faces:
    count = [len(edge.plan) for edge in edges]
    plan = np.concatenate([edge.plan for edge in edges])
    lower = np.concatenate([edge.lower for edge in edges])
    which = np.repeat(np.arange(len(edges)), count)
    y = plan[:, 1] - pivot_mm
    side = np.repeat([float(edge.side) for edge in edges], count)
    return _Faces(
        x=plan[:, 0] - np.repeat([edge.slope for edge in edges], count) * y,
        y=y,
        brightness=np.concatenate([edge.brightness for edge in edges]),
        which=which,
        group=np.repeat([edge.group for edge in edges], count),
        face=np.unique(2 * which + lower, return_inverse=True)[1],
        towards=side * np.where(lower, -1, 1),
        walled=np.flatnonzero([edge.lower.any() for edge in edges]),
    )


def _used(faces: _Faces, state: _State) -> Mask:
    depth = faces.depth(state.place)
    return np.asarray((depth > BEFORE_HALF * state.width[faces.group]) & (depth < REACH_MM))


def _solve(faces: _Faces, state: _State, used: Mask) -> _Solution:
    """One Gauss-Newton step.  The levels enter linearly: they are solved anew each time."""
    if used.sum() < FEWEST:
        raise MeasurementError(f"edges: {used.sum()} samples beside them do not determine them")
    which, y, brightness = faces.which[used], faces.y[used], faces.brightness[used]
    width = state.width[faces.group[used]]
    t = faces.depth(state.place)[used] / width
    ends = np.eye(len(state.place) - 1)[which]
    groups = np.eye(len(state.width))[faces.group[used]]
    walls = ends[:, faces.walled]
    wall = walls @ state.wall
    density = np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi)
    share = ndtr(t) + wall * density
    terms = np.column_stack([np.ones_like(y), t, y / REACH_MM])
    levels = np.eye(int(faces.face.max()) + 1)[faces.face[used]]
    levels = (levels[:, :, None] * terms[:, None, :]).reshape(len(y), -1)
    level = levels @ np.linalg.lstsq(levels * share[:, None], brightness, rcond=None)[0]
    by_t = density * (1 - wall * t) / share
    design = np.column_stack(
        [
            (by_t / width * faces.towards[used])[:, None] * np.column_stack([y, ends]),
            -(by_t * t / width)[:, None] * groups,
            (density / share)[:, None] * walls,
            levels / level[:, None],
        ]
    )
    relative = brightness / (level * share) - 1
    freedom = len(y) - design.shape[1]
    try:
        inverse = np.linalg.inv(design.T @ design)
    except np.linalg.LinAlgError:
        freedom = 0
    if freedom <= 0:
        raise MeasurementError(f"edges: {len(y)} samples beside them do not determine them")
    step = inverse @ (design.T @ relative)
    residual = relative - design @ step
    return _Solution(step, inverse * float(residual @ residual) / freedom, residual)


def _advanced(state: _State, step: Floats) -> tuple[_State, float]:
    """The state after a bounded step, and how far an edge moved, mm."""
    place, width, wall, _ = np.split(
        step, np.cumsum([len(state.place), len(state.width), len(state.wall)])
    )
    largest = float(np.abs(place[1:]).max())
    bounded = place * min(1.0, LARGEST_STEP_MM / max(largest, 1e-300))
    half = state.width / 2
    return (
        _State(
            state.place + bounded,
            np.clip(state.width + np.clip(width, -half, half), *WIDTHS_MM),
            np.clip(state.wall + wall, *WALL),
        ),
        largest,
    )
