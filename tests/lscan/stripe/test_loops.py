"""Compiled loops against closed forms and against every possibility tried out."""

import os
import subprocess
import sys
from itertools import combinations, pairwise

import numpy as np
import pytest
from drawn_examples import examples
from hypothesis import given, strategies as st
from lines_drawn import drawn

from lscan.stripe.loops.scatter import weighted_moments
from lscan.stripe.loops.spots import best_path, linked_runs

ROWS = np.arange(4)


def spots(*places: tuple[int, float]) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows."""
    column, row = np.array(places).T
    return column.astype(np.int64), row.astype(np.int64)


def test_runs_go_on_over_gaps_and_through_the_nearest_spot() -> None:
    """Two lines, 3 px high, one with a gap of two columns, and a spot beyond the longest gap."""
    column, row = spots((0, 10), (0, 30), (1, 11), (1, 15), (1, 30), (4, 11), (4, 31), (9, 12))
    assert linked_runs(column, row - 1, row + 1, 4).tolist() == [0, 1, 0, 2, 1, 0, 1, 3]
    assert linked_runs(column, row - 1, row + 1, 2).tolist() == [0, 1, 0, 2, 1, 3, 4, 5]
    assert len(linked_runs(column[:0], row[:0], row[:0], 4)) == 0


@examples(60)
@given(
    places=st.lists(st.tuples(st.integers(0, 6), st.integers(0, 40)), min_size=1, max_size=8),
    seed=st.integers(0, 2**31),
)
def test_no_path_has_a_higher_sum(places: list[tuple[int, int]], seed: int) -> None:
    """Of all there are, each column once: gains, less the moves, the gaps and new beginnings."""
    column, row = spots(*sorted(places))
    gain, begin, missed = np.random.default_rng(seed).uniform(-0.3, 0.7, len(row)), 0.4, 0.1

    def worth(path: tuple[int, ...]) -> float:
        total = gain[list(path)].sum() - begin
        for one, other in pairwise(path):
            apart = column[other] - column[one]
            step = min(abs(row[other] - row[one]) / (3.0 * apart), begin) + missed * (apart - 1)
            total -= min(step, begin) if apart <= 4 else begin
        return float(total)

    paths = [
        path
        for length in range(1, len(row) + 1)
        for path in combinations(range(len(row)), length)
        if np.all(np.diff(column[list(path)]) > 0)
    ]
    found = tuple(best_path(column, row.astype(float), gain, 4, 3.0, begin, missed))
    most = max(map(worth, paths))
    assert worth(found) == pytest.approx(most, abs=1e-9) if found else most <= 1e-9


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.float64])
def test_moments_of_a_gaussian_line_are_known(kind: type) -> None:
    """Its middle, and of its variance w², with a pixel's 1/12, s² w² / (s² + w²) over s²."""
    centre, width, scale = np.array([20.0, 20.25, 20.5, 21.1]), 1.6, 2.0
    columns = np.ascontiguousarray(drawn(centre, width, 60, 200.0).T).astype(kind)
    middle, squared, total = weighted_moments(columns, ROWS, np.full(4, 20.0), scale)
    seen = width**2 + 1 / 12
    np.testing.assert_allclose(middle, centre, atol=0.01)
    np.testing.assert_allclose(squared, seen / (scale**2 + seen), rtol=0.01)
    height = 200.0 * width / np.sqrt(seen)
    expected = height * np.sqrt(2 * np.pi / (1 / scale**2 + 1 / seen))
    np.testing.assert_allclose(total, expected, rtol=0.01)
    assert np.isnan(weighted_moments(columns, ROWS, np.full(4, 50.0), scale)).all()


def test_loops_run_without_a_compiler_too() -> None:
    code = (
        "import lscan, numpy as np; image = np.zeros((40, 24), np.uint8)\n"
        "image[13:18] = [[20], [120], [200], [120], [20]]\n"
        "for name in ('max', 'gaussian', 'ml', 'steger'):\n"
        "    stripe = lscan.extract_stripe(image, lscan.StripeSection(extractor=name))\n"
        "    np.testing.assert_allclose(stripe.centre_px, 15, atol=1e-6)\n"
    )
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=60)


