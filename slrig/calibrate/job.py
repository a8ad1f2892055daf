"""Calibration sessions: poses and solves as jobs; sessions opened, imported, exported, compared, removed when old."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from uuid import UUID, uuid4

import structlog

from slrig.bundle import (
    check_calibration,
    read_calibration,
    stored_json,
    write_calibration,
    write_durably,
    write_opencv_calibration,
)
from slrig.calibrate.store import (
    ANSWER,
    CALIBRATION,
    COMPARED,
    READING,
    REPORT,
    USUAL_PATTERNS,
    ActivePointer,
    CalibrationRegister,
    CalibrationStore,
    PoseRecord,
    SessionRecord,
    SessionState,
    picture_name,
    read_session,
    reading_bytes,
    session_readings,
    setting_of,
    with_poses_on_disk,
)
from slrig.calibration import PROJECTOR, Board, BoardShape, PoseObservation
from slrig.calibration.accuracy import Comparison
from slrig.devices import Turntable
from slrig.disk import storage_errors
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    CalibrationStateError,
    CameraNotFoundError,
    DamagedError,
    PoseRefusedError,
    SlrigError,
    SolveRefusedError,
    UnsupportedByDeviceError,
    setting,
)
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.database import or_none
from slrig.jobs.job import Job, JobRun, Outcome, Recording
from slrig.jobs.manager import JobManager
from slrig.jobs.records import Holder, JobKind, utc_now
from slrig.jobs.retention import Kept
from slrig.jobs.worker import REQUEST_WAIT_S, Task
from slrig.model import Calibration, Size
from slrig.rig.session import ActiveCalibration, RigFacts, RigSession
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan, check_plan, no_turntable

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
        """Move the board to `position`, if any, and record a bundle."""
        opened = rig.open_whole()
        if self.position is not None and opened.positioner is not None:
            run.report("move", 0.0, self.position_name or "")
            opened.positioner.move(self.position)
        # Neither an earlier calibration nor what a rendered rig knows of its scene is any business of this one's.
        bare = replace(opened, calibration=None, head=None)
        return capture_frames(bare, self._scan, run.recording, run)

    def compute(self, run: JobRun) -> Outcome:
        """Read the pose, judge it by those before it, and draw what each camera saw."""
        from slrig.calibrate import pose_reading, report
        from slrig.calibrate.pose_reading import bundle_device_sizes

        session = _session_folder(run)
        record = read_session(session)
        cameras = bundle_device_sizes(run.bundle)
        projector = cameras.pop(PROJECTOR, None)
        require_same_devices(record, cameras, projector)
        setting, reading = setting_of(record), None
        try:
            reading = pose_reading.read_pose(run.bundle, setting.board, f"pose {self.number}")
            judged = report.judgement(reading, session_readings(session), setting)
        except PoseRefusedError as error:
            # The number is shown with it.
            judged = report.Judgement((str(error).removeprefix(f"pose 'pose {self.number}': "),), {}, None)
        run.check()
        answer = {"refused": list(judged.refusals), "answer": judged.answer}
        with disk_errors(run.folder):
            write_durably(run.folder / ANSWER, (json.dumps(answer, indent=1, allow_nan=False) + "\n").encode())
            for camera in setting.cameras:
                picture = report.pose_png(run.bundle, camera, reading, setting.board)
                write_durably(run.folder / picture_name(camera), picture)
            if reading is not None and not judged.refusals:
                write_durably(run.folder / READING, reading_bytes(reading))
        guidance = None if judged.guidance is None else asdict(judged.guidance)
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
        from slrig.calibrate import report, store

        session = _session_folder(run)
        record = with_poses_on_disk(read_session(session), session)
        setting, poses = setting_of(record), session_readings(session)
        compared = session / COMPARED
        result = store.solve_poses(
            setting.board, setting.cameras, setting.projector, poses, run,
            earlier=read_calibration(compared) if compared.is_file() else None,
            board_shape=self.board_shape,
            tolerance_mm=self.tolerance_mm,
        )  # fmt: skip
        if result.calibration.solved is not None:
            solved = replace(result.calibration.solved, id=solve_name(self.group, self.number))
            result = replace(result, calibration=replace(result.calibration, solved=solved))
        bundles = {pose.name: session / "poses" / f"{pose.number:02d}" / BUNDLE for pose in record.accepted}
        write_calibration(run.folder / CALIBRATION, result.calibration)
        report.write_report(run.folder / REPORT, result, poses, record, bundles)
        return Outcome({"solve": self.number, "result": report.summary(result)})

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
    """The extents of the rig's cameras, and of its projector; None in a session of cameras alone, without codes."""
    return facts.sizes, facts.projector.size if record.patterns.codes else None


