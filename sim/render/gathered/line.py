"""The lit line of a sheet, what surfaces receive from it, and the sheet's glow in water.

Rays of the sheet are traced far closer than segments lie.  The line is cut wherever the surface
ends, begins or is creased; between cuts segments are short where the surface is bent.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import asinh, exp, log, pi
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints, Mask
from sim.render.ambient import reflectance
from sim.render.firstorder import HEAD
from sim.render.gathered.halo import Picture
from sim.render.plugins.arrays import floats, opaque
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import SpreadLookup
from sim.render.sampled.beams import straight_rays
from sim.scene import Laser, LaserLine
from sim.water.spread import LogAxis, Spread

# The lit line of a sheet: short straight segments of surfaces that the sheet lights.

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
    return _line_segments(power, point.T, normals.T, off_mm)


def facing(si: mi.SurfaceInteraction3f) -> mi.Vector3f:
    """The surface's normal as it is shaded, on the side that rays come from.

    Parameters
    ----------
    si : SurfaceInteraction3f, what rays meet
    """
    normal = mi.Vector3f(si.sh_frame.n)
    return dr.select(mi.Frame3f.cos_theta(si.wi) < 0, -normal, normal)


def _line_segments(power: Floats, point: Floats, normal: Floats, off_mm: Floats) -> LitLine:
    """Segments of what (RAYS,) rays lit, whose light lies so far off them."""
    runs, weight = _runs(power > 0, point, normal)
    segments = np.zeros((SEGMENTS, 12))
    if len(runs):
        gone = np.concatenate([[0.0], np.cumsum(weight)])
        lit = gone[runs[:, 1]] - gone[runs[:, 0]]
        # Each run has one cluster at least, all have CLUSTERS, in proportion to their weights.
        wanted = (CLUSTERS - len(runs)) * lit / lit.sum()
        count = np.floor(wanted).astype(int)
        left = CLUSTERS - len(runs) - count.sum()
        count[np.argsort(count - wanted, kind="stable")[:left]] += 1
        rays = _RaySpans(runs, 1 + count, gone)
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
    rest = dr.select(blocked, 0.0, light)
    dr.eval(light, rest)  # once: each sum would work both out
    whole, rest = dr.block_sum(light, CLUSTERS), dr.block_sum(rest, CLUSTERS)
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


def received(
    line: LitLine, point: mi.Point3f, normal: mi.Vector3f, extinction: mi.Float, active: mi.Bool
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
    clusters, segments = line.clusters, line.segments

    # What a loop does not change is no state of it: to find that out takes tracing it twice.
    def add_cluster(
        close: mi.Float, far: mi.Float, cluster: mi.UInt32
    ) -> tuple[mi.Float, mi.Float, mi.UInt32]:
        place = dr.gather(mi.Vector4f, clusters, 2 * cluster)
        upright = dr.gather(mi.Vector4f, clusters, 2 * cluster + 1)
        offset = mi.Point3f(place.x, place.y, place.z) - point
        square = dr.squared_norm(offset)
        leaving = -dr.dot(mi.Vector3f(upright.x, upright.y, upright.z), offset)
        facing = dr.maximum(leaving, 0) * dr.maximum(dr.dot(normal, offset), 0)

        def from_afar() -> mi.Float:
            loss = dr.exp(-extinction * dr.sqrt(square))
            return upright.w * facing / dr.square(square) * loss

        light = dr.if_stmt(
            (),
            square < dr.square(NEAR * place.w),
            lambda: _nearby(segments, CLUSTER * cluster, point, normal, extinction),
            lambda: dr.if_stmt((), facing > 0, from_afar, lambda: mi.Float(0)),
        )
        is_close = square < dr.square(CLOSE * place.w)
        close = close + dr.select(is_close, light, 0.0)
        return close, far + dr.select(is_close, 0.0, light), cluster + 1

    close, far, _ = dr.while_loop(
        (mi.Float(0), mi.Float(0), mi.UInt32(0)),
        lambda close, far, cluster: active & (cluster < CLUSTERS),
        add_cluster,
    )
    return close * dr.inv_pi, far * dr.inv_pi


def _nearby(
    segments: mi.Float,
    first: mi.UInt32,
    point: mi.Point3f,
    normal: mi.Vector3f,
    extinction: mi.Float,
) -> mi.Float:
    """By the segments of a cluster, the first of which is given, times pi."""

    def add_segment(light: mi.Float, number: mi.UInt32) -> tuple[mi.Float, mi.UInt32]:
        index = 3 * (first + number)
        place = dr.gather(mi.Vector4f, segments, index)
        upright = dr.gather(mi.Vector4f, segments, index + 1)
        offset = mi.Point3f(place.x, place.y, place.z) - point
        leaving = -dr.dot(mi.Vector3f(upright.x, upright.y, upright.z), offset)

        def shining() -> mi.Float:
            axis = dr.gather(mi.Vector4f, segments, index + 2)
            along = mi.Vector3f(axis.x, axis.y, axis.z)
            middle, slope = dr.dot(along, offset), dr.dot(normal, along)
            # No closer than the light lies off the segment: a line without thickness would be
            # endlessly bright beside it, where facets rise above each other's planes.
            height2 = dr.squared_norm(offset - middle * along) + dr.square(AROUND * axis.w)
            fixed = dr.dot(normal, offset) - slope * middle
            shape = leaving * _segment(middle, place.w, fixed, slope, height2)
            return upright.w * shape * dr.exp(-extinction * dr.norm(offset))

        # Few segments light a place: what lies below either's plane costs no more than this.
        highest = dr.dot(normal, offset) + place.w
        is_lit = (leaving > ABOVE_MM) & (highest > ABOVE_MM)
        return light + dr.if_stmt((), is_lit, shining, lambda: mi.Float(0)), number + 1

    light, _ = dr.while_loop(
        (mi.Float(0), mi.UInt32(0)), lambda _, number: number < CLUSTER, add_segment
    )
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


# The sheet's light that the water scatters onto surfaces: a table in the sheet's own frame.
#
# Every ray of the sheet spreads as a pencil beam does in endless water (sim.water.spread).  At a
# place (phi, rho) of the sheet's middle and the offset s from it, a plane surface with the normal n
# receives the sum over the fan; the rays end on the surface's own plane.  Along the fan the sum is
# over hyperbolic sines of the distance, for light between a line and a point beside it falls off
# with the distance.  How the sum depends on n is a polynomial of the second degree, found by least
# squares.  The sheet's thickness blurs it along s.


# Angles: so many steps to either edge of the fan, where a node lies, and as many beyond.
STEPS = 5
GLOW_ANGLES = 4 * STEPS + 1
RHO_AXIS = LogAxis(80.0, 3000.0, 12)
ASIDE_AXIS = LogAxis(0.0, 2000.0, 28, 0.1)
BEAMS = 16  # Gauss and Legendre's, of the fan
# Places across the sheet's thickness, out to so many standard deviations.
GLOW_ACROSS, REACH = 240, 5.0
FARTHEST_MM = 5000.0  # where rays end that meet no surface
# Normals that the polynomial is fitted to: no more than 84 degrees off the way back to the apex.
COSINES, AZIMUTHS = (1.0, 0.9, 0.75, 0.55, 0.3, 0.1), 6
DIM = 0.3  # of a facing surface's light: above, the fit's error counts relative to the light
# Of the brightest surface's, the same, where a facing one is dark: so few photons came so far off.
DIMMEST = 1e-6
ODD = (2, 7, 8)  # the polynomial's terms that change sign from one side of the sheet to the other
LEAST = 1e-6  # of an endless fan's light
LEAST_LIGHT = 1e-30  # mW/mm2
# What falls about so near the sheet's middle the lit line reflects along with its own light: it is
# finer than patches, which lie 5 to 20 mm apart.
STRIP_MM = 10.0
# Gauss and Legendre's nodes across that strip, at hyperbolic sines from about FINEST_MM on, out to
# so many STRIP_MM; a surface that the sheet grazes is taken to lean by this sine.
STRIP_NODES, FINEST_MM, STRIP_REACH, GRAZING = 16, 0.5, 3.0, 0.2
Part = TypeVar("Part", mi.Float, Floats)


class Glow:
    """The irradiance by scattered light of one sheet, which may move once this is made."""

    def __init__(self, sheet: LaserSheet, spread: Spread, extinction_per_mm: float) -> None:
        """Sum up the table.

        Parameters
        ----------
        sheet : LaserSheet, configured
        spread : Spread, of the water
        extinction_per_mm : float, its attenuation
        """
        self._sheet, self._edge = sheet, _edge(sheet)
        self._loss = opaque(_loss(spread, extinction_per_mm))
        table = _coefficient_table(sheet.settings, spread, extinction_per_mm)
        self._table = mi.Texture3f(mi.TensorXf(table), use_accel=False)

    def of_strip(self, point: mi.Point3f, normal: mi.Vector3f) -> mi.Float:
        """What falls about the line on a surface, mW per radian of the fan; see ``off_strip``.

        Parameters
        ----------
        point : Point3f, mm, world frame, of the line
        normal : Vector3f, of the surface, on the side that is lit
        """
        sheet, span = self._sheet, asinh(STRIP_REACH * STRIP_MM / FINEST_MM)
        node, weight = np.polynomial.legendre.leggauss(STRIP_NODES)
        aside, width = FINEST_MM * np.sinh(span * node), FINEST_MM * span * np.cosh(span * node)
        lane = dr.arange(mi.UInt32, dr.width(point) * STRIP_NODES)
        index = lane // STRIP_NODES
        s, step = (
            dr.gather(mi.Float, floats(values), lane % STRIP_NODES)
            for values in (aside, width * weight)
        )
        middle, plane = dr.gather(mi.Point3f, point, index), dr.gather(mi.Vector3f, normal, index)
        across = sheet.normal - plane * dr.dot(plane, sheet.normal)
        lean = dr.maximum(dr.norm(across), GRAZING)
        light = self.irradiance(middle + across * (s / dr.square(lean)), plane) * _strip_share(s)
        strip = dr.block_sum(light * step / lean, STRIP_NODES)
        line = dr.cross(normal, sheet.normal)
        offset = point - sheet.apex(mi.Float(0))
        grazed = dr.norm(dr.cross(line, offset)) / dr.maximum(dr.norm(line), GRAZING)
        return strip * dr.squared_norm(offset) / dr.maximum(grazed, GRAZING * dr.norm(offset))

    def off_strip(self, point: mi.Point3f, normal: mi.Normal3f) -> mi.Float:
        """What surfaces receive, mW/mm2, but for what counts as of the line.

        Parameters
        ----------
        point, normal : as those of ``irradiance``
        """
        phi, _, s = self._sheet.coordinates(point, mi.Float(0))
        within = dr.select(dr.abs(phi) <= self._sheet.half_angle, _strip_share(s), 0.0)
        return (1 - within) * self.irradiance(point, normal)

    def irradiance(self, point: mi.Point3f, normal: mi.Normal3f) -> mi.Float:
        """What surfaces receive, mW/mm2.

        Parameters
        ----------
        point : Point3f, mm, world frame, in which the sheet is placed
        normal : Normal3f, on the side that is lit
        """
        sheet = self._sheet
        phi, rho, s = sheet.coordinates(point, mi.Float(0))
        place = mi.Point3f(
            (phi / self._edge + 1) * (0.5 * (GLOW_ANGLES - 1)),
            _place(RHO_AXIS, rho),
            _place(ASIDE_AXIS, dr.abs(s)),
        )
        size = mi.Vector3f(GLOW_ANGLES, RHO_AXIS.count, ASIDE_AXIS.count)
        log_value, *terms = self._table.eval((place + 0.5) / size)
        sine, cosine = dr.sincos(phi)
        back = -dr.dot(normal, sheet.across * sine + sheet.axis * cosine)
        along = dr.dot(normal, sheet.across * cosine - sheet.axis * sine)
        outward = dr.dot(normal, sheet.normal) * dr.select(s < 0, -1.0, 1.0)
        total, *basis = _basis(back, along, outward)
        for term, factor in zip(terms, basis, strict=True):
            total += term * factor
        light = dr.exp(log_value - self._loss * rho) * _share(sheet, phi, rho, s)
        return light * dr.maximum(total, 0)


def _strip_share(s: mi.Float) -> mi.Float:
    """Share of the light s mm off the sheet's middle that counts as of the line."""
    return dr.exp(-0.5 * dr.square(s / STRIP_MM))


