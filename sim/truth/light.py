"""How bright the true line is in its picture, and how far it stands out of the noise.

The light of the line's middle (sim.truth.light), spread by lens and pixel, in the grey
values of the channel that the instrument reads.  Left out are light that the water or other
surfaces throw onto the line, the blur of a moving head, and what a colour filter's interpolation
and JPEG do: a line they blur is lower.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh
from scipy.ndimage import map_coordinates
from scipy.special import erf, ndtr, roots_legendre

from lscan.records import Floats, Ints, Mask, Status
from sim.meshes import Paint, reflectance_at, target_parts
from sim.scene import Laser, LaserLine, PlanePort, Scene, head_pose, into_world, target_pose
from sim.scene.instrument import FULL_SCALE_DN, Response
from sim.scene.matter import AmbientLight, Penumbra
from sim.sensor.radiometry import AMBIENT_NM, photons_per_radiance, speckle_contrast
from sim.truth.camera import TrueCamera, camera_of, flat_normal, project, rays_to
from sim.truth.sheet import TrueSheet, sheet_of
from sim.truth.stripe import StripeTruth, row_positions_mm
from sim.truth.surfaces import Mesh, TankSurface, surfaces_of
from sim.truth.visibility import apex_xz, fan_angle
from sim.water import water_optics

# How much of the laser's light the surfaces send towards the camera: albedo and finish.
#
# Written anew from the literature; the tank renders Mitsuba's own materials.


FRESNEL_NODES = 64  # of the mean over a hemisphere: good to 1e-4


@dataclass(frozen=True)
class LineInSpace:
    """N points of the scene's surfaces under the laser, seen by the camera.

    face: (N,) index into ``surfaces_of(scene)``.  points, entry: (N, 3) head frame, mm, the points
    and where the camera's rays to them enter the water.  direction: (N, 3) of these rays in the
    air, camera frame, of any length.  normals: (N, 3) unit, head frame, to either side.
    places: (N, 3) the points in the world frame, mm.  world_normals, to_laser, to_camera: (N, 3)
    unit vectors there.
    """

    face: Ints
    points: Floats
    entry: Floats
    direction: Floats
    normals: Floats
    places: Floats
    world_normals: Floats
    to_laser: Floats
    to_camera: Floats


@dataclass(frozen=True)
class Reflectance:
    """What the surfaces of a scene reflect at the laser's wavelength.

    albedo: of the target where its paint is white.  paint: of the target's first painted part.
    """

    scene: Scene
    surfaces: Sequence[TankSurface]
    albedo: float
    paint: Paint | None

    def albedo_at(self, face: Ints, places: Floats) -> Floats:
        """(N,) albedo at (N, 3) places of the world; a board's marks are taken for its ground."""
        floor = self._is_on_floor(face)
        albedo = np.full(len(face), self.albedo)
        if self.paint is not None:
            albedo[~floor] *= self._level(places[~floor])
        if self.scene.tank.floor is not None:
            albedo[floor] = self.scene.tank.floor.albedo
        return albedo

    def towards_camera(self, line: LineInSpace) -> Floats:
        """(N,) radiance towards the camera per irradiance across the light's way, 1/sr."""
        albedo = self.albedo_at(line.face, line.places)
        to_laser = np.einsum("ij,ij->i", line.world_normals, line.to_laser)
        to_camera = np.einsum("ij,ij->i", line.world_normals, line.to_camera)
        cosines = np.abs(to_laser), np.abs(to_camera)
        half = line.to_laser + line.to_camera
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        tilt = np.abs(np.einsum("ij,ij->i", line.world_normals, half))
        light = albedo / np.pi * cosines[0]
        target = self.scene.tank.target
        if target.finish != "matt":
            index = water_optics(self.scene.tank.water, self.scene.tank.laser.wavelength_nm).index
            glint = facets(*cosines, tilt, target.roughness)
            if target.finish == "mirror":
                finished = albedo * glint
            else:
                between = np.einsum("ij,ij->i", half, line.to_laser)
                ratio = target.coat_index / index
                finished = fresnel(between, ratio) * glint + coated_radiance(
                    albedo, *cosines, ratio
                )
            light = np.where(self._is_on_floor(line.face), light, finished)
        return np.where(to_laser * to_camera > 0, light, 0.0)

    def _is_on_floor(self, face: Ints) -> Mask:
        """(N,) whether a face is the floor: it comes after all of the target's."""
        if self.scene.tank.floor is None:
            return np.zeros(len(face), dtype=bool)
        return face == len(self.surfaces) - 1

    def _level(self, places: Floats) -> Floats:
        """(N,) how bright the paint is at (N, 3) places of the target."""
        assert self.paint is not None
        target, own = self.scene.tank.target, target_pose(self.scene).invert(places)
        if target.shape == "mesh":
            mesh = self.surfaces[0]
            assert isinstance(mesh, Mesh)
            triangle = mesh.triangles_at(places)
            share = trimesh.triangles.points_to_barycentric(mesh.mesh.triangles[triangle], places)
            uv = np.einsum("nk,nkj->nj", share, self.paint.uv[mesh.mesh.faces[triangle]])
        else:
            assert target.texture is not None
            plan = own[:, (0, 2)] if target.shape == "board" else own[:, :2]
            uv = (plan - np.array(target.texture.corner_mm)) / np.array(target.texture.size_mm)
        height, width = self.paint.levels.shape
        at = [(1 - uv[:, 1]) * height - 0.5, uv[:, 0] * width - 0.5]
        return np.asarray(map_coordinates(self.paint.levels, at, order=1, mode="grid-wrap"))


