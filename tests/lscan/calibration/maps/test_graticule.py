"""The graticule: closed forms, the paper's tables, error bounds, gaps, sensitivity."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given
from planeviews import BARREL, View, affine, board_points, paper_board, read_board, views

from lscan.calibration.maps.graticule import (
    VARIANTS,
    Graticule,
    LineSet,
    graticule_lines,
    ruler_conversions,
    solver,
)
from lscan.calibration.maps.graticulelines import GridLine, fit_lines
from lscan.config.board import Board
from lscan.errors import BoardNotFound
from lscan.records import BoardReading, Floats, Marks, Status

BOARD = paper_board()
GRID_MM = BOARD.grid.points_mm()


def rms(errors: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def distance_errors(graticule: Graticule, reading: BoardReading) -> Floats:
    """Measured less nominal of the distances of Table I, mm."""
    ends = [[reading.dots[name].image_px for name in pair] for pair in BOARD.distances]
    points = graticule.to_plane(np.array(ends).reshape(-1, 2)).xz_mm.reshape(-1, 2, 2)
    measured = np.linalg.norm(points[:, 0] - points[:, 1], axis=1)
    return measured - [BOARD.distance_mm(*pair) for pair in BOARD.distances]


def diameter_errors(graticule: Graticule, reading: BoardReading) -> Floats:
    """Measured less nominal of the diameters of Table II, mm, by algebraic circle fits."""
    errors = []
    for ring in BOARD.ring:
        points = graticule.to_plane(reading.rings[ring.name].image_px).xz_mm
        system = np.column_stack([2 * points, np.ones(len(points))])
        a, b, c = np.linalg.lstsq(system, (points**2).sum(axis=1), rcond=None)[0]
        errors.append(2 * np.sqrt(c + a**2 + b**2) - ring.diameter_mm)
    return np.array(errors)


# --- closed forms -------------------------------------------------------------------------


@pytest.mark.parametrize("variant", VARIANTS)
def test_affine_view_is_exact(variant: str) -> None:
    graticule = solver.solve(read_board(BOARD, affine), variant)
    points = board_points(300, seed=1)
    answer = graticule.to_plane(affine(points))
    assert (answer.status == Status.OK).all()
    np.testing.assert_allclose(answer.xz_mm, points, rtol=0, atol=1e-8)
    np.testing.assert_allclose(answer.sigma_mm, 0.0, atol=1e-7)


@pytest.mark.parametrize("turns", [1, 2, 3])
@pytest.mark.parametrize("variant", ["1", "2", "bspline"])
def test_a_board_turned_by_a_quarter_is_exact_too(variant: str, turns: int) -> None:
    turn = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), turns)

    def turned(board_mm: Floats) -> Floats:
        middle = np.array([319.5, 239.5])
        return 0.7 * (affine(board_mm) - middle) @ turn.T + middle

    reading = read_board(BOARD, turned)
    graticule = solver.solve(reading, variant)
    points = board_points(300, seed=1)
    answer = graticule.to_plane(turned(points))
    assert (answer.status == Status.OK).all()
    np.testing.assert_allclose(answer.xz_mm, points, rtol=0, atol=1e-8)
    kept = solver.restore(variant, graticule.parameters())
    np.testing.assert_array_equal(kept.to_plane(turned(points)).xz_mm, answer.xz_mm)


def test_weight_of_eq_3() -> None:
    """Sec. II: w_i = 0.26 puts the point 37 mm beneath H_i; lines 100 px apart, level."""
    level = Board.model_validate({"grid": BOARD.grid.model_dump()})
    reading = read_board(level, lambda xz: np.column_stack([xz[:, 0], -xz[:, 1]]))
    answer = solver.solve(reading, "2-norulers").to_plane(np.array([[120.0, 150.0 + 37.0]]))
    np.testing.assert_allclose(answer.xz_mm, [[120.0, -187.0]], atol=1e-9)


def test_spline_without_rulers_gives_control_points_back() -> None:
    reading = read_board(BOARD, View().project, 0.3, np.random.default_rng(3))
    answer = solver.solve(reading, "bspline-norulers").to_plane(reading.grid.image_px)
    np.testing.assert_allclose(answer.xz_mm, GRID_MM, rtol=0, atol=1e-8)


@pytest.mark.parametrize("fit", ["1", "2"])
def test_control_points_come_back_within_the_fit_residual(fit: str) -> None:
    """z errs by the line's miss in px times mm a px of a cell, of either cell that meets there."""
    reading = read_board(BOARD, View().project, 0.3, np.random.default_rng(4))
    graticule = solver.solve(reading, f"{fit}-norulers")
    answer = graticule.to_plane(reading.grid.image_px)
    assert (answer.status == Status.OK).all()
    for axis, lines in ((0, graticule.longitudes), (1, graticule.latitudes)):
        along, across = reading.grid.image_px[:, 1 - axis], reading.grid.image_px[:, axis]
        index = np.indices(reading.shape)[1 - axis].ravel()
        heights = np.stack([line.curve(along) for line in lines.lines])
        miss = np.abs(heights[index, np.arange(100)] - across)
        cell = np.abs(np.diff(heights, axis=0)).min()
        error = np.abs(answer.xz_mm[:, axis] - GRID_MM[:, axis])
        assert (error <= miss * BOARD.grid.pitch_mm / cell + 1e-9).all()


