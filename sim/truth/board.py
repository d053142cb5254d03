"""Where the calibration board's marks truly are in its picture."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely

from lscan.records import BoardReading, Floats, Ints, Mark, Marks, RingPoints, RulerReading, Status
from sim.scene import Scene, into_head, target_pose
from sim.truth.camera import project
from sim.truth.stripe import row_positions_mm, travel_mm
from sim.truth.surfaces import surfaces_of
from sim.truth.visibility import in_picture, seen

RIM_POINTS = 128  # of a dot's outline, for its area's centroid
RING_POINTS = 72  # on a ring's centre line
TURNS = 5  # of the rolling shutter's fixed point


# Pixels of marks: their nominal places on the board, their diameter and by what they are misplaced.
Imager = Callable[[Floats, float, Floats], Floats]


@dataclass(frozen=True)
class BoardTruth:
    """The board's marks as they ought to be read; sigma_px is 0.

    ``board_mm`` are the nominal places; the true ones, which are seen, have the board's errors.
    A ring's points count as dots as wide as its line.  A mark is OUT_OF_VIEW where its centre lies
    outside the picture, OCCLUDED where something occludes it; a ring's points, which have no
    status, are NaN then.

    Attributes
    ----------
    scene : Scene, its target is the board
    position_mm : float, mm, track position of the head; where it moves, in the middle of the
        read-out

    Examples
    --------
    >>> import sim
    >>> scene = sim.load_scene("paper/board")
    >>> sim.board_truth(scene, 0.0).centres.grid.image_px.shape
    (100, 2)
    """

    scene: Scene
    position_mm: float

    @cached_property
    def centres(self) -> BoardReading:
        """The marks' true centres projected, in px, from which a plane map should be solved."""
        return self._reading(lambda places, _, shift: self._project(places, shift))

    @cached_property
    def centroids(self) -> BoardReading:
        """The centroids of the dots' pictures, px, which a perfect extractor would find.

        They differ from ``centres`` by the perspective's bias.
        """
        return self._reading(self._centroids)

    def _reading(self, image: Imager) -> BoardReading:
        board, camera = self.scene.board(), self.scene.rig.camera

        def marks(places: Floats, diameter_mm: float, shift: Floats) -> Marks:
            status = self._status(places, shift)
            shown = status == Status.OK
            pixels = np.where(shown[:, np.newaxis], image(places, diameter_mm, shift), np.nan)
            sigma = np.where(shown, 0.0, np.nan)
            return Marks(board_mm=places, image_px=pixels, sigma_px=sigma, status=status)

        grid, *by_ruler, by_dot, by_ring = self.scene.true_board().shifts_mm()
        rulers = [
            RulerReading(r.direction, r.at_mm, marks(r.points_mm(), r.mark_diameter_mm, shift))
            for r, shift in zip(board.ruler, by_ruler, strict=True)
        ]
        dots = {
            d.name: marks(np.array([[d.x_mm, d.z_mm]]), d.diameter_mm, shift)
            for d, shift in zip(board.dot, by_dot, strict=True)
        }
        rings = {
            r.name: marks(
                np.array([r.x_mm, r.z_mm]) + _circle(RING_POINTS, r.diameter_mm), r.width_mm, shift
            )
            for r, shift in zip(board.ring, by_ring, strict=True)
        }
        return BoardReading(
            image_size=(camera.width_px, camera.height_px),
            pitch_mm=board.grid.pitch_mm,
            shape=(board.grid.rows, board.grid.columns),
            grid=marks(board.grid.points_mm(), board.grid.dot_diameter_mm, grid),
            rulers=tuple(rulers),
            dots={name: _single(mark) for name, mark in dots.items()},
            rings={name: RingPoints(mark.image_px, mark.sigma_px) for name, mark in rings.items()},
        )

    def _status(self, places: Floats, shift: Floats) -> Ints:
        """(N,) of Status, of (N, 2) places on the board: OK, OUT_OF_VIEW or OCCLUDED."""
        head, position = self._in_head(places, shift)
        shown = in_picture(self.scene, project(self.scene, head))
        free = seen(self.scene, surfaces_of(self.scene), head, position)
        return np.select([~shown, ~free], [Status.OUT_OF_VIEW, Status.OCCLUDED], Status.OK)

    def sheet_px(self, places_mm: Floats) -> Floats:
        """(N, 2) px of places of the sheet y = 0 in the frame that the board marks there.

        That of a board off the sheet is dropped onto it perpendicularly.

        Parameters
        ----------
        places_mm : (N, 2) array, mm, nominal (x, z) on the board
        """
        head, _ = self._in_head(places_mm, np.zeros(2))
        return project(self.scene, head * [1.0, 0.0, 1.0])

    def marks_px(self) -> Floats:
        """(M, 2) px of control points and rulers' marks, in that order, hidden or not."""
        board = self.scene.board()
        places = [board.grid.points_mm(), *(ruler.points_mm() for ruler in board.ruler)]
        shifts = self.scene.true_board().shifts_mm()[: len(places)]
        shifts = [np.broadcast_to(shift, p.shape) for shift, p in zip(shifts, places, strict=True)]
        return self._project(np.concatenate(places), np.concatenate(shifts))

    def _project(self, places: Floats, shift: Floats) -> Floats:
        """(N, 2) px of (N, 2) places on the board."""
        return project(self.scene, self._in_head(places, shift)[0])

    def _centroids(self, places: Floats, diameter_mm: float, shift: Floats) -> Floats:
        """(N, 2) px of the centroids of the pictures of discs at (N, 2) places on the board."""
        outline = (places[:, np.newaxis] + _circle(RIM_POINTS, diameter_mm)).reshape(-1, 2)
        shifts = np.repeat(np.broadcast_to(shift, places.shape), RIM_POINTS, axis=0)
        return area_centroids(self._project(outline, shifts).reshape(-1, RIM_POINTS, 2))

    def _in_head(self, places: Floats, shift: Floats) -> tuple[Floats, Floats]:
        """(N, 3) places in the head frame, mm, and (N,) the track positions then, mm.

        places: (N, 2) of nominal (x, z) on the board, mm; shift: (2,) or (N, 2) by which their
        marks are misplaced.  The position is that of the mid-exposure of the row that a place
        shows in.  Under a rolling shutter the row depends on the head's place and that on the row;
        each turn brings the answer closer by travel times magnification over the picture's height,
        a hundredth or less.
        """
        scene, true = self.scene, self.scene.true_board()
        x, z = true.printed_places(places, shift).T
        world = target_pose(scene).apply(true.bent(np.column_stack([x, np.zeros_like(x), z])))
        position: Floats = np.full(len(world), self.position_mm)
        for _ in range(0 if travel_mm(scene) == 0 else TURNS):
            rows = project(scene, into_head(scene.tank.head, world, position))[:, 1]
            there = row_positions_mm(scene, self.position_mm, rows)
            position = np.where(np.isfinite(there), there, self.position_mm)
        return into_head(scene.tank.head, world, position), position


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
    scene.board()  # refuses another target
    return BoardTruth(scene, position_mm)


def _single(marks: Marks) -> Mark:
    return Mark(marks.image_px[0], float(marks.sigma_px[0]), Status(int(marks.status[0])))


def _circle(count: int, diameter_mm: float) -> Floats:
    """(count, 2) points on a circle about 0, counter-clockwise from the right."""
    angle = 2 * np.pi * np.arange(count) / count
    return diameter_mm / 2 * np.column_stack([np.cos(angle), np.sin(angle)])


def area_centroids(outlines: Floats) -> Floats:
    """(N, 2) centroids of the areas of N polygons of K corners, (N, K, 2); NaN of those of NaN."""
    found = np.full(outlines[:, 0].shape, np.nan)
    whole = np.isfinite(outlines).all(axis=(1, 2))
    found[whole] = shapely.get_coordinates(shapely.centroid(shapely.polygons(outlines[whole])))
    return found
