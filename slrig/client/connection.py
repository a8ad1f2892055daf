"""Requests to a service and their answers: JSON, files, pictures, events, over connections that break."""

from __future__ import annotations

import json
import os
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias
from urllib.parse import quote, urlsplit

import httpx2

from slrig import KEY_VARIABLE, local_key_path
from slrig.client.errors import UnreachableError, foreign, refusal
from slrig.disk import staging_name, storage_errors
from slrig.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """(H, W) grey or (H, W, 3) red, green, blue."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Event:
    """An event. number : rises from event to event. job : its id, where all jobs are followed. An event of a kind that
    this client does not know has no more.
    """

    number: int
    job: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress(Event):
    """Progress of a job. fraction : 0 to 1 of the whole. pose : of a calibration, its number."""

    stage: str = ""
    fraction: float = 0.0
    detail: str = ""
    pose: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class StateChange(Event):
    """The new state of a job or a calibration; `error` is the problem that it failed of."""

    state: str = ""
    error: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Captured(Event):
    """The rig is free of the job; its frames are reconstructed from now on. pose : of a calibration, its number."""

    pose: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class FileReady(Event):
    """A file of a scan can be fetched from now on."""

    name: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseChange(Event):
    """The new state of a pose of a calibration."""

    pose: int = 0
    state: str = ""
    error: Mapping[str, Any] | None = None


_KINDS: Mapping[str, type[Event]] = {
    "progress": Progress,
    "state": StateChange,
    "captured": Captured,
    "file": FileReady,
    "pose": PoseChange,
}


def event_of(number: int, kind: str, data: Mapping[str, Any]) -> Event:
    """An event as it was sent.

    >>> event_of(3, "file", {"name": "mesh.ply"})
    FileReady(number=3, job=None, name='mesh.ply')
    """
    found = _KINDS.get(kind, Event)
    known = {field.name for field in fields(found)} - {"number"}
    return found(number=number, **{name: value for name, value in data.items() if name in known})


URL = "http://127.0.0.1:8731"
PATIENCE_S = 30.0
"""Time in which a broken connection is tried again before the service counts as gone."""

_LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
_RETRY_S = 0.5
_BUSY_TRIES = 20  # of a file that the service has no time to make: half a minute each
_HEAD_END = b"\r\n\r\n"
_LENGTH = b"content-length:"

Json: TypeAlias = dict[str, Any]


class Connection:
    """The connections to one service.

    url, key : None: as SLRIG_URL and SLRIG_API_KEY say; without the first, the service of this machine; without the
    second, what a service of the same user on this machine left for its programs. pause : waits
    between two tries. transport : httpx2's, in place of the network.

    Raises
    ------
    ConfigError
        The address is not a URL, or the key holds a character that no key has.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        pause: Callable[[float], None] = time.sleep,
        transport: httpx2.BaseTransport | None = None,
    ) -> None:
        self.http = _http(url, key, transport)
        self._pause = pause

    def send(
        self, method: str, path: str, *, params: Mapping[str, Any] | None = None, once: bool = False, **body: Any
    ) -> httpx2.Response:
        """Send a request and return the answer. once : however often it is sent, the service does it once.

        Raises
        ------
        ServiceError
            The service refuses, or cannot be reached.
        """
        # By its key the service knows whether the first request arrived.
        headers = {"Idempotency-Key": uuid.uuid4().hex} if once else {}
        headers |= body.pop("headers", {})
        request = self.http.build_request(method, path, params=params, headers=headers, **body)
        try:
            try:
                response = self._send(request)
            except (httpx2.ReadError, httpx2.RemoteProtocolError):
                if not once:
                    raise
                response = self._send(request)
        except httpx2.TransportError as error:
            raise self._unreachable(error) from error
        if response.status_code >= 400:
            raise refusal(response)
        return response

    def json(self, method: str, path: str, **request: Any) -> Json:
        """The JSON that a request is answered with. See `send`."""
        response = self.send(method, path, **request)
        try:
            return response.json()  # type: ignore[no-any-return]
        except ValueError as error:
            raise foreign(response) from error

    def picture(self, path: str, **request: Any) -> Picture:
        """The pixels of a PNG or JPEG. See `send`."""
        return decode_picture(self.send("GET", path, **request).content)

    def follow(self, path: str, *, after: int | None = 0, **request: Any) -> Iterator[Event]:
        """Yield the events of a job, from the first to the last, also across broken connections.

        after : number of the event to begin after; None: as the request says.

        Raises
        ------
        ServiceError
            The service is gone for longer than `PATIENCE_S`, or refuses.
        """
        waited_s = 0.0
        while True:
            headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
            if after is not None:
                headers["Last-Event-ID"] = str(after)
            try:
                with self._stream(path, headers=headers, **request) as response:
                    if response.status_code == 204:
                        return
                    for event in httpx2.EventSource(response):
                        waited_s, after = 0.0, int(event.id)
                        # An event without data only says where the stream begins.
                        if event.data:
                            yield event_of(after, event.event, json.loads(event.data))
            except (httpx2.SSEError, ValueError) as error:
                raise foreign(response) from error
            except httpx2.TransportError as error:
                if waited_s >= PATIENCE_S:
                    raise self._unreachable(error) from error
                waited_s += _RETRY_S
                self._pause(_RETRY_S)

    def pictures(self, path: str, **request: Any) -> Iterator[Picture]:
        """Yield each picture of a stream of JPEG pictures. Raises ServiceError."""
        try:
            with self._stream(path, **request) as response:
                for part in _parts(response.iter_bytes()):
                    yield decode_picture(part)
        except httpx2.TransportError as error:
            raise self._unreachable(error) from error

    @contextmanager
    def streamed(self, path: str, **request: Any) -> Iterator[Iterator[bytes]]:
        """The pieces of an answer as they come. Raises ServiceError."""
        try:
            with self._stream(path, **request) as response:
                yield response.iter_bytes()
        except httpx2.TransportError as error:
            raise self._unreachable(error) from error

    def fetch(self, path: str, target: Path) -> None:
        """Write an answer into a file, whole or not at all. Raises ServiceError, StorageError."""
        partial = staging_name(target)
        try:
            with self._stream(path) as response:
                with storage_errors(target):
                    file = partial.open("xb")
                with file:
                    for piece in response.iter_bytes():
                        with storage_errors(target):
                            file.write(piece)
            with storage_errors(target):
                partial.replace(target)
        except httpx2.TransportError as error:
            raise self._unreachable(error) from error
        finally:
            partial.unlink(missing_ok=True)

    @contextmanager
    def _stream(self, path: str, **request: Any) -> Iterator[httpx2.Response]:
        """A streamed answer, closed at the end. Raises ServiceError where it is a refusal."""
        response = self._send(self.http.build_request("GET", path, **request), stream=True)
        try:
            if response.status_code >= 400:
                response.read()
                raise refusal(response)
            yield response
        finally:
            response.close()

    def _send(self, request: httpx2.Request, *, stream: bool = False) -> httpx2.Response:
        """The answer to a request. Where the service has no time to make a file now and says when to try again, the
        request is repeated for some minutes.
        """
        tries = _BUSY_TRIES if request.method in {"GET", "HEAD"} else 1
        while True:
            tries -= 1
            response = self.http.send(request, stream=stream)
            later_s = response.headers.get("Retry-After", "") if response.status_code == 503 else ""
            if not (later_s.isdecimal() and tries):
                return response
            response.close()
            self._pause(float(later_s))

    def _unreachable(self, error: Exception) -> UnreachableError:
        url = str(self.http.base_url).rstrip("/")
        return UnreachableError(
            f"The service at {url} cannot be reached ({error}). Start it with `slrig serve RIG`, or name another with "
            "--url."
        )


