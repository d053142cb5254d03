"""The geometric tier: a rig's errors without a picture.

Where the board's marks and the laser's line truly fall is computed in float64 by sim.truth; what
the instrument finds there is that, off by the scatter and the bias of its own algorithms, which
were found once on pictures of the rig as it ought to be (prepared.py).  From there on the
instrument's own code runs: the solver of the plane map, the map, the place of the profile on the
track.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from lscan.board import read_board
from lscan.calibration.calibrate import without_outliers
from lscan.calibration.check import map_for_rig
from lscan.calibration.marks import joined_marks, with_marks
from lscan.calibration.planemap import NamedSolver, find_solver
from lscan.errors import MeasurementError
from lscan.records import BoardReading, Floats, Status, select
from sim.render.tank import Tank
from sim.scene import Pose, Scene, at_moment, into_world
from sim.scene.file import is_changing
from sim.studies.problem import AFTER, Output
from sim.studies.rig.prepared import (
    SENSOR,
    SPECKLE,
    Prepared,
    centres_in,
    depends_on_light,
    line_bounds_px,
    lines_at,
    picture_of_layers,
    places_mm,
    stated_reading,
)
from sim.studies.rig.states import (
    PlacesInState,
    RigStates,
    ScanPlaces,
    height_above,
    lit_points,
    states_of,
)
from sim.studies.studyfile import Study
from sim.truth import StripeTruth, board_truth
from sim.truth.camera import camera_of, image, rays_to

# From where points were measured and where they are to the errors that a study looks at.


MOST_LOST = 0.2  # of the places: beyond, a rig is no rig to speak of
PER_MM = 100.0  # of a length whose error is given
WITHIN = 0.99  # of the places of a scan, as reports state it of slices


@dataclass(frozen=True)
class ErrorFrame:
    """Where the P places of a scan lie, and what is fitted to their errors.

    Attributes
    ----------
    world_mm : (P, 3) array, mm, world frame, as the rig ought to be
    """

    world_mm: Floats

    @property
    def outputs(self) -> tuple[Output, ...]:
        """What ``errors_of`` gives, in this order."""
        count = len(self.world_mm)
        return (
            Output("height", "mm", count),
            Output("levelled", "mm", count),
            Output("levelled-rms", "mm"),
            Output("levelled-99", "mm"),
            Output("level", "mm"),
            Output("tilt-across", "deg"),
            Output("tilt-along", "deg"),
            Output("length-across", f"mm per {PER_MM:g} mm"),
            Output("length-along", f"mm per {PER_MM:g} mm"),
            Output("turn", "deg"),
        )

    def errors_of(self, measured_mm: Floats, true_mm: Floats, height_mm: Floats) -> Floats:
        """(K,) errors, measured less true.

        height: of each place, above the true surface beneath where it was measured.  levelled: the
        same less the plane that fits it best, whose height in the middle of all places is level,
        and whose slopes across the track and along it are tilt-across and tilt-along.
        levelled-rms, levelled-99: of one scan, the rms of levelled, and what 99 % of the places
        keep within.
        length-across, length-along: of 100 mm.  turn: of what was measured, about the vertical.

        Parameters
        ----------
        measured_mm, true_mm : (P, 3) array, mm, world frame; NaN where the map has no value
        height_mm : (P,) array, mm, of ``measured_mm`` above the surface

        Raises
        ------
        MeasurementError
            More than a fifth of the places were lost.
        """
        found = np.isfinite(height_mm)
        lost = 1 - np.mean(found)
        if lost > MOST_LOST:
            raise MeasurementError(f"{100 * lost:.0f} % of the places lie beside the board")
        middle = self.world_mm.mean(axis=0)
        across, along = (self.world_mm - middle)[:, :2].T
        plane = np.column_stack([np.ones(len(across)), across, along])
        off = (measured_mm - true_mm)[:, :2]
        fitted = np.column_stack([height_mm, off])
        if not found.all():
            # A place that was lost is given what its neighbours' plane says: it adds nothing.
            fit = np.linalg.lstsq(plane[found], fitted[found])[0]
            fitted = np.where(found[:, np.newaxis], fitted, plane @ fit)
        else:
            fit = np.linalg.lstsq(plane, fitted)[0]
        height, (of_height, of_x, of_y) = fitted[:, 0], fit.T
        levelled = height - plane @ of_height
        sizes = np.sqrt(np.mean(levelled**2)), np.quantile(np.abs(levelled), WITHIN)
        slopes = np.degrees(np.arctan(of_height[1:]))
        turn = np.degrees((of_y[1] - of_x[2]) / 2)
        scalars = [*sizes, of_height[0], *slopes, PER_MM * of_x[1], PER_MM * of_y[2], turn]
        return np.concatenate([height, levelled, scalars])


# The geometric tier: a rig's errors without a picture.


STILL = Pose(np.eye(3), np.zeros(3))
BOARD, BOARD_ANEW = 2, 3  # streams of the numbers drawn for one rig, beside prepared.LINE


class GeometricRig:
    """The problem of a study in the geometric tier.

    Parameters
    ----------
    study : Study
    prepared : Prepared, what was found on pictures of the rig as it ought to be
    """

    def __init__(self, study: Study, prepared: Prepared) -> None:
        self.study, self.prepared = study, prepared
        self._frame = ErrorFrame(prepared.places.world_mm)
        self._root = study.correlation_root()

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of the study's causes."""
        return self.study.causes

    @cached_property
    def outputs(self) -> tuple[Output, ...]:
        """Those of ``ErrorFrame``, and the same after recalibration where anything drifts."""
        before = self._frame.outputs
        if not any(cause.when == "drift" for cause in self.study.file.cause.values()):
            return before
        return (*before, *(replace(one, name=one.name + AFTER) for one in before))

    def evaluate(self, row: Floats) -> Floats:
        """(K,) errors of the rig that a row stands for; see ``StudyProblem``.

        Parameters
        ----------
        row : (D,) array
        """
        states = states_of(self.study, row, self._root)
        pixels, true_mm = self._line(states)
        reading = self._reading(states.calibrate, states.seeds, BOARD)
        errors = self._errors(reading, states.frame, pixels, true_mm)
        if len(self.outputs) == len(self._frame.outputs):
            return errors
        if states.recalibrate is None:
            return np.concatenate([errors, errors])
        anew = self._reading(states.recalibrate, states.seeds, BOARD_ANEW)
        after = self._errors(anew, states.frame_anew, pixels, true_mm)
        return np.concatenate([errors, after])

    def _line(self, states: RigStates) -> tuple[Floats, Floats]:
        """(P, 2) px where the line is found, and (P, 3) mm where it is, world frame."""
        pixels, true_mm = self._true_line(states.scan, self.prepared.places)
        scatter_px = None
        if states.seeds and self._follows_light:
            scatter_px = self._scatter_px(states.scan)
        pixels[:, self._across] += self.prepared.line_off_px(states.seeds, scatter_px)
        return pixels, true_mm

    @cached_property
    def _follows_light(self) -> bool:
        return depends_on_light(self.study)

    @cached_property
    def _lines(self) -> list[StripeTruth]:
        return lines_at(self.study.scan, self.prepared.places)

    @cached_property
    def _nominal_bounds(self) -> Floats:
        """(2, P) px of the rig as it ought to be."""
        return line_bounds_px(self.study.scan, self.prepared.places, self._lines)

    def _scatter_px(self, scan: Scene) -> Floats:
        """(2, P) px by which sensor and speckle scatter the line in a rig's light."""
        times = line_bounds_px(scan, self.prepared.places, self._lines) / self._nominal_bounds
        # Where a column holds the end of a face in one of the two, its light is not compared.
        sensor, both = np.where(np.isfinite(times), times, 1.0)
        sensor_px = sensor * self.prepared.sensor_px
        both_px = both * np.hypot(self.prepared.sensor_px, self.prepared.speckle_px)
        return np.stack([sensor_px, np.sqrt(np.maximum(both_px**2 - sensor_px**2, 0.0))])

    @property
    def _across(self) -> int:
        """The coordinate of a pixel that runs across the line."""
        return 1 if self.study.scan.rig.stripe.axis == "columns" else 0

    def _true_line(self, scan: Scene, places: ScanPlaces) -> tuple[Floats, Floats]:
        """(P, 2) px where the line truly is, and (P, 3) mm, world frame."""
        parts = [_in_state(scan, select(places, here)) for here in alike(scan, places)]
        points_head, true_mm = lit_points(parts)
        return seen_together([part.scene for part in parts], points_head), true_mm

    def _reading(self, board: Scene, seeds: Mapping[str, int], stream: int) -> BoardReading:
        """What the instrument reads of the board in a state of the rig."""
        nominal = self.prepared.reading
        image = board_truth(board).marks_px()
        image += self.prepared.marks_off_px(seeds, stream)
        marks = joined_marks(nominal)
        seen = marks.found & np.isfinite(image).all(axis=1)  # one behind the camera has no place
        status = np.where(marks.found & ~seen, Status.NOT_FOUND, marks.status)
        image_px = np.where(seen[:, np.newaxis], image, np.nan)
        moved = with_marks(nominal, replace(marks, image_px=image_px, status=status))
        return replace(moved, dots={}, rings={})

    @cached_property
    def _solver(self) -> NamedSolver:
        """The solver, beginning at the map of the rig as it ought to be where it searches."""
        solver = find_solver(self.study.calibrate.rig.calibration.plane_map)
        if not solver.searches:
            return solver
        nominal = solver.solve(self.prepared.reading, self.study.calibrate.rig.optics)
        return solver.near(nominal)

    def _errors(
        self, reading: BoardReading, frame: Pose, pixels: Floats, true_mm: Floats
    ) -> Floats:
        """(K,) errors of the line's points by the map that is solved from a reading.

        frame: of that calibration, to the head's.
        """
        sound = without_outliers(reading).reading
        plane_map = self._solver.bare(sound, self.study.calibrate.rig.optics)
        scan, places = self.study.scan, self.prepared.places
        xz = places_mm(map_for_rig(plane_map, scan.rig), pixels)
        head = frame.apply(np.column_stack([xz[:, 0], np.zeros(len(xz)), xz[:, 1]]))
        found = np.flatnonzero(np.isfinite(xz).all(axis=1))
        measured = np.full(head.shape, np.nan)
        measured[found] = into_world(scan.tank.head, head[found], places.position_mm[found])
        height = np.full(len(head), np.nan)
        height[found] = height_above(scan, select(places, found), measured[found])
        return self._frame.errors_of(measured, true_mm, height)


