"""Every figure of the table of suites and data sets, measured chapter by chapter."""

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from lscan.benchmark.suiterun import DRAWN
from lscan.records import Progress
from lscan.suites.files import suite_cache, suites_found
from sim.datasets.suite import load_suite_spec, make_cached_suite
from sim.validation.chapters import in_turn
from sim.validation.regression.datasets import dataset_rows
from sim.validation.regression.mutations import mutation_rows, paired_rows
from sim.validation.regression.suites import NAME, judged_rows, made_rows
from sim.validation.rows import Row, RowFile

REPEATS, QUICK_REPEATS = 200, 4
HARMS, QUICK_HARMS = 1000, 14


def run_regression(
    output: Path, quick: bool = False, progress: Progress | None = None
) -> list[Row]:
    """The rows, also written as a JSON list, chapter by chapter.

    Chapters follow each other: most have workers of their own, and some are timed.  A chapter that
    ends with an error is a failed row.

    Parameters
    ----------
    output : Path, the JSON file
    quick : bool, every row, with the least effort: extractors are judged on drawn lines
    progress : Progress or None, called with (done, all) after each chapter

    Raises
    ------
    InputError
        The disk refuses.
    """
    suite = DRAWN if quick else NAME
    chapters: Mapping[str, Callable[[], list[Row]]] = {
        "suite rendered": partial(_rendered, suite),
        "extractors judged": partial(judged_rows, suite),
        "mutations": partial(mutation_rows, suite),
        "paired test": partial(paired_rows, QUICK_REPEATS if quick else REPEATS),
        "suites made": partial(made_rows, QUICK_HARMS if quick else HARMS, quick),
        "data sets": partial(dataset_rows, quick),
    }
    return in_turn(chapters, RowFile(output, quick), progress)


def _rendered(suite: str) -> list[Row]:
    """No row: rendered into the user's cache, a suite that is not drawn, nor a package's."""
    cache = suite_cache()
    if suite == NAME and (cache is None or suites_found().get(NAME, cache).is_relative_to(cache)):
        make_cached_suite(load_suite_spec(NAME), NAME, afresh=True)
    return []
