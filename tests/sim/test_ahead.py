"""Calls made ahead by other processes: the same results, and no process left behind."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import Any

import pytest
from helper_spies import readiness
from slow_calls import Squares

from sim.processes import LEAST, Ahead, HelperEnded, HelperProcess

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX")
CALLS = [(number,) for number in range(LEAST + 40)]
STARTED_S = 60.0  # for a process to start on a busy machine


def helpers(count: int) -> Callable[[], AbstractContextManager[list[dict[str, str]]]]:
    @contextmanager
    def sharing() -> Iterator[list[dict[str, str]]]:
        yield [{"HELPER_IS": "here"}] * count

    return sharing


@pytest.fixture
def ready(monkeypatch: pytest.MonkeyPatch) -> threading.Semaphore:
    return readiness(monkeypatch)


def is_running(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    return True


def ends(process_id: int) -> bool:
    until_s = time.monotonic() + STARTED_S
    while is_running(process_id) and time.monotonic() < until_s:
        time.sleep(0.02)
    return not is_running(process_id)


def test_results_are_in_order_whoever_makes_them(ready: threading.Semaphore) -> None:
    count = 2
    ahead = Ahead(partial(Squares, 0.01), CALLS, helpers(count))
    found = [ahead.take(0)]
    for _ in range(count):
        assert ready.acquire(timeout=STARTED_S)
    found += [ahead.take(*call) for call in CALLS[1:]]
    ahead.close()
    squares, makers = zip(*found, strict=True)
    assert squares == tuple(number**2 for (number,) in CALLS)
    assert len(set(makers)) == 1 + count and os.getpid() in makers
    # All sleep for as long: each makes its share, but for what waits at the ends.
    assert makers.count(os.getpid()) < 2 * len(CALLS) / (1 + count)


def test_no_call_waits_for_a_process_that_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    never = threading.Event()
    monkeypatch.setattr(HelperProcess, "wait", lambda _: never.wait(STARTED_S))
    ahead = Ahead(partial(Squares, 0.0), CALLS, helpers(1))
    assert {ahead.take(*call)[1] for call in CALLS} == {os.getpid()}
    never.set()
    ahead.close()


@pytest.mark.parametrize("end", ["killed", "failed"])
def test_calls_of_a_process_that_ends_are_made_here(end: str, ready: threading.Semaphore) -> None:
    deadly = 30 if end == "failed" else None
    ahead = Ahead(partial(Squares, 0.005, deadly), CALLS, helpers(1))
    ahead.take(0)
    assert ready.acquire(timeout=STARTED_S)
    found = [ahead.take(*call) for call in CALLS[1:20]]
    if end == "killed":
        os.kill(ahead._helpers[0]._process.pid, signal.SIGKILL)
    found += [ahead.take(*call) for call in CALLS[20:]]
    assert [square for square, _ in found] == [number**2 for (number,) in CALLS[1:]]
    assert len({maker for _, maker in found[:19]}) == 2 or end == "failed"
    ahead.close()
    assert not is_running(ahead._helpers[0]._process.pid)


def test_calls_out_of_order_are_made_all_the_same(ready: threading.Semaphore) -> None:
    ahead = Ahead(partial(Squares, 0.002), CALLS, helpers(1))
    order = [0, 3, 4, 4, 2, 10, 500, 11, 12, 0, 1]
    assert [ahead.take(number)[0] for number in order] == [number**2 for number in order]
    assert len(ahead._begun) <= 3
    ahead.close()


@pytest.mark.parametrize("calls, count", [(CALLS[:LEAST], 1), (CALLS, 0)])
def test_no_process_is_started_in_vain(calls: list[tuple[int]], count: int) -> None:
    """For few calls, or where no core is left."""
    ahead = Ahead(partial(Squares, 0.0), calls, helpers(count))
    assert [ahead.take(*call)[0] for call in calls] == [number**2 for (number,) in calls]
    assert not ahead._helpers
    ahead.close()


@pytest.mark.parametrize("most", [0, 1])
def test_what_the_system_does_not_start_is_made_here(
    most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of two processes none or one is started."""
    popen, count = subprocess.Popen, []

    def limited(*arguments: Any, **named: Any) -> Any:
        count.append(1)
        if len(count) > most:
            raise BlockingIOError("Resource temporarily unavailable")
        return popen(*arguments, **named)

    monkeypatch.setattr("sim.processes.subprocess.Popen", limited)
    ahead = Ahead(partial(Squares, 0.0), CALLS, helpers(2))
    assert [ahead.take(*call)[0] for call in CALLS] == [number**2 for (number,) in CALLS]
    assert len(ahead._helpers) == most
    ahead.close()


def test_closing_leaves_no_process(ready: threading.Semaphore) -> None:
    """Even in the middle of a call; the second time it does nothing."""
    ahead = Ahead(partial(Squares, 30.0), [(0,), *CALLS[1:]], helpers(2))
    ahead._work = lambda number: (number**2, os.getpid())
    ahead.take(0)
    assert ready.acquire(timeout=STARTED_S) and ready.acquire(timeout=STARTED_S)
    ahead._begin_after(0)
    time.sleep(0.1)
    began_s = time.monotonic()
    ahead.close()
    ahead.close()
    assert time.monotonic() - began_s < 20.0  # far less than a call takes
    assert not any(is_running(helper._process.pid) for helper in ahead._helpers)


SCRIPT = """
import sys, time
from functools import partial
from slow_calls import Squares
from sim.processes import HelperProcess
helper = HelperProcess(partial(Squares, 0.0))
helper.wait()
print(helper._process.pid, helper(7)[0], flush=True)
time.sleep(600)
"""


def test_a_process_ends_with_a_killed_script_that_has_no_guard(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """The script is not run a second time by the helper, as multiprocessing's would be."""
    file = tmp_path_factory.mktemp("script") / "script.py"
    file.write_text(SCRIPT)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, str(file)], stdout=subprocess.PIPE, text=True, env=environment
    ) as script:
        assert script.stdout is not None
        helper, square = map(int, script.stdout.readline().split())
        assert square == 49 and is_running(helper)
        script.kill()
    assert ends(helper)


def test_a_call_that_fails_says_so() -> None:
    helper = HelperProcess(partial(Squares, 0.0, 5), {"HELPER_IS": "here"})
    helper.wait()
    assert helper(4)[0] == 16
    with pytest.raises(HelperEnded):
        helper(5)
    helper.close()
