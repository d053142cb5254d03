"""Photons in endless water: conserved, scattered once as quadrature says, spread as theory says."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2, norm

from lscan.records import Floats
from sim.render.spreads import TILTS, first_crossings, plane_crossings
from sim.scene.matter import Water
from sim.water import water_optics
from sim.water.spread import (
    RINGS,
    Crossings,
    Spread,
    once_scattered,
    ring_edges,
    solid_angles,
    tabulate,
)
from tests.validation.light.water import on_planes

DEPTHS = np.geomspace(0.1, 3.0, 10)
PHOTONS = 2**18
EDGES = ring_edges()
MIDDLES = np.sqrt((EDGES[1:] ** 2 + EDGES[:-1] ** 2) / 2)
GROUP = 8  # rings of one count


@cache
def lobe(asymmetry: float):
    water = Water(particle_scattering_per_m=1.0, phase="henyey-greenstein", asymmetry=asymmetry)
    return water_optics(water, 650.0).phase


def narrow(angle: Floats) -> Floats:
    """A Gaussian lobe of NARROW rad a plane; not 0 where a table takes its logarithm."""
    return np.maximum(np.exp(-0.5 * (angle / NARROW) ** 2) / (2 * np.pi * NARROW**2), 1e-30)


NARROW = 0.02


@cache
def counted(asymmetry: float, albedo: float) -> Crossings:
    return first_crossings(lobe(asymmetry), albedo, DEPTHS, PHOTONS, seed=5)


@cache
def tables(phase, albedo: float, seed: int) -> Spread:
    """The tables from few photons."""
    spheres = first_crossings(phase, albedo, DEPTHS, PHOTONS, seed)
    flat = plane_crossings(phase, albedo, DEPTHS, TILTS, 4 * PHOTONS, seed)
    return tabulate(phase, albedo, spheres, flat)


def surprise(crossings: Crossings, asymmetry: float, albedo: float) -> float:
    """How likely counts of light scattered once are as far from quadrature as these."""
    once = once_scattered(lobe(asymmetry), albedo, DEPTHS[-1])
    theta, depth = np.meshgrid(MIDDLES, DEPTHS)
    light = once.vector_irradiance(theta, depth, depth).real * depth**2 * solid_angles()
    groups = np.arange(0, RINGS, GROUP)
    expected, found, variance = (
        np.add.reduceat(sums, groups, axis=1)
        for sums in (light * crossings.photons, crossings.weight[0], crossings.squared[0])
    )
    enough = variance > 30  # of a Gaussian's kind
    squares = (found - expected)[enough] ** 2 / variance[enough]
    return float(chi2.sf(squares.sum(), enough.sum()))


def test_without_absorption_every_photon_crosses_every_sphere_once() -> None:
    """All but the e^-depth that were never scattered, a binomial number."""
    crossings = counted(0.9, 1.0)
    assert crossings.photons == PHOTONS
    missing = 1 - crossings.weight.sum(axis=(0, 2)) / PHOTONS
    spread = np.sqrt(np.exp(-DEPTHS) * (1 - np.exp(-DEPTHS)) / PHOTONS)
    assert np.all(np.abs(missing - np.exp(-DEPTHS)) < norm.isf(1e-4) * spread)
    assert np.array_equal(crossings.weight, crossings.squared)


@pytest.mark.parametrize("albedo", [1.0, 0.6])
def test_light_scattered_once_is_that_of_quadrature(albedo: float) -> None:
    crossings = counted(0.9, albedo)
    assert surprise(crossings, 0.9, albedo) > 1e-3


def test_another_asymmetry_or_albedo_is_noticed() -> None:
    crossings = counted(0.9, 0.6)
    assert surprise(crossings, 0.92, 0.6) < 1e-9
    assert surprise(crossings, 0.9, 0.65) < 1e-9


def test_other_seeds_give_other_photons() -> None:
    one, again, other = (
        first_crossings(lobe(0.9), 0.6, DEPTHS, 2**12, seed).weight for seed in (1, 1, 2)
    )
    assert one == pytest.approx(again, rel=1e-12)  # sums in another order
    assert not np.allclose(one, other)


def test_progress_counts_batches() -> None:
    seen: list[tuple[int, int]] = []
    first_crossings(lobe(0.9), 0.6, DEPTHS, 100, 1, lambda done, every: seen.append((done, every)))
    assert seen == [(1, 1)]


def test_a_narrow_lobe_spreads_as_small_angle_theory_says() -> None:
    """Fermi and Eyges: in each of two planes, after many turns of variance s2 over the depth t,
    <x2> = s2 t3 / 3 and <x psi> = s2 t2 / 2, so on a sphere <theta2> = 2 s2 t / 3 and
    <theta (psi - theta)> is half of that.

    The photons' own error: theta2 varies by less than 3 times its mean from photon to photon, 2
    of them in three scattered, so 3 / sqrt(1.7e5) = 0.7 %, four times that is allowed; angles are
    sines to s2 t = 1e-3.
    """
    spread = tables(narrow, 1.0, seed=7)
    for depth in (1.0, 3.0):
        radial, tangential = spread.vector_irradiance(MIDDLES, depth, depth)
        power = depth**2 * solid_angles()
        expected = 2 / 3 * NARROW**2 * depth
        assert np.sum(radial * power * MIDDLES**2) == pytest.approx(expected, rel=0.03)
        assert np.sum(tangential * power * MIDDLES) == pytest.approx(expected / 2, rel=0.03)


@pytest.mark.parametrize("depth", [0.15, 0.7, 2.0])
def test_a_table_without_absorption_holds_all_scattered_power(depth: float) -> None:
    """1 - e^-depth on any sphere: the quadrature and the curves through the counts together.

    The counts' binomial error is 0.1 % of 1; the rest is interpolation, 1e-3 of the light.
    """
    spread = tables(lobe(0.9), 1.0, seed=5)
    radial, _ = spread.vector_irradiance(MIDDLES, depth, depth)
    power = np.sum(radial * depth**2 * solid_angles())
    scattered = 1 - np.exp(-depth)
    assert power == pytest.approx(scattered, abs=4e-3 * scattered + 1e-3)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, 48.0])
def test_planes_receive_what_photons_bring_there(tilt_deg: float) -> None:
    """Planes of tilts between those of the fit, other photons: three rings, far and near side.

    A ring has 1e4 photons or more here, and as many in the fit: 1.5 % together; 4 % is
    allowed.  Without what the horizon hides, the far side of a steep plane is too dark by a
    sixth or more.
    """
    tilt, distances = np.radians(tilt_deg), np.array([0.6, 1.0])
    counts = plane_crossings(lobe(0.9), 1.0, distances, np.array([tilt]), 2**20, seed=11)
    found = counts.weight[0] / counts.photons
    spread = tables(lobe(0.9), 1.0, seed=5)
    plain = replace(spread, horizon=0 * spread.horizon)
    ratios = []
    for table in (spread, plain):
        expected = on_planes(table, tilt, distances)
        groups = np.where(np.isnan(expected), 0, [expected, found]).reshape(2, 2, 3, 8, 2, 4)
        ratios.append(np.divide(*groups.sum(axis=(3, 5))))
    assert ratios[0] == pytest.approx(1, abs=0.04)
    if tilt_deg > 40:
        assert ratios[1][:, 2, 0].max() < 0.85
