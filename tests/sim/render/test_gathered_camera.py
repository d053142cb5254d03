"""The camera's leg: halos of small patches of light, and of even light, against the tables."""

from math import pi

import mitsuba as mi
import numpy as np
import pytest
from gathered_cases import WATER, beside_a_beam, small_view, spread

from sim.render.gathered import halo as charts
from sim.render.gathered.halo import (
    CameraLeg,
    Chart,
    ChartGrid,
    Picture,
    Shining,
    make_chart,
    summed_in_cells,
)
from sim.render.gathered.picture import _splat
from sim.render.plugins.arrays import floats
from sim.scene import Head, load_scene

# Gaussians in the kernel's place are 2 to 3 % off between its angles (its own test).
GAUSSIANS = 0.03


@pytest.fixture(scope="module")
def chart() -> Chart:
    return small_view()[1]


@pytest.fixture(scope="module")
def leg(chart: Chart) -> CameraLeg:
    return CameraLeg(chart, spread(), WATER.extinction_per_mm)


class TiltedPlane:
    """A plane through the middle of a fine cell, seen from the chart's pivot."""

    def __init__(
        self, chart: Chart, at: tuple[int, int], distance: float, tilt: float, towards: float
    ) -> None:
        """At (column, row); towards: the tilt's azimuth from the right."""
        self.chart, self.distance, self.at, self.cosine = chart, distance, at, np.cos(tilt)
        index = at[1] * chart.inner.shape[1] + at[0]
        grid = chart.inner
        self.centre = grid.directions[:, index]
        right, down = grid.right[:, index], grid.down[:, index]
        across = np.cos(towards) * right + np.sin(towards) * down
        self.normal = -np.cos(tilt) * self.centre + np.sin(tilt) * across
        x, y = right @ grid.directions, down @ grid.directions
        self.angle = np.arccos(np.clip(self.centre @ grid.directions, -1, 1)).reshape(grid.shape)
        # The beam passes the patch on the other side of where it aims.
        self.azimuth = pi + np.arctan2(y, x).reshape(grid.shape) - towards

    def shining(self, grid: ChartGrid, power: Picture) -> Shining:
        facing = np.minimum(self.normal @ grid.directions, -0.05)
        distance = self.distance * (self.centre @ self.normal) / facing
        normal = np.broadcast_to(self.normal.astype(np.float32), (*grid.shape, 3))
        return summed_in_cells(power, distance.reshape(grid.shape).astype(np.float32), normal)

    def patch(self, power: float = 1.0) -> list[Shining]:
        """Light in three by three cells, and none in the coarse grid: it takes the fine one's."""
        inner, outer = (np.zeros(g.shape, np.float32) for g in (self.chart.inner, self.chart.outer))
        column, row = self.at
        inner[row - 1 : row + 2, column - 1 : column + 2] = power / 9
        return [self.shining(self.chart.inner, inner), self.shining(self.chart.outer, outer)]


@pytest.mark.parametrize(
    ("at", "tilt", "distance"),
    [((72, 56), 0.0, 600.0), ((36, 28), 0.6, 1200.0), ((72, 56), 1.2, 1200.0)],
)
def test_a_patch_has_the_waters_halo(
    chart: Chart, leg: CameraLeg, at: tuple[int, int], tilt: float, distance: float
) -> None:
    """Power times what a beam brings to the tilted patch, over its cosine; rays start nearer to it
    than the chart's pivot, so that their angles are wider.  Means over rings that are an octave
    wide within GAUSSIANS, single cells within twice that."""
    plane = TiltedPlane(chart, at, distance, tilt, 0.4)
    halo = leg.halo(*plane.patch(2.0))
    angle = plane.angle * (1 + chart.near_mm / distance)
    light = beside_a_beam(angle, plane.azimuth, distance, plane.cosine)
    ratio = halo / (2.0 * light / plane.cosine)
    cells = plane.angle / chart.inner.cell
    for nearest in (4, 8, 16, 32):
        ring = ratio[(cells > nearest) & (cells < 2 * nearest)]
        assert ring.mean() == pytest.approx(1, abs=GAUSSIANS)
        assert ring.std() < 2 * GAUSSIANS


