"""The topics of the page and their figures, with the words of topics.toml."""

from collections.abc import Iterable
from typing import Any

from matplotlib.figure import Figure

from lscan.figures import style
from lscan.figures.style import ReportFigure
from lscan.files.disk import packaged_table
from sim.validation.rows import Row, Topic


def topic(key: str, rows: Iterable[Row], figures: tuple[ReportFigure, ...] = ()) -> Topic:
    """The topic of that key of topics.toml."""
    words = _words(key)
    return Topic(key, words["title"], words["text"].replace("\n", " "), tuple(rows), figures)


def page_figure(key: str, drawn: Figure) -> ReportFigure:
    """The figure of the topic of that key, as drawn."""
    words = _words(key)["figure"]
    words["caption"] = words["caption"].replace("\n", " ")
    return ReportFigure(**words, paper="", body=style.svg(drawn, words["key"], words["alt"]))


def _words(key: str) -> Any:
    return packaged_table("sim.validation.physics", "topics.toml")[key]


def reference(key: str) -> Any:
    """The values that the topic of that key is held against."""
    return packaged_table("sim.validation.physics", "references.toml")[key]
