"""What the figures are drawn from, and what comes out: plain records of plain arrays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lscan.records import Floats, Ints


@dataclass(frozen=True)
class ReportFigure:
    """A figure ready for a page.

    key: short name, unique on the page.  title: what is shown, a few words.
    paper: the paper's figure, such as "Fig. 13".  alt: the picture in words.
    caption: what is seen, and the finding with its numbers.
    body: self-contained HTML: an inline SVG, or a canvas with its script.
    script: JavaScript to run after the page's plotting library, "" for a still picture.
    """

    key: str
    title: str
    paper: str
    alt: str
    caption: str
    body: str
    script: str = ""


@dataclass(frozen=True)
class RowFits:
    """One row of control points and the latitude lines fitted to it, in px.

    points_px: (C, 2) of (u, v), as found.  curves: plane map name to (K, 2) points along the
    line fitted to them.  shifted_px, shifted_curves: the same after one control point was
    moved by one pixel across the row; None and empty where that was not tried.
    """

    points_px: Floats
    curves: Mapping[str, Floats]
    shifted_px: Floats | None = None
    shifted_curves: Mapping[str, Floats] | None = None


@dataclass(frozen=True)
class RulerCurve:
    """The conversion curve of one auxiliary ruler: pixel coordinate to board coordinate.

    name: such as "R4".  coordinate: "z" of a vertical ruler (px is v), "x" of a horizontal
    one (px is u).  marks_px, marks_mm: (M,) each mark.  curve_px, curve_mm: (K,) the curve.
    """

    name: str
    coordinate: str
    marks_px: Floats
    marks_mm: Floats
    curve_px: Floats
    curve_mm: Floats


@dataclass(frozen=True)
class SliceData:
    """A straight slice of the aligned surface, N points.

    along_mm: (N,) distance from the slice's start.  measured_mm: (N,) height, NaN where
    status gives none.  status: (N,) of Status.  nominal_mm, error_mm: (N,) designed height
    and measured minus nominal, None where the shape is unknown.  sigma_mm: (N,) standard
    uncertainty of the height.  ends_mm: (2, 2) of (x, y), start and end.
    """

    along_mm: Floats
    measured_mm: Floats
    status: Ints
    nominal_mm: Floats | None = None
    error_mm: Floats | None = None
    sigma_mm: Floats | None = None
    ends_mm: Floats | None = None


def signed(value: float, digits: int) -> str:
    """The number with its sign, + or a true minus, and so many decimals."""
    return f"{value:+.{digits}f}".replace("-", "−")
