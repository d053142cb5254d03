"""The emulated webcam: pictures from where the head stands, served over HTTP."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any, Literal

import numpy as np

from lscan.errors import InputError
from lscan.records import Bytes
from sim.devices import camera_options
from sim.emulators.track import ServeOptions
from sim.processes import HelperEnded, HelperProcess, start_helpers
from sim.render.backend import sharing
from sim.render.tank import Tank
from sim.scene import Scene
from sim.scene.file import is_changing
from sim.sensor import Webcam
from sim.sensor.webcam import StillView, jpeg_bytes

# What the webcam sees from each place of the head, rendered once and kept.


NANOMETRE = 6  # decimals of a place in mm: finer, two places are one


class Places:
    """Views of the tank from track positions; the ``most`` used last are kept.

    One view of 640 by 480 px takes about 5 MB, twice that where the laser is switched.
    """

    def __init__(self, scene: Scene, most: int, *, switched_laser: bool = False) -> None:
        """Load the tank; InputError where the scene holds what pictures kept cannot show."""
        _refuse_change(scene)
        self._scene = scene
        self._tank, self._webcam = Tank(scene), Webcam(scene)
        self._exposure_ms = scene.rig.camera.exposure_ms
        self._switched = switched_laser
        self._kept = lru_cache(most)(self._render)

    def view(self, position_mm: float, *, lit: bool = True) -> StillView:
        """The view from a position in mm, rendered where it is not kept."""
        with_laser, without = self._kept(round(position_mm, NANOMETRE))
        return with_laser if lit else without

    def passing_view(self, position_mm: float, *, lit: bool = True) -> StillView:
        """The view from a position in mm that the head passes: nothing is kept of it."""
        with_laser, without = self._render(position_mm)
        return with_laser if lit else without

    @contextmanager
    def helpers(self) -> Iterator[list[HelperProcess]]:
        """Processes on the other cores that make a ``PassedPicture`` each, until the block ends."""
        with sharing() as environments:
            make = partial(PassedPicture, self._scene, self._switched)
            helpers = start_helpers(make, environments)
            try:
                yield helpers
            finally:
                for helper in helpers:
                    helper.close()

    def _render(self, position_mm: float) -> tuple[StillView, StillView]:
        """The views with the laser on and off; both are lit where it is never switched."""
        layers = self._tank.render(position_mm)
        lit = self._webcam.still(layers, self._exposure_ms)
        if not self._switched:
            return lit, lit
        return lit, self._webcam.still(layers.without_laser(), self._exposure_ms)


class PassedPicture:
    """Pictures of places that the head passes, as a process of its own takes them."""

    def __init__(self, scene: Scene, switched_laser: bool) -> None:
        self._places = Places(scene, 0, switched_laser=switched_laser)

    def __call__(self, position_mm: float, lit: bool, seed: int) -> Bytes:
        """The picture of a place in mm, with the noise of a seed."""
        view = self._places.passing_view(position_mm, lit=lit)
        return view.picture(np.random.Generator(np.random.SFC64(seed)))


def _refuse_change(scene: Scene) -> None:
    """Refuse what makes two pictures of one place differ by more than noise, or not at all."""
    refused = {
        "laser.drift": (scene.tank.laser.drift is not None, "no such table"),
        "track_errors and change": (is_changing(scene), "neither"),
        "head.speed_mm_s": (scene.tank.head.speed_mm_s != 0, "0"),
        "camera.options.auto_exposure": (camera_options(scene).auto_exposure, "false"),
        "camera.bits": (scene.rig.camera.bits > 8, "8, as its stream is of JPEG pictures"),
        "sensor.noise": (not scene.tank.sensor.noise, "true: a camera without noise looks stuck"),
    }
    for key, (is_so, allowed) in refused.items():
        if is_so:
            what = f"{key}: cannot be served as hardware"
            raise InputError(what, where=scene.source, allowed=allowed)


# The emulated camera: it goes on taking pictures from where the head stands.


CameraFault = Literal["hang", "drop", "black", "wrong-size", "frozen"]
"""hang: connected, and sends no more pictures.  drop: breaks the connection and refuses new ones.
wrong-size: from now on half as wide and high.  frozen: the same picture, byte for byte."""
LONG_MOVE_S = 0.25  # longer than a step of a scan takes, and not much longer than a picture
PASSING_S = 0.02  # how often a further thread looks whether the head moves
SEED_STREAM = 4  # of the sensor's seed; 0 to 3 are taken (sim.sensor.webcam)


@dataclass(frozen=True)
class HeadState:
    """What there is to be seen.  position_mm: where the head rests, None while it moves.

    lit: whether the laser is on.  now_mm: where the head is at this moment.
    """

    position_mm: float | None
    lit: bool
    now_mm: float


@dataclass(frozen=True)
class Shot:
    """A picture as a JPEG file.  number: from 1 on.  head: what it shows, as it was at begun_s."""

    number: int
    jpeg: bytes
    head: HeadState
    begun_s: float


class EmulatedCamera:
    """Pictures of the tank at a steady rate while anyone watches, in a thread of its own.

    A picture handed out while the head rests shows where it rests.  Once it rests where nothing
    has been rendered yet, nothing is handed out until that is done.  While it moves, the place
    where it rested is shown for LONG_MOVE_S, so that the short steps of a scan wait for no
    picture; from then on each picture is rendered from where the head is when it is taken, by
    processes on the other cores too, which are started at the first such move.
    """

    def __init__(
        self, places: Places, head_state: Callable[[], HeadState], options: ServeOptions, seed: int
    ) -> None:
        self._places, self._head_state, self._options = places, head_state, options
        self._generator = np.random.Generator(np.random.SFC64([seed, SEED_STREAM]))
        self._changed = threading.Condition()
        self._shot: Shot | None = None
        self._rested_mm, self._rested_s = head_state().now_mm, time.monotonic()
        self._watchers, self._ended, self._due_s = 0, False, 0.0
        self.fault: CameraFault | None = None
        self._helpers: list[HelperProcess] | None = None
        self._stack = ExitStack()
        self._threads = [threading.Thread(target=self._run, name="emulated camera", daemon=True)]
        self._threads[0].start()

    @property
    def count(self) -> int:
        """Pictures taken so far."""
        return self._shot.number if self._shot else 0

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Someone watches within the block; without anyone, no picture is taken."""
        with self._changed:
            self._watchers += 1
            self._changed.notify_all()
        try:
            yield
        finally:
            with self._changed:
                self._watchers -= 1

    def newest(self, after: int, timeout_s: float) -> Shot | None:
        """The newest picture if its number is above ``after`` and it is still true, or becomes
        so in time; else None."""
        with self._changed:
            self._changed.wait_for(lambda: self._ended or self._is_true(after), timeout_s)
            return self._shot if self._is_true(after) and not self._ended else None

    def close(self) -> None:
        """End the threads; closing twice is harmless."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._threads[0].join()  # which alone starts others
        for helper in self._helpers or ():
            helper.kill()
        for thread in self._threads:
            thread.join()
        self._stack.close()

    def _is_true(self, after: int) -> bool:
        """Whether the last shot may still be handed out: the head may have left since."""
        if self._shot is None or self._shot.number <= after or self.fault == "hang":
            return False
        now, then = self._head_state(), self._shot.head
        return now.lit == then.lit and now.position_mm in (None, then.position_mm)

    def _run(self) -> None:
        while self._awaited():
            head, begun_s = self._head_state(), time.monotonic()
            if self._is_passing(head):
                self._begin_beside()
                view = self._places.passing_view(head.now_mm, lit=head.lit)
            elif head.position_mm is None:
                view = self._places.view(self._rested_mm, lit=head.lit)
            else:
                view = self._places.view(head.position_mm, lit=head.lit)
                self._rested_mm, self._rested_s = head.position_mm, time.monotonic()
            self._publish(view.picture(self._generator), head, begun_s)

    def _is_passing(self, head: HeadState) -> bool:
        """Whether each picture is to show where the head is at its moment."""
        return head.position_mm is None and time.monotonic() - self._rested_s > LONG_MOVE_S

    def _begin_beside(self) -> None:
        """Start the other processes and a thread for each, the first time."""
        if self._helpers is not None:
            return
        self._helpers = self._stack.enter_context(self._places.helpers())
        for number, helper in enumerate(self._helpers):
            seeds = np.random.Generator(np.random.SFC64(self._generator.integers(2**32, size=4)))
            args, name = (helper, seeds), f"emulated camera {number}"
            thread = threading.Thread(target=self._run_beside, args=args, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def _run_beside(self, helper: HelperProcess, seeds: np.random.Generator) -> None:
        """Publish pictures of what the head passes that another process takes, while it lasts."""
        with suppress(HelperEnded):
            helper.wait()
            while self._awaited(passing=True):
                head, begun_s = self._head_state(), time.monotonic()
                image = helper(head.now_mm, head.lit, int(seeds.integers(2**63)))
                self._publish(image, head, begun_s)

    def _awaited(self, passing: bool = False) -> bool:
        """Wait until the next picture is due and someone watches; False at the end.

        passing: and until the head passes what is to be shown.
        """
        with self._changed:
            while passing and not self._ended and not self._is_passing(self._head_state()):
                self._changed.wait(PASSING_S)
            due_s = max(self._due_s, time.monotonic())
            self._due_s = due_s + 1 / self._options.fps
            self._changed.wait_for(lambda: self._ended, max(0.0, due_s - time.monotonic()))
            self._changed.wait_for(lambda: self._ended or self._watchers > 0)
            return not self._ended

    def _publish(self, image: Bytes, head: HeadState, begun_s: float) -> None:
        """Show a picture of the head as it was, as it leaves a camera with this fault."""
        if self.fault == "black":
            image = np.zeros_like(image)
        elif self.fault == "wrong-size":
            image = image[::2, ::2]
        if self.fault == "frozen" and self._shot is not None:
            jpeg = self._shot.jpeg
        else:
            jpeg = jpeg_bytes(image, self._options.quality, self._options.subsampling)
        self._show(jpeg, head, begun_s)

    def _show(self, jpeg: bytes, head: HeadState, begun_s: float) -> None:
        """Let all see a picture, unless one that was begun later is there already."""
        with self._changed:
            if self._shot is None or begun_s > self._shot.begun_s:
                self._shot = Shot(self.count + 1, jpeg, head, begun_s)
                self._changed.notify_all()


# The emulated camera's pictures over HTTP: ``/stream.mjpg`` and ``/snapshot.jpg``.
#
# A stream is ``multipart/x-mixed-replace``, one JPEG a part, as network cameras send it.  Every
# client has a thread of its own that takes the newest picture whenever the last one is sent: one
# that stops reading holds up nobody, and nothing queues for it here.  Loopback only.


HOST = "127.0.0.1"
STREAM, SNAPSHOT = "/stream.mjpg", "/snapshot.jpg"
BOUNDARY = "picture"
LOOK_UP_S = 0.25  # how often a client's thread looks whether it or the camera was dropped
SNAPSHOT_S = 30.0  # time in which a place is rendered
SEND_BYTES = 64 * 1024  # about a picture: what waits in the system's buffer is old when read


class MjpegServer(ThreadingTCPServer):
    """The server, answering from construction to ``close``."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, camera: EmulatedCamera, port: int = 0) -> None:
        """Listen at ``port`` of this machine, any free one if 0; InputError where it is taken."""
        self.camera = camera
        self._connections: set[socket.socket] = set()
        self._clients: list[threading.Thread] = []
        self._lock = threading.Lock()
        try:
            super().__init__((HOST, port), _Client)
        except OSError as error:
            what = f"cannot listen there: {error.strerror}"
            allowed = "a port that no other program holds; 0 for any"
            raise InputError(what, where="--http-port", value=port, allowed=allowed) from error
        self._thread = threading.Thread(
            target=self.serve_forever, args=(0.05,), name="http", daemon=True
        )
        self._thread.start()

    @property
    def address(self) -> str:
        """``http://HOST:PORT``."""
        return f"http://{HOST}:{self.server_address[1]}"

    def drop(self) -> None:
        """Break all connections."""
        with self._lock:
            for connection in self._connections:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Stop listening, break all connections, wait for the threads."""
        self.shutdown()
        self.drop()
        self.server_close()
        for thread in (self._thread, *self._clients):
            thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer one client in a thread of its own; both are remembered, so that ``close`` can
        break the connection and wait for the thread (socketserver waits for no daemon)."""
        target, args = self.process_request_thread, (request, client_address)
        thread = threading.Thread(
            target=target, args=args, name=f"client {client_address[1]}", daemon=True
        )
        with self._lock:
            self._connections.add(request)
        self._clients = [client for client in self._clients if client.is_alive()]
        thread.start()
        self._clients.append(thread)

    def shutdown_request(self, request: Any) -> None:
        """Forget the connection."""
        with self._lock:
            self._connections.discard(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that goes away is no error of ours."""


class _Client(BaseHTTPRequestHandler):
    """One connection."""

    server: MjpegServer

    def setup(self) -> None:
        self.request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
        super().setup()

    def do_GET(self) -> None:
        camera = self.server.camera
        if camera.fault == "drop":
            self.send_error(503, "the camera is gone")
        elif self.path not in (STREAM, SNAPSHOT):
            self.send_error(404, f"there are {STREAM} and {SNAPSHOT}")
        else:
            with camera.watched():
                self._stream(camera) if self.path == STREAM else self._snapshot(camera)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the command's output is for its user."""

    def _stream(self, camera: EmulatedCamera) -> None:
        self._begin({"Content-Type": f"multipart/x-mixed-replace; boundary={BOUNDARY}"})
        sent = camera.count
        while camera.fault != "drop" and not self._hung_up():
            if (shot := camera.newest(sent, LOOK_UP_S)) is not None:
                self.wfile.write(_part(shot))
                sent = shot.number

    def _snapshot(self, camera: EmulatedCamera) -> None:
        sent, last_s = camera.count, time.monotonic() + SNAPSHOT_S
        shot = camera.newest(sent, LOOK_UP_S)
        while shot is None and time.monotonic() < last_s and not self._hung_up():
            shot = camera.newest(sent, LOOK_UP_S)
        if shot is None:
            self.send_error(503, "the camera sends nothing")
            return
        self._begin({"Content-Type": "image/jpeg", "Content-Length": str(len(shot.jpeg))})
        self.wfile.write(shot.jpeg)

    def _begin(self, headers: dict[str, str]) -> None:
        self.send_response(200)
        for name, value in {**headers, "Cache-Control": "no-store", "Connection": "close"}.items():
            self.send_header(name, value)
        self.end_headers()

    def _hung_up(self) -> bool:
        """Whether the client is gone: it has nothing to say, so all that can be read is an end."""
        try:
            return self.request.recv(1, socket.MSG_DONTWAIT | socket.MSG_PEEK) == b""
        except BlockingIOError:
            return False


def _part(shot: Shot) -> bytes:
    head = f"--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(shot.jpeg)}\r\n\r\n"
    return head.encode("ascii") + shot.jpeg + b"\r\n"
