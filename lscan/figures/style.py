"""One look for all figures: colours that follow the page's theme, and SVG of stable bytes.

Figures are drawn in the light theme's colours; in the SVG each becomes a CSS variable with
that colour as its fallback, so that the page may turn dark and a saved figure stays right.
"""

import base64
import io
import re
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import cv2
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from lscan.errors import InputError, MeasurementError
from lscan.files.pictures import eight_bit
from lscan.records import Floats, Picture

PALETTE: Mapping[str, str] = MappingProxyType(
    {
        "ink": "#1d2a31",
        "muted": "#67757d",
        "rule": "#d5dbdd",
        "paper": "#fdfdfb",
        "first": "#b5452c",
        "second": "#17688c",
        "third": "#8a6d14",
        "accent": "#c2185b",
    }
)
INK, MUTED, RULE, PAPER, FIRST, SECOND, THIRD, ACCENT = (
    PALETTE[name]
    for name in ("ink", "muted", "rule", "paper", "first", "second", "third", "accent")
)

HEIGHT_COLOURS = ("#0c3547", "#1f6274", "#5d8f80", "#b5b07c", "#f1e3b3")
"""Deep water to sand; lightness rises throughout, so it reads in grey too."""

HEIGHTS = LinearSegmentedColormap.from_list("heights", HEIGHT_COLOURS)

NOTE: Any = {"textcoords": "offset points", "va": "center", "fontweight": "bold"}
"""Keywords of a short label beside a point, offset in points."""

PLATE: Any = {"facecolor": PAPER, "edgecolor": "none", "alpha": 0.8, "pad": 1.2}
"""Keywords of the ground behind a label that lies on a picture."""

styled = matplotlib.style.context("lscan.figures.report")
"""Decorator of the functions that draw: matplotlib has report.mplstyle's look in them only."""

WIDTH_IN = 5.8
"""Width of most figures: their 9 pt type then shows at the page's own size."""


def legend(axes: Axes) -> None:
    """Name the lines of ``axes`` in one row above its right end.

    Parameters
    ----------
    axes : Axes, its lines are labelled
    """
    columns = len(axes.get_legend_handles_labels()[1])
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.98), ncols=columns, borderpad=0.1)


def panels(
    rows: int,
    size_in: tuple[float, float],
    heights: tuple[float, ...] | None = None,
    share_x: bool = True,
) -> tuple[Figure, list[Axes]]:
    """An empty figure with panels one above the other.

    Parameters
    ----------
    rows : int, number of panels
    size_in : tuple of float, (width, height) of the figure, inches
    heights : tuple of float, optional, of the panels, relative to each other; by default alike
    share_x : bool, whether the panels share their x axis

    Returns
    -------
    tuple of Figure and list of Axes
        The panels from the top down.
    """
    figure = Figure(figsize=size_in, layout="constrained", facecolor="none")
    options = {"height_ratios": heights} if heights else None
    grid = figure.subplots(rows, 1, sharex=share_x, squeeze=False, gridspec_kw=options)
    return figure, [axes for (axes,) in grid]


def png(figure: Figure, dpi: int = 150) -> bytes:
    """The figure as a PNG file; the same figure gives the same bytes.

    Parameters
    ----------
    figure : Figure
    dpi : int, pixels an inch
    """
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None})
    return buffer.getvalue()


def svg(figure: Figure, key: str, alt: str) -> str:
    """The figure as an inline SVG element; the same figure gives the same characters.

    Parameters
    ----------
    figure : Figure, drawn in the colours of PALETTE
    key : str, prefix of every id in it, so that several stand on one page
    alt : str, its description
    """
    buffer = io.StringIO()
    FigureCanvasSVG(figure)
    no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(buffer, format="svg", metadata=no_metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'(?<= id=")|(?<=href="#)|(?<=url\(#)', f"{key}-", text)
    text = re.sub(r"(?<=\d\.\d{2})\d+", "", text)  # a hundredth of a point is enough
    for name, colour in PALETTE.items():
        text = text.replace(colour, f"var(--{name}, {colour})")
    return _with_label(text, alt)


def photograph(image: Picture, overlay: str, alt: str) -> str:
    """The picture as an inline SVG element, with SVG shapes over it in pixel coordinates.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB
    overlay : str, SVG elements whose coordinates are pixels (u, v)
    alt : str, its description

    Raises
    ------
    InputError
        Where the array is no such picture.
    """
    known = image.dtype in (np.uint8, np.uint16)
    if not known or image.ndim not in (2, 3) or image.shape[2:] not in ((), (3,)):
        raise InputError(
            "not a picture",
            where="report",
            value=f"{image.dtype} array of shape {image.shape}",
            allowed="(H, W) or (H, W, 3) uint8 or uint16",
        )
    height, width = image.shape[:2]
    # JPEG without chroma subsampling: the laser's red line and coloured marks stay sharp.
    settings = [cv2.IMWRITE_JPEG_QUALITY, 90]
    settings += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    seen = eight_bit(image)
    bgr = seen if seen.ndim == 2 else seen[:, :, ::-1]
    _, encoded = cv2.imencode(".jpg", np.ascontiguousarray(bgr), settings)
    data = base64.b64encode(encoded.tobytes()).decode("ascii")
    # The picture's corner is half a pixel up and left of the centre of its first pixel.
    frame = f'x="-0.5" y="-0.5" width="{width}" height="{height}"'
    text = (
        f'<svg viewBox="-0.5 -0.5 {width} {height}" class="photograph">'
        f'<image {frame} href="data:image/jpeg;base64,{data}"/>{overlay}</svg>'
    )
    return _with_label(text, alt)