# --- the paper's figures ------------------------------------------------------------------


@pytest.mark.parametrize("view", [View(), BARREL], ids=["tank", "barrel"])
def test_second_order_meets_table_1(view: View) -> None:
    """The bar of the paper's board: 0.40 mm on every distance, marks noisy by 0.05 px."""
    for seed in range(5):
        reading = read_board(BOARD, view.project, 0.05, np.random.default_rng(seed))
        graticule = solver.solve(reading, "2")
        assert np.abs(distance_errors(graticule, reading)).max() < 0.40


def test_second_order_beats_first_on_tables_1_and_2() -> None:
    errors: dict[str, list[Floats]] = {"1": [], "2": []}
    for seed in range(5):
        reading = read_board(BOARD, BARREL.project, 0.05, np.random.default_rng(seed))
        for fit, found in errors.items():
            graticule = solver.solve(reading, fit)
            found += [distance_errors(graticule, reading), diameter_errors(graticule, reading)]
    assert rms(np.concatenate(errors["2"])) <= rms(np.concatenate(errors["1"]))


@pytest.mark.parametrize(
    ("variant", "noted_rms", "noted_max"), [("1-norulers", 0.33, 0.88), ("2-norulers", 0.23, 0.33)]
)
def test_errors_computed_apart(variant: str, noted_rms: float, noted_max: float) -> None:
    """docs/explanation/physics.md, section 9, computed with other code; given to two digits, on
    a view known only roughly: a tenth."""
    points = board_points(4000, seed=5)
    graticule = solver.solve(read_board(BOARD, BARREL.project), variant)
    error = np.linalg.norm(graticule.to_plane(BARREL.project(points)).xz_mm - points, axis=1)
    assert rms(error) == pytest.approx(noted_rms, rel=0.1)
    assert error.max() == pytest.approx(noted_max, rel=0.1)


def test_rulers_cut_the_interpolation_error() -> None:
    """From 50 to 10 mm (Sec. III.3): the error of a straight chord falls as its square."""
    points = board_points(2000, seed=6)
    reading = read_board(BOARD, BARREL.project)
    image = BARREL.project(points)
    with_rulers, without = (
        rms(solver.solve(reading, variant).to_plane(image).xz_mm[:, 1] - points[:, 1])
        for variant in ("2", "2-norulers")
    )
    assert with_rulers < without / (50 / 10) ** 2


def _arc(shift_px: float) -> tuple[Floats, Marks]:
    """Ten control points 50 px apart on a gentle arc, P2 shifted up; Fig. 33 and 34."""
    u = 50.0 * np.arange(10)
    v = 100.0 + 1e-4 * (u - 225.0) ** 2
    v[1] -= shift_px
    board = np.column_stack([u, np.zeros(10)])
    return u, Marks(board, np.column_stack([u, v]), np.full(10, 0.05), np.zeros(10, dtype=int))


def _curvature(line: GridLine | None, u: Floats) -> Floats:
    assert line is not None
    step = 1e-3
    return (line.curve.slope(u + step) - line.curve.slope(u - step)) / (2 * step)