def alike(scan: Scene, places: ScanPlaces) -> list[slice]:
    """Which places can be looked at in one go: all, or where pictures differ those of each.

    Parameters
    ----------
    scan : Scene
    places : ScanPlaces, picture by picture
    """
    if not is_changing(scan):
        return [slice(None)]
    ends = np.flatnonzero(np.diff(places.frame, append=-1)) + 1
    return [slice(first, end) for first, end in pairwise([0, *ends.tolist()])]


def _in_state(scan: Scene, places: ScanPlaces) -> PlacesInState:
    """Places of one moment, with the rig as it is then."""
    moment = at_moment(scan, int(places.frame[0]), float(places.position_mm[0]))
    true_at = places.position_mm
    if is_changing(scan):
        true_at = np.full(len(places.frame), moment.position_mm)
    return PlacesInState(moment.scene, places, true_at)


def seen_together(moments: Sequence[Scene], points_head: Sequence[Floats]) -> Floats:
    """(N, 2) px of points seen at several moments: all at once but where the optics differ.

    Parameters
    ----------
    moments : sequence of Scene
    points_head : sequence of (N_i, 3) array, mm, head frame, as many
    """
    cameras = [camera_of(moment) for moment in moments]
    local = [
        camera.pose.invert(points) for camera, points in zip(cameras, points_head, strict=True)
    ]
    still = [replace(camera, pose=STILL) for camera in cameras]
    optics = [(camera.lens, camera.port, camera.water_index) for camera in cameras]
    if all(one == optics[0] for one in optics):
        return image(still[0], rays_to(still[0], np.concatenate(local)).direction)
    pairs = zip(still, local, strict=True)
    return np.concatenate([image(one, rays_to(one, points).direction) for one, points in pairs])


