"""A server of the live page's interface without devices: scripted pictures, recorded commands."""

import copy
import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np

from lscan.live.server import HEADERS, page_files
from lscan.records import Floats

WIDTH, HEIGHT = 640, 480
MM_PER_PX = 0.25
FILES = page_files()
GAP = slice(100, 120)  # columns without a stripe
CLIPPED = slice(300, 310)

COLUMNS = np.arange(WIDTH, dtype=float)
CENTRE_PX = 240.0 + 60.0 * np.sin(2 * np.pi * COLUMNS / 213.0) + 0.02 * COLUMNS
X_MM = (COLUMNS - WIDTH / 2) * MM_PER_PX
Z_MM = -(CENTRE_PX - 100.0) * MM_PER_PX
MARKS_PX = [[160.0 + 80.0 * i, 120.0 + 80.0 * j] for j in range(4) for i in range(5)]


def jpeg(image: np.ndarray) -> bytes:
    """An (H, W, 3) RGB picture as JPEG."""
    return cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


@cache
def stripe_jpeg(variant: int) -> bytes:
    """A red line along CENTRE_PX on a dark ground, with the noise of this variant."""
    noise = np.random.default_rng(variant).normal(0.0, 2.0, (HEIGHT, WIDTH, 1))
    line = 230.0 * np.exp(-0.5 * ((np.arange(HEIGHT)[:, None] - CENTRE_PX) / 2.0) ** 2)
    line[:, GAP] = 0.0
    image = 14.0 + noise + line[..., None] * np.array([1.0, 0.22, 0.18])
    return jpeg(np.clip(image, 0, 255).astype(np.uint8))


@cache
def board_jpeg() -> bytes:
    """A light board with dark dots at MARKS_PX."""
    image = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    cv2.rectangle(image, (110, 70), (530, 410), (215, 215, 210), -1)
    for u, v in MARKS_PX:
        cv2.circle(image, (round(u), round(v)), 15, (25, 25, 25), -1, cv2.LINE_AA)
    return jpeg(image)


def with_gaps(values: Floats) -> list[float | None]:
    """The values as the interface sends them: rounded, null where there is no stripe."""
    sent: list[float | None] = [round(float(value), 3) for value in values]
    sent[GAP] = [None] * (GAP.stop - GAP.start)
    return sent


def stripe_answer() -> dict[str, Any]:
    """The members of a frame's JSON on the stripe."""
    found = WIDTH - (GAP.stop - GAP.start)
    return {
        "stripe": {
            "axis": "columns",
            "centre_px": with_gaps(CENTRE_PX),
            "found": found,
            "of": WIDTH,
            "clipped": CLIPPED.stop - CLIPPED.start,
            "clipped_at": list(range(CLIPPED.start, CLIPPED.stop)),
            "width_px": 4.7,
            "snr": 61.0,
            "slope": 0.02,
            "status": {"OK": found - 10, "SATURATED": 10, "NO_PEAK": 20},
        },
        "profile": {"x_mm": with_gaps(X_MM), "z_mm": with_gaps(Z_MM), "sigma_mm": 0.084},
        "board": None,
    }


def board_answer() -> dict[str, Any]:
    """The members of a frame's JSON on the board."""
    offset = {
        "distance_mm": 1.9,
        "sigma_mm": 0.3,
        "tilt_x_deg": 0.4,
        "tilt_x_sigma_deg": 0.04,
        "tilt_z_deg": -0.2,
        "tilt_z_sigma_deg": 0.2,
        "corners_mm": [1.4, 0.6, -0.3, 4.4],
    }
    return {
        "stripe": None,
        "profile": None,
        "board": {
            "found": len(MARKS_PX),
            "expected": len(MARKS_PX),
            "message": "",
            "marks_px": MARKS_PX,
            "residual_rms_px": 0.11,
            "residual_max_px": 0.31,
            "residual_rms_mm": 0.05,
            "offset": offset,
            "offset_message": "",
            "age_s": 0.6,
        },
    }


