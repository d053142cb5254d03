"""The bench's table and picture, printed and on disk."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from matplotlib.axes import Axes
from pydantic_core import to_jsonable_python

from lscan.benchmark.drawn import LineCase
from lscan.benchmark.methods import (
    ExtractorRow,
    MapRow,
    bench_extractors,
    bench_maps,
    board_cases,
    cases,
    failed_of_extractor,
    failed_of_map,
)
from lscan.benchmark.suiterun import SavedRun, SuiteRow, read_saved, row_of
from lscan.calibration.planemap import find_solver
from lscan.config.plugins import installed
from lscan.errors import InputError
from lscan.figures import style
from lscan.figures.page import page_template
from lscan.files.disk import make_folder, write_atomically, write_json
from lscan.records import Progress
from lscan.stripe import find_extractor
from lscan.version import __version__

AnyRow = TypeVar("AnyRow", ExtractorRow, MapRow)

DPI = 90
LIMITS_PX, LIMITS_MM = (0.003, 1.0), (0.001, 1.0)  # of the picture's colours


def _peak(case: LineCase) -> str:
    """Such as "200 speckled"."""
    words = [f"{case.peak_dn:g}"]
    words += ["clipped"] if case.saturated else []
    words += ["speckled"] if case.noise.speckle else []
    return " ".join(words)


def _if_solved(figure: Callable[[MapRow], str]) -> Callable[[MapRow], str]:
    """The figure of a row, empty where the map was refused."""
    return lambda row: "" if row.refused else figure(row)


EXTRACTOR_COLUMNS: Mapping[str, Callable[[ExtractorRow], str]] = {
    "extractor": lambda row: row.extractor,
    "water": lambda row: row.case.water,
    "width px": lambda row: f"{row.case.sigma_px:g}",
    "peak DN": lambda row: _peak(row.case),
    "bias px": lambda row: f"{row.bias_px:+.4f}",
    "scatter px": lambda row: f"{row.scatter_px:.4f}",
    "to bound": lambda row: "" if row.bound_ratio is None else f"{row.bound_ratio:.2f}",
    "outliers %": lambda row: f"{100 * row.outliers:.1f}",
    "3 sigma %": lambda row: f"{100 * row.within_3_sigma:.1f}",
    "found %": lambda row: f"{100 * row.found:.1f}",
    "us a frame": lambda row: f"{row.us_a_frame:.0f}",
    "out of limits": lambda row: ", ".join(failed_of_extractor(row)),
}
"""The printed table of the extractors: heading to cell."""

MAP_COLUMNS: Mapping[str, Callable[[MapRow], str]] = {
    "plane map": lambda row: row.plane_map,
    "board": lambda row: row.board,
    "noise px": lambda row: f"{row.noise_px:g}",
    "rms mm": lambda row: "refused" if row.refused else f"{row.rms_mm:.4f}",
    "largest mm": _if_solved(lambda row: f"{row.max_mm:.3f}"),
    "3 sigma %": _if_solved(lambda row: f"{100 * row.within_3_sigma:.1f}"),
    "covered %": _if_solved(lambda row: f"{100 * row.covered:.1f}"),
    "ms solve": _if_solved(lambda row: f"{row.ms_solve:.1f}"),
    "ms profile": _if_solved(lambda row: f"{row.ms_profile:.2f}"),
    "out of limits": lambda row: ", ".join(failed_of_map(row)),
}
"""The printed table of the maps: heading to cell."""


def table_cells(
    rows: Iterable[AnyRow], columns: Mapping[str, Callable[[AnyRow], str]]
) -> list[list[str]]:
    """Cells of the printed table of the rows, a list for each row, under the columns' headings.

    Parameters
    ----------
    rows : iterable, of the extractors or of the plane maps
    columns : mapping, the text of a row's cell by the column's heading
    """
    return [[cell(row) for cell in columns.values()] for row in rows]


def write_bench(
    folder: Path, extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]
) -> dict[str, Any]:
    """What bench.json holds, written to ``folder`` with bench.png; InputError from the disk."""
    content = {
        "extractors": [_row_content(row, failed_of_extractor(row)) for row in extractors],
        "maps": [_row_content(row, failed_of_map(row)) for row in maps],
    }
    make_folder(folder)
    write_json(folder / "bench.json", content)
    write_atomically(folder / "bench.png", draw_bench(extractors, maps))
    return content


def _row_content(row: ExtractorRow | MapRow, failed: list[str]) -> dict[str, Any]:
    """The row in JSON types, null for what is no number, and which figures are out of limits."""
    written: dict[str, Any] = to_jsonable_python(row, inf_nan_mode="null")
    return {**written, "failed": failed, "passed": not failed}


@style.styled
def draw_bench(extractors: Sequence[ExtractorRow], maps: Sequence[MapRow]) -> bytes:
    """The picture, PNG: how far each extractor and each map is off, everywhere."""
    errors_px = {
        (row.extractor, _title(row.case)): float(np.hypot(row.bias_px, row.scatter_px))
        for row in extractors
    }
    errors_mm = {(row.plane_map, f"{row.board}\n{row.noise_px:g} px"): row.rms_mm for row in maps}
    parts = (
        ("Stripe extractors: rms error in px (colour: its logarithm)", errors_px, LIMITS_PX),
        ("Plane maps: rms error in mm, by board and noise of its marks", errors_mm, LIMITS_MM),
    )
    counts = [len({name for name, _ in errors}) for _, errors, _ in parts]
    size = (19.0, 2.6 + 0.24 * sum(counts))
    heights = tuple(float(max(count, 1)) for count in counts)
    figure, panels = style.panels(2, size, heights, share_x=False)
    figure.set_facecolor(style.PAPER)
    for axes, (title, errors, limits) in zip(panels, parts, strict=True):
        _heat(axes, errors, limits)
        axes.set_title(title)
    return style.png(figure, DPI)


def _title(case: LineCase) -> str:
    speckled = "\nspeckle" if case.noise.speckle else ""
    return f"{case.water}\n{case.sigma_px:g} px\n{case.peak_dn:g} DN{speckled}"


def _heat(axes: Axes, errors: Mapping[tuple[str, str], float], limits: tuple[float, float]) -> None:
    """A table of numbers with a colour each, by (row, column); empty where there is no number."""
    axes.grid(False)
    if not errors:
        axes.set_axis_off()
        return
    rows, columns = (list(dict.fromkeys(names)) for names in zip(*errors, strict=True))
    values = np.array([[errors.get((row, column), np.nan) for column in columns] for row in rows])
    low, high = np.log10(limits)
    shade = np.clip(np.log10(np.where(values > 0, values, limits[0])), low, high)
    shade = np.where(np.isfinite(values), shade, np.nan)
    axes.imshow(shade, cmap="RdYlGn_r", vmin=low, vmax=high, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            text = f"{value:.3f}" if value < 1 else f"{value:.1f}"
            axes.text(j, i, text.lstrip("0"), ha="center", va="center", fontsize=6.5)
    axes.set_yticks(range(len(rows)), rows)
    axes.set_xticks(range(len(columns)), columns, fontsize=6)


# The whole bench: which readers of lines and which maps take part, and their rows.


MAPS = (
    "graticule-1",
    "graticule-2",
    "graticule-2-norulers",
    "graticule-bspline",
    "projective",
    "polynomial-3",
    "polynomial-5",
    "spline",
    "refractive",
)
PICTURES, QUICK_PICTURES = 6, 3  # of each kind of line
DRAWS, QUICK_DRAWS = 5, 2  # of the noise of each board's marks


@dataclass(frozen=True)
class Benchmark:
    """The rows of both tables, and what bench.json holds of them."""

    extractors: list[ExtractorRow]
    maps: list[MapRow]
    content: dict[str, Any]

    @property
    def failed(self) -> int:
        """Number of rows with a figure out of its limit."""
        return sum(not row["passed"] for rows in self.content.values() for row in rows)


def registered_extractors() -> tuple[str, ...]:
    """The names of all extractors installed, in alphabetical order."""
    return installed("lscan.extractors")


def run_bench(
    folder: Path,
    extractors: Sequence[str],
    maps: Sequence[str],
    quick: bool = False,
    seed: int = 1,
    progress: Progress | None = None,
) -> Benchmark:
    """The rows of the extractors and of the maps named, also written to ``folder``.

    Parameters
    ----------
    folder : Path
        For bench.json and bench.png; it is made.
    extractors : sequence of str
        Names, or ``package.module:function`` of one's own.
    maps : sequence of str
        Full names of plane maps.
    quick : bool
        Fewer kinds of lines and boards, for a first look.
    seed : int
        Of all random numbers.
    progress : callable, optional
        Called with (done, all) after each row.

    Returns
    -------
    Benchmark

    Raises
    ------
    InputError
        Where nothing is named, for a name that does not exist and for a folder that cannot be
        made, before any work; and where the disk refuses.
    """
    if not extractors and not maps:
        raise InputError("nothing to judge", where="bench", allowed="an extractor or a plane map")
    for name in extractors:
        find_extractor(name)
    for name in maps:
        find_solver(name)
    make_folder(folder)
    pictures, draws = (QUICK_PICTURES, QUICK_DRAWS) if quick else (PICTURES, DRAWS)
    every: Iterable[ExtractorRow | MapRow] = chain(
        bench_extractors(extractors, seed, pictures, quick) if extractors else (),
        bench_maps(maps, seed, draws, quick) if maps else (),
    )
    total = len(extractors) * len([*cases(quick)]) + len(maps) * len([*board_cases(quick)])
    rows: list[ExtractorRow | MapRow] = []
    for row in every:
        rows.append(row)
        if progress is not None:
            progress(len(rows), total)
    lines = [row for row in rows if isinstance(row, ExtractorRow)]
    boards = [row for row in rows if isinstance(row, MapRow)]
    return Benchmark(lines, boards, write_bench(folder, lines, boards))


# A page that ranks what saved runs of suites say: one table for each suite.


@dataclass(frozen=True)
class Standing:
    """One method in one saved run.  run: the file's name, or its folder's where it is bench.json.

    row: over all of its cases; its time is the mean of what the file's table says, NaN where that
    holds none of the method.
    """

    run: str
    row: SuiteRow

    @property
    def rms(self) -> float:
        """Of the errors that are not wrong, in the suite's unit."""
        return math.hypot(self.row.bias_px, self.row.scatter_px)


