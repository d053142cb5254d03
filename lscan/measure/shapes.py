"""Planes, spheres and cylinders in space, as shapes to fit, and where their fits start."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lscan.measure.circle import algebraic_ball
from lscan.measure.shapefit import ShapeTerms
from lscan.records import Floats, Ints

DIRECTIONS = 200
"""Of a cylinder's axis that are tried, even over half a sphere: 10 degrees from one to the next."""

MOST_TRIED = 200
"""Points that the directions are tried on, evenly picked."""


def tangents(direction: Floats) -> Floats:
    """(2, 3) unit vectors square to a direction and to each other.

    Parameters
    ----------
    direction : (3,) array, unit vector
    """
    least = np.eye(3)[np.argmin(np.abs(direction))]
    first = np.cross(direction, least)
    first = first / np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def _unit(vector: Floats) -> Floats:
    unit: Floats = vector / np.linalg.norm(vector)
    return unit


@dataclass(frozen=True)
class ParallelPlanes:
    """Planes of one normal: (p - pivot) . normal = offset.

    Its parameters are two tilts of the normal (rad) and the offsets (mm).

    Attributes
    ----------
    normal : (3,) array, unit vector, upwards
    offsets_mm : (Q,) array, mm, of the planes
    pivot_mm : (3,) array, mm, the points' mean
    plane : (K,) array, the plane that each of the points belongs to
    """

    normal: Floats
    offsets_mm: Floats
    pivot_mm: Floats
    plane: Ints

    @classmethod
    def start(cls, xyz_mm: Floats, plane: Ints) -> "ParallelPlanes":
        """Level planes at the median heights of their points.

        Parameters
        ----------
        xyz_mm : (K, 3) array, mm
        plane : (K,) array, from 0, the plane of each point
        """
        pivot = xyz_mm.mean(axis=0)
        heights = [np.median(xyz_mm[plane == k, 2]) for k in range(int(plane.max()) + 1)]
        return cls(np.array([0.0, 0.0, 1.0]), np.array(heights) - pivot[2], pivot, plane)

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """As of FittedShape."""
        offset = xyz_mm - self.pivot_mm
        along = tangents(self.normal)
        return ShapeTerms(
            distance_mm=offset @ self.normal - self.offsets_mm[self.plane],
            normal=np.broadcast_to(self.normal, xyz_mm.shape),
            design=np.column_stack([offset @ along.T, -np.eye(len(self.offsets_mm))[self.plane]]),
            usable=np.ones(len(xyz_mm), dtype=bool),
            turn=np.vstack([along, np.zeros((len(self.offsets_mm), 3))]),
        )

    def moved(self, step: Floats) -> "ParallelPlanes":
        """As of FittedShape."""
        normal = self.normal + step[:2] @ tangents(self.normal)
        length = float(np.linalg.norm(normal))
        offsets = (self.offsets_mm + step[2:]) / length
        return replace(self, normal=normal / length, offsets_mm=offsets)

    def quantities(self) -> Mapping[str, float]:
        """Height: of one plane at the pivot, mm; of two, the first above the second; slopes."""
        slope_x, slope_y = np.degrees(np.arctan(-self.normal[:2] / self.normal[2])).tolist()
        if len(self.offsets_mm) == 1:
            height = float(self.pivot_mm[2] + self.offsets_mm[0] / self.normal[2])
        else:
            height = float(self.offsets_mm[0] - self.offsets_mm[1])
        return {"height_mm": height, "slope_x_deg": slope_x, "slope_y_deg": slope_y}


@dataclass(frozen=True)
class SphereShape:
    """A sphere; its parameters are the centre's coordinates and the radius, mm.

    Attributes
    ----------
    centre_mm : (3,) array, mm
    radius_mm : float, mm
    """

    centre_mm: Floats
    radius_mm: float

    @classmethod
    def start(cls, xyz_mm: Floats) -> "SphereShape":
        """The algebraic sphere of points.

        Parameters
        ----------
        xyz_mm : (K, 3) array, mm
        """
        *centre, radius = algebraic_ball(xyz_mm).tolist()
        return cls(np.array(centre), radius)

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """As of FittedShape."""
        distance, normal = _away(xyz_mm - self.centre_mm)
        return ShapeTerms(
            distance_mm=distance - self.radius_mm,
            normal=normal,
            design=np.column_stack([-normal, -np.ones(len(normal))]),
            usable=np.ones(len(normal), dtype=bool),
        )

    def moved(self, step: Floats) -> "SphereShape":
        """As of FittedShape."""
        return SphereShape(self.centre_mm + step[:3], self.radius_mm + float(step[3]))

    def quantities(self) -> Mapping[str, float]:
        """Radius and centre, mm."""
        x, y, z = self.centre_mm.tolist()
        return {"radius_mm": self.radius_mm, "x_mm": x, "y_mm": y, "z_mm": z}


