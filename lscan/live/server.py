"""The live page over HTTP: files, pictures by long poll, state and commands.

The event loop only waits and sends; whatever may take time runs in threads.  A browser gets the
next picture when it asks for it, so one that stops reading holds up itself alone.
"""

import asyncio
import contextlib
import importlib
import json
import re
import secrets
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import urlsplit

import uvicorn
from pydantic import Field, StrictBool
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import MutableHeaders
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    FileResponse,
    JSONResponse,
    PlainTextResponse,
    RedirectResponse,
    Response,
)
from starlette.routing import Route
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from lscan.config.documents import Strict, check
from lscan.errors import DeviceError, InputError, LscanError
from lscan.live.session import Session

# Who may use the live page: whoever sits at this machine, or has the token.
#
# A page of another site, open in the same browser, must not move the track.  It cannot send the
# cookie (SameSite) nor hide where it is from (Origin), and a name that it makes point at this
# machine (DNS rebinding) is not a name that is served here (Host).  A command is taken only where
# the browser states that it comes from this very page: to SameSite, another port is the same site.


TOKEN = re.compile(r"[A-Za-z0-9_-]{8,200}")
LOOPBACK = ("127.0.0.1", "localhost", "::1")
EVERYWHERE = {"0.0.0.0": (socket.AF_INET,), "::": (socket.AF_INET, socket.AF_INET6)}
"""The hosts that mean all addresses of this machine, with the families served then."""
ELSEWHERE = {socket.AF_INET: "192.0.2.1", socket.AF_INET6: "2001:db8::1"}
"""Addresses of nobody, kept for documentation (RFC 5737, RFC 3849): on no network of ours."""


@dataclass(frozen=True)
class Access:
    """Where the page is served, and to whom.  token: None where none is needed."""

    host: str
    port: int
    token: str | None

    @property
    def cookie(self) -> str:
        """Name of the cookie that holds the token; cookies are shared by all ports."""
        return f"lscan-{self.port}"

    @property
    def addresses(self) -> tuple[str, ...]:
        """What to type into a browser, the likeliest first.

        Where all of this machine is served, its numbers and last its name, which a telephone
        often cannot resolve.
        """
        names: tuple[str, ...] = (self.host,)
        if self.host in EVERYWHERE:
            names = (*machine_numbers(EVERYWHERE[self.host]), socket.gethostname())
        query = f"/?token={self.token}" if self.token else "/"
        hosts = (f"[{name}]" if ":" in name else name for name in names)
        return tuple(f"http://{host}:{self.port}{query}" for host in hosts)

    @property
    def remark(self) -> str:
        """Who can move the track and switch the laser, in a line beneath the addresses."""
        if self.token is None:
            return (
                "every user of this machine can move the track and switch the laser; --token keeps "
                "others out"
            )
        seen = "" if self.host in LOOPBACK else "; plain HTTP shows the address to the network"
        return f"everybody with this address can move the track and switch the laser{seen}"

    def refusal(
        self, headers: Mapping[str, str], query_token: str | None = None, commands: bool = False
    ) -> str | None:
        """Why a request is refused, a plain sentence; None where it is not.

        headers: of the request, by their names in lower case.  query_token: from the address of
        the page itself, None everywhere else.  commands: whether it would change anything.
        """
        host, origin = headers.get("host", ""), headers.get("origin")
        if not self._serves(host):
            return f"This page is not served under the name {host[:80]!r}."
        if origin is not None and origin != f"http://{host}":
            return "Requests from pages of other sites are refused."
        if commands and origin is None and headers.get("sec-fetch-site") != "same-origin":
            return "Commands are taken from this page alone: the request names no Origin."
        if self.token is None:
            return None
        cookies = headers.get("cookie", "").split(";")
        pairs = (cookie.strip().partition("=") for cookie in cookies)
        # All cookies of our name: other programs of this host set theirs too.
        named = [value for name, _, value in pairs if name == self.cookie]
        given = named if query_token is None else [query_token]
        wanted = self.token.encode()
        if not any(secrets.compare_digest(token.encode(), wanted) for token in given):
            return "A token is needed: open the whole address that lscan live printed."
        return None

    def _serves(self, host: str) -> bool:
        try:
            parts = urlsplit(f"//{host}")
            name, port = parts.hostname or "", parts.port or 80
        except ValueError:
            return False
        if port != self.port or set(host) & set("/?#@"):
            return False
        if self.host in LOOPBACK:
            return name in LOOPBACK
        if self.host in EVERYWHERE:  # by number no site can be meant but this machine
            return _is_address(name) or name in (*LOOPBACK, socket.gethostname().lower())
        return name == self.host.lower()


def grant(host: str, port: int, token: str | None) -> Access:
    """Where the live page is served, and to whom.

    Parameters
    ----------
    host : str
        Name or number to serve under.
    port : int
        TCP port.
    token : str or None
        What a browser must present.  None: no token on this machine's own addresses, a random
        one on any other.

    Returns
    -------
    Access

    Raises
    ------
    InputError
        For a token too short to keep anybody out, or that no address can hold.

    Examples
    --------
    >>> grant("127.0.0.1", 8765, None).addresses
    ('http://127.0.0.1:8765/',)
    """
    if token is not None and not TOKEN.fullmatch(token):
        allowed = "8 to 200 letters, digits, '-' and '_'"
        raise InputError("not a token", where="--token", value=token, allowed=allowed)
    if token is None and host not in LOOPBACK:
        token = secrets.token_urlsafe(16)
    return Access(host, port, token)


