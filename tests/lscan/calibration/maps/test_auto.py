"""Cross-validation of plane maps, and the choice that rests on it."""

from copy import deepcopy
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from planeviews import BARREL, EXACT_BOARD, View, affine, board_points, paper_board, read_board

from lscan.calibration import calibrate as crossvalidation
from lscan.calibration.calibrate import Calibration, Score, calibrate, deal, resolve, try_maps
from lscan.calibration.calibrationfile import load_calibration, save_calibration
from lscan.calibration.maps import auto
from lscan.calibration.maps.auto import Auto, best_first, calibrate_best
from lscan.calibration.marks import without
from lscan.calibration.planemap import NamedSolver, find_solver
from lscan.config.rig import OpticsSection
from lscan.errors import BoardNotFound, InputError
from lscan.records import BoardReading, Floats, Marks, RulerReading

BOARD = paper_board()
QUICK = ("spline", "polynomial-3", "projective")
NOISE_PX = 0.05


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """``auto`` with three quick candidates and one that does not exist."""
    monkeypatch.setattr(auto, "CANDIDATES", (*QUICK, "nothing"))


def _reading(seed: int = 1, noise_px: float = NOISE_PX) -> BoardReading:
    return read_board(BOARD, BARREL.project, noise_px, np.random.default_rng(seed))


@cache
def _best() -> Auto:
    """The best of the three for the reading, under the fixture ``quick``."""
    return auto.solver.solve(_reading(), "", OpticsSection(**EXACT_BOARD))


@cache
def _calibrated() -> Calibration:
    return calibrate(_reading(), "auto")


def _scores(*arguments: Any, **options: Any) -> list[Score]:
    return [trial.score for trial in try_maps(*arguments, **options)]


def _marks(reading: BoardReading) -> list[Marks]:
    return [reading.grid, *(ruler.marks for ruler in reading.rulers)]


# --- folds --------------------------------------------------------------------------------


@examples(15)
@given(folds=st.integers(2, 12), seed=st.integers(0, 99))
def test_folds_are_even_and_share_places(folds: int, seed: int) -> None:
    """Sizes differ by no more than one; where a ruler lies on a grid line, its marks go with
    the control points they lie on."""
    reading = read_board(BOARD, View().project)
    on_line = RulerReading("vertical", 100.0, _column(reading.grid, 2))
    plain = deal(replace(reading, rulers=()), folds, np.random.default_rng(seed))
    sizes = np.bincount(plain, minlength=folds)
    assert sizes.sum() == 100
    assert sizes.max() - sizes.min() <= 1
    both = deal(replace(reading, rulers=(on_line,)), folds, np.random.default_rng(seed))
    np.testing.assert_array_equal(both[:100].reshape(10, 10)[:, 2], both[100:])


def _column(grid: Marks, column: int) -> Marks:
    which = np.arange(100) % 10 == column
    return Marks(
        grid.board_mm[which], grid.image_px[which], grid.sigma_px[which], grid.status[which]
    )


def test_no_fold_takes_a_border_away() -> None:
    """Of the ten marks of any row or column, eight folds leave at least six."""
    fold = deal(replace(_reading(), rulers=()), 8, np.random.default_rng(0)).reshape(10, 10)
    for lines in (fold, fold.T):
        assert max(np.bincount(line).max() for line in lines) <= 4


@pytest.mark.parametrize("name", ["spline", "graticule-2"])
def test_nothing_leaks_from_marks_held_out(name: str) -> None:
    """A map solved without them is the same number for number wherever they lie."""
    reading = _reading()
    held_out = deal(reading, 8, np.random.default_rng(2)) == 3
    rng = np.random.default_rng(3)
    spoiled = iter(np.split(held_out, np.cumsum([len(m.status) for m in _marks(reading)])))

    def spoil(marks: Marks) -> Marks:
        wrong = next(spoiled)
        shift = np.where(wrong[:, None], rng.normal(0.0, 50.0, (len(wrong), 2)), 0.0)
        sigma = np.where(wrong, 7.0, marks.sigma_px)
        return replace(marks, image_px=marks.image_px + shift, sigma_px=sigma)

    grid = spoil(reading.grid)
    other = replace(
        reading, grid=grid, rulers=tuple(replace(r, marks=spoil(r.marks)) for r in reading.rulers)
    )
    solve = find_solver(name).solve
    assert (
        solve(without(reading, held_out)).parameters()
        == solve(without(other, held_out)).parameters()
    )


