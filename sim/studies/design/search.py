"""Which rig of a catalogue: the error it is predicted to have, and NSGA-II over parts and numbers.

References
----------
Deb, Pratap, Agarwal & Meyarivan, IEEE Trans. Evolutionary Computation 6, 182 (2002): NSGA-II
and its constrained domination; here as Optuna's sampler.
"""

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from math import isfinite, pi, sqrt
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lscan.board.lattice import RIM_EVIDENCE
from lscan.calibration.marks import all_marks, joined_marks
from lscan.config.documents import Document, by_content, merge
from lscan.config.rig import parse_rig
from lscan.errors import InputError, LscanError, MeasurementError
from lscan.files.disk import json_text, read_json, write_json
from lscan.records import Floats, Marks, Mask, Progress, has_value, select
from sim.meshes.parts import reflectance_at
from sim.scene import Scene, scene_of
from sim.scene.instrument import FULL_SCALE_DN
from sim.sensor.radiometry import AMBIENT_NM, photons_per_radiance
from sim.studies.design.catalogue import (
    Catalogue,
    DesignSection,
    Figure,
    LaserClass,
    UniformNumber,
    laser_class,
    ordinal,
)
from sim.studies.design.rig import LONGEST_MS, RigDesign, document_of, measured_mm, with_exposure
from sim.studies.problem import ALL, SETS, columns, make_design
from sim.studies.rig.evaluation import GeometricRig
from sim.studies.rig.prepared import Prepared, line_bounds_px, lines_at, on_board, stated_reading
from sim.studies.rig.states import places_of, require_one_line
from sim.studies.studyfile import Looked, Study, study_of
from sim.truth import board_truth

# Whether the picture of a board tells which of its dots are seen.


def require_rim(scene: Scene) -> None:
    """Refuse a rig whose picture shows no rim of the board's dots.

    Where the picture cuts a whole board, the instrument knows a row for the first by the empty
    place beside it; where it sees neither that nor the one beside the last, it does not know which
    rows it sees.

    Parameters
    ----------
    scene : Scene, its target is the board

    Raises
    ------
    MeasurementError
        Neither the first nor the last row is known by its rim, or column.
    """
    grid, camera = scene.board().grid, scene.rig.camera
    if not grid.whole:
        return
    truth = board_truth(scene)
    dots = truth.marks_px()[: grid.rows * grid.columns].reshape(grid.rows, grid.columns, 2)
    shown = truth.centres.grid.found.reshape(grid.rows, grid.columns)
    pitch_px = np.nanmedian(np.linalg.norm(np.diff(dots, axis=1), axis=-1))
    radius_px = float(pitch_px * grid.dot_diameter_mm / grid.pitch_mm / 2)
    size = np.array([camera.width_px, camera.height_px])

    def in_view(places: Floats, margin_px: float) -> Mask:
        return np.all((places >= margin_px) & (places <= size - 1 - margin_px), axis=-1)

    shown &= in_view(dots, radius_px)
    for axis, what in ((0, "rows"), (1, "columns")):
        lines = np.flatnonzero(shown.any(axis=1 - axis))
        whole = shown.shape[axis]
        if len(lines) < 2:
            raise MeasurementError(f"{len(lines)} of the {whole} {what} of dots are in view")
        p = np.moveaxis(dots, axis, 0)
        rims = ((lines[0], lines[0] + 1), (lines[-1], lines[-1] - 1))
        empty = [in_view(2 * p[rim] - p[inner], 2 * radius_px).sum() for rim, inner in rims]
        if len(lines) < whole and (np.array(empty) >= RIM_EVIDENCE).sum() != 1:
            raise MeasurementError(
                f"{len(lines)} of the {whole} {what} of dots are in view and neither end of them "
                "is: the instrument would not know which it sees"
            )


