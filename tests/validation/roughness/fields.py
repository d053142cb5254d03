"""Random fields of a known power law, with holes: bias of the fit, and how often intervals hold."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import binomtest

from lscan.records import Floats, Mask
from lscan.roughness import Patch, PowerLaw, PowerLawFit, find_ripples, fit_power_law
from sim.meshes.parts import random_fields, ripple_heights
from sim.scene.matter import Ripples
from tests.validation.rows import Row, row

# How much of the roughness table's work is done: all of it, or a quick look at every row.


@dataclass(frozen=True)
class RoughnessEffort:
    """What a run of the roughness table measures; by default all of it.

    fields : of random fields whose power law is fitted.  side : of theirs, cells.
    simulated : patches that intervals come from.  trains : of ripples.  frames : of the block's
    scan, ``step_mm`` apart.
    plain : rendered with few samples, in the first order of light.
    """

    fields: int = 200
    side: int = 128
    simulated: int = 400
    trains: int = 40
    frames: int = 240
    step_mm: float = 0.5
    plain: bool = False


FULL = RoughnessEffort()
QUICK = RoughnessEffort(
    fields=4, side=48, simulated=40, trains=2, frames=60, step_mm=2.0, plain=True
)


# Random fields of a known power law, with holes: bias of the fit, and how often intervals hold.


Density = Callable[[Floats, Floats], Floats]
CELL_CM = 0.1
EXPONENTS = 2.4, 3.9
STRENGTH_CM4 = 0.004
HOLES = 0.1
PADDING = 4  # of the fields: they hold waves four times as long as they are
FINER = 8  # a seabed's law goes on beyond the grid: what is sampled from is drawn so much finer
FINE_PADDING = 2  # of those fields, which are large
DB_PER_LN = 10 / np.log(10)
SEED = 17
RIPPLE_SIDE = 128
"""Cells a side of a patch with ripples: of a smaller one their crests would fall between cells."""
GROUND_CM4 = 2e-5  # strength of the rough ground that ripples lie on


@dataclass(frozen=True)
class FittedField:
    """A field's true exponent, and what was fitted to it."""

    gamma2: float
    fit: PowerLawFit

    @property
    def off(self) -> Floats:
        """(2,) errors of the exponent, and of 10 lg w2."""
        off_db = DB_PER_LN * np.log(self.fit.law.w2_cm4 / STRENGTH_CM4)
        return np.array([self.fit.law.gamma2 - self.gamma2, off_db])

    @property
    def holds(self) -> Mask:
        """(2,) whether the 95 % intervals hold the truth."""
        sigma = np.array([self.fit.sigma_gamma2, self.fit.sigma_w2_db])
        return np.asarray(np.abs(self.off) <= self.fit.within * sigma)


def field_rows(effort: RoughnessEffort) -> list[Row]:
    """Bias in both parameters, and coverage of their intervals.

    Parameters
    ----------
    effort : RoughnessEffort, its fields, their side, and the simulated patches
    """
    found = list(_fitted(effort))
    off = np.array([one.off for one in found])
    held = np.array([one.holds for one in found])
    rows = []
    for column, name, bar, unit in ((0, "gamma2", 0.02, ""), (1, "w2", 0.2, "dB")):
        bias = float(off[:, column].mean())
        error = float(off[:, column].std(ddof=1) / np.sqrt(len(found)))
        count = int(held[:, column].sum())
        low, high = binomtest(count, len(found)).proportion_ci(method="wilson")
        words: dict[str, Any] = {"name": name, "fields": len(found), "side": effort.side}
        percent = 100 * count / len(found)
        rows += [
            row("roughness-bias", abs(bias), bar=bar, seed=SEED, of=unit, bias=bias,
                error=error, **words),
            row("roughness-coverage", abs(percent - 95), seed=SEED, percent=percent,
                low=100 * low, high=100 * high, **words),
        ]  # fmt: skip
    return rows


