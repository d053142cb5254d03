"""Light scattered once against adaptive quadrature over places instead of angles."""

from functools import cache

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from scipy.integrate import quad_vec

from lscan.records import Floats
from sim.scene.matter import Water
from sim.water import water_optics
from sim.water.spread import ANGLE_AXIS, LogAxis, OnceScattered, between_nodes, once_scattered

PHASES = {
    name: water_optics(Water(particle_scattering_per_m=1.0, phase=name), 650.0).phase
    for name in ("petzold-mixture", "petzold", "fournier-forand", "henyey-greenstein")
}
ALBEDO, FARTHEST = 0.8, 12.0
# Linear interpolation between nodes that are h = 0.029 apart in log angle is off by m2 h2 / 8,
# 2e-4, where the table falls as the angle to the power m = -1.35; between rows likewise.
# Petzold's density has corners, which cost h / 8 of the change of slope within a cell at most.
BETWEEN_NODES, AT_CORNERS = 1e-3, 3e-3


def behind_the_start(theta: float, depth: float) -> float:
    """What linear interpolation costs beyond a right angle, where J falls to 0 towards pi.

    Far from the axis J is p 2 cos2(theta / 2) / (c h), whose second derivative by the log angle
    is 2 [theta / (pi - theta)]2 of itself.  Near to it J is p (pi - theta), with the second
    derivative 2 p / (c h) by c h.  Steps of s cost s2 / 8 of either; both are added.
    """
    if theta < np.pi / 2:
        return 0.0
    rows = tables("henyey-greenstein").across_axis
    across, left = depth * np.sin(theta), np.pi - theta
    step = (across + rows.offset) / rows.scale
    return float((theta / left / ANGLE_AXIS.scale) ** 2 + step**2 / (across * left)) / 4


@cache
def tables(name: str) -> OnceScattered:
    return once_scattered(PHASES[name], ALBEDO, FARTHEST)


def along_the_beam(phase, theta: float, depth: float, end: float) -> complex:
    """The integral over places z of b p exp(-c (z + l)) / l2, all in optical depths."""
    across, foot = depth * np.sin(theta), depth * np.cos(theta)

    def arriving(place: float) -> complex:
        onward = np.hypot(across, foot - place)
        psi = np.arctan2(across, foot - place)
        light = float(phase(np.array(psi))) * np.exp(-place - onward) / onward**2
        return complex(ALBEDO * light * np.exp(1j * (psi - theta)))

    near = across * np.geomspace(0.1, 1e5, 13)
    marks = np.clip(np.concatenate([foot - near, foot + near]), 0.0, end)
    return complex(quad_vec(arriving, 0.0, end, epsabs=0, epsrel=1e-6, points=np.unique(marks))[0])


@examples(25)
@given(
    name=st.sampled_from(list(PHASES)),
    theta=st.floats(-5, 0.45).map(lambda power: 10.0**power),
    depth=st.floats(0.03, FARTHEST),
    end=st.one_of(st.just(1.0), st.floats(0.6, 1.5)),
)
def test_tables_agree_with_adaptive_quadrature(name, theta, depth, end) -> None:
    expected = along_the_beam(PHASES[name], theta, depth, end * depth)
    found = tables(name).vector_irradiance(np.array(theta), np.array(depth), np.array(end * depth))
    # A beam that ends far in front of the point leaves the difference of two large numbers.
    endless = tables(name).vector_irradiance(np.array(theta), np.array(depth), np.array(depth))
    bound = AT_CORNERS if name == "petzold" else BETWEEN_NODES
    bound += behind_the_start(theta, depth)
    assert abs(complex(found) - expected) < bound * max(abs(expected), abs(complex(endless)))


def test_a_beam_that_ends_before_the_point_loses_the_light_from_behind() -> None:
    """Each further part of the way in front of the point adds light that travels outwards."""
    theta, depth = np.array(0.01), np.array(2.0)
    shares = [
        tables("petzold-mixture").vector_irradiance(theta, depth, np.array(end)).real
        for end in (0.5, 1.0, 1.9)
    ]
    assert 0 < shares[0] < shares[1] < shares[2]


@given(x=st.floats(0.0, 9.0), offset=st.floats(0.01, 3.0))
def test_an_axis_finds_its_own_nodes(x: float, offset: float) -> None:
    axis = LogAxis(0.0, 9.0, 33, offset)
    nodes = axis.nodes()
    assert nodes[0] == 0.0
    assert nodes[-1] == 9.0
    assert axis.place(nodes) == pytest.approx(np.arange(33), abs=1e-9)
    place = float(axis.place(np.array(x)))
    assert nodes[int(place)] <= x * (1 + 1e-9)


def test_between_nodes_values_are_linear_and_beyond_them_held() -> None:
    table: Floats = np.arange(12.0).reshape(3, 4)
    rows, columns = np.array([0.5, 2.0, -1.0, 9.0]), np.array([1.25, 3.0, 0.0, 9.0])
    assert between_nodes(table, rows, columns) == pytest.approx([3.25, 11.0, 0.0, 11.0])
    assert ANGLE_AXIS.nodes()[-1] == np.pi
