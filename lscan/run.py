"""The run folder: the pictures of one scan, and everything needed to make sense of them.

    run.json           rig document as read, plan, state, software versions, own checksum
    frames.csv         one row a frame: where, when, how long, and the picture's checksum
    frames/000000.png  the pictures, lossless, as the camera delivered them

With ``plan.laser = "pairs"`` there is also frames/000000-dark.png, the same view with the laser
off, and its checksum in a further column.

A folder stands alone: copied to a machine without the rig file and without the drivers it
still opens.  No file holds a wall-clock time or a host name, so that the same simulated
scan gives the same bytes.  This module reads; runwriter.py writes.
"""

from __future__ import annotations

import hashlib
import json
import math
import platform
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

import lscan
from lscan.disk import list_names, read_bytes
from lscan.documents import Document, Strict, check
from lscan.errors import InputError
from lscan.records import Bytes, Floats, Frame
from lscan.rig import Plan, RigFile, parse_rig

MANIFEST, TABLE, FRAMES = "run.json", "frames.csv", "frames"
COLUMNS = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,crc32"
PAIRED_COLUMNS = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,dark_sha256,crc32"
State = Literal["scanning", "complete"]
Versions = dict[str, str]


class Manifest(Strict):
    """What run.json holds, without its checksum.

    track_zero: name of the zero that the frames' positions count from, as
    ``lscan.devices.api.PlaceChecking`` gives it; left out where the track finds it anew.
    """

    format: Literal["lscan-run"] = "lscan-run"
    version: Literal[1] = 1
    state: State
    software: list[Versions]
    plan: Plan
    rig: Document
    track_zero: str | None = None

    def as_text(self) -> str:
        """The file's text: JSON with, as its last key, the SHA-256 of its meaning."""
        content = self.model_dump(mode="json")
        if self.track_zero is None:
            del content["track_zero"]
        content["sha256"] = _digest(content)
        return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def from_text(cls, text: str, where: object) -> Manifest:
        """The manifest that ``as_text`` wrote; InputError where it is garbled or was edited."""
        try:
            content = json.loads(text, parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise InputError(f"is not valid JSON: {error}", where=where) from error
        if not isinstance(content, dict):
            raise InputError("is not a run manifest", where=where)
        digest = content.pop("sha256", None)
        manifest = check(cls, content, where=where)
        if digest != _digest(content):
            raise InputError("was changed after it was written", where=where)
        return manifest


@dataclass(frozen=True)
class Row:
    """One row of frames.csv.

    sha256: of the picture's file, in hexadecimal; dark_sha256: of its background's, None where
    the run has none.
    """

    index: int
    commanded_mm: float
    position_mm: float
    time_s: float
    exposure_ms: float
    sha256: str
    dark_sha256: str | None = None

    def as_text(self) -> str:
        """The row without its line end.

        Floats are written so that reading gives the same bits.  The last field is the
        CRC-32 of all that stands before it, so a changed digit does not pass unseen.
        """
        numbers = (self.commanded_mm, self.position_mm, self.time_s, self.exposure_ms)
        digests = [self.sha256] if self.dark_sha256 is None else [self.sha256, self.dark_sha256]
        text = ",".join([str(self.index), *(repr(float(x)) for x in numbers), *digests])
        return f"{text},{_crc32(text)}"

    @classmethod
    def from_text(cls, text: str, where: object, paired: bool = False) -> Row:
        """The row that ``as_text`` wrote; InputError where it is torn or was changed.

        paired: whether it must list a background, or must not.
        """
        body, _, crc = text.rpartition(",")
        if crc != _crc32(body):
            raise InputError("row is torn or was changed", where=where, value=text)
        try:
            index, *fields = body.split(",")
            commanded, position, time, exposure = map(_finite, fields[:4])
            sha256, *dark_sha256 = fields[4:]
            if len(dark_sha256) != paired:
                raise ValueError("the wrong number of checksums")
            return cls(int(index), commanded, position, time, exposure, sha256, *dark_sha256)
        except ValueError as error:
            what = "row does not hold what it should"
            raise InputError(what, where=where, value=text, allowed=columns(paired)) from error


@dataclass(frozen=True)
class Run:
    """A run folder opened for reading.

    rig_file: the rig the scan was made with, as the folder keeps it.
    software: versions of what wrote the folder; more than one entry where a scan was
        resumed under other versions.
    rows: one per frame, in order.
    """

    path: Path
    rig_file: RigFile
    state: State
    software: tuple[Versions, ...]
    rows: tuple[Row, ...]

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def positions_mm(self) -> Floats:
        """(F,) track position of each frame as the track reported it, mm."""
        return np.array([row.position_mm for row in self.rows], dtype=float)

    def frame(self, index: int) -> Frame:
        """Frame ``index``, 0 to len - 1, read from disk.

        Raises InputError where there is no such frame, or where its picture is missing,
        is not the one that was recorded, or is not of the rig's size.
        """
        if not 0 <= index < len(self):
            allowed = f"0 to {len(self) - 1}"
            raise InputError("no such frame", where=self.path, value=index, allowed=allowed)
        row = self.rows[index]
        return Frame(
            image=self._picture(row),
            index=index,
            commanded_mm=row.commanded_mm,
            position_mm=row.position_mm,
            time_s=row.time_s,
            exposure_ms=row.exposure_ms,
            background=None if row.dark_sha256 is None else self._picture(row, dark=True),
        )

    def frames(self) -> Iterator[Frame]:
        """All frames in order, each read when it is asked for; errors as ``frame``."""
        return (self.frame(index) for index in range(len(self)))

    def verify(self) -> None:
        """Read every picture's file and compare its checksum; InputError as ``frame``."""
        for row in self.rows:
            self._checked_bytes(row)
            if row.dark_sha256 is not None:
                self._checked_bytes(row, dark=True)

    def _picture(self, row: Row, dark: bool = False) -> Bytes:
        """A frame's picture, or its background."""
        data = self._checked_bytes(row, dark)
        return self._decoded(data, frame_file(self.path, row.index, dark))

    def _checked_bytes(self, row: Row, dark: bool = False) -> bytes:
        file = frame_file(self.path, row.index, dark)
        data = read_bytes(file)
        if hashlib.sha256(data).hexdigest() != (row.dark_sha256 if dark else row.sha256):
            what = f"is not the picture that {TABLE} line {row.index + 2} lists (checksum differs)"
            raise InputError(what, where=file)
        return data

    def _decoded(self, data: bytes, file: Path) -> Bytes:
        camera = self.rig_file.rig.camera
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)):
            raise InputError("is not an 8-bit grey or RGB picture", where=file)
        if image.shape[:2] != (camera.height_px, camera.width_px):
            size = f"{image.shape[1]} by {image.shape[0]} px"
            allowed = f"{camera.width_px} by {camera.height_px} px, as in the rig"
            raise InputError("wrong picture size", where=file, value=size, allowed=allowed)
        rgb = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
        return np.asarray(rgb, dtype=np.uint8)


