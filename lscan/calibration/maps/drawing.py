"""Curves of a solved graticule as points to draw (paper Figs. 13, 16, 33 and 34)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lscan.calibration.maps.graticule import Graticule
from lscan.calibration.maps.lines import Curve, GridLine
from lscan.calibration.maps.rulers import FittedRuler, ruler_axis
from lscan.records import BoardReading, Floats

Kind = Literal["latitude", "longitude", "vertical ruler", "horizontal ruler"]


@dataclass(frozen=True)
class DrawnLine:
    """One fitted line of a graticule.

    Attributes
    ----------
    kind : str, "latitude", "longitude", "vertical ruler" or "horizontal ruler"
    at_mm : float, mm, its place on the board
    image_px : (S, 2) array, px, points (u, v)
    """

    kind: Kind
    at_mm: float
    image_px: Floats


@dataclass(frozen=True)
class DrawnConversion:
    """Fig. 16 for one ruler: px (v of a vertical ruler, u of a horizontal) against mm.

    Attributes
    ----------
    direction : str, "vertical" or "horizontal"
    at_mm : float, mm, its place on the board
    marks_px : (N,) array, px, of the marks found
    marks_mm : (N,) array, mm, of the marks found
    curve_px : (S,) array, px, of the conversion curve
    curve_mm : (S,) array, mm, of the conversion curve
    """

    direction: Literal["vertical", "horizontal"]
    at_mm: float
    marks_px: Floats
    marks_mm: Floats
    curve_px: Floats
    curve_mm: Floats


def graticule_lines(graticule: Graticule, samples: int = 200) -> list[DrawnLine]:
    """All lines of the graticule and its rulers, each over the stretch its marks span.

    Parameters
    ----------
    graticule : Graticule, solved
    samples : int, points per line, S

    References
    ----------
    Figs. 13, 33 and 34 of the paper.
    """
    across, down = graticule.latitudes, graticule.longitudes
    curves: list[tuple[Kind, GridLine | FittedRuler, Curve]] = [
        *(("latitude", line, line.curve) for line in across.lines),
        *(("longitude", line, line.curve) for line in down.lines),
        *(("vertical ruler", ruler, ruler.line) for ruler in across.rulers),
        *(("horizontal ruler", ruler, ruler.line) for ruler in down.rulers),
    ]
    drawn = []
    for kind, line, curve in curves:
        along = np.linspace(line.first_px, line.last_px, samples)
        runs_across = kind in ("latitude", "horizontal ruler")
        along_u = runs_across != graticule.transposed
        pair = (along, curve(along)) if along_u else (curve(along), along)
        drawn.append(DrawnLine(kind, line.at_mm, np.column_stack(pair)))
    return drawn


def ruler_conversions(
    graticule: Graticule, reading: BoardReading, samples: int = 200
) -> list[DrawnConversion]:
    """The conversion curve of each ruler that the graticule uses, with the marks behind it.

    Parameters
    ----------
    graticule : Graticule, solved
    reading : BoardReading, the one the graticule was solved from
    samples : int, points per curve, S

    References
    ----------
    Fig. 16 of the paper.
    """
    drawn = []
    for ruler in reading.rulers:
        axis, found = ruler_axis(ruler), ruler.marks.found
        fitted = (graticule.longitudes, graticule.latitudes)[axis].rulers
        for solved in (one for one in fitted if one.at_mm == ruler.at_mm):
            place = np.linspace(solved.first_px, solved.last_px, samples)
            drawn.append(
                DrawnConversion(
                    direction=ruler.direction,
                    at_mm=ruler.at_mm,
                    marks_px=ruler.marks.image_px[found, axis ^ graticule.transposed],
                    marks_mm=ruler.marks.board_mm[found, axis],
                    curve_px=place,
                    curve_mm=solved.conversion(place),
                )
            )
    return drawn
