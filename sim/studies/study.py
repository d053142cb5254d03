"""A study from its file to its results: prepared, run until its indices are known, evaluated."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lscan.config.documents import by_content
from lscan.errors import InputError
from lscan.files.disk import make_folder
from lscan.records import Floats, Progress
from sim.scene import target_pose
from sim.studies.budget import (
    IndexConvergence,
    StudyResults,
    StudyRuns,
    TierRow,
    Tolerances,
    budgets_of,
    error_maps,
    scatters_of,
)
from sim.studies.comparison import (
    RigRuns,
    changes_of,
    compare_rigs,
    other_rig,
    restated_of,
)
from sim.studies.design.run import design_problem, design_runs, search_designs
from sim.studies.problem import (
    ALL,
    BASE,
    Design,
    Indices,
    Output,
    alone,
    columns,
    make_design,
    next_base,
    sobol_indices,
)
from sim.studies.results import (
    Results,
    ResultStore,
    distinct_rows,
    identity_of,
    joined_runs,
    open_store,
    require_same_document,
    runs_of,
    write_results,
)
from sim.studies.rig.prepared import Prepared
from sim.studies.rig.states import check_keys
from sim.studies.running import RigSource, StudyOptions, StudyRunning, prepared_of, require_at_most
from sim.studies.studyfile import Study, Tier, load_study
from sim.studies.tiers import (
    MOST_RUNS,
    alone_squares,
    bounded_output,
    find_tolerances,
    in_rendered_physics,
    pad_rows,
    rendered_design,
    sizes_of,
    tier_rows,
    with_spreads,
)

PREPARED, RUNS, RENDERED_RUNS, TIGHTER = "prepared.npz", "runs", "runs-rendered", "tolerances"
OTHERS = "against"
"""Folder of the studies of other rigs, each in one that is named after its changes."""
COUNTED = ("height",)
"""The outputs whose indices are to be known as well as the study's file asks."""
BOTH = (
    "both tiers: moments, indices and what is compared are those of rendered rigs; 95 % ranges,"
    " convergence, sensitivities and maps those of geometric ones"
)


