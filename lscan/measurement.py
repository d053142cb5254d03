"""What a run measures of a known piece: the board, the grooved block or the sandwave (Sec. IV).

The same functions serve runs of the tank and of real hardware.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

from lscan.acquisition.run import Run
from lscan.board import read_board
from lscan.calibration.check import carried
from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import BoardNotFound, InputError, MeasurementError
from lscan.measure import (
    SliceErrors,
    compare_slice,
    diameters,
    distances,
    groove_dimensions,
    unmeasured_distances,
)
from lscan.pipeline import mean_picture, read_profiles, reconstruct
from lscan.records import BoardReading, Length, Progress, Status, Surface
from lscan.surface import Alignment, Slice, resample
from lscan.surface.shaft import ShaftFit, calibrate_shaft, shaft_of


@dataclass(frozen=True)
class BoardMeasures:
    """Lengths of the board by one plane map: Tables I and II.

    Attributes
    ----------
    distances : mapping of Length, mm, by the two dots, such as "A1A2" (Table I)
    diameters : mapping of Length, mm, by ring, such as "E" (Table II)
    unmeasured : mapping of Status, the distances without a value, each with the reason
    """

    distances: Mapping[str, Length]
    diameters: Mapping[str, Length]
    unmeasured: Mapping[str, Status]

    def as_json(self) -> dict[str, Any]:
        """The entries of results.json."""
        return {
            "distances": lengths_json(self.distances),
            "diameters": lengths_json(self.diameters),
            "unmeasured": {name: status.name for name, status in self.unmeasured.items()},
        }

    def __str__(self) -> str:
        """A line for each length."""
        return _lines({**self.distances, **self.diameters})


@dataclass(frozen=True)
class GrooveMeasures:
    """Dimensions of the grooved block.

    Attributes
    ----------
    dimensions : mapping of Length, mm, by their names in Table III
    """

    dimensions: Mapping[str, Length]

    def as_json(self) -> dict[str, Any]:
        """The entry of results.json."""
        return {"groove": lengths_json(self.dimensions)}

    def __str__(self) -> str:
        """A line for each dimension."""
        return _lines(self.dimensions)


@dataclass(frozen=True)
class SandwaveMeasures:
    """The sandwave's surface as scanned and aligned, and its slices by name (Fig. 28).

    Attributes
    ----------
    raw : Surface, frame of the head, as scanned
    alignment : Alignment, from the head's frame to the workpiece's
    aligned : Surface, frame of the workpiece, corrected as ``reconstruct`` does
    slices : mapping of Slice, frame of the workpiece, by name
    errors : mapping of SliceErrors, measured minus designed height of each slice, mm
    step_mm : float, mm, from one picture to the next along the track
    """

    raw: Surface
    alignment: Alignment
    aligned: Surface
    slices: Mapping[str, Slice]
    errors: Mapping[str, SliceErrors]
    step_mm: float

    def as_json(self) -> dict[str, Any]:
        """The entry of results.json."""
        return {
            "sandwave": {
                "frames": len(self.raw.position_mm),
                "step_mm": self.step_mm,
                "yaw_deg": {"estimated": self.alignment.yaw_deg},
                "slices": {name: errors.as_json() for name, errors in self.errors.items()},
            }
        }


Piece = TypeVar("Piece", GroovedBlock, Sandwave)
Measures = BoardMeasures | GrooveMeasures | SandwaveMeasures


def measure_run(run: Run, plane_map: PlaneMap, progress: Progress | None = None) -> Measures:
    """What the run can be measured for, by what its rig says stands in the tank.

    Parameters
    ----------
    run : Run, of the rig's ``[workpiece]``, or of its ``[board]`` where it names none
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet
    progress : callable, optional, called with the number of pictures that are read and of all

    Returns
    -------
    BoardMeasures, GrooveMeasures or SandwaveMeasures

    Raises
    ------
    InputError
        Where the run shows nothing that can be measured.
    MeasurementError
        Where the piece is not what was scanned, or too little of it is seen.

    Examples
    --------
    >>> import lscan
    >>> plane_map = lscan.load_calibration("calibration.json").plane_map
    >>> measures = lscan.measure_run(lscan.open_run("runs/groove"), plane_map)
    >>> type(measures).__name__
    'GrooveMeasures'
    """
    piece = run.rig_file.rig.workpiece
    if piece is None:
        board, reading = read_shown_board(run)
        return measure_reading(reading, board, carried(plane_map, run.rig_file.rig))
    try:
        if isinstance(piece, GroovedBlock):
            return measure_groove(run, plane_map)
        return measure_sandwave(run, plane_map, progress)
    except MeasurementError as error:
        error.add_note(
            f"[workpiece] of the run's rig file is a {piece.kind}; where something else was "
            "scanned, `lscan reconstruct` gives its surface"
        )
        raise


def measure_reading(reading: BoardReading, board: Board, plane_map: PlaneMap) -> BoardMeasures:
    """The board's lengths (Tables I and II).

    Parameters
    ----------
    reading : BoardReading, px, the marks found
    board : Board, mm, their nominal places and the distances wanted
    plane_map : PlaneMap, of the camera that took the picture

    Raises
    ------
    MeasurementError
        Where not one distance can be measured, or a ring has fewer than four points in the sheet.
    """
    return BoardMeasures(
        distances(reading, board, plane_map),
        diameters(reading, board, plane_map),
        unmeasured_distances(reading, board, plane_map),
    )


def measure_groove(run: Run, plane_map: PlaneMap) -> GrooveMeasures:
    """The dimensions of the grooved block (Table III).

    Parameters
    ----------
    run : Run, of a rig whose ``[workpiece]`` is a grooved block
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet

    Raises
    ------
    InputError
        Where the rig names another piece, or the scan was made about a shaft.
    MeasurementError
        Where a part of the block is not seen.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> result = lscan.measure_groove(lscan.open_run("runs/groove"), calibration.plane_map)
    >>> abs(result.dimensions["W1"].error_mm) < 0.7
    True
    """
    piece = require_piece(run, GroovedBlock)
    if run.rig_file.rig.shaft is not None:
        raise InputError(
            "the grooves are measured in profiles normal to them, and those of a shaft are oblique",
            where=run.path,
            allowed="a scan on a linear track, without [shaft]",
        )
    return GrooveMeasures(groove_dimensions(list(read_profiles(run, plane_map)), piece))


def measure_sandwave(
    run: Run, plane_map: PlaneMap, progress: Progress | None = None
) -> SandwaveMeasures:
    """The sandwave's surface, its alignment and its slices (Figs. 28 to 32).

    Parameters
    ----------
    run : Run, of a rig whose ``[workpiece]`` is a sandwave
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet
    progress : callable, optional, called with the number of pictures that are read and of all

    Raises
    ------
    InputError
        Where the rig names another piece.
    MeasurementError
        Where the block is not found in the surface.

    Examples
    --------
    Of a run of ``paper/sandwave``, 400 pictures:

    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> run = lscan.open_run("runs/sandwave")  # doctest: +SKIP
    >>> lscan.measure_sandwave(run, calibration.plane_map).errors["S1"]  # doctest: +SKIP
    """
    piece = require_piece(run, Sandwave)
    built = reconstruct(run, plane_map, progress)
    alignment = built.require_alignment()
    slices = {name: resample(built.surface, ends) for name, ends in piece.slices_mm().items()}
    return SandwaveMeasures(
        raw=built.raw,
        alignment=alignment,
        aligned=built.surface,
        slices=slices,
        errors={name: compare_slice(cut, piece) for name, cut in slices.items()},
        step_mm=run.rig_file.rig.plan.step_mm,
    )


def _lines(lengths: Mapping[str, Length]) -> str:
    return "\n".join(f"{name}: {length}" for name, length in lengths.items())


def find_shaft(run: Run, plane_map: PlaneMap, progress: Progress | None = None) -> ShaftFit:
    """The rig's shaft as the run's scan of the sandwave shows it.

    Parameters
    ----------
    run : Run, of a rig with a ``[shaft]`` and a sandwave for its ``[workpiece]``
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet
    progress : callable, optional, called with the number of pictures that are read and of all

    Raises
    ------
    InputError
        Where the rig has no ``[shaft]``, one that is known exactly, or another workpiece.
    MeasurementError
        Where the block is not found, or too little of it is in the scan.
    """
    shaft = run.rig_file.rig.shaft
    if shaft is None:
        raise InputError("the rig file has no section [shaft]", where=run.path)
    piece = require_piece(run, Sandwave)
    profiles = list(read_profiles(run, plane_map, progress))
    return calibrate_shaft(profiles, piece, shaft_of(shaft))


def read_shown_board(run: Run) -> tuple[Board, BoardReading]:
    """The board that the run's pictures show, and its marks.

    A rig file may hold its [board] for calibration while something else is scanned, so only the
    pictures tell.  A scan is judged by its first picture before all are averaged.

    Parameters
    ----------
    run : Run, of which nothing but a board can be measured: its rig names no workpiece

    Returns
    -------
    tuple of Board and BoardReading
        The board of the rig file, and what was found of it in the mean picture, px.

    Raises
    ------
    InputError
        Where the rig has no board or the pictures show none; it says what can be measured.
    """
    rig = run.rig_file.rig
    board, channel = rig.board, rig.calibration.channel
    if board is None:
        raise _nothing_to_measure(run, "names neither [board] nor [workpiece]")
    lit = rig.plan.laser != "untouched"
    scanned = len(run) > 0 and (lit or len(set(run.positions_mm)) > 1)
    try:
        if scanned:
            read_board(run.frame(0).image, board, channel=channel)
        return board, read_board(mean_picture(run), board, channel=channel)
    except BoardNotFound as error:
        missing = "names a [board] and no [workpiece], and the pictures show no board"
        hint = "" if scanned else f" ({error})"  # a picture of one place may be a poor one of it
        raise _nothing_to_measure(run, missing + hint) from error


def lengths_json(lengths: Mapping[str, Length]) -> dict[str, dict[str, float]]:
    """The entries of results.json for a set of measured lengths.

    Parameters
    ----------
    lengths : mapping of Length, mm, by feature
    """
    return {name: length.as_json() for name, length in lengths.items()}


def _nothing_to_measure(run: Run, missing: str) -> InputError:
    return InputError(
        f"the run's rig file {missing}; `lscan reconstruct` gives the surface of what is there",
        where=run.path,
        allowed='a picture of the [board], or [workpiece] kind = "grooved-block" or "sandwave"',
    )


def require_piece(run: Run, wanted: type[Piece]) -> Piece:
    """The workpiece that the run's rig names.

    Parameters
    ----------
    run : Run, of any piece
    wanted : type, of the piece: GroovedBlock or Sandwave

    Raises
    ------
    InputError
        Where the rig names none, or one of another kind.
    """
    piece = run.rig_file.rig.workpiece
    if isinstance(piece, wanted):
        return piece
    raise InputError(
        "the run's rig file has another workpiece",
        where=run.path,
        value=piece.kind if piece else None,
        allowed=f'[workpiece] kind = "{wanted.model_fields["kind"].default}"',
    )