def test_spline_changes_curvature_where_second_order_hardly_does() -> None:
    """Figs. 33 and 34.  Shifting P2 of ten by a pixel changes y'' of the rms parabola by
    2 p(2)/sum p^2 / h^2 = 8/528/h^2, p the discrete Legendre polynomial of order 2."""
    u = np.linspace(5.0, 445.0, 300)
    before = {fit: _curvature(fit_lines([_arc(0.0)[1]], 0, fit)[0], u) for fit in ("2", "bspline")}
    after = {fit: _curvature(fit_lines([_arc(1.0)[1]], 0, fit)[0], u) for fit in ("2", "bspline")}
    np.testing.assert_allclose(after["2"] - before["2"], -8 / 528 / 50**2, rtol=1e-4)
    assert (before["bspline"] > 0).all()
    assert (after["bspline"] < 0).any()
    assert (after["bspline"] > 0).any()
    assert (after["2"] > 0).all()


# --- error bounds over random rigs --------------------------------------------------------


def _chord_bound_mm(view: View, lines: LineSet, axis: int, image: Floats) -> float:
    """What linear interpolation between fitted lines can err by, from exact derivatives.

    At a fixed along coordinate the board coordinate is a function g of the across pixel.  A
    chord over D px errs by at most max|g''| D^2/8, and lines that miss their place by m px
    add max|g'| m; a tenth of a cell outside the lines makes that 1.2 m.  The derivatives
    are sampled at ``image``: 5 % for what lies between.
    """
    step = np.zeros(2)
    step[axis] = 0.5
    before, here, after = (view.locate(image + s * step)[:, axis] for s in (-1, 0, 1))
    slope, bend = np.abs(after - before).max(), np.abs(after - 2 * here + before).max() / 0.25
    spans = np.diff(
        np.sort([line.curve(image[:, 1 - axis]) for line in lines.lines], axis=0), axis=0
    )
    miss = max(_miss_px(view, line, axis) for line in lines.lines)
    return float(1.05 * (bend * spans.max() ** 2 / 8 + 1.2 * slope * miss))


def _miss_px(view: View, line: GridLine, axis: int) -> float:
    """Greatest distance of a fitted line from where the view shows it."""
    along = np.linspace(0.0, 450.0, 200) * (1 if axis == 1 else -1)
    fixed = np.full(200, line.at_mm)
    image = view.project(np.column_stack((along, fixed) if axis == 1 else (fixed, along)))
    along_px = image[:, 1 - axis]
    reached = (along_px >= line.first_px - 60.0) & (along_px <= line.last_px + 60.0)
    return float(np.abs(line.curve(image[reached, 1 - axis]) - image[reached, axis]).max())


@examples(12)
@given(view=views())
def test_round_trip_without_rulers_within_the_chord_bound(view: View) -> None:
    graticule = solver.solve(read_board(BOARD, view.project), "2-norulers")
    points = board_points(400, seed=7)
    image = view.project(points)
    answer = graticule.to_plane(image)
    valued = answer.status == Status.OK
    assert valued.mean() > 0.5
    error = np.abs(answer.xz_mm - points)[valued]
    for axis, lines in ((0, graticule.longitudes), (1, graticule.latitudes)):
        assert error[:, axis].max() <= _chord_bound_mm(view, lines, axis, image[valued])


@examples(8)
@given(view=views())
def test_round_trip_with_rulers_within_twice_that_and_the_rulers_own(view: View) -> None:
    """Target and intersection have the same weight, so both obey the chord bound; the
    ruler adds what its line and its conversion curve miss the truth by."""
    graticule = solver.solve(read_board(BOARD, view.project), "2")
    points = board_points(300, seed=8)
    image = view.project(points)
    answer = graticule.to_plane(image)
    valued = answer.status == Status.OK
    error = np.abs(answer.xz_mm - points)[valued]
    for axis, lines in ((0, graticule.longitudes), (1, graticule.latitudes)):
        bound = 2 * _chord_bound_mm(view, lines, axis, image[valued])
        assert error[:, axis].max() <= bound + _rulers_miss_mm(view, lines, axis)


def _rulers_miss_mm(view: View, lines: LineSet, axis: int) -> float:
    worst = 0.0
    for ruler in lines.rulers:
        mm = np.linspace(0.0, 450.0, 300) * (-1 if axis == 1 else 1)
        fixed = np.full(300, ruler.at_mm)
        image = view.project(np.column_stack((fixed, mm) if axis == 1 else (mm, fixed)))
        here = ruler.reaches(image[:, axis])
        convert = np.abs(ruler.conversion(image[here, axis]) - mm[here]).max()
        aside = image[here].copy()
        aside[:, 1 - axis] = ruler.line(image[here, axis])
        worst = max(worst, convert + np.abs(view.locate(aside)[:, axis] - mm[here]).max())
    return worst


