"""Whether camera, laser and target are placed so that they can be scanned.

Refused: a camera or a laser inside the target or beneath the floor.  Logged as warnings, for it
may be meant: how large a mesh file is and what it lacks, a target that the line does not fall
on, and one whose end lies within the sheet's thickness.
"""

import logging
from pathlib import Path

import numpy as np
import trimesh

from lscan.errors import InputError
from lscan.files.meshes import TWICE
from lscan.records import Floats, Mask
from sim.meshes import target_mesh
from sim.scene import PlanePort, Scene, camera_pose, head_pose, into_world, target_pose
from sim.truth import project, sheet_of
from sim.truth.camera import flat_normal
from sim.truth.sheet import TrueSheet
from sim.truth.surfaces import Mesh, TargetSection, section_at
from sim.truth.visibility import in_fan, in_picture, passing_mm

MOST_PLACES = 25  # of the plan's, spread evenly, that are looked at
INSIDE = 0.5  # winding number between 1, inside a closed surface, and 0, outside

_log = logging.getLogger(__name__)


def check_placement(scene: Scene) -> None:
    """Refuse what cannot be scanned, and log what is odd about the target, as warnings.

    Parameters
    ----------
    scene : Scene, its target, floor, head and plan

    Raises
    ------
    InputError
        Names the key, where camera or laser lie inside the target or beneath the floor at a
        position of the plan, and where the target cannot be made.
    """
    mesh, target = target_mesh(scene), scene.tank.target
    if target.shape == "mesh":
        _warn(scene, mesh_notes(scene, mesh))
    _check_outside(scene, mesh)
    if target.shape in ("mesh", "rough", "workpiece") and scene.tank.laser.on:
        _warn(scene, out_of_reach(scene, mesh) or lit_ends(scene, mesh))


def _warn(scene: Scene, notes: list[str]) -> None:
    for note in notes:  # warnings, so that they are seen without logging set up
        _log.warning("note: %s: %s", scene.source, note)


def mesh_notes(scene: Scene, mesh: trimesh.Trimesh) -> list[str]:
    """How large the target's mesh file is, and what it lacks; mesh: in the world, mm."""
    name = Path(scene.tank.target.file or "").name
    own = target_pose(scene).invert(np.asarray(mesh.vertices))
    size = " x ".join(f"{side:.4g}" for side in np.ptp(own, axis=0))
    twice = [mesh.metadata[TWICE]] if TWICE in mesh.metadata else []
    said = [f"is {size} mm, {len(mesh.faces)} triangles", *twice, *gaps_of(mesh)]
    return [f"target.file: {name} {note}" for note in said]


def gaps_of(mesh: trimesh.Trimesh) -> list[str]:
    """One note on the open edges of a mesh, none where every edge has a triangle on either side.

    A loop of k open edges is closed by k - 2 triangles; loops that share a vertex are counted
    by Euler's formula: E edges, V vertices and C connected parts have E - V + C loops.  That
    counts a ring of gaps, each of which touches the next, as one loop more.
    """
    joined = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    edges = joined.edges_sorted
    lone = trimesh.grouping.group_rows(edges, require_count=1)
    if len(lone) == 0:
        return []
    border = edges[lone]
    parts = trimesh.graph.connected_components(border, min_len=1)
    loops = len(border) - len(np.unique(border)) + len(parts)
    missing = max(len(border) - 2 * loops, 1)
    return [
        f"is not watertight: {len(border)} edges have a triangle on one side only; "
        f"about {missing} triangles would close it"
    ]


def out_of_reach(scene: Scene, mesh: trimesh.Trimesh) -> list[str]:
    """One note where the line does not fall on the target in the plan's pictures, else none."""
    reasons = [
        _why_missed(scene, mesh, sheet_of(scene, line))
        for line in range(len(scene.tank.laser.sheets))
    ]
    if None in reasons:
        return []
    low, high = (np.round(corner, 1).tolist() for corner in mesh.bounds)
    unit = "; is target.unit right?" if scene.tank.target.shape == "mesh" else ""
    return [
        f"target: the line does not fall on it: {reasons[0]}; it spans {low} to {high} mm "
        f"in the world{unit}"
    ]


def lit_ends(scene: Scene, mesh: trimesh.Trimesh) -> list[str]:
    """One note where a flat sheet's middle is past an end of the target and its light is not."""
    laser, places = scene.tank.laser, np.array(scene.rig.plan.positions_mm())
    notes = []
    for line in range(len(laser.sheets)):
        sheet = sheet_of(scene, line)
        if sheet.bow is not None or scene.tank.head.shaft is not None:
            continue
        passed = passing_mm(scene.tank.head, np.asarray(mesh.vertices), sheet)
        past = np.maximum(passed.min() - places, places - passed.max())
        lit = places[(past > 0) & (past < laser.waist_mm)]
        if len(lit):
            notes.append(
                f"target: at track position {lit[0]:g} mm the sheet's middle is past its end and "
                "some of the sheet's light is not: the picture has a line where the truth has none"
            )
    return notes[:1]


