"""The lit line of a sheet: short straight segments of surfaces that the sheet lights.

Rays of the sheet are traced far closer than segments lie.  The line is cut wherever the surface
ends, begins or is creased; between cuts segments are short where the surface is bent.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import exp, log

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints, Mask
from sim.render.ambient import reflectance
from sim.render.plugins.arrays import floats
from sim.render.plugins.sheet import LaserSheet
from sim.render.sampled.beams import straight_rays

RAYS = 2048
SCATTERED = 16  # rays that share what the water scatters beside them
# Segments that follow each other on one surface: from afar they are one place.  Where it is bent a
# segment lights neither itself nor, as it should, its neighbours.
SEGMENTS, CLUSTER = 256, 8
CLUSTERS = SEGMENTS // CLUSTER
CREASE_RAD = 0.3  # where the normal turns by more between two rays, or what they meet lies by
LEAVES = 0.3  # more (sine) out of the tangent plane, the line is cut
# A turn by a radian gets as many segments as so many mm: of a bend of 5 mm radius, 1.5 rad of it
# lit, they are a third as long as of a plane.
BEND_MM = 10.0
# Standard deviation of a sheet's irradiance over its 1/e2 half width, times how far off, in such, a
# thin line has to be for as much of its light to fall on a wall that it runs into.  Light t aside
# gives a place z above the line z / 2 (z2 + t2), the wall up to Z the mean of ln(1 + Z2/t2) / 4;
# the mean of ln t2 is ln sigma2 - ln 2 - Euler's constant.
OFF = 0.5 * exp(-(np.euler_gamma + log(2)) / 2)


@dataclass(frozen=True)
class LitLine:
    """SEGMENTS of a lit line, world frame.

    Attributes
    ----------
    segments : Float, 12 numbers each: middle, half its length in mm; the surface's normal, the
        power in mW that it sends into the water; the unit vector along it, how far its light
        lies off it, mm: the bent middle off the chord, and the sheet's thickness
    clusters : Float, 8 numbers for each of CLUSTERS: middle, half its length; normal, power
    """

    segments: mi.Float
    clusters: mi.Float


def lit_line(
    scene: mi.Scene,
    sheet: LaserSheet,
    arriving: Callable[[mi.Float], mi.Float],
    beside: Callable[[mi.Point3f, mi.Vector3f], mi.Float] | None = None,
) -> LitLine:
    """The line of a sheet where it is placed.

    Parameters
    ----------
    scene : mi.Scene, of matt surfaces
    sheet : LaserSheet
    arriving : function of the distance in mm, the share of the light that arrives on the line
    beside : function of places and normals, optional: what falls beside it and counts as of it,
        mW per radian
    """
    step = 2 * sheet.half_angle / RAYS
    phi = step * (dr.arange(mi.Float, RAYS) + 0.5) - sheet.half_angle
    along = sheet.direction(phi)
    si = scene.ray_intersect(mi.Ray3f(sheet.apex(mi.Float(0)), dr.normalize(along)))
    lit = si.is_valid()
    sends = reflectance(si) * step
    sent = dr.select(lit, sends * sheet.power_density(phi) * arriving(si.t), 0.0)
    normal = facing(si)
    off = dr.select(lit, OFF * sheet.half_width(si.t), 0.0)
    columns = [sent, si.p, normal, off, dr.select(lit, sends, 0.0)]
    dr.eval(columns)
    power, point, normals, off_mm, share = (np.array(column, dtype=float) for column in columns)
    if beside is not None:
        ray = SCATTERED * dr.arange(mi.UInt32, RAYS // SCATTERED) + SCATTERED // 2
        more = beside(dr.gather(mi.Point3f, si.p, ray), dr.gather(mi.Vector3f, normal, ray))
        lit_too = np.array(dr.gather(mi.Bool, lit, ray))
        power += share * np.where(lit_too, np.array(more), 0.0).repeat(SCATTERED)
    return _segmented(power, point.T, normals.T, off_mm)


def facing(si: mi.SurfaceInteraction3f) -> mi.Vector3f:
    """The surface's normal as it is shaded, on the side that rays come from.

    Parameters
    ----------
    si : SurfaceInteraction3f, what rays meet
    """
    normal = mi.Vector3f(si.sh_frame.n)
    return dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -normal, normal)


def _segmented(power: Floats, point: Floats, normal: Floats, off_mm: Floats) -> LitLine:
    """Segments of what (RAYS,) rays lit, whose light lies so far off them."""
    runs, weight = _runs(power > 0, point, normal)
    segments = np.zeros((SEGMENTS, 12))
    if len(runs):
        gone = np.concatenate([[0.0], np.cumsum(weight)])
        rays = _RaySpans(runs, _shared_out(gone[runs[:, 1]] - gone[runs[:, 0]]), gone)
        sent = np.concatenate([[0.0], np.cumsum(power)])
        low, middle, high = (rays.at(CLUSTER, part) for part in (0.0, 0.5, 1.0))
        chord = rays.of(point, high) - rays.of(point, low)
        length = np.linalg.norm(chord, axis=1, keepdims=True)
        each = np.arange(RAYS + 1)
        segments[:, :3], segments[:, 3:4] = rays.of(point, middle), length / 2
        segments[:, 4:7] = _unit(rays.of(normal, middle))
        segments[:, 7] = np.interp(high.place, each, sent) - np.interp(low.place, each, sent)
        segments[:, 8:11] = chord / np.maximum(length, 1e-12)
        between = (rays.of(point, low) + rays.of(point, high)) / 2
        bent = np.linalg.norm(segments[:, :3] - between, axis=1)
        segments[:, 11] = np.hypot(bent, np.interp(middle.place - 0.5, each[:-1], off_mm))
    return LitLine(floats(segments), floats(_clusters(segments)))


def _runs(lit: Mask, point: Floats, normal: Floats) -> tuple[Ints, Floats]:
    """(R, 2) first rays of the line's pieces without a cut and those behind their last ones.

    Also the (RAYS,) weights of the rays, by which segments are dealt out.
    """
    offset = np.diff(point, axis=0)
    length = np.linalg.norm(offset, axis=1)
    turn = np.linalg.norm(np.diff(normal, axis=0), axis=1)
    out = np.abs(np.sum(offset * (normal[1:] + normal[:-1]) / 2, axis=1)) > LEAVES * length
    cut = (turn > CREASE_RAD) | out
    for cuts in (cut, np.zeros_like(cut)):
        begins = lit & np.concatenate([[True], ~lit[:-1] | cuts])
        ends = lit & np.concatenate([~lit[1:] | cuts, [True]])
        runs = np.column_stack([np.flatnonzero(begins), np.flatnonzero(ends) + 1])
        if len(runs) <= CLUSTERS:
            break
    between = np.where(cut | ~lit[1:] | ~lit[:-1], 0.0, length + BEND_MM * turn) + 1e-9
    around = np.concatenate([between[:1], between]), np.concatenate([between, between[-1:]])
    return runs[:CLUSTERS], np.where(lit, np.maximum(*around), 0.0)


def _shared_out(weight: Floats) -> Ints:
    """Numbers of clusters, one at least each, CLUSTERS in all, in proportion to weights."""
    wanted = (CLUSTERS - len(weight)) * weight / weight.sum()
    count = np.floor(wanted).astype(int)
    left = CLUSTERS - len(weight) - count.sum()
    count[np.argsort(count - wanted, kind="stable")[:left]] += 1
    return 1 + count


def _clusters(segments: Floats) -> Floats:
    """(CLUSTERS, 8) of their segments."""
    each = segments.reshape(CLUSTERS, CLUSTER, 12)
    power = each[..., 7]
    share = power / np.maximum(power.sum(axis=1, keepdims=True), 1e-30)
    middle, normal = (
        np.einsum("cs,csk->ck", share, each[..., some]) for some in (np.s_[:3], np.s_[4:7])
    )
    half = each[..., 3].sum(axis=1, keepdims=True)
    return np.hstack([middle, half, _unit(normal), power.sum(axis=1, keepdims=True)])


@dataclass(frozen=True)
class _Spans:
    """Places along the rays, whose number k is at k + 1/2, and the first and last ray of each."""

    place: Floats
    first: Ints
    last: Ints


@dataclass(frozen=True)
class _RaySpans:
    """How clusters are dealt out to runs of rays, by what of the weight is gone before each ray."""

    runs: Ints
    counts: Ints
    gone: Floats

    def at(self, each: int, part: float) -> _Spans:
        """Where the parts into which all clusters are cut, so many each, are so far gone."""
        pieces = each * self.counts
        run = np.repeat(np.arange(len(pieces)), pieces)
        number = np.arange(pieces.sum()) - np.repeat(np.cumsum(pieces) - pieces, pieces)
        first, end = self.runs[run].T
        share = (number + part) / pieces[run]
        wanted = self.gone[first] + share * (self.gone[end] - self.gone[first])
        place = np.interp(wanted, self.gone, np.arange(len(self.gone)))
        return _Spans(np.clip(place, first, end), first, end - 1)

    def of(self, values: Floats, places: _Spans) -> Floats:
        """(N, 3) values of the rays there, linear in between and half a step beyond the last."""
        ray = places.place - 0.5
        low = np.clip(np.floor(ray).astype(int), places.first, np.maximum(places.last - 1, 0))
        high = np.minimum(low + 1, places.last)
        return values[low] + (ray - low)[:, np.newaxis] * (values[high] - values[low])


def _unit(vectors: Floats) -> Floats:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


# Where the sheets' rays end: the lit line as points of light, for all that they light in turn.


ANGLES = 1024  # across the fan: two thirds of a usual pixel
# Gauss and Hermite's nodes across the sheet, in standard deviations, which keep its variance.
ACROSS, SHARES = (-np.sqrt(3), 0.0, np.sqrt(3)), (1 / 6, 2 / 3, 1 / 6)


@dataclass(frozen=True)
class LitPoints:
    """Points of the lines of all sheets, in the world.

    point: mm.  power: radiance times area of the surface, mW/sr, of matt surfaces.  normal: on
    the side that the laser lights.
    """

    point: mi.Point3f
    normal: mi.Normal3f
    power: mi.Float


def lit_points(scene: mi.Scene, sheets: Sequence[LaserSheet], extinction: mi.Float) -> LitPoints:
    """The lines of sheets where they are placed.

    extinction: of the water, 1/mm.
    """
    lines = [_line(scene, sheet, extinction) for sheet in sheets]
    if len(lines) == 1:
        return lines[0]
    columns = zip(*((*line.point, *line.normal, line.power) for line in lines), strict=True)
    px, py, pz, nx, ny, nz, power = (dr.concat(column) for column in columns)
    return LitPoints(mi.Point3f(px, py, pz), mi.Normal3f(nx, ny, nz), power)


def _line(scene: mi.Scene, sheet: LaserSheet, extinction: mi.Float) -> LitPoints:
    lane = dr.arange(mi.UInt32, ANGLES * len(ACROSS))
    number, across = lane % ANGLES, lane // ANGLES
    phi = sheet.half_angle * ((mi.Float(number) + 0.5) * (2 / ANGLES) - 1)
    rays = straight_rays(scene, sheet, phi, mi.Float(0), mi.Bool(True))
    nodes = mi.Float([float(x) for x in ACROSS]), mi.Float([float(x) for x in SHARES])
    offset, share = (dr.gather(mi.Float, node, across) for node in nodes)
    origin, way = rays.line(offset)
    way = dr.normalize(way)
    si = scene.ray_intersect(mi.Ray3f(origin, way), mi.RayFlags.All, coherent=True)
    step = sheet.half_angle * (2 / ANGLES)
    power = sheet.power_density(phi) * step * share * dr.exp(-extinction * si.t)
    power = dr.select(si.is_valid(), power * reflectance(si) / dr.pi, 0.0)
    normal = dr.select(dr.dot(si.n, way) > 0, -si.n, si.n)
    point = dr.select(si.is_valid(), si.p, origin)
    return LitPoints(point, mi.Normal3f(normal), power)


# What places of surfaces receive from a lit line in closed form, and how much of it is hidden.


# What rises less above a surface's tangent plane sends it no light: it is the surface itself.
ABOVE_MM = 1e-3
AROUND = 1.0  # times that a bent segment lies off its chord: as wide it is taken for
START_MM = 0.02  # of rays, above surfaces: chords of a wave's facets lie within
# Half lengths: farther clusters count as points.  Of a line that ends so far away 1/64 is left out
# of light that falls with the distance's cube, the most.
NEAR = 8.0
# Half lengths: nearer clusters are taken as seen wherever they are above the horizon.
CLOSE = 4.0


def visible_part(
    scene: mi.Scene, line: LitLine, point: mi.Point3f, normal: mi.Vector3f
) -> mi.Float:
    """Share of a line's light that no surface keeps from places which are not CLOSE to it.

    It takes a ray to each cluster.

    Parameters
    ----------
    scene : mi.Scene
    line : LitLine
    point, normal : Point3f, mm, and Vector3f, of the places
    """
    lane = dr.arange(mi.UInt32, dr.width(point) * CLUSTERS)
    index, cluster = lane // CLUSTERS, lane % CLUSTERS
    point, normal = dr.gather(mi.Point3f, point, index), dr.gather(mi.Vector3f, normal, index)
    place, outward, power, close = _cluster(line, cluster)
    start = point + START_MM * normal
    way = place + START_MM * outward - start
    distance = dr.norm(way)
    light = power * dr.maximum(dr.dot(way, normal), 0) * dr.maximum(-dr.dot(way, outward), 0)
    light = dr.select(distance > close, light / dr.square(dr.square(distance)), 0.0)
    blocked = scene.ray_test(mi.Ray3f(start, way / distance, distance, 0.0, []), light > 0)
    whole, rest = (
        dr.block_sum(value, CLUSTERS) for value in (light, dr.select(blocked, 0.0, light))
    )
    return dr.select(whole > 0, rest / whole, 1.0)


def _cluster(
    line: LitLine, cluster: mi.UInt32
) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float]:
    """A place of a cluster and the normal there, its power, and what is close to it.

    It is the middle of a segment: that of a bent cluster may lie within the body.
    """
    segment = 3 * (CLUSTER * cluster + CLUSTER // 2)
    place = dr.gather(mi.Vector4f, line.segments, segment)
    upright = dr.gather(mi.Vector4f, line.segments, segment + 1)
    outward = mi.Vector3f(upright.x, upright.y, upright.z)
    half = dr.gather(mi.Vector4f, line.clusters, 2 * cluster).w
    power = dr.gather(mi.Vector4f, line.clusters, 2 * cluster + 1).w
    return mi.Point3f(place.x, place.y, place.z), outward, power, CLOSE * half


@dr.syntax
def received(
    line: LitLine,
    point: mi.Point3f,
    normal: mi.Vector3f,
    extinction: mi.Float,
    active: mi.Bool,
) -> tuple[mi.Float, mi.Float]:
    """Irradiance in mW/mm2 of places by the matt segments of a line, if none is hidden.

    It is that by segments CLOSE by, and that by all others.


    On a surface of the normal n a segment of half the length a, the power P, its middle x and the
    normal m adds P/(2 pi a) times the integral of (m.(p - y)) (n.(y - p)) / |y - p|4 over its
    places y; the first factor is the same for all of them, and with h the distance from the
    segment's straight line and t along it the rest is the integral of
    (b0 + b1 t) / (t2 + h2)2, which is elementary.

    Parameters
    ----------
    line : LitLine
    point, normal : Point3f, mm, and Vector3f, of the places
    extinction : Float, 1/mm, of the way between
    active : Bool, the places that the line may light
    """
    close, far, cluster = mi.Float(0), mi.Float(0), mi.UInt32(0)
    clusters, segments = line.clusters, line.segments
    while active & (cluster < CLUSTERS):
        place = dr.gather(mi.Vector4f, clusters, 2 * cluster)
        upright = dr.gather(mi.Vector4f, clusters, 2 * cluster + 1)
        offset = mi.Point3f(place.x, place.y, place.z) - point
        square, light = dr.squared_norm(offset), mi.Float(0)
        if square < dr.square(NEAR * place.w):
            light = _nearby(segments, CLUSTER * cluster, point, normal, extinction)
        else:
            leaving = -dr.dot(mi.Vector3f(upright.x, upright.y, upright.z), offset)
            facing = dr.maximum(leaving, 0) * dr.maximum(dr.dot(normal, offset), 0)
            loss = dr.exp(-extinction * dr.sqrt(square))
            light = upright.w * facing / dr.square(square) * loss
        is_close = square < dr.square(CLOSE * place.w)
        close += dr.select(is_close, light, 0.0)
        far += dr.select(is_close, 0.0, light)
        cluster += 1
    return close * dr.inv_pi, far * dr.inv_pi


@dr.syntax
def _nearby(
    segments: mi.Float,
    first: mi.UInt32,
    point: mi.Point3f,
    normal: mi.Vector3f,
    extinction: mi.Float,
) -> mi.Float:
    """By the segments of a cluster, the first of which is given, times pi."""
    light, number = mi.Float(0), mi.UInt32(0)
    while number < CLUSTER:
        index = 3 * (first + number)
        place = dr.gather(mi.Vector4f, segments, index)
        upright = dr.gather(mi.Vector4f, segments, index + 1)
        axis = dr.gather(mi.Vector4f, segments, index + 2)
        offset = mi.Point3f(place.x, place.y, place.z) - point
        along = mi.Vector3f(axis.x, axis.y, axis.z)
        leaving = -dr.dot(mi.Vector3f(upright.x, upright.y, upright.z), offset)
        middle, slope = dr.dot(along, offset), dr.dot(normal, along)
        # No closer than the light lies off the segment: a line without thickness would be
        # endlessly bright beside it, where facets rise above each other's planes.
        height2 = dr.squared_norm(offset - middle * along) + dr.square(AROUND * axis.w)
        fixed = dr.dot(normal, offset) - slope * middle
        shape = leaving * _segment(middle, place.w, fixed, slope, height2)
        loss = dr.exp(-extinction * dr.norm(offset))
        above = leaving > ABOVE_MM
        light += dr.select(above, upright.w * shape * loss, 0.0)
        number += 1
    return light


def _segment(
    middle: mi.Float, half: mi.Float, fixed: mi.Float, slope: mi.Float, height2: mi.Float
) -> mi.Float:
    """Mean over a segment of (fixed + slope t) / (t2 + h2)2 where that is positive."""
    low, high = middle - half, middle + half
    horizon = (ABOVE_MM - fixed) / dr.select(dr.abs(slope) < 1e-9, 1e-9, slope)
    low = dr.select(slope > 0, dr.maximum(low, horizon), low)
    high = dr.select(slope < 0, dr.minimum(high, horizon), high)
    height2 = dr.maximum(height2, 1e-6)
    height = dr.sqrt(height2)

    def ends(t: mi.Float) -> tuple[mi.Float, mi.Float]:
        inverse = dr.rcp(t * t + height2)
        return t * inverse, inverse

    (low_ratio, low_inverse), (high_ratio, high_inverse) = ends(low), ends(high)
    angle = dr.atan2((high - low) * height, height2 + low * high)
    whole = fixed / (2 * height2) * (high_ratio - low_ratio + angle / height)
    whole -= 0.5 * slope * (high_inverse - low_inverse)
    above = (high > low) & ((slope != 0) | (fixed > ABOVE_MM))
    return dr.select(above, whole / (2 * dr.maximum(half, 1e-9)), 0.0)