def reflectance_of(scene: Scene, surfaces: Sequence[TankSurface]) -> Reflectance:
    """What the scene's surfaces reflect; InputError where a file of theirs cannot be read.

    surfaces: those of ``surfaces_of(scene)``.
    """
    target = scene.tank.target
    where = f"{scene.source}: target.albedo"
    albedo = reflectance_at(target.albedo, scene.tank.laser.wavelength_nm, where)
    painted = target.shape == "mesh" or target.texture is not None
    paints = [part.paint for part in target_parts(scene) if part.paint] if painted else []
    return Reflectance(scene, surfaces, albedo, paints[0] if paints else None)


def facets(to_laser: Floats, to_camera: Floats, tilt: Floats, roughness: float) -> Floats:
    """(N,) light that a rough mirror sends to the camera, per irradiance across its way, 1/sr.

    Beckmann's distribution of the facets' slopes and Smith's shading of one by another.
    to_laser, to_camera, tilt: (N,) cosines to the normal, of either way and of their middle.

    References
    ----------
    B. Walter, S. Marschner, H. Li, K. Torrance, Microfacet models for refraction through rough
    surfaces, Eurographics Symposium on Rendering (2007) 195.
    """
    steep = (1 - tilt**2) / tilt**2 / roughness**2
    density = np.exp(-steep) / (np.pi * roughness**2 * tilt**4)
    free = _smith_g1(to_laser, roughness) * _smith_g1(to_camera, roughness)
    return density * free / (4 * np.maximum(to_camera, np.finfo(float).tiny))


def _smith_g1(cosine: Floats, roughness: float) -> Floats:
    """(N,) share of the facets that nothing shades, seen under a cosine: Smith's G1."""
    level = np.sqrt(np.maximum(1 - cosine**2, 1e-30))
    a = np.minimum(cosine / (roughness * level), 1e6)
    return 2 / (1 + erf(a) + np.exp(-(a**2)) / (np.maximum(a, 1e-12) * np.sqrt(np.pi)))


def coated_radiance(albedo: Floats, to_laser: Floats, to_camera: Floats, ratio: float) -> Floats:
    """(N,) light from the matt ground under a smooth coat, per irradiance across its way, 1/sr.

    ratio: the coat's index over the water's.  Light goes to and fro between ground and coat.

    References
    ----------
    J. L. Saunderson, Calculation of the color of pigmented plastics, J. Opt. Soc. Am. 32 (1942)
    727.
    """
    nodes, weights = roots_legendre(FRESNEL_NODES)
    cosine = (nodes + 1) / 2
    # What the coat holds back inside: 1 - R_in = (1 - R_out) / ratio^2, by reciprocity.
    outside = float(weights @ (cosine * fresnel(cosine, ratio)))
    inside = 1 - (1 - outside) / ratio**2
    through = (1 - fresnel(to_laser, ratio)) * (1 - fresnel(to_camera, ratio)) / ratio**2
    return through * albedo / (1 - albedo * inside) / np.pi * to_laser


def fresnel(cosine: Floats, ratio: float) -> Floats:
    """(N,) share of unpolarised light that a smooth face reflects (Born & Wolf sec. 1.5.2).

    cosine: (N,) of the angle of incidence.  ratio: index behind the face over that before it;
    1 where no light gets through.
    """
    behind = np.sqrt(np.maximum(1 - (1 - cosine**2) / ratio**2, 0.0))
    across = (cosine - ratio * behind) / (cosine + ratio * behind)
    along = (ratio * cosine - behind) / (ratio * cosine + behind)
    return np.asarray((across**2 + along**2) / 2)


