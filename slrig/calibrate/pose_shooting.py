"""Poses of a session, shot in line with the scans, one by one or as a script of the positioner's, then read and judged.

A pose is a job; its summary is what the pose's folder says of it, the figures or the cause.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import structlog

from slrig.bundle import write_durably
from slrig.calibrate.records import PoseRecord, SessionRecord, SessionState, pose_of
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.solving import ReadPose
from slrig.calibrate.store import ANSWER, READING, picture_name, reading_bytes
from slrig.calibrate.tools import CalibrationTools, Judgement, setting_of
from slrig.devices import Rig
from slrig.errors import CalibrationError, CalibrationStateError, PoseRefusedError, SlrigError, UnsupportedByDeviceError
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.job import Holder, Job
from slrig.jobs.progress import ProgressRecorder
from slrig.jobs.records import JobKind, JobRecord, JobState, acting_as, actor, utc_now
from slrig.jobs.rig_jobs import Outcome, Parts, Recorded, RigJobs
from slrig.model import Size
from slrig.rig.session import RigFacts, RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import check_plan

_log = structlog.get_logger(__name__)


@dataclass(frozen=True, slots=True)
class PoseRequest:
    """A pose that is asked for. position : index or name of a pose of the positioner; None leaves the board where it
    is.
    """

    position: int | str | None = None
    exposure_s: float | None = None


@dataclass(slots=True)
class PoseDesk:
    """Shoots, reads, cancels and drops poses. Any thread may call."""

    register: CalibrationRegister
    folder: DataFolder
    work: RigJobs
    tools: CalibrationTools
    spare_bytes: int
    _reading: threading.Lock = field(default_factory=threading.Lock)
    """One at a time: each is judged by those before it."""

    def warm(self) -> None:
        """Load, on a thread of its own, what reading a pose needs."""

        def load() -> None:
            try:
                self.tools.warm()
            except Exception:  # noqa: BLE001 - the first pose will tell
                _log.exception("what reads poses cannot be loaded")

        threading.Thread(target=load, name="slrig-warm", daemon=True).start()

    def shoot(
        self,
        session_id: UUID,
        request: PoseRequest,
        *,
        wait: bool,
        key: str | None = None,
        holder: Holder | None = None,
    ) -> PoseRecord:
        """Have a pose shot; `wait` lets it stand in line. Returns at once.

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
            rig = self.work.queue.rig
            place, name = _position(request.position, rig.facts)
            scan = ScanPlan(patterns=record.patterns, exposure_s=request.exposure_s)
            if rig.facts is not None:
                _require_same_rig(record, rig.facts)
                self.folder.require_space(2 * check_plan(scan, rig.facts) + self.spare_bytes)
            number = record.latest_pose + 1
            pose = PoseRecord(number, uuid4(), JobState.QUEUED, utc_now(), place, name, request.exposure_s)

            def begun() -> None:
                self.register.change(session_id, latest_pose=number)
                self.register.jobs.create(
                    pose.plan, rig=rig.name, label=None, key=key, job_id=pose.id, kind=JobKind.POSE, parent=session_id
                )

            parts = self._parts(session_id, pose, scan, asked_by=actor())
            self.work.submit(pose.id, parts, holder=holder or _holder(session_id, number), wait=wait, record=begun)
            return self.register.pose(session_id, number)

    def take_up(self, session_id: UUID, job: JobRecord) -> None:
        """Go on with a pose of an earlier run of the service: one that waited is shot, one that was read is read once
        more, one that had the rig was interrupted.
        """
        pose = pose_of(job)
        scan = ScanPlan(patterns=self.register.get(session_id).patterns, exposure_s=pose.exposure_s)
        parts = self._parts(session_id, pose, scan, asked_by=job.requested_by)
        whole = self.folder.owns(self.folder.staging(job.id) / BUNDLE)
        self.work.take_up(job, parts, holder=_holder(session_id, pose.number), resumes=whole)

    def script(
        self,
        session_id: UUID,
        positions: Sequence[int | str],
        request: PoseRequest,
        *,
        wait: bool,
        key: str | None = None,
    ) -> PoseRecord:
        """Have poses of the positioner shot one after the other, and return the first; none means all of them.

        Other work may come between two of them. A pose that fails or is cancelled ends the script; one that is refused
        does not. Raises as `shoot` does.
        """
        with self.register.lock:
            facts = self.work.queue.rig.facts
            # Of a rig without positions, the first is asked for, and refused.
            asked = positions or range(max(len(facts.positions) if facts is not None else 0, 1))
            first, *others = [place for each in asked if (place := _position(each, facts)[0]) is not None]
            pose = self.shoot(session_id, replace(request, position=first), wait=wait, key=key)
            self._set_script(session_id, *others)
            return pose

    def cancel(self, session_id: UUID, number: int) -> PoseRecord:
        """Ask a pose to end early, and the script that it belongs to. Returns at once; a pose that is over stays so."""
        pose = self.register.pose(session_id, number)
        if not pose.state.final:
            self._set_script(session_id)
            self.work.cancel(pose.id)
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
            self.register.store.discard_pose(session_id, number)
            self.register.jobs.delete(pose.id)
        self._survey(session_id)

    def _parts(self, session_id: UUID, pose: PoseRecord, scan: ScanPlan, *, asked_by: str | None) -> Parts:
        """The two parts of a pose. asked_by : who asks for the next one of its script, too."""
        last_frame_s = time.monotonic()

        def capture(held: RigSession, job: Job, progress: ProgressRecorder) -> Recorded:
            """Move the board if asked, and record a bundle."""
            nonlocal last_frame_s
            rig = held.open()
            self._meet(session_id, rig)
            if pose.position is not None and rig.positioner is not None:
                progress("move", 0.0, pose.position_name or "")
                rig.positioner.move(pose.position)
            # Neither an earlier calibration nor what a rendered rig knows of its scene is any business of this one's.
            bare, folder = replace(rig, calibration=None, head=None), self.folder.recording(pose.id)
            recording = self.tools.capture(bare, scan, folder, progress=progress, cancelled=job.stop.is_set)
            last_frame_s = time.monotonic()
            return recording

        def captured() -> None:
            with acting_as(asked_by):
                self._go_on(session_id, pose.exposure_s)

        def compute(*_: object) -> Outcome:
            with self._reading:
                # A run of the service that ended in the middle of this may have left some of it.
                return self._read(session_id, pose, self.folder.clear_results(pose.id), last_frame_s)

        def failed(_: Exception) -> None:
            """Remove a pose that came to nothing, and end the script with it."""
            self._set_script(session_id)
            self.register.store.discard_pose(session_id, pose.number)

        return Parts(compute, capture, captured=captured, failed=failed)

    def _meet(self, session_id: UUID, rig: Rig) -> None:
        """Take the rig's devices down with the first pose, and hold the others against them."""
        facts = RigFacts({name: camera.info for name, camera in rig.cameras.items()}, rig.projector.info, None)
        record = self.register.get(session_id)
        _require_same_rig(record, facts)
        if not record.cameras:
            self.register.change(session_id, cameras=facts.sizes, projector=_projector(record, facts))

    def _read(self, session_id: UUID, pose: PoseRecord, staged: Path, since_s: float) -> Outcome:
        """Read a pose whose frames lie in `staged`, put it in its place, and return what was found.

        since_s : when the last frame came, on the monotonic clock.
        """
        record = self.register.get(session_id)
        setting = setting_of(record)
        reading: ReadPose | None = None
        try:
            reading = self.tools.read(staged / BUNDLE, setting.board, pose.name)
            judged = self.tools.judge(reading, self.register.store.readings(record), setting)
        except PoseRefusedError as error:
            # The number is told beside it; and the person shot it just now.
            judged = Judgement((str(error).removeprefix(f"pose '{pose.name}': "),), {}, None)
        document = {"pose": pose.plan, "refused": list(judged.refusals), "answer": judged.answer}
        with disk_errors(staged):
            write_durably(staged / ANSWER, (json.dumps(document, indent=1, allow_nan=False) + "\n").encode())
            for camera in setting.cameras:
                picture = self.tools.picture(staged / BUNDLE, camera, reading, setting.board)
                write_durably(staged / picture_name(camera), picture)
            if reading is not None and not judged.refusals:
                write_durably(staged / READING, reading_bytes(reading))
        self.register.store.commit_pose(session_id, pose.number, staged)
        noted = {} if judged.standing is None else asdict(judged.standing)
        if not judged.refusals:
            # A solved session is open again; the earlier result stays.
            noted["state"] = SessionState.OPEN
        self.register.change(session_id, must_last=False, **noted)
        seconds = round(time.monotonic() - since_s, 3)
        refused = bool(judged.refusals)
        _log.info("pose read", calibration=str(session_id), pose=pose.number, refused=refused, seconds=seconds)
        return outcome_of(document, seconds=seconds)

    def _survey(self, session_id: UUID) -> None:
        """Bring coverage and advice up to date; they are a help, and nothing fails for want of them."""
        try:
            record = self.register.get(session_id)
            if record.cameras:
                standing = self.tools.survey(self.register.store.readings(record), setting_of(record))
                self.register.change(session_id, must_last=False, **asdict(standing))
        except Exception:  # noqa: BLE001 - see above
            _log.exception("coverage could not be told", calibration=str(session_id))

    def _set_script(self, session_id: UUID, *left: int) -> None:
        self.register.change(session_id, must_last=False, script=left)

    def _go_on(self, session_id: UUID, exposure_s: float | None) -> None:
        """Have the next pose of a script shot, exposed like the one before."""
        with self.register.lock:
            script = self.register.get(session_id).script
            if not script:
                return
            self._set_script(session_id, *script[1:])
            try:
                self.shoot(session_id, PoseRequest(script[0], exposure_s), wait=True)
            except SlrigError as error:
                _log.warning("the script of poses ends", calibration=str(session_id), cause=str(error))
                self._set_script(session_id)


