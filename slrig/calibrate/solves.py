"""The solve of a session: a job without the rig, with its results on disk."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import UUID

import structlog

from slrig.bundle.calibration_file import check_calibration, write_calibration
from slrig.calibrate.pose_answering import PoseAnswers, board_of, setting_of
from slrig.calibrate.records import SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.store import BUNDLE, CALIBRATION, REPORT
from slrig.calibrate.tools import CalibrationTools
from slrig.calibration.board import BoardShape
from slrig.errors import CalibrationError, CalibrationStateError, SolveRefusedError
from slrig.failure import JobFailure
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import Clock, JobKind, JobRecord, JobState
from slrig.jobs.rig_jobs import Outcome, Parts, RigJobs
from slrig.model import Calibration

_log = structlog.get_logger(__name__)


class SolveDesk:
    """Solves sessions. Any thread may call.

    earlier : gives the calibration in use, for the solve to be held against; None where there is none.
    """

    def __init__(
        self,
        register: CalibrationRegister,
        work: RigJobs,
        tools: CalibrationTools,
        answers: PoseAnswers,
        *,
        clock: Clock,
        earlier: Callable[[], Calibration | None],
    ) -> None:
        self._register = register
        self._store = register.store
        self._work = work
        self._tools = tools
        self._answers = answers
        self._clock = clock
        self._earlier = earlier

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
        with self._register.lock:
            record = self._register.get(session_id)
            board_of(record)
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
            job = self._register.jobs.create(plan, rig=record.rig, label=None, kind=JobKind.SOLVE, parent=session_id)
            self._work.compute(job.id, self._parts(session_id, job))
            return self._register.get(session_id)

    def take_up(self, session_id: UUID, job: JobRecord) -> None:
        """End a solve that the end of the service cut off: as what it came to, or as interrupted."""
        if self._register.get(session_id).solve >= job.plan["number"]:
            self._register.jobs.finish(job.id, JobState.SUCCEEDED)
        else:
            self._work.interrupt(job.id, self._parts(session_id, job))

    def _parts(self, session_id: UUID, job: JobRecord) -> Parts:
        def ended(state: JobState, _: JobFailure | None) -> None:
            if state is not JobState.SUCCEEDED:
                failed = lambda found: replace(found, state=SessionState.FAILED)  # noqa: E731 - of one line
                self._register.change(session_id, failed, must_last=False)

        return Parts(compute=lambda progress: self._solve(session_id, job.plan, progress), ended=ended)

    def _solve(self, session_id: UUID, plan: Mapping[str, Any], progress: ProgressRecorder) -> Outcome:
        record = self._register.get(session_id)
        setting = setting_of(record)
        poses = self._answers.readings(record)
        result = self._tools.solve(
            setting.board,
            setting.cameras,
            setting.projector,
            poses,
            progress=progress,
            earlier=self._comparable(record),
            board_shape=BoardShape(plan["board_shape"]),
        )
        number = plan["number"]
        if result.calibration.solved is not None:
            solved = replace(result.calibration.solved, id=solve_name(record.id, number))
            result = replace(result, calibration=replace(result.calibration, solved=solved))
        summary = self._tools.summary(result)
        staged = self._store.stage_solve(record.id)
        try:
            write_calibration(staged / CALIBRATION, result.calibration)
            self._tools.report(staged / REPORT, result, poses, record, self._bundles(record))
            self._store.commit_solve(record.id, number, staged)
        except BaseException:
            self._store.discard(staged)
            raise
        self._register.change(
            record.id,
            lambda found: replace(
                found, state=SessionState.SOLVED, solve=number, solved_at=self._clock(), result=summary
            ),
        )
        _log.info("calibration solved", calibration=str(record.id), solve=number)
        return Outcome({"solve": number})

    def _bundles(self, record: SessionRecord) -> dict[str, Path]:
        return {pose.name: self._store.pose(record.id, pose.number) / BUNDLE for pose in record.accepted}

    def _comparable(self, record: SessionRecord) -> Calibration | None:
        """The calibration in use, if it is one of the same devices."""
        earlier = self._earlier()
        if earlier is None or record.projector is None:
            return None
        try:
            check_calibration(earlier, record.projector, record.cameras, "the calibration in use")
        except CalibrationError:
            return None
        return earlier


def solve_name(session_id: UUID, number: int) -> str:
    """What a solve is called in the calibration itself: the session's id, with its number from the second on.

    >>> solve_name(UUID(int=0), 2)
    '00000000-0000-0000-0000-000000000000.2'
    """
    return str(session_id) if number == 1 else f"{session_id}.{number}"
