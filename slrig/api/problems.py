"""Errors as RFC 9457 problems, one table from error classes to status codes; scopes; and the OpenAPI document."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from types import MappingProxyType
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig.api.scopes import needed_scope
from slrig.bundle import model_keys, proposal
from slrig.errors import RigBusyError, SlrigError
from slrig.failure import UNEXPECTED, JobFailure, errors_by_code
from slrig.printable import printable

_NOTHING: Mapping[str, str] = MappingProxyType({})
MEDIA_TYPE = "application/problem+json"

_CODES = {
    404: "schedule-not-found camera-not-found calibration-not-found job-not-found preset-not-found",
    409: "rig-busy not-calibrated scan-cancelled calibration-state artefact-not-ready scan-state key-in-flight "
    "rig-file-changed live-state",
    410: "damaged",
    422: "invalid-input config bundle calibration pattern schedule nothing-to-reconstruct "
    "unsupported-by-device wrong-system pose-refused solve-refused registration-refused stage-refused views-failed "
    "idempotency",
    429: "queue-full",
    500: "slrig device-state worker-lost out-of-memory",
    501: "extra-missing",
    502: "scan-evidence device service",
    503: "device-gone device-busy driver-not-found driver-broken library-missing scan-interrupted data-folder-gone "
    "worker-busy catalogue",
    504: "frame-timeout",
    507: "storage",
}

STATUS = {code: status for status, codes in _CODES.items() for code in codes.split()}
"""HTTP status by the code of an error. A test compares it with the whole error tree."""

RETRY_AFTER_S = {"rig-busy": 5, "queue-full": 30, "key-in-flight": 1, "worker-busy": 5}

_NAMES = {413: "content-too-large", 416: "range-not-satisfiable", 422: "invalid-request"}
# Python's own names for these differ from version to version.

_TITLES = {
    "artefact-not-ready": "The file is not ready yet",
    "bundle": "The recorded scan cannot be used",
    "calibration": "The calibration cannot be used",
    "calibration-state": "The calibration does not allow this now",
    "catalogue": "The shared catalogue does not answer",
    "config": "A setting does not fit",
    "damaged": "Files are damaged",
    "device": "A device failed",
    "device-busy": "Another program uses the device",
    "device-gone": "A device is gone",
    "device-state": "A device was called in the wrong order",
    "extra-missing": "A library is missing",
    "foreign-page": "The request comes from another site",
    "idempotency": "The request's key was used for another request",
    "invalid-input": "A value does not fit",
    "key-in-flight": "The same request is being answered",
    "pattern": "The patterns do not fit",
    "scan-evidence": "Frames do not show their patterns",
    "scan-state": "The job does not allow this now",
    "live-state": "Live depth does not allow this now",
    "schedule": "The schedule cannot be kept",
    "scope": "This key may not do that",
    "service": "The service failed",
    "slrig": "slrig failed",
    "stage-refused": "The turntable's axis was refused",
    "storage": "The disk refused",
    "unauthorized": "Log in first",
    "unexpected": "Unexpected error",
    "unsupported-by-device": "The device cannot do this",
    "worker-busy": "Too much is computed already",
    "worker-lost": "The computation ended early",
}
"""Titles of problems with codes that do not read as titles."""

_MESSAGES = {
    "extra_forbidden": "There is no such field here; check its spelling. /openapi.json lists those that there are.",
    "timezone_aware": "expected the offset from UTC, too, as in 2026-11-20T06:00:00Z",
}

_PLAIN_DETAILS = {
    "Content Too Large": "The request's body is larger than this service reads. A scan request is a few hundred bytes.",
    "Invalid host header": (
        "This service does not answer to the name in the request's Host header. Use the address that it printed at "
        "its start, or allow the name with --allow-host NAME."
    ),
}


class FieldFault(BaseModel):
    """A fault of one field of a request: its path, the fault, and the value found."""

    field: str
    message: str
    found: Any = None


class Problem(BaseModel):
    """Body of every refusal (RFC 9457). `GET` on `type` explains it."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="stable name of the kind of problem; a path on this service that explains it")
    title: str
    status: int
    detail: str
    errors: list[FieldFault] | None = Field(default=None, description="every fault of an invalid request")
    holder: str | None = Field(default=None, description="who holds the rig")
    since: str | None = Field(default=None, description="since when")


def title_of(code: str) -> str:
    """Title of a kind of problem.

    >>> title_of("config"), title_of("queue-full")
    ('A setting does not fit', 'Queue full')
    """
    return _TITLES.get(code) or code.replace("-", " ").capitalize()


def problem(status: int, code: str, detail: str, **members: Any) -> dict[str, Any]:
    """The members of a problem document, without those that are None."""
    document = {
        "type": f"/problems/{code}",
        "title": title_of(code),
        "status": status,
        "detail": detail,
        **members,
    }
    return {key: value for key, value in document.items() if value is not None}


