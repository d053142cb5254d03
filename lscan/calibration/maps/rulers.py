"""Auxiliary rulers: from a place on a ruler's line in the picture to mm (paper Figs. 14 to 16).

The paper looks a pixel coordinate up in the "ruler conversion curve" of Fig. 16, and also
speaks of interpolating between the two marks around it.  Here the conversion curve is the
least-squares polynomial of order 4 through all marks of the ruler, used only where they
reach.  On the paper's view it departs from the truth by 0.002 mm rms, less than straight
lines from mark to mark (0.009 mm), and it averages the noise of the marks: at 0.05 px its
standard error is about 0.015 mm, where two marks alone would leave 0.04 mm.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lscan.calibration.maps.lines import (
    DEGREE,
    Curve,
    CurvePoints,
    Fit,
    fit_curves,
    fit_polynomials,
)
from lscan.calibration.stored import STRICT, Number
from lscan.records import Floats, Mask, RulerReading

CONVERSION_ORDER = 4


@dataclass(frozen=True)
class FittedRuler:
    """A ruler that crosses the lines it reads: a vertical one crosses the latitude lines.

    Attributes
    ----------
    at_mm : float, mm, its fixed coordinate on the board
    line : Curve, px, its own fitted line, along px as a function of across px (GridLine has them
        the other way round, because a ruler runs across the lines it reads)
    conversion : Curve, mm as a function of across px, Fig. 16
    first_px, last_px : float, px, across: the stretch where conversion holds, half a mark beyond
        the outermost marks
    """

    __pydantic_config__ = STRICT
    at_mm: Number
    line: Curve
    conversion: Curve
    first_px: Number
    last_px: Number

    def reaches(self, across_px: Floats) -> Mask:
        """Mask of the places on the ruler that its marks cover.

        Parameters
        ----------
        across_px : (N,) array, px
        """
        return (across_px >= self.first_px) & (across_px <= self.last_px)


def fit_rulers(readings: Sequence[RulerReading], fit: Fit) -> tuple[FittedRuler, ...]:
    """The rulers with lines of the same kind as the map's, without those of too few marks.

    Too few: not enough for the line, or for a conversion curve with a mark to spare.

    Parameters
    ----------
    readings : sequence of RulerReading, px and mm
    fit : str, of the line: "1", "2" or "bspline"

    References
    ----------
    Sec. III.3 and Figs. 14 to 16 of the paper.
    """
    usable, lines, conversions, orders = [], [], [], []
    for reading in readings:
        across, marks, found = ruler_axis(reading), reading.marks, reading.marks.found
        place, along = marks.image_px[found, across], marks.image_px[found, 1 - across]
        sigma, mm = marks.sigma_px[found], marks.board_mm[found, across]
        different = len(set(place.tolist()))
        if different > max(DEGREE[fit], 3):
            usable.append(reading)
            lines.append(CurvePoints(place, along, sigma, sigma))
            conversions.append(CurvePoints(place, mm, sigma, np.zeros_like(sigma)))
            orders.append(min(CONVERSION_ORDER, different - 2))
    curves = zip(fit_curves(lines, fit), fit_polynomials(conversions, orders), strict=True)
    found_at = [points.x for points in lines]
    return tuple(
        _fitted(reading, place, *pair)
        for reading, place, pair in zip(usable, found_at, curves, strict=True)
    )


def _fitted(reading: RulerReading, place: Floats, line: Curve, conversion: Curve) -> FittedRuler:
    half = float(np.median(np.diff(np.sort(place)))) / 2
    first, last = float(place.min()) - half, float(place.max()) + half
    return FittedRuler(reading.at_mm, line, conversion, first, last)


def ruler_axis(reading: RulerReading) -> int:
    """The coordinate a ruler reads: 1 (v, z) for a vertical one, 0 (u, x) for a horizontal.

    Parameters
    ----------
    reading : RulerReading, its direction counts
    """
    return 1 if reading.direction == "vertical" else 0