def outcome_of(answer: Mapping[str, Any], *, seconds: float | None = None) -> Outcome:
    """What the job of a pose came to, by what the pose's folder says."""
    refusals = answer["refused"]
    fault = JobFailure(PoseRefusedError.code, " ".join(refusals)) if refusals else None
    return Outcome({"answer": answer["answer"], "seconds": seconds}, fault)


def _require_same_rig(record: SessionRecord, facts: RigFacts) -> None:
    """Raise CalibrationError unless the rig's devices are those of the session's poses."""
    projector = _projector(record, facts)
    if not record.cameras or (dict(record.cameras) == dict(facts.sizes) and record.projector == projector):
        return
    message = (
        f"The poses of calibration {record.id} were shot with {_devices(record.cameras, record.projector)}; the rig "
        f"now has {_devices(facts.sizes, projector)}. Open a new calibration for it."
    )
    raise CalibrationError(message)


def _projector(record: SessionRecord, facts: RigFacts) -> Size | None:
    """The extent of the rig's projector; None in a session of cameras alone, whose poses carry no codes."""
    return facts.projector.size if record.patterns.codes else None


def _devices(cameras: Mapping[str, Size], projector: Size | None) -> str:
    had = ", ".join(f"{name} {size}" for name, size in cameras.items())
    return had if projector is None else f"{had} and a projector of {projector}"


def _holder(session_id: UUID, number: int) -> Holder:
    words = f"calibration {session_id}, pose {number}"
    return Holder(words, words, f"/calibration/{session_id}/pose/{number}")


def _position(asked: int | str | None, facts: RigFacts | None) -> tuple[int | None, str | None]:
    """The index and the name of a position. Raises UnsupportedByDeviceError."""
    if asked is None:
        return None, None
    names = () if facts is None else facts.positions
    if not names:
        message = (
            "position: this rig has no positioner, or is not open yet; hold the board yourself and leave position out"
        )
        raise UnsupportedByDeviceError(message)
    if isinstance(asked, str) and asked in names:
        return names.index(asked), asked
    if isinstance(asked, int) and 0 <= asked < len(names):
        return asked, names[asked]
    message = f"position: found {asked!r}, this rig has 0 to {len(names) - 1}: {', '.join(names)}"
    raise UnsupportedByDeviceError(message)
