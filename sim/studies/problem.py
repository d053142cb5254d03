"""What a study evaluates: a pure function from causes to errors, by which rows; and its indices."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

import numpy as np
from scipy.stats import qmc, t as student

from lscan.errors import InputError
from lscan.records import Floats, Mask

NOMINAL = float("nan")
"""In a row: this cause is not at work.  Its number is the scene's own, its noise is off."""


@dataclass(frozen=True)
class Output:
    """One error that is looked at.

    Attributes
    ----------
    name : str, as the study's file and its results name it; with ``AFTER``: after recalibration
    unit : str, such as "mm"
    size : int, 1 of a scalar; P of a field, the errors of P places of the surface
    """

    name: str
    unit: str
    size: int = 1


AFTER = ".after"
"""Ends the name of an output as it is once the instrument was calibrated anew before the scan."""


class StudyProblem(Protocol):
    """Errors as a function of their causes.

    Attributes
    ----------
    causes : tuple of str, the names of D causes
    outputs : tuple of Output, whose sizes sum up to K
    """

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of D causes."""
        ...

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The outputs, whose sizes sum up to K."""
        ...

    def evaluate(self, row: Floats) -> Floats:
        """(K,) errors, measured less true, of the rig that a row stands for.

        Parameters
        ----------
        row : (D,) array, of numbers in [0, 1), or NOMINAL: each cause's number is its
            distribution's quantile there; what is new in each picture, and noise, are drawn with
            a seed made from it.  The same row gives the same bytes in any process.

        Raises
        ------
        LscanError
            The rig cannot be calibrated or measured: a status of the run.
        """
        ...


def columns(outputs: Sequence[Output]) -> dict[str, slice]:
    """Where each output's values are among the K of a row of results.

    Parameters
    ----------
    outputs : sequence of Output

    Examples
    --------
    >>> columns([Output("height", "mm", 3), Output("yaw", "deg")])
    {'height': slice(0, 3, None), 'yaw': slice(3, 4, None)}
    """
    ends = list(accumulate(output.size for output in outputs))
    return {
        output.name: slice(end - output.size, end)
        for output, end in zip(outputs, ends, strict=True)
    }


def width(outputs: Sequence[Output]) -> int:
    """K, the number of values in a row of results.

    Parameters
    ----------
    outputs : sequence of Output
    """
    return sum(output.size for output in outputs)


# The rows of a study: which rigs are evaluated for its budget.
#
# Its quasi-random points come in SETS independently scrambled Sobol' sequences, dealt out in turn:
# sample n is point n // SETS of set n % SETS.  So a greater design begins with the smaller one, the
# error falls nearly as fast as that of one long sequence, and the scatter of the sets tells how
# large it is, which one sequence cannot (Owen 1997; L'Ecuyer & Lemieux 2002).
#
# References ---------- Saltelli, Annoni, Azzini, Campolongo, Ratto & Tarantola 2010, Computer
# Physics Communications 181: the blocks A, B and A with columns of B. Owen 1997, Annals of
# Statistics 25; L'Ecuyer & Lemieux 2002, in Modeling Uncertainty: replicates.


SETS = 16
"""Independent sequences: at fewer, the quantile of Student's t widens the intervals by more than
the 9 % it does here; at more, the points of each are fewer and less even.  With 16 the intervals
of a linear error of 12 causes are 0.6 times as wide, at a base of 1024, as with random points."""

BASE, ALL, AGAIN = "base", "all", "all again"
"""Blocks of rows: no cause at work; all of them (Saltelli's A); all, drawn once more (his B)."""


def alone(group: str) -> str:
    """The block of rows in which this group of causes is at work and no other.

    Parameters
    ----------
    group : str, its name
    """
    return f"alone: {group}"


def mixed_block(group: str) -> str:
    """The block ALL with this group's causes as they are in the block AGAIN.

    Parameters
    ----------
    group : str, its name
    """
    return f"mixed: {group}"


