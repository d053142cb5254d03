"""``[board_errors]``, ``[track_errors]``: how board and head truly differ from the nominal."""

from dataclasses import dataclass
from math import pi, radians, sin
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from lscan.config.board import Board
from lscan.config.documents import Strict
from lscan.config.rig import Plan
from lscan.records import Floats
from sim.scene.instrument import Seed
from sim.scene.varying import unit_normal

# ``[board_errors]``: how the true board differs from the nominal one that the instrument knows.

PPM = 1e-6
FACET_MM = 5e-4  # by which facets lie off a bend along either axis: 1 µm where both are bent
# Times its bend a side must be long: it then slopes by 6 degrees at its ends, which from its middle
# rise by 3 and hide 1.2e-3 of the sky.
STEEPEST = 40

Scale = Annotated[float, Field(ge=-2e4, le=2e4)]
Bend = Annotated[float, Field(ge=-20, le=20)]


class BoardErrors(Strict):
    """Errors of print and plate; nothing in the board file tells of them.

    scale_x_ppm, scale_z_ppm: by which share the print is too large, about the plate's middle,
    marks and all.  shear_deg: the columns lean towards +x by this angle, the rows lie as they
    ought to.  dot_noise_mm: standard deviation of the place of each mark, along x and along z.
    bend_x_mm, bend_z_mm: how far the plate's middle lies behind (+y) its ends, along either axis;
    a parabola of the arc length, to which the print keeps.  A plate that is bent along one axis
    is not stretched by it.  Along both the two add up, and it is: lines across it turn by the
    product of the slopes.
    """

    scale_x_ppm: Scale = 0.0
    scale_z_ppm: Scale = 0.0
    shear_deg: Annotated[float, Field(ge=-5, le=5)] = 0.0
    dot_noise_mm: NonNegativeFloat = 0.0
    bend_x_mm: Bend = 0.0
    bend_z_mm: Bend = 0.0
    seed: Seed = 1


@dataclass(frozen=True)
class TrueBoard:
    """The board as it truly is, in its own frame: marks and facets.

    Attributes
    ----------
    board : Board, the nominal one
    errors : BoardErrors, by which it is off
    """

    board: Board
    errors: BoardErrors

    @property
    def is_bent(self) -> bool:
        """Whether the plate is not flat."""
        return self.errors.bend_x_mm != 0 or self.errors.bend_z_mm != 0

    def shifts_mm(self) -> list[Floats]:
        """(N, 2) of x and z by which marks are misplaced: of grid, each ruler, dots and rings."""
        board = self.board
        rulers = [len(ruler.points_mm()) for ruler in board.ruler]
        counts = [board.grid.rows * board.grid.columns, *rulers, len(board.dot), len(board.ring)]
        generator = np.random.Generator(np.random.SFC64(self.errors.seed))
        drawn = self.errors.dot_noise_mm * generator.standard_normal((sum(counts), 2))
        return np.split(drawn, np.cumsum(counts)[:-1])

    def printed_places(self, places: Floats, shift_mm: Floats) -> Floats:
        """(N, 2) places of marks on the flat plate, mm, from their (N, 2) nominal ones.

        Parameters
        ----------
        places : (N, 2) array, mm, of nominal x and z
        shift_mm : (2,) or (N, 2) array, of the marks they belong to
        """
        left, right, bottom, top = self.board.outline_mm()
        scale_x, scale_z = PPM * self.errors.scale_x_ppm, PPM * self.errors.scale_z_ppm
        lean = np.radians(self.errors.shear_deg)
        along = np.array([np.sin(lean), np.cos(lean)]) * (1 + scale_z) - [0, 1]
        off = places - [(left + right) / 2, (bottom + top) / 2]
        return np.asarray(places + off @ np.array([[scale_x, 0], along]) + shift_mm)

    def facets_mm(self) -> tuple[Floats, Floats]:
        """Where the plate's facets begin and end along x and z of the flat plate, mm."""
        left, right, bottom, top = self.board.outline_mm()
        sides = (left, right, self.errors.bend_x_mm), (bottom, top, self.errors.bend_z_mm)
        x, z = (
            np.linspace(low, high, max(1, int(np.ceil(np.sqrt(abs(bend) / FACET_MM)))) + 1)
            for low, high, bend in sides
        )
        return x, z

    def bent(self, points: Floats) -> Floats:
        """(N, 3) points of the flat plate where they are on its facets, mm.

        Parameters
        ----------
        points : (N, 3) array, mm, of x, y and z on the flat plate, its face in y = 0
        """
        if not self.is_bent:
            return points
        moved = points.copy()
        bends = self.errors.bend_x_mm, self.errors.bend_z_mm
        for axis, nodes, bend_mm in zip((0, 2), self.facets_mm(), bends, strict=True):
            along, behind = parabola(nodes, bend_mm)
            moved[:, axis] = np.interp(points[:, axis], nodes, along)
            moved[:, 1] += np.interp(points[:, axis], nodes, behind)
        return moved


