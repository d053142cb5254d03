"""Views of a board: VIEWS.toml, what each picture gives, and pictures of what was seen."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field, PositiveFloat, ValidationInfo, field_validator

from lscan.board import read_board
from lscan.board.chessboard import read_charuco, read_chessboard
from lscan.calibration.marks import Region, region_around
from lscan.config.board import load_board
from lscan.config.documents import Strict, check, read_document
from lscan.config.rig import Channel, Known, LensChoice, OpticsSection, StripeSection
from lscan.errors import BoardNotFound, InputError, MeasurementError
from lscan.files.disk import make_folder
from lscan.files.pictures import eight_bit, read_picture, write_picture
from lscan.records import Axis, Bytes, Floats, Marks, Picture, Progress, Stripe, has_value
from lscan.stripe import extract_stripe

# What one picture of the board gives to the multi-view calibration.


@dataclass(frozen=True)
class LinePoints:
    """The laser line on a board, where it was found.

    Attributes
    ----------
    image_px : (K, 2) array, px, of (u, v)
    sigma_px : (K,) array, px, standard uncertainty across the line
    axis : str, "columns": the line was looked for in each column, its v is what is uncertain;
        "rows": in each row, and its u is
    """

    image_px: Floats
    sigma_px: Floats
    axis: Axis

    @property
    def across(self) -> Floats:
        """(2,) unit vector in the picture along which the points are uncertain."""
        return np.array([0.0, 1.0] if self.axis == "columns" else [1.0, 0.0])


@dataclass(frozen=True)
class CalibrationView:
    """One pose of the board.

    Attributes
    ----------
    name : str, of the picture, for messages
    marks : Marks or None, px and mm, of the board; None where it was not found
    line : LinePoints or None, px, the laser line on it, None where there is none
    fault : str, why marks, or the line that was looked for, are missing; "" where nothing is
    """

    name: str
    marks: Marks | None
    line: LinePoints | None = None
    fault: str = ""

    @property
    def marks_found(self) -> int:
        """How many marks were found."""
        return 0 if self.marks is None else int(self.marks.found.sum())

    @property
    def points_found(self) -> int:
        """How many points of the laser line were found."""
        return 0 if self.line is None else len(self.line.image_px)


@dataclass(frozen=True)
class FittedView(CalibrationView):
    """A view, and what became of it; NaN where there is no number.

    Attributes
    ----------
    used : bool, whether camera and sheet rest on its marks
    marks_used : int, how many of them
    rms_px : float, px, root mean square length of their residuals
    line_used : bool, whether the sheet rests on its line
    line_points_used : int, how many of the line's points
    line_rms_mm : float, mm, root mean square of their distances from the sheet
    reason : str, why the view, or its line, was not used, or what is doubtful about it; "" where
        nothing is
    """

    used: bool = False
    marks_used: int = 0
    rms_px: float = np.nan
    line_used: bool = False
    line_points_used: int = 0
    line_rms_mm: float = np.nan
    reason: str = ""

    @property
    def outcome(self) -> str:
        """Whether it was used, and the reason if there is one, in words."""
        whole = self.used and (self.line is None or self.line_used)
        return "; ".join(filter(None, ("used" if whole else "", self.reason))) or "not used"


# Which points of a stripe lie on the board.


Outline = tuple[float, float, float, float]
"""(left, right, bottom, top) of a board, mm, in the frame of its marks."""

EDGE_PX = 3.0  # from the board's edge: nearer, blur mixes the line with what lies behind the board


def line_on_board(stripe: Stripe, marks: Marks, outline_mm: Outline | None = None) -> LinePoints:
    """The points of a stripe that lie on the board: to its edge, or to its outermost marks.

    Elsewhere the line falls on what stands behind the board.  Saturated points weigh as little
    as their sigma_px says.

    Parameters
    ----------
    stripe : Stripe, px, of the picture with the line
    marks : Marks, px, of the picture of the board, from the same place
    outline_mm : tuple of float, optional, mm, frame of the marks, (left, right, bottom, top) of the
        board; where it is not known, points within the hull of the marks are taken

    Raises
    ------
    MeasurementError
        Where the marks span no area.
    """
    usable = np.flatnonzero(has_value(stripe.status))
    places = stripe.image_px[usable]
    inside = region_around(marks.image_px[marks.found]).covers(places)
    if outline_mm is not None and (board := _board_region(marks, outline_mm)) is not None:
        inside |= board.covers(places)
    kept = usable[inside]
    return LinePoints(stripe.image_px[kept], stripe.sigma_px[kept], stripe.axis)


def _board_region(marks: Marks, outline_mm: Outline) -> Region | None:
    """The board in the picture, EDGE_PX within its edge; None where that is not known.

    A homography takes the marks to the picture.  What it misses of them, by the lens's
    distortion, it may miss of the edge as well.
    """
    board_mm, seen = marks.board_mm[marks.found], marks.image_px[marks.found]
    homography = cv2.findHomography(board_mm, seen)[0] if len(seen) >= 4 else None
    if homography is None:
        return None
    left, right, bottom, top = outline_mm
    corners = np.array([[left, bottom], [right, bottom], [right, top], [left, top]])
    if (np.column_stack([corners, np.ones(4)]) @ homography[2] <= 0).any():
        return None  # a corner lies behind the camera
    missed = np.linalg.norm(_under_homography(homography, board_mm) - seen, axis=1).max()
    return region_around(_under_homography(homography, corners), -(EDGE_PX + float(missed)))


def _under_homography(homography: cv2.typing.MatLike, points: Floats) -> Floats:
    """(N, 2) points under a homography."""
    return np.asarray(cv2.perspectiveTransform(points[:, None], homography)[:, 0], dtype=float)


# VIEWS.toml: which pictures of which board, and how they are to be read.


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


HeldBoard = Annotated[Dots | Chessboard | Charuco, Field(discriminator="kind")]


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
    uncertainty, beside the section [optics].  lens: the model of the lens, Brown's, the rational
    one or a fisheye's (Kannala and Brandt's), or "auto": with no port, or a dome, that which
    predicts best the views that it was not fitted to.
    """

    name: str = "unnamed"
    channel: Channel = "grey"
    board: HeldBoard
    optics: OpticsSection = OpticsSection()
    k3: Known = (0.0, 0.0)
    lens: LensChoice = "auto"
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

    def read(name: str) -> Picture:
        nonlocal size
        path = views.path.parent / name
        picture = read_picture(path)
        own = (picture.shape[1], picture.shape[0])
        size = size or own
        if own != size:
            what = "is not of the first picture's size"
            raise InputError(what, where=path, value=own, allowed=f"{size[0]} x {size[1]} px")
        return picture

    for entry in views.document.view:
        found.append(_read(entry, views.document.stripe, read, read_marks, outline_mm))
        if progress is not None:
            progress(len(found), len(views.document.view))
    assert size is not None  # the file holds a view
    return found, size