# What reaches the lens from the middle of the line: the laser's power on its way there.


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
    xz = sheet.flatten(points)
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


# How bright the true line is in its picture, and how far it stands out of the noise.


STEP_MM = 0.01  # of differences: the projection's third derivative costs 1e-9 of a slope
MM_PER_M = 1000.0
TRANSPARENT_PER_MM = 1e-12  # water that takes less stands for none
PIXEL_VARIANCE = 1 / 12  # px2, of the place within a pixel
CHANNELS = {
    "red": (1.0, 0.0, 0.0),
    "green": (0.0, 1.0, 0.0),
    "blue": (0.0, 0.0, 1.0),
    "grey": (0.299, 0.587, 0.114),  # ITU-R BT.601
}


@dataclass(frozen=True)
class LineBrightness:
    """The true line's brightness, one entry per column (or row); NaN where its status is not OK.

    Attributes
    ----------
    height_dn : (N,) array, DN, by which the line's brightest pixel is expected above those beside
        the line: what ``stripe.threshold_dn`` is held against
    noise_dn : (N,) array, DN, standard deviation of a pixel beside the line: dark and shot noise,
        the pixels' differences, rounding
    height_sigma_dn : (N,) array, DN, standard deviation of the brightest pixel, speckle and the
        line's own shot noise included
    width_px : (N,) array, px, standard deviation of the line across, without the lens's glare
    snr : (N,) array, height_dn over noise_dn; the highest of 480 pixels of pure noise stands out of
        it by 3.0 (the mean of the largest of 480 normal numbers): below, a line is lost in noise
    """

    height_dn: Floats
    noise_dn: Floats
    height_sigma_dn: Floats
    width_px: Floats

    @property
    def snr(self) -> Floats:
        """(N,) signal to noise."""
        return self.height_dn / self.noise_dn


def line_brightness(
    scene: Scene, truths: Sequence[StripeTruth], exposures_ms: Sequence[float] | None = None
) -> list[LineBrightness]:
    """How bright each of the true lines is in its picture.

    Where the line has an end or an edge nearer than the lens blurs (``edge_px``) it is lower than
    said, by up to half.  On sand each point counts with the facet it lies on.  A board's marks
    count as its ground.

    Parameters
    ----------
    scene, truths
        The scene, and true lines of it.
    exposures_ms
        Of their pictures; the rig's if None.

    Returns
    -------
    One record for each of ``truths``.

    Raises
    ------
    InputError
        Where a file of the target's cannot be read.
    """
    reflectance = reflectance_of(scene, surfaces_of(scene))
    if exposures_ms is None:
        exposures_ms = [scene.rig.camera.exposure_ms] * len(truths)
    pairs = zip(truths, exposures_ms, strict=True)
    return [_brightness(scene, reflectance, truth, exposure) for truth, exposure in pairs]


def _brightness(
    scene: Scene, reflectance: Reflectance, truth: StripeTruth, exposure_ms: float
) -> LineBrightness:
    shown = truth.status == Status.OK
    sheet = sheet_of(scene, truth.line)
    line = line_in_space(scene, reflectance.surfaces, truth)
    radiance = line_radiance(scene, reflectance, line, sheet, truth.line)
    light, width_px = brightest_pixel(scene, line, sheet, truth)
    ambient = _ambient(scene, reflectance, line)
    entries = np.full((4, len(shown)), np.nan)
    entries[:3, shown] = _in_grey_values(scene, radiance * light, ambient, line, exposure_ms)
    entries[3, shown] = width_px
    return LineBrightness(*entries)


