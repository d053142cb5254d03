"""Calibration boards seen through a flat port from the paper's place: exact marks, then noise."""

from collections.abc import Mapping

import numpy as np

from lscan.camera import CameraModel, PortModel, project
from lscan.config.board import Board, Grid, Ruler
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Floats, Marks, RulerReading, Status

IMAGE_SIZE = (640, 480)
CAMERA_MM = np.array([225.0, -866.0254, 300.0])  # as in scenes/paper/rig.toml: 1 m, 30 degrees down
DEPRESSION = np.radians(30.0)


CAMERA = CameraModel(
    focal_px=850.0,
    centre_px=(319.5, 239.5),
    k1=-0.26,
    k2=0.06,
    port=PortModel(gap_mm=10.0, thickness_mm=6.0, glass_index=1.488, water_index=1.33131),
)
OPTICS = OpticsSection(
    focal_px=(830.0, 80.0),
    gap_mm=(11.0, 3.0),
    thickness_mm=(6.0, 0.3),
    glass_index=(1.49, 0.005),
    water_index=(1.3317, 0.0005),
)
"""What the owner of such a rig knows of it: the port by ruler and data sheet."""


def image_px(xz_mm: Floats) -> Floats:
    """(N, 2) px where the camera at ``CAMERA_MM`` sees places of the sheet.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm, (x, z) in the sheet y = 0
    """
    head = np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]]) - CAMERA_MM
    cosine, sine = np.cos(DEPRESSION), np.sin(DEPRESSION)
    right = np.array([1.0, 0.0, 0.0])
    ahead, down = np.array([0.0, cosine, -sine]), np.array([0.0, -sine, -cosine])
    return project(CAMERA, head @ np.column_stack([right, down, ahead]))


def _ruled(grid: Grid) -> Board:
    """The grid with the paper's kind of rulers: marks every 10 mm half-way between dots."""
    width, height = (grid.columns - 1) * grid.pitch_mm, (grid.rows - 1) * grid.pitch_mm
    middle = grid.pitch_mm / 2
    down = [k * grid.pitch_mm + middle for k in (1, grid.columns // 2 - 1, grid.columns - 3)]
    across = [-k * grid.pitch_mm - middle for k in (2, grid.rows - 4)]
    rulers = [Ruler(direction="vertical", at_mm=x, first_mm=0.0, last_mm=-height) for x in down] + [
        Ruler(direction="horizontal", at_mm=z, first_mm=0.0, last_mm=width) for z in across
    ]
    return Board(grid=grid, ruler=tuple(rulers))


BOARDS: Mapping[str, Board] = {
    "paper": _ruled(Grid(columns=10, rows=10, pitch_mm=50.0, dot_diameter_mm=5.0)),
    "dots alone": Board(grid=Grid(columns=10, rows=10, pitch_mm=50.0, dot_diameter_mm=5.0)),
    "coarse": Board(grid=Grid(columns=6, rows=6, pitch_mm=90.0, dot_diameter_mm=8.0)),
    "dense": Board(grid=Grid(columns=31, rows=31, pitch_mm=15.0, dot_diameter_mm=5.0)),
}


def reading_of(board: Board, noise_px: float, generator: np.random.Generator) -> BoardReading:
    """The board's marks as the camera shows them, each shifted by normal noise in u and in v.

    Their sigma_px is the noise, or 1e-4 px where there is none.

    Parameters
    ----------
    board : Board, mm
    noise_px : float, px, standard deviation
    generator : Generator, of NumPy
    """

    def marks(places: Floats) -> Marks:
        return seen_marks(places, image_px(places), IMAGE_SIZE, noise_px, generator)

    rulers = [RulerReading(r.direction, r.at_mm, marks(r.points_mm())) for r in board.ruler]
    return BoardReading(
        image_size=IMAGE_SIZE,
        pitch_mm=board.grid.pitch_mm,
        shape=(board.grid.rows, board.grid.columns),
        grid=marks(board.grid.points_mm()),
        rulers=tuple(rulers),
    )


def seen_marks(
    board_mm: Floats,
    exact_px: Floats,
    image_size: tuple[int, int],
    noise_px: float,
    generator: np.random.Generator,
) -> Marks:
    """Marks with normal noise in u and in v; OUT_OF_VIEW where that takes them off the picture.

    Their sigma_px is the noise, or 1e-4 px where there is none.

    Parameters
    ----------
    board_mm : (N, 2) array, mm, on the board
    exact_px : (N, 2) array, px, where the camera sees them
    image_size : tuple of int, (width, height) of the picture, px
    noise_px : float, px, standard deviation
    generator : Generator, of NumPy
    """
    image = exact_px + noise_px * generator.standard_normal(exact_px.shape)
    seen = np.all((image >= 0) & (image <= np.array(image_size) - 1), axis=1)
    return Marks(
        board_mm=board_mm,
        image_px=np.where(seen[:, None], image, np.nan),
        sigma_px=np.where(seen, max(noise_px, 1e-4), np.nan),
        status=np.where(seen, Status.OK, Status.OUT_OF_VIEW).astype(np.int64),
    )
