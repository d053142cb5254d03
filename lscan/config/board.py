"""The calibration board: where its marks nominally are.

Coordinates are those of the plane frame (records.py): origin at control point O, the
upper-left dot of the grid, x right, z up, in mm.  The paper's board (Figs. 8, 14, 18) is
``scenes/paper/calibration-board.toml``.
"""

from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, PositiveFloat, model_validator
from scipy.spatial import cKDTree

from lscan.config.documents import Strict, check, read_document
from lscan.errors import InputError
from lscan.records import Floats

MOST_MARKS = 10_000  # on one ruler


class Grid(Strict):
    """The control points: ``columns`` by ``rows`` dots, ``pitch_mm`` apart.

    whole: False where the board is larger than ``columns`` by ``rows`` or than the view,
    so that the picture shows a part of it and the origin is the upper-left dot found.
    columns and rows are then the most that may be seen.
    """

    columns: Annotated[int, Field(ge=3, le=1000)]
    rows: Annotated[int, Field(ge=3, le=1000)]
    pitch_mm: PositiveFloat
    dot_diameter_mm: PositiveFloat
    whole: bool = True

    @model_validator(mode="after")
    def _dots_apart(self) -> Self:
        if self.dot_diameter_mm >= self.pitch_mm:
            raise ValueError("dot_diameter_mm must be smaller than pitch_mm")
        return self

    def points_mm(self) -> Floats:
        """(rows * columns, 2) of (x, z), row by row, the top row first."""
        column, row = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        return np.column_stack([column.ravel(), -row.ravel()]).astype(float) * self.pitch_mm


class Ruler(Strict):
    """An auxiliary ruler (Fig. 14): marks every ``step_mm`` from ``first_mm`` to ``last_mm``.

    vertical: at x = at_mm, marks along z.  horizontal: at z = at_mm, marks along x.
    """

    direction: Literal["vertical", "horizontal"]
    at_mm: float
    first_mm: float
    last_mm: float
    step_mm: PositiveFloat = 10.0
    mark_diameter_mm: PositiveFloat = 2.0

    @model_validator(mode="after")
    def _marks_apart(self) -> Self:
        if self.mark_diameter_mm >= self.step_mm:
            raise ValueError("mark_diameter_mm must be smaller than step_mm")
        if abs(self.last_mm - self.first_mm) < 2 * self.step_mm:
            raise ValueError("a ruler needs three marks: last_mm too close to first_mm")
        if abs(self.last_mm - self.first_mm) > MOST_MARKS * self.step_mm:
            raise ValueError(f"a ruler has at most {MOST_MARKS} marks: step_mm is too small")
        return self

    def points_mm(self) -> Floats:
        """(N, 2) of (x, z), from first_mm to last_mm."""
        span = self.last_mm - self.first_mm
        count = int(np.floor(abs(span) / self.step_mm + 1e-9)) + 1
        along = self.first_mm + np.sign(span) * self.step_mm * np.arange(count)
        fixed = np.full(count, self.at_mm)
        pair = (fixed, along) if self.direction == "vertical" else (along, fixed)
        return np.column_stack(pair)


class Dot(Strict):
    """A single named dot (features A to D, Fig. 18)."""

    name: str
    x_mm: float
    z_mm: float
    diameter_mm: PositiveFloat = 3.0


class Ring(Strict):
    """A milled circle (E to G): ``diameter_mm`` of its centre line, ``width_mm`` of the line."""

    name: str
    x_mm: float
    z_mm: float
    diameter_mm: PositiveFloat
    width_mm: PositiveFloat = 0.8

    @model_validator(mode="after")
    def _has_a_hole(self) -> Self:
        if self.width_mm >= self.diameter_mm:
            raise ValueError("width_mm must be smaller than diameter_mm")
        return self


class Plate(Strict):
    """The plate's outline: how far it reaches beyond the grid, and how thick it is."""

    margin_mm: PositiveFloat = 30.0
    thickness_mm: PositiveFloat = 8.0