# Short tasks of the worker


def survey(session: Path) -> Mapping[str, Any]:
    """Coverage by the accepted poses of a session, and where to hold the board next, as JSON values."""
    from slrig.calibrate.report import session_guidance

    return asdict(session_guidance(session_readings(session), setting_of(read_session(session))))


def coverage_picture(session: Path, device: str, next_move: Mapping[str, Any]) -> bytes:
    """A PNG of the board positions in a device's views, and of the next one."""
    from slrig.calibrate.report import coverage_png

    return coverage_png(setting_of(read_session(session)), device, session_readings(session), next_move)


def compare(first: Calibration, second: Calibration) -> Comparison:
    """Differences of the second calibration from the first."""
    from slrig.calibration.accuracy import compare_calibrations

    return compare_calibrations(first, second)


def warm() -> None:
    """Load what reading a pose needs, so that the first one is answered as fast as the others."""
    from slrig.calibrate.report import warm

    warm()


@dataclass(frozen=True, slots=True)
class AxisJob(Job):
    """The axis of the turntable from a board on it, shot at `count` angles, `step_deg` apart from
    `first_deg` on.
    """

    kind: ClassVar[JobKind] = JobKind.AXIS
    noun: ClassVar[str] = "axis of the turntable"

    board: Board
    first_deg: float = -50.0
    step_deg: float = 20.0
    count: int = 6
    exposure_s: float | None = None

    def check(self, rig: RigSession) -> int:
        """See `Job`. Raises UnsupportedByDeviceError: the rig has no turntable; CalibrationStateError, PatternError."""
        if rig.facts is None:
            return 0
        rig.refuse_misfit()
        if not rig.facts.turntable:
            raise no_turntable(self.step_deg)
        if rig.calibration is None:
            message = "The rig has no calibration in use, by which poses of a board give an axis. Activate one first."
            raise CalibrationStateError(message)
        return self.count * check_plan(self._scan, rig.facts)

    @property
    def capture_share(self) -> float:
        """See `Job`."""
        return 0.7

    def capture(self, rig: RigSession, run: JobRun) -> None:
        """Turn the board, and record a bundle at each angle; at the end the turntable is where it was."""
        opened = rig.open_whole()
        table = opened.positioner
        if not isinstance(table, Turntable):
            raise no_turntable(self.step_deg)
        with storage_errors(run.recording):
            run.recording.mkdir()
        # A board must not be known beforehand, as a rendered rig knows its scene.
        bare = replace(opened, head=None)
        for number, angle_deg in enumerate(self._angles_deg):
            name = f"{angle_deg:g}°"
            run.step(f"{name}: turn", number / self.count, "")
            table.turn(angle_deg)
            place = run.recording / f"{number:02d}"
            capture_frames(bare, self._scan, place, run.part(number, self.count, name)).finish()
        table.turn(0.0)

    def compute(self, run: JobRun) -> Outcome:
        """Read the board at each angle, and find what it turned about. Poses that cannot be read are left out.

        Raises TurntableRefusedError: fewer than three are left, or they give no axis.
        """
        from slrig.calibrate.pose_reading import axis_of_poses, read_pose

        calibration = read_calibration(run.bundle / "00" / CALIBRATION)
        read, angles_deg, refused = [], [], {}
        for number, angle_deg in enumerate(self._angles_deg):
            run.step("reading the board", number / self.count, f"{angle_deg:g}°")
            try:
                read.append(read_pose(run.bundle / f"{number:02d}", self.board, f"{angle_deg:g}°").observation)
                angles_deg.append(angle_deg)
            except PoseRefusedError as error:
                refused[f"{angle_deg:g}°"] = str(error)
        found = axis_of_poses(read, self.board, calibration, angles_deg, refused=refused)
        axis = found.axis.measured_axis
        return Outcome(
            {
                "axis": {
                    "point_mm": axis.point_mm.tolist(),
                    "direction": axis.direction.tolist(),
                    "covariance": axis.covariance.tolist(),
                    "point_sigma_mm": axis.point_sigma_mm,
                    "direction_sigma_deg": math.degrees(axis.direction_sigma_rad),
                },
                "poses": [
                    {
                        "name": name,
                        "residual_mm": left,
                        "angle_deg": found.angles_deg[name],
                        "error_deg": found.errors_deg.get(name),
                    }
                    for name, left in found.residual_mm.items()
                ],
                "refused": refused,
            }
        )

    @property
    def _angles_deg(self) -> list[float]:
        return [self.first_deg + number * self.step_deg for number in range(self.count)]

    @property
    def _scan(self) -> ScanPlan:
        return ScanPlan(patterns=USUAL_PATTERNS, exposure_s=self.exposure_s)


