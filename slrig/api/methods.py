"""What methods a path has: all are named where another one is refused, and HEAD is answered wherever GET is."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from fastapi.routing import iter_route_contexts
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.api.problems import answer, problem

_STREAMS = ("text/event-stream", "multipart/x-mixed-replace")
"""Answers that last: GET opens a stream, and light may move for it. HEAD is refused there."""


class Methods:
    """Middleware that refuses the methods that a path has not, and answers HEAD with the head of what GET would say.

    FastAPI names the method of one route where several share a path, and takes `/calibration/import` for a calibration
    of that name wherever the method is not its own.
    """

    def __init__(self, app: ASGIApp, *, routes: Sequence[BaseRoute]) -> None:
        self._app = app
        self._fixed: dict[str, set[str]] = {}
        self._patterns: dict[str, tuple[re.Pattern[str], set[str]]] = {}
        for route in iter_route_contexts(routes):
            path, methods = route.path_format or "", set(route.methods or ())
            if "GET" in methods and not _streams(getattr(route, "responses", {})):
                methods.add("HEAD")
            if "{" in path:
                self._patterns.setdefault(path, (route.path_regex, set()))[1].update(methods)
            else:
                self._fixed.setdefault(path, set()).update(methods)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        method, allowed = scope["method"], self._methods(scope["path"])
        if allowed and method not in allowed:
            listed = ", ".join(sorted(allowed))
            detail = (
                f"{scope['path']} takes {listed}, and the request is a {method}. /openapi.json says what each does."
            )
            refusal = answer(problem(405, "method-not-allowed", detail), headers={"Allow": listed})
            await refusal(scope, receive, send)
        elif method == "HEAD":
            asked = {**scope, "method": "GET"}
            try:
                await self._app(asked, receive, _head_only(asked, scope, send))
            except _HeadSentError:
                return
        else:
            await self._app(scope, receive, send)

    def _methods(self, path: str) -> set[str]:
        """Those of a path; none where there is nothing at it."""
        if path in self._fixed:
            return self._fixed[path]
        return {each for pattern, methods in self._patterns.values() if pattern.match(path) for each in methods}


class _HeadSentError(Exception):
    """Ends the making of an answer of which only the head was asked for."""


def _head_only(asked: Scope, scope: Scope, send: Send) -> Send:
    async def head(message: Message) -> None:
        # Whoever measures outside of this looks for it there.
        scope["route"] = asked.get("route")
        await send(message)
        await send({"type": "http.response.body"})
        raise _HeadSentError

    return head


def _streams(responses: dict[int | str, dict[str, Iterable[str]]]) -> bool:
    answered = responses.get(200, {}).get("content", ())
    return any(kind.startswith(_STREAMS) for kind in answered)
