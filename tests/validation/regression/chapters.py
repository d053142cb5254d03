"""Suites, the paired test and data sets."""

from functools import partial

from lscan.benchmark.suiterun import DRAWN
from lscan.suites.files import suite_cache, suites_found
from sim.datasets.suite import load_suite_spec, make_cached_suite
from tests.validation.regression.datasets import dataset_rows
from tests.validation.regression.mutations import mutation_rows, paired_rows
from tests.validation.regression.suites import NAME, judged_rows, made_rows
from tests.validation.rows import Chapters, Request, Row

REPEATS, QUICK_REPEATS = 200, 4
HARMS, QUICK_HARMS = 1000, 14


def chapters(request: Request) -> Chapters:
    """The chapters of suites and data sets: most have workers of their own, and some are timed.

    Those of a quick run judge extractors on drawn lines.

    Parameters
    ----------
    request : Request
    """
    quick = request.quick
    suite = DRAWN if quick else NAME
    return {
        "suite rendered": partial(_rendered, suite),
        "extractors judged": partial(judged_rows, suite),
        "mutations": partial(mutation_rows, suite),
        "paired test": partial(paired_rows, QUICK_REPEATS if quick else REPEATS),
        "suites made": partial(made_rows, QUICK_HARMS if quick else HARMS, quick),
        "data sets": partial(dataset_rows, quick),
    }


def _rendered(suite: str) -> list[Row]:
    """No row: rendered into the user's cache, a suite that is not drawn, nor a package's."""
    cache = suite_cache()
    if suite == NAME and (cache is None or suites_found().get(NAME, cache).is_relative_to(cache)):
        make_cached_suite(load_suite_spec(NAME), NAME, afresh=True)
    return []
