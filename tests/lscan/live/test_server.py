"""The live page over HTTP, by a real server on a port of its own."""

import asyncio
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from fake_devices import FakeTrack, folder_bytes
from live_rig import LONG_S, GatedTrack, SeeingCamera, live_bench, wait_for
from live_served import Page, served
from places import SUPPORT

from lscan.acquisition.run import open_run
from lscan.errors import InputError
from lscan.live.server import FOLDER, LivePage, grant, listen
from lscan.live.session import Newest

COMMANDS = [
    "mode",
    "board",
    "scan/start",
    "scan/pause",
    "scan/resume",
    "scan/stop",
    "move",
    "laser",
]
TOKEN = "correct-horse"
KINDS = {
    "html": "text/html; charset=utf-8",
    "css": "text/css; charset=utf-8",
    "js": "text/javascript; charset=utf-8",
    "svg": "image/svg+xml",
}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """One for all tests that leave it as it is."""
    output = tmp_path_factory.mktemp("live") / "runs"
    with (
        pytest.MonkeyPatch.context() as patch,
        live_bench(patch, output) as bench,
        served(bench) as page,
    ):
        yield page


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Page]:
    with live_bench(monkeypatch, tmp_path / "runs") as bench, served(bench) as page:
        yield page


def asking(port: int, after: int) -> socket.socket:
    """A browser that has asked for a picture and has not read the answer."""
    plain = socket.create_connection(("127.0.0.1", port), LONG_S)
    plain.sendall(request_for(port, after))
    return plain


def request_for(port: int, after: int) -> bytes:
    return f"GET /api/frame?after={after} HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()


# ---- files and headers ------------------------------------------------------------------


def test_every_file_of_the_page_is_served_with_its_type_and_a_strict_policy(page: Page) -> None:
    names = sorted(file.name for file in FOLDER.iterdir())
    assert {"index.html", "style.css", "main.js"} < set(names)
    for name in names:
        answer = page.http.get("/" if name == "index.html" else f"/live/{name}")
        assert answer.status_code == 200, name
        assert answer.content == (FOLDER / name).read_bytes()
        kind = KINDS[name.rpartition(".")[2]]
        assert answer.headers["content-type"] == kind
        assert "set-cookie" not in answer.headers


def test_every_answer_has_the_safety_headers(page: Page) -> None:
    """Of OWASP's secure headers those that hold for a page over plain HTTP."""
    expected = {
        "x-frame-options": "DENY",
        "x-content-type-options": "nosniff",
        "referrer-policy": "no-referrer",
    }
    answers = [
        page.http.get("/"),
        page.http.get("/live/main.js"),
        page.http.get("/api/state"),
        page.http.get("/api/frame"),
        page.http.get("/no-such-page"),
        page.http.get("/", headers={"host": "evil.example"}),
        page.post("mode", {"mode": "both"}),
        page.post("scan/stop"),
    ]
    assert [answer.status_code for answer in answers] == [200, 200, 200, 200, 404, 403, 400, 409]
    for answer in answers:
        assert expected.items() <= dict(answer.headers).items()
        policy = answer.headers["content-security-policy"].split("; ")
        assert {"default-src 'none'", "script-src 'self'", "frame-ancestors 'none'"} <= set(policy)
        assert "unsafe" not in answer.headers["content-security-policy"]


@pytest.mark.parametrize(
    "path",
    [
        "/../rig.py",
        "/..%2frig.py",
        "/%2e%2e/%2e%2e/pyproject.toml",
        "/index.html",
        "/live",
        "/live/",
        "/live/index.html",
        "/live.js",
        "/live/../main.js",
        "/live/../../report.html.j2",
        "/live/..%2f..%2frig.py",
        "/live/%2e%2e/%2e%2e/rig.py",
        "/live/....//rig.py",
        "/live/.main.js",
        "/live/main.js%00.css",
        "/live//main.js",
        "/live/MAIN.JS",
        "/report.html.j2",
        "/templates/live/main.js",
        "//etc/passwd",
        "/api",
        "/api/frame/..",
    ],
)
def test_nothing_else_is_served(page: Page, path: str) -> None:
    with socket.create_connection(("127.0.0.1", page.port), LONG_S) as plain:
        plain.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
        assert b" 404 " in plain.recv(4096).split(b"\r\n")[0]