@lru_cache(maxsize=8)  # tanks often differ in the target, the camera or the sensor alone
def _coefficient_table(
    settings: tuple[Laser, LaserLine, float, float], spread: Spread, extinction_per_mm: float
) -> Picture:
    """(S, R, A, terms) the table of a sheet with these settings."""
    sheet = LaserSheet(mi.Properties())
    sheet.configure(*settings)
    sheet.place(HEAD)
    edge = _edge(sheet)
    aside, rho, phi = np.meshgrid(
        ASIDE_AXIS.nodes(), RHO_AXIS.nodes(), np.linspace(-edge, edge, GLOW_ANGLES), indexing="ij"
    )
    lookup = SpreadLookup(spread, extinction_per_mm)
    terms = _widen_by_sheet(_fit_coefficients(sheet, lookup, phi, rho, aside), sheet)
    share = _share(sheet, *(floats(values) for values in (phi, rho, aside)))
    facing = np.maximum(terms[..., :1], LEAST_LIGHT)
    log_value = np.log(facing[..., 0] / np.array(share).reshape(phi.shape))
    log_value += _loss(spread, extinction_per_mm) * rho
    channels = np.concatenate([log_value[..., np.newaxis], terms[..., 1:] / facing], axis=-1)
    return channels.astype(np.float32)


