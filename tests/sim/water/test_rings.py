"""Curves through counts: they follow the light that the counts were drawn from."""

import numpy as np
import pytest

from lscan.records import Floats
from sim.water.spread import RINGS, Crossings, fit_rings, ring_edges, solid_angles

PHOTONS = 4_000_000
ANGLES = np.geomspace(1e-4, 2.5, 60)


def light(angle: Floats) -> Floats:
    """A spread beam's kind of curve, 1/sr: flat near the axis, falling as angle^-3 beyond."""
    return 3.0 / (1 + (angle / 0.02) ** 2) ** 1.5


def counted(seed: int) -> Crossings:
    """Photons of weight 0.5 in two spheres; their tangential part is 0.3 of the angle."""
    random = np.random.default_rng(seed)
    edges = ring_edges()
    angle = np.sqrt((edges[1:] ** 2 + edges[:-1] ** 2) / 2)
    numbers = random.poisson(light(angle) * solid_angles() * PHOTONS / 0.5, (2, 2, RINGS))
    weight = 0.5 * numbers
    slope = 0.3 * angle + random.normal(0, 0.2, weight.shape) / np.sqrt(np.maximum(numbers, 1))
    return Crossings(PHOTONS, np.array([1.0, 2.0]), weight, 0.5 * weight, slope * weight)


def test_curves_agree_with_the_light_within_their_errors() -> None:
    """Over 20 draws the mean square of z is 1 within its own spread: 60 angles on a spline of
    18 coefficients where photons fall are about 18 independent numbers a draw; 18 x 40 draws
    leave sqrt(2 / 720) = 5 %.  The prior makes errors smaller than stated near the axis."""
    scores, slopes = [], []
    for seed in range(20):
        fit = fit_rings(counted(seed), ANGLES)
        scores.append((fit.log_value - np.log(light(ANGLES))) / fit.log_error)
        slopes.append((fit.ratio - 0.3 * ANGLES) / fit.ratio_error)
    many = ANGLES > 2e-3
    assert np.mean(np.square(scores)[..., many]) == pytest.approx(1, abs=0.2)
    assert np.mean(np.square(slopes)[..., many]) == pytest.approx(1, abs=0.2)
    assert np.mean(np.square(scores)[..., ~many]) < 1.5


def test_errors_are_small_where_many_photons_fall() -> None:
    """A knot's ring about the peak's edge has 4e6 x 0.4 x 0.02^2 pi / 0.5 = 4e3 photons or more:
    1.6 %, and a spline is known to about the error of one knot's count."""
    fit = fit_rings(counted(0), ANGLES)
    assert fit.log_error[:, (ANGLES > 0.01) & (ANGLES < 0.1)].max() < 0.016


def test_spheres_that_no_photon_reached_hold_hardly_any_light() -> None:
    empty = np.zeros((2, 2, RINGS))
    fit = fit_rings(Crossings(1000, np.array([1.0, 2.0]), empty, empty, empty), ANGLES)
    assert np.all(np.isfinite(fit.log_value))
    assert np.all(np.isfinite(fit.ratio))
    power = np.exp(fit.log_value[0]) * np.gradient(-np.cos(ANGLES)) * 2 * np.pi
    assert power.sum() < 1e-3
