"""A suite rendered: one render for many exposures, kept case by case, packed when all are there."""

import os
import shutil
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Literal

from lscan.errors import InputError
from lscan.files.disk import lock_folder, make_folder, read_text, write_atomically
from lscan.records import Progress
from lscan.suites import is_written, open_suite, pack_suite, write_case, write_manifest
from lscan.suites.files import suite_cache
from lscan.version import __version__
from sim.datasets.boards import board_case
from sim.datasets.lines import line_case, line_truths, turned_case
from sim.datasets.suitespec import KINDS, CaseSet, PlannedCase, SuiteSpec

IDENTITY = "identity.txt"


@dataclass(frozen=True)
class RenderTask:
    """The cases of one render.

    among: the cases of their kind.  folder: where they are written, which all workers see.  first:
    the case whose scene is rendered, also where it is there already.
    """

    among: CaseSet
    folder: Path
    first: PlannedCase
    cases: tuple[PlannedCase, ...]


def make_suite(
    spec: SuiteSpec,
    file: Path,
    *,
    workers: int | Literal["none"] = 2,
    progress: Progress | None = None,
) -> Path:
    """Render a suite into an archive: the same bytes whatever the workers, however often ended.

    Its cases are kept in a folder beside it, ``FILE.partial``, until all are there.

    Parameters
    ----------
    spec : SuiteSpec
    file : Path, the archive
    workers : int, processes of this machine; "none": all in this process
    progress : callable or None, called with (done, all) cases

    Returns
    -------
    The archive, which is left as it is where it holds this very suite.

    Raises
    ------
    InputError
        There is another suite, another process makes it, the disk refuses, or a scene is wrong: one
        of each kind is looked at before anything is rendered.
    """
    made_by = _maker(spec)
    if file.exists():
        content = open_suite(file).content
        if (content.made_by, content.seed) != (made_by, spec.seed):
            raise InputError("holds another suite", where=file, allowed="another file")
        return file
    for among in spec.case_sets:
        for last in among.cases()[-1:]:
            among.scene(last)  # refused before anything is written
    folder = file.with_name(f"{file.name}.partial").resolve()
    make_folder(folder)
    lock = lock_folder(folder, "lscan-sim suite make")
    try:
        _keep_identity(folder / IDENTITY, f"{made_by} seed {spec.seed}\n")
        _render_missing(spec, folder, workers, progress)
        axes = {
            of.kind: {case.name: of.axes_of(case) for case in of.cases()} for of in spec.case_sets
        }
        kinds = [axes.get(kind, {}) for kind in KINDS]
        write_manifest(folder, spec.file.name, spec.seed, made_by, *kinds)
        pack_suite(folder, file)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)
    return file


def make_cached_suite(
    spec: SuiteSpec,
    name: str,
    *,
    workers: int | Literal["none"] = 2,
    progress: Progress | None = None,
    afresh: bool = False,
) -> Path:
    """As ``make_suite``, in the user's cache, where a suite of before makes room for this one.

    Parameters
    ----------
    spec : SuiteSpec
    name : str, that the suite is found by
    workers : int, processes of this machine; "none": all in this process
    progress : callable or None, called with (done, all) cases
    afresh : bool, though it is there: other code of this version may have made it

    Returns
    -------
    The archive.

    Raises
    ------
    InputError
        Another process makes it, or the disk refuses.
    """
    cache = suite_cache()
    if cache is None:
        allowed = "HOME or XDG_CACHE_HOME in a folder of one's own; or a file for the suite"
        raise InputError("there is no cache of this user's own", value=name, allowed=allowed)
    make_folder(cache)
    file = cache / f"{name}.zip"
    try:
        content = open_suite(file).content
        there = not afresh and (content.made_by, content.seed) == (_maker(spec), spec.seed)
    except InputError:  # there is none, or one that this version does not read
        there = False
    if not there:
        fresh = file.with_name(f".{file.name}")  # not found by name before it is whole
        fresh.unlink(missing_ok=True)
        make_suite(spec, fresh, workers=workers, progress=progress).replace(file)
    return file


def _maker(spec: SuiteSpec) -> str:
    """What the bytes depend on beside the seed: the version, the spec, photons of quick tables."""
    from sim.render.spreads import MOST_PHOTONS, photons_asked_for

    photons = photons_asked_for()
    quickly = f" {photons} photons" if photons != MOST_PHOTONS else ""
    return f"lscan {__version__} {spec.sha256[:16]}{quickly}"


def _keep_identity(file: Path, identity: str) -> None:
    """Write what the folder is to hold; refuse one that holds cases of something else."""
    if not file.exists() or not list(file.parent.glob("*/*")):
        write_atomically(file, identity.encode())
    elif read_text(file) != identity:
        allowed = "another file, or its removal"
        raise InputError("holds the cases of another suite", where=file.parent, allowed=allowed)


def _render_missing(
    spec: SuiteSpec, folder: Path, workers: int | Literal["none"], progress: Progress | None
) -> None:
    tasks = [task for among in spec.case_sets for task in _tasks(among, folder)]
    count = sum(among.file.pictures for among in spec.case_sets)
    done = count - sum(len(task.cases) for task in tasks)
    with closing(_made(tasks, workers)) as made:
        for task, failure in zip(tasks, made, strict=True):
            if failure:
                raise InputError(failure, where=", ".join(task.cases[0].render))
            done += len(task.cases)
            if progress is not None:
                progress(done, count)


def _tasks(among: CaseSet, folder: Path) -> list[RenderTask]:
    """One for each render of which cases are missing."""
    cases = among.cases()
    missing = [case for case in cases if not is_written(folder, case.name)]
    first = {case.render: case for case in reversed(cases)}
    shared = groupby(missing, key=lambda case: case.render)
    return [RenderTask(among, folder, first[one], tuple(group)) for one, group in shared]


def _made(
    tasks: Sequence[RenderTask], workers: int | Literal["none"]
) -> Generator[str, None, None]:
    """For each task, once it is done, what kept it from being so."""
    if workers == "none" or len(tasks) < 2:
        yield from map(make_cases, tasks)
        return
    from sim.studies.cluster import in_order, open_client  # takes a second to import

    with open_client(min(workers, len(tasks))) as client:
        yield from in_order(client, make_cases, tasks, lambda reason: f"its render {reason}")


def make_cases(task: RenderTask) -> str:
    """Render once, and write each of the cases; returns nothing.

    Parameters
    ----------
    task : RenderTask
    """
    from sim.datasets.scans import ScanScenes, scan_cases
    from sim.render.tank import Tank

    among = task.among
    if among.kind == "scan":
        first, *wanted = (
            ScanScenes(one.name, among.axes_of(one), among.board_scene(one), among.scene(one))
            for one in (task.first, *task.cases)
        )
        for scan in scan_cases(first, wanted):
            write_case(task.folder, scan)
        return ""
    scene = among.scene(task.first)
    layers = Tank(scene).render(scene.rig.plan.start_mm)
    truths = line_truths(scene) if among.kind == "case" else ()
    for case in task.cases:
        scene, axes = among.scene(case), among.axes_of(case)
        if among.kind == "board":
            write_case(task.folder, board_case(scene, case.name, axes, layers))
            continue
        pair = among.has_pair(case)
        made = line_case(scene, case.name, axes, layers, truths, pair=pair)
        write_case(task.folder, turned_case(made) if axes["lines"] == "rows" else made)
    return ""
