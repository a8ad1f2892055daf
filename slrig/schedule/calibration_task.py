"""The scheduled calibration: every pose of the positioner shot, the solve, and, if asked for, its use."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any
from uuid import UUID

from slrig.calibrate.calibrating import Calibrations
from slrig.calibrate.pose_shooting import PoseRequest
from slrig.calibrate.records import SessionRecord, SessionState
from slrig.calibration.judging.verdict import Grade
from slrig.errors import (
    CalibrationNotFoundError,
    CalibrationStateError,
    DeviceError,
    UnsupportedByDeviceError,
    WorkerLostError,
)
from slrig.jobs.job import Holder
from slrig.jobs.records import JobState
from slrig.scan.runner import RigAccess
from slrig.schedule.polling import error_of, until
from slrig.schedule.positions import require_positions
from slrig.schedule.task_options import CalibrationOptions, checked


class CalibrationTask:
    """Implements `slrig.schedule.tasks.Task`. Scans may come between two poses; a pose waits in line behind them.

    tidy : called after each, however it ended, so that they do not pile up.
    """

    def __init__(self, queue: RigAccess, calibrations: Calibrations, tidy: Callable[[], object]) -> None:
        self._queue = queue
        self._calibrations = calibrations
        self._tidy = tidy

    def check(self, options: Mapping[str, Any], /) -> None:
        """See `Task`."""
        require_positions(self._queue.status().facts, _options(options).positions)

    def do(self, holder: Holder, options: Mapping[str, Any], /, *, cancelled: Callable[[], bool]) -> Mapping[str, Any]:
        """See `Task`. Poses that are refused are left out; one that fails ends the run."""
        asked = _options(options)
        first, *others = self._positions(asked)
        session = self._calibrations.open(asked.board.board(), label=holder.words).id
        try:
            try:
                # The first may not wait: a busy rig is told before anything was done.
                self._shoot(session, holder, asked, first, wait=False)
            except BaseException:
                self._calibrations.delete(session)
                raise
            for position in others:
                self._await_rig(session, cancelled)
                self._shoot(session, holder, asked, position, wait=True)
            self._await_poses(session, cancelled)
            return self._told(self._solved(session, cancelled), asked)
        except (DeviceError, WorkerLostError):
            # It is tried again from the first pose on. A pose that is being read yet leaves it to `tidy`.
            with suppress(CalibrationStateError, CalibrationNotFoundError):
                self._calibrations.delete(session)
            raise
        finally:
            self._tidy()

    def _positions(self, asked: CalibrationOptions) -> list[int | str]:
        facts = self._queue.status().facts
        names = () if facts is None else facts.positions
        if not names:
            message = (
                "this rig has no positioner, and nobody is there to move the board: calibrate with `slrig calibrate`, "
                "or schedule a verification of a board that stays in view"
            )
            raise UnsupportedByDeviceError(message)
        return [*asked.positions] or list(range(len(names)))

    def _shoot(
        self, session: UUID, holder: Holder, asked: CalibrationOptions, position: int | str, *, wait: bool
    ) -> None:
        request = PoseRequest(position, asked.exposure_s)
        self._calibrations.poses.shoot(session, request, wait=wait, holder=holder)

    def _await_rig(self, session: UUID, cancelled: Callable[[], bool]) -> None:
        """Until the last pose was shot: it may still be read while the next one is."""
        self._await(session, {JobState.QUEUED, JobState.CAPTURING}, cancelled)

    def _await_poses(self, session: UUID, cancelled: Callable[[], bool]) -> None:
        self._await(session, {JobState.QUEUED, JobState.CAPTURING, JobState.COMPUTING}, cancelled)

    def _await(self, session: UUID, pending: set[JobState], cancelled: Callable[[], bool]) -> None:
        register, poses = self._calibrations.register, self._calibrations.poses

        def cancel() -> None:
            for pose in register.get(session).poses:
                poses.cancel(session, pose.number)

        until(lambda: not any(pose.state in pending for pose in register.get(session).poses), cancelled, cancel=cancel)
        for pose in register.get(session).poses:
            if pose.fault is not None and not pose.refused:
                raise error_of(pose.fault)

    def _solved(self, session: UUID, cancelled: Callable[[], bool]) -> SessionRecord:
        register = self._calibrations.register
        self._calibrations.solves.solve(session)
        until(lambda: register.get(session).state is not SessionState.SOLVING, cancelled, cancel=lambda: None)
        record = register.get(session)
        if record.fault is not None:
            raise error_of(record.fault)
        return record

    def _told(self, record: SessionRecord, asked: CalibrationOptions) -> Mapping[str, Any]:
        result = record.result or {}
        verdict = result.get("verdict") or {}
        # Nobody looks at the report before scans use it.
        usable = verdict.get("grade") != Grade.DO_NOT_USE
        if asked.activate and usable:
            self._calibrations.activate(record.id)
        return {
            "calibration": str(record.id),
            "poses": len(record.poses),
            "accepted": len(record.accepted),
            "refused": {
                pose.position_name or pose.name: None if pose.fault is None else pose.fault.message
                for pose in record.poses
                if pose.refused
            },
            "verdict": verdict.get("summary"),
            "expected_error_mm": (result.get("expected") or {}).get("point_mm"),
            "activated": asked.activate and usable,
        }


def _options(given: Mapping[str, Any]) -> CalibrationOptions:
    return checked(CalibrationOptions, given, task="calibration")
