"""The calibration file: its JSON layout, strict reading, and writing whole or not at all.

It holds format and version, model name, parameters with their covariances, what was known of
the optics, the marks with their residuals, image size, software: data only, and all that is
needed to solve the map again.
"""

import json
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BeforeValidator,
    Field,
    PlainSerializer,
    PositiveFloat,
    model_validator,
)

from lscan.calibration.api import find_solver
from lscan.calibration.solve import Calibration, residuals
from lscan.calibration.stored import STRICT, Gaps, Matrix, NotNegativeOrNaN, Number, Place, Sigmas
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.files.disk import read_json, write_atomically
from lscan.records import BoardReading, Floats, Ints, Mark, Marks, RingPoints, RulerReading, Status

FORMAT: Final = "lscan-calibration"
VERSION: Final = 2  # 2: marks with status and sigma for dots and rings; optics
MOST_BYTES: Final = 32 * 2**20
"""Of a calibration file of either route; those of the paper's board have half a megabyte."""
SAME_MM = 1e-6  # residuals that belong to the parameters agree this well on any machine

Side = Annotated[int, Field(strict=True, gt=0)]


def _name(status: Any) -> Any:
    return status.name if isinstance(status, Status) else status


def _each(status: Any) -> Any:
    return [Status(code) for code in status] if isinstance(status, np.ndarray) else status


if TYPE_CHECKING:
    Code = Status
    Codes = Ints
else:  # names in the file
    Code = Annotated[
        Literal["OK", "NOT_FOUND", "OUT_OF_VIEW"],
        BeforeValidator(_name),
        AfterValidator(Status.__getitem__),
        PlainSerializer(_name),
    ]
    Codes = Annotated[
        tuple[Code, ...],
        BeforeValidator(_each),
        AfterValidator(partial(np.array, dtype=np.int64)),
        PlainSerializer(lambda status: [Status(code).name for code in status]),
    ]


def _pairs(values: Floats) -> Floats:
    if values.size and values.shape[1:] != (2,):
        raise ValueError("must be a list of pairs")
    return values.reshape(-1, 2)


@dataclass(frozen=True)
class StoredMarks(Marks):
    """Marks that are in a file; ``null`` where one has no place."""

    __pydantic_config__ = STRICT
    board_mm: Matrix
    image_px: Gaps
    sigma_px: Sigmas
    status: Codes

    def __post_init__(self) -> None:
        """Raise ValueError unless all are as many, with a place just where status is OK."""
        count = len(self.status)
        if self.board_mm.shape != (count, 2) or self.image_px.shape != (count, 2):
            raise ValueError(f"board_mm and image_px must hold {count} pairs, one per status")
        if self.sigma_px.shape != (count,):
            raise ValueError(f"sigma_px must hold {count} numbers, one per status")
        for values in (*self.image_px.T, self.sigma_px):
            if (np.isfinite(values) != self.found).any():
                raise ValueError("image_px and sigma_px must be numbers just where status is OK")


@dataclass(frozen=True)
class StoredMark(Mark):
    """A mark that is in a file; ``null`` where it has no place."""

    __pydantic_config__ = STRICT
    image_px: Gaps
    sigma_px: NotNegativeOrNaN
    status: Code

    def __post_init__(self) -> None:
        """Raise ValueError unless it has a place just where status is OK."""
        if self.image_px.shape != (2,):
            raise ValueError("image_px must be two numbers")
        if (np.isfinite([*self.image_px, self.sigma_px]) != (self.status == Status.OK)).any():
            raise ValueError("image_px and sigma_px must be numbers just where status is OK")


@dataclass(frozen=True)
class StoredRing(RingPoints):
    """Points of a ring that are in a file."""

    __pydantic_config__ = STRICT
    image_px: Annotated[Gaps, AfterValidator(_pairs)]
    sigma_px: Sigmas

    def __post_init__(self) -> None:
        """Raise ValueError unless each point is finite and has its uncertainty."""
        if self.sigma_px.shape != (len(self.image_px),):
            raise ValueError("image_px must hold one pair for each number of sigma_px")
        if not (np.isfinite(self.image_px).all() and np.isfinite(self.sigma_px).all()):
            raise ValueError("image_px and sigma_px must be finite numbers")


@dataclass(frozen=True)
class StoredRuler(RulerReading):
    """A ruler that is in a file."""

    __pydantic_config__ = STRICT
    direction: Literal["vertical", "horizontal"]
    at_mm: Number
    marks: StoredMarks