def brightest_pixel(
    scene: Scene, line: LineInSpace, sheet: TrueSheet, truth: StripeTruth
) -> tuple[Floats, Floats]:
    """(N,) light of the brightest pixel across the line, over that of its unblurred middle; and
    (N,) px, standard deviation of what the core of the point spread makes of the line.

    A straight line, Gaussian across: its variance grows by the point spread's (core and glare
    each with their share), and by that of the pixel along the line; across it the Gaussian is
    integrated over the pixel that the line's centre lies in.
    """
    lens, camera = scene.tank.lens, camera_of(scene)
    per_px = offset_per_px(scene, line, sheet)
    along, across = (0, 1) if truth.axis == "columns" else (1, 0)
    steep = np.linalg.norm(per_px, axis=1)
    distance = np.linalg.norm(sheet.flatten(line.points) - apex_xz(scene.tank.laser), axis=1)
    width = scene.tank.laser.half_thickness_mm(distance, camera.water_index) / 2 / steep
    lean2 = (per_px[:, along] / per_px[:, across]) ** 2
    centre = truth.centre_px[truth.status == Status.OK]
    aside = centre - np.rint(centre)
    defocus = defocus_variance(scene, camera, line)
    light, sigmas = np.zeros(len(centre)), []
    for share, blur in ((1 - lens.glare, lens.blur_px), (lens.glare, lens.glare_px)):
        blurred2 = (width**2 + blur**2 + defocus) * (1 + lean2)
        sigma = np.sqrt(blurred2 + PIXEL_VARIANCE * lean2)
        sigmas.append(sigma)
        inside = ndtr((aside + 0.5) / sigma) - ndtr((aside - 0.5) / sigma)
        # sqrt(2 pi) times the standard deviation across, unblurred: the light of a column.
        light += share * np.sqrt(2 * np.pi * (1 + lean2)) * width * inside
    return light, sigmas[0]


