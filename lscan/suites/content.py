"""What a suite holds: its manifest, and its cases as bytes of their members.

A case is a picture of a laser line, a picture of the calibration board, or a whole scan with its
board.  Each says which members it must have, what bytes they are, and how it is read from them.
"""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal

import cv2
import numpy as np
from pydantic import Field

from lscan.config.board import Board
from lscan.config.documents import Model, Strict, check
from lscan.config.plugins import refuse_code
from lscan.config.rig import OpticsSection, Rig, StripeSection
from lscan.errors import InputError
from lscan.files.disk import parse_json
from lscan.files.pictures import eight_bit, encode_picture, read_png
from lscan.records import Bytes, Floats, Ints, Marks, Picture, Status

MANIFEST = "suite.json"
VERSION = 3
MOST_MANIFEST_BYTES, MOST_MEMBER_BYTES, MOST_SUITE_BYTES = 2**25, 2**28, 2**31
PICTURE, DARK, LABELS, TRUTH, SETTINGS = (
    "picture.png", "dark.png", "labels.png", "truth.csv", "stripe.json",
)  # fmt: skip
LAYERS = "layers.png"  # of a line's picture, where they are known
MAP, BOARD, OPTICS = "map.csv", "board.json", "optics.json"
FRAME, RIG, LINE, SLICES = "frame-{:04d}.png", "rig.json", "line.csv", "slices.csv"
SMOOTH = (cv2.IMWRITE_PNG_COMPRESSION, 9)  # of a PNG without noise
_PLAIN = re.compile(r"[a-z0-9][a-z0-9._-]*/[a-z0-9][a-z0-9._-]*")
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 ._+-]{0,99}$")]


class MemberSum(Strict):
    """Size in bytes and checksum of a member."""

    size: int = Field(ge=0, le=MOST_MEMBER_BYTES)
    sha256: str = Field(pattern="^[0-9a-f]{64}$")


class SuiteContent(Strict):
    """The manifest.

    cases: pictures of a laser line, by name, with the case's value on each axis (water, target
    ...).  boards, scans: likewise, pictures of the calibration board, and whole scans.
    """

    format: Literal["lscan-suite"] = "lscan-suite"
    version: int = VERSION
    name: str = Field(pattern="^[a-z0-9][a-z0-9-]{0,63}$")
    seed: int = Field(ge=0)
    made_by: Word
    cases: Mapping[str, Mapping[Word, Word]]
    boards: Mapping[str, Mapping[Word, Word]] = Field(default_factory=dict)
    scans: Mapping[str, Mapping[Word, Word]] = Field(default_factory=dict)
    members: Mapping[str, MemberSum]

    @property
    def kinds(self) -> dict[str, Mapping[str, Mapping[str, str]]]:
        """What it holds, by what it is called, each by name with its axes."""
        return {"cases": self.cases, "boards": self.boards, "scans": self.scans}


def axes_of(cases: Mapping[str, Mapping[str, str]]) -> dict[str, dict[str, int]]:
    """How many cases there are of each value on each axis.

    Parameters
    ----------
    cases : mapping, of a manifest: ``cases``, ``boards`` or ``scans``
    """
    found: dict[str, Counter[str]] = {}
    for axes in cases.values():
        for axis, value in axes.items():
            found.setdefault(axis, Counter())[value] += 1
    return {axis: dict(sorted(counts.items())) for axis, counts in found.items()}


def manifest_bytes(content: SuiteContent) -> bytes:
    """The one file that says this content: JSON with sorted keys, and its own checksum before."""
    plain = json.dumps(content.model_dump(mode="json"), sort_keys=True, indent=1)
    return f"{hashlib.sha256(plain.encode()).hexdigest()}\n{plain}\n".encode()


