"""What a suite holds: its manifest, and a case's picture and truth as bytes of its members."""

import csv
import hashlib
import io
import json
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field

from lscan.config.board import Board
from lscan.config.documents import Model, Strict, check
from lscan.config.plugins import refuse_code
from lscan.config.rig import OpticsSection, Rig, StripeSection
from lscan.errors import InputError
from lscan.files.disk import parse_json
from lscan.files.pictures import encoded, read_png
from lscan.records import Bytes, Floats, Ints, Marks, Mask, Status

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

    def turned(self) -> "LightLayers":
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


# What a suite holds: its manifest, and a case's picture and truth as bytes of its members.


MANIFEST = "suite.json"
VERSION = 3
MOST_MANIFEST_BYTES, MOST_MEMBER_BYTES, MOST_SUITE_BYTES = 2**25, 2**28, 2**31
PICTURE, DARK, LABELS, TRUTH, SETTINGS = (
    "picture.png", "dark.png", "labels.png", "truth.csv", "stripe.json",
)  # fmt: skip
PARTS = (PICTURE, LABELS, TRUTH, SETTINGS)
LAYERS = "layers.png"  # of a line's picture, where they are known
MAP, BOARD, OPTICS = "map.csv", "board.json", "optics.json"
BOARD_PARTS = (PICTURE, TRUTH, MAP, BOARD, OPTICS)
FRAME, RIG, LINE, SLICES = "frame-{:04d}.png", "rig.json", "line.csv", "slices.csv"
SCAN_PARTS = (*BOARD_PARTS, RIG, LINE)
COLUMNS = ("centre_px", "sigma_px", "height_dn", "noise_dn", "multiple", "status")
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


@dataclass(frozen=True)
class SuiteCase:
    """One picture of a suite.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the suite's axes
    picture : (H, W) or (H, W, 3) array, uint8, DN
    dark : as ``picture``, with the laser off; None where there is none
    labels : (H, W) array, uint8, class of each pixel (sim.datasets.labels.Label)
    truth : CaseTruth
    settings : StripeSection, of the rig: noise, threshold, axis
    layers : LightLayers or None, of each pixel, where they are known
    """

    name: str
    axes: Mapping[str, str]
    picture: Bytes
    dark: Bytes | None
    labels: Bytes
    truth: CaseTruth
    settings: StripeSection
    layers: LightLayers | None = None


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
            raise InputError(
                f"{MANIFEST} is of another version", where=where, value=version, allowed=allowed
            )
    except UnicodeDecodeError as error:
        raise InputError(f"{MANIFEST} is no manifest of a suite", where=where) from error
    content = check(SuiteContent, document, where=where, prefix=MANIFEST)
    for name in content.members:
        if not _PLAIN.fullmatch(name):
            raise InputError("a member has a name that is not plain", where=where, value=name)
    kinds = content.kinds.values()
    for cases, parts in zip(kinds, (PARTS, BOARD_PARTS, SCAN_PARTS), strict=True):
        for name in (f"{case}/{part}" for case in cases for part in parts):
            if name not in content.members:
                raise InputError(f"member {name} is not in the manifest", where=where)
    named = Counter(name for cases in kinds for name in cases)
    if twice := [name for name, count in named.items() if count > 1]:
        raise InputError("a case is of two kinds", where=where, value=min(twice))
    if sum(member.size for member in content.members.values()) > MOST_SUITE_BYTES:
        raise InputError(f"{MANIFEST} states more than a suite may hold", where=where)
    return content


def truth_bytes(truth: CaseTruth) -> bytes:
    """The truth as CSV: centres to 1e-5 px, all else to four digits."""
    stream = io.StringIO()
    stream.write(",".join(COLUMNS) + "\n")
    table = np.column_stack([getattr(truth, name) for name in COLUMNS])
    np.savetxt(stream, table, fmt=("%.5f", "%.4g", "%.4g", "%.4g", "%d", "%d"), delimiter=",")
    return stream.getvalue().encode()