def _edge(sheet: LaserSheet) -> float:
    """rad, the table's largest angle."""
    return 2 * float(sheet.half_angle[0])


def _loss(spread: Spread, extinction_per_mm: float) -> float:
    """1/mm, about what scattered light loses: without it the table is nearly a power of rho."""
    return spread.loss * extinction_per_mm


def _place(axis: LogAxis, x: mi.Float) -> mi.Float:
    return (dr.log(dr.maximum(x, 1e-3) + axis.offset) - axis.start) * axis.scale


def _basis(back: Part, along: Part, outward: Part) -> list[Part]:
    """The polynomial's terms; for a surface that faces the apex the first is 1, the others 0.

    back, along, outward: the normal's parts back to the apex, along the fan, out of the sheet.
    """
    return [
        back,
        along,
        outward,
        back * (1 - back),
        along * along,
        outward * outward,
        back * along,
        back * outward,
        along * outward,
    ]


def _share(sheet: LaserSheet, phi: mi.Float, rho: mi.Float, s: mi.Float) -> mi.Float:
    """About how much of an endless fan's light reaches a place: it falls off at the fan's edges.

    It is exact where light falls off as the square of the distance from a ray.
    """
    across = rho / dr.hypot(s, 0.5 * sheet.half_width(rho))
    ends = dr.atan(across * (sheet.half_angle - phi)) + dr.atan(across * (sheet.half_angle + phi))
    return dr.maximum(ends / pi, LEAST)