# --- scores -------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_finds_the_true_order_of_a_polynomial_board(order: int) -> None:
    """Marks whose place is a polynomial of that order of the pixel, with noise of 0.05 px.

    Lower orders miss its leading terms, which are a hundred times the noise; higher ones
    have nothing to gain but chance.  By fitting noise they change the squared error by about
    sqrt(2 p) / n of itself, p terms more and n = 660 coordinates: under 4 % at four sigmas.
    """
    reading = _polynomial_board(order)
    names = [f"polynomial-{k}" for k in range(2, 8)]
    rms = [score.rms_mm or np.nan for score in _scores(reading, names)]
    true = rms[order - 2]
    assert true < 1.02 * min(rms)
    assert all(value > 2 * true for value in rms[: order - 2])


def _polynomial_board(order: int) -> BoardReading:
    i, j = np.indices((order + 1, order + 1)).reshape(2, -1)
    coefficients = np.random.default_rng(order).normal(0.0, 1.0, (2, len(i)))
    coefficients *= 5.0 * (i + j <= order)

    def truth(image: Floats) -> Floats:
        a, b = ((image - [300.0, 230.0]) / 300.0).T
        bent = [np.sum(c[:, None] * a ** i[:, None] * b ** j[:, None], axis=0)
                for c in coefficients]  # fmt: skip
        return image + np.column_stack(bent)

    exact = read_board(BOARD, affine, sigma_px=NOISE_PX)
    rng = np.random.default_rng(9)

    def seen(marks: Marks) -> Marks:
        noise = rng.normal(0.0, NOISE_PX, marks.image_px.shape)
        return replace(marks, board_mm=truth(marks.image_px), image_px=marks.image_px + noise)

    rulers = tuple(replace(r, marks=seen(r.marks)) for r in exact.rulers)
    return replace(exact, grid=seen(exact.grid), rulers=rulers)


def test_scores_count_every_mark_and_are_fair_to_the_truth() -> None:
    """A right map errs on held-out marks by their noise and a little of its own: 0.05 px of
    about 1 mm in u and in v are 0.07 mm, and the map's own share is below half of that."""
    reading = _reading()
    found = sum(int(marks.found.sum()) for marks in _marks(reading))
    spline, projective = _scores(reading, ("spline", "projective"))
    assert spline.points + spline.without_value == found
    assert 0 < spline.without_value <= 16  # some of the marks on the border
    jacobian = 450.0 / np.linalg.norm(np.diff(BARREL.project(np.array([[0.0, 0.0], [450.0, 0.0]])),
                                              axis=0))  # fmt: skip
    noise = np.sqrt(2) * NOISE_PX * jacobian
    assert spline.rms_mm is not None
    assert projective.rms_mm is not None
    assert 0.8 * noise < spline.rms_mm < 1.5 * noise
    assert spline.max_mm is not None
    assert spline.max_mm >= spline.rms_mm
    assert projective.rms_mm > 2 * spline.rms_mm


def test_a_map_that_refuses_is_listed_with_its_reason() -> None:
    missing = np.ones((10, 10), dtype=bool)
    missing[:4, :5] = False
    reading = replace(read_board(BOARD, View().project, missing=missing.ravel()), rulers=())
    good, short, unknown = _scores(reading, ("projective", "polynomial-7", "nothing"))
    assert good.refused is None
    assert short.refused is not None
    assert "36 terms" in short.refused
    assert short.rms_mm is None
    assert unknown.refused is not None
    assert "no such family" in unknown.refused


