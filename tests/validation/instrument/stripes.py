"""The best extractor against the Cramér-Rao bound, over all widths and noises asked for."""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np

from lscan.benchmark.drawn import LineCase, centres, draw
from lscan.benchmark.methods import bound_px
from lscan.config.rig import NoiseSection, StripeSection
from lscan.records import has_value
from lscan.stripe import extract_stripe
from tests.validation.instrument.effort import AccuracyEffort
from tests.validation.rows import Row, row

WIDTHS_PX = (0.8, 1.2, 2.0, 3.0)
PEAK_TO_NOISE = (10.0, 30.0, 100.0, 200.0)
PEAK_DN = 200.0
THRESHOLD_DN = 80.0  # four standard deviations of the worst noise
READ_DN = 0.5  # beside shot noise; rounding alone is 0.29
SEED = 41
PHASES = 8  # bins of the sub-pixel place in which the bias is taken


@dataclass(frozen=True)
class ExtractorFigures:
    """One kind of noise and width: scatter over the bound, and the largest bias of a phase."""

    name: str
    ratio: float
    bias_px: float


def bound_rows(scenes: Path, effort: AccuracyEffort) -> list[Row]:
    """Worst scatter of the best groove's extractor against the bound, worst bias at any phase.

    A hundred drawings of each line give the bias of a phase to 0.003 px.
    """
    extractor = effort.best(scenes, "groove").rig.stripe.extractor
    cells = [cell(extractor, case, name, effort.drawings) for name, case in cases()]
    far, off = max(cells, key=lambda c: c.ratio), max(cells, key=lambda c: c.bias_px)
    return [
        row("extractor-scatter", far.ratio, seed=SEED, extractor=extractor, case=far.name),
        row("extractor-bias", off.bias_px, seed=SEED, extractor=extractor, case=off.name),
    ]


def cases() -> Iterator[tuple[str, LineCase]]:
    """Every width and peak over noise, additive noise and shot noise apart."""
    for width, ratio in product(WIDTHS_PX, PEAK_TO_NOISE):
        additive = NoiseSection(read_dn=PEAK_DN / ratio)
        shot = NoiseSection(read_dn=READ_DN, dn_per_electron=PEAK_DN / ratio**2)
        for kind, noise in (("additive", additive), ("shot", shot)):
            yield f"{kind} {ratio:g}, {width:g} px", LineCase("tap", width, PEAK_DN, noise)


def cell(extractor: str, case: LineCase, name: str, drawings: int) -> ExtractorFigures:
    """Scatter and bias of one case's drawings; a column without a value is infinitely wrong."""
    generator = np.random.default_rng([SEED, round(10 * case.sigma_px)])
    settings = StripeSection(extractor=extractor, threshold_dn=THRESHOLD_DN, noise=case.noise)
    errors, phases = [], []
    for _ in range(drawings):
        true = centres(generator.random())
        stripe = extract_stripe(draw(case, true, generator), settings)
        found = has_value(stripe.status)
        errors.append(np.where(found, stripe.centre_px - true, np.inf))
        phases.append(true % 1)
    error, phase = np.concatenate(errors), np.concatenate(phases)
    if not np.isfinite(error).all():
        return ExtractorFigures(name, float("inf"), float("inf"))
    bins = np.minimum((phase * PHASES).astype(int), PHASES - 1)
    means = np.bincount(bins, error, PHASES) / np.bincount(bins, minlength=PHASES)
    return ExtractorFigures(name, float(error.std()) / bound_px(case), float(np.abs(means).max()))
