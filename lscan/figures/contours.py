"""Figures of the surface from above (Figs. 27 and 28), and one to turn with the mouse."""

from __future__ import annotations

import json
from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from lscan.figures import style
from lscan.figures.exhibit import Exhibit, SliceData
from lscan.figures.grid import HeightGrid, cell_for, grid_heights
from lscan.paper import YAW_DEG
from lscan.records import Floats

_CELL_MM = 1.5  # least cell of the grids drawn: three of the paper's steps
_CONTOURS = 12
_LINE = "#10222b"  # dark on every height colour, whatever the page's theme
_SLICE = "#e8401f"
_PAPERS_YAW = f"{YAW_DEG:.2f}° in the paper"


@style.styled
def contours_before(xyz_mm: Floats, yaw_deg: float | None) -> Exhibit:
    """Contours before yaw calibration (Fig. 27).

    xyz_mm: (F, N, 3), level and with W_L W_R along x.  yaw_deg: the yaw found, if any.
    """
    key, alt = "contours-before", "Contour plot of the surface before yaw calibration."
    figure, _, step_mm = _draw_contours(xyz_mm)
    shift = "a little more than the one before"
    if yaw_deg is not None:
        track_mm = float(np.ptp(xyz_mm[..., 1][np.isfinite(xyz_mm[..., 1])]))
        total_mm = track_mm * np.tan(np.radians(abs(yaw_deg)))
        shift += f", {total_mm:.1f} mm over {track_mm:.0f} mm at the yaw found, {yaw_deg:.3f}°"
    return Exhibit(
        key=key,
        title="Contours before yaw calibration",
        paper="Fig. 27",
        alt=alt,
        caption="A square block shows as a parallelogram where the laser sheet is yawed against "
        f"the track: each profile is shifted along x {shift}. Contours every {step_mm:g} mm.",
        body=style.svg(figure, key, alt),
    )


@style.styled
def contours_after(
    xyz_mm: Floats, yaw_deg: float | None, slices: Mapping[str, SliceData]
) -> Exhibit:
    """Contours after yaw calibration, with the places of the slices (Fig. 28).

    xyz_mm: (F, N, 3) of the aligned surface.  yaw_deg: the yaw found, if any.
    """
    key, alt = "contours-after", "Contour plot of the surface after yaw calibration."
    figure, axes, step_mm = _draw_contours(xyz_mm)
    lines = {name: data.ends_mm for name, data in slices.items() if data.ends_mm is not None}
    for name, ends in lines.items():
        axes.plot(*ends.T, color=_SLICE, linewidth=1.2)
        axes.annotate(name, ends[1], (4, 0), color=_SLICE, bbox=style.PLATE, **style.NOTE)
    found = "" if yaw_deg is None else f" by the yaw found, {yaw_deg:.3f}° ({_PAPERS_YAW})"
    named = f" Lines: the slices {', '.join(lines)}." if lines else ""
    return Exhibit(
        key=key,
        title="Contours after yaw calibration",
        paper="Fig. 28",
        alt=alt,
        caption=f"The profiles are shifted back along x{found}.{named} Contours every "
        f"{step_mm:g} mm.",
        body=style.svg(figure, key, alt),
    )


def _draw_contours(xyz_mm: Floats) -> tuple[Figure, Axes, float]:
    """The figure, its axes, and the height between two contours in mm."""
    grid = grid_heights(xyz_mm, cell_for(xyz_mm, _CELL_MM))
    low, high = (float(value) for value in np.nanpercentile(grid.z_mm, (0.5, 99.5)))
    round_levels = MaxNLocator(_CONTOURS).tick_values(low, high)
    step_mm = float(round_levels[1] - round_levels[0])
    # Half a step off the round heights, where flat parts would dissolve into speckle.
    levels = np.asarray(round_levels) + step_mm / 2
    height = np.ma.masked_invalid(grid.z_mm)
    figure, (axes,) = style.panels(1, (style.WIDTH_IN, 4.7))
    shade = axes.pcolormesh(
        grid.x_mm, grid.y_mm, height, cmap=style.HEIGHTS, vmin=low, vmax=high, rasterized=True
    )
    axes.contour(grid.x_mm, grid.y_mm, height, levels=levels, colors=_LINE, linewidths=0.4)
    axes.grid(False)
    figure.colorbar(shade, ax=axes, label="z / mm", shrink=0.85)
    axes.set(xlabel="x / mm", ylabel="y / mm", aspect="equal")
    return figure, axes, step_mm


def surface_to_turn(xyz_mm: Floats) -> Exhibit:
    """The surface, (F, N, 3), as an interactive figure; its script needs Plotly on the page."""
    cell = cell_for(xyz_mm, _CELL_MM)
    grid = grid_heights(xyz_mm, cell)
    alt = "Interactive surface: drag to turn, scroll or pinch to come closer."
    return Exhibit(
        key="interactive",
        title="The surface to turn",
        paper="Figs. 22, 25 and 26",
        alt=alt,
        caption=f"Drag to turn, scroll or pinch to come closer. Heights averaged over cells of "
        f"{cell:.3g} mm, true to scale.",
        body=f'<div id="surface" role="img" aria-label="{alt}"></div>',
        script=_plotly_call(grid),
    )


def _plotly_call(grid: HeightGrid) -> str:
    steps = np.linspace(0, 1, len(style.HEIGHT_COLOURS))
    low, high = (float(value) for value in np.nanpercentile(grid.z_mm, (0.5, 99.5)))
    trace = {
        "type": "surface",
        "x": _numbers(grid.x_mm),
        "y": _numbers(grid.y_mm),
        "z": [_numbers(row) for row in grid.z_mm],
        "cmin": low,
        "cmax": high,
        "colorscale": [[float(s), c] for s, c in zip(steps, style.HEIGHT_COLOURS, strict=True)],
        "colorbar": {"title": {"text": "z / mm"}, "thickness": 12, "len": 0.7},
        "lighting": {"ambient": 0.55, "diffuse": 0.8, "specular": 0.05, "roughness": 0.9},
        "hovertemplate": "x %{x:.1f}<br>y %{y:.1f}<br>z %{z:.2f} mm<extra></extra>",
    }
    titles = {f"{axis}axis": {"title": {"text": f"{axis} / mm"}} for axis in "xyz"}
    layout = {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": "#7d898f"},  # legible on the light and on the dark page
        "scene": {
            **titles,
            "aspectmode": "data",
            "camera": {"eye": {"x": -0.75, "y": -1.6, "z": 1.0}},
        },
    }
    parts = (json.dumps(part, allow_nan=False) for part in ([trace], layout))
    config = '{"responsive": true, "displaylogo": false, "displayModeBar": false}'
    return f'Plotly.newPlot("surface", {", ".join(parts)}, {config});'


def _numbers(values: Floats) -> list[float | None]:
    """Values to a hundredth of a millimetre, None where there is none."""
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
