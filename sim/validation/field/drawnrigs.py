"""Rigs drawn from what is known of one, and calibrated from what the truth says they would see.

Nothing is rendered: marks and lines are where ``sim.truth`` puts them, with noise, so that hundreds
of rigs can be calibrated and their intervals counted.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import fsolve

from lscan.benchmark.drawn import seen_marks
from lscan.calibration.calibrate import calibrate
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.calibration.physical import PhysicalMap
from lscan.config.board import Board
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Floats, Marks, RulerReading
from sim.scene import Pose, Scene, camera_pose, head_pose, target_pose
from sim.truth import project, sheet_of

NOISE_PX = 0.03  # of marks and of points of the line, as the renders of the board have it
LENS, PORT = ("focal_px",), ("gap_mm", "thickness_mm", "glass_index")
LEAST_GAP_MM = 1.0
LINE_POINTS = 80
REACH_MM = 60.0  # of the line on a board, to either side of its foot


def drawn_rig(scene: Scene, generator: np.random.Generator) -> Scene:
    """The scene with lens and port drawn from what its ``[optics]`` says of them."""
    optics = scene.rig.optics

    def drawn(name: str) -> float:
        mean, sigma = getattr(optics, name)
        return float(generator.normal(mean, sigma))

    port = {name: drawn(name) for name in PORT}
    port["gap_mm"] = max(port["gap_mm"], LEAST_GAP_MM)
    return scene.with_tank(lens={name: drawn(name) for name in LENS}, port=port)


def refractive_map(
    scene: Scene, optics: OpticsSection, generator: np.random.Generator
) -> PhysicalMap:
    """The refractive map solved from the scene's board, which lies in the sheet."""
    solved = calibrate(drawn_reading(scene, generator), "refractive", optics).plane_map
    assert isinstance(solved, PhysicalMap)
    return solved


def metric_map(
    scene: Scene, held: Sequence[Scene], optics: OpticsSection, generator: np.random.Generator
) -> PhysicalMap:
    """The metric map solved from the scene's board, held as in ``held``."""
    size = scene.rig.camera.size_px
    views = [_view(number, scene, board_pose(pose), generator) for number, pose in enumerate(held)]
    return calibrate_metric(views, optics, size).plane_map


def metric_frame(scene: Scene) -> Pose:
    """The frame of the metric map in the head's: origin where the middle pixel sees the sheet."""
    width, height = scene.rig.camera.size_px
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    sheet, camera = sheet_of(scene), camera_pose(scene.tank.head)

    def missed(xz_mm: Floats) -> Floats:
        seen: Floats = project(scene, sheet.in_head(xz_mm[None]))
        return seen[0] - middle

    start = sheet.pose.invert(camera.apply(np.array([0.0, 0.0, 1000.0])))[[0, 2]]
    origin = sheet.in_head(fsolve(missed, start, xtol=1e-12)[None])[0]
    away = sheet.pose.rotation[:, 1]
    away = away * np.sign(away @ camera.rotation[:, 2])
    x = camera.rotation[:, 0] - (camera.rotation[:, 0] @ away) * away
    x /= np.linalg.norm(x)
    return Pose(np.column_stack([x, away, np.cross(x, away)]), origin)


def drawn_reading(scene: Scene, generator: np.random.Generator) -> BoardReading:
    """The marks of the scene's board as a picture of it would be read, with NOISE_PX."""
    board, pose = scene.board(), board_pose(scene)
    grid = board.grid
    return BoardReading(
        image_size=scene.rig.camera.size_px,
        pitch_mm=grid.pitch_mm,
        shape=(grid.rows, grid.columns),
        grid=_marks(scene, pose, grid.points_mm(), generator),
        rulers=tuple(
            RulerReading(
                ruler.direction, ruler.at_mm, _marks(scene, pose, ruler.points_mm(), generator)
            )
            for ruler in board.ruler
        ),
    )


def _marks(scene: Scene, pose: Pose, board_mm: Floats, generator: np.random.Generator) -> Marks:
    """Marks at (N, 2) mm of a board in that pose."""
    exact = project(scene, pose.apply(in_space(board_mm)))
    return seen_marks(board_mm, exact, scene.rig.camera.size_px, NOISE_PX, generator)


def _view(number: int, scene: Scene, pose: Pose, generator: np.random.Generator) -> CalibrationView:
    """The board in that pose, and the laser's line on it."""
    board, sheet = scene.board(), sheet_of(scene).pose
    marks = _marks(scene, pose, board.grid.points_mm(), generator)
    middle = pose.apply(in_space(_middle_mm(board)[None]))[0]
    face, normal = pose.rotation[:, 1], sheet.rotation[:, 1]
    along = np.cross(face, normal)
    along /= np.linalg.norm(along)
    across = normal - (face @ normal) * face
    foot = middle - sheet.invert(middle)[1] / (across @ across) * across
    reach = np.linspace(-REACH_MM, REACH_MM, LINE_POINTS)[:, None]
    image = project(scene, foot + reach * along)
    level = np.ptp(image[:, 0]) >= np.ptp(image[:, 1])
    image[:, 1 if level else 0] += generator.normal(0.0, NOISE_PX, LINE_POINTS)
    line = LinePoints(image, np.full(LINE_POINTS, NOISE_PX), "columns" if level else "rows")
    return CalibrationView(f"pose-{number}", marks, line)


def board_pose(scene: Scene) -> Pose:
    """Board frame to head frame, the head at track position 0.

    Parameters
    ----------
    scene : Scene, with a board
    """
    head, board = head_pose(scene.tank.head, 0.0), target_pose(scene)
    return Pose(head.rotation.T @ board.rotation, head.invert(board.origin_mm))


def _middle_mm(board: Board) -> Floats:
    return board.grid.points_mm().mean(axis=0)


def in_space(xz_mm: Floats) -> Floats:
    """(N, 3) mm, board frame, of places (x, z) on a board.

    Parameters
    ----------
    xz_mm : (N, 2) array, mm
    """
    return np.column_stack([xz_mm[:, 0], np.zeros(len(xz_mm)), xz_mm[:, 1]])