class StoredReading(Strict):
    """records.BoardReading."""

    image_size: tuple[Side, Side]
    pitch_mm: Annotated[PositiveFloat, Field(strict=True)]
    shape: tuple[Side, Side]
    grid: StoredMarks
    rulers: tuple[StoredRuler, ...]
    dots: dict[str, StoredMark]
    rings: dict[str, StoredRing]

    @model_validator(mode="after")
    def _whole_grid(self) -> Self:
        rows, columns = self.shape
        if len(self.grid.status) != rows * columns:
            raise ValueError(f"grid must hold {rows} by {columns} marks, as shape says")
        return self

    def reading(self) -> BoardReading:
        """As the program holds it."""
        return BoardReading(**dict(self))


class StoredResiduals(Strict):
    """Map of each control point less its nominal place, N pairs; ``null`` where there is none."""

    mm: Gaps
    px: Gaps


class CalibrationFile(Strict):
    """The whole file."""

    format: Literal["lscan-calibration"] = FORMAT
    version: Literal[2] = VERSION
    software: str
    plane_map: str
    optics: OpticsSection
    parameters: dict[str, Any]
    reading: StoredReading
    residuals: StoredResiduals
    outliers_mm: tuple[Place, ...] = ()  # not in older files

    @model_validator(mode="after")
    def _one_residual_each(self) -> Self:
        shape = self.reading.grid.image_px.shape
        if self.residuals.mm.shape != shape or self.residuals.px.shape != shape:
            raise ValueError(f"residuals must hold {shape[0]} pairs, one per control point")
        return self


def write_file(path: Path, content: Strict) -> None:
    """Write a calibration whole or not at all.

    Parameters
    ----------
    path : Path, of the file
    content : Strict, the model of the file

    Raises
    ------
    InputError
        Where the disk refuses.
    """
    text = json.dumps(content.model_dump(mode="json"), indent=1, allow_nan=False)
    write_atomically(path, (text + "\n").encode())


def save_calibration(path: Path | str, calibration: Calibration) -> None:
    """Write the calibration to a file: a whole file or none.

    Parameters
    ----------
    path : Path or str, of the file
    calibration : Calibration, of one picture

    Raises
    ------
    InputError
        Where the file cannot be written.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.calibrate_run(lscan.open_run("runs/board"), "projective")
    >>> lscan.save_calibration("projective.json", calibration)
    """
    content = CalibrationFile(
        software=calibration.software,
        plane_map=calibration.name,
        optics=calibration.optics,
        parameters=calibration.plane_map.parameters(),
        reading=check(StoredReading, asdict(calibration.reading), where="board reading"),
        residuals=StoredResiduals(mm=calibration.residuals_mm, px=calibration.residuals_px),
        outliers_mm=tuple(calibration.outliers_mm),
    )
    write_file(Path(path), content)


def load_calibration(path: Path | str) -> Calibration:
    """The calibration that was saved in a file, number for number.

    Parameters
    ----------
    path : Path or str, of the file

    Raises
    ------
    InputError
        Names the file and the key of anything that is not as it was written: unknown or missing
        keys, numbers out of range, a map that does not exist, and residuals that do not belong to
        the parameters.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> calibration.plane_map.name
    'graticule-2'
    """
    return calibration_of(read_json(Path(path), MOST_BYTES), Path(path))


def calibration_of(document: Any, path: Path) -> Calibration:
    """The calibration in the JSON document of a file.

    Parameters
    ----------
    document : object, as JSON has it
    path : Path, of the file, for messages

    Raises
    ------
    InputError
        As ``load_calibration``.
    """
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        found = document.get("format") if isinstance(document, dict) else None
        raise InputError(
            "is no calibration file", where=path, value=found, allowed=f'format "{FORMAT}"'
        )
    version = document.get("version")
    if type(version) is not int or version != VERSION:
        raise InputError(
            "version: is not the one this program writes; calibrate again from the picture",
            where=path,
            value=version,
            allowed=VERSION,
        )
    content = check(CalibrationFile, document, where=path)
    reading, stored = content.reading.reading(), content.residuals
    with np.errstate(all="ignore"):  # numbers that make no map do not give these residuals
        try:
            plane_map = find_solver(content.plane_map).restore(content.parameters)
        except InputError as error:
            raise InputError(f"plane_map: {error}", where=path) from error
        computed, _ = residuals(plane_map, reading)
    if not np.allclose(computed, stored.mm, rtol=0, atol=SAME_MM, equal_nan=True):
        raise InputError("residuals.mm: do not belong to the parameters", where=path)
    return Calibration(
        name=content.plane_map,
        plane_map=plane_map,
        reading=reading,
        residuals_mm=stored.mm,
        residuals_px=stored.px,
        optics=content.optics,
        software=content.software,
        outliers_mm=np.array(content.outliers_mm, dtype=float).reshape(-1, 2),
    )
