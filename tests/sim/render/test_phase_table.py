"""The phase function's tables: values, angles drawn along lines and in directions."""

from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from water_sphere import integral

from lscan.records import Floats
from sim.render.plugins.arrays import floats
from sim.render.plugins.water import FINEST, FLAT, SCALE, PhaseTable, angle_between, approach
from sim.scene.matter import Water
from sim.water import Optics, water_optics
from sim.water.optics import TABLE_RAD

WATERS = {
    "mixture": Water(particle_scattering_per_m=0.5),
    "petzold": Water(particle_scattering_per_m=0.5, phase="petzold"),
    "fournier-forand": Water(particle_scattering_per_m=0.5, phase="fournier-forand"),
    "one lobe": Water(particle_scattering_per_m=0.5, phase="henyey-greenstein", asymmetry=0.95),
}
every_water = pytest.mark.parametrize("name", WATERS)
FEW = examples(20)
SINGLE = 2.0**-24  # half a unit in the last place of single precision
STEEPEST = 2.0  # no peak here is steeper than angle^-2


@cache
def optics(name: str) -> Optics:
    return water_optics(WATERS[name], 650.0)


@cache
def table(name: str) -> PhaseTable:
    return PhaseTable(optics(name).phase)


def doubles(values: mi.Float) -> Floats:
    return np.array(values, dtype=float)


def evenly(count: int) -> Floats:
    """The middles of ``count`` equal parts of 0 to 1: numbers without noise for a sampler."""
    return (np.arange(count) + 0.5) / count


def cell_share(angle: Floats) -> Floats:
    """A cell's width over its angle."""
    return (FINEST + angle) / (SCALE * angle)


def cumulative(values: Floats, at: Floats) -> Floats:
    """(N,) trapezoid integral from the first of (N,) places."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(at))])


def cut_off(name: str) -> float:
    """The share of scattering that is lost where an infinite peak is taken as flat."""
    phase = optics(name).phase
    top = float(phase(np.array([FLAT]))[0])
    return integral(lambda angle: phase(angle) - top, high=FLAT)


@pytest.mark.parametrize("name", ["mixture", "petzold", "fournier-forand", "one lobe"])
def test_the_value_is_the_waters(name: str) -> None:
    """Required to 1e-4.  Within a cell log p is taken as linear: for p = angle^-m that is off
    by m h2/8, h a cell's share of its angle, 5e-4 at 1e-4 rad and nothing above 1e-3 rad.
    Petzold's density has a corner at each angle of his table, which a cell that holds it cuts
    by h/4 of the change of slope, 1.6 at most; those cells are left out."""
    angle = np.append(np.geomspace(1e-4, 3.14159, 4001), np.pi - 1e-6)
    if name == "petzold":
        corners = np.abs(np.log(angle[:, np.newaxis] / TABLE_RAD)).min(axis=1)
        angle = angle[corners > cell_share(angle)]
    value = doubles(table(name).value(floats(angle)))
    own = optics(name).phase(angle.astype(np.float32).astype(float))
    bound = STEEPEST * cell_share(angle) ** 2 / 8 + 1e-4
    assert np.all(np.abs(value / own - 1) < bound)


@every_water
@FEW
@given(low=st.floats(-4, 0.4), share=st.floats(0.1, 1))
def test_angles_along_a_line_follow_the_phase_function(name: str, low: float, share: float) -> None:
    """Even numbers give even shares of the integral of p(psi) between any two angles."""
    first = 10.0**low
    last = first * (np.pi / first) ** share
    tabulated = table(name)
    below, above = (tabulated.line_integral(floats(np.array([angle]))) for angle in (first, last))
    numbers = evenly(4096)
    drawn = doubles(tabulated.sample_line(below, above, floats(numbers)))

    angle = np.geomspace(first, last, 40001)
    integral = cumulative(optics(name).phase(angle), angle)
    found = np.interp(drawn, angle, integral) / integral[-1]
    # Single precision of the table, counted from the middle, over the mass between the ends;
    # within a cell the density is flat: 1/8 of a cell's share of the peak's steepness.
    largest = max(abs(doubles(below)[0]), abs(doubles(above)[0]))
    rounding = 4 * SINGLE * largest / (doubles(above) - doubles(below))[0]
    flat = STEEPEST * cell_share(first) ** 2 / 8
    assert np.abs(found - numbers).max() < rounding + flat + 1e-4


@every_water
def test_directions_follow_the_phase_function(name: str) -> None:
    """Their mean cosine is the water's g, and their cumulative share is the integral of p."""
    numbers = evenly(2**16)
    sample = mi.Point2f(floats(numbers), floats((numbers * 977) % 1))
    drawn = table(name).sample_direction(mi.Vector3f(0.6, 0.0, 0.8), sample)
    angle = doubles(angle_between(mi.Vector3f(0.6, 0.0, 0.8), drawn))

    phase = optics(name).phase
    cosine = integral(lambda angle: np.cos(angle) * phase(angle))
    # Flat in a cell, 0.4 % of its angle wide; and what is cut off the peak goes elsewhere.
    error = cut_off(name) + 1e-4
    assert np.cos(angle).mean() == pytest.approx(cosine, abs=error)
    grid = np.geomspace(1e-3, np.pi, 100001)
    beyond = cumulative(2 * np.pi * np.sin(grid) * phase(grid), grid)
    wide = angle > grid[0]
    share = 1 - beyond[-1] + np.interp(angle[wide], grid, beyond)
    assert np.abs(share - numbers[wide]).max() < error


