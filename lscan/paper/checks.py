"""The head of the report: each part's figure beside the paper's, and whether it kept its bar."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from lscan.figures.reportfigure import signed
from lscan.paper import published as paper
from lscan.paper.tables import Length, known, read_lengths, worst


@dataclass(frozen=True)
class Check:
    """One line of the report's head: what, our figure, the bar and whether it was kept.

    paper: the paper's figure for the same.  passed: None where there is no bar.
    """

    what: str
    figure: str
    paper: str
    bar: str
    passed: bool | None


def checks(results: Mapping[str, Any], bars: paper.Bars) -> list[Check]:
    """What ``results`` (results.json) says was measured, and whether it kept its bar.

    A length that was not measured, or a slice without a point compared, does not pass.
    """
    second = {
        name: (results.get(name) or {}).get(paper.CHOSEN_MAP) or {}
        for name in ("distances", "diameters")
    }
    return [
        *_control_point_checks(results),
        *_render_checks(results),
        *_percent_check("Distances", second["distances"], paper.TABLE_1, bars.board_percent),
        *_percent_check("Diameters", second["diameters"], paper.TABLE_2, bars.board_percent),
        *_groove_check(results.get("groove") or {}, bars.groove_mm),
        *_sandwave_checks(results.get("sandwave") or {}, bars.sandwave_mm),
    ]


def _percent_check(
    what: str,
    section: Mapping[str, Any],
    printed: Mapping[str, Mapping[str, paper.Printed]],
    bar_percent: float,
) -> list[Check]:
    """Largest errors by the second-order fit, none where no truth is known."""
    lengths = read_lengths(section).values()
    largest, missing = worst(lengths), _missing(lengths)
    if largest is None and not missing:
        return []
    theirs = [row["Second rms"] for row in printed.values()]
    paper_mm, paper_percent = _largest_mm(theirs), max(abs(row.percent) for row in theirs)
    ours = f"{largest[0]:.2f} mm, {largest[1]:.2f} %{missing}" if largest else f"none{missing}"
    return [
        Check(
            f"{what}, largest error",
            ours,
            f"{paper_mm:.2f} mm, {paper_percent:.2f} %",
            f"{bar_percent:g} %",
            largest is not None and largest[1] <= bar_percent and not missing,
        )
    ]


def _groove_check(section: Mapping[str, Any], bar_mm: float) -> list[Check]:
    lengths = read_lengths(section).values()
    largest, missing = worst(lengths), _missing(lengths)
    if largest is None and not missing:
        return []
    return [
        Check(
            "Grooved block, largest error",
            f"{largest[0]:.2f} mm{missing}" if largest else f"none{missing}",
            f"{_largest_mm(paper.TABLE_3.values()):.2f} mm",
            f"{bar_mm:g} mm",
            largest is not None and largest[0] <= bar_mm and not missing,
        )
    ]


def _missing(lengths: Collection[Length]) -> str:
    """Such as ", 2 of 14 not measured", "" where all were."""
    count = sum(length.measured_mm is None for length in lengths)
    return f", {count} of {len(lengths)} not measured" if count else ""


def _largest_mm(printed: Iterable[paper.Printed]) -> float:
    return max(abs(row.error_mm) for row in printed)


def _control_point_checks(results: Mapping[str, Any]) -> list[Check]:
    points = results.get("control_points")
    if not points:
        return []
    expected, found = points["expected"], points["found"]
    lines = [Check("Control points found", f"{found} of {expected}", "—", "all", found == expected)]
    if points.get("rms_px") is not None:
        off = f"{points['rms_px']:.3f} px rms, {points['max_px']:.3f} px at most"
        lines.append(Check("Control points, distance from the truth", off, "—", "—", None))
    return lines


def _render_checks(results: Mapping[str, Any]) -> list[Check]:
    stripe = results.get("render_check")
    if not stripe:
        return []
    off = f"{stripe['stripe_rms_px']:.3f} px rms, {stripe['stripe_max_px']:.3f} px at most"
    return [Check("Line in the picture, distance from the truth", off, "—", "—", None)]


def _sandwave_checks(sandwave: Mapping[str, Any], bar_mm: float) -> list[Check]:
    lines = []
    yaw = sandwave.get("yaw_deg") or {}
    true, estimated = known(yaw, "true"), known(yaw, "estimated")
    if estimated is not None:
        found = f"{estimated:.3f}°" + (f" (true {true:.3f}°)" if true is not None else "")
        lines.append(Check("Yaw of the sheet", found, f"{paper.YAW_DEG:.2f}°", "—", None))
    low, high = (signed(error, 1) for error in paper.SLICE_ERRORS_MM)
    for name, entry in (sandwave.get("slices") or {}).items():
        least, most, rmse = (known(entry, key) for key in ("min_mm", "max_mm", "rmse_mm"))
        found, passed = "no point compared", False
        if least is not None and most is not None and rmse is not None:
            found = f"{signed(least, 2)} to {signed(most, 2)} mm, rmse {rmse:.2f} mm"
            passed = max(-least, most) <= bar_mm
        theirs, bar = f"most within {low} to {high} mm", f"±{bar_mm:g} mm"
        lines.append(Check(f"Slice {name}, error", found, theirs, bar, passed))
    return lines