def run_study(
    path: Path | str,
    output: Path,
    options: StudyOptions | None = None,
    *,
    against: Mapping[str, float] | None = None,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> StudyResults:
    """Run a study and write its results.json, runs.nc and report.html.

    With ``against`` it is then run once more, on the same draws, of a rig some of whose numbers are
    others; that study's files lie in a folder beneath, and against.txt has the comparison.

    Parameters
    ----------
    path : Path or str
        The study's file.
    output : Path
        Folder; its ``runs`` keeps what has been computed.
    options : StudyOptions, optional
        How it is run; ``at_most`` counts the runs of both rigs.
    against : mapping, optional
        From dotted keys of the scenes to the other rig's numbers, as ``other_rig`` takes them.
    progress : callable, optional
        Called with the number of runs done and of all.
    say : callable, optional
        Told, in one line each, what is begun and how long it will take.

    Raises
    ------
    InputError
        The file, or a number of the other rig, is wrong; the study has more runs than were agreed
        to; the folder holds another study's runs, or this one's without ``resume``.
    LscanError
        The rig as it ought to be cannot be calibrated or scanned.
    """
    options, say = options or StudyOptions(), say or (lambda _: None)
    study = load_study(path)
    check_keys(study)
    rows = _design(study, study.file.precision.base).rows
    bound, section = study.file.tolerances, study.file.design
    more = (MOST_RUNS if bound else 0) + (0 if section is None else design_runs(section))
    if not against:
        require_at_most(rows, options.at_most, more)
        return _run_in_folder(study, output, options, progress, say).results
    other = other_rig(study, against)
    check_keys(other)
    require_at_most(rows, options.at_most, more + len(distinct_rows(rows)))
    options = replace(options, at_most=options.at_most // 2)
    this = _run_in_folder(study, output, options, progress, say)
    changes = changes_of(study, other, list(against))
    name = ",".join(f"{key}={number:.12g}" for key, (_, number) in sorted(changes.items()))
    say(f"the other rig, {name}: the same draws, in {output / OTHERS / name}")
    own = _same_draws(other, len(this.found.design.blocks[ALL]))
    that = _run_in_folder(own, output / OTHERS / name, options, progress, say)
    compared = compare_rigs(
        this.found.design,
        this.rig_runs,
        that.rig_runs,
        changes,
        restated_of(study, other),
        f"{OTHERS}/{name}",
    )
    seconds = this.results.seconds + that.results.seconds
    results = replace(this.results, against=compared, seconds=seconds)
    write_results(output, results, this.runs)
    return results


@dataclass(frozen=True)
class _TierRuns:
    """A design with its results, and the indices of each smaller design and of it."""

    tier: Tier
    design: Design
    results: Results
    store: ResultStore
    convergence: list[tuple[int, dict[str, Indices]]]

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The outputs of the rows."""
        return self.store.identity.outputs


@dataclass(frozen=True)
class _DoneStudy:
    """A study with its results written; rendered: of both tiers, the second one's."""

    results: StudyResults
    runs: StudyRuns
    found: _TierRuns
    rendered: tuple[Design, Results] | None

    @property
    def rig_runs(self) -> RigRuns:
        """What its rig is compared by with another one."""
        design = self.found.design
        whole = self.rendered and pad_rows(design, self.rendered[0], self.rendered[1].values)
        return RigRuns(self.found.outputs, self.found.results.values, whole)


def _same_draws(study: Study, base: int) -> Study:
    """The study of another rig with as many samples as the first one's, and no more questions."""
    precision = study.file.precision.model_copy(update={"base": base, "most": base})
    update = {"precision": precision, "tolerances": None, "design": None}
    return replace(study, file=study.file.model_copy(update=update))


def _run_in_folder(
    study: Study,
    output: Path,
    options: StudyOptions,
    progress: Progress | None,
    say: Callable[[str], None],
) -> _DoneStudy:
    """The study run until its indices are known, and its files."""
    began = time.monotonic()
    tier, section = options.tier or study.file.tier, study.file.design
    problem = None if section is None else design_problem(study, section)
    if tier == "both":  # refused before anything is run, not after hours
        smallest = _design(study, study.file.precision.base)
        rendered_design(smallest, {}, study.file.precision.rendered)
    if (output / RUNS).exists() and not options.resume:
        what = "holds runs of a study"
        raise InputError(what, where=output / RUNS, allowed="--resume, or another folder")
    documents = study.document, study.calibrate.document, study.scan.document
    source = RigSource("rendered" if tier == "rendered" else "geometric", *documents, b"", "")
    require_same_document(output / RUNS, by_content(source.stated))
    make_folder(output)
    packed = prepared_of(study, output / PREPARED, say)
    with ExitStack() as stack:
        running = StudyRunning(study, output, options, packed, stack, progress, say)
        found = _until_known(running, "rendered" if tier == "rendered" else "geometric")
        rendered = None
        if tier == "both":  # of a geometric study's rows a part, with its results
            where = columns(found.outputs)[COUNTED[0]]
            squares = alone_squares(found.design, found.results.values[:, where])
            part = rendered_design(found.design, squares, study.file.precision.rendered)
            source, store = running.begin("rendered", RENDERED_RUNS, part.rows)
            rendered = part, running.run(source, store, part.rows)
        tolerances = _tolerances(running, found)
        trials = () if problem is None else search_designs(running, problem)
    results, runs = _results(study, tier, packed, found, rendered)
    seconds = time.monotonic() - began
    results = replace(results, tolerances=tolerances, trials=trials, seconds=seconds)
    write_results(output, results, runs)
    return _DoneStudy(results, runs, found, rendered)


def _until_known(running: StudyRunning, tier: Tier) -> _TierRuns:
    """The runs of a tier, more and more of them until the indices are known."""
    study, precision = running.study, running.study.file.precision
    base, convergence = precision.base, []
    source, store = running.begin(tier, RUNS, _design(study, base).rows)
    if study.file.tolerances:
        bounded_output(study.file.tolerances, store.identity.outputs, study.source)
    while True:
        design = _design(study, base)
        results = running.run(source, store, design.rows)
        indices = sobol_indices(design, results.values, store.identity.outputs)
        convergence.append((len(design.rows), indices))
        wanted = [indices[name] for name in COUNTED]
        grown = next_base(wanted, precision.half_width, base)
        if grown is None or grown > precision.most:
            break
        if len(distinct_rows(_design(study, grown).rows)) > running.options.at_most:
            most = running.options.at_most
            running.say(f"{grown} samples would be more than the {most} runs agreed to")
            break
        running.say(
            f"the indices are not yet known to {precision.half_width:g}: on to {grown} samples"
        )
        base = grown
    return _TierRuns(tier, design, results, store, convergence)


def _design(study: Study, base: int) -> Design:
    file = study.file
    return make_design(study.causes, base, file.precision.alone, file.seed, study.groups)


def _tolerances(running: StudyRunning, found: _TierRuns) -> Tolerances | None:
    """Those that the study's file asks for, of geometric runs; each spread has its own folder."""
    file = running.study.file
    if (bound := file.tolerances) is None:
        return None
    groups = found.convergence[-1][1][bound.output].groups
    source = running.source("geometric")

    def sizes(factors: Mapping[str, float], rows: Floats) -> Floats:
        words = ", ".join(f"{factor:g}" for factor in sorted(set(factors.values())))
        running.say(f"tolerances: {len(rows)} rigs with {words} of the stated spreads")
        if found.tier == "geometric" and set(factors.values()) == {1.0}:
            results = running.run(source, found.store, rows, agreed=True)
            return sizes_of(results, found.outputs, bound.output)
        tighter = replace(source, study=with_spreads(file, source.study, factors))
        identity = identity_of(tighter)
        folder = running.output / TIGHTER / identity.sha256[:16]
        with open_store(folder, identity) as own:
            results = running.run(tighter, own, rows, agreed=True)
        return sizes_of(results, found.outputs, bound.output)

    shares = {name: group.total.value for name, group in groups.items()}
    return find_tolerances(file, bound, shares, sizes)


def _results(
    study: Study,
    tier: Tier,
    packed: bytes,
    found: _TierRuns,
    rendered: tuple[Design, Results] | None,
) -> tuple[StudyResults, StudyRuns]:
    runs = runs_of(study, found.design, found.results, found.outputs)
    indices, every = found.convergence[-1][1], runs
    tiers: tuple[TierRow, ...] = ()
    if rendered is not None:
        values = pad_rows(found.design, rendered[0], rendered[1].values)
        both = found.design, found.results.values
        indices = sobol_indices(*both, found.outputs, values)
        tiers = tier_rows(*both, values, found.outputs)
        every = joined_runs(runs, runs_of(study, *rendered, found.outputs))
    convergence = {name: _convergence(found.convergence, name) for name in indices}
    budgets = budgets_of(runs, indices, seed=study.file.seed, convergence=convergence)
    if rendered is not None:
        budgets = tuple(in_rendered_physics(budget, indices, tiers) for budget in budgets)
    # The files, and the places, of an error map are those of the rig as it ought to be.
    places = Prepared.unpacked(packed, study).places
    xy = target_pose(study.scan).invert(places.world_mm)[:, :2]
    fields = {output.name: xy for output in runs.outputs if output.size > 1}
    notes = [f"{name}: {one.note}" for name, one in indices.items() if one.note]
    notes += _remarks(study, tier, runs, indices)
    return (
        StudyResults(
            name=study.file.name,
            source=study.document,
            tier=tier,
            seed=study.file.seed,
            runs=len(every.statuses),
            seconds=0.0,  # told at the end
            causes=runs.causes,
            outputs=budgets,
            failures=dict(Counter(status for status in every.statuses if status != "ok")),
            maps=error_maps(runs, fields),
            scatters=scatters_of(runs, budgets),
            notes=(*notes, *([BOTH] if rendered else [])),
            tiers=tiers,
        ),
        every,
    )


def without_effect(runs: StudyRuns) -> list[str]:
    """The causes, or groups, that change no value of any output where they are alone at work.

    Parameters
    ----------
    runs : StudyRuns
    """
    blocks = np.array(runs.blocks, dtype=object)
    base = runs.values[blocks == BASE]
    groups = dict.fromkeys(cause.counted_as for cause in runs.causes)
    apart = {group: runs.values[blocks == alone(group)] for group in groups}
    return [group for group, values in apart.items() if len(values) and (values == base).all()]


def _remarks(
    study: Study, tier: Tier, runs: StudyRuns, indices: Mapping[str, Indices]
) -> list[str]:
    """What a reader has to know of causes that do nothing, and of indices not known well enough."""
    notes = []
    if still := without_effect(runs):
        words = f"{', '.join(still)}: without any effect alone in the {tier} tier"
        if tier == "geometric":
            words += "; what changes the light acts there on the scatter by noise"
        notes.append(words)
    counted, wanted = [indices[name] for name in COUNTED], study.file.precision.half_width
    if next_base(counted, wanted, counted[0].base):
        names = ", ".join(COUNTED)
        notes.append(
            f"The indices of {names} are known less well than ± {wanted:g}, which the study's "
            "[precision] half_width asks for: its `most` or --at-most does not allow enough runs"
        )
    return notes


def _convergence(
    found: list[tuple[int, dict[str, Indices]]], name: str
) -> tuple[IndexConvergence, ...]:
    """The three largest total indices of an output against the number of runs."""
    last = found[-1][1][name].groups
    told = [group for group in last if np.isfinite(last[group].total.value)]
    largest = sorted(told, key=lambda group: -last[group].total.value)[:3]
    runs = tuple(count for count, _ in found)
    return tuple(
        IndexConvergence(
            group, "total", runs, tuple(one[name].groups[group].total for _, one in found)
        )
        for group in largest
    )
