"""What verify says of the spread's tables: small for the water's own, large for another's."""

from dataclasses import replace
from functools import cache

from sim.render.spreads import make_spread
from sim.scene.matter import Water
from sim.water import Optics, water_optics
from sim.water.spread import Spread
from tests.validation.light.water import plane_missed, power_missed

PHOTONS = 2**18
WATER = replace(water_optics(Water(kind="harbor"), 650.0), absorption_per_mm=0.0)


@cache
def made(asymmetry: float) -> tuple[Optics, Spread]:
    """A water that absorbs nothing, of one lobe."""
    lobe = water_optics(Water(phase="henyey-greenstein", asymmetry=asymmetry), 650.0).particles
    water = replace(WATER, particles=lobe)
    return water, make_spread(water, PHOTONS, seed=1)


def test_the_waters_own_tables_miss_no_more_than_the_photons_number_explains() -> None:
    """Power: a photon's share of 1 has the error 1 / 512 at most, three times that.  Planes: both
    sides have the error that is told, and the fit has a quarter of the photons: 1 + 4 parts of
    its square, where it follows every photon."""
    water, spread = made(0.9)
    assert power_missed(spread, water) < 3 / 512
    missed, error = plane_missed(spread, water, PHOTONS)
    assert missed < 5**0.5 * error + 0.005


def test_an_asymmetry_off_by_0_02_is_noticed() -> None:
    (water, spread), (_, other) = made(0.9), made(0.92)
    right, error = plane_missed(spread, water, PHOTONS)
    wrong, _ = plane_missed(other, water, PHOTONS)
    assert wrong > right + 5 * error


def test_light_that_is_left_out_is_noticed() -> None:
    """2 % of what was scattered more than once: 1 % of the power and more on 2 m."""
    water, spread = made(0.9)
    dimmer = replace(spread, multiple=spread.multiple - [0.02, 0.0])
    assert power_missed(dimmer, water) > 0.01
