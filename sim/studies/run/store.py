"""The results of a study in a folder: each row's errors once, whenever and wherever it was run.

``manifest.json`` says what was evaluated; ``results.bin`` has a record for each row that was, in
the order in which they came.  A record is found by its row's own bytes, so that neither the order
of the rows nor that of their arrival matters, and a design that grows keeps what it has.  Records
carry a checksum: what a killed process left half written is cut off when the folder is opened.
"""

import hashlib
import json
import logging
import mmap
import os
import time
import traceback
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from struct import Struct
from typing import Any, Final, Protocol, Self, TypeVar

import cv2
import numpy as np
import scipy

from lscan.acquisition.run import first_difference
from lscan.config.documents import by_content
from lscan.errors import InputError, LscanError
from lscan.files.disk import (
    append_synced,
    content_sha256,
    disk_errors,
    lock_folder,
    make_folder,
    read_text,
    write_atomically,
)
from lscan.records import Floats
from lscan.version import __version__
from sim.studies.problem import Output, StudyProblem, width

MANIFEST = "manifest.json"
RECORDS = "results.bin"
OK: Final = "ok"

_HEAD = Struct("<II16s?")  # length of the content, checksum of what follows, row, whether values
_UNCHECKED = Struct("<II").size
_MANIFEST_BYTES = 2**24
_Place = tuple[int, int, bool]  # of a record's content: offset, length, whether it is values

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
        return _sha256(self.as_json())


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

    def each(self) -> Iterator[tuple[Floats, Floats, str]]:
        """Each row, its values and its status."""
        return zip(self.rows, self.results.values, self.results.status, strict=True)


def canonical(rows: Floats) -> Floats:
    """(N, D) rows with one kind of zero and of NaN, so that equal rows have equal bytes.

    Parameters
    ----------
    rows : (N, D) array
    """
    return np.where(np.isnan(rows), np.nan, rows).astype("<f8") + 0.0


def distinct(rows: Floats) -> Floats:
    """(M, D) the rows without repetitions, canonical, in the order in which they first stand.

    Parameters
    ----------
    rows : (N, D) array
    """
    first = {_key(row): n for n, row in reversed(list(enumerate(canonical(rows))))}
    return canonical(rows)[sorted(first.values())]


class ResultStore:
    """A folder of results that is open, locked so that two studies cannot mix.

    Made by ``open_store``; use it in a ``with`` statement.

    Parameters
    ----------
    folder : Path
    identity : StudyIdentity
    lock : int, descriptor of the locked folder; closed with the store
    """

    def __init__(self, folder: Path, identity: StudyIdentity, lock: int) -> None:
        self.folder, self.identity = folder, identity
        self._held = [lock]
        file = folder / RECORDS
        with disk_errors(file):
            flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC
            self._records = os.open(file, flags, 0o666)
        self._held.append(self._records)
        self._places = dict(_whole_records(self._records, file))
        self._end = _cut_torn_tail(self._records, file, self._places.values())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        """Let go of the folder; an error of the block, or Ctrl-C, gets a note of what is kept."""
        self.close()
        if isinstance(error, (LscanError, KeyboardInterrupt)):
            error.add_note(f"{len(self)} rows are kept in {self.folder}; go on with --resume")

    def __len__(self) -> int:
        """How many distinct rows have a result."""
        return len(self._places)

    def close(self) -> None:
        """Let go of the folder; closing twice is harmless."""
        while self._held:
            os.close(self._held.pop())

    def missing(self, rows: Floats) -> Floats:
        """(M, D) the distinct rows that have no result yet, in their order.

        Parameters
        ----------
        rows : (N, D) array
        """
        once = distinct(rows)
        return once[[_key(row) not in self._places for row in once]]

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
        data, places = bytearray(), {}
        for row, values, status in (result for batch in batches for result in batch.each()):
            good = status == OK
            content = values.astype("<f8").tobytes() if good else status.encode()
            key = _key(row)
            checked = _HEAD.pack(len(content), 0, key, good)[_UNCHECKED:] + content
            data += _HEAD.pack(len(content), zlib.crc32(checked), key, good) + content
            places[key] = (self._end + len(data) - len(content), len(content), good)
        append_synced(self._records, bytes(data), self.folder / RECORDS)
        self._end += len(data)
        self._places |= places

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
        with disk_errors(self.folder / RECORDS):
            for n, row in enumerate(canonical(rows)):
                place, length, good = self._places[_key(row)]
                content = os.pread(self._records, length, place)
                status.append(OK if good else content.decode())
                if good:
                    values[n] = np.frombuffer(content, "<f8")
        return Results(values, tuple(status))


def open_store(folder: Path, identity: StudyIdentity) -> ResultStore:
    """The results that a folder has, to be read and added to; an empty one where it has none.

    Parameters
    ----------
    folder : Path, made where it is missing
    identity : StudyIdentity, of the study whose results they are

    Raises
    ------
    InputError
        The folder has results of another study, another process writes to it, or the disk
        refuses.
    """
    make_folder(folder)
    lock = lock_folder(folder, "study")
    try:
        _keep_manifest(folder / MANIFEST, identity)
        return ResultStore(folder, identity, lock)
    except BaseException:
        os.close(lock)
        raise


def _keep_manifest(file: Path, identity: StudyIdentity) -> None:
    """Write what the study is, or refuse a folder that holds another one."""
    if not file.exists():
        content = {"sha256": identity.sha256, **identity.as_json()}
        write_atomically(file, f"{json.dumps(content, indent=2)}\n".encode())
        return
    _require_same(_read_manifest(file), identity.as_json(), file.parent)


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
    if (folder / MANIFEST).exists():
        content = _read_manifest(folder / MANIFEST)
        kept = {key: content["document"].get(key) for key in document}
        mine = {"document": dict(document), "version": __version__}
        _require_same({"document": kept, "version": content["version"]}, mine, folder)


