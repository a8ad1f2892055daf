"""Requests and their answers, events and pictures, written once over a wire."""

from __future__ import annotations

import io
import json
import uuid
from collections.abc import AsyncGenerator, AsyncIterator, Mapping
from contextlib import aclosing, asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeAlias, TypeVar

import httpx2

from slrig.client.errors import UnreachableError, foreign, refusal
from slrig.client.events import Event, event_of
from slrig.client.wire import Awaited, Blocking
from slrig.disk import refusals_of, staging_name

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """(H, W) grey or (H, W, 3) red, green, blue."""

PATIENCE_S = 30.0
"""How long a connection that broke is tried again before the service counts as gone."""

_RETRY_S = 0.5
_BUSY_TRIES = 20  # of a file that the service has no time to make: half a minute each
_HEAD_END = b"\r\n\r\n"
_LENGTH = b"content-length:"

Json: TypeAlias = dict[str, Any]
W = TypeVar("W", bound="Blocking | Awaited")


@dataclass(frozen=True, slots=True)
class Core(Generic[W]):
    """One service, over a wire."""

    wire: W

    async def send(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        once: bool = False,
        **body: Any,
    ) -> httpx2.Response:
        """Send a request and return the answer. once : however often it is sent, the service does it once.

        Raises
        ------
        ServiceError
            The service refuses, or cannot be reached.
        """
        # By its key the service knows whether the first one arrived.
        headers = {"Idempotency-Key": uuid.uuid4().hex} if once else {}
        headers |= body.pop("headers", {})
        request = self.wire.http.build_request(method, path, params=params, headers=headers, **body)
        try:
            try:
                response = await self._sent(request)
            except (httpx2.ReadError, httpx2.RemoteProtocolError):
                if not once:
                    raise
                response = await self._sent(request)
        except httpx2.TransportError as error:
            raise self._unreached(error) from error
        if response.status_code >= 400:
            raise refusal(response)
        return response

    async def content(self, kind: str, method: str, path: str, **request: Any) -> Any:
        """Send a request and return what it answers. kind : "Json", "str", "bytes", "Picture" or "None"."""
        response = await self.send(method, path, **request)
        if kind == "Json":
            try:
                return response.json()
            except ValueError as error:
                raise foreign(response) from error
        if kind == "Picture":
            return await self.wire.apart(lambda: decoded(response.content))
        return {"str": response.text, "bytes": response.content}.get(kind)

    def follow_all(self, path: str, **request: Any) -> AsyncGenerator[Event]:
        """Yield what happens to all jobs, from now on or as the request says. See `follow`."""
        return self.follow(path, seen=None, **request)

    async def follow(self, path: str, *, seen: int | None = 0, **request: Any) -> AsyncGenerator[Event]:
        """Yield what happens to a job, from its first event to its last, whatever happens to the connection.

        seen : number of the event to begin after; None: as the request says.

        Raises
        ------
        ServiceError
            The service is gone for longer than `PATIENCE_S`, or refuses.
        """
        waited_s = 0.0
        while True:
            headers = {"Accept": "text/event-stream", "Cache-Control": "no-store"}
            if seen is not None:
                headers["Last-Event-ID"] = str(seen)
            try:
                async with self._opened(path, headers=headers, **request) as response:
                    if response.status_code == 204:
                        return
                    async with aclosing(self.wire.events(response)) as events:
                        async for event in events:
                            waited_s, seen = 0.0, int(event.id)
                            # One without data only says where the stream begins.
                            if event.data:
                                yield event_of(seen, event.event, json.loads(event.data))
            except (httpx2.SSEError, ValueError) as error:
                raise foreign(response) from error
            except httpx2.TransportError as error:
                if waited_s >= PATIENCE_S:
                    raise self._unreached(error) from error
                waited_s += _RETRY_S
                await self.wire.pause(_RETRY_S)

    async def pictures(self, path: str, **request: Any) -> AsyncGenerator[Picture]:
        """Yield each picture of a stream of JPEG pictures. Raises ServiceError."""
        try:
            async with (
                self._opened(path, **request) as response,
                aclosing(self.wire.pieces(response)) as pieces,
                aclosing(_parts(pieces)) as parts,
            ):
                async for part in parts:
                    yield await self.wire.apart(lambda jpeg=part: decoded(jpeg))  # type: ignore[misc]
        except httpx2.TransportError as error:
            raise self._unreached(error) from error

    async def fetch(self, path: str, target: Path) -> None:
        """Write an answer into a file, whole or not at all. Raises ServiceError, StorageError."""
        partial = staging_name(target)
        try:
            async with self._opened(path) as response, aclosing(self.wire.pieces(response)) as pieces:
                with refusals_of(target):
                    file = await self.wire.apart(lambda: partial.open("xb"))
                with file:
                    async for piece in pieces:
                        with refusals_of(target):
                            await self.wire.apart(lambda data=piece: file.write(data))  # type: ignore[misc]
            with refusals_of(target):
                partial.replace(target)
        except httpx2.TransportError as error:
            raise self._unreached(error) from error
        finally:
            partial.unlink(missing_ok=True)

    @asynccontextmanager
    async def _opened(self, path: str, **request: Any) -> AsyncIterator[httpx2.Response]:
        """A streamed answer; closed at the end. Raises ServiceError where it is a refusal."""
        response = await self._sent(self.wire.http.build_request("GET", path, **request), stream=True)
        try:
            if response.status_code >= 400:
                await self.wire.read(response)
                raise refusal(response)
            yield response
        finally:
            await self.wire.shut(response)

    async def _sent(self, request: httpx2.Request, *, stream: bool = False) -> httpx2.Response:
        """The answer to a request. A service that says when to ask again, because it has no time to make a file now, is
        asked again for some minutes.
        """
        tries = _BUSY_TRIES if request.method == "GET" else 1
        while True:
            tries -= 1
            response = await self.wire.send(request, stream=stream)
            later_s = response.headers.get("Retry-After", "") if response.status_code == 503 else ""
            if not (later_s.isdecimal() and tries):
                return response
            await self.wire.shut(response)
            await self.wire.pause(float(later_s))

    def _unreached(self, error: Exception) -> UnreachableError:
        url = str(self.wire.http.base_url).rstrip("/")
        return UnreachableError(
            f"The service at {url} cannot be reached ({error}). Start it with `slrig serve RIG`, or name another with "
            "--url."
        )


async def _parts(pieces: AsyncIterator[bytes]) -> AsyncGenerator[bytes]:
    """The bodies of a multipart stream whose parts state their lengths."""
    waiting = b""
    async for piece in pieces:
        waiting += piece
        while (end := waiting.find(_HEAD_END)) >= 0:
            stated = [line for line in waiting[:end].lower().splitlines() if line.startswith(_LENGTH)]
            start = end + len(_HEAD_END)
            if not stated:
                # Empty lines that show that somebody is there.
                waiting = waiting[end + 2 :]
                continue
            length = int(stated[-1].removeprefix(_LENGTH))
            if len(waiting) < start + length:
                break
            yield waiting[start : start + length]
            waiting = waiting[start + length :]


def decoded(encoded: bytes) -> Picture:
    """The pixels of a PNG or JPEG."""
    import numpy as np
    from PIL import Image

    with Image.open(io.BytesIO(encoded)) as image:
        return np.asarray(image)