# ---- access -----------------------------------------------------------------------------


def test_another_name_and_another_site_are_refused(page: Page) -> None:
    for headers in ({"host": "evil.example"}, {"origin": "http://evil.example"}):
        for path in ("/", "/live/main.js", "/api/state", "/api/frame"):
            assert page.http.get(path, headers=headers).status_code == 403
        for command in COMMANDS:
            answer = page.http.post(f"/api/{command}", json={}, headers=headers)
            assert answer.status_code == 403
            assert "content-security-policy" in answer.headers
    assert page.session.state()["scan"]["state"] == "idle"
    assert page.post("mode", {"mode": "stripe"}).status_code == 200


def test_a_command_names_the_page_that_it_is_from(page: Page) -> None:
    """By Origin, or by Sec-Fetch-Site; another port is the same site but not the same origin."""
    own = f"http://127.0.0.1:{page.port}"
    bodies = {"mode": {"mode": "stripe"}, "move": {"position_mm": 0.0}, "laser": {"on": True}}
    foreign: list[dict[str, str]] = [
        {},
        {"origin": "null"},
        {"origin": "http://127.0.0.1:1"},
        {"sec-fetch-site": "same-site"},
        {"sec-fetch-site": "cross-site"},
        {"sec-fetch-site": "none"},
    ]
    with httpx.Client(base_url=own, timeout=LONG_S) as program:
        for headers in foreign:
            for command in COMMANDS:
                body = bodies.get(command, {})
                answer = program.post(f"/api/{command}", json=body, headers=headers)
                assert answer.status_code == 403, (command, headers)
        for headers in ({"origin": own}, {"sec-fetch-site": "same-origin"}):
            answer = program.post("/api/mode", json=bodies["mode"], headers=headers)
            assert answer.status_code == 200


