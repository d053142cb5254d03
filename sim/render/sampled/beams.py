"""How a ray of the laser is drawn for light that goes to a point, and how probable it is.

Its angle in the fan and its offset across the sheet are drawn near the point, for the light
between a line and a point beside it falls off with the distance.
"""

from dataclasses import dataclass
from math import pi, sqrt

import drjit as dr
import mitsuba as mi

from sim.render.plugins.sheet import LaserSheet

FARTHEST_MM = 1e5
# The beam is drawn from a Gaussian this much wider than the sheet where its middle meets a
# surface, so that a nearer surface beside it, where it is wider seen from the apex, does not
# weigh too much.
WIDER = 1.3
NARROWEST = 1e-4  # rad: the least scale on which the fan's angle is drawn
# Within the line, half the beams are drawn about the point itself, no farther than this many
# half widths: light between a line and a point beside it goes as 1 / distance.
ABOUT, ABOUT_REACH, ABOUT_WITHIN = 0.5, 2.0, 1.5


@dataclass(frozen=True)
class Falloff:
    """A density about a centre, 1 / sqrt(scale2 + (x - centre)2), cut off at both ends.

    That is how light from a line falls off with the distance along it.
    """

    centre: mi.Float
    scale: mi.Float
    first: mi.Float
    last: mi.Float
    low: mi.Float
    high: mi.Float

    def sample(self, sample: mi.Float) -> mi.Float:
        """An angle or a place, no farther than the ends, where rounding would put a few."""
        place = self.centre + self.scale * dr.sinh(dr.lerp(self.low, self.high, sample))
        return dr.clip(place, self.first, self.last)

    def density(self, x: mi.Float) -> mi.Float:
        """Probability per unit."""
        spread = dr.sqrt(dr.square(self.scale) + dr.square(x - self.centre))
        return 1 / (spread * (self.high - self.low))


@dataclass(frozen=True)
class BeamDensity:
    """How a ray of the laser is drawn for light that goes to a point.

    fan: density of its angle phi.  Across the sheet it is drawn in units of the sheet's
    standard deviation, from a Gaussian of WIDER; or, with the odds ``about``, in polar
    coordinates around the point, of the radius ``reach`` mm.  phi, rho, offset: the point's
    own; unit: mm of the standard deviation there.
    """

    fan: Falloff
    about: mi.Float
    reach: mi.Float
    phi: mi.Float
    rho: mi.Float
    offset: mi.Float
    unit: mi.Float

    def sample(
        self, choice: mi.Float, first: mi.Point2f, second: mi.Float
    ) -> tuple[mi.Float, mi.Float]:
        """phi, and the offset across in standard deviations."""
        s, c = dr.sincos(2 * pi * first.y)
        radius = self.reach * first.x
        near_phi = self.phi + radius * c / self.rho
        near_lateral = (self.offset + radius * s) / self.unit
        lateral = WIDER * mi.warp.square_to_std_normal(first).x
        near = choice < self.about
        phi = dr.select(near, near_phi, self.fan.sample(second))
        return phi, dr.select(near, near_lateral, lateral)

    def density(self, phi: mi.Float, lateral: mi.Float) -> mi.Float:
        """Probability per radian and standard deviation."""
        wide = self.fan.density(phi) * gaussian(lateral / WIDER) / WIDER
        along, across = self.rho * (phi - self.phi), self.unit * lateral - self.offset
        radius = dr.maximum(dr.sqrt(dr.square(along) + dr.square(across)), 1e-9)
        polar = self.rho * self.unit / (2 * pi * radius * self.reach)
        # A hair more, for what rounding puts beside the circle.
        near = dr.select(radius <= 1.0001 * self.reach, polar, 0.0)
        in_fan = (phi >= self.fan.first) & (phi <= self.fan.last)
        return (1 - self.about) * dr.select(in_fan, wide, 0.0) + self.about * near


@dataclass(frozen=True)
class Beam:
    """One ray of the laser.

    phi: its angle in the fan.  lateral: its offset across, in standard deviations of the
    sheet.  density: probability of both.  power: mW, of the Gaussian sheet, per that.
    """

    phi: mi.Float
    lateral: mi.Float
    density: mi.Float
    power: mi.Float


