"""Loops over arrays, compiled by numba and kept in a file."""

import logging
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numba
from numba.core import event

_log = logging.getLogger(__name__)

_P = ParamSpec("_P")
_R = TypeVar("_R")


class _FirstTime(event.Listener):
    """Says once why nothing happens for some seconds."""

    said = False

    def on_start(self, event: event.Event) -> None:
        """Called where something is compiled that no cache has."""
        if not self.said:
            _log.warning(
                "note: compiles what reads pictures: half a minute, once if it can be kept"
            )
            self.said = True

    def on_end(self, event: event.Event) -> None:
        """Called where that is done."""


event.register("numba:compile", _FirstTime())


def compiled(function: Callable[_P, _R], fastmath: object = False) -> Callable[_P, _R]:
    """Decorator of a loop over arrays: it runs without the interpreter, and without its lock.

    numba compiles it when it is first called, and keeps that beside the module or, where nothing
    can be written there, in the user's cache; where it cannot either, each process compiles anew.
    With ``NUMBA_DISABLE_JIT=1`` it stays Python.

    Parameters
    ----------
    function : callable, in the part of Python that numba knows
    fastmath : as ``numba.njit`` takes it
    """
    options: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": fastmath}
    try:
        made = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # there is no place for it
        made = numba.njit(**options)(function)
    return cast(Callable[_P, _R], made)


def compiled_sums(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """As ``compiled``, of sums whose terms may be added in any order, several at once.

    Parameters
    ----------
    function : callable, as of ``compiled``; NaN stays what it is
    """
    return compiled(function, {"reassoc", "contract", "nsz"})


def compiled_order(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """As ``compiled``, of values that are compared, several at once; none is NaN.

    Parameters
    ----------
    function : callable, as of ``compiled``
    """
    return compiled(function, {"nnan", "nsz", "contract"})