def _fit_coefficients(
    sheet: LaserSheet, lookup: SpreadLookup, phi: Floats, rho: Floats, aside: Floats
) -> Floats:
    """(S, R, A, terms) coefficients for a sheet without thickness, at (S, R, A) places."""
    normals = _normals()
    basis = np.stack(_basis(*normals.T), axis=-1)
    received = thin_sheet(sheet, lookup, phi, rho, aside, normals)
    dimmest = np.maximum(DIM * received[..., :1], DIMMEST * received.max(axis=-1, keepdims=True))
    weight = 1 / np.maximum(np.maximum(received, dimmest), LEAST_LIGHT)
    design = basis * weight[..., np.newaxis]
    transposed = np.swapaxes(design, -1, -2)
    right = transposed @ (received * weight)[..., np.newaxis]
    return np.asarray(np.linalg.solve(transposed @ design, right)[..., 0])


def _normals() -> Floats:
    """(N, 3) parts back to the apex, along the fan, out of the sheet; the first faces the apex."""
    cosine = np.repeat(COSINES[1:], AZIMUTHS)
    azimuth = (2 * pi / AZIMUTHS) * (np.arange(len(cosine)) % AZIMUTHS + 0.5)
    sine = np.sqrt(1 - cosine**2)
    tilted = np.stack([cosine, sine * np.cos(azimuth), sine * np.sin(azimuth)], axis=-1)
    return np.vstack([[1.0, 0.0, 0.0], tilted])


