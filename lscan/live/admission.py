"""Admission to the live page: the check of every request, and the safety headers of answers."""

from starlette.requests import Request
from starlette.responses import PlainTextResponse, RedirectResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from lscan.live.access import Access

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
