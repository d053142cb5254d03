"""The camera's kernel: sums of Gaussians against the light that they stand for."""

from dataclasses import dataclass
from typing import cast

import numpy as np
import pytest
from gathered_cases import WATER, beside_a_beam, spread

from lscan.records import Floats
from sim.render.gathered.halo import COSINE_AXIS, RANGE_AXIS, ScatterKernel, scatter_kernel
from sim.water.spread import Spread

PIXEL_RAD = 1e-3
# A sum whose Gaussians' widths double repeats a power law to 0.2 %, but at its ends, where it is
# fitted as far as it goes and 1 to 2 % off, and between what the tables' noise makes of one ring
# and of the next, 1 to 2 %.
WITHIN_2, WITHIN_5 = 0.03, 0.04  # of the light within 0.2 and 0.5 rad
ANGLES = np.geomspace(PIXEL_RAD, 0.5, 60)
AZIMUTHS = (np.arange(32) + 0.5) * np.pi / 32


@dataclass(frozen=True)
class PowerLaw:
    """Light that falls with a power of the angle, and by absorption."""

    power: float

    def irradiance(
        self, theta: Floats, depth: Floats, cosine: Floats, _aside: Floats, _end: Floats
    ) -> Floats:
        return theta**-self.power * cosine * np.exp(-0.3 * depth)


def summed(kernel: ScatterKernel, row: int, column: int) -> tuple[Floats, Floats]:
    """What goes with the cosine of no and of one azimuth, (Q,) each at ANGLES."""
    x = ANGLES[:, np.newaxis] / kernel.sigmas
    bell = np.exp(-0.5 * x**2)
    weights = kernel.weights[row, column]
    return bell @ weights[:, 0], (x * bell) @ weights[:, 1]


@pytest.mark.parametrize("power", [1.0, 1.5, 2.0, 2.5])
def test_a_power_law_is_a_sum_of_gaussians(power: float) -> None:
    """And goes with its own power of a change of scale, as does each Gaussian's weight."""
    kernel = scatter_kernel(cast(Spread, PowerLaw(power)), 1e-3, PIXEL_RAD / 16)
    light, _ = summed(kernel, 5, 4)
    distance, cosine = RANGE_AXIS.nodes()[5], COSINE_AXIS.nodes()[4]
    ratio = light / (1e-6 * ANGLES**-power * cosine * np.exp(-0.3e-3 * distance))
    assert np.abs(ratio - 1)[ANGLES < 0.1].max() < 0.02
    assert np.abs(ratio - 1).max() < WITHIN_5
    np.testing.assert_allclose(kernel.steepness, -power, atol=1e-3)


@pytest.fixture(scope="module")
def kernel() -> ScatterKernel:
    return scatter_kernel(spread(), WATER.extinction_per_mm, PIXEL_RAD / 16)


@pytest.mark.parametrize(("row", "column"), [(5, 7), (9, 7), (5, 5), (9, 5), (7, 3)])
def test_gaussians_are_the_waters_light(kernel: ScatterKernel, row: int, column: int) -> None:
    """Its mean over the azimuths of the tilt, and what goes with their cosine."""
    distance, cosine = RANGE_AXIS.nodes()[row], COSINE_AXIS.nodes()[column]
    light = beside_a_beam(ANGLES[:, np.newaxis], AZIMUTHS, distance, cosine)
    mean, first = light.mean(axis=1), 2 * (light * np.cos(AZIMUTHS)).mean(axis=1)
    for found, expected in zip(summed(kernel, row, column), (mean, first), strict=True):
        off = np.abs(found - expected) / mean
        assert off[ANGLES < 0.2].max() < WITHIN_2
        assert off.max() < WITHIN_5
