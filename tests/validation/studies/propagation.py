"""Small causes, to whose first order the law of propagation holds: a budget against that law."""

from typing import Any

import numpy as np
from scipy.special import ndtr

from lscan.config.documents import Document
from lscan.records import Floats
from sim.studies.problem import AFTER, ALL, columns, make_design
from sim.studies.rig.evaluation import GeometricRig
from tests.validation.rows import Row, row
from tests.validation.studies.twelve import CAUSES, assumed, scan_places, twelve

BASE = 512  # rows: of the sum of squares of 8 normal numbers the 16 sets leave 0.5 % rms
SMALLER = 0.01
SEED = 15
HEIGHT = "height"


def propagation_rows(base: int = BASE, plane_map: str = "refractive") -> list[Row]:
    """How far the standard deviation of the height is off the law of propagation, in per cent.

    Before and after recalibrating, of causes a hundredth of those of ``twelve.CAUSES`` that are
    drawn once for each rig.

    Parameters
    ----------
    base : int, rigs, a multiple of SETS
    plane_map : str, name of the rig's map
    """
    study = twelve(plane_map, small_causes())
    rig = GeometricRig(study, assumed(study, scan_places()))
    rigs = make_design(rig.causes, base, 0, SEED).blocks[ALL]
    values = np.array([rig.evaluate(one) for one in rigs])
    law = propagated_variance(rig)
    rows = []
    for name in (HEIGHT, HEIGHT + AFTER):
        part = columns(rig.outputs)[name]
        found, expected = (
            float(np.sqrt(of[part].mean())) for of in (values.var(axis=0, ddof=1), law)
        )
        words: dict[str, Any] = {"name": name, "causes": len(rig.causes), "base": base}
        words["expected"] = 1000 * expected
        rows.append(row("study-propagation", 100 * abs(found / expected - 1), seed=SEED, **words))
    return rows


def small_causes() -> Document:
    """The causes of ``twelve.CAUSES`` that are drawn once a rig, a hundredth as large."""
    return {
        name: _smaller(cause)
        for name, cause in CAUSES.items()
        if {"normal", "uniform"} & {*cause} and cause["when"] != "each-frame"
    }


def _smaller(cause: dict[str, Any]) -> dict[str, Any]:
    if "normal" in cause:
        mean, sigma = cause["normal"]
        return {**cause, "normal": [mean, SMALLER * sigma]}
    return {**cause, "uniform": [SMALLER * end for end in cause["uniform"]]}


def propagated_variance(rig: GeometricRig) -> Floats:
    """(K,) variances of all errors by the law of propagation, derived by central differences.

    A cause is moved by its standard deviation to either side of its mean, so that half the
    difference is what it contributes.

    Parameters
    ----------
    rig : GeometricRig, all its causes normal or uniform, and independent

    References
    ----------
    JCGM 100:2008, eq. (10).
    """
    total: Floats = np.zeros(sum(output.size for output in rig.outputs))
    for k, cause in enumerate(rig.study.file.cause.values()):
        away = float(ndtr(1.0)) - 0.5 if cause.normal is not None else 1 / np.sqrt(12)
        ends = np.full((2, len(rig.causes)), 0.5)
        ends[:, k] += [away, -away]
        after, before = (rig.evaluate(end) for end in ends)
        total += ((after - before) / 2) ** 2
    return total
