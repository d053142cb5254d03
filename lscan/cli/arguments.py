"""What the arguments of the command line name: pictures, runs, calibrations, seeds.

Heavy modules are imported where they are used, so that ``lscan --help`` stays quick.
"""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from lscan.cli.console import note
from lscan.errors import InputError

if TYPE_CHECKING:
    from lscan.acquisition.run import Run
    from lscan.calibration.api import PlaneMap
    from lscan.config.board import Board
    from lscan.config.rig import CalibrationSection, OpticsSection, StripeSection
    from lscan.records import BoardReading, Bytes, Floats

RigOrScene = Annotated[
    Path, typer.Argument(help="Rig file or scene file (TOML), or a scene's name.")
]
PictureOrRun = Annotated[Path, typer.Argument(help="Picture file or run folder.")]
ChannelName = Annotated[str | None, typer.Option("--channel", help="red, green, blue or grey.")]
Overlay = Annotated[
    Path | None,
    typer.Option("--overlay", help="Write the picture with what was found drawn on it."),
]
RunFolder = Annotated[Path, typer.Argument(help="Run folder.")]
CalibrationFile = Annotated[
    Path, typer.Option("--calibration", "-c", help="Calibration file (JSON).")
]
ShaftFile = Annotated[
    Path | None,
    typer.Option("--shaft", help="TOML file with the [shaft] found; a run folder has its own."),
]
Trust = Annotated[
    bool, typer.Option("--trust", help="Run the code that a run folder names as its extractor.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def require_folders(*outputs: Path | None) -> None:
    """Refuse, before any work is done, an output whose folder does not exist."""
    for output in outputs:
        if output is not None and not output.parent.is_dir():
            raise InputError("the folder to write to does not exist", where=output)


def open_calibrated(
    run: Path, calibration: Path, shaft: Path | None = None, trusted: bool = False
) -> tuple[Run, PlaneMap]:
    """A run and the plane map for its pictures; a run that is not complete is said to be so.

    shaft: TOML file whose [shaft] takes the place of the run's own.  trusted: as ``open_run``.
    """
    from lscan.acquisition.run import open_run
    from lscan.calibration.loading import load_plane_map
    from lscan.pipeline import require_size

    opened = open_run(run, trusted)
    if shaft is not None:
        opened = _about(opened, shaft)
    plane_map, size = load_plane_map(calibration)
    rig = opened.rig_file.rig
    require_size(rig.camera, size, calibration, opened.path)
    if len(opened) < rig.plan.frames:
        note(f"{run} holds {len(opened)} of {rig.plan.frames} frames")
    return opened, plane_map


def _about(run: Run, shaft: Path) -> Run:
    """The run with the [shaft] of a file; InputError where it was not made about a shaft."""
    from dataclasses import replace

    from lscan.surface.shaftfile import load_shaft

    rig_file = run.rig_file
    if rig_file.rig.shaft is None:
        raise InputError("was made on a linear track, without [shaft]", where=run.path)
    rig = rig_file.rig.model_copy(update={"shaft": load_shaft(shaft)})
    return replace(run, rig_file=replace(rig_file, rig=rig))


def parse_seeds(text: str | None) -> Floats | None:
    """(3, 2) px of "u1,v1,u2,v2,u3,v3", None for None; InputError where it is neither."""
    if text is None:
        return None
    try:
        numbers = [float(part) for part in text.replace(";", ",").split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 6 or not np.isfinite(numbers).all():
        raise InputError(
            "not three points", where="--seeds", value=text, allowed="u1,v1,u2,v2,u3,v3 in px"
        )
    return np.array(numbers).reshape(3, 2)


@dataclass(frozen=True)
class BoardSource:
    """The picture of a board, the board, how to calibrate with it, and what is known of the lens.

    image: (H, W, 3) or (H, W) uint8.  run: whose mean picture it is, None of a picture file.
    """

    image: Bytes
    board: Board
    calibration: CalibrationSection
    optics: OpticsSection
    run: Run | None = None

    def read(self, seeds: Floats | None, channel: str | None) -> BoardReading:
        """The marks found; seeds: (3, 2) px; channel: in place of what the rig says."""
        from lscan.board import read_board
        from lscan.config.documents import check
        from lscan.config.rig import CalibrationSection
        from lscan.pipeline import board_expected

        section = self.calibration
        if channel is not None:
            section = check(CalibrationSection, {"channel": channel}, where="command line")
        with board_expected(self.run) if self.run else nullcontext():
            return read_board(self.image, self.board, seeds=seeds, channel=section.channel)


def board_picture(
    picture: Path, board: Path | None, optics: Path | None = None, trusted: bool = False
) -> BoardSource:
    """What a picture file or a run folder gives to calibrate from.

    board, optics: files that stand in for what a run's rig file says; a picture file needs
    the first.  trusted: as ``open_run``.
    Raises InputError where one is missing or cannot be used.
    """
    from lscan.acquisition.run import open_run
    from lscan.config.board import load_board
    from lscan.config.rig import CalibrationSection, OpticsSection
    from lscan.files.pictures import read_picture
    from lscan.pipeline import mean_picture, require_board

    if picture.is_dir():
        run = open_run(picture, trusted)
        rig = run.rig_file.rig
        nominal = load_board(board) if board else require_board(run.rig_file)
        known = read_optics(optics) if optics else rig.optics
        return BoardSource(mean_picture(run), nominal, rig.calibration, known, run)
    if not picture.exists():
        raise InputError(
            "no such file or folder", where=picture, allowed="a picture file or a run folder"
        )
    if board is None:
        raise InputError("a picture needs a board file", where="--board", allowed="a TOML file")
    known = read_optics(optics) if optics else OpticsSection()
    return BoardSource(read_picture(picture), load_board(board), CalibrationSection(), known)


def board_of(path: Path) -> Board:
    """The board that a board file describes, or the one in the section [board] of a rig file."""
    from lscan.config.board import Board
    from lscan.config.documents import check, read_document
    from lscan.config.rigfile import inline_board

    document = inline_board(read_document(path), source=str(path))
    if "board" in document:
        return check(Board, document["board"], where=path, prefix="board")
    return check(Board, document, where=path)


def read_optics(path: Path) -> OpticsSection:
    """The section [optics] of a TOML file, which may be a whole rig file; InputError if none."""
    from lscan.config.documents import check, read_document
    from lscan.config.rig import OpticsSection

    document = read_document(path)
    if "optics" not in document:
        raise InputError("has no section [optics]", where=path)
    return check(OpticsSection, document["optics"], where=path, prefix="optics")


def stripe_picture(
    picture: Path, frame: int, trusted: bool
) -> tuple[Bytes, Bytes | None, StripeSection]:
    """The picture of a line, the same with the laser off, and how the line is to be found.

    picture: file, or run folder of which ``frame`` is meant.  The first two are (H, W, 3) or
    (H, W) uint8, the second None where there is none.  trusted: as ``open_run``.
    """
    from lscan.acquisition.run import open_run
    from lscan.config.rig import StripeSection
    from lscan.files.pictures import read_picture

    if not picture.is_dir():
        return read_picture(picture), None, StripeSection()
    run = open_run(picture, trusted)
    if not 0 <= frame < len(run):
        raise InputError(
            "no such frame", where="--frame", value=frame, allowed=f"0 to {len(run) - 1}"
        )
    taken = run.frame(frame)
    return taken.image, taken.background, run.rig_file.rig.stripe