# The rendered tier: a rig's errors with every picture rendered, exposed and read.
#
# The places are those of the geometric tier, moved along the line into the middles of the columns
# that they show in, so that what differs between the tiers is what the pictures hold: what noise,
# light and lens do to marks and line beyond what was found on the rig as it ought to be.


# Of the water of rigs, relative, up to which its light of higher orders is that of another: on the
# paper's sandwave the line's centre moves by 5e-4 px rms, by 8e-3 px at most, with half of it.
WATER_STEP = 0.01
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
        found = self._line_rows_px(states)
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

    def _line_rows_px(self, states: RigStates) -> Floats:
        """(F, N) px where the line is found in the pictures that have places."""
        scan, places = states.scan, self.prepared.places
        tank = Tank(scan, water_step=WATER_STEP)
        pictures = []
        for frame in np.unique(places.frame):
            part = select(places, places.frame == frame)
            moment = at_moment(scan, int(frame), float(part.position_mm[0]))
            tank.take(moment.scene)
            layers = tank.render(moment.position_mm)
            at_work = (SENSOR in states.seeds, SPECKLE in states.seeds)
            seed = _mix_seed(states.seeds, int(frame))
            pictures.append(picture_of_layers(moment.scene, layers, *at_work, seed))
        return centres_in(scan, pictures)

    def _reading(self, board: Scene, seeds: Mapping[str, int], stream: int) -> BoardReading:
        layers = Tank(board, water_step=WATER_STEP).render(board.rig.plan.positions_mm()[0])
        noises = (SENSOR in seeds, SPECKLE in seeds)
        picture = picture_of_layers(board, layers, *noises, _mix_seed(seeds, -stream))
        channel = board.rig.calibration.channel
        reading = read_board(picture, board.board(), channel=channel)
        if SENSOR in seeds:
            return replace(reading, dots={}, rings={})
        # Of a picture without noise a ruler's marks state a tenth of their uncertainty, the points
        # hardly less: a map that weighs them so is no map of this instrument.
        usual = joined_marks(self.prepared.reading)
        return stated_reading(reading, usual.sigma_px, usual.status)


def _mix_seed(seeds: Mapping[str, int], picture: int) -> int:
    """A seed of one picture's noise."""
    stream = [seeds.get(SENSOR, 0), seeds.get(SPECKLE, 0), abs(picture), int(picture < 0)]
    return int(np.random.SeedSequence(stream).generate_state(1)[0])