@dataclass(frozen=True)
class Design:
    """The rows of a study, block by block; a row is known by its block and its place in it.

    Attributes
    ----------
    blocks : mapping, name of a block to its (n, D) rows of numbers in (0, 1) or NOMINAL
    groups : tuple of str, the groups of causes
    """

    blocks: Mapping[str, Floats]
    groups: tuple[str, ...]

    @property
    def rows(self) -> Floats:
        """(R, D) all rows, in the order of the blocks."""
        return np.concatenate(list(self.blocks.values()))

    @property
    def labels(self) -> list[tuple[str, int]]:
        """Of each of the R rows its block and its place there, the same in a greater design."""
        return [(name, n) for name, rows in self.blocks.items() for n in range(len(rows))]

    def split(self, values: Floats) -> dict[str, Floats]:
        """(R, ...) results block by block.

        Parameters
        ----------
        values : (R, ...) array, of ``rows``
        """
        ends = np.cumsum([len(rows) for rows in self.blocks.values()])
        return dict(zip(self.blocks, np.split(values, ends[:-1]), strict=True))


def make_design(
    causes: Sequence[str],
    base: int,
    apart: int,
    seed: int,
    groups: Mapping[str, Sequence[str]] | None = None,
) -> Design:
    """The design of a budget with first-order and total indices: base times (groups + 2) rows.

    Parameters
    ----------
    causes : sequence of str, the names of D causes
    base : int, rows of ALL, a multiple of SETS; best is SETS times a power of two
    apart : int, rows of each group alone, likewise
    seed : int
    groups : mapping, name of a group to its causes; each cause is one by default.  What is in no
        group stays NOMINAL in all rows.

    Returns
    -------
    Design, of whose blocks those of a smaller base or apart are the beginnings

    Raises
    ------
    InputError
        A number of rows is no multiple of SETS; a group names an unknown cause or one of another.
    """
    groups = {cause: (cause,) for cause in causes} if groups is None else groups
    for name, number in (("base", base), ("apart", apart)):
        if number % SETS or number < 0:
            raise InputError(f"design: {name} is {number}, must be a multiple of {SETS}")
    masks = {name: np.isin(causes, list(members)) for name, members in groups.items()}
    _check_groups(causes, groups)
    at_work = np.any(list(masks.values()), axis=0)
    first, again = np.split(_points(2 * len(causes), base, (seed, 0)), 2, axis=1)
    first, again = (np.where(at_work, numbers, NOMINAL) for numbers in (first, again))
    blocks = {BASE: np.full((1, len(causes)), NOMINAL)}
    for k, (name, mask) in enumerate(masks.items()):
        rows = np.full((apart, len(causes)), NOMINAL)
        rows[:, mask] = _points(int(mask.sum()), apart, (seed, 1 + k))
        blocks[alone(name)] = rows
    blocks |= {ALL: first, AGAIN: again}
    blocks |= {mixed_block(name): np.where(mask, again, first) for name, mask in masks.items()}
    return Design(blocks, tuple(groups))


def _points(dimensions: int, count: int, seed: tuple[int, int]) -> Floats:
    """(count, dimensions) numbers within (0, 1), the SETS sequences in turn.

    Sobol' numbers are multiples of 2^-30, zero among them, where the quantile of a normal
    distribution is infinite: half a step is added, which is exact and keeps them below one.
    """
    if not count:  # a sequence takes a millisecond to make
        return np.empty((0, dimensions))
    each = count // SETS
    whole = max(each - 1, 0).bit_length()  # a sequence is drawn by powers of two
    sets = [
        qmc.Sobol(dimensions, rng=np.random.default_rng([*seed, k])).random_base2(whole)[:each]
        for k in range(SETS)
    ]
    return np.stack(sets, axis=1).reshape(count, dimensions) + 2.0**-31


def _check_groups(causes: Sequence[str], groups: Mapping[str, Sequence[str]]) -> None:
    grouped = [cause for members in groups.values() for cause in members]
    for cause in grouped:
        if cause not in causes:
            raise InputError(f"groups: {cause} is no cause of this study")
        if grouped.count(cause) > 1:
            raise InputError(f"groups: {cause} is in two groups, must be in one")
    for name, members in groups.items():
        if not members:
            raise InputError(f"groups: {name} has no causes")