def read_manifest(data: bytes, where: object) -> SuiteContent:
    """The content that ``manifest_bytes`` wrote; InputError for any other bytes."""
    try:
        stated, _, plain = data.decode().partition("\n")
        if hashlib.sha256(plain[:-1].encode()).hexdigest() != stated or plain[-1:] != "\n":
            raise InputError(f"{MANIFEST} does not have its own checksum", where=where)
        document = parse_json(plain, where)
        version = document.get("version") if isinstance(document, dict) else None
        if version != VERSION:
            allowed = f"{VERSION}; lscan-sim suite make renders it anew"
            what = f"{MANIFEST} is of another version"
            raise InputError(what, where=where, value=version, allowed=allowed)
    except UnicodeDecodeError as error:
        raise InputError(f"{MANIFEST} is no manifest of a suite", where=where) from error
    content = check(SuiteContent, document, where=where, prefix=MANIFEST)
    for name in content.members:
        if not _PLAIN.fullmatch(name):
            raise InputError("a member has a name that is not plain", where=where, value=name)
    for kind, cases in content.kinds.items():
        for name in (f"{case}/{part}" for case in cases for part in KINDS[kind].needed):
            if name not in content.members:
                raise InputError(f"member {name} is not in the manifest", where=where)
    named = Counter(name for cases in content.kinds.values() for name in cases)
    if twice := [name for name, count in named.items() if count > 1]:
        raise InputError("a case is of two kinds", where=where, value=min(twice))
    if sum(member.size for member in content.members.values()) > MOST_SUITE_BYTES:
        raise InputError(f"{MANIFEST} states more than a suite may hold", where=where)
    return content


def member_sum(data: bytes) -> MemberSum:
    """Size and checksum of a member's bytes."""
    return MemberSum(size=len(data), sha256=hashlib.sha256(data).hexdigest())


# Tables of truth, as CSV.


@dataclass(frozen=True)
class Table:
    """A table in a member.

    Attributes
    ----------
    what : str, for errors
    columns : str, their names, as the first line has them
    form : str, how the numbers of a row are written
    finite : int, how many of the first columns have a number wherever the status is OK
    everywhere : bool, whether also where it is not; then there is a row at least
    statuses : tuple of int, that there may be
    """

    what: str
    columns: str
    form: str
    finite: int
    everywhere: bool = False
    statuses: tuple[int, ...] = tuple(Status)


LINE_TRUTH = Table(
    "a line's truth",
    "centre_px,sigma_px,height_dn,noise_dn,multiple,status", "%.5f,%.4g,%.4g,%.4g,%d,%d", 2,
)  # fmt: skip
MARKS_TRUTH = Table(
    "marks", "x_mm,z_mm,u_px,v_px,status", "%.4f,%.4f,%.6f,%.6f,%d", 4,
    statuses=(Status.OK, Status.OUT_OF_VIEW, Status.OCCLUDED),
)  # fmt: skip
MAP_TRUTH = Table("a map", "u_px,v_px,x_mm,z_mm", "%.6f,%.6f,%.4f,%.4f", 4, everywhere=True)
POINTS_TRUTH = Table(
    "a scan's truth", "x_mm,z_mm,height_dn,multiple,status", "%.4f,%.4f,%.0f,%d,%d", 3
)
SLICES_TRUTH = Table(
    "a scan's truth", "x_mm,y_mm,z_mm,status", "%.4f,%.4f,%.4f,%d", 3, everywhere=True
)


def table_bytes(table: Table, *columns: Floats | Ints) -> bytes:
    """The CSV of a table.

    Parameters
    ----------
    table : Table
    columns : (N,) or (N, C) arrays, which beside each other are its columns
    """
    stream = io.StringIO()
    np.savetxt(stream, np.column_stack(columns), table.form, header=table.columns, comments="")
    return stream.getvalue().encode()


def read_table(table: Table, data: bytes, where: object) -> Floats:
    """The rows, (N, C), of a table that ``table_bytes`` wrote; InputError for any other bytes.

    Parameters
    ----------
    table : Table
    data : bytes
    where : for errors
    """
    try:
        names, *lines = csv.reader(io.StringIO(data.decode()))
        if names != table.columns.split(","):
            raise ValueError
        rows = np.array(lines, dtype=float).reshape(len(lines), len(names))
    except (ValueError, csv.Error) as error:
        said = table.columns.replace(",", ", ")
        raise InputError(f"is no table of {said}", where=where) from error
    of = dict(zip(names, rows.T, strict=True))
    status = of.get("status", np.full(len(rows), float(Status.OK)))
    needed = rows[(status == Status.OK) | table.everywhere, : table.finite]
    flags = np.isin(status, table.statuses).all() and np.isin(of.get("multiple", 0), (0, 1)).all()
    if not (flags and np.isfinite(needed).all() and (len(rows) or not table.everywhere)):
        raise InputError(f"is no table of {table.what}", where=where)
    return rows


# The members of a case.