class Instrument:
    """The state behind the page: changed by its commands, and by the test.

    frame: changes to the JSON of every picture.  posts: (path, body) of every command.
    refusal: the line with which the next commands are refused, by_device: for a device's sake.
    stuck: no new pictures.  states_asked: how often the state was asked for.
    state_answers: how many of those answers may leave, each with the state as it was when it was
    asked for; None for all.
    """

    def __init__(self, rate_hz: float = 20.0) -> None:
        self.rate_hz = rate_hz
        self.frame: dict[str, Any] = {}
        self.posts: list[tuple[str, Any]] = []
        self.refusal, self.by_device = "", False
        self.stuck = False
        self.states_asked = 0
        self.state_answers: threading.Semaphore | None = None
        self.token = ""
        self._began = time.monotonic()
        self.state: dict[str, Any] = {
            "rig": "sandwave in the tank",
            "source": "rig.toml",
            "camera": {
                "driver": "opencv",
                "size_px": [WIDTH, HEIGHT],
                "error": "",
                "gone": False,
                "seen_s_ago": 0.0,
            },
            "track": {"driver": "grbl", "position_mm": 12.0, "error": ""},
            "can_switch_laser": True,
            "laser": "on",
            "laser_warning": "",
            "calibration": "runs/board-001.json",
            "board": True,
            "mode": "stripe",
            "plan": {"start_mm": 0.0, "step_mm": 1.0, "frames": 100},
            "scan": self._scan("idle"),
            "task": {"name": "", "message": ""},
        }

    @staticmethod
    def _scan(state: str, folder: str | None = None, done: int = 0) -> dict[str, Any]:
        left = 0.25 * (100 - done) if state == "scanning" else None
        times = {"elapsed_s": 0.25 * done, "left_s": left}
        return {
            "state": state, "folder": folder, "done": done, "planned": 100, **times, "message": "",
            "by_device": False,
        }  # fmt: skip

    def scan_is(
        self, state: str, done: int = 34, message: str = "", by_device: bool = False
    ) -> None:
        """Put the scan into a state."""
        folder = None if state == "idle" else "runs/scan-003"
        scan = self._scan(state, folder, done)
        self.state["scan"] = {**scan, "message": message, "by_device": by_device}

    def _phase(self) -> str:
        if self.state["scan"]["state"] in ("scanning", "stopping", "paused", "failed"):
            return "scan"
        return "calibrated" if self.state["calibration"] else "alignment"

    def next_frame(self, after: int) -> tuple[dict[str, Any], bytes] | None:
        """The newest picture numbered above ``after``, waited for; None where none came."""
        deadline = time.monotonic() + 2.0
        while time.monotonic() < deadline:
            number = 1 + int((time.monotonic() - self._began) * self.rate_hz)
            if number > after and not self.stuck:
                return self._answer(number)
            time.sleep(0.2 / self.rate_hz)
        return None

    def _answer(self, number: int) -> tuple[dict[str, Any], bytes]:
        board = self.state["mode"] == "board"
        answer = {
            "number": number,
            "time_s": time.monotonic() - self._began,
            "size_px": [WIDTH, HEIGHT],
            "rate_hz": 24.6,
            "camera_hz": 30.0,
            "exposure_ms": 8.0,
            "position_mm": self.state["track"]["position_mm"],
            "mode": self.state["mode"],
            "phase": self._phase(),
            "saturated_percent": 0.02,
            "focus": 91.0,
            "focus_best": 100.0,
            **(board_answer() if board else stripe_answer()),
        }
        picture = board_jpeg() if board else stripe_jpeg(number % 4)
        return {**answer, **copy.deepcopy(self.frame)}, picture

    def command(self, path: str, body: Any) -> tuple[int, dict[str, Any]]:
        """What the server answers to a POST: the code and the JSON."""
        self.posts.append((path, body))
        if self.refusal:
            return 409, {"error": self.refusal, "device": self.by_device}
        match path:
            case "/api/mode":
                self.state["mode"] = body["mode"]
            case "/api/scan/start":
                self.scan_is("scanning", 0)
                self.state["scan"]["folder"] = f"runs/{body.get('name', 'scan-003')}"
            case "/api/scan/pause":
                self.scan_is("paused")
            case "/api/scan/resume":
                self.scan_is("scanning")
            case "/api/scan/stop":
                self.scan_is("idle")
                self.state["scan"] = self._scan("idle", "runs/scan-003", 35)
            case "/api/move":
                self.state["track"]["position_mm"] = body["position_mm"]
            case "/api/laser":
                self.state["laser"] = "on" if body["on"] else "off"
            case "/api/board":
                self.state["task"] = {"name": "board picture", "message": "taking picture 1 of 4"}
        return 200, self.state


