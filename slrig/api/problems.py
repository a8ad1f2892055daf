"""Errors as RFC 9457 problems: one table from error classes to status codes, and nothing else leaves the service."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slrig import errors
from slrig.errors import RigBusyError, SlrigError
from slrig.failure import UNEXPECTED, JobFailure, errors_by_code

MEDIA_TYPE = "application/problem+json"

STATUS: Mapping[type[SlrigError], int] = {
    errors.SlrigError: 500,
    errors.InvalidInputError: 422,
    errors.ConfigError: 422,
    errors.BundleError: 422,
    errors.CalibrationError: 422,
    errors.PatternError: 422,
    errors.ScheduleError: 422,
    errors.ScheduleNotFoundError: 404,
    errors.ScanEvidenceError: 502,
    errors.NothingToReconstructError: 422,
    errors.DeviceError: 502,
    errors.DeviceGoneError: 503,
    errors.DeviceBusyError: 503,
    errors.DeviceStateError: 500,
    errors.UnsupportedByDeviceError: 422,
    errors.WrongSystemError: 422,
    errors.FrameTimeoutError: 504,
    errors.DriverNotFoundError: 503,
    errors.DriverBrokenError: 503,
    errors.LibraryMissingError: 503,
    errors.RigBusyError: 409,
    errors.QueueFullError: 429,
    errors.ScanCancelledError: 409,
    errors.CameraNotFoundError: 404,
    errors.PoseRefusedError: 422,
    errors.SolveRefusedError: 422,
    errors.CalibrationNotFoundError: 404,
    errors.CalibrationStateError: 409,
    errors.JobNotFoundError: 404,
    errors.ArtefactNotReadyError: 409,
    errors.ScanStateError: 409,
    errors.IdempotencyError: 422,
    errors.StorageError: 507,
    errors.ServiceError: 502,
    errors.WorkerLostError: 500,
    errors.OutOfMemoryError: 500,
    errors.ScanInterruptedError: 503,
    errors.KeyInFlightError: 409,
}
"""Which status stands for which error. A test holds it against the whole error tree."""

RETRY_AFTER_S: Mapping[type[SlrigError], int] = {
    errors.RigBusyError: 5,
    errors.QueueFullError: 30,
    errors.KeyInFlightError: 1,
}

_NAMES = {413: "content-too-large", 416: "range-not-satisfiable", 422: "invalid-request"}
# Python's own names for these differ from version to version.

_MESSAGES = {
    "extra_forbidden": "There is no such field here; look at its spelling. /openapi.json lists those that there are.",
}

_PLAIN_DETAILS = {
    "Content Too Large": "The request's body is larger than this service reads. A scan request is a few hundred bytes.",
    "Invalid host header": (
        "This service does not answer to the name in the request's Host header. Use the address that it printed at "
        "its start, or allow the name with --allow-host NAME."
    ),
}


class FieldFault(BaseModel):
    """One thing wrong with a request: where, what, and what was found there."""

    field: str
    message: str
    found: Any = None


class Problem(BaseModel):
    """What every refusal looks like (RFC 9457). `GET` on `type` explains it."""

    model_config = ConfigDict(extra="allow")

    type: str = Field(description="stable name of the kind of problem; a path on this service that explains it")
    title: str
    status: int
    detail: str
    errors: list[FieldFault] | None = Field(default=None, description="every fault of an invalid request")
    holder: str | None = Field(default=None, description="who holds the rig")
    since: str | None = Field(default=None, description="since when")


def problem(status: int, code: str, detail: str, **members: Any) -> dict[str, Any]:
    """The members of a problem document, without those that are None."""
    document = {
        "type": f"/problems/{code}",
        "title": code.replace("-", " ").capitalize(),
        "status": status,
        "detail": detail,
        **members,
    }
    return {key: value for key, value in document.items() if value is not None}


def fault_problem(fault: JobFailure) -> dict[str, Any]:
    """The problem that stands for a scan's recorded fault."""
    known = errors_by_code().get(fault.code)
    return problem(500 if known is None else STATUS[known], fault.code, fault.message)


