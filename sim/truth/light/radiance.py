"""What reaches the lens from the middle of the line: the laser's power on its way there."""

from collections.abc import Sequence

import numpy as np

from lscan.records import Floats, Status
from sim.scene import Laser, LaserLine, PlanePort, Scene, head_pose, into_world
from sim.truth.camera.flat import flat_normal
from sim.truth.camera.projection import TrueCamera, camera_of, rays_to
from sim.truth.light.reflection import LineInSpace, Reflectance, fresnel
from sim.truth.sheet import TrueSheet
from sim.truth.shutter import row_positions_mm
from sim.truth.stripe import StripeTruth
from sim.truth.target.surfaces import TankSurface
from sim.truth.visibility import apex_xz, fan_angle
from sim.water import water_optics

FAN_STEPS = 2001  # of the fan's power, whose sum over them is the laser's
W_PER_M2_IN_MW_PER_MM2 = 1e3


def line_in_space(scene: Scene, surfaces: Sequence[TankSurface], truth: StripeTruth) -> LineInSpace:
    """The line's OK columns, the head where it is when they are exposed.

    Parameters
    ----------
    scene : Scene, its head moves along the track
    surfaces : sequence, those of ``surfaces_of(scene)``, world frame
    truth : StripeTruth, the line in the picture

    Returns
    -------
    LineInSpace
        N points, as many as the line has columns that are OK.
    """
    shown = truth.status == Status.OK
    rows = truth.centre_px if truth.axis == "columns" else np.arange(len(shown), dtype=float)
    positions_mm = row_positions_mm(scene, truth.position_mm, rows[shown])
    points = np.column_stack([truth.xz_mm[:, 0], truth.y_mm, truth.xz_mm[:, 1]])[shown]
    camera, face, head = camera_of(scene), truth.face[shown], scene.tank.head
    rays = rays_to(camera, points)
    entry = camera.pose.apply(rays.entry_mm)
    places = into_world(head, points, positions_mm)
    apex = np.broadcast_to(np.array(scene.tank.laser.apex_mm), points.shape)
    normals = np.empty_like(points)
    for number, surface in enumerate(surfaces):
        normals[face == number] = surface.normals(places[face == number])
    return LineInSpace(
        face=face,
        points=points,
        entry=entry,
        direction=rays.direction,
        normals=normals @ head_pose(head, truth.position_mm).rotation,
        places=places,
        world_normals=normals,
        to_laser=_unit(into_world(head, apex, positions_mm) - places),
        to_camera=_unit(into_world(head, entry, positions_mm) - places),
    )


def line_radiance(
    scene: Scene, reflectance: Reflectance, line: LineInSpace, sheet: TrueSheet, number: int
) -> Floats:
    """Radiance of the line's middle, not yet blurred by the lens.

    Straight from the laser and straight to the camera: what the water or other surfaces throw
    there is left out.

    Parameters
    ----------
    scene, reflectance, line
        The scene, what its surfaces reflect, and N points of a line in it.
    sheet, number
        The sheet that lights them, and its number among ``laser.sheets``.

    Returns
    -------
    (N,) W/(m2 sr), in the air behind the port.
    """
    laser, camera = scene.tank.laser, camera_of(scene)
    extinction = water_optics(scene.tank.water, laser.wavelength_nm).extinction_per_mm
    way = np.linalg.norm(line.points - np.array(laser.apex_mm), axis=1)
    way = way + np.linalg.norm(line.points - line.entry, axis=1)
    light = irradiance(laser, laser.sheets[number], sheet, line.points, camera.water_index)
    light = light * W_PER_M2_IN_MW_PER_MM2 * np.exp(-extinction * way)
    return light * reflectance.towards_camera(line) * port_weight(camera, line.direction)


def irradiance(
    laser: Laser, line: LaserLine, sheet: TrueSheet, points: Floats, water_index: float
) -> Floats:
    """Irradiance in the sheet's middle, across the light's way; without the water's loss.

    The fan's power per radian, over the arc at that distance, over the sheet's Gaussian.

    Parameters
    ----------
    laser, line, sheet
        The laser, one of its lines, and where that lies.
    points
        (N, 3) of the head frame, mm.
    water_index
        Relative to air.

    Returns
    -------
    (N,) mW/mm2.
    """
    xz = sheet.flattened(points)
    half = np.radians(laser.fan_half_angle_deg)
    angle = np.linspace(-half, half, FAN_STEPS)
    power = laser.power_mw * line.share / np.trapezoid(_fan(laser, angle), angle)
    density = power * _fan(laser, fan_angle(laser, xz))
    distance = np.linalg.norm(xz - apex_xz(laser), axis=1)
    thickness = np.sqrt(np.pi / 2) * laser.half_thickness_mm(distance, water_index)
    return density / distance / thickness


def port_weight(camera: TrueCamera, direction: Floats) -> Floats:
    """(N,) radiance in the air over that in the water, of rays in directions (N, 3), camera frame.

    Both faces transmit as Fresnel says, unpolarised; radiance over the index squared is the same
    along a ray.
    """
    port, towards = camera.port, _unit(direction)
    glass, water = float(port.glass_index), camera.water_index
    if isinstance(port, PlanePort):
        sine = np.linalg.norm(np.cross(towards, flat_normal(port)), axis=1)
        sines = sine, sine
    else:
        # Index times the sine at each face, from the distance at which the ray passes the centre.
        passing = np.linalg.norm(np.cross(towards, np.array(port.centre_mm)), axis=1)
        sines = passing / port.radius_mm, passing / (port.radius_mm + port.thickness_mm)
    inner = 1 - fresnel(np.sqrt(1 - sines[0] ** 2), glass)
    outer = 1 - fresnel(np.sqrt(1 - (sines[1] / glass) ** 2), water / glass)
    return np.asarray(inner * outer / water**2)


def _fan(laser: Laser, angle: Floats) -> Floats:
    """(N,) the fan's power per angle, of any scale."""
    relative = angle / np.radians(laser.fan_half_angle_deg)
    if laser.fan == "gaussian":
        return np.asarray(np.exp(-2 * relative**2))
    return 1 + laser.fan_rise * relative**2


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
