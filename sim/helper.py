"""Another process that makes calls for this one, on what it has built for itself.

``python -m sim.helper`` is that process.  It reads pickled calls, writes pickled results, and ends
with the process that started it.  It is no process of ``multiprocessing``, which would run the
caller's script again: a script of three lines has no guard against that.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any


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
            [sys.executable, "-m", "sim.helper"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": home, **(environment or {})},
            start_new_session=True,  # a terminal's Ctrl-C is for the one that ends the others
        )
        self._make: Callable[[], Callable[..., Any]] | None = make

    @property
    def process_id(self) -> int:
        """The process's number."""
        return self._process.pid

    def wait(self) -> None:
        """Wait until it is ready; HelperEnded where it does not come to that."""
        make, self._make = self._make, None
        self._asked(make)

    def __call__(self, *arguments: object) -> Any:
        """The call's result; HelperEnded where there is none.

        Parameters
        ----------
        arguments : of the call, can be pickled, as its result
        """
        return self._asked(arguments)

    def _asked(self, question: object) -> Any:
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


def started(
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
