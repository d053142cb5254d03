"""A study from its file to its results: prepared, run until its indices are known, evaluated."""

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lscan.config.rigfile import parse_rig
from lscan.errors import InputError
from lscan.files.disk import make_folder, write_atomically
from lscan.records import Floats, Progress
from sim.scene import Scene, scene_of, target_pose
from sim.studies.budget import budgets_of, error_maps, scatters_of
from sim.studies.geometric import GeometricRig
from sim.studies.indices import Indices, next_base, sobol_indices
from sim.studies.prepared import Prepared, prepare
from sim.studies.records import (
    CauseFacts,
    IndexConvergence,
    OutputBudget,
    StudyResults,
    StudyRuns,
    Tolerances,
)
from sim.studies.rendered import RenderedRig
from sim.studies.results import write_results
from sim.studies.runner import cost_estimate, require_at_most, run_rows
from sim.studies.sampling import AGAIN, ALL, BASE, Design, alone, make_design
from sim.studies.states import check_keys, correlated, share_of
from sim.studies.store import Results, ResultStore, distinct, open_store
from sim.studies.studyfile import Cause, Study, Tier, load_study, study_of
from sim.studies.tolerances import (
    MOST_RUNS,
    bounded_output,
    find_tolerances,
    sizes_of,
    with_spreads,
)
from sim.studies.worker import identity_of

if TYPE_CHECKING:
    from distributed import Client

PREPARED, RUNS, TIGHTER = "prepared.npz", "runs", "tolerances"
AT_MOST = 20_000
"""Runs of a study that nobody has to agree to: ten minutes of the geometric tier."""
COUNTED = ("height",)
"""The outputs whose indices are to be known as well as the study's file asks."""
UNITS = {
    "_mm": "mm", "_deg": "deg", "_px": "px", "_nm": "nm", "_mw": "mW", "_ms": "ms", "_c": "°C",
    "_psu": "psu", "_ppm": "ppm", "_per_m": "1/m", "_ntu": "NTU", "_mpa": "MPa", "_e": "e-",
}  # fmt: skip


@dataclass(frozen=True)
class RigSource:
    """What a worker makes a study's problem from.

    Attributes
    ----------
    tier : str
    study, calibrate, scan : dict, documents: the study's own, and those of its two scenes
    prepared : bytes, as ``Prepared.packed`` gives them
    name : str, of the study's file, for errors
    """

    tier: Tier
    study: dict[str, Any]
    calibrate: dict[str, Any]
    scan: dict[str, Any]
    prepared: bytes
    name: str

    @property
    def document(self) -> Mapping[str, Any]:
        """All that the results of a row depend on."""
        counts = ("cause", "correlation", "places")
        return {
            "tier": self.tier,
            "study": {key: self.study[key] for key in counts if key in self.study},
            "calibrate": self.calibrate,
            "scan": self.scan,
            "prepared": hashlib.sha256(self.prepared).hexdigest(),
        }

    def make(self) -> GeometricRig:
        """The problem."""
        scenes = self._scene(self.calibrate), self._scene(self.scan)
        study = study_of(self.study, self.name, scenes)
        rig = RenderedRig if self.tier == "rendered" else GeometricRig
        return rig(study, Prepared.unpacked(self.prepared, study))

    def _scene(self, document: dict[str, Any]) -> Scene:
        return scene_of(parse_rig(document, source=self.name, trusted=True))


@dataclass(frozen=True)
class StudyOptions:
    """How a study is run.

    Attributes
    ----------
    workers : int, processes of this machine; "none": everything in this one
    scheduler : str or None, address of the scheduler of another cluster
    at_most : int, runs that are agreed to
    tier : str or None, in place of the file's
    resume : bool, whether a folder that holds runs of this study is gone on with
    """

    workers: int | Literal["none"] = 2
    scheduler: str | None = None
    at_most: int = AT_MOST
    tier: Tier | None = None
    resume: bool = False