def _read_manifest(file: Path) -> dict[str, Any]:
    """What a manifest says, without its checksum, which is checked."""
    try:
        content: dict[str, Any] = json.loads(read_text(file, _MANIFEST_BYTES, within=file.parent))
        if content.pop("sha256") != _sha256(content):
            raise InputError("was changed by hand", where=file, allowed="another folder")
    except (ValueError, KeyError, AttributeError, TypeError) as error:
        raise InputError(
            "is no manifest of a study", where=file, allowed="another folder"
        ) from error
    return content


def _require_same(kept: Mapping[str, Any], mine: Mapping[str, Any], folder: Path) -> None:
    differing = first_difference(kept, json.loads(json.dumps(mine)))
    if differing is not None:
        raise InputError(
            f"holds the results of another study, which differs in its {differing}",
            where=folder,
            value=_sha256(kept),
            allowed=f"{_sha256(mine)}, which is this study; or another folder",
        )


def _whole_records(descriptor: int, file: Path) -> Iterator[tuple[bytes, _Place]]:
    """Each record's row, and where its content is, up to the first that is damaged."""
    with disk_errors(file):
        size = os.fstat(descriptor).st_size
        if size == 0:
            return
        with mmap.mmap(descriptor, 0, access=mmap.ACCESS_READ) as data:
            begin = 0
            while begin + _HEAD.size <= size:
                length, checksum, key, good = _HEAD.unpack_from(data, begin)
                place = begin + _HEAD.size
                checked = data[begin + _UNCHECKED : place + length]
                begin = place + length
                if begin > size or zlib.crc32(checked) != checksum:
                    return
                yield key, (place, length, good)


def _cut_torn_tail(descriptor: int, file: Path, places: Iterable[_Place]) -> int:
    """Cut off what stands behind the last whole record; the length of what is left."""
    end = max((place + length for place, length, _ in places), default=0)
    with disk_errors(file):
        torn = os.fstat(descriptor).st_size - end
        if torn:
            _log.warning("%s: its last %d bytes are damaged and cut off", file, torn)
            os.ftruncate(descriptor, end)
            os.fsync(descriptor)
    return end


def _key(row: Floats) -> bytes:
    """What a canonical row is found by."""
    return hashlib.blake2b(row.tobytes(), digest_size=16).digest()


def _sha256(content: Mapping[str, Any]) -> str:
    """In hexadecimal, of the canonical JSON text of the content."""
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(text.encode()).hexdigest()


# What a worker does: it makes a study's problem once, and evaluates rows.
#
# Before anything else it sees to it that it has in common with its client what it must: another
# version of a package, another mesh of the same path or another disk of the same name would change
# results in silence.


Found = TypeVar("Found")


@cache
def package_versions() -> Mapping[str, str]:
    """Version, by name, of each package that the bytes of a row or a picture depend on."""
    found = {"lscan": __version__, "numpy": np.__version__}
    found |= {"scipy": scipy.__version__, "opencv": cv2.__version__}
    for name in ("mitsuba", "drjit"):
        try:
            found[name] = version(name)  # importing Mitsuba takes a second
        except PackageNotFoundError:
            found[name] = "none"
    return found


@dataclass(frozen=True)
class InCommon:
    """What a worker must have as the process has that sends it work.

    Attributes
    ----------
    versions : tuple of (name, version), of packages
    files : tuple of (path, SHA-256), of files that results depend on
    marker : Path or None, a file of a name that no other has, in the folder that is written to
    """

    versions: tuple[tuple[str, str], ...]
    files: tuple[tuple[str, str], ...] = ()
    marker: Path | None = None


def call_in_common(common: InCommon, function: Callable[..., Found], *arguments: Any) -> Found:
    """What a function gives, called on a worker.

    Parameters
    ----------
    common : InCommon
    function : callable, of the arguments

    Raises
    ------
    InputError
        The worker has something else; names the worker, what, and what it is.
    """
    if (found := _difference(common)) is not None:
        what, value, allowed = found
        where = f"the worker at {_address()}"
        raise InputError(what, where=where, value=value, allowed=allowed)
    return function(*arguments)


@lru_cache(maxsize=4)
def _difference(common: InCommon) -> tuple[str, str, str] | None:
    """What this process has not in common: what, what it has, what it is to have."""
    here = package_versions()
    for name, wanted in common.versions:
        if here[name] != wanted:
            return f"has another version of {name}", here[name], f"{wanted}, as here"
    if common.marker is not None and not common.marker.exists():
        folder = str(common.marker.parent)
        return "has another folder of the same name", folder, "a folder that both see"
    for file, wanted in common.files:
        if content_sha256(Path(file)) != wanted:
            return "has another file of the same name, or none", file, "the same as here"
    return None


def _address() -> str:
    from distributed import get_worker

    return str(get_worker().address)


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
            values[n] = _checked(problem.evaluate(row.copy()), values.shape[1])
            status.append(OK)
        except LscanError as error:
            status.append(_one_line(str(error)))
        except Exception as error:  # whatever it is, the other rows are still wanted
            status.append(_one_line(f"error: {type(error).__name__}: {error}"))
            traces.setdefault(status[-1], traceback.format_exc())
    seconds = time.perf_counter() - began_s
    return Batch(rows, Results(values, tuple(status)), seconds, traces)


def _checked(errors: Floats, size: int) -> Floats:
    """What a problem returned, where it has as many values as its outputs have."""
    if np.shape(errors) != (size,):
        raise ValueError(f"errors of shape {np.shape(errors)} instead of ({size},)")
    return errors


def _one_line(text: str) -> str:
    return " ".join(text.split())
