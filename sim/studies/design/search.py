"""Which rig of a catalogue: NSGA-II over parts and numbers, and the front that it finds.

References
----------
Deb, Pratap, Agarwal & Meyarivan, IEEE Trans. Evolutionary Computation 6, 182 (2002): NSGA-II
and its constrained domination; here as Optuna's sampler.
"""

import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from math import isfinite
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from lscan.config.documents import Document, by_content
from lscan.config.rig import parse_rig
from lscan.errors import InputError, LscanError
from lscan.files.jsonfiles import json_text, read_json, write_json
from lscan.records import Floats, Mask, Progress
from sim.scene import scene_of
from sim.studies.design.catalogue import (
    Catalogue,
    DesignSection,
    Figure,
    LaserClass,
    UniformNumber,
    laser_class,
    ordinal,
)
from sim.studies.design.rig import RigDesign, document_of, measured_mm, with_exposure

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
