"""A suite rendered: one render for many exposures, kept case by case, packed when all are there."""

import hashlib
import json
import shutil
from collections.abc import Iterator, Mapping, Sequence, Set
from contextlib import closing
from dataclasses import dataclass
from itertools import combinations, groupby
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from lscan.config.documents import Document, Strict, by_content, check, merge, read_document
from lscan.config.rig import inline_board, parse_rig
from lscan.config.scenes import included_file, spec_file
from lscan.errors import InputError
from lscan.files.disk import make_folder
from lscan.records import Progress
from lscan.suites import is_written, open_suite, pack_suite, write_case, write_manifest
from lscan.suites.content import Word
from lscan.suites.files import suite_cache
from lscan.version import __version__
from sim.datasets.cases import board_case, line_case, line_truths, turned_case
from sim.scene import Scene, scene_of
from sim.scene.instrument import Seed
from sim.studies.executor import in_order, keep_identity, locked_folder, open_workers

# What a suite is rendered from: a spec file, and the cases that cover its values pair by pair.


TRIED = 40  # combinations at random, of which the one that covers most new pairs becomes a case
EXPOSED = {"camera": {"options"}, "sensor": None, "stripe": None, "lens": {"blur_px", "glare"}}
"""Sections, and of some the keys alone, that change a picture without its being rendered anew."""
Sections = dict[str, dict[str, Any]]
Values = Annotated[dict[Word, Sections], Field(min_length=1)]
Axes = dict[Word, Values]
Combination = tuple[str, ...]  # a value on each axis
Kind = Literal["case", "board", "scan"]
KINDS: tuple[Kind, ...] = ("case", "board", "scan")
OF_THE_RIG = {
    "camera", "lens", "head", "port", "water", "sensor", "optics", "stripe", "calibration", "sheet",
}  # fmt: skip
"""Sections in which the scene of a scan's board is as that of the scan."""


class CasesFile(Strict):
    """Cases as a spec file says them.

    scene: a file or a name, which all cases start from.  pictures: how many cases.  base: sections
    of the scene that differ in every case.  render: by axis and value, sections that need another
    render.  expose: likewise, those of the same light exposed otherwise.
    """

    scene: str
    pictures: Annotated[int, Field(ge=1, le=9999)]
    base: Sections = Field(default_factory=dict)
    render: Annotated[Axes, Field(min_length=1)]
    expose: Annotated[Axes, Field(min_length=1)]

    @model_validator(mode="after")
    def _exposes_alone(self) -> Self:
        if twice := self.render.keys() & self.expose.keys():
            raise ValueError(f"render and expose: {', '.join(sorted(twice))} is an axis of both")
        for axis, values in self.expose.items():
            for value, sections in values.items():
                for section, keys in sections.items():
                    free = EXPOSED.get(section, set())
                    other = set(keys) - free if free is not None else set()
                    if other:
                        named = f"{axis}.{value}.{section}.{min(other)}"
                        raise ValueError(f"expose: {named} needs another render")
        return self


class LinesFile(CasesFile):
    """Pictures of a laser line.

    turned: every so many-th case is turned so that its line runs down; 0: none.  pairs: likewise
    has a picture with the laser off.
    """

    turned: Annotated[int, Field(ge=0)] = 0
    pairs: Annotated[int, Field(ge=0)] = 0


class ScansFile(CasesFile):
    """Whole scans; ``pictures`` counts scans.

    board: a file or a name, the scene of the board that each rig is calibrated by; of base and of
    the axes it has the sections of the instrument and of the water.
    """

    board: str


class SuiteSpecFile(Strict):
    """A suite as its file says it.

    lines: pictures of a laser line.  boards: of the calibration board.  scans: whole scans, each
    with a picture of the board.
    """

    name: Annotated[str, Field(pattern="^[a-z0-9][a-z0-9-]{0,63}$")]
    seed: Seed = 1
    lines: LinesFile | None = None
    boards: CasesFile | None = None
    scans: ScansFile | None = None

    @model_validator(mode="after")
    def _holds_some(self) -> Self:
        if self.lines is self.boards is self.scans is None:
            raise ValueError("needs one of [lines], [boards] and [scans]")
        return self


@dataclass(frozen=True)
class PlannedCase:
    """A case to be made.  name: of it.  number: from 0.  render, expose: its values on the axes."""

    name: str
    number: int
    render: Combination
    expose: Combination


