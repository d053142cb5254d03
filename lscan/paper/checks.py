"""The head of the report: each part's figure beside the paper's, and whether it kept its bar."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Literal

from lscan.figures.style import signed
from lscan.measure import SliceErrors
from lscan.paper import published as paper
from lscan.paper.experiment import Experiment
from lscan.paper.tables import worst
from lscan.records import Length


@dataclass(frozen=True)
class ReportCheck:
    """One line of the report's head: a figure of ours and whether it kept its bar.

    Attributes
    ----------
    what : str, what was measured
    figure : str, ours
    paper : str, the paper's for the same
    bar : str, what is accepted
    passed : bool or None, None where there is no bar
    """

    what: str
    figure: str
    paper: str
    bar: str
    passed: bool | None


def checks(experiment: Experiment, bars: paper.Bars) -> list[ReportCheck]:
    """What the experiment measured by the paper's chain, and whether it kept its bars.

    Distances of which one was not measured do not pass.

    Parameters
    ----------
    experiment : Experiment, pieces that were not scanned have no lines
    bars : Bars, the largest errors accepted
    """
    board = experiment.board.measures[paper.CHOSEN_MAP]
    groove = experiment.groove.dimensions if experiment.groove else {}
    first, second = (
        [rows["Second rms"] for rows in table.values()] for table in (paper.TABLE_1, paper.TABLE_2)
    )
    percent, missing = bars.board_percent, len(board.unmeasured)
    return [
        *_control_point_checks(experiment),
        *_render_checks(experiment),
        *_length_check("Distances", board.distances, first, percent, "%", missing),
        *_length_check("Diameters", board.diameters, second, percent, "%"),
        *_length_check("Grooved block", groove, paper.TABLE_3.values(), bars.groove_mm, "mm"),
        *_sandwave_checks(experiment, bars.sandwave_mm),
    ]


def _length_check(
    what: str,
    lengths: Mapping[str, Length],
    printed: Collection[paper.PrintedLength],
    bar: float,
    unit: Literal["%", "mm"],
    missing: int = 0,
) -> list[ReportCheck]:
    """The largest errors beside those printed.  missing: how many more were not measured."""
    if not lengths:
        return []
    figure, largest = _largest(lengths.values(), unit)
    if missing:
        figure += f", {missing} of {missing + len(lengths)} not measured"
    kept = largest <= bar and not missing
    theirs, _ = _largest(printed, unit)
    return [ReportCheck(f"{what}, largest error", figure, theirs, f"{bar:g} {unit}", kept)]


def _largest(
    lengths: Collection[Length | paper.PrintedLength], unit: Literal["%", "mm"]
) -> tuple[str, float]:
    """The largest errors as text, and the one in that unit."""
    largest_mm, percent = worst(lengths)
    if unit == "mm":
        return f"{largest_mm:.2f} mm", largest_mm
    return f"{largest_mm:.2f} mm, {percent:.2f} %", percent


def _control_point_checks(experiment: Experiment) -> list[ReportCheck]:
    points = experiment.control_points
    found = f"{points.found} of {points.expected}"
    complete = points.found == points.expected
    lines = [ReportCheck("Control points found", found, "—", "all", complete)]
    if points.rms_px is not None:
        off = f"{points.rms_px:.3f} px rms, {points.max_px:.3f} px at most"
        lines.append(ReportCheck("Control points, distance from the truth", off, "—", "—", None))
    return lines


def _render_checks(experiment: Experiment) -> list[ReportCheck]:
    if experiment.truth is None:
        return []
    line = experiment.truth.render_check
    off = f"{line.stripe_rms_px:.3f} px rms, {line.stripe_max_px:.3f} px at most"
    return [ReportCheck("Line in the picture, distance from the truth", off, "—", "—", None)]


def _sandwave_checks(experiment: Experiment, bar_mm: float) -> list[ReportCheck]:
    sandwave = experiment.sandwave
    if sandwave is None:
        return []
    lines = [_slice_check(name, errors, bar_mm) for name, errors in sandwave.errors.items()]
    yaw_deg = sandwave.alignment.yaw_deg
    if yaw_deg is None:
        return lines
    true = f" (true {experiment.truth.yaw_deg:.3f}°)" if experiment.truth else ""
    found, theirs = f"{yaw_deg:.3f}°{true}", f"{paper.YAW_DEG:.2f}°"
    return [ReportCheck("Yaw of the sheet", found, theirs, "—", None), *lines]


def _slice_check(name: str, errors: SliceErrors, bar_mm: float) -> ReportCheck:
    low, high = (signed(error, 1) for error in paper.SLICE_ERRORS_MM)
    least, most = errors.min_mm, errors.max_mm
    return ReportCheck(
        f"Slice {name}, error",
        f"{signed(least, 2)} to {signed(most, 2)} mm, rmse {errors.rmse_mm:.2f} mm",
        f"most within {low} to {high} mm",
        f"±{bar_mm:g} mm",
        max(-least, most) <= bar_mm,
    )
