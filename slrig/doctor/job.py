"""The examinations of a rig as jobs: the doctor, and how late its light is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from slrig.capture import DEFAULT_SEARCH_S, DEFAULT_TRIALS, measure_latency
from slrig.devices import Rig, Trigger
from slrig.discovery import discover_devices, installed_drivers
from slrig.doctor.doctor import examine, latency_document
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.records import JobKind
from slrig.rig.session import RigSession
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.plan_check import rig_sequence


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
        opened = rig.open()
        run.step("looking for displays", 0.0, "")
        # Light engines, trigger boxes, and outputs with a display.
        projectors = {driver.name for driver in installed_drivers() if driver.kind == "projector"}
        displays = tuple(device for device in discover_devices().devices if device.driver in projectors)
        lines = self.patterns.named
        diagnosis = examine(
            self._as_scanned(opened),
            own_sequence=rig_sequence(ScanPlan(patterns=self.patterns), opened),
            displays=displays,
            period_px=lines.period_px,
            steps=lines.steps or lines.period_px,
            sines=lines.sines,
            search_s=self.search_s,
            progress=run.step,
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
        measured = measure_latency(
            rig.open(), trials=self.trials, search_s=self.search_s, exposure_s=self.exposure_s, trigger=self.trigger,
            on_progress=run.step,
        )  # fmt: skip
        return Outcome({"rig": rig.name, **latency_document(measured)})