def test_a_token_is_taken_from_the_address_and_kept_in_a_cookie(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with live_bench(monkeypatch, tmp_path) as bench, served(bench, token=TOKEN) as page:
        for path in ("/", "/?token=wrong-token", "/live/main.js", f"/api/state?token={TOKEN}"):
            answer = page.http.get(path)
            assert answer.status_code == 403
            assert "token" in answer.text
            assert "set-cookie" not in answer.headers
        assert page.post("scan/start").status_code == 403
        for _ in range(2):  # the printed address goes on serving, this browser and others
            answer = page.http.get(f"/?token={TOKEN}")
            assert (answer.status_code, answer.headers["location"]) == (303, "/")
            name, _, rest = answer.headers["set-cookie"].partition("=")
            assert name == f"lscan-{page.port}"  # cookies do not distinguish ports
            assert rest == f"{TOKEN}; HttpOnly; SameSite=Strict; Path=/"
        assert TOKEN not in page.http.get("/").text
        assert page.http.get("/live/main.js").status_code == 200
        assert page.http.get("/api/state").status_code == 200
        assert page.post("mode", {"mode": "stripe"}).status_code == 200


# ---- commands ---------------------------------------------------------------------------


def test_a_scan_by_the_buttons(fresh: Page) -> None:
    answer = fresh.post("scan/start", {"name": "a"})
    assert answer.status_code == 200
    assert answer.json()["scan"]["planned"] == 5
    state = wait_for(
        lambda: (s := fresh.http.get("/api/state").json())["scan"]["state"] == "done" and s
    )
    assert state["scan"]["done"] == 5
    assert state["scan"]["left_s"] is None
    assert len(open_run(Path(state["scan"]["folder"]))) == 5
    again = fresh.post("scan/start", {"name": "a"})
    assert again.status_code == 400
    assert "exists already" in again.json()["error"]
    assert fresh.post("move", {"position_mm": 3}).json()["track"]["position_mm"] == 3.013


def test_the_state_is_as_agreed(page: Page) -> None:
    state = page.http.get("/api/state").json()
    assert set(state) == {
        "rig", "source", "camera", "track", "can_switch_laser", "laser", "laser_warning",
        "calibration", "board", "mode", "plan", "scan", "task",
    }  # fmt: skip
    assert state["rig"] == "Prüfstand"
    camera = state["camera"]
    assert camera.pop("seen_s_ago") >= 0
    assert camera == {"driver": "fake", "size_px": [20, 16], "error": "", "gone": False}
    assert state["plan"] == {"start_mm": 1.0, "step_mm": 0.1, "frames": 5}
    assert set(state["scan"]) == {
        "state", "folder", "done", "planned", "elapsed_s", "left_s", "message", "by_device",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("command", "body"),
    [
        ("mode", b'{"mode": "both"}'),
        ("mode", b"{}"),
        ("mode", b'{"mode": "board"}'),  # this rig has none
        ("board", b"{}"),
        ("scan/start", b'{"name": "../x"}'),
        ("scan/start", b'{"folder": "x"}'),
        ("move", b'{"position_mm": NaN}'),
        ("move", b'{"position_mm": 1e999}'),
        ("move", b"[5]"),
        ("move", b'{"position_mm": 5'),
        ("move", b"\xff\xfe"),
        ("move", b"[" * 5000),
        ("move", b" " * 20_000),
        ("laser", b'{"on": 1}'),
        ("laser", b'{"on": true}'),  # this track has no switch
    ],
)
def test_a_bad_body_gets_one_clear_line_and_does_nothing(
    page: Page, command: str, body: bytes
) -> None:
    before = page.bench.drivers.track.moves
    answer = page.http.post(f"/api/{command}", content=body)
    assert answer.status_code == 400
    assert answer.json()["device"] is False
    assert answer.json()["error"].count("\n") == 0
    assert page.bench.drivers.track.moves == before
    assert page.session.state()["scan"]["state"] == "idle"


@pytest.mark.parametrize("command", ["scan/pause", "scan/resume", "scan/stop"])
def test_what_cannot_be_done_now_is_a_conflict(page: Page, command: str) -> None:
    answer = page.post(command)
    assert answer.status_code == 409
    assert answer.json()["error"]


def test_commands_are_posts(page: Page) -> None:
    for command in COMMANDS:
        assert page.http.get(f"/api/{command}").status_code == 405


def test_a_device_that_refuses_is_a_conflict_with_its_line(fresh: Page) -> None:
    fresh.bench.drivers.track.fail_at = 0
    answer = fresh.post("move", {"position_mm": 5})
    assert answer.status_code == 409
    assert "limit switch" in answer.json()["error"]
    assert answer.json()["device"] is True


# ---- pictures ---------------------------------------------------------------------------


def test_a_picture_that_comes_as_the_server_ends_leaves_nothing_undone() -> None:
    """The event loop ends in the very round in which it learns of the picture."""
    session: Any = SimpleNamespace(frames=Newest[bytes]())
    page = LivePage(session, grant("127.0.0.1", 80, None))

    async def serve_and_end() -> None:
        async with page._lifespan(None):  # type: ignore[arg-type]
            session.frames.put(b"")

    loop = asyncio.new_event_loop()
    loop.run_until_complete(serve_and_end())
    assert not asyncio.all_tasks(loop)
    loop.close()
    session.frames.put(b"")  # and the next one finds no loop


def test_each_picture_is_answered_once_and_newer_than_the_last(page: Page) -> None:
    number = 0
    for _ in range(5):
        frame = page.frame(number)
        assert frame is not None
        assert frame["number"] > number
        number = frame["number"]
    assert {"mode", "focus", "focus_best", "stripe", "profile", "board", "rate_hz"} <= set(frame)
    assert frame["focus_best"] >= frame["focus"]


@pytest.mark.parametrize("after", ["-1", "x", "1.5", "٣", "9" * 40])
def test_a_bad_number_is_refused(page: Page, after: str) -> None:
    answer = page.http.get("/api/frame", params={"after": after})
    assert answer.status_code == 400
    assert "after" in answer.json()["error"]


def test_a_picture_that_does_not_come_is_204(page: Page, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lscan.live.server.LONGEST_WAIT_S", 0.05)
    assert page.frame(10**9) is None


def test_a_hundred_browsers_that_wait_hold_up_nobody(
    page: Page, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More than there are threads: they must wait in the event loop."""
    monkeypatch.setattr("lscan.live.server.LONGEST_WAIT_S", 2.0)
    waiting = [asking(page.port, 10**9) for _ in range(100)]
    for _ in range(5):
        assert page.post("mode", {"mode": "stripe"}).status_code == 200
        assert page.frame(0) is not None
    for plain in waiting:
        assert b" 204 " in plain.recv(4096).split(b"\r\n")[0]
        plain.close()


def test_a_browser_that_stops_reading_slows_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    track = GatedTrack(gate=threading.Semaphore(0))
    with (
        live_bench(monkeypatch, tmp_path, track, SeeingCamera) as bench,
        served(bench, frames=20) as page,
        socket.socket() as deaf,
    ):
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
        deaf.connect(("127.0.0.1", page.port))
        request = request_for(page.port, 0)
        deaf.setblocking(False)
        sent = 0
        try:
            while sent < 20_000_000:  # until the server takes no more requests either
                sent += deaf.send(request * 100)
        except BlockingIOError:
            pass
        analysed = page.frame(0)
        assert analysed is not None
        page.post("scan/start", {"name": "a"})
        track.gate.release(20)
        wait_for(lambda: page.http.get("/api/state").json()["scan"]["state"] == "done")
        wait_for(lambda: page.frame(analysed["number"] + 10))


def test_the_server_ends_while_browsers_wait(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lscan.live.server.LONGEST_WAIT_S", 10 * LONG_S)
    with live_bench(monkeypatch, tmp_path) as bench:
        with served(bench) as page:
            waiting = asking(page.port, 10**9)
            for _ in range(3):  # later requests than that one, which is in by then
                page.frame(0)
        assert b" 204 " in waiting.recv(4096).split(b"\r\n")[0]
        waiting.close()


def test_answers_are_sent_at_once() -> None:
    """Nagle's algorithm would hold each picture back until the browser has confirmed the last."""
    with listen("127.0.0.1", 0) as listening:
        with socket.create_connection(listening.getsockname()):
            accepted, _ = listening.accept()
        with accepted:
            assert accepted.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_a_port_in_use_is_refused_before_a_device_is_opened() -> None:
    with listen("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        with pytest.raises(InputError, match=f"--port {port}"):
            listen("127.0.0.1", port)
    with pytest.raises(InputError, match="cannot listen there"):
        listen("no-such-host.invalid", 0)
    with pytest.raises(InputError, match=r"--host a\.\.b --port 0: .*no such name"):
        listen("a..b", 0)


# ---- the command ------------------------------------------------------------------------

LIVE = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
import lscan.acquisition.scan, lscan.config.rig
from fake_devices import FakeCamera, FakeDrivers, fake_rig
from live_rig import GatedTrack
import time

class SlowTrack(GatedTrack):
    def move_to(self, position_mm):
        time.sleep(0.05)
        return super().move_to(position_mm)

    def close(self):
        print("track closed", flush=True)

track = SlowTrack()
lscan.config.rig.find_plugin = FakeDrivers(track, FakeCamera(track)).find_plugin
lscan.config.rig.load_rig = lambda path: fake_rig(1000)
from lscan.cli.app import main
sys.argv = ["lscan", "live", "rig.toml", "--port", "0", "-o", {output!r}]
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_the_scan_after_its_frame(tmp_path: Path, number: int) -> None:
    output = tmp_path / "runs"
    script = LIVE.format(tests=str(SUPPORT), output=str(output))
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        address = process.stdout.readline().split()[0]
        remark = process.stdout.readline()
        own = {"origin": address.rstrip("/")}
        answer = httpx.post(f"{address}api/scan/start", json={}, headers=own, timeout=LONG_S)
        assert answer.status_code == 200
        wait_for(
            lambda: httpx.get(f"{address}api/state", timeout=LONG_S).json()["scan"]["done"] > 2
        )
        process.send_signal(number)
        out, err = process.communicate(timeout=LONG_S)
    assert (process.returncode, err) == (0, "")
    assert remark.startswith(
        "every user of this machine can move the track and switch the laser; -"
    )
    folder = output / "scan-001"
    assert out.splitlines() == [
        "track closed",
        f"stopped; go on with: lscan scan rig.toml -o {folder} --resume",
    ]
    run = open_run(folder)
    assert run.state == "scanning"
    assert 2 < len(run) < 1000
    assert len(folder_bytes(folder / "frames")) == len(run)  # no picture without its row


def test_the_track_is_not_moved_by_looking(page: Page) -> None:
    track = page.bench.drivers.track
    assert isinstance(track, FakeTrack)
    page.frame(0)
    assert track.moves == 0