def machine_numbers(families: Iterable[socket.AddressFamily]) -> tuple[str, ...]:
    """The IP addresses of this machine that others may reach it by, each once.

    First those it goes out by, then those its own name has; no loopback and no link-local
    ones, which a browser elsewhere cannot use.  Empty where there are none.
    """
    found: dict[str, None] = {}
    for family in families:
        numbers: list[str] = []
        with suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
            probe.connect((ELSEWHERE[family], 9))  # sends nothing
            numbers.append(probe.getsockname()[0])
        with suppress(OSError):
            known = socket.getaddrinfo(socket.gethostname(), None, family, socket.SOCK_STREAM)
            numbers += [str(place[0]).partition("%")[0] for *_, place in known]
        for number in numbers:
            address = ip_address(number)
            if not (address.is_loopback or address.is_link_local or address.is_unspecified):
                found[number] = None
    return tuple(found)


def _is_address(name: str) -> bool:
    try:
        ip_address(name)
    except ValueError:
        return False
    return True


# Admission to the live page: connections, the check of each request, the headers of answers.


MOST_CONNECTIONS = 128
"""At a time: browsers open up to six each, and all the tabs of a laboratory fit."""

KEPT_FILES = 128
"""Of the files that this process may have open at a time, how many are no connection's.  Libraries,
devices, the page's own files and a scan have some 50 open."""

REQUEST_S = 5.0
"""Within it a connection is to bring a whole request: the first, and each after an answer."""

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Frame-Options": "DENY",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class AccessMiddleware:
    """Lets requests in as ``access`` says, and puts the safety headers on all answers.

    The token of the printed address is exchanged for a cookie, and the browser sent on to the
    bare address, so that the token is neither shown nor kept in the history.  It stays valid:
    the printed address serves every browser it is opened in.
    """

    def __init__(self, inner: ASGIApp, access: Access) -> None:
        self._inner, self._access = inner, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._inner(scope, receive, send)
            return
        request = Request(scope)
        headers, at_page = dict(HEADERS), request.url.path == "/"
        token = request.query_params.get("token") if at_page else None
        commands = request.method not in ("GET", "HEAD")
        refusal = self._access.refusal(request.headers, token, commands)
        inner = self._inner if refusal is None else PlainTextResponse(refusal, 403)
        if refusal is None and self._access.token and token is not None:
            inner = RedirectResponse("/", 303)
            headers["Set-Cookie"] = (
                f"{self._access.cookie}={self._access.token}; HttpOnly; SameSite=Strict; Path=/"
            )
        elif refusal and at_page and request.headers.get("sec-fetch-site") == "cross-site":
            # A browser that followed a link from elsewhere sends no cookie with its first request
            # (SameSite); with the one that this answer makes it send, it does.
            headers["Refresh"] = "0"

        async def send_safely(message: Message) -> None:
            if message["type"] == "http.response.start":
                MutableHeaders(scope=message).update(headers)
            await send(message)

        await inner(scope, receive, send_safely)


class BrowserConnection(H11Protocol):
    """A connection that asks for nothing is dropped after a while, and sooner where room is short.

    Whoever reaches the port, with or without a token, could else take every file that the process
    may open, and so end a scan.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._began_s = self.loop.time()
        self._drop_if_silent_after(None)
        if len(self.connections) > max(1, min(MOST_CONNECTIONS, _most_files() - KEPT_FILES)):
            own = [each for each in self.connections if isinstance(each, BrowserConnection)]
            max(own, key=BrowserConnection.dispensable).transport.abort()

    def dispensable(self) -> tuple[bool, bool, float]:
        """How readily it is dropped: nothing is asked now, or was ever, and for how long."""
        asks = self.cycle is not None and not self.cycle.response_complete
        is_left = asks or self.transport.is_closing()
        return not is_left, self.cycle is None, -self._began_s

    def on_response_complete(self) -> None:
        answered = self.cycle  # which the next request, already read, may replace
        super().on_response_complete()
        self._drop_if_silent_after(answered)

    def _drop_if_silent_after(self, answered: Any) -> None:
        self.loop.call_later(REQUEST_S, self._drop_if_silent, answered)

    def _drop_if_silent(self, answered: Any) -> None:
        if self.cycle is answered:
            self.transport.abort()


def _most_files() -> int:
    """How many files this process may have open (``ulimit -n``)."""
    try:
        resource = importlib.import_module("resource")
    except ModuleNotFoundError:  # Windows, whose sockets are no files
        return sys.maxsize
    most: int = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    return most


# The files of the live page, listed once: no path of a request reaches the file system.


FOLDER = Path(__file__).parent / "page"
KINDS = {
    ".html": "text/html",
    ".js": "text/javascript",
    ".css": "text/css",
    ".svg": "image/svg+xml",
}


def page_files(folder: Path = FOLDER) -> dict[str, tuple[Path, str]]:
    """The file and the content type behind each path of the server.

    index.html of ``folder`` is "/", every other "/live/NAME"; hidden files, folders and what
    is of none of KINDS are left out.
    """
    return {
        "/" if file.name == "index.html" else f"/live/{file.name}": (file, KINDS[file.suffix])
        for file in sorted(folder.iterdir())
        if file.is_file() and file.suffix in KINDS and not file.name.startswith(".")
    }


# The live page over HTTP: files, pictures by long poll, state and commands.


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
            return _refusal(error, 400)
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
                return _refusal(error, 400)
            except LscanError as error:
                return _refusal(error, 409)
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


def _refusal(error: LscanError, code: int) -> JSONResponse:
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
