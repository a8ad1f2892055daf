"""Calibration sessions over a tame bench: poses that show what a test says, and a solve that gives what it says."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast
from uuid import UUID

import numpy as np

from slrig.api.server import KINDS
from slrig.calibrate.job import Calibrations, PoseRequest
from slrig.calibrate.report import Judgement, SessionGuidance
from slrig.calibrate.store import CalibrationResult, PoseRecord, ReadPose, SessionRecord, SessionState, Setting
from slrig.calibration.board import Board, BoardKind, BoardShape, BoardView, PoseObservation, ViewQuality
from slrig.devices import Rig
from slrig.errors import PoseRefusedError
from slrig.jobs.listener import Listener
from slrig.jobs.manager import JobManager
from slrig.jobs.resume import resume
from slrig.model import Calibration, Size
from slrig.rig.session import ActiveCalibration, RigSession
from tests.samples import put_database
from tests.unit.scan.bench import Bench, wait_for
from tests.unit.scan.fakes import WAIT_S, TamePositioner, tame_calibration
from tests.unit.stand_ins import stand_ins

BOARD = Board(BoardKind.CHESSBOARD, 4, 3, 10.0)
PNG = b"\x89PNG tame"
POSITIONS = ("near", "far", "tilted")
GOOD = {"grade": "good", "summary": "good", "reasons": []}


@dataclass(frozen=True, slots=True)
class TameResult:
    """As much of a CalibrationResult as a session looks at."""

    calibration: Calibration


class TameCalibrating:
    """The mathematics of a session, as a test says.

    refusals : of the next poses; unseen : the next pose's frames show no board; read_error, solve_error : raised.
    solving : while it is clear a solve goes on.
    """

    def __init__(self) -> None:
        self.refusals: tuple[str, ...] = ()
        self.unseen = False
        self.read_error: Exception | None = None
        self.solve_error: Exception | None = None
        self.solving = threading.Event()
        self.solving.set()
        self.visited: list[int] = []
        self.judged: list[list[str]] = []
        self.solved: list[list[str]] = []
        self.earlier: list[Calibration | None] = []
        self.board_shapes: list[BoardShape] = []
        self.boards: list[Board] = []
        self.tolerance_mm: float | None = None
        self.calibration = tame_calibration()

    def patched(self) -> AbstractContextManager[None]:
        """Have the mathematics of calibrations be this within the block."""
        return stand_ins(
            {
                "calibrate.pose_reading.read_pose": self._read,
                "calibrate.report.judgement": self._judge,
                "calibrate.report.session_guidance": lambda poses, _: SessionGuidance(
                    {"poses": [each.observation.name for each in poses]}, {}
                ),
                "calibrate.report.write_report": lambda path, *_: path.write_text("<html>report</html>"),
                "calibrate.report.summary": lambda _: {"verdict": {"grade": "good", "summary": "good", "reasons": []}},
                "calibrate.report.pose_png": lambda *_: PNG,
                "calibrate.report.coverage_png": lambda _, device, poses, __: f"{device} {len(poses)}".encode(),
                "calibrate.store.solve_poses": self._solve,
            }
        )

    def _read(self, folder: Path, board: Board, name: str) -> ReadPose:
        assert (folder / "bundle.json").is_file()
        if self.read_error is not None:
            raise self.read_error
        if self.unseen:
            message = f"pose '{name}': no camera sees the board. Move it into view."
            raise PoseRefusedError(message)
        count = board.corner_count
        view = BoardView(np.arange(count, dtype=np.int32), board.points_mm[:, :2].copy(), np.full(count, 0.05))
        return ReadPose(PoseObservation(name, {"cam0": view}), {"cam0": ViewQuality(0.01, 0.0, 0.4, 1.0, np.nan)})

    def _judge(self, pose: ReadPose, earlier: Sequence[ReadPose], setting: Setting) -> Judgement:
        assert setting.board == BOARD
        names = [each.observation.name for each in earlier]
        self.judged.append(names)
        if not self.refusals:
            names = [*names, pose.observation.name]
        standing = SessionGuidance({"poses": names}, {"words": "tilt it", "enough": False})
        return Judgement(self.refusals, {"corners_found": {"cam0": 12}}, standing)

    def _solve(
        self,
        board: Board,
        cameras: Mapping[str, Size],
        projector: Size | None,
        poses: Sequence[ReadPose],
        listener: Listener,
        /,
        *,
        earlier: Calibration | None = None,
        board_shape: BoardShape = BoardShape.AUTO,
        tolerance_mm: float | None = None,
    ) -> CalibrationResult:
        assert (dict(cameras), projector) == ({"cam0": Size(64, 48)}, Size(64, 40))
        self.boards.append(board)
        listener.report("adjust", 0.5, "turn 3")
        assert self.solving.wait(WAIT_S)
        if self.solve_error is not None:
            raise self.solve_error
        self.solved.append([each.observation.name for each in poses])
        self.earlier.append(earlier)
        self.board_shapes.append(board_shape)
        self.tolerance_mm = tolerance_mm
        return cast("CalibrationResult", TameResult(self.calibration))


class CalibrationBench(Bench):
    """Calibrations over a tame bench."""

    def __init__(self, tmp_path: Path, *, positioner: bool = False) -> None:
        put_database(tmp_path / "data" / "slrig.sqlite")
        super().__init__(tmp_path)
        self.tame = TameCalibrating()
        self.patched.enter_context(self.tame.patched())
        self._positioner = positioner
        self.calibrations = Calibrations(self.manager)

    def restarted(self, *, start: bool = False) -> Calibrations:
        """The calibrations as the next start of the service has them. start : jobs go on."""
        manager = JobManager(self.store, self.folder, RigSession("bench", self.open_rig), self.worker, *KINDS)
        self.next_rig = manager.rig
        self.patched.callback(manager.close)
        again = Calibrations(manager)
        again.settle()
        resume(manager)
        if start:
            manager.start()
        return again

    def open_rig(self) -> Rig:
        rig = super().open_rig()
        return replace(rig, positioner=TamePositioner(POSITIONS, self.tame.visited)) if self._positioner else rig

    def until_pose(self, session_id: UUID, number: int) -> PoseRecord:
        """The pose once it is in a final state."""
        self.until_session(session_id, lambda record: all(each.state.final for each in record.poses))
        return self.calibrations.register.pose(session_id, number)

    def until_session(self, session_id: UUID, done: Callable[[SessionRecord], bool]) -> SessionRecord:
        """The session once `done` says so."""
        register = self.calibrations.register
        wait_for(self.store, session_id, lambda: done(register.get(session_id)))
        return register.get(session_id)

    def record(self, session_id: UUID) -> SessionRecord:
        """The session as it is."""
        return self.calibrations.register.get(session_id)

    @property
    def in_use(self) -> ActiveCalibration:
        """The calibration that scans are made with."""
        active = self.manager.status().active
        assert active is not None
        return active

    def session(self) -> UUID:
        """A session that was opened."""
        return self.calibrations.open(BOARD).id

    def shot(self, session_id: UUID, request: PoseRequest = PoseRequest()) -> PoseRecord:  # noqa: B008 - frozen
        """A pose that has its answer."""
        pose = self.calibrations.shoot(session_id, request, wait=True)
        return self.until_pose(session_id, pose.number)

    def held_pose(self, session_id: UUID) -> PoseRecord:
        """A pose that is being shot until `gate` is set."""
        self.began.clear()
        self.gate.clear()
        pose = self.calibrations.shoot(session_id, PoseRequest(), wait=False)
        assert self.began.wait(WAIT_S)
        return pose

    def solve(self, session_id: UUID, state: SessionState = SessionState.SOLVED) -> SessionRecord:
        """Solve a session, which ends in this state."""
        self.calibrations.solve(session_id)
        record = self.until_session(session_id, lambda found: found.state is not SessionState.SOLVING)
        assert record.state is state, record.fault
        return record

    def solved(self, *, poses: int = 2) -> UUID:
        """A session that was solved."""
        session_id = self.session()
        for _ in range(poses):
            self.shot(session_id)
        self.solve(session_id)
        return session_id

    def close(self) -> None:
        self.tame.solving.set()
        super().close()
