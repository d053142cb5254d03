"""What a worker does: it makes a study's problem once, and evaluates rows."""

import time
import traceback
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from lscan.errors import LscanError
from lscan.records import Floats
from sim.studies.problem import StudyProblem, width
from sim.studies.store import OK, Batch, Results, StudyIdentity


class ProblemSource(Protocol):
    """What a problem is made from: small, and sent to each worker; a frozen record, say.

    Attributes
    ----------
    document : mapping, of JSON types: all that the problem's results depend on, content of
        files included, but not which rows are looked at
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
    identity = StudyIdentity(source.document, problem.causes, problem.outputs)
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