@every_water
def test_a_directions_weight_hardly_varies(name: str) -> None:
    """Value over density is 1 within a cell's change of the phase function: 3 % above
    2e-4 rad, and its mean is exactly the phase function's whole, 1."""
    numbers = evenly(2**15)
    sample = mi.Point2f(floats(numbers), floats(numbers))
    axis = mi.Vector3f(0.0, 0.0, 1.0)
    angle = angle_between(axis, table(name).sample_direction(axis, sample))
    weight = doubles(table(name).value(angle)) / doubles(table(name).direction_density(angle))
    wide = doubles(angle) > 2e-4
    assert np.abs(weight[wide] - 1).max() < 0.03
    assert weight.mean() == pytest.approx(1, abs=2e-3)


@FEW
@given(
    beside=st.floats(0, 2.5).map(lambda power: 10**power),
    azimuth=st.floats(0, 6.3),
    foot=st.floats(-300, 900),
    end=st.floats(50, 1500),
    name=st.sampled_from(list(WATERS)),
)
def test_places_on_a_line_follow_their_density(
    beside: float, azimuth: float, foot: float, end: float, name: str
) -> None:
    """The density integrates to 1 over the line, and even numbers give even shares of it.

    Points a millimetre or more beside the line: nearer ones see its far end at an angle
    whose difference from pi has too few digits in single precision.
    """
    tabulated = table(name)
    direction = mi.Vector3f(0.0, 0.0, 1.0)
    seen_from = beside * np.cos(azimuth), beside * np.sin(azimuth), foot
    point = mi.Point3f(*(float(v) for v in seen_from))
    near = approach(tabulated, mi.Point3f(0.0), direction, mi.Float(end), point)

    # Places as dense as the density is steep: even in log distance from the foot.
    fine = 1e-3 * beside
    first, last = np.arcsinh(-foot / fine), np.arcsinh((end - foot) / fine)
    place = foot + fine * np.sinh(np.linspace(first, last, 200001))
    density = doubles(near.density(tabulated, floats(place)))
    share = cumulative(density, place)
    # A cell's density is flat, and off by no more than its share where it meets the next.
    assert share[-1] == pytest.approx(1, abs=2e-3)

    numbers = evenly(2048)
    drawn = doubles(near.sample(tabulated, floats(numbers)))
    assert np.abs(np.interp(drawn, place, share) - numbers).max() < 3e-3


def test_angles_between_close_directions_are_exact() -> None:
    """1e-5 rad, where an arc cosine in single precision has no digit left."""
    angle = np.geomspace(1e-5, 3.1, 200)
    turned = mi.Vector3f(floats(np.sin(angle)), mi.Float(0.0), floats(np.cos(angle)))
    found = doubles(angle_between(mi.Vector3f(0.0, 0.0, 1.0), dr.normalize(turned)))
    # Near pi the arc sine is steep: its error is that of its argument over pi - angle.
    bound = SINGLE * (4 * angle + 8 / np.maximum(np.pi - angle, 0.01))
    assert np.all(np.abs(found - angle) < bound)
