"""What is lit by the laser and seen by the camera.  Both travel straight in the water."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize.elementwise import find_root

from lscan.config.targets import Sandwave
from lscan.errors import InputError
from lscan.records import Floats, Mask
from sim.scene import (
    Head,
    Laser,
    Pose,
    Scene,
    TrueShaft,
    head_pose,
    into_head,
    into_world,
    seat_pose,
    target_pose,
    track_pose,
)
from sim.truth.camera import entry_points, project
from sim.truth.sheet import TrueSheet, sheet_of
from sim.truth.surfaces import SELF_MM, TankSurface, TargetSection, cross, spread, surfaces_of

ALIGNED = TrueSheet(Pose(np.eye(3), np.zeros(3)), bow=None)


def is_blocked(surfaces: Sequence[TankSurface], start: Floats, end: Floats) -> Mask:
    """(N,) whether anything comes between (N, 3) starts and ends; world frame, mm."""
    hidden = np.zeros(len(start), dtype=bool)
    for surface in surfaces:
        rays = np.flatnonzero(~hidden)
        hidden[rays] = surface.blocks(start[rays], end[rays])
    return hidden


def in_fan(laser: Laser, xz_mm: Floats) -> Mask:
    """(N,) whether (N, 2) points of a sheet lie within the laser's fan."""
    return np.abs(fan_angle(laser, xz_mm)) <= np.radians(laser.fan_half_angle_deg)


def fan_angle(laser: Laser, xz_mm: Floats) -> Floats:
    """(...,) angle, rad, at the apex between the fan's axis and points of a sheet.

    Parameters
    ----------
    laser : Laser, its apex and aim
    xz_mm : (..., 2) array, mm, in the sheet's plane
    """
    right, up = np.moveaxis(xz_mm - apex_xz(laser), -1, 0)
    aim = np.radians(laser.aim_deg)
    across = right * np.cos(aim) + up * np.sin(aim)
    ahead = right * np.sin(aim) - up * np.cos(aim)
    return np.arctan2(across, ahead)


def lit(laser: Laser, section: TargetSection, xz_mm: Floats) -> Mask:
    """(N,) whether the laser reaches (N, 2) points of the section: the first hit of its ray.

    Two-dimensional visibility in the sheet: every piece of the section is met by the rays
    whose angles lie between those of its ends.
    """
    angle = fan_angle(laser, xz_mm)
    order = np.argsort(angle)
    ends = fan_angle(laser, section.ends_mm)
    low, high = ends.min(axis=1), ends.max(axis=1)
    first = np.searchsorted(angle[order], low, side="left")
    last = np.searchsorted(angle[order], high, side="right")
    # A piece that spans half a turn passes above the apex, out of every fan.
    owner, step = spread(np.where(high - low < np.pi, last - first, 0))
    point = order[first[owner] + step]

    offset = xz_mm - apex_xz(laser)
    distance = np.linalg.norm(offset, axis=1)
    towards = offset[point] / distance[point, np.newaxis]
    start = section.ends_mm[owner, 0] - apex_xz(laser)
    along = section.ends_mm[owner, 1] - section.ends_mm[owner, 0]
    across = cross(towards, along)
    radial = across == 0  # seen edge on: stops nothing
    reach = np.where(radial, np.inf, cross(start, along) / np.where(radial, 1.0, across))
    nearest = np.full(len(xz_mm), np.inf)
    np.minimum.at(nearest, point, reach)
    return in_fan(laser, xz_mm) & (distance <= nearest + SELF_MM)


def seen(
    scene: Scene, surfaces: Sequence[TankSurface], points_head: Floats, position_mm: Floats | float
) -> Mask:
    """(N,) whether the camera's line of sight to (N, 3) points of the head frame is free.

    position_mm: track position of the head, one for all points or (N,).
    """
    entry = entry_points(scene, points_head)
    start = into_world(scene.tank.head, entry, position_mm)
    end = into_world(scene.tank.head, points_head, position_mm)
    free: Mask = np.all(np.isfinite(entry), axis=1)
    free[free] = ~is_blocked(surfaces, start[free], end[free])
    return free


def in_picture(scene: Scene, pixels: Floats) -> Mask:
    """(N,) whether (N, 2) of (u, v) fall on a pixel of the picture."""
    size = np.array(scene.rig.camera.size_px)
    return np.all((pixels >= -0.5) & (pixels <= size - 0.5), axis=1)


