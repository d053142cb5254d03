"""Light that was reflected twice and more, beside a lit line.

Where the line runs into a corner such light falls off within millimetres of it, far closer than
patches lie.  It is gathered anew at the most lit nodes of a lattice along the line and across it,
out of a few directions each, from what patches and the line send there.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import asinh

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats, Ints
from sim.render.ambient.field import TURN
from sim.render.gathered.bounces import PatchField
from sim.render.gathered.lines import CLUSTER, CREASE_RAD, LEAVES, SEGMENTS, LitLine, facing
from sim.render.gathered.received import START_MM, received
from sim.render.plugins.arrays import floats, indices, vectors
from sim.render.plugins.sheet import LaserSheet

# Columns on either side of the line, at hyperbolic sines of even steps: the first is about
# FINEST_MM off, the last, at REACH_MM, knows what patches do.
ASIDE, FINEST_MM, REACH_MM = 5, 1.0, 20.0
COLUMNS, STEP = 2 * ASIDE + 1, asinh(REACH_MM / FINEST_MM) / ASIDE
GATHERING, DIRECTIONS = 704, 32  # nodes, and directions from each
# Rows along the line: one for every other segment, and others so many mm before the ends of its
# pieces, for in a corner light grows as fast as the distance shrinks.
EVERY, CORNER_MM = 2, (0.25, 0.8, 2.0)
ROWS = SEGMENTS // EVERY + 128
ANGLES = 16384  # of the fan, at which the place between rows is kept
NEAR_MM = 0.05  # off a node's tangent plane, of places on its surface, beside LEAVES times as far
LIKE = 1 - 2 * CREASE_RAD**2  # cosine between normals of one surface: twice a crease
Radiosity = Callable[[mi.SurfaceInteraction3f], mi.Float]


@dataclass(frozen=True)
class BesideLine:
    """Irradiance about the line of a sheet, where it is placed.

    Attributes
    ----------
    sheet : LaserSheet
    nodes : Float, 8 numbers each, row by row: place in mm, irradiance in mW/mm2; normal, 0
    rows : Float, at ANGLES of the fan, the number of the row there
    """

    sheet: LaserSheet
    nodes: mi.Float
    rows: mi.Float

    def at(self, point: mi.Point3f, normal: mi.Vector3f, otherwise: mi.Float) -> mi.Float:
        """At places of surfaces; linear between those of the four nodes that lie on the same one.

        Parameters
        ----------
        point, normal : Point3f, mm, and Vector3f, of the places
        otherwise : Float, where there are none
        """
        phi, _, aside = self.sheet.coordinates(point, mi.Float(0))
        return dr.if_stmt(  # few places are: the others cost nothing
            (point, normal, phi, aside, otherwise),
            (dr.abs(aside) < REACH_MM) & (dr.abs(phi) < self.sheet.half_angle),
            self._between_nodes,
            lambda *at: at[-1],
        )

    def _between_nodes(
        self,
        point: mi.Point3f,
        normal: mi.Vector3f,
        phi: mi.Float,
        aside: mi.Float,
        otherwise: mi.Float,
    ) -> mi.Float:
        """At places within the nodes: rad from the fan's axis and mm off the sheet's plane."""
        angle, along = _between((phi / self.sheet.half_angle + 1) * (0.5 * (ANGLES - 1)), ANGLES)
        first, behind = (dr.gather(mi.Float, self.rows, angle + k) for k in (0, 1))
        row, down = _between(first + along * (behind - first), ROWS)
        column, right = _between(dr.asinh(aside / FINEST_MM) / STEP + ASIDE, COLUMNS)
        total, weight = mi.Float(0), mi.Float(0)
        for one, high in ((0, 1 - down), (1, down)):
            for other, wide in ((0, 1 - right), (1, right)):
                index = 2 * ((row + one) * COLUMNS + column + other)
                node = dr.gather(mi.Vector4f, self.nodes, index)
                upright = dr.gather(mi.Vector4f, self.nodes, index + 1)
                plane = mi.Vector3f(upright.x, upright.y, upright.z)
                offset = point - mi.Point3f(node.x, node.y, node.z)
                above = dr.abs(dr.dot(offset, plane)) - LEAVES * dr.norm(offset)
                same = (above < NEAR_MM) & (dr.dot(normal, plane) > LIKE)
                share = dr.select(same, high * wide, 0.0)
                total, weight = total + share * node.w, weight + share
        return dr.select(weight > 0, total / weight, otherwise)


def _between(place: mi.Float, count: int) -> tuple[mi.UInt32, mi.Float]:
    """The last of so many nodes before a place, but for the very last, and how far behind it."""
    place = dr.clip(place, 0, count - 1)
    before = dr.minimum(mi.UInt32(place), count - 2)
    return before, place - mi.Float(before)


def beside_line(
    scene: mi.Scene, sheet: LaserSheet, line: LitLine, field: PatchField, sent: Radiosity
) -> BesideLine:
    """Gather the light beside a line.

    Parameters
    ----------
    scene : mi.Scene
    sheet : LaserSheet, where it is placed
    line : LitLine, its line
    field : PatchField, whose first two numbers are irradiance by light that was reflected once,
        and more often
    sent : function of what rays meet, the radiosity in mW/mm2 that arrives of it
    """
    place = _row_places(np.array(line.segments).reshape(SEGMENTS, -1))
    phi, _, _ = sheet.coordinates(mi.Point3f(vectors(place.T)), mi.Float(0))
    angle = np.maximum.accumulate(np.array(phi))
    half, number = float(sheet.half_angle[0]), np.arange(ROWS)
    rows = np.interp(np.linspace(-half, half, ANGLES), angle, number)
    lane = dr.arange(mi.UInt32, ROWS * COLUMNS)
    column = mi.Float(lane % COLUMNS) - ASIDE
    origin = sheet.apex(mi.Float(0)) + sheet.normal * (FINEST_MM * dr.sinh(STEP * column))
    way = sheet.direction(dr.gather(mi.Float, floats(angle), lane // COLUMNS))
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(origin), dr.normalize(way)))
    normal, (_, more, *_) = facing(si), field.at(si)
    inner = si.is_valid() & (dr.abs(column) < ASIDE)
    close, _ = received(line, si.p, normal, mi.Float(0), inner)
    columns = [*si.p, more, *normal, mi.Float(0), close]
    dr.eval(columns)
    nodes = np.stack([np.broadcast_to(np.array(values), len(lane)) for values in columns], axis=-1)
    most = np.argsort(-nodes[:, 8], kind="stable")[:GATHERING]
    nodes[most, 3] = _gathered(scene, most, nodes[most], sent)
    return BesideLine(sheet, floats(nodes[:, :8]), floats(rows))


def _row_places(segments: Floats) -> Floats:
    """(ROWS, 3) mm, along the line: the middles of its segments, and places near corners.

    Its pieces end where the next segment begins by more than half of one farther on, or is turned.
    """
    middle, half, along = segments[:, :3], segments[:, 3:4], segments[:, 8:11]
    ends = np.stack([middle - half * along, middle + half * along])
    apart = np.linalg.norm(ends[0, 1:] - ends[1, :-1], axis=1) > half[1:, 0]
    turned = np.sum(segments[1:, 4:7] * segments[:-1, 4:7], axis=1) < LIKE
    cut = np.concatenate([[True], apart | turned, [True]])
    places, order = [middle[::EVERY]], [np.arange(0, SEGMENTS, EVERY, dtype=float)]
    for which, (end, sign) in enumerate(zip(ends, (1, -1), strict=True)):
        number = np.flatnonzero(cut[which : which + SEGMENTS])
        for off_mm in CORNER_MM:
            inner = number[CLUSTER * half[number, 0] > off_mm]
            places.append(end[inner] + sign * off_mm * along[inner])
            order.append(inner - sign * (1 - off_mm / half[inner, 0]) / 2)
    placed = np.concatenate(places)[np.argsort(np.concatenate(order)[:ROWS], kind="stable")]
    return np.pad(placed, ((0, ROWS - len(placed)), (0, 0)), mode="edge")


def _gathered(scene: mi.Scene, number: Ints, nodes: Floats, sent: Radiosity) -> Floats:
    """Irradiance of nodes, given their numbers: means over directions on a spiral each."""
    lane = dr.arange(mi.UInt32, DIRECTIONS * len(number))
    index, which = lane // DIRECTIONS, lane % DIRECTIONS
    point, normal = (
        dr.gather(kind, floats(nodes[:, some]), index)
        for kind, some in ((mi.Point3f, np.s_[:3]), (mi.Vector3f, np.s_[4:7]))
    )
    turned = DIRECTIONS * dr.gather(mi.UInt32, indices(number), index)
    sine, cosine = dr.sincos(TURN * mi.Float(turned + which))
    radius2 = (mi.Float(which) + 0.5) / DIRECTIONS
    radius = dr.sqrt(radius2)
    towards = mi.Vector3f(cosine * radius, sine * radius, dr.sqrt(1 - radius2))
    ray = mi.Ray3f(point + START_MM * normal, mi.Frame3f(normal).to_world(towards))
    return np.array(dr.block_sum(sent(scene.ray_intersect(ray)), DIRECTIONS)) / DIRECTIONS