@dataclass(frozen=True)
class CaseSet:
    """The cases of one kind: what their file says, their scene's document, and the suite's seed.

    kind: "case" for those of a line, "board", "scan"; their names begin so.  source: for errors.
    board: of scans, the document of the scene of the board.
    """

    kind: Kind
    file: CasesFile
    document: Document
    seed: int
    source: str
    board: Document | None = None

    def cases(self) -> list[PlannedCase]:
        """The cases: those of one render follow each other.

        Raises
        ------
        InputError
            There are fewer pictures than renders.
        """
        render, expose = self._names(self.file.render), self._names(self.file.expose)
        rng = np.random.default_rng([self.seed, 1])
        renders = list(covering(render, [], rng))
        count = self.file.pictures
        if count < len(renders):
            allowed = f"{len(renders)} or more, so that each render has one"
            raise InputError("pictures", where=self.source, value=count, allowed=allowed)
        shared = [renders[number * len(renders) // count] for number in range(count)]
        rows = covering([*render, *expose], shared, rng)
        split = len(render)
        return [
            PlannedCase(f"{self.kind}-{n:04d}", n, row[:split], row[split:])
            for n, row in enumerate(rows)
        ]

    def axes_of(self, case: PlannedCase) -> dict[str, str]:
        """The case's value on each axis.

        Parameters
        ----------
        case : PlannedCase
        """
        axes = [*self.file.render, *self.file.expose]
        own = dict(zip(axes, case.render + case.expose, strict=True))
        if isinstance(self.file, LinesFile):
            own["lines"] = "rows" if _every(self.file.turned, case) else "columns"
        return own

    def scene(self, case: PlannedCase) -> Scene:
        """The scene of a case, with the seed of its noise.

        Parameters
        ----------
        case : PlannedCase

        Raises
        ------
        InputError
            A key or a value is wrong.
        """
        where = f"{self.source}: {', '.join(case.render + case.expose)}"
        scene = self._laid_over(self.document, case, None, where)
        if self.kind == "board" and scene.tank.target.shape != "board":
            allowed = 'a scene whose target is of shape "board"'
            raise InputError("boards.scene", where=where, value=self.file.scene, allowed=allowed)
        return scene

    def board_scene(self, case: PlannedCase) -> Scene:
        """The scene of the board that the rig of a scan is calibrated by.

        Parameters
        ----------
        case : PlannedCase, of a scan

        Raises
        ------
        InputError
            A key or a value is wrong, or the scene has no board or one that is moved: a map holds
            in the frame of the head then only where it is calibrated in it.
        """
        assert self.board is not None
        where = f"{self.source}: {', '.join(case.render + case.expose)}"
        scene = self._laid_over(self.board, case, OF_THE_RIG, where)
        target = scene.tank.target
        moved = (*target.position_mm, target.turn_deg, target.tilt_x_deg, target.tilt_y_deg)
        if target.shape != "board" or any(moved):
            allowed = 'a scene whose target is of shape "board", at the origin and level'
            raise InputError("scans.board", where=where, allowed=allowed)
        return scene

    def _laid_over(
        self, document: Document, case: PlannedCase, only: Set[str] | None, where: str
    ) -> Scene:
        """The scene of a document with a case's sections; of these ``only`` some, if not None."""

        def some(sections: Mapping[str, Any]) -> Document:
            return {key: of for key, of in sections.items() if only is None or key in only}

        document = merge(document, some(self.file.base))
        for axes, values in ((self.file.render, case.render), (self.file.expose, case.expose)):
            for (_, sections), value in zip(axes.items(), values, strict=True):
                document = merge(document, some(sections[value]))
        seed = int(np.random.SeedSequence([self.seed, case.number]).generate_state(1)[0] >> 1)
        document = merge(document, {"sensor": {"seed": seed}, "render": {"seed": self.seed}})
        return scene_of(parse_rig(inline_board(document, source=where), source=where))

    @staticmethod
    def _names(axes: Mapping[str, Mapping[str, Any]]) -> list[Combination]:
        return [tuple(values) for values in axes.values()]


def _every(period: int, case: PlannedCase) -> bool:
    return period > 0 and case.number % period == period - 1


@dataclass(frozen=True)
class SuiteSpec:
    """A spec: its file, the seed of all that is random, and the cases of each kind that it has."""

    file: SuiteSpecFile
    seed: int
    case_sets: tuple[CaseSet, ...]

    @property
    def sha256(self) -> str:
        """Of all that the cases depend on but the seed: of files their content, not their place."""
        documents = [[cases.document, cases.board] for cases in self.case_sets]
        stated = by_content([self.file.model_dump(mode="json"), *documents])
        text = json.dumps(stated, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def load_suite_spec(path: Path | str, seed: int | None = None) -> SuiteSpec:
    """The spec in a TOML file, or of the name of one that comes with lscan.

    Parameters
    ----------
    path : Path or str
    seed : int or None, in place of the spec's own

    Raises
    ------
    InputError
        Names the file, the key, the value and what is allowed.
    """
    source = spec_file(path, "suite")
    file = check(SuiteSpecFile, read_document(source), where=source)
    own = file.seed if seed is None else seed

    def document(scene: str) -> Document:
        return read_document(included_file(source.parent, scene))

    case_sets = tuple(
        CaseSet(kind, of, document(of.scene), own, str(source),
                document(of.board) if isinstance(of, ScansFile) else None)
        for kind, of in zip(KINDS, (file.lines, file.boards, file.scans), strict=True)
        if of is not None
    )  # fmt: skip
    return SuiteSpec(file, own, case_sets)


def covering(
    axes: Sequence[Combination], begun: Sequence[Combination], rng: np.random.Generator
) -> Iterator[Combination]:
    """Combinations in which every pair of values of two axes occurs, few of them (greedy).

    Parameters
    ----------
    axes : sequence, the values of each
    begun : sequence, how the combinations begin, one each; where empty, as many as it takes
    rng : Generator, whose numbers they depend on

    References
    ----------
    Cohen, Dalal, Fredman, Patton: The AETG system, IEEE Transactions on Software Engineering 23
    (1997): a greedy choice from random candidates needs a number of rows that grows as the
    logarithm of the number of axes.
    """
    places = list(combinations(range(len(axes)), 2))
    missing = {(i, j, a, b) for i, j in places for a in axes[i] for b in axes[j]}
    if len(axes) == 1 and not begun:
        yield from ((value,) for value in axes[0])
        return
    number = 0
    while number < len(begun) if begun else missing:
        start = begun[number] if begun else ()
        forced = min(missing) if missing and not begun else None
        best: Combination = ()
        most: set[tuple[int, int, str, str]] = set()
        for _ in range(TRIED if missing else 1):
            drawn = [values[rng.integers(len(values))] for values in axes]
            drawn[: len(start)] = start
            if forced is not None:
                drawn[forced[0]], drawn[forced[1]] = forced[2:]
            row = tuple(drawn)
            new = {(i, j, row[i], row[j]) for i, j in places} & missing
            if not best or len(new) > len(most):
                best, most = row, new
        missing -= most
        number += 1
        yield best


# A suite rendered: one render for many exposures, kept case by case, packed when all are there.


IDENTITY = "identity.json"


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
    with locked_folder(folder, "lscan-sim suite make"):
        identity = {"made_by": made_by, "seed": spec.seed}
        what, allowed = "the cases of another suite", "another file, or its removal"
        begun = any(folder.glob("*/*"))
        keep_identity(folder / IDENTITY, identity, what, allowed, begun=begun)
        _render_missing(spec, folder, workers, progress)
        axes = {
            of.kind: {case.name: of.axes_of(case) for case in of.cases()} for of in spec.case_sets
        }
        kinds = [axes.get(kind, {}) for kind in KINDS]
        write_manifest(folder, spec.file.name, spec.seed, made_by, *kinds)
        pack_suite(folder, file)
        shutil.rmtree(folder, ignore_errors=True)
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
    if (cache := suite_cache()) is None:
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


def _render_missing(
    spec: SuiteSpec, folder: Path, workers: int | Literal["none"], progress: Progress | None
) -> None:
    tasks = [task for among in spec.case_sets for task in _tasks(among, folder)]
    count = sum(among.file.pictures for among in spec.case_sets)
    done = count - sum(len(task.cases) for task in tasks)
    if workers != "none":
        workers = min(workers, len(tasks)) if len(tasks) > 1 else "none"
    with (
        open_workers(workers) as able,
        closing(in_order(able, make_cases, tasks, lambda reason: f"its render {reason}")) as made,
    ):
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


def make_cases(task: RenderTask) -> str:
    """Render once, and write each of the cases; returns nothing.

    Parameters
    ----------
    task : RenderTask
    """
    from sim.datasets.cases import ScanScenes, scan_cases
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
        pair = isinstance(among.file, LinesFile) and _every(among.file.pairs, case)
        made = line_case(scene, case.name, axes, layers, truths, pair=pair)
        write_case(task.folder, turned_case(made) if axes["lines"] == "rows" else made)
    return ""