def even_light(chart: Chart, leg: CameraLeg, distance: float) -> float:
    """Scattered radiance in the middle of a sphere of the radiance 1 about the pivot."""
    shining = []
    for grid in (chart.inner, chart.outer):
        full = np.full(grid.shape, distance - chart.near_mm, np.float32)
        normal = -grid.directions.T.reshape(*grid.shape, 3).astype(np.float32)
        shining.append(summed_in_cells(grid.solid_angle * np.float32(distance**2), full, normal))
    rows, columns = chart.inner.shape
    height, width = chart.pixel_rad.shape
    away = floats(np.full(height * width, distance - chart.near_mm))
    near = np.array(leg.near_gain(away)).reshape(height, width)[height // 2, width // 2]
    return float(leg.halo(*shining)[rows // 2, columns // 2] + near)


def test_even_light_is_scattered_as_a_whole(
    chart: Chart, leg: CameraLeg, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The integral over all directions of the chart, whatever part of it narrow Gaussians are:
    those with a cell's width trade places where cells are half as wide, to 1 %."""
    distance = 800.0
    angle = np.geomspace(1e-7, 0.9, 1200)
    start = distance - chart.near_mm
    wider = angle * (1 + chart.near_mm / start)
    light = beside_a_beam(wider, np.zeros(1), start, 1.0) * distance**2
    expected = np.trapezoid(light * 2 * pi * np.sin(angle), angle)
    found = even_light(chart, leg, distance)
    assert found == pytest.approx(expected, rel=GAUSSIANS)
    monkeypatch.setattr(charts, "CELLS", 288)
    rays, _ = small_view()
    finer = make_chart(rays, paper_head())
    assert finer.inner.cell == pytest.approx(chart.inner.cell / 2, rel=0.01)
    other = even_light(finer, CameraLeg(finer, spread(), WATER.extinction_per_mm), distance)
    assert other == pytest.approx(found, rel=0.01)


def paper_head() -> Head:
    return load_scene("paper/sandwave").tank.head


def test_narrow_gaussians_move_light_and_keep_it(chart: Chart, leg: CameraLeg) -> None:
    """Even light needs no correction; of a line's they leave the sum, but for what pixels' sizes
    differ by from row to row, and its middle loses."""
    shape = chart.pixel_rad.shape
    distance = np.full(shape, 800.0, np.float32)
    facing = np.zeros((*shape, 2), np.float32)
    even = leg.near_peaked(np.ones(shape, np.float32), distance, facing)
    gain = np.array(leg.near_gain(floats(distance))).reshape(shape)
    # Pixels' sizes alone make light uneven.
    assert np.abs(even).max() < 0.01 * gain.max()
    line = np.zeros(shape, np.float32)
    line[60] = 1
    change = leg.near_peaked(line, distance, facing)
    assert np.all(change[60] < 0) and np.all(change[59:62:2] > 0)
    assert np.abs(change[:, 20:-20].sum()) < 1e-3 * np.abs(change[60, 20:-20]).sum()
    np.testing.assert_allclose(leg.near_peaked(2 * line, distance, facing), 2 * change, rtol=1e-5)


def test_one_cells_halo_is_even(chart: Chart, leg: CameraLeg) -> None:
    """As bright on the right as on the left, and above as below, of a surface that faces the
    camera.  Grids are doubled by a quadratic spline, which moves no light; the cubics of OpenCV
    move it by up to 0.05 cells, which is 3 % here."""
    plane = TiltedPlane(chart, (72, 56), 900.0, 0.0, 0.0)
    inner, outer = (np.zeros(grid.shape, np.float32) for grid in (chart.inner, chart.outer))
    inner[56, 72] = 1
    halo = leg.halo(plane.shining(chart.inner, inner), plane.shining(chart.outer, outer))
    for away in (5, 8, 12, 16, 24, 32):
        right, left = halo[56, 72 + away], halo[56, 72 - away]
        below, above = halo[56 + away, 72], halo[56 - away, 72]
        assert left == pytest.approx(right, rel=0.01)
        assert above == pytest.approx(below, rel=0.01)


@pytest.mark.parametrize("tilt", [0.0, 1.0])
def test_a_line_on_a_tilted_plane_shines_more_to_one_side(
    chart: Chart, leg: CameraLeg, tilt: float
) -> None:
    """Pixels above and below a line have the sum of what beams would bring to it, and, close to the
    line, the ratio of both sides is that of beams to half of GAUSSIANS: both errors are of the same
    Gaussians.  Without the first harmonic of the narrow ones it is 2.6 % off 2 px away."""
    rows, columns = chart.pixel_rad.shape
    row, distance = rows // 2, 900.0
    plane = TiltedPlane(chart, (72, 56), distance, tilt, pi / 2)
    rays, _ = small_view()
    way = np.array(rays.direction, dtype=float).reshape(3, rows + 2, columns + 2)[:, 1:-1, 1:-1]
    line = way[:, row]
    far = distance * (plane.centre @ plane.normal) / (plane.normal @ line)
    power = (chart.pixel_rad[row] * (far + chart.near_mm)) ** 2
    points = chart.inner.pivot[:, np.newaxis] + line * (far + chart.near_mm)
    upright = np.repeat(plane.normal[:, np.newaxis], columns, axis=1)
    cells = [_splat(grid, chart, points, upright, power) for grid in (chart.inner, chart.outer)]
    radiance = np.zeros((rows, columns), np.float32)
    radiance[row] = 1
    leans = np.zeros((rows, columns, 2), np.float32)
    leans[row] = chart.tilt(upright.T.astype(np.float32), line.astype(np.float32))
    even = np.broadcast_to(far.astype(np.float32), radiance.shape)
    near = np.array(leg.near_gain(floats(even))).reshape(rows, columns) * radiance
    near += leg.near_peaked(radiance, even, leans)
    wide = mi.Texture2f(mi.TensorXf(leg.halo(*cells)[..., np.newaxis]), use_accel=False)
    found = {}
    for away in (-16, -8, -4, -2, 2, 4, 8, 16):
        at, here = (row + away, columns // 2), way[:, row + away, columns // 2]
        place = mi.Point2f(*((chart.pixels[:, *at] + 0.5) / chart.inner.shape[::-1]).tolist())
        (halo,) = wide.eval_cubic(place)
        angle = np.arccos(np.clip(here @ line, -1, 1))
        away_from_beam = (line * np.cos(angle) - here[:, np.newaxis]) / np.sin(angle)
        cosine = -(plane.normal @ line)
        leaning = plane.normal @ away_from_beam / np.sqrt(np.maximum(1 - cosine**2, 1e-9))
        wider, chi = angle * (1 + chart.near_mm / far), np.arccos(np.clip(leaning, -1, 1))
        light = [beside_a_beam(*of) for of in zip(wider, chi, far, cosine, strict=True)]
        expected = (power / cosine * np.array(light)).sum()
        found[away] = (near[at] + float(halo[0])) / expected
    assert list(found.values()) == pytest.approx([1.0] * len(found), abs=GAUSSIANS)
    for away in (2, 4):
        assert found[away] / found[-away] == pytest.approx(1, abs=GAUSSIANS / 2)
