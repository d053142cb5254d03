"""How and where the rows of a study are run: from what, by which workers, agreed to by whom."""

import hashlib
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from lscan.config.documents import by_content
from lscan.config.rig import parse_rig
from lscan.files.disk import read_bytes, write_atomically
from lscan.records import Floats, Progress
from lscan.version import __version__
from sim.scene import Scene, scene_of
from sim.studies.rig.evaluation import GeometricRig, RenderedRig
from sim.studies.rig.prepared import MOST_PREPARED_BYTES, Prepared, prepare
from sim.studies.run.executor import cost_estimate, run_rows
from sim.studies.run.store import Results, ResultStore, identity_of, open_store
from sim.studies.studyfile import Study, Tier, study_of

if TYPE_CHECKING:
    from distributed import Client


AT_MOST = 20_000
"""Runs of a study that nobody has to agree to: ten minutes of the geometric tier."""


@dataclass(frozen=True)
class RigSource:
    """What a worker makes a study's problem from.

    Attributes
    ----------
    tier : str, "geometric" or "rendered"
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
        return {**self.stated, "prepared": hashlib.sha256(self.prepared).hexdigest()}

    @property
    def stated(self) -> dict[str, Any]:
        """The same without what was prepared."""
        counts = ("cause", "correlation", "places")
        return {
            "tier": self.tier,
            "study": {key: self.study[key] for key in counts if key in self.study},
            "calibrate": self.calibrate,
            "scan": self.scan,
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


@dataclass
class StudyRunning:
    """How and where the rows of a study are run."""

    study: Study
    output: Path
    options: StudyOptions
    packed: bytes
    stack: ExitStack
    progress: Progress | None
    say: Callable[[str], None]
    client: "Client | None" = None

    def source(self, tier: Tier) -> RigSource:
        """What a worker makes the problem of a tier from."""
        return RigSource(
            tier,
            self.study.document,
            self.study.calibrate.document,
            self.study.scan.document,
            self.packed,
            self.study.source,
        )

    def begin(self, tier: Tier, folder: str, rows: Floats) -> tuple[RigSource, ResultStore]:
        """The source and the store of a tier's runs; says how long these rows will take."""
        source = self.source(tier)
        store = self.stack.enter_context(open_store(self.output / folder, identity_of(source)))
        at_once = 1 if self.options.workers == "none" else self.options.workers
        cost = cost_estimate(source, rows, store, at_once)
        if cost.rows:
            left = f"{cost.rows} {tier} runs to go, {cost.row_s:.2g} s each, {at_once} at a time"
            self.say(f"{left}: about {cost.seconds:.0f} s")
        return source, store

    def workers(self) -> "Client | None":
        """The cluster's client, which is started once a study; None: all in this process."""
        from sim.studies.run.executor import open_client  # takes a second to import

        workers = self.options.workers
        if workers != "none" and self.client is None:
            self.client = self.stack.enter_context(open_client(workers, self.options.scheduler))
        return self.client

    def run(
        self, source: RigSource, store: ResultStore, rows: Floats, *, agreed: bool = False
    ) -> Results:
        """The results of rows.  agreed: they were counted before."""
        return run_rows(
            source,
            rows,
            store,
            self.workers() or "none",
            progress=self.progress,
            at_most=None if agreed else self.options.at_most,
        )


def prepared_of(study: Study, file: Path, say: Callable[[str], None]) -> bytes:
    """What pictures show of the rig as it ought to be, kept in a file, packed.

    Parameters
    ----------
    study : Study
    file : Path, read where it holds this
    say : callable, told what is begun
    """
    scenes = by_content([study.calibrate.document, study.scan.document])
    key = hashlib.sha256(repr((__version__, scenes, study.file.places)).encode()).digest()
    if file.exists() and (kept := read_bytes(file, MOST_PREPARED_BYTES))[: len(key)] == key:
        return kept[len(key) :]
    say("looks at pictures of the rig as it ought to be: a minute or two, once")
    packed = prepare(study).packed()
    write_atomically(file, key + packed)
    return packed
