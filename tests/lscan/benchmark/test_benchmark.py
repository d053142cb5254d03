"""The bench: its pictures are what they say, and its rows attribute a known error correctly."""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from lscan.benchmark import methods as maps_module
from lscan.benchmark.drawn import (
    BACKGROUND_DN,
    BOARDS,
    SHAPE,
    LineCase,
    centres,
    draw,
    mean_picture,
    reading_of,
)
from lscan.benchmark.methods import (
    ExtractorRow,
    bench_extractors,
    bench_maps,
    bound_px,
    failed_of_extractor,
    failed_of_map,
)
from lscan.benchmark.run import (
    EXTRACTOR_COLUMNS,
    MAP_COLUMNS,
    MAPS,
    registered_extractors,
    run_bench,
    table_cells,
    write_bench,
)
from lscan.calibration.planemap import PlaneMap, find_solver
from lscan.cli.app import app
from lscan.config.rig import NoiseSection, OpticsSection, StripeSection
from lscan.errors import InputError
from lscan.records import BoardReading, Floats, Mask, PlanePoints, Status, Stripe
from lscan.stripe import find_extractor

QUIET = NoiseSection(read_dn=1.0)
OFFSET_PX = 0.25
WRONG = f"{__name__}:off_by_a_quarter"


def off_by_a_quarter(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The centroid above the background of the whole column, a quarter of a pixel too low."""
    light = np.maximum(image - BACKGROUND_DN - 4.0, 0.0)
    rows = np.arange(len(image))[:, None]
    centre = (light * rows).sum(axis=0) / light.sum(axis=0) + OFFSET_PX
    nothing = np.zeros(image.shape[1])
    status = np.full(image.shape[1], int(Status.OK), dtype=np.int64)
    return Stripe("columns", centre, nothing + OFFSET_PX, image.max(axis=0), status)


def constant_row(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The middle row in every column, and the sigma of a uniform distribution over all rows."""
    each = np.ones(image.shape[1])
    height = float(len(image))
    status = np.full(len(each), int(Status.OK))
    return Stripe("columns", (height / 2) * each, height / 12**0.5 * each, 100 * each, status)


def blind(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """No line anywhere."""
    nan = np.full(image.shape[1], np.nan)
    return Stripe("columns", nan, nan, nan, np.full(len(nan), int(Status.NO_PEAK)))


def one_pixel_off(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The best there is, a pixel too low, and a sigma that allows for it."""
    stripe = find_extractor("ml")(image, settings, clipped)
    return replace(stripe, centre_px=stripe.centre_px + 1, sigma_px=np.hypot(stripe.sigma_px, 1))


def too_sure(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The best there is, with a tenth of its sigma."""
    stripe = find_extractor("ml")(image, settings, clipped)
    return replace(stripe, sigma_px=stripe.sigma_px / 10)


def now_and_then(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """The best there is, in every fortieth column the picture's first row: 2.5 % of outliers."""
    stripe = find_extractor("ml")(image, settings, clipped)
    wild = np.arange(len(stripe.centre_px)) % 40 == 0
    return replace(stripe, centre_px=np.where(wild, 0.0, stripe.centre_px))


@pytest.mark.parametrize("sigma_px", [0.8, 1.5, 3.0])
def test_the_line_is_where_it_is_said_to_be(sigma_px: float) -> None:
    true = centres(0.37)
    light = mean_picture(LineCase("tap", sigma_px, 100.0, QUIET), true) - BACKGROUND_DN
    rows = np.arange(SHAPE[0])[:, None]
    # Pixel means keep the first moment, and add 1/12 to the second (Sheppard's corrections),
    # but for aliases of the pixel grid: the Gaussian's transform one cycle a pixel away.
    alias = 20 * np.exp(-2 * (np.pi * sigma_px) ** 2) + 1e-9
    centroid = (light * rows).sum(axis=0) / light.sum(axis=0)
    assert np.abs(centroid - true).max() < alias
    spread = (light * (rows - true) ** 2).sum(axis=0) / light.sum(axis=0)
    assert np.abs(spread - sigma_px**2 - 1 / 12).max() < alias


def test_the_noise_is_the_noise_declared() -> None:
    gain, contrast = 0.05, 0.2
    noise = NoiseSection(read_dn=2.0, dn_per_electron=gain, speckle=contrast)
    case, true = LineCase("tap", 2.0, 150.0, noise), centres(0.1)
    generator = np.random.default_rng(5)
    shots = np.array([draw(case, true, generator) for _ in range(100)], dtype=float)
    mean = mean_picture(case, true)
    light = mean - BACKGROUND_DN
    variance = noise.read_dn**2 + gain * mean + (contrast * light) ** 2
    crest = light > 30  # far from 0 and from 255 DN, where the range would cut the noise
    assert mean.max() + 4 * np.sqrt(variance.max()) < 350
    clear = crest & (mean + 4 * np.sqrt(variance) < 255)
    pulls = (shots.mean(axis=0) - mean)[clear] / np.sqrt(variance[clear] / len(shots))
    # Pulls of thousands of pixels: their mean square is 1 within four of its standard errors.
    assert abs(np.mean(pulls**2) - 1) < 4 * np.sqrt(2 / clear.sum())
    # Poisson and gamma noise have kurtosis; 5 % covers it many times over for so many pixels.
    assert abs(np.mean(shots.var(axis=0)[clear] / variance[clear]) - 1) < 0.05


def test_a_known_error_is_attributed_correctly() -> None:
    rows = list(bench_extractors([WRONG, "centroid-relative"], pictures=4, quick=True))
    ours = {row.case: row for row in rows if row.extractor == WRONG}
    theirs = {row.case: row for row in rows if row.extractor == "centroid-relative"}
    assert ours.keys() == theirs.keys() and len(ours) == 7
    bright = next(c for c in ours if c.water == "tap" and c.peak_dn == 200 and not c.noise.speckle)
    row = ours[bright]
    error_of_mean = row.scatter_px / np.sqrt(4 * SHAPE[1])
    assert abs(row.bias_px - OFFSET_PX) < 5 * error_of_mean + 1e-3
    assert row.found == 1.0
    assert row.bound_ratio is not None and row.bound_ratio > 1
    # The span of the paper's centroid holds two sigma: its bias, by symmetry, vanishes.
    assert abs(theirs[bright].bias_px) < 5 * theirs[bright].scatter_px / np.sqrt(4 * SHAPE[1])


def test_the_bound_is_that_of_a_wide_line_in_additive_noise() -> None:
    # Cramer-Rao bound of a Gaussian in additive noise: (sigma_n / A) sqrt(2 w / sqrt(pi));
    # pixels narrow it by under 2 %.
    case = LineCase("tap", 3.0, 100.0, NoiseSection(read_dn=2.0))
    closed = 2.0 / 100.0 * np.sqrt(2 * 3.0 / np.sqrt(np.pi))
    assert bound_px(case) == pytest.approx(closed, rel=0.02)


def test_the_seed_fixes_the_rows() -> None:
    def first(seed: int) -> ExtractorRow:
        row = next(bench_extractors(["max"], seed=seed, pictures=1, quick=True))
        return replace(row, us_a_frame=0.0)

    assert first(3) == first(3) != first(4)


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="no such"):
        next(bench_extractors(["median"]))
    with pytest.raises(InputError, match="no such"):
        next(bench_maps(["globe"]))


@pytest.mark.parametrize("board", BOARDS)
def test_a_board_is_seen_whole_and_its_noise_is_the_noise_asked_for(board: str) -> None:
    exact = reading_of(BOARDS[board], 0.0, np.random.default_rng(1))
    noisy = reading_of(BOARDS[board], 0.1, np.random.default_rng(1))
    assert exact.grid.found.all()
    shift = noisy.grid.image_px - exact.grid.image_px
    # chi-square of 2 N degrees of freedom, four standard deviations
    count = shift.size
    assert abs(np.sum(shift**2) / 0.1**2 - count) < 4 * np.sqrt(2 * count)


def test_maps_are_judged_by_the_truth() -> None:
    names = ["polynomial-1", "polynomial-5", "polynomial-9"]
    rows = list(bench_maps(names, draws=2, quick=True))
    exact = {row.plane_map: row for row in rows if row.noise_px == 0}
    # docs/explanation/physics.md, section 9: polynomials of order 5 leave 0.0022 mm on such
    # a view.
    assert exact["polynomial-5"].rms_mm < 0.004
    assert exact["polynomial-1"].rms_mm > 1.0
    assert exact["polynomial-5"].covered > 0.99
    # 55 terms to 100 points: with noise the highest order is the worst of all.
    noisy = {row.plane_map: row for row in rows if row.noise_px == 0.1}
    assert noisy["polynomial-9"].rms_mm > noisy["polynomial-5"].rms_mm > 0.01


def test_table_and_picture_are_written(tmp_path: Path) -> None:
    extractors = list(bench_extractors(["max"], pictures=1, quick=True))
    maps = list(bench_maps(["polynomial-2"], draws=1, quick=True))
    nan = float("nan")
    blind = replace(extractors[0], extractor="blind", bias_px=nan, scatter_px=nan, worst_z=nan)
    refused = replace(maps[0], plane_map="shy", rms_mm=nan, max_mm=nan, refused="too few dots")
    write_bench(tmp_path / "bench", [*extractors, blind], [*maps, refused])
    content = json.loads((tmp_path / "bench" / "bench.json").read_text())
    assert content["extractors"][0]["bias_px"] == extractors[0].bias_px
    assert content["extractors"][-1]["scatter_px"] is None
    assert content["maps"][-1]["refused"] == "too few dots"
    assert (tmp_path / "bench" / "bench.png").read_bytes().startswith(b"\x89PNG")
    lengths = {len(cells) for cells in table_cells(extractors, EXTRACTOR_COLUMNS)}
    assert lengths == {len(EXTRACTOR_COLUMNS)}
    assert table_cells([refused], MAP_COLUMNS)[0][3:] == ["refused", "", "", "", "", "", "refused"]


def test_the_whole_bench_takes_ones_own_extractor_and_reports_its_progress(tmp_path: Path) -> None:
    steps: list[tuple[int, int]] = []
    done = run_bench(
        tmp_path, [WRONG], ["polynomial-2"], True, 2, lambda at, of: steps.append((at, of))
    )
    assert steps == [(step, 10) for step in range(1, 11)]  # 7 kinds of line, 3 noises
    assert {row.extractor for row in done.extractors} == {WRONG}
    assert json.loads((tmp_path / "bench.json").read_text()) == done.content
    assert not run_bench(tmp_path, [], ["projective"], True).extractors


def test_a_wrong_name_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    for names in (["median"], []), ([], ["globe"]):
        with pytest.raises(InputError, match="no such"):
            run_bench(tmp_path / "bench", *names, quick=True)
    assert not (tmp_path / "bench").exists()


def test_the_usual_ones_exist() -> None:
    """That MAPS do, too, is shown where all that is shipped is held to the limits."""
    assert {"max", "centroid", "centroid-relative", "ml"} <= set(registered_extractors())


def test_the_command_adds_ones_own_and_prints_json(tmp_path: Path) -> None:
    own = ["--extractor", WRONG, "--map", "polynomial-3", "--only", "--quick", "--json"]
    result = CliRunner().invoke(app, ["bench", "-o", str(tmp_path), *own])
    assert result.exit_code == 0
    printed = json.loads(result.stdout)
    assert {row["extractor"] for row in printed["extractors"]} == {WRONG}
    assert {row["plane_map"] for row in printed["maps"]} == {"polynomial-3"}
    assert all(row["passed"] for rows in printed.values() for row in rows)


def test_a_folder_that_cannot_be_made_is_said_before_the_work(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "file", tmp_path / "file" / "under"):
        with pytest.raises(InputError, match="cannot be made a folder"):
            run_bench(folder, (f"{__name__}:never",), ())


def never(image: Floats, settings: StripeSection, clipped: Mask) -> Stripe:
    """Must not be called."""
    raise AssertionError


def test_a_bench_of_nothing_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nothing to judge.*an extractor or a plane map"):
        run_bench(tmp_path / "out", (), ())
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("extractor", "figures"),
    [
        (constant_row, {"scatter", "outliers"}),
        (blind, {"found"}),
        pytest.param(one_pixel_off, {"bias"}, marks=pytest.mark.slow),
        (too_sure, {"sigma"}),
        pytest.param(now_and_then, {"scatter", "outliers"}, marks=pytest.mark.slow),
    ],
)
def test_an_extractor_of_no_use_fails(
    extractor: Callable[..., Stripe], figures: set[str], tmp_path: Path
) -> None:
    named = f"{__name__}:{extractor.__name__}"
    call = ["bench", "-o", str(tmp_path), "--extractor", named, "--only", "--quick"]
    result = CliRunner().invoke(app, call)
    assert result.exit_code == 1
    rows = json.loads((tmp_path / "bench.json").read_text())["extractors"]
    assert [row["passed"] for row in rows] == [not row["failed"] for row in rows]
    bright = next(row for row in rows if row["case"]["peak_dn"] == 200)
    assert figures <= set(bright["failed"])
    assert f"{sum(not row['passed'] for row in rows)} of {len(rows)} rows" in result.stderr
    for figure in figures:
        assert figure in result.stdout


@dataclass(frozen=True)
class Spoilt:
    """Solves polynomial-5 and changes what it answers."""

    spoil: Callable[[PlanePoints], PlanePoints]

    def solve(self, reading: BoardReading, optics: OpticsSection) -> PlaneMap:
        self.__dict__["solved"] = find_solver("polynomial-5").solve(reading, optics)
        return self  # type: ignore[return-value]

    def to_plane(self, image_px: Floats, sigma_px: Floats | None = None) -> PlanePoints:
        solved: PlaneMap = self.__dict__["solved"]
        return self.spoil(solved.to_plane(image_px, sigma_px))


def moved(points: PlanePoints) -> PlanePoints:
    # One pixel sees 0.82 mm of the sheet or more (the bench's view over the paper's board).
    return replace(
        points, xz_mm=points.xz_mm + 0.82 * np.array([1.0, 0.0]), sigma_mm=points.sigma_mm + 0.82
    )


def nowhere(points: PlanePoints) -> PlanePoints:
    nan = np.full_like(points.xz_mm, np.nan)
    lost = np.full_like(points.status, int(Status.OUT_OF_BOARD))
    return PlanePoints(nan, nan, lost)


@pytest.mark.parametrize(
    ("spoil", "figure"),
    [
        (moved, "rms"),
        (nowhere, "covered"),
        (lambda points: replace(points, xz_mm=0 * points.xz_mm), "rms"),
        (lambda points: replace(points, sigma_mm=points.sigma_mm / 10), "sigma"),
        (lambda points: replace(points, xz_mm=points.xz_mm + np.nan), "rms"),
    ],
)
def test_a_map_of_no_use_fails(
    spoil: Callable[[PlanePoints], PlanePoints],
    figure: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(maps_module, "find_solver", lambda name: Spoilt(spoil))
    named = ["--map", "polynomial-5", "--only", "--quick"]
    result = CliRunner().invoke(app, ["bench", "-o", str(tmp_path), *named])
    assert result.exit_code == 1
    rows = json.loads((tmp_path / "bench.json").read_text())["maps"]
    assert any(figure in row["failed"] for row in rows)
    assert figure in result.stdout


def test_a_map_refused_fails_on_the_papers_board_alone() -> None:
    row = next(bench_maps(["polynomial-5"], draws=1, quick=True))
    refused = replace(row, refused="too few dots", covered=0.0)
    assert failed_of_map(row) == []
    assert failed_of_map(refused) == ["refused"]
    assert failed_of_map(replace(refused, board="coarse")) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_all_that_is_shipped_keeps_to_the_limits(tmp_path: Path, seed: int) -> None:
    done = run_bench(tmp_path, registered_extractors(), MAPS, quick=True, seed=seed)
    assert {row.plane_map for row in done.maps} == set(MAPS)
    out = [row for row in done.extractors if failed_of_extractor(row)]
    assert not out
    assert not [row for row in done.maps if failed_of_map(row)]
    assert done.failed == 0


def test_the_skirt_may_clip_a_line_that_is_not_clipped_by_itself() -> None:
    # In harbor water 200 DN stand on a skirt of 133 DN; in tap water on none.
    for water, clipped in (("tap", False), ("coastal", False), ("harbor", True)):
        case = LineCase(water, 3.0, 200.0, QUIET)
        assert case.saturated == clipped
        assert (mean_picture(case, centres(0.0)).max() > 255) == clipped


def test_a_refused_map_is_said_to_be_so_with_the_reason(tmp_path: Path) -> None:
    call = ["bench", "-o", str(tmp_path), "--only", "--quick", "--map", "polynomial-99"]
    result = CliRunner().invoke(app, call)
    assert result.exit_code == 1
    assert "polynomial-99 on the board 'paper': refused, plane map: no such" in result.stdout
    assert result.stdout.count("refused, ") == 1  # once for all noises