def standings(files: Sequence[Path]) -> dict[str, list[Standing]]:
    """By suite, every method of every saved run, that of the smallest rms error first.

    Parameters
    ----------
    files : sequence of Path, each a bench.json of ``lscan bench --suite``

    Raises
    ------
    InputError
        There is none, or one is no saved run.
    """
    if not files:
        raise InputError("nothing to rank", where="leaderboard", allowed="a bench.json")
    found: dict[str, list[Standing]] = {}
    for file in files:
        saved = read_saved(file)
        run = file.parent.name if file.name == "bench.json" and file.parent.name else file.stem
        for name in saved.sums:
            found.setdefault(saved.suite, []).append(Standing(run, _row(saved, name)))
    for ranked in found.values():
        ranked.sort(key=lambda one: (math.isnan(one.rms), one.rms, one.row.extractor, one.run))
    return dict(sorted(found.items()))


def _row(saved: SavedRun, name: str) -> SuiteRow:
    """The method's row over all cases."""
    timed = [
        (float(row["cases"]), float(row["time"]))
        for row in saved.rows
        if row["extractor"] == name and row["time"] is not None
    ]
    cases = sum(count for count, _ in timed)
    time = sum(count * each for count, each in timed) / cases if cases else math.nan
    return row_of(name, saved.sums[name], {}, time)


