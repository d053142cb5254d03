"""Straight edges of a target in a scan: between samples, and by how the line's light fades.

A sample says only that the edge lies beyond it, and the next one that it lies before that,
so an edge is known per profile to within one column.  Fitting the midpoints by least squares
wastes what is known: a line that runs almost along the track crosses few columns and its
midpoints form stairs.  The lines fitted here are the most likely ones when each sample is on
the near side of its line with a probability that is logistic in its distance (logistic
regression, D. R. Cox, J. R. Stat. Soc. B 20, 215, 1958).

The directions of the edges against each other are those of the nominal shape, so they share
one unknown: the lean that a shear x + lean * y of the whole plan gives to each of them.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints, Mask
from lscan.stripe.blurredstep import StepLimits, StepSamples, fit_steps

# Straight edges located between the last sample on them and the first one off them.

SOFTNESS = 0.07
"""Scale of the logistic in units of the gap between two samples.  Small against 1, so that
the line keeps between the samples, yet not 0, so that one outlier does not rule."""

OUTLIER = 0.3
"""A profile whose samples lie on the wrong side of the line by more than this many gaps is
left out: a sample was missing there, or a wall was hit, and the edge was taken for elsewhere."""

MIN_CROSSINGS = 10


@dataclass(frozen=True)
class EdgeCrossings:
    """Where K profiles cross one edge, in any frame.

    Attributes
    ----------
    inside : (K, 2) or (K, 3) array, mm, last sample on the edge's upper side
    outside : (K, 2) or (K, 3) array, mm, where the next sample would lie if the upper side went on
    index : (K,) array, of the inside sample among all F N of the surface
    slope : float, the edge's nominal dx/dy in the workpiece's plan
    """

    inside: Floats
    outside: Floats
    index: Ints
    slope: float = 0.0

    def only(self, keep: Mask) -> "EdgeCrossings":
        """Those of the mask (K,)."""
        return replace(
            self, inside=self.inside[keep], outside=self.outside[keep], index=self.index[keep]
        )

    def moved(self, to: Callable[[Floats], Floats]) -> "EdgeCrossings":
        """The same crossings in another frame; ``to`` takes points (K, 3) there."""
        return replace(self, inside=to(self.inside), outside=to(self.outside))


@dataclass(frozen=True)
class EdgeFit:
    """E straight edges in plan fitted together: x = at_mm + (slope + lean) * (y - pivot_mm).

    Attributes
    ----------
    at_mm : (E,) array, mm
    slope : (E,) array, nominal ones
    lean : float, dx/dy common to all, over and above those
    pivot_mm : float, mm, the y at which the edges are at ``at_mm``
    covariance : (E + 1, E + 1) array, of the lean and at_mm: that of the likelihood, and that of
        the crossings' scatter
    weight : (K,) array, how much each sample of all edges counts, in their order, 0 to 1
    """

    at_mm: Floats
    slope: Floats
    lean: float
    pivot_mm: float
    covariance: Floats
    weight: Floats

    def meet(self, first: int, second: int) -> Floats:
        """(2,) x and y in mm where two of the edges meet.

        Parameters
        ----------
        first, second : int, indices of the edges
        """
        y = (self.at_mm[second] - self.at_mm[first]) / (self.slope[first] - self.slope[second])
        x = self.at_mm[first] + (self.slope[first] + self.lean) * y
        return np.array([x, y + self.pivot_mm])


def fit_edges(
    edges: Mapping[str, EdgeCrossings], pivot_mm: float, weight: Floats | None = None
) -> EdgeFit:
    """The edges that share one lean, from their crossings in plan.

    Parameters
    ----------
    edges : mapping of EdgeCrossings, mm, by name
    pivot_mm : float, mm, the y about which the edges lean
    weight : (K,) array, optional, 0 for the crossings that are outliers, where that is decided

    Raises
    ------
    MeasurementError
        For an edge crossed by fewer than MIN_CROSSINGS profiles, or by fewer than half as many that
        agree on a line.

    References
    ----------
    Logistic regression: D. R. Cox, J. R. Stat. Soc. B 20, 215 (1958).
    """
    for name, edge in edges.items():
        if len(edge.inside) < MIN_CROSSINGS:
            raise MeasurementError(
                f"{name} not found: {len(edge.inside)} profiles cross it, "
                f"{MIN_CROSSINGS} are needed"
            )
    each = list(edges.values())
    which = np.repeat(np.arange(len(each)), [len(edge.inside) for edge in each])
    inside = np.concatenate([_upright(edge.inside, edge.slope, pivot_mm) for edge in each])
    outside = np.concatenate([_upright(edge.outside, edge.slope, pivot_mm) for edge in each])
    keep = np.ones(len(which), dtype=bool) if weight is None else weight > 0
    place = _least_absolute((inside + outside) / 2, which)
    for _ in range(3):
        place, covariance = _most_likely(inside[keep], outside[keep], which[keep], place)
        if weight is None:
            keep = _violation(inside, outside, which, place) < OUTLIER
            _require_agreeing(list(edges), np.bincount(which[keep], minlength=len(each)))
    noise = _scatter_covariance((inside + outside)[keep] / 2, which[keep], place)
    return EdgeFit(
        at_mm=place[1:],
        slope=np.array([edge.slope for edge in each]),
        lean=float(place[0]),
        pivot_mm=pivot_mm,
        covariance=covariance + noise,
        weight=keep.astype(float),
    )


def _require_agreeing(names: Sequence[str], counts: Ints) -> None:
    for name, count in zip(names, counts.tolist(), strict=True):
        if count < MIN_CROSSINGS // 2:
            raise MeasurementError(
                f"{name} not found: {count} profiles cross it in a line, {MIN_CROSSINGS // 2} are "
                "needed"
            )


def _scatter_covariance(middle: Floats, which: Ints, place: Floats) -> Floats:
    """Covariance of lean and places by least squares through the middles, as they scatter.

    The likelihood takes every sample for surely on its side of the edge.  Speckle makes the
    brightness, by which that is judged, uncertain; what the middles scatter about the lines
    shows by how much.
    """
    design = _design(middle, which)
    freedom = max(len(middle) - len(place), 1)
    scatter = float(np.sum((middle[:, 0] - design @ place) ** 2)) / freedom
    return np.asarray(scatter * np.linalg.inv(design.T @ design))


def _upright(points: Floats, slope: float, pivot_mm: float) -> Floats:
    """The points sheared so that the nominal edge runs along y, y counted from the pivot."""
    y = points[:, 1] - pivot_mm
    return np.column_stack([points[:, 0] - slope * y, y])


def _design(points: Floats, which: Ints) -> Floats:
    """(K, E + 1): what the lean and each edge's place do to the edge's x at each point's y."""
    return np.column_stack([points[:, 1], np.eye(int(which.max()) + 1)[which]])


