"""What got better or worse between two runs of one suite: a paired test, case by case."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
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
    """

    extractor: str
    figure: str
    worse: bool
    change: float
    p: float
    cases: int

    @property
    def in_words(self) -> str:
        """One line."""
        how = "worse" if self.worse else "better"
        ratio = self.figure in _RATIOS
        more, size = ("larger" if self.change > 0 else "smaller"), abs(self.change)
        if not ratio:
            change = f"{size:.2g} columns {'more' if self.change > 0 else 'fewer'}"
        elif size < 1:
            change = f"{100 * size:.{0 if size > 0.1 else 1}f} % {more}"
        else:
            change = f"{1 + self.change:.3g} times as large"
        return (
            f"{self.extractor}: {self.figure} {how}: {change}, in {self.cases} cases, "
            f"p = {self.p:.1g}"
        )


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
            typical = pseudo_median(difference)
            change = float(np.expm1(typical)) if figure in _RATIOS else typical
            worse = typical > 0
            if figure == _SIGMA:
                off = np.abs(np.nanmean(pairs, axis=0) - LOG_Z)
                worse = bool(off[0] > off[1])
            found.append(Difference(extractor, figure, worse, change, p, len(difference)))
    return found


def _probability(difference: Floats) -> float:
    """Two-sided, of the signed-rank test; 1 where nothing differs."""
    if len(difference) == 0:
        return 1.0
    return float(wilcoxon(difference).pvalue)


def pseudo_median(values: Floats) -> float:
    """The median of the means of all pairs of values, each value with itself among them.

    Parameters
    ----------
    values : (N,) array, 1 at least
    """
    one, other = np.triu_indices(len(values))
    return float(np.median((values[one] + values[other]) / 2))
