"""SHAPES.toml: what is to be measured of a surface, and where on it."""

from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, Field, model_validator

from lscan.config.documents import Strict, check, read_document

Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
PlanPlace = tuple[Coordinate, Coordinate]


def _rising(interval: tuple[float, float]) -> tuple[float, float]:
    """The interval; ValueError where it has no length."""
    if not interval[0] < interval[1]:
        raise ValueError("must be a lower and a higher number")
    return interval


Interval = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_rising)]
Name = Annotated[str, Field(min_length=1, max_length=100)]


class SurfaceBox(Strict):
    """The points of a surface within a box, in the surface's frame; z_mm: all heights if left out.

    A limit in z cuts a noisy surface unevenly: it is to lie clear of what is fitted.
    """

    x_mm: Interval
    y_mm: Interval
    z_mm: Interval | None = None


class NamedBox(SurfaceBox):
    """A box that holds one shape."""

    name: Name


class StepShape(Strict):
    """Two parallel planes, whose distance is wanted."""

    name: Name
    upper: SurfaceBox
    lower: SurfaceBox


class HeightShape(Strict):
    """Two places in plan, whose difference in height is wanted: ``to_mm`` less ``from_mm``."""

    name: Name
    from_mm: PlanPlace
    to_mm: PlanPlace


class ShapesDocument(Strict):
    """The whole file: what each table names is measured."""

    plane: tuple[NamedBox, ...] = ()
    step: tuple[StepShape, ...] = ()
    sphere: tuple[NamedBox, ...] = ()
    cylinder: tuple[NamedBox, ...] = ()
    height: tuple[HeightShape, ...] = ()

    @model_validator(mode="after")
    def _named_apart(self) -> Self:
        names = [entry.name for _, entries in self for entry in entries]
        if not names:
            raise ValueError("names nothing: a plane, step, sphere, cylinder or height is needed")
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"names used twice: {twice}")
        return self


def load_shapes(path: Path) -> ShapesDocument:
    """What a TOML file asks to measure.

    Parameters
    ----------
    path : Path, of the file

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    return check(ShapesDocument, read_document(path), where=path)
