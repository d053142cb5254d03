"""A whole picture of gathered light against the judge, and what the comparison would notice."""

from collections.abc import Iterator
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from lscan.records import Floats
from sim.render.firstorder import HEAD
from sim.render.gathered import picture, surfaces as reflections
from sim.render.gathered.halo import CameraLeg
from sim.render.gathered.line import Glow
from sim.render.gathered.picture import GatheredLight
from sim.render.spreads import spread_of
from sim.render.tank import Tank
from sim.scene import load_scene
from sim.scene.matter import Water
from sim.water import water_optics
from tests.validation.light.gallery import shrunk
from tests.validation.light.judge import JudgeEffort, judge
from tests.validation.light.rigs import light_case

TURBID = {"kind": "tank", "turbidity_ntu": 1.0, "phase": "henyey-greenstein", "asymmetry": 0.9}
LEFT, RIGHT = 48, 96
POSITION_MM = 1.0
# Rows between which light is summed.  The line on the block is at row 89, in its groove below.
ROWS = (0, 24, 48, 64, 80, 88, 96, 104, 112, 120)
# What the judge finds there, W/(m2 sr), and its standard errors:
# judge(tank, POSITION_MM, (LEFT, 0, RIGHT - LEFT, 120), JudgeEffort(1 << 20, 40, 8), seed=5).total
JUDGED = np.array(
    [6.364e-5, 9.406e-5, 1.786e-4, 3.260e-4, 8.898e-4, 1.572e-3, 9.702e-4, 4.748e-4, 3.154e-4]
)
ERRORS = np.array([2.6e-6, 2.1e-6, 4.8e-6, 8.5e-6, 2.0e-5, 1.6e-5, 1.4e-5, 1.2e-5, 9.6e-6])
# Of few photons, tables are noisy by 3 %, and the kernel's Gaussians are 2 % off between angles.
TABLES = 0.05


@pytest.fixture(scope="module")
def module_tank() -> Tank:
    """The paper's groove at 1 NTU in a picture of 160 by 120 px."""
    none = {"particle_absorption_per_m": None, "particle_scattering_per_m": None}
    tank = Tank(shrunk(load_scene("paper/groove"), 4).with_tank(water={**none, **TURBID}))
    tank.higher_orders(POSITION_MM)
    return tank


@pytest.fixture
def tank(module_tank: Tank, monkeypatch: pytest.MonkeyPatch) -> Iterator[Tank]:
    """Its legs are as before after each test."""
    for leg in ("_camera", "_glows"):
        monkeypatch.setattr(module_tank._gathered, leg, getattr(module_tank._gathered, leg))
    yield module_tank


def gathered(tank: Tank) -> GatheredLight:
    assert tank._gathered is not None
    return tank._gathered


def is_judges(tank: Tank) -> bool:
    """Whether no band of rows is off by more than three standard errors and TABLES."""
    light = sum(tank.higher_orders(POSITION_MM).values())[:, LEFT:RIGHT].mean(axis=1)
    bands: Floats = np.array([light[low:end].mean() for low, end in pairwise(ROWS)])
    return bool(np.all(np.abs(bands - JUDGED) < 3 * ERRORS + TABLES * JUDGED))


def with_tables_of(tank: Tank, water: Water) -> None:
    """Light spreads as in another water, as far as its tables say."""
    light, extinction = gathered(tank), tank.water.extinction_per_mm
    spread = spread_of(water_optics(water, tank.scene.tank.laser.wavelength_nm))
    for sheet in tank.sheets:
        sheet.place(HEAD)
    light._camera = CameraLeg(light._chart, spread, extinction)
    light._glows = [Glow(sheet, spread, extinction) for sheet in tank.sheets]


@pytest.mark.slow
def test_a_picture_is_the_judges(tank: Tank) -> None:
    assert is_judges(tank)


@pytest.mark.slow
@pytest.mark.parametrize("asymmetry", [0.88, 0.92])
def test_another_asymmetry_is_noticed(tank: Tank, asymmetry: float) -> None:
    with_tables_of(tank, Water(**{**TURBID, "asymmetry": asymmetry}))
    assert not is_judges(tank)


@pytest.mark.slow
@pytest.mark.parametrize(
    "water", [Water(kind="harbor"), Water(**{**TURBID, "turbidity_ntu": 2.0})], ids=["harbor", "2"]
)
def test_the_table_of_another_water_is_noticed(tank: Tank, water: Water) -> None:
    with_tables_of(tank, water)
    assert not is_judges(tank)


