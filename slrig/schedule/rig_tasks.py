"""The kinds of work that a schedule does with the rig: a verification, a calibration, an acceptance test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any
from uuid import UUID

from slrig.accept.asking import AcceptanceRequest
from slrig.accept.job import AcceptanceTests
from slrig.accept.records import AcceptanceState
from slrig.accept.verdicts import verdicts
from slrig.calibrate.calibrating import Calibrations, PoseRequest
from slrig.calibrate.records import SessionState
from slrig.calibrate.verification import VerificationJob
from slrig.calibration import Board
from slrig.errors import (
    CalibrationError,
    CalibrationNotFoundError,
    CalibrationStateError,
    DeviceError,
    ScanCancelledError,
    WorkerLostError,
)
from slrig.failure import error_of, job_failure
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder, JobState
from slrig.jobs.store import JobStore
from slrig.schedule.task_options import CalibrationOptions, VerificationOptions, require_positions

_TOLD = ("state", "reasons", "remedy", "expected_mm", "drift_mm", "scale_percent", "scale_mm")


class Stop:
    """Has a run of a schedule end early. Any thread may call."""

    def __init__(self) -> None:
        self._news = threading.Event()
        self._asked = False

    def ask(self) -> None:
        """Have the run end."""
        self._asked = True
        self._news.set()

    def wait(
        self, jobs: JobStore, followed: UUID, reached: Callable[[], bool], *, cancel: Callable[[], object]
    ) -> None:
        """Return once `reached()`, which may turn true with each event of a job or of those of a group. Once the run is
        to end, `cancel` is called, and ScanCancelledError is raised.
        """
        unwatch = jobs.watch(followed, self._news.set)
        try:
            while not reached():
                if self._asked:
                    cancel()
                    message = "the run was cancelled"
                    raise ScanCancelledError(message)
                self._news.wait()
                self._news.clear()
        finally:
            unwatch()


class VerificationTask:
    """The board shot where it is, or where the positioner takes it, and judged."""

    options = VerificationOptions

    def __init__(self, manager: JobManager, calibrations: Calibrations) -> None:
        self._manager = manager
        self._calibrations = calibrations

    def check(self, asked: VerificationOptions, /) -> None:
        """See `Task`. A calibration may be made before the first run; a board to look at is named now or never."""
        self._board(asked)
        if asked.position is not None:
            require_positions(self._manager.rig.facts, [asked.position])

    def do(self, holder: Holder, asked: VerificationOptions, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. A rig that is found stale is a verification that succeeded."""
        manager, jobs = self._manager, self._manager.store
        job = manager.submit(VerificationJob(self._board(asked), asked.position, asked.exposure_s), holder=holder)[0].id
        stop.wait(jobs, job, lambda: jobs.get(job).state.final, cancel=lambda: manager.cancel(job))
        over = jobs.get(job)
        if over.fault is not None:
            raise error_of(over.fault)
        found = over.summary or {}
        return {"verification": found["id"], **{name: found.get(name) for name in _TOLD}}

    def _board(self, asked: VerificationOptions) -> Board:
        """The board that is asked for, or that of the calibration in use."""
        if asked.board is not None:
            return asked.board.board()
        active = self._calibrations.active
        board = None if active is None else self._calibrations.register.get(active).board
        if board is None:
            used = "no calibration that was made here is in use" if active is None else "the one in use was imported"
            message = (
                f"which board is in view is not known: {used}. Give the schedule the option "
                '"board", as {"kind": "charuco", "corners": [11, 8], "square_mm": 12}, or activate a calibration that '
                "was made here"
            )
            raise CalibrationError(message)
        return board


