"""The laser sheet: its power, its beam, where it lies, how it is bowed and how it moves."""

from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st

from lscan.records import Floats
from sim.render.plugins.arrays import floats, vectors
from sim.render.plugins.sheet import BOW_NODES, LaserSheet, bow
from sim.scene import Head, Laser, Pose, head_pose, sheet_pose
from sim.truth.sheet import TrueSheet, bow_of, sheet_plane

INDEX, NM = (1.3313, 650.0)  # fresh water, red diode: docs/explanation/physics.md, section 1
STILL = Pose(np.eye(3), np.zeros(3))
FEW = examples(25)
# Positions of up to 1000 mm in single precision: half a unit in the last place is 3e-5 mm,
# and a rotated coordinate is a sum of three products of them.
POSITION_MM = 2e-4
ASKEW = st.builds(
    Laser,
    power_mw=st.floats(0.5, 50),
    apex_mm=st.tuples(st.floats(-200, 200), st.floats(-30, 30), st.floats(100, 500)),
    aim_deg=st.floats(-20, 20),
    tilt_deg=st.floats(-15, 15),
    skew_deg=st.floats(-15, 15),
    fan_half_angle_deg=st.floats(10, 38),
    fan_rise=st.floats(-0.5, 1),
    waist_mm=st.floats(1, 4),
    waist_distance_mm=st.floats(200, 800),
    port_tilt_deg=st.just(0.0) | st.floats(-20, 20),
)


def sheets_of(laser: Laser, head: Pose = STILL, velocity: Floats | None = None) -> list[LaserSheet]:
    """The emitters of all the laser's lines."""
    sheets = []
    for line in laser.sheets:
        sheet = LaserSheet(mi.Properties())
        sheet.configure(laser, line, INDEX, NM)
        sheet.place(head, velocity)
        sheets.append(sheet)
    return sheets


def irradiance(sheet: LaserSheet, points: Floats, time: float = 0.0) -> Floats:
    """(N,) mW/mm2 at (N, 3) points of the world."""
    place = mi.Point3f(vectors(points.T))
    return np.array(sheet.irradiance(place, mi.Float(time)), dtype=float)


def slopes(sheet: LaserSheet, phi: Floats) -> Floats:
    """(N,) the plugin's q at angles of the fan."""
    return np.array(sheet.slope(floats(phi)), dtype=float)


def refracted_slopes(tilt_deg: float, index: float, angles: Floats) -> tuple[Floats, Floats]:
    """phi and q of the fan's rays at angles in air, by Snell's law for vectors.

    A ray d that meets a face of normal N leaves along d/n + (sqrt(1 - (1 - c2)/n2) - c/n) N,
    c = d.N (any textbook of optics).  Frame: across, normal, axis of the sheet in air.
    """
    tilt = np.radians(tilt_deg)
    window = np.array([0.0, np.sin(tilt), np.cos(tilt)])
    angles = np.append(angles, 0.0)  # the middle ray comes last
    rays = np.column_stack([np.sin(angles), np.zeros_like(angles), np.cos(angles)])
    c = rays @ window
    along = np.sqrt(1 - (1 - c**2) / index**2) - c / index
    water = rays / index + along[:, np.newaxis] * window
    axis = water[-1]
    across = np.array([1.0, 0.0, 0.0])
    normal = np.cross(axis, across)
    x, y, z = water @ across, water @ normal, water @ axis
    return np.arctan2(x, z)[:-1], (y / np.hypot(x, z))[:-1]


FANS: dict[str, dict[str, Any]] = {
    "uniform": {},
    "brighter at the edges": {"fan_rise": 0.4},
    "gaussian": {"fan": "gaussian"},
    "bowed": {"port_tilt_deg": 15.0, "fan_rise": -0.2},
    "three lines": {
        "lines": [{"tilt_deg": t, "share": s} for t, s in ((-8, 0.2), (0, 0.5), (8, 0.3))]
    },
}


