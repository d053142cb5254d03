"""The page: every check explained, its figures beside their bars, its plots; self-contained."""

from collections.abc import Sequence
from importlib.metadata import version

from lscan.figures.style import page_template
from sim.validation.physics.gallery import ScenePicture
from sim.validation.rows import Topic, number, rows_of

SOFTWARE = ("lscan", "mitsuba", "drjit", "numpy", "scipy")


def render_page(
    checks: Sequence[Topic], plates: Sequence[ScenePicture] = (), seconds: float = 0.0
) -> str:
    """The page as HTML text; it loads nothing from anywhere."""
    template = page_template(
        "sim.validation.physics", "report.html.j2", number=number, share=share_of_bar
    )
    return template.render(
        checks=checks,
        plates=plates,
        seconds=seconds,
        rows=rows_of(checks),
        versions={name: version(name) for name in SOFTWARE},
    )


def share_of_bar(figure: float, bar: float | None) -> float:
    """How much of its bar a figure uses, in percent, for the gauge: 100 where it is beyond."""
    if bar is None or not figure <= bar:
        return 100.0
    return 100.0 * figure / bar if bar > 0 else 0.0