def slice_visibility(scene: Scene, points_mm: Floats, line: int = 0) -> Mask:
    """(N,) whether points of the sandwave are lit and seen when a sheet passes over them.

    A point that lies outside the picture at that moment is not seen.

    Parameters
    ----------
    scene : Scene, its target is the sandwave, taken without sand and wedges
    points_mm : (N, 2) array, (x, y), mm, workpiece frame; their height is that of the nominal
        shape, eq. (4), on the rims z = 0
    line : int, index into ``laser.sheets``

    Raises
    ------
    InputError
        The target is no sandwave, the points are not finite (N, 2), or there is no such line.
    """
    points = np.asarray(points_mm, dtype=float)
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise InputError("slice points", value=points.shape, allowed="finite, (N, 2)")
    scene = scene.with_tank(target={"sand": None})
    tank, workpiece = scene.tank, scene.rig.workpiece
    if tank.target.shape != "workpiece" or not isinstance(workpiece, Sandwave):
        what, allowed = "target is no sandwave", 'shape = "workpiece" and kind = "sandwave"'
        raise InputError(what, where=scene.source, value=tank.target.shape, allowed=allowed)
    over = np.all((points >= 0) & (points <= workpiece.side_mm), axis=1)
    height = np.where(over, workpiece.height_mm(points[:, 0], points[:, 1]), 0.0)
    world = target_pose(scene).apply(np.column_stack([points, height]))

    sheet = sheet_of(scene, line)
    position = passing_mm(tank.head, world, sheet)
    passed = np.isfinite(position)
    world, position = world[passed], position[passed]
    head = into_head(tank.head, world, position)
    apex = np.broadcast_to(np.array(tank.laser.apex_mm), head.shape)
    start = into_world(tank.head, apex, position)
    surfaces = surfaces_of(scene)
    shone = in_fan(tank.laser, sheet.flatten(head)) & ~is_blocked(surfaces, start, world)
    shone &= in_picture(scene, project(scene, head)) & seen(scene, surfaces, head, position)
    visible = np.zeros(len(points), dtype=bool)
    visible[passed] = shone
    return visible


def passing_mm(head: Head, points_world: Floats, sheet: TrueSheet = ALIGNED) -> Floats:
    """(N,) track positions at which a sheet passes through (N, 3) points of the world.

    sheet: the head's plane y = 0 if left out.  About a shaft a flat sheet passes a point twice
    in a turn: the position nearer to 0 is given, NaN where it never does.  Raises InputError
    for a bowed sheet about a shaft.
    """
    if head.shaft is not None:
        turned = replace(sheet, pose=seat_pose(head) @ sheet.pose)
        points_track = track_pose(head, 0.0).invert(points_world - head.shift_mm)
        return _turning_past_mm(head.shaft, points_track, turned)
    plane = head_pose(head, 0.0) @ sheet.pose
    normal = plane.rotation[:, 1]
    flat = (points_world @ normal - plane.origin_mm @ normal) / normal[1]
    if sheet.bow is None:
        return flat

    def clearance(position: Floats, *points: Floats) -> Floats:
        return sheet.clearance_mm(into_head(head, np.column_stack(points), position))

    bulge = 2 * np.abs(clearance(flat, *points_world.T) / normal[1]) + SELF_MM
    bracket = (flat - bulge, flat + bulge)
    return np.asarray(find_root(clearance, bracket, args=tuple(points_world.T)).x)


def _turning_past_mm(shaft: TrueShaft, points_mm: Floats, sheet: TrueSheet) -> Floats:
    """(N,) arcs at which a flat sheet passes through (N, 3) points of the head frame of arc 0.

    The head turned by a sees q = X - p at q_along + cos(a) q_across - sin(a) d x q, so that the
    sheet's plane is met where A cos a + B sin a = C.
    """
    if sheet.bow is not None or shaft.arc_radius_mm is None:
        raise InputError("no passing of a bowed sheet about a shaft", where="laser.port_tilt_deg")
    normal = sheet.pose.rotation[:, 1]
    point = np.array(shaft.point_mm)
    direction = np.array(shaft.direction) / np.linalg.norm(shaft.direction)
    offset = points_mm - point
    along = np.outer(offset @ direction, direction)
    even, odd = (offset - along) @ normal, -np.cross(direction, offset) @ normal
    rest = (sheet.pose.origin_mm - point) @ normal - along @ normal
    reach = np.hypot(even, odd)
    met = reach > np.abs(rest)
    ratio = np.divide(rest, reach, out=np.full(len(rest), np.nan), where=met)
    middle, half = np.arctan2(odd, even), np.arccos(ratio)
    angles = (np.stack([middle - half, middle + half]) + np.pi) % (2 * np.pi) - np.pi
    nearer = np.abs(angles[0]) <= np.abs(angles[1])
    return np.asarray(np.where(nearer, angles[0], angles[1]) * shaft.arc_radius_mm)


def apex_xz(laser: Laser) -> Floats:
    """(2,) of (x, z): the laser's apex, mm, in the plane of each of its sheets.

    Parameters
    ----------
    laser : Laser
    """
    return np.array([laser.apex_mm[0], laser.apex_mm[2]])
