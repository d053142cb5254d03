"""Readers of boards and plane maps judged by a suite: what is known of them is what is said."""

import json
from dataclasses import replace

import numpy as np
import pytest
import suite_cases
from command_line import call, refused

from lscan.benchmark.drawn import OPTICS, reading_of
from lscan.benchmark.judging import judge_map, judge_reader
from lscan.benchmark.suiterun import run_suite, suite_rows
from lscan.calibration.planemap import find_solver
from lscan.errors import BoardNotFound, InputError
from lscan.records import Status

NOISE_PX = 0.05


def _marks_of(case, board, noise_px=NOISE_PX):
    """The case's board as it is drawn, by a seed of its own."""
    return reading_of(board, noise_px, np.random.default_rng([9, int(case.name[-3:])]))


def exact_reader(picture, board):
    """A reader that knows the truth and adds noise, seeded by the picture."""
    return reading_of(board, NOISE_PX, np.random.default_rng([9, int(picture.flat[0])]))


def same_reader(*picture):
    return exact_reader(*picture)


def off_reader(picture, board):
    """The same, a tenth of a pixel too far right and too far down."""
    found = exact_reader(picture, board)
    return replace(found, grid=replace(found.grid, image_px=found.grid.image_px + 0.1))


def next_reader(picture, board):
    """Each dot taken for its neighbour."""
    found = exact_reader(picture, board)
    return replace(found, grid=replace(found.grid, image_px=np.roll(found.grid.image_px, 1, 0)))


def blind_reader(picture, board):
    """Finds nothing."""
    raise BoardNotFound("no board")


def broken_reader(picture, board):
    """Raises what no reader should."""
    raise ZeroDivisionError("by zero")


def few_reader(picture, board):
    """Gives fewer marks than there are."""
    found = exact_reader(picture, board)
    grid = found.grid
    return replace(found, grid=replace(
        grid, board_mm=grid.board_mm[1:], image_px=grid.image_px[1:], sigma_px=grid.sigma_px[1:],
        status=grid.status[1:],
    ))  # fmt: skip


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    folder = tmp_path_factory.mktemp("judged") / "boards"
    folder.mkdir()
    suite_cases.board_suite(folder, 12)
    return folder


def _named(reader):
    return f"{__name__}:{reader.__name__}"


def test_a_reader_is_said_to_be_what_it_is(suite):
    """36 dots of 12 boards have 864 coordinates at most: their rms is known to 1 / sqrt(2 x 864),
    of which four are allowed for, their mean to its rms over sqrt(864)."""
    readers = (exact_reader, off_reader, next_reader, blind_reader)
    run = run_suite(str(suite), {"reader": [_named(reader) for reader in readers]})
    exact, off, wrong, blind = suite_rows(run, ())
    clear = sum(of.clear for of in run.sums[_named(exact_reader)].values())
    assert clear >= 600
    assert exact.scatter_px == pytest.approx(NOISE_PX, rel=4 / (2 * clear) ** 0.5)
    assert abs(exact.bias_px) < 4 * NOISE_PX / clear**0.5
    assert (exact.found, exact.wrong) == (1, 0)
    assert exact.z_ratio == pytest.approx(1.0, abs=4 * np.pi / (8 * clear) ** 0.5)
    assert off.bias_px - exact.bias_px == pytest.approx(0.1)
    assert off.scatter_px == pytest.approx(exact.scatter_px)
    assert (wrong.wrong, wrong.sure) == (1, 1)
    assert blind.found == 0
    assert np.isnan(blind.wrong)
    by_water = suite_rows(run, ["water"])
    assert {row.group["water"]: row.cases for row in by_water} == {"tap": 6, "harbor": 6}


@pytest.mark.parametrize("pool", [suite_cases.Threads, pytest.param(None, marks=pytest.mark.slow)])
def test_several_processes_judge_boards_as_one_does(suite, monkeypatch, pool):
    if pool is not None:
        monkeypatch.setattr("lscan.benchmark.suiterun.ProcessPoolExecutor", pool)
    methods = {"reader": [_named(exact_reader), _named(blind_reader)], "map": ["polynomial-3"]}
    alone = run_suite(str(suite), methods)
    monkeypatch.setattr("lscan.benchmark.suiterun.LEAST_SHARED", 1)
    monkeypatch.setattr("lscan.benchmark.suiterun.AT_ONCE", 8)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    shared = run_suite(str(suite), methods)
    assert [*alone.sums] == [*shared.sums] == [*methods["reader"], *methods["map"]]
    for name, sums in alone.sums.items():
        for case, of in sums.items():
            assert replace(of, seconds=0.0) == replace(shared.sums[name][case], seconds=0.0)


