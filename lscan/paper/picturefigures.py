"""Figures of pictures: the board, its control points and fits, and the laser line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lscan.board import draw_overlay
from lscan.calibration.calibrate import calibrate
from lscan.calibration.maps.graticule import (
    DrawnConversion,
    Graticule,
    graticule_lines,
    ruler_conversions,
)
from lscan.calibration.planemap import PlaneMap
from lscan.config.plugins import find_plugin
from lscan.config.rig import StripeSection
from lscan.figures import style
from lscan.figures.page import ReportFigure
from lscan.files.disk import packaged_table
from lscan.files.pictures import grey_dn
from lscan.paper import published as paper
from lscan.paper.experiment import BoardResult, LinePictures
from lscan.paper.published import CHOSEN_MAP
from lscan.records import BoardReading, Floats, Picture, Status, Stripe, has_value

# The report's figures as their words in figures.toml have them.


_TABLE = packaged_table("lscan.paper", "figures.toml")


def figure_of(name: str, figure: Figure, /, **found: object) -> ReportFigure:
    """The drawn figure with the words of that name, ``found`` put into them."""
    words = words_of(name, **found)
    return ReportFigure(**words, body=style.svg(figure, words["key"], words["alt"]))


def photo_of(name: str, image: Picture, overlay: str = "", /, **found: object) -> ReportFigure:
    """The picture as ``style.photograph`` has it, with the words of that name."""
    words = words_of(name, **found)
    return ReportFigure(**words, body=style.photograph(image, overlay, words["alt"]))


def words_of(name: str, /, **found: object) -> dict[str, str]:
    """Key, title, paper's figure, picture in words and caption, as ReportFigure takes them."""
    templates = {"key": name, **_TABLE[name]}
    return {part: text.format(**found).replace("\n", " ") for part, text in templates.items()}


# Figures of the calibration: board picture, control points, line fits, ruler conversion.


FITS: Mapping[str, tuple[str, str]] = {
    "graticule-1": ("first-order rms", style.THIRD),
    "graticule-2": ("second-order rms", style.SECOND),
    "graticule-bspline": ("cubic B-spline", style.FIRST),
}
"""The three fits of Fig. 13, top to bottom: plane map name to name and colour."""

SENSITIVITIES = {"graticule-bspline": "Fig. 33", "graticule-2": "Fig. 34"}


@dataclass(frozen=True)
class RowFits:
    """One row of C control points and the latitude lines fitted to it, in px.

    points_px: (C, 2) of (u, v), as found.  curves: plane map name to (K, 2) points along the
    line fitted to them.  shifted_px, shifted_curves: the same after one control point was
    moved by one pixel across the row.
    """

    points_px: Floats
    curves: Mapping[str, Floats]
    shifted_px: Floats
    shifted_curves: Mapping[str, Floats]


def board_figures(board: BoardResult) -> tuple[list[ReportFigure], list[ReportFigure]]:
    """The figures of the calibration, and those of its sensitivity to one control point."""
    row, conversion = row_fits(board), _last_vertical_ruler(board)
    figures = [
        board_picture(board.image, board.reading),
        control_points(board.image, board.reading),
        line_fits(row),
    ]
    if conversion is not None:
        figures.append(ruler(conversion))
    return figures, [sensitivity(row, name, paper) for name, paper in SENSITIVITIES.items()]


def row_fits(board: BoardResult) -> RowFits:
    """The middle row of control points with its three fits, and with one point moved by 1 px."""
    rows, columns = board.reading.shape
    row, moved = rows // 2, columns // 2
    image_px = board.reading.grid.image_px.copy()
    image_px[row * columns + moved, 1] -= 1.0  # one pixel higher in the picture (Fig. 33)
    shifted = replace(board.reading, grid=replace(board.reading.grid, image_px=image_px))
    fits = {name: board.calibrations[name].plane_map for name in FITS}
    again = {name: calibrate(shifted, name).plane_map for name in FITS}
    lattice = slice(row * columns, (row + 1) * columns)
    at_mm = float(board.reading.grid.board_mm[lattice][0, 1])
    return RowFits(
        points_px=board.reading.grid.image_px[lattice],
        curves={name: _latitude(plane, at_mm) for name, plane in fits.items()},
        shifted_px=shifted.grid.image_px[lattice],
        shifted_curves={name: _latitude(plane, at_mm) for name, plane in again.items()},
    )


def _latitude(plane_map: PlaneMap, at_mm: float) -> Floats:
    """(K, 2) points in px of the latitude line at z = at_mm."""
    assert isinstance(plane_map, Graticule)
    lines = [line for line in graticule_lines(plane_map) if line.kind == "latitude"]
    return min(lines, key=lambda line: abs(line.at_mm - at_mm)).image_px


def _last_vertical_ruler(board: BoardResult) -> DrawnConversion | None:
    """The conversion curve of the last vertical ruler; None where the board has none."""
    plane_map = board.calibrations[CHOSEN_MAP].plane_map
    assert isinstance(plane_map, Graticule)
    rulers = ruler_conversions(plane_map, board.reading)
    vertical = [ruler for ruler in rulers if ruler.direction == "vertical"]
    return vertical[-1] if vertical else None