EVERY_KIND = """
import gc
from itertools import product

import numpy as np
from boards import View, render
from numba.core.registry import CPUDispatcher
from places import SCENES

from lscan import StripeSection, calibrate, extract_stripe, read_board
from lscan.stripe import find_extractor
from lscan.board.loops import compile_marks
from lscan.calibration.maps.spline import compile_splines
from lscan.config.board import load_board
from lscan.config.rig import NoiseSection
from lscan.stripe.extract import compile_lines
from lscan.surface.sheetresponse import Sight, compile_reliefs, responses

def compiled():
    loops = [found for found in gc.get_objects() if isinstance(found, CPUDispatcher)]
    return {f"{loop.py_func.__qualname__}{kinds}" for loop in loops for kinds in loop.signatures}

compile_lines(), compile_marks(), compile_splines(), compile_reliefs()
before = compiled()
rows, columns = np.mgrid[:120, :200]
line = np.exp(-((rows - 55 - 0.1 * columns) ** 2) / 8)
grain = np.random.default_rng(3).uniform(0, 6, line.shape)
checks = 90 * ((rows // 16 + columns // 16) % 2)
names = "max centroid centroid-relative gaussian ml blais-rioux centroid-squared smoothed-peak"
dark = np.full(line.shape, 2, np.uint8)
for light, under, name in product(
    (150 * line, 500 * line, 0 * line), (grain, grain + checks), [*names.split(), "steger"]
):
    picture = np.minimum(light + under, 255).astype(np.uint8)
    for settings, background in (
        ({}, None), ({}, dark), ({"gamma": 2.2}, None), ({"axis": "rows"}, dark),
        ({"noise": NoiseSection(read_dn=1.0)}, None), ({"line_width_px": 9.0}, None),
        ({"smooth_px": 3.0, "blur_px": 1.0}, None), ({"returns": "first"}, dark),
    ):
        extract_stripe(picture, StripeSection(extractor=name, **settings), background)
        deep, deep_dark = (
            None if each is None else each.astype(np.uint16) << 8 for each in (picture, background)
        )
        deep[::7] += 16  # values that are no whole DN
        extract_stripe(deep, StripeSection(extractor=name, **settings), deep_dark)
    extract_stripe(np.stack([picture] * 3, -1), StripeSection(extractor=name, channel="auto"))
for name in names.split():
    foreign = find_extractor(name)  # as an extractor of somebody's own would call it
    for image in map(np.asfortranarray, (picture, picture.astype(np.int16))):
        image.flags.writeable = False
        foreign(image, StripeSection(), image >= 255)
board = load_board(SCENES / "paper" / "calibration-board.toml")
for options in ({}, {"channel": "green"}):
    reading = read_board(render(board, View()), board, **options)
for name in ("spline", "polynomial-3", "graticule-2"):
    calibrate(reading, name).plane_map.to_plane(reading.grid.image_px[:3])
for shape in ((3, 1), (4, 5)):
    sight = Sight(np.zeros(shape), np.zeros(shape[1]), np.ones((2, *shape)))
    for height in (np.zeros(shape), np.zeros(shape, order="F")):
        responses(height, 0.5, 1.0, 0.7, sight)
print(compiled() - before, {name for name in before if "'C', True, aligned" in name})
"""


def test_what_is_compiled_beforehand_is_all_that_is_needed() -> None:
    """Or the first picture of each kind, and the first relief, would wait for seconds, in every
    process of a read-only installation.  Nor is a loop compiled once more for arrays that are read
    alone."""
    paths = os.pathsep.join(sys.path)
    command = [sys.executable, "-c", EVERY_KIND]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": paths}, capture_output=True, text=True
    )
    assert done.stdout == "set() set()\n", done.stdout + done.stderr
