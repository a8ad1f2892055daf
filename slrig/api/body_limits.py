"""How long the body of a request may be: short, but for the few that carry a file."""

from __future__ import annotations

from collections.abc import Mapping

from starlette.middleware.body_limit import RequestBodyLimitMiddleware
from starlette.types import ASGIApp, Receive, Scope, Send


class BodyLimits:
    """Middleware. `most_bytes` holds for every path but those of `longer`, which have their own."""

    def __init__(self, app: ASGIApp, *, most_bytes: int, longer: Mapping[str, int]) -> None:
        self._usual: ASGIApp = RequestBodyLimitMiddleware(app, max_body_size=most_bytes)
        self._longer: Mapping[str, ASGIApp] = {
            path: RequestBodyLimitMiddleware(app, max_body_size=most) for path, most in longer.items()
        }

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        app = self._longer.get(scope["path"], self._usual) if scope["type"] == "http" else self._usual
        await app(scope, receive, send)
