"""A client of the service: starts scans, follows them through broken connections, fetches files."""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self
from urllib.parse import urlsplit

import httpx2

from slrig import KEY_VARIABLE
from slrig.disk import refusals_of, staging_name
from slrig.errors import ConfigError, ServiceError
from slrig.printable import printable

PATIENCE_S = 30.0
"""How long a connection that broke is tried again before the service counts as gone."""

_RETRY_S = 0.5
_LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})


def read_key(file: Path | None) -> str | None:
    """The API key: from `file`, else from the environment, else None. Raises ConfigError."""
    if file is None:
        return os.environ.get(KEY_VARIABLE) or None
    try:
        return file.read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError) as error:
        message = (
            f"The API key cannot be read from {file}: {error}. Name the file that holds it, or set {KEY_VARIABLE}."
        )
        raise ConfigError(message) from error


@dataclass(frozen=True, slots=True)
class Readiness:
    """What /readyz tells. checks : each thing "ok" or what it lacks; pending : those that get there by themselves."""

    checks: dict[str, str]
    pending: frozenset[str]


class ServiceClient:
    """Talks to one service. A context manager."""

    def __init__(
        self,
        url: str,
        key: str | None,
        *,
        pause: Callable[[float], None] = time.sleep,
        transport: httpx2.BaseTransport | None = None,
    ) -> None:
        if key is not None and not (key.isascii() and key.isprintable()):
            message = (
                f"The API key holds a character that no key has. Copy it again as the service printed it, into "
                f"{KEY_VARIABLE} or the file that --key-file names."
            )
            raise ConfigError(message)
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        try:
            parts = urlsplit(url)
            if parts.scheme not in {"http", "https"} or not parts.hostname:
                fault = "it has no http:// or no host"
                raise ValueError(fault)  # noqa: TRY301 - told together with what httpx refuses
            # A proxy of the environment is for other machines.
            elsewhere = parts.hostname not in _LOCAL
            self._http = httpx2.Client(
                base_url=url,
                headers=headers,
                timeout=httpx2.Timeout(30, read=60),
                trust_env=elsewhere,
                transport=transport,
            )
        except (httpx2.InvalidURL, ValueError) as error:
            message = f"'{url}' is no URL of a service: {error}. Write it as http://127.0.0.1:8731."
            raise ConfigError(message) from error
        self._url = url
        self._pause = pause

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._http.close()

    def readiness(self) -> Readiness | None:
        """Return what the service says of its parts; None while it does not answer."""
        try:
            answer = self._http.get("/readyz").json()
            return Readiness(dict(answer["checks"]), frozenset(answer.get("pending", ())))
        except (httpx2.TransportError, ValueError, KeyError, TypeError):
            return None

    def start(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Start a scan and return it. Raises ServiceError."""
        # One repeat after a broken connection: by its key the service knows whether the first one arrived.
        headers = {"Idempotency-Key": uuid.uuid4().hex}
        with self._reaching():
            try:
                response = self._http.post("/scan", json=dict(request), headers=headers)
            except (httpx2.ReadError, httpx2.RemoteProtocolError):
                response = self._http.post("/scan", json=dict(request), headers=headers)
            return _content(response)

    def get(self, path: str) -> dict[str, Any]:
        """Return a JSON answer. Raises ServiceError."""
        with self._reaching():
            return _content(self._http.get(path))

    def post(self, path: str, request: Mapping[str, Any] | None) -> dict[str, Any]:
        """Send a request that may be repeated without harm, and return the JSON answer. Raises ServiceError."""
        with self._reaching():
            return _content(self._http.post(path, json=None if request is None else dict(request)))

    def delete(self, path: str) -> None:
        """Delete what is at a path. Raises ServiceError."""
        with self._reaching():
            _refuse_problem(self._http.delete(path))

    def follow(self, scan: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield what happens to a scan, from its first event to its last, whatever happens to the connection.

        Raises
        ------
        ServiceError
            The service is gone for longer than `PATIENCE_S`, or refuses.
        """
        seen = 0
        waited_s = 0.0
        while True:
            try:
                headers = {"Last-Event-ID": str(seen)}
                with self._http.sse(scan["links"]["events"], headers=headers) as source:
                    response = source.response
                    if response.status_code == 204:
                        return
                    if response.status_code != 200:
                        response.read()
                        _refuse_problem(response)
                    for event in source:
                        waited_s = 0.0
                        seen = int(event.id)
                        yield {"kind": event.event, **json.loads(event.data)}
            except httpx2.TransportError as error:
                if waited_s >= PATIENCE_S:
                    raise self._unreached(error) from error
                waited_s += _RETRY_S
                self._pause(_RETRY_S)

    def fetch(self, path: str, target: Path) -> None:
        """Write an answer into a file, whole or not at all. Raises ServiceError, StorageError."""
        partial = staging_name(target)
        try:
            with self._reaching(), self._http.stream("GET", path) as response:
                if response.status_code != 200:
                    response.read()
                    _refuse_problem(response)
                with refusals_of(target), partial.open("xb") as file:
                    for piece in response.iter_bytes(2**20):
                        file.write(piece)
            with refusals_of(target):
                partial.replace(target)
        finally:
            partial.unlink(missing_ok=True)

    @contextmanager
    def _reaching(self) -> Iterator[None]:
        try:
            yield
        except httpx2.TransportError as error:
            raise self._unreached(error) from error

    def _unreached(self, error: Exception) -> ServiceError:
        return ServiceError(
            f"The service at {self._url} cannot be reached ({error}). Start it with `slrig serve RIG`, or name another "
            "with --url."
        )


def _content(response: httpx2.Response) -> dict[str, Any]:
    _refuse_problem(response)
    content: dict[str, Any] = response.json()
    return content


def _refuse_problem(response: httpx2.Response) -> None:
    if response.status_code < 400:
        return
    try:
        problem = response.json()
        lines = [printable(str(problem["detail"]))]
        lines += [printable(f"  {fault['field']}: {fault['message']}") for fault in problem.get("errors", ())]
    except (ValueError, KeyError, TypeError, AttributeError):
        lines = [
            f"{response.request.url} answered {response.status_code} {response.reason_phrase}, and not as slrig does. "
            "Is another program listening there? Name the service with --url."
        ]
    if response.status_code == 401:
        lines.append(f"Set {KEY_VARIABLE}, or name its file with --key-file.")
    raise ServiceError("\n".join(lines))
