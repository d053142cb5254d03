"""Figures of the surface in relief: as scanned, and after reorientation (Figs. 25 and 26)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lscan.figures import style
from lscan.figures.style import ReportFigure, signed
from lscan.paper.figures.words import drawn
from lscan.records import Floats
from lscan.surface import Alignment, levelling_step

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
    along_x, along_y = (signed(tilt, 2) for tilt in np.degrees(np.arctan(slopes)))
    return drawn(
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
    return drawn("levelled", figure, drawn=_describe(len(xyz_mm), gain), apart=apart)


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
