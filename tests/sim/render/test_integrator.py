"""Light of the first order against quadrature and stock Mitsuba; helpers to compare pictures."""

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_cases import (
    DRY,
    RUNS,
    differ,
    floor_scene,
    groove_scene,
    make_sheet,
    one_lobe,
    parts,
    render,
)

from lscan.records import Floats
from sim.render.plugins.arrays import vectors
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.integrator import SheetIntegrator
from sim.render.tank import Tank
from sim.scene import Laser, Pose
from sim.water import Optics
from tests.validation.light.scattering import stock_medium


def veil(sheet: LaserSheet, water: Optics, start: Floats, along: Floats, count: int) -> Floats:
    """(count,) samples of the light scattered into a ray, mW/(mm2 sr)."""
    integrator = SheetIntegrator(mi.Properties())
    integrator.configure(water, [sheet], 0.0)
    scene = mi.load_dict({"type": "scene", "sheet": sheet})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(11, count)
    ray = mi.Ray3f(mi.Point3f(start.tolist()), mi.Vector3f(along.tolist()))
    rays = dr.gather(mi.RayDifferential3f, mi.RayDifferential3f(ray), dr.zeros(mi.UInt32, count))
    _, _, layers = integrator.sample(scene, sampler, rays)
    return np.array(layers[1], dtype=float)


# Check values of docs/explanation/physics.md, section 7: metres and watts there, mm and mW here.
CHECK = [(0.0, 5.942197074e-4), (0.1, 9.540560200e-4), (0.2, 1.300608409e-3)]


@pytest.mark.parametrize(("x", "quadrature"), CHECK)
def test_single_scattering_against_the_check_values(x: float, quadrature: float) -> None:
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
    along = np.array([x, 0.05, 1.0]) / np.linalg.norm([x, 0.05, 1.0])
    water = one_lobe(0.4e-3, 0.5e-3, 0.9)
    values = veil(make_sheet(laser, pose), water, np.zeros(3), along, 100_000) * 1e6  # per m2
    error = values.std() / np.sqrt(len(values))
    assert error < 3e-5 * quadrature, "the integrand should hardly vary over the Gaussian"
    assert values.mean() == pytest.approx(quadrature, rel=1e-4)


@pytest.mark.parametrize(
    ("shape", "waist"),
    [({"tilt_deg": 7.0, "fan": "gaussian"}, 0.3), ({"port_tilt_deg": -20.0}, 3.0)],
)
def test_a_bent_or_leant_sheets_veil_against_quadrature(
    shape: dict[str, Any], waist: float
) -> None:
    """Along a ray that crosses far from the fan's middle, where a bowed sheet is far from its
    plane: the sum over places 0.01 w apart of what the sheet's irradiance scatters."""
    laser = Laser(
        power_mw=1.0, apex_mm=(0, 0, 300), fan_half_angle_deg=35, waist_mm=waist,
        waist_distance_mm=500, **shape,
    )  # fmt: skip
    sheet, water = make_sheet(laser), one_lobe(0.4e-3, 0.5e-3, 0.7)
    start = np.array([150.0, -500.0, -100.0])
    along = np.array([0.1, 1.0, -0.05]) / np.linalg.norm([0.1, 1.0, -0.05])

    t = np.arange(300.0, 700.0, 0.01 * waist)
    points = start + t[:, np.newaxis] * along
    place = mi.Point3f(vectors(points.T))
    irradiance = np.array(sheet.irradiance(place, mi.Float(0.0)), dtype=float)
    from_apex = points - [0, 0, 300]
    distance = np.linalg.norm(from_apex, axis=1)
    angle = np.arccos(-(from_apex @ along) / distance)
    source = water.scattering_per_mm * water.phase(angle) * irradiance
    expected = np.sum(source * np.exp(-water.extinction_per_mm * (distance + t))) * 0.01 * waist

    values = veil(sheet, water, start, along, 100_000)
    error = values.std() / np.sqrt(len(values))
    # The irradiance's place in single precision: 3e-5 mm, over many places of either sign.
    assert values.mean() == pytest.approx(expected, abs=4 * error + 1e-4 * expected)
    assert error < 2e-3 * expected, "the integrand should hardly vary over the Gaussian"


def test_direct_light_in_clear_medium_equals_stock_path() -> None:
    """Without absorption and scattering the picture is what Mitsuba's own ``path`` renders."""
    tank = Tank(groove_scene())
    camera = tank.make_camera(jitter=True)
    ours = SheetIntegrator(mi.Properties())
    ours.configure(DRY, tank.sheets, 0.0)
    mine = parts(render(tank, camera, ours, 64, range(RUNS)), 4)
    stock = {"type": "path", "max_depth": 2}
    theirs = parts(render(tank, camera, stock, 256, range(100, 100 + RUNS)), 4)
    assert not differ(mine, theirs)
    assert differ(1.02 * mine, theirs), "a line 2 % brighter is seen"


def test_line_and_veil_in_turbid_water_equal_stock_volpaths() -> None:
    """Both legs' losses and one scattering: the line on the floor and the veil above it are
    what stock ``volpath`` renders up to its second vertex."""
    tank = Tank(floor_scene())
    water = one_lobe(4e-4, 1e-3, 0.6)
    ours = SheetIntegrator(mi.Properties())
    ours.configure(water, tank.sheets, 0.0)
    mine = render(tank, tank.make_camera(jitter=True), ours, 64, range(RUNS))
    stock = {"type": "volpath", "max_depth": 2, "rr_depth": 100}
    camera = tank.make_camera(medium=stock_medium(water), jitter=True)
    theirs = render(tank, camera, stock, 512, range(100, 100 + RUNS))

    ours.configure(DRY, tank.sheets, 0.0)
    floor = render(tank, tank.make_camera(jitter=True), ours, 16, range(1))[0]
    line, above = floor > 0.3 * floor.max(), floor < 1e-6 * floor.max()

    def of(pictures: Floats) -> Floats:
        return np.column_stack([pictures[:, mask].sum(axis=1) for mask in (line, above)])

    assert not differ(of(mine), of(theirs))
    assert differ(of(mine) * [1.04, 1], of(theirs)), "a line 4 % brighter is seen"
    assert differ(of(mine) * [1, 1.1], of(theirs)), "a veil 10 % brighter is seen"
