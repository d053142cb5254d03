"""The records of the paper's whole experiment (Sec. IV), and what its board picture gives."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from lscan.acquisition.run import Run
from lscan.board import read_board
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.measurement import BoardMeasures, GrooveMeasures, SandwaveMeasures, measure_reading
from lscan.pipeline import board_expected, mean_picture, require_board
from lscan.records import BoardReading, Bytes, Stripe

METHODS = (
    "graticule-1",
    "graticule-2",
    "graticule-bspline",
    "graticule-2-norulers",
    "projective",
    "polynomial-3",
    "polynomial-5",
)
PICTURES_SHOWN = 3  # of Fig. 35


@dataclass(frozen=True)
class PictureSource:
    """Where a run's pictures come from.

    Attributes
    ----------
    camera : str, its driver
    simulated : bool, whether that is known to be the tank's
    noise : bool, whether the simulated sensor has any
    noise_seed : int or None, None where the run states none
    """

    camera: str
    simulated: bool
    noise: bool = True
    noise_seed: int | None = None

    def as_json(self) -> dict[str, Any]:
        """The entry of results.json: of a camera that is not the tank's its driver alone."""
        return asdict(self) if self.simulated else {"camera": self.camera}


@dataclass(frozen=True)
class Chain:
    """What turned pictures into lengths.

    Attributes
    ----------
    plane_map : str, full name of the map
    extractors : tuple of str, how the line was found, in alphabetical order; more than one where
        the runs differ
    corrected_for : tuple of str, "blur", "sheet thickness", or neither
    """

    plane_map: str
    extractors: tuple[str, ...] = ()
    corrected_for: tuple[str, ...] = ()


@dataclass(frozen=True)
class BoardResult:
    """What one board picture gives, by the plane map's full name.

    Attributes
    ----------
    image : (H, W) or (H, W, 3) array, uint8, DN, the mean of the run's pictures
    reading : BoardReading, px, its marks
    calibrations : mapping of Calibration, by the map's name
    measures : mapping of BoardMeasures, mm, by the map's name
    """

    image: Bytes
    reading: BoardReading
    calibrations: Mapping[str, Calibration]
    measures: Mapping[str, BoardMeasures]


@dataclass(frozen=True)
class LinePictures:
    """Consecutive pictures of a scan, and the line in the first.

    Attributes
    ----------
    images : sequence of array, (H, W) or (H, W, 3) uint8, DN
    stripe : Stripe, px, of the first
    """

    images: Sequence[Bytes]
    stripe: Stripe


@dataclass(frozen=True)
class ControlPoints:
    """How many control points were found, and of how many.

    Attributes
    ----------
    expected, found : int, their numbers
    rms_px, max_px : float or None, px, their distance from the ground truth; None where that is not
        known
    """

    expected: int
    found: int
    rms_px: float | None = None
    max_px: float | None = None


@dataclass(frozen=True)
class RenderCheck:
    """Distance of the line in noise-free renders from the ground truth.

    Attributes
    ----------
    stripe_rms_px, stripe_max_px : float, px, of light that was scattered once
    all_orders_rms_px, all_orders_max_px : float, px, with the light that target and water scatter
        further
    """

    stripe_rms_px: float
    stripe_max_px: float
    all_orders_rms_px: float
    all_orders_max_px: float


@dataclass(frozen=True)
class GroundTruth:
    """What only a tank in software can tell of an experiment.

    Attributes
    ----------
    control_points : ControlPoints, px, those in view
    render_check : RenderCheck, px
    yaw_deg : float, degrees, of the sheet against the track
    """

    control_points: ControlPoints
    render_check: RenderCheck
    yaw_deg: float


@dataclass(frozen=True)
class Experiment:
    """What the paper's experiment gave; groove and sandwave are None where not scanned.

    Attributes
    ----------
    scene : str, name of the scene
    chain : Chain, how it was evaluated
    board : BoardResult, calibrations and lengths
    groove : GrooveMeasures or None, mm
    sandwave : SandwaveMeasures or None, mm
    sources : mapping of PictureSource, of each run's pictures, by "board" and so on
    shown : mapping of LinePictures, pictures of the line, by "groove" and "sandwave"
    best : Experiment or None, the same pictures by the best chain, None where that was not possible
    best_refused : str, why there is no ``best``
    seconds : mapping of float, s, wall time spent on each part, where known
    truth : GroundTruth or None, None for real hardware
    quick : bool or None, whether a tank's demo took the least effort
    """

    scene: str
    chain: Chain
    board: BoardResult
    groove: GrooveMeasures | None = None
    sandwave: SandwaveMeasures | None = None
    sources: Mapping[str, PictureSource] = field(default_factory=dict)
    shown: Mapping[str, LinePictures] = field(default_factory=dict)
    best: "Experiment | None" = None
    best_refused: str = ""
    seconds: Mapping[str, float] = field(default_factory=dict)
    truth: GroundTruth | None = None
    quick: bool | None = None

    @property
    def control_points(self) -> ControlPoints:
        """Those found: of all that are in view where the truth is known, else of the board's."""
        if self.truth is not None:
            return self.truth.control_points
        grid = self.board.reading.grid
        return ControlPoints(len(grid.found), int(grid.found.sum()))


def measure_board(run: Run, methods: Sequence[str] = METHODS) -> BoardResult:
    """Calibrations of the run's board picture, one for each plane map, and the board's lengths.

    Parameters
    ----------
    run : Run, of the board; its pictures are averaged
    methods : sequence of str, full names of plane maps

    Raises
    ------
    InputError
        Where the rig has no board.
    BoardNotFound
        Where the picture shows none.
    MeasurementError
        Where not one distance can be measured, or a ring has fewer than four points in the sheet.

    References
    ----------
    Sec. IV.A and Tables I and II of the paper.
    """
    rig = run.rig_file.rig
    board = require_board(run.rig_file)
    image = mean_picture(run)
    with board_expected(run):
        reading = read_board(image, board, channel=rig.calibration.channel)
    calibrations = {name: calibrate(reading, name, rig.optics) for name in methods}
    measures = {
        name: measure_reading(reading, board, calibration.plane_map)
        for name, calibration in calibrations.items()
    }
    return BoardResult(image, reading, calibrations, measures)