@dataclass(frozen=True)
class CaseMembers:
    """Reads the members of a case, whose bytes are as the manifest states; each names itself.

    Attributes
    ----------
    case : str, its name
    axes : mapping, its values
    suite : where it lies, for errors
    known : container of the names of the suite's members
    member : callable, the bytes of a member by its name
    """

    case: str
    axes: Mapping[str, str]
    suite: object
    known: Container[str]
    member: Callable[[str], bytes]

    def has(self, part: str) -> bool:
        """Whether there is such a part."""
        return f"{self.case}/{part}" in self.known

    def png(self, part: str, depth_bits: Literal[8] | None = 8) -> Picture:
        """The picture in a member.  depth_bits: as ``read_png`` takes it."""
        return read_png(*self._bytes_of(part), depth_bits=depth_bits)

    def table(self, table: Table, part: str) -> Floats:
        """The rows of the table in a member."""
        return read_table(table, *self._bytes_of(part))

    def section(self, model: type[Model], part: str) -> Model:
        """The section of a rig file in a member; InputError where it is none, or names code."""
        data, where = self._bytes_of(part)
        section = check(model, parse_json(data, where), where=where)
        for of in (section, getattr(section, "stripe", None)):
            if isinstance(of, StripeSection):
                refuse_code(of.extractor, where)
        return section

    def differ(self, what: str) -> InputError:
        """The error of members that do not fit each other."""
        return InputError(f"members of case {self.case} differ in {what}", where=self.suite)

    def _bytes_of(self, part: str) -> tuple[bytes, str]:
        """The bytes of a member, and where it lies, for errors."""
        name = f"{self.case}/{part}"
        if name not in self.known:
            raise InputError(f"member {name} is missing", where=self.suite)
        return self.member(name), f"{self.suite}: member {name}"


def section_bytes(section: Strict) -> bytes:
    """The JSON of a section of a rig file."""
    return f"{section.model_dump_json(indent=1)}\n".encode()