@dataclass(frozen=True)
class StraightRays:
    """Rays of one angle in the fan as straight lines that start beside the apex.

    middle: the sheet's direction at that angle.  first: a standard deviation of the sheet at the
    apex, mm.  slope: by how much it grows per rho.
    """

    apex: mi.Point3f
    middle: mi.Vector3f
    normal: mi.Vector3f
    first: mi.Float
    slope: mi.Float

    def line(self, lateral: mi.Float) -> tuple[mi.Point3f, mi.Vector3f]:
        """Start and direction, per rho, of the ray so many standard deviations off the middle."""
        origin = self.apex + self.normal * (self.first * lateral)
        return origin, self.middle + self.normal * (self.slope * lateral)

    def unit(self, rho: mi.Float) -> mi.Float:
        """A standard deviation, mm."""
        return self.first + self.slope * rho

    def area(self, rho: mi.Float, along: mi.Vector3f, normal: mi.Vector3f) -> mi.Float:
        """Of a surface, mm2, that the rays meet per radian and standard deviation.

        Across the fan's plane, in which ``along`` has the length 1, it is rho times ``unit``.
        """
        return rho * self.unit(rho) / dr.abs(dr.dot(normal, along))


def straight_rays(
    scene: mi.Scene, sheet: LaserSheet, phi: mi.Float, time: mi.Float, active: mi.Bool
) -> StraightRays:
    """Rays as far apart as the sheet is wide at the apex and where its middle meets a surface.

    Parameters
    ----------
    scene : Scene, its surfaces
    sheet : LaserSheet, where it is placed
    phi : Float, rad, the rays' angle in the fan
    time : Float, s
    active : Bool, which of the lanes are wanted
    """
    apex, middle = sheet.apex(time), sheet.direction(phi)
    length = dr.norm(middle)
    ray = mi.Ray3f(apex, middle / length, time, [])
    hit = scene.ray_intersect_preliminary(ray, coherent=False, active=active)
    waist = dr.maximum(dr.abs(sheet.waist_distance), 100.0)
    rho = dr.select(hit.is_valid(), hit.t / length, waist)
    first = 0.5 * sheet.half_width(mi.Float(0))
    slope = (0.5 * sheet.half_width(rho) - first) / rho
    return StraightRays(apex, middle, sheet.normal, first, slope)


def beam_density(sheet: LaserSheet, about: mi.Point3f, time: mi.Float) -> BeamDensity:
    """How a ray of the sheet is drawn for light that goes to ``about``."""
    phi, rho, s = sheet.coordinates(about, time)
    width = sheet.half_width(rho)
    centre = dr.clip(phi, -sheet.half_angle, sheet.half_angle)
    rho = dr.maximum(rho, 1.0)
    scale = (dr.abs(s) + 0.5 * width) / rho + dr.abs(phi - centre)
    fan = falloff(centre, dr.clip(scale, NARROWEST, 1.0), -sheet.half_angle, sheet.half_angle)
    within = (dr.abs(s) < ABOUT_WITHIN * width) & (phi == centre)
    return BeamDensity(
        fan=fan,
        about=dr.select(within, ABOUT, 0.0),
        reach=ABOUT_REACH * width,
        phi=phi,
        rho=rho,
        offset=s,
        unit=0.5 * width,
    )


def drawn_beam(
    sheet: LaserSheet, sampler: mi.Sampler, about: mi.Point3f, time: mi.Float, active: mi.Bool
) -> Beam:
    """A ray of the sheet, drawn for light that goes to ``about``.

    Parameters
    ----------
    sheet : LaserSheet, where it is placed
    sampler : Sampler, of four numbers a lane
    about : Point3f, mm, world frame
    time : Float, s
    active : Bool, which of the lanes are wanted
    """
    drawn = beam_density(sheet, about, time)
    choice, second = sampler.next_1d(active), sampler.next_1d(active)
    phi, lateral = drawn.sample(choice, sampler.next_2d(active), second)
    density = drawn.density(phi, lateral)
    power = sheet.power_density(phi) * gaussian(lateral) / density
    return Beam(phi, lateral, density, dr.select(density > 0, power, 0.0))


def falloff(centre: mi.Float, scale: mi.Float, first: mi.Float, last: mi.Float) -> Falloff:
    """The density between ``first`` and ``last``."""
    low, high = dr.asinh((first - centre) / scale), dr.asinh((last - centre) / scale)
    return Falloff(centre, scale, first, last, low, high)


def line_density(centre: mi.Float, scale: mi.Float, end: mi.Float) -> Falloff:
    """The density of a place between 0 and ``end`` on a line.

    Parameters
    ----------
    centre, scale : Float, mm, where the density is highest, and how far it reaches from there
    end : Float, mm, of the line
    """
    return falloff(dr.clip(centre, 0, end), dr.clip(scale, 1e-2, FARTHEST_MM), mi.Float(0), end)


def gaussian(x: mi.Float) -> mi.Float:
    """The standard normal density."""
    return dr.exp(-0.5 * dr.square(x)) / sqrt(2 * pi)