@pytest.mark.parametrize("fan", FANS)
@pytest.mark.parametrize("rho", [150.0, 600.0])
def test_power_through_a_cylinder_about_the_apex_is_the_lasers(fan: str, rho: float) -> None:
    """All the power crosses every cylinder of radius rho: integral of E over arc and s."""
    settings_of_fan = {"waist_mm": 0.5, "aim_deg": 12.0, **FANS[fan]}
    laser = Laser(power_mw=7.0, apex_mm=(10, 0, 20), **settings_of_fan)
    half = np.radians(laser.fan_half_angle_deg)
    phi = (np.arange(400) + 0.5) * (half / 200) - half  # midpoints: no edge of the fan
    in_air = np.linspace(-1.2, 1.2, 4001)
    q = np.interp(phi, *refracted_slopes(laser.port_tilt_deg, INDEX, in_air))
    s = np.linspace(-8, 8, 801)
    angle, offset = np.meshgrid(phi, s)
    local = np.stack([rho * np.sin(angle), offset + rho * q, -rho * np.cos(angle)], axis=-1)

    power = 0.0
    for sheet, line in zip(sheets_of(laser), laser.sheets, strict=True):
        points = sheet_pose(laser, line).apply(local.reshape(-1, 3))
        values = irradiance(sheet, points)
        power += values.sum() * rho * (phi[1] - phi[0]) * (s[1] - s[0])
    # Midpoint sums over 400 cells of the fan are off by f''/f h2/24, at most 4e-6 (of the
    # Gaussian); trapezoid sums of a Gaussian by nothing; the rest is single precision.
    assert power == pytest.approx(7.0, rel=2e-5)


def test_no_light_outside_the_fan() -> None:
    """The fan ends at its half angle, sharply."""
    laser = Laser(power_mw=1, apex_mm=(0, 0, 0), fan_half_angle_deg=30)
    (sheet,) = sheets_of(laser)
    angle = np.radians([-30.01, -29.99, 29.99, 30.01])
    points = 500 * np.column_stack([np.sin(angle), np.zeros(4), -np.cos(angle)])
    assert (irradiance(sheet, points) > 0).tolist() == [False, True, True, False]


def test_the_sheet_spreads_as_a_gaussian_beam() -> None:
    """In water at 650 nm w0 = 0.25 mm gives z_R = 0.402 m, w(1 m) 0.67.

    docs/explanation/physics.md, section 4.
    """
    laser = Laser(power_mw=1, apex_mm=(0, 0, 0), waist_mm=0.25, waist_distance_mm=0)
    (sheet,) = sheets_of(laser)
    assert float(sheet.rayleigh[0]) == pytest.approx(402, abs=0.5)
    assert float(sheet.half_width(mi.Float(1000.0))[0]) == pytest.approx(0.67, abs=0.005)
    (poor,) = sheets_of(laser.model_copy(update={"m2": 2.0}))
    assert float(poor.rayleigh[0]) == pytest.approx(201, abs=0.25), "M2 divides the length"


@FEW
@given(tilt=st.floats(-30, 30), index=st.floats(1.30, 1.36))
def test_the_bow_is_snells(tilt: float, index: float) -> None:
    """q(phi) of the table, and of kernels, against vectors refracted one by one."""
    laser = Laser(power_mw=1, apex_mm=(0, 0, 0), port_tilt_deg=tilt)
    phi, q = refracted_slopes(tilt, index, np.linspace(-1.0, 1.0, 101))
    table = np.interp(phi, np.linspace(-np.pi, np.pi, BOW_NODES), bow(laser, index))
    # Straight between nodes: |q''| h2/8, |q''| up to 3 at these tilts, h = 3.8e-4 rad.
    assert np.abs(table - q).max() < 6e-8

    sheet = LaserSheet(mi.Properties())
    sheet.configure(laser, laser.sheets[0], index, NM)
    if tilt != 0:
        # Places up to 16384 in single precision are good to 1e-3 cells, 4e-7 rad; |q'| < 1.
        assert np.abs(slopes(sheet, phi) - q).max() < 5e-7


