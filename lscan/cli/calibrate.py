"""The commands ``lscan calibrate`` and ``lscan check``: thin faces over lscan.calibration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lscan.cli.arguments import (
    MAPS,
    ChannelName,
    Json,
    Overlay,
    PictureOrRun,
    Trust,
    require_folders,
)
from lscan.cli.console import print_json, print_table, progress_bar

if TYPE_CHECKING:
    from lscan.calibration.calibrate import Calibration, Score
    from lscan.calibration.check import CalibrationCheck, CorrectionKind

BoardFile = Annotated[
    Path | None, typer.Option("--board", help="Board file; a run folder has its own.")
]
OpticsFile = Annotated[
    Path | None,
    typer.Option("--optics", help="TOML file with [optics]; a run folder has its own."),
]
Seeds = Annotated[
    str | None,
    typer.Option(
        "--seeds", help="u,v of the upper-left dot, the one beneath and the one to its right."
    ),
]


def calibrate(
    picture: PictureOrRun,
    output: Annotated[Path, typer.Option("--output", "-o", help="Calibration file to write.")],
    board: BoardFile = None,
    optics: OpticsFile = None,
    plane_map: Annotated[
        str | None, typer.Option("--map", help=f"Plane map: {MAPS}; auto: the best.")
    ] = None,
    seeds: Seeds = None,
    channel: ChannelName = None,
    overlay: Overlay = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Find the board's control points in a picture and solve a plane map from them."""
    from lscan.board import draw_overlay
    from lscan.calibration.calibrate import calibrate as solve
    from lscan.calibration.calibrationfile import save_calibration
    from lscan.calibration.maps.auto import calibrate_best
    from lscan.cli.inputs import board_picture, parse_seeds
    from lscan.files.pictures import write_picture

    require_folders(output, overlay)
    given = board_picture(picture, board, optics, trust)
    name = given.calibration.plane_map if plane_map is None else plane_map
    reading = given.read(parse_seeds(seeds), channel)
    if overlay:
        write_picture(overlay, draw_overlay(given.image, reading))
    with progress_bar("maps") as progress:
        if name == "auto":
            calibration = calibrate_best(reading, given.optics, progress)
        else:
            calibration = solve(reading, name, given.optics)
    save_calibration(output, calibration)
    if json:
        print_json(_calibration_json(output, calibration))
    else:
        _print_calibration(output, calibration)


def check(
    calibration: Annotated[Path, typer.Argument(help="Calibration file (JSON).")],
    picture: PictureOrRun,
    board: BoardFile = None,
    optics: OpticsFile = None,
    placed: Annotated[
        float | None, typer.Option(help="How well the board was put back, mm; else not judged.")
    ] = None,
    level: Annotated[float, typer.Option(help="Chance of a false alarm.")] = 0.01,
    update: Annotated[
        Path | None,
        typer.Option("--update", help="Calibration file to write, with what is off corrected."),
    ] = None,
    correct: Annotated[
        list[str] | None,
        typer.Option("--correct", help="What --update corrects: scale, index, shift."),
    ] = None,
    seeds: Seeds = None,
    channel: ChannelName = None,
    trust: Trust = False,
    json: Json = False,
) -> None:
    """Score an old calibration against a new picture of the board; exit code 1 if it is off."""
    from lscan.calibration.calibrationfile import load_any, save_any
    from lscan.calibration.check import check_calibration, corrected, proposed
    from lscan.cli.inputs import board_picture, parse_corrections, parse_seeds

    require_folders(update)
    asked = parse_corrections(correct)
    if asked and update is None:
        raise typer.BadParameter("--correct needs --update FILE")
    loaded = load_any(calibration)
    given = board_picture(picture, board, optics, trust)
    reading, water = given.read(parse_seeds(seeds), channel), given.optics
    found = check_calibration(loaded, reading, level, placed, water)
    kinds = asked or proposed(found)
    if update is not None and kinds:
        save_any(update, corrected(loaded, reading, kinds, placed, water))
    if json:
        print_json({"agrees": found.agrees, "correct": kinds, **asdict(found)})
    else:
        _print_check(found, kinds, update)
    if not found.agrees and (update is None or not kinds):
        raise typer.Exit(1)


def _calibration_json(path: Path, calibration: Calibration) -> dict[str, Any]:
    from lscan.calibration.maps.auto import Auto

    grid, plane_map = calibration.reading.grid, calibration.plane_map
    content: dict[str, Any] = {
        "calibration": path,
        "map": calibration.name,
        "control_points": {"expected": len(grid.found), "found": int(grid.found.sum())},
        "residuals": {
            "rms_mm": calibration.rms_mm,
            "max_mm": calibration.max_mm,
            "rms_px": calibration.rms_px,
        },
        "outliers_mm": calibration.outliers_mm,
        "misfit": calibration.misfit,
    }
    if isinstance(plane_map, Auto):
        content["chosen"] = plane_map.chosen.name
        content["scores"] = plane_map.scores
    return content


def _print_calibration(path: Path, calibration: Calibration) -> None:
    from lscan.calibration.maps.auto import Auto

    found, plane_map, chosen = calibration.reading.grid.found, calibration.plane_map, ""
    if isinstance(plane_map, Auto):
        _print_scores(plane_map.scores)
        chosen = f" ({plane_map.chosen.name})"
    print(
        f"{calibration.name}{chosen}: {found.sum()} of {len(found)} control points, "
        f"residuals {calibration.rms_mm:.3f} mm rms, {calibration.max_mm:.3f} mm at most; {path}"
    )
    for x, z in calibration.outliers_mm:
        print(f"left out: the mark at ({x:g}, {z:g}) mm does not lie where the others predict it")
    if calibration.misfit:
        print(f"warning: {calibration.misfit}")


def _print_scores(scores: tuple[Score, ...]) -> None:
    rows = [
        [
            score.name,
            *(f"{mm:.4f}" for mm in (score.rms_mm, score.max_mm, score.sigma_mm)),
            "yes" if score.tied else "",
            score.points,
            score.without_value,
            f"{score.ms:.0f}",
        ]
        for score in scores
        if score.refused is None
    ]
    headings = ["map", "rms mm", "max mm", "sigma mm", "tied", "marks", "without value", "ms"]
    print_table("marks held out of the map", headings, rows)
    for score in scores:
        if score.refused is not None:
            print(f"{score.name}: refused, {score.refused}")


def _print_check(
    check: CalibrationCheck, kinds: Sequence[CorrectionKind], update: Path | None
) -> None:
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
    if check.index is not None:
        index = check.index
        print(
            f"index of the water that fits best: {index.index:.5f} ± {index.sigma:.5f}, "
            f"chi-square {index.chi_square:.0f}"
        )
    if kinds and update is not None:
        print(f"corrected ({', '.join(kinds)}): {update}")
    elif kinds:
        options = " ".join(f"--correct {kind}" for kind in kinds)
        print(f"to correct it: lscan check ... --update FILE {options}")
    if kinds and "shape" in check.reasons and "index" not in kinds:
        print("what that leaves of the shape enters the uncertainty; a new calibration is better")
    elif not kinds and not check.agrees:
        print("no change of scale, index or shift explains it: calibrate again")
    elif not kinds and update is not None:
        print("nothing to correct")