def turntable_axis(
    poses: Sequence[PoseObservation], board: Board, calibration: Calibration, angles_deg: Sequence[float] | None
) -> BoardAxis:
    """The axis that a board was turned about."""
    from slrig.calibrate.pose_reading import axis_of_poses

    return axis_of_poses(poses, board, calibration, angles_deg)


def _session_folder(run: JobRun) -> Path:
    """The folder of the session that a pose or a solve belongs to."""
    if run.place is None:
        raise ValueError(run)
    return run.place.parent.parent


def _devices(cameras: Mapping[str, Size], projector: Size | None) -> str:
    had = ", ".join(f"{name} {size}" for name, size in cameras.items())
    return had if projector is None else f"{had} and a projector of {projector}"


EXPORTS = ("calibration.json", "calibration.yml", "calibration.xml")
"""The forms in which a calibration can be had, and taken in."""

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PoseRequest:
    """A requested pose. position : index or name of a pose of the positioner; None leaves the board in place."""

    position: int | str | None = None
    exposure_s: float | None = None


class Calibrations:
    """The calibrations of a data folder, and the work on them: the `Group` of poses and solves. Any thread may call.

    register : the sessions on record. tolerance_mm : what the rig file says that a point of a scan may be wrong by.

    Raises StorageError if the folder cannot be read.
    """

    def __init__(self, manager: JobManager, *, tolerance_mm: float | None = None) -> None:
        self.store = CalibrationStore(manager.data)
        self.register = CalibrationRegister(self.store, manager.store)
        self._manager = manager
        self.tolerance_mm = tolerance_mm
        self._last_frame_s: dict[UUID, float] = {}
        manager.groups.update(dict.fromkeys((JobKind.POSE, JobKind.SOLVE), self))
        manager.rig.use_calibration(self.store.active_calibration())

    def settle(self) -> None:
        """Forget jobs of calibrations that are gone. At the start, before jobs are gone on with."""
        known = {record.id for record in self.register.all()}
        for session_id in self._manager.store.by_parent(JobKind.POSE, JobKind.SOLVE).keys() - known:
            self._manager.store.delete_of(session_id)

    def open(self, board: Board, *, label: str | None = None, patterns: PatternPlan = USUAL_PATTERNS) -> SessionRecord:
        """Open a session for a board. Touches no device. Raises StorageError."""
        record = self.register.add(uuid4(), self._manager.rig.name, label, board=board, patterns=patterns)

        def load() -> None:
            try:
                self._manager.worker.run(Task(warm, what="preparation"))
            except Exception:  # noqa: BLE001 - the first pose will report it
                _log.exception("the code that reads poses cannot be loaded")

        threading.Thread(target=load, name="slrig-warm", daemon=True).start()
        return record

    # Poses

    def shoot(
        self,
        session_id: UUID,
        request: PoseRequest,
        *,
        wait: bool,
        key: str | None = None,
        holder: Holder | None = None,
    ) -> PoseRecord:
        """Shoot a pose; with `wait` it may wait in line. Returns at once.

        key : the idempotency key of the request, reserved. holder : whom a refusal names meanwhile; None the pose.

        Raises
        ------
        CalibrationNotFoundError, CalibrationStateError
            There is no such session, or it is being solved, or was imported.
        UnsupportedByDeviceError
            The rig has no positioner, or not that position, or a camera cannot expose so long.
        CalibrationError
            The rig is not the one of the session's other poses.
        RigBusyError, QueueFullError, DeviceError, StorageError
            As a scan.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            setting_of(record)
            if record.state is SessionState.SOLVING:
                message = f"Calibration {record.id} is being solved. Shoot the next pose when that is over."
                raise CalibrationStateError(message)
            facts = self._manager.rig.facts
            place, name = _position(request.position, facts)
            if facts is not None:
                require_same_devices(record, *session_devices(record, facts))
            number = record.latest_pose + 1
            self._manager.submit(
                PoseJob(session_id, number, place, name, request.exposure_s, record.patterns),
                wait=wait, key=key, holder=holder,
                first=lambda: self.register.change(session_id, latest_pose=number),
            )  # fmt: skip
            return self.register.pose(session_id, number)

    def script(
        self,
        session_id: UUID,
        positions: Sequence[int | str],
        request: PoseRequest,
        *,
        wait: bool,
        key: str | None = None,
    ) -> PoseRecord:
        """Shoot poses of the positioner one after the other, and return the first; none means all of them.

        Other work may come between two of them. A pose that fails or is cancelled ends the script; one that is refused
        does not. Raises as `shoot` does.
        """
        with self.register.lock:
            facts = self._manager.rig.facts
            # Of a rig without positions, the first is requested, and refused.
            wanted = positions or range(max(len(facts.positions) if facts is not None else 0, 1))
            first, *others = [place for each in wanted if (place := _position(each, facts)[0]) is not None]
            exposed = PoseRequest(first, request.exposure_s)
            pose = self.shoot(session_id, exposed, wait=wait, key=key)
            self._set_script(session_id, *others)
            return pose

    def cancel(self, session_id: UUID, number: int) -> PoseRecord:
        """Request the early end of a pose and of its script. Returns at once; a pose that is over stays so."""
        pose = self.register.pose(session_id, number)
        if not pose.state.final:
            self._set_script(session_id)
            self._manager.cancel(pose.id)
        return self.register.pose(session_id, number)

    def drop(self, session_id: UUID, number: int) -> None:
        """Forget a pose and remove its files. Raises CalibrationStateError while it is under way."""
        with self.register.lock:
            pose = self.register.pose(session_id, number)
            solving = self.register.get(session_id).state is SessionState.SOLVING
            if not pose.state.final or solving:
                what = "The calibration is being solved" if pose.state.final else f"Pose {number} is {pose.state}"
                message = f"{what}. Wait until that is over, then drop the pose."
                raise CalibrationStateError(message)
            if pose.accepted:
                self.register.change(session_id, state=SessionState.OPEN)
            self.store.discard_pose(session_id, number)
            self._manager.store.delete(pose.id)
        try:
            if self.register.get(session_id).cameras:
                guidance = self._manager.worker.run(
                    Task(survey, (self.store.folder(session_id),), what="survey of the poses")
                )
                self.register.change(session_id, must_last=False, **guidance)
        except Exception:  # noqa: BLE001 - coverage and advice are a help, and nothing fails for want of them
            _log.exception("coverage could not be computed", calibration=str(session_id))

    # The solve

    def solve(
        self,
        session_id: UUID,
        *,
        board_shape: BoardShape = BoardShape.AUTO,
        measured_mm: Sequence[float] | None = None,
    ) -> SessionRecord:
        """Begin to solve a session from its accepted poses. Returns at once.

        board_shape : whether the board may be bowed. measured_mm : what the two printed scales of the board measure,
        see `Board.as_measured`, where that was not known before.

        Raises
        ------
        CalibrationNotFoundError
            There is no such session.
        CalibrationStateError
            It is being solved, a pose of it is under way, or it was imported. Or its board was measured already.
        CalibrationError
            The scales cannot measure that.
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
                    f"(POST /calibration/{session_id}/pose); GET /calibration/{session_id} shows what to shoot."
                )
                raise SolveRefusedError(message)
            if measured_mm is not None and record.board is not None:
                if record.board.measured:
                    message = (
                        f"The board of calibration {session_id} was measured already: {record.board.title}. Leave out "
                        f"{setting('measured_mm')}, or open a new calibration."
                    )
                    raise CalibrationStateError(message)
                self.register.change(session_id, board=record.board.as_measured(*measured_mm))
            compared, used = self.store.folder(session_id) / COMPARED, self._comparable(record)
            with disk_errors(compared):
                compared.unlink(missing_ok=True)
            if used is not None:
                write_calibration(compared, used)
            self._manager.submit(SolveJob(session_id, record.solve + 1, board_shape, self.tolerance_mm))
            return self.register.get(session_id)

    def _comparable(self, record: SessionRecord) -> Calibration | None:
        """The calibration in use, if it is one of the same devices."""
        used = self._manager.rig.calibration
        if used is None or record.projector is None:
            return None
        try:
            check_calibration(used, record.projector, record.cameras, "the calibration in use")
        except CalibrationError:
            return None
        return used

    # What becomes of jobs

    def captured(self, job: Job, job_id: UUID) -> None:
        """See `Group`: the next pose of a script is shot, exposed like the one before."""
        if not isinstance(job, PoseJob):
            return
        self._last_frame_s[job_id] = time.monotonic()
        facts = self._manager.rig.facts
        with self.register.lock:
            record = self.register.get(job.group)
            if not record.cameras and facts is not None:
                cameras, projector = session_devices(record, facts)
                self.register.change(job.group, must_last=False, cameras=cameras, projector=projector)
            if not record.script:
                return
            self._set_script(job.group, *record.script[1:])
            try:
                self.shoot(job.group, PoseRequest(record.script[0], job.exposure_s), wait=True)
            except SlrigError as error:
                _log.warning("the script of poses ends", calibration=str(job.group), cause=str(error))
                self._set_script(job.group)

    def ended(self, job: Job, job_id: UUID, outcome: Outcome | None) -> Outcome:
        """See `Group`."""
        if isinstance(job, SolveJob):
            return self._solved(job, outcome)
        if not isinstance(job, PoseJob):
            raise TypeError(job)
        since_s = self._last_frame_s.pop(job_id, None)
        if outcome is None or outcome.summary is None:
            self._set_script(job.group)
            self.store.discard_pose(job.group, job.number)
            return Outcome()
        summary = dict(outcome.summary)
        noted: dict[str, Any] = summary.pop("guidance") or {}
        if outcome.fault is None:
            # A solved session is open again; the earlier result stays.
            noted = {**noted, "state": SessionState.OPEN}
        self.register.change(job.group, must_last=False, **noted)
        seconds = None if since_s is None else round(time.monotonic() - since_s, 3)
        refused = outcome.fault is not None
        _log.info("pose read", calibration=str(job.group), pose=job.number, refused=refused, seconds=seconds)
        return Outcome({**summary, "seconds": seconds}, outcome.fault)

    def _solved(self, job: SolveJob, outcome: Outcome | None) -> Outcome:
        with suppress(OSError):
            (self.store.folder(job.group) / COMPARED).unlink(missing_ok=True)
        if outcome is None or outcome.summary is None:
            self.register.change(job.group, must_last=False, state=SessionState.FAILED)
            return Outcome()
        self.register.change(
            job.group, state=SessionState.SOLVED, solve=job.number, solved_at=utc_now(),
            result=outcome.summary["result"],
        )  # fmt: skip
        _log.info("calibration solved", calibration=str(job.group), solve=job.number)
        return Outcome({"solve": job.number})

    def _set_script(self, session_id: UUID, *left: int) -> None:
        self.register.change(session_id, must_last=False, script=left)

    # What is kept

    def submit(self, text: bytes, ending: str, *, label: str | None = None) -> SessionRecord:
        """Make a calibration of a file's text: ours, or OpenCV's. `ending` is that of one of `EXPORTS`.

        Raises CalibrationError if the text is not a calibration, StorageError if the disk refused.
        """
        session_id = uuid4()
        staged = self.store.stage_solve(session_id)
        source = staged / f"imported{ending}"
        try:
            with disk_errors(staged):
                write_durably(source, text)
            try:
                task = Task(read_calibration, (source,), what="reading of the calibration")
                calibration: Calibration = self._manager.worker.run(task, within_s=REQUEST_WAIT_S)
            except CalibrationError as error:
                message = str(error).replace(str(source), "the calibration sent")
                raise CalibrationError(message) from error
            source.unlink()
            write_calibration(staged / CALIBRATION, calibration)
            cameras = {name: device.size for name, device in calibration.cameras.items()}
            projector = None if calibration.projector is None else calibration.projector.size
            with self.register.lock:
                self.register.add(session_id, self._manager.rig.name, label, cameras=cameras, projector=projector)
                try:
                    self.store.commit_solve(session_id, 1, staged)
                    self.register.change(session_id, state=SessionState.SOLVED, solve=1)
                except BaseException:
                    self.register.remove(session_id)
                    raise
                return self.register.get(session_id)
        finally:
            self.store.discard(staged)

    def activate(self, session_id: UUID) -> SessionRecord:
        """Scan with what this session's last solve gave, from the next scan on, and after a restart.

        Raises as `calibration` does, CalibrationError also if it is for other devices than the rig has, and
        StorageError.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            self._manager.rig.use_calibration(ActiveCalibration(str(session_id), self.calibration(session_id)))
            try:
                self.store.activate(ActivePointer(session_id, record.solve))
            except BaseException:
                self._manager.rig.use_calibration(self.store.active_calibration())
                raise
        _log.info("calibration activated", calibration=str(session_id), solve=record.solve)
        return record

    def deactivate(self, session_id: UUID) -> SessionRecord:
        """Scan with the rig's own calibration again. Raises CalibrationStateError if this one is not in use."""
        with self.register.lock:
            record = self.register.get(session_id)
            if self.active != session_id:
                message = f"Calibration {session_id} is not in use."
                raise CalibrationStateError(message)
            self.store.activate(None)
            self._manager.rig.use_calibration(None)
        return record

    @property
    def active(self) -> UUID | None:
        """The calibration in use; None where it is the rig's own, or not known."""
        used = self._manager.rig.active
        return None if used is None else or_none(UUID, used.name)

    def pin(self, session_id: UUID, *, pinned: bool) -> SessionRecord:
        """Exempt a calibration from every retention, or not any more.

        Raises CalibrationNotFoundError, StorageError.
        """
        self.register.change(session_id, pinned=pinned)
        return self.register.get(session_id)

    def delete(self, session_id: UUID, trash: Path | None = None) -> None:
        """Remove a calibration with all its poses, or move it to `trash`.

        Raises CalibrationNotFoundError, and CalibrationStateError if it is in use or something is under way in it.
        """
        with self.register.lock:
            record = self.register.get(session_id)
            if self.active == session_id:
                message = (
                    f"Calibration {session_id} is in use. Activate another one, or go back to the rig's own with "
                    f"POST /calibration/{session_id}/deactivate, then delete it."
                )
                raise CalibrationStateError(message)
            if record.under_way:
                message = f"Something is under way in calibration {session_id}. Wait for it, then delete it."
                raise CalibrationStateError(message)
            self.register.remove(session_id, trash)
        _log.info("calibration deleted", calibration=str(session_id))

    def calibration(self, session_id: UUID) -> Calibration:
        """Return what the last solve gave.

        Raises CalibrationNotFoundError, CalibrationStateError if it was never solved, CalibrationError if it cannot be
        read.
        """
        record = self.register.get(session_id)
        if not record.solve:
            message = (
                f"Calibration {record.id} is {record.state} and was not solved yet. Solve it first "
                f"(POST /calibration/{record.id}/solve)."
            )
            raise CalibrationStateError(message)
        return self.store.calibration(record.id, record.solve)

    def file(self, session_id: UUID, name: str) -> Path:
        """Return where a file of the last solve lies. Raises CalibrationNotFoundError, ArtefactNotReadyError."""
        record = self.register.get(session_id)
        path = self.store.solve(session_id, record.solve) / name
        if record.solve:
            self._manager.data.require_whole(path.parent, name)
        if not record.solve or not self._manager.data.owns(path):
            what = "was imported, and" if record.board is None else "has no solve yet that went well, and"
            message = f"Calibration {session_id} {what} has no {name}."
            raise ArtefactNotReadyError(message)
        return path

    def exported(self, session_id: UUID, name: str) -> bytes:
        """Return a calibration as one of `EXPORTS`. Raises as `calibration` does."""
        calibration = self.calibration(session_id)
        staged = self.store.stage_solve(session_id)
        try:
            write = write_calibration if name.endswith(".json") else write_opencv_calibration
            write(staged / name, calibration)
            with disk_errors(staged):
                return (staged / name).read_bytes()
        finally:
            self.store.discard(staged)

    def coverage_picture(self, session_id: UUID, device: str | None) -> bytes:
        """Return a PNG of the board's positions in a device's views so far; None means the first camera.

        Raises CalibrationNotFoundError, ArtefactNotReadyError if it has no pose yet, and CameraNotFoundError if it has
        no such device.
        """
        record = self.register.get(session_id)
        if not record.cameras or record.board is None:
            message = f"Calibration {session_id} has no pose yet, and nothing is covered."
            raise ArtefactNotReadyError(message)
        setting = setting_of(record)
        names = list(setting.sizes)
        chosen = names[0] if device is None else device
        if chosen not in names:
            message = f"Calibration {session_id} has no device '{chosen}'; it has {', '.join(names)}."
            raise CameraNotFoundError(message)
        given = (self.store.folder(session_id), chosen, record.next_move or {})
        picture: bytes = self._manager.worker.run(
            Task(coverage_picture, given, what="picture of the coverage"), within_s=REQUEST_WAIT_S
        )
        return picture

    def compare(self, first: UUID, second: UUID) -> Comparison:
        """Return what the second says otherwise than the first. Raises as `calibration` does."""
        given = (self.calibration(first), self.calibration(second))
        found: Comparison = self._manager.worker.run(Task(compare, given, what="comparison"), within_s=REQUEST_WAIT_S)
        return found

    def latest(self) -> Sequence[SessionRecord]:
        """Return all calibrations, newest first."""
        return self.register.all()


