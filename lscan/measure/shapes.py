"""Planes, spheres and cylinders fitted to a surface, and what a shapes file asks for."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lscan.config.targets import HeightShape, ShapesDocument, SurfaceBox
from lscan.errors import MeasurementError
from lscan.measure.board import algebraic_ball
from lscan.records import Floats, Ints, Mask, Status, Surface, has_value
from lscan.surface.alignment import own_variances, turned_modes
from lscan.surface.surface import sample

# A shape fitted to the points of a surface by least squares of their distances from it.
#
# A point's distance has the standard uncertainty that its own noise has along the shape's normal,
# and is weighed by it.  Three things make the fitted parameters uncertain:
#
# * the points' own noise, through the least squares;
# * errors that neighbours share, such as a lens's blur on a flank: they show as a scatter of the
#   scores, summed over cells of the region, that is larger than independent noise gives, and
# enlarge
#   the covariance by that ratio (the scores' scatter over clusters: Liang and Zeger 1986);
# * the errors of calibration and alignment that all points share, the surface's modes: each
# changes
#   the parameters by a weighted sum of what it does to the distances.
#
# All is of first order in the noise: the radius of a sphere grows by s²/r, 0.3 µm of 30 mm for
# noise of 0.1 mm.


OUTLIER = 5.0
"""Points beyond so many robust standard deviations are left out: of a normal distribution one in
two million."""

LEAST_SIGMA_MM = 1e-4
"""Points are weighed as if known to no better than this: exact ones have weights too."""

CELLS_ACROSS = 8
"""Cells of a region along its longer side: errors of neighbours change within less than that."""

CELLS_A_PARAMETER = 4
"""Fewest cells for each parameter, from which the scatter of their scores is judged: a variance
from 16 or more is known to a third."""

MOST_ITERATIONS = 100

UNDECIDED_ITERATIONS = 15
"""Rounds after which it stays as it is which points are outliers: a doubtful one that came and
went would keep the fit from settling."""

SETTLED = 1e-4
"""Length of a step, in standard deviations, at which the iteration ends."""

SLOW_ITERATIONS = 25
"""Rounds after which it also ends once a step no longer lessens the squares: over the facets of a
mesh steps stay longer."""

SINGULAR = 1e-12
"""Least eigenvalue of the normal matrix, each parameter in its own scale, that determines all of
them: rounding of a double is 2e-16 for each of some thousand points."""

FELT = 1e-9
"""A parameter that changes the distances by less than this, against what another one of them does,
is not determined: a plane's normal has components of 1e-16 within it by rounding alone."""


@dataclass(frozen=True)
class MeasuredPoints:
    """K points of a surface.

    Attributes
    ----------
    xyz_mm : (K, 3) array, mm, frame of the surface
    own_mm2 : (K, 3) array, mm², variances of x, y and z that are each point's own
    modes_mm : (K, 3, M) array, mm, what each independent error of calibration and alignment
        displaces the points by
    """

    xyz_mm: Floats
    own_mm2: Floats
    modes_mm: NDArray[np.floating]

    def only(self, wanted: Mask | Ints) -> "MeasuredPoints":
        """Those of a mask (K,) or of indices.

        Parameters
        ----------
        wanted : (K,) mask or array of indices, of the points kept
        """
        return MeasuredPoints(self.xyz_mm[wanted], self.own_mm2[wanted], self.modes_mm[wanted])


def measured_points(surface: Surface, wanted: Mask | None = None) -> MeasuredPoints:
    """The points of a surface that have a value, profile by profile.

    Parameters
    ----------
    surface : Surface, of F by N points, in either frame
    wanted : (F, N) mask, optional, of those wanted; by default all
    """
    valid = has_value(surface.status) & np.isfinite(surface.xyz_mm).all(axis=-1)
    if wanted is not None:
        valid &= wanted
    index = np.flatnonzero(valid)
    modes = turned_modes(surface, np.eye(3), index)
    return MeasuredPoints(surface.xyz_mm[valid], own_variances(surface)[valid], modes)


