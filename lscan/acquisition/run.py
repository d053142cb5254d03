"""The run folder: the pictures of one scan, and everything needed to make sense of them.

    run.json           rig document as read, plan, state, software versions, own checksum
    frames.csv         one row a frame: where, when, how long, and the picture's checksum
    frames/000000.png  the pictures, lossless, as the camera delivered them

With ``plan.laser = "pairs"`` there is also frames/000000-dark.png, the same view with the laser
off, and its checksum in a further column.

A folder stands alone: copied to a machine without the rig file and without the drivers it
still opens.  No file holds a wall-clock time or a host name, so that the same simulated
scan gives the same bytes.  This module reads; writer.py writes.
"""

import hashlib
import json
import logging
import os
import platform
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from pydantic import Field, FiniteFloat, TypeAdapter

from lscan.config.documents import Document, Strict, check
from lscan.config.plugins import find_plugin, installed, others_versions, refuse_code
from lscan.config.rig import Plan, Rig, RigFile, parse_rig
from lscan.devices.api import LASER_MAY_BE_LIT, Camera, Identified
from lscan.errors import DeviceError, InputError, LscanError
from lscan.files.cache import long_work
from lscan.files.disk import content_sha256, list_names, read_bytes, read_json, require_within
from lscan.files.pictures import read_png
from lscan.records import Floats, Frame, Picture
from lscan.version import __version__

MANIFEST, TABLE, FRAMES = "run.json", "frames.csv", "frames"
COLUMNS = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,crc32"
PAIRED_COLUMNS = "index,commanded_mm,position_mm,time_s,exposure_ms,sha256,dark_sha256,crc32"
MOST_ROW_BYTES = 300
"""Of a line of the table: at most 247, of four numbers, two SHA-256 and a CRC-32."""
State = Literal["scanning", "complete"]
Versions = dict[str, str]


class Manifest(Strict):
    """What run.json holds, without its checksum.

    track_zero: name of the zero that the frames' positions count from, as
    ``lscan.devices.api.PlaceChecking`` gives it; left out where the track finds it anew.
    camera_identity: of the camera, as ``lscan.devices.api.Identified`` gives it; left out where
    that is unknown.
    files: SHA-256 of each file that the rig names, such as a mesh, by its path; left out where it
    names none.
    laser_may_be_lit: from before the scan lights the laser until it is known to be off; left out
    from then on.
    """

    format: Literal["lscan-run"] = "lscan-run"
    version: Literal[1] = 1
    state: State
    software: list[Versions]
    plan: Plan
    rig: Document
    track_zero: str | None = Field(default=None, exclude_if=lambda zero: zero is None)
    camera_identity: str | None = Field(default=None, exclude_if=lambda identity: identity is None)
    files: dict[str, str] = Field(default_factory=dict, exclude_if=lambda files: not files)
    laser_may_be_lit: bool = Field(default=False, exclude_if=lambda lit: not lit)

    def as_text(self) -> str:
        """The file's text: JSON with, as its last key, the SHA-256 of its meaning."""
        content = self.model_dump(mode="json")
        content["sha256"] = _digest(content)
        return json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"

    @classmethod
    def from_file(cls, file: Path) -> "Manifest":
        """The manifest whose text ``as_text`` wrote; InputError where it is garbled or edited."""
        content = read_json(file, within=file.parent)
        if not isinstance(content, dict):
            raise InputError("is not a run manifest", where=file)
        digest = content.pop("sha256", None)
        manifest = check(cls, content, where=file)
        if digest != _digest(content):
            raise InputError("was changed after it was written", where=file)
        return manifest


