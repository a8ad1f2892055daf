"""Acceptance tests on a running service: opened, measured position by position or by script, and kept. No HTTP here.

DATA/acceptance/ID/points/   what each capture gave
DATA/acceptance/ID/report.html, report.json   when every position is measured

A test under way lives in memory: one that is cut off by the end of the service keeps its points and is not taken up.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from uuid import UUID, uuid4

from slrig.devices import Rig
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    DeviceBusyError,
    InvalidInputError,
    ScanCancelledError,
    ScanNotFoundError,
    ScanStateError,
)
from slrig.model import Calibration
from slrig.scan.records import Clock, utc_now
from slrig.scan.work import Holder
from slrig.sessions.acceptance.evaluation import Evidence, Reading
from slrig.sessions.acceptance.plan import AcceptancePlan, Step
from slrig.sessions.acceptance.running import AcceptanceResult, ReconstructBundle, by_positioner, measured, verdicts
from slrig.sessions.calibration.pose_shooting import RigLender


class AcceptanceState(StrEnum):
    """How far a test is. OPEN: it waits for its next position."""

    OPEN = "open"
    MEASURING = "measuring"
    FINISHED = "finished"
    CANCELLED = "cancelled"


@dataclass(frozen=True, slots=True)
class AcceptanceRecord:
    """One test. error : why the last position was not measured, None where it was; it may be measured again.

    progress : stage, fraction and detail of what is under way.
    """

    id: UUID
    created_at: datetime
    plan: AcceptancePlan
    state: AcceptanceState = AcceptanceState.OPEN
    readings: tuple[Reading, ...] = ()
    error: Exception | None = None
    progress: tuple[str, float, str] | None = None
    result: AcceptanceResult | None = None

    @property
    def next_take(self) -> tuple[Step, int] | None:
        """The position to measure next, and how many times it was measured before; None when all are."""
        takes = self.plan.takes
        return takes[len(self.readings)] if len(self.readings) < len(takes) else None


@dataclass(slots=True)
class _Held:
    """What only the desk knows of a test."""

    record: AcceptanceRecord
    evidence: list[Evidence] = field(default_factory=list)
    loan: UUID | None = None


class AcceptanceDesk:
    """The tests of one service. Any thread may call. `folder` : where they are kept, a folder of the data folder."""

    def __init__(
        self,
        folder: Path,
        lender: RigLender,
        *,
        clock: Clock = utc_now,
        reconstruct: ReconstructBundle | None = None,
    ) -> None:
        self._folder = folder
        self._lender = lender
        self._clock = clock
        self._reconstruct = reconstruct
        self._lock = threading.RLock()
        self._tests: dict[UUID, _Held] = {}

    def open(self, plan_of: Callable[[Calibration], AcceptancePlan]) -> AcceptanceRecord:
        """Open a test of the rig as it is calibrated now. Touches no device.

        Raises
        ------
        DeviceBusyError
            The rig is not open yet.
        CalibrationError, InvalidInputError
            It has no calibration, or the plan cannot be done.
        """
        status = self._lender.status()
        if status.facts is None:
            message = "The rig is being opened. Ask again in a moment."
            raise DeviceBusyError(message)
        calibration = status.facts.calibration if status.active is None else status.active.calibration
        if calibration is None:
            message = f"rig '{status.rig}' has no calibration, and nothing can be measured; calibrate it first"
            raise CalibrationError(message)
        record = AcceptanceRecord(uuid4(), self._clock(), plan_of(calibration))
        with self._lock:
            self._tests[record.id] = _Held(record)
        return record

    def get(self, test_id: UUID) -> AcceptanceRecord:
        """Return a test. Raises ScanNotFoundError."""
        return self._held(test_id).record

    def latest(self) -> tuple[AcceptanceRecord, ...]:
        """Return all tests of this run of the service, newest first."""
        with self._lock:
            return tuple(held.record for held in reversed(self._tests.values()))

    def measure(self, test_id: UUID, *, wait: bool, scripted: bool) -> AcceptanceRecord:
        """Have the next position measured, or, scripted, all that are left; return at once.

        By hand, the artefact is to stand in its place. `wait` lets it stand in line behind other work.

        Raises
        ------
        ScanNotFoundError, ScanStateError
            There is no such test, or it is being measured, or it is over.
        RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        with self._lock:
            held = self._held(test_id)
            if held.record.state is not AcceptanceState.OPEN:
                message = f"Acceptance test {test_id} is {held.record.state}; a position is measured while it is open."
                raise ScanStateError(message)
            words = f"acceptance test {test_id}"

            def begun(loan: UUID) -> None:
                held.loan = loan
                held.record = replace(held.record, state=AcceptanceState.MEASURING, error=None)

            self._lender.borrow(
                lambda rig, cancelled: self._measure(held, rig, cancelled, scripted=scripted),
                holder=Holder(words, words, f"/acceptance/{test_id}"),
                wait=wait,
                ended=lambda error: self._ended(held, error),
                begun=begun,
            )
            return held.record

    def cancel(self, test_id: UUID) -> AcceptanceRecord:
        """End a test. Returns at once; one that is over stays so. Raises ScanNotFoundError."""
        with self._lock:
            held = self._held(test_id)
            loan = held.loan
            if held.record.state is AcceptanceState.OPEN:
                held.record = replace(held.record, state=AcceptanceState.CANCELLED)
        if loan is not None:
            self._lender.recall(loan)
        return held.record

    def file(self, test_id: UUID, name: str) -> Path:
        """Return where a report lies. Raises ScanNotFoundError, ArtefactNotReadyError."""
        record = self.get(test_id)
        path = self._folder / str(test_id) / name
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
            message = f"There is no acceptance test {test_id} under way here; finished ones lie in {self._folder}."
            raise ScanNotFoundError(message)
        return held

    def _measure(self, held: _Held, rig: Rig, cancelled: Callable[[], bool], *, scripted: bool) -> None:
        """On the rig's thread: measure one position, or all that are left."""
        from slrig.sessions.acceptance.report import write_reports

        plan = held.record.plan
        if plan.rendered and rig.truth() is None:
            message = "exact artefacts are those of a rendered rig, and this one is not; send the certificates' values"
            raise InvalidInputError(message)
        place = by_positioner(rig, plan) if scripted else None
        folder = self._folder / str(held.record.id)
        count = len(plan.takes)
        while (following := held.record.next_take) is not None:
            step, take = following
            done = len(held.record.readings)

            def told(stage: str, fraction: float, detail: str, /, name: str = step.name, done: int = done) -> None:
                share = (done + min(max(fraction, 0.0), 1.0)) / count
                self._change(held, progress=(f"{name}: {stage}", share, detail))

            if cancelled():
                message = f"the acceptance test was cancelled before {step.name}"
                raise ScanCancelledError(message)
            if place is not None and take == 0:
                place(rig, step)
            found, evidence = measured(
                rig, plan, step, take, folder, progress=told, cancelled=cancelled, reconstruct=self._reconstruct
            )
            held.evidence.append(evidence)
            self._change(held, readings=(*held.record.readings, found))
            following = held.record.next_take
            # A repeat goes with its first: nothing is moved between them.
            if place is None and (following is None or following[1] == 0):
                break
        if held.record.next_take is None:
            calibration = rig.calibration
            if calibration is None:
                message = f"rig '{rig.name}' has lost its calibration; calibrate it, and test again"
                raise CalibrationError(message)
            record = held.record
            result = AcceptanceResult(
                rig.name, record.created_at, self._clock(), plan, calibration, record.readings,
                verdicts(record.readings, plan),
            )  # fmt: skip
            write_reports(result, held.evidence, folder)
            self._change(held, result=result)

    def _change(self, held: _Held, **changes: object) -> None:
        with self._lock:
            held.record = replace(held.record, **changes)  # type: ignore[arg-type]

    def _ended(self, held: _Held, error: Exception | None) -> None:
        """The rig is free."""
        state = AcceptanceState.OPEN
        if held.record.result is not None:
            state = AcceptanceState.FINISHED
        elif isinstance(error, ScanCancelledError):
            state = AcceptanceState.CANCELLED
        with self._lock:
            held.loan = None
            held.record = replace(held.record, state=state, error=error, progress=None)