def _marks_reader(document: ViewsDocument) -> Callable[[Picture], Marks]:
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
    read: Callable[[str], Picture],
    read_marks: Callable[[Picture], Marks],
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
        seen = extract_stripe(lit, stripe, dark)
        line = line_on_board(seen, marks, outline_mm)
    except MeasurementError as error:
        return CalibrationView(entry.picture, marks, None, str(error))
    if len(line.image_px) == 0:
        why = f"no column has one above [stripe] threshold_dn = {stripe.threshold_dn:g}"
        if beside := int(has_value(seen.status).sum()):
            why = f"{beside} columns have one beside it: [board] margin_mm says how far it reaches"
        fault = f"no laser line was found on the board; {why}"
        return CalibrationView(entry.picture, marks, None, fault)
    return CalibrationView(entry.picture, marks, line)


# Pictures of what was seen of each view: its marks, its line, and what became of them.


USED, LEFT_OUT = (0, 230, 0), (255, 40, 40)
LINE_USED = (255, 200, 0)
BAND_PX = 18  # at the top, for the words
ARM_PX = 9  # of a cross


def write_overlays(views: ViewsFile, fitted: Sequence[FittedView], folder: Path) -> list[Path]:
    """Write a picture for each view: what ``draw_view`` draws on the picture with its line.

    Parameters
    ----------
    views : ViewsFile, as loaded
    fitted : sequence of FittedView, of the file's views in their order
    folder : Path, to write to; it is made

    Returns
    -------
    list of Path
        The pictures, ``0-NAME.png`` and so on.

    Raises
    ------
    InputError
        Where a picture cannot be read or written.
    """
    make_folder(folder)
    written = []
    for number, (entry, view) in enumerate(zip(views.document.view, fitted, strict=True)):
        shown = entry.picture if entry.laser in (None, SAME) else entry.laser
        assert shown is not None  # a picture is always named
        drawn = draw_view(read_picture(views.path.parent / shown), view)
        written.append(folder / f"{number}-{Path(entry.picture).stem}.png")
        write_picture(written[-1], drawn)
    return written


def draw_view(image: Picture, view: FittedView) -> Bytes:
    """(H, W, 3) RGB: the picture with the marks and the line that were found in it.

    Marks of a view that was used are green crosses, a line that was used is amber; what was left
    out is red.  The words at the top say why.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, uint8 or uint16, grey or RGB, where the view was found
    view : FittedView, px
    """
    seen = eight_bit(image)
    canvas: Bytes = np.ascontiguousarray(np.dstack([seen] * 3) if seen.ndim == 2 else seen.copy())
    if view.marks is not None:
        colour = USED if view.used else LEFT_OUT
        for u, v in np.rint(view.marks.image_px[view.marks.found]).astype(int).tolist():
            cv2.drawMarker(canvas, (u, v), colour, cv2.MARKER_TILTED_CROSS, ARM_PX)
    if view.line is not None:
        colour = LINE_USED if view.line_used else LEFT_OUT
        u, v = np.rint(view.line.image_px).astype(int).T
        canvas[np.clip(v, 0, canvas.shape[0] - 1), np.clip(u, 0, canvas.shape[1] - 1)] = colour
    canvas[:BAND_PX] //= 4
    words = f"{view.name}: {view.outcome}".encode("ascii", "replace").decode()
    font, white = cv2.FONT_HERSHEY_SIMPLEX, (255, 255, 255)
    cv2.putText(canvas, words, (4, BAND_PX - 5), font, 0.42, white, 1, cv2.LINE_AA)
    return canvas
