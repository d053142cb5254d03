"""The rendered tier: a rig's errors with every picture rendered, exposed and read.

The places are those of the geometric tier, moved along the line into the middles of the columns
that they show in, so that what differs between the tiers is what the pictures hold: what noise,
light and lens do to marks and line beyond what was found on the rig as it ought to be.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from lscan.board import read_board
from lscan.calibration.planemap import joined_marks
from lscan.records import BoardReading, Floats, select
from sim.render.tank import Tank
from sim.scene import Scene, at_moment
from sim.studies.geometric import GeometricRig
from sim.studies.places import ScanPlaces
from sim.studies.prepared import SENSOR, SPECKLE, centres_in, exposed, stated
from sim.studies.states import RigStates

STEP_RAD = 1e-4  # of a ray in the fan: a tenth of a pixel; the line is straight over that


class RenderedRig(GeometricRig):
    """The problem of a study in the rendered tier.

    Parameters
    ----------
    study : Study
    prepared : Prepared, its places, and what the rig corrects for
    """

    def _line(self, states: RigStates) -> tuple[Floats, Floats]:
        places = self._in_columns(states.scan)
        pixels, true_mm = self._true_line(states.scan, places)
        found = self._found(states)
        along = 1 - self._across
        column = np.rint(pixels[:, along]).astype(int)
        number = np.searchsorted(np.unique(places.frame), places.frame)
        inside = (column >= 0) & (column < found.shape[1])
        centre = np.where(inside, found[number, np.where(inside, column, 0)], np.nan)
        pixels[:, self._across] = centre - self.prepared.corrected_px
        return pixels, true_mm

    def _in_columns(self, scan: Scene) -> ScanPlaces:
        """The places, each moved along the line into the middle of the column it shows in."""
        places, along = self.prepared.places, 1 - self._across
        here = self._true_line(scan, places)[0][:, along]
        beside = self._true_line(scan, replace(places, angle=places.angle + STEP_RAD))[0][:, along]
        angle = places.angle + (np.rint(here) - here) * STEP_RAD / (beside - here)
        return replace(places, angle=angle)

    def _found(self, states: RigStates) -> Floats:
        """(F, N) px where the line is found in the pictures that have places."""
        scan, places = states.scan, self.prepared.places
        tank = Tank(scan)
        pictures = []
        for frame in np.unique(places.frame):
            part = select(places, places.frame == frame)
            moment = at_moment(scan, int(frame), float(part.position_mm[0]))
            tank.take(moment.scene)
            layers = tank.render(moment.position_mm)
            at_work = (SENSOR in states.seeds, SPECKLE in states.seeds)
            seed = _mixed(states.seeds, int(frame))
            pictures.append(exposed(moment.scene, layers, *at_work, seed))
        return centres_in(scan, pictures)

    def _reading(self, board: Scene, seeds: Mapping[str, int], stream: int) -> BoardReading:
        layers = Tank(board).render(board.rig.plan.positions_mm()[0])
        noises = (SENSOR in seeds, SPECKLE in seeds)
        picture = exposed(board, layers, *noises, _mixed(seeds, -stream))
        channel = board.rig.calibration.channel
        reading = read_board(picture, board.board(), channel=channel)
        if SENSOR in seeds:
            return replace(reading, dots={}, rings={})
        # Of a picture without noise a ruler's marks state a tenth of their uncertainty, the points
        # hardly less: a map that weighs them so is no map of this instrument.
        usual = joined_marks(self.prepared.reading)
        return stated(reading, usual.sigma_px, usual.status)


def _mixed(seeds: Mapping[str, int], picture: int) -> int:
    """A seed of one picture's noise."""
    stream = [seeds.get(SENSOR, 0), seeds.get(SPECKLE, 0), abs(picture), int(picture < 0)]
    return int(np.random.SeedSequence(stream).generate_state(1)[0])