@dataclass(frozen=True)
class FrameRow:
    """One row of frames.csv.

    sha256: of the picture's file, in hexadecimal; dark_sha256: of its background's, None where
    the run has none.
    """

    index: int
    commanded_mm: FiniteFloat
    position_mm: FiniteFloat
    time_s: FiniteFloat
    exposure_ms: FiniteFloat
    sha256: str
    dark_sha256: str | None = None

    def as_text(self) -> str:
        """The row without its line end.

        Floats are written so that reading gives the same bits.  The last field is the
        CRC-32 of all that stands before it, so a changed digit does not pass unseen.
        """
        index, *numbers, sha256, dark_sha256 = astuple(self)
        digests = [sha256] if dark_sha256 is None else [sha256, dark_sha256]
        text = ",".join([str(index), *(repr(float(x)) for x in numbers), *digests])
        return f"{text},{_crc32(text)}"

    @staticmethod
    def from_text(text: str, where: object, paired: bool = False) -> "FrameRow":
        """The row that ``as_text`` wrote.

        Parameters
        ----------
        text : str, without its line end
        where : object, file and line, for the error
        paired : bool, whether it must list a background, or must not

        Raises
        ------
        InputError
            It is torn or was changed.
        """
        body, _, crc = text.rpartition(",")
        if crc != _crc32(body):
            raise InputError("row is torn or was changed", where=where, value=text)
        try:
            fields = zip(columns(paired).split(",")[:-1], body.split(","), strict=True)
            return _ROW.validate_strings(dict(fields))
        except ValueError as error:
            what = "row does not hold what it should"
            raise InputError(what, where=where, value=text, allowed=columns(paired)) from error


_ROW = TypeAdapter(FrameRow)


@dataclass(frozen=True)
class Run:
    """A run folder opened for reading.

    Attributes
    ----------
    path : Path, of the folder
    rig_file : RigFile, the rig the scan was made with, as the folder keeps it
    state : State, "complete", or "scanning" where frames are missing
    software : tuple, versions of what wrote the folder; more than one entry where a scan was
        resumed under other versions
    rows : tuple, one per frame, in order
    files : mapping, SHA-256 of each file that the rig names, by its path

    Examples
    --------
    >>> import lscan
    >>> run = lscan.open_run("runs/groove")
    >>> len(run), run.state, run.positions_mm.tolist()
    (2, 'complete', [0.0, 1.0])
    """

    path: Path
    rig_file: RigFile
    state: State
    software: tuple[Versions, ...]
    rows: tuple[FrameRow, ...]
    files: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.rows)

    def __repr__(self) -> str:
        rig, frames = self.rig_file.rig, f"{len(self)} of {self.rig_file.rig.plan.frames} frames"
        return f"<Run {str(self.path)!r}: {rig.name!r}, {frames}, {self.state}>"

    @property
    def positions_mm(self) -> Floats:
        """(F,) track position of each frame as the track reported it, mm."""
        return np.array([row.position_mm for row in self.rows], dtype=float)

    def frame(self, index: int) -> Frame:
        """A frame, read from disk.

        Parameters
        ----------
        index : int, 0 to len - 1

        Raises
        ------
        InputError
            There is no such frame, or its picture is missing, is not the one that was recorded, or
            is not of the rig's size.
        """
        if not 0 <= index < len(self):
            allowed = f"0 to {len(self) - 1}"
            raise InputError("no such frame", where=self.path, value=index, allowed=allowed)
        row = self.rows[index]
        places_mm = row.commanded_mm, row.position_mm
        background = None if row.dark_sha256 is None else self._picture(row, dark=True)
        return Frame(self._picture(row), index, *places_mm, row.time_s, row.exposure_ms, background)

    def frames(self) -> Iterator[Frame]:
        """All frames in order, each read when it is asked for; errors as ``frame``."""
        return (self.frame(index) for index in range(len(self)))

    def verify(self) -> None:
        """Read every picture's file and compare its checksum; InputError as ``frame``."""
        with long_work("recorded pictures checked") as progress:
            for done, row in enumerate(self.rows, start=1):
                self.picture_bytes(row)
                if row.dark_sha256 is not None:
                    self.picture_bytes(row, dark=True)
                progress(done, len(self))

    def picture_bytes(self, row: FrameRow, dark: bool = False) -> bytes:
        """The file of a frame's picture, PNG, as it was recorded.

        Parameters
        ----------
        row : FrameRow, of the frame
        dark : bool, whether its background is meant

        Raises
        ------
        InputError
            It is missing, or is not the one that was recorded.
        """
        file, camera = frame_file(self.path, row.index, dark), self.rig_file.rig.camera
        # PNG needs hardly more than the pixels, 3 bytes each, or 6.
        most_bytes = 4 * camera.width_px * camera.height_px * camera.bytes_a_value + 2**20
        data = read_bytes(file, most_bytes, within=self.path)
        if hashlib.sha256(data).hexdigest() != (row.dark_sha256 if dark else row.sha256):
            what = f"is not the picture that {TABLE} line {row.index + 2} lists (checksum differs)"
            raise InputError(what, where=file)
        return data

    def _picture(self, row: FrameRow, dark: bool = False) -> Picture:
        """A frame's picture, or its background."""
        file, camera = frame_file(self.path, row.index, dark), self.rig_file.rig.camera
        data = self.picture_bytes(row, dark)
        depth_bits: Literal[8, 16] = 8 if camera.bits == 8 else 16
        return read_png(data, file, camera.size_px, whose=", as in the rig", depth_bits=depth_bits)