def write_leaderboard(files: Sequence[Path], page: Path) -> Path:
    """Write the page: HTML that needs nothing else.

    Parameters
    ----------
    files : sequence of Path, as of ``standings``
    page : Path, of the page; its folder is made

    Returns
    -------
    The page.

    Raises
    ------
    InputError
        As of ``standings``, or the disk refuses.
    """
    tables = {
        suite: [_cells(rank, one) for rank, one in enumerate(ranked, start=1)]
        for suite, ranked in standings(files).items()
    }
    template = page_template("lscan.benchmark", "leaderboard.html.j2")
    text = template.render(tables=tables, headings=HEADINGS, version=__version__)
    make_folder(page.parent)
    write_atomically(page, text.encode())
    return page


HEADINGS: Mapping[str, str] = {
    "method": "extractor, reader of boards (px) or plane map (mm)",
    "run": "the saved run",
    "cases": "pictures",
    "rms": "of the errors on what must be found, wrong ones left out, px or mm",
    "bias": "their mean",
    "to bound": "their rms, divided by the Cramér-Rao bound of a single column",
    "found": "share of what must be found, %",
    "wrong": "share of values that are of something else, %",
    "sure": "share of values that are so and say they are not, %",
    "ghosts": "share of places without anything that got a value, %",
    "3 sigma": "share of values within three of their own sigmas, %",
    "z": "typical error over sigma, 1 where sigma is right",
    "time": "of a picture, to that of a reference workload in the same run",
}


def _cells(rank: int, one: Standing) -> list[tuple[str, float | str]]:
    """Of each column what is shown, and what it is sorted by."""
    row = one.row
    shares = (row.found, row.wrong, row.sure, row.ghosts, row.within_3_sigma)
    numbers = (
        (f"{row.cases}", float(row.cases)), (f"{one.rms:.4f}", one.rms),
        (f"{row.bias_px:+.4f}", row.bias_px), (f"{row.bound_ratio:.2f}", row.bound_ratio),
        *((f"{100 * share:.1f}", share) for share in shares),
        (f"{row.z_ratio:.2f}", row.z_ratio), (f"{row.time:.2f}", row.time),
    )  # fmt: skip
    return [
        (row.extractor, row.extractor),
        (one.run, one.run),
        *(("–", 1e99) if math.isnan(value) else (text, value) for text, value in numbers),
    ]