def answer(document: Mapping[str, Any], *, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """A problem as a response."""
    return JSONResponse(
        document,
        status_code=document["status"],
        media_type=MEDIA_TYPE,
        headers=None if headers is None else {**headers},
    )


def explanations() -> dict[str, str]:
    """What each kind of problem means, by its slug: the docstrings of the error tree, and of HTTP's own refusals."""
    tree = {code: " ".join((error.__doc__ or "").split()) for code, error in errors_by_code().items()}
    own = {
        "invalid-request": "The request does not fit what is documented in /openapi.json. `errors` has every fault.",
        "unauthorized": "The request carries no API key, or a wrong one. The key was printed at the first start.",
        "unexpected": "slrig met an error it did not expect. The service's log has the details.",
        "not-ready": "The service runs and cannot scan. `checks` says why.",
    }
    http = {_http_code(status): status.description or status.phrase for status in HTTPStatus if status >= 400}
    return {**http, **tree, **own}


def install_problems(app: FastAPI) -> None:
    """Have every error that a handler raises leave `app` as a problem."""
    app.add_exception_handler(SlrigError, _slrig_error)
    app.add_exception_handler(RequestValidationError, _invalid_request)
    app.add_exception_handler(HTTPException, _http_error)
    app.add_exception_handler(Exception, _unexpected)


async def _slrig_error(_request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, SlrigError):
        raise error
    held = {"holder": error.holder, "since": error.since} if isinstance(error, RigBusyError) else {}
    document = problem(STATUS[errors_by_code()[error.code]], error.code, str(error), **held)
    wait_s = RETRY_AFTER_S.get(type(error))
    return answer(document, headers=None if wait_s is None else {"Retry-After": str(wait_s)})


async def _invalid_request(request: Request, error: Exception) -> JSONResponse:
    if not isinstance(error, RequestValidationError):
        raise error
    found = field_faults(error.errors(), is_json="json" in request.headers.get("content-type", "").lower())
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
    return answer(_http_problem(status, detail), headers=error.headers)


async def _unexpected(_request: Request, error: Exception) -> JSONResponse:
    detail = (
        f"slrig met an error it did not expect ({type(error).__name__}) while it answered this request. The service's "
        "log has the details; please report them."
    )
    return answer(problem(500, UNEXPECTED, detail))


def field_faults(found: Sequence[Any], *, is_json: bool = True) -> list[dict[str, Any]]:
    """What pydantic found, as the `errors` of a problem. What was sent is shown only where it is short.

    `is_json` says whether the request called its body JSON.
    """
    faults_found = []
    for entry in found:
        if entry["type"] == "json_invalid":
            message = f"is no JSON: {entry['ctx']['error']} at character {entry['loc'][-1]}"
            faults_found.append({"field": "body", "message": message})
            continue
        if entry["loc"] == ("body",) and not is_json:
            message = "expected a JSON object; send it with Content-Type: application/json"
            faults_found.append({"field": "body", "message": message})
            continue
        place = [printable(str(part)) for part in entry["loc"] if part != "body"]
        sent = entry.get("input")
        message = printable(_MESSAGES.get(entry["type"], entry["msg"]))
        fault: dict[str, Any] = {"field": ".".join(place) or "body", "message": message}
        if isinstance(sent, str) and len(sent) <= 80:
            fault["found"] = printable(sent)
        elif isinstance(sent, float) and not abs(sent) <= 1e300:
            # NaN and infinities, which Python's JSON reader lets through, are no JSON on the way out.
            fault["found"] = str(sent)
        elif isinstance(sent, (bool, int, float)):
            fault["found"] = sent
        faults_found.append(fault)
    return faults_found


def printable(text: str) -> str:
    r"""The text with an escape for what UTF-8 cannot hold: half a surrogate pair, which JSON can.

    >>> printable("\ud800")
    '\\ud800'
    """
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def _http_problem(status: HTTPStatus, detail: str) -> dict[str, Any]:
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
        refused: int | None = None
        headers: list[tuple[bytes, bytes]] = []
        body = bytearray()

        async def rewrite(message: Message) -> None:
            nonlocal refused
            if message["type"] == "http.response.start":
                kept = {name.lower(): value for name, value in message.get("headers", ())}
                if message["status"] >= 400 and not kept.get(b"content-type", b"").startswith(MEDIA_TYPE.encode()):
                    refused = message["status"]
                    dropped = {b"content-type", b"content-length"}
                    headers.extend((name, value) for name, value in kept.items() if name not in dropped)
                    return
            elif refused is not None and message["type"] == "http.response.body":
                body.extend(message.get("body", b""))
                if not message.get("more_body", False):
                    await self._send_problem(send, HTTPStatus(refused), headers, bytes(body))
                return
            await send(message)

        await self._app(scope, receive, rewrite)

    async def _send_problem(
        self, send: Send, status: HTTPStatus, headers: list[tuple[bytes, bytes]], body: bytes
    ) -> None:
        text = body.decode("utf-8", "replace")
        detail = _PLAIN_DETAILS.get(text, text or status.description or status.phrase)
        content = json.dumps(_http_problem(status, detail)).encode()
        length = (b"content-length", str(len(content)).encode())
        start = {
            "type": "http.response.start",
            "status": status.value,
            "headers": [*headers, (b"content-type", MEDIA_TYPE.encode()), length],
        }
        await send(start)
        await send({"type": "http.response.body", "body": content})