def run_study(
    path: Path | str,
    output: Path,
    options: StudyOptions | None = None,
    *,
    progress: Progress | None = None,
    say: Callable[[str], None] | None = None,
) -> StudyResults:
    """Run a study and write its results.json, runs.nc and report.html.

    Parameters
    ----------
    path : Path or str
        The study's file.
    output : Path
        Folder; its ``runs`` keeps what has been computed.
    options : StudyOptions, optional
        How it is run.
    progress : callable, optional
        Called with the number of runs done and of all.
    say : callable, optional
        Told, in one line each, what is begun and how long it will take.

    Raises
    ------
    InputError
        The file is wrong; the study has more runs than were agreed to; the folder holds another
        study's runs, or this one's without ``resume``.
    LscanError
        The rig as it ought to be cannot be calibrated or scanned.
    """
    options, say = options or StudyOptions(), say or (lambda _: None)
    began = time.monotonic()
    study = load_study(path)
    check_keys(study)
    tier = options.tier or study.file.tier
    precision = study.file.precision
    smallest = _design(study, precision.base)
    bound = study.file.tolerances
    require_at_most(smallest.rows, options.at_most, more=MOST_RUNS if bound else 0)
    if (output / RUNS).exists() and not options.resume:
        raise InputError(
            "holds runs of a study", where=output / RUNS, allowed="--resume, or another folder"
        )
    make_folder(output)
    source = RigSource(
        tier,
        study.document,
        study.calibrate.document,
        study.scan.document,
        _prepared(study, output / PREPARED, say),
        str(path),
    )
    from sim.studies.cluster import open_client  # takes a second to import

    with ExitStack() as stack:
        store = stack.enter_context(open_store(output / RUNS, identity_of(source)))
        if bound:
            bounded_output(bound, store.identity.outputs, str(path))
        workers: int | Literal["none"] | Client = options.workers
        at_once = 1 if options.workers == "none" else options.workers
        cost = cost_estimate(source, smallest.rows, store, at_once)
        if options.workers != "none":
            workers = stack.enter_context(open_client(options.workers, options.scheduler))
        if cost.rows:
            say(f"{cost.rows} runs to go, {cost.row_s:.2g} s each: about {cost.seconds:.0f} s")
        base, convergence = precision.base, []
        while True:
            design = _design(study, base)
            results = run_rows(
                source,
                design.rows,
                store,
                workers,
                progress=progress,
                at_most=options.at_most,
            )
            indices = sobol_indices(design, results.values, source.make().outputs)
            convergence.append((len(design.rows), indices))
            wanted = [indices[name] for name in COUNTED]
            grown = next_base(wanted, precision.half_width, base)
            if grown is None or grown > precision.most:
                break
            if len(distinct(_design(study, grown).rows)) > options.at_most:
                say(f"{grown} samples would be more than the {options.at_most} runs agreed to")
                break
            say(f"the indices are not yet known to {precision.half_width:g}: on to {grown} samples")
            base = grown
        tolerances = _tolerances(study, source, store, indices, workers, progress, say)
        found = _results(study, tier, design, results, convergence, time.monotonic() - began, store)
    whole = replace(found[0], tolerances=tolerances)
    write_results(output, whole, found[1])
    return whole


def _design(study: Study, base: int) -> Design:
    file = study.file
    return make_design(study.causes, base, file.precision.alone, file.seed, study.groups)


def _tolerances(
    study: Study,
    source: RigSource,
    store: ResultStore,
    indices: Mapping[str, Indices],
    workers: "int | Literal['none'] | Client",
    progress: Progress | None,
    say: Callable[[str], None],
) -> Tolerances | None:
    """Those that the study's file asks for, of geometric runs; each spread has its own folder."""
    bound = study.file.tolerances
    if bound is None:
        return None
    outputs = store.identity.outputs
    groups = indices[bound.output].groups

    def sizes(factors: Mapping[str, float], rows: Floats) -> Floats:
        words = ", ".join(f"{factor:g}" for factor in sorted(set(factors.values())))
        say(f"tolerances: {len(rows)} rigs with {words} of the stated spreads")
        if source.tier == "geometric" and set(factors.values()) == {1.0}:
            results = run_rows(source, rows, store, workers, progress=progress)
            return sizes_of(results, outputs, bound.output)
        drawn = with_spreads(study.file, source.study, factors)
        tighter = replace(source, tier="geometric", study=drawn)
        identity = identity_of(tighter)
        folder = store.folder.parent / TIGHTER / identity.sha256[:16]
        with open_store(folder, identity) as own:
            results = run_rows(tighter, rows, own, workers, progress=progress)
        return sizes_of(results, outputs, bound.output)

    shares = {name: group.total.value for name, group in groups.items()}
    return find_tolerances(study.file, bound, shares, sizes)


def _prepared(study: Study, file: Path, say: Callable[[str], None]) -> bytes:
    """What pictures show of the rig as it ought to be, kept in the study's folder."""
    key = hashlib.sha256(repr((study.calibrate.document, study.scan.document, study.file.places))
                         .encode()).digest()  # fmt: skip
    if file.exists() and (kept := file.read_bytes())[: len(key)] == key:
        return kept[len(key) :]
    say("looks at pictures of the rig as it ought to be: a minute or two, once")
    packed = prepare(study).packed()
    write_atomically(file, key + packed)
    return packed