# The error that a design is predicted to have: no picture of it is rendered.
#
# The same rigs stand for every design: its causes are drawn at the same quantiles, so that designs
# differ by what they are made of, and hardly by chance.  How far line and marks scatter is taken
# from bounds of Cramér and Rao, in that design's light, times what the instrument is above them on
# pictures of the study's own rig; neither has a bias.

MOST_PLACES = Looked(pictures=4, columns=80)
"""Of a design, where the study's file asks for more; each picture of a winner is rendered."""
OF_THE_SCAN = ("name", "plan", "render", "sheet", "stripe", "target")
"""Sections that a design's scan does not share with its calibration."""
WHITE_DN = 200.0  # of a board that is well exposed, as the study's own is taken to be
BOX_PX2 = 1 / 12  # variance of a pixel's own width


@dataclass(frozen=True)
class AboveBounds:
    """How many times the bounds of Cramér and Rao an instrument's scatter is.

    Attributes
    ----------
    sensor, both : float, of the line's centre, by the sensor's noise, and by speckle with it
    marks : float, of the board's marks
    """

    sensor: float = 1.0
    both: float = 1.0
    marks: float = 1.0


AT_BOUNDS = AboveBounds()


def above_bounds(study: Study, prepared: Prepared) -> AboveBounds:
    """What pictures of a study's own rig show of its instrument: medians over places and marks.

    Parameters
    ----------
    study : Study
    prepared : Prepared, of its rig
    """
    places = prepared.places
    bounds = line_bounds_px(study.scan, places, lines_at(study.scan, places))
    found = np.stack([prepared.sensor_px, np.hypot(prepared.sensor_px, prepared.speckle_px)])
    sensor, both = np.nanmedian(found / bounds, axis=1)
    sigma, least = prepared.marks_sigma_px, marks_sigma_px(study.calibrate)
    marks = np.median((sigma / least)[sigma > 0])
    return AboveBounds(float(sensor), float(both), float(marks))


@dataclass(frozen=True)
class PredictedError:
    """Rms of the height over rigs that differ as a study's causes say; see ``ErrorOf``.

    Attributes
    ----------
    study, calibrate, scan : Document, of a study and of its two scenes
    source : str, of the study's file, for errors
    above : AboveBounds, of the study's own rig
    """

    study: Document
    calibrate: Document
    scan: Document
    source: str
    above: AboveBounds = AT_BOUNDS

    def __call__(self, document: Document) -> float:
        """Predicted error of a scene, mm.

        Parameters
        ----------
        document : Document, of the scan with the design's parts
        """
        study = self.of_design(document)
        return float(np.sqrt(self.squares(study, design_rows(study)).mean()))

    def of_design(self, document: Document) -> Study:
        """The study of a design's rig.

        Parameters
        ----------
        document : Document, of the scan with the design's parts
        """
        parts = changed_keys(document, self.scan)
        parts = {key: value for key, value in parts.items() if key not in OF_THE_SCAN}
        parts.get("camera", {}).pop("exposure_ms", None)
        base = self._scene(self.calibrate)
        board = self._scene(merge(self.calibrate, parts))
        exposure_ms = min(base.rig.camera.exposure_ms * _light(base) / _light(board), LONGEST_MS)
        board = self._scene(merge(board.document, {"camera": {"exposure_ms": exposure_ms}}))
        stated_places = self.study.get("places", {})
        own = Looked.model_validate(stated_places)
        places = {key: min(getattr(own, key), most) for key, most in MOST_PLACES}
        of_rig = {key: value for key, value in self.study.items() if key != "design"}
        return study_of({**of_rig, "places": places}, self.source, (board, self._scene(document)))

    def squares(self, study: Study, rows: Floats) -> Floats:
        """(N,) mm², mean square of the height's error over the places of each rig.

        Parameters
        ----------
        study : Study, of a design
        rows : (N, D) array
        """
        rig = GeometricRig(study, predicted_pictures(study, self.above))
        return height_squares(rig, np.stack([rig.evaluate(row) for row in rows]))

    def _scene(self, document: Document) -> Scene:
        return scene_of(parse_rig(document, source="the design", trusted=True))