@dataclass(frozen=True)
class ShapeTerms:
    """Where K points lie against a shape of P parameters.

    Attributes
    ----------
    distance_mm : (K,) array, mm, signed distance of each point from the shape
    normal : (K, 3) array, unit normals, along which the distance grows
    design : (K, P) array, derivatives of the distances by the parameters
    usable : (K,) mask, of the points that the shape has a distance for
    turn : (P, 3) array, optional, change of the normals by the parameters, alike at all points
    """

    distance_mm: Floats
    normal: Floats
    design: Floats
    usable: Mask
    turn: Floats | None = None

    def sigma_mm(self, points: MeasuredPoints) -> Floats:
        """(K,) mm, standard uncertainty of the distances by the points' own noise.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        variance = (self.normal**2 * points.own_mm2).sum(axis=1)
        return np.sqrt(np.maximum(variance, LEAST_SIGMA_MM**2))

    def by_sigma(self, points: MeasuredPoints) -> Floats:
        """(K, P) derivatives of the distances over their sigma, which turns with the normals.

        Without that, heights alone being uncertain, a plane would come out too steep.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        sigma = self.sigma_mm(points)[:, None]
        if self.turn is None:
            return self.design / sigma
        turned = (self.normal * points.own_mm2) @ self.turn.T / sigma**2
        return (self.design - self.distance_mm[:, None] * turned) / sigma

    def by_modes(self, points: MeasuredPoints) -> Floats:
        """(K, M) mm, change of the distances by each of the points' modes.

        Parameters
        ----------
        points : MeasuredPoints, the K points
        """
        return np.einsum("ki,kim->km", self.normal, points.modes_mm)


class FittedShape(Protocol):
    """A shape in space, of P parameters."""

    def terms(self, xyz_mm: Floats) -> ShapeTerms:
        """Where points (K, 3), mm, lie against it."""
        ...

    def moved(self, step: Floats) -> "FittedShape":
        """The shape with its parameters changed by a step (P,)."""
        ...


@dataclass(frozen=True)
class ShapeFit:
    """A shape fitted to points.

    Attributes
    ----------
    shape : FittedShape, of P parameters
    covariance : (P, P) array, of the parameters, from noise and from errors that neighbours share
    modes : (P, M) array, change of the parameters by each of the points' modes
    determined : bool, whether the points determine all parameters
    terms : ShapeTerms, of all points about the shape
    kept : (K,) mask, of the points that are no outliers
    """

    shape: FittedShape
    covariance: Floats
    modes: Floats
    determined: bool
    terms: ShapeTerms
    kept: Mask

    @property
    def rms_mm(self) -> float:
        """Root mean square distance of the points that are no outliers, mm."""
        return float(np.sqrt(np.mean(self.terms.distance_mm[self.kept] ** 2)))

    def sigma(self, gradient: Floats) -> Floats:
        """(Q,) standard uncertainties of quantities, all causes together.

        Parameters
        ----------
        gradient : (Q, P) array, of the quantities by the parameters
        """
        own = np.einsum("qi,ij,qj->q", gradient, self.covariance, gradient)
        return np.sqrt(np.maximum(own, 0.0) + np.square(gradient @ self.modes).sum(axis=1))

    def share_of_noise(self, points: MeasuredPoints) -> float:
        """How much of what determines the parameters is the points' own noise: of variances.

        Points on one line have noise aside of it too, by which any plane through the line seems
        determined.  The noise counts as alike along all axes: the shape may stand wrongly.

        Parameters
        ----------
        points : MeasuredPoints, that it was fitted to
        """
        noise = np.sqrt(np.maximum(points.own_mm2.max(axis=1, keepdims=True), LEAST_SIGMA_MM**2))
        ways = noise * np.eye(3)[:, None]
        change = np.stack([self.shape.terms(points.xyz_mm + way).design for way in ways])
        change = (change - self.terms.design) / self.terms.sigma_mm(points)[:, None]
        change = change[:, self.kept].reshape(-1, len(self.covariance))
        return float(((change @ self.covariance) * change).sum())