@dataclass(frozen=True)
class CylinderShape:
    """A cylinder; its parameters are two offsets (mm) and tilts (rad) of its axis, and the radius.

    Attributes
    ----------
    axis_mm : (3,) array, mm, the point of the axis nearest to ``pivot_mm``
    direction : (3,) array, unit vector along the axis
    radius_mm : float, mm
    pivot_mm : (3,) array, mm, the points' mean
    """

    axis_mm: Floats
    direction: Floats
    radius_mm: float
    pivot_mm: Floats

    @classmethod
    def start(cls, xyz_mm: Floats) -> "CylinderShape":
        """The algebraic cylinder along that of many directions which suits the points best.

        Parameters
        ----------
        xyz_mm : (K, 3) array, mm
        """
        some = xyz_mm[:: int(np.ceil(len(xyz_mm) / MOST_TRIED))]
        pivot = xyz_mm.mean(axis=0)
        directions = _half_sphere(DIRECTIONS)
        across = np.stack([tangents(direction) for direction in directions])
        plan = np.einsum("ki,dci->dkc", some - pivot, across)
        centre, radius = _circles(plan)
        off = np.abs(np.linalg.norm(plan - centre[:, None], axis=-1) - radius[:, None])
        best = int(np.argmin(np.median(off, axis=1)))
        axis = pivot + centre[best] @ across[best]
        return cls(axis, directions[best], float(radius[best]), pivot)

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """As of FittedShape."""
        offset = xyz_mm - self.axis_mm
        along = offset @ self.direction
        distance, normal = _away(offset - along[:, None] * self.direction)
        facing = normal @ tangents(self.direction).T
        return ShapeTerms(
            distance_mm=distance - self.radius_mm,
            normal=normal,
            design=np.column_stack([-facing, -along[:, None] * facing, -np.ones(len(normal))]),
            usable=np.ones(len(normal), dtype=bool),
        )

    def moved(self, step: Floats) -> "CylinderShape":
        """As of FittedShape."""
        across = tangents(self.direction)
        direction = _unit(self.direction + step[2:4] @ across)
        axis = self.axis_mm + step[:2] @ across
        axis = axis + ((self.pivot_mm - axis) @ direction) * direction
        return replace(
            self, axis_mm=axis, direction=direction, radius_mm=self.radius_mm + float(step[4])
        )

    def quantities(self) -> Mapping[str, float]:
        """Radius, the point of the axis nearest to the points' mean, mm; the axis's angles.

        turn_deg: of its plan, from x towards y; rise_deg: from level, upwards along that.
        """
        x, y, z = self.axis_mm.tolist()
        # Forwards along x or y, whichever it is nearer to: at the turn of 180 degrees no angle.
        along = self.direction * np.sign(self.direction[np.argmax(np.abs(self.direction[:2]))])
        turn = float(np.degrees(np.arctan2(along[1], along[0])))
        rise = float(np.degrees(np.arctan2(along[2], np.hypot(along[0], along[1]))))
        place = {"x_mm": x, "y_mm": y, "z_mm": z}
        return {"radius_mm": self.radius_mm, **place, "turn_deg": turn, "rise_deg": rise}


MeasuredShape = ParallelPlanes | SphereShape | CylinderShape


def _away(offset: Floats) -> tuple[Floats, Floats]:
    """(K,) lengths of (K, 3) offsets, mm, and (K, 3) their directions."""
    distance = np.maximum(np.linalg.norm(offset, axis=1), np.finfo(float).tiny)
    return distance, offset / distance[:, None]


def _circles(plan: Floats) -> tuple[Floats, Floats]:
    """Centres (D, 2) and radii (D,) of the algebraic circles of D sets of points (D, K, 2).

    By normal equations, which points on a line leave singular: precise enough to start from.
    """
    design = np.concatenate([plan, np.ones((*plan.shape[:2], 1))], axis=-1)
    right = -np.einsum("dkp,dk->dp", design, np.square(plan).sum(axis=-1))
    normal = np.swapaxes(design, 1, 2) @ design
    solution = (np.linalg.pinv(normal) @ right[..., None])[..., 0]
    centre = -solution[:, :2] / 2
    radius = np.sqrt(np.maximum(np.square(centre).sum(axis=1) - solution[:, 2], 0.0))
    return centre, radius


def _half_sphere(count: int) -> Floats:
    """(count, 3) unit vectors spread evenly over half a sphere: a Fibonacci lattice.

    References
    ----------
    A. Gonzalez, Math. Geosci. 42, 49 (2010).
    """
    z = (np.arange(count) + 0.5) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5.0))
    across = np.sqrt(1 - z**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), z])
