"""The command ``lscan compare``: a thin face over lscan.measure.meshes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lscan.cli.arguments import Json, require_folders
from lscan.cli.console import note, print_json, print_table
from lscan.errors import InputError

if TYPE_CHECKING:
    from lscan.measure.meshes import MeshPose


def compare(
    surface: Annotated[Path, typer.Argument(help="Surface (.nc).")],
    mesh: Annotated[Path, typer.Argument(help="Mesh file: PLY, STL, OBJ or OFF.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="JSON file to write.")
    ] = None,
    unit: Annotated[str, typer.Option(help="Of the mesh: mm, cm, m or inch.")] = "mm",
    at: Annotated[
        str, typer.Option(help="x,y,z of the mesh's origin in the surface's frame, mm.")
    ] = "0,0,0",
    turn: Annotated[float, typer.Option(help="Of the mesh about z, degrees.")] = 0.0,
    fit: Annotated[
        bool, typer.Option("--fit", help="Find the pose from the points, starting from that.")
    ] = False,
    within: Annotated[
        float, typer.Option(help="mm; points farther off the mesh are not compared.")
    ] = 10.0,
    points: Annotated[
        Path | None, typer.Option(help="Points coloured by distance to write (.ply).")
    ] = None,
    histogram: Annotated[
        Path | None, typer.Option(help="Histogram of the distances to write (.png).")
    ] = None,
    json: Json = False,
) -> None:
    """Compare a surface with a mesh: the signed distances of its points."""
    from lscan.files.disk import write_json
    from lscan.files.meshes import MM_PER_UNIT, TWICE, load_mesh
    from lscan.measure.meshes import (
        MeshPose,
        compare_mesh,
        save_coloured_points,
        save_histogram,
    )
    from lscan.surface import load_surface

    require_folders(output, points, histogram)
    if unit not in MM_PER_UNIT:
        raise InputError("no such unit", where="--unit", value=unit, allowed=", ".join(MM_PER_UNIT))
    if not (np.isfinite(within) and within > 0):
        raise InputError("is not a distance", where="--within", value=within, allowed="> 0 mm")
    if not np.isfinite(turn):
        raise InputError("is not an angle", where="--turn", value=turn, allowed="degrees")
    pose = MeshPose.at(_place(at), turn)
    shape = load_mesh(mesh, MM_PER_UNIT[unit])
    found = compare_mesh(load_surface(surface), shape, pose, fit, within)
    if TWICE in shape.metadata:
        note(f"{mesh} {shape.metadata[TWICE]}")
    if output:
        write_json(output, found.as_json())
    if points:
        save_coloured_points(points, found)
    if histogram:
        save_histogram(histogram, found)
    if json:
        print_json(found.as_json())
        return
    summary = found.as_json()
    low, high = summary["central_95_mm"]
    rows = [
        ["points", summary["points"]],
        [f"not compared: farther than {within:g} mm", summary["far"]],
        ["not compared: beside the mesh", summary["beside"]],
        ["mean mm", summary["mean_mm"]["value"]],
        ["its sigma mm", summary["mean_mm"]["sigma"]],
        ["rms mm", summary["rms_mm"]],
        ["95 % between mm", f"{low:.3f} and {high:.3f}"],
        ["within 2 sigma", summary["within_2_sigma"]],
    ]
    if fit:
        rows += _pose_rows(found.pose)
    print_table("distances from the mesh", ["", ""], rows)


def _pose_rows(pose: MeshPose) -> list[list[str]]:
    """Where a mesh lies, as a scene file states it."""
    from scipy.spatial.transform import Rotation

    turns = Rotation.from_matrix(pose.rotation).as_euler("xyz", degrees=True)
    return [
        ["mesh at x, y, z mm", ", ".join(f"{mm:.3f}" for mm in pose.translation_mm)],
        ["turned about x, y, z deg", ", ".join(f"{turn:.3f}" for turn in turns)],
    ]


def _place(text: str) -> tuple[float, float, float]:
    """(x, y, z) of "x,y,z"; InputError where it is none."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 3 or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e6:
        raise InputError("not a point", where="--at", value=text, allowed="x,y,z in mm")
    return numbers[0], numbers[1], numbers[2]