def test_too_few_folds() -> None:
    with pytest.raises(InputError, match="folds"):
        _scores(_reading(), QUICK, folds=1)


# --- auto ---------------------------------------------------------------------------------


def test_ranked_by_error_among_the_complete() -> None:
    """A map that leaves out a tenth of the marks does not win by that."""
    scores = (
        Score("refused", refused="no reason"),
        Score("choosy", 0.01, 0.02, points=90),
        Score("worse", 0.03, 0.04, points=100),
        Score("better", 0.02, 0.09, points=97),
    )
    assert [score.name for score in best_first(scores)] == ["better", "worse", "choosy", "refused"]


def test_of_tied_maps_the_surest_comes_first() -> None:
    scores = (
        Score("least error", 0.020, 0.04, sigma_mm=0.03, tied=True, points=100),
        Score("surest", 0.021, 0.04, sigma_mm=0.01, tied=True, points=100),
        Score("sure but wrong", 0.040, 0.09, sigma_mm=0.001, points=100),
    )
    assert [score.name for score in best_first(scores)] == [
        "surest",
        "least error",
        "sure but wrong",
    ]


def test_ties_are_of_maps_that_the_marks_do_not_distinguish() -> None:
    """Fourth and fifth orders differ on the view by less than the noise; second orders miss a
    hundred times that.  The map of least error is always one of the tied."""
    scores = _scores(_reading(), ("polynomial-4", "polynomial-5", "polynomial-2"))
    assert not scores[2].tied
    least = min(scores, key=lambda score: score.rms_mm or np.inf)
    assert least.tied
    for score in scores:
        assert score.sigma_mm is not None
        assert score.sigma_mm > 0


def test_the_same_map_twice_is_a_tie() -> None:
    both = _scores(_reading(), ("projective", "projective"))
    assert both[0].tied
    assert both[1].tied


def test_slow_maps_are_solved_fewer_times_and_judged_on_all_marks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(crossvalidation.FEWER_FOLDS, "projective", 4)
    reading, reported = _reading(), []
    slow, quick = _scores(
        reading,
        ("projective", "spline"),
        progress=lambda done, total: reported.append((done, total)),
    )
    assert reported == [(0, 2), (1, 2)]
    found = sum(int(marks.found.sum()) for marks in _marks(reading))
    assert slow.points + slow.without_value == quick.points + quick.without_value == found


@pytest.mark.usefixtures("quick")
def test_calibrate_best_is_calibrate_by_auto() -> None:
    reading, reported = _reading(), []
    one = _calibrated()
    other = calibrate_best(reading, None, lambda done, total: reported.append(done))
    assert reported == [0, 1, 2, 3]
    assert other.plane_map.parameters() == one.plane_map.parameters()
    assert (other.name, other.software, other.optics) == (one.name, one.software, one.optics)
    np.testing.assert_array_equal(other.residuals_px, one.residuals_px)


@pytest.mark.usefixtures("quick")
def test_auto_is_the_best_map_itself() -> None:
    reading, image = _reading(), BARREL.project(board_points(100, seed=4))
    solved = _best()
    assert solved.scores[0].name == solved.chosen.name == "spline"
    assert [score.name for score in solved.scores if score.refused] == ["nothing"]
    alone = find_solver("spline").solve(reading).to_plane(image)
    answer = solved.to_plane(image)
    np.testing.assert_array_equal(answer.xz_mm, alone.xz_mm)
    np.testing.assert_array_equal(answer.sigma_mm, alone.sigma_mm)