def parabola(nodes: Floats, bend_mm: float) -> tuple[Floats, Floats]:
    """Where places of a strip are once it is bent: along the way between its ends, and behind it.

    Behind by b (1 - (2 s / L)²) at the arc length s from the middle of a strip of length L, which
    sloped by the sine k s, k = 8 b / L², ends up at the integral of its cosine.

    Parameters
    ----------
    nodes : array, mm, rising; the first and the last are the ends
    bend_mm : float, mm, b
    """
    low, high = nodes[0], nodes[-1]
    middle, length = (low + high) / 2, high - low
    arc = nodes - middle
    sine = 8 * bend_mm / length**2 * arc
    over = np.divide(np.arcsin(sine), sine, out=np.ones_like(sine), where=sine != 0)
    along = arc * (np.sqrt(1 - sine**2) + over) / 2
    return middle + along, bend_mm * (1 - (2 * arc / length) ** 2)


# ``[track_errors]``: where the head truly is when the track is commanded to a position.


MM_PER_M = 1000.0
STREAM = "track_errors"


class TrackErrors(Strict):
    """Errors of the way and of the carriage on it; nothing the track reports tells of them.

    Commanded to s the head stands at s + scale_ppm s + periodic_mm sin(2 pi s / pitch_mm +
    phase_deg), and ``backlash_mm`` beyond that where its last move went towards smaller s.  The
    moves are the plan's: of its first picture from 0, of each other one by a step.  ``noise_mm``
    is the standard deviation of what is new in every picture.  From ``lost_at_mm`` on, in the
    plan's direction, the head lags by ``lost_step_mm``.
    yaw, pitch, roll: how fast the head turns about its own z, x and y along the way, 0 at
    position 0; about ``head.pivot_mm``.  bow_x_mm, bow_z_mm: how far the way's ends,
    ``bow_length_mm`` apart and position 0 midway, lie off its tangent there; the way between is a
    parabola, and the head does not turn with it but by the three angles.
    """

    scale_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    periodic_mm: float = 0.0
    pitch_mm: PositiveFloat = 8.0
    phase_deg: float = 0.0
    backlash_mm: NonNegativeFloat = 0.0
    noise_mm: NonNegativeFloat = 0.0
    lost_step_mm: float = 0.0
    lost_at_mm: float = 0.0
    yaw_deg_per_m: float = 0.0
    pitch_deg_per_m: float = 0.0
    roll_deg_per_m: float = 0.0
    bow_x_mm: float = 0.0
    bow_z_mm: float = 0.0
    bow_length_mm: PositiveFloat = 1000.0
    seed: Seed = 1

    def true_mm(self, plan: Plan, frame: int, position_mm: float) -> float:
        """Where the head stands along the track, mm.

        Parameters
        ----------
        plan : Plan, whose step says which way the head moves
        frame : int, number of the picture
        position_mm : float, mm, as commanded
        """
        s, ahead = position_mm, plan.step_mm >= 0
        last_move_mm = position_mm if frame == 0 else plan.step_mm
        error = 1e-6 * self.scale_ppm * s
        error += self.periodic_mm * sin(2 * pi * s / self.pitch_mm + radians(self.phase_deg))
        if last_move_mm < 0:
            error += self.backlash_mm
        if s >= self.lost_at_mm if ahead else s <= self.lost_at_mm:
            error -= self.lost_step_mm if ahead else -self.lost_step_mm
        if self.noise_mm > 0:
            error += self.noise_mm * unit_normal(self.seed, STREAM, frame)
        return s + error

    def turn_deg(self, position_mm: float) -> Floats:
        """(3,) angles about x, y and z of the head at a commanded position.

        Parameters
        ----------
        position_mm : float, mm, as commanded
        """
        rates = (self.pitch_deg_per_m, self.roll_deg_per_m, self.yaw_deg_per_m)
        return np.array(rates) * position_mm / MM_PER_M

    def shift_mm(self, position_mm: float) -> Floats:
        """(3,) mm off the straight way, world frame, at a commanded position.

        Parameters
        ----------
        position_mm : float, mm, as commanded
        """
        part = (2 * position_mm / self.bow_length_mm) ** 2
        return part * np.array([self.bow_x_mm, 0.0, self.bow_z_mm])
