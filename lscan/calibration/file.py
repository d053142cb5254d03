"""The calibration file: its JSON layout, strict reading, and writing whole or not at all."""

import json
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, cast

import numpy as np
from pydantic import BeforeValidator, ConfigDict, Field, PositiveFloat, model_validator

from lscan.calibration.stored import Gaps, Matrix, NotNegative, Number
from lscan.config.documents import Strict, check
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.files.disk import write_atomically
from lscan.records import BoardReading, Mark, Marks, RingPoints, RulerReading, Status

FORMAT: Final = "lscan-calibration"
VERSION: Final = 2  # 2: marks with status and sigma for dots and rings; optics
MOST_BYTES: Final = 32 * 2**20
"""Of a calibration file of either route; those of the paper's board have half a megabyte."""

StatusName = Literal["OK", "NOT_FOUND", "OUT_OF_VIEW"]
Side = Annotated[int, Field(strict=True, gt=0)]


def _name(status: Any) -> Any:
    return status.name if isinstance(status, Status) else status


def _names(status: Any) -> Any:
    codes = isinstance(status, np.ndarray)
    return tuple(Status(code).name for code in status) if codes else status


def none_for_nan(value: Any) -> Any:
    """The value, None in place of NaN."""
    return None if value != value else value


class StoredRecord(Strict):
    """Base of what holds a record of the program: it is made from the record itself."""

    model_config = ConfigDict(from_attributes=True)


class StoredMarks(StoredRecord):
    """records.Marks; ``null`` where a mark has no place."""

    board_mm: Matrix
    image_px: Gaps
    sigma_px: Gaps
    status: Annotated[tuple[StatusName, ...], BeforeValidator(_names)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.status)
        if self.board_mm.shape != (count, 2) or self.image_px.shape != (count, 2):
            raise ValueError(f"board_mm and image_px must hold {count} pairs, one per status")
        if self.sigma_px.shape != (count,):
            raise ValueError(f"sigma_px must hold {count} numbers, one per status")
        found = np.array([name == "OK" for name in self.status])
        for values in (self.image_px[:, 0], self.image_px[:, 1], self.sigma_px):
            if (np.isfinite(values) != found).any():
                raise ValueError("image_px and sigma_px must be numbers just where status is OK")
        if (self.sigma_px[found] < 0).any():
            raise ValueError("sigma_px must not be below 0")
        return self

    def marks(self) -> Marks:
        """As the program holds them."""
        status = np.array([Status[name] for name in self.status], dtype=np.int64)
        return Marks(self.board_mm, self.image_px, self.sigma_px, status)


class StoredMark(StoredRecord):
    """records.Mark; ``null`` where it has no place."""

    image_px: Gaps
    sigma_px: Annotated[NotNegative | None, BeforeValidator(none_for_nan)]
    status: Annotated[StatusName, BeforeValidator(_name)]

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.image_px.shape != (2,):
            raise ValueError("image_px must be two numbers")
        found = self.status == "OK"
        if (np.isfinite(self.image_px) != found).any() or (self.sigma_px is not None) != found:
            raise ValueError("image_px and sigma_px must be numbers just where status is OK")
        return self

    def mark(self) -> Mark:
        """As the program holds it."""
        sigma_px = float("nan") if self.sigma_px is None else self.sigma_px
        return Mark(self.image_px, sigma_px, Status[self.status])


class StoredRing(StoredRecord):
    """records.RingPoints."""

    image_px: Gaps
    sigma_px: Gaps

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = self.sigma_px.size
        if self.image_px.size and self.image_px.shape[1:] != (2,):
            raise ValueError("image_px must be a list of pairs")
        if self.sigma_px.shape != (count,) or self.image_px.size != 2 * count:
            raise ValueError("image_px must hold one pair for each number of sigma_px")
        if not (np.isfinite(self.image_px).all() and np.isfinite(self.sigma_px).all()):
            raise ValueError("image_px and sigma_px must be finite numbers")
        if (self.sigma_px < 0).any():
            raise ValueError("sigma_px must not be below 0")
        return self

    def points(self) -> RingPoints:
        """As the program holds them."""
        return RingPoints(self.image_px.reshape(-1, 2), self.sigma_px)


class StoredRuler(StoredRecord):
    """records.RulerReading."""

    direction: Literal["vertical", "horizontal"]
    at_mm: Number
    marks: StoredMarks


class StoredReading(StoredRecord):
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
        rulers = [RulerReading(r.direction, r.at_mm, r.marks.marks()) for r in self.rulers]
        return BoardReading(
            image_size=self.image_size,
            pitch_mm=self.pitch_mm,
            shape=self.shape,
            grid=self.grid.marks(),
            rulers=tuple(rulers),
            dots={name: dot.mark() for name, dot in self.dots.items()},
            rings={name: ring.points() for name, ring in self.rings.items()},
        )


def store_reading(reading: BoardReading) -> StoredReading:
    """The reading as the file holds it.

    Parameters
    ----------
    reading : BoardReading, px and mm
    """
    return check(StoredReading, cast(Any, reading), where="board reading")


class StoredResiduals(Strict):
    """Map of each control point less its nominal place, N pairs; ``null`` where there is none."""

    mm: Gaps
    px: Gaps


class CalibrationFile(Strict):
    """The whole file."""

    format: Literal["lscan-calibration"]
    version: Literal[2]
    software: str
    plane_map: str
    optics: OpticsSection
    parameters: dict[str, Any]
    reading: StoredReading
    residuals: StoredResiduals

    @model_validator(mode="after")
    def _one_residual_each(self) -> Self:
        shape = self.reading.grid.image_px.shape
        if self.residuals.mm.shape != shape or self.residuals.px.shape != shape:
            raise ValueError(f"residuals must hold {shape[0]} pairs, one per control point")
        return self


def calibration_file(document: Any, path: Path) -> CalibrationFile:
    """The content of a calibration file.

    Parameters
    ----------
    document : object, as JSON has it
    path : Path, of the file, for messages

    Raises
    ------
    InputError
        Names the key at fault.
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
    return check(CalibrationFile, document, where=path)


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