@pytest.mark.usefixtures("quick")
@examples(1)
@given(scale=st.floats(0.1, 10.0), shift=st.tuples(st.floats(-500, 500), st.floats(-500, 500)))
def test_auto_is_equivariant_in_pitch_and_origin(scale: float, shift: tuple[float, float]) -> None:
    reading = _reading()

    def move(marks: Marks) -> Marks:
        return replace(marks, board_mm=scale * marks.board_mm + np.array(shift))

    rulers = tuple(
        RulerReading(r.direction, scale * r.at_mm + shift[r.direction != "vertical"], move(r.marks))
        for r in reading.rulers
    )
    moved = replace(
        reading, pitch_mm=scale * reading.pitch_mm, grid=move(reading.grid), rulers=rulers
    )
    one, other = _best(), auto.solver.solve(moved, "")
    assert one.chosen.name == other.chosen.name
    for before, after in zip(one.scores, other.scores, strict=True):
        assert before.name == after.name
        if before.rms_mm is not None:
            assert after.rms_mm == pytest.approx(scale * before.rms_mm, rel=1e-6)


@pytest.mark.usefixtures("quick")
def test_the_file_keeps_the_choice_and_the_table(tmp_path: Path) -> None:
    saved = _calibrated()
    save_calibration(tmp_path / "c.json", saved)
    loaded = load_calibration(tmp_path / "c.json")
    assert loaded.name == "auto"
    assert isinstance(saved.plane_map, Auto)
    assert isinstance(loaded.plane_map, Auto)
    assert loaded.plane_map.chosen.name == "spline"
    untimed = tuple(replace(score, ms=None) for score in saved.plane_map.scores)
    assert loaded.plane_map.scores == untimed
    assert resolve(loaded).plane_map.parameters() == loaded.plane_map.parameters()


@pytest.mark.usefixtures("quick")
def test_auto_refusals() -> None:
    with pytest.raises(InputError, match="allowed: auto"):
        auto.solver.solve(_reading(), "2")
    single = np.ones((10, 10), dtype=bool)
    single[3] = False
    row = replace(read_board(BOARD, affine, missing=single.ravel()), rulers=())
    with pytest.raises(BoardNotFound, match="no plane map could be solved"):
        auto.solver.solve(row, "")
    parameters = deepcopy(_best().parameters())
    with pytest.raises(InputError, match="chosen"):
        auto.solver.restore("", {**parameters, "chosen": "auto"})


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tied": "yes"}, "tied"),
        ({"ms": -5.0}, "ms"),
        ({"rms_mm": None}, "either rms_mm and max_mm, or refused"),
        ({"refused": "too few"}, "either rms_mm and max_mm, or refused"),
    ],
)
@pytest.mark.usefixtures("quick")
def test_scores_that_nobody_wrote_are_refused(change: dict[str, Any], said: str) -> None:
    parameters = deepcopy(_best().parameters())
    parameters["scores"][0] |= change
    with pytest.raises(InputError, match=said):
        auto.solver.restore("", parameters)


@pytest.mark.slow  # a wrong mark of test_refractive.py: a fit begun nearby ends at the same map
def test_a_search_begun_at_the_whole_board_ends_where_others_end(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The folds' solutions are those of least squares, wherever their search begins.

    Both end where a step changes the sum of squares by less than 1e-9 of itself: the map is then
    within 1e-3 of its sigma, which is less than the error on a mark held out.
    """
    reading = _reading()
    near = _scores(reading, ("refractive",))[0]
    monkeypatch.setattr(NamedSolver, "searches", property(lambda self: False))
    afresh = _scores(reading, ("refractive",))[0]
    assert near.rms_mm == pytest.approx(afresh.rms_mm, rel=1e-3)
    assert near.sigma_mm == pytest.approx(afresh.sigma_mm, rel=1e-3)


def test_a_map_solved_for_its_score_is_not_solved_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auto, "CANDIDATES", ("refractive",))
    monkeypatch.setitem(crossvalidation.FEWER_FOLDS, "refractive", 4)
    reading, alone = _reading(), find_solver("refractive").solve(_reading())
    chosen = auto.solver.solve(reading, "").chosen
    assert chosen.parameters() == alone.parameters()
