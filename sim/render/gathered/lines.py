"""The lit line of a sheet: short straight segments of surfaces that the sheet lights.

Rays of the sheet are traced far closer than segments lie.  The line is cut wherever the surface
ends, begins or is creased; between cuts segments are short where the surface is bent.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, log

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints, Mask
from sim.render.ambient.field import reflectance
from sim.render.plugins.arrays import floats
from sim.render.plugins.sheet import LaserSheet

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
