"""The two clients of a service: one that blocks, one that is awaited."""

from __future__ import annotations

import os
import time
from collections.abc import AsyncGenerator, Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Self, TypeVar, Unpack
from urllib.parse import urlsplit

import httpx2

from slrig import KEY_VARIABLE
from slrig.client.core import Core, Json, W
from slrig.client.endpoints import (
    Acceptance,
    Calibrations,
    Presets,
    RigHealth,
    RigState,
    ScanOptions,
    Scans,
    Schedules,
    System,
)
from slrig.client.events import Event
from slrig.client.models import Models
from slrig.client.operations import Operation, Remote
from slrig.client.scans import ScanJob, ScanResult, Told
from slrig.client.stage import RigStage
from slrig.client.wire import Awaited, Blocking
from slrig.errors import ConfigError, ServiceError

URL = "http://127.0.0.1:8731"

_LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})
H = TypeVar("H", httpx2.Client, httpx2.AsyncClient)


class _Service(Remote[W]):
    """What both clients offer: scans as objects; the service's interface in namespaces; what links of answers name."""

    def __init__(self, wire: W) -> None:
        super().__init__(Core(wire))
        self.scans = Scans(self.core)
        self.models = Models(self.core)
        self.presets = Presets(self.core)
        self.rig = RigState(self.core)
        self.calibration = Calibrations(self.core)
        self.health = RigHealth(self.core)
        self.stage = RigStage(self.core)
        self.accept = Acceptance(self.core)
        self.schedules = Schedules(self.core)
        self.system = System(self.core)

    async def _start_scan(self, **options: Unpack[ScanOptions]) -> ScanJob[W]:
        """Start a scan, which waits in line while the rig is held; see `ScanOptions`. Raises ServiceError."""
        asked = {name: value for name, value in {"if_busy": "queue", **options}.items() if value is not None}
        return ScanJob(self.core, await self.core.content("Json", "POST", "/scan", once=True, json=asked))

    start_scan = Operation(_start_scan)

    @Operation
    async def scan(self, *, progress: Told | None = None, **options: Unpack[ScanOptions]) -> ScanResult[W]:
        """Scan, and wait for the end; of a series, for that of its first scan. Ctrl-C, or the end of the task that
        waits, cancels it. See `start_scan`, `ScanJob.result`.
        """
        job = await self._start_scan(**options)
        try:
            return await job.awaited(progress)
        except (Exception, GeneratorExit):
            raise
        except BaseException:
            with suppress(ServiceError):
                await self.core.send("POST", job.scan["links"]["cancel"])
            raise

    async def _job(self, scan_id: str) -> ScanJob[W]:
        return ScanJob(self.core, await self.core.content("Json", "GET", f"/scan/{scan_id}"))

    job = Operation(_job, doc="A scan on record, to be followed.")

    @Operation
    async def result(self, scan_id: str) -> ScanResult[W]:
        """What came of a scan on record; waits for its end."""
        return await (await self._job(scan_id)).awaited()

    @Operation
    async def get(self, link: str) -> Json:
        """The JSON that a link of an answer leads to, such as `next` of a page."""
        return await self.core.content("Json", "GET", link)  # type: ignore[no-any-return]

    @Operation
    async def post(self, link: str, request: Mapping[str, Any] | None = None) -> Json:
        """Do what a link of an answer names, such as `cancel`, and return the answer."""
        body = {} if request is None else {"json": request}
        return await self.core.content("Json", "POST", link, **body)  # type: ignore[no-any-return]

    @Operation
    async def delete(self, link: str) -> None:
        """Delete what a link of an answer leads to."""
        await self.core.send("DELETE", link)

    @Operation
    async def fetch(self, link: str, path: str | Path) -> None:
        """Write the file that a link of an answer leads to, whole or not at all."""
        await self.core.fetch(link, Path(path))

    @Operation
    def follow(self, link: str) -> AsyncGenerator[Event]:
        """What happens to the job whose `events` link this is, until it is over."""
        return self.core.follow(link)


class Client(_Service[Blocking]):
    """A service, called and waited for. A context manager.

    url, key : None: as SLRIG_URL and SLRIG_API_KEY say; without the first, the service of this machine. pause : what
    waits between two tries. transport : httpx2's, in place of the network.

    Raises
    ------
    ConfigError
        The address is no URL, or the key holds a character that no key has.
    """

    def __init__(
        self,
        url: str | None = None,
        key: str | None = None,
        *,
        pause: Callable[[float], None] = time.sleep,
        transport: httpx2.BaseTransport | None = None,
    ) -> None:
        super().__init__(Blocking(_http(httpx2.Client, url, key, transport=transport), pause))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self.core.wire.http.close()


class AsyncClient(_Service[Awaited]):
    """The same, awaited, on asyncio's event loop. See `Client`."""

    def __init__(
        self, url: str | None = None, key: str | None = None, *, transport: httpx2.AsyncBaseTransport | None = None
    ) -> None:
        super().__init__(Awaited(_http(httpx2.AsyncClient, url, key, transport=transport)))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.aclose()

    async def aclose(self) -> None:
        """Close its connections."""
        await self.core.wire.http.aclose()


def _http(kind: type[H], url: str | None, key: str | None, **options: Any) -> H:
    url = url or os.environ.get("SLRIG_URL") or URL
    key = key if key is not None else os.environ.get(KEY_VARIABLE) or None
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
            raise ValueError(fault)  # noqa: TRY301 - told together with what httpx refuses
        # A proxy of the environment is for other machines.
        elsewhere = parts.hostname not in _LOCAL
        timeout = httpx2.Timeout(30, read=60)
        return kind(base_url=url, headers=headers, timeout=timeout, trust_env=elsewhere, **options)
    except (httpx2.InvalidURL, ValueError) as error:
        message = f"'{url}' is no URL of a service: {error}. Write it as http://127.0.0.1:8731."
        raise ConfigError(message) from error
