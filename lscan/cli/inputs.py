"""What the arguments of the command line name, opened: runs, boards, calibrations, seeds."""

import os
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from lscan.acquisition.run import Run, open_run
from lscan.board import read_board
from lscan.board.marks import FEWEST
from lscan.calibration.calibrationfile import load_plane_map
from lscan.calibration.check import CorrectionKind, kept_for_want_of_water, map_for_rig
from lscan.calibration.planemap import PlaneMap
from lscan.cli.console import note, one_of, require_folders
from lscan.config.board import load_board
from lscan.config.documents import check, read_document
from lscan.config.rig import CalibrationSection, OpticsSection, Rig
from lscan.errors import InputError
from lscan.files.pictures import display_turn, eight_bit, grey_dn, read_picture, step_of
from lscan.pipeline import board_expected, mean_picture, require_board, require_size
from lscan.records import BoardReading, Floats, Mask, Picture, Status
from lscan.surface.shaft import load_shaft


def require_mcap(option: str, path: Path) -> None:
    """Refuse a recording of another kind, or in a folder that is not there."""
    if path.suffix.lower() != ".mcap":
        raise InputError("no such kind of file", where=option, value=str(path), allowed=".mcap")
    require_folders(path)


def open_calibrated(
    run: Path, calibration: Path | None, shaft: Path | None = None, trusted: bool = False
) -> tuple[Run, PlaneMap]:
    """A run and the plane map for its pictures; a run that is not complete is said to be so.

    shaft: TOML file whose [shaft] takes the place of the run's own.  trusted: as ``open_run``.
    """
    if calibration is None:
        gone = "" if os.path.exists(run) else f", and {run} does not exist"  # noqa: PTH110 - any text
        allowed = "a file, with a run folder"
        raise InputError(f"is missing{gone}", where="--calibration", allowed=allowed)
    opened = open_run(run, trusted)
    rig = opened.rig_file.rig
    if shaft is not None:
        if rig.shaft is None:
            raise InputError("was made on a linear track, without [shaft]", where=opened.path)
        rig = rig.model_copy(update={"shaft": load_shaft(shaft)})
        opened = replace(opened, rig_file=replace(opened.rig_file, rig=rig))
    plane_map, size = load_plane_map(calibration)
    require_size(rig.camera, size, calibration, opened.path)
    note_water(plane_map, rig.optics)
    if len(opened) < rig.plan.frames:
        note(f"{run} holds {len(opened)} of {rig.plan.frames} frames")
    if rig.curve_is_unknown:
        note(
            "[stripe] gamma is not stated: if this webcam has a tone curve (about 2.2), lines end "
            "up to two pixels late at edges, which widths of grooves allow for and edges of "
            "surfaces do not; lscan devices RIG --test finds it, 1: it has none"
        )
    return opened, plane_map


def note_water(plane_map: PlaneMap, optics: OpticsSection) -> None:
    """Say of a map that it is not carried to the water stated, and why."""
    if kept := kept_for_want_of_water(plane_map, optics):
        note(kept)


