"""Nominal shapes of the paper's test pieces, and SHAPES.toml: what to measure of others.

Each piece has its own workpiece frame, in mm, z up; a scene places it in the tank.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, PositiveFloat, model_validator

from lscan.config.documents import Strict, check, read_document
from lscan.records import Floats

# Nominal shapes of the paper's test pieces.


class Groove(Strict):
    """A groove along y cut from the top: ``ridge_mm`` of top to its left, then the groove."""

    ridge_mm: PositiveFloat
    width_mm: PositiveFloat
    depth_mm: PositiveFloat


class GroovedBlock(Strict):
    """The grooved block (Fig. 20) with the nine dimensions of Table III.

    The drawing is not in the paper's text; this layout carries all nine.  Workpiece frame:
    x = 0 at the block's left side, y = 0 at mid-length, z = 0 at the underside, where the
    floor is.  From left to right: a ridge, groove 1 (W1 wide, H3 deep), a ridge, groove 2
    (W2, H4), a ridge, groove 3 (W3, H1), the last ridge.  H2 is the height of the top above
    the floor; S1 runs from the block's left side to the left edge of groove 3, S2 from the
    right edge of groove 1 to the right edge of groove 3.
    """

    kind: Literal["grooved-block"] = "grooved-block"
    height_mm: PositiveFloat = 80.06
    length_mm: PositiveFloat = 120.0
    grooves: tuple[Groove, Groove, Groove] = (
        Groove(ridge_mm=33.92, width_mm=19.96, depth_mm=20.04),
        Groove(ridge_mm=35.56, width_mm=29.96, depth_mm=40.02),
        Groove(ridge_mm=35.56, width_mm=29.96, depth_mm=60.00),
    )
    last_ridge_mm: PositiveFloat = 30.0

    def edges_mm(self) -> Floats:
        """(8,) x of the top's edges, left to right: block, three grooves' pairs, block."""
        steps = [0.0]
        for groove in self.grooves:
            steps += [groove.ridge_mm, groove.width_mm]
        return np.cumsum([*steps, self.last_ridge_mm])

    def outline_mm(self) -> Floats:
        """(N, 2) closed outline of the cross-section in (x, z), clockwise from (0, 0)."""
        edges, top = self.edges_mm(), self.height_mm
        corners = [(0.0, 0.0), (0.0, top)]
        for k, groove in enumerate(self.grooves):
            left, right, bottom = edges[1 + 2 * k], edges[2 + 2 * k], top - groove.depth_mm
            corners += [(left, top), (left, bottom), (right, bottom), (right, top)]
        corners += [(edges[-1], top), (edges[-1], 0.0)]
        return np.array(corners)

    def dimensions_mm(self) -> dict[str, float]:
        """The nine dimensions under the names of Table III."""
        first, second, third = self.grooves
        edges = self.edges_mm()
        return {
            "W1": first.width_mm,
            "W2": second.width_mm,
            "W3": third.width_mm,
            "H1": third.depth_mm,
            "H2": self.height_mm,
            "H3": first.depth_mm,
            "H4": second.depth_mm,
            "S1": float(edges[5] - edges[0]),
            "S2": float(edges[6] - edges[2]),
        }


class Wedge(Strict):
    """The flat-topped wedges on the left and right rims (eqs. 5 to 7, Fig. 26).

    In plan each is a triangle: its base lies on the block's side, its tip, the corner W_L
    or W_R, points inwards at mid-length.  height_mm is the top's height above z = 0.
    """

    base_mm: PositiveFloat = 60.0
    reach_mm: PositiveFloat = 26.0
    height_mm: PositiveFloat = 10.0


class Sandwave(Strict):
    """The sandwave block of eq. (4) with its wedges (Figs. 22, 23, 26).

    Workpiece frame: eq. (4) holds for x and y from 0 to ``side_mm``; around it a flat rim of
    ``rim_mm`` at z = 0.  The tips of the wedges lie at y = side/2.  a, b, c, d, e are the
    paper's A to E (mm, 1, 1/mm, rad, 1/mm).
    """

    kind: Literal["sandwave"] = "sandwave"
    a_mm: PositiveFloat = 1.5
    b: Annotated[float, Field(ge=0)] = 0.043
    c_per_mm: PositiveFloat = 0.167
    d_rad: float = 2.0
    e_per_mm: float = 0.042
    side_mm: PositiveFloat = 150.0
    rim_mm: PositiveFloat = 30.0
    body_mm: PositiveFloat = 32.0
    wedge: Wedge = Wedge()

    def height_mm(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """z of eq. (4), mm, workpiece frame; same shape, not clipped to the region.

        Parameters
        ----------
        x_mm, y_mm : arrays of one shape, mm, workpiece frame
        """
        phase = self.c_per_mm * x_mm + self.d_rad * np.sin(self.e_per_mm * y_mm)
        return (self.a_mm + self.b * y_mm) * np.sin(phase)

    def slopes(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """(N, 2) partial derivatives of eq. (4) by x and y.

        Parameters
        ----------
        x_mm, y_mm : (N,) arrays, mm, workpiece frame
        """
        phase = self.c_per_mm * x_mm + self.d_rad * np.sin(self.e_per_mm * y_mm)
        swing = (self.a_mm + self.b * y_mm) * np.cos(phase)
        along_y = swing * self.d_rad * self.e_per_mm * np.cos(self.e_per_mm * y_mm)
        return np.column_stack([swing * self.c_per_mm, along_y + self.b * np.sin(phase)])

    def inset_mm(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """How far from the border of the waves, mm, same shape; negative outside of it.

        Parameters
        ----------
        x_mm, y_mm : arrays of one shape, mm, workpiece frame
        """
        return np.minimum(
            np.minimum(x_mm, self.side_mm - x_mm), np.minimum(y_mm, self.side_mm - y_mm)
        )

    def normals(self, x_mm: Floats, y_mm: Floats) -> Floats:
        """(N, 3) unit normals of eq. (4), upwards, workpiece frame.

        Parameters
        ----------
        x_mm, y_mm : (N,) arrays, mm, workpiece frame
        """
        upwards = np.column_stack([-self.slopes(x_mm, y_mm), np.ones_like(x_mm)])
        return upwards / np.linalg.norm(upwards, axis=1, keepdims=True)

    def wedge_tips_mm(self) -> tuple[Floats, Floats]:
        """W_L and W_R, each (2,) of (x, y)."""
        middle = self.side_mm / 2
        reach = self.wedge.reach_mm - self.rim_mm
        return np.array([reach, middle]), np.array([self.side_mm - reach, middle])

    def wedge_plans_mm(self) -> tuple[Floats, Floats]:
        """Plan of the left and the right wedge, each (3, 2) of (x, y), counter-clockwise."""
        half, middle = self.wedge.base_mm / 2, self.side_mm / 2
        tip_left, tip_right = self.wedge_tips_mm()
        left, right = -self.rim_mm, self.side_mm + self.rim_mm
        return (
            np.array([[left, middle - half], tip_left, [left, middle + half]]),
            np.array([[right, middle + half], tip_right, [right, middle - half]]),
        )

    def slices_mm(self) -> dict[str, tuple[Floats, Floats]]:
        """The slices of Fig. 28, name to the two ends (x, y) in mm.

        S1 lies where the amplitude is 2 mm, S3 where it is 7.5 mm, S2 half-way between;
        SD is the diagonal of the sandwave.
        """
        y1, y3 = (self._y_of_amplitude(amplitude) for amplitude in (2.0, 7.5))
        end = self.side_mm
        along = {"S1": y1, "S2": (y1 + y3) / 2, "S3": y3}
        lines = {n: (np.array([0.0, y]), np.array([end, y])) for n, y in along.items()}
        return {**lines, "SD": (np.array([0.0, 0.0]), np.array([end, end]))}

    def _y_of_amplitude(self, amplitude_mm: float) -> float:
        if self.b == 0:
            return self.side_mm / 2
        return float(np.clip((amplitude_mm - self.a_mm) / self.b, 0.0, self.side_mm))


Workpiece = Annotated[GroovedBlock | Sandwave, Field(discriminator="kind")]


# SHAPES.toml: what is to be measured of a surface, and where on it.


Coordinate = Annotated[float, Field(ge=-1e6, le=1e6)]
PlanPlace = tuple[Coordinate, Coordinate]


def _require_length(interval: tuple[float, float]) -> tuple[float, float]:
    """The interval; ValueError where it has no length."""
    if not interval[0] < interval[1]:
        raise ValueError("must be a lower and a higher number")
    return interval


Interval = Annotated[tuple[Coordinate, Coordinate], AfterValidator(_require_length)]
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
    def _require_unique_names(self) -> Self:
        if not (names := [entry.name for _, entries in self for entry in entries]):
            raise ValueError("names nothing: a plane, step, sphere, cylinder or height is needed")
        if twice := sorted({name for name in names if names.count(name) > 1}):
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