def board_picture(image: Picture, reading: BoardReading) -> ReportFigure:
    """The calibration board as the camera sees it (Fig. 9), and how uneven its pitch is."""
    height, width = image.shape[:2]
    # Mean distance of neighbours in the highest and in the lowest row that hold some.
    lattice = reading.grid.image_px.reshape(*reading.shape, 2)
    step = np.linalg.norm(np.diff(lattice, axis=1), axis=2)
    rows = step[np.isfinite(step).any(axis=1)]
    pitch = {"top": np.nanmean(rows[0]), "bottom": np.nanmean(rows[-1])}
    return photo_of("board", image, width=width, height=height, pitch=reading.pitch_mm, **pitch)


def control_points(image: Picture, reading: BoardReading) -> ReportFigure:
    """The marks that were found, and the boxes in which they were looked for (Fig. 12)."""
    grid = reading.grid
    found = f"{int(grid.found.sum())} of {len(grid.status)} control points"
    if reading.rulers:
        seen = sum(int(ruler.marks.found.sum()) for ruler in reading.rulers)
        asked = sum(len(ruler.marks.status) for ruler in reading.rulers)
        found += f" and {seen} of {asked} marks of {len(reading.rulers)} rulers"
    outside = int((grid.status == Status.OUT_OF_VIEW).sum())
    sigma = np.median(grid.sigma_px[grid.found])
    unseen = f" {outside} lie outside the picture." if outside else ""
    return photo_of(
        "control-points", draw_overlay(image, reading), found=found, sigma=sigma, unseen=unseen
    )


@style.styled
def line_fits(row: RowFits) -> ReportFigure:
    """The three fits of one row of control points, one above the other (Fig. 13)."""
    figure, axes = style.panels(len(FITS), (style.WIDTH_IN, 1.4 * len(FITS) + 0.4))
    notes = []
    for panel, (name, (title, colour)) in zip(axes, FITS.items(), strict=True):
        points = row.points_px[np.isfinite(row.points_px).all(axis=1)]
        off = np.abs(points[:, 1] - _across(row.curves[name], points[:, 0]))  # in v, px
        rms, worst = float(np.sqrt(np.mean(off**2))), float(off.max())
        notes.append(f"{title} {rms:.2f} px rms, {worst:.2f} px at most")
        panel.plot(*row.curves[name].T, color=colour)
        _mark(panel, row.points_px)
        panel.set(title=f"{title}: {rms:.2f} px rms off the control points", ylabel="v / px")
        panel.invert_yaxis()
    axes[-1].set_xlabel("u / px")
    fits = ", ".join(title for title, _ in FITS.values())
    return figure_of("line-fits", figure, fits=fits, distances="; ".join(notes))


def _mark(panel: Axes, points: Floats, colour: str = style.INK) -> None:
    panel.plot(*points.T, "x", color=colour, markersize=5, markeredgewidth=1.0)


def _across(curve: Floats, u: Floats) -> Floats:
    """v of a curve's (K, 2) points at u, whichever way the curve runs."""
    return np.interp(u, *curve[np.argsort(curve[:, 0])].T)


@style.styled
def sensitivity(row: RowFits, name: str, paper: str) -> ReportFigure:
    """What one control point shifted by one pixel does to a fit (Figs. 33 and 34).

    name: "graticule-bspline" or "graticule-2".  paper: the paper's figure.
    """
    title, colour = FITS[name]
    before, after = row.curves[name], row.shifted_curves[name]
    change = after[:, 1] - _across(before, after[:, 0])
    moved = int(np.nanargmax(np.abs(row.shifted_px - row.points_px).max(axis=1)))
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
    differences.set(ylim=(1.25, -1.25), ylabel="change of v / px", xlabel="u / px")
    sign = 1.0 if abs(change.max()) >= abs(change.min()) else -1.0
    return figure_of(
        "sensitivity",
        figure,
        plane_map=name,
        fit=title,
        paper=paper,
        along=(sign * change).max(),
        against=max(0.0, (-sign * change).max()),
        before=_inflections(before),
        after=_inflections(after),
    )


def _inflections(curve: Floats) -> int:
    """How often the curvature of (K, 2) points along a line v(u) changes sign.

    Curvature below a twentieth of its largest value counts as none.
    """
    bend = np.gradient(np.gradient(curve[:, 1], curve[:, 0]), curve[:, 0])[2:-2]
    bend = bend[np.abs(bend) > 0.05 * np.abs(bend).max()]
    return int(np.count_nonzero(np.diff(np.sign(bend))))


@style.styled
def ruler(curve: DrawnConversion) -> ReportFigure:
    """Vertical pixel coordinate of a ruler's marks against their height on the board (Fig. 16)."""
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 3.4))
    axes.plot(curve.curve_px, curve.curve_mm, color=style.SECOND)
    axes.plot(curve.marks_px, curve.marks_mm, "o", color=style.INK, markersize=3)
    axes.set(xlabel="v / px", ylabel="z / mm")
    scale = np.abs(np.gradient(curve.curve_mm, curve.curve_px))
    marks = len(curve.marks_px)
    return figure_of(
        "ruler", figure, at=curve.at_mm, marks=marks, least=scale.min(), most=scale.max()
    )


