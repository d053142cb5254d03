"""Admission to the live page: connections, the check of each request, the headers of answers."""

import asyncio
import resource
from typing import Any

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from lscan.live.access import Access

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
                extra = [(k.lower().encode(), v.encode()) for k, v in headers.items()]
                message = {**message, "headers": [*message["headers"], *extra]}
            await send(message)

        await inner(scope, receive, send_safely)


def most_connections() -> int:
    """How many connections may be open at a time, whatever is left for files (``ulimit -n``)."""
    allowed, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return max(1, min(MOST_CONNECTIONS, allowed - KEPT_FILES))


class BrowserConnection(H11Protocol):
    """A connection that asks for nothing is dropped after a while, and sooner where room is short.

    Whoever reaches the port, with or without a token, could else take every file that the process
    may open, and so end a scan.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._began_s = self.loop.time()
        self._drop_if_silent_after(None)
        if len(self.connections) > most_connections():
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
