"""Figures of the surface: in relief, from above, in slices, and to turn (Figs. 25 to 32)."""

import json
from collections.abc import Mapping
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from lscan.figures import style
from lscan.figures.page import ReportFigure, signed_number
from lscan.figures.style import CELL_MM, NodeHeights, cell_for, grid_heights, height_range
from lscan.files.disk import packaged_table
from lscan.measure import SliceErrors
from lscan.paper.picturefigures import figure_of, words_of
from lscan.paper.published import YAW_DEG
from lscan.pipeline import SandwaveMeasures
from lscan.records import Floats, Mask, Status
from lscan.surface import Alignment, Slice, levelling_step

# Figures of the surface in relief: as scanned, and after reorientation (Figs. 25 and 26).

_LINES = 90  # profiles drawn of a relief
_COLUMNS = 320  # points drawn of a profile, at most
_FLAT_MM = 40.0  # a surface whose heights span less is drawn with twice the height
_LEAN = (0.32, 0.42)  # how far a step along y goes right and up


@style.styled
def raw_relief(xyz_mm: Floats) -> ReportFigure:
    """The surface as scanned, (F, N, 3) in the head frame (Fig. 25)."""
    figure, _, gain = _draw_relief(xyz_mm)
    points = xyz_mm[np.isfinite(xyz_mm).all(axis=2)]
    centred = points - points.mean(axis=0)
    slopes = np.linalg.lstsq(centred[:, :2], centred[:, 2], rcond=None)[0]
    along_x, along_y = (signed_number(tilt, 2) for tilt in np.degrees(np.arctan(slopes)))
    return figure_of(
        "raw",
        figure,
        points=int(np.isfinite(xyz_mm[..., 2]).sum()),
        frames=len(xyz_mm),
        drawn=_describe(len(xyz_mm), gain),
        along_x=along_x,
        along_y=along_y,
    )


@style.styled
def levelled_relief(xyz_mm: Floats, alignment: Alignment) -> ReportFigure:
    """The surface after reorientation, eqs. (5) to (7), with base plane and corners (Fig. 26).

    xyz_mm: (F, N, 3) as scanned.  alignment: of the sandwave in it.
    """
    levelling = levelling_step(alignment.normal)
    left, right = (
        levelling @ alignment.to_raw(np.array([*corner, alignment.base_mm]))
        for corner in (alignment.left_corner_mm, alignment.right_corner_mm)
    )
    levelled = xyz_mm @ levelling.T
    figure, axes, gain = _draw_relief(levelled)
    _draw_base_plane(axes, levelled, (left, right), gain)
    apart = np.linalg.norm(right - left)
    return figure_of("levelled", figure, drawn=_describe(len(xyz_mm), gain), apart=apart)


def _describe(frames: int, gain: float) -> str:
    """How many profiles are drawn, and at what scale."""
    step = _profile_step(frames)
    shown = "every profile drawn" if step == 1 else f"one in {step} profiles drawn"
    scale = "heights true to scale" if gain == 1 else f"heights {gain:g} times too large"
    return f"{shown}, {scale}"