def fit_shape(start: FittedShape, points: MeasuredPoints, what: str) -> ShapeFit:
    """The shape of least squares through points, outliers left out.

    Parameters
    ----------
    start : FittedShape, from which it is looked for
    points : MeasuredPoints, mm
    what : str, how messages call it

    Raises
    ------
    MeasurementError
        Where there are too few points, or the fit does not settle.

    References
    ----------
    Covariance with errors that neighbours share: K.-Y. Liang and S. L. Zeger, Biometrika 73, 13
    (1986).
    """
    shape, kept, least = start, None, np.inf
    for iteration in range(MOST_ITERATIONS):
        terms = shape.terms(points.xyz_mm)
        sigma = terms.sigma_mm(points)
        if kept is None or iteration < UNDECIDED_ITERATIONS:
            kept = _no_outliers(terms, sigma)
        count, fewest = int(kept.sum()), 2 * terms.design.shape[1]
        if count < fewest:
            raise MeasurementError(f"{what}: {count} points lie there, {fewest} are needed")
        weighted, ratio = terms.by_sigma(points)[kept], terms.distance_mm[kept] / sigma[kept]
        step = -_inverse(weighted.T @ weighted)[0] @ (weighted.T @ ratio)
        length = float(np.linalg.norm(weighted @ step))  # in standard deviations
        squares = float(np.square(ratio).sum())
        idle = iteration >= SLOW_ITERATIONS and squares >= least
        if (length < SETTLED and iteration >= UNDECIDED_ITERATIONS) or idle:
            return _shape_fit(shape, points, kept)
        shape, least = shape.moved(step), squares
    raise MeasurementError(f"{what}: the fit does not settle: does what lies there determine it?")


def _no_outliers(terms: ShapeTerms, sigma: Floats) -> Mask:
    """(K,) which points are no outliers; a distance that rounding explains is none."""
    ratio = np.abs(terms.distance_mm) / sigma
    if not terms.usable.any():
        return terms.usable
    # Of a normal distribution the median of the absolute value is 0.6745 sigma.
    spread = float(np.median(ratio[terms.usable])) / 0.6745
    return terms.usable & (ratio <= OUTLIER * spread + LEAST_SIGMA_MM / sigma)


def _inverse(matrix: Floats) -> tuple[Floats, bool]:
    """The inverse of a normal matrix, of what it determines, and whether that is all.

    What it does not determine stays as it is: by the scaled parameters alone, of which the least
    length is taken, a lean of 0.01 about x came out as a turn about z that nothing holds.
    """
    squares = np.diag(matrix)
    scale = np.sqrt(np.where(squares > FELT**2 * squares.max(), squares, np.inf))
    values, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    known = values > SINGULAR
    inverse = (vectors[:, known] / values[known]) @ vectors[:, known].T / np.outer(scale, scale)
    open_ways = vectors[:, ~known] / np.where(np.isfinite(scale), scale, 1.0)[:, None]
    held = np.eye(len(matrix)) - open_ways @ np.linalg.pinv(open_ways)
    return held @ inverse @ held.T, bool(known.all())


def _shape_fit(shape: FittedShape, points: MeasuredPoints, kept: Mask) -> ShapeFit:
    """The fit with its uncertainty, the shape and the points that had a part in it decided."""
    terms = shape.terms(points.xyz_mm)
    sigma = terms.sigma_mm(points)[kept]
    weighted = terms.by_sigma(points)[kept]
    inverse, determined = _inverse(weighted.T @ weighted)
    ratio = terms.distance_mm[kept] / sigma
    excess = _excess(weighted, ratio, inverse, _cells(points.xyz_mm[kept]))
    common = terms.by_modes(points)[kept] / sigma[:, None]
    return ShapeFit(
        shape=shape,
        covariance=inverse * excess,
        modes=-inverse @ (weighted.T @ common),
        determined=determined,
        terms=terms,
        kept=kept,
    )


def _cells(xyz: Floats) -> Ints:
    """(K,) number of the square cell in plan that each point lies in, from 0."""
    plan = xyz[:, :2] - xyz[:, :2].min(axis=0)
    side = max(float(plan.max()) / CELLS_ACROSS, np.finfo(float).tiny)
    place = np.minimum(plan / side, CELLS_ACROSS - 1).astype(np.int64)
    return np.unique(place @ [CELLS_ACROSS, 1], return_inverse=True)[1]


