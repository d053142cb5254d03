"""The figures of the report's page, section by section."""

from collections.abc import Sequence

from lscan.figures.page import ReportFigure
from lscan.paper import picturefigures, surfacefigures
from lscan.paper.experiment import Experiment, LinePictures
from lscan.paper.published import Bars
from lscan.pipeline import SandwaveMeasures

_SLICE_FIGURES = {"S1": "Fig. 29", "S2": "Fig. 30", "S3": "Fig. 31", "SD": "Fig. 32"}

Shown = tuple[Sequence[ReportFigure], tuple[str, ...]]
"""Figures, and the runs their pictures come from: "board", "groove" and "sandwave"."""


def page_figures(experiment: Experiment, bars: Bars) -> dict[str, list[Shown]]:
    """The figures by the heading they stand under; none for pieces that were not scanned."""
    calibration, sensitivity = picturefigures.board_figures(experiment.board)
    shown, sandwave = experiment.shown, experiment.sandwave
    sections: dict[str, list[Shown]] = {"Calibration": [(calibration, ("board",))]}
    if shown:
        sections["The laser line"] = lines = []
        if "groove" in shown:
            lines.append(([picturefigures.groove_snapshot(shown["groove"])], ("groove",)))
        if "sandwave" in shown:
            lines.append((_sandwave_lines(shown["sandwave"]), ("sandwave",)))
    if sandwave is not None:
        of_both = ("board", "sandwave")
        sections["The surface"] = [(_surface(sandwave), of_both)]
        sections["Slices"] = [(_slices(sandwave, bars.sandwave_mm), of_both)]
    sections["Sensitivity of the fits"] = [(sensitivity, ("board",))]
    return sections


def _sandwave_lines(shown: LinePictures) -> list[ReportFigure]:
    column = picturefigures.lit_column(shown)
    return [
        picturefigures.sandwave_snapshot(shown, column),
        picturefigures.column_intensities(shown.images, column),
    ]


def _surface(sandwave: SandwaveMeasures) -> list[ReportFigure]:
    waves = surfacefigures.on_the_waves(sandwave)
    return [
        surfacefigures.raw_relief(sandwave.raw.xyz_mm),
        surfacefigures.levelled_relief(sandwave.raw.xyz_mm, sandwave.alignment),
        surfacefigures.contours_before(sandwave, waves),
        surfacefigures.contours_after(sandwave, waves),
        surfacefigures.surface_to_turn(sandwave.aligned.xyz_mm, waves),
    ]


def _slices(sandwave: SandwaveMeasures, bar_mm: float) -> list[ReportFigure]:
    return [
        surfacefigures.slice_plot(
            name, cut, sandwave.errors[name], _SLICE_FIGURES.get(name, ""), bar_mm
        )
        for name, cut in sandwave.slices.items()
    ]
