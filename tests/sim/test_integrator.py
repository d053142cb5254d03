"""The sheet and the integrator against closed forms, quadrature and stock Mitsuba."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.integrate import quad

from sim.plugins.integrator import SheetIntegrator
from sim.plugins.sheet import LaserSheet
from sim.scene import Laser, Pose, load_scene
from sim.tank import Tank, stock_medium
from sim.water import Optics

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "paper"


def make_sheet(laser: Laser, pose: Pose | None = None, water_index: float = 1.33) -> LaserSheet:
    sheet = LaserSheet(mi.Properties())
    sheet.configure(laser, water_index)
    sheet.place(pose or Pose(np.eye(3), np.zeros(3)))
    return sheet


def single_lobe(absorption: float, scattering: float, g: float) -> Optics:
    return Optics(
        index=1.33,
        absorption_per_mm=absorption,
        scattering_per_mm=scattering,
        hg_weights=np.array([1.0]),
        hg_g=np.array([g]),
        molecular_weight=0.0,
    )


@pytest.mark.parametrize("fan", ["uniform", "gaussian"])
@pytest.mark.parametrize("rho", [150.0, 600.0])
def test_power_through_a_cylinder_about_the_apex_is_the_lasers(fan: str, rho: float) -> None:
    """All the power crosses every cylinder of radius rho: integral of E over arc and s."""
    laser = Laser(power_mw=7.0, apex_mm=(10, 0, 20), fan=fan, waist_mm=0.5, aim_deg=12.0)
    sheet = make_sheet(laser)
    half = np.radians(laser.fan_half_angle_deg)

    phi = np.linspace(-half, half, 801)[:-1] + half / 800  # midpoints: no edge of the fan
    s = np.linspace(-8, 8, 1601)
    p, q = np.meshgrid(phi, s)
    angle = p + np.radians(laser.aim_deg)
    x, z = 10 + rho * np.sin(angle), 20 - rho * np.cos(angle)
    points = mi.Point3f(*(mi.Float(v.ravel().astype(np.float32)) for v in (x, q, z)))
    irradiance = np.array(sheet.irradiance(points), dtype=float)
    power = irradiance.sum() * rho * (phi[1] - phi[0]) * (s[1] - s[0])
    # Midpoint and trapezoid sums of smooth functions; what is left is single precision.
    assert power == pytest.approx(7.0, rel=1e-5)


def test_the_sheet_spreads_as_a_gaussian_beam() -> None:
    """physics.md section 4: in water at 650 nm w0 = 0.25 mm gives z_R = 0.402 m, w(1 m) 0.67."""
    laser = Laser(power_mw=1, apex_mm=(0, 0, 0), waist_mm=0.25, waist_distance_mm=0)
    sheet = make_sheet(laser, water_index=1.3313)
    assert float(sheet.rayleigh[0]) == pytest.approx(402, abs=0.5)
    assert float(sheet.half_width(mi.Float(1000.0))[0]) == pytest.approx(0.67, abs=0.005)


# Published check values, physics.md section 7: metres and watts there, mm and mW here.
CHECK = [(0.0, 5.942212822e-4), (0.1, 9.540600974e-4), (0.2, 1.300616580e-3)]


@pytest.mark.parametrize(("x", "quadrature"), CHECK)
def test_single_scattering_against_published_quadrature(x: float, quadrature: float) -> None:
    """The sampled estimator reproduces the quadrature for a 2 mm sheet to 1e-4."""
    tilt = np.radians(17.0)
    axis = np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    across = np.array([0.0, 1.0, 0.0])
    normal = np.cross(across, axis)
    # Head axes in the world: x is across the fan, y the normal, -z the fan's axis.
    pose = Pose(np.column_stack([across, normal, -axis]), np.array([300.0, 0.0, 0.0]))
    laser = Laser(
        power_mw=1.0, apex_mm=(0, 0, 0), fan_half_angle_deg=30, waist_mm=2.0,
        waist_distance_mm=700,
    )  # fmt: skip
    sheet = make_sheet(laser, pose)
    integrator = SheetIntegrator(mi.Properties())
    integrator.configure(single_lobe(0.4e-3, 0.5e-3, 0.9), sheet, 0.0)
    scene = mi.load_dict({"type": "scene", "sheet": sheet})

    count = 100_000
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, count)
    direction = np.array([x, 0.05, 1.0]) / np.linalg.norm([x, 0.05, 1.0])
    ray = mi.RayDifferential3f(mi.Ray3f(mi.Point3f(0), mi.Vector3f(direction.tolist())))
    ray = dr.gather(mi.RayDifferential3f, ray, dr.zeros(mi.UInt32, count))
    _, _, layers = integrator.sample(scene, sampler, ray)
    values = np.array(layers[1], dtype=float) * 1e6  # 1/mm2 to 1/m2
    mean, error = values.mean(), values.std() / np.sqrt(count)
    assert error < 3e-5 * quadrature, "the integrand should hardly vary over the Gaussian"
    assert mean == pytest.approx(quadrature, rel=1e-4)


def test_phase_function_is_the_waters_own() -> None:
    """The plugin's phase function equals sim.water's to single precision, and integrates to 1."""
    tank = Tank(load_scene(SCENES / "groove.toml"))
    cosine = np.cos(np.radians(np.linspace(0.2, 180, 500)))
    plugin = np.array(tank.integrator.phase(mi.Float(cosine.astype(np.float32))), dtype=float)
    own = tank.water.phase(cosine.astype(np.float32).astype(float))
    # The forward peak's denominator (1-g)2 = 8e-6 is a difference of numbers near 1.
    np.testing.assert_allclose(plugin, own, rtol=1e-2)
    wide = cosine < np.cos(np.radians(5))
    np.testing.assert_allclose(plugin[wide], own[wide], rtol=1e-4)
    total, _ = quad(lambda a: 2 * np.pi * np.sin(a) * float(tank.water.phase(np.cos(a))), 0, np.pi,
                    points=[0.001, 0.01, 0.1], limit=400)  # fmt: skip
    assert total == pytest.approx(1.0, abs=1e-6)


def runs(tank: Tank, integrator, camera, samples: int, seeds: range) -> np.ndarray:
    pictures = [
        np.array(
            mi.render(
                tank.mitsuba_scene, sensor=camera, integrator=integrator, spp=samples, seed=seed
            )
        )[..., 0]
        for seed in seeds
    ]
    return np.array(pictures, dtype=float)


def z_scores(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Difference of two sets of runs in units of its standard error, per column of pixels."""
    a, b = ours.sum(axis=1), theirs.sum(axis=1)
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + b.var(axis=0, ddof=1) / len(b))
    return (a.mean(axis=0) - b.mean(axis=0)) / np.maximum(error, 1e-30)