def _least_absolute(middle: Floats, which: Ints) -> Floats:
    """A start that outliers do not spoil: least absolute deviations, by reweighting."""
    design = _design(middle, which)
    weight = np.ones(len(middle))
    parameters: Floats = np.zeros(design.shape[1])
    for _ in range(20):
        root = np.sqrt(weight)
        solution = np.linalg.lstsq(design * root[:, None], middle[:, 0] * root, rcond=None)[0]
        parameters = solution.astype(float)
        weight = 1 / np.maximum(np.abs(middle[:, 0] - design @ parameters), 0.1)
    return parameters


def _most_likely(
    inside: Floats, outside: Floats, which: Ints, start: Floats
) -> tuple[Floats, Floats]:
    """Lean and places of greatest likelihood, and their covariance: Newton, steps bounded."""
    sign = np.sign(outside[:, 0] - inside[:, 0])
    softness = SOFTNESS * float(np.median(np.abs(outside[:, 0] - inside[:, 0])))
    near, far = _design(inside, which), _design(outside, which)
    # A sample counts at least a little, so that the matrix can always be inverted.
    least = 1e-6 * near.T @ near
    parameters = start
    hessian: Floats = np.eye(len(start))
    for _ in range(60):
        pull_out = expit(-sign * (near @ parameters - inside[:, 0]) / softness)
        pull_in = expit(-sign * (outside[:, 0] - far @ parameters) / softness)
        gradient = (far.T @ (sign * pull_in) - near.T @ (sign * pull_out)) / softness
        weight_near, weight_far = pull_out * (1 - pull_out), pull_in * (1 - pull_in)
        hessian = (near.T * weight_near) @ near + (far.T * weight_far) @ far + least
        hessian = hessian / softness**2
        step = np.linalg.solve(hessian, gradient)
        step *= min(1.0, 2 * softness / max(float(np.abs(near @ step).max()), 1e-300))
        parameters = parameters - step
        if np.abs(near @ step).max() < 1e-10:
            break
    return parameters, np.linalg.inv(hessian).astype(float)


