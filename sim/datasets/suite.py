"""A suite rendered: one render for many exposures, kept case by case, packed when all are there."""

import os
import shutil
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from lscan.errors import InputError
from lscan.files.disk import lock_folder, make_folder, read_text, write_atomically
from lscan.records import Bytes, Floats, Mask, Progress, Status
from lscan.suites import (
    CaseTruth,
    SuiteCase,
    is_written,
    open_suite,
    pack_suite,
    write_case,
    write_manifest,
)
from lscan.version import __version__
from sim.datasets.boards import exposed_board
from sim.datasets.labels import label_scene
from sim.datasets.suitespec import CaseSet, PlannedCase, SuiteSpec
from sim.scene import Scene
from sim.truth import StripeTruth, line_brightness, stripe_truth

if TYPE_CHECKING:
    from sim.render.tank import Layers

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
        There is another suite, another process makes it, or the disk refuses.
    """
    made_by = _maker(spec)
    if file.exists():
        content = open_suite(file).content
        if (content.made_by, content.seed) != (made_by, spec.seed):
            raise InputError("holds another suite", where=file, allowed="another file")
        return file
    folder = file.with_name(f"{file.name}.partial").resolve()
    make_folder(folder)
    lock = lock_folder(folder, "lscan-sim suite make")
    try:
        _keep_identity(folder / IDENTITY, f"{made_by} seed {spec.seed}\n")
        _render_missing(spec, folder, workers, progress)
        axes = [{case.name: of.axes_of(case) for case in of.cases()} for of in spec.case_sets]
        write_manifest(folder, spec.file.name, spec.seed, made_by, *axes)
        pack_suite(folder, file)
        shutil.rmtree(folder, ignore_errors=True)
    finally:
        os.close(lock)
    return file


def _maker(spec: SuiteSpec) -> str:
    """What the bytes depend on beside the seed: the version, the spec, photons of quick tables."""
    from sim.render.spreads import MOST_PHOTONS, photons_asked_for

    photons = photons_asked_for()
    quickly = f" {photons} photons" if photons != MOST_PHOTONS else ""
    return f"lscan {__version__} {spec.sha256[:16]}{quickly}"


def _keep_identity(file: Path, identity: str) -> None:
    if not file.exists():
        write_atomically(file, identity.encode())
    elif read_text(file) != identity:
        allowed = "another file, or its removal"
        raise InputError("holds the cases of another suite", where=file.parent, allowed=allowed)


def _render_missing(
    spec: SuiteSpec,
    folder: Path,
    workers: int | Literal["none"],
    progress: Progress | None,
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
    from sim.render.tank import Tank

    scene = task.among.scene(task.first)
    position_mm = scene.rig.plan.start_mm
    layers = Tank(scene).render(position_mm)
    if task.among.kind == "board":
        for case in task.cases:
            write_case(task.folder, exposed_board(task.among, case, layers))
        return ""
    lines = range(len(scene.tank.laser.sheets) if scene.tank.laser.on else 1)
    truths = [stripe_truth(scene, position_mm, line) for line in lines]
    for case in task.cases:
        exposed = _exposed(task.among, case, layers, truths)
        turned = exposed.axes["lines"] == "rows"
        write_case(task.folder, _turned(exposed) if turned else exposed)
    return ""


def _exposed(
    among: CaseSet, case: PlannedCase, layers: "Layers", truths: Sequence[StripeTruth]
) -> SuiteCase:
    """The light of one render as the webcam of a case takes it."""
    from sim.devices import exposure_of
    from sim.sensor import Webcam

    scene = among.scene(case)
    webcam = Webcam(scene)
    exposure_ms = exposure_of(scene, webcam, layers)
    seed = scene.tank.sensor.seed
    dark = None
    if among.has_pair(case):
        none = np.zeros_like(layers.ambient)
        unlit = replace(layers, direct=none, scattered=none)
        dark = webcam.expose(unlit, exposure_ms, np.random.default_rng([seed, 2]))
    return SuiteCase(
        case.name,
        among.axes_of(case),
        webcam.expose(layers, exposure_ms, np.random.default_rng([seed, 1])),
        dark,
        label_scene(scene, scene.rig.plan.start_mm, layers, truths if scene.tank.laser.on else ()),
        _truth_of(scene, truths, exposure_ms),
        scene.rig.stripe,
    )


def _truth_of(scene: Scene, truths: Sequence[StripeTruth], exposure_ms: float) -> CaseTruth:
    """The line that [stripe] means, column by column: the first or last of several lines."""
    lights = line_brightness(scene, truths, [exposure_ms] * len(truths))
    centres = np.stack([one.centre_px for one in truths])
    shown: Mask = np.stack([one.status == Status.OK for one in truths])
    last = scene.rig.stripe.returns == "last"
    key: Floats = np.where(shown, -centres if last else centres, np.inf)
    meant, along = key.argmin(axis=0), np.arange(centres.shape[1])
    some = shown.any(axis=0)
    status = np.where(some, int(Status.OK), truths[0].status)
    several = (shown.sum(axis=0) > 1) & (scene.rig.stripe.returns == "brightest")
    hidden = np.stack([one.multiple for one in truths]).any(axis=0)  # the truth has one of them

    def of(values: Sequence[Floats]) -> Floats:
        chosen: Floats = np.stack(values)[meant, along]
        return np.where(some, chosen, np.nan)

    return CaseTruth(
        of([one.centre_px for one in truths]),
        of([one.width_px for one in lights]),
        of([one.height_dn for one in lights]),
        of([one.noise_dn for one in lights]),
        (several | hidden).astype(np.int64),
        status.astype(np.int64),
    )


def _turned(case: SuiteCase) -> SuiteCase:
    """The case as a camera sees it whose columns are the other's rows."""

    def swapped(image: Bytes) -> Bytes:
        return np.ascontiguousarray(np.swapaxes(image, 0, 1))

    return replace(
        case,
        picture=swapped(case.picture),
        dark=None if case.dark is None else swapped(case.dark),
        labels=swapped(case.labels),
        settings=case.settings.model_copy(update={"axis": "rows"}),
    )