def open_run(path: Path) -> Run:
    """The run in the folder ``path``, complete or not.

    Manifest and table are checked here, and that every picture is there; a picture's bytes
    are checked against the table each time a frame is read (``Run.verify`` reads them all).
    Raises InputError that names file and line: run.json missing, garbled, edited or of an
    unknown version; a row torn, changed, repeated or skipped; a picture missing; more or
    fewer frames than planned.
    """
    manifest, rig_file = read_manifest(path)
    plan = manifest.plan
    rows, planned = _read_rows(path / TABLE, plan.paired), plan.frames
    if len(rows) > planned or (manifest.state == "complete" and len(rows) < planned):
        what = f"the number of frames does not fit the plan of this {manifest.state} run"
        raise InputError(what, where=path / TABLE, value=len(rows), allowed=planned)
    present = list_names(path / FRAMES)
    for row in rows:
        for dark in (False, True) if plan.paired else (False,):
            file = frame_file(path, row.index, dark)
            if file.name not in present:
                raise InputError(f"missing, but {TABLE} line {row.index + 2} lists it", where=file)
    return Run(path, rig_file, manifest.state, tuple(manifest.software), tuple(rows))


def frame_file(path: Path, index: int, dark: bool = False) -> Path:
    """Where the run folder ``path`` keeps the picture of frame ``index``, or its background."""
    return path / FRAMES / f"{index:06d}{'-dark' if dark else ''}.png"


def columns(paired: bool) -> str:
    """The header of frames.csv, for a run with or without backgrounds."""
    return PAIRED_COLUMNS if paired else COLUMNS


def read_manifest(path: Path) -> tuple[Manifest, RigFile]:
    """The manifest of the run folder ``path`` and the rig it keeps; InputError as open_run."""
    file = path / MANIFEST
    if path.is_dir() and not file.exists():
        raise InputError(f"is not a run folder: it has no {MANIFEST}", where=path)
    try:
        text = read_bytes(file).decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError("is not UTF-8 text", where=file) from error
    manifest = Manifest.from_text(text, where=file)
    rig_file = parse_rig(manifest.rig, source=str(file), trusted=True)
    if rig_file.rig.plan != manifest.plan:
        raise InputError("plan and rig.plan differ", where=file)
    return manifest, rig_file


def software_versions() -> Versions:
    """Name to version of what writes run folders here."""
    return {
        "lscan": lscan.__version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }


def _read_rows(file: Path, paired: bool) -> list[Row]:
    # Latin-1 takes any byte for a character, so a stray one fails its row's checksum.
    header, *lines = read_bytes(file).decode("latin-1").split("\n")
    if header != columns(paired):
        where = f"{file} line 1"
        raise InputError("wrong header", where=where, value=header, allowed=columns(paired))
    if not lines or lines.pop() != "":
        where = f"{file} line {len(lines) + 2}"
        raise InputError("the last row is torn; lscan scan --resume cuts it off", where=where)
    rows: list[Row] = []
    for index, line in enumerate(lines):
        where = f"{file} line {index + 2}"
        row = Row.from_text(line, where, paired)
        if row.index != index:
            what = "a frame is listed twice" if row.index < index else "a frame is skipped"
            raise InputError(what, where=where, value=row.index, allowed=index)
        rows.append(row)
    return rows


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is not finite")
    return number


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not a number")


def _digest(content: Document) -> str:
    """SHA-256 over sorted keys without spaces, so over what the document means."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _crc32(text: str) -> str:
    return f"{zlib.crc32(text.encode('latin-1')):08x}"
