"""The paper's printed numbers that a report sets beside ours, each with its place.

"Nonmetric Camera Calibration for Underwater Laser Scanning System" (the paper): Tables I to
III, the pixels and centres of eq. (8), and the bounds its text claims.  Numbers stand here and
in published.toml as printed, misprints included; ``MISPRINTS`` lists those that contradict one
another.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from lscan.files.disk import packaged_table

CHOSEN_MAP = "graticule-2"
"""The paper's choice after Tables I and II: second-order rms."""

OUR_MAPS: Mapping[str, str] = {
    "First rms": "graticule-1",
    "Second rms": "graticule-2",
    "Cubic B-spline": "graticule-bspline",
}
"""The paper's fitting methods (Fig. 13) and the plane maps here that work the same way."""


@dataclass(frozen=True)
class PrintedLength:
    """One cell group of a table: the error is measured minus nominal, percent of nominal."""

    nominal_mm: float
    measured_mm: float
    error_mm: float
    percent: float


@dataclass(frozen=True)
class Misprint:
    """Where the paper contradicts itself, what it prints, and what its other numbers give."""

    place: str
    printed: str
    follows: str


@dataclass(frozen=True)
class Bars:
    """The largest errors a report accepts; the defaults are the bounds the paper claims.

    Attributes
    ----------
    board_percent : float, percent; Secs. IV.A and VI, "percentage error less than 1%"
    groove_mm : float, mm; Sec. IV.B, "absolute errors ... are all less than 0.6 mm"
    sandwave_mm : float, mm; Sec. VI, "error bound less than 1.5 mm"
    """

    board_percent: float = 1.0
    groove_mm: float = 0.6
    sandwave_mm: float = 1.5


PrintedTable = Mapping[str, Mapping[str, PrintedLength]]
"""By feature, then by fitting method."""

_PRINTED = packaged_table("lscan.paper", "published.toml")


def _rows_by_method(table: str) -> PrintedTable:
    """A table with rows of the nominal length and, in the order of ``OUR_MAPS``, the fits'."""
    return {
        feature: {
            method: PrintedLength(nominal_mm, *row)
            for method, row in zip(OUR_MAPS, rows, strict=True)
        }
        for feature, (nominal_mm, *rows) in _PRINTED[table].items()
    }


TABLE_1 = _rows_by_method("table-1")
"""Table I, distances between known points: feature, then fitting method."""

TABLE_2 = _rows_by_method("table-2")
"""Table II, diameters of circles: feature, then fitting method."""

TABLE_3: Mapping[str, PrintedLength] = {
    feature: PrintedLength(*row) for feature, row in _PRINTED["table-3"].items()
}
"""Table III, the grooved block, by second-order rms; the nominal is a caliper's reading."""

YAW_DEG = 2.20
"""Sec. IV.C: yaw between the laser sheet and the track, found from the block's left side."""

SLICE_ERRORS_MM = (-1.0, 1.5)
"""Sec. IV.C, Figs. 29 to 32: "most of the errors are bounded between -1 and 1.5 mm"."""

COLUMN = 320
"""Sec. V.B, Fig. 35: the column of the picture whose intensities are shown."""

COLUMN_PIXELS = _PRINTED["column-pixels"]
"""Sec. V.B: (v, intensity) of the brightest pixel and two neighbours each side, per frame."""

CENTRES_RAW_PX = (252.8795, 252.9087, 252.2313)
"""Sec. V.B: the centres eq. (8) gives for frames 1 to 3 with the intensities as they are."""

CENTRES_RELATIVE_PX = (252.6657, 252.7470, 252.6909)
"""Sec. V.B: the same with intensities relative to the least of the five."""

MISPRINTS = tuple(Misprint(**entry) for entry in _PRINTED["misprint"])
"""Found by recomputing every printed number from the others (tests/lscan/paper/test_paper.py)."""