def height_squares(rig: GeometricRig, values: Floats) -> Floats:
    """(N,) mm², mean square of the height's error over the places of each rig.

    Parameters
    ----------
    rig : GeometricRig
    values : (N, K) array, of its outputs
    """
    return np.asarray((values[:, columns(rig.outputs)["height"]] ** 2).mean(axis=1))


def design_rows(study: Study) -> Floats:
    """(SETS, D) rows of the rigs that stand for a design, the same for all designs of a study.

    Parameters
    ----------
    study : Study
    """
    design = make_design(study.causes, SETS, SETS, study.file.seed, study.groups)
    return design.blocks[ALL]


def predicted_pictures(study: Study, above: AboveBounds = AT_BOUNDS) -> Prepared:
    """What pictures of a rig would show: marks and line without bias, scattered above bounds.

    Parameters
    ----------
    study : Study
    above : AboveBounds, of its instrument

    Raises
    ------
    MeasurementError
        The line is seen on the board at less than half of the places, or no rim of the board is.
    """
    require_one_line(study.scan)
    require_rim(study.calibrate)
    truth = board_truth(study.calibrate).centres
    sigma = above.marks * marks_sigma_px(study.calibrate)
    reading = stated_reading(truth, sigma, joined_marks(truth).status)
    places = places_of(study.scan, study.file.places.pictures, study.file.places.columns)
    bounds = line_bounds_px(study.scan, places, lines_at(study.scan, places))
    known = np.isfinite(bounds).all(axis=0) & on_board(study, reading, places)
    if known.sum() < np.count_nonzero(~known):
        what = f"the line is seen on the board at {known.sum()} of {len(known)} places"
        raise MeasurementError(what)
    sensor, both = bounds[:, known] * [[above.sensor], [above.both]]
    none = np.zeros(len(sensor))
    return Prepared(
        places=select(places, known),
        reading=reading,
        marks_bias_px=np.zeros((len(sigma), 2)),
        marks_sigma_px=sigma,
        line_bias_px=none,
        corrected_px=none,
        sensor_px=sensor,
        speckle_px=np.sqrt(np.maximum(both**2 - sensor**2, 0.0)),
    )


def marks_sigma_px(scene: Scene) -> Floats:
    """(M,) px, least scatter of the board's marks, of u and of v.

    Of a disc of radius R and contrast C whose edge a Gaussian b blurs, in noise s of each pixel,
    it is s sqrt(2 b / (sqrt(pi) R)) / C: Fisher's information on its centre is the sum of the
    squares of the picture's slope over s², and the slope is C / b times the Gaussian.

    Parameters
    ----------
    scene : Scene, of a board that is well exposed

    References
    ----------
    Kay, Fundamentals of Statistical Signal Processing I, sec. 3.5: a signal in white noise.
    """
    tank, board = scene.tank, scene.board()
    truth = board_truth(scene).centres
    px_per_mm = _scale(truth.grid, board.grid.columns, board.grid.pitch_mm)
    sizes = [board.grid.dot_diameter_mm, *(ruler.mark_diameter_mm for ruler in board.ruler)]
    sensor = tank.sensor
    gain = FULL_SCALE_DN * sensor.gain / sensor.full_well_e
    middle = WHITE_DN / 2  # of the edges, where the information is
    noise = sqrt(
        gain**2 * (sensor.dark_noise_e**2 + sensor.dsnu_e**2)
        + gain * middle + (sensor.prnu * middle) ** 2 + BOX_PX2
    )  # fmt: skip
    plate = reflectance_at(tank.target.albedo, AMBIENT_NM)
    contrast = WHITE_DN * (1 - tank.target.mark_albedo / plate)
    blur = sqrt(tank.lens.blur_px**2 + BOX_PX2)
    bound = [
        noise / contrast * sqrt(2 * blur / (sqrt(pi) * px_per_mm * size / 2)) for size in sizes
    ]
    return np.repeat(bound, [len(marks.status) for marks in all_marks(truth)])


