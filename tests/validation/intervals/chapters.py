"""Whether what is fitted through many points states an interval that holds."""

from functools import partial

from tests.validation.intervals.gamma import gamma_rows
from tests.validation.rows import Chapters, Request


def chapters(request: Request) -> Chapters:
    """The chapters of intervals; those of a quick run need a minute.

    Parameters
    ----------
    request : Request
    """
    quick, scenes = request.quick, request.scenes
    return {"tone curves": partial(gamma_rows, scenes, quick)}
