"""The one chain: from a run's pictures to its calibration, its surface and its measures."""

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from lscan.acquisition.run import Run
from lscan.acquisition.scan import cores, in_order
from lscan.board import read_board
from lscan.board.loops import compile_marks
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.calibration.check import map_for_rig
from lscan.calibration.maps.spline import compile_splines
from lscan.calibration.planemap import PlaneMap
from lscan.config.board import Board
from lscan.config.rig import CameraSection, Rig, RigFile
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
from lscan.records import (
    BoardReading,
    Floats,
    Length,
    Picture,
    Profile,
    Progress,
    Status,
    Surface,
    html_table,
    plus_minus,
)
from lscan.stripe.extract import compile_lines, extract_stripe
from lscan.surface import Alignment, Slice, align_sandwave, apply, resample, stack
from lscan.surface.alignment import KeptAlignment
from lscan.surface.shaft import ShaftFit, calibrate_shaft, shaft_of, stack_about
from lscan.surface.sheetresponse import compile_reliefs
from lscan.surface.surface import provenance_of, to_profiles
from lscan.surface.thickness import correct_thickness

# The one chain from a run's pictures to its calibration and its surface.

READ_AT_ONCE = 16
"""Pictures whose lines are found, and whose points are mapped, in one call.  A call for one takes
longer for each, to begin NumPy's steps; more at once gain little."""


@dataclass(frozen=True)
class Reconstruction:
    """A run's surface, before and after all that is known of the rig has been corrected for.

    Attributes
    ----------
    raw : Surface, frame of the head, as the profiles give it
    surface : Surface, corrected; frame of the workpiece where it is aligned, else the head's
    alignment : Alignment or None, of the sandwave, or the one that was kept; None where no
        sandwave is named or it was not found
    unaligned : MeasurementError or None, why a sandwave that the rig names was not found
    """

    raw: Surface
    surface: Surface
    alignment: Alignment | None = None
    unaligned: MeasurementError | None = None

    def require_alignment(self) -> Alignment:
        """The alignment of the sandwave.

        Raises
        ------
        MeasurementError
            Where the rig names no sandwave, or it was not found in the surface.
        """
        if self.alignment is None:
            raise self.unaligned or MeasurementError("the rig names no sandwave to align with")
        return self.alignment


def calibrate_run(run: Run, plane_map: str | None = None) -> Calibration:
    """The plane map solved from the board that the run's pictures show.

    Parameters
    ----------
    run : Run, of a rig that names its ``[board]``; its pictures are averaged
    plane_map : str, optional, full name of the map, or "auto"; by default what the rig's
        ``[calibration]`` names

    Raises
    ------
    InputError
        Where the rig has no board, or there is no map of that name.
    BoardNotFound
        Where the pictures do not show the board, or too few of its marks.

    Examples
    --------
    >>> import lscan
    >>> lscan.calibrate_run(lscan.open_run("runs/board"), "graticule-2").rms_mm < 0.2
    True
    """
    rig = run.rig_file.rig
    with board_expected(run):
        board = require_board(run.rig_file)
        reading = read_board(mean_picture(run), board, channel=rig.calibration.channel)
    return calibrate(reading, plane_map or rig.calibration.plane_map, rig.optics)


def reconstruct(
    run: Run,
    plane_map: PlaneMap,
    progress: Progress | None = None,
    kept: KeptAlignment | None = None,
) -> Reconstruction:
    """The surface of all the run's pictures, aligned where the rig names a sandwave.

    Parameters
    ----------
    run : Run, the pictures, and the rig they were taken with
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet
    progress : callable, optional, called with the number of pictures done, and of all
    kept : KeptAlignment, optional, of another scan, used in place of one found in this

    Returns
    -------
    Reconstruction
        Of F profiles of N columns, mm.  Without an alignment the sheet's yaw is not known, and
        its thickness is corrected for as ``correct`` does by default.

    Raises
    ------
    InputError
        Where the run holds no picture, or one that cannot be read; where ``kept`` is given for a
        scan about a shaft.

    Examples
    --------
    >>> import lscan
    >>> calibration = lscan.load_calibration("calibration.json")
    >>> built = lscan.reconstruct(lscan.open_run("runs/groove"), calibration.plane_map)
    >>> built.surface.xyz_mm.shape
    (2, 640, 3)
    """
    rig = run.rig_file.rig
    raw = build_surface(list(read_profiles(run, plane_map, progress)), rig)
    raw = replace(raw, provenance=provenance_of(rig, len(run), plane_map))
    if rig.stripe.blur_px is not None:
        raw = replace(raw, corrections=(f"blur of {rig.stripe.blur_px:g} px",))
    return finish(raw, rig, kept)