def _results(
    study: Study,
    tier: Tier,
    design: Design,
    results: Results,
    convergence: list[tuple[int, dict[str, Indices]]],
    seconds: float,
    store: ResultStore,
) -> tuple[StudyResults, StudyRuns]:
    runs = runs_of(study, design, results, store.identity.outputs)
    indices = convergence[-1][1]
    budgets = budgets_of(
        runs,
        {name: _as_tuples(found) for name, found in indices.items()},
        seed=study.file.seed,
        convergence={name: _convergence(convergence, name) for name in indices},
    )
    budgets = tuple(_with_rest(budget, indices) for budget in budgets)
    # The files, and the places, of an error map are those of the rig as it ought to be.
    places = Prepared.unpacked((store.folder.parent / PREPARED).read_bytes()[32:], study).places
    xy = target_pose(study.scan).invert(places.world_mm)[:, :2]
    fields = {output.name: xy for output in runs.outputs if output.size > 1}
    failures = Counter(status for status in results.status if status != "ok")
    notes = [f"{name}: {found.note}" for name, found in indices.items() if found.note]
    if still := without_effect(runs):
        words = f"{', '.join(still)}: without any effect in the {tier} tier"
        if tier == "geometric":
            words += "; what changes the pictures alone has one in the rendered tier"
        notes.append(words)
    counted, wanted = [indices[name] for name in COUNTED], study.file.precision.half_width
    if next_base(counted, wanted, counted[0].base):
        names = ", ".join(COUNTED)
        notes.append(
            f"The indices of {names} are not known to ± {wanted:g}, as the study asks: it ended at"
            " the most runs that it or --at-most allows"
        )
    return (
        StudyResults(
            name=study.file.name,
            source=study.document,
            tier=tier,
            seed=study.file.seed,
            runs=len(results.status),
            seconds=seconds,
            causes=runs.causes,
            outputs=budgets,
            failures=dict(failures),
            maps=error_maps(runs, fields),
            scatters=scatters_of(runs, budgets),
            notes=tuple(notes),
        ),
        runs,
    )


def runs_of(study: Study, design: Design, results: Results, outputs: tuple[Any, ...]) -> StudyRuns:
    """The runs of a design with their causes' numbers, as files and budgets have them.

    Parameters
    ----------
    study : Study
    design : Design
    results : Results, of its rows
    outputs : tuple of Output
    """
    rows, facts = design.rows, tuple(map(_facts, *zip(*study.file.cause.items(), strict=True)))
    correlations = study.correlations()
    root: Floats | None = None
    if study.file.correlation:
        root = np.asarray(np.linalg.cholesky(correlations), dtype=float)
    shares = np.stack([correlated(row, root) for row in rows])
    physical = np.full(rows.shape, np.nan)
    for column, cause in enumerate(study.file.cause.values()):
        if cause.when in ("noise", "each-frame"):
            continue
        for n in np.flatnonzero(np.isfinite(shares[:, column])):
            physical[n, column] = share_of(study, cause, float(shares[n, column]))
    names = [ALL if block == AGAIN else block for block, _ in design.labels]
    return StudyRuns(
        facts, outputs, rows, physical, tuple(names), results.values, tuple(results.status)
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


def _facts(name: str, cause: Cause) -> CauseFacts:
    has_number = cause.when in ("as-built", "drift")
    field = next((part for part in reversed(cause.key.split(".")) if not part.isdigit()), "")
    unit = next((unit for end, unit in UNITS.items() if field.endswith(end)), "1")
    return CauseFacts(
        name=name,
        when=cause.when,
        keys=(cause.key, *cause.together),
        distribution=cause.in_words,
        unit=unit if has_number else None,
        group=cause.group or "",
    )


def _as_tuples(found: Indices) -> dict[str, tuple[float, float, float, float, float, float]]:
    return {
        name: (
            group.first.value, group.first.low, group.first.high,
            group.total.value, group.total.low, group.total.high,
        )
        for name, group in found.groups.items()
    }  # fmt: skip


def _with_rest(budget: OutputBudget, indices: Mapping[str, Indices]) -> OutputBudget:
    rest = indices[budget.name].rest
    after = budget.after and _with_rest(budget.after, indices)
    return replace(budget, rest=rest if np.isfinite(rest.value) else None, after=after)


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