@pytest.mark.slow
def test_a_missing_leg_of_the_laser_is_noticed(tank: Tank, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Glow, "irradiance", lambda *_: mi.Float(0))
    assert not is_judges(tank)


@pytest.mark.slow
def test_a_missing_leg_of_the_camera_is_noticed(
    tank: Tank, monkeypatch: pytest.MonkeyPatch
) -> None:
    halo, near = CameraLeg.halo, CameraLeg.near_gain
    monkeypatch.setattr(CameraLeg, "halo", lambda *given: 0 * halo(*given))
    monkeypatch.setattr(CameraLeg, "near_gain", lambda *given: 0 * near(*given))
    monkeypatch.setattr(CameraLeg, "near_peaked", lambda _, radiance, *others: 0 * radiance)
    assert not is_judges(tank)


@pytest.mark.slow
def test_missing_shadows_are_noticed(tank: Tank, monkeypatch: pytest.MonkeyPatch) -> None:
    """The sheet's own water lights the groove's floor through the block."""

    def everywhere(*given: object) -> mi.Float:
        point = given[3]
        return dr.full(mi.Float, 1.0, dr.width(point))

    monkeypatch.setattr(reflections, "visible_share", everywhere)
    assert not is_judges(tank)


@pytest.mark.slow
def test_what_the_water_scatters_is_reflected_from_where_it_lands() -> None:
    """In a trough of the sandwave, at b d = 2, within 12 rows of the line: 3 %, the bar of such
    places, and two standard errors of 1.3 %.  Were all of it reflected from the line, as without
    spreading, there would be 8 % too much."""
    case = light_case("sandwave", 2.0, np.random.default_rng([91, 2]), 48, 24)
    left, top, width, height = case.window[0] + 9, case.window[1], 14, case.window[3]
    tank = Tank(case.scene)
    effort = JudgeEffort(photons=1 << 18, walks=128, batches=4)
    judged = judge(tank, case.position_mm, (left, top, width, height), effort, seed=3).total
    ours = np.asarray(sum(tank.higher_orders(case.position_mm).values()))
    columns = slice(left, left + width)
    row = np.arange(top, top + height)[:, np.newaxis]
    near = np.abs(row - case.truth.centre_px[columns]) < 12
    batches = judged[:, near].mean(axis=1)
    mean, error = batches.mean(), batches.std(ddof=1) / 2
    found = ours[top : top + height, columns][near].mean()
    assert abs(found - mean) < 0.03 * mean + 2 * error
    assert error < 0.02 * mean


@pytest.mark.slow
def test_scattered_light_on_the_line_is_the_mean_down_each_pixel(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """On steep flanks the line is 1.4 mm wide and a pixel sees 3.5 mm.  Four of 13 rows or more lie
    within such a width, to the edges of which a sum is off by 1 part in 50; the light in the
    pixel's middle may be twice the mean.  An edge through a pixel cuts the lattice of its samples,
    13 a column, to one of them."""
    case = light_case("sandwave", 2.0, np.random.default_rng([91, 2]), 48, 24)
    left, top, width, height = case.window
    tank, edges = Tank(case.scene), []
    cut = picture._cut_pixels
    monkeypatch.setattr(picture, "_cut_pixels", lambda *of: edges.append(of[1]) or cut(*of))
    found = {}
    for rows in (picture.LINE_ROWS, 100, 1):
        monkeypatch.setattr(picture, "LINE_ROWS", rows)
        light = tank.higher_orders(case.position_mm)["surfaces"]
        found[rows] = light[top : top + height, left : left + width]
    ours, exact, middle = found.values()
    bent = edges[0][top : top + height, left : left + width]
    off = np.abs(ours - exact) / exact.max()
    assert off[~bent].max() < 0.02
    assert off.max() < 1 / 13
    assert np.abs(middle - exact).max() > 0.2 * exact.max()


@pytest.mark.slow
def test_a_picture_is_gathered_whose_line_is_out_of_view() -> None:
    """Two metres beside the camera; what the water scatters is still seen."""
    scene = shrunk(load_scene("paper/sandwave"), 4)
    x, y, z = scene.tank.laser.apex_mm
    light = Tank(scene.with_tank(laser={"apex_mm": (x, y + 2000.0, z)})).render(POSITION_MM, 1)
    assert np.all(light.direct == 0)
    assert np.all(np.isfinite(light.scattered)) and light.scattered.max() > 0
