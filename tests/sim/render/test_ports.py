"""Ports in closed form against dielectric geometry that Mitsuba traces, and closed cases."""

import mitsuba as mi
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.records import Floats
from sim.render.plugins.camera import DomeOptics, FlatOptics, PortCrossing, PortOptics, cross_face
from sim.scene import PlanePort
from sim.scene.instrument import DomePort

GLASS, WATER = 1.488, 1.3313
MANY = examples(60)


def bundle(count: int, pupil_mm: float, widest_deg: float, seed: int) -> tuple[Floats, Floats]:
    """(N, 3) starts in a pupil about the pinhole and unit directions about the axis."""
    rng = np.random.default_rng(seed)
    angle = np.radians(widest_deg) * np.sqrt(rng.random(count))
    around, about = rng.uniform(-np.pi, np.pi, (2, count))
    beside = np.column_stack([np.cos(around), np.sin(around)]) * np.sin(angle)[:, None]
    start = np.column_stack([np.cos(about), np.sin(about)]) * rng.random((count, 1)) * pupil_mm / 2
    direction = np.column_stack([beside, np.cos(angle)])
    return np.column_stack([start, np.zeros(count)]), direction / np.linalg.norm(
        direction, axis=1, keepdims=True
    )


def cross(optics: PortOptics, start: Floats, direction: Floats) -> tuple[Floats, Floats, Floats]:
    """Points (N, 3), directions (N, 3) and weights (N,) behind the port, double precision."""
    crossing: PortCrossing = optics.cross(mi.Point3f(vector(start)), mi.Vector3f(vector(direction)))
    point = np.array(crossing.point, dtype=float).T
    return point, np.array(crossing.direction, dtype=float).T, np.array(crossing.weight)


def vector(values: Floats) -> Floats:
    return np.ascontiguousarray(values.T, dtype=np.float32)


@pytest.mark.parametrize(
    ("radius", "thickness", "glass", "water"), [(20, 1, 1.9, 1.33), (100, 15, 1.3, 1.345)]
)
def test_a_dome_about_the_pinhole_turns_no_ray(
    radius: float, thickness: float, glass: float, water: float
) -> None:
    """Angles in the water are those in air, and Fresnel's loss is that at normal incidence.

    A unit vector is good to some 1e-7 in single precision.
    """
    port = DomePort(kind="dome", radius_mm=radius, thickness_mm=thickness)
    start, direction = bundle(200, 0.0, 89, seed=4)
    point, behind, weight = cross(DomeOptics(port, glass, water), start, direction)
    np.testing.assert_allclose(behind, direction, atol=1e-6)
    np.testing.assert_allclose(point, (radius + thickness) * direction, rtol=1e-6, atol=1e-4)
    lost = ((glass - 1) / (glass + 1)) ** 2, ((glass - water) / (glass + water)) ** 2
    np.testing.assert_allclose(weight, (1 - lost[0]) * (1 - lost[1]) / water**2, rtol=1e-5)


@pytest.mark.parametrize(
    ("radius", "glass", "off"), [(20, 1.9, 0.8), (60, 1.5, -0.3), (100, 1.3, -0.8)]
)
def test_a_dome_keeps_bouguers_invariant(radius: float, glass: float, off: float) -> None:
    """Index times distance from the centre of the ray drawn on: n |c x d| is conserved.

    Born & Wolf, Principles of Optics, sec. 3.2.  Single precision of lengths up to 100 mm.
    """
    port = DomePort(kind="dome", radius_mm=radius, centre_mm=(off * radius, 0.0, 0.0))
    start, direction = bundle(200, 5.0, 80, seed=5)
    point, behind, _ = cross(DomeOptics(port, glass, WATER), start, direction)
    before = np.cross(start - port.centre_mm, direction)
    after = WATER * np.cross(point - port.centre_mm, behind)
    np.testing.assert_allclose(after, before, atol=1e-4)


@MANY
@given(angle=st.floats(1, 85), n_in=st.floats(1, 1.9), n_out=st.floats(1, 1.9))
def test_what_a_face_does_not_transmit_it_reflects(angle: float, n_in: float, n_out: float) -> None:
    """R + T = 1, with R from Fresnel's sine and tangent laws (Born & Wolf, 1.5.2, eq. 21).

    Beyond the critical angle R = 1.  Near it T rises as the square root of the distance: an
    error of 1e-7 in the sine makes one of 1e-3 in T (the issue's bar); elsewhere 1e-5.
    """
    a = float(np.radians(angle))
    sine = np.sin(a) * n_in / n_out
    direction = np.array([[np.sin(a), 0.0, np.cos(a)]])
    refracted, cos_out, passed = cross_face(
        mi.Vector3f(vector(direction)), mi.Vector3f(0, 0, 1), mi.Float(n_in), mi.Float(n_out)
    )
    reflected = 1.0
    if sine < 1:
        b = np.arcsin(sine)
        r_s, r_p = np.sin(a - b) / np.sin(a + b), np.tan(a - b) / np.tan(a + b)
        reflected = 0.5 * (r_s**2 + r_p**2)
        assert float(cos_out[0]) == pytest.approx(np.cos(b), abs=1e-3)
        assert float(refracted.x[0]) == pytest.approx(sine, abs=1e-6)
    bound = 1e-3 if abs(sine - 1) < 1e-3 else 1e-5
    assert float(passed[0]) + reflected == pytest.approx(1.0, abs=bound)


def test_the_weight_on_the_axis_is_fresnels_loss_over_the_index_squared() -> None:
    """On the axis R = ((n1-n2)/(n1+n2))^2 at each face."""
    optics = FlatOptics(PlanePort(), GLASS, WATER)
    _, _, weight = cross(optics, np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]))
    inner = 1 - ((GLASS - 1) / (GLASS + 1)) ** 2
    outer = 1 - ((GLASS - WATER) / (GLASS + WATER)) ** 2
    assert weight[0] == pytest.approx(inner * outer / WATER**2, rel=1e-5)


def test_rays_that_do_not_come_through_weigh_nothing() -> None:
    """Those that turn away from a flat port or start beyond it, or start outside a dome."""
    flat = PlanePort(gap_mm=5.0, thickness_mm=6.0)
    away = np.array([[0.0, 0.6, -0.8]])
    beyond = np.array([[0.0, 0.0, 8.0]])
    ahead = np.array([[0.0, 0.0, 1.0]])
    assert cross(FlatOptics(flat, GLASS, WATER), np.zeros((1, 3)), away)[2] == 0
    assert cross(FlatOptics(flat, GLASS, WATER), beyond, ahead)[2] == 0
    dome = DomePort(kind="dome", radius_mm=30.0)
    outside = np.array([[0.0, 31.0, 0.0]])
    assert cross(DomeOptics(dome, GLASS, WATER), outside, ahead)[2] == 0
