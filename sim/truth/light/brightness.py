"""How bright the true line is in its picture, and how far it stands out of the noise.

The light of the line's middle (sim.truth.light.radiance), spread by lens and pixel, in the grey
values of the channel that the instrument reads.  Left out are light that the water or other
surfaces throw onto the line, the blur of a moving head, and what a colour filter's interpolation
and JPEG do: a line they blur is lower.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import ndtr

from lscan.records import Floats, Status
from sim.scene import PlanePort, Scene
from sim.scene.instrument import FULL_SCALE_DN, Response
from sim.scene.matter import AmbientLight, Penumbra
from sim.sensor.radiometry import AMBIENT_NM, photons_per_radiance, speckle_contrast
from sim.truth.camera.flat import flat_normal
from sim.truth.camera.projection import TrueCamera, camera_of, project, rays_to
from sim.truth.light.radiance import line_in_space, line_radiance, port_weight
from sim.truth.light.reflection import LineInSpace, Reflectance, reflectance_of
from sim.truth.sheet import TrueSheet, sheet_of
from sim.truth.stripe import StripeTruth
from sim.truth.target.section import surfaces_of
from sim.truth.visibility import apex_xz
from sim.water import water_optics

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
    distance = np.linalg.norm(sheet.flattened(line.points) - apex_xz(scene.tank.laser), axis=1)
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
    albedo = albedo * _unshaded(sky.penumbra, line.places[:, 0]) * _level(sky, line.places)
    mean = 1 / extinction - way / np.expm1(extinction * way)
    veil = _level(sky, line.places + (way - mean)[:, np.newaxis] * line.to_camera)
    light = sky.ambient_w_m2_sr * (albedo * left + turned * (1 - left) * veil)
    return light * port_weight(camera, line.direction)


def _level(light: AmbientLight, places: Floats) -> Floats:
    """(N,) ambient light at (N, 3) places of the world over that in its gradient's middle."""
    off_m = (places - np.array(light.centre_mm)) / MM_PER_M
    return np.maximum(1 + off_m @ np.array(light.gradient_per_m), 0.0)


def _unshaded(penumbra: Penumbra | None, x_mm: Floats) -> Floats:
    """(N,) share of the ambient light that reaches places of the world frame."""
    if penumbra is None:
        return np.ones_like(x_mm)
    outward = -1 if penumbra.side == "right" else 1
    lit = ndtr(outward * (x_mm - penumbra.x_mm) / penumbra.width_mm)
    share: Floats = penumbra.left + (1 - penumbra.left) * lit
    return share


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
    offset; rounding to whole DN adds 1/12 DN2.  speckle_e: (3, N) electrons, in step in all
    colours.
    """
    sensor, slope = scene.tank.sensor, _grey(scene, electrons)[1]
    variance = np.full(electrons.shape[1], float(weights**2 @ np.full(3, 1 / 12)))
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
