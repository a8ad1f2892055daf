"""What every answer carries for the browser's sake, and how much a request may bring."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.datastructures import MutableHeaders
from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")

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
        await limited(scope, receive, send)