def read_truth(data: bytes, where: object) -> CaseTruth:
    """The truth that ``truth_bytes`` wrote; InputError where it is none."""
    try:
        rows = list(csv.reader(io.StringIO(data.decode())))
        if tuple(rows[0]) != COLUMNS:
            raise ValueError
        table = np.array(rows[1:], dtype=float).reshape(len(rows) - 1, len(COLUMNS))
        multiple, status = table[:, 4], table[:, 5]
        if not (np.isin(multiple, (0, 1)).all() and np.isin(status, list(Status)).all()):
            raise ValueError
        if not np.isfinite(table[status == Status.OK, :2]).all():
            raise ValueError
    except (ValueError, IndexError, csv.Error) as error:
        raise InputError("is no table of a line's truth", where=where) from error
    centre, sigma, height, noise = table[:, :4].T
    whole = multiple.astype(np.int64), status.astype(np.int64)
    return CaseTruth(centre, sigma, height, noise, *whole)


def read_section(model: type[Model], data: bytes, where: object) -> Model:
    """The section of a rig file in a member; InputError where it is none, or names code."""
    section = check(model, parse_json(data, where), where=where)
    for of in (section, getattr(section, "stripe", None)):
        if isinstance(of, StripeSection):
            refuse_code(of.extractor, where)
    return section


def member_sum(data: bytes) -> MemberSum:
    """Size and checksum of a member's bytes."""
    return MemberSum(size=len(data), sha256=hashlib.sha256(data).hexdigest())


def noisy_png(picture: Bytes) -> bytes:
    """The PNG of a picture with noise: a fifteenth smaller than by the usual compression."""
    level = (cv2.IMWRITE_PNG_COMPRESSION, 3)  # stated at all, each line has its own filter
    return encoded(
        picture, ".png", (*level, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE)
    )


def case_members(case: SuiteCase) -> dict[str, bytes]:
    """The bytes of each member of a case by its name, that of the truth last."""
    noisy = {PICTURE: case.picture, DARK: case.dark}
    members = {name: noisy_png(shown) for name, shown in noisy.items() if shown is not None}
    members[LABELS] = encoded(case.labels, ".png")
    if case.layers is not None:
        members[LAYERS] = encoded(layers_picture(case.layers), ".png", SMOOTH)
    members[SETTINGS] = f"{case.settings.model_dump_json(indent=1)}\n".encode()
    members[TRUTH] = truth_bytes(case.truth)
    return {f"{case.name}/{name}": data for name, data in members.items()}


# Pictures of the calibration board in a suite: the marks' true places, the map on the sheet.


MARK_COLUMNS = ("x_mm", "z_mm", "u_px", "v_px", "status")
MAP_COLUMNS = ("u_px", "v_px", "x_mm", "z_mm")
MARK_STATUSES = (Status.OK, Status.OUT_OF_VIEW, Status.OCCLUDED)
_FORMS = {"px": "%.6f", "mm": "%.4f", "dn": "%.0f"}  # by a column's unit