# 16 independent runs a side give a t distribution of about 30 degrees of freedom; over 24
# columns at an overall level of 1e-3 (Sidak) the bound on |t| is 4.6.
BOUND = 4.6


@pytest.mark.slow
def test_direct_light_in_clear_medium_equals_stock_path() -> None:
    """Without absorption and scattering the picture is what Mitsuba's own ``path`` renders."""
    tank = Tank(load_scene(SCENES / "groove.toml"))
    camera = tank.make_camera((220, 350, 24, 18), jitter=True)
    dry = replace(tank.water, absorption_per_mm=0.0, scattering_per_mm=0.0)
    ours = SheetIntegrator(mi.Properties())
    ours.configure(dry, tank.sheet, 0.0)
    stock = mi.load_dict({"type": "path", "max_depth": 2})
    mine, theirs = (
        runs(tank, ours, camera, 256, range(16)),
        runs(tank, stock, camera, 256, range(100, 116)),
    )
    assert mine.sum() > 0
    assert np.abs(z_scores(mine, theirs)).max() < BOUND
    # Power: a line 2 percent brighter is seen at once.
    assert np.abs(z_scores(1.02 * mine, theirs)).max() > BOUND


def murky(tank: Tank) -> tuple[Optics, SheetIntegrator]:
    """Water between Petzold's coastal and harbour, so that the veil is seen, and our picture."""
    water = replace(tank.water, absorption_per_mm=2e-4, scattering_per_mm=5e-4)
    ours = SheetIntegrator(mi.Properties())
    ours.configure(water, tank.sheet, 0.0)
    return water, ours


STOCK = {"type": "volpath", "max_depth": 2, "rr_depth": 100}


@pytest.mark.slow
def test_the_line_in_turbid_water_equals_stock_volpath() -> None:
    """Both legs' losses: up to one scattering, the line is what stock ``volpath`` renders."""
    tank = Tank(load_scene(SCENES / "groove.toml"))
    water, ours = murky(tank)
    window = (220, 350, 24, 18)
    mine = runs(tank, ours, tank.make_camera(window, jitter=True), 256, range(16))
    stock_camera = tank.make_camera(window, stock_medium(water), jitter=True)
    theirs = runs(tank, mi.load_dict(STOCK), stock_camera, 4096, range(100, 116))
    assert np.abs(z_scores(mine, theirs)).max() < BOUND
    lit = np.abs(z_scores(np.zeros_like(mine), theirs))
    assert lit.min() > BOUND, "every column holds the line, and its absence would be seen"


@pytest.mark.slow
def test_the_veil_equals_stock_volpaths() -> None:
    """Above the line only light scattered once is seen.  Its sum over the window agrees with
    ``volpath``'s, whose veil is rare bright specks: 16 runs give it to about a percent."""
    tank = Tank(load_scene(SCENES / "groove.toml"))
    water, ours = murky(tank)
    window = (240, 120, 64, 48)
    mine = runs(tank, ours, tank.make_camera(window, jitter=True), 16, range(16))
    stock_camera = tank.make_camera(window, stock_medium(water), jitter=True)
    theirs = runs(tank, mi.load_dict(STOCK), stock_camera, 1024, range(100, 116))
    whole = (16, -1, 1)
    assert np.abs(z_scores(mine.reshape(whole), theirs.reshape(whole))).max() < BOUND
    # A veil 10 percent off, as half a lobe of the phase function would make it, is seen.
    assert np.abs(z_scores(1.1 * mine.reshape(whole), theirs.reshape(whole))).max() > BOUND


def test_quadrature_of_the_sheet_is_its_thin_limit() -> None:
    """The closed form of physics.md section 7 follows from the sheet's irradiance: a check of
    the irradiance's scale by an integral across the sheet that Mitsuba has no part in."""
    laser = Laser(power_mw=1, apex_mm=(0, 0, 0), fan_half_angle_deg=30, waist_mm=2)
    sheet = make_sheet(laser)
    rho = 400.0

    def irradiance(s: float) -> float:
        point = mi.Point3f(mi.Float(0.0), mi.Float(s), mi.Float(-rho))
        return float(sheet.irradiance(point)[0])

    across, _ = quad(irradiance, -10, 10)
    assert across == pytest.approx(1 / (2 * np.radians(30)) / rho, rel=1e-5)
