"""VIEWS.toml: which pictures of which board, and how they are to be read."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, PositiveFloat, ValidationInfo, field_validator

from lscan.board import read_board
from lscan.board.chessboard import read_charuco, read_chessboard
from lscan.calibration.multiview.boardline import Outline, line_on_board
from lscan.calibration.multiview.views import CalibrationView
from lscan.config.board import load_board
from lscan.config.documents import Strict, check, read_document
from lscan.config.rig import Channel, Known, OpticsSection, StripeSection
from lscan.errors import BoardNotFound, InputError, MeasurementError
from lscan.files.pictures import read_picture
from lscan.records import Bytes, Marks, Progress
from lscan.stripe import extract_stripe

Side = Annotated[int, Field(ge=3, le=1000)]
SAME = "same"  # the line is on the board's picture itself
NONE = "none"  # nothing is subtracted


class Dots(Strict):
    """A dot board, described by a board file.  margin_mm: of the board beyond its dots."""

    kind: Literal["dots"]
    file: str
    margin_mm: PositiveFloat | None = None


class Chessboard(Strict):
    """columns, rows: inner corners.  margin_mm: of the board beyond them; None: a square."""

    kind: Literal["chessboard"]
    columns: Side
    rows: Side
    square_mm: PositiveFloat
    margin_mm: PositiveFloat | None = None


class Charuco(Strict):
    """columns, rows, margin_mm: as of a chessboard.  dictionary: as OpenCV calls it."""

    kind: Literal["charuco"]
    columns: Side
    rows: Side
    square_mm: PositiveFloat
    marker_mm: PositiveFloat
    dictionary: str = "DICT_4X4_50"
    margin_mm: PositiveFloat | None = None


class ViewEntry(Strict):
    """One pose.  laser: the picture with the line on it, or "same"; no line if left out.

    background: of the laser's own picture, the same view with the laser off, to be subtracted;
    the board's picture if left out, "none": nothing is subtracted, as where the lamps were
    dimmed for the line.  Paths are relative to the file.
    """

    picture: str
    laser: str | None = None
    background: str | None = None

    @field_validator("background")
    @classmethod
    def _has_a_laser_picture(cls, background: str | None, info: ValidationInfo) -> str | None:
        if background is not None and info.data.get("laser") in (None, SAME):
            raise ValueError("goes with a laser picture of its own")
        return background


class ViewsDocument(Strict):
    """The whole file.

    channel: in which the board is looked for.  k3: third radial coefficient and its standard
    uncertainty, beside the section [optics].
    """

    name: str = "unnamed"
    channel: Channel = "grey"
    board: Annotated[Dots | Chessboard | Charuco, Field(discriminator="kind")]
    optics: OpticsSection = OpticsSection()
    k3: Known = (0.0, 0.0)
    stripe: StripeSection = StripeSection()
    view: Annotated[tuple[ViewEntry, ...], Field(min_length=1, max_length=1000)]


@dataclass(frozen=True)
class ViewsFile:
    """A views file as read.

    Attributes
    ----------
    document : ViewsDocument, its content
    path : Path, of the file; the pictures' paths are relative to its folder
    """

    document: ViewsDocument
    path: Path


def load_views(path: Path) -> ViewsFile:
    """The views file at a path.

    Parameters
    ----------
    path : Path, of the TOML file

    Raises
    ------
    InputError
        Names the key that is wrong.
    """
    return ViewsFile(check(ViewsDocument, read_document(path), where=path), path)


def read_views(
    views: ViewsFile, progress: Progress | None = None
) -> tuple[list[CalibrationView], tuple[int, int]]:
    """All views of the file, read, and the pictures' (width, height) in px.

    A picture without the board, or with too little of it, or a line that is not there, makes a view
    with a fault.

    Parameters
    ----------
    views : ViewsFile, as loaded
    progress : callable, optional, called with the number of views done, and of all

    Raises
    ------
    InputError
        For a picture that cannot be read or is of another size than the first.
    """
    read_marks = _marks_reader(views.document)
    outline_mm = _outline_mm(views.document)
    found: list[CalibrationView] = []
    size: tuple[int, int] | None = None

    def read(name: str) -> Bytes:
        nonlocal size
        path = views.path.parent / name
        picture = read_picture(path)
        own = (picture.shape[1], picture.shape[0])
        size = size or own
        if own != size:
            raise InputError(
                "is not of the first picture's size",
                where=path,
                value=own,
                allowed=f"{size[0]} x {size[1]} px",
            )
        return picture

    for entry in views.document.view:
        found.append(_read(entry, views.document.stripe, read, read_marks, outline_mm))
        if progress is not None:
            progress(len(found), len(views.document.view))
    assert size is not None  # the file holds a view
    return found, size


def _marks_reader(document: ViewsDocument) -> Callable[[Bytes], Marks]:
    """What finds the marks of the file's board in a picture; BoardNotFound where they are not."""
    section, channel = document.board, document.channel
    match section:
        case Dots():
            board = load_board(Path(section.file))
            return lambda picture: read_board(picture, board, channel=channel).grid
        case Chessboard():
            size = (section.columns, section.rows, section.square_mm)
            return lambda picture: read_chessboard(picture, *size, channel)
        case Charuco():
            whole = (section.columns, section.rows, section.square_mm, section.marker_mm)
            return lambda picture: read_charuco(picture, *whole, section.dictionary, channel)


def _outline_mm(document: ViewsDocument) -> Outline | None:
    """How far the file's board reaches, in the frame of its marks; None where it is not known."""
    section = document.board
    if isinstance(section, Dots):
        grid = load_board(Path(section.file)).grid
        columns, rows, pitch, margin = grid.columns, grid.rows, grid.pitch_mm, section.margin_mm
        if margin is None or not grid.whole:
            return None
    else:
        columns, rows, pitch = section.columns, section.rows, section.square_mm
        margin = pitch if section.margin_mm is None else section.margin_mm
    return -margin, (columns - 1) * pitch + margin, -(rows - 1) * pitch - margin, margin


def _read(
    entry: ViewEntry,
    stripe: StripeSection,
    read: Callable[[str], Bytes],
    read_marks: Callable[[Bytes], Marks],
    outline_mm: Outline | None,
) -> CalibrationView:
    picture = read(entry.picture)
    try:
        marks = read_marks(picture)
    except BoardNotFound as error:
        return CalibrationView(entry.picture, None, None, str(error))
    if entry.laser is None:
        return CalibrationView(entry.picture, marks)
    lit, dark = picture, None
    if entry.laser != SAME:
        lit = read(entry.laser)
        dark = picture if entry.background is None else None
        if entry.background is not None and entry.background != NONE:
            dark = read(entry.background)
    try:
        line = line_on_board(extract_stripe(lit, stripe, dark), marks, outline_mm)
    except MeasurementError as error:
        return CalibrationView(entry.picture, marks, None, str(error))
    if len(line.image_px) == 0:
        return CalibrationView(entry.picture, marks, None, "no laser line was found on the board")
    return CalibrationView(entry.picture, marks, line)
