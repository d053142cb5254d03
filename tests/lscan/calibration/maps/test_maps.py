"""Projective and polynomial maps, and what every plane map must do."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import BARREL, View, affine, board_points, paper_board, read_board, views

from lscan.calibration.maps.projective import solver as projective
from lscan.calibration.planemap import find_solver
from lscan.errors import BoardNotFound, InputError
from lscan.paper.experiment import METHODS
from lscan.records import BoardReading, Floats, Marks, RulerReading, Status

BOARD = paper_board()
MAPS = (*METHODS, "spline")


# --- closed forms -------------------------------------------------------------------------


@examples(25)
@given(view=views("perspective"))
def test_projective_is_exact_on_perspective_views(view: View) -> None:
    reading = read_board(BOARD, view.project)
    points = board_points(200, seed=1)
    answer = projective.solve(reading, "").to_plane(view.project(points))
    valued = answer.status == Status.OK
    assert valued.mean() > 0.5
    np.testing.assert_allclose(answer.xz_mm[valued], points[valued], rtol=0, atol=1e-9)


@pytest.mark.parametrize("order", range(1, 10))
def test_polynomial_is_exact_on_polynomials(order: int) -> None:
    """Marks whose board place is a polynomial of the pixel of just that order."""
    rng = np.random.default_rng(order)
    reading = read_board(BOARD, affine)
    i, j = np.indices((order + 1, order + 1)).reshape(2, -1)
    coefficients = rng.normal(0.0, 5.0, (2, len(i))) * (i + j <= order)

    def truth(image: Floats) -> Floats:
        a, b = ((image - [300.0, 230.0]) / 300.0).T
        return np.column_stack([np.sum(c[:, None] * a ** i[:, None] * b ** j[:, None], axis=0)
                                for c in coefficients])  # fmt: skip

    grid = replace(reading.grid, board_mm=truth(reading.grid.image_px))
    solved = find_solver(f"polynomial-{order}").solve(replace(reading, grid=grid, rulers=()))
    image = affine(board_points(200, seed=2))
    answer = solved.to_plane(image)
    assert (answer.status == Status.OK).all()
    np.testing.assert_allclose(answer.xz_mm, truth(image), rtol=0, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "noted_rms"), [("projective", 0.35), ("polynomial-3", 0.070), ("polynomial-5", 0.0022)]
)
def test_errors_computed_apart(name: str, noted_rms: float) -> None:
    """docs/explanation/physics.md, section 9, computed with other code on a view known only
    roughly; the higher the order, the more it matters: within a third."""
    points = board_points(4000, seed=3)
    solved = find_solver(name).solve(read_board(BOARD, BARREL.project))
    error = np.linalg.norm(solved.to_plane(BARREL.project(points)).xz_mm - points, axis=1)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(noted_rms, rel=1 / 3)


# --- every map ----------------------------------------------------------------------------


def _moved(reading: BoardReading, scale: float, shift: Floats) -> BoardReading:
    """The same picture of a board whose coordinates are scale * (x, z) + shift."""

    def move(marks: Marks) -> Marks:
        return replace(marks, board_mm=scale * marks.board_mm + shift)

    rulers = [
        RulerReading(r.direction, scale * r.at_mm + shift[r.direction != "vertical"], move(r.marks))
        for r in reading.rulers
    ]
    return replace(
        reading, pitch_mm=scale * reading.pitch_mm, grid=move(reading.grid), rulers=tuple(rulers)
    )


@pytest.mark.parametrize("name", MAPS)
@examples(2)
@given(
    view=views(),
    scale=st.floats(0.1, 10.0),
    shift=st.tuples(st.floats(-500, 500), st.floats(-500, 500)),
)
def test_equivariant_in_origin_and_pitch(
    name: str, view: View, scale: float, shift: tuple[float, float]
) -> None:
    reading = read_board(BOARD, view.project, 0.05, np.random.default_rng(4))
    image = view.project(board_points(60, seed=5))
    before = find_solver(name).solve(reading).to_plane(image)
    after = find_solver(name).solve(_moved(reading, scale, np.array(shift))).to_plane(image)
    np.testing.assert_array_equal(before.status, after.status)
    rounding = 1e-8 * max(1.0, scale)  # 1e-11 of the board's 450 mm, and slack for inverses
    np.testing.assert_allclose(after.xz_mm, scale * before.xz_mm + shift, rtol=0, atol=rounding)
    np.testing.assert_allclose(after.sigma_mm, scale * before.sigma_mm, rtol=1e-5)


@pytest.mark.parametrize("name", MAPS)
def test_order_of_points_is_kept(name: str) -> None:
    """Down a picture column z falls, along a picture row x rises, across every cell and from
    ruler to ruler."""
    reading = read_board(BOARD, View().project, 0.05, np.random.default_rng(6))
    solved = find_solver(name).solve(reading)
    for u in (100.0, 211.3, 402.0, 540.0):
        answer = solved.to_plane(np.column_stack([np.full(480, u), np.arange(480)]))
        valued = answer.status == Status.OK
        assert valued.sum() > 300
        assert (np.diff(answer.xz_mm[valued, 1]) < 0).all()
    for v in (40.0, 188.8, 300.0, 440.0):
        answer = solved.to_plane(np.column_stack([np.arange(640), np.full(640, v)]))
        valued = answer.status == Status.OK
        assert valued.sum() > 300
        assert (np.diff(answer.xz_mm[valued, 0]) > 0).all()


@pytest.mark.parametrize("name", MAPS)
@examples(3)
@given(view=views())
def test_no_value_outside_the_control_points(name: str, view: View) -> None:
    """Judged by OpenCV's hull of the marks: no pixel farther out than twice the margin of
    about 0.05 * 55 px has a value, and none fails whose cell has its four control points
    on lines of four marks, enough for every fit.  (First-order lines need not surround
    what a bent view shows.)"""
    reading = read_board(BOARD, view.project)
    solved = find_solver(name).solve(reading)
    hull = cv2.convexHull(reading.grid.image_px[reading.grid.found].astype(np.float32))
    rng = np.random.default_rng(7)
    image = np.column_stack([rng.uniform(-300, 940, 400), rng.uniform(-300, 780, 400)])
    depth = np.array([cv2.pointPolygonTest(hull, (u, v), True) for u, v in image])
    assert (solved.to_plane(image).status[depth < -6.0] == Status.OUT_OF_BOARD).all()
    if name == "graticule-1":
        return
    points = board_points(300, seed=9)
    column, row = (points / [50.0, -50.0]).astype(int).T
    found = reading.grid.found.reshape(reading.shape)
    found = found & (found.sum(axis=0) >= 4) & (found.sum(axis=1) >= 4)[:, None]
    whole = found[row, column] & found[row + 1, column]
    whole &= found[row, column + 1] & found[row + 1, column + 1]
    assert (solved.to_plane(view.project(points[whole])).status == Status.OK).all()


@pytest.mark.parametrize("name", MAPS)
def test_value_status_and_sigma_go_together(name: str) -> None:
    solved = find_solver(name).solve(read_board(BOARD, View().project, 0.05))
    image = np.array([[300.0, 200.0], [np.nan, 200.0], [5.0, 5.0], [np.inf, 9.0], [1e300, 0.0]])
    answer = solved.to_plane(image, np.array([0.1, np.nan, 0.1, 0.1, 0.1]))
    expected = [Status.OK, Status.NO_DATA, *3 * [Status.OUT_OF_BOARD]]
    assert answer.status.tolist() == expected
    assert np.isfinite(answer.xz_mm[0]).all()
    assert (answer.sigma_mm[0] > 0).all()
    assert np.isnan(answer.xz_mm[1:]).all()
    assert np.isnan(answer.sigma_mm[1:]).all()
    empty = solved.to_plane(np.empty((0, 2)))
    assert empty.xz_mm.shape == empty.sigma_mm.shape == (0, 2)


@pytest.mark.parametrize("name", MAPS)
def test_vectorised_is_one_by_one(name: str) -> None:
    """Equal to rounding: sums of another length may add in another order."""
    solved = find_solver(name).solve(read_board(BOARD, View().project, 0.05))
    image = View().project(board_points(25, seed=8))
    sigma = np.linspace(0.0, 0.3, 25)
    together = solved.to_plane(image, sigma)
    for k in range(25):
        alone = solved.to_plane(image[k : k + 1], sigma[k : k + 1])
        np.testing.assert_allclose(alone.xz_mm[0], together.xz_mm[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(alone.sigma_mm[0], together.sigma_mm[k], rtol=1e-9)


# --- refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["projective-2", "polynomial-0", "polynomial-x", "graticule-3", "refractive-2"]
)
def test_unknown_variant(name: str) -> None:
    with pytest.raises(InputError, match="allowed"):
        find_solver(name).solve(read_board(BOARD, affine))


@pytest.mark.parametrize(
    "name", ["projective", "polynomial-2", "polynomial-9", "graticule-1", "refractive"]
)
def test_a_single_row_is_no_board(name: str) -> None:
    missing = np.ones((10, 10), dtype=bool)
    missing[3] = False
    with pytest.raises(BoardNotFound):
        find_solver(name).solve(read_board(BOARD, affine, missing=missing.ravel()))


@pytest.mark.parametrize(
    ("image", "sigma", "said"),
    [
        (np.zeros(2), None, "image_px: bad shape"),
        (np.zeros((4, 3)), None, "image_px: bad shape"),
        (np.full((2, 2), 200.0), np.zeros(3), "sigma_px: bad shape"),
        (np.full((2, 2), 200.0), np.array([0.1, -0.1]), r"sigma_px\[1\]"),
        (np.full((2, 2), 200.0), np.array([np.nan, 0.1]), r"sigma_px\[0\]"),
    ],
)
def test_bad_arrays(image: Floats, sigma: Floats | None, said: str) -> None:
    solved = projective.solve(read_board(BOARD, affine), "")
    with pytest.raises(InputError, match=said):
        solved.to_plane(image, sigma)
