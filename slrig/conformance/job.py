"""An examination by the driver contract as a job."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from slrig.conformance.running import run_checks
from slrig.jobs.job import Job, JobRun, Outcome
from slrig.jobs.records import JobKind
from slrig.rig.session import RigSession
from slrig.scan.plan import PatternPlan, ScanPlan, rig_sequence


@dataclass(frozen=True, slots=True)
class ConformanceJob(Job):
    """Every check of the driver contract. patterns : of a scan on this rig."""

    kind: ClassVar[JobKind] = JobKind.CONFORMANCE
    computes: ClassVar[bool] = False
    noun: ClassVar[str] = "examination"

    patterns: PatternPlan

    def capture(self, rig: RigSession, run: JobRun) -> Outcome:
        """Close the rig, and examine it; many checks open it again. The summary is the `ConformanceReport`. Where a
        device hangs, the checks before that are on record. Raises DeviceError, PatternError.
        """
        sequence = rig_sequence(ScanPlan(patterns=self.patterns), rig.open())
        report = run_checks(
            rig.open_for_checks, sequence, run, calls=rig.calls,
            found=lambda report: run.found(report.document()),
        )  # fmt: skip
        return Outcome(report.document())