def _violation(inside: Floats, outside: Floats, which: Ints, parameters: Floats) -> Floats:
    """(K,) how far each pair of samples lies on one side of its line, in gaps; 0 if astride."""
    gap = outside[:, 0] - inside[:, 0]
    before = (inside[:, 0] - _design(inside, which) @ parameters) / gap
    behind = (_design(outside, which) @ parameters - outside[:, 0]) / gap
    return np.maximum(np.maximum(before, behind), 0.0)


# Straight edges located by how the line's light fades over them.
#
# The laser sheet has a thickness and the lens blurs, so the line does not end at an edge: its light
# falls off as a blurred step (stripe/blurredstep.py), and where half is left the sheet's middle
# lies on the edge.  Where light that misses the edge falls on a lower face in view, the line found
# in the picture changes over to that one at about half; only samples before that are used. The
# share of a wall between them is that of both faces of an edge, where it pulls in opposite
# directions: with samples of one face alone it could not be distinguished from the edge's place.
# The level is linear over each face; the width is shared by the edges of a group.


REACH_MM = 9.0
"""How far from the edge samples are used: to find the level, a few times the width."""

FIRST_WIDTH_MM = 1.0
PLACE_SIGMA_MM, LEAN_SIGMA = 1.0, 0.02
"""How well edges are known from their crossings: to a column and the sheet's thickness."""

LIMITS = StepLimits(least_t=0.3, most_mm=REACH_MM, widths_mm=(0.1, 2.5), step_mm=1.0)
"""At 0.3 widths a face has 62 % of its light and the other 38 %, which noise of 15 % a column
confuses once in a hundred times."""


@dataclass(frozen=True)
class FaceSamples:
    """The K samples on the faces beside one edge.

    Attributes
    ----------
    slope : float, its nominal dx/dy
    side : int, +1 where the upper face lies at smaller x, else -1
    group : int, edges of one group fade over the same width; counted from 0
    plan : (K, 2) array, mm, (x, y)
    brightness : (K,) array, DN
    lower : (K,) mask, of the samples on the lower face; none where it is out of sight
    """

    slope: float
    side: int
    group: int
    plan: Floats
    brightness: Floats
    lower: Mask


def fit_fading(
    edges: Sequence[FaceSamples], start: EdgeFit, weight: Floats | None = None
) -> EdgeFit:
    """The edges that share one lean, each at x = at + (slope + lean) (y - pivot), mm.

    Parameters
    ----------
    edges : sequence of FaceSamples, mm and DN
    start : EdgeFit, the edges as found before, in the same order, good to about the width
    weight : (K,) array, optional, how much each sample counts, of all edges in their order, where
        that is decided

    Raises
    ------
    MeasurementError
        Where the samples do not determine the edges.
    """
    place = np.array([start.lean, *start.at_mm])
    width = np.full(1 + max(edge.group for edge in edges), FIRST_WIDTH_MM)
    sigma = np.array([LEAN_SIGMA, *np.full(len(edges), PLACE_SIGMA_MM)])
    fit = fit_steps(_samples(edges, start.pivot_mm), place, sigma, width, LIMITS, weight)
    return EdgeFit(
        at_mm=fit.place[1:],
        slope=np.array([edge.slope for edge in edges]),
        lean=float(fit.place[0]),
        pivot_mm=start.pivot_mm,
        covariance=fit.covariance,
        weight=fit.weight,
    )


def _samples(edges: Sequence[FaceSamples], pivot_mm: float) -> StepSamples:
    """All samples; the places are the lean and the x of each edge."""
    count = [len(edge.plan) for edge in edges]
    plan = np.concatenate([edge.plan for edge in edges])
    lower = np.concatenate([edge.lower for edge in edges])
    which = np.repeat(np.arange(len(edges)), count)
    y = plan[:, 1] - pivot_mm
    x = plan[:, 0] - np.repeat([edge.slope for edge in edges], count) * y
    towards = np.repeat([float(edge.side) for edge in edges], count) * np.where(lower, -1, 1)
    faces, face = np.unique(2 * which + lower, return_inverse=True)
    edge = faces // 2
    walled = np.array([edge.lower.any() for edge in edges])
    return StepSamples(
        stretch=face,
        brightness=np.concatenate([edge.brightness for edge in edges]),
        level=np.stack([np.ones_like(y), (x - x.mean()) / REACH_MM, y / REACH_MM]),
        by_place=towards * np.stack([y, np.ones_like(y)])[None],
        offset=(towards * x)[None],
        places=np.column_stack([np.zeros_like(edge), 1 + edge]),
        group=np.array([edge.group for edge in edges])[edge],
        wall=np.where(walled, np.cumsum(walled) - 1, -1)[edge],
    )