def _fitted(effort: RoughnessEffort) -> Iterator[FittedField]:
    exponents = np.linspace(*EXPONENTS, effort.fields)
    shape = effort.side, effort.side
    for number in range(0, effort.fields, 2):
        for second in (0, 1):
            if number + second == effort.fields:
                return
            # Fields come in pairs of one exponent, as they are drawn.
            gamma2 = float(exponents[number])
            generator = np.random.default_rng([SEED, number])
            pair = sampled_fields(PowerLaw(gamma2, STRENGTH_CM4).density, shape, generator)
            seen = holes(shape, HOLES, generator)
            patch = Patch(np.where(seen, pair[second], 0.0), seen, CELL_CM)
            fit = fit_power_law(patch, seed=number + second, simulated=effort.simulated)
            yield FittedField(gamma2, fit)


def sampled_fields(
    density: Density, shape: tuple[int, int], generator: np.random.Generator
) -> tuple[Floats, Floats]:
    """Two independent fields of a spectrum that goes on beyond their cells, at the cells alone.

    Parameters
    ----------
    density : callable, of rad/cm along y and x: W2 in cm^4, as the instrument passes it
    shape : (R, C)
    generator : Generator
    """
    fine = FINER * shape[0], FINER * shape[1]
    step = CELL_CM / FINER
    one, other = random_fields(density, fine, (step, step), FINE_PADDING, generator)
    return one[::FINER, ::FINER], other[::FINER, ::FINER]


def ripple_rows(effort: RoughnessEffort) -> list[Row]:
    """The largest errors of wavelength, heading and height of ripples on rough ground with holes.

    Parameters
    ----------
    effort : RoughnessEffort, its trains
    """
    off, missed = [], 0
    for number in range(effort.trains):
        generator = np.random.default_rng([SEED, 1, number])
        shape = RIPPLE_SIDE, RIPPLE_SIDE
        law = PowerLaw(3.0, GROUND_CM4)
        z, _ = random_fields(law.density, shape, (CELL_CM, CELL_CM), PADDING, generator)
        true = Ripples(
            wavelength_mm=10 * RIPPLE_SIDE * CELL_CM / generator.uniform(5, 12),
            height_mm=generator.uniform(2, 6),
            heading_deg=generator.uniform(0, 180),
            crests=generator.uniform(0, 0.8),
        )
        x = np.asarray(10 * CELL_CM * np.arange(RIPPLE_SIDE), dtype=float)
        z = z + ripple_heights(true, x, x[:, np.newaxis]) / 10
        seen = holes(shape, HOLES, generator)
        found = find_ripples(Patch(np.where(seen, z, 0.0), seen, CELL_CM))
        if found is None:
            missed += 1
            continue
        turn = (found.heading_deg - true.heading_deg + 90) % 180 - 90
        longer = 1000 * found.wavelength_cm / true.wavelength_mm - 100
        higher = 1000 * found.height_cm / true.height_mm - 100
        off.append(np.abs([longer, turn, higher]))
    worst = np.max(off, axis=0) if off else np.full(3, np.nan)
    words: dict[str, Any] = {"trains": effort.trains, "missed": missed}
    return [
        row("roughness-ripples", float(worst[k]) if not missed else float("nan"), bar=bar,
            seed=SEED, name=name, of=unit, **words)
        for k, (name, bar, unit) in enumerate(
            (("wavelength", 1.0, "%"), ("heading", 1.0, "deg"), ("height", 3.0, "%"))
        )
    ]  # fmt: skip


def holes(shape: tuple[int, int], share: float, generator: np.random.Generator) -> Mask:
    """Where cells are seen: a third of the missing ones single, the rest in squares of 2 to 6.

    Parameters
    ----------
    shape : (R, C)
    share : float, of the cells that are missing
    generator : Generator
    """
    seen = generator.random(shape) > share / 3
    while seen.mean() > 1 - share:
        side = int(generator.integers(2, 7))
        row_, column = (int(generator.integers(0, count)) for count in shape)
        seen[row_ : row_ + side, column : column + side] = False
    return np.asarray(seen)
