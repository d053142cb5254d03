"""Where a lit stretch ends: one model of a blurred step, and its least-squares fit.

The blur of lens and pixel, and the thickness of the sheet, draw the end of a line out: light
falls off there as the integral of a Gaussian, half of it being left at the end itself.  A wall
below the end that faces the camera shines beside it, most where the sheet's middle meets it.  So

    brightness = level * product over the ends of (Phi(t) + g phi(t)),   t = depth / width

with the depth inside each end, the width of its blur, the wall's share g (0 without a wall), and
a level that is linear in coefficients of its own.  (Model and derivation are ours.)
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import cast

import numpy as np
from scipy.special import ndtr

from lscan.errors import MeasurementError
from lscan.records import Floats, Ints

WALL = (-0.3, 1.0)
"""Least and greatest share of a wall: of walls lit at a grazing angle 0.2 to 0.6 was seen."""

WALL_SIGMA = 0.5

FAINTEST = -2.0
"""In widths: samples farther outside an end say nothing of it.  The model is not evaluated there,
where it vanishes (1 / Phi overflows) and, with a negative share of a wall, changes its sign."""

OUTLIER, _DOUBTED = 4.0, 1.0
"""Samples whose brightness is off by so many standard deviations count half, those off by one more
not at all, by one less in full.  A sample that counted in full or not at all would come and go with
the place, and the step that ends the search would not be zero but change its sign there."""

_FADING_T, _FADING_MM = 0.1, 0.5  # the same at the limits of depth: to either side of them

FIRST_SCATTER = 0.1  # of brightness from sample to sample, relative, where the fit starts
LEAST_SCATTER = 1e-9  # exact samples have weights too
ROUNDS = 60
GROWS = 1.25  # of a step's share, while it does not turn back
SETTLED_MM = 1e-6  # a thousandth of what noise leaves uncertain, and less


@dataclass(frozen=True)
class StepSamples:
    """K samples of brightness on S stretches that end, by P places of ends.

    Attributes
    ----------
    stretch : (K,) array, on which stretch each sample lies
    brightness : (K,) array, DN, above 0
    level : (L, K) array, terms of the stretch's level
    by_place : (J, A, K) array, depth = by_place @ places - offset, mm, inside each of the at most J
        ends of the stretch, the places being the A that count there
    offset : (J, K) array, mm; ``NO_END`` where there is no end
    places : (S, A) array, which places count on each stretch, -1 for none
    group : (S,) array, which width does
    wall : (S,) array, which wall is beside it, -1 for none
    """

    stretch: Ints
    brightness: Floats
    level: Floats
    by_place: Floats
    offset: Floats
    places: Ints
    group: Ints
    wall: Ints


NO_END = -1e6
"""Offset, mm, of an end that is not there: its depth is beyond any blur."""


@dataclass(frozen=True)
class StepLimits:
    """What a fit may do and which samples it may use.

    Attributes
    ----------
    least_t : float, least depth, in widths
    most_mm : float, mm, greatest depth inside the nearest end
    widths_mm : tuple of float, mm, least and greatest width
    step_mm : float, mm, farthest a place may move in one round
    unmodelled : float, uncertainty of brightness, relative to the level, that is no noise
    """

    least_t: float
    most_mm: float
    widths_mm: tuple[float, float]
    step_mm: float
    unmodelled: float = 0.0


@dataclass(frozen=True)
class StepFit:
    """Fitted ends.

    Attributes
    ----------
    place : (P,) array, mm
    covariance : (P, P) array, mm², of the places
    width : (G,) array, mm, of the blur
    weight : (K,) array, how much each sample counts, 0 to 1
    """

    place: Floats
    covariance: Floats
    width: Floats
    weight: Floats


def fit_steps(
    samples: StepSamples,
    place: Floats,
    place_sigma: Floats,
    width: Floats,
    limits: StepLimits,
    weight: Floats | None = None,
) -> StepFit:
    """The most probable ends of lit stretches, from how the brightness falls there.

    Gauss-Newton on brightness relative to the model's, for speckle grows with the light, the
    samples weighed anew in each round: less at the limits of depth and far from the model.  The
    covariance is that of the samples' scatter.

    Parameters
    ----------
    samples : StepSamples, of the brightness
    place : (P,) array, mm, where the search begins
    place_sigma : (P,) array, mm, how far the places may lie from there, a weak prior as are those
        of width (as large as it is) and wall: where the brightness does not fall within the samples
        they keep the search from running away
    width : (G,) array, mm, of the blur, where the search begins
    limits : StepLimits, of the search and of the samples used
    weight : (K,) array, optional, how much each sample counts, where that is decided already

    Raises
    ------
    MeasurementError
        Where the samples do not determine the ends.

    References
    ----------
    The model is this module's own; its text derives it.
    """
    wall = np.zeros(samples.wall.max() + 1)
    state = _StepState(place, width, wall, FIRST_SCATTER)
    sigma = np.concatenate([place_sigma, width, np.full(len(wall), WALL_SIGMA)])
    prior = _Prior(
        expected=np.concatenate([place, width, wall]),
        precision=sigma**-2.0,
        least=np.repeat(
            [-np.inf, limits.widths_mm[0], WALL[0]], [len(place), len(width), len(wall)]
        ),
        most=np.repeat([np.inf, limits.widths_mm[1], WALL[1]], [len(place), len(width), len(wall)]),
    )
    order = np.argsort(samples.stretch, kind="stable")
    size, share, before = len(place), 1.0, np.zeros(len(sigma))
    for _ in range(ROUNDS):
        depth = np.append(state.place, 0.0)[samples.places[samples.stretch]].T
        depth = (samples.by_place * depth).sum(axis=1) - samples.offset
        t = depth / state.width[samples.group[samples.stretch]]
        if weight is None:
            counts = _counts(t.min(axis=0) - limits.least_t, _FADING_T)
            counts *= _counts(limits.most_mm - depth.min(axis=0), _FADING_MM)
        else:
            counts = weight * (t.min(axis=0) > FAINTEST)
        used = order[counts[order] > 0]
        model = _step_model(samples, state, used, t[:, used])
        if weight is None:
            # Outliers are told by a fit to all: told by one without them they would be its own.
            first = _solve(model, state, counts[used], limits.unmodelled, prior)
            off = np.abs(first.residual) / max(first.scatter, 1.0)
            counts[used] *= _counts(OUTLIER - off, _DOUBTED)
        solution = _solve(model, state, counts[used], limits.unmodelled, prior)
        # Steps that turn back overshoot: without shorter ones they go to and fro for ever.
        share = share / 2 if solution.step @ before < 0 else min(1.0, GROWS * share)
        before = solution.step
        state = _next_state(state, share * solution.step, solution.scatter, limits)
        if np.abs(solution.step[:size]).max() < SETTLED_MM:  # not its share: that can be small
            break
    return StepFit(state.place, solution.covariance[:size, :size], state.width, counts)


def _counts(inside: Floats, within: float) -> Floats:
    """How much a sample counts, 0 to 1, that lies so far inside a limit; half at the limit."""
    return np.clip((1 + inside / within) / 2, 0.0, 1.0)


@dataclass(frozen=True)
class _StepState:
    """The unknowns, and the relative scatter of the samples about them.

    place: (P,) mm.  width: (G,) of the blur, mm.  wall: (W,) shares.
    """

    place: Floats
    width: Floats
    wall: Floats
    scatter: float


@dataclass(frozen=True)
class _Prior:
    """What is known of the unknowns beforehand: expected value, 1/variance, and bounds."""

    expected: Floats
    precision: Floats
    least: Floats
    most: Floats


@dataclass(frozen=True)
class _StepSolution:
    """One step of all unknowns and their covariance.

    residual: of each used sample, in units of its uncertainty.  scatter: theirs, by the median.
    """

    step: Floats
    covariance: Floats
    residual: Floats
    scatter: float


@dataclass(frozen=True)
class _StepModel:
    """Used samples and their model, n of them, stretch by stretch.

    begin: (S + 1,) where the stretches begin, and where the last ends.  stretch: (n,).  terms:
    (L, n) of the level.  total: (n,) share of the level that is left.  brightness: (n,).  changes:
    (A + 2, n) of total relative to itself, with the places, the width and the wall.  unknowns:
    (S, A + 3) numbers of a stretch's among all, -1 for none.
    """

    begin: Ints
    stretch: Ints
    terms: Floats
    total: Floats
    brightness: Floats
    changes: Floats
    unknowns: Ints


def _step_model(samples: StepSamples, state: _StepState, used: Ints, t: Floats) -> _StepModel:
    """The model of the used samples, (n,) stretch by stretch; t: their depth in widths."""
    stretch = samples.stretch[used]
    width = state.width[samples.group[stretch]]
    wall = np.append(state.wall, 0.0)[samples.wall[stretch]]
    density = np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi)
    share = ndtr(t) + wall * density
    by_t = density * (1 - wall * t) / share / width
    by_place = (by_t[:, None] * samples.by_place[:, :, used]).sum(axis=0)
    by_width, by_wall = -(by_t * t).sum(axis=0), (density / share).sum(axis=0)
    # Numbers of each stretch's places, width and wall among all unknowns, -1 for none, and of its
    # brightness, which comes after them.
    sizes = np.cumsum([len(state.place), len(state.width), len(state.wall)])
    walls = np.where(samples.wall < 0, -1, sizes[1] + samples.wall)
    last = np.full(len(walls), sizes[2])
    return _StepModel(
        begin=np.searchsorted(stretch, np.arange(len(samples.group) + 1)),
        stretch=stretch,
        terms=samples.level[:, used],
        total=share.prod(axis=0),
        brightness=samples.brightness[used],
        changes=np.vstack([by_place, by_width, by_wall]),
        unknowns=np.column_stack([samples.places, sizes[0] + samples.group, walls, last]),
    )


def _solve(
    model: _StepModel, state: _StepState, weight: Floats, unmodelled: float, prior: _Prior
) -> _StepSolution:
    """One Gauss-Newton step.  The levels enter linearly: they are solved anew each time.

    weight: (n,) how much each sample counts.
    """
    terms, total, begin = model.terms, model.total, model.begin
    root, counted = np.sqrt(weight), weight > 0
    sums = _sums(np.vstack([terms * total, model.brightness]) * root, begin)
    # Of a stretch without samples the terms are 0: the inverse gives it no level.
    levels = np.linalg.pinv(sums[:, :-1, :-1], hermitian=True) @ sums[:, :-1, -1:]
    level = np.einsum("lk,lk->k", terms, levels[..., 0].T[:, model.stretch])
    freedom = weight.sum() - len(prior.expected) - levels.size
    if freedom <= 0 or not (level[counted] > 0).all():
        raise MeasurementError(f"edges: {counted.sum()} samples beside them do not fix them")
    level = np.where(counted, level, 1.0)  # where nothing counts it may be anything, and 0
    relative = model.brightness / (level * total) - 1
    design = np.vstack([terms / level, model.changes, relative])
    design /= np.hypot(state.scatter, unmodelled / total)
    # Each stretch's levels are eliminated by themselves: what is left of it is the unknowns'.
    own = len(terms)
    sums = _sums(design * root, begin)
    follow = np.linalg.pinv(sums[:, :own, :own], hermitian=True) @ sums[:, :own, own:]
    unknowns = model.unknowns
    normal = np.zeros((len(prior.expected) + 2, len(prior.expected) + 2))
    left = sums[:, own:, own:] - sums[:, own:, :own] @ follow
    np.add.at(normal, (unknowns[:, :, None], unknowns[:, None, :]), left)
    present = np.concatenate([state.place, state.width, state.wall])
    known = normal[:-2, :-2] + np.diag(prior.precision)
    inverse = cast(Floats, np.linalg.pinv(known, hermitian=True))
    gradient = normal[:-2, -2] + prior.precision * (prior.expected - present)
    step = _within_bounds(known, inverse, gradient, present, prior)
    shares = np.append(-step, [1.0, 0.0])[unknowns]
    shares = np.column_stack([-(follow @ shares[..., None])[..., 0], shares])
    residual = np.einsum("mk,mk->k", design, shares.T[:, model.stretch])
    chi2 = max(float(weight @ residual**2) / freedom, 1.0)
    return _StepSolution(step, inverse * chi2, residual, 1.4826 * _median(np.abs(residual), weight))


def _within_bounds(
    known: Floats, inverse: Floats, gradient: Floats, present: Floats, prior: _Prior
) -> Floats:
    """The step of the unknowns, those held that would leave their bounds with it.

    The others' step would be that beside a step which is not taken, and go to and fro for ever.
    """
    step, free = inverse @ gradient, np.ones(len(present), dtype=bool)
    while True:
        held = (step < 0) & (present <= prior.least) | (step > 0) & (present >= prior.most)
        if not held.any():
            return step
        free &= ~held
        step = np.zeros(len(present))
        step[free] = np.linalg.pinv(known[np.ix_(free, free)], hermitian=True) @ gradient[free]


def _median(values: Floats, weight: Floats) -> float:
    """The weighted median, which changes continuously with the weights (n,)."""
    order = np.argsort(values)
    up_to = np.cumsum(weight[order]) - weight[order] / 2
    return float(np.interp(weight.sum() / 2, up_to, values[order]))


def _sums(rows: Floats, begin: Ints) -> Floats:
    """(S, M, M) sums over each stretch of the products of the rows (M, n), two by two.

    begin: (S + 1,) where the stretches begin, and where the last ends.
    """
    parts = (rows[:, first:last] for first, last in pairwise(begin))
    return np.array([part @ part.T for part in parts])


def _next_state(state: _StepState, step: Floats, scatter: float, limits: StepLimits) -> _StepState:
    """The state after a bounded step; scatter: of the residuals before it."""
    sizes = [len(state.place), len(state.width), len(state.wall)]
    place, width, wall, _ = np.split(step, np.cumsum(sizes))
    largest = float(np.abs(place).max())
    half = state.width / 2
    return _StepState(
        state.place + place * min(1.0, limits.step_mm / max(largest, 1e-300)),
        np.clip(state.width + np.clip(width, -half, half), *limits.widths_mm),
        np.clip(state.wall + wall, *WALL),
        max(state.scatter * scatter, LEAST_SCATTER),
    )
