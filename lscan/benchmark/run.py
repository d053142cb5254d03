"""The whole bench: which readers of lines and which maps take part, and their rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lscan.benchmark.extractors import ExtractorRow, bench_extractors, cases
from lscan.benchmark.maps import MapRow, bench_maps, board_cases
from lscan.benchmark.page import write_bench
from lscan.calibration.planemap import find_solver
from lscan.config.plugins import installed
from lscan.errors import InputError
from lscan.files.disk import make_folder
from lscan.records import Progress
from lscan.stripe import find_extractor

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
        Called with (done, all) after each kind of line and each board.

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
    kinds = len(list(cases(quick))) if extractors else 0
    total = kinds + (len(list(board_cases(quick))) if maps else 0)

    def step(done: int) -> None:
        if progress is not None:
            progress(done, total)

    pictures, draws = (QUICK_PICTURES, QUICK_DRAWS) if quick else (PICTURES, DRAWS)
    of_lines = bench_extractors(extractors, seed, pictures, quick, step) if extractors else []
    of_boards = (
        bench_maps(maps, seed, draws, quick, lambda done: step(kinds + done)) if maps else []
    )
    return Benchmark(of_lines, of_boards, write_bench(folder, of_lines, of_boards))
