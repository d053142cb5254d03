"""The chart of the camera's view: a conformal map of directions."""

import numpy as np
import pytest
from gathered_cases import small_view

from lscan.records import Floats
from sim.render.gathered.halo import Chart, ChartGrid, cells_in_picture


@pytest.fixture(scope="module")
def chart() -> Chart:
    return small_view()[1]


@pytest.fixture(params=["inner", "outer"])
def grid(chart: Chart, request: pytest.FixtureRequest) -> ChartGrid:
    found = getattr(chart, request.param)
    assert isinstance(found, ChartGrid)
    return found


def places(grid: ChartGrid, count: int = 300) -> Floats:
    """(2, N) columns and rows anywhere on a grid."""
    rows, columns = grid.shape
    return np.random.default_rng(5).uniform(0, 1, (2, count)) * [[columns - 1], [rows - 1]]


def test_chords_are_the_charts_lengths(chart: Chart, grid: ChartGrid) -> None:
    """2 sin(q / 2) = |z1 - z2| c1 c2, of any two cells' middles."""
    rows, columns = grid.shape
    one, two = np.random.default_rng(4).integers(0, rows * columns, (2, 500))
    chord = np.linalg.norm(grid.directions[:, one] - grid.directions[:, two], axis=0)
    (row1, column1), (row2, column2) = (np.divmod(cell, columns) for cell in (one, two))
    length = grid.cell * np.hypot(row1 - row2, column1 - column2)
    c = grid.half_cosine.ravel()
    np.testing.assert_allclose(chord, length * c[one] * c[two], rtol=1e-5, atol=1e-7)


def test_places_and_directions_are_each_others(chart: Chart, grid: ChartGrid) -> None:
    """However far away, and a cell's middle has the cell's own direction."""
    there = places(grid)
    way = chart.between(grid, there)
    np.testing.assert_allclose(np.linalg.norm(way, axis=0), 1, rtol=1e-12)
    for distance in (50.0, 3000.0):
        found = chart.place(grid, grid.pivot[:, np.newaxis] + distance * way)
        np.testing.assert_allclose(found, there, atol=1e-8)
    row, column = (3, 17)
    middle = chart.between(grid, np.array([[column], [row]], dtype=float))[:, 0]
    np.testing.assert_allclose(middle, grid.directions[:, row * grid.shape[1] + column], atol=1e-12)


def test_solid_angles_add_up(chart: Chart, grid: ChartGrid) -> None:
    """To that of the grid's outline, by the Euler-Eriksson formula for the two halves of each of
    its cells; a cell of 0.02 rad is flat to 1e-3 at the outermost."""
    rows, columns = grid.shape
    x, y = np.meshgrid(np.arange(columns + 1) - 0.5, np.arange(rows + 1) - 0.5)
    way = chart.between(grid, np.stack([x.ravel(), y.ravel()])).T.reshape(*x.shape, 3)
    a, b, c, d = way[:-1, :-1], way[:-1, 1:], way[1:, 1:], way[1:, :-1]

    def triangle(u: Floats, v: Floats, w: Floats) -> Floats:
        volume = np.einsum("...i,...i->...", u, np.cross(v, w))
        below = 1 + sum(np.einsum("...i,...i->...", *p) for p in ((u, v), (v, w), (w, u)))
        return np.asarray(2 * np.arctan2(volume, below))

    exact = np.abs(triangle(a, b, c) + triangle(a, c, d))
    np.testing.assert_allclose(grid.solid_angle, exact, rtol=1e-3)
    assert grid.solid_angle.sum() == pytest.approx(exact.sum(), rel=1e-3)


def test_pixels_lie_where_their_rays_point() -> None:
    """A ray of a pixel goes through its place, but for the port: rays miss the pivot by less than
    a millimetre, and far away all directions from there are theirs."""
    rays, chart = small_view()
    way, origin = (np.array(v, dtype=float) for v in (rays.direction, rays.origin))
    offset = origin - chart.inner.pivot[:, np.newaxis]
    along = (offset * way).sum(axis=0)
    assert np.linalg.norm(offset - along * way, axis=0).max() < 1
    assert along.mean() == pytest.approx(chart.near_mm, abs=1e-6)
    far = chart.inner.pivot[:, np.newaxis] + 1000 * way
    found = chart.place(chart.inner, far).reshape(2, *rays.size_px[::-1])[:, 1:-1, 1:-1]
    np.testing.assert_allclose(chart.pixels, found, atol=1e-4)
    height, width = chart.pixel_rad.shape
    square = way.reshape(3, *rays.size_px[::-1])[:, height // 2 + 1, width // 2 + 1 :][:, :2]
    angle = np.linalg.norm(square[:, 1] - square[:, 0])
    assert chart.pixel_rad[height // 2, width // 2] == pytest.approx(angle, rel=0.01)


def test_cells_lie_where_the_picture_shows_them(chart: Chart) -> None:
    """A picture of the pixels' own places on the chart, read at a cell, gives the cell's number:
    to a 32nd of a pixel, to which places are rounded.  Cells outside lie beyond the picture's
    outline, or within a pixel of it, for the outline is taken as straight between every eighth."""
    cells = cells_in_picture(chart)
    x, y = chart.pixels
    row, column = np.nonzero(cells.inside)
    side = float(np.ptp(x)) / (x.shape[1] - 1)
    for picture, number in ((x, column), (y, row)):
        np.testing.assert_allclose(cells.read(picture), number, atol=side / 32)
    row, column = np.nonzero(~cells.inside)
    within = (column > x.min(axis=1).max() + side) & (column < x.max(axis=1).min() - side)
    within &= (row > y.min(axis=0).max() + side) & (row < y.max(axis=0).min() - side)
    assert not within.any()
    assert all(box % 2 == 1 for box in cells.box_px)