# --- gaps and refusals --------------------------------------------------------------------


def test_missing_marks_cost_accuracy_not_the_map() -> None:
    """Three to seven of each row missing at random: second order still needs only three."""
    rng = np.random.default_rng(9)
    missing = np.zeros((10, 10), dtype=bool)
    for row in missing:
        row[rng.choice(10, rng.integers(3, 8), replace=False)] = True
    reading = read_board(BOARD, BARREL.project, missing=missing.ravel())
    graticule = solver.solve(reading, "2")
    points = board_points(2000, seed=10)
    answer = graticule.to_plane(BARREL.project(points))
    valued = answer.status == Status.OK
    assert valued.mean() > 0.8
    assert np.abs(answer.xz_mm - points)[valued].max() < 0.40


def test_a_line_with_too_few_marks_is_left_out() -> None:
    missing = np.zeros((10, 10), dtype=bool)
    missing[4, 2:] = True
    graticule = solver.solve(read_board(BOARD, affine, missing=missing.ravel()), "2-norulers")
    assert [line.at_mm for line in graticule.latitudes.lines] == [
        -50.0 * row for row in range(10) if row != 4
    ]
    points = np.array([[225.0, -190.0], [225.0, -210.0]])
    np.testing.assert_allclose(graticule.to_plane(affine(points)).xz_mm, points, atol=1e-8)


def test_no_extrapolation_from_a_short_outer_line() -> None:
    """Only three marks of the top row: its line must not serve the far end of the board."""
    missing = np.zeros((10, 10), dtype=bool)
    missing[0, 3:] = True
    graticule = solver.solve(read_board(BOARD, affine, missing=missing.ravel()), "2")
    answer = graticule.to_plane(affine(np.array([[50.0, -20.0], [400.0, -20.0], [400.0, -80.0]])))
    assert answer.status.tolist() == [Status.OK, Status.OUT_OF_BOARD, Status.OK]
    assert np.isnan(answer.xz_mm[1]).all()
    assert np.isnan(answer.sigma_mm[1]).all()


def test_a_direction_without_rulers_falls_back() -> None:
    reading = read_board(BOARD, View().project)
    only = tuple(ruler for ruler in reading.rulers if ruler.direction == "vertical")
    image = View().project(board_points(100, seed=11))
    mixed = solver.solve(replace(reading, rulers=only), "2").to_plane(image).xz_mm
    full, plain = (solver.solve(reading, v).to_plane(image).xz_mm for v in ("2", "2-norulers"))
    np.testing.assert_array_equal(mixed[:, 0], plain[:, 0])
    np.testing.assert_array_equal(mixed[:, 1], full[:, 1])


def test_too_few_marks() -> None:
    missing = np.ones((10, 10), dtype=bool)
    missing[0, :] = missing[5, :2] = False
    with pytest.raises(BoardNotFound, match="two latitude lines of 3 control points"):
        solver.solve(read_board(BOARD, affine, missing=missing.ravel()), "2")


# --- curves for the report ----------------------------------------------------------------


@pytest.mark.parametrize("transposed", [False, True])
def test_drawn_lines_and_conversions(transposed: bool) -> None:
    def seen(board_mm: Floats) -> Floats:
        return affine(board_mm)[:, ::-1] if transposed else affine(board_mm)

    reading = read_board(BOARD, seen)
    graticule = solver.solve(reading, "2")
    drawn = graticule_lines(graticule, samples=50)
    assert [line.kind for line in drawn].count("latitude") == 10
    assert [line.kind for line in drawn].count("horizontal ruler") == 2
    for line in drawn:
        axis = 1 if line.kind in ("latitude", "horizontal ruler") else 0
        inverse = np.linalg.inv([[1.1, 0.05], [-0.03, -0.95]])
        image_px = line.image_px[:, ::-1] if transposed else line.image_px
        board = (image_px - [40.0, 10.0]) @ inverse
        np.testing.assert_allclose(board[:, axis], line.at_mm, atol=1e-8)
    conversions = ruler_conversions(graticule, reading)
    assert [conversion.at_mm for conversion in conversions] == [75, 225, 375, -125, -325]
    for conversion in conversions:
        order = np.argsort(conversion.curve_px)
        looked_up = np.interp(
            conversion.marks_px, conversion.curve_px[order], conversion.curve_mm[order]
        )
        np.testing.assert_allclose(looked_up, conversion.marks_mm, atol=1e-8)