class Board(Strict):
    """The whole calibration board.

    marks: "dark" dots on a bright plate or "bright" dots on a dark one.
    distances: pairs of named dots whose distance is to be verified (Table I).
    """

    marks: Literal["dark", "bright"] = "dark"
    grid: Grid
    plate: Plate = Plate()
    ruler: tuple[Ruler, ...] = ()
    dot: tuple[Dot, ...] = ()
    ring: tuple[Ring, ...] = ()
    distances: tuple[tuple[str, str], ...] = ()

    @model_validator(mode="after")
    def _names_known_and_unique(self) -> Self:
        names = [dot.name for dot in self.dot] + [ring.name for ring in self.ring]
        if twice := {name for name in names if names.count(name) > 1}:
            raise ValueError(f"names used twice: {sorted(twice)}")
        dots = {dot.name for dot in self.dot}
        if unknown := {name for pair in self.distances for name in pair} - dots:
            raise ValueError(f"distances name unknown dots: {sorted(unknown)}")
        if to_itself := [first for first, second in self.distances if first == second]:
            raise ValueError(f"distances from a dot to itself: {to_itself}")
        return self

    @model_validator(mode="after")
    def _marks_apart(self) -> Self:
        discs = self.discs_mm()
        near = cKDTree(discs[:, :2]).query_pairs(discs[:, 2].max())  # by the largest diameter
        for (x, z, d), (other_x, other_z, other_d) in (discs[[*pair]] for pair in sorted(near)):
            if np.hypot(x - other_x, z - other_z) < (d + other_d) / 2:
                raise ValueError(
                    f"marks overlap at ({x:g}, {z:g}) and ({other_x:g}, {other_z:g}) mm"
                )
        for ring in self.ring:
            away = np.hypot(discs[:, 0] - ring.x_mm, discs[:, 1] - ring.z_mm)
            gap = np.abs(away - ring.diameter_mm / 2) - (ring.width_mm + discs[:, 2]) / 2
            if gap.min() < 0:
                x, z, _ = discs[gap.argmin()]
                raise ValueError(f"ring {ring.name} runs over the mark at ({x:g}, {z:g}) mm")
        return self

    def discs_mm(self) -> Floats:
        """(N, 3) of x, z and diameter of every dot and ruler mark, mm."""
        sets = [(self.grid.points_mm(), self.grid.dot_diameter_mm)]
        sets += [(ruler.points_mm(), ruler.mark_diameter_mm) for ruler in self.ruler]
        sets += [(np.array([[dot.x_mm, dot.z_mm]]), dot.diameter_mm) for dot in self.dot]
        return np.vstack([np.column_stack([p, np.full(len(p), d)]) for p, d in sets])

    def dot_mm(self, name: str) -> Floats:
        """(2,) nominal (x, z) of a named dot, mm, plane frame.

        Parameters
        ----------
        name : str, of the dot, such as "A"

        Raises
        ------
        KeyError
            There is no such dot.
        """
        return np.array({dot.name: (dot.x_mm, dot.z_mm) for dot in self.dot}[name])

    def distance_mm(self, first: str, second: str) -> float:
        """Nominal distance between two named dots, mm.

        Parameters
        ----------
        first, second : str, names of the dots
        """
        return float(np.linalg.norm(self.dot_mm(first) - self.dot_mm(second)))

    def outline_mm(self) -> tuple[float, float, float, float]:
        """(left, right, bottom, top) of the plate, mm in the plane frame."""
        margin, grid = self.plate.margin_mm, self.grid
        width = (grid.columns - 1) * grid.pitch_mm
        height = (grid.rows - 1) * grid.pitch_mm
        return -margin, width + margin, -height - margin, margin


def load_board(path: Path) -> Board:
    """The board described by a TOML file.

    Parameters
    ----------
    path : Path, the file

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    document = read_document(path)
    if "grid" not in document and {"camera", "track"} & document.keys():
        allowed = "a file with [grid] and the board's other marks, such as [board] file names"
        raise InputError("is a rig or scene file, no board file", where=path, allowed=allowed)
    return check(Board, document, where=path)
