"""Pictures of the calibration board in a suite: the marks' true places, the map on the sheet."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lscan.config.board import Board
from lscan.config.rig import OpticsSection
from lscan.errors import InputError
from lscan.files.pictures import read_png
from lscan.records import Bytes, Floats, Marks, Status
from lscan.suites.content import BOARD, MAP, OPTICS, PICTURE, TRUTH, noisy_png, read_section

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
