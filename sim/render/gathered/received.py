"""What places of surfaces receive from a lit line in closed form, and how much of it is hidden."""

import drjit as dr
import mitsuba as mi

from sim.render.gathered.lines import CLUSTER, CLUSTERS, LitLine

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
