"""Whether what is fitted through many points states an interval that holds."""

from functools import partial

from tests.validation.intervals.coded import coded_rows
from tests.validation.intervals.gamma import gamma_rows
from tests.validation.intervals.level import exposure_rows, level_rows
from tests.validation.intervals.maps import map_rows
from tests.validation.intervals.metric import metric_rows
from tests.validation.intervals.rough import RESPONSES, lawless_rows, rough_rows
from tests.validation.intervals.water import water_interval_rows
from tests.validation.intervals.wide import wide_rows
from tests.validation.rows import Chapters, Request


def chapters(request: Request) -> Chapters:
    """The chapters of intervals; those of a quick run take a minute or two.

    Parameters
    ----------
    request : Request
    """
    quick = request.quick
    return {  # the longest first: they are measured side by side
        **{f"rough surfaces, {told}": partial(rough_rows, quick, told) for told in RESPONSES},
        "tone curves": partial(gamma_rows, request.scenes, quick),
        "level lines": partial(level_rows, quick),
        "exposures": partial(exposure_rows, quick),
        "coded pictures": partial(coded_rows, quick),
        "other water": partial(water_interval_rows, 2 if quick else 20),
        "maps of one board": partial(map_rows, 4 if quick else 40),
        "views of a board": partial(metric_rows, quick),
        "wide lenses": partial(wide_rows, request.scenes, 1 if quick else 5),
        "surfaces without a law": partial(lawless_rows, quick),
    }
