"""Figures of the calibration: board picture, control points, line fits, ruler conversion."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes

from lscan.figures import style
from lscan.figures.reportfigure import ReportFigure, RowFits, RulerCurve
from lscan.records import BoardReading, Bytes, Floats, Marks, Status

FITS: Mapping[str, tuple[str, str]] = {
    "graticule-1": ("first-order rms", style.THIRD),
    "graticule-2": ("second-order rms", style.SECOND),
    "graticule-bspline": ("cubic B-spline", style.FIRST),
}
"""The three fits of Fig. 13, top to bottom: plane map name to name and colour."""


def board_picture(image: Bytes, reading: BoardReading | None) -> ReportFigure:
    """The calibration board as the camera sees it (Fig. 9), and how uneven its pitch is."""
    height, width = image.shape[:2]
    alt = f"Photograph of the calibration board, {width} by {height} pixels."
    return ReportFigure(
        key="board",
        title="The calibration board as the camera sees it",
        paper="Fig. 9",
        alt=alt,
        caption=f"One picture of {width} × {height} px calibrates the whole instrument."
        f"{'' if reading is None else _pitch(reading)}",
        body=style.photograph(image, "", alt),
    )


def _pitch(reading: BoardReading) -> str:
    """Mean distance of neighbours in the highest and in the lowest row that hold some."""
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    step = np.linalg.norm(np.diff(lattice, axis=1), axis=2)
    rows = step[np.isfinite(step).any(axis=1)]
    if len(rows) == 0:
        return ""
    return (
        f" Control points {reading.pitch_mm:g} mm apart on the board are {np.nanmean(rows[0]):.1f} "
        f"px apart in the top row and {np.nanmean(rows[-1]):.1f} px in the bottom row: what the "
        "plane map has to undo."
    )


def control_points(image: Bytes, reading: BoardReading | None, marked: bool) -> ReportFigure:
    """The marks that were found (Fig. 12).

    image: the board picture.  marked: the search boxes and crosses are painted into it
    already; where False the crosses are drawn from ``reading``.
    """
    overlay = "" if marked or reading is None else _crossed(reading)
    alt = "The board picture with a cross on every control point that was found."
    boxes = "Boxes show where each one was looked for. " if marked else ""
    found = "" if reading is None else _found(reading)
    return ReportFigure(
        key="control-points",
        title="Control points found",
        paper="Fig. 12",
        alt=alt,
        caption=f"Every control point that was found is marked ×. {boxes}{found}",
        body=style.photograph(image, overlay, alt),
    )


def _crossed(reading: BoardReading) -> str:
    rulers = "".join(
        style.crosses(ruler.marks.image_px, "#ffd54a", 2.2, 0.8) for ruler in reading.rulers
    )
    origin = reading.grid.image_px[0]
    name = ""
    if np.isfinite(origin).all():
        name = style.label((origin[0] - 16, origin[1] - 8), "O", "#ff3b30")
    return rulers + style.crosses(reading.grid.image_px, "#ff3b30", 6.0, 1.2) + name


def _found(reading: BoardReading) -> str:
    parts = [f"{_count(reading.grid)} control points"]
    if reading.rulers:
        seen = sum(int(ruler.marks.found.sum()) for ruler in reading.rulers)
        asked = sum(len(ruler.marks.status) for ruler in reading.rulers)
        parts.append(f"{seen} of {asked} marks of {len(reading.rulers)} rulers")
    sigma = reading.grid.sigma_px[reading.grid.found]
    typical = (
        f"; the median standard uncertainty of a control point is {np.median(sigma):.3f} px"
        if len(sigma)
        else ""
    )
    return f"Found: {' and '.join(parts)}{typical}.{_unseen(reading.grid)}"


def _count(marks: Marks) -> str:
    return f"{int(marks.found.sum())} of {len(marks.status)}"


def _unseen(marks: Marks) -> str:
    outside = int((marks.status == Status.OUT_OF_VIEW).sum())
    return f" {outside} lie outside the picture." if outside else ""


@style.styled
def line_fits(row: RowFits) -> ReportFigure:
    """The three fits of one row of control points, one above the other (Fig. 13)."""
    fits = [name for name in FITS if name in row.curves]
    figure, axes = style.panels(len(fits), (style.WIDTH_IN, 1.4 * len(fits) + 0.4))
    notes = []
    for panel, name in zip(axes, fits, strict=True):
        title, colour = FITS[name]
        rms, worst = _residual(row.points_px, row.curves[name])
        notes.append(f"{title} {rms:.2f} px rms, {worst:.2f} px at most")
        panel.plot(*row.curves[name].T, color=colour)
        _mark(panel, row.points_px)
        panel.set_title(f"{title}: {rms:.2f} px rms off the control points")
        panel.set_ylabel("v / px")
        panel.invert_yaxis()
    axes[-1].set_xlabel("u / px")
    alt = "One row of control points with " + ", ".join(FITS[name][0] for name in fits) + "."
    return ReportFigure(
        key="line-fits",
        title="Fits of one row of control points",
        paper="Fig. 13",
        alt=alt,
        caption="One row of control points (×) and the latitude line fitted to it, from top to "
        "bottom; v is stretched. Distance between control points and line: "
        f"{'; '.join(notes)}.",
        body=style.svg(figure, "line-fits", alt),
    )


def _mark(panel: Axes, points: Floats, colour: str = style.INK) -> None:
    panel.plot(*points.T, "x", color=colour, markersize=5, markeredgewidth=1.0)


def _residual(points: Floats, curve: Floats) -> tuple[float, float]:
    """Rms and largest |distance| in v between points and curve, px."""
    points = points[np.isfinite(points).all(axis=1)]
    off = np.abs(points[:, 1] - _across(curve, points[:, 0]))
    return float(np.sqrt(np.mean(off**2))), float(off.max())


def _across(curve: Floats, u: Floats) -> Floats:
    """v of a curve's (K, 2) points at u, whichever way the curve runs."""
    return np.interp(u, *curve[np.argsort(curve[:, 0])].T)