class Resource:
    """A group of the service's requests."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection


def path(template: str, *names: object) -> str:
    """A path with names in it, each quoted.

    >>> path("/calibration/{}/pose/{}", "a/b", 3)
    '/calibration/a%2Fb/pose/3'
    """
    return template.format(*(quote(str(name), safe="") for name in names))


def given(**options: Any) -> Json:
    """The options that are not None: the service has defaults for the others.

    >>> given(label="cup", exposure_s=None)
    {'label': 'cup'}
    """
    return {name: value for name, value in options.items() if value is not None}


def document_body(document: Mapping[str, Any] | str | bytes) -> Json:
    """A document as the body of a request: slrig's own as JSON, OpenCV's files by how they begin."""
    if isinstance(document, Mapping):
        return {"json": document}
    start = document[:1] if isinstance(document, str) else document[:1].decode("latin-1")
    kind = {"{": "json", "<": "xml"}.get(start, "yaml")
    return {"content": document, "headers": {"Content-Type": f"application/{kind}"}}


def decode_picture(encoded: bytes) -> Picture:
    """The pixels of a PNG or JPEG: grey, or red, green and blue. Raises ValueError: it is neither."""
    import cv2
    import numpy as np

    found = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    if found is None:
        message = f"{len(encoded)} bytes came that are not a picture"
        raise ValueError(message)
    return found if found.ndim == 2 else np.ascontiguousarray(found[..., ::-1])


def _parts(pieces: Iterator[bytes]) -> Iterator[bytes]:
    """The bodies of a multipart stream with parts that state their lengths."""
    waiting = b""
    for piece in pieces:
        waiting += piece
        while (end := waiting.find(_HEAD_END)) >= 0:
            stated = [line for line in waiting[:end].lower().splitlines() if line.startswith(_LENGTH)]
            start = end + len(_HEAD_END)
            if not stated:
                # Empty lines, which keep the connection open.
                waiting = waiting[end + 2 :]
                continue
            length = int(stated[-1].removeprefix(_LENGTH))
            if len(waiting) < start + length:
                break
            yield waiting[start : start + length]
            waiting = waiting[start + length :]


def _local_key(url: str) -> str | None:
    """The key of a service of the same user on this machine; None for another service."""
    with suppress(OSError, ValueError):
        parts = urlsplit(url)
        if parts.hostname in _LOCAL:
            return local_key_path(parts.port or 80).read_text("ascii").strip() or None
    return None


def _http(url: str | None, key: str | None, transport: httpx2.BaseTransport | None) -> httpx2.Client:
    url = url or os.environ.get("SLRIG_URL") or URL
    key = key if key is not None else os.environ.get(KEY_VARIABLE) or _local_key(url)
    if key is not None and not (key.isascii() and key.isprintable()):
        message = (
            f"The API key holds a character that no key has. Copy it again as the service printed it, into "
            f"{KEY_VARIABLE} or the file that --key-file names."
        )
        raise ConfigError(message)
    headers = {"Authorization": f"Bearer {key}"} if key else {}
    try:
        parts = urlsplit(url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            fault = "it has no http:// or no host"
            raise ValueError(fault)  # noqa: TRY301 - one message for this and for what httpx2 refuses
        # A proxy of the environment is for other machines.
        elsewhere = parts.hostname not in _LOCAL
        timeout = httpx2.Timeout(30, read=60)
        return httpx2.Client(base_url=url, headers=headers, timeout=timeout, trust_env=elsewhere, transport=transport)
    except (httpx2.InvalidURL, ValueError) as error:
        message = f"'{url}' is not a URL of a service: {error}. Write it as http://127.0.0.1:8731."
        raise ConfigError(message) from error