# Figures of the laser line: snapshots with the stripe found, and one column's intensities.


_FOUND, _COLUMN = "#35e0ff", "#ffd54a"
_ZOOM_PX = 8
_COLOURS = (style.FIRST, style.SECOND, style.THIRD)


def groove_snapshot(pictures: LinePictures) -> ReportFigure:
    """The laser line on the grooved block (Fig. 21)."""
    stripe = pictures.stripe
    return photo_of("groove", pictures.images[0], _line_spots(stripe), line=_describe(stripe))


def sandwave_snapshot(pictures: LinePictures, column: int) -> ReportFigure:
    """The laser line on the sandwave, and the column of Fig. 35 (Fig. 24).

    column: u of the column that is marked.
    """
    image, stripe = pictures.images[0], pictures.stripe
    dashes = f'd="M{column},0V{image.shape[0]}" stroke-width="0.8" stroke-dasharray="4 4"'
    overlay = f'{_line_spots(stripe)}<path {dashes} stroke="{_COLUMN}"/>'
    return photo_of("sandwave", image, overlay, line=_describe(stripe), column=column)


def _line_spots(stripe: Stripe) -> str:
    return style.spots(stripe.image_px, _FOUND, 1.1)


def _describe(stripe: Stripe) -> str:
    valued = has_value(stripe.status)
    clipped = int((stripe.status == Status.SATURATED).sum())
    parts = [f"{int(valued.sum())} of {len(valued)} {stripe.axis} hold a line (pale dots)"]
    if clipped:
        parts.append(f"{clipped} of them clipped")
    if valued.any():
        parts.append(f"median standard uncertainty {np.median(stripe.sigma_px[valued]):.3f} px")
    return f"{', '.join(parts)}."


def lit_column(pictures: LinePictures) -> int:
    """The column for Fig. 35: the paper's 320th, or the nearest one that holds a line."""
    stripe = pictures.stripe
    wanted = min(paper.COLUMN, pictures.images[0].shape[1] - 1)
    if stripe.axis != "columns":
        return wanted
    lit = np.flatnonzero(has_value(stripe.status))
    return int(lit[np.abs(lit - wanted).argmin()]) if len(lit) else wanted


@style.styled
def column_intensities(images: Sequence[Picture], column: int) -> ReportFigure:
    """Intensities of one column over consecutive frames, with eq. (8)'s centres (Fig. 35).

    images: at most three frames, each (H, W) grey or (H, W, 3) RGB, whose red is shown.
    """
    reds = [grey_dn(image if image.ndim == 2 else image[:, :, 0]).astype(float) for image in images]
    relative = [_centre("centroid-relative", red, column) for red in reds]
    raw = [_centre("centroid", red, column) for red in reds]
    figure, (whole, close) = style.panels(2, (style.WIDTH_IN, 4.4), share_x=False)
    for axes in (whole, close):
        for k, (red, colour) in enumerate(zip(reds, _COLOURS, strict=False), start=1):
            axes.plot(red[:, column], color=colour, linewidth=1.0, label=f"frame {k}")
        axes.set_ylabel("red / DN")
    for centres, dash in ((relative, "--"), (raw, ":")):
        for centre, colour in zip(centres, _COLOURS, strict=False):
            if np.isfinite(centre):
                close.axvline(centre, color=colour, linewidth=0.9, linestyle=dash)
    peak = int(reds[0][:, column].argmax())
    close.set(xlim=(peak - _ZOOM_PX, peak + _ZOOM_PX), xlabel="v / px", title="(b) near the peak")
    whole.set(xlim=(0, len(reds[0]) - 1), title="(a) the whole column")
    style.legend(whole)
    return figure_of(
        "intensities",
        figure,
        column=column,
        frames=len(reds),
        relative=_spread_sentence("relative", relative, paper.CENTRES_RELATIVE_PX),
        raw=_spread_sentence("raw", raw, paper.CENTRES_RAW_PX),
    )


def _centre(extractor: str, red: Floats, column: int) -> float:
    """Centre of the line in one column by a paper's extractor, px; NaN where there is none."""
    stripe: Stripe = find_plugin("lscan.extractors", extractor)(red, StripeSection(), red >= 255)
    return float(stripe.centre_px[column])


def _spread_sentence(kind: str, centres: Sequence[float], printed: Sequence[float]) -> str:
    """One sentence on the centres by one kind of intensity, and on the paper's."""
    theirs = f"{max(printed) - min(printed):.4f} px in the paper"
    if not np.isfinite(centres).all():
        return f"Eq. (8) on {kind} intensities finds no line in some frame."
    listed = ", ".join(f"{centre:.4f}" for centre in centres)
    return (
        f"Eq. (8) on {kind} intensities puts the line at v = {listed} px: a spread of "
        f"{max(centres) - min(centres):.4f} px, {theirs}."
    )
