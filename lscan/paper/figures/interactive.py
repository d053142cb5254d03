"""The surface to turn with the mouse: what Plotly draws, and from where it looks."""

import json
from itertools import product

import numpy as np

from lscan.figures import style
from lscan.figures.grid import CELL_MM, NodeHeights, cell_for, grid_heights, height_range
from lscan.figures.reportfigure import ReportFigure
from lscan.paper.figures.words import words_of
from lscan.records import Floats, Mask

BOX_ASPECT, SCENE_SHARE = 4 / 3, 0.83
"""Width over height of the box on the page, and the share of its height above the colour bar."""
ASPECT = BOX_ASPECT / SCENE_SHARE
"""Width over height of what the eye sees."""
VIEW_ANGLE_RAD = np.pi / 4
"""Plotly's perspective, from the upper to the lower edge."""
_TOWARDS = np.array([-0.75, -1.6, 1.0])  # from the surface's middle to the eye
_ROOM = 1.15  # for the names of the axes around the surface


def surface_to_turn(xyz_mm: Floats, waves: Mask) -> ReportFigure:
    """The surface, (F, N, 3), as an interactive figure; its script needs Plotly on the page.

    waves: (F, N) the points on the waves, to whose heights the colours keep.
    """
    cell = cell_for(xyz_mm, CELL_MM)
    grid = grid_heights(xyz_mm, cell)
    colours = height_range(xyz_mm[waves])
    words = words_of("interactive", cell=cell)
    box = f'<div id="surface" style="aspect-ratio: {BOX_ASPECT:.4g}" role="img" '
    box += f'aria-label="{words["alt"]}"></div>'
    return ReportFigure(**words, body=box, script=_plotly_call(grid, colours))


def start_eye(sides: Floats) -> Floats:
    """(3,) the nearest eye in the start direction that sees a whole box of ``sides`` (3,).

    The box is centred on the origin and the eye looks there, z up, through a picture of
    ``ASPECT``.
    """
    forward = -_TOWARDS / np.linalg.norm(_TOWARDS)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * sides
    half = np.tan(VIEW_ANGLE_RAD / 2)
    # A corner is in view where its offset is at most its distance ahead times the half angle's
    # tangent: distance + corner . forward >= offset / tangent.
    across = np.abs(corners @ right) / (half * ASPECT)
    along = np.abs(corners @ np.cross(right, forward)) / half
    distance = (np.maximum(across, along) - corners @ forward).max()
    return -forward * distance * _ROOM


def _plotly_call(grid: NodeHeights, colours_mm: tuple[float, float]) -> str:
    steps = np.linspace(0, 1, len(style.HEIGHT_COLOURS))
    low, high = colours_mm
    trace = {
        "type": "surface",
        "x": _numbers(grid.x_mm),
        "y": _numbers(grid.y_mm),
        "z": [_numbers(row) for row in grid.z_mm],
        "cmin": low,
        "cmax": high,
        "colorscale": [[float(s), c] for s, c in zip(steps, style.HEIGHT_COLOURS, strict=True)],
        "colorbar": {
            "title": {"text": "z / mm", "side": "right"},
            "orientation": "h",  # beside the surface it would take a fifth of a phone's width
            "thickness": 12,
            "len": 0.7,
            "y": 0,
            "yanchor": "bottom",
        },
        "lighting": {"ambient": 0.55, "diffuse": 0.8, "specular": 0.05, "roughness": 0.9},
        "hovertemplate": "x %{x:.1f}<br>y %{y:.1f}<br>z %{z:.2f} mm<extra></extra>",
    }
    parts = (json.dumps(part, allow_nan=False) for part in ([trace], _layout(grid)))
    config = '{"responsive": true, "displaylogo": false, "displayModeBar": false}'
    return f'Plotly.newPlot("surface", {", ".join(parts)}, {config});'


def _layout(grid: NodeHeights) -> dict[str, object]:
    """Plotly's layout: axes true to scale, their ranges those of the surface, and the eye."""
    ends = {
        axis: [float(np.nanmin(values)), float(np.nanmax(values))]
        for axis, values in zip("xyz", (grid.x_mm, grid.y_mm, grid.z_mm), strict=True)
    }
    sides = np.array([high - low for low, high in ends.values()])
    sides = np.maximum(sides / sides.max(), 1e-3)  # a surface may be flat
    axes: dict[str, dict[str, object]] = {
        f"{axis}axis": {"title": {"text": f"{axis} / mm"}, "range": ends[axis]} for axis in "xyz"
    }
    axes["zaxis"]["nticks"] = 4  # seen at a low angle, more overprint one another
    eye = dict(zip("xyz", start_eye(sides).tolist(), strict=True))
    return {
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "font": {"color": "#7d898f"},  # legible on the light and on the dark page
        "scene": {
            **axes,
            "domain": {"y": [1 - SCENE_SHARE, 1]},
            "aspectmode": "manual",
            "aspectratio": dict(zip("xyz", sides.tolist(), strict=True)),
            "camera": {"eye": eye},
        },
    }


def _numbers(values: Floats) -> list[float | None]:
    """Values to a hundredth of a millimetre, None where there is none."""
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
