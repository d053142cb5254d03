"""Boards drawn from closed forms, and rigs drawn from what is known of one.

The lens is defined from the picture to the ray, by a polynomial in the picture's radius, so the
place on the board that a pixel sees is a closed form; only the truth, the other way round, needs an
iteration.  An edge is drawn as a straight one blurred by a Gaussian, at its true distance from each
pixel to first order.  None of the instrument's code is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation
from scipy.special import erf

from lscan.benchmark.drawn import seen_marks
from lscan.calibration.calibrate import calibrate
from lscan.calibration.metric.solve import calibrate_metric
from lscan.calibration.metric.views import CalibrationView, LinePoints
from lscan.calibration.physical import PhysicalMap
from lscan.camera.posedboards import CENTRE_WIDTHS
from lscan.config.board import Board
from lscan.config.rig import OpticsSection
from lscan.records import BoardReading, Bytes, Floats, Marks, RulerReading
from sim.scene import Pose, Scene, camera_pose, head_pose, target_pose
from sim.truth import project, sheet_of

# Boards drawn from closed forms: where each mark is seen is known exactly.

NEWTON_STEPS = 30


@dataclass(frozen=True)
class DrawnView:
    """A camera before a board.

    Attributes
    ----------
    size : tuple of int, (width, height) of the picture, px
    focal_px : float, px
    distance_mm : float, mm, from the pinhole to the place on the board seen in the middle
    middle_mm : tuple of float, mm, that place, (x, z)
    turn_deg : tuple of float, degrees, of the board about the picture's u, v and the axis of sight
    barrel : float, a pixel at the radius r (over the focal length) from the middle lies on the ray
        of radius r (1 + barrel r^2)
    """

    size: tuple[int, int]
    focal_px: float
    distance_mm: float
    middle_mm: tuple[float, float]
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    barrel: float = 0.0

    @property
    def axes(self) -> Floats:
        """(3, 3) the board's axes in the camera frame: right, down, away from the camera."""
        turned: Floats = Rotation.from_euler("xyz", self.turn_deg, degrees=True).as_matrix().T
        return turned

    def board_mm(self, image_px: Floats) -> Floats:
        """(..., 2) of (x, z) mm on the board that pixels (..., 2) of (u, v) see."""
        at = (image_px - (np.array(self.size) - 1) / 2) / self.focal_px
        at = at * (1 + self.barrel * (at**2).sum(axis=-1, keepdims=True))
        right, down, ahead = self.axes
        rays = np.concatenate([at, np.ones_like(at[..., :1])], axis=-1)
        reach = self.distance_mm * ahead[2] / (rays @ ahead)
        x = reach * (rays @ right) - self.distance_mm * right[2]
        z = self.distance_mm * down[2] - reach * (rays @ down)
        return np.stack([x, z], axis=-1) + np.array(self.middle_mm)

    def image_px(self, board_mm: Floats) -> Floats:
        """(N, 2) px of (u, v) at which places (N, 2) mm of the board are seen."""
        at = np.tile((np.array(self.size) - 1) / 2, (len(board_mm), 1))
        for _ in range(NEWTON_STEPS):
            miss = self.board_mm(at) - board_mm
            by_pixel = np.stack(
                [self.board_mm(at + step) - self.board_mm(at - step) for step in np.eye(2) / 2],
                axis=-1,
            )
            at = at - np.clip(np.linalg.solve(by_pixel, miss[..., None])[..., 0], -100, 100)
        return at

    def line_mm(self, sheet_per_mm: Floats, x_mm: Floats) -> Floats:
        """(N, 2) of (x, z) mm where the plane q . X = 1 of the camera frame cuts the board."""
        right, down, _ = self.axes
        origin = np.array([0.0, 0.0, self.distance_mm]) @ sheet_per_mm
        along = (x_mm - self.middle_mm[0]) * (right @ sheet_per_mm)
        beneath = (1 - origin - along) / (down @ sheet_per_mm)
        return np.column_stack([x_mm, self.middle_mm[1] - beneath])

    def pixels(self) -> Floats:
        """(H, W, 2) of (u, v) of all pixels."""
        u, v = np.meshgrid(np.arange(float(self.size[0])), np.arange(float(self.size[1])))
        return np.stack([u, v], axis=-1)


def dots_cover(
    view: DrawnView, shape: tuple[int, int], pitch_mm: float, diameter_mm: float, blur_px: float
) -> Floats:
    """(H, W) share of each pixel that the dots of a board cover; the first at (0, 0).

    Parameters
    ----------
    view : DrawnView, of the board
    shape : tuple of int, (rows, columns)
    pitch_mm, diameter_mm : float, mm
    blur_px : float, px, Gaussian sigma
    """
    place = view.board_mm(view.pixels())
    most = np.array([shape[1] - 1, 0]), np.array([0, 1 - shape[0]])
    node = np.clip(np.rint(place / pitch_mm), np.minimum(*most), np.maximum(*most)) * pitch_mm
    away = place - node
    distance = np.linalg.norm(away, axis=-1)
    unit = away / np.maximum(distance, 1e-9)[..., None]
    by_v, by_u = np.gradient(place, axis=(0, 1))
    slope = np.hypot((unit * by_u).sum(axis=-1), (unit * by_v).sum(axis=-1))
    return _covered((diameter_mm / 2 - distance) / slope, blur_px)


