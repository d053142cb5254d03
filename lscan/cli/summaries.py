"""What the commands on calibrations and reports print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lscan.cli.console import print_table

if TYPE_CHECKING:
    from lscan.calibration.check import Check
    from lscan.calibration.solve import Calibration
    from lscan.paper.tables import Block

_LEFT_OUT = ("\nmm", "\n%")  # columns of the page that a terminal has no room for


def calibration_summary(path: Path, calibration: Calibration) -> dict[str, Any]:
    """What ``lscan calibrate --json`` prints of the calibration saved at ``path``.

    A calibration by ``auto`` also says which map was chosen, and the scores of all.
    """
    from dataclasses import asdict

    from lscan.calibration.maps.auto import Auto

    grid, plane_map = calibration.reading.grid, calibration.plane_map
    summary: dict[str, Any] = {
        "calibration": str(path),
        "map": calibration.name,
        "control_points": {"expected": len(grid.found), "found": int(grid.found.sum())},
        "residuals": {
            "rms_mm": calibration.rms_mm,
            "max_mm": calibration.max_mm,
            "rms_px": calibration.rms_px,
        },
    }
    if isinstance(plane_map, Auto):
        summary["chosen"] = plane_map.chosen.name
        summary["scores"] = [asdict(score) for score in plane_map.scores]
    return summary


def print_calibration(summary: dict[str, Any]) -> None:
    """Print a calibration's summary, with the table of scores where there is one."""
    if "scores" in summary:
        _print_scores(summary["scores"])
    points, residuals = summary["control_points"], summary["residuals"]
    chosen = f" ({summary['chosen']})" if "chosen" in summary else ""
    print(
        f"{summary['map']}{chosen}: {points['found']} of {points['expected']} control points, "
        f"residuals {residuals['rms_mm']:.3f} mm rms, {residuals['max_mm']:.3f} mm at most; "
        f"{summary['calibration']}"
    )


def _print_scores(scores: list[dict[str, Any]]) -> None:
    solved = [score for score in scores if score["refused"] is None]
    rows = [
        [
            score["name"],
            f"{score['rms_mm']:.4f}",
            f"{score['max_mm']:.4f}",
            f"{score['sigma_mm']:.4f}",
            "yes" if score["tied"] else "",
            score["points"],
            score["without_value"],
            f"{score['ms']:.0f}",
        ]
        for score in solved
    ]
    headings = ["map", "rms mm", "max mm", "sigma mm", "tied", "marks", "without value", "ms"]
    print_table("marks held out of the map", headings, rows)
    for score in scores:
        if score["refused"] is not None:
            print(f"{score['name']}: refused, {score['refused']}")


def print_check(check: Check) -> None:
    """Print how a calibration did on a new board picture."""
    (x, z), (x_sigma, z_sigma) = check.shift_mm, check.shift_sigma_mm
    print(f"{check.marks} marks compared, {check.without_value} outside the calibration")
    print(f"as they are: {check.raw_rms_mm:.3f} mm rms, {check.raw_max_mm:.3f} mm at most")
    print(
        f"board put back with a shift of {x:.3f} ± {x_sigma:.3f} mm in x, {z:.3f} ± "
        f"{z_sigma:.3f} mm in z and a turn of {check.turn_deg:.4f} ± {check.turn_sigma_deg:.4f} deg"
    )
    print(f"without those: {check.rms_mm:.3f} mm rms, {check.max_mm:.3f} mm at most")
    print(f"scale error {1e6 * check.scale_error:.0f} ± {1e6 * check.scale_sigma:.0f} ppm")
    print(f"chi-square {check.chi_square:.0f} for {check.degrees_of_freedom} degrees of freedom")
    rows = [[mark.name, *mark.residual_mm, f"{mark.ratio:.1f}"] for mark in check.worst]
    print_table("farthest off", ["mark", "x mm", "z mm", "sigmas"], rows)
    verdict = "agrees" if check.agrees else f"disagrees: {', '.join(check.reasons)}"
    print(f"the calibration {verdict} (chance of a false alarm {100 * check.level:g} %)")


def print_chains(results: Mapping[str, Any]) -> None:
    """Print where a report's pictures come from, and the errors of both chains side by side."""
    from lscan.acquisition.provenance import PARTS, chain_names, chains_in_words, note
    from lscan.paper.published import Bars
    from lscan.paper.tables import paper_tables

    for line in filter(None, (note(results, PARTS), chains_in_words(results))):
        print(line)
    names = [name.removeprefix("Ours, ") for name in chain_names(results)]
    for table in paper_tables(results, Bars()):
        if table.chains is not None:
            _print_block(f"{table.title}, mm", table.chains, names)


def _print_block(title: str, block: Block, names: Sequence[str]) -> None:
    """The columns of errors and their sigmas: all of them are too many for a terminal."""
    groups = [("paper", block.paper_heads)]
    groups += [(name, block.our_heads) for name in (names if block.has_best else names[:1])]
    columns = [f"{name}\n{head}" for name, heads in groups for head in heads]
    kept = [k for k, column in enumerate(columns) if not column.endswith(_LEFT_OUT)]
    rows = []
    for row in block.rows:
        cells = [cell.text for cell in row.paper + row.ours + row.best]
        rows.append([row.label, *(cells[k] for k in kept)])
    print_table(title, [block.names, *(columns[k] for k in kept)], rows)