def spots(points: Floats, colour: str, width_px: float) -> str:
    """SVG of a round spot at each point; a NaN point has none.

    Parameters
    ----------
    points : (N, 2) array, px, of (u, v)
    colour : str, as CSS writes it
    width_px : float, px, diameter of a spot
    """
    seen = points[np.isfinite(points).all(axis=1)]
    path = "".join(f"M{u:.2f},{v:.2f}h0" for u, v in seen)
    style = f'fill="none" stroke="{colour}" stroke-width="{width_px}" stroke-linecap="round"'
    return f'<path {style} d="{path}"/>'


def _with_label(text: str, alt: str) -> str:
    escaped = alt.replace("&", "&amp;").replace("<", "&lt;").replace('"', "&quot;")
    return text.replace("<svg", f'<svg role="img" aria-label="{escaped}"', 1)


# Scattered points of a surface averaged onto a regular grid, for pictures.


CELL_MM = 1.5
"""The least cell of the grids drawn: three of the paper's steps."""


@dataclass(frozen=True)
class NodeHeights:
    """Heights on a regular grid of C by R nodes.

    Attributes
    ----------
    x_mm : (C,) array, mm, of the nodes
    y_mm : (R,) array, mm, of the nodes
    z_mm : (R, C) array, mm, heights; NaN where there is no point near the node
    """

    x_mm: Floats
    y_mm: Floats
    z_mm: Floats


def grid_heights(xyz_mm: Floats, cell_mm: float) -> NodeHeights:
    """The mean height about each node of a grid.

    Each point counts at its four nearest nodes with the weights of bilinear interpolation, so that
    a plane sampled evenly stays a plane.

    Parameters
    ----------
    xyz_mm : (..., 3) array, mm, points in any frame with z up; NaN where there is none
    cell_mm : float, mm, from node to node along x and along y

    Raises
    ------
    MeasurementError
        Where there is no point at all.

    Examples
    --------
    >>> corners = np.array([[0.0, 0.0, 1.0], [2.0, 0.0, 1.0], [0.0, 2.0, 3.0], [2.0, 2.0, 3.0]])
    >>> grid_heights(corners, cell_mm=2.0).z_mm[:2, :2]
    array([[1., 1.],
           [3., 3.]])
    """
    points = xyz_mm.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        raise MeasurementError("the surface holds no point to draw")
    start = np.floor(points[:, :2].min(axis=0) / cell_mm)
    place = points[:, :2] / cell_mm - start
    columns, rows = (int(n) for n in np.floor(place.max(axis=0)) + 2)
    weight, total = np.zeros(rows * columns), np.zeros(rows * columns)
    whole = np.floor(place).astype(np.int64)
    part = place - whole
    for right, up in ((0, 0), (1, 0), (0, 1), (1, 1)):
        share = np.abs(1 - right - part[:, 0]) * np.abs(1 - up - part[:, 1])
        node = (whole[:, 1] + up) * columns + whole[:, 0] + right
        weight += np.bincount(node, share, minlength=rows * columns)
        total += np.bincount(node, share * points[:, 2], minlength=rows * columns)
    # A node that points only graze, on a rim or in a shadow, would invent a height there.
    held = weight > 0.25
    z_mm = np.where(held, total / np.where(held, weight, 1.0), np.nan).reshape(rows, columns)
    x_mm, y_mm = ((start[k] + np.arange(n)) * cell_mm for k, n in enumerate((columns, rows)))
    return NodeHeights(x_mm, y_mm, z_mm)


def cell_for(xyz_mm: Floats, least_mm: float, most_nodes: int = 220) -> float:
    """The cell in mm that fits a scan: no finer than its points, nor than ``least_mm``.

    Parameters
    ----------
    xyz_mm : (F, N, 3) array, mm, F profiles of N points; NaN where there is none
    least_mm : float, mm, the least cell
    most_nodes : int, along the longer side of the surface
    """
    steps = [_typical_step(xyz_mm[..., 1], axis=0), _typical_step(xyz_mm[..., 0], axis=1)]
    plan = xyz_mm[..., :2].reshape(-1, 2)
    plan = plan[np.isfinite(plan).all(axis=1)]
    extent = float(np.ptp(plan, axis=0).max()) if len(plan) else 0.0
    return max(least_mm, 1.5 * max(steps), extent / most_nodes)


def height_range(xyz_mm: Floats) -> tuple[float, float]:
    """Lowest and highest height in mm, less the outermost half percent each.

    Parameters
    ----------
    xyz_mm : (..., 3) array, mm, points with z up; NaN where there is none
    """
    low, high = np.nanpercentile(xyz_mm[..., 2], (0.5, 99.5))
    return float(low), float(high)


def _typical_step(values: Floats, axis: int) -> float:
    step = np.abs(np.diff(values, axis=axis))
    finite = step[np.isfinite(step)]
    return float(np.median(finite)) if len(finite) else 0.0
