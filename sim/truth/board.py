"""Where the calibration board's marks truly are in its picture."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import shapely

from lscan.config.board import Board, Ring
from lscan.records import (
    BoardReading,
    Floats,
    Ints,
    Mark,
    Marks,
    RingPoints,
    RulerReading,
    Status,
)
from sim.scene import Scene, into_head, target_pose
from sim.truth.camera.projection import project
from sim.truth.shutter import row_positions_mm, travel_mm
from sim.truth.target.section import surfaces_of
from sim.truth.target.surfaces import TankSurface
from sim.truth.visibility import in_picture, seen

RIM_POINTS = 128  # of a dot's outline, for its area's centroid
RING_POINTS = 72  # on a ring's centre line
TURNS = 5  # of the rolling shutter's fixed point


@dataclass(frozen=True)
class BoardTruth:
    """The board's marks as they ought to be read; sigma_px is 0.

    A ring's points count as dots as wide as its line.  A mark is OUT_OF_VIEW where its centre lies
    outside the picture, OCCLUDED where something occludes it; a ring's points, which have no
    status, are NaN then.

    Attributes
    ----------
    centres : BoardReading, the marks' true centres projected, px: what a map of the plane should be
        solved from
    centroids : BoardReading, the centroids of the dots' pictures, px, which a perfect extractor
        would find; the two differ by the perspective's bias

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/board")
    >>> sim.board_truth(scene, 0.0).centres.grid.image_px.shape
    (100, 2)
    """

    centres: BoardReading
    centroids: BoardReading


@dataclass(frozen=True)
class BoardProjection:
    """The board picture of a scene: how places on the board, (N, 2) of (x, z) mm, are imaged."""

    scene: Scene
    surfaces: Sequence[TankSurface]
    position_mm: float

    def head(self, places: Floats) -> tuple[Floats, Floats]:
        """(N, 3) the places in the head frame, mm, and (N,) the track positions then, mm."""
        x, z = places.T
        world = target_pose(self.scene).apply(np.column_stack([x, np.zeros_like(x), z]))
        position = self._position(world)
        return into_head(self.scene.tank.head, world, position), position

    def _position(self, world: Floats) -> Floats:
        """(N,) where the head is, mm, in mid-exposure of the rows (N, 3) points show in.

        Under a rolling shutter the row depends on the head's place and that on the row; each
        turn brings the answer closer by travel times magnification over the picture's height,
        a hundredth or less.
        """
        scene, count = self.scene, len(world)
        position: Floats = np.full(count, self.position_mm)
        for _ in range(0 if travel_mm(scene) == 0 else TURNS):
            rows = project(scene, into_head(scene.tank.head, world, position))[:, 1]
            there = row_positions_mm(scene, self.position_mm, rows)
            position = np.where(np.isfinite(there), there, self.position_mm)
        return position

    def status(self, places: Floats) -> Ints:
        """(N,) of Status: OK, OUT_OF_VIEW or OCCLUDED."""
        head, position = self.head(places)
        shown = in_picture(self.scene, project(self.scene, head))
        free = seen(self.scene, self.surfaces, head, position)
        return np.select([~shown, ~free], [Status.OUT_OF_VIEW, Status.OCCLUDED], Status.OK)

    def centre(self, places: Floats, diameter_mm: float) -> Floats:
        """(N, 2) px of the places themselves."""
        return project(self.scene, self.head(places)[0])

    def centroid(self, places: Floats, diameter_mm: float) -> Floats:
        """(N, 2) px of the centroids of the pictures of discs at the places."""
        angle = 2 * np.pi * np.arange(RIM_POINTS) / RIM_POINTS
        circle = diameter_mm / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
        outline = (places[:, np.newaxis] + circle).reshape(-1, 2)
        return area_centroids(self.centre(outline, 0.0).reshape(-1, RIM_POINTS, 2))


Imager = Callable[[Floats, float], Floats]  # BoardProjection.centre or BoardProjection.centroid


def board_truth(scene: Scene, position_mm: float = 0.0) -> BoardTruth:
    """The truth of the picture of the calibration board.

    Parameters
    ----------
    scene
        The board in its tank.
    position_mm
        Track position of the head; where it moves, in the middle of the read-out.

    Raises
    ------
    InputError
        Where the scene's target is not the board.

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/board")
    >>> int(sim.board_truth(scene, 0.0).centres.grid.found.sum())
    100
    """
    board = scene.board()
    view = BoardProjection(scene, surfaces_of(scene), position_mm)
    return BoardTruth(_reading(board, view, view.centre), _reading(board, view, view.centroid))


def _reading(board: Board, view: BoardProjection, image: Imager) -> BoardReading:
    def marks(places: Floats, diameter_mm: float) -> Marks:
        status = view.status(places)
        shown = (status == Status.OK)[:, np.newaxis]
        pixels = np.where(shown, image(places, diameter_mm), np.nan)
        sigma = np.where(shown[:, 0], 0.0, np.nan)
        return Marks(board_mm=places, image_px=pixels, sigma_px=sigma, status=status)

    camera, grid = view.scene.rig.camera, board.grid
    rulers = [
        RulerReading(r.direction, r.at_mm, marks(r.points_mm(), r.mark_diameter_mm))
        for r in board.ruler
    ]
    dots = {d.name: marks(np.array([[d.x_mm, d.z_mm]]), d.diameter_mm) for d in board.dot}
    rings = {r.name: marks(_on_ring(r), r.width_mm) for r in board.ring}
    return BoardReading(
        image_size=(camera.width_px, camera.height_px),
        pitch_mm=grid.pitch_mm,
        shape=(grid.rows, grid.columns),
        grid=marks(grid.points_mm(), grid.dot_diameter_mm),
        rulers=tuple(rulers),
        dots={name: _single(mark) for name, mark in dots.items()},
        rings={name: RingPoints(mark.image_px, mark.sigma_px) for name, mark in rings.items()},
    )


def _single(marks: Marks) -> Mark:
    return Mark(marks.image_px[0], float(marks.sigma_px[0]), Status(int(marks.status[0])))


def _on_ring(ring: Ring) -> Floats:
    """(RING_POINTS, 2) places on the ring's centre line, counter-clockwise from the right."""
    angle = 2 * np.pi * np.arange(RING_POINTS) / RING_POINTS
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.array([ring.x_mm, ring.z_mm]) + ring.diameter_mm / 2 * circle


def area_centroids(outlines: Floats) -> Floats:
    """(N, 2) centroids of the areas of N polygons of K corners, (N, K, 2); NaN of those of NaN."""
    centroids = shapely.centroid(shapely.polygons(outlines))
    return np.column_stack([shapely.get_x(centroids), shapely.get_y(centroids)])