# 95 % confidence intervals from the scatter of a design's independent sets of points.
#
# The jackknife takes one set away at a time.  Its pseudo-values are nearly independent values of
# the figure itself, free of its bias of first order: their mean is the figure, their scatter gives
# Student's interval.  A figure that cannot be negative, and is not near zero, gets it on a
# logarithmic scale, where its distribution is more nearly symmetrical.
#
# References
# ----------
# Tukey 1958, Annals of Mathematical Statistics 29, 614; Efron & Stein 1981, Annals of Statistics
# 9.


CONFIDENCE = 0.95


@dataclass(frozen=True)
class Bounded:
    """A figure with its 95 % confidence interval; NaN where there is none."""

    value: float
    low: float
    high: float

    @property
    def half_width(self) -> float:
        """Half of the interval's width."""
        return (self.high - self.low) / 2

    @property
    def known(self) -> "Bounded | None":
        """It, or None where it has no interval."""
        return self if np.isfinite([self.value, self.half_width]).all() else None


def set_sums(samples: Floats) -> Floats:
    """(SETS, q) sums of (N, q) samples over those of each set.

    Parameters
    ----------
    samples : (N, q) array, in the order of a design's block; zero where left out
    """
    return samples.reshape(-1, SETS, samples.shape[-1]).sum(axis=0)


def pseudo_values(sums: Floats, figure: Callable[[Floats], Floats]) -> Floats:
    """(SETS,) pseudo-values of a figure; NaN of a set that has no samples.

    Parameters
    ----------
    sums : (SETS, q) array, sums over samples, the first of them their number
    figure : callable, from (..., q) sums to the figure, (...)
    """
    filled = sums[:, 0] > 0
    sets, total = int(filled.sum()), sums.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = sets * figure(total) - (sets - 1) * figure(total - sums)
    return np.where(filled, values, np.nan)


def interval(pseudo: Floats, positive: bool = False) -> Bounded:
    """The figure and its interval.

    Parameters
    ----------
    pseudo : (SETS,) array, pseudo-values, NaN of an empty set
    positive : bool, the figure cannot be negative
    """
    pseudo = pseudo[np.isfinite(pseudo)]
    if len(pseudo) < 2:
        return Bounded(np.nan, np.nan, np.nan)
    value = float(pseudo.mean())
    error = float(pseudo.std(ddof=1)) / len(pseudo) ** 0.5
    reach = float(student.ppf(0.5 + CONFIDENCE / 2, len(pseudo) - 1)) * error
    if positive and value > reach:
        factor = float(np.exp(reach / value))
        return Bounded(value, value / factor, value * factor)
    return Bounded(value, value - reach, value + reach)


# Means in a dear tier from few of its runs and many of a cheap one: control variates.
#
# With y a term in the dear tier and x the same in the cheap one, of the same rig, the mean of y
# over n rigs is corrected by how far the mean of x over these n is from that over all N:
#
#     y_n + alpha (x_N - x_n).
#
# For a fixed alpha it has no bias, whatever x is.  Its scatter is least where alpha is the slope of
# y on x, and then that of what x does not explain.  The slope is found from the same n rigs: that
# costs a factor of (n - 2) / (n - 3) of the variance, and a bias that the jackknife removes to
# first order.  The products that Sobol' indices are ratios of are such terms.
#
# References ---------- Lavenberg & Welch 1981, Management Science 27, 322: the slope from the same
# samples. Peherstorfer, Willcox & Gunzburger 2016, SIAM Journal on Scientific Computing 38, A3163.
# Qian, Peherstorfer, O'Malley, Vesselinov & Willcox 2018, SIAM/ASA Journal on Uncertainty
# Quantification 6, 683: Sobol' indices.


Figure = Callable[[Floats], Floats]
"""From (..., q) means of terms to a figure, (...)."""

CONSTANT = 1e-12
"""Variance over mean square of a term that does not vary: what is left of it is rounding."""


