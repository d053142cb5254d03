"""The live page served on a port of its own, with a browser's client of it."""

import json
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import httpx
from live_rig import LONG_S, Bench, wait_for

from lscan.live.server import grant, listen, make_server
from lscan.live.session import Session


@dataclass
class Page:
    """A served session and a browser of it."""

    session: Session
    port: int
    http: httpx.Client
    bench: Bench

    def post(self, path: str, body: Any = None) -> httpx.Response:
        return self.http.post(f"/api/{path}", json={} if body is None else body)

    def frame(self, after: int) -> dict[str, Any] | None:
        answer = self.http.get("/api/frame", params={"after": after})
        if answer.status_code == 204:
            return None
        assert answer.headers["content-type"] == "application/octet-stream"
        (length,) = struct.unpack(">I", answer.content[:4])
        assert answer.content[4 + length :][:2] == b"\xff\xd8"  # a JPEG begins so
        document: dict[str, Any] = json.loads(answer.content[4 : 4 + length])
        return document


@contextmanager
def served(bench: Bench, frames: int = 5, token: str | None = None) -> Iterator[Page]:
    session = bench.open(frames)
    with listen("127.0.0.1", 0) as listening:
        port = listening.getsockname()[1]
        server = make_server(session, grant("127.0.0.1", port, token))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]})
        thread.start()
        try:
            wait_for(lambda: server.started)
            own = f"http://127.0.0.1:{port}"  # as a browser says of the page's own commands
            with httpx.Client(base_url=own, headers={"origin": own}, timeout=LONG_S) as http:
                yield Page(session, port, http, bench)
        finally:
            server.stop()
            thread.join(LONG_S)
            assert not thread.is_alive()