def _profile_step(frames: int) -> int:
    return max(1, -(-frames // _LINES))


def _draw_relief(xyz_mm: Floats) -> tuple[Figure, Axes, float]:
    """Profiles in oblique projection, the far ones first: figure, axes and gain of heights."""
    low, high = (float(value) for value in np.nanpercentile(xyz_mm[..., 2], (0.2, 99.8)))
    gain = 2.0 if high - low < _FLAT_MM else 1.0
    u, v = _project(xyz_mm, gain)
    shape = np.ptp(v[np.isfinite(v)]) / np.ptp(u[np.isfinite(u)])
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, style.WIDTH_IN * float(shape) * 0.95 + 0.3))
    floor = float(np.nanmin(v)) - 2.0
    across = max(1, xyz_mm.shape[1] // _COLUMNS)
    rows = np.arange(0, len(xyz_mm), _profile_step(len(xyz_mm)))
    # Rows without a point count as nearest.
    place = np.ma.masked_invalid(xyz_mm[rows, :, 1]).mean(axis=1).filled(-np.inf)
    for row in rows[np.argsort(-place)]:
        along, up = u[row, ::across], v[row, ::across]
        # What stands behind a profile is hidden by it.
        axes.fill_between(along, up, floor, color=style.PAPER, linewidth=0)
        axes.plot(along, up, color=style.INK, linewidth=0.55)
    axes.set_aspect("equal")
    axes.set_axis_off()
    _draw_scale(axes, float(np.nanmin(u)), floor, gain)
    return figure, axes, gain


def _project(xyz_mm: Floats, gain: float) -> tuple[Floats, Floats]:
    x, y, z = np.moveaxis(xyz_mm, -1, 0)
    return x + _LEAN[0] * y, _LEAN[1] * y + gain * z


def _draw_scale(axes: Axes, left: float, floor: float, gain: float) -> None:
    """Bars of 50 mm along x and y and of 10 mm along z, at the lower left."""
    origin = np.array([left - 45.0, floor])
    bars = (
        ("x 50 mm", np.array([50.0, 0.0]), (0, -3), "center", "top"),
        ("y 50 mm", 50.0 * np.array(_LEAN), (0, 2), "center", "bottom"),
        ("z 10 mm", np.array([0.0, 10.0 * gain]), (-4, 0), "right", "center"),
    )
    for name, bar, offset, ha, va in bars:
        axes.plot(*np.column_stack([origin, origin + bar]), color=style.MUTED, linewidth=1.0)
        axes.annotate(
            name,
            origin + bar,
            offset,
            textcoords="offset points",
            color=style.MUTED,
            ha=ha,
            va=va,
            fontsize=8,
        )


def _draw_base_plane(
    axes: Axes, xyz_mm: Floats, corners: tuple[Floats, Floats], gain: float
) -> None:
    height = float(corners[0][2] + corners[1][2]) / 2
    x, y = xyz_mm[..., 0], xyz_mm[..., 1]
    left, right, near, far = np.nanmin(x), np.nanmax(x), np.nanmin(y), np.nanmax(y)
    around = [(left, near), (right, near), (right, far), (left, far), (left, near)]
    outline = np.array([(*corner, height) for corner in around])
    axes.plot(*_project(outline, gain), color=style.SECOND, linewidth=1.0, linestyle="--")
    ends = np.array(corners, dtype=float)
    u, v = _project(ends, gain)
    axes.plot(u, v, color=style.FIRST, linewidth=0.9, linestyle="--")
    axes.plot(u, v, "o", color=style.FIRST, markersize=5)
    for name, at in zip(("$W_L$", "$W_R$"), zip(u, v, strict=True), strict=True):
        axes.annotate(name, at, (7, 9), color=style.FIRST, bbox=style.PLATE, **style.NOTE)


# Figures of the surface from above, before and after yaw calibration (Figs. 27 and 28).


_STEPS_MM = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)
_MOST_CONTOURS = 40
_INDEX = 5  # every fifth contour is thicker and has its height written on it
_MARGIN = 0.25  # of the extent of the waves: the rim and a strip of the floor
_DARK, _PALE = "#10222b", "#cfe0e4"  # contours on light and on dark heights, in either theme
_SLICE = "#e8401f"
_DASHES = ((0, (5, 2)), "solid", (0, (7, 1.5, 1.5, 1.5)), (0, (1.5, 1)))
_PAPERS_YAW = f"{YAW_DEG:.2f}° in the paper"


def on_the_waves(sandwave: SandwaveMeasures) -> Mask:
    """(F, N) the points within the slices, one of which is the diagonal of the waves."""
    ends = np.concatenate([cut.xy_mm[[0, -1]] for cut in sandwave.slices.values()])
    xyz = sandwave.aligned.xyz_mm
    plan = xyz[..., :2]
    within: Mask = ((plan >= ends.min(axis=0)) & (plan <= ends.max(axis=0))).all(axis=2)
    return within & np.isfinite(xyz).all(axis=2)


@style.styled
def contours_before(sandwave: SandwaveMeasures, waves: Mask) -> ReportFigure:
    """Contours before yaw calibration, level and with W_L W_R along x (Fig. 27).

    waves: (F, N) the points on the waves, to which colours and contours keep.
    """
    alignment = sandwave.alignment
    xyz_mm = sandwave.raw.xyz_mm @ alignment.rotation.T + alignment.translation_mm
    figure, _, contours = _draw_surface(xyz_mm, waves)
    shift = ""
    if alignment.yaw_deg is not None:
        track_mm = float(np.nanmax(xyz_mm[..., 1]) - np.nanmin(xyz_mm[..., 1]))
        total_mm = track_mm * np.tan(abs(alignment.yaw_rad))
        shift = f", {total_mm:.1f} mm over {track_mm:.0f} mm at the yaw found, "
        shift += f"{alignment.yaw_deg:.3f}°"
    return figure_of("contours-before", figure, shift=shift, contours=contours)


