"""The application: routers, and round them what every request passes."""

from __future__ import annotations

import importlib.metadata
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from starlette.middleware.trustedhost import TrustedHostMiddleware

from slrig.api import acceptance, artefacts, calibration, events, health, rig, scans, schedules, system
from slrig.api.calibration import IMPORT_PATH, MOST_IMPORT_BYTES
from slrig.api.events import OpenStreams
from slrig.api.openapi import describe
from slrig.api.problems import PlainErrorsToProblems, install_problems
from slrig.api.security import LOCAL_NAMES, BodyLimits, KeyCheck
from slrig.api.service import Service

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
    )
    for part in (scans, events, artefacts, rig, calibration, health, acceptance, schedules, system):
        app.include_router(part.router)
    app.openapi = lambda: describe(app)  # type: ignore[method-assign] # the way that FastAPI documents
    install_problems(app)
    return app


def create_app(service: Service, *, key_digest: str | None) -> FastAPI:
    """The application over a service, which it starts and closes. `key_digest` None leaves it open to all."""
    settings = service.settings
    app = bare_app()
    app.state.service = service
    app.state.streams = OpenStreams(settings.max_event_streams)
    # The last one added is the outermost: every refusal becomes a problem, Host comes first, then the key, then the
    # body's size. FastAPI's own size limit would lie outside of all of them and answer in plain text.
    longer = {IMPORT_PATH: max(MOST_IMPORT_BYTES, settings.max_body_bytes)}
    app.add_middleware(BodyLimits, most_bytes=settings.max_body_bytes, longer=longer)
    if key_digest is not None:
        app.add_middleware(KeyCheck, key_digest=key_digest)
    hosts = [*LOCAL_NAMES, settings.host, *settings.allowed_hosts]
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=hosts, www_redirect=False)
    app.add_middleware(PlainErrorsToProblems)
    return app


@asynccontextmanager
async def _life(app: FastAPI) -> AsyncIterator[None]:
    service: Service = app.state.service
    service.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.close)