def finish(raw: Surface, rig: Rig, kept: KeptAlignment | None = None) -> Reconstruction:
    """The raw surface of a run of the rig, aligned and corrected as ``reconstruct`` does.

    Parameters
    ----------
    raw : Surface, frame of the head
    rig : Rig, of the run: its ``[workpiece]``, ``[sheet]`` and ``[shaft]`` count
    kept : KeptAlignment, optional, of another scan, used in place of one found in this

    Returns
    -------
    Reconstruction
        A sandwave that is not found leaves its MeasurementError in ``unaligned``; none is raised.

    Raises
    ------
    InputError
        Where ``kept`` is given for a scan about a shaft.
    """
    if kept is not None:
        if rig.shaft is not None:
            what = "a kept alignment is that of a linear track"
            raise InputError(what, where=kept.source, allowed="a scan without [shaft]")
        alignment = kept.of(raw)
        done = f"yaw and level by {kept.source}"
        surface = place(raw, alignment, rig)
        surface = replace(surface, corrections=(*surface.corrections, done))
        return Reconstruction(raw, surface, alignment)
    if not isinstance(rig.workpiece, Sandwave):
        return Reconstruction(raw, correct(raw, rig))
    try:
        alignment = align_sandwave(raw, rig.workpiece, sheared=rig.shaft is None)
    except MeasurementError as error:
        return Reconstruction(raw, correct(raw, rig), unaligned=error)
    return Reconstruction(raw, place(raw, alignment, rig), alignment)


def place(raw: Surface, alignment: Alignment, rig: Rig) -> Surface:
    """The raw surface corrected with the alignment's yaw, and taken to the workpiece frame.

    The alignment stays as it is: on the wedges' flat tops there is nothing to correct.

    Parameters
    ----------
    raw : Surface, frame of the head
    alignment : Alignment, found in ``raw`` or kept
    rig : Rig, whose ``[sheet]`` says what is corrected for

    Raises
    ------
    InputError
        Where ``raw`` is not in the head frame.
    """
    return apply(alignment, correct(raw, rig, alignment.yaw_rad))


def correct(raw: Surface, rig: Rig, yaw_rad: float = 0.0) -> Surface:
    """The raw surface corrected for the sheet's thickness; itself where the rig has no [sheet].

    Parameters
    ----------
    raw : Surface, frame of the head
    rig : Rig, whose ``[sheet]`` says how thick the sheet is and how it is seen
    yaw_rad : float, rad, angle of the sheet against the track.  0, a sheet square to the track, is
        what the head frame itself takes it for.  A yaw of 2.2 degrees that is not known so leaves a
        quarter of the displacement on the sandwave (rms), far less than no correction does.

    Returns
    -------
    Surface
        In the head frame.

    Raises
    ------
    InputError
        Where ``raw`` is not in the head frame.
    """
    return raw if rig.sheet is None else correct_thickness(raw, rig.sheet, yaw_rad)


def build_surface(profiles: Sequence[Profile], rig: Rig) -> Surface:
    """The raw surface of the rig's profiles, in the head frame: turned where it has a [shaft].

    Parameters
    ----------
    profiles : sequence of Profile, frame of the sheet, mm; F of N points each
    rig : Rig, they were taken with

    Returns
    -------
    Surface
        Of F by N points.

    Raises
    ------
    InputError
        Where there is no profile, or the profiles differ in length or in their number of modes.
    """
    return stack(profiles) if rig.shaft is None else stack_about(profiles, shaft_of(rig.shaft))


