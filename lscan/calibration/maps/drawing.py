"""Curves of a solved graticule as points to draw (paper Figs. 13, 16, 33 and 34)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lscan.calibration.maps.graticule import Graticule
from lscan.calibration.maps.lines import Curve, Line
from lscan.calibration.maps.rulers import Ruler, ruler_axis
from lscan.records import BoardReading, Floats

Kind = Literal["latitude", "longitude", "vertical ruler", "horizontal ruler"]


@dataclass(frozen=True)
class DrawnLine:
    """One fitted line: its kind, its place on the board, and (S, 2) points (u, v) in px."""

    kind: Kind
    at_mm: float
    image_px: Floats


@dataclass(frozen=True)
class DrawnConversion:
    """Fig. 16 for one ruler: px (v of a vertical ruler, u of a horizontal) against mm.

    marks_px, marks_mm: (N,) the marks found.  curve_px, curve_mm: (S,) the conversion curve.
    """

    direction: Literal["vertical", "horizontal"]
    at_mm: float
    marks_px: Floats
    marks_mm: Floats
    curve_px: Floats
    curve_mm: Floats


def graticule_lines(graticule: Graticule, samples: int = 200) -> list[DrawnLine]:
    """All lines of the graticule and its rulers, each over the stretch its marks span.

    samples: points per line, S.
    """
    drawn = [
        _sample(kind, line.at_mm, line.curve, (line.first_px, line.last_px), samples)
        for kind, lines in _lines_by_kind(graticule)
        for line in lines
    ]
    drawn += [
        _sample(kind, ruler.at_mm, ruler.line, (ruler.first_px, ruler.last_px), samples)
        for kind, rulers in _rulers_by_kind(graticule)
        for ruler in rulers
    ]
    return drawn


def _lines_by_kind(graticule: Graticule) -> list[tuple[Kind, tuple[Line, ...]]]:
    return [
        ("latitude", graticule.latitudes.lines),
        ("longitude", graticule.longitudes.lines),
    ]


def _rulers_by_kind(graticule: Graticule) -> list[tuple[Kind, tuple[Ruler, ...]]]:
    return [
        ("vertical ruler", graticule.latitudes.rulers),
        ("horizontal ruler", graticule.longitudes.rulers),
    ]


def _sample(
    kind: Kind, at_mm: float, curve: Curve, stretch_px: tuple[float, float], samples: int
) -> DrawnLine:
    along = np.linspace(*stretch_px, samples)
    runs_across = kind in ("latitude", "horizontal ruler")
    pair = (along, curve(along)) if runs_across else (curve(along), along)
    return DrawnLine(kind, at_mm, np.column_stack(pair))


def ruler_conversions(
    graticule: Graticule, reading: BoardReading, samples: int = 200
) -> list[DrawnConversion]:
    """The conversion curve of each ruler that the graticule uses, with the marks behind it.

    reading: the one the graticule was solved from.  samples: points per curve, S.
    """
    drawn = []
    for ruler in reading.rulers:
        axis = ruler_axis(ruler)
        lines = (graticule.longitudes, graticule.latitudes)[axis]
        found = ruler.marks.found
        for solved in lines.rulers:
            if solved.at_mm == ruler.at_mm:
                place = np.linspace(solved.first_px, solved.last_px, samples)
                drawn.append(
                    DrawnConversion(
                        direction=ruler.direction,
                        at_mm=ruler.at_mm,
                        marks_px=ruler.marks.image_px[found, axis],
                        marks_mm=ruler.marks.board_mm[found, axis],
                        curve_px=place,
                        curve_mm=solved.conversion(place),
                    )
                )
    return drawn