@dataclass(frozen=True)
class TermMeans:
    """Means of q terms over a design's samples, and over all of its sets but one.

    Attributes
    ----------
    sums : (SETS, 1 + q) array, number of samples, and sums of the terms over them; of two tiers
        (SETS, 2 + 5 q): that of the cheap one, and of the samples that both have their number and
        sums of x, y, x^2 and x y
    terms : int, q
    """

    sums: Floats
    terms: int

    @property
    def used(self) -> int:
        """The samples that count; of two tiers, those that both have."""
        return int(self.sums[:, self._counted].sum())

    def pseudo_values(self, figure: Figure) -> Floats:
        """(SETS,) pseudo-values of a figure; of two tiers, in the dear one.

        Parameters
        ----------
        figure : callable
        """
        return pseudo_values(self.sums, lambda sums: figure(self._means(sums)))

    @property
    def _counted(self) -> int:
        """Where the number of samples stands that count."""
        return 1 + self.terms if self.sums.shape[1] > 1 + self.terms else 0

    def _cheap(self, sums: Floats) -> Floats:
        return sums[..., 1 : 1 + self.terms] / sums[..., :1]

    def _means(self, sums: Floats) -> Floats:
        if not self._counted:
            return self._cheap(sums)
        paired = sums[..., self._counted + 1 :] / sums[..., self._counted, None]
        x, y, squares, products = np.split(paired, 4, axis=-1)
        varies = squares - x**2 > CONSTANT * squares
        alpha = np.where(varies, (products - x * y) / np.where(varies, squares - x**2, 1.0), 1.0)
        return y + alpha * (self._cheap(sums) - x)


def term_means(cheap: Floats, dear: Floats | None = None) -> TermMeans:
    """Means of terms; of two tiers, those in the dear one.

    Parameters
    ----------
    cheap : (N, q) array, of samples in the order of a design's block; NaN where a run failed
    dear : (N, q) array, optional, of the same rigs; NaN where there is none
    """
    kept: Mask = np.asarray(np.isfinite(cheap).all(axis=1))
    samples = [kept[:, None], _zero_unused(cheap, kept)]
    if dear is not None:
        both: Mask = np.asarray(kept & np.isfinite(dear).all(axis=1))
        x, y = _zero_unused(cheap, both), _zero_unused(dear, both)
        samples += [both[:, None], x, y, x**2, x * y]
    return TermMeans(set_sums(np.hstack(samples)), cheap.shape[1])


def _zero_unused(terms: Floats, kept: Mask) -> Floats:
    return np.where(kept[:, None], terms, 0.0)


# Sobol' indices of each output and group of causes, and the moments of its error.


MOST_FAILED = 0.05
"""Share of failed runs beyond which a note says so: the 5 % of errors that a 95 % range leaves out
could then all be those of rigs that nobody could measure."""

POSITIVE = ("variance", "mean_square", "rms")  # that are not near zero where anything varies

ROUNDS = 2
"""Of finding a weight and the ratio from one another: each takes 1 / sqrt(N) of what is left."""


@dataclass(frozen=True)
class Moments:
    """Moments of an error over rigs, of a field's also over its places.

    mean_square is systematic + variance.

    Attributes
    ----------
    mean : Bounded, in the output's unit
    systematic : Bounded, the mean error over rigs squared, mean over places, unit squared
    variance : Bounded, of rigs about that, mean over places, unit squared
    mean_square : Bounded, unit squared
    """

    mean: Bounded
    systematic: Bounded
    variance: Bounded
    mean_square: Bounded


@dataclass(frozen=True)
class GroupIndices:
    """Sobol' indices of a group.  used: the base samples that they come from."""

    first: Bounded
    total: Bounded
    used: int


@dataclass(frozen=True)
class Indices:
    """Where the variance of an output comes from.

    Attributes
    ----------
    groups : mapping, name of a group to its indices
    rest : Bounded, 1 less all first-order indices: what interaction leaves
    moments : Moments, with all causes at work
    base : int, base samples
    failed : int, runs without a value
    note : str, what a reader has to know, "" where nothing
    """

    groups: Mapping[str, GroupIndices]
    rest: Bounded
    moments: Moments
    base: int
    failed: int
    note: str = ""


def sobol_indices(
    design: Design, values: Floats, outputs: Sequence[Output], rendered: Floats | None = None
) -> dict[str, Indices]:
    """The indices of each output, by its name.

    Parameters
    ----------
    design : Design
    values : (R, K) array, results of its rows, NaN where a run failed
    outputs : sequence of Output, whose sizes sum up to K
    rendered : (R, K) array, optional, results in the tier that counts, NaN where there are none
    """
    found = {}
    for name, where in columns(outputs).items():
        tiers = [values] if rendered is None else [values, rendered]
        found[name] = _output_indices(design, [design.split(tier[:, where]) for tier in tiers])
    return found