def thin_sheet(
    sheet: LaserSheet,
    lookup: SpreadLookup,
    phi: Floats,
    rho: Floats,
    aside: Floats,
    normals: Floats,
) -> Floats:
    """(..., N) what planes receive of a sheet without thickness, mW/mm2.

    Parameters
    ----------
    sheet : LaserSheet, placed
    lookup : SpreadLookup, of the water
    phi, rho, aside : arrays of one shape, the places, rad and mm
    normals : (N, 3) parts back to the apex, along the fan and out of the sheet
    """
    node, weight = (floats(values) for values in np.polynomial.legendre.leggauss(BEAMS))
    lane = dr.arange(mi.UInt32, phi.size * len(normals) * BEAMS)
    node, weight = (dr.gather(mi.Float, values, lane % BEAMS) for values in (node, weight))
    plane, site = (lane // BEAMS) % len(normals), lane // (BEAMS * len(normals))
    angle, distance, offset = (
        dr.gather(mi.Float, floats(values), site) for values in (phi, rho, aside)
    )
    sine, cosine = dr.sincos(angle)
    ahead, across = (
        sheet.across * sine + sheet.axis * cosine,
        sheet.across * cosine - sheet.axis * sine,
    )
    apex = sheet.apex(mi.Float(0))
    point = apex + sheet.direction(angle) * distance + sheet.normal * offset
    back, along, outward = (dr.gather(mi.Float, floats(part), plane) for part in normals.T)
    surface = across * along + sheet.normal * outward - ahead * back

    centre = dr.clip(angle, -sheet.half_angle, sheet.half_angle)
    scale = dr.maximum(offset / distance, LEAST) + dr.abs(angle - centre)
    low = dr.asinh((-sheet.half_angle - centre) / scale)
    high = dr.asinh((sheet.half_angle - centre) / scale)
    place = 0.5 * (low + high + (high - low) * node)
    ray_angle = centre + scale * dr.sinh(place)
    step = 0.5 * (high - low) * scale * dr.cosh(place) * weight

    way = dr.normalize(sheet.direction(ray_angle))
    towards = dr.dot(way, surface)
    end = dr.dot(point - apex, surface) / dr.minimum(towards, -LEAST)
    end = dr.select(towards < 0, dr.clip(end, 0, FARTHEST_MM), FARTHEST_MM)
    light = lookup.received(apex, way, point, surface, end) * sheet.power_density(ray_angle)
    received = np.array(dr.block_sum(light * step, BEAMS), dtype=float)
    return received.reshape(*phi.shape, len(normals))


def _widen_by_sheet(thin: Floats, sheet: LaserSheet) -> Floats:
    """(S, R, A, terms) means over the Gaussian of the sheet's thickness about each offset."""
    nodes = ASIDE_AXIS.nodes()
    # The middles of even steps never meet the infinite light in the middle of a thin sheet.
    step = REACH * ((np.arange(GLOW_ACROSS) + 0.5) * (2 / GLOW_ACROSS) - 1)
    weight = np.exp(-0.5 * step**2) / np.exp(-0.5 * step**2).sum()
    sigmas = 0.5 * np.array(sheet.half_width(floats(RHO_AXIS.nodes())))
    wide = np.empty_like(thin)
    for row, sigma in enumerate(sigmas):
        place = nodes[:, np.newaxis] - sigma * step
        # (offset, step, node): the share of each node in the light at each place.
        shares = np.maximum(
            1 - np.abs(ASIDE_AXIS.place(np.abs(place))[..., np.newaxis] - np.arange(len(nodes))), 0
        )
        even = weight @ shares
        odd = ((weight * np.sign(place))[:, np.newaxis] @ shares)[:, 0]
        wide[:, row] = np.tensordot(even, thin[:, row], axes=1)
        wide[:, row, :, ODD] = np.tensordot(odd, thin[:, row][..., ODD], axes=1).transpose(2, 0, 1)
    return wide