def parse_numbers(text: str, count: int) -> list[float] | None:
    """The finite numbers of "1,2,3"; None where they are not that many."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return None
    return numbers if len(numbers) == count and np.isfinite(numbers).all() else None


def parse_seeds(text: str | None) -> Floats | None:
    """(3, 2) px of "u1,v1,u2,v2,u3,v3", None for None; InputError where it is neither."""
    if text is None:
        return None
    if (numbers := parse_numbers(text.replace(";", ","), 6)) is None:
        allowed = "u1,v1,u2,v2,u3,v3 in px"
        raise InputError("not three points", where="--seeds", value=text, allowed=allowed)
    return np.array(numbers).reshape(3, 2)


def parse_corrections(words: Sequence[str] | None) -> tuple[CorrectionKind, ...]:
    """The kinds of correction, in the order in which they are made; InputError for another."""
    allowed = get_args(CorrectionKind)
    kinds = [one_of(word, allowed, "--correct", "no such correction") for word in words or ()]
    return tuple(kind for kind in allowed if kind in kinds)


def read_board_picture(
    picture: Path,
    board: Path | None,
    optics: Path | None,
    seeds: str | None,
    channel: str | None,
    trusted: bool,
) -> tuple[BoardReading, Picture, CalibrationSection, OpticsSection]:
    """The marks of a board, the picture that shows them, how to calibrate by it, and its optics.

    picture: a file, or a run folder, whose mean picture is taken.
    board, optics: files that stand in for what a run's rig file says; a picture file needs
    the first.  seeds: as of ``parse_seeds``.  channel: in place of what the rig says.
    trusted: as ``open_run``.
    A note names the dots that are not where the board file has them, and the rings of which
    less than half of the smallest's points are.
    Raises InputError where a file is missing or cannot be used.
    """
    section, known, run = CalibrationSection(), OpticsSection(), None
    if os.path.isdir(picture):  # noqa: PTH112 - takes any text
        run = open_run(picture, trusted)
        rig = run.rig_file.rig
        section, known = rig.calibration, rig.optics
        nominal = load_board(board) if board else require_board(run.rig_file)
    elif not os.path.exists(picture):  # noqa: PTH110 - takes any text
        allowed = "a picture file or a run folder"
        raise InputError("no such file or folder", where=picture, allowed=allowed)
    elif board is None:
        raise InputError("a picture needs a board file", where="--board", allowed="a TOML file")
    else:
        nominal = load_board(board)
    if optics is not None:
        document = read_document(optics)  # it may be a whole rig file
        if "optics" not in document:
            raise InputError("has no section [optics]", where=optics)
        known = check(OpticsSection, document["optics"], where=optics, prefix="optics")
    image = read_as_stored(picture) if run is None else mean_picture(run)
    colour = section.channel
    if channel is not None:
        colour = check(CalibrationSection, {"channel": channel}, where=None, prefix="--").channel
    places = parse_seeds(seeds)
    with nullcontext() if run is None else board_expected(run):
        reading = read_board(image, nominal, seeds=places, channel=colour)
    lost = [name for name, dot in reading.dots.items() if dot.status == Status.NOT_FOUND]
    lost += [name for name, ring in reading.rings.items() if len(ring.sigma_px) < FEWEST / 2]
    if lost:
        where = "check that they are in view and clean, and their places in the board file"
        note(f"not found where the board file has them: {', '.join(lost)}; {where}")
    return reading, image, section, known


def read_as_stored(path: Path) -> Picture:
    """``read_picture``; a note says what is not in the file: that it is not turned, its bits."""
    picture = read_picture(path)
    if picture.dtype != np.uint8:
        grey = grey_dn(picture)
        note(
            f"{path}: of 16 bit, taken for a camera's of {8 - round(np.log2(step_of(grey)))}, its "
            f"brightest pixel at {grey.max():.1f} of 256 DN; state bits under [camera] of a rig"
        )
    if turn := display_turn(path):
        note(
            f"{path}: viewers show it {turn} (EXIF orientation); it is taken as stored, and so are "
            "seeds, parts and overlays"
        )
    return picture


def plane_maps(
    files: list[Path], most: int, image: Picture, where: Path, rig: Rig | None = None
) -> list[PlaneMap]:
    """The plane maps of no calibration file, or of as many as there are lines.

    most: how many lines are looked for.  image: (H, W, ...), whose size the maps must be for.
    where: the picture or run, for messages.  rig: of a run, to whose water the maps are carried.
    Raises InputError where one does not fit.
    """
    if len(files) not in (0, most):
        allowed = "none or one" if most == 1 else "none or two: of the upper line, of the lower"
        raise InputError("too many or too few files", where="-c", value=len(files), allowed=allowed)
    maps = []
    for file in files:
        plane_map, size = load_plane_map(file)
        if size != (shown := (image.shape[1], image.shape[0])):
            what = "is of another size than the calibration's pictures"
            allowed = f"{size[0]} x {size[1]} px, as in {file}"
            raise InputError(what, where=where, value=shown, allowed=allowed)
        if rig is not None:
            note_water(plane_map, rig.optics)
            plane_map = map_for_rig(plane_map, rig)
        maps.append(plane_map)
    return maps


def picture_part(roi: str | None, mask: Path | None, image: Picture) -> Mask | None:
    """(H, W) mask of the part of a picture that the options name; None of the whole.

    roi: "u0,v0,u1,v1", two opposite corners in px, both of them in the part.  mask: a picture of
    the same size, of which pixels of half the range or more are in the part.
    Raises InputError where either is none, or no pixel is left.
    """
    if roi is None and mask is None:
        return None
    height, width = image.shape[:2]
    keep = np.ones((height, width), dtype=bool)
    if roi is not None:
        try:
            u0, v0, u1, v1 = (int(part) for part in roi.split(","))
        except ValueError:
            u0 = v0 = u1 = v1 = -1
        if not (0 <= u0 < u1 < width and 0 <= v0 < v1 < height):
            allowed = f"u0,v0,u1,v1 in px, u0 < u1 < {width} and v0 < v1 < {height}"
            raise InputError("no part of the picture", where="--roi", value=roi, allowed=allowed)
        keep[:] = False
        keep[v0 : v1 + 1, u0 : u1 + 1] = True
    if mask is not None:
        picture = read_picture(mask)
        if picture.shape[:2] != (height, width):
            size = (picture.shape[1], picture.shape[0])
            allowed = f"{width} x {height} px, as the picture"
            raise InputError("is of another size", where=mask, value=size, allowed=allowed)
        keep &= eight_bit(picture if picture.ndim == 2 else picture.max(axis=2)) > 127
    if not keep.any():
        raise InputError("leaves nothing of the picture", where="--mask", value=str(mask))
    return keep