def chessboard_grey(
    view: DrawnView,
    inner: tuple[int, int],
    square_mm: float,
    slivers: tuple[float, float, float, float],
    blur_px: float,
) -> Floats:
    """(H, W) grey values, 0 black to 1 white, of a chessboard on white; first inner corner at 0.

    Parameters
    ----------
    view : DrawnView, of the board
    inner : tuple of int, (rows, columns) of corners between whole squares
    square_mm : float, mm
    slivers : tuple of float, what shows of further squares, as parts of one: left, right, top,
        bottom
    blur_px : float, px, Gaussian sigma
    """
    place = view.board_mm(view.pixels()) / square_mm * [1.0, -1.0]  # right and down
    by_v, by_u = np.gradient(place, axis=(0, 1))
    slope = np.hypot(by_u, by_v)
    nearest = np.rint(place)
    step = 2 * _covered((place - nearest) / slope, blur_px) - 1
    waves = step * (-1.0) ** nearest
    left, right, top, bottom = slivers
    low = np.array([-1 - left, -1 - top])
    high = np.array([inner[1] + right, inner[0] + bottom])
    inside = _covered((place - low) / slope, blur_px) * _covered((high - place) / slope, blur_px)
    dark = (1 + waves.prod(axis=-1)) / 2
    return 1 - dark * inside.prod(axis=-1)


def photographed(
    grey: Floats, noise_dn: float, rng: np.random.Generator, grain_px: float = 0.0
) -> Bytes:
    """(H, W) picture of grey values 0 to 1, with noise.

    Parameters
    ----------
    grey : (H, W) array
    noise_dn : float, DN, standard deviation
    rng : Generator, of NumPy
    grain_px : float, px, by which the noise is smoothed, as denoising and coding leave it; its
        standard deviation stays
    """
    noise = rng.standard_normal(grey.shape)
    if grain_px > 0:
        noise = gaussian_filter(noise, grain_px)
        noise /= noise.std()
    return np.clip(np.rint(10 + 220 * grey + noise_dn * noise), 0, 255).astype(np.uint8)


def _covered(inside_px: Floats, blur_px: float) -> Floats:
    """How much of a pixel lies within an edge so far outside it, (...) from 0 to 1."""
    return (1 + erf(inside_px / (np.sqrt(2) * blur_px))) / 2


# Rigs drawn from what is known of one, and calibrated from what the truth says they would see.
#
# Nothing is rendered: marks and lines are where ``sim.truth`` puts them, with noise, so that
# hundreds of rigs can be calibrated and their intervals counted.


NOISE_PX = 0.03  # of marks and of points of the line, as the renders of the board have it
LENS = ("focal_px", "p1", "p2")
PORT = ("gap_mm", "thickness_mm", "glass_index", "tilt_x_deg", "tilt_y_deg")
LEAST_GAP_MM = 1.0
LINE_POINTS = 80
REACH_MM = 60.0  # of the line on a board, to either side of its foot


def drawn_rig(scene: Scene, generator: np.random.Generator) -> Scene:
    """The scene with lens and port drawn from what its ``[optics]`` says of them.

    So is what it does not say and a calibration assumes: how far the lens is decentred and the
    glass tilted.  The truth of a quantity that is uncertain must err as it is said to.
    """
    optics = scene.rig.optics

    def drawn(name: str) -> float:
        mean, sigma = getattr(optics, name)
        return float(generator.normal(mean, sigma))

    port = {name: drawn(name) for name in PORT}
    port["gap_mm"] = max(port["gap_mm"], LEAST_GAP_MM)
    lens: dict[str, Any] = {name: drawn(name) for name in LENS}
    width, height = scene.rig.camera.size_px
    middle = np.array([width - 1, height - 1]) / 2
    lens["centre_px"] = generator.normal(middle, CENTRE_WIDTHS * width).tolist()
    return scene.with_tank(lens=lens, port=port)


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


# How much of the field table's work is done: all of it, or a quick look at every row.


@dataclass(frozen=True)
class FieldEffort:
    """What a run of the field table measures; by default all of it.

    seeds: of sensor noise, and of what else is drawn at random in a chapter.  photographs: folder
    of real pictures; None: rows of real pictures are left out.  plain: rendered with few samples,
    in the first order of light.
    """

    seeds: tuple[int, ...] = tuple(range(1, 21))
    photographs: Path | None = None
    plain: bool = False

    @property
    def seeded(self) -> str:
        """The seeds in words."""
        return f"seeds {self.seeds[0]} to {self.seeds[-1]}"


FULL = FieldEffort()
QUICK = FieldEffort(seeds=(1,), plain=True)
