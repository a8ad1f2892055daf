"""The client of a service."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import httpx2

from slrig.client.connection import Connection, Json, given
from slrig.client.events import Event
from slrig.client.resources import (
    Acceptance,
    CalibrationResource,
    Examinations,
    IfBusy,
    Models,
    PresetResource,
    ProgressCallback,
    RigHealth,
    RigState,
    Scans,
    Schedules,
    System,
    TurntableResource,
)
from slrig.client.results import ScanJob, ScanResult
from slrig.errors import ServiceError


class Client:
    """A running service: scans as objects, and each of its requests as a method. A context manager.

    url, key : None: as SLRIG_URL and SLRIG_API_KEY say; without the first, the service of this machine. pause : waits
    between two tries. transport : httpx2's, in place of the network.

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
        self.connection = Connection(url, key, pause=pause, transport=transport)
        self.scans = Scans(self.connection)
        self.models = Models(self.connection)
        self.presets = PresetResource(self.connection)
        self.rig = RigState(self.connection)
        self.examinations = Examinations(self.connection)
        self.calibration = CalibrationResource(self.connection)
        self.health = RigHealth(self.connection)
        self.turntable = TurntableResource(self.connection)
        self.accept = Acceptance(self.connection)
        self.schedules = Schedules(self.connection)
        self.system = System(self.connection)

    def scan(
        self,
        *,
        progress: ProgressCallback | None = None,
        label: str | None = None,
        preset: str | None = None,
        exposure_s: float | None = None,
        exposures_s: Sequence[float] | None = None,
        exposure_factors: Sequence[float] | None = None,
        patterns: Mapping[str, Any] | None = None,
        reconstruction: Mapping[str, Any] | None = None,
        colour: bool | None = None,
        coloured_light: bool | None = None,
        turn_deg: float | None = None,
        turned_by: str | None = None,
        if_busy: IfBusy | None = "queue",
        repeat: int | None = None,
        every_s: float | None = None,
    ) -> ScanResult:
        """Scan, wait for the end, and return the result; of a series, that of its first scan. Ctrl-C cancels the scan.

        Parameters
        ----------
        progress
            Called with the stage, 0 to 1 of the whole, and a detail.
        label
            A name for people.
        preset
            The name of options that the service knows; those given here go first.
        exposure_s, exposures_s
            Of every frame, in seconds; several make a bracket, from which each pixel takes its best.
        exposure_factors
            A bracket as multiples of the rig's exposure.
        patterns, reconstruction
            Options of the patterns and of the reconstruction, such as {"rows": True} and {"region": ...}.
        colour, coloured_light
            Take the colour of the surface by a colour camera; by red, green and blue light.
        turn_deg, turned_by
            The angle of the turntable, in degrees, and what turns it, "table" or "hand".
        if_busy
            "queue": wait while the rig is held; "reject": fail. None: as the service is set up.
        repeat, every_s
            A series of so many scans, one every so many seconds.

        Raises
        ------
        ScanFailedError
            The scan ended without a mesh.
        ScanCancelledError
            Another client cancelled it.
        ServiceError
            The service refused, or is gone.
        """
        job = self.start_scan(
            label=label,
            preset=preset,
            exposure_s=exposure_s,
            exposures_s=exposures_s,
            exposure_factors=exposure_factors,
            patterns=patterns,
            reconstruction=reconstruction,
            colour=colour,
            coloured_light=coloured_light,
            turn_deg=turn_deg,
            turned_by=turned_by,
            if_busy=if_busy,
            repeat=repeat,
            every_s=every_s,
        )
        try:
            return job.result(progress)
        except Exception:
            raise
        except BaseException:
            with suppress(ServiceError):
                job.cancel()
            raise

    def start_scan(
        self,
        *,
        label: str | None = None,
        preset: str | None = None,
        exposure_s: float | None = None,
        exposures_s: Sequence[float] | None = None,
        exposure_factors: Sequence[float] | None = None,
        patterns: Mapping[str, Any] | None = None,
        reconstruction: Mapping[str, Any] | None = None,
        colour: bool | None = None,
        coloured_light: bool | None = None,
        turn_deg: float | None = None,
        turned_by: str | None = None,
        if_busy: IfBusy | None = "queue",
        repeat: int | None = None,
        every_s: float | None = None,
    ) -> ScanJob:
        """Start a scan, and return at once. The options are those of `scan`. Raises ServiceError."""
        options = given(
            label=label,
            preset=preset,
            exposure_s=exposure_s,
            exposures_s=exposures_s,
            exposure_factors=exposure_factors,
            patterns=patterns,
            reconstruction=reconstruction,
            colour=colour,
            coloured_light=coloured_light,
            turn_deg=turn_deg,
            turned_by=turned_by,
            if_busy=if_busy,
            repeat=repeat,
            every_s=every_s,
        )
        return ScanJob(self.connection, self.scans.start(**options))

    def job(self, scan_id: str) -> ScanJob:
        """A scan on record, to follow."""
        return ScanJob(self.connection, self.scans.get(scan_id))

    def result(self, scan_id: str) -> ScanResult:
        """The result of a scan on record; waits for its end."""
        return self.job(scan_id).result()

    def get(self, link: str) -> Json:
        """The JSON behind a link of an answer, such as `next` of a page."""
        return self.connection.json("GET", link)

    def post(self, link: str, request: Mapping[str, Any] | None = None) -> Json:
        """Send a POST to a link of an answer, such as `cancel`, and return the answer."""
        body = {} if request is None else {"json": request}
        return self.connection.json("POST", link, **body)

    def delete(self, link: str) -> None:
        """Send a DELETE to a link of an answer."""
        self.connection.send("DELETE", link)

    def fetch(self, link: str, path: str | Path) -> None:
        """Write the file behind a link of an answer, whole or not at all."""
        self.connection.fetch(link, Path(path))

    def follow(self, link: str) -> Iterator[Event]:
        """The events of the job whose `events` link this is, until it is done."""
        return self.connection.follow(link)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close its connections."""
        self.connection.http.close()