def _handler(instrument: Instrument) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        timeout = 30

        def do_GET(self) -> None:
            url = urlsplit(self.path)
            given = parse_qs(url.query).get("token", [""])[0]
            if self._refused(given):
                return
            if url.path == "/api/state":
                answer = copy.deepcopy(instrument.state)
                instrument.states_asked += 1
                if instrument.state_answers:
                    instrument.state_answers.acquire(timeout=4.0)  # less than the page waits
                self._json(200, answer)
            elif url.path == "/api/frame":
                self._frame(int(parse_qs(url.query)["after"][0]))
            elif url.path in FILES:
                self._file(url.path, given)
            else:
                self._answer(404, "text/plain", b"no such page")

        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            if not self._refused(""):
                self._json(*instrument.command(self.path, body))

        def _refused(self, given: str) -> bool:
            token = instrument.token
            if not token or token == given or f"token={token}" in (self.headers["Cookie"] or ""):
                return False
            line = b"Open the address with its token, as lscan live printed it."
            self._answer(403, "text/plain", line)
            return True

        def _frame(self, after: int) -> None:
            found = instrument.next_frame(after)
            if found is None:
                self._answer(204, "application/octet-stream", b"")
                return
            head = json.dumps(found[0]).encode()
            body = len(head).to_bytes(4, "big") + head + found[1]
            self._answer(200, "application/octet-stream", body)

        def _file(self, path: str, given: str) -> None:
            file, kind = FILES[path]
            cookie = {"Set-Cookie": f"token={given}; HttpOnly; SameSite=Strict"} if given else {}
            self._answer(200, f"{kind}; charset=utf-8", file.read_bytes(), {**HEADERS, **cookie})

        def _json(self, code: int, answer: dict[str, Any]) -> None:
            self._answer(code, "application/json", json.dumps(answer).encode())

        def _answer(
            self, code: int, kind: str, body: bytes, headers: dict[str, str] | None = None
        ) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing: the tests' output is theirs."""

        def handle(self) -> None:
            try:
                super().handle()
            except (ConnectionError, TimeoutError):
                self.close_connection = True  # the browser went away

    return Handler


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    allow_reuse_address = True

    def __init__(self, port: int, handler: Callable[..., BaseHTTPRequestHandler]) -> None:
        self.sockets: list[Any] = []
        super().__init__(("127.0.0.1", port), handler)

    def get_request(self) -> Any:
        accepted = super().get_request()
        self.sockets.append(accepted[0])
        return accepted

    def cut(self) -> None:
        """Close every connection, as the end of the process does."""
        for one in self.sockets:
            try:
                one.shutdown(2)
            except OSError:
                continue  # closed already


@contextmanager
def served(instrument: Instrument, port: int = 0) -> Iterator[str]:
    """The address under which the instrument is served on loopback."""
    server = _Server(port, _handler(instrument))
    thread = threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}/"
    finally:
        server.shutdown()
        server.server_close()
        server.cut()
        thread.join()
