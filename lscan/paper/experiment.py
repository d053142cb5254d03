"""The paper's whole experiment, from run folders to numbers (Sec. IV).

One function a test piece: board, grooved block, sandwave.  The same functions serve the
tank's runs and those of real hardware.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from lscan.acquisition.run import Run
from lscan.board import read_board
from lscan.calibration.api import PlaneMap
from lscan.calibration.solve import Calibration, calibrate
from lscan.config.board import Board
from lscan.config.targets import GroovedBlock, Sandwave
from lscan.errors import BoardNotFound, InputError
from lscan.measure import compare_slice, diameters, distances, groove_dimensions
from lscan.measure.slices import SliceErrors
from lscan.pipeline import mean_picture, read_profiles, reconstruct, require_board
from lscan.records import BoardReading, Bytes, Length, Profile, Progress, Stripe, Surface
from lscan.stripe import extract_stripe
from lscan.surface import Alignment, Slice, resample
from lscan.surface.shaft import shaft_of
from lscan.surface.shaftfit import ShaftFit, calibrate_shaft

METHODS = (
    "graticule-1",
    "graticule-2",
    "graticule-bspline",
    "graticule-2-norulers",
    "projective",
    "polynomial-3",
    "polynomial-5",
)
PICTURES_KEPT = 3  # consecutive frames shown in the report (Fig. 35)


@dataclass(frozen=True)
class BoardResult:
    """What one board picture gives: calibrations and Tables I and II, by plane map's name.

    image: the mean of the run's pictures, (H, W, 3) or (H, W) uint8.
    """

    image: Bytes
    reading: BoardReading
    calibrations: dict[str, Calibration]
    distances: dict[str, dict[str, Length]]
    diameters: dict[str, dict[str, Length]]


@dataclass(frozen=True)
class GrooveResult:
    """The grooved block: the first picture with its line, all profiles, Table III."""

    image: Bytes
    stripe: Stripe
    profiles: list[Profile]
    dimensions: dict[str, Length]


@dataclass(frozen=True)
class SandwaveResult:
    """The sandwave: three pictures from the middle, the surface raw and aligned, the slices."""

    images: list[Bytes]
    stripe: Stripe
    raw: Surface
    alignment: Alignment
    aligned: Surface
    slices: dict[str, Slice]
    errors: dict[str, SliceErrors]
    step_mm: float


def measure_board(run: Run, methods: Sequence[str] = METHODS) -> BoardResult:
    """Calibrations and verification of the run's board picture, one for each method.

    Raises InputError where the rig has no board, BoardNotFound where the picture has none.
    """
    rig = run.rig_file.rig
    board = require_board(run)
    image = mean_picture(run)
    reading = read_board(image, board, channel=rig.calibration.channel)
    calibrations = {name: calibrate(reading, name, rig.optics) for name in methods}
    maps = {name: calibration.plane_map for name, calibration in calibrations.items()}
    return BoardResult(
        image=image,
        reading=reading,
        calibrations=calibrations,
        distances={name: distances(reading, board, plane) for name, plane in maps.items()},
        diameters={name: diameters(reading, board, plane) for name, plane in maps.items()},
    )


def measure_groove(run: Run, plane_map: PlaneMap) -> GrooveResult:
    """Table III from the run's pictures of the grooved block."""
    piece = run.rig_file.rig.workpiece
    if not isinstance(piece, GroovedBlock):
        raise _wrong_piece(run, "grooved-block")
    if run.rig_file.rig.shaft is not None:
        raise InputError(
            "the grooves are measured in profiles square to them, which a shaft turns askew",
            where=run.path,
            allowed="a scan on a linear track, without [shaft]",
        )
    first = run.frame(0)
    profiles = list(read_profiles(run, plane_map))
    return GrooveResult(
        image=first.image,
        stripe=extract_stripe(first.image, run.rig_file.rig.stripe, first.background),
        profiles=profiles,
        dimensions=groove_dimensions(profiles, piece),
    )


def measure_sandwave(
    run: Run, plane_map: PlaneMap, progress: Progress | None = None
) -> SandwaveResult:
    """Surface, alignment and the slices of Fig. 28 from the run's pictures of the sandwave."""
    rig = run.rig_file.rig
    if not isinstance(rig.workpiece, Sandwave):
        raise _wrong_piece(run, "sandwave")
    first = max(0, (len(run) - PICTURES_KEPT) // 2)
    kept = range(first, min(len(run), first + PICTURES_KEPT))
    frames = [run.frame(index) for index in kept]
    built = reconstruct(run, plane_map, progress)
    alignment = built.require_alignment()
    lines = rig.workpiece.slices_mm().items()
    slices = {name: resample(built.surface, ends) for name, ends in lines}
    return SandwaveResult(
        images=[frame.image for frame in frames],
        stripe=extract_stripe(frames[0].image, rig.stripe, frames[0].background),
        raw=built.raw,
        alignment=alignment,
        aligned=built.surface,
        slices=slices,
        errors={name: compare_slice(cut, rig.workpiece) for name, cut in slices.items()},
        step_mm=rig.plan.step_mm,
    )


def find_shaft(run: Run, plane_map: PlaneMap, progress: Progress | None = None) -> ShaftFit:
    """The rig's shaft as the run's scan of the sandwave shows it.

    Raises InputError where the rig has no [shaft], one that is known exactly, or another
    workpiece; MeasurementError where the scan does not carry it.
    """
    rig = run.rig_file.rig
    if rig.shaft is None:
        raise InputError("the rig file has no section [shaft]", where=run.path)
    if not isinstance(rig.workpiece, Sandwave):
        raise _wrong_piece(run, "sandwave")
    profiles = list(read_profiles(run, plane_map, progress))
    return calibrate_shaft(profiles, rig.workpiece, shaft_of(rig.shaft))


def read_shown_board(run: Run) -> tuple[Board, BoardReading]:
    """The board that the run's pictures show, and its marks.

    A rig file may hold its [board] for calibration while something else is scanned, so only the
    pictures tell.  A scan is judged by its first picture before all are averaged.

    Parameters
    ----------
    run : Run
        Of which nothing but a board can be measured: its rig names no workpiece.

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


def _nothing_to_measure(run: Run, missing: str) -> InputError:
    return InputError(
        f"the run's rig file {missing}; `lscan reconstruct` gives the surface of what is there",
        where=run.path,
        allowed='a picture of the [board], or [workpiece] kind = "grooved-block" or "sandwave"',
    )


def require_size(run: Run, size_px: tuple[int, int], calibration: object) -> None:
    """InputError where the run's pictures are not of the size a calibration was made for."""
    camera = run.rig_file.rig.camera
    if (camera.width_px, camera.height_px) != tuple(size_px):
        raise InputError(
            f"pictures are not of the size of the calibration {calibration}",
            where=run.path,
            value=(camera.width_px, camera.height_px),
            allowed=f"{size_px[0]} x {size_px[1]} px",
        )


def lengths_json(lengths: dict[str, Length]) -> dict[str, dict[str, float]]:
    """The entries of results.json for a set of measured lengths."""
    return {name: length.as_json() for name, length in lengths.items()}


def _wrong_piece(run: Run, wanted: str) -> InputError:
    piece = run.rig_file.rig.workpiece
    return InputError(
        "the run's rig file has another workpiece",
        where=run.path,
        value=piece.kind if piece else None,
        allowed=f'[workpiece] kind = "{wanted}"',
    )