def moments(errors: Floats, rendered: Floats | None = None) -> Moments:
    """Moments of errors with their intervals.

    Parameters
    ----------
    errors : (N, P) array, of rigs in the order of a design's blocks, at P places; NaN where failed
    rendered : (N, P) array, optional, the same in the tier that counts, NaN where there are none
    """
    pseudo = moment_pseudo_values(errors, rendered)
    bounded = {name: interval(pseudo[name], name in POSITIVE) for name in pseudo}
    return Moments(**{name: bounded[name] for name in Moments.__dataclass_fields__})


def moment_pseudo_values(errors: Floats, rendered: Floats | None = None) -> dict[str, Floats]:
    """(SETS,) pseudo-values of each of ``Moments``, of the rms and of its logarithm, by name.

    Squares are taken about each tier's own mean: a shift between the tiers would else be a part of
    them that the first does not explain.

    Parameters
    ----------
    errors, rendered : (N, P) arrays, as in ``moments``
    """
    tiers = [errors] if rendered is None else [errors, rendered]
    centres = [_centre(*tiers[: k + 1]) for k in range(len(tiers))]
    off = [tier - centre for tier, centre in zip(tiers, centres, strict=True)]
    means = term_means(*(np.column_stack([(one**2).mean(axis=1), one]) for one in off))

    def systematic(of: Floats) -> Floats:
        return np.mean((centres[-1][0] + of[..., 1:]) ** 2, axis=-1)

    def variance(of: Floats) -> Floats:
        return of[..., 0] - np.mean(of[..., 1:] ** 2, axis=-1)

    figures: dict[str, Figure] = {
        "mean": lambda of: np.mean(centres[-1][0] + of[..., 1:], axis=-1),
        "systematic": systematic,
        "variance": variance,
        "mean_square": lambda of: systematic(of) + variance(of),
        "rms": lambda of: np.sqrt(np.maximum(systematic(of) + variance(of), 0.0)),
        "log_rms": lambda of: np.log(np.maximum(systematic(of) + variance(of), 0.0)) / 2,
    }
    return {name: means.pseudo_values(figure) for name, figure in figures.items()}


def next_base(indices: Iterable[Indices], wanted_half_width: float, base: int) -> int | None:
    """To which base the design must grow for the half-widths wanted; None where they are reached.

    Those of the three groups with the largest total indices of each output count, of both
    indices.  They fall as 1 / sqrt(base), or faster.  It grows to SETS times a power of two, and
    about fourfold at most: what a small base says of its own intervals is uncertain.

    Parameters
    ----------
    indices : iterable of Indices, of the outputs that count
    wanted_half_width : float
    base : int, of the design that they come from
    """
    widest = 0.0
    for output in indices:
        told = [group for group in output.groups.values() if np.isfinite(group.total.value)]
        for group in sorted(told, key=lambda group: -group.total.value)[:3]:
            widest = max(widest, group.first.half_width, group.total.half_width)
    if widest <= wanted_half_width:
        return None
    grown = SETS
    while grown <= base or grown < min(base * (widest / wanted_half_width) ** 2, 4 * base):
        grown *= 2
    return grown


def index_pseudo_values(
    design: Design, tiers: Sequence[Mapping[str, Floats]]
) -> dict[str, tuple[Floats, Floats, int]]:
    """Of each group (SETS,) pseudo-values of its first-order and its total index, and samples used.

    Parameters
    ----------
    design : Design
    tiers : sequence of mapping, of each tier an output's (N, P) results block by block, the tier
        that counts last; NaN where there is none
    """
    both = both_draws(tiers)
    centres = [_centre(*both[: k + 1]) for k in range(len(both))]
    found = {}
    for group in design.groups:
        samples = []
        for blocks, centre in zip(tiers, centres, strict=True):
            samples.append([blocks[name] - centre for name in (ALL, AGAIN, mixed_block(group))])
        first, total = (
            term_means(*(_terms(*terms(a, b, c), _dot(a, b)) for a, b, c in samples))
            for terms in (_of_first, _of_total)
        )
        pseudo = first.pseudo_values(lambda of: _ratio(of, 1.0))
        found[group] = pseudo, total.pseudo_values(lambda of: _ratio(of, 0.0)), first.used
    return found


