"""Profiles, the surface they are stacked to, and slices of it."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.spatial import cKDTree

from lscan.calibration.planemap import PlaneMap
from lscan.camera.optics import stated_water
from lscan.config.documents import Strict
from lscan.config.plugins import with_package
from lscan.config.rig import Rig
from lscan.errors import InputError, MeasurementError
from lscan.records import (
    Floats,
    Ints,
    Mask,
    PlanePoints,
    Profile,
    Provenance,
    Status,
    Stripe,
    Surface,
    has_value,
    select,
)

# From the stripe in a picture to the profile in the laser sheet.


def to_profile(stripe: Stripe, plane_map: PlaneMap, position_mm: float) -> Profile:
    """The scan line in the sheet of the head at a track position.

    A point without a value in the stripe keeps the stripe's status, and so does a clipped
    one (SATURATED) that the map can place; every other has the map's.  The map combines the
    stripe's sigma_px with its own uncertainty, and its modes are passed on; like the numbers
    they are NaN where there is no value.

    Parameters
    ----------
    stripe : Stripe, px, of N entries
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    position_mm : float, mm, of the track

    Returns
    -------
    Profile
        Of N points (x, z), mm, frame of the sheet, in the stripe's order.

    Raises
    ------
    InputError
        Where ``position_mm`` is not finite.
    """
    return to_profiles([stripe], plane_map, [position_mm])[0]


def to_profiles(
    stripes: Sequence[Stripe], plane_map: PlaneMap, positions_mm: Sequence[float]
) -> list[Profile]:
    """The scan lines of several pictures, as :func:`to_profile` gives each, all mapped at once.

    Parameters
    ----------
    stripes : sequence of Stripe, px, one or more
    plane_map : PlaneMap, from the pixels of that camera to the laser sheet
    positions_mm : sequence of float, mm, of the track, one for each

    Raises
    ------
    InputError
        Where a position is not finite.
    """
    for position_mm in positions_mm:
        if not np.isfinite(position_mm):
            raise InputError("track position is not finite", where="to_profile", value=position_mm)
    pixels, sigma_px = ([stripe.image_px for stripe in stripes], [s.sigma_px for s in stripes])
    mapped = plane_map.to_plane(np.concatenate(pixels), np.concatenate(sigma_px))
    points = _with_stripe_status(np.concatenate([stripe.status for stripe in stripes]), mapped)
    profiles, first = [], 0
    for stripe, position_mm in zip(stripes, positions_mm, strict=True):
        part = slice(first, first + len(stripe.status))
        brightness = stripe.peak if stripe.flux is None else stripe.flux
        profiles.append(Profile(float(position_mm), select(points, part), brightness))
        first = part.stop
    return profiles


def _with_stripe_status(found: Ints, mapped: PlanePoints) -> PlanePoints:
    """The points that a map has placed, with what the stripe says of them."""
    status = np.where(~has_value(found) | (mapped.status == Status.OK), found, mapped.status)
    valued = has_value(status)[:, None]
    return PlanePoints(
        xz_mm=np.where(valued, mapped.xz_mm, np.nan),
        sigma_mm=np.where(valued, mapped.sigma_mm, np.nan),
        status=status,
        modes_mm=(
            None
            if mapped.modes_mm is None
            else np.where(valued[..., None], mapped.modes_mm, np.nan)
        ),
    )


# Profiles stacked into a surface.


def stack(profiles: Sequence[Profile]) -> Surface:
    """The raw surface of F profiles of N points each, in the order given.

    Frame "head": a point is (x, s, z) in mm, where x and z lie in the laser sheet and s is
    the track position of its profile.  This is not yet the true shape where the sheet is
    yawed against the track: see :func:`lscan.surface.alignment.shear`.

    Parameters
    ----------
    profiles : sequence of Profile, mm, frame of the sheet

    Returns
    -------
    Surface
        Its modes_mm are the profiles' own, nothing common in y, in single precision; None unless
        every profile has them.

    Raises
    ------
    InputError
        Where there is no profile, where the profiles differ in length or in their number of modes,
        or where a track position is not finite.
    """
    if not profiles:
        raise InputError("no profiles to stack", where="surface", allowed="one or more")
    _require_one("length", {len(profile.points.status) for profile in profiles}, "one length")
    position = np.array([profile.position_mm for profile in profiles], dtype=float)
    if not np.isfinite(position).all():
        where = f"profile {int(np.argmin(np.isfinite(position)))}"
        raise InputError("track position is not finite", where=where, allowed="a number of mm")
    status = np.stack([profile.points.status for profile in profiles])
    xz = np.stack([profile.points.xz_mm for profile in profiles])
    sigma = np.stack([profile.points.sigma_mm for profile in profiles])
    track = np.where(np.isfinite(xz[..., 0]), position[:, None], np.nan)
    return Surface(
        xyz_mm=np.stack([xz[..., 0], track, xz[..., 1]], axis=-1),
        sigma_x_mm=sigma[..., 0],
        sigma_z_mm=sigma[..., 1],
        status=status,
        position_mm=position,
        modes_mm=_modes(profiles),
        brightness=np.stack([profile.brightness for profile in profiles]),
    )


def require_head_frame(surface: Surface) -> None:
    """InputError for a surface that is not in the head frame.

    Parameters
    ----------
    surface : Surface
    """
    if surface.frame != "head":
        what = "is aligned already"
        allowed = "the head frame, as of a rig that names no sandwave in [workpiece]"
        raise InputError(what, where="surface", value=surface.frame, allowed=allowed)


def _require_one(what: str, found: set[int], allowed: str) -> None:
    """InputError where the profiles differ in ``what``."""
    if len(found) > 1:
        message = f"profiles differ in {what}"
        raise InputError(message, where="surface", value=sorted(found), allowed=allowed)


def _modes(profiles: Sequence[Profile]) -> NDArray[np.float32] | None:
    """(F, N, 3, M) modes of x, y and z."""
    modes = [profile.points.modes_mm for profile in profiles]
    known = [mode for mode in modes if mode is not None]
    if len(known) < len(modes):
        return None
    counts = {mode.shape[2] for mode in known}
    _require_one("their number of modes", counts, "one calibration")
    stacked = np.zeros((len(known), len(known[0]), 3, *counts), dtype=np.float32)
    for row, mode in zip(stacked, known, strict=True):
        row[:, [0, 2]] = mode
    # y is the track's, without error, but holds no number where there is no point.
    stacked[:, :, 1][np.isnan(stacked[:, :, 0])] = np.nan
    return stacked


# Slices of an aligned surface: the height along a straight line in plan (Fig. 28).


RADIUS_IN_SAMPLES = 2.0
"""Radius of the neighbourhood in units of the coarser of the two sample spacings: a circle
holds 12 points of a square grid, twice what a quadratic has coefficients."""

NEIGHBOURS = 64
"""Most points one height is fitted to: a full circle where one spacing is a fifth of the other."""

FEWEST = {6: 9, 3: 4}
"""Fewest points for a quadratic (6 coefficients) and for a plane (3)."""


@dataclass(frozen=True)
class Slice:
    """Heights along a line in plan, at M places.

    Attributes
    ----------
    xy_mm : (M, 2) array, mm, where, frame of the surface
    along_mm : (M,) array, mm, distance from the line's start
    z_mm : (M,) array, mm, height; NaN where the status is NO_DATA
    sigma_z_mm : (M,) array, mm, standard uncertainty of z
    status : (M,) array, of Status
    radius_mm : float, mm, how far around a point measurements were used; beyond it there is no data
    modes_mm : (M, K) array or None, mm, what the calibration's K errors displace all heights by in
        common, as in Surface; part of sigma_z_mm.  None where the surface has none.
    """

    xy_mm: Floats
    along_mm: Floats
    z_mm: Floats
    sigma_z_mm: Floats
    status: Ints
    radius_mm: float
    modes_mm: Floats | None = None


def resample(surface: Surface, line: tuple[Floats, Floats], step_mm: float = 0.5) -> Slice:
    """The height of ``surface`` at even steps along a line.

    At each point a quadratic is fitted by least squares to the measurements within a radius of
    RADIUS_IN_SAMPLES sample spacings: a plane over a disc of radius r would flatten a crest of
    curvature k by k r² / 8, on the paper's slice S3 by 0.1 mm.  Nothing is interpolated across
    holes: where the points around do not enclose the place, so that the quadratic's height
    there is less certain than a single measurement, a plane is tried, and where that is no
    better the status is NO_DATA.

    sigma_z_mm: the measurements' own errors average out, those of the calibration that all have
    in common (Surface.modes_mm) do not.  The plane's lack of fit counts as noise.

    Parameters
    ----------
    surface : Surface, mm, in any frame with z up
    line : tuple of array, its two ends (x, y), mm, frame of the surface
    step_mm : float, mm, from one place to the next

    Raises
    ------
    InputError
        For a line without length or a step that is not positive.
    MeasurementError
        For a surface without points.
    """
    start, end = np.asarray(line[0], dtype=float), np.asarray(line[1], dtype=float)
    length = float(np.linalg.norm(end - start))
    if not np.isfinite(length) or length == 0:
        raise InputError("slice has no length", where="slice", value=line, allowed="two points")
    if not step_mm > 0:
        raise InputError("step is not positive", where="slice", value=step_mm, allowed="> 0 mm")
    along = np.linspace(0.0, length, max(round(length / step_mm), 1) + 1)
    return _slice_at(surface, start + along[:, None] * (end - start) / length, along)


def sample(surface: Surface, xy_mm: Floats) -> Slice:
    """The height of ``surface`` at places in plan, as ``resample`` finds it.

    Parameters
    ----------
    surface : Surface, mm, in any frame with z up
    xy_mm : (M, 2) array, mm, the places, frame of the surface; ``along_mm`` is counted from one to
        the next

    Raises
    ------
    MeasurementError
        For a surface without points.
    """
    steps = np.linalg.norm(np.diff(xy_mm, axis=0, prepend=xy_mm[:1]), axis=1)
    return _slice_at(surface, xy_mm, np.cumsum(steps))


def _slice_at(surface: Surface, xy: Floats, along: Floats) -> Slice:
    """The heights at places (M, 2), mm, that lie at ``along`` (M,)."""
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    if not valid.any():
        raise MeasurementError("the surface holds no measured point to slice")
    radius = RADIUS_IN_SAMPLES * _spacing(surface.xyz_mm, valid)
    near = _neighbours(surface, valid, xy, radius)
    return _slice(xy, along, near, radius)


def _spacing(xyz: Floats, valid: Mask) -> float:
    """The coarser of the median plan distances between neighbours in a row and in a column."""
    spacings = []
    for axis in (0, 1):
        both = np.take(valid, range(1, valid.shape[axis]), axis) & np.take(
            valid, range(valid.shape[axis] - 1), axis
        )
        steps = np.diff(xyz[..., :2], axis=axis)[both]
        if len(steps):
            spacings.append(float(np.median(np.hypot(steps[:, 0], steps[:, 1]))))
    if not spacings:
        raise MeasurementError("the surface has no two measured points side by side")
    return max(spacings)


@dataclass(frozen=True)
class _Near:
    """The measurements around each of M places, at most NEIGHBOURS of them.

    offset: (M, K, 2) from the place in plan, in radii.  z_mm: (M, K) height.
    used: (M, K) which of the K there are.
    own_mm2: (M, K, 2) variances of x and of z that are each measurement's own.
    modes_mm: (M, K, 3, modes) what the calibration displaces them by; no mode where unknown.
    """

    offset: Floats
    z_mm: Floats
    used: Mask
    own_mm2: Floats
    modes_mm: Floats


def _neighbours(surface: Surface, valid: Mask, xy: Floats, radius: float) -> _Near:
    plan = surface.xyz_mm[..., :2]
    low, high = xy.min(axis=0) - radius, xy.max(axis=0) + radius
    near = valid & ((plan >= low) & (plan <= high)).all(axis=-1)  # a smaller tree is sooner built
    if not near.any():  # any point will do: it is out of reach
        near.flat[np.flatnonzero(valid)[0]] = True
    points = surface.xyz_mm[near]
    _, nearest = cKDTree(points[:, :2]).query(xy, k=NEIGHBOURS, distance_upper_bound=radius)
    used: Mask = np.less(nearest, len(points))
    index = np.where(used, nearest, 0)
    total = np.stack([surface.sigma_x_mm[near], surface.sigma_z_mm[near]], axis=-1)[index] ** 2
    modes = np.zeros((*used.shape, 3, 0))
    if surface.modes_mm is not None:
        modes = surface.modes_mm[near][index].astype(float)
    common = np.square(modes[..., [0, 2], :]).sum(axis=-1)
    offset, z_mm = (points[index][..., :2] - xy[:, None]) / radius, points[index][..., 2]
    return _Near(
        offset=offset, z_mm=z_mm, used=used, own_mm2=np.maximum(total - common, 0.0), modes_mm=modes
    )


def _slice(xy: Floats, along: Floats, near: _Near, radius: float) -> Slice:
    """The slice: quadratics where the points allow them, planes elsewhere."""
    curved, flat = _fit(near, radius, 6), _fit(near, radius, 3)
    fitted = np.where(np.isfinite(curved[:, :1]), curved, flat)
    z, variance, modes = fitted[:, 0], fitted[:, 1], fitted[:, 2:]
    sigma = np.sqrt(variance + np.square(modes).sum(axis=1))
    status = np.where(np.isfinite(z), Status.OK, Status.NO_DATA).astype(np.int64)
    known = modes if modes.shape[1] else None
    return Slice(xy, along, z, sigma, status, radius, known)


def _fit(near: _Near, radius: float, size: int) -> Floats:
    """(M, 2 + K) heights of the local least-squares polynomials of ``size`` coefficients, 3 or 6.

    In columns: the height, mm, its own variance, mm², and its K modes, mm; NaN where there is no
    fit.
    """
    dx, dy = near.offset[..., 0], near.offset[..., 1]
    terms = [np.ones_like(dx), dx, dy, dx**2, dx * dy, dy**2][:size]
    design = np.stack(terms, axis=-1) * near.used[..., None]
    normal = np.einsum("mki,mkj->mij", design, design)
    count = near.used.sum(axis=1)
    good = (count >= FEWEST[size]) & (np.linalg.eigvalsh(normal)[:, 0] > 1e-6)
    inverse = np.linalg.inv(np.where(good[:, None, None], normal, np.eye(size)))
    good &= inverse[:, 0, 0] < 1
    # The weight each measurement has in the height here, and in its slopes.
    weight = np.einsum("mij,mkj->mik", inverse[:, :3], design)
    fitted = np.einsum("mik,mk->mi", weight, near.z_mm)
    slope = fitted[:, 1:] / radius
    variance = near.own_mm2[..., 1] + slope[:, :1] ** 2 * near.own_mm2[..., 0]
    if size == 3:
        variance = variance + _lack_of_fit(near, fitted, variance)[:, None]
    # An error of x or y moves the height found at a fixed place against the slope.
    turn = np.column_stack([-slope, np.ones(len(slope))])
    modes = np.einsum("mk,mkcq,mc->mq", weight[:, 0], near.modes_mm, turn)
    own = np.einsum("mk,mk->m", weight[:, 0] ** 2, variance)
    return np.where(good[:, None], np.column_stack([fitted[:, 0], own, modes]), np.nan)


def _lack_of_fit(near: _Near, fitted: Floats, variance: Floats) -> Floats:
    """(M,) mm² by which the residuals of planes exceed what the measurements' noise explains.

    fitted: (M, 3) height here and its differences over one radius along x and y.
    """
    plane = fitted[:, :1] + np.einsum("mkc,mc->mk", near.offset, fitted[:, 1:])
    squares = np.where(near.used, (near.z_mm - plane) ** 2, 0.0).sum(axis=1)
    freedom = np.maximum(near.used.sum(axis=1) - 3, 1)
    noise = np.where(near.used, variance, 0.0).sum(axis=1) / np.maximum(near.used.sum(axis=1), 1)
    return np.maximum(squares / freedom - noise, 0.0)


# What a surface was made from: as it is found, and as files have it.


class StoredProvenance(Strict):
    """As records.Provenance, in a file."""

    rig: str
    pictures: Annotated[int, Field(ge=1)]
    extractor: str
    plane_map: str
    calibration_sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

    def provenance(self) -> Provenance:
        """As the program holds it."""
        return Provenance(**self.model_dump(include=set(StoredProvenance.model_fields)))


def provenance_of(rig: Rig, pictures: int, plane_map: PlaneMap) -> Provenance:
    """What a surface of a run's pictures is made from.

    Parameters
    ----------
    rig : Rig, the pictures were taken with
    pictures : int, their number
    plane_map : PlaneMap, of the rig's camera, as calibrated
    """
    since = rig.since_calibration
    carried_by = [stated_water(rig.optics), since and since.model_dump(mode="json")]
    content = json.dumps([plane_map.name, plane_map.parameters(), carried_by], sort_keys=True)
    return Provenance(
        rig=rig.name,
        pictures=pictures,
        extractor=with_package("lscan.extractors", rig.stripe.extractor),
        plane_map=with_package("lscan.planemaps", plane_map.name),
        calibration_sha256=hashlib.sha256(content.encode()).hexdigest(),
    )
