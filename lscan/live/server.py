"""The live page over HTTP: files, pictures by long poll, state and commands.

The event loop only waits and sends; whatever may take time runs in threads.  A browser gets the
next picture when it asks for it, so one that stops reading holds up itself alone.
"""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Callable
from typing import Annotated, Any, Literal, TypeVar

import uvicorn
from pydantic import Field, StrictBool
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.requests import ClientDisconnect, Request
from starlette.responses import FileResponse, JSONResponse, Response
from starlette.routing import Route
from starlette.types import ASGIApp

from lscan.config.documents import Strict, check
from lscan.errors import DeviceError, InputError, LscanError
from lscan.live.access import Access
from lscan.live.admission import REQUEST_S, AccessMiddleware, BrowserConnection
from lscan.live.files import page_files
from lscan.live.session import Session

TAKEN_AT_ONCE = 8
"""Connections taken in a round of the loop.  One too many is closed three rounds later, so that
some four times as many may be open beyond the most: few of the files that are kept for a scan."""

WAITING = 128
"""Connections that wait to be taken; one more would ask again after a second (RFC 6298)."""

LONGEST_WAIT_S = 5.0
LONGEST_BODY = 10_000  # bytes; a command takes some fifty


class Nothing(Strict):
    """The body of a command that has nothing to say."""


class ModeBody(Strict):
    """What is to be looked for."""

    mode: Literal["stripe", "board"]


class StartBody(Strict):
    """name: of the new run folder."""

    name: str | None = None


class MoveBody(Strict):
    """position_mm: where the head is to go."""

    position_mm: Annotated[float, Field(ge=-1e6, le=1e6)]


class LaserBody(Strict):
    """on: whether the laser is to be."""

    on: StrictBool


Body = TypeVar("Body", bound=Strict)


class LivePage:
    """The application: answers for one session."""

    def __init__(self, session: Session, access: Access) -> None:
        self._session, self._access = session, access
        self._files = page_files()
        self._changed = asyncio.Event()  # set by the next change, then replaced
        self._closing = False
        self._loop: asyncio.AbstractEventLoop | None = None

    def application(self) -> ASGIApp:
        """The ASGI application, which lets in whom ``access`` does."""
        command, session = self._command, self._session
        scanning = session.scanning
        routes = [
            *(Route(path, self._file) for path in self._files),
            Route("/api/frame", self._frame),
            Route("/api/state", self._state),
            command("/api/mode", ModeBody, lambda body: session.set_mode(body.mode)),
            command("/api/board", Nothing, lambda _: session.take_board()),
            command("/api/scan/start", StartBody, lambda body: session.start_scan(body.name)),
            command("/api/scan/pause", Nothing, lambda _: scanning.pause()),
            command("/api/scan/resume", Nothing, lambda _: session.resume_scan()),
            command("/api/scan/stop", Nothing, lambda _: scanning.stop()),
            command("/api/move", MoveBody, lambda body: session.move_to(body.position_mm)),
            command("/api/laser", LaserBody, lambda body: session.switch_laser(body.on)),
        ]
        inner = Starlette(routes=routes, lifespan=self._lifespan)
        return AccessMiddleware(inner, self._access)

    def close(self) -> None:
        """Let those who wait for a picture go; from any thread or signal handler."""
        self._closing = True
        self._notify()

    @contextlib.asynccontextmanager
    async def _lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self._loop = asyncio.get_running_loop()
        self._session.frames.listen(self._notify)
        yield

    def _notify(self) -> None:
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended before the pictures
                self._loop.call_soon_threadsafe(self._wake)

    def _wake(self) -> None:
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    async def _file(self, request: Request) -> Response:
        file, kind = self._files[request.url.path]
        return FileResponse(file, media_type=kind)

    async def _state(self, _: Request) -> Response:
        return JSONResponse(await run_in_threadpool(self._session.state))

    async def _frame(self, request: Request) -> Response:
        text = request.query_params.get("after", "0")
        if not (text.isascii() and text.isdigit() and len(text) < 16):
            error = InputError("not a number", where="after", value=text, allowed="0 or above")
            return _refused(error, 400)
        newest = self._session.frames
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(LONGEST_WAIT_S):
                # No wake-up is missed: the event loop runs nothing between check and wait.
                while not (self._closing or newest.after(int(text))):
                    await self._changed.wait()
        found = newest.after(int(text))
        if found is None or self._closing:
            return Response(status_code=204)
        return Response(found[1], media_type="application/octet-stream")

    def _command(self, path: str, model: type[Body], act: Callable[[Body], None]) -> Route:
        """A route that carries out a command and answers the state after it."""

        async def answer(request: Request) -> Response:
            try:
                body = check(model, await _document(request), where=None)
                await run_in_threadpool(act, body)
            except InputError as error:
                return _refused(error, 400)
            except LscanError as error:
                return _refused(error, 409)
            return await self._state(request)

        return Route(path, answer, methods=["POST"])


