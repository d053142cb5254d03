"""Laser light that surfaces reflect onto each other, without random noise.

The line of each sheet lights other surfaces as short straight segments of a matt surface do, in
closed form, less what is hidden.  What those surfaces reflect in their turn comes from patches
(``bounces``), as does how much of the lines is hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import pi

import drjit as dr
import mitsuba as mi
import numpy as np

from sim.meshes import MeshPart
from sim.render.ambient import is_convex, reflectance
from sim.render.gathered.bounces import BesideLine, Bounces, PatchField, beside_line, lasting
from sim.render.gathered.glow import Glow
from sim.render.gathered.line import LitLine, facing, lit_line, received, visible_part
from sim.render.plugins.arrays import opaque
from sim.render.plugins.sheet import LaserSheet
from sim.render.plugins.water import PhaseTable
from sim.render.sampled.integrator import SheetIntegrator
from sim.water import Optics

# How much of the light that a sheet's rays scatter onto a surface other surfaces let through.
#
# Most of it comes along the ray that meets the surface.  Where that is stopped, a place in shadow
# receives a fraction of what is received beside it: light on either side is kept apart.


# Rays of the sheet that stand for all, and places on each: of equal shares of the light that is
# scattered once where it falls off as the square of the distance from the ray.
RAYS, PLACES = 6, 4
START_MM = 0.01  # off the surface


def visible_share(
    scene: mi.Scene,
    sheet: LaserSheet,
    phase: PhaseTable,
    point: mi.Point3f,
    normal: mi.Vector3f,
) -> mi.Float:
    """Share of the sheet's light, scattered once, that gets to places of surfaces, 0 to 1.

    Parameters
    ----------
    scene : mi.Scene
    sheet : LaserSheet, where it is placed
    phase : PhaseTable, of the water
    point : Point3f, mm, world frame
    normal : Vector3f, of the surface, on the side that is lit
    """
    lane = dr.arange(mi.UInt32, dr.width(point) * RAYS)
    index, ray = lane // RAYS, mi.Float(lane % RAYS)
    point, normal = dr.gather(mi.Point3f, point, index), dr.gather(mi.Vector3f, normal, index)
    phi, rho, s = sheet.coordinates(point, mi.Float(0))
    aside = dr.maximum(dr.abs(s), 0.5 * sheet.half_width(rho))
    angle = phi + aside * dr.tan(pi * ((ray + 0.5) / RAYS - 0.5)) / rho
    inside = dr.abs(angle) <= sheet.half_angle
    way = dr.normalize(sheet.direction(angle))
    apex = sheet.apex(mi.Float(0))
    ends = scene.ray_intersect_preliminary(mi.Ray3f(apex, way), active=inside).t
    offset = point - apex
    foot = dr.dot(offset, way)
    beside = dr.norm(offset - way * foot)
    below = phase.line_integral(dr.atan2(beside, foot))
    above = phase.line_integral(mi.Float(pi / 2))
    start, total, seen = point + normal * START_MM, mi.Float(0), mi.Float(0)
    for place in range(PLACES):
        turned = phase.sample_line(below, above, mi.Float((place + 0.5) / PLACES))
        along = dr.maximum(foot - beside / dr.tan(turned), 0)
        towards = apex + way * along - point
        distance = dr.norm(towards)
        towards /= distance
        weight = dr.select(inside, dr.maximum(dr.dot(towards, normal), 0), 0.0)
        total += weight
        lit = (weight > 0) & (along < ends)
        hidden = scene.ray_test(mi.Ray3f(start, towards, distance, 0.0, []), lit)
        seen += dr.select(lit & ~hidden, weight, 0.0)
    total, seen = dr.block_sum(total, RAYS), dr.block_sum(seen, RAYS)
    return dr.select(total > 0, seen / total, 1.0)


def sees_apex(
    scene: mi.Scene, sheet: LaserSheet, point: mi.Point3f, normal: mi.Vector3f, active: mi.Bool
) -> mi.Bool:
    """Whether nothing lies between places and where a sheet's rays come from; False if inactive.

    Parameters
    ----------
    scene, sheet, point, normal : as those of ``visible_share``
    active : Bool, the places that are asked for
    """
    start = point + normal * START_MM
    way = sheet.apex(mi.Float(0)) - start
    far = dr.norm(way)
    ray = mi.Ray3f(start, way / far, far, 0.0, [])
    return active & (dr.dot(way, normal) > 0) & ~scene.ray_test(ray, active)


# Laser light that surfaces reflect onto each other, without random noise.


# Shares of scattered light in and out of the sheet's light: what differs by less is not told apart.
SHARES_DIFFER = 0.02


@dataclass(frozen=True)
class LitSurfaces:
    """What sheets light where they are placed.

    Attributes
    ----------
    lines : tuple of LitLine, one for each sheet
    field : PatchField, irradiance in mW/mm2 by light of the lines that was reflected once, and by
        what was reflected more often or scattered onto surfaces off the lines; of each sheet, the
        share of its line afar that is seen, that of its light that the water scatters, in the
        sheet's light and in shadow, and that light in shadow in mW/mm2.  None where no surface
        sees another
    beside : tuple of BesideLine, light reflected more often once more, about each line
    """

    lines: tuple[LitLine, ...]
    field: PatchField | None
    beside: tuple[BesideLine, ...] = ()


class Reflections:
    """Irradiance of surfaces by light that other surfaces reflect, of a tank."""

    def __init__(
        self,
        scene: mi.Scene,
        parts: Sequence[MeshPart],
        integrator: SheetIntegrator,
        water: Optics,
        glows: Sequence[Glow] = (),
    ) -> None:
        """Work out what stands still.

        Parameters
        ----------
        scene : mi.Scene, its shapes are the parts
        parts : sequence of MeshPart, matt
        integrator : SheetIntegrator, its sheets
        water : Optics
        glows : sequence of Glow, of each sheet; none where the water scatters nothing
        """
        self._scene, self._integrator, self._glows = scene, integrator, glows
        between = lasting(water)
        self._extinction = opaque(between.extinction_per_mm)
        # On convex bodies no surface sees another, and black ones send nothing on.
        dark = is_convex(parts) or not any(part.albedo for part in parts)
        self._bounces = None if dark else Bounces(scene, parts, between)

    def lit(self) -> LitSurfaces:
        """What the sheets light where they are placed now."""
        bounces, sheets = self._bounces, self._integrator.sheets
        if bounces is None:
            return LitSurfaces((), None)
        lines, seen, shares, inside, glows = [], [], [], [], []
        point, normal = bounces.sender_point, bounces.sender_normal
        patches = bounces.point, bounces.normal
        received_once, extinction = mi.Float(0), self._integrator.extinction
        for number, sheet in enumerate(sheets):
            strip = self._glows[number].of_strip if self._glows else None
            line = lit_line(self._scene, sheet, lambda far: dr.exp(-extinction * far), strip)
            part = visible_part(self._scene, line, *patches)
            close, far = received(line, point, normal, self._extinction, mi.Bool(True))
            received_once += close + far * dr.gather(mi.Float, part, bounces.owner)
            lines.append(line)
            seen.append(part)
            shares.append(visible_share(self._scene, sheet, self._integrator.phase, *patches))
            inside.append(sees_apex(self._scene, sheet, *patches, mi.Bool(True)))
            glow = self._glows[number].irradiance(*patches) if self._glows else mi.Float(0)
            glows.append(shares[-1] * glow)
        dr.eval(received_once, seen, shares, inside, glows)
        once = np.array(received_once)
        seen_there = [dr.gather(mi.Float, share, bounces.owner) for share in shares]
        scattered = self._scattered(point, normal, seen_there)
        values = [bounces.about(once), bounces.of(once + np.array(scattered))]
        for part, share, is_lit, glow in zip(seen, shares, inside, glows, strict=True):
            here = np.array(is_lit)
            values += [np.array(part), *bounces.apart(np.array(share), here)]
            values.append(bounces.apart(np.broadcast_to(np.array(glow), here.shape), here)[1])
        field = bounces.field(values)
        lit = LitSurfaces(tuple(lines), field)

        def sent(si: mi.SurfaceInteraction3f) -> mi.Float:
            loss = dr.select(si.is_valid(), dr.exp(-self._extinction * si.t), 0.0)
            light, shares = self.irradiance(lit, si)
            normal, sends = facing(si), reflectance(si) * loss
            dr.eval(light, shares, normal, sends, si.p)  # apart from the glow, as in a picture
            return (light + self._scattered(si.p, normal, shares)) * sends

        beside = [
            beside_line(self._scene, sheet, line, field, sent)
            for sheet, line in zip(sheets, lines, strict=True)
        ]
        return replace(lit, beside=tuple(beside))

    def _scattered(
        self, point: mi.Point3f, normal: mi.Vector3f, shares: Sequence[mi.Float]
    ) -> mi.Float:
        """mW/mm2 that the water scatters onto surfaces, but for what counts as of the lines.

        shares: of each sheet, the share that no surface hides.
        """
        light = mi.Float(0)
        for glow, share in zip(self._glows, shares, strict=False):
            light += share * glow.off_strip(point, normal)
        return light

    def irradiance(
        self, lit: LitSurfaces, si: mi.SurfaceInteraction3f
    ) -> tuple[mi.Float, list[mi.Float]]:
        """Irradiance in mW/mm2 of places of surfaces, and the share of each sheet's glow there.

        Parameters
        ----------
        lit : LitSurfaces
        si : SurfaceInteraction3f, the places, on the side that is seen
        """
        count = len(self._integrator.sheets)
        if lit.field is None:
            return mi.Float(0), [mi.Float(1)] * count
        once, light, *rest = lit.field.at(si)
        for beside in lit.beside:
            light = beside.at(si.p, facing(si), light)
        shares = []
        for number, (line, sheet) in enumerate(
            zip(lit.lines, self._integrator.sheets, strict=True)
        ):
            seen, bright, dark, dim = rest[4 * number : 4 * number + 4]
            close, far = received(line, si.p, facing(si), self._extinction, once > 0)
            light += close + seen * far
            asked = si.is_valid() & (dr.abs(bright - dark) > SHARES_DIFFER)
            is_lit = sees_apex(self._scene, sheet, si.p, facing(si), asked)
            in_shadow = asked & ~is_lit
            light += dr.select(in_shadow, dim, 0.0)
            shares.append(dr.select(in_shadow, 0.0, bright))
        return dr.select(si.is_valid(), light, 0.0), shares