def both_draws(tiers: Sequence[Mapping[str, Floats]]) -> list[Floats]:
    """(2 N, P) results of all rigs with all causes at work, tier by tier.

    Parameters
    ----------
    tiers : sequence of mapping, as in ``index_pseudo_values``
    """
    return [np.concatenate([blocks[ALL], blocks[AGAIN]]) for blocks in tiers]


def _output_indices(design: Design, tiers: Sequence[Mapping[str, Floats]]) -> Indices:
    names = (ALL, AGAIN, *map(mixed_block, design.groups))
    both, pseudo = both_draws(tiers), index_pseudo_values(design, tiers)
    known = both[-1][_intact(both[-1])]
    constant = len(known) > 0 and bool((known == known[:1]).all())
    failed = sum(int(np.sum(~_intact(tiers[0][name]))) for name in names)
    return Indices(
        groups={
            group: GroupIndices(interval(first), interval(total, True), used)
            for group, (first, total, used) in pseudo.items()
        },
        rest=interval(1 - np.sum([first for first, _, _ in pseudo.values()], axis=0)),
        moments=moments(*both),
        base=len(tiers[0][ALL]),
        failed=failed,
        note=_note(failed, sum(len(tiers[0][name]) for name in names), constant),
    )


def _centre(low: Floats, high: Floats | None = None) -> Floats:
    """(1, P) mean error of the last of the tiers given; NaN where every run failed."""
    either = low[_intact(low)]
    if not len(either):
        return np.full((1, low.shape[1]), np.nan)
    # Less one of them first: what does not vary is then exactly zero.
    centre: Floats = either[:1] + (either - either[:1]).mean(axis=0)
    if high is None:
        return centre
    off = (high - low)[_intact(high) & _intact(low)]
    return centre + (off.mean(axis=0) if len(off) else np.nan)


def _of_first(a: Floats, b: Floats, c: Floats) -> tuple[Floats, Floats]:
    return _dot(b, c), (_dot(b, b) + _dot(c, c)) / 2


def _of_total(a: Floats, b: Floats, c: Floats) -> tuple[Floats, Floats]:
    return _dot(a - c, a - c) / 2, (_dot(a, a) + _dot(c, c)) / 2


def _terms(above: Floats, beneath: Floats, free: Floats) -> Floats:
    """(N, 6) what the ratio of the means of ``above`` and ``beneath`` needs, each of (N,)."""
    return np.column_stack([above, beneath, free, above * free, beneath * free, free**2])


def _ratio(means: Floats, start: float) -> Floats:
    """(...) ratio of two means, ``free`` being known to have the mean 0, of (..., 6) terms.

    The best weight of ``free`` is the slope of the ratio's residual on it (Glasserman 2003, Monte
    Carlo Methods in Financial Engineering, 4.1), found from ``start``.
    """
    top, low, zero, top_zero, low_zero, square = np.moveaxis(means, -1, 0)
    spread = square - zero**2
    weight: Floats = np.asarray(start)
    for _ in range(ROUNDS):
        ratio = (top - weight * zero) / low
        slope = top_zero - ratio * low_zero - (top - ratio * low) * zero
        weight = np.where(spread > 0, slope / np.where(spread > 0, spread, 1.0), 0.0)
    return (top - weight * zero) / low


def _dot(x: Floats, y: Floats) -> Floats:
    """(N,) sums of products over the places."""
    return np.einsum("np,np->n", x, y)


def _intact(errors: Floats) -> Mask:
    """Which runs have a value at all P places, of (..., P)."""
    return np.asarray(np.isfinite(errors).all(axis=-1))


def _note(failed: int, runs: int, constant: bool) -> str:
    if failed == runs:
        return "every run failed"
    if constant:
        return "does not vary: there are no indices"
    if failed > MOST_FAILED * runs:
        return f"{failed} of {runs} runs failed: this speaks for the rigs that could be measured"
    return ""