def _why_missed(scene: Scene, mesh: trimesh.Trimesh, sheet: TrueSheet) -> str | None:
    """Why a sheet's line is not seen on the target; None where it is."""
    places = np.array(scene.rig.plan.positions_mm())
    head = scene.tank.head
    if sheet.bow is None:
        passed = passing_mm(head, np.asarray(mesh.vertices), sheet)
        passed = passed[np.isfinite(passed)]
        if len(passed) == 0:
            return "the sheet never meets it"
        reached = f"the sheet meets it at track positions {passed.min():.1f} to {passed.max():.1f}"
        spanned = f"the plan's are {places.min():g} to {places.max():g} mm"
        places = places[(places >= passed.min()) & (places <= passed.max())]
        if len(places) == 0:
            return f"{reached}, {spanned}"
    found = set()
    for place in _spread_places(places):
        plane = head_pose(head, float(place)) @ sheet.pose
        fault = _fault(scene, sheet, section_at([Mesh(mesh)], plane, sheet.bow), float(place))
        if fault is None:
            return None
        found.add(fault)
    return ", ".join(sorted(found))


def _fault(scene: Scene, sheet: TrueSheet, section: TargetSection, place: float) -> str | None:
    """Why none of a section shows in a picture; None where some of it may."""
    xz = section.ends_mm.reshape(-1, 2)
    xz = np.concatenate([xz, section.ends_mm.mean(axis=1)])
    if len(xz) == 0:
        return "the sheet passes it by"
    points = sheet.in_head(xz)
    lit = in_fan(scene.tank.laser, xz)
    if not lit.any():
        return "it lies outside the laser's fan"
    if (floor := scene.tank.floor) is not None:
        lit &= into_world(scene.tank.head, points, place)[:, 2] > floor.z_mm
    if not lit.any():
        return "it lies beneath the floor"
    shown: Mask = in_picture(scene, project(scene, points[lit]))
    return None if shown.any() else "it lies outside the picture"


def _check_outside(scene: Scene, mesh: trimesh.Trimesh) -> None:
    """Refuse a camera or a laser's apex inside the target or beneath the floor."""
    head, laser, floor = scene.tank.head, scene.tank.laser, scene.tank.floor
    stated = {
        "head.camera_mm": ("the camera", head.camera_mm, _camera_points(scene)),
        "laser.apex_mm": ("the laser", laser.apex_mm, np.array([laser.apex_mm])),
    }
    places = _spread_places(np.array(scene.rig.plan.positions_mm()))
    for key, (what, value, points) in stated.items():
        for place in places.tolist():
            there = into_world(head, points, place)
            if floor is not None and np.any(there[:, 2] <= floor.z_mm):
                fault, allowed = "beneath the floor", f"above the floor, at z = {floor.z_mm:g} mm"
            elif any(inside(mesh, point) for point in there):
                low, high = (np.round(corner, 1).tolist() for corner in mesh.bounds)
                fault = "inside the target"
                allowed = f"outside the target, which spans {low} to {high} mm in the world"
            else:
                continue
            message = f"{key}: {what} is {fault} at track position {place:g} mm"
            raise InputError(message, where=scene.source, value=value, allowed=allowed)


def _camera_points(scene: Scene) -> Floats:
    """(2, 3) the pinhole, and the middle of the port's outer face; head frame, mm."""
    port = scene.tank.port
    if isinstance(port, PlanePort):
        front = (port.gap_mm + port.thickness_mm) * flat_normal(port)
    else:
        ahead = np.array([0.0, 0.0, port.radius_mm + port.thickness_mm])
        front = np.array(port.centre_mm) + ahead
    return camera_pose(scene.tank.head).apply(np.array([np.zeros(3), front]))


def inside(mesh: trimesh.Trimesh, point: Floats) -> bool:
    """Whether a (3,) point lies inside a mesh, which may have gaps, mm.

    By the winding number, the solid angle of all triangles over 4 pi, which a gap changes by its
    own solid angle only.

    References
    ----------
    A. van Oosterom, J. Strackee, The solid angle of a plane triangle, IEEE Trans. Biomed. Eng. 30
    (1983) 125.  A. Jacobson, L. Kavan, O. Sorkine, Robust inside-outside segmentation using
    generalized winding numbers, ACM Trans. Graph. 32 (2013) 33.
    """
    if len(mesh.faces) == 0 or np.any(point < mesh.bounds[0]) or np.any(point > mesh.bounds[1]):
        return False
    a, b, c = np.moveaxis(np.asarray(mesh.triangles) - point, 1, 0)
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a))]
    below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
    winding = np.arctan2(volume, below).sum() / (2 * np.pi)
    return bool(abs(winding) > INSIDE)


def _spread_places(places: Floats) -> Floats:
    """Up to MOST_PLACES of (N,) places, evenly spread, both ends among them."""
    index = np.linspace(0, len(places) - 1, min(len(places), MOST_PLACES))
    return places[np.unique(np.rint(index).astype(int))]
