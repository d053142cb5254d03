"""Figures of the surface from above, before and after yaw calibration (Figs. 27 and 28)."""

from collections.abc import Mapping
from itertools import cycle

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from lscan.figures import style
from lscan.figures.style import (
    CELL_MM,
    NodeHeights,
    ReportFigure,
    cell_for,
    grid_heights,
    height_range,
)
from lscan.measurement import SandwaveMeasures
from lscan.paper.figures.words import drawn
from lscan.paper.published import YAW_DEG
from lscan.records import Floats, Mask

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
    return drawn("contours-before", figure, shift=shift, contours=contours)


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
    return drawn("contours-after", figure, yaw=yaw, slices=names, contours=contours)


def contour_step(low_mm: float, high_mm: float) -> float:
    """The height between two contours in mm: 1, or more where that were over 40 contours."""
    span = high_mm - low_mm
    return next((step for step in _STEPS_MM if span / step <= _MOST_CONTOURS), _STEPS_MM[-1])


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
    step = contour_step(low_mm, high_mm)
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
