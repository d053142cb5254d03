"""What a worker does: it makes a study's problem once, and evaluates rows.

Before anything else it sees to it that it has in common with its client what it must: another
version of a package, another mesh of the same path or another disk of the same name would change
results in silence.
"""

import time
import traceback
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Protocol, TypeVar

import cv2
import numpy as np
import scipy

from lscan.config.documents import by_content
from lscan.errors import InputError, LscanError
from lscan.files.disk import content_sha256
from lscan.records import Floats
from lscan.version import __version__
from sim.studies.problem import StudyProblem, width
from sim.studies.store import OK, Batch, Results, StudyIdentity

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
