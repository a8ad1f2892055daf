"""The work of a calibration session: a pose shot, read and judged; the solve; and what else the worker does for it.

The mathematics is loaded where it is used: the service knows these jobs, and computes nothing.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from uuid import UUID

from slrig.bundle import read_calibration, write_calibration, write_durably
from slrig.calibrate.records import USUAL_PATTERNS, SessionRecord, setting_of
from slrig.calibrate.store import (
    ANSWER,
    CALIBRATION,
    COMPARED,
    READING,
    REPORT,
    picture_name,
    read_session,
    reading_bytes,
    session_readings,
    with_poses_on_disk,
)
from slrig.calibration import PROJECTOR, Board, BoardShape, PoseObservation
from slrig.calibration.accuracy import Comparison
from slrig.errors import CalibrationError, PoseRefusedError, UnsupportedByDeviceError
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.records import JobKind
from slrig.model import Calibration, Size
from slrig.rig.session import RigFacts, RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.plan_check import check_plan

if TYPE_CHECKING:
    from slrig.multiview import BoardAxis


@dataclass(frozen=True, slots=True)
class PoseJob(Job):
    """One pose of a session, the `group`. number : counts from 1 within it. position : index of the pose that the
    positioner takes, None where a person holds the board.
    """

    kind: ClassVar[JobKind] = JobKind.POSE
    one_at_a_time: ClassVar[bool] = True
    promises: ClassVar[tuple[str, ...]] = (ANSWER,)
    noun: ClassVar[str] = "reading of the pose"

    group: UUID
    number: int
    position: int | None = None
    position_name: str | None = None
    exposure_s: float | None = None
    patterns: PatternPlan = USUAL_PATTERNS

    def check(self, rig: RigSession) -> int:
        """See `Job`. Raises UnsupportedByDeviceError, PatternError."""
        if rig.facts is None:
            return 0
        if self.position is not None and self.position >= len(rig.facts.positions):
            message = f"position: found {self.position}, this rig has {len(rig.facts.positions)} of them"
            raise UnsupportedByDeviceError(message)
        return 2 * check_plan(self._scan, rig.facts)

    def capture(self, rig: RigSession, run: JobRun) -> Recording:
        """Move the board if asked, and record a bundle."""
        opened = rig.open()
        if self.position is not None and opened.positioner is not None:
            run.report("move", 0.0, self.position_name or "")
            opened.positioner.move(self.position)
        # Neither an earlier calibration nor what a rendered rig knows of its scene is any business of this one's.
        bare = replace(opened, calibration=None, head=None)
        return capture_frames(bare, self._scan, run.recording, progress=run.report, cancelled=run.cancelled)

    def compute(self, run: JobRun) -> Outcome:
        """Read the pose, judge it by those before it, and draw what each camera saw."""
        from slrig.calibrate import pose_judging, pose_pictures, pose_reading
        from slrig.calibrate.pose_frames import bundle_device_sizes

        session = _session_of(run)
        record = read_session(session)
        cameras = bundle_device_sizes(run.bundle)
        projector = cameras.pop(PROJECTOR, None)
        require_same_devices(record, cameras, projector)
        setting, reading = setting_of(record), None
        try:
            reading = pose_reading.read_pose(run.bundle, setting.board, f"pose {self.number}")
            judged = pose_judging.judgement(reading, session_readings(session), setting)
        except PoseRefusedError as error:
            # The number stands beside it; and the person shot it just now.
            judged = pose_judging.Judgement((str(error).removeprefix(f"pose 'pose {self.number}': "),), {}, None)
        run.check()
        answer = {"refused": list(judged.refusals), "answer": judged.answer}
        with disk_errors(run.folder):
            write_durably(run.folder / ANSWER, (json.dumps(answer, indent=1, allow_nan=False) + "\n").encode())
            for camera in setting.cameras:
                picture = pose_pictures.pose_png(run.bundle, camera, reading, setting.board)
                write_durably(run.folder / picture_name(camera), picture)
            if reading is not None and not judged.refusals:
                write_durably(run.folder / READING, reading_bytes(reading))
        guidance = None if judged.standing is None else asdict(judged.standing)
        fault = JobFailure(PoseRefusedError.code, " ".join(judged.refusals)) if judged.refusals else None
        return Outcome({"answer": judged.answer, "guidance": guidance}, fault)

    def place(self, data: DataFolder, job_id: UUID) -> Path:  # noqa: ARG002 - as it is called
        """See `Job`."""
        return data.calibrations / str(self.group) / "poses" / f"{self.number:02d}"

    @classmethod
    def places(cls, data: DataFolder) -> list[Path]:
        """See `Job`."""
        return [place for place in sorted(data.calibrations.glob("*/poses/*")) if data.owns(place.parent)]

    @property
    def _scan(self) -> ScanPlan:
        return ScanPlan(patterns=self.patterns, exposure_s=self.exposure_s)


@dataclass(frozen=True, slots=True)
class SolveJob(Job):
    """A solve of a session, the `group`, from its accepted poses. tolerance_mm : what a point may be wrong by, as the
    rig file says. The calibration that the result is compared with lies in the session's folder.
    """

    kind: ClassVar[JobKind] = JobKind.SOLVE
    uses_rig: ClassVar[bool] = False
    promises: ClassVar[tuple[str, ...]] = (CALIBRATION, REPORT)
    noun: ClassVar[str] = "solve"

    group: UUID
    number: int
    board_shape: BoardShape = BoardShape.AUTO
    tolerance_mm: float | None = None

    def compute(self, run: JobRun) -> Outcome:
        """Solve, and write the calibration and its report."""
        from slrig.calibrate import pose_judging, solving

        session = _session_of(run)
        record = with_poses_on_disk(read_session(session), session)
        setting, poses = setting_of(record), session_readings(session)
        compared = session / COMPARED

        def report(stage: str, fraction: float, detail: str, /) -> None:
            run.check()
            run.report(stage, fraction, detail)

        result = solving.solve_poses(
            setting.board, setting.cameras, setting.projector, poses,
            progress=report,
            earlier=read_calibration(compared) if compared.is_file() else None,
            board_shape=self.board_shape,
            tolerance_mm=self.tolerance_mm,
        )  # fmt: skip
        if result.calibration.solved is not None:
            solved = replace(result.calibration.solved, id=solve_name(self.group, self.number))
            result = replace(result, calibration=replace(result.calibration, solved=solved))
        bundles = {pose.name: session / "poses" / f"{pose.number:02d}" / BUNDLE for pose in record.accepted}
        write_calibration(run.folder / CALIBRATION, result.calibration)
        pose_judging.write_report(run.folder / REPORT, result, poses, record, bundles)
        return Outcome({"solve": self.number, "result": pose_judging.summary(result)})

    def place(self, data: DataFolder, job_id: UUID) -> Path:  # noqa: ARG002 - as it is called
        """See `Job`."""
        return data.calibrations / str(self.group) / "solves" / str(self.number)


def solve_name(session_id: UUID, number: int) -> str:
    """Name of a solve in the calibration file: the session's id, with its number from the second on.

    >>> solve_name(UUID(int=0), 2)
    '00000000-0000-0000-0000-000000000000.2'
    """
    return str(session_id) if number == 1 else f"{session_id}.{number}"


def require_same_devices(record: SessionRecord, cameras: Mapping[str, Size], projector: Size | None) -> None:
    """Raise CalibrationError unless these devices are those of the session's poses."""
    if not record.cameras or (dict(record.cameras) == dict(cameras) and record.projector == projector):
        return
    message = (
        f"The poses of calibration {record.id} were shot with {_devices(record.cameras, record.projector)}; the rig "
        f"now has {_devices(cameras, projector)}. Open a new calibration for it."
    )
    raise CalibrationError(message)


