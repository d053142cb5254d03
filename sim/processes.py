"""Calls whose order is known, some made ahead by other processes while this one makes its own."""

import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, suppress
from pathlib import Path
from typing import Any, Generic, TypeVar

# Another process that makes calls for this one, on what it has built for itself.
#
# ``python -m sim.processes`` is that process.  It reads pickled calls, writes pickled results, and
# ends
# with the process that started it.  It is no process of ``multiprocessing``, which would run the
# caller's script again: a script of three lines has no guard against that.


class HelperEnded(Exception):
    """The process ended before it answered: killed, or by an error of the call."""


class HelperProcess:
    """A process that makes calls one at a time; ``close`` ends it."""

    def __init__(
        self, make: Callable[[], Callable[..., Any]], environment: dict[str, str] | None = None
    ) -> None:
        """Start it; it is ready when ``wait`` returns.  OSError where the system starts no more.

        Parameters
        ----------
        make : callable, can be pickled, returns what is called there
        environment : dict, variables of that process beside this one's
        """
        home = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
        self._process = subprocess.Popen(
            [sys.executable, "-m", "sim.processes"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": home, **(environment or {})},
            start_new_session=True,  # a terminal's Ctrl-C is for the one that ends the others
        )
        self._make: Callable[[], Callable[..., Any]] | None = make

    def wait(self) -> None:
        """Wait until it is ready; HelperEnded where it does not come to that."""
        make, self._make = self._make, None
        self._answer(make)

    def __call__(self, *arguments: object) -> Any:
        """The call's result; HelperEnded where there is none.

        Parameters
        ----------
        arguments : of the call, can be pickled, as its result
        """
        return self._answer(arguments)

    def _answer(self, question: object) -> Any:
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            pickle.dump(question, self._process.stdin)
            self._process.stdin.flush()
            return pickle.load(self._process.stdout)
        except (OSError, EOFError, pickle.PickleError) as error:
            raise HelperEnded from error

    def kill(self) -> None:
        """End it at once; whoever waits for an answer gets HelperEnded."""
        self._process.kill()

    def close(self) -> None:
        """End it, once nobody waits for an answer any more; closing twice is harmless."""
        self.kill()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):  # what was left to write has no reader
                    pipe.close()
        self._process.wait()


def start_helpers(
    make: Callable[[], Callable[..., Any]], environments: Iterable[dict[str, str]]
) -> list[HelperProcess]:
    """A helper for each environment, as many as the system starts.

    Parameters
    ----------
    make, environments : as of ``HelperProcess``, to be closed by the caller
    """
    helpers: list[HelperProcess] = []
    with suppress(OSError):  # without more, the caller does more itself
        for environment in environments:
            helpers.append(HelperProcess(make, environment))
    return helpers


def main() -> None:
    """Answer calls until the other side is gone; an error of a call ends it too."""
    calls, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print must not come between the answers
    work, answer = pickle.load(calls)(), None
    while True:
        pickle.dump(answer, answers)
        answers.flush()
        try:
            arguments = pickle.load(calls)
        except EOFError:
            return
        answer = work(*arguments)


if __name__ == "__main__":
    main()


# Calls whose order is known, some made ahead by other processes while this one makes its own.


_Result = TypeVar("_Result")

LEAST = 60  # calls still to come; for fewer, a process that imports and loads the tank is no help
AHEAD = 3  # calls begun or waiting for each process, so that none waits for the next one


class Ahead(Generic[_Result]):
    """Results of calls, the same whoever makes them; ``close`` ends the other processes.

    While one that was asked for is still being made elsewhere, this process makes the next that
    nobody has begun.  Where another process ends, its calls are made here.
    """

    def __init__(
        self,
        make: Callable[[], Callable[..., _Result]],
        order: Sequence[tuple[Any, ...]],
        sharing: Callable[[], AbstractContextManager[Sequence[dict[str, str]]]],
    ) -> None:
        """Build what is called; other processes begin after the first call of a long order.

        Parameters
        ----------
        make : callable, can be pickled, returns what is called
        order : sequence of tuple, arguments of the calls to come, each of which can be hashed
        sharing : callable, while whose context lasts this process leaves cores to others; it
            gives the environment's variables of each
        """
        self._make, self._work, self._sharing = make, make(), sharing
        self._order, self._places = order, {call: n for n, call in enumerate(order)}
        self._closed = ExitStack()
        self._begun: dict[tuple[Any, ...], Future[_Result | None]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._helpers: list[HelperProcess] = []
        self._own = threading.local()

    def take(self, *call: Any) -> _Result:
        """The result of a call; those that follow it in the order are begun.

        Parameters
        ----------
        call : its arguments
        """
        if (place := self._places.get(call)) is None:
            return self._work(*call)
        if self._pool is None:
            result = self._work(*call)  # first here: what is made once and kept is found there
            if len(self._order) - place > LEAST:
                self._start()
                self._begin_after(place)
            return result
        self._begin_after(place)
        future = self._begun.pop(call, None)
        if future is None or future.cancel():
            return self._work(*call)
        while not future.done() and self._make_waiting():
            pass
        try:
            made = future.result()
        except CancelledError:  # closed meanwhile
            made = None
        return self._work(*call) if made is None else made

    def close(self) -> None:
        """End the other processes; closing twice is harmless."""
        for helper in self._helpers:
            helper.kill()
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
        for helper in self._helpers:
            helper.close()
        self._closed.close()

    def _start(self) -> None:
        """Start a process for each core that is left to others, of which there may be none."""
        self._helpers = start_helpers(self._make, self._closed.enter_context(self._sharing()))
        if not self._helpers:
            self._closed.close()
            self._order, self._places = (), {}  # from now on all is made here
            return
        waiting = iter(self._helpers)
        self._pool = ThreadPoolExecutor(
            len(self._helpers), "helper", initializer=lambda: self._adopt(next(waiting))
        )

    def _adopt(self, helper: HelperProcess) -> None:
        """Give this thread its process, once that is ready; until then, no call waits for it."""
        self._own.helper = helper
        try:
            helper.wait()
        except HelperEnded:
            self._own.helper = None

    def _begin_after(self, place: int) -> None:
        """Ask for the calls that follow a place; forget all others but its own."""
        if self._pool is None:
            return
        window = self._order[place : place + 1 + AHEAD * len(self._helpers)]
        for other in [call for call in self._begun if call not in window]:
            self._begun.pop(other).cancel()
        for call in window[1:]:
            if call not in self._begun:
                self._begun[call] = self._pool.submit(self._elsewhere, call)

    def _elsewhere(self, call: tuple[Any, ...]) -> _Result | None:
        """The result from this thread's process; None where that has ended."""
        if self._own.helper is None:
            return None
        try:
            result: _Result = self._own.helper(*call)
        except HelperEnded:
            self._own.helper = None
            return None
        return result

    def _make_waiting(self) -> bool:
        """Make the first call here that nobody has begun; False where there is none."""
        for call, future in self._begun.items():
            if future.cancel():
                made: Future[_Result | None] = Future()
                made.set_result(self._work(*call))
                self._begun[call] = made
                return True
        return False