@dataclass(frozen=True)
class BoardCase:
    """One picture of the calibration board.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the axes of boards
    picture : (H, W) or (H, W, 3) array, uint8, DN
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
    picture: Bytes
    board: Board
    optics: OpticsSection
    marks: Marks
    map_px: Floats
    map_mm: Floats


def board_members(case: BoardCase) -> dict[str, bytes]:
    """The bytes of each member of a case by its name, that of the marks last.

    Parameters
    ----------
    case : BoardCase
    """
    marks = np.column_stack([case.marks.board_mm, case.marks.image_px, case.marks.status])
    members = {
        PICTURE: noisy_png(case.picture),
        BOARD: f"{case.board.model_dump_json(indent=1)}\n".encode(),
        OPTICS: f"{case.optics.model_dump_json(indent=1)}\n".encode(),
        MAP: table_bytes(MAP_COLUMNS, np.column_stack([case.map_px, case.map_mm])),
        TRUTH: table_bytes(MARK_COLUMNS, marks),
    }
    return {f"{case.name}/{name}": data for name, data in members.items()}


def read_board_case(
    name: str, axes: Mapping[str, str], member: Callable[[str], bytes], suite: object
) -> BoardCase:
    """The case that ``board_members`` wrote.

    Parameters
    ----------
    name : str, of the case
    axes : mapping, its values
    member : callable, the bytes of a member by its name
    suite : where it lies, for errors

    Raises
    ------
    InputError
        Names the member that is harmed.
    """

    def shown(part: str) -> tuple[bytes, str]:
        return member(f"{name}/{part}"), f"{suite}: member {name}/{part}"

    board = read_section(Board, *shown(BOARD))
    marks = _marks(*shown(TRUTH))
    places = [board.grid.points_mm(), *(ruler.points_mm() for ruler in board.ruler)]
    if len(marks.status) != sum(map(len, places)):
        raise InputError(f"members of case {name} differ in marks", where=suite)
    table = read_table(MAP_COLUMNS, *shown(MAP))
    if not (len(table) and np.isfinite(table).all()):
        raise InputError("is no table of a map", where=shown(MAP)[1])
    picture, optics = read_png(*shown(PICTURE)), read_section(OpticsSection, *shown(OPTICS))
    return BoardCase(name, axes, picture, board, optics, marks, table[:, :2], table[:, 2:])


def _marks(data: bytes, where: object) -> Marks:
    table = read_table(MARK_COLUMNS, data, where)
    status = table[:, 4]
    shown = status == Status.OK
    if not (np.isin(status, MARK_STATUSES).all() and np.isfinite(table[shown, :4]).all()):
        raise InputError("is no table of marks", where=where)
    pixels = np.where(shown[:, np.newaxis], table[:, 2:4], np.nan)
    return Marks(table[:, :2], pixels, np.where(shown, 0.0, np.nan), status.astype(np.int64))


def table_bytes(columns: Sequence[str], rows: Floats) -> bytes:
    """CSV: px to a millionth, mm to a ten-thousandth, all else whole.

    Parameters
    ----------
    columns : sequence of str, C of them
    rows : (N, C) array
    """
    stream = io.StringIO()
    stream.write(",".join(columns) + "\n")
    form = [_FORMS.get(name.rpartition("_")[2], "%d") for name in columns]
    np.savetxt(stream, rows, fmt=form, delimiter=",")
    return stream.getvalue().encode()


def read_table(columns: Sequence[str], data: bytes, where: object) -> Floats:
    """The rows, (N, C), that ``table_bytes`` wrote; InputError for any other bytes.

    Parameters
    ----------
    columns : sequence of str, C of them
    data : bytes
    where : for errors
    """
    try:
        head, *rows = csv.reader(io.StringIO(data.decode()))
        if tuple(head) != tuple(columns):
            raise ValueError
        return np.array(rows, dtype=float).reshape(len(rows), len(columns))
    except (ValueError, csv.Error) as error:
        raise InputError(f"is no table of {', '.join(columns)}", where=where) from error


# Whole scans in a suite: the picture of the board, those of the line, and what they truly show.


LINE_COLUMNS = ("x_mm", "z_mm", "height_dn", "multiple", "status")
SLICE_COLUMNS = ("x_mm", "y_mm", "z_mm", "status")


@dataclass(frozen=True)
class ScanCase:
    """One scan, with the board that its rig is calibrated by.

    Attributes
    ----------
    name : str
    axes : mapping, the case's value on each of the axes of scans
    board : BoardCase
    frames : tuple of (H, W) or (H, W, 3) array, uint8, DN; F of them
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
    frames: tuple[Bytes, ...]
    rig: Rig
    line_mm: Floats
    height_dn: Floats
    multiple: Ints
    status: Ints
    slices_mm: Floats
    slice_status: Ints

    @property
    def picture(self) -> Bytes:
        """The picture in the middle of the scan, to look at."""
        return self.frames[len(self.frames) // 2]


def _rig_bytes(rig: Rig) -> bytes:
    """JSON, the drivers' options left out."""
    stated = rig.model_dump(mode="json", exclude_unset=True)
    for device in ("camera", "track"):
        stated[device].pop("options", None)
    return f"{json.dumps(stated, indent=1, sort_keys=True)}\n".encode()


def scan_members(case: ScanCase) -> dict[str, bytes]:
    """The bytes of each member of a case by its name, that of the marks' truth last.

    Parameters
    ----------
    case : ScanCase
    """
    line = np.dstack([case.line_mm, np.rint(case.height_dn), case.multiple, case.status])
    members = {FRAME.format(k): noisy_png(frame) for k, frame in enumerate(case.frames)}
    members[RIG] = _rig_bytes(case.rig)
    members[LINE] = table_bytes(LINE_COLUMNS, line.reshape(-1, len(LINE_COLUMNS)))
    if len(case.slices_mm):
        table = np.column_stack([case.slices_mm, case.slice_status])
        members[SLICES] = table_bytes(SLICE_COLUMNS, table)
    named = {f"{case.name}/{name}": data for name, data in members.items()}
    return {**named, **board_members(case.board)}


def read_scan_case(
    name: str,
    axes: Mapping[str, str],
    member: Callable[[str], bytes],
    has: Callable[[str], bool],
    suite: object,
) -> ScanCase:
    """The case that ``scan_members`` wrote.

    Parameters
    ----------
    name : str, of the case
    axes : mapping, its values
    member : callable, the bytes of a member by its name
    has : callable, whether there is a member of that name
    suite : where it lies, for errors

    Raises
    ------
    InputError
        Names the member that is harmed.
    """

    def shown(part: str) -> tuple[bytes, str]:
        if not has(f"{name}/{part}"):
            raise InputError(f"member {name}/{part} is missing", where=suite)
        return member(f"{name}/{part}"), f"{suite}: member {name}/{part}"

    board = read_board_case(name, axes, member, suite)
    rig = read_section(Rig, *shown(RIG))
    camera, count = rig.camera, rig.plan.frames
    frames = tuple(read_png(*shown(FRAME.format(k))) for k in range(count))
    columns = camera.width_px if rig.stripe.axis == "columns" else camera.height_px
    size = (camera.height_px, camera.width_px)
    line = read_table(LINE_COLUMNS, *shown(LINE))
    sizes = {picture.shape[:2] for picture in (board.picture, *frames)}
    if sizes != {size} or len(line) != count * columns:
        raise InputError(f"members of case {name} differ in size", where=suite)
    points = line.reshape(count, columns, len(LINE_COLUMNS))
    _check(points[..., :3], points[..., 4], np.isin(points[..., 3], (0, 1)), shown(LINE)[1])
    slices = np.empty((0, len(SLICE_COLUMNS)))
    if has(f"{name}/{SLICES}"):
        slices = read_table(SLICE_COLUMNS, *shown(SLICES))
        _check(slices[:, :3], slices[:, 3], np.isfinite(slices[:, :3]), shown(SLICES)[1])
    return ScanCase(
        name,
        axes,
        board,
        frames,
        rig,
        points[..., :2],
        points[..., 2],
        points[..., 3].astype(np.int64),
        points[..., 4].astype(np.int64),
        slices[:, :3],
        slices[:, 3].astype(np.int64),
    )


def _check(places: Floats, status: Floats, plain: Mask, where: str) -> None:
    """Refuse a table of statuses that are none, or of places that are no numbers."""
    shown = status == Status.OK
    whole = np.isin(status, list(Status)).all() and np.isfinite(places[shown]).all()
    if not (whole and plain.all()):
        raise InputError("is no table of a scan's truth", where=where)