def open_run(path: Path | str, trusted: bool = False) -> Run:
    """The run in the folder ``path``, complete or not.

    Manifest and table are checked here, and that every picture is there; a picture's bytes
    are checked against the table each time a frame is read (``Run.verify`` reads them all).

    Parameters
    ----------
    path : Path or str
        The run folder.
    trusted : bool
        Whether it may name code, as ``stripe.extractor = "package.module:function"`` does, that
        runs when the line is looked for; only the names of installed extractors otherwise.

    Raises
    ------
    InputError
        It names file and line: run.json missing, garbled, edited, of an unknown version or
        naming code; a row torn, changed, repeated or skipped; a picture missing; more or fewer
        frames than planned; a link that leads out of the folder.

    Examples
    --------
    >>> import lscan
    >>> lscan.open_run("runs/groove").rig_file.rig.workpiece.kind
    'grooved-block'
    """
    path = Path(path)
    manifest, rig_file = read_manifest(path)
    if not trusted:
        allowed = "look at it, and say --trust where you trust it"
        refuse_code(rig_file.rig.stripe.extractor, rig_file.source, allowed)
    plan = manifest.plan
    rows, planned = _read_rows(path / TABLE, plan), plan.frames
    if len(rows) > planned or (manifest.state == "complete" and len(rows) < planned):
        what = f"the number of frames does not fit the plan of this {manifest.state} run"
        raise InputError(what, where=path / TABLE, value=len(rows), allowed=planned)
    require_within(path / FRAMES, path)
    present = list_names(path / FRAMES)
    for row in rows:
        for dark in (False, True) if plan.paired else (False,):
            file = frame_file(path, row.index, dark)
            if file.name not in present:
                raise InputError(f"missing, but {TABLE} line {row.index + 2} lists it", where=file)
    software, files = tuple(manifest.software), manifest.files
    return Run(path, rig_file, manifest.state, software, tuple(rows), files)


def frame_file(path: Path, index: int, dark: bool = False) -> Path:
    """Where a run folder keeps the picture of a frame, or its background.

    Parameters
    ----------
    path : Path, of the run folder
    index : int, of the frame, from 0
    dark : bool, whether the background is meant
    """
    return path / FRAMES / f"{index:06d}{'-dark' if dark else ''}.png"


def columns(paired: bool) -> str:
    """The header of frames.csv, for a run with or without backgrounds."""
    return PAIRED_COLUMNS if paired else COLUMNS