def _excess(weighted: Floats, ratio: Floats, inverse: Floats, cell: Ints) -> float:
    """By how much the parameters' variances are larger than the points' own noise says; 1 or more.

    weighted: (K, P) design and ratio: (K,) distances in units of sigma.
    """
    count, parameters = weighted.shape
    excess = max(1.0, float(ratio @ ratio) / max(count - parameters, 1))
    cells = int(cell.max()) + 1
    if cells < CELLS_A_PARAMETER * parameters:
        return excess
    scores = np.zeros((cells, parameters))
    np.add.at(scores, cell, weighted * ratio[:, None])
    # The fit takes its own freedom out of the scores' scatter.
    freedom = cells / (cells - parameters)
    of_cells = freedom * float(np.trace(inverse @ (scores.T @ scores))) / parameters
    return max(excess, of_cells)


# Planes, spheres and cylinders in space, as shapes to fit, and where their fits start.


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
    return vector / np.linalg.norm(vector)


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


# What a shapes file asks for, measured on a surface: values with their uncertainties.


MOST_POINTS = 50_000
"""Of a shape; more are thinned out evenly: what they add is below what neighbours share."""

SMALL = 1e-5
"""Change of a parameter, mm or rad, by which quantities are differentiated: their second
derivatives, below 1e3, then count for 1e-7 of a slope of 1, and rounding for as little."""

MOST_NOISE = 0.1  # in what determines a shape: of a plane, profiles six sigmas apart, or nearer


@dataclass(frozen=True)
class Quantity:
    """A measured value and its standard uncertainty, all causes together, in the value's unit."""

    value: float
    sigma: float


@dataclass(frozen=True)
class ShapeMeasure:
    """What was measured of one entry of a shapes file.

    Attributes
    ----------
    name : str, of the entry
    kind : str, "plane", "step", "sphere", "cylinder" or "height"
    values : mapping of Quantity, by quantity, whose name ends with its unit
    points, outliers : int or None, number of points used, and of those left out as too far off;
        None of a height
    rms_mm : float or None, mm, root mean square distance of the points used from the shape
    """

    name: str
    kind: str
    values: Mapping[str, Quantity]
    points: int | None = None
    outliers: int | None = None
    rms_mm: float | None = None

    def as_json(self) -> dict[str, Any]:
        """The entry as JSON has it."""
        counts = {"points": self.points, "outliers": self.outliers, "rms_mm": self.rms_mm}
        values = {name: asdict(one) for name, one in self.values.items()}
        known = {name: count for name, count in counts.items() if count is not None}
        return {"kind": self.kind, "values": values, **known}


def measure_shapes(surface: Surface, wanted: ShapesDocument) -> list[ShapeMeasure]:
    """All that a shapes file asks for.

    Parameters
    ----------
    surface : Surface, mm; the file's coordinates are those of its frame
    wanted : ShapesDocument, what is measured, and where

    Raises
    ------
    MeasurementError
        Names the entry where there is too little of the surface, or another shape.

    Examples
    --------
    >>> import lscan
    >>> from lscan.config.targets import ShapesDocument
    >>> surface = lscan.load_surface("surface.nc")
    >>> wanted = ShapesDocument.model_validate(
    ...     {"plane": [{"name": "top", "x_mm": [180, 200], "y_mm": [-1, 2]}]}
    ... )
    >>> [measure.name for measure in measure_shapes(surface, wanted)]
    ['top']
    """
    found = [_planes(surface, "plane", one.name, [one]) for one in wanted.plane]
    found += [_planes(surface, "step", one.name, [one.upper, one.lower]) for one in wanted.step]
    for kind, shape, entries in (
        ("sphere", SphereShape, wanted.sphere),
        ("cylinder", CylinderShape, wanted.cylinder),
    ):
        for entry in entries:
            points = _points_in_box(surface, entry, entry.name)
            fit = fit_shape(shape.start(points.xyz_mm), points, f"{kind} {entry.name!r}")
            found.append(_measure(kind, entry.name, fit, points))
    return found + [_height(surface, one) for one in wanted.height]