@FEW
@given(laser=ASKEW, seed=st.integers(0, 2**31), position=st.floats(-100, 100))
def test_the_sheet_lies_where_the_truth_has_it(laser: Laser, seed: int, position: float) -> None:
    """Irradiance peaks on the truth's sheet, leant, turned, displaced and bowed, and falls to
    exp(-1/2) half a width beside it; the truth shares no formula with the emitter."""
    generator = np.random.default_rng(seed)
    head = head_pose(Head(camera_mm=(0, 0, 0), yaw_deg=3.0), position)
    (sheet,) = sheets_of(laser, head)
    truth = TrueSheet(sheet_plane(laser, laser.sheets[0]), bow_of(laser, INDEX))

    half = np.radians(laser.fan_half_angle_deg)
    phi, rho = generator.uniform(-0.99 * half, 0.99 * half, 50), generator.uniform(100, 700, 50)
    angle = phi + np.radians(laser.aim_deg)
    apex = np.array(laser.apex_mm)[[0, 2]]
    xz = apex + rho[:, np.newaxis] * np.column_stack([np.sin(angle), -np.cos(angle)])
    rayleigh = np.pi * laser.waist_mm**2 * INDEX / (NM * 1e-6)
    width = laser.waist_mm * np.hypot(1, (rho - laser.waist_distance_mm) / rayleigh)
    fan = (1 + laser.fan_rise * (phi / half) ** 2) / (2 * half * (1 + laser.fan_rise / 3))
    peak = laser.power_mw * fan / rho * np.sqrt(2 / np.pi) / width

    middle, normal = truth.in_head(xz), truth.pose.rotation[:, 1]
    for beside in (-0.5, 0.0, 0.5):
        points = head.apply(middle + beside * width[:, np.newaxis] * normal)
        expected = peak * np.exp(-2 * beside**2)
        # d ln E = 4 s/w ds/w; the bow in kernels is good to 5e-7 of rho.
        error = 4 * abs(beside) * (POSITION_MM + 5e-7 * rho) / width + 1e-5
        relative = irradiance(sheet, points) / expected - 1
        assert np.all(np.abs(relative) < error)


@FEW
@given(tilt=st.floats(-20, 20), aim=st.floats(-20, 20))
def test_the_bow_is_the_truths(tilt: float, aim: float) -> None:
    """The table against the cone of the second degree that the truth solves in closed form."""
    laser = Laser(power_mw=1, apex_mm=(5, 0, 90), port_tilt_deg=tilt, aim_deg=aim)
    truth = bow_of(laser, INDEX)
    phi, rho = np.linspace(-0.6, 0.6, 101), 500.0
    angle = phi + np.radians(aim)
    expected = np.zeros_like(phi)
    if truth is not None:
        expected = truth.offset_mm(5 + rho * np.sin(angle), 90 - rho * np.cos(angle)) / rho
    table = np.interp(phi, np.linspace(-np.pi, np.pi, BOW_NODES), bow(laser, INDEX))
    assert np.abs(table - expected).max() < 6e-8  # straight between nodes, as above


def test_a_moving_head_takes_the_sheet_along() -> None:
    """The apex is at rest + velocity time, and so is all the sheet's light."""
    laser = Laser(power_mw=1, apex_mm=(10, 2, 300), aim_deg=5, port_tilt_deg=10)
    velocity = np.array([3.0, 40.0, -2.0])
    (moving,) = sheets_of(laser, velocity=velocity)
    (still,) = sheets_of(laser)
    generator = np.random.default_rng(5)
    points = generator.uniform((-100, -1, -300), (100, 1, -100), (200, 3))
    for time in (-0.02, 0.0, 0.5):
        apex = np.array(moving.apex(mi.Float(time)), dtype=float).ravel()
        np.testing.assert_allclose(apex, [10, 2, 300] + velocity * time, atol=POSITION_MM)
        lit = irradiance(moving, points + velocity * time, time)
        # d ln E = 4 s ds / w2 with s below 6 mm where there is light to speak of, w 1.5 mm.
        reference = irradiance(still, points)
        bound = 24 * POSITION_MM / 1.5**2 * reference + 1e-12
        assert np.all(np.abs(lit - reference) < bound)


