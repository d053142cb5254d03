"""The records of the paper's whole experiment (Sec. IV), and what its board picture gives."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from lscan.acquisition.run import Run
from lscan.board import read_board
from lscan.calibration.solve import Calibration, calibrate
from lscan.measurement import BoardMeasures, GrooveMeasures, SandwaveMeasures, measure_reading
from lscan.pipeline import mean_picture, require_board
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

    camera: its driver.  simulated: whether that is known to be the tank's.
    noise: whether the simulated sensor has any.  noise_seed: None where the run states none.
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

    extractors: how the line was found, in alphabetical order; more than one where the runs
        differ.  corrected_for: "blur", "sheet thickness", or neither.
    """

    plane_map: str
    extractors: tuple[str, ...] = ()
    corrected_for: tuple[str, ...] = ()


@dataclass(frozen=True)
class BoardResult:
    """What one board picture gives: calibrations and lengths, by the plane map's full name.

    image: the mean of the run's pictures, (H, W, 3) or (H, W) uint8.
    """

    image: Bytes
    reading: BoardReading
    calibrations: Mapping[str, Calibration]
    measures: Mapping[str, BoardMeasures]


@dataclass(frozen=True)
class LinePictures:
    """Consecutive pictures of a scan, each (H, W, 3) or (H, W) uint8, and the line in the first."""

    images: Sequence[Bytes]
    stripe: Stripe


@dataclass(frozen=True)
class ControlPoints:
    """How many control points were found, and of how many.

    rms_px, max_px: their distance from the ground truth; None where that is not known.
    """

    expected: int
    found: int
    rms_px: float | None = None
    max_px: float | None = None


@dataclass(frozen=True)
class RenderCheck:
    """Distance of the line in noise-free renders from the ground truth, px.

    stripe_rms_px, stripe_max_px: of light that was scattered once.  all_orders_rms_px,
    all_orders_max_px: with the light that target and water scatter further.
    """

    stripe_rms_px: float
    stripe_max_px: float
    all_orders_rms_px: float
    all_orders_max_px: float


@dataclass(frozen=True)
class GroundTruth:
    """What only a tank in software can tell of an experiment.  yaw_deg: of the sheet."""

    control_points: ControlPoints
    render_check: RenderCheck
    yaw_deg: float


@dataclass(frozen=True)
class Experiment:
    """What the paper's experiment gave; groove and sandwave are None where not scanned.

    chain: how it was evaluated.  sources: of each run's pictures, by "board" and so on.
    shown: pictures of the line, by "groove" and "sandwave".
    best: the same pictures by the best chain, None where that was not possible, and
    best_refused then says why.  seconds: wall time spent on each part, where known.
    truth: None for real hardware.  quick: whether a tank's demo took the least effort.
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
    run : Run
        Of the board; its pictures are averaged.
    methods : sequence of str
        Full names of plane maps.

    Raises
    ------
    InputError
        Where the rig has no board.
    BoardNotFound
        Where the picture shows none.
    """
    rig = run.rig_file.rig
    board = require_board(run)
    image = mean_picture(run)
    reading = read_board(image, board, channel=rig.calibration.channel)
    calibrations = {name: calibrate(reading, name, rig.optics) for name in methods}
    measures = {
        name: measure_reading(reading, board, calibration.plane_map)
        for name, calibration in calibrations.items()
    }
    return BoardResult(image, reading, calibrations, measures)