@style.styled
def contours_after(sandwave: SandwaveMeasures, waves: Mask) -> ReportFigure:
    """Contours after yaw calibration, with the places of the slices (Fig. 28).

    waves: as ``contours_before``.
    """
    figure, axes, contours = _draw_surface(sandwave.aligned.xyz_mm, waves)
    _draw_slices(axes, {name: cut.xy_mm[[0, -1]] for name, cut in sandwave.slices.items()})
    yaw_deg = sandwave.alignment.yaw_deg
    yaw = "" if yaw_deg is None else f" by the yaw found, {yaw_deg:.3f}° ({_PAPERS_YAW})"
    names = ", ".join(sandwave.slices)
    return figure_of("contours-after", figure, yaw=yaw, slices=names, contours=contours)


def _draw_surface(xyz_mm: Floats, waves: Mask) -> tuple[Figure, Axes, str]:
    """The figure, its axes, and what a caption says of contours and colours.

    Over the heights of floor and wedges the waves would share one colour.
    """
    inner = np.where(waves[..., None], xyz_mm, np.nan)
    low, high = height_range(inner)
    cell = cell_for(xyz_mm, CELL_MM)
    whole, grid = grid_heights(xyz_mm, cell), grid_heights(inner, cell)
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 4.7))
    shade = axes.pcolormesh(
        whole.x_mm,
        whole.y_mm,
        np.ma.masked_invalid(whole.z_mm),
        cmap=style.HEIGHTS,
        vmin=low,
        vmax=high,
        rasterized=True,
    )
    step = _draw_contours(axes, grid, low, high)
    axes.grid(False)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
    figure.colorbar(shade, ax=axes, label="z / mm", shrink=0.85, extend="both")
    _frame(axes, grid, whole)
    note = (
        f"Contours every {step:g} mm, thicker every {_INDEX * step:g} mm; colours and contours "
        "keep to the heights of the waves: floor and wedges lie beyond."
    )
    return figure, axes, note


def _draw_contours(axes: Axes, grid: NodeHeights, low_mm: float, high_mm: float) -> float:
    """Contours at whole multiples of their step, which is returned in mm."""
    few = (step for step in _STEPS_MM if (high_mm - low_mm) / step <= _MOST_CONTOURS)
    step = next(few, _STEPS_MM[-1])
    counts = np.arange(np.ceil(low_mm / step), np.floor(high_mm / step) + 1)
    index = counts % _INDEX == 0
    if len(counts):
        lines = axes.contour(
            grid.x_mm,
            grid.y_mm,
            np.ma.masked_invalid(grid.z_mm),
            levels=step * counts,
            colors=list(np.where(step * counts < (2 * low_mm + high_mm) / 3, _PALE, _DARK)),
            linewidths=np.where(index, 0.9, 0.35),
            linestyles="solid",
        )
        axes.clabel(lines, step * counts[index], fmt="%g", fontsize=7)
    return step


def _frame(axes: Axes, grid: NodeHeights, whole: NodeHeights) -> None:
    """Show the waves with a margin, no farther than the surface goes."""
    for limit, inner, outer in (
        (axes.set_xlim, grid.x_mm, whole.x_mm),
        (axes.set_ylim, grid.y_mm, whole.y_mm),
    ):
        margin = _MARGIN * np.ptp(inner)
        limit(max(inner[0] - margin, outer[0]), min(inner[-1] + margin, outer[-1]))


def _draw_slices(axes: Axes, ends_mm: Mapping[str, Floats]) -> None:
    """Each slice in dashes of its own, the longest undermost, its name beyond its end."""
    halo = [withStroke(linewidth=2.6, foreground=style.PAPER)]
    longest_first = sorted(ends_mm.items(), key=lambda item: -np.hypot(*np.diff(item[1].T)[:, 0]))
    for dashes, (name, ends) in zip(cycle(_DASHES), longest_first, strict=False):
        axes.plot(*ends.T, color=_SLICE, linewidth=1.3, linestyle=dashes, path_effects=halo)
        along = ends[1] - ends[0]
        note = {**style.NOTE, "ha": "center", "color": _SLICE, "bbox": style.PLATE}
        axes.annotate(name, ends[1], 11 * along / np.hypot(*along), **note)


# Figures of slices: measured against designed height, and the error (Figs. 29 to 32).


