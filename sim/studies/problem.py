"""What a study evaluates: a pure function from the causes of an error to errors."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Protocol

from lscan.records import Floats

NOMINAL = float("nan")
"""In a row: this cause is not at work.  Its number is the scene's own, its noise is off."""


@dataclass(frozen=True)
class Output:
    """One error that is looked at.

    Attributes
    ----------
    name : str, as the study's file and its results name it; with ``AFTER``: after recalibration
    unit : str, such as "mm"
    size : int, 1 of a scalar; P of a field, the errors of P places of the surface
    """

    name: str
    unit: str
    size: int = 1


AFTER = ".after"
"""Ends the name of an output as it is once the instrument was calibrated anew before the scan."""


class StudyProblem(Protocol):
    """Errors as a function of their causes.

    Attributes
    ----------
    causes : tuple of str, the names of D causes
    outputs : tuple of Output, whose sizes sum up to K
    """

    @property
    def causes(self) -> tuple[str, ...]:
        """The names of D causes."""
        ...

    @property
    def outputs(self) -> tuple[Output, ...]:
        """The outputs, whose sizes sum up to K."""
        ...

    def evaluate(self, row: Floats) -> Floats:
        """(K,) errors, measured less true, of the rig that a row stands for.

        Parameters
        ----------
        row : (D,) array, of numbers in [0, 1), or NOMINAL: each cause's number is its
            distribution's quantile there; what is new in each picture, and noise, are drawn with
            a seed made from it.  The same row gives the same bytes in any process.

        Raises
        ------
        LscanError
            The rig cannot be calibrated or measured: a status of the run.
        """
        ...


def columns(outputs: Sequence[Output]) -> dict[str, slice]:
    """Where each output's values are among the K of a row of results.

    Parameters
    ----------
    outputs : sequence of Output

    Examples
    --------
    >>> columns([Output("height", "mm", 3), Output("yaw", "deg")])
    {'height': slice(0, 3, None), 'yaw': slice(3, 4, None)}
    """
    ends = list(accumulate(output.size for output in outputs))
    return {
        output.name: slice(end - output.size, end)
        for output, end in zip(outputs, ends, strict=True)
    }


def width(outputs: Sequence[Output]) -> int:
    """K, the number of values in a row of results.

    Parameters
    ----------
    outputs : sequence of Output
    """
    return sum(output.size for output in outputs)
