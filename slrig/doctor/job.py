"""The doctor and the latency of the light as jobs; and the last examination of each kind in the data folder.

A command that ran without the service leaves its file there, too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Any, ClassVar
from uuid import UUID

import structlog
from pydantic import BaseModel, Field, ValidationError

from slrig.bundle import write_file
from slrig.capture.latency import DEFAULT_SEARCH_S, DEFAULT_TRIALS, measure_latency
from slrig.devices import Rig, Trigger
from slrig.discovery import discover_devices, installed_drivers
from slrig.doctor.doctor import examine, latency_document
from slrig.errors import StorageError
from slrig.jobs.data_folder import SCANS
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.records import JobKind, utc_now
from slrig.rig.session import RigSession
from slrig.scan.plan import PatternPlan, ScanPlan, rig_sequence


@dataclass(frozen=True, slots=True)
class DoctorJob(Job):
    """An examination of the open rig: light, timing, picture, response, flicker, exposure.

    patterns, exposure_s : of a scan on this rig. search_s : longest latency to search for, seconds.
    """

    kind: ClassVar[JobKind] = JobKind.DOCTOR
    computes: ClassVar[bool] = False
    noun: ClassVar[str] = "examination"

    patterns: PatternPlan
    exposure_s: float | None = None
    search_s: float = DEFAULT_SEARCH_S

    def capture(self, rig: RigSession, run: JobRun) -> Outcome:
        """Examine the rig. What is measured next depends on what was found, so nothing is left to compute afterwards.
        The summary is the `Diagnosis`. Raises DeviceError, and as the rig's drivers do.
        """
        opened = rig.open_whole()
        run.step("looking for displays", 0.0, "")
        # Light engines, trigger boxes, and outputs with a display.
        projectors = {driver.name for driver in installed_drivers() if driver.kind == "projector"}
        displays = tuple(device for device in discover_devices().devices if device.driver in projectors)
        lines = self.patterns.named
        diagnosis = examine(
            self._as_scanned(opened),
            run,
            own_sequence=rig_sequence(ScanPlan(patterns=self.patterns), opened),
            displays=displays,
            period_px=lines.period_px,
            steps=lines.steps or lines.period_px,
            sines=lines.sines,
            search_s=self.search_s,
        )
        return Outcome(diagnosis.document())

    def _as_scanned(self, rig: Rig) -> Rig:
        """The rig with the exposure that scans use, where one is set for all cameras."""
        if self.exposure_s is None:
            return rig
        exposed = {name: replace(each, exposure_s=self.exposure_s) for name, each in rig.settings.items()}
        return replace(rig, settings=exposed)


@dataclass(frozen=True, slots=True)
class LatencyJob(Job):
    """A measurement of how late the light is. trials : flashes of each camera. trigger : how the cameras are triggered;
    None the best way that they and the projector have.
    """

    kind: ClassVar[JobKind] = JobKind.LATENCY
    computes: ClassVar[bool] = False
    noun: ClassVar[str] = "latency measurement"

    trials: int = DEFAULT_TRIALS
    search_s: float = DEFAULT_SEARCH_S
    exposure_s: float | None = None
    trigger: Trigger | None = None

    def capture(self, rig: RigSession, run: JobRun) -> Outcome:
        """Flash the projector, and fit latency and line time of each camera. Raises DeviceError, ScanEvidenceError."""
        opened = rig.open_whole()
        measured = measure_latency(
            opened, trials=self.trials, search_s=self.search_s, exposure_s=self.exposure_s, trigger=self.trigger,
            on_progress=run.step,
        )  # fmt: skip
        return Outcome({"rig": rig.name, **latency_document(measured, opened.synchronisation)})


EXAMINATIONS = (JobKind.DOCTOR, JobKind.LATENCY, JobKind.CONFORMANCE)

_log = structlog.get_logger(__name__)


class Examination(BaseModel):
    """What an examination found, and when."""

    at: datetime
    found: dict[str, Any] = Field(description="as the command prints it as JSON")


class Examinations:
    """The last examination of each kind: the `Group` of examinations."""

    def __init__(self, root: Path) -> None:
        """Root : of the data folder."""
        self._root = root

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`."""

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:  # noqa: ARG002 - as it is called
        """See `Group`. One that cannot be kept is on the record of its job all the same."""
        if outcome is None or outcome.summary is None:
            return outcome or Outcome()
        try:
            keep(self._root, job.kind, outcome.summary)
        except StorageError as error:
            _log.warning("an examination could not be kept", kind=str(job.kind), cause=str(error))
        return outcome


def keep(data: Path, kind: str, found: Mapping[str, Any]) -> bool:
    """Keep what an examination found in a data folder, and return whether it is one. Raises StorageError."""
    is_one = (data / SCANS).is_dir()
    if is_one:
        write_file(data / f"{kind}.json", Examination(at=utc_now(), found=dict(found)).model_dump_json().encode())
    return is_one


def last_examination(data: Path, kind: str, rig: str) -> Examination | None:
    """What an examination found last on the rig of that name; None where nothing was, or what lies there is no such
    file.
    """
    try:
        kept = Examination.model_validate_json((data / f"{kind}.json").read_bytes())
    except (OSError, ValidationError):
        return None
    return kept if kept.found.get("rig") == rig else None
