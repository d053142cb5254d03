"""Figures of slices: measured against designed height, and the error (Figs. 29 to 32)."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from lscan.figures import style
from lscan.figures.reportfigure import ReportFigure, SliceData, signed
from lscan.records import Status


@style.styled
def slice_plot(name: str, data: SliceData, paper: str, bar_mm: float) -> ReportFigure:
    """A slice: measured solid, designed dotted, and the error below (Figs. 29 to 32).

    bar_mm: the error bound that is drawn.
    """
    known = data.nominal_mm is not None and data.error_mm is not None
    figure, axes = style.panels(
        2 if known else 1, (style.WIDTH_IN, 3.4 if known else 2.4), (1.5, 1.0) if known else None
    )
    heights = axes[0]
    if data.nominal_mm is not None:
        heights.plot(data.along_mm, data.nominal_mm, ":", color=style.INK, label="theory")
    heights.plot(data.along_mm, data.measured_mm, color=style.SECOND, label="measured")
    heights.set_ylabel("z / mm")
    style.legend(heights)
    if data.error_mm is not None and known:
        _draw_error(axes[1], data, bar_mm)
    for panel in axes:
        _shade_gaps(panel, data)
    axes[-1].set_xlabel(f"along {name} / mm")
    alt = f"Height along slice {name}, measured against theory, with the error below."
    return ReportFigure(
        key=f"slice-{name}",
        title=f"Slice {name}",
        paper=paper,
        alt=alt,
        caption=f"Measured (solid){' and designed (dotted)' if known else ''} height along "
        f"{name}. {_slice_note(data, bar_mm)}",
        body=style.svg(figure, f"slice-{name}", alt),
    )


def _draw_error(axes: Axes, data: SliceData, bar_mm: float) -> None:
    error = np.asarray(data.error_mm)
    if data.sigma_mm is not None:
        low, high = error - 2 * data.sigma_mm, error + 2 * data.sigma_mm
        axes.fill_between(data.along_mm, low, high, color=style.FIRST, alpha=0.2, linewidth=0)
    axes.plot(data.along_mm, error, color=style.FIRST, linewidth=1.0)
    for bound in (-bar_mm, bar_mm):
        axes.axhline(bound, color=style.MUTED, linewidth=0.8, linestyle="--")
    largest = float(np.nanmax(np.abs(error), initial=0.0))
    reach = 1.15 * max(bar_mm, largest)
    axes.set_ylim(-reach, reach)
    axes.set_ylabel("error / mm")


def _shade_gaps(axes: Axes, data: SliceData) -> None:
    missing = ~np.isfinite(data.measured_mm)
    whole, colour = axes.get_xaxis_transform(), style.RULE
    axes.fill_between(
        data.along_mm, 0, 1, where=missing, transform=whole, color=colour, linewidth=0, step="mid"
    )


def _slice_note(data: SliceData, bar_mm: float) -> str:
    codes, counts = np.unique(data.status[~np.isfinite(data.measured_mm)], return_counts=True)
    why = ", ".join(
        f"{count} {Status(int(code)).name.lower().replace('_', ' ')}"
        for code, count in zip(codes, counts, strict=True)
    )
    gaps = f" Grey: {why}, of {len(data.status)} points." if why else ""
    if data.error_mm is None or not np.isfinite(data.error_mm).any():
        return gaps.strip()
    error = data.error_mm[np.isfinite(data.error_mm)]
    band = " (band: two standard uncertainties)" if data.sigma_mm is not None else ""
    skipped = int((np.isfinite(data.measured_mm) & ~np.isfinite(data.error_mm)).sum())
    gaps += f" Measured but not compared: {skipped} points." if skipped else ""
    within = 100 * np.mean(np.abs(error) <= bar_mm)
    return (
        f"Error{band}: rmse {np.sqrt(np.mean(error**2)):.2f} mm, from {signed(error.min(), 2)} to "
        f"{signed(error.max(), 2)} mm; {within:.1f} % within ±{bar_mm:g} mm (dashed).{gaps}"
    )
