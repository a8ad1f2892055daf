"""Acceptance tests on a running service: opened, measured position by position or by script, and kept. No HTTP here."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

from slrig.accept.plan import AcceptancePlan
from slrig.accept.records import AcceptanceRecord, AcceptanceState, with_jobs
from slrig.accept.running import Evaluate, by_positioner, measured, required_calibration
from slrig.accept.store import AcceptanceStore
from slrig.accept.verdicts import AcceptanceResult, verdicts
from slrig.devices import Rig
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    DeviceBusyError,
    InvalidInputError,
    JobNotFoundError,
    ScanStateError,
)
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.queue import JobQueue
from slrig.jobs.records import Clock, JobRecord, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, RigJobs
from slrig.jobs.store import JobStore
from slrig.model import Calibration
from slrig.rig.session import RigSession


class AcceptanceDesk:
    """The tests of one service, those of earlier runs among them. Any thread may call; `close` at the end. Raises
    StorageError.
    """

    def __init__(
        self,
        folder: DataFolder,
        queue: JobQueue,
        jobs: JobStore,
        *,
        evaluate: Evaluate,
        report: Callable[[AcceptanceResult, Path], None],
        tolerance_mm: float | None = None,
        clock: Clock = utc_now,
    ) -> None:
        """`evaluate` : as `slrig.accept.running.evaluated`. report : writes the reports of a test. jobs : those of
        positions. tolerance_mm : what a point may be wrong by in what the rig is for, by the rig file.
        """
        self._data = folder
        self._store = AcceptanceStore(folder)
        self._queue = queue
        self.jobs = jobs
        self._work = RigJobs(jobs, queue, folder)
        self._clock, self._wanted_mm = clock, tolerance_mm
        self._evaluate, self._report = evaluate, report
        self._lock = threading.RLock()
        self._tests = {record.id: record for record in self._store.load()}

    def take_up(self) -> None:
        """Go on with the positions that waited when the service ended; those that had the rig were interrupted."""
        for test_id, jobs in self.jobs.of().items():
            if test_id not in self._tests:
                self.jobs.delete_of(test_id)
                continue
            for job in jobs:
                if not job.state.final:
                    parts = self._parts(test_id, scripted=job.plan["scripted"])
                    self._work.take_up(job, parts, holder=_holder(test_id))

    def close(self) -> None:
        """Put on record what the disk refused before. Idempotent."""
        self._work.close()

    def open(self, plan_of: Callable[[Calibration, float | None], AcceptancePlan]) -> AcceptanceRecord:
        """Open a test of the rig as it is calibrated now, and of what its rig file wants. Touches no device.

        Raises DeviceBusyError if the rig is not open yet, CalibrationError if it has no calibration, InvalidInputError
        if the plan cannot be done; StorageError.
        """
        with self._lock:
            rig = self._queue.rig
            if rig.facts is None:
                message = "The rig is being opened. Ask again in a moment."
                raise DeviceBusyError(message)
            calibration = rig.facts.calibration if rig.active is None else rig.active.calibration
            if calibration is None:
                message = f"rig '{rig.name}' has no calibration, and nothing can be measured; calibrate it first"
                raise CalibrationError(message)
            number = 1 + max((each.number for each in self._tests.values()), default=0)
            plan = plan_of(calibration, self._wanted_mm)
            record = AcceptanceRecord(number, uuid4(), self._clock(), rig.name, calibration.solve_id, plan)
            self._store.save(record)
            self._tests[record.id] = record
        return record

    def get(self, test_id: UUID) -> AcceptanceRecord:
        """Return a test. Raises JobNotFoundError."""
        with self._lock:
            return with_jobs(self._found(test_id), self.jobs.of(test_id).get(test_id, ()))

    def latest(self) -> tuple[AcceptanceRecord, ...]:
        """Return all tests, newest first."""
        with self._lock:
            jobs = self.jobs.of()
            return tuple(with_jobs(record, jobs.get(record.id, ())) for record in reversed(self._tests.values()))

    def measure(
        self, test_id: UUID, *, wait: bool, scripted: bool, key: str | None = None, holder: Holder | None = None
    ) -> JobRecord:
        """Have the next position measured, or, scripted, all that are left; return the job at once.

        By hand, the artefact is to stand in its place. `wait` lets it stand in line behind other work. key : the
        idempotency key of the request, reserved. holder : whom a refusal names meanwhile; None the test.

        Raises JobNotFoundError, ScanStateError if there is no such test, or it is being measured, or it is over;
        RigBusyError, QueueFullError, DeviceError as a scan.
        """
        with self._lock:
            record = self.get(test_id)
            if not record.state.waiting:
                message = f"Acceptance test {test_id} is {record.state}; a position is measured while it is open."
                raise ScanStateError(message)
            job_id, parts = uuid4(), self._parts(test_id, scripted=scripted)
            told = partial(
                self.jobs.create,
                {"scripted": scripted}, rig=record.rig, label=None, key=key, job_id=job_id, parent=test_id,
            )  # fmt: skip
            self._work.submit(job_id, parts, holder=holder or _holder(test_id), wait=wait, record=told)
            return self.jobs.get(job_id)

    def cancel(self, test_id: UUID) -> AcceptanceRecord:
        """End a test. Returns at once; one that is over stays so. Raises JobNotFoundError, StorageError."""
        with self._lock:
            if self.get(test_id).state.waiting:
                self._change(test_id, state=AcceptanceState.CANCELLED)
            under_way = [job.id for job in self.jobs.of(test_id).get(test_id, ()) if not job.state.final]
        for job_id in under_way:
            self._work.cancel(job_id)
        return self.get(test_id)

    def delete(self, test_id: UUID) -> None:
        """Forget a test and remove its files. Raises JobNotFoundError, ScanStateError, StorageError."""
        with self._lock:
            if self.get(test_id).state is AcceptanceState.MEASURING:
                message = f"Acceptance test {test_id} is being measured. Cancel it, then delete it."
                raise ScanStateError(message)
            self._store.delete(test_id)
            del self._tests[test_id]
            self.jobs.delete_of(test_id)

    def file(self, test_id: UUID, name: str) -> Path:
        """Return where a report lies. Raises JobNotFoundError, ArtefactNotReadyError."""
        record = self.get(test_id)
        path = self._store.folder(test_id) / name
        if record.state is not AcceptanceState.FINISHED or not self._data.owns(path):
            reason = f"has no {name} before every position is measured."
            message = f"Acceptance test {test_id} is {record.state}, and {reason}"
            raise ArtefactNotReadyError(message)
        return path

    def _found(self, test_id: UUID) -> AcceptanceRecord:
        """A test as it is on disk."""
        with self._lock:
            record = self._tests.get(test_id)
        if record is None:
            message = f"No acceptance test {test_id} is on record here. GET /acceptance lists those that are."
            raise JobNotFoundError(message)
        return record

    def _parts(self, test_id: UUID, *, scripted: bool) -> Parts:
        """Captures and evaluates, with the rig; then the report, where all is measured."""
        calibration: Calibration | None = None

        def capture(held: RigSession, job: Job, progress: ProgressRecorder) -> None:
            nonlocal calibration
            rig = held.open()
            calibration = _same_calibration(self._found(test_id), rig)
            self._measure(test_id, rig, progress, job.stop.is_set, scripted=scripted)

        def compute(*_: object) -> Outcome:
            record = self._found(test_id)
            if record.next_take is None and calibration is not None:
                self._conclude(record, calibration)
            return Outcome({"captures_done": len(record.readings)})

        return Parts(compute, capture)

    def _measure(
        self, test_id: UUID, rig: Rig, progress: ProgressRecorder, cancelled: Callable[[], bool], *, scripted: bool
    ) -> None:
        """On the rig's thread: measure one position, or all that are left."""
        record = self._change(test_id, readings=self._found(test_id).from_first_take().readings)
        plan = record.plan
        if plan.rendered and rig.truth() is None:
            message = "exact artefacts are those of a rendered rig, and this one is not; send the certificates' values"
            raise InvalidInputError(message)
        place = by_positioner(rig, plan) if scripted else None
        for found in measured(
            rig, plan, len(record.readings), self._store.folder(test_id),
            progress=progress, cancelled=cancelled, place=place, evaluate=self._evaluate,
        ):  # fmt: skip
            record = self._change(test_id, readings=(*record.readings, found))
            following = record.next_take
            # A repeat goes with its first: nothing is moved between them.
            if place is None and (following is None or following[1] == 0):
                break

    def _conclude(self, record: AcceptanceRecord, calibration: Calibration) -> None:
        """Decide, and write the reports: every position is measured."""
        result = AcceptanceResult(
            record.rig, record.created_at, self._clock(), record.plan, calibration, record.readings,
            verdicts(record.readings, record.plan),
        )  # fmt: skip
        self._report(result, self._store.folder(record.id))
        self._change(record.id, state=AcceptanceState.FINISHED, decision=result.decision)

    def _change(self, test_id: UUID, **changes: Any) -> AcceptanceRecord:
        """Put a change on record, and return the test. Raises StorageError, and changes nothing then."""
        with self._lock:
            changed = replace(self._found(test_id), **changes)
            self._store.save(changed)
            self._tests[test_id] = changed
            return changed


def _holder(test_id: UUID) -> Holder:
    words = f"acceptance test {test_id}"
    return Holder(words, words, f"/acceptance/{test_id}")


def _same_calibration(record: AcceptanceRecord, rig: Rig) -> Calibration:
    """The rig's calibration. Raises CalibrationStateError unless it is the one that the test began with."""
    calibration = required_calibration(rig)
    if calibration.solve_id != record.calibration:
        message = (
            f"Acceptance test {record.id} is of calibration {record.calibration}, and the rig now uses "
            f"{calibration.solve_id}. Activate the first again, or open a new test."
        )
        raise CalibrationStateError(message)
    return calibration
