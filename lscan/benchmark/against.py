"""What got better or worse between two runs of one suite: a paired test, case by case."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri
from scipy.stats import wilcoxon

from lscan.benchmark.judging import CaseSums
from lscan.records import Floats

FALSE_ALARMS = 0.01  # probability that any figure of an extractor differs where nothing changed
EQUAL = 1e-4  # a smaller difference is none: 0.01 % of an rms, less than a column


def _log_rms(sums: CaseSums) -> float:
    return 0.5 * float(np.log(max(sums.square / sums.core, 1e-12))) if sums.core else np.nan


def _log_z(sums: CaseSums) -> float:
    return sums.log_z / sums.core if sums.core else np.nan


def _log_score(sums: CaseSums) -> float:
    """Of stated sigmas, in rms errors: an accuracy that changes alone is the rms error's to say."""
    return float(np.log(sums.score / sums.core)) - _log_rms(sums) if sums.score else np.nan


FIGURES: Mapping[str, Callable[[CaseSums], float]] = {
    "rms error": _log_rms,
    "error in stated sigmas": _log_z,
    "score of stated sigmas": _log_score,
    "missed columns": lambda sums: sums.missed,
    "columns without a line": lambda sums: sums.ghosts,
    "wrong columns": lambda sums: sums.outlying,
    "wrong columns that are sure": lambda sums: sums.sure,
}
"""Of a case; more is worse, but of the error in sigmas: too large and too small are both worse.

The first three are logarithms, whose differences are ratios.
"""
_SIGMA = "error in stated sigmas"
_RATIOS = ("rms error", _SIGMA, "score of stated sigmas")
LOG_Z = -(np.euler_gamma + np.log(2)) / 2  # the mean of ln |z| where z is standard normal


@dataclass(frozen=True)
class Difference:
    """A figure that differs.

    Attributes
    ----------
    extractor : str
    figure : str, a key of FIGURES
    worse : bool
    change : float, of the cases in which it differs: the pseudo-median of the ratio less 1, or of
        the difference in columns
    p : float, probability of so much where nothing changed
    cases : int, in which it differs at all
    interval : tuple of float, of change, 95 %
    """

    extractor: str
    figure: str
    worse: bool
    change: float
    p: float
    cases: int
    interval: tuple[float, float]

    @property
    def in_words(self) -> str:
        """One line."""
        how = "worse" if self.worse else "better"
        low, high = (self._size(end) for end in self.interval)
        return (
            f"{self.extractor}: {self.figure} {how}: {self._size(self.change)} ({low} to {high}), "
            f"in {self.cases} cases, p = {self.p:.1g}"
        )

    def _size(self, change: float) -> str:
        size, more = abs(change), change > 0
        if self.figure not in _RATIOS:
            return f"{size:.2g} columns {'more' if more else 'fewer'}"
        if size >= 1:
            return f"{1 + change:.3g} times as large"
        return f"{100 * size:.{0 if size > 0.1 else 1}f} % {'larger' if more else 'smaller'}"


def differences(
    extractor: str, now: Mapping[str, CaseSums], before: Mapping[str, CaseSums]
) -> list[Difference]:
    """What differs on the cases that both have, the probability of any false alarm being 1 %.

    Parameters
    ----------
    extractor : str, for the records
    now, before : mappings, sums by case

    References
    ----------
    Wilcoxon, Individual comparisons by ranking methods, Biometrics Bulletin 1 (1945), cases without
    a difference left out; Bonferroni's correction for the number of figures.  That 5 % of the cases
    got a little worse and all others stayed as they are is then seen, too.  The pseudo-median
    belongs to that test (Hodges and Lehmann, Estimates of location based on rank tests, Annals of
    Mathematical Statistics 34 (1963)): its sign is that of the rank sum.
    """
    common = sorted(now.keys() & before.keys())
    found = []
    for figure, of in FIGURES.items():
        pairs = np.array([[of(now[case]), of(before[case])] for case in common]).reshape(-1, 2)
        difference = pairs[:, 0] - pairs[:, 1]
        difference = difference[np.abs(difference) > EQUAL]  # NaN, too, is left out
        p = _probability(difference)
        if p < FALSE_ALARMS / len(FIGURES):
            low, typical, high = pseudo_median(difference)
            worse = typical > 0
            if figure == _SIGMA:
                off = np.abs(np.nanmean(pairs, axis=0) - LOG_Z)
                worse = bool(off[0] > off[1])
            if figure in _RATIOS:
                low, typical, high = np.expm1([low, typical, high]).tolist()
            found.append(
                Difference(extractor, figure, worse, typical, p, len(difference), (low, high))
            )
    return found


def between(sums: Mapping[str, Mapping[str, CaseSums]]) -> list[Difference]:
    """What differs between the first of several methods and each other, on the same cases.

    Parameters
    ----------
    sums : mapping, by method and case
    """
    (first, own), *others = sums.items()
    return [one for name, of in others for one in differences(f"{name} beside {first}", of, own)]


def before_and_after(now: Mapping[str, CaseSums], before: Mapping[str, CaseSums]) -> str:
    """Bias and rms error of two runs, of the columns that count, and the cases changed most.

    Parameters
    ----------
    now, before : mappings, sums by case; counted are the clear columns of the cases of both with a
        value within three widths of the line
    """
    common = [case for case in sorted(now) if case in before and now[case].core]
    common = [case for case in common if before[case].core]
    if not common:
        return "no case of both has a column that counts"

    def rms(of: Mapping[str, CaseSums], cases: Sequence[str]) -> float:
        return float(np.sqrt(sum(of[c].square for c in cases) / sum(of[c].core for c in cases)))

    bias = [
        sum(of[c].error for c in common) / sum(of[c].core for c in common) for of in (before, now)
    ]
    changed = sorted(common, key=lambda case: abs(_log_rms(now[case]) - _log_rms(before[case])))
    most = ", ".join(
        f"{case} ({rms(before, [case]):.3f} to {rms(now, [case]):.3f} px)"
        for case in changed[:-4:-1]
    )
    return (
        f"bias {bias[0]:+.4f} to {bias[1]:+.4f} px, rms error {rms(before, common):.4f} to "
        f"{rms(now, common):.4f} px, of {sum(now[case].core for case in common):.0f} columns in "
        f"{len(common)} cases; changed most: {most}"
    )


def _probability(difference: Floats) -> float:
    """Two-sided, of the signed-rank test; 1 where nothing differs."""
    if len(difference) == 0:
        return 1.0
    return float(wilcoxon(difference).pvalue)


def pseudo_median(values: Floats) -> tuple[float, float, float]:
    """The median of the means of all pairs of values, each with itself among them.

    Parameters
    ----------
    values : (N,) array, 1 at least

    Returns
    -------
    tuple of float
        The lower end of its 95 % interval, itself, the upper end: that of the values which the
        signed-rank test does not reject.  Of fewer than six values the ends are the outermost.

    References
    ----------
    Hollander, Wolfe and Chicken, Nonparametric Statistical Methods, 3rd edition, section 3.3.
    """
    one, other = np.triu_indices(len(values))
    means, n = np.sort((values[one] + values[other]) / 2), len(values)
    spread = np.sqrt(n * (n + 1) * (2 * n + 1) / 24)
    left_out = max(int(n * (n + 1) / 4 - ndtri(0.975) * spread), 0)
    return float(means[left_out]), float(np.median(means)), float(means[-1 - left_out])
