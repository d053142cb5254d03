"""The paper's whole experiment (Sec. IV): its records, its evaluations, its pictures' origin."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from lscan import pipeline
from lscan.acquisition.run import Run, Versions, software_versions
from lscan.board import read_board
from lscan.calibration.calibrate import Calibration, calibrate
from lscan.config.rig import Rig
from lscan.errors import InputError, LscanError
from lscan.paper.published import CHOSEN_MAP
from lscan.records import BoardReading, Picture, Progress, Stripe
from lscan.stripe import extract_stripe

# The records of the paper's whole experiment (Sec. IV), and what its board picture gives.

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
    image : (H, W) or (H, W, 3) array, uint8 or uint16, the mean of the run's pictures
    reading : BoardReading, px, its marks
    calibrations : mapping of Calibration, by the map's name
    measures : mapping of BoardMeasures, mm, by the map's name
    """

    image: Picture
    reading: BoardReading
    calibrations: Mapping[str, Calibration]
    measures: Mapping[str, pipeline.BoardMeasures]


@dataclass(frozen=True)
class LinePictures:
    """Consecutive pictures of a scan, and the line in the first.

    Attributes
    ----------
    images : sequence of array, (H, W) or (H, W, 3), uint8 or uint16
    stripe : Stripe, px, of the first
    """

    images: Sequence[Picture]
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
    groove: pipeline.GrooveMeasures | None = None
    sandwave: pipeline.SandwaveMeasures | None = None
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
    board = pipeline.require_board(run.rig_file)
    image = pipeline.mean_picture(run)
    with pipeline.board_expected(run):
        reading = read_board(image, board, channel=rig.calibration.channel)
    calibrations = {name: calibrate(reading, name, rig.optics) for name in methods}
    measures = {
        name: pipeline.measure_reading(reading, board, calibration.plane_map)
        for name, calibration in calibrations.items()
    }
    return BoardResult(image, reading, calibrations, measures)


# Where a report's pictures come from and what turned them into numbers, in words.
#
# A run whose camera is the tank's says so; what was played back, or came over a network, may have
# been rendered as well, but no run can know.


PARTS = ("board", "groove", "sandwave")
PAPERS_EXTRACTORS = {"centroid", "centroid-relative"}
"""Eq. (8) with the intensities as they are, or above the lowest (Sec. V.B)."""
_TANK_DRIVER = "sim"

Sources = Mapping[str, PictureSource]


def chain_versions(experiment: Experiment) -> Versions:
    """Name to version of what made an experiment's figures of its pictures.

    Parameters
    ----------
    experiment : Experiment, its chain and best chain count
    """
    chains = [one.chain for one in (experiment, experiment.best) if one is not None]
    extractors = [("lscan.extractors", name) for chain in chains for name in chain.extractors]
    return software_versions(
        [*extractors, *(("lscan.planemaps", chain.plane_map) for chain in chains)]
    )


def picture_source(run: Run) -> PictureSource:
    """Where the run's pictures come from, by the rig document that it keeps.

    Parameters
    ----------
    run : Run, of any camera
    """
    driver = run.rig_file.rig.camera.driver
    if driver != _TANK_DRIVER:
        return PictureSource(driver, simulated=False)
    sensor: object = run.rig_file.section("sensor")
    stated = sensor if isinstance(sensor, dict) else {}  # a run folder may come from anybody
    seed = stated.get("seed")
    whole = isinstance(seed, int) and not isinstance(seed, bool)
    return PictureSource(driver, True, stated.get("noise") is not False, seed if whole else None)


def note(sources: Sources, parts: Collection[str] = PARTS) -> str:
    """What a caption says of pictures of some parts; "" where none is known to be simulated.

    Such as "Simulated tank, noise seed 1."; where the others are not: "Groove: simulated tank,
    noise seed 1."

    Parameters
    ----------
    sources : mapping of PictureSource, by "board", "groove" and "sandwave"
    parts : collection of str, of these names
    """
    there = {part: source for part, source in sources.items() if part in parts}
    if not (simulated := simulated_parts(there)):
        return ""
    words = f"simulated tank, {noise_words(simulated.values())}."
    if len(simulated) < len(there):
        words = f"{' and '.join(simulated)}: {words}"
    return words[0].upper() + words[1:]


