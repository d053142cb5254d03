"""The topics of the page, each with the title and the text of topics.toml."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from importlib.resources import files

from lscan.figures.reportfigure import ReportFigure
from sim.validation.rows import Row, Topic


def topic(key: str, rows: Iterable[Row], figures: tuple[ReportFigure, ...] = ()) -> Topic:
    """The topic of that key of topics.toml."""
    text = files("sim.validation.physics").joinpath("topics.toml").read_text(encoding="utf-8")
    said = tomllib.loads(text)[key]
    return Topic(key, said["title"], " ".join(said["text"].split()), tuple(rows), figures)
