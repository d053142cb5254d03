"""The results of a study: kept row by row in a folder, and its answers as files and back."""

import hashlib
import json
import logging
import os
import sqlite3
import time
import traceback
import zlib
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Protocol, Self

import numpy as np
from pydantic import TypeAdapter, ValidationError

from lscan.config.documents import by_content
from lscan.errors import DiskError, InputError, LscanError
from lscan.files.containers import NetcdfArray, netcdf_bytes
from lscan.files.disk import disk_errors, make_folder, read_text, write_atomically, write_json
from lscan.records import Floats
from lscan.version import __version__
from sim.studies.budget import CauseFacts, StudyResults, StudyRuns
from sim.studies.executor import keep_identity, locked_folder, read_identity, require_same
from sim.studies.page import comparison_text, render_page
from sim.studies.problem import AGAIN, ALL, Design, Output, StudyProblem, columns, width
from sim.studies.rig.states import correlate, share_of
from sim.studies.studyfile import Cause, Study

# The results of a study in a folder: each row's errors once, whenever and wherever it was run.
#
# ``manifest.json`` says what was evaluated; ``results.db`` is an SQLite database with a record for
# each row that was.  A record is found by its row's own bytes, so that neither the order of the
# rows nor that of their arrival matters, and a design that grows keeps what it has.  What a killed
# process left half written is not there when the database is opened; a record carries a checksum,
# which SQLite does not, against disks that change what they keep.