def noisy_png(picture: Picture) -> bytes:
    """The PNG of a picture with noise: a fifteenth smaller than by the usual compression."""
    level = (cv2.IMWRITE_PNG_COMPRESSION, 3)  # stated at all, each line has its own filter
    return encode_picture(
        picture, ".png", (*level, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    )


# The layers of light that a picture is made of, as a picture of their logarithms.


STEPS = 16  # to a factor of two: rounding makes 2.2 %
LEAST_DN = 0.25  # beneath, steps are even: rounding makes 0.006 DN at 0 and 0.01 DN there


@dataclass(frozen=True)
class LightLayers:
    """What reaches the lens from each pixel's direction, without noise, blur or clipping.

    In the unit of light that lifts a pixel on the axis from black by one digital number in that
    picture.

    Attributes
    ----------
    direct : (H, W) array, DN, laser light reflected once, by the surface the laser itself lit
    scattered : (H, W) array, DN, all other laser light: veil, halo, reflections of the line
    ambient : (H, W) array, DN, everything that is not the laser's
    """

    direct: Floats
    scattered: Floats
    ambient: Floats

    def transpose(self) -> "LightLayers":
        """As a camera sees them whose columns are the other's rows."""
        return replace(self, **{name: layer.T for name, layer in vars(self).items()})


def layers_picture(layers: LightLayers) -> Bytes:
    """(H, W, 3) uint8, a channel for each layer: STEPS log2(1 + layer / LEAST_DN), rounded.

    255 stands for 15,700 DN and all above.

    Parameters
    ----------
    layers : LightLayers
    """
    light = np.stack([layers.direct, layers.scattered, layers.ambient], axis=-1)
    return np.clip(np.rint(STEPS * np.log2(1 + light / LEAST_DN)), 0, 255).astype(np.uint8)


def layers_of_picture(picture: Bytes) -> LightLayers:
    """The layers that ``layers_picture`` wrote, to its rounding.

    Parameters
    ----------
    picture : (H, W, 3) array, uint8
    """
    light = LEAST_DN * (np.exp2(np.arange(256) / STEPS) - 1)
    return LightLayers(*(light[picture[..., k]] for k in range(3)))


# The cases.


@dataclass(frozen=True)
class CaseTruth:
    """The truth of a line in a picture, by column (or row, where the line runs down).

    Attributes
    ----------
    centre_px : (N,) array, px; NaN where the line is not to be seen
    sigma_px : (N,) array, px, standard deviation of the line across
    height_dn : (N,) array, DN, its peak above what lies about it
    noise_dn : (N,) array, DN, standard deviation of the noise beside it
    multiple : (N,) array, 1 where the column holds several lines and none of them is the one meant
    status : (N,) array, of Status
    """

    centre_px: Floats
    sigma_px: Floats
    height_dn: Floats
    noise_dn: Floats
    multiple: Ints
    status: Ints


@dataclass(frozen=True, eq=False)
class SuiteCase:
    """One picture of a suite.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the suite's axes
    picture : (H, W) or (H, W, 3) array, uint8 or uint16
    dark : as ``picture``, with the laser off; None where there is none
    labels : (H, W) array, uint8, class of each pixel (sim.datasets.labels.Label)
    truth : CaseTruth
    settings : StripeSection, of the rig: noise, threshold, axis
    layers : LightLayers or None, of each pixel, where they are known
    """

    name: str
    axes: Mapping[str, str]
    picture: Picture
    dark: Picture | None
    labels: Bytes
    truth: CaseTruth
    settings: StripeSection
    layers: LightLayers | None = None
    needed: ClassVar = (PICTURE, LABELS, TRUTH, SETTINGS)

    def parts(self) -> dict[str, bytes]:
        """The bytes of each member by its name within the case, that of the truth last."""
        noisy = {PICTURE: self.picture, DARK: self.dark}
        members = {name: noisy_png(shown) for name, shown in noisy.items() if shown is not None}
        members[LABELS] = encode_picture(self.labels, ".png")
        if self.layers is not None:
            members[LAYERS] = encode_picture(layers_picture(self.layers), ".png", SMOOTH)
        members[SETTINGS] = section_bytes(self.settings)
        members[TRUTH] = table_bytes(LINE_TRUTH, *vars(self.truth).values())
        return members

    @classmethod
    def read(cls, of: CaseMembers) -> "SuiteCase":
        """The case whose ``parts`` are members; InputError, which names one that is harmed.

        Parameters
        ----------
        of : CaseMembers
        """
        picture, labels = of.png(PICTURE, None), eight_bit(of.png(LABELS))
        dark = of.png(DARK, None) if of.has(DARK) else None
        light = eight_bit(of.png(LAYERS)) if of.has(LAYERS) else None
        truth, settings = of.table(LINE_TRUTH, TRUTH).T, of.section(StripeSection, SETTINGS)
        sizes = labels.shape == picture.shape[:2]
        sizes &= truth.shape[1] == picture.shape[settings.axis == "columns"]
        sizes &= dark is None or dark.shape == picture.shape
        if not sizes or (light is not None and light.shape != (*labels.shape, 3)):
            raise of.differ("size")
        return cls(
            of.case, of.axes, picture, dark, labels,
            CaseTruth(*truth[:4], *truth[4:].astype(np.int64)), settings,
            None if light is None else layers_of_picture(light),
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class BoardCase:
    """One picture of the calibration board.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the axes of boards
    picture : (H, W) or (H, W, 3) array, uint8 or uint16
    board : Board, as it was made
    optics : OpticsSection, what its owner knows of camera and port
    marks : Marks, the grid row by row, then the rulers' in their order, where their centres truly
        are in the picture; sigma_px is 0, or NaN where a mark is not to be seen
    map_px : (N, 2) array, px, places of the picture, on a lattice over the board
    map_mm : (N, 2) array, mm, (x, z) of the laser sheet that is truly seen there, in the frame that
        the board marks on it
    """

    name: str
    axes: Mapping[str, str]
    picture: Picture
    board: Board
    optics: OpticsSection
    marks: Marks
    map_px: Floats
    map_mm: Floats
    needed: ClassVar = (PICTURE, TRUTH, MAP, BOARD, OPTICS)

    def parts(self) -> dict[str, bytes]:
        """The bytes of each member by its name within the case, that of the marks last."""
        marks = self.marks
        return {
            PICTURE: noisy_png(self.picture),
            BOARD: section_bytes(self.board),
            OPTICS: section_bytes(self.optics),
            MAP: table_bytes(MAP_TRUTH, self.map_px, self.map_mm),
            TRUTH: table_bytes(MARKS_TRUTH, marks.board_mm, marks.image_px, marks.status),
        }

    @classmethod
    def read(cls, of: CaseMembers) -> "BoardCase":
        """The case whose ``parts`` are members; InputError, which names one that is harmed.

        Parameters
        ----------
        of : CaseMembers
        """
        board, marks = of.section(Board, BOARD), of.table(MARKS_TRUTH, TRUTH)
        count = len(board.grid.points_mm())
        if len(marks) != count + sum(len(ruler.points_mm()) for ruler in board.ruler):
            raise of.differ("marks")
        status, places = marks[:, 4], of.table(MAP_TRUTH, MAP)
        shown = status == Status.OK
        pixels = np.where(shown[:, np.newaxis], marks[:, 2:4], np.nan)
        sigma = np.where(shown, 0.0, np.nan)
        return cls(
            of.case, of.axes, of.png(PICTURE, None), board, of.section(OpticsSection, OPTICS),
            Marks(marks[:, :2], pixels, sigma, status.astype(np.int64)),
            places[:, :2], places[:, 2:],
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class ScanCase:
    """One scan, with the board that its rig is calibrated by.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the axes of scans
    board : BoardCase
    frames : tuple of (H, W) or (H, W, 3) array, uint8 or uint16; F of them
    rig : Rig, what its owner knows of it; its plan says where the pictures were taken
    line_mm : (F, N, 2) array, mm, (x, z) on the laser sheet of what each column truly shows, in the
        frame that the board marks on it; NaN where the line is not to be seen
    height_dn : (F, N) array, DN, its peak above what lies about it, to a whole number
    multiple : (F, N) array, 1 where a column holds several points of the line
    status : (F, N) array, of Status
    slices_mm : (M, 3) array, mm, points of the sandwave in its own frame, slice by slice; none of
        any other workpiece
    slice_status : (M,) array, of Status: OK where lit and seen
    """

    name: str
    axes: Mapping[str, str]
    board: BoardCase
    frames: tuple[Picture, ...]
    rig: Rig
    line_mm: Floats
    height_dn: Floats
    multiple: Ints
    status: Ints
    slices_mm: Floats
    slice_status: Ints
    needed: ClassVar = (*BoardCase.needed, RIG, LINE)

    @property
    def picture(self) -> Picture:
        """The picture in the middle of the scan, to look at."""
        return self.frames[len(self.frames) // 2]

    def parts(self) -> dict[str, bytes]:
        """The bytes of each member by its name within the case, that of the marks' truth last.

        The rig without its drivers' options.
        """
        stated = self.rig.model_dump(mode="json", exclude_unset=True)
        for device in ("camera", "track"):
            stated[device].pop("options", None)
        members = {FRAME.format(k): noisy_png(frame) for k, frame in enumerate(self.frames)}
        members[RIG] = f"{json.dumps(stated, indent=1, sort_keys=True)}\n".encode()
        columns = (self.height_dn, self.multiple, self.status)
        members[LINE] = table_bytes(
            POINTS_TRUTH, self.line_mm.reshape(-1, 2), *(of.ravel() for of in columns)
        )
        if len(self.slices_mm):
            members[SLICES] = table_bytes(SLICES_TRUTH, self.slices_mm, self.slice_status)
        return {**members, **self.board.parts()}

    @classmethod
    def read(cls, of: CaseMembers) -> "ScanCase":
        """The case whose ``parts`` are members; InputError, which names one that is harmed.

        Parameters
        ----------
        of : CaseMembers
        """
        board, rig = BoardCase.read(of), of.section(Rig, RIG)
        size = (rig.camera.height_px, rig.camera.width_px)
        frames = tuple(of.png(FRAME.format(k), None) for k in range(rig.plan.frames))
        points = of.table(POINTS_TRUTH, LINE)
        shape = len(frames), size[rig.stripe.axis == "columns"]
        sizes = {picture.shape[:2] for picture in (board.picture, *frames)}
        if sizes != {size} or len(points) != np.prod(shape):
            raise of.differ("size")
        slices = of.table(SLICES_TRUTH, SLICES) if of.has(SLICES) else np.empty((0, 4))
        columns = points.T.reshape(-1, *shape)
        multiple, status = columns[3:].astype(np.int64)
        return cls(
            of.case, of.axes, board, frames, rig, points[:, :2].reshape(*shape, 2), columns[2],
            multiple, status, slices[:, :3], slices[:, 3].astype(np.int64),
        )  # fmt: skip


KINDS: Mapping[str, type[SuiteCase | BoardCase | ScanCase]] = {
    "cases": SuiteCase,
    "boards": BoardCase,
    "scans": ScanCase,
}
"""By what a manifest calls them, with the parts that a case of each must have."""
