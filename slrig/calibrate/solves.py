"""The solve of a session: a job without the rig, with its results on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any
from uuid import UUID

import structlog

from slrig.bundle import check_calibration, write_calibration
from slrig.calibrate.records import SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.store import CALIBRATION, REPORT
from slrig.calibrate.tools import CalibrationTools, setting_of
from slrig.calibration import BoardShape
from slrig.errors import CalibrationError, CalibrationStateError, SolveRefusedError
from slrig.jobs.data_folder import BUNDLE
from slrig.jobs.job import Holder
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobKind, JobRecord, JobState, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, RigJobs
from slrig.model import Calibration

_log = structlog.get_logger(__name__)


@dataclass(slots=True)
class SolveDesk:
    """Solves sessions. Any thread may call."""

    register: CalibrationRegister
    work: RigJobs
    tools: CalibrationTools
    tolerance_mm: float | None = None
    """What the rig file says that a point of a scan may be wrong by."""
    of_the_rig: Callable[[], Calibration | None] = lambda: None
    """Gives the calibration that the rig has by itself."""

    def solve(self, session_id: UUID, *, board_shape: BoardShape = BoardShape.AUTO) -> SessionRecord:
        """Begin to solve a session from its accepted poses. Returns at once.

        board_shape : whether the board may be bowed.

        Raises
        ------
        CalibrationNotFoundError
            There is no such session.
        CalibrationStateError
            It is being solved, a pose of it is under way, or it was imported.
        SolveRefusedError
            It has no accepted pose.
        StorageError
            The disk refused.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            setting_of(record)
            if record.state is SessionState.SOLVING:
                message = (
                    f"Calibration {session_id} is being solved already. Follow it with GET /calibration/{session_id}."
                )
                raise CalibrationStateError(message)
            pending = [pose.name for pose in record.poses if not pose.state.final]
            if pending:
                message = f"{', '.join(pending)} is still under way. Solve when it has its answer."
                raise CalibrationStateError(message)
            if not record.accepted:
                message = (
                    f"Calibration {session_id} has no accepted pose. Shoot some first "
                    f"(POST /calibration/{session_id}/pose); GET /calibration/{session_id} tells what to shoot."
                )
                raise SolveRefusedError(message)
            plan = {"number": record.solve + 1, "board_shape": str(board_shape)}
            job = self.register.jobs.create(plan, rig=record.rig, label=None, kind=JobKind.SOLVE, parent=session_id)
            self.work.take_up(job, self._parts(session_id, job), holder=_holder(session_id, job))
            return self.register.get(session_id)

    def take_up(self, session_id: UUID, job: JobRecord) -> None:
        """End a solve that the end of the service cut off: as what it came to, or as interrupted."""
        if self.register.get(session_id).solve >= job.plan["number"]:
            self.register.jobs.finish(job.id, JobState.SUCCEEDED)
        else:
            self.work.take_up(job, self._parts(session_id, job), holder=_holder(session_id, job))

    def _parts(self, session_id: UUID, job: JobRecord) -> Parts:
        return Parts(
            lambda _, progress: self._solve(session_id, job.plan, progress),
            failed=lambda _: self.register.change(session_id, must_last=False, state=SessionState.FAILED),
            capture_share=0.0,
        )

    def _solve(self, session_id: UUID, plan: Mapping[str, Any], progress: ProgressRecorder) -> Outcome:
        record, store = self.register.get(session_id), self.register.store
        setting, poses = setting_of(record), store.readings(record)
        result = self.tools.solve(
            setting.board,
            setting.cameras,
            setting.projector,
            poses,
            progress=progress,
            earlier=self._comparable(record),
            board_shape=BoardShape(plan["board_shape"]),
            tolerance_mm=self.tolerance_mm,
        )
        number = plan["number"]
        if result.calibration.solved is not None:
            solved = replace(result.calibration.solved, id=solve_name(record.id, number))
            result = replace(result, calibration=replace(result.calibration, solved=solved))
        summary = self.tools.summary(result)
        bundles = {pose.name: store.pose(record.id, pose.number) / BUNDLE for pose in record.accepted}
        staged = store.stage_solve(record.id)
        try:
            write_calibration(staged / CALIBRATION, result.calibration)
            self.tools.report(staged / REPORT, result, poses, record, bundles)
            store.commit_solve(record.id, number, staged)
        finally:
            store.discard(staged)
        self.register.change(record.id, state=SessionState.SOLVED, solve=number, solved_at=utc_now(), result=summary)
        _log.info("calibration solved", calibration=str(record.id), solve=number)
        return Outcome({"solve": number})

    def _comparable(self, record: SessionRecord) -> Calibration | None:
        """The calibration in use, or else the rig's own, if it is one of the same devices."""
        active = self.register.store.active_calibration()
        used = self.of_the_rig() if active is None else active.calibration
        if used is None or record.projector is None:
            return None
        try:
            check_calibration(used, record.projector, record.cameras, "the calibration in use")
        except CalibrationError:
            return None
        return used


def _holder(session_id: UUID, job: JobRecord) -> Holder:
    words = f"calibration {session_id}, solve {job.plan['number']}"
    return Holder(words, words, f"/calibration/{session_id}")


def solve_name(session_id: UUID, number: int) -> str:
    """What a solve is called in the calibration itself: the session's id, with its number from the second on.

    >>> solve_name(UUID(int=0), 2)
    '00000000-0000-0000-0000-000000000000.2'
    """
    return str(session_id) if number == 1 else f"{session_id}.{number}"