def chain_names(chain: Chain) -> tuple[str, str]:
    """What the columns of our two chains are called.

    Parameters
    ----------
    chain : Chain, the first.  It is the paper's where the line was found by the paper's rules too;
        else its map alone is.

    Examples
    --------
    >>> chain_names(Chain("graticule-2", extractors=("ml",)))
    ('Ours, paper’s map', 'Ours, best chain')
    """
    papers = set(chain.extractors) <= PAPERS_EXTRACTORS and not chain.corrected_for
    return f"Ours, paper’s {'chain' if papers else 'map'}", "Ours, best chain"


def describe_chains(experiment: Experiment) -> str:
    """What the two chains are, in two sentences, or why there is but one.

    Parameters
    ----------
    experiment : Experiment, its chain and best chain count
    """
    names = chain_names(experiment.chain)
    first, second = (name.removeprefix("Ours, ") for name in names)
    words = f"The {first}: {_describe(experiment.chain)}."
    if experiment.best is not None:
        better = _describe(experiment.best.chain)
        return f"Two chains read the same pictures. {words} The {second}: {better}."
    refused = experiment.best_refused
    return f"{words} No {second}: {refused}." if refused else words


def simulated_parts(sources: Sources) -> Sources:
    """Those of the sources that are known to be simulated."""
    return {part: source for part, source in sources.items() if source.simulated}


def noise_words(sources: Collection[PictureSource]) -> str:
    """Such as "noise seed 1"."""
    if not (noisy := [source for source in sources if source.noise]):
        return "without noise"
    if not (seeds := {source.noise_seed for source in noisy if source.noise_seed is not None}):
        return "noise seed not stated"
    return f"noise seed{'s' if len(seeds) > 1 else ''} {' and '.join(map(str, sorted(seeds)))}"


def _describe(chain: Chain) -> str:
    words = f"plane map {chain.plane_map}"
    if chain.extractors:
        words += f", line by {' and '.join(chain.extractors)}"
    if chain.corrected_for:
        words += f", corrected for {' and '.join(chain.corrected_for)}"
    return words


# The paper's experiment evaluated twice from the same pictures: by its chain and by the best.


BEST_MAP, BEST_EXTRACTOR = "refractive", "ml"


def evaluate(
    board: Run,
    groove: Run | None = None,
    sandwave: Run | None = None,
    progress: Progress | None = None,
    best: Mapping[str, Rig] | None = None,
) -> Experiment:
    """All measurements of the experiment, by the paper's map and by the best chain.

    The maps are solved from the board's run.  Both chains read the same pictures.

    Parameters
    ----------
    board, groove, sandwave : Run, scans of the three pieces; the last two may be missing
    progress : callable, optional, called with the number of the sandwave's pictures that are read,
        and of all, by both chains
    best : mapping of str to Rig, optional, "board", "groove" and "sandwave" to rigs that say how
        the best chain reads the pictures: their ``[calibration]``, ``[optics]``, ``[stripe]`` and
        ``[sheet]`` count.  By default the runs' own rigs with the map ``refractive`` and the
        extractor ``ml``; that map wants the section ``[optics]``.

    Raises
    ------
    LscanError
        What the measurements by the paper's chain raise: InputError, BoardNotFound,
        MeasurementError.  An error of the best chain is kept in ``best_refused``.

    References
    ----------
    Sec. IV of the paper.
    """
    parts = {"board": board, "groove": groove, "sandwave": sandwave}
    runs = {part: run for part, run in parts.items() if run is not None}
    experiment = replace(
        _measure(runs, METHODS, CHOSEN_MAP, _half(progress, 0)),
        sources={part: picture_source(run) for part, run in runs.items()},
        shown=_line_pictures(groove, sandwave),
    )
    try:
        better = _best_runs(runs, best)
        plane_map = better["board"].rig_file.rig.calibration.plane_map
        measured = _measure(better, (plane_map,), plane_map, _half(progress, 1))
    except LscanError as error:
        return replace(experiment, best_refused=str(error))
    return replace(experiment, best=measured)


