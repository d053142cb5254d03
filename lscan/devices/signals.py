"""Signals that end a program: what runs is ended in order, so that no laser stays lit."""

import signal
import threading
import weakref
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

from lscan.errors import LscanError


def _known_signals(*names: str) -> tuple[int, ...]:
    return tuple(getattr(signal, name) for name in names if hasattr(signal, name))


STOPPING = _known_signals(
    *("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT"),  # Ctrl-C, kill, the terminal goes, Ctrl-\
    *("SIGUSR1", "SIGUSR2", "SIGXCPU", "SIGPWR"),  # batch systems, limits, a UPS
    "SIGBREAK",  # Ctrl-Break on Windows
)
"""What others send to end a program, as far as it can be handled.  SIGKILL cannot."""

SUSPENDING = _known_signals("SIGTSTP", "SIGTTIN", "SIGTTOU")
"""Ctrl-Z, and what a terminal does to a program in the background that uses it."""

_MEANT = _known_signals("SIGINT", "SIGTERM", "SIGQUIT")


@contextmanager
def on_stop_signals(act: Callable[[], None]) -> Iterator[None]:
    """Let the signals of STOPPING call a function within the block.

    SIGINT and SIGQUIT do so also where the process was begun with them ignored, as ``nohup``,
    cron and a script's ``&`` do: whoever then sends one by ``kill`` means it.  A SIGHUP that is
    ignored stays so: under ``nohup`` the work goes on when the terminal goes.

    Parameters
    ----------
    act : callable, called by the signal, in the main thread
    """
    with _handle_signals(filter(_may_act, STOPPING), lambda _: act()):
        yield


@contextmanager
def interrupted_by_signals(unhandled_only: bool = False) -> Iterator[None]:
    """Let the signals of STOPPING raise KeyboardInterrupt within the block, one at a time.

    Until the exception has been dealt with, further signals change nothing: they ask for what
    is being done, and must not cut it short.  One that was lost, as in a destructor, of which
    Python tells nobody, is replaced at the next signal.

    Parameters
    ----------
    unhandled_only : bool
        Leave alone those for which there is a handler, such as a script's own.
    """
    handled = filter(_is_unhandled if unhandled_only else _may_act, STOPPING)
    with _handle_signals(handled, _Interruption()), interruption_kept():
        yield


@contextmanager
def interruption_kept() -> Iterator[None]:
    """Raise KeyboardInterrupt where a library made another error of it within the block.

    Mitsuba and Dr.Jit do, of what is raised while code of ours runs that they have called: as the
    error's cause, or as no more than its name in what the error says.  An error of lscan's own that
    comes while the interruption is dealt with, as of a laser that stays lit, is left.
    """
    try:
        yield
    except LscanError:
        raise
    except Exception as error:
        behind: BaseException | None = error
        while behind is not None:
            if isinstance(behind, KeyboardInterrupt) or "KeyboardInterrupt" in str(behind):
                raise KeyboardInterrupt from error
            behind = behind.__cause__ or behind.__context__
        raise


@contextmanager
def stop_signals_held() -> Iterator[None]:
    """Let the signals of STOPPING that come within the block act at its end, as one."""
    came: list[int] = []
    try:
        with _handle_signals(filter(_may_act, STOPPING), came.append):
            yield
    finally:
        if came:
            signal.raise_signal(came[0])


def ignore_stop_signals() -> None:
    """Let the signals of STOPPING change nothing any more, for a process that is about to end."""
    for number in STOPPING:
        signal.signal(number, signal.SIG_IGN)


@contextmanager
def no_suspending() -> Iterator[None]:
    """Let Ctrl-Z act as Ctrl-C within the block, in which a laser may be lit.

    A program that is suspended could not switch it off.  That it is in the background and uses
    the terminal does not suspend it either.
    """

    def act(number: int) -> None:
        if number == SUSPENDING[0]:
            signal.raise_signal(signal.SIGINT)

    with _handle_signals(SUSPENDING, act):
        yield


class _KeyboardInterrupt(KeyboardInterrupt):
    """Unlike its base it can be referred to weakly; Mitsuba passes on no more than its name."""


class _Interruption:
    """A handler that raises, but not while what it raised is on its way."""

    def __init__(self) -> None:
        self._raised: Callable[[], KeyboardInterrupt | None] = lambda: None

    def __call__(self, _: int) -> None:
        if self._raised() is None:
            raise self._new()

    def _new(self) -> _KeyboardInterrupt:
        # Not in a variable of __call__, whose frame the exception refers to.
        interrupted = _KeyboardInterrupt()
        self._raised = weakref.ref(interrupted)
        return interrupted


@contextmanager
def _handle_signals(numbers: Iterable[int], act: Callable[[int], None]) -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():  # which alone may set handlers
        yield
        return
    before = {number: signal.signal(number, lambda n, _: act(n)) for number in list(numbers)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _may_act(number: int) -> bool:
    """Whether the signal is not ignored on purpose, nor handled outside of Python."""
    handler = signal.getsignal(number)
    return handler is not None and (handler != signal.SIG_IGN or number in _MEANT)


def _is_unhandled(number: int) -> bool:
    """Whether the signal does what it does without anybody's doing."""
    return signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler)
