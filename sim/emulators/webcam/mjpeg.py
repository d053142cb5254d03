"""The emulated camera's pictures over HTTP: ``/stream.mjpg`` and ``/snapshot.jpg``.

A stream is ``multipart/x-mixed-replace``, one JPEG a part, as network cameras send it.  Every
client has a thread of its own that takes the newest picture whenever the last one is sent: one
that stops reading holds up nobody, and nothing queues for it here.  Loopback only.
"""

import contextlib
import socket
import threading
from http.server import BaseHTTPRequestHandler
from socketserver import ThreadingTCPServer
from typing import Any

from lscan.errors import InputError
from sim.emulators.webcam.camera import EmulatedCamera, Shot

HOST = "127.0.0.1"
STREAM, SNAPSHOT = "/stream.mjpg", "/snapshot.jpg"
BOUNDARY = "picture"
LOOK_UP_S = 0.25  # how often a client's thread looks whether the camera was dropped
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
        self._lock = threading.Lock()
        try:
            super().__init__((HOST, port), _Client)
        except OSError as error:
            raise InputError(
                f"cannot listen there: {error.strerror}",
                where="--http-port",
                value=port,
                allowed="a port that no other program holds; 0 for any",
            ) from error
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
        self._thread.join()

    def process_request(self, request: Any, client_address: Any) -> None:
        """Remember the connection, so that it can be broken."""
        with self._lock:
            self._connections.add(request)
        super().process_request(request, client_address)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer one client, in a thread that is known by its name."""
        threading.current_thread().name = f"client {client_address[1]}"
        super().process_request_thread(request, client_address)

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
            shot = camera.newest(sent, LOOK_UP_S)
            if shot is not None:
                self.wfile.write(_part(shot))
                sent = shot.number

    def _snapshot(self, camera: EmulatedCamera) -> None:
        shot = camera.newest(camera.count, SNAPSHOT_S)
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
