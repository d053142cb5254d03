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
from lscan.records import Floats, Ints, Mask

WALL = (-0.3, 1.0)
"""Least and greatest share of a wall: of walls lit at a grazing angle 0.2 to 0.6 was seen."""

WALL_SIGMA = 0.5

FAINTEST = -2.0
"""In widths: samples farther outside an end say nothing of it.  The model is not evaluated there,
where it vanishes (1 / Phi overflows) and, with a negative share of a wall, changes its sign."""

OUTLIER = 4.0
"""Samples whose brightness is off by more than this many standard deviations are left out."""

FIRST_SCATTER = 0.1  # of brightness from sample to sample, relative, where the fit starts
LEAST_SCATTER = 1e-9  # exact samples have weights too
ROUNDS = 30
GROWS = 1.25  # of a step's share, while it does not turn back
SETTLED_MM = 1e-8


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
    kept : (K,) mask, of the samples used
    """

    place: Floats
    covariance: Floats
    kept: Mask


def fit_steps(
    samples: StepSamples,
    place: Floats,
    place_sigma: Floats,
    width: Floats,
    limits: StepLimits,
    kept: Mask | None = None,
) -> StepFit:
    """The most probable ends of lit stretches, from how the brightness falls there.

    Gauss-Newton on brightness relative to the model's, for speckle grows with the light.  The
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
    kept : (K,) mask, optional, the samples to use, where that is decided already

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
    prior = np.concatenate([place, width, wall]), sigma**-2.0
    order = np.argsort(samples.stretch, kind="stable")
    places: list[Floats] = [place]
    share, before = 1.0, np.zeros(len(sigma))
    for left in reversed(range(ROUNDS)):
        depth = np.append(state.place, 0.0)[samples.places[samples.stretch]].T
        depth = (samples.by_place * depth).sum(axis=1) - samples.offset
        t = depth / state.width[samples.group[samples.stretch]]
        if kept is None:
            used = (t > limits.least_t).all(axis=0) & (depth.min(axis=0) < limits.most_mm)
            at = order[used[order]]
            first = _solve(samples, state, at, t, limits.unmodelled, prior)
            used[at] = np.abs(first.residual) < OUTLIER * max(first.scatter, 1.0)
        else:
            used = kept & (t > FAINTEST).all(axis=0)
        solution = _solve(samples, state, order[used[order]], t, limits.unmodelled, prior)
        # Steps that turn back overshoot: without shorter ones they go to and fro for ever.
        share = share / 2 if solution.step @ before < 0 else min(1.0, GROWS * share)
        before = solution.step
        state = _advanced(state, share * solution.step, solution.scatter, limits)
        if _repeats([*places, state.place], left):
            break
        places.append(state.place)
    size = len(place)
    covariance = solution.covariance[:size, :size]
    return StepFit(state.place, covariance, used)


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
class _StepSolution:
    """One step of all unknowns and their covariance.

    residual: of each used sample, in units of its uncertainty.  scatter: theirs, robust.
    """

    step: Floats
    covariance: Floats
    residual: Floats
    scatter: float


def _solve(
    samples: StepSamples,
    state: _StepState,
    used: Ints,
    t: Floats,
    unmodelled: float,
    prior: tuple[Floats, Floats],
) -> _StepSolution:
    """One Gauss-Newton step.  The levels enter linearly: they are solved anew each time.

    used: (n,) the samples that count, stretch by stretch.  prior: expected value and 1/variance of
    the unknowns.
    """
    t, stretch, terms = t[:, used], samples.stretch[used], samples.level[:, used]
    begin = np.searchsorted(stretch, np.arange(len(samples.group) + 1))
    width = state.width[samples.group[stretch]]
    wall = np.append(state.wall, 0.0)[samples.wall[stretch]]
    density = np.exp(-(t**2) / 2) / np.sqrt(2 * np.pi)
    share = ndtr(t) + wall * density
    total, brightness = share.prod(axis=0), samples.brightness[used]
    sums = _sums(np.vstack([terms * total, brightness]), begin)
    # Of a stretch without samples the terms are 0: the inverse gives it no level.
    levels = np.linalg.pinv(sums[:, :-1, :-1], hermitian=True) @ sums[:, :-1, -1:]
    level = np.einsum("lk,lk->k", terms, levels[..., 0].T[:, stretch])
    by_t = density * (1 - wall * t) / share / width
    by_place = (by_t[:, None] * samples.by_place[:, :, used]).sum(axis=0)
    by_width, by_wall = -(by_t * t).sum(axis=0), (density / share).sum(axis=0)
    relative = brightness / (level * total) - 1
    design = np.vstack([terms / level, by_place, by_width, by_wall, relative])
    design /= np.hypot(state.scatter, unmodelled / total)
    expected, precision = prior
    freedom = len(used) - len(expected) - levels.size
    if freedom <= 0 or not (level > 0).all():
        raise MeasurementError(f"edges: {len(used)} samples beside them do not fix them")
    # Each stretch's levels are eliminated by themselves: what is left of it is the unknowns'.
    own = len(terms)
    sums = _sums(design, begin)
    follow = np.linalg.pinv(sums[:, :own, :own], hermitian=True) @ sums[:, :own, own:]
    unknowns = _unknowns(samples, state)
    normal = np.zeros((len(expected) + 2, len(expected) + 2))
    left = sums[:, own:, own:] - sums[:, own:, :own] @ follow
    np.add.at(normal, (unknowns[:, :, None], unknowns[:, None, :]), left)
    present = np.concatenate([state.place, state.width, state.wall])
    known = normal[:-2, :-2] + np.diag(precision)
    inverse = cast(Floats, np.linalg.pinv(known, hermitian=True))
    step = inverse @ (normal[:-2, -2] + precision * (expected - present))
    shares = np.append(-step, [1.0, 0.0])[unknowns]
    shares = np.column_stack([-(follow @ shares[..., None])[..., 0], shares])
    residual = np.einsum("mk,mk->k", design, shares.T[:, stretch])
    chi2 = max(float(residual @ residual) / freedom, 1.0)
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return _StepSolution(step, inverse * chi2, residual, spread)


def _sums(rows: Floats, begin: Ints) -> Floats:
    """(S, M, M) sums over each stretch of the products of the rows (M, n), two by two.

    begin: (S + 1,) where the stretches begin, and where the last ends.
    """
    parts = (rows[:, first:last] for first, last in pairwise(begin))
    return np.array([part @ part.T for part in parts])


def _unknowns(samples: StepSamples, state: _StepState) -> Ints:
    """(S, A + 3) numbers of a stretch's places, width and wall among all unknowns, -1 for none.

    The last is that of the brightness itself, which is numbered after them.
    """
    sizes = np.cumsum([len(state.place), len(state.width), len(state.wall)])
    wall = np.where(samples.wall < 0, -1, sizes[1] + samples.wall)
    last = np.full(len(wall), sizes[2])
    return np.column_stack([samples.places, sizes[0] + samples.group, wall, last])


def _repeats(places: list[Floats], left: int) -> bool:
    """Whether the last of some places is where the search would be after ``left`` more rounds.

    It is at rest, or a doubtful sample that comes and goes leads it round in a circle.
    """
    *before, last = places
    for period, place in enumerate(reversed(before), start=1):
        if left % period == 0 and np.abs(last - place).max() < SETTLED_MM:
            return True
    return False


def _advanced(state: _StepState, step: Floats, scatter: float, limits: StepLimits) -> _StepState:
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
