"""``[track_errors]``: where the head truly is when the track is commanded to a position."""

from math import pi, radians, sin
from typing import Annotated

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from lscan.config.documents import Strict
from lscan.config.rig import Plan
from lscan.records import Floats
from sim.scene.instrument import Seed
from sim.scene.randomness import unit_normal

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
