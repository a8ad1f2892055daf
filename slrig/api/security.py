"""What every answer carries for the browser's sake, and how much a request may bring."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from contextlib import suppress

from starlette.datastructures import MutableHeaders
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")

_TOO_LONG = 413
_PASS_OVER_S = 1.0
"""A body of 100 MB is here by then on a usual network; who sends more, or slowly, may find the connection reset."""

_HEADERS = {
    # What is sent as a picture or as text is never run.
    "X-Content-Type-Options": "nosniff",
    # Our pages load from here alone, and nobody frames them.
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; "
    "object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'",
    "X-Frame-Options": "DENY",
    # No other site's page shows our pictures, holds our window, or is told which page a link was on.
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Referrer-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class SecurityHeaders:
    """Middleware that adds them, where an answer says nothing of its own."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""

        async def with_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                # A report has a stricter policy of its own.
                for name, value in _HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        await self._app(scope, receive, with_headers if scope["type"] == "http" else send)


class BodyLimits:
    """Middleware: how long a body may be. `most_bytes` holds for every path but those of `longer`."""

    def __init__(self, app: ASGIApp, *, most_bytes: int, longer: Mapping[str, int]) -> None:
        self._usual = RequestBodyLimitMiddleware(app, max_body_size=most_bytes)
        self._longer = {path: RequestBodyLimitMiddleware(app, max_body_size=most) for path, most in longer.items()}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        limited = self._longer.get(scope["path"], self._usual) if scope["type"] == "http" else self._usual

        async def after_the_body(message: Message) -> None:
            if message["type"] == "http.response.start" and message["status"] == _TOO_LONG:
                await _pass_over(scope, receive)
            await send(message)

        await limited(scope, receive, after_the_body)


async def _pass_over(scope: Scope, receive: Receive) -> None:
    """Take what a client is still sending, for a moment: a connection that is closed with bytes unread is reset, and
    a proxy then loses the answer. One that waits to be told to send has sent nothing.
    """
    if any(name == b"expect" for name, _ in scope["headers"]):
        return
    with suppress(TimeoutError):
        async with asyncio.timeout(_PASS_OVER_S):
            while (await receive()).get("more_body", False):
                pass