def offset_per_px(scene: Scene, line: LineInSpace, sheet: TrueSheet) -> Floats:
    """(N, 2) mm by which the surface leaves the sheet's middle per px of u and of v.

    Along the tangent plane, by differences of the projection and of the sheet's clearance.

    Parameters
    ----------
    scene : Scene, its camera sees the line
    line : LineInSpace, N points, head frame, with the surface's normals there
    sheet : TrueSheet, the line's, head frame
    """
    first = np.cross(line.normals, np.eye(3)[np.abs(line.normals).argmin(axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    pixels, leaves = [], []
    for tangent in (first, np.cross(line.normals, first)):
        ahead, behind = (line.points + sign * STEP_MM * tangent for sign in (1, -1))
        pixels.append((project(scene, ahead) - project(scene, behind)) / (2 * STEP_MM))
        leaves.append((sheet.clearance_mm(ahead) - sheet.clearance_mm(behind)) / (2 * STEP_MM))
    # Seen edge on there is no inverse.
    return (np.linalg.pinv(np.stack(pixels, axis=1)) @ np.stack(leaves, axis=1)[..., None])[..., 0]


def defocus_variance(scene: Scene, camera: TrueCamera, line: LineInSpace) -> Floats:
    """(N,) variance along an axis, px2, of the disc that a point out of focus is spread over.

    The pupil, moved by d, sees the point in another direction t; a point in focus, at the
    distance F in air, is where t changes by -d/F.  A disc's variance is its radius squared over 4.
    """
    lens = camera.lens
    if lens.focus_mm is None:
        return np.zeros(len(line.points))
    aperture_mm = lens.focal_px * scene.tank.sensor.pixel_um * 1e-3 / lens.f_number
    seen = []
    for move in (STEP_MM, -STEP_MM):
        step = np.array([move, 0.0, 0.0])
        nearer: dict[str, Any]
        if isinstance(camera.port, PlanePort):
            nearer = {"gap_mm": camera.port.gap_mm - float(step @ flat_normal(camera.port))}
        else:
            nearer = {"centre_mm": tuple(np.array(camera.port.centre_mm) - step)}
        moved = replace(camera, port=camera.port.model_copy(update=nearer))
        shifted = line.points - camera.pose.rotation @ step
        direction = rays_to(moved, shifted).direction
        seen.append(direction[:, 0] / direction[:, 2])
    change = (seen[0] - seen[1]) / (2 * STEP_MM) + 1 / lens.focus_mm
    return (lens.focal_px * aperture_mm * change / 2) ** 2 / 4


def _ambient(scene: Scene, reflectance: Reflectance, line: LineInSpace) -> Floats:
    """(N,) radiance beside the line in the air behind the port, W/(m2 sr), of ambient light.

    As if nothing stood between the sky and the surface; the water adds its own, as much as at the
    mean distance of what it sends along the way.
    """
    camera, sky = camera_of(scene), scene.tank.light
    water = water_optics(scene.tank.water, scene.tank.laser.wavelength_nm)
    way = np.linalg.norm(line.points - line.entry, axis=1)
    extinction = max(water.extinction_per_mm, TRANSPARENT_PER_MM)
    left = np.exp(-water.extinction_per_mm * way)
    turned = water.scattering_per_mm / extinction
    albedo = reflectance.albedo_at(line.face, line.places)
    albedo = albedo * _ambient_share(sky.penumbra, line.places[:, 0]) * _level(sky, line.places)
    mean = 1 / extinction - way / np.expm1(extinction * way)
    veil = _level(sky, line.places + (way - mean)[:, np.newaxis] * line.to_camera)
    light = sky.ambient_w_m2_sr * (albedo * left + turned * (1 - left) * veil)
    return light * port_weight(camera, line.direction)


def _level(light: AmbientLight, places: Floats) -> Floats:
    """(N,) ambient light at (N, 3) places of the world over that in its gradient's middle."""
    off_m = (places - np.array(light.centre_mm)) / MM_PER_M
    return np.maximum(1 + off_m @ np.array(light.gradient_per_m), 0.0)


def _ambient_share(penumbra: Penumbra | None, x_mm: Floats) -> Floats:
    """(N,) share of the ambient light that reaches places of the world frame."""
    if penumbra is None:
        return np.ones_like(x_mm)
    outward = -1 if penumbra.side == "right" else 1
    lit = ndtr(outward * (x_mm - penumbra.x_mm) / penumbra.width_mm)
    return penumbra.left + (1 - penumbra.left) * lit


def _in_grey_values(
    scene: Scene, peak: Floats, ambient: Floats, line: LineInSpace, exposure_ms: float
) -> tuple[Floats, Floats, Floats]:
    """(N,) height, noise beside the line and noise of the brightest pixel, DN.

    peak, ambient: (N,) radiance in W/(m2 sr) of the line's brightest pixel, and beside it.
    """
    lens, sensor, nm = scene.tank.lens, scene.tank.sensor, scene.tank.laser.wavelength_nm
    cosine = line.direction[:, 2] / np.linalg.norm(line.direction, axis=1)

    def electrons(light: Floats, wavelength_nm: float, of: Response) -> Floats:
        photons = photons_per_radiance(lens, sensor, exposure_ms, wavelength_nm)
        return np.outer([of.red, of.green, of.blue], cosine**lens.vignetting * light * photons)

    beside = electrons(ambient, AMBIENT_NM, sensor.ambient_response)
    laser = electrons(peak, nm, sensor.laser_response)
    weights = np.array(CHANNELS[scene.rig.stripe.colour])
    height = weights @ (_grey(scene, beside + laser)[0] - _grey(scene, beside)[0])
    contrast = 0.0
    if sensor.speckle != "none" and sensor.noise:
        contrast = speckle_contrast(sensor.pixel_um, lens.f_number, nm, sensor.speckle)
    noise = _noise_dn(scene, weights, beside, 0.0 * laser)
    return height, noise, _noise_dn(scene, weights, beside + laser, contrast * laser)


def _noise_dn(scene: Scene, weights: Floats, electrons: Floats, speckle_e: Floats) -> Floats:
    """(N,) standard deviation in DN of pixels that expect (3, N) electrons.

    EMVA 1288: shot noise of the electrons, dark noise, their differences in sensitivity and
    offset; rounding to steps of s DN adds s2/12 DN2.  speckle_e: (3, N) electrons, in step in all
    colours.
    """
    sensor, slope = scene.tank.sensor, _grey(scene, electrons)[1]
    rounding = scene.rig.camera.step_dn**2 / 12
    variance = np.full(electrons.shape[1], float(weights**2 @ np.full(3, rounding)))
    if sensor.noise:
        own = electrons + sensor.dark_noise_e**2 + sensor.dsnu_e**2
        own = own + (sensor.prnu * electrons) ** 2
        variance += weights**2 @ (slope**2 * own) + (weights @ (slope * speckle_e)) ** 2
    return np.sqrt(variance)


def _grey(scene: Scene, electrons: Floats) -> tuple[Floats, Floats]:
    """Grey values, not rounded, of (3, N) electrons, and DN per electron there."""
    sensor = scene.tank.sensor
    gain = np.where(electrons > sensor.full_well_e, 0.0, sensor.gain / sensor.full_well_e)
    held = np.minimum(electrons, sensor.full_well_e) * sensor.gain / sensor.full_well_e
    most = (sensor.clips_dn / FULL_SCALE_DN) ** sensor.gamma
    linear = np.minimum(sensor.black_level_dn / FULL_SCALE_DN + held, most)
    slope = gain * np.maximum(linear, 1 / FULL_SCALE_DN) ** (1 / sensor.gamma - 1) / sensor.gamma
    return FULL_SCALE_DN * linear ** (1 / sensor.gamma), FULL_SCALE_DN * slope
