"""The application: its routers, the middleware around them, and the documentation page."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path

from anyio.to_thread import current_default_thread_limiter
from fastapi import APIRouter, Depends, FastAPI, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import FileResponse
from fastapi.routing import iter_route_contexts
from starlette.exceptions import HTTPException
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.api import (
    acceptance,
    auth,
    calibration,
    events,
    files,
    hand_eye,
    live,
    models,
    notices,
    rig,
    rig_file,
    scans,
    schedules,
    system,
)
from slrig.api.auth import LOCAL_NAMES, Access, BodyLimits, KeyRing, SecurityHeaders, Sessions
from slrig.api.calibration import IMPORT_PATH, MOST_IMPORT_BYTES
from slrig.api.problems import PlainErrorsToProblems, answer, describe, install_problems, problem
from slrig.api.service import Latency, Service, turn

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
            as_get = {**scope, "method": "GET"}
            try:
                await self._app(as_get, receive, _head_only(as_get, scope, send))
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
    """Ends the making of an answer after its head, for a HEAD request."""


def _head_only(as_get: Scope, scope: Scope, send: Send) -> Send:
    async def head(message: Message) -> None:
        # Outer middleware reads it there.
        scope["route"] = as_get.get("route")
        await send(message)
        await send({"type": "http.response.body"})
        raise _HeadSentError

    return head


def _streams(responses: dict[int | str, dict[str, Iterable[str]]]) -> bool:
    answered = responses.get(200, {}).get("content", ())
    return any(kind.startswith(_STREAMS) for kind in answered)


_TITLE = "slrig"
_SUMMARY = "Structured-light scans over HTTP: from POST /scan to a triangle mesh in millimetres"


def bare_app() -> FastAPI:
    """The routes and their description, with nothing behind them: what the OpenAPI document is made from."""
    app = FastAPI(
        title=_TITLE,
        summary=_SUMMARY,
        version=importlib.metadata.version("slrig"),
        # The usual pages load their scripts from other people's servers.
        docs_url=None,
        redoc_url=None,
        generate_unique_id_function=lambda route: route.name,
        lifespan=_life,
        dependencies=[Depends(turn, scope="function")],
    )
    for part in (
        # Before what would take its name for an id.
        files.together_router,
        scans.router,
        events.router,
        files.router,
        models.router,
        scans.preset_router,
        scans.exposure_router,
        rig.router,
        live.router,
        rig.examination_router,
        rig_file.router,
        calibration.router,
        hand_eye.router,
        rig.health_router,
        rig.turntable_router,
        acceptance.router,
        schedules.router,
        notices.router,
        auth.router,
        system.router,
        router,
        system.page_router,
    ):
        app.include_router(part)
    app.mount(system.FILES_PATH, system.page_files())
    app.openapi = lambda: describe(app)  # type: ignore[method-assign] # the way that FastAPI documents
    install_problems(app)
    app.add_middleware(Methods, routes=app.routes)
    return app


def create_app(service: Service, *, ring: KeyRing | None, cookie: str = "slrig_session") -> FastAPI:
    """The application over a service, which it starts and closes.

    ring : its keys; None leaves it open to all. cookie : the name of the cookie of a logged-in browser.
    """
    settings = service.settings
    app = bare_app()
    app.state.service = service
    app.state.sessions = None if ring is None else Sessions(ring, cookie=cookie)
    # The last one added is the outermost: every refusal becomes a problem, Host comes first, then page and key, then
    # the body's size. FastAPI's own size limit would lie outside of all of them and answer in plain text.
    longer = {
        IMPORT_PATH: max(MOST_IMPORT_BYTES, settings.max_body_bytes),
        **dict.fromkeys(hand_eye.PATHS, max(hand_eye.MOST_BYTES, settings.max_body_bytes)),
        "/model/shoot": max(scans.MOST_SCAN_BYTES, settings.max_body_bytes),
        "/scan": max(scans.MOST_SCAN_BYTES, settings.max_body_bytes),
    }
    app.add_middleware(BodyLimits, most_bytes=settings.max_body_bytes, longer=longer)
    app.add_middleware(
        Access, ring=ring, sessions=app.state.sessions, audit=service.audit, per_second=settings.requests_per_s
    )
    hosts = [*LOCAL_NAMES, settings.host, *settings.allowed_hosts]
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False)
    app.add_middleware(PlainErrorsToProblems)
    app.add_middleware(SecurityHeaders)
    app.add_middleware(Latency, durations=service.durations)
    return app


@asynccontextmanager
async def _life(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    # One for each connection: shares limit how many answers are made at once, and none waits for another's thread.
    current_default_thread_limiter().total_tokens = service.settings.max_connections
    service.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.close)


_ASSETS = {"swagger-ui-bundle.js": "text/javascript", "swagger-ui.css": "text/css", "favicon.png": "image/png"}
_START = """SwaggerUIBundle({
  url: "/openapi.json", dom_id: "#docs", deepLinking: true, validatorUrl: null,
  presets: [SwaggerUIBundle.presets.apis], layout: "BaseLayout",
});
"""
_PAGE = """<!doctype html>
<html lang="en">
<head>
  <meta charset="utf-8"><title>slrig: the interface</title>
  <link rel="icon" href="/docs/favicon.png"><link rel="stylesheet" href="/docs/swagger-ui.css">
</head>
<body><div id="docs"></div>
  <script src="/docs/swagger-ui-bundle.js"></script><script src="/docs/start.js"></script>
</body>
</html>
"""

router = APIRouter(prefix="/docs", include_in_schema=False)


@router.get("")
def show_interface() -> Response:
    """Show the description of the interface as a page."""
    if find_spec("fastapi_offline") is None:
        detail = "This page needs Swagger UI: pip install 'slrig[docs]'. What it shows is /openapi.json."
        raise HTTPException(404, detail)
    return Response(_PAGE, media_type="text/html")


@router.get("/start.js")
def start_page() -> Response:
    """The page's start script, in a file of its own: scripts within the page are forbidden."""
    return Response(_START, media_type="text/javascript")


@router.get("/{name}")
def fetch_asset(name: str) -> Response:
    """Return a part of Swagger UI."""
    found = find_spec("fastapi_offline")
    if name not in _ASSETS or found is None or found.origin is None:
        raise HTTPException(404)
    return FileResponse(Path(found.origin).parent / "static" / name, media_type=_ASSETS[name])