def rays_of(sheet: LaserSheet, points: Floats) -> tuple[Floats, Floats]:
    """(N, 3) unit directions of light at (N, 3) points of the world, and its sources."""
    place = mi.Point3f(vectors(points.T))
    along, source = sheet.arrival(place, mi.Float(0.0))
    return np.array(along, dtype=float).T, np.array(source, dtype=float).T


@FEW
@given(laser=ASKEW, waist=st.floats(0.1, 4), seed=st.integers(0, 2**31))
def test_light_runs_along_the_hyperbolas_of_a_gaussian_beam(
    laser: Laser, waist: float, seed: int
) -> None:
    """At a constant share of the half width beside the truth's sheet, light follows the curve
    and began on it beside the apex."""
    laser = laser.model_copy(update={"waist_mm": waist})
    generator = np.random.default_rng(seed)
    head = head_pose(Head(camera_mm=(0, 0, 0), yaw_deg=3.0), 20.0)
    (sheet,) = sheets_of(laser, head)
    truth = TrueSheet(sheet_plane(laser, laser.sheets[0]), bow_of(laser, INDEX))
    half = np.radians(laser.fan_half_angle_deg)
    angle = generator.uniform(-0.99 * half, 0.99 * half, 50) + np.radians(laser.aim_deg)
    rho, share = generator.uniform(100, 700, 50), generator.uniform(-1.5, 1.5, 50)

    def curve(rho: Floats) -> Floats:
        way = np.column_stack([np.sin(angle), -np.cos(angle)])
        xz = np.array(laser.apex_mm)[[0, 2]] + rho[:, np.newaxis] * way
        aside = share * laser.half_thickness_mm(rho, INDEX)
        normal = truth.pose.rotation[:, 1]
        return head.apply(truth.in_head(xz) + aside[:, np.newaxis] * normal)

    along, source = rays_of(sheet, curve(rho))
    tangent = curve(rho + 0.1) - curve(rho - 0.1)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    # A place's error over its distance turns phi, times the wavefront's curvature it turns the
    # slope; the bow in kernels is good to 5e-7.  Differences over 0.1 mm err by 0.1^2 / z_R^2.
    rayleigh = np.pi * waist**2 * INDEX / (NM * 1e-6)
    placed = POSITION_MM + 5e-7 * rho
    error = 2e-6 + placed / rho + placed / (2 * rayleigh) + 1e-2 / rayleigh**2
    assert np.all(np.linalg.norm(along - tangent, axis=1) < 3 * error)
    narrower = laser.half_thickness_mm(np.array(0.0), INDEX) / laser.half_thickness_mm(rho, INDEX)
    began = curve(np.full(50, 1e-9))
    assert np.all(np.linalg.norm(source - began, axis=1) < 2 * POSITION_MM + 3 * narrower * placed)


def test_the_emitter_is_a_delta_light() -> None:
    """Integrators scatter its light from the local direction, look for what stands before its
    source, which lies beside the apex, and never meet it by chance."""
    laser = Laser(power_mw=1, apex_mm=(0, 0, 100), waist_mm=0.2, waist_distance_mm=250)
    (sheet,) = sheets_of(laser)
    si = mi.SurfaceInteraction3f()
    si.p = mi.Point3f(20, 0.4, -300)
    ds, weight = sheet.sample_direction(si, mi.Point2f(0.5))
    (along,), (source,) = rays_of(sheet, np.array([[20.0, 0.4, -300.0]]))
    np.testing.assert_allclose(np.array(ds.d, dtype=float).ravel(), -along, atol=1e-6)
    np.testing.assert_allclose(np.array(ds.p, dtype=float).ravel(), source, atol=1e-6)
    assert abs(source[1]) > 0.3 and np.all(source[[0, 2]] == [0, 100])
    assert float(ds.dist[0]) == pytest.approx(np.linalg.norm(source - [20, 0.4, -300]), rel=1e-6)
    value = irradiance(sheet, np.array([[20.0, 0.4, -300.0]]))[0]
    assert float(weight[0][0]) == pytest.approx(value, rel=1e-6)
    assert float(sheet.eval_direction(si, ds)[0][0]) == pytest.approx(value, rel=1e-6)
    assert float(sheet.pdf_direction(si, ds)[0]) == 0
    assert bool(ds.delta[0])
