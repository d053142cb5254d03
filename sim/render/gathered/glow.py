"""The sheet's light that the water scatters onto surfaces: a table in the sheet's own frame.

Every ray of the sheet spreads as a pencil beam does in endless water (sim.water.spread).  At a
place (phi, rho) of the sheet's middle and the offset s from it, a plane surface with the normal n
receives the sum over the fan; the rays end on the surface's own plane.  Along the fan the sum is
over hyperbolic sines of the distance, for light between a line and a point beside it falls off
with the distance.  How the sum depends on n is a polynomial of the second degree, found by least
squares.  The sheet's thickness blurs it along s.
"""

from functools import lru_cache
from math import asinh, pi
from typing import TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from lscan.records import Floats
from sim.render.firstorder import HEAD
from sim.render.gathered.chart import Picture
from sim.render.plugins.arrays import floats, opaque
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import SpreadLookup
from sim.scene import Laser, LaserLine
from sim.water.planes import LogAxis
from sim.water.spread import Spread

# Angles: so many steps to either edge of the fan, where a node lies, and as many beyond.
STEPS = 5
ANGLES = 4 * STEPS + 1
RHO_AXIS = LogAxis(80.0, 3000.0, 12)
ASIDE_AXIS = LogAxis(0.0, 2000.0, 28, 0.1)
BEAMS = 16  # Gauss and Legendre's, of the fan
# Places across the sheet's thickness, out to so many standard deviations.
ACROSS, REACH = 240, 5.0
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
        table = _summed_up(sheet.settings, spread, extinction_per_mm)
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
        light = self.irradiance(middle + across * (s / dr.square(lean)), plane) * _in_strip(s)
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
        within = dr.select(dr.abs(phi) <= self._sheet.half_angle, _in_strip(s), 0.0)
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
            (phi / self._edge + 1) * (0.5 * (ANGLES - 1)),
            _place(RHO_AXIS, rho),
            _place(ASIDE_AXIS, dr.abs(s)),
        )
        size = mi.Vector3f(ANGLES, RHO_AXIS.count, ASIDE_AXIS.count)
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


def _in_strip(s: mi.Float) -> mi.Float:
    """Share of the light s mm off the sheet's middle that counts as of the line."""
    return dr.exp(-0.5 * dr.square(s / STRIP_MM))


@lru_cache(maxsize=8)  # tanks often differ in the target, the camera or the sensor alone
def _summed_up(
    settings: tuple[Laser, LaserLine, float, float], spread: Spread, extinction_per_mm: float
) -> Picture:
    """(S, R, A, terms) the table of a sheet with these settings."""
    sheet = LaserSheet(mi.Properties())
    sheet.configure(*settings)
    sheet.place(HEAD)
    edge = _edge(sheet)
    aside, rho, phi = np.meshgrid(
        ASIDE_AXIS.nodes(), RHO_AXIS.nodes(), np.linspace(-edge, edge, ANGLES), indexing="ij"
    )
    lookup = SpreadLookup(spread, extinction_per_mm)
    terms = _widened(_fitted(sheet, lookup, phi, rho, aside), sheet)
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


def _fitted(
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


def _widened(thin: Floats, sheet: LaserSheet) -> Floats:
    """(S, R, A, terms) means over the Gaussian of the sheet's thickness about each offset."""
    nodes = ASIDE_AXIS.nodes()
    # The middles of even steps never meet the infinite light in the middle of a thin sheet.
    step = REACH * ((np.arange(ACROSS) + 0.5) * (2 / ACROSS) - 1)
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
