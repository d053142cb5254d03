"""Morris screening: which causes matter at all, from few runs.

References
----------
Morris 1991, Technometrics 33, 161.
Campolongo, Cariboni & Saltelli 2007, Environmental Modelling & Software 22, 1509: mu*.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from SALib.sample import morris
from scipy.stats import t as student

from lscan.records import Floats
from sim.studies.intervals import CONFIDENCE, Bounded
from sim.studies.problem import Output, columns

LEVELS = 4
LOWEST = 1 / (2 * LEVELS)
"""The levels are the middles of LEVELS equal parts of a distribution: at 0 and 1, which are usual,
the quantile of a normal one is infinite."""
STEP = LEVELS / (2 * (LEVELS - 1))
"""Of one step, as a share of the way from the lowest to the highest level."""


@dataclass(frozen=True)
class Effect:
    """What a group of causes does on its way from its lowest to its highest level.

    In the output's unit; of a field, the rms over its places.

    Attributes
    ----------
    size : Bounded, mu*, the mean size of the elementary effects
    spread : float, sigma, their standard deviation: by curvature, and by other causes; it tells
        less of a group whose causes step in opposite directions
    used : int, trajectories
    """

    size: Bounded
    spread: float
    used: int


def screening_rows(
    causes: Sequence[str], trajectories: int, seed: int, groups: Mapping[str, Sequence[str]]
) -> Floats:
    """(T, G + 1, D) numbers in (0, 1): from each row to the next, the causes of one group step.

    Parameters
    ----------
    causes : sequence of str, the names of D causes
    trajectories : int, T; those of a smaller number are the first of a greater
    seed : int
    groups : mapping, name of each of G groups to its causes; each cause is in one
    """
    group_of = {cause: name for name, members in groups.items() for cause in members}
    problem = {
        "num_vars": len(causes),
        "names": list(causes),
        "bounds": [[LOWEST, 1 - LOWEST]] * len(causes),
        "groups": [group_of[cause] for cause in causes],
    }
    rows = [
        morris.sample(problem, 1, num_levels=LEVELS, seed=np.random.default_rng([seed, k]))
        for k in range(trajectories)
    ]
    return np.stack(rows)


def effects(
    rows: Floats,
    values: Floats,
    causes: Sequence[str],
    outputs: Sequence[Output],
    groups: Mapping[str, Sequence[str]],
) -> dict[str, dict[str, Effect]]:
    """The effect on each output, by its name, of each group.

    Parameters
    ----------
    rows : (T, G + 1, D) array, of screening_rows
    values : (T, G + 1, K) array, their results, NaN where a run failed
    causes : sequence of str, the names of D causes
    outputs : sequence of Output, whose sizes sum up to K
    groups : mapping, as the rows were made with
    """
    steps, changes = np.diff(rows, axis=1), np.diff(values, axis=1) / STEP
    found: dict[str, dict[str, Effect]] = {output.name: {} for output in outputs}
    for group, members in groups.items():
        step = steps[..., list(causes).index(members[0])]
        which = np.argmax(step != 0, axis=1)
        trajectory = np.arange(len(rows))
        change = changes[trajectory, which] * np.sign(step[trajectory, which])[:, None]
        for name, where in columns(outputs).items():
            found[name][group] = _effect(change[:, where])
    return found


def _effect(changes: Floats) -> Effect:
    """Of (T, P) elementary effects at P places."""
    changes = changes[np.isfinite(changes).all(axis=1)]
    used = len(changes)
    if used < 2:
        return Effect(Bounded(np.nan, np.nan, np.nan), np.nan, used)
    sizes = np.sqrt(np.mean(changes**2, axis=1))
    error = float(sizes.std(ddof=1)) / used**0.5
    reach = float(student.ppf(0.5 + CONFIDENCE / 2, used - 1)) * error
    size = float(sizes.mean())
    spread = float(np.sqrt(np.mean(changes.var(axis=0, ddof=1))))
    return Effect(Bounded(size, size - reach, size + reach), spread, used)
