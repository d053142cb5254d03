"""Tables of functions of the pixel: closed forms, what is not smooth, and a map's own sigma."""

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import View, board_points, paper_board, read_board

from lscan.calibration.maps.refractive import Refractive, solver
from lscan.calibration.marks import Region
from lscan.calibration.physical import BLOCK, SHARE, PhysicalMap, PixelTable, pixel_table
from lscan.config.rig import OpticsSection, SinceSection
from lscan.records import Floats

CORNERS = np.array([[40.0, 10.0], [580.0, 30.0], [600.0, 440.0], [20.0, 400.0]])
REGION = Region(CORNERS, 2.0)
LOW, HIGH = REGION.bounds_px


def somewhere(count: int, seed: int = 1) -> Floats:
    """Pixels of the rectangle about the region."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (count, 2))


def table_of(values: object) -> PixelTable:
    table = pixel_table(values, REGION)  # type: ignore[arg-type]
    assert table is not None
    return table


def test_the_rectangle_holds_the_region() -> None:
    np.testing.assert_array_equal(LOW, [18.0, 8.0])
    np.testing.assert_array_equal(HIGH, [602.0, 442.0])


@examples(25)
@given(st.lists(st.floats(-1e3, 1e3), min_size=16, max_size=16))
def test_cubics_are_exact(coefficients: list[float]) -> None:
    """Four coefficients along each axis hold every polynomial of the third degree."""
    matrix = np.array(coefficients).reshape(4, 4)

    def cubic(px: Floats) -> Floats:
        u, v = ((px - LOW) / (HIGH - LOW)).T
        return np.polynomial.polynomial.polyval2d(u, v, matrix)[:, None]

    table, px = table_of(cubic), somewhere(200)
    assert len(table.coefficients) == 4
    scale = np.abs(matrix).sum()
    np.testing.assert_allclose(table.look_up(px), cubic(px), atol=1e-13 * scale, rtol=0)


@pytest.mark.parametrize("pole", [1.5, 2.5, 4.0])
def test_analytic_functions_are_within_the_share(pole: float) -> None:
    """A pole beside the rectangle: the nearer, the more coefficients.  The nodes of the next
    order judge; between them an error of Chebyshev's is at most twice as large."""

    def function(px: Floats) -> Floats:
        u, v = (2 * (px - LOW) / (HIGH - LOW) - 1).T
        return np.stack([1 / (pole - u * v), np.sin(3 * u) + v**2], axis=1)

    px = somewhere(2000)
    error = np.abs(table_of(function).look_up(px) - function(px)).max()
    assert error <= 2 * SHARE * np.abs(function(px)).max()


@pytest.mark.parametrize("function", [
    lambda px: np.abs(px[:, :1] - 300.0),
    lambda px: np.where(px[:, :1] > 500.0, np.nan, 1.0),
    lambda px: (px[:, :1] > 300.0) * 1.0,
])  # fmt: skip
def test_what_is_not_smooth_has_no_table(function: object) -> None:
    assert pixel_table(function, REGION) is None  # type: ignore[arg-type]


def test_no_values_and_no_pixels() -> None:
    table = table_of(lambda px: np.zeros((len(px), 0)))
    assert table.look_up(somewhere(5)).shape == (5, 0)
    assert table_of(lambda px: px).look_up(np.zeros((0, 2))).shape == (0, 2)


@examples(25)
@given(st.integers(0, 3 * BLOCK), st.integers(0, 3 * BLOCK))
def test_a_pixel_has_the_same_bytes_in_any_company(first: int, count: int) -> None:
    table = table_of(lambda px: np.sin(px / 200) @ np.arange(1.0, 15.0).reshape(2, 7))
    px = somewhere(3 * BLOCK)
    part = slice(first, first + count)
    np.testing.assert_array_equal(table.look_up(px)[part], table.look_up(px[part]))


def solved_map() -> Refractive:
    view = View()
    reading = read_board(paper_board(), view.project, 0.02, np.random.default_rng(3))
    known = OpticsSection(focal_px=(850.0, 20.0), gap_mm=(10.0, 1.0), board_tilt_deg=0.1)
    return solver.solve(reading, "", known)


def test_a_maps_sigma_is_that_without_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each mode is within SHARE (twice, between the nodes) of the largest; a variance, the sum of
    M squares of at most that size, within 2 M 2 SHARE of the largest square."""
    solved, image = solved_map(), View().project(board_points(300, seed=2))
    quick = solved.to_plane(image, np.full(300, 0.1))
    assert solved._tables is not None and all(solved._tables)
    monkeypatch.setattr("lscan.calibration.physical.pixel_table", lambda *_: None)
    exact = solved.model_copy().to_plane(image, np.full(300, 0.1))
    np.testing.assert_array_equal(quick.xz_mm, exact.xz_mm)
    assert quick.modes_mm is not None and exact.modes_mm is not None
    largest = np.nanmax(np.abs(exact.modes_mm))
    np.testing.assert_allclose(quick.modes_mm, exact.modes_mm, rtol=0, atol=2 * SHARE * largest)
    count = exact.modes_mm.shape[2]
    greatest = np.nanmax(exact.sigma_mm**2)
    bound = 4 * (count + 2) * SHARE * greatest
    np.testing.assert_allclose(quick.sigma_mm**2, exact.sigma_mm**2, rtol=0, atol=bound)


def test_a_changed_map_has_tables_of_its_own() -> None:
    """What may have changed since adds to sigma also where the map has been asked before."""
    solved: PhysicalMap = solved_map()
    image = View().project(board_points(50, seed=2))
    before = solved.to_plane(image).sigma_mm
    since = solved.with_changes_since(SinceSection(sheet_shift_mm=2.0))
    assert (since.to_plane(image).sigma_mm[:, 1] > before[:, 1] + 0.1).all()
    np.testing.assert_array_equal(solved.to_plane(image).sigma_mm, before)
