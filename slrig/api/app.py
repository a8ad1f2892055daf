"""The application: routers, and round them what every request passes."""

from __future__ import annotations

import importlib.metadata
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from fastapi import FastAPI
from fastapi.concurrency import run_in_threadpool
from starlette.middleware.trustedhost import TrustedHostMiddleware

from slrig.api import (
    acceptance,
    artefacts,
    audit,
    calibration,
    docs,
    events,
    examinations,
    exposure,
    fleet,
    health,
    model_shooting,
    models,
    page,
    presets,
    rig,
    scans,
    schedules,
    sessions,
    system,
    turntable,
)
from slrig.api.access import Access
from slrig.api.calibration import IMPORT_PATH, MOST_IMPORT_BYTES
from slrig.api.events import OpenStreams
from slrig.api.keys import KeyRing
from slrig.api.latency import Latency
from slrig.api.methods import Methods
from slrig.api.openapi import describe
from slrig.api.problems import PlainErrorsToProblems, install_problems
from slrig.api.security import LOCAL_NAMES, BodyLimits, SecurityHeaders
from slrig.api.service import Service
from slrig.api.sessions import Sessions

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
    for part in (
        scans,
        events,
        artefacts,
        models,
        model_shooting,
        presets,
        exposure,
        rig,
        examinations,
        calibration,
        health,
        turntable,
        acceptance,
        schedules,
        sessions,
        audit,
        fleet,
        system,
        docs,
        page,
    ):
        app.include_router(part.router)
    app.mount(page.FILES_PATH, page.page_files())
    app.openapi = lambda: describe(app)  # type: ignore[method-assign] # the way that FastAPI documents
    install_problems(app)
    app.add_middleware(Methods, routes=app.routes)
    return app


def create_app(service: Service, *, ring: KeyRing | None, cookie: str = "slrig_session") -> FastAPI:
    """The application over a service, which it starts and closes.

    ring : its keys; None leaves it open to all. cookie : the name of what a browser that is logged in sends.
    """
    settings = service.settings
    app = bare_app()
    app.state.service = service
    app.state.streams = OpenStreams(settings.max_event_streams)
    app.state.sessions = None if ring is None else Sessions(ring, cookie=cookie)
    # The last one added is the outermost: every refusal becomes a problem, Host comes first, then page and key, then
    # the body's size. FastAPI's own size limit would lie outside of all of them and answer in plain text.
    longer = {
        IMPORT_PATH: max(MOST_IMPORT_BYTES, settings.max_body_bytes),
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
    service.start()
    try:
        yield
    finally:
        await run_in_threadpool(service.close)