def _scale(grid: Marks, wide: int, pitch_mm: float) -> float:
    """Pixels of a millimetre of the board, the median of its grid's steps."""
    image = np.where(has_value(grid.status)[:, None], grid.image_px, np.nan)
    rows = image.reshape(-1, wide, 2)
    steps = np.linalg.norm(np.diff(rows, axis=1), axis=2)
    if not np.isfinite(steps).any():
        raise MeasurementError("the board is not in the picture")
    return float(np.nanmedian(steps)) / pitch_mm


def _light(scene: Scene) -> float:
    """DN of a board in a millisecond, up to what the design leaves as it is."""
    lens, sensor = scene.tank.lens, scene.tank.sensor
    photons = photons_per_radiance(lens, sensor, 1.0, AMBIENT_NM)
    return photons * sensor.gain / sensor.full_well_e


def changed_keys(document: Mapping[str, Any], base: Mapping[str, Any]) -> Document:
    """The keys of a document that are not as in the base, table by table.

    Parameters
    ----------
    document, base : mapping
    """
    found: Document = {}
    for key, value in document.items():
        own = base.get(key)
        if isinstance(value, Mapping) and isinstance(own, Mapping):
            if inner := changed_keys(value, own):
                found[key] = inner
        elif value != own:
            found[key] = value
    return found


# Which rig of a catalogue: NSGA-II over parts and numbers, and the front that it finds.
#
# References
# ----------
# Deb, Pratap, Agarwal & Meyarivan, IEEE Trans. Evolutionary Computation 6, 182 (2002): NSGA-II
# and its constrained domination; here as Optuna's sampler.


Parameters = dict[str, str | float]
NOT_ASSESSED_MM = 1e6
"""What the sampler is told of the error of a design that was not assessed, or failed."""
FAILED_EXCESS = 100.0
"""By how much a failed design breaks a limit, in the sampler's eyes: more than any of use."""


class ErrorOf(Protocol):
    """The prediction of a rig's error."""

    def __call__(self, document: Document) -> float:
        """Predicted error of a scene, mm.

        Parameters
        ----------
        document : Document, of the scene

        Raises
        ------
        LscanError
            The rig cannot be calibrated or measured with.
        """
        ...


@dataclass(frozen=True)
class DesignFigures:
    """What a design is judged by; error_mm is None where a limit was broken without it."""

    error_mm: float | None
    width_mm: float
    depth_mm: float
    cost_eur: float
    laser_class: LaserClass


@dataclass(frozen=True)
class RigTrial:
    """One design that was looked at.

    Attributes
    ----------
    number : int, from 0
    parameters : mapping, by name: sight, laser, window, track, and the free numbers
    figures : DesignFigures, None where it failed
    reason : str, why it failed or which limits it breaks; empty where it keeps them
    """

    number: int
    parameters: Parameters
    figures: DesignFigures | None
    reason: str


Judged = tuple[DesignFigures | None, str]


