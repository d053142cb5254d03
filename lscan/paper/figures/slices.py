"""Figures of slices: measured against designed height, and the error (Figs. 29 to 32)."""

import numpy as np
from matplotlib.axes import Axes

from lscan.figures import style
from lscan.figures.reportfigure import ReportFigure, signed
from lscan.measure import SliceErrors
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
    alt = f"Height along slice {name}, measured against theory, with the error below."
    return ReportFigure(
        key=f"slice-{name}",
        title=f"Slice {name}",
        paper=paper,
        alt=alt,
        caption=f"Measured (solid) and designed (dotted) height along "
        f"{name}. {_slice_note(cut, errors, bar_mm)}",
        body=style.svg(figure, f"slice-{name}", alt),
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


def _slice_note(cut: Slice, errors: SliceErrors, bar_mm: float) -> str:
    measured, compared = np.isfinite(cut.z_mm), np.isfinite(errors.error_mm)
    codes, counts = np.unique(cut.status[~measured], return_counts=True)
    why = ", ".join(
        f"{count} {Status(int(code)).name.lower().replace('_', ' ')}"
        for code, count in zip(codes, counts, strict=True)
    )
    gaps = f" Grey: {why}, of {len(cut.status)} points." if why else ""
    skipped = int((measured & ~compared).sum())
    gaps += f" Measured but not compared: {skipped} points." if skipped else ""
    within = 100 * np.mean(np.abs(errors.error_mm[compared]) <= bar_mm)
    return (
        f"Error (band: two standard uncertainties): rmse {errors.rmse_mm:.2f} mm, from "
        f"{signed(errors.min_mm, 2)} to {signed(errors.max_mm, 2)} mm; {within:.1f} % within "
        f"±{bar_mm:g} mm (dashed).{gaps}"
    )
