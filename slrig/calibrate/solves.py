"""The solve of a session, on a thread of its own: its progress, its results on disk, and its end."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import structlog

from slrig.bundle.calibration_file import check_calibration, write_calibration
from slrig.calibrate.pose_answering import PoseAnswers, board_of, setting_of
from slrig.calibrate.records import SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.store import BUNDLE, CALIBRATION, REPORT
from slrig.calibrate.tools import CalibrationTools
from slrig.calibration.board import BoardShape
from slrig.errors import CalibrationError, CalibrationStateError, ScanInterruptedError, SlrigError, SolveRefusedError
from slrig.failure import failure_of
from slrig.jobs.records import Clock, JobProgress
from slrig.model import Calibration

_log = structlog.get_logger(__name__)


class SolveDesk:
    """Solves sessions, one at a time. Any thread may call.

    earlier : gives the calibration in use, for the solve to be held against; None where there is none.
    """

    def __init__(
        self,
        register: CalibrationRegister,
        tools: CalibrationTools,
        answers: PoseAnswers,
        *,
        clock: Clock,
        earlier: Callable[[], Calibration | None],
    ) -> None:
        self._register = register
        self._store = register.store
        self._tools = tools
        self._answers = answers
        self._clock = clock
        self._earlier = earlier
        self._solving = threading.Lock()

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
            begun = JobProgress("solve", 0.0, "")
            record = self._register.change(
                session_id, lambda found: replace(found, state=SessionState.SOLVING, fault=None, progress=begun)
            )
        threading.Thread(target=self._run, args=(record, board_shape), name="slrig-solve", daemon=True).start()
        return record

    def _run(self, record: SessionRecord, board_shape: BoardShape) -> None:
        try:
            with self._solving:
                self._solved(record, board_shape)
        except ScanInterruptedError:
            # The service ends: the register marks what is under way, now or at the next start.
            return
        except Exception as error:  # noqa: BLE001 - whatever goes wrong, the session gets out of SOLVING
            fault = failure_of(error)
            if isinstance(error, SlrigError):
                _log.warning("solve failed", calibration=str(record.id), code=fault.code, cause=fault.message)
            else:
                _log.exception("solve failed", calibration=str(record.id))
            self._register.change(
                record.id,
                lambda found: replace(found, state=SessionState.FAILED, fault=fault, progress=None),
                must_last=False,
            )

    def _solved(self, record: SessionRecord, board_shape: BoardShape) -> None:
        def progress(stage: str, fraction: float, detail: str) -> None:
            self._register.progress(record.id, stage, fraction, detail)

        setting = setting_of(record)
        poses = self._answers.readings(record)
        result = self._tools.solve(
            setting.board,
            setting.cameras,
            setting.projector,
            poses,
            progress=progress,
            earlier=self._comparable(record),
            board_shape=board_shape,
        )
        number = record.solve + 1
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
                found,
                state=SessionState.SOLVED,
                solve=number,
                solved_at=self._clock(),
                result=summary,
                progress=None,
                fault=None,
            ),
        )
        _log.info("calibration solved", calibration=str(record.id), solve=number)

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