@style.styled
def sensitivity(row: RowFits, name: str, paper: str) -> ReportFigure:
    """What one control point shifted by one pixel does to a fit (Figs. 33 and 34).

    name: "graticule-bspline" or "graticule-2".  The row must carry its shifted fits.
    """
    if row.shifted_px is None or row.shifted_curves is None:
        raise ValueError("the row has no shifted fits")
    title, colour = FITS[name]
    before, after = row.curves[name], row.shifted_curves[name]
    change = after[:, 1] - _across(before, after[:, 0])
    moved = int(np.nanargmax(np.abs(row.shifted_px - row.points_px).max(axis=1)))
    key = f"sensitivity-{name}"
    figure, (lines, differences) = style.panels(2, (style.WIDTH_IN, 4.0), (1.4, 1.0))
    lines.plot(*before.T, color=style.INK, linewidth=1.0, label="control points as found")
    lines.plot(*after.T, color=colour, label="one shifted by 1 px")
    _mark(lines, row.points_px)
    lines.plot(*row.shifted_px[moved], "o", color=colour, fillstyle="none", markersize=8)
    lines.set_ylabel("v / px")
    lines.invert_yaxis()
    style.legend(lines)
    differences.axhline(0, color=style.MUTED, linewidth=0.7)
    differences.plot(after[:, 0], change, color=colour)
    differences.set_ylim(1.25, -1.25)
    differences.set_ylabel("change of v / px")
    differences.set_xlabel("u / px")
    alt = f"A {title} through a row of control points, before and after one moved by a pixel."
    return ReportFigure(
        key=key,
        title=f"Sensitivity of the {title} to one control point",
        paper=paper,
        alt=alt,
        caption=f"Above, the {title} of one row before and after the ringed control point is "
        f"shifted by 1 px; below, by how much the line moves. {_ripple(change)} Its "
        f"curvature changes sign {_inflections(before)} times before and {_inflections(after)} "
        "times after the shift.",
        body=style.svg(figure, key, alt),
    )


def _ripple(change: Floats) -> str:
    sign = 1.0 if abs(change.max()) >= abs(change.min()) else -1.0
    along, against = float((sign * change).max()), float(max(0.0, (-sign * change).max()))
    return (
        f"It follows the shift by up to {along:.2f} px and swings the other way by up to "
        f"{against:.2f} px."
    )


def _inflections(curve: Floats) -> int:
    """How often the curvature of (K, 2) points along a line v(u) changes sign.

    Curvature below a twentieth of its largest value counts as none.
    """
    bend = np.gradient(np.gradient(curve[:, 1], curve[:, 0]), curve[:, 0])[2:-2]
    bend = bend[np.abs(bend) > 0.05 * np.abs(bend).max()]
    return int(np.count_nonzero(np.diff(np.sign(bend))))


@style.styled
def ruler(curve: RulerCurve) -> ReportFigure:
    """Pixel coordinate of a ruler's marks against their board coordinate (Fig. 16)."""
    pixel = "v" if curve.coordinate == "z" else "u"
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 3.4))
    axes.plot(curve.curve_px, curve.curve_mm, color=style.SECOND)
    axes.plot(curve.marks_px, curve.marks_mm, "o", color=style.INK, markersize=3)
    axes.set_xlabel(f"{pixel} / px")
    axes.set_ylabel(f"{curve.coordinate} / mm")
    scale = np.abs(np.gradient(curve.curve_mm, curve.curve_px))
    alt = f"Board coordinate against pixel coordinate for the marks of ruler {curve.name}."
    known = np.isfinite(curve.marks_px)
    return ReportFigure(
        key="ruler",
        title=f"Conversion curve of ruler {curve.name}",
        paper="Fig. 16",
        alt=alt,
        caption=f"{int(known.sum())} marks of ruler {curve.name} (dots) and the curve that "
        f"turns {pixel} into {curve.coordinate}. A pixel is {scale.min():.2f} to "
        f"{scale.max():.2f} mm on the board, larger where the board is farther away; the paper "
        "says about 1 mm.",
        body=style.svg(figure, "ruler", alt),
    )