def read_manifest(path: Path) -> tuple[Manifest, RigFile]:
    """The manifest of a run folder and the rig it keeps.

    Parameters
    ----------
    path : Path, of the run folder

    Raises
    ------
    InputError
        As ``open_run``.
    """
    file = path / MANIFEST
    if os.path.isdir(path) and not os.path.lexists(file):  # noqa: PTH112 - takes any text
        raise InputError(f"is not a run folder: it has no {MANIFEST}", where=path)
    manifest = Manifest.from_file(file)
    rig_file = parse_rig(manifest.rig, source=str(file), trusted=True)
    if rig_file.rig.plan != manifest.plan:
        raise InputError("plan and rig.plan differ", where=file)
    return manifest, rig_file


@contextmanager
def laser_warning_repeated(path: Path) -> Iterator[None]:
    """Note with an error of the block that the laser may be lit, where the run says so.

    Parameters
    ----------
    path : Path, of the run folder
    """
    try:
        yield
    except BaseException as error:
        with suppress(LscanError):
            lit = Manifest.from_file(path / MANIFEST).laser_may_be_lit
            if lit and LASER_MAY_BE_LIT not in getattr(error, "__notes__", ()):
                error.add_note(LASER_MAY_BE_LIT)
        raise


def software_versions(plugins: Iterable[tuple[str, str]] = ()) -> Versions:
    """Name to version of what works here, the packages of plug-ins that are not lscan's among them.

    Parameters
    ----------
    plugins : iterable of tuple, group and name of each that takes part
    """
    versions = {
        "lscan": __version__,
        "python": platform.python_version(),
        "numpy": np.__version__,
        "opencv": cv2.__version__,
    }
    for group, name in plugins:
        versions |= others_versions(group, name)
    return versions


def recording_versions(rig: Rig) -> Versions:
    """As ``software_versions``, of what writes a run of a rig: its drivers take part.

    Parameters
    ----------
    rig : Rig
    """
    drivers = {"lscan.cameras": rig.camera.driver, "lscan.tracks": rig.track.driver}
    return software_versions(drivers.items())


def most_table_bytes(plan: Plan) -> int:
    """The largest size of a run's table, bytes: a header, and a row for each frame of the plan.

    Parameters
    ----------
    plan : Plan, of the run
    """
    return (plan.frames + 1) * MOST_ROW_BYTES


def _read_rows(file: Path, plan: Plan) -> list[FrameRow]:
    data = read_bytes(file, most_table_bytes(plan), within=file.parent)
    # Latin-1 takes any byte for a character, so a damaged one fails its row's checksum.
    header, *lines = data.decode("latin-1").split("\n")
    if header != columns(plan.paired):
        where, allowed = f"{file} line 1", columns(plan.paired)
        raise InputError("wrong header", where=where, value=header, allowed=allowed)
    if not data.endswith(b"\n"):
        where = f"{file} line {len(lines) + 1}"
        raise InputError("the last row is torn; lscan scan --resume cuts it off", where=where)
    rows: list[FrameRow] = []
    for index, line in enumerate(lines[:-1]):
        where = f"{file} line {index + 2}"
        row = FrameRow.from_text(line, where, plan.paired)
        if row.index != index:
            what = "a frame is listed twice" if row.index < index else "a frame is skipped"
            raise InputError(what, where=where, value=row.index, allowed=index)
        rows.append(row)
    return rows