class CalibrationTask:
    """Every pose of the positioner shot, the solve, and, if asked for, its use. Scans may come between two poses; a
    pose waits in line behind them.

    tidy : called after each, however it ended, so that they do not pile up.
    """

    options = CalibrationOptions

    def __init__(self, manager: JobManager, calibrations: Calibrations, tidy: Callable[[], object]) -> None:
        self._manager = manager
        self._calibrations = calibrations
        self._tidy = tidy

    def check(self, asked: CalibrationOptions, /) -> None:
        """See `Task`."""
        asked.board.board()
        require_positions(self._manager.rig.facts, asked.positions)

    def do(self, holder: Holder, asked: CalibrationOptions, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. Poses that are refused are left out; one that fails ends the run."""
        facts = self._manager.rig.facts
        require_positions(facts, asked.positions)
        first, *others = asked.positions or range(0 if facts is None else len(facts.positions))
        session = self._calibrations.open(asked.board.board(), label=holder.words).id
        try:
            try:
                # The first may not wait: a busy rig is told before anything was done.
                self._shoot(session, holder, PoseRequest(first, asked.exposure_s), wait=False)
            except BaseException:
                self._calibrations.delete(session)
                raise
            for position in others:
                # Until the last pose was shot: it may still be read while the next one is.
                self._await_poses(session, {JobState.QUEUED, JobState.CAPTURING}, stop)
                self._shoot(session, holder, PoseRequest(position, asked.exposure_s), wait=True)
            self._await_poses(session, {JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING}, stop)
            return self._solved(session, asked, stop)
        except (DeviceError, WorkerLostError):
            # It is tried again from the first pose on. A pose that is being read yet leaves it to `tidy`.
            with suppress(CalibrationStateError, CalibrationNotFoundError):
                self._calibrations.delete(session)
            raise
        finally:
            self._tidy()

    def _shoot(self, session: UUID, holder: Holder, request: PoseRequest, *, wait: bool) -> None:
        self._calibrations.shoot(session, request, wait=wait, holder=holder)

    def _await_poses(self, session: UUID, pending: set[JobState], stop: Stop) -> None:
        register = self._calibrations.register

        def cancel() -> None:
            for pose in register.get(session).poses:
                self._calibrations.cancel(session, pose.number)

        def shot() -> bool:
            return not any(pose.state in pending for pose in register.get(session).poses)

        stop.wait(self._manager.store, session, shot, cancel=cancel)
        for pose in register.get(session).poses:
            if pose.fault is not None and not pose.refused:
                raise error_of(pose.fault)

    def _solved(self, session: UUID, asked: CalibrationOptions, stop: Stop) -> Mapping[str, Any]:
        register = self._calibrations.register
        self._calibrations.solve(session)

        def solved() -> bool:
            return register.get(session).state is not SessionState.SOLVING

        stop.wait(self._manager.store, session, solved, cancel=lambda: None)
        record = register.get(session)
        if record.fault is not None:
            raise error_of(record.fault)
        result = record.result or {}
        verdict = result.get("verdict") or {}
        # Nobody looks at the report before scans use it.
        unattended = verdict.get("unattended") or []
        activated = asked.activate and not unattended
        if activated:
            self._calibrations.activate(session)
        return {
            "calibration": str(session),
            "poses": len(record.poses),
            "accepted": len(record.accepted),
            "refused": {
                pose.position_name or pose.name: pose.fault.message
                for pose in record.poses
                if pose.refused and pose.fault is not None
            },
            "verdict": verdict.get("summary"),
            "expected_error_mm": (result.get("expected") or {}).get("point_mm"),
            "activated": activated,
            "left_to_a_person": unattended if asked.activate else [],
        }


class AcceptanceTask:
    """Every prescribed position measured by the rig's positioner, and the decision."""

    options = AcceptanceRequest

    def __init__(self, manager: JobManager, tests: AcceptanceTests) -> None:
        self._manager = manager
        self._tests = tests

    def check(self, _asked: AcceptanceRequest, /) -> None:
        """See `Task`."""
        require_positions(self._manager.rig.facts, ())

    def do(self, holder: Holder, asked: AcceptanceRequest, /, *, stop: Stop) -> Mapping[str, Any]:
        """See `Task`. A rig that fails the test is a run that succeeded."""
        tests = self._tests
        test = tests.open(asked.plan).id
        try:
            tests.measure(test, wait=False, scripted=True, holder=holder)
        except BaseException:
            tests.cancel(test)
            raise

        def measured() -> bool:
            return tests.get(test).state is not AcceptanceState.MEASURING

        stop.wait(self._manager.store, test, measured, cancel=lambda: tests.cancel(test))
        record = tests.get(test)
        if record.decision is None:
            tests.cancel(test)
            raise error_of(record.fault or job_failure(RuntimeError("the test ended without a result")))
        return {
            "acceptance": str(test),
            "decision": str(record.decision),
            "quantities": {
                str(each.quantity): {
                    "error_mm": each.error_mm,
                    "limit_mm": each.limit_mm,
                    "uncertainty_mm": each.uncertainty.expanded_mm,
                    "position": each.step,
                    "decision": str(each.decision),
                }
                for each in verdicts(record.readings, record.plan)
            },
        }
