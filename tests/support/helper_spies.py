"""What tests see of the processes that make calls for others (sim/processes.py)."""

import threading

import pytest

from sim.processes import HelperProcess


def readiness(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    """Released once for each process that is ready from now on."""
    semaphore, wait = threading.Semaphore(0), HelperProcess.wait

    def waited(helper: HelperProcess) -> None:
        wait(helper)
        semaphore.release()

    monkeypatch.setattr(HelperProcess, "wait", waited)
    return semaphore


def calls_made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """The arguments of each call that another process is asked for from now on."""
    made, call = [], HelperProcess.__call__

    def called(helper: HelperProcess, *arguments: object) -> object:
        made.append(arguments)
        return call(helper, *arguments)

    monkeypatch.setattr(HelperProcess, "__call__", called)
    return made