def _measure(
    runs: Mapping[str, Run], methods: Sequence[str], chosen: str, progress: Progress | None
) -> Experiment:
    """The experiment with all ``methods`` on the board, and ``chosen`` among them for the rest."""
    board = measure_board(runs["board"], methods)
    others = {part: run for part, run in runs.items() if part != "board"}
    for run in others.values():
        size_px = board.reading.image_size
        pipeline.require_size(
            run.rig_file.rig.camera, size_px, f"from {runs['board'].path}", run.path
        )
    plane_map = board.calibrations[chosen].plane_map
    groove, sandwave = others.get("groove"), others.get("sandwave")
    return Experiment(
        scene=runs[max(runs)].rig_file.rig.name,  # the sandwave's, else the groove's
        chain=_chain(chosen, [run.rig_file.rig for run in others.values()]),
        board=board,
        groove=None if groove is None else pipeline.measure_groove(groove, plane_map),
        sandwave=None
        if sandwave is None
        else pipeline.measure_sandwave(sandwave, plane_map, progress),
    )


def _line_pictures(groove: Run | None, sandwave: Run | None) -> dict[str, LinePictures]:
    """The first picture of the groove, and of the sandwave some from the middle of its scan."""
    shown = {}
    if groove is not None:
        shown["groove"] = _pictures(groove, range(1))
    if sandwave is not None:
        first = max(0, (len(sandwave) - PICTURES_SHOWN) // 2)
        last = min(len(sandwave), first + PICTURES_SHOWN)
        shown["sandwave"] = _pictures(sandwave, range(first, last))
    return shown


def _pictures(run: Run, indices: Sequence[int]) -> LinePictures:
    frames = [run.frame(index) for index in indices]
    stripe = extract_stripe(frames[0].image, run.rig_file.rig.stripe, frames[0].background)
    return LinePictures([frame.image for frame in frames], stripe)


def _chain(plane_map: str, rigs: Sequence[Rig]) -> Chain:
    corrections = {
        "blur": any(rig.stripe.blur_px is not None for rig in rigs),
        "sheet thickness": any(rig.sheet is not None for rig in rigs),
    }
    extractors = tuple(sorted({rig.stripe.extractor for rig in rigs}))
    corrected_for = tuple(name for name, made in corrections.items() if made)
    return Chain(plane_map, extractors=extractors, corrected_for=corrected_for)


def _best_runs(runs: Mapping[str, Run], best: Mapping[str, Rig] | None) -> dict[str, Run]:
    """The runs with rigs that have them read by the best chain."""
    if best is None and "optics" not in runs["board"].rig_file.document:
        what = f"the rig file has no section [optics], which the map {BEST_MAP} starts from"
        raise InputError(what, where=runs["board"].path)
    return {
        part: _read_as(run, _best_rig(run.rig_file.rig) if best is None else best[part])
        for part, run in runs.items()
    }


def _best_rig(rig: Rig) -> Rig:
    stripe = rig.stripe.model_copy(update={"extractor": BEST_EXTRACTOR})
    calibration = rig.calibration.model_copy(update={"plane_map": BEST_MAP})
    return rig.model_copy(update={"stripe": stripe, "calibration": calibration})


def _read_as(run: Run, like: Rig) -> Run:
    """The run, its pictures to be read as those of the rig ``like``."""
    sections = ("calibration", "optics", "stripe", "sheet")
    rig = run.rig_file.rig.model_copy(update={name: getattr(like, name) for name in sections})
    return replace(run, rig_file=replace(run.rig_file, rig=rig))


def _half(progress: Progress | None, before: int) -> Progress | None:
    """Progress of the first (before = 0) or second (1) of two passes over the same pictures."""
    if progress is None:
        return None
    return lambda done, total: progress(done + before * total, 2 * total)
