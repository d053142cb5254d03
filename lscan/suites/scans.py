"""Whole scans in a suite: the picture of the board, those of the line, and what they truly show."""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from lscan.config.rig import Rig
from lscan.errors import InputError
from lscan.files.pictures import read_png
from lscan.records import Bytes, Floats, Ints, Mask, Status
from lscan.suites.boards import BoardCase, board_members, read_board_case, read_table, table_bytes
from lscan.suites.content import FRAME, LINE, RIG, SLICES, noisy_png, read_section

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
