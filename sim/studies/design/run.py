"""The design search of a study: trials, their front, and some of its rigs rendered."""

import hashlib
import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lscan.config.documents import Document, by_content, named_files
from lscan.config.scenes import included_file
from lscan.errors import LscanError
from lscan.files.disk import json_text, make_folder
from sim.studies.budget import DesignTrial
from sim.studies.design.catalogue import DesignSection, load_catalogue
from sim.studies.design.search import (
    DesignProblem,
    Judge,
    Judged,
    Parameters,
    PredictedError,
    RigTrial,
    Run,
    above_bounds,
    design_rows,
    front_of,
    height_squares,
    search,
)
from sim.studies.executor import in_order
from sim.studies.problem import SETS, Bounded, interval, pseudo_values
from sim.studies.results import OK, identity_of, open_store
from sim.studies.rig.prepared import Prepared
from sim.studies.running import RigSource, StudyRunning, prepared_of
from sim.studies.studyfile import Study

DESIGNS, WINNERS = "designs.json", "winners"
RIGS = 4  # of a design of the front, rendered and predicted alike: what is compared is their ratio


def design_runs(section: DesignSection) -> int:
    """Runs that a design search has, at most: those that predict, and those that are rendered.

    Parameters
    ----------
    section : DesignSection
    """
    return section.trials * SETS + section.rendered * RIGS


def design_problem(study: Study, section: DesignSection) -> DesignProblem:
    """What decides what a design of a study is worth.

    Parameters
    ----------
    study : Study
    section : DesignSection, its own

    Raises
    ------
    InputError
        The catalogue is wrong, or has no such parts.
    """
    own = section.catalogue_file
    catalogue = (
        load_catalogue(included_file(Path(study.source).parent, own)) if own else load_catalogue()
    )
    section.space(catalogue)  # refuses patterns of no part before anything is run
    # The search's own keys are told apart by it; a rig's error does not depend on them.
    causes = {key: value for key, value in study.document.items() if key != "design"}
    error_of = PredictedError(causes, study.calibrate.document, study.scan.document, study.source)
    return DesignProblem(section, catalogue, study.scan.document, error_of)


def search_designs(running: StudyRunning, problem: DesignProblem) -> tuple[DesignTrial, ...]:
    """All trials, those on the front marked, some of these rendered too.

    Parameters
    ----------
    running : StudyRunning, where the trials run and are kept
    problem : DesignProblem, of the same study
    """
    study, predict = running.study, problem.error_of
    assert isinstance(predict, PredictedError)
    above = above_bounds(study, Prepared.unpacked(running.packed, study))
    problem = replace(problem, error_of=replace(predict, above=above))
    section, file = problem.section, running.output / DESIGNS
    if not file.exists():
        running.say(_estimate(running, problem))
    trials = search(problem, file, _run(running), running.progress)
    best = front_of(problem, trials)
    spread = np.unique(np.linspace(0, len(best) - 1, min(section.rendered, len(best))).round())
    chosen = [best[int(place)] for place in spread]
    found: dict[int, tuple[float | None, Bounded | None, str]] = {}
    for done, trial in enumerate(chosen, start=1):
        running.say(f"renders design {trial.number + 1}, {done} of {len(chosen)}: {RIGS} rigs")
        found[trial.number] = _rendered_error(running, problem, trial)
    on_front = {trial.number for trial in best}
    return tuple(
        trial_of(
            problem, trial, trial.number in on_front, *found.get(trial.number, (None, None, ""))
        )
        for trial in trials
    )


def _estimate(running: StudyRunning, problem: DesignProblem) -> str:
    """How long the search will take, by the study's own rig, and how much that rig is off."""
    began_s = time.process_time()
    own_mm = problem.error_of(running.study.scan.document)
    workers = running.options.workers
    trials, at_once = problem.section.trials, 1 if workers == "none" else workers
    minutes = (time.process_time() - began_s) * trials / at_once / 60
    return (
        f"designs: {trials}, each of {SETS} rigs, without pictures: about {minutes:.2g} min; "
        f"the study's own rig is predicted to be off by {own_mm:.2g} mm"
    )


def trial_of(
    problem: DesignProblem,
    trial: RigTrial,
    on_front: bool,
    predicted_mm: float | None = None,
    rendered_mm: Bounded | None = None,
    reason: str = "",
) -> DesignTrial:
    """A trial as the results have it.

    Parameters
    ----------
    problem : DesignProblem
    trial : RigTrial
    on_front : bool
    predicted_mm, rendered_mm : float and Bounded, mm, of the rigs that were rendered
    reason : str, why it could not be rendered
    """
    figures, design = trial.figures, problem.design(trial.parameters)
    objectives: dict[str, float | str | None] = {
        "predicted error / mm": figures.error_mm if figures else None,
        "measured width / mm": figures.width_mm if figures else None,
        "depth range / mm": figures.depth_mm if figures else None,
        "cost / €": design.cost_eur,
        "laser class": figures.laser_class if figures else None,
    }
    status = trial.reason or reason or OK
    return DesignTrial(objectives, trial.parameters, on_front, status, predicted_mm, rendered_mm)


def _rendered_error(
    running: StudyRunning, problem: DesignProblem, trial: RigTrial
) -> tuple[float | None, Bounded | None, str]:
    """Predicted and rendered error of the same rigs, mm, and why there is none."""
    predict = problem.error_of
    assert isinstance(predict, PredictedError)
    try:
        study = predict.of_design(problem.document(trial.parameters))
        rows = design_rows(study)[:RIGS]
        predicted = predict.squares(study, rows)
        documents = study.document, study.calibrate.document, study.scan.document
        folder = running.output / WINNERS / _name(documents)
        make_folder(folder)
        packed = prepared_of(study, folder / "prepared.npz", running.say)
        source = RigSource("rendered", *documents, packed, study.source)
        with open_store(folder / "runs", identity_of(source)) as store:
            results = running.run(source, store, rows, agreed=True)
        good = np.array([status == OK for status in results.status])
        if good.sum() < 2:
            return None, None, next(status for status in results.status if status != OK)
        rendered = height_squares(source.make(), results.values)
    except LscanError as error:
        return None, None, str(error)
    told_mm = float(np.sqrt(predicted[good].mean()))
    # Of the same rigs in both, each a set of its own: their ratio is known better than either.
    sums = np.column_stack([np.ones(good.sum()), predicted[good], rendered[good]])
    ratio = interval(pseudo_values(sums, lambda of: np.sqrt(of[..., 2] / of[..., 1])), True)
    rendered_mm = Bounded(*(told_mm * x for x in (ratio.value, ratio.low, ratio.high)))
    own = "" if good.all() else f"{np.count_nonzero(~good)} of {len(good)} rendered rigs failed"
    return told_mm, rendered_mm, own


def _run(running: StudyRunning) -> Run:
    workers, study = running.workers, running.study
    files = named_files(study.calibrate.document) | named_files(study.scan.document)

    def run(judge: Judge, of: Sequence[Parameters]) -> Iterable[Judged]:
        return in_order(workers, judge, of, lambda status: (None, status), files=files)

    return run


def _name(documents: Iterable[Document]) -> str:
    return hashlib.sha256(json_text(by_content(list(documents))).encode()).hexdigest()[:16]
