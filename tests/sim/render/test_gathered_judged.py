"""A whole picture of gathered light against the judge, and what the comparison would notice."""

from itertools import pairwise

import numpy as np
import pytest

from lscan.records import Floats
from sim.render.gathered import picture
from sim.render.tank import Tank
from sim.scene import load_scene
from tests.validation.light.gallery import shrunk
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


def test_a_picture_is_the_judges() -> None:
    """The paper's groove at 1 NTU in a picture of 160 by 120 px: no band of rows is off by more
    than three standard errors and TABLES."""
    none = {"particle_absorption_per_m": None, "particle_scattering_per_m": None}
    tank = Tank(shrunk(load_scene("paper/groove"), 4).with_tank(water={**none, **TURBID}))
    light = sum(tank.higher_orders(POSITION_MM).values())[:, LEFT:RIGHT].mean(axis=1)
    bands: Floats = np.array([light[low:end].mean() for low, end in pairwise(ROWS)])
    assert np.all(np.abs(bands - JUDGED) < 3 * ERRORS + TABLES * JUDGED)


@pytest.mark.slow
def test_what_the_water_scatters_is_reflected_from_where_it_lands() -> None:
    """In a trough of the sandwave, at b d = 2, within 12 rows of the line: 3 %, the bar of such
    places, and two standard errors of 1.4 %.  Were all of it reflected from the line, as without
    spreading, there would be 8 % too much.  What the judge finds there, W/(m2 sr):
    JudgeEffort(1 << 18, 128, 4), seed=3."""
    case = light_case("sandwave", 2.0, np.random.default_rng([91, 2]), 48, 24)
    left, top, width, height = case.window[0] + 9, case.window[1], 14, case.window[3]
    ours = np.asarray(sum(Tank(case.scene).higher_orders(case.position_mm).values()))
    columns = slice(left, left + width)
    row = np.arange(top, top + height)[:, np.newaxis]
    near = np.abs(row - case.truth.centre_px[columns]) < 12
    mean, error = 2.3305e-3, 3.23e-5
    found = ours[top : top + height, columns][near].mean()
    assert abs(found - mean) < 0.03 * mean + 2 * error


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
    away = {"laser": {"apex_mm": (x, y + 2000.0, z)}, "light": {"ambient_w_m2_sr": 0.0}}
    light = Tank(scene.with_tank(**away)).render(POSITION_MM, 1)
    assert np.all(light.direct == 0)
    assert np.all(np.isfinite(light.scattered)) and light.scattered.max() > 0