async def _document(request: Request) -> dict[str, Any]:
    """The JSON object in the body, {} for none; InputError for anything else."""
    body = b""
    try:
        async with asyncio.timeout(REQUEST_S):
            async for part in request.stream():
                body += part
                if len(body) > LONGEST_BODY:
                    raise InputError("is too long", where="body", allowed=f"{LONGEST_BODY} bytes")
    except (ClientDisconnect, TimeoutError) as error:
        raise InputError("was cut short", where="body") from error
    try:
        document = json.loads(body or b"{}")
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not valid JSON: {error}", where="body") from error
    if not isinstance(document, dict):
        raise InputError("is not a JSON object", where="body", value=document)
    return document


def _refused(error: LscanError, code: int) -> JSONResponse:
    answer = {"error": str(error), "device": isinstance(error, DeviceError)}
    return JSONResponse(answer, status_code=code)


class LiveServer(uvicorn.Server):
    """Leaves signals to who runs it, so that what comes after it is still done."""

    def __init__(self, config: uvicorn.Config, page: LivePage) -> None:
        super().__init__(config)
        self._page = page

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        for listening in sockets or []:  # asyncio knows one number for both
            listening.listen(WAITING)

    def stop(self) -> None:
        """End soon: those who wait for a picture are let go, nothing new is taken on.

        Again and again, from any thread or signal handler.
        """
        self.should_exit = True
        self._page.close()

    def capture_signals(self) -> contextlib.nullcontext[None]:  # type: ignore[override]
        return contextlib.nullcontext()


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens at an address.

    Parameters
    ----------
    host : str
        Name or number of this machine.
    port : int
        TCP port; 0 for any that is free.

    Returns
    -------
    socket.socket

    Raises
    ------
    InputError
        Where it cannot listen there.
    """
    try:
        family, *_ = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listening = socket.create_server((host, port), family=family)
    except (OSError, UnicodeError) as error:  # such as of a name with an empty part
        # What follows in " (while attempting to bind ..." is where, said already.
        reason = (getattr(error, "strerror", "") or "no such name").partition(" (while")[0]
        where = f"--host {host} --port {port}"
        raise InputError(f"cannot listen there: {reason}", where=where) from error
    # Connections inherit it; without it TCP holds answers back for up to 40 ms (Nagle, RFC 896).
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return listening


def make_server(session: Session, access: Access) -> LiveServer:
    """The server of a session's page.

    Parameters
    ----------
    session : Session
        What the page shows and commands.
    access : Access
        Whom it serves.

    Returns
    -------
    LiveServer
        Its ``run(sockets=[...])`` serves on a socket of :func:`listen` until it is stopped.
    """
    page = LivePage(session, access)
    config = uvicorn.Config(
        page.application(),
        log_level="critical",
        access_log=False,
        lifespan="on",
        http=BrowserConnection,
        backlog=TAKEN_AT_ONCE,
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=2,
    )
    return LiveServer(config, page)