def test_a_mark_that_is_not_to_be_seen_is_a_ghost():
    case = suite_cases.board_case(1)
    hidden = np.arange(len(case.marks.status)) < 3
    status = np.where(hidden, int(Status.OCCLUDED), case.marks.status)
    case = replace(case, marks=replace(case.marks, status=status))
    sums = judge_reader("exact", exact_reader, case)
    assert (sums.dark, sums.ghosts, sums.missed) == (6, 6, 0)


@pytest.mark.parametrize("name", ["graticule-2-norulers", "polynomial-3"])
def test_a_map_is_judged_in_the_sheet(name):
    """Of exact marks six dots across the lens's distortion leave a millimetre of a model's own
    error; of marks all 1 px to the right every place is as far to the left as a pixel is wide."""
    case = suite_cases.board_case(2)
    reading = _marks_of(case, case.board, 0.0)
    solve = find_solver(name).solve
    sums = judge_map(name, solve, reading, case)
    assert sums.clear == 100
    shifted = replace(reading, grid=replace(
        reading.grid, image_px=reading.grid.image_px + np.array([1.0, 0.0])
    ))  # fmt: skip
    moved = judge_map(name, solve, shifted, case)
    lattice = case.marks.image_px[:36].reshape(6, 6, 2)
    apart = np.nanmean(90.0 / np.diff(lattice[..., 0], axis=1))  # mm of the board a pixel
    assert (sums.square / sums.core) ** 0.5 < 1.0
    to_left = (sums.error - moved.error) / moved.core * 2  # of x alone: half of all
    assert to_left == pytest.approx(apart, rel=0.05)


def test_what_a_map_has_no_reading_of_is_missed():
    case = suite_cases.board_case(2)
    sums = judge_map("polynomial-3", find_solver("polynomial-3").solve, None, case)
    assert (sums.missed, sums.valued) == (100, 0)


def test_a_reader_that_fails_or_gives_other_marks_is_named(suite):
    with pytest.raises(InputError, match=r"broken_reader failed: ZeroDivisionError: by zero"):
        run_suite(str(suite), {"reader": [_named(broken_reader)]})
    with pytest.raises(InputError, match=r"few_reader gave another number of marks.*35.*36"):
        run_suite(str(suite), {"reader": [_named(few_reader)]})
    with pytest.raises(InputError, match="no such reader of control points"):
        run_suite(str(suite), {"reader": ["nobodys"]})
    with pytest.raises(InputError, match="no pictures of the board"):
        folder = suite.parent / "lines"
        folder.mkdir()
        suite_cases.drawn_suite(folder)
        run_suite(str(folder), {"reader": [_named(exact_reader)]})


def test_the_command_judges_boards_and_notices_a_change(suite, tmp_path, capsys):
    mine, theirs = _named(exact_reader), _named(off_reader)
    options = ["bench", "--suite", suite, "--boards", "--only", "-o", tmp_path / "one"]
    code, out, _ = call(capsys, *options, "--reader", mine, "--reader", _named(same_reader))
    assert code == 0 and "" not in out.splitlines()
    assert out.splitlines()[-2:] == ["nothing differs", str(options[-1] / "bench.json")]
    saved = tmp_path / "one" / "bench.json"
    content = json.loads(saved.read_text())
    assert content["suite"].startswith("boards of boards seed 7")
    content["extractors"][theirs] = content["extractors"][mine]
    saved.write_text(json.dumps(content))
    options[-1] = tmp_path / "two"
    code, out, _ = call(capsys, *options, "--reader", theirs, "--against", saved)
    assert code == 1
    assert f"{theirs}: rms error worse" in out
    assert "by water" in out
    refused(call(capsys, "bench", "--suite", suite, "--reader", mine), "--boards")
    refused(call(capsys, "bench", "--boards", "--reader", mine), "--suite")
    refused(call(capsys, "bench", "max", "--suite", suite, "--boards"), "needs the boards")


def test_optics_are_what_the_owner_knows():
    assert suite_cases.board_case(0).optics == OPTICS
