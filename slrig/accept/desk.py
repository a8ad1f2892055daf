"""Acceptance tests on a running service: opened, measured position by position or by script, and kept. No HTTP here."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import structlog

from slrig.accept.plan import AcceptancePlan
from slrig.accept.records import AcceptanceRecord, AcceptanceState, RequestKey
from slrig.accept.running import Evaluate, by_positioner, measured, required_calibration
from slrig.accept.store import AcceptanceStore, interruption_fault
from slrig.accept.verdicts import AcceptanceResult, verdicts
from slrig.calibrate.pose_shooting import RigQueue
from slrig.devices import Rig
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    DeviceBusyError,
    InvalidInputError,
    JobNotFoundError,
    ScanCancelledError,
    ScanInterruptedError,
    ScanStateError,
    StorageError,
)
from slrig.failure import failure_of
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Holder
from slrig.jobs.records import Clock, JobProgress, require_same_body, utc_now
from slrig.model import Calibration

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class _Held:
    """A test, and the id of its work with the rig."""

    record: AcceptanceRecord
    work_id: UUID | None = None


class AcceptanceDesk:
    """The tests of one service, those of earlier runs among them. Any thread may call.

    Raises
    ------
    StorageError
        The disk refused.
    """

    def __init__(
        self,
        folder: DataFolder,
        queue: RigQueue,
        *,
        evaluate: Evaluate,
        report: Callable[[AcceptanceResult, Path], None],
        clock: Clock = utc_now,
    ) -> None:
        """`evaluate` : as `slrig.accept.running.evaluated`. report : writes the reports of a test."""
        self._store = AcceptanceStore(folder)
        self._queue = queue
        self._clock = clock
        self._evaluate, self._report = evaluate, report
        self._lock = threading.RLock()
        self._tests = {record.id: _Held(record) for record in self._store.load()}

    def open(
        self, plan_of: Callable[[Calibration], AcceptancePlan], *, key: RequestKey | None = None
    ) -> AcceptanceRecord:
        """Open a test of the rig as it is calibrated now, or return the one that a request with this key opened before.

        Touches no device.

        Raises
        ------
        IdempotencyError
            The key was sent before with another request.
        DeviceBusyError
            The rig is not open yet.
        CalibrationError, InvalidInputError
            It has no calibration, or the plan cannot be done.
        StorageError
            The disk refused.
        """
        with self._lock:
            if key is not None:
                for held in self._tests.values():
                    opened = held.record.opened_by
                    if opened is not None and opened.key == key.key:
                        require_same_body(opened.fingerprint, key.fingerprint, made="request")
                        return held.record
            status = self._queue.status()
            if status.facts is None:
                message = "The rig is being opened. Ask again in a moment."
                raise DeviceBusyError(message)
            calibration = status.facts.calibration if status.active is None else status.active.calibration
            if calibration is None:
                message = f"rig '{status.rig}' has no calibration, and nothing can be measured; calibrate it first"
                raise CalibrationError(message)
            number = 1 + max((held.record.number for held in self._tests.values()), default=0)
            record = AcceptanceRecord(
                number, uuid4(), self._clock(), status.rig, calibration.solve_id, plan_of(calibration), opened_by=key
            )
            self._store.save(record)
            self._tests[record.id] = _Held(record)
        return record

    def get(self, test_id: UUID) -> AcceptanceRecord:
        """Return a test. Raises JobNotFoundError."""
        return self._held(test_id).record

    def latest(self) -> tuple[AcceptanceRecord, ...]:
        """Return all tests, newest first."""
        with self._lock:
            return tuple(held.record for held in reversed(self._tests.values()))

    def measure(
        self,
        test_id: UUID,
        *,
        wait: bool,
        scripted: bool,
        key: RequestKey | None = None,
        holder: Holder | None = None,
    ) -> AcceptanceRecord:
        """Have the next position measured, or, scripted, all that are left; return at once.

        By hand, the artefact is to stand in its place. `wait` lets it stand in line behind other work. A request with
        a key that came before changes nothing. holder : whom a refusal names meanwhile; None the test.

        Raises
        ------
        JobNotFoundError, ScanStateError
            There is no such test, or it is being measured, or it is over.
        IdempotencyError
            The key was sent before with another request.
        RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        with self._lock:
            held = self._held(test_id)
            if key is not None and key.key in held.record.measured_by:
                require_same_body(held.record.measured_by[key.key], key.fingerprint, made="request")
                return held.record
            if not held.record.state.waiting:
                message = f"Acceptance test {test_id} is {held.record.state}; a position is measured while it is open."
                raise ScanStateError(message)
            words = f"acceptance test {test_id}"
            keys = {} if key is None else {key.key: key.fingerprint}

            def begun(work_id: UUID) -> None:
                held.work_id = work_id
                held.record = replace(
                    held.record,
                    state=AcceptanceState.MEASURING,
                    fault=None,
                    measured_by={**held.record.measured_by, **keys},
                )

            self._queue.submit_work(
                lambda rig, cancelled: self._measure(held, rig, cancelled, scripted=scripted),
                holder=holder or Holder(words, words, f"/acceptance/{test_id}"),
                wait=wait,
                ended=lambda error: self._ended(held, error),
                begun=begun,
            )
            return held.record

    def cancel(self, test_id: UUID) -> AcceptanceRecord:
        """End a test. Returns at once; one that is over stays so. Raises JobNotFoundError, StorageError."""
        with self._lock:
            held = self._held(test_id)
            work_id = held.work_id
            if held.record.state.waiting:
                self._change(held, state=AcceptanceState.CANCELLED)
        if work_id is not None:
            self._queue.cancel_work(work_id)
        return held.record

    def delete(self, test_id: UUID) -> None:
        """Forget a test and remove its files. Raises JobNotFoundError, ScanStateError, StorageError."""
        with self._lock:
            held = self._held(test_id)
            if held.record.state is AcceptanceState.MEASURING:
                message = f"Acceptance test {test_id} is being measured. Cancel it, then delete it."
                raise ScanStateError(message)
            self._store.delete(test_id)
            del self._tests[test_id]

    def file(self, test_id: UUID, name: str) -> Path:
        """Return where a report lies. Raises JobNotFoundError, ArtefactNotReadyError."""
        record = self.get(test_id)
        path = self._store.folder(test_id) / name
        if record.state is not AcceptanceState.FINISHED or not path.is_file():
            message = (
                f"Acceptance test {test_id} is {record.state}, and has no {name} before every position is measured."
            )
            raise ArtefactNotReadyError(message)
        return path

    def _held(self, test_id: UUID) -> _Held:
        with self._lock:
            held = self._tests.get(test_id)
        if held is None:
            message = f"No acceptance test {test_id} is on record here. GET /acceptance lists those that are."
            raise JobNotFoundError(message)
        return held

    def _measure(self, held: _Held, rig: Rig, cancelled: Callable[[], bool], *, scripted: bool) -> None:
        """On the rig's thread: measure one position, or all that are left."""
        with self._lock:
            self._change(held, readings=held.record.from_first_take().readings)
        plan = held.record.plan
        calibration = _same_calibration(held.record, rig)
        if plan.rendered and rig.truth() is None:
            message = "exact artefacts are those of a rendered rig, and this one is not; send the certificates' values"
            raise InvalidInputError(message)
        place = by_positioner(rig, plan) if scripted else None
        folder = self._store.folder(held.record.id)
        count = len(plan.takes)
        while (following := held.record.next_take) is not None:
            step, take = following
            done = len(held.record.readings)

            def told(stage: str, fraction: float, detail: str, /, name: str = step.name, done: int = done) -> None:
                share = (done + min(max(fraction, 0.0), 1.0)) / count
                with self._lock:
                    held.record = replace(held.record, progress=JobProgress(f"{name}: {stage}", share, detail))

            if cancelled():
                message = f"the acceptance test was cancelled before {step.name}"
                raise ScanCancelledError(message)
            if place is not None and take == 0:
                place(rig, step)
            found = measured(rig, plan, step, take, folder, progress=told, cancelled=cancelled, evaluate=self._evaluate)
            self._change(held, readings=(*held.record.readings, found))
            following = held.record.next_take
            # A repeat goes with its first: nothing is moved between them.
            if place is None and (following is None or following[1] == 0):
                break
        if held.record.next_take is None:
            record = held.record
            result = AcceptanceResult(
                rig.name, record.created_at, self._clock(), plan, calibration, record.readings,
                verdicts(record.readings, plan),
            )  # fmt: skip
            self._report(result, folder)
            self._change(held, state=AcceptanceState.FINISHED, decision=result.decision, progress=None)

    def _change(self, held: _Held, **changes: Any) -> None:
        """Put a change on record. Raises StorageError, and changes nothing then."""
        with self._lock:
            changed = replace(held.record, **changes)
            self._store.save(changed)
            held.record = changed

    def _ended(self, held: _Held, error: Exception | None) -> None:
        """The rig is free."""
        state, fault = AcceptanceState.OPEN, None if error is None else failure_of(error)
        if held.record.state is AcceptanceState.FINISHED:
            state = AcceptanceState.FINISHED
        elif isinstance(error, ScanCancelledError):
            state = AcceptanceState.CANCELLED
        elif isinstance(error, ScanInterruptedError):
            state, fault = AcceptanceState.INTERRUPTED, interruption_fault()
        with self._lock:
            held.work_id = None
            held.record = replace(held.record, state=state, fault=fault, progress=None)
            try:
                self._store.save(held.record)
            except StorageError:
                # Whoever waits is told by the record in memory.
                _log.exception("the end of a measurement could not be put on record", acceptance=str(held.record.id))


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
