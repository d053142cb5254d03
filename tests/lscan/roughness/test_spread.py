"""The spread of ripples: none of a single wave, that of its spectrum where there is one."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import example, given, strategies as st
from rough_patches import drawn, holes, patch, wave, whole

from lscan.roughness import Patch, PowerLaw, find_ripples, fit_waves, ripple_spread
from sim.meshes.parts import random_fields

SHAPE, CELL_CM, WAVES = (64, 64), 0.5, 12  # 5 cells a wave
SIZE = 2 * np.pi * WAVES / (SHAPE[0] * CELL_CM)


def _peak(heading_deg, along, across_deg):
    """A spectrum of ripples: normal about their wavenumber, and about its opposite."""
    way = np.radians(heading_deg)

    def density(y, x):
        parts = []
        for sign in (1, -1):
            ahead = sign * (y * np.sin(way) + x * np.cos(way)) / SIZE - 1
            aside = (x * np.sin(way) - y * np.cos(way)) / SIZE
            parts.append(
                np.exp(-((ahead / along) ** 2 + (aside / np.radians(across_deg)) ** 2) / 2)
            )
        return sum(parts) + 1e-4 * np.maximum(np.hypot(y, x) / SIZE, 0.05) ** -3.0

    return density


def _found(z_cm, heading_deg, seen=None):
    way = np.radians(heading_deg)
    cells = patch(z_cm, seen, CELL_CM)
    return ripple_spread(cells, fit_waves(cells, SIZE * np.array([np.sin(way), np.cos(way)])))


@examples(10)
@example(heading=118.0, missing=0.1, seed=0)  # found by make soak
@example(heading=0.0, missing=0.1, seed=0)
@given(heading=st.floats(0, 179), missing=st.sampled_from([0.0, 0.1]), seed=st.integers(0, 99))
def test_a_single_wave_has_none(heading, missing, seed):
    """On white noise a hundredth of its amplitude: 1e-4 of its power, over an ellipse whose second
    moments are 0.5² / 4 and 0.7² / 4, and in it as many values as 0.35 pi WAVES², 158.

    Holes scatter as much of the wave over the ellipse as there are, 0.1.  That is taken off; what
    is left is its product with the noise, of random sign: 2 sqrt(0.1 * 1e-4) / sqrt(158) of the
    power, which is a spread of 0.006 along the heading and 0.008 across it.
    """
    rng = np.random.default_rng(seed)
    z = wave(SHAPE, CELL_CM, WAVES, heading, 1.0) + 0.01 * rng.standard_normal(SHAPE)
    found = _found(z, heading, holes(SHAPE, missing, seed) if missing else None)
    assert found.relative < 0.01
    assert found.heading_deg < np.degrees(0.01)


@pytest.mark.parametrize(
    ("along", "across_deg"),
    [(0.08, 4.0), *(pytest.param(*s, marks=pytest.mark.slow) for s in ((0.12, 8.0), (0.05, 10.0)))],
)
def test_the_spread_is_that_of_the_spectrum(along, across_deg):
    """The mean of 8 fields.

    A field of 12 waves has 12 independent values along each axis for each wavenumber: a peak of a
    standard deviation s holds about 4 pi (12 s)(12 s') of them, 13 at least, whose variances are
    known to sqrt(2 / 13) of themselves, deviations to half of that; an eighth's root of it is
    7 %, of which three are allowed for.
    """
    heading = 30.0
    found = []
    for seed in range(4):
        rng = np.random.default_rng([5, seed])
        density = _peak(heading, along, across_deg)
        for z in random_fields(density, SHAPE, (CELL_CM, CELL_CM), 2, rng):
            spread = _found(z, heading)
            found.append([spread.relative, np.radians(spread.heading_deg)])
    mean = np.sqrt((np.array(found) ** 2).mean(axis=0))
    np.testing.assert_allclose(mean, [along, np.radians(across_deg)], rtol=0.21)


@pytest.mark.parametrize("cells", [8.0, 10.0, 10.07, 12.5])
def test_waves_of_whole_cells_are_as_high_as_they_are(cells: float) -> None:
    """Their tenth harmonic is at the cells a plane, the ninth the wave: 15 cm came out for 0.6.

    The patch holds few of them: what leaks from a wave is no wave of twice its length.
    """
    _, x = np.mgrid[:32, :40] * 0.2
    rng = np.random.default_rng(int(100 * cells))
    z = 0.3 * np.cos(2 * np.pi * x / (0.2 * cells) + 0.4) + 0.01 * rng.normal(size=x.shape)
    train = find_ripples(Patch(z, np.full(x.shape, True), 0.2))
    assert train is not None and train.wavelength_cm == pytest.approx(0.2 * cells, rel=0.01)
    # Between cells a crest is missed by as much as a cosine falls within half a cell.
    missed = 0.6 * (1 - np.cos(np.pi / cells))
    assert abs(train.height_cm - 0.6) < 4 * train.sigma_height_cm + missed
    assert train.sigma_height_cm < 0.01


@pytest.mark.parametrize("seed", [1, 2])
def test_a_wave_is_found_whose_harmonic_stands_out_more(seed: int) -> None:
    """Of crests so sharp that the third harmonic has half the amplitude, over a law of K^-3.5."""
    shape, turn = (64, 64), np.radians(20.0)
    z, _ = drawn(PowerLaw(3.5, 2e-5), shape, 0.2, seed)
    y, x = np.mgrid[: shape[0], : shape[1]] * 0.2
    phase = 2 * np.pi / 2.1 * (np.sin(turn) * y + np.cos(turn) * x)
    train = find_ripples(whole(z + 0.05 * (np.cos(phase) + 0.5 * np.cos(3 * phase)), 0.2))
    assert train is not None
    assert train.wavelength_cm == pytest.approx(2.1, rel=0.01)
