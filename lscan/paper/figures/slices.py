"""Figures of slices: measured against designed height, and the error (Figs. 29 to 32)."""

import numpy as np
from matplotlib.axes import Axes

from lscan.figures import style
from lscan.figures.style import ReportFigure, signed
from lscan.measure import SliceErrors
from lscan.paper.figures.words import drawn
from lscan.records import Status
from lscan.surface import Slice


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
    for panel in (heights, below):
        _shade_gaps(panel, cut)
    below.set_xlabel(f"along {name} / mm")
    compared = np.isfinite(errors.error_mm)
    return drawn(
        "slice",
        figure,
        name=name,
        paper=paper,
        rmse=errors.rmse_mm,
        least=signed(errors.min_mm, 2),
        most=signed(errors.max_mm, 2),
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
    axes.set_ylim(-reach, reach)
    axes.set_ylabel("error / mm")


def _shade_gaps(axes: Axes, cut: Slice) -> None:
    missing = ~np.isfinite(cut.z_mm)
    whole, colour = axes.get_xaxis_transform(), style.RULE
    axes.fill_between(
        cut.along_mm, 0, 1, where=missing, transform=whole, color=colour, linewidth=0, step="mid"
    )


def _gaps(cut: Slice, skipped: int) -> str:
    """What is missing in a slice, in words.  skipped: points measured but not compared."""
    codes, counts = np.unique(cut.status[~np.isfinite(cut.z_mm)], return_counts=True)
    why = ", ".join(
        f"{count} {Status(int(code)).name.lower().replace('_', ' ')}"
        for code, count in zip(codes, counts, strict=True)
    )
    gaps = f" Grey: {why}, of {len(cut.status)} points." if why else ""
    return gaps + (f" Measured but not compared: {skipped} points." if skipped else "")
