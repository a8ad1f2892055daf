"""Exceptions of a client: the service's problems (RFC 9457). All are ServiceErrors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import httpx2

from slrig import KEY_VARIABLE
from slrig.errors import ServiceError
from slrig.printable import printable


class UnreachableError(ServiceError):
    """The service does not answer: it is not started, or the connection broke for good."""


class ForeignAnswerError(ServiceError):
    """The server is not a slrig service."""


class RefusedError(ServiceError):
    """The service refused a request, or its work failed.

    code : the problem's name, such as "rig-busy"; GET /problems/NAME explains it. status : of HTTP. detail : the
    problem as text. fields : of an invalid request, each fault as {"field", "message", "found"}. problem : the whole
    document, with `holder` and `since` where the rig is held. retry_after_s : when to try again, if it says so.
    """

    code: str  # type: ignore[misc] # of the service's error, not of this class

    def __init__(self, problem: Mapping[str, Any], *, retry_after_s: float | None = None, hint: str = "") -> None:
        self.problem = dict(problem)
        self.code = str(problem.get("type", "")).rpartition("/")[2] or "unknown"
        self.status = int(problem.get("status", 0))
        self.detail = printable(str(problem["detail"]))
        self.fields: list[dict[str, Any]] = list(problem.get("errors") or ())
        self.retry_after_s = retry_after_s
        lines = [self.detail, *(printable(f"  {fault['field']}: {fault['message']}") for fault in self.fields), hint]
        super().__init__("\n".join(filter(None, lines)))


class UnauthorizedError(RefusedError):
    """The key is missing, wrong, over, or not for this."""


class NotFoundError(RefusedError):
    """Nothing of this id or name is on record there."""


class ConflictError(RefusedError):
    """The rig is held (code "rig-busy"), or the request conflicts with the state of its subject."""


class InvalidRequestError(RefusedError):
    """The request says something that cannot be done; `fields` has every fault."""


class TooManyError(RefusedError):
    """Too many jobs wait, or too many requests came: `retry_after_s` says when to try again."""


class ScanFailedError(RefusedError):
    """A scan ended without a mesh. scan : as it is on record."""

    def __init__(self, scan: Mapping[str, Any]) -> None:
        fault = scan["error"]
        super().__init__({**fault, "detail": f"Scan {scan['id']} {scan['state']}: {fault['detail']}"})
        self.scan = dict(scan)


class ModelFailedError(RefusedError):
    """A model was not made, or cancelled. model : as it is on record."""

    def __init__(self, model: Mapping[str, Any]) -> None:
        fault = model["error"]
        super().__init__({**fault, "detail": f"Model {model['id']} {model['state']}: {fault['detail']}"})
        self.model = dict(model)


class ExaminationFailedError(RefusedError):
    """An examination found nothing: it failed or was cancelled. examination : as it is on record."""

    def __init__(self, examination: Mapping[str, Any]) -> None:
        fault = examination["error"]
        super().__init__({**fault, "detail": f"The examination {examination['state']}: {fault['detail']}"})
        self.examination = dict(examination)


_KINDS = {
    401: UnauthorizedError,
    403: UnauthorizedError,
    404: NotFoundError,
    409: ConflictError,
    422: InvalidRequestError,
    429: TooManyError,
}


def refusal(response: httpx2.Response) -> ServiceError:
    """The error of an answer with a status from 400 on. Its body has been read."""
    status = response.status_code
    wait = response.headers.get("Retry-After", "")
    # For users of both the command line and Python.
    hint = f"Set {KEY_VARIABLE}, or name its file with --key-file." if status == 401 else ""
    try:
        problem = {"status": status, **response.json()}
        kind = _KINDS.get(status, RefusedError)
        return kind(problem, retry_after_s=float(wait) if wait.isdecimal() else None, hint=hint)
    except (ValueError, KeyError, TypeError, AttributeError):
        return foreign(response, hint)


def foreign(response: httpx2.Response, hint: str = "") -> ForeignAnswerError:
    """The error of an answer that is not like slrig's."""
    message = (
        f"{response.request.url} answered {response.status_code} {response.reason_phrase}, and not as slrig does. "
        "Is another program listening there? Name the service with --url."
    )
    return ForeignAnswerError("\n".join(filter(None, (message, hint))))