def session_devices(record: SessionRecord, facts: RigFacts) -> tuple[Mapping[str, Size], Size | None]:
    """The extents of the rig's cameras, and of its projector; None in a session of cameras alone, whose poses carry no
    codes.
    """
    return facts.sizes, facts.projector.size if record.patterns.codes else None


# Short tasks of the worker


def survey(session: Path) -> Mapping[str, Any]:
    """Coverage by the accepted poses of a session, and where to hold the board next, as JSON values."""
    from slrig.calibrate.pose_judging import standing

    return asdict(standing(session_readings(session), setting_of(read_session(session))))


def coverage_picture(session: Path, device: str, next_move: Mapping[str, Any]) -> bytes:
    """A PNG of the board positions that a device has seen, and of the next one."""
    from slrig.calibrate.pose_pictures import coverage_png

    return coverage_png(setting_of(read_session(session)), device, session_readings(session), next_move)


def compare(first: Calibration, second: Calibration) -> Comparison:
    """Differences of the second calibration from the first."""
    from slrig.calibration.accuracy import compare_calibrations

    return compare_calibrations(first, second)


def warm() -> None:
    """Load what reading a pose needs, so that the first one is answered as fast as the others."""
    from slrig.calibrate.pose_judging import warm

    warm()


def turntable_axis(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, angles_deg: Sequence[float] | None
) -> BoardAxis:
    """The axis that a board was turned about."""
    from slrig.calibrate.turntable_axis import axis_of_poses

    return axis_of_poses(poses, board, calibration, angles_deg)


def _session_of(run: JobRun) -> Path:
    """The folder of the session that a pose or a solve belongs to."""
    if run.place is None:
        raise ValueError(run)
    return run.place.parent.parent


def _devices(cameras: Mapping[str, Size], projector: Size | None) -> str:
    had = ", ".join(f"{name} {size}" for name, size in cameras.items())
    return had if projector is None else f"{had} and a projector of {projector}"