@dataclass(frozen=True)
class DesignProblem:
    """All that decides what a design is worth; a pure function of its parameters.

    Attributes
    ----------
    section : DesignSection
    catalogue : Catalogue
    base : Document, of the scene the parts go into, its board read in
    error_of : ErrorOf, the prediction of the error; has to be found by its name where trials are
        judged in other processes
    """

    section: DesignSection
    catalogue: Catalogue
    base: Document
    error_of: ErrorOf

    def design(self, parameters: Parameters) -> RigDesign:
        """The parts and numbers of a trial."""
        camera, lens = self.catalogue.sights[str(parameters["sight"])]
        laser, window, track = (
            next(part for part in getattr(self.catalogue, kind) if part.name == parameters[kind])
            for kind in ("laser", "window", "track")
        )
        numbers = {key: float(parameters[key]) for key in self.section.numbers}
        return RigDesign(camera, lens, laser, window, track, numbers)

    def document(self, parameters: Parameters) -> Document:
        """The scene of a trial, as it is assessed, and as a winner is rendered."""
        return self._with_exposure(document_of(self.design(parameters), self.base))

    def _with_exposure(self, document: Document) -> Document:
        return with_exposure(document, "the design") if self.section.expose else document

    def judge(self, parameters: Parameters) -> Judged:
        """Figures of a trial, None where it failed, and what is wrong with it.

        The error is predicted only where no other limit is broken: it costs most by far.

        Parameters
        ----------
        parameters : mapping, as of a RigTrial
        """
        design = self.design(parameters)
        try:
            document = document_of(design, self.base)
            scene = scene_of(parse_rig(document, source="the design", trusted=True))
            width_mm, depth_mm = measured_mm(scene)
            safety = laser_class(scene.tank.laser)
            figures = DesignFigures(None, width_mm, depth_mm, design.cost_eur, safety)
            if not self.broken(figures):
                error_mm = float(self.error_of(self._with_exposure(document)))
                if not isfinite(error_mm):
                    return None, "its predicted error is not finite"
                figures = DesignFigures(error_mm, width_mm, depth_mm, design.cost_eur, safety)
        except LscanError as error:
            return None, str(error)
        except Exception as error:  # whatever it is, the other designs are still wanted
            return None, " ".join(f"error: {type(error).__name__}: {error}".split())
        return figures, "; ".join(f"breaks the limit of {name}" for name in self.broken(figures))

    def excesses(self, figures: DesignFigures) -> dict[Figure, float]:
        """By how much each limit is broken, as far as the figures are known."""
        values = {name: getattr(figures, name) for name in self.section.limits}
        return {
            name: bound.excess(values[name])
            for name, bound in self.section.limits.items()
            if values[name] is not None
        }

    def broken(self, figures: DesignFigures) -> list[Figure]:
        """The limits that are broken."""
        return [name for name, excess in self.excesses(figures).items() if excess > 0]

    def values(self, figures: DesignFigures | None) -> list[float]:
        """The objectives, each to be minimised."""
        found = []
        for name, least in self.section.objectives:
            value = ordinal(getattr(figures, name)) if figures is not None else NOT_ASSESSED_MM
            value = value if isfinite(value) else NOT_ASSESSED_MM
            found.append(value if least or figures is None else -value)
        return found


Judge = Callable[[Parameters], Judged]
Run = Callable[[Judge, Sequence[Parameters]], Iterable[Judged]]
"""Calls a function with each of the parameters, anywhere; gives results in their order."""


def search(
    problem: DesignProblem,
    file: Path | None = None,
    run: Run = map,
    progress: Progress | None = None,
) -> list[RigTrial]:
    """All trials of the section, those that a file holds not judged again.

    The same seed gives the same trials, whoever runs them and however often they were stopped:
    a generation is drawn whole before any of it is judged.

    Parameters
    ----------
    problem : DesignProblem
    file : Path or None, JSON, written after every trial; read first where it is there
    run : Run, ``map`` by default
    progress : called with how many trials are done, and how many there are

    Raises
    ------
    InputError
        The file holds trials of another search.
    """
    import optuna

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    section = problem.section
    sampler = optuna.samplers.NSGAIISampler(population_size=section.population, seed=section.seed)
    study = optuna.create_study(directions=["minimize"] * len(section.objectives), sampler=sampler)
    space = {name: _distribution(of) for name, of in section.space(problem.catalogue).items()}
    kept = _Kept(problem, file)
    trials: list[RigTrial] = []
    while len(trials) < section.trials:
        asked = [study.ask(space) for _ in range(section.population)]
        parameters = [trial.params for trial in asked]
        # Of designs that come twice, one is judged.
        new = {_key(one): one for one in parameters if _key(one) not in kept.judged}
        results = iter(run(problem.judge, list(new.values())))
        for trial, of in zip(asked, parameters, strict=True):
            judged = kept.judged[_key(of)] if _key(of) in kept.judged else next(results)
            trials.append(RigTrial(trial.number, of, *judged))
            kept.keep(trials[-1])
            if progress is not None:
                progress(len(trials), section.trials)
        for trial, done in zip(asked, trials[-len(asked) :], strict=True):
            excess = problem.excesses(done.figures) if done.figures else {}
            for name in section.limits:
                trial.set_constraint(name, excess.get(name, 0.0))
            trial.set_constraint("failed", 0.0 if done.figures else FAILED_EXCESS)
            study.tell(trial, problem.values(done.figures))
    return trials


