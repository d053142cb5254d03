"""The surface to turn with the mouse: what Plotly draws, and from where it looks."""

import json
from itertools import product

import numpy as np

from lscan.figures import style
from lscan.figures.style import (
    CELL_MM,
    NodeHeights,
    ReportFigure,
    cell_for,
    grid_heights,
    height_range,
)
from lscan.files.disk import packaged_table
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
    """The call that draws: axes true to scale, their ranges those of the surface, and the eye."""
    figure = packaged_table("lscan.paper.figures", "plotly.toml")
    low, high = colours_mm
    steps = np.linspace(0, 1, len(style.HEIGHT_COLOURS)).tolist()
    heights = [_numbers(row) for row in grid.z_mm]
    figure["trace"] |= {"x": _numbers(grid.x_mm), "y": _numbers(grid.y_mm), "z": heights}
    figure["trace"] |= {"cmin": low, "cmax": high}
    figure["trace"]["colorscale"] = list(zip(steps, style.HEIGHT_COLOURS, strict=True))
    ends = [
        [float(np.nanmin(values)), float(np.nanmax(values))]
        for values in (grid.x_mm, grid.y_mm, grid.z_mm)
    ]
    sides = np.diff(ends)[:, 0]
    sides = np.maximum(sides / sides.max(), 1e-3)  # a surface may be flat
    scene = figure["layout"]["scene"]
    for axis, values in zip("xyz", ends, strict=True):
        scene[f"{axis}axis"]["range"] = values
    scene["domain"] = {"y": [1 - SCENE_SHARE, 1]}
    scene["aspectratio"] = dict(zip("xyz", sides.tolist(), strict=True))
    scene["camera"] = {"eye": dict(zip("xyz", start_eye(sides).tolist(), strict=True))}
    parts = ([figure["trace"]], figure["layout"], figure["config"])
    written = ", ".join(json.dumps(part, allow_nan=False) for part in parts)
    return f'Plotly.newPlot("surface", {written});'


def _numbers(values: Floats) -> list[float | None]:
    """Values to a hundredth of a millimetre, None where there is none."""
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