MANIFEST = "manifest.json"
RECORDS, FORMER = "results.db", "results.bin"
OK: Final = "ok"
OTHER = "the results of another study"
TABLE = """CREATE TABLE IF NOT EXISTS results
    (row BLOB PRIMARY KEY, status TEXT NOT NULL, numbers BLOB NOT NULL, checksum INTEGER NOT NULL)
"""
# The folder is locked: without others there is no need of shared memory, which networks have not.
SETTINGS = "locking_mode = EXCLUSIVE", "journal_mode = WAL", "synchronous = FULL"
_FULL_OR_FAILED = sqlite3.SQLITE_FULL, sqlite3.SQLITE_IOERR

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StudyIdentity:
    """What a row's results depend on beside the row itself.

    Attributes
    ----------
    document : mapping, of JSON types: all that the problem was made from
    causes : tuple of str, D names
    outputs : tuple of Output, whose sizes sum up to K
    version : str, of lscan
    """

    document: Mapping[str, Any]
    causes: tuple[str, ...]
    outputs: tuple[Output, ...]
    version: str = __version__

    def as_json(self) -> dict[str, Any]:
        """It as the manifest holds it."""
        return {
            "document": dict(self.document),
            "causes": list(self.causes),
            "outputs": [asdict(output) for output in self.outputs],
            "version": self.version,
        }

    @property
    def sha256(self) -> str:
        """In hexadecimal; the order of the document's keys is of no account."""
        text = json.dumps(self.as_json(), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Results:
    """What became of N rows.

    Attributes
    ----------
    values : (N, K) array, of each row's errors, NaN where it has none
    status : tuple of N str, ``OK`` or what kept the row from being evaluated, in one line
    """

    values: Floats
    status: tuple[str, ...]


@dataclass(frozen=True)
class Batch:
    """What became of n rows that one worker evaluated.

    Attributes
    ----------
    rows : (n, D) array
    results : Results
    seconds : float, that evaluating took, s
    traces : mapping, the traceback of each status that no rig explains, but a fault of the program
    """

    rows: Floats
    results: Results
    seconds: float
    traces: Mapping[str, str] = field(default_factory=dict)


def canonical_rows(rows: Floats) -> Floats:
    """(N, D) rows with one kind of zero and of NaN, so that equal rows have equal bytes.

    Parameters
    ----------
    rows : (N, D) array
    """
    return np.where(np.isnan(rows), np.nan, rows).astype("<f8") + 0.0


def distinct_rows(rows: Floats) -> Floats:
    """(M, D) the rows without repetitions, canonical, in the order in which they first stand.

    Parameters
    ----------
    rows : (N, D) array
    """
    first = {row.tobytes(): n for n, row in reversed(list(enumerate(canonical_rows(rows))))}
    return canonical_rows(rows)[sorted(first.values())]


class ResultStore:
    """A folder of results that is open, locked so that two studies cannot mix.

    Made by ``open_store``; use it in a ``with`` statement.

    Parameters
    ----------
    folder : Path
    identity : StudyIdentity
    database : sqlite3.Connection, of RECORDS in the folder
    held : ExitStack, closed with the store
    """

    def __init__(
        self, folder: Path, identity: StudyIdentity, database: sqlite3.Connection, held: ExitStack
    ) -> None:
        self.folder, self.identity, self.database = folder, identity, database
        self._held = held

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Let go of the folder; an error of the block, or Ctrl-C, gets a note of what is kept."""
        with self._held, suppress(sqlite3.Error):
            if isinstance(error, (LscanError, KeyboardInterrupt)):
                error.add_note(f"{len(self)} rows are kept in {self.folder}; go on with --resume")

    def __len__(self) -> int:
        """How many distinct rows have a result."""
        return int(self.database.execute("SELECT count(*) FROM results").fetchone()[0])

    def close(self) -> None:
        """Let go of the folder; closing twice is harmless."""
        self._held.close()

    def missing(self, rows: Floats) -> Floats:
        """(M, D) the distinct rows that have no result yet, in their order.

        Parameters
        ----------
        rows : (N, D) array
        """
        once = distinct_rows(rows)
        return once[[self._found(row) is None for row in once]]

    def append(self, batches: Iterable[Batch]) -> None:
        """Keep what became of rows; when this returns, it is on disk, synced.

        Parameters
        ----------
        batches : of canonical rows

        Raises
        ------
        InputError
            The disk refuses; what was kept before stays whole.
        """
        with _database_errors(self.folder), self.database:
            for batch in batches:
                found = batch.results
                for row, values, status in zip(batch.rows, found.values, found.status, strict=True):
                    content = row.tobytes(), status, values.astype("<f8").tobytes()
                    written = *content, _checksum(*content)
                    self.database.execute("REPLACE INTO results VALUES (?, ?, ?, ?)", written)

    def results(self, rows: Floats) -> Results:
        """What became of rows that all have a result.

        Parameters
        ----------
        rows : (N, D) array, in any order, with repetitions or without

        Raises
        ------
        InputError
            The file cannot be read.
        KeyError
            A row has no result.
        """
        values = np.full((len(rows), width(self.identity.outputs)), np.nan)
        status = []
        for n, row in enumerate(canonical_rows(rows)):
            if (found := self._found(row)) is None:
                raise KeyError(row)
            status.append(found[0])
            if found[0] == OK:
                values[n] = np.frombuffer(found[1], "<f8")
        return Results(values, tuple(status))

    def _found(self, row: Floats) -> tuple[str, bytes] | None:
        """Status and values of a canonical row."""
        with _database_errors(self.folder):
            sought = "SELECT status, numbers FROM results WHERE row = ?"
            found: tuple[str, bytes] | None = self.database.execute(
                sought, (row.tobytes(),)
            ).fetchone()
        return found


def open_store(folder: Path, identity: StudyIdentity) -> ResultStore:
    """The results that a folder has, to be read and added to; an empty one where it has none.

    Parameters
    ----------
    folder : Path, made where it is missing
    identity : StudyIdentity, of the study whose results they are

    Raises
    ------
    InputError
        The folder has results of another study or of an earlier lscan, another process writes to
        it, or the disk refuses.
    """
    file = folder / RECORDS
    with ExitStack() as stack:
        stack.enter_context(locked_folder(folder, "study"))
        _refuse_former(folder)
        whose = {**identity.as_json(), "sha256": identity.sha256}
        what, allowed = OTHER, f"{identity.sha256}, which is this study; or another folder"
        manifest = folder / MANIFEST
        keep_identity(manifest, whose, what, allowed, begun=manifest.exists())
        with disk_errors(file):  # in the system's own words; SQLite would follow a link
            flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            os.close(os.open(file, flags, 0o666))
        with _database_errors(folder):
            database = stack.enter_context(closing(sqlite3.connect(file)))
            for setting in SETTINGS:
                database.execute(f"PRAGMA {setting}")
            database.execute(TABLE)
            every = database.execute("SELECT rowid, row, status, numbers, checksum FROM results")
            damaged = [(n,) for n, *content, checksum in every if _checksum(*content) != checksum]
            if damaged:  # by a disk that changed them since: they are evaluated again
                _log.warning(
                    "%s: %d rows are damaged, and will be evaluated again", file, len(damaged)
                )
                with database:
                    database.executemany("DELETE FROM results WHERE rowid = ?", damaged)
        return ResultStore(folder, identity, database, stack.pop_all())


def _checksum(row: bytes, status: str, numbers: bytes) -> int:
    return zlib.crc32(b"".join((row, status.encode(), numbers)))


@contextmanager
def _database_errors(folder: Path) -> Iterator[None]:
    """Say what the disk, or SQLite, refuses, and what to do."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        kind, remedy = InputError, "make its folder writable, or choose another folder"
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in _FULL_OR_FAILED:
            kind, remedy = DiskError, "make room on the disk; check it, its quota and ulimit -f"
        raise kind(f"{error}; {remedy}", where=folder / RECORDS) from error


def _refuse_former(folder: Path) -> None:
    if (folder / FORMER).exists():
        what = "holds the results of a study as an earlier lscan kept them"
        allowed = "another folder, in which the study is begun anew; or that lscan"
        raise InputError(what, where=folder, allowed=allowed)


def require_same_document(folder: Path, document: Mapping[str, Any]) -> None:
    """Refuse a folder that has results of another study, before anything is made for this one.

    Parameters
    ----------
    folder : Path, that may have none
    document : mapping, as that of an identity, or some of its keys

    Raises
    ------
    InputError
        The folder has results of another document or version; names where they differ first.
    """
    _refuse_former(folder)
    file = folder / MANIFEST
    if file.exists():
        kept = read_identity(file)
        document_kept = {key: kept.get("document", {}).get(key) for key in document}
        mine = {"document": dict(document), "version": __version__}
        of_both = {"document": document_kept, "version": kept.get("version")}
        require_same(of_both, mine, OTHER, file, "another folder")


# What a worker does: it makes a study's problem once, and evaluates rows.


class ProblemSource(Protocol):
    """What a problem is made from: small, and sent to each worker; a frozen record, say.

    Attributes
    ----------
    document : mapping, of JSON types: all that the problem's results depend on, but not which
        rows are looked at; of files that it names, what they hold
    """

    @property
    def document(self) -> Mapping[str, Any]:
        """All that the problem's results depend on, of JSON types."""
        ...

    def make(self) -> StudyProblem:
        """Make the problem with all its heavy state: meshes, tables, compiled kernels."""
        ...


_made: dict[str, StudyProblem] = {}  # one at most: it may hold gigabytes


def identity_of(source: ProblemSource) -> StudyIdentity:
    """What the results of a source's problem depend on; this process keeps the problem.

    Parameters
    ----------
    source : ProblemSource
    """
    problem = source.make()
    identity = StudyIdentity(by_content(dict(source.document)), problem.causes, problem.outputs)
    _made.clear()
    _made[identity.sha256] = problem
    return identity


def problem_of(source: ProblemSource, sha256: str) -> StudyProblem:
    """The problem of a source, made unless this process made the same one last.

    Parameters
    ----------
    source : ProblemSource
    sha256 : str, of its identity
    """
    if sha256 not in _made:
        _made.clear()
        _made[sha256] = source.make()
    return _made[sha256]


def evaluate_rows(source: ProblemSource, sha256: str, rows: Floats) -> Batch:
    """The results of n rows; a row that cannot be evaluated has a status.

    Parameters
    ----------
    source : ProblemSource
    sha256 : str, of its identity
    rows : (n, D) array, canonical
    """
    problem = problem_of(source, sha256)
    values = np.full((len(rows), width(problem.outputs)), np.nan)
    status: list[str] = []
    traces: dict[str, str] = {}
    began_s = time.perf_counter()
    for n, row in enumerate(rows):
        try:
            errors = problem.evaluate(row.copy())
            if np.shape(errors) != values[n].shape:
                raise ValueError(f"errors of shape {np.shape(errors)} instead of {values[n].shape}")
            values[n] = errors
            status.append(OK)
        except LscanError as error:
            status.append(_one_line(str(error)))
        except Exception as error:  # whatever it is, the other rows are still wanted
            status.append(_one_line(f"error: {type(error).__name__}: {error}"))
            traces.setdefault(status[-1], traceback.format_exc())
    seconds = time.perf_counter() - began_s
    return Batch(rows, Results(values, tuple(status)), seconds, traces)


def _one_line(text: str) -> str:
    return " ".join(text.split())


# The files of a study: results.json, runs.nc with every run, and the page report.html.


RESULTS, RUNS, PAGE, AGAINST = "results.json", "runs.nc", "report.html", "against.txt"
MOST_BYTES = 2**28
"""Of results.json: a hundred fields of a thousand places with fifty causes are half of it."""
_IN_UNIT = ("base_rms", "mean", "standard_uncertainty", "range_95", "rms", "stated_rms")
"""Of a budget and of a map, what is in the output's unit; in the file the name ends in it."""
_RESULTS = TypeAdapter(StudyResults)


def write_results(folder: Path, results: StudyResults, runs: StudyRuns) -> None:
    """Write the three files into a folder, each whole or not at all; same results, same bytes.

    Where another rig was compared, the comparison is in a fourth one too, in plain text.

    Parameters
    ----------
    folder : Path, made where it is missing
    results : StudyResults
    runs : StudyRuns

    Raises
    ------
    InputError
        The disk refuses.
    """
    make_folder(folder)
    write_atomically(folder / RUNS, runs_netcdf(runs, results.name))
    write_json(folder / RESULTS, as_document(results))
    write_atomically(folder / PAGE, render_page(results).encode())
    if results.against:
        write_atomically(folder / AGAINST, f"{comparison_text(results.against)}\n".encode())


def as_document(results: StudyResults) -> dict[str, Any]:
    """What results.json holds: units in the names.

    Parameters
    ----------
    results : StudyResults
    """
    return _rename_numbers(asdict(results), lambda name, unit: (name, name + _suffix(unit)))


def load_results(folder: Path) -> StudyResults:
    """What ``write_results`` wrote to results.json.

    Parameters
    ----------
    folder : Path

    Raises
    ------
    InputError
        The file cannot be read or is not such a file.
    """
    file = folder / RESULTS
    try:
        document = json.loads(read_text(file, MOST_BYTES))
        document = _rename_numbers(document, lambda name, unit: (name + _suffix(unit), name))
        return _RESULTS.validate_python(document)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{file}: {'.'.join(map(str, first['loc']))}"
        raise InputError(first["msg"], where=where) from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise InputError("holds no results of a study", where=file) from error


def runs_netcdf(runs: StudyRuns, title: str) -> bytes:
    """Every run as NetCDF-4 after the CF conventions 1.11.

    ``number`` is (run, cause); each cause that has a unit has a variable ``value: NAME`` (run,),
    each output one ``error: NAME``, (run,) or of a field (run, place).  Names keep the study's
    words, but for "/", which NetCDF forbids.

    Parameters
    ----------
    runs : StudyRuns
    title : str, of the study
    """
    number = {"long_name": "number that the distribution's quantile is taken at", "units": "1"}
    names = np.array([cause.name for cause in runs.causes])
    data = {
        "block": _array("run", np.array(runs.blocks), long_name="what the run is for"),
        "status": _array("run", np.array(runs.statuses), long_name="ok, or the error"),
        "cause": _array("cause", names, long_name="name of the cause"),
        "number": NetcdfArray(("run", "cause"), runs.rows, number),
    }
    for k, cause in enumerate(runs.causes):
        if cause.unit is not None:
            words = f"{', '.join(cause.keys)}: {cause.distribution}, {cause.when}"
            name, unit = _variable("value", cause.name), _udunit(cause.unit)
            data[name] = _array("run", runs.physical[:, k], units=unit, long_name=words)
    for output in runs.outputs:
        values = runs.values[:, columns(runs.outputs)[output.name]]
        words = f"{output.name}, measured less true"
        attributes = {"units": _udunit(output.unit), "long_name": words}
        name = _variable("error", output.name)
        shape = ("run", _variable("place", output.name)) if output.size > 1 else ("run",)
        data[name] = NetcdfArray(shape, values if output.size > 1 else values[:, 0], attributes)
    return netcdf_bytes(data, {"title": title, "source": f"lscan {__version__}"})


def _array(dimension: str, values: np.ndarray, **attributes: str) -> NetcdfArray:
    return NetcdfArray((dimension,), values, attributes)


UNKNOWN_UNITS = ("", "px", "psu", "NTU", "e-")
"""That UDUNITS does not know, by which CF states units: there they are 1, and named in words."""


def _udunit(unit: str) -> str:
    """A unit as UDUNITS reads it, which takes "mm per 9 mm" for an area."""
    over, _, under = unit.partition(" per ")
    if under:
        return f"{over}/({under})"
    return "1" if unit in UNKNOWN_UNITS else {"deg": "degree"}.get(unit, unit)


def _variable(kind: str, name: str) -> str:
    return f"{kind}: {name}".replace("/", "_")


def _suffix(unit: str) -> str:
    """Such as ``_mm`` or ``_deg_per_m``."""
    return "_" + unit.replace("/", "_per_").replace("%", "percent").replace(" ", "_")


def _rename_numbers(document: dict[str, Any], names: Any) -> dict[str, Any]:
    """The document with the numbers in an output's unit renamed by ``names`` of name and unit."""
    causes = {cause["name"]: cause["unit"] for cause in document["causes"]}

    def changed(record: dict[str, Any], fields: tuple[str, ...], unit: str) -> dict[str, Any]:
        renamed = dict(names(field, unit) for field in fields)
        return {renamed.get(name, name): value for name, value in record.items()}

    def cause(record: dict[str, Any], unit: str) -> dict[str, Any]:
        record = changed(record, ("alone_rms",), unit)
        return changed(record, ("sensitivity",), f"{unit}/{causes.get(record['cause']) or 1}")

    def budget(record: dict[str, Any]) -> dict[str, Any]:
        unit, after = record["unit"], record["after"]
        record = record | {"causes": [cause(one, unit) for one in record["causes"]]}
        return changed(record | {"after": after and budget(after)}, _IN_UNIT, unit)

    maps = [changed(one, _IN_UNIT, one["unit"]) for one in document["maps"]]
    return document | {"outputs": [budget(one) for one in document["outputs"]], "maps": maps}


# The runs of a study with their causes' numbers, as files and budgets have them.


UNITS = {
    "_mm": "mm", "_deg": "deg", "_px": "px", "_nm": "nm", "_mw": "mW", "_ms": "ms", "_c": "°C",
    "_psu": "psu", "_ppm": "ppm", "_per_m": "1/m", "_ntu": "NTU", "_mpa": "MPa", "_e": "e-",
}  # fmt: skip


def runs_of(
    study: Study, design: Design, results: Results, outputs: tuple[Output, ...]
) -> StudyRuns:
    """The runs of a design.

    Parameters
    ----------
    study : Study
    design : Design
    results : Results, of its rows
    outputs : tuple of Output
    """
    rows, facts = design.rows, tuple(map(_facts, *zip(*study.file.cause.items(), strict=True)))
    root = study.correlation_root()
    shares = np.stack([correlate(row, root) for row in rows])
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


def joined_runs(runs: StudyRuns, rendered: StudyRuns) -> StudyRuns:
    """The runs of both tiers; the blocks of those that were rendered say so.

    Parameters
    ----------
    runs, rendered : StudyRuns, of the same study
    """
    return replace(
        runs,
        rows=np.concatenate([runs.rows, rendered.rows]),
        physical=np.concatenate([runs.physical, rendered.physical]),
        blocks=(*runs.blocks, *(f"rendered, {block}" for block in rendered.blocks)),
        values=np.concatenate([runs.values, rendered.values]),
        statuses=runs.statuses + rendered.statuses,
    )


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