def _position(place: int | str | None, facts: RigFacts | None) -> tuple[int | None, str | None]:
    """The index and the name of a position. Raises UnsupportedByDeviceError."""
    if place is None:
        return None, None
    names = () if facts is None else facts.positions
    if not names:
        message = (
            "position: this rig has no positioner, or is not open yet; hold the board yourself and leave position out"
        )
        raise UnsupportedByDeviceError(message)
    if isinstance(place, str) and place in names:
        return names.index(place), place
    if isinstance(place, int) and 0 <= place < len(names):
        return place, names[place]
    message = f"position: found {place!r}, this rig has 0 to {len(names) - 1}: {', '.join(names)}"
    raise UnsupportedByDeviceError(message)


@dataclass(frozen=True, slots=True)
class CalibrationArchive:
    """The calibrations for a retention: see `Archive`. Those without a solve are counted apart.

    scans : the folder of the scans, which name calibrations. named : gives further names that are needed.
    """

    calibrations: Calibrations
    scans: Path
    named: Callable[[], set[str]] = set
    kind: str = "calibration"

    def kept(self) -> Sequence[Kept]:
        """See `Archive`."""
        return [
            Kept(
                each.id, each.label, each.created_at, each.solved_at or each.created_at,
                each.solve > 0, each.pinned or each.under_way,
            )
            for each in self.calibrations.latest()
        ]  # fmt: skip

    def needed(self, old: Collection[UUID]) -> Collection[UUID]:
        """See `Archive`: those that scans were measured by, and what else is named."""
        named = named_by_scans(self.scans) | set(map(_session_of, self.named()))
        return [each for each in old if self._names(self.calibrations.register.get(each)) & named]

    def place(self, item: UUID) -> Path:
        """See `Archive`."""
        return self.calibrations.store.folder(item)

    def remove(self, item: UUID, trash: Path) -> None:
        """See `Archive`."""
        self.calibrations.delete(item, trash)

    def _names(self, record: SessionRecord) -> set[str]:
        """Its names in scans."""
        names = {str(record.id)}
        for number in range(1, record.solve + 1):
            with suppress(CalibrationError, DamagedError):
                names.add(_session_of(self.calibrations.store.calibration(record.id, number).solve_id))
        return names


def named_by_scans(scans: Path) -> set[str]:
    """Names of the calibrations in the scans of a folder; of a solve's id, the session's part.

    A scan with unreadable files names none.
    """
    names = set()
    for scan in (place for place in scans.iterdir() if not place.is_symlink()):
        with suppress(OSError, ValueError, KeyError, TypeError):
            names.add(_session_of(stored_json((scan / "report.json").read_bytes())["calibration"]["id"]))
            continue
        with suppress(OSError, CalibrationError):
            # A scan that got no mesh may be reconstructed yet.
            names.add(_session_of(read_calibration(scan / "bundle" / "calibration.json").solve_id))
    return names


def _session_of(solve: str) -> str:
    """The part of a solve's name that all solves of its session share.

    >>> _session_of("3f2a.2"), _session_of("0123456789ab")
    ('3f2a', '0123456789ab')
    """
    return solve.partition(".")[0]