def fault_problem(fault: JobFailure) -> dict[str, Any]:
    """The problem of a scan's recorded fault."""
    return problem(STATUS.get(fault.code, 500), fault.code, fault.message)


def answer(document: Mapping[str, Any], *, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """A problem as a response."""
    return JSONResponse(document, document["status"], headers, MEDIA_TYPE)


def explanations() -> dict[str, str]:
    """Meaning of each kind of problem, by its slug: the docstrings of the error tree, and of HTTP's own refusals."""
    tree = {code: " ".join((error.__doc__ or "").split()) for code, error in errors_by_code().items()}
    own = {
        "invalid-request": "The request does not fit what is documented in /openapi.json. `errors` has every fault.",
        "unauthorized": "The request carries no API key or session, or one that is wrong, over or revoked.",
        "scope": "The key is not for this: its scopes say what for.",
        "foreign-page": "The request was sent by the page of another site, or of another service of this machine.",
        "unexpected": "slrig met an error it did not expect. The service's log has the details.",
        "not-ready": "The service runs and cannot scan. `checks` says why.",
    }
    http = {_http_code(status): status.description or status.phrase for status in HTTPStatus if status >= 400}
    return {**http, **tree, **own}


def install_problems(app: FastAPI) -> None:
    """Convert every error that a handler raises into a problem."""
    app.add_exception_handler(SlrigError, _slrig_error)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(ClientDisconnect, _gone)
    app.add_exception_handler(Exception, _unexpected)


async def _slrig_error(_request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, SlrigError):
        raise error
    held = {"holder": error.holder, "since": error.since} if isinstance(error, RigBusyError) else {}
    document = problem(STATUS[error.code], error.code, str(error), **held)
    wait_s = RETRY_AFTER_S.get(error.code)
    return answer(document, headers=None if wait_s is None else {"Retry-After": str(wait_s)})


async def _invalid_request(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, RequestValidationError):
        raise error
    faults = error.errors()
    known: Mapping[str, str] = {}
    body = getattr(request.scope.get("route"), "body_field", None)
    if body is not None and any(fault["type"] == "extra_forbidden" for fault in faults):
        known = model_keys(TypeAdapter(body.field_info.annotation))
    found = field_faults(faults, known)
    names = ", ".join(fault["field"] for fault in found)
    noun = "fault" if len(found) == 1 else "faults"
    detail = f"The request has {len(found)} {noun}: {names}. See errors."
    return answer(problem(422, "invalid-request", detail, errors=found))


async def _http_error(_request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, HTTPException):
        raise error
    status = HTTPStatus(error.status_code)
    text = str(error.detail)
    detail = _PLAIN_DETAILS.get(text, text if text != status.phrase else status.description or status.phrase)
    return answer(http_problem(status, detail), headers=error.headers)


async def _gone(_request: Request, _error: Exception) -> JSONResponse:
    # For the measurements and the audit: the client is gone.
    return answer(http_problem(HTTPStatus.BAD_REQUEST, "The client went away before all of its request was here."))


async def _unexpected(_request: Request, error: Exception) -> JSONResponse:
    detail = (
        f"slrig met an error it did not expect ({type(error).__name__}) while it answered this request. The service's "
        "log has the details; please report them."
    )
    return answer(problem(500, UNEXPECTED, detail))


def field_faults(found: Sequence[Any], known: Mapping[str, str] = _NOTHING) -> list[dict[str, Any]]:
    """Faults found by pydantic, as the `errors` of a problem. Values are shown only where they are short.

    known : fields and their places, see `model_keys`, of which one is proposed for a misspelt or misplaced one.
    """
    return [_field_fault(entry, known) for entry in found]


def _field_fault(entry: Any, known: Mapping[str, str]) -> dict[str, Any]:
    if entry["type"] == "json_invalid":
        message = f"is not JSON: {entry['ctx']['error']} at character {entry['loc'][-1]}"
        return {"field": "body", "message": message}
    place = [printable(str(part)) for part in entry["loc"] if part != "body"]
    sent = entry.get("input")
    message = printable(_MESSAGES.get(entry["type"], entry["msg"]))
    if place and entry["type"] == "extra_forbidden" and (advice := proposal(place[-1], known)) is not None:
        message = f"There is no such field here; {advice}"
    fault: dict[str, Any] = {"field": ".".join(place) or "body", "message": message}
    if isinstance(sent, str) and len(sent) <= 80:
        fault["found"] = printable(sent)
    elif isinstance(sent, float) and not abs(sent) <= 1e300:
        # NaN and infinities, which Python's JSON reader accepts, are not JSON in an answer.
        fault["found"] = str(sent)
    elif isinstance(sent, (bool, int, float)):
        fault["found"] = sent
    return fault


def http_problem(status: HTTPStatus, detail: str) -> dict[str, Any]:
    """The problem of a refusal of HTTP's own."""
    return problem(status.value, _http_code(status), detail)


def _http_code(status: HTTPStatus) -> str:
    return _NAMES.get(status.value) or status.name.lower().replace("_", "-")


class PlainErrorsToProblems:
    """Middleware that rewrites the plain-text refusals of Starlette's own parts, which pass by every handler."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        refused: Message | None = None
        body = bytearray()

        async def rewrite(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start" and message["status"] >= 400:
                kind = Headers(raw=message.get("headers", [])).get("content-type", "")
                refused = None if kind.startswith(MEDIA_TYPE) else message
            if refused is None:
                await send(message)
            elif message["type"] == "http.response.body":
                body.extend(message.get("body", b""))
                if not message.get("more_body", False):
                    await _as_problem(refused, bytes(body))(scope, receive, send)

        await self._app(scope, receive, rewrite)


def _as_problem(refused: Message, body: bytes) -> Response:
    """A plain refusal, its first message and its text, as a problem with the headers that it had."""
    status = HTTPStatus(refused["status"])
    text = body.decode("utf-8", "replace")
    detail = _PLAIN_DETAILS.get(text, text or status.description or status.phrase)
    dropped = {"content-type", "content-length"}
    headers = {name: value for name, value in Headers(raw=refused.get("headers", [])).items() if name not in dropped}
    return Response(json.dumps(http_problem(status, detail)), status, headers, MEDIA_TYPE)


_PROBLEM = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
_EVERYWHERE = (400, 401, 403, 413, 429, 500)

BYTES = {"type": "string", "format": "binary"}
"""A body that is neither JSON nor text."""

_TEXTS = {
    "application/json": {"type": "object"},
    **{kind: {"type": "string"} for kind in ("application/xml", "application/yaml", "image/svg+xml", "text/html")},
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that may answer with problems of these statuses. `describe` adds those of every route
    of its kind: 404 where the path names something, 422 where a request may say something.
    """
    return {status: {"description": HTTPStatus(status).phrase, "content": _PROBLEM} for status in statuses}


def file_of(media_type: str, *statuses: int) -> dict[int | str, dict[str, Any]]:
    """The `responses` of a route that answers with a file, or with problems of these statuses."""
    content = {media_type: {"schema": _TEXTS.get(media_type, BYTES)}}
    return {200: {"description": "the file", "content": content}, **problems(*statuses)}


def describe(app: FastAPI) -> dict[str, Any]:
    """The OpenAPI document of the service: every refusal is a problem, and what needs a key says what for."""
    if app.openapi_schema:
        return app.openapi_schema
    document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
    components = document.setdefault("components", {})
    schemas = components.setdefault("schemas", {})
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    definition = Problem.model_json_schema(ref_template="#/components/schemas/{model}")
    schemas.update(definition.pop("$defs", {}))
    schemas["Problem"] = definition
    components["securitySchemes"] = {
        "bearer": {"type": "http", "scheme": "bearer"},
        "header": {"type": "apiKey", "in": "header", "name": "X-API-Key"},
    }
    components["securitySchemes"]["session"] = {"type": "apiKey", "in": "cookie", "name": "slrig_session_PORT"}
    document["security"] = [{"bearer": []}, {"header": []}, {"session": []}]
    for path, operations in document["paths"].items():
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                _without_null(parameter)
            answers = operation["responses"]
            for status, found in list(answers.items()):
                if "HTTPValidationError" in json.dumps(found):
                    del answers[status]
            needed = [status for status in _EVERYWHERE if status != 401 or operation.get("security") != []]
            if "parameters" in operation or "requestBody" in operation:
                needed.append(422)
            if "{" in path:
                needed.append(404)
            if method not in {"get", "head"}:
                needed.append(415)
            for status in needed:
                answers.setdefault(str(status), problems(status)[status])
            operation["responses"] = dict(sorted(answers.items()))
            if operation.get("security") != []:
                operation["x-scope"] = str(needed_scope(method.upper(), path))
    app.openapi_schema = document
    return document


def _without_null(parameter: dict[str, Any]) -> None:
    """Describe an optional parameter without null, which paths, queries and headers do not have."""
    schema = parameter["schema"]
    if "anyOf" in schema:
        (meant,) = (each for each in schema["anyOf"] if each != {"type": "null"})
        parameter["schema"] = {**meant, **{key: value for key, value in schema.items() if key != "anyOf"}}


def text(app: FastAPI) -> str:
    """The document as it is kept in config/openapi.json."""
    return json.dumps(describe(app), indent=2, ensure_ascii=False) + "\n"
