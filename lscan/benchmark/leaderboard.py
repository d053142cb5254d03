"""A page that ranks what saved runs of suites say: one table for each suite."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lscan.benchmark.savedrun import SavedRun, read_saved
from lscan.benchmark.suiterun import SuiteRow, row_of
from lscan.errors import InputError
from lscan.figures.style import page_template
from lscan.files.disk import make_folder, write_atomically
from lscan.version import __version__


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
    "to bound": "their rms over the least that pixel noise allows",
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
