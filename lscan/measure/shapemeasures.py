"""What a shapes file asks for, measured on a surface: values with their uncertainties."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from lscan.config.targets import HeightShape, ShapesDocument, SurfaceBox
from lscan.errors import MeasurementError
from lscan.measure.shapefit import MeasuredPoints, ShapeFit, fit_shape, measured_points
from lscan.measure.shapes import CylinderShape, MeasuredShape, ParallelPlanes, SphereShape
from lscan.records import Floats, Ints, Mask, Status, Surface, has_value
from lscan.surface.surface import sample

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
            points = _in_box(surface, entry, entry.name)
            fit = fit_shape(shape.start(points.xyz_mm), points, f"{kind} {entry.name!r}")
            found.append(_measure(kind, entry.name, fit, points))
    return found + [_height(surface, one) for one in wanted.height]


def _planes(surface: Surface, kind: str, name: str, boxes: Sequence[SurfaceBox]) -> ShapeMeasure:
    """One plane, or two parallel ones, the upper first."""
    parts = [_in_box(surface, box, name) for box in boxes]
    alike = zip(*((part.xyz_mm, part.own_mm2, part.modes_mm) for part in parts), strict=True)
    points = MeasuredPoints(*map(np.concatenate, alike))
    which: Ints = np.repeat(np.arange(len(parts)), [len(part.xyz_mm) for part in parts])
    start = ParallelPlanes.start(points.xyz_mm, which)
    return _measure(kind, name, fit_shape(start, points, f"{kind} {name!r}"), points)


def _in_box(surface: Surface, box: SurfaceBox, name: str) -> MeasuredPoints:
    """The surface's points in the box, at most MOST_POINTS of them."""
    x, y, z = np.moveaxis(surface.xyz_mm, -1, 0)
    inside: Mask = np.ones(x.shape, dtype=bool)
    for values, limits in ((x, box.x_mm), (y, box.y_mm), (z, box.z_mm)):
        if limits is not None:
            inside &= (values >= limits[0]) & (values <= limits[1])
    points = measured_points(surface, inside)
    if len(points.xyz_mm) == 0:
        raise MeasurementError(
            f"{name!r}: the surface has no point in its box; it has points in {_reach(surface)}"
        )
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
        raise MeasurementError(
            f"{kind} {name!r}: the points in its box do not determine it, given their scatter"
        )
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
