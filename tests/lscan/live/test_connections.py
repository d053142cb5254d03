"""Connections to the live page that ask for nothing: a scan goes on, and they are dropped."""

import errno
import os
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest
from live_rig import LONG_S, GatedTrack, live_bench, wait_for
from live_served import served

from lscan.errors import DiskError, InputError
from lscan.files.disk import disk_errors, read_bytes

CLIENTS, SPARE_FILES = 300, 160

# Every third sends nothing, every third half a request, every third all of it but the body.
CLIENT = """
import resource, socket, sys
_, most = resource.getrlimit(resource.RLIMIT_NOFILE)
resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
begun = [b"", b"GET /api/sta", b"POST /api/move HTTP/1.1\\r\\nHost: x\\r\\nContent-Length: 9\\r\\n"]
held = []
for number in range(int(sys.argv[2])):
    held.append(socket.create_connection(("127.0.0.1", int(sys.argv[1]))))
    held[-1].sendall(begun[number % 3])
print("held", flush=True)
for each in held:
    try:
        while each.recv(4096): pass
    except OSError: pass
print("dropped", flush=True)
"""


@contextmanager
def few_files() -> Iterator[None]:
    """This process may open no more than SPARE_FILES beyond those it has open."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    allowed = len(list(Path("/proc/self/fd").iterdir())) + SPARE_FILES
    resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_connections_that_ask_for_nothing_stop_no_scan_and_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """More of them than the process may open files; another browser is served meanwhile."""
    monkeypatch.setattr("lscan.live.server.REQUEST_S", LONG_S)
    track = GatedTrack(gate=threading.Semaphore(0))
    with live_bench(monkeypatch, tmp_path, track) as bench, served(bench) as page, few_files():
        page.post("scan/start", {"name": "a"})
        command = [sys.executable, "-S", "-c", CLIENT, str(page.port), str(CLIENTS)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as clients:
            assert clients.stdout is not None
            assert clients.stdout.readline() == "held\n"
            track.gate.release(100)
            with httpx.Client(base_url=page.http.base_url, timeout=LONG_S) as another:
                wait_for(lambda: another.get("/api/state").json()["scan"]["state"] == "done")
            clients.kill()
    assert [record.message for record in caplog.records if record.name == "asyncio"] == []


def test_a_connection_is_dropped_that_brings_no_whole_request(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that waits for a picture is not, however long."""
    monkeypatch.setattr("lscan.live.server.REQUEST_S", 0.1)
    monkeypatch.setattr("lscan.live.server.LONGEST_WAIT_S", 0.5)
    with live_bench(monkeypatch, tmp_path) as bench, served(bench) as page:
        command = [sys.executable, "-S", "-c", CLIENT, str(page.port), "6"]
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONG_S)
        assert done.stdout == "held\ndropped\n"
        assert page.frame(10**9) is None


def test_too_many_open_files_get_their_own_remedy(tmp_path: Path) -> None:
    with (
        pytest.raises(DiskError, match=r"cannot be written: .*ulimit -n"),
        disk_errors(tmp_path),
    ):
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))
    with few_files(), pytest.raises(InputError, match=r"cannot be read: .*ulimit -n"):
        held: list[int] = []
        try:
            while True:
                held.append(os.dup(0))
        except OSError:
            read_bytes(Path(__file__), 10**6)
        finally:
            for descriptor in held:
                os.close(descriptor)
