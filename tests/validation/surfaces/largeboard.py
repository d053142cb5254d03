"""The calibration from a picture of a large board, timed in a process without the renderer."""

from pathlib import Path
from time import process_time

from lscan.board import read_board
from lscan.calibration.calibrate import calibrate
from lscan.calibration.calibrationfile import save_calibration
from lscan.config.board import Board, Grid
from lscan.config.rig import OpticsSection
from lscan.files.pictures import read_picture

LARGE = Board(grid=Grid(columns=60, rows=50, pitch_mm=10.0, dot_diameter_mm=5.0))
SMALL = Board(grid=Grid(columns=15, rows=12, pitch_mm=10.0, dot_diameter_mm=5.0))


def calibrate_large(file: str, plane_map: str, plain: bool) -> None:
    """Calibrate from a picture of LARGE, and print how many seconds of processor time it took.

    plain: the picture is of SMALL, as a quick run has it.
    """
    start = process_time()
    board = SMALL if plain else LARGE
    reading = read_board(read_picture(Path(file)), board)
    saved = calibrate(reading, plane_map, OpticsSection(port="none"))
    save_calibration(Path(file).with_suffix(".json"), saved)
    print(process_time() - start)