@style.styled
def slice_plot(
    name: str, cut: Slice, errors: SliceErrors, paper: str, bar_mm: float
) -> ReportFigure:
    """A slice: measured solid, designed dotted, and the error below (Figs. 29 to 32).

    paper: the paper's figure.  bar_mm: the error bound that is drawn.
    """
    figure, (heights, below) = style.panels(2, (style.WIDTH_IN, 3.4), (1.5, 1.0))
    heights.plot(cut.along_mm, errors.nominal_mm, ":", color=style.INK, label="theory")
    heights.plot(cut.along_mm, cut.z_mm, color=style.SECOND, label="measured")
    heights.set_ylabel("z / mm")
    style.legend(heights)
    _draw_error(below, cut, errors, bar_mm)
    missing = ~np.isfinite(cut.z_mm)
    for panel in (heights, below):
        panel.fill_between(
            cut.along_mm,
            0,
            1,
            where=missing,
            transform=panel.get_xaxis_transform(),
            color=style.RULE,
            linewidth=0,
            step="mid",
        )
    below.set_xlabel(f"along {name} / mm")
    compared = np.isfinite(errors.error_mm)
    return figure_of(
        "slice",
        figure,
        name=name,
        paper=paper,
        rmse=errors.rmse_mm,
        least=signed_number(errors.min_mm, 2),
        most=signed_number(errors.max_mm, 2),
        within=100 * np.mean(np.abs(errors.error_mm[compared]) <= bar_mm),
        bar=bar_mm,
        gaps=_gaps(cut, int((np.isfinite(cut.z_mm) & ~compared).sum())),
    )


def _draw_error(axes: Axes, cut: Slice, errors: SliceErrors, bar_mm: float) -> None:
    error = errors.error_mm
    low, high = error - 2 * cut.sigma_z_mm, error + 2 * cut.sigma_z_mm
    axes.fill_between(cut.along_mm, low, high, color=style.FIRST, alpha=0.2, linewidth=0)
    axes.plot(cut.along_mm, error, color=style.FIRST, linewidth=1.0)
    for bound in (-bar_mm, bar_mm):
        axes.axhline(bound, color=style.MUTED, linewidth=0.8, linestyle="--")
    reach = 1.15 * max(bar_mm, float(np.nanmax(np.abs(error))))
    axes.set(ylim=(-reach, reach), ylabel="error / mm")


def _gaps(cut: Slice, skipped: int) -> str:
    """What is missing in a slice, in words.  skipped: points measured but not compared."""
    codes, counts = np.unique(cut.status[~np.isfinite(cut.z_mm)], return_counts=True)
    why = ", ".join(
        f"{count} {Status(int(code)).name.lower().replace('_', ' ')}"
        for code, count in zip(codes, counts, strict=True)
    )
    gaps = f" Grey: {why}, of {len(cut.status)} points." if why else ""
    return gaps + (f" Measured but not compared: {skipped} points." if skipped else "")


# The surface to turn with the mouse: what Plotly draws, and from where it looks.


# From the surface's middle to the eye, in diagonals of its box: so far away Plotly, whose picture
# spans 45 degrees from its upper to its lower edge, shows the whole sphere about the box.
_EYE = np.array([-0.75, -1.6, 1.0]) / np.linalg.norm([-0.75, -1.6, 1.0]) / (2 * np.sin(np.pi / 8))


def surface_to_turn(xyz_mm: Floats, waves: Mask) -> ReportFigure:
    """The surface, (F, N, 3), as an interactive figure; its script needs Plotly on the page.

    waves: (F, N) the points on the waves, to whose heights the colours keep.
    """
    cell = cell_for(xyz_mm, CELL_MM)
    grid = grid_heights(xyz_mm, cell)
    places = {"x": grid.x_mm, "y": grid.y_mm, "z": grid.z_mm}
    figure = packaged_table("lscan.paper", "plotly.toml")
    trace, scene = figure["trace"], figure["layout"]["scene"]
    # To a hundredth of a millimetre, None where there is no value.
    for axis, values in places.items():
        trace[axis] = np.ma.masked_invalid(np.round(values, 2)).tolist()
    trace["cmin"], trace["cmax"] = height_range(xyz_mm[waves])
    steps = np.linspace(0, 1, len(style.HEIGHT_COLOURS)).tolist()
    trace["colorscale"] = list(zip(steps, style.HEIGHT_COLOURS, strict=True))
    # True to scale, and no farther than the surface goes.
    ends = np.array([[np.nanmin(values), np.nanmax(values)] for values in places.values()])
    sides = np.ptp(ends, axis=1)
    sides = np.maximum(sides / sides.max(), 1e-3)  # a surface may be flat
    for axis, pair in zip(places, ends.tolist(), strict=True):
        scene[f"{axis}axis"]["range"] = pair
    scene["aspectratio"] = dict(zip(places, sides.tolist(), strict=True))
    eye = np.linalg.norm(sides) * _EYE
    scene["camera"] = {"eye": dict(zip(places, eye.tolist(), strict=True))}
    words = words_of("interactive", cell=cell)
    box = f'<div id="surface" role="img" aria-label="{words["alt"]}"></div>'
    parts = ([trace], figure["layout"], figure["config"])
    written = ", ".join(json.dumps(part, allow_nan=False) for part in parts)
    script = f'Plotly.newPlot("surface", {written});'
    return ReportFigure(**words, body=box, script=script)