def _digest(content: Document) -> str:
    """SHA-256 over sorted keys without spaces, so over what the document means."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


def _crc32(text: str) -> str:
    return f"{zlib.crc32(text.encode('latin-1')):08x}"


# Whether a run may go on with the rig as it now is: all that its data depend on is unchanged.
#
# What only says how a device is reached and waited for, its driver's ``connection_options``, may
# differ: a track that is plugged in again may be another port, and a server another address.


_log = logging.getLogger(__name__)

_GROUPS = {"camera": "lscan.cameras", "track": "lscan.tracks"}


def require_same_rig(begun: RigFile, now: RigFile, where: Path) -> None:
    """Refuse to go on with a run under another rig than it was begun with.

    Parameters
    ----------
    begun : RigFile, the rig the run was begun with
    now : RigFile, the rig it would go on with
    where : Path, the file that keeps the first

    Raises
    ------
    InputError
        The rigs differ; names the key path that differs first, what it was, what it is, and what to
        do.
    """
    was, is_now = _without_connection(begun), _without_connection(now)
    if (key := first_difference(was, is_now)) is not None:
        raise InputError(
            f"cannot go on: the run was begun {_key_in_words(key, was)}, this rig comes "
            f"{_key_in_words(key, is_now)}; restore it in {now.source}, or begin a new scan",
            where=where,
        )


def require_same_camera(begun_with: str | None, camera: Camera) -> None:
    """Refuse to go on with a run with another camera; say so where that cannot be told.

    Parameters
    ----------
    begun_with : str or None, identity of the camera the run was begun with
    camera : Camera, the one it would go on with

    Raises
    ------
    DeviceError
        They are two.
    """
    if not isinstance(camera, Identified):
        return
    if begun_with is None or camera.identity is None:
        _log.warning(
            "nothing tells whether this is the camera the run was begun with (then: %s; now: %s)",
            begun_with or "unknown",
            camera.identity or "unknown",
        )
    elif begun_with != camera.identity:
        raise DeviceError(
            f"cannot go on: the run was begun with the camera {begun_with}, this one is "
            f"{camera.identity}; name the first one as camera.options.device (`lscan devices` "
            "lists what is connected), or begin a new scan"
        )


def require_same_files(files: Mapping[str, str], where: Path) -> None:
    """Refuse files that hold something else than they did.

    Parameters
    ----------
    files : mapping, SHA-256 of what each held, by its path
    where : Path, what was made with them, for the error

    Raises
    ------
    InputError
        Names the first file that is another one, or is gone.
    """
    for file, kept in files.items():
        now = content_sha256(Path(file))
        if now != kept:
            what = f"{'was changed' if now else 'is gone'} since {where} was made with it"
            allowed = f"SHA-256 {kept}: bring that file back, or begin anew"
            raise InputError(what, where=file, value=now or None, allowed=allowed)


def first_difference(one: Any, other: Any) -> str | None:
    """Key path, such as ``camera.options.seed``, of the first difference of two documents.

    None where there is none.  1 and 1.0 differ: they would not give the same run.json.

    Parameters
    ----------
    one, other : Document, or any part of one
    """
    left, right = dict(_leaves(one)), dict(_leaves(other))
    return next((key for key in [*left, *right] if left.get(key) != right.get(key)), None)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    if isinstance(value, dict) and value:
        for name, inner in value.items():
            yield from _leaves(inner, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value:
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{key}[{index}]")
    else:
        yield key, repr(value)


def _key_in_words(key: str, document: Mapping[str, Any]) -> str:
    """The key with its value, or that it is not there, or that more than a value is."""
    leaves = dict(_leaves(document))
    if key in leaves:
        return f"with {key} = {leaves[key]}"
    filled = any(leaf.startswith((f"{key}.", f"{key}[")) for leaf in leaves)
    return f"with entries in {key}" if filled else f"without {key}"


def _without_connection(rig_file: RigFile) -> Document:
    """The rig's document less what only says how its devices are reached."""
    kept = dict(rig_file.document)
    for name, group in _GROUPS.items():
        section = dict(kept[name])
        options = section.pop("options", {})
        connection: frozenset[str] = frozenset()
        if section["driver"] in installed(group):  # and names none where it has none
            driver = find_plugin(group, section["driver"])
            connection = getattr(driver, "connection_options", connection)
        lasting = {key: value for key, value in options.items() if key not in connection}
        kept[name] = {**section, "options": lasting} if lasting else section
    return kept
