"""The paper's printed numbers that a report sets beside ours, each with its place.

"Nonmetric Camera Calibration for Underwater Laser Scanning System" (the paper): Tables I to
III, the pixels and centres of eq. (8), and the bounds its text claims.  Numbers stand here
as printed, misprints included; ``MISPRINTS`` lists those that contradict one another.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

CHOSEN_MAP = "graticule-2"
"""The paper's choice after Tables I and II: second-order rms."""

OUR_MAPS: Mapping[str, str] = MappingProxyType(
    {
        "First rms": "graticule-1",
        "Second rms": "graticule-2",
        "Cubic B-spline": "graticule-bspline",
    }
)
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

    board_percent: Secs. IV.A and VI, "percentage error less than 1%".
    groove_mm: Sec. IV.B, "absolute errors ... are all less than 0.6 mm".
    sandwave_mm: Sec. VI, "error bound less than 1.5 mm".
    """

    board_percent: float = 1.0
    groove_mm: float = 0.6
    sandwave_mm: float = 1.5


Triple = tuple[float, float, float]
PrintedTable = Mapping[str, Mapping[str, PrintedLength]]
"""By feature, then by fitting method."""


def _rows(nominal_mm: float, *rows: Triple) -> dict[str, PrintedLength]:
    """The rows of one feature, in the order of ``OUR_MAPS``."""
    named = zip(OUR_MAPS, rows, strict=True)
    return {method: PrintedLength(nominal_mm, *row) for method, row in named}


TABLE_1: PrintedTable = MappingProxyType(
    {
        "A1A2": _rows(80.00, (80.19, 0.19, 0.24), (80.01, 0.01, 0.01), (86.82, 5.82, 7.28)),
        "A2A3": _rows(89.44, (89.68, 0.24, 0.27), (89.43, -0.02, -0.02), (94.73, 5.28, 5.91)),
        "A3A1": _rows(40.00, (39.66, -0.34, -0.86), (39.84, -0.16, -0.39), (40.10, 0.10, 0.26)),
        "B1B2": _rows(60.00, (59.86, -0.14, -0.24), (59.80, -0.20, -0.33), (63.77, 3.77, 6.28)),
        "B2B3": _rows(30.00, (29.69, -0.31, -1.02), (29.90, -0.11, -0.35), (30.03, 0.03, 0.09)),
        "B3B4": _rows(60.00, (59.85, -0.15, -0.26), (59.84, -0.16, -0.27), (63.89, 3.89, 6.48)),
        "B4B1": _rows(30.00, (29.90, -0.10, -0.35), (29.88, -0.12, -0.39), (30.16, 0.16, 0.55)),
        "C1C2": _rows(25.00, (24.88, -0.12, -0.47), (24.91, -0.09, -0.37), (25.62, 0.62, 2.49)),
        "C2C3": _rows(25.00, (24.94, -0.06, -0.23), (25.09, 0.09, 0.35), (25.09, 0.09, 0.37)),
        "C3C4": _rows(25.00, (24.91, -0.09, -0.34), (24.91, -0.09, -0.34), (25.58, 0.58, 2.33)),
        "C4C1": _rows(25.00, (24.89, -0.11, -0.44), (24.95, -0.05, -0.20), (24.90, -0.10, -0.42)),
        "D1D2": _rows(40.00, (39.64, -0.36, -0.91), (39.82, -0.18, -0.46), (40.45, 0.45, 1.13)),
        "D2D3": _rows(50.00, (49.66, -0.34, -0.68), (49.72, -0.28, -0.57), (49.71, -0.29, -0.58)),
        "D3D1": _rows(30.00, (30.45, 0.45, 1.51), (30.11, 0.11, 0.38), (30.28, 0.28, 0.95)),
    }
)
"""Table I, distances between known points: feature, then fitting method."""

TABLE_2: PrintedTable = MappingProxyType(
    {
        "E": _rows(28.40, (28.39, -0.01, -0.04), (28.22, -0.18, -0.64), (29.17, 0.77, 2.70)),
        "F": _rows(49.20, (49.04, -0.16, -0.32), (49.09, -0.11, -0.22), (50.39, 1.19, 2.42)),
        "G": _rows(49.20, (49.04, -0.16, -0.32), (49.07, -0.13, -0.26), (49.63, 0.43, 0.88)),
    }
)
"""Table II, diameters of circles: feature, then fitting method."""

TABLE_3: Mapping[str, PrintedLength] = MappingProxyType(
    {
        "W1": PrintedLength(19.96, 20.03, 0.07, 0.34),
        "W2": PrintedLength(29.96, 29.76, -0.20, -0.67),
        "W3": PrintedLength(29.96, 30.12, 0.16, 0.53),
        "H1": PrintedLength(60.00, 59.45, -0.55, -0.91),
        "H2": PrintedLength(80.06, 79.40, -0.66, -0.83),
        "H3": PrintedLength(20.04, 19.97, -0.07, -0.36),
        "H4": PrintedLength(40.02, 39.67, -0.35, -0.89),
        "S1": PrintedLength(154.96, 154.56, -0.40, -0.26),
        "S2": PrintedLength(131.04, 130.73, -0.31, -0.24),
    }
)
"""Table III, the grooved block, by second-order rms; the nominal is a caliper's reading."""

YAW_DEG = 2.20
"""Sec. IV.C: yaw between the laser sheet and the track, found from the block's left side."""

SLICE_ERRORS_MM = (-1.0, 1.5)
"""Sec. IV.C, Figs. 29 to 32: "most of the errors are bounded between -1 and 1.5 mm"."""

COLUMN = 320
"""Sec. V.B, Fig. 35: the column of the picture whose intensities are shown."""

COLUMN_PIXELS: tuple[tuple[tuple[int, int], ...], ...] = (
    ((251, 142), (252, 245), (253, 255), (254, 176), (255, 120)),
    ((251, 138), (252, 233), (253, 255), (254, 186), (255, 119)),
    ((250, 126), (251, 157), (252, 255), (253, 255), (254, 168)),
)
"""Sec. V.B: (v, intensity) of the brightest pixel and two neighbours each side, per frame."""

CENTRES_RAW_PX: Triple = (252.8795, 252.9087, 252.2313)
"""Sec. V.B: the centres eq. (8) gives for frames 1 to 3 with the intensities as they are."""

CENTRES_RELATIVE_PX: Triple = (252.6657, 252.7470, 252.6909)
"""Sec. V.B: the same with intensities relative to the least of the five."""

MISPRINTS: tuple[Misprint, ...] = (
    Misprint(
        place="Table I, A1A2, cubic B-spline",
        printed="measured 86.82 mm, error 5.82 mm, 7.28 %",
        follows="error and percentage agree on a measured length of 85.82 mm",
    ),
    Misprint(
        place="Sec. IV.B on Table III",
        printed="absolute errors are all less than 0.6 mm",
        follows="H2 in the table is off by −0.66 mm",
    ),
    Misprint(
        place="Sec. V.B, frame 3, intensities as they are",
        printed="252.2313 px",
        follows="eq. (8) gives 252.1894 px for the five printed pixels",
    ),
    Misprint(
        place="Sec. V.B, frame 3, relative intensities",
        printed="252.6909 px",
        follows="eq. (8) gives 252.5498 px for the five printed pixels",
    ),
)
"""Found by recomputing every printed number from the others (tests/lscan/paper/test_paper.py)."""