def read_profiles(
    run: Run, plane_map: PlaneMap, progress: Progress | None = None
) -> Iterator[Profile]:
    """One profile a picture, in the run's order; several pictures are worked on at once.

    Parameters
    ----------
    run : Run, its rig's ``[stripe]`` says how the line is found
    plane_map : PlaneMap, of the rig's camera, from its pixels to the laser sheet
    progress : callable, optional, called with the number of pictures done, and of all

    Yields
    ------
    Profile
        In the frame of the sheet, mm.

    Raises
    ------
    InputError
        Where a picture cannot be read, or there is no extractor of that name.
    """
    rig = run.rig_file.rig
    plane_map = map_for_rig(plane_map, rig)

    def profiles_of(part: range) -> list[Profile]:
        frames = (run.frame(index) for index in part)
        stripes = [extract_stripe(frame.image, rig.stripe, frame.background) for frame in frames]
        return to_profiles(stripes, plane_map, [run.rows[index].position_mm for index in part])

    size = min(READ_AT_ONCE, -(-len(run) // cores()) or 1)
    parts = [range(len(run))[first : first + size] for first in range(0, len(run), size)]
    profiles = chain.from_iterable(in_order(profiles_of, parts))
    for done, profile in enumerate(profiles, start=1):
        yield profile
        if progress:
            progress(done, len(run))


def mean_picture(run: Run) -> Picture:
    """The mean of the run's pictures, with the laser on, rounded, same shape as each.

    Parameters
    ----------
    run : Run, of one picture or more

    Returns
    -------
    array
        (H, W) grey or (H, W, 3) RGB, uint8 or uint16.

    Raises
    ------
    InputError
        Where the run holds no picture, or one that cannot be read.

    Examples
    --------
    >>> import lscan
    >>> lscan.mean_picture(lscan.open_run("runs/board")).shape
    (480, 640, 3)
    """
    if len(run) == 0:
        raise InputError("holds no picture yet", where=run.path)
    total: Floats | float = 0.0
    for frame in in_order(run.frame, range(len(run))):
        total = total + frame.image.astype(float)
    return np.rint(total / len(run)).astype(frame.image.dtype)


def require_board(rig_file: RigFile) -> Board:
    """The board of a rig.

    Parameters
    ----------
    rig_file : RigFile, of a rig that names its ``[board]``

    Raises
    ------
    InputError
        Where the rig file has no section ``[board]``.
    """
    if rig_file.rig.board is None:
        raise InputError("has no section [board]", where=rig_file.source)
    return rig_file.rig.board


@contextmanager
def board_expected(run: Run) -> Iterator[None]:
    """Say of a run of something else that it is none of the board, where none is found.

    Advice on how to light a board would mislead there.

    Parameters
    ----------
    run : Run, in whose pictures the board is looked for within this context

    Raises
    ------
    BoardNotFound
        In place of the one raised within: it names what was scanned.
    """
    try:
        yield
    except BoardNotFound as error:
        rig = run.rig_file.rig
        shown = "a scan from several places" if len(set(run.positions_mm)) > 1 else None
        if rig.workpiece is not None:
            shown = f"a scan of the [workpiece] {rig.workpiece.kind!r}"
        if shown is None:
            raise
        raise BoardNotFound(
            f"{run.path}: shows no board: by its rig file it is {shown}; calibrate from a run or "
            f"a picture of the board, such as a scan of paper/board ({error})"
        ) from error


def require_size(
    camera: CameraSection, size_px: tuple[int, int], calibration: object, where: Path
) -> None:
    """Refuse a camera whose pictures are not of the size that a calibration was made for.

    Parameters
    ----------
    camera : CameraSection, of the rig
    size_px : tuple of int, (width, height) of the calibration's pictures, px
    calibration : object, how the message names the calibration
    where : Path, of the run or of the rig file of the camera

    Raises
    ------
    InputError
        Where the sizes differ.
    """
    if (camera.width_px, camera.height_px) != tuple(size_px):
        raise InputError(
            f"pictures are not of the size of the calibration {calibration}",
            where=where,
            value=(camera.width_px, camera.height_px),
            allowed=f"{size_px[0]} x {size_px[1]} px",
        )


# What a run measures of a known piece: the board, the grooved block or the sandwave (Sec. IV).
#
# The same functions serve runs of the tank and of real hardware.


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

    def _repr_html_(self) -> str:
        return _lengths_html({**self.distances, **self.diameters})


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

    def _repr_html_(self) -> str:
        return _lengths_html(self.dimensions)


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

    def __str__(self) -> str:
        """A line for each slice."""
        return "\n".join(f"{name}: {errors}" for name, errors in self.errors.items())

    def _repr_html_(self) -> str:
        return html_table(self.errors.items())


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
    if (piece := run.rig_file.rig.workpiece) is None:
        board, reading = read_shown_board(run)
        return measure_reading(reading, board, map_for_rig(plane_map, run.rig_file.rig))
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
    profiles, unknown = list(read_profiles(run, plane_map)), run.rig_file.rig.curve_is_unknown
    return GrooveMeasures(groove_dimensions(profiles, piece, unknown))


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


def _lengths_html(lengths: Mapping[str, Length]) -> str:
    rows = [
        (name, plus_minus(one.measured_mm, one.sigma_mm), f"{one.nominal_mm:g}",
         plus_minus(one.error_mm, one.sigma_mm))
        for name, one in lengths.items()
    ]  # fmt: skip
    return html_table(rows, ["", "measured, mm", "nominal, mm", "error, mm"])


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
    if (shaft := run.rig_file.rig.shaft) is None:
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
    what = f"the run's rig file {missing}; `lscan reconstruct` gives the surface of what is there"
    allowed = 'a picture of the [board], or [workpiece] kind = "grooved-block" or "sandwave"'
    return InputError(what, where=run.path, allowed=allowed)


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
    what = "the run's rig file has another workpiece"
    allowed = f'[workpiece] kind = "{wanted.model_fields["kind"].default}"'
    raise InputError(what, where=run.path, value=piece.kind if piece else None, allowed=allowed)


def compile_loops() -> None:
    """Compile all loops of the instrument, for the processes that follow: on two cores."""
    with ProcessPoolExecutor(2, initializer=logging.disable) as pool:
        lines = pool.submit(compile_lines)
        others = [pool.submit(each) for each in (compile_marks, compile_splines, compile_reliefs)]
        for part in (lines, *others):
            part.result()