def _planes(surface: Surface, kind: str, name: str, boxes: Sequence[SurfaceBox]) -> ShapeMeasure:
    """One plane, or two parallel ones, the upper first."""
    parts = [_points_in_box(surface, box, name) for box in boxes]
    alike = zip(*((part.xyz_mm, part.own_mm2, part.modes_mm) for part in parts), strict=True)
    points = MeasuredPoints(*map(np.concatenate, alike))
    which: Ints = np.repeat(np.arange(len(parts)), [len(part.xyz_mm) for part in parts])
    start = ParallelPlanes.start(points.xyz_mm, which)
    return _measure(kind, name, fit_shape(start, points, f"{kind} {name!r}"), points)


def _points_in_box(surface: Surface, box: SurfaceBox, name: str) -> MeasuredPoints:
    """The surface's points in the box, at most MOST_POINTS of them."""
    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    inside: Mask = np.ones(x.shape, dtype=bool)
    for values, limits in ((x, box.x_mm), (y, box.y_mm), (z, box.z_mm)):
        if limits is not None:
            inside &= (values >= limits[0]) & (values <= limits[1])
    points = measured_points(surface, inside)
    if len(points.xyz_mm) == 0:
        what = f"{name!r}: the surface has no point in its box; it has points in {_reach(surface)}"
        raise MeasurementError(what)
    return points.only(np.arange(0, len(points.xyz_mm), -(-len(points.xyz_mm) // MOST_POINTS)))


def _reach(surface: Surface) -> str:
    """From where to where there are points, in words."""
    points = surface.xyz_mm[has_value(surface.status)]
    sides = zip(
        "xyz", points.min(axis=0, initial=np.inf), points.max(axis=0, initial=-np.inf), strict=True
    )
    return ", ".join(f"{axis} from {low:.1f} to {high:.1f} mm" for axis, low, high in sides)


def _measure(kind: str, name: str, fit: ShapeFit, points: MeasuredPoints) -> ShapeMeasure:
    """The quantities of a fitted shape with their uncertainties."""
    shape = fit.shape
    assert isinstance(shape, MeasuredShape)
    if not fit.determined or fit.share_of_noise(points) > MOST_NOISE:
        what = f"{kind} {name!r}: the points in its box do not determine it, given their scatter"
        raise MeasurementError(what)
    values = shape.quantities()
    sigma = fit.sigma(_gradient(shape, len(fit.covariance)))
    return ShapeMeasure(
        name=name,
        kind=kind,
        values={
            key: Quantity(values[key], s) for key, s in zip(values, sigma.tolist(), strict=True)
        },
        points=int(fit.kept.sum()),
        outliers=int((~fit.kept).sum()),
        rms_mm=fit.rms_mm,
    )


def _gradient(shape: MeasuredShape, parameters: int) -> Floats:
    """(Q, P) of a shape's quantities by its parameters, by central differences."""

    def at(step: Floats) -> Floats:
        return np.array(list(shape.moved(step).quantities().values()))

    steps = SMALL * np.eye(parameters)
    return np.stack([(at(step) - at(-step)) / (2 * SMALL) for step in steps], axis=1)


def _height(surface: Surface, wanted: HeightShape) -> ShapeMeasure:
    """The difference in height of two places; what errs in common at both cancels."""
    places = sample(surface, np.array([wanted.from_mm, wanted.to_mm], dtype=float))
    if (places.status != Status.OK).any():
        missing = (wanted.from_mm, wanted.to_mm)[int(np.argmax(places.status != Status.OK))]
        raise MeasurementError(
            f"height {wanted.name!r}: too few points lie within {places.radius_mm:.3g} mm of "
            f"{missing}"
        )
    modes = np.zeros((2, 0)) if places.modes_mm is None else places.modes_mm
    own = places.sigma_z_mm**2 - np.square(modes).sum(axis=1)
    variance = float(np.maximum(own, 0.0).sum() + np.square(modes[1] - modes[0]).sum())
    height = float(places.z_mm[1] - places.z_mm[0])
    measured = Quantity(height, float(np.sqrt(variance)))
    return ShapeMeasure(wanted.name, "height", {"height_mm": measured})