class _Kept:
    """What is known of designs: by their parameters, and in the file."""

    def __init__(self, problem: DesignProblem, file: Path | None) -> None:
        self.judged: dict[str, Judged] = {}
        self.file, self.rows = file, dict[int, RigTrial]()
        # Of a function its name says nothing of what it does.
        error_of = problem.error_of if is_dataclass(problem.error_of) else None
        stated = (problem.section, problem.catalogue, by_content(problem.base), error_of)
        self.of = hashlib.sha256(json_text(stated).encode()).hexdigest()
        if file is not None and file.exists():
            self._read(file)

    def _read(self, file: Path) -> None:
        content = read_json(file)
        if not isinstance(content, dict) or content.get("of") != self.of:
            allowed = "a file of the same design, catalogue and scene, or none"
            raise InputError("holds trials of another search", where=file, allowed=allowed)
        for row in content["trials"]:
            figures = DesignFigures(**row["figures"]) if row["figures"] else None
            self._add(RigTrial(row["number"], row["parameters"], figures, row["reason"]))

    def _add(self, trial: RigTrial) -> None:
        self.rows[trial.number] = trial
        self.judged[_key(trial.parameters)] = (trial.figures, trial.reason)

    def keep(self, trial: RigTrial) -> None:
        """Add a trial, also to the file where it is not there yet."""
        new = trial.number not in self.rows
        self._add(trial)
        if new and self.file is not None:
            rows = [asdict(self.rows[number]) for number in sorted(self.rows)]
            write_json(self.file, {"of": self.of, "trials": rows})


def _key(parameters: Parameters) -> str:
    return json_text(sorted(parameters.items()))


def _distribution(of: Any) -> Any:
    import optuna

    if isinstance(of, UniformNumber):
        return optuna.distributions.FloatDistribution(*of.uniform)
    return optuna.distributions.CategoricalDistribution(of)


def front(values: Floats) -> Mask:
    """(N,) which of N points no other dominates.

    A point dominates another where it is as good in all objectives and better in one; of equal
    points none does.

    Parameters
    ----------
    values : (N, M) array, M objectives, each to be minimised
    """
    as_good = np.all(values[:, None] <= values[None], axis=2)
    better = np.any(values[:, None] < values[None], axis=2)
    return ~np.any(as_good & better, axis=0)


def front_of(problem: DesignProblem, trials: Sequence[RigTrial]) -> list[RigTrial]:
    """The designs that keep all limits and that none of the others dominates, each once.

    Parameters
    ----------
    problem : DesignProblem, whose limits and objectives count
    trials : sequence of RigTrial

    Returns
    -------
    list of RigTrial, by the first objective, the best first
    """
    kept = {_key(trial.parameters): trial for trial in reversed(trials) if not trial.reason}
    if not kept:
        return []
    good = list(kept.values())
    values = np.array([problem.values(trial.figures) for trial in good])
    best = [(tuple(values[i]), good[i].number, good[i]) for i in np.flatnonzero(front(values))]
    return [trial for *_, trial in sorted(best, key=lambda item: item[:2])]
