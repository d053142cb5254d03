"""Roughness: how often the 95 % intervals of a law and of its rings hold, whatever is missing."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.stats import binomtest

from lscan.errors import MeasurementError
from lscan.records import Floats, Mask
from lscan.roughness import (
    Patch,
    PowerLaw,
    PowerLawFit,
    ScannerResponse,
    find_ripples,
    fit_power_law,
)
from tests.validation.roughness.fields import (
    CELL_CM,
    DB_PER_LN,
    STRENGTH_CM4,
    Density,
    holes,
    sampled_fields,
)
from tests.validation.rows import Row, row

SEED = 58
RESPONSES: Mapping[str, ScannerResponse] = {
    "sampled pointwise": ScannerResponse(),
    "by sheet and pixel": ScannerResponse(sheet_cm=0.025, blur_cm=0.02, pixel_cm=0.04),
}
MISSING = "nothing", "15 % single cells", "a mix", "one square", "one profile"
WAYS = np.linspace(0.0, np.pi, 90, endpoint=False)  # that a ring's true mean is found over


@dataclass(frozen=True)
class LawEffort:
    """fields: of each exponent, response and kind of hole, an even number; side: of theirs, cells;
    simulated: patches that intervals come from.  exponents: of the laws."""

    fields: int = 100
    side: int = 64
    simulated: int = 400
    exponents: tuple[float, ...] = (2.5, 3.0, 3.3, 3.8)


FULL = LawEffort()
QUICK = LawEffort(fields=2, side=32, simulated=40, exponents=(2.5, 3.8))


def rough_rows(quick: bool, told: str) -> list[Row]:
    """Coverage by what is missing, and false alarms, of surfaces that follow a power law.

    Parameters
    ----------
    quick : bool, two fields of each in place of 100
    told : str, which of RESPONSES the surfaces are seen by
    """
    effort, response, rows = QUICK if quick else FULL, RESPONSES[told], list[Row]()
    unlike, trains, fields = 0, 0, 0
    for missing in MISSING:
        held = {"exponent": list[bool](), "strength": list[bool](), "rings": list[bool]()}
        for law, patch in _patches(effort, missing, response):
            fit = fit_power_law(patch, response=response, simulated=effort.simulated)
            for name, each in _held(law, fit, response).items():
                held[name] += each
            unlike += fit.lack > 1
            trains += find_ripples(patch, response=response) is not None
            fields += 1
        for name, every in held.items():
            low, high = binomtest(sum(every), len(every)).proportion_ci(method="wilson")
            percent = 100 * sum(every) / len(every)
            rows.append(row(
                "intervals-roughness", abs(percent - 95), seed=SEED, name=name, response=told,
                missing=missing, percent=percent, low=100 * low, high=100 * high,
                count=len(every), fields=effort.fields, side=effort.side,
                exponents=", ".join(map(str, effort.exponents)),
            ))  # fmt: skip
    for name, count in (("a lack of fit", unlike), ("ripples", trains)):
        rows.append(row("intervals-roughness-false", 100 * count / fields, seed=SEED, name=name,
                        response=told, count=count, fields=fields))  # fmt: skip
    return rows


def lawless_rows(quick: bool) -> list[Row]:
    """How many of the surfaces that follow no power law are refused or said to lack a fit.

    Parameters
    ----------
    quick : bool, two fields of each in place of 100
    """
    effort = QUICK if quick else FULL
    return [_unlike_row(name, density, effort) for name, density in LAWLESS.items()]


def _patches(
    effort: LawEffort, missing: str, response: ScannerResponse
) -> Iterator[tuple[PowerLaw, Patch]]:
    shape = effort.side, effort.side
    for exponent, gamma2 in enumerate(effort.exponents):
        law = PowerLaw(gamma2, STRENGTH_CM4)
        for number in range(0, effort.fields, 2):
            generator = np.random.default_rng([SEED, MISSING.index(missing), exponent, number])
            for z in sampled_fields(partial(_passed, law, response), shape, generator):
                seen = _seen(missing, shape, generator)
                yield law, Patch(np.where(seen, z, np.nan), seen, CELL_CM)


def _passed(law: PowerLaw, response: ScannerResponse, y: Floats, x: Floats) -> Floats:
    return law.density(y, x) * response(y, x)


def _seen(missing: str, shape: tuple[int, int], generator: np.random.Generator) -> Mask:
    if missing == "a mix":
        return holes(shape, 0.1, generator)
    seen = np.ones(shape, dtype=bool)
    if missing == "15 % single cells":
        seen = generator.random(shape) > 0.15
    elif missing == "one profile":
        seen[generator.integers(2, shape[0] - 2)] = False
    elif missing == "one square":
        side = shape[0] // 4
        y, x = generator.integers(0, shape[0] - side, 2)
        seen[y : y + side, x : x + side] = False
    return seen


def _held(law: PowerLaw, fit: PowerLawFit, response: ScannerResponse) -> dict[str, list[bool]]:
    off_db = DB_PER_LN * np.log(fit.law.w2_cm4 / law.w2_cm4)
    rings = fit.rings
    size = rings.wavenumber_per_cm[:, np.newaxis]
    true = _passed(law, response, size * np.sin(WAYS), size * np.cos(WAYS)).mean(axis=1)
    stated = np.isfinite(rings.low_cm4)
    inside = (rings.low_cm4 <= true) & (true <= rings.high_cm4)
    return {
        "exponent": [bool(abs(fit.law.gamma2 - law.gamma2) <= fit.within * fit.sigma_gamma2)],
        "strength": [bool(abs(off_db) <= fit.within * fit.sigma_w2_db)],
        "rings": inside[stated].tolist(),
    }


def _bent(y: Floats, x: Floats) -> Floats:
    """A roughness that ends at waves of 12 mm: flat above, steep below."""
    return STRENGTH_CM4 * (5.0**2 + y**2 + x**2) ** -1.9


def _smooth(y: Floats, x: Floats) -> Floats:
    """Of a Gaussian autocovariance, with a little noise."""
    return 1e-3 * np.exp(-(y**2 + x**2) * 0.3**2 / 4) + 1e-7


LAWLESS: Mapping[str, Density] = {
    "bent at 12 mm": _bent,
    "of a Gaussian autocovariance": _smooth,
    "twice as rough along one axis, fitted as alike": PowerLaw(3.0, 0.004, (0.7, 0.0)).density,
}


def _unlike_row(name: str, density: Density, effort: LawEffort) -> Row:
    """How many of the fields are refused or said to lack a fit."""
    # Of fewer cells the band begins beyond the bend.
    count, shape = 0, (FULL.side, FULL.side)
    for number in range(0, effort.fields, 2):
        generator = np.random.default_rng([SEED, 9, number])
        for z in sampled_fields(density, shape, generator):
            patch = Patch(z, np.ones(shape, dtype=bool), CELL_CM)
            try:
                count += fit_power_law(patch, simulated=effort.simulated).lack > 1
            except MeasurementError:
                count += 1
    return row("intervals-roughness-unlike", 100 * count / effort.fields, seed=SEED, name=name,
               count=count, fields=effort.fields, side=FULL.side)  # fmt: skip
