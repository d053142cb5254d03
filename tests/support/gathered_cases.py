"""What tests of gathered light share: a water, a camera's chart, a beam that ends on a plane."""

from functools import cache

import numpy as np

from lscan.records import Floats
from sim.render.firstorder import HeadRays
from sim.render.gathered.halo import Chart, make_chart
from sim.render.spreads import spread_of
from sim.render.tank import Tank
from sim.scene import load_scene
from sim.scene.matter import Water
from sim.water import water_optics
from sim.water.spread import Spread
from tests.validation.light.gallery import shrunk

TIMES = 4  # pictures of 160 by 120 px
WATER = water_optics(Water(kind="harbor"), 650.0)


@cache
def spread() -> Spread:
    """Of WATER."""
    return spread_of(WATER)


@cache
def small_view() -> tuple[HeadRays, Chart]:
    """The rays and the chart of the paper's camera, in a small picture."""
    tank = Tank(shrunk(load_scene("paper/sandwave"), TIMES))
    assert tank._sparse is not None
    tank._sparse.look(tank.scene.tank.head)
    rays = tank._sparse.rays
    return rays, make_chart(rays, tank.scene.tank.head)


def beside_a_beam(theta: Floats, chi: Floats, distance: float, cosine: float) -> Floats:
    """What planes in WATER receive of a beam of unit power that ends on them, 1/mm2.

    Shapes broadcast.

    Parameters
    ----------
    theta : array, rad, between the beam and the way to the place
    chi : array, rad, of the plane's tilt: 0 where its normal leans away from the beam
    distance : float, mm, of the place from the beam's origin
    cosine : float, of the tilt
    """
    theta, chi = np.broadcast_arrays(theta, chi)
    aside = np.sqrt(1 - cosine**2) * np.cos(chi)
    towards = cosine * np.cos(theta) + aside * np.sin(theta)
    end = distance * np.where(towards > 0, cosine / np.maximum(towards, 1e-2), 100.0)
    c = WATER.extinction_per_mm
    angles = (np.full_like(theta, value) for value in (c * distance, cosine))
    return np.asarray(c**2 * spread().irradiance(theta, *angles, aside, c * end))
