"""Poses of a session, shot: in line with the scans, one by one or as a script of the positioner's."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol
from uuid import UUID

import structlog

from slrig.calibrate.pose_answering import PoseAnswers, board_of, opened
from slrig.calibrate.records import KeptKey, PoseRecord, PoseState, SessionRecord, SessionState
from slrig.calibrate.register import CalibrationRegister
from slrig.calibrate.store import BUNDLE
from slrig.calibrate.tools import CalibrationTools
from slrig.devices import Rig
from slrig.errors import (
    CalibrationError,
    CalibrationStateError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.job import Holder
from slrig.jobs.records import Clock, require_same_body
from slrig.model import Size
from slrig.rig.session import RigFacts
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.runner import RunnerStatus

_log = structlog.get_logger(__name__)


class RigQueue(Protocol):
    """`slrig.scan.runner.Runner`, as far as a session needs it."""

    def submit_work(
        self,
        work: Callable[[Rig, Callable[[], bool]], None],
        *,
        holder: Holder,
        wait: bool,
        ended: Callable[[Exception | None], None],
        begun: Callable[[UUID], None],
    ) -> UUID:
        """Have work done with the rig."""
        ...

    def cancel_work(self, work_id: UUID) -> None:
        """Ask it to end early."""
        ...

    def status(self) -> RunnerStatus:
        """What the rig is."""
        ...


@dataclass(frozen=True, slots=True)
class PoseRequest:
    """A pose that is asked for. position : index or name of a pose of the positioner; None leaves the board where it
    is. key, fingerprint : of the request, so that its repeat shoots nothing.
    """

    position: int | str | None = None
    exposure_s: float | None = None
    key: str | None = None
    fingerprint: str = ""


class PoseDesk:
    """Shoots, cancels and drops poses. Any thread may call."""

    def __init__(
        self,
        register: CalibrationRegister,
        folder: DataFolder,
        queue: RigQueue,
        tools: CalibrationTools,
        answers: PoseAnswers,
        *,
        clock: Clock,
        spare_bytes: int,
    ) -> None:
        self._register = register
        self._store = register.store
        self._folder = folder
        self._queue = queue
        self._tools = tools
        self._clock = clock
        self._spare_bytes = spare_bytes
        self._answers = answers
        self._work_ids: dict[tuple[UUID, int], UUID] = {}

    def shoot(self, session_id: UUID, request: PoseRequest, *, wait: bool, holder: Holder | None = None) -> PoseRecord:
        """Have a pose shot; `wait` lets it stand in line. Returns at once.

        holder : whom a refusal names meanwhile; None the pose.

        Raises
        ------
        CalibrationNotFoundError, CalibrationStateError
            There is no such session, or it is being solved, or was imported.
        UnsupportedByDeviceError
            The rig has no positioner, or not that position, or a camera cannot expose so long.
        CalibrationError
            The rig is not the one of the session's other poses.
        IdempotencyError
            The key was sent before with another request.
        StorageError
            There is too little room, or the disk refused.
        RigBusyError, QueueFullError, DeviceError
            As a scan.
        """
        with self._register.lock:
            record = self._register.get(session_id)
            earlier = _kept(record, request)
            if earlier is not None:
                return self._register.pose(session_id, earlier)
            _refuse_closed(record)
            facts = self._queue.status().facts
            place, name = _position(request.position, facts)
            plan = ScanPlan(patterns=record.patterns, exposure_s=request.exposure_s)
            if facts is not None:
                require_same_rig(record, facts)
                self._folder.require_space(2 * check_plan(plan, facts) + self._spare_bytes)
            number = record.latest_pose + 1
            pose = PoseRecord(number, PoseState.QUEUED, self._clock(), place, name, request.exposure_s)

            def begun(work_id: UUID) -> None:
                self._work_ids[session_id, number] = work_id
                self._register.change(session_id, lambda found: _with_new(found, pose, request))

            own = Holder(
                f"calibration {session_id}, pose {number}",
                f"calibration {session_id}, pose {number}",
                f"/calibration/{session_id}/pose/{number}",
            )
            self._queue.submit_work(
                lambda rig, cancelled: self._shoot(session_id, pose, plan, rig, cancelled),
                holder=holder or own,
                wait=wait,
                ended=lambda error: self._shot(session_id, number, error),
                begun=begun,
            )
            return pose

    def script(
        self, session_id: UUID, positions: Sequence[int | str], request: PoseRequest, *, wait: bool
    ) -> PoseRecord:
        """Have poses of the positioner shot one after the other, and return the first; none means all of them.

        Other work may come between two of them. A pose that fails or is cancelled ends the script; one that is refused
        does not. Raises as `shoot` does.
        """
        with self._register.lock:
            record = self._register.get(session_id)
            earlier = _kept(record, request)
            if earlier is not None:
                return self._register.pose(session_id, earlier)
            facts = self._queue.status().facts
            asked = positions or range(len(facts.positions) if facts is not None else 0)
            indices = [place for place, _ in (_position(each, facts) for each in asked) if place is not None]
            if not indices:
                _position(0, facts)
            first = self.shoot(session_id, replace(request, position=indices[0]), wait=wait)
            self._register.change(session_id, lambda found: replace(found, script=tuple(indices[1:])))
            return first

    def cancel(self, session_id: UUID, number: int) -> PoseRecord:
        """Ask a pose to end early, and the script that it belongs to. Returns at once; a pose that is over stays so."""
        pose = self._register.pose(session_id, number)
        work_id = self._work_ids.get((session_id, number))
        if work_id is not None and not pose.state.final:
            self._register.change(session_id, lambda found: replace(found, script=()), must_last=False)
            self._queue.cancel_work(work_id)
        return self._register.pose(session_id, number)

    def drop(self, session_id: UUID, number: int) -> None:
        """Forget a pose and remove its files. Raises CalibrationStateError while it is under way."""
        with self._register.lock:
            pose = self._register.pose(session_id, number)
            record = self._register.get(session_id)
            if not pose.state.final or record.state is SessionState.SOLVING:
                what = f"{pose.name} is {pose.state}" if not pose.state.final else "the calibration is being solved"
                message = f"{what[:1].upper()}{what[1:]}. Wait until that is over, then drop the pose."
                raise CalibrationStateError(message)

            def without(found: SessionRecord) -> SessionRecord:
                kept = replace(found, poses=tuple(each for each in found.poses if each.number != number))
                return opened(kept) if pose.state is PoseState.ACCEPTED else kept

            self._register.change(session_id, without)
            self._store.discard_pose(session_id, number)
        self._answers.survey(session_id)

    def _shoot(
        self, session_id: UUID, pose: PoseRecord, plan: ScanPlan, rig: Rig, cancelled: Callable[[], bool]
    ) -> None:
        """On the rig's thread: move the board if asked, and record a bundle."""
        self._register.change_pose(session_id, pose.number, lambda found: replace(found, state=PoseState.SHOOTING))
        self._meet(session_id, rig)
        if pose.position is not None and rig.positioner is not None:
            self._register.progress(session_id, "move", 0.0, pose.position_name or "", pose=pose.number)
            rig.positioner.move(pose.position)
        staged = self._store.stage_pose(session_id, pose.number)

        def progress(stage: str, fraction: float, detail: str) -> None:
            self._register.progress(session_id, stage, fraction, detail, pose=pose.number)

        # Neither an earlier calibration nor what a rendered rig knows of its scene is any business of this one's.
        bare = replace(rig, calibration=None, head=None)
        self._tools.capture(bare, plan, staged / BUNDLE, progress=progress, cancelled=cancelled)

    def _meet(self, session_id: UUID, rig: Rig) -> None:
        """Take the rig's devices down with the first pose, and hold the others against them."""
        facts = RigFacts({name: camera.info for name, camera in rig.cameras.items()}, rig.projector.info, None)
        record = self._register.get(session_id)
        require_same_rig(record, facts)
        if not record.cameras:
            projector = _projector(record, facts)
            self._register.change(session_id, lambda found: replace(found, cameras=facts.sizes, projector=projector))

    def _shot(self, session_id: UUID, number: int, error: Exception | None) -> None:
        """The rig is free: read the pose on a thread of its own, or tell why there is nothing to be read."""
        self._work_ids.pop((session_id, number), None)
        if error is not None:
            self._store.discard(self._store.staged_pose(session_id, number))
            self._answers.end(session_id, number, error)
            return
        since_s = time.monotonic()
        self._register.change_pose(
            session_id, number, lambda found: replace(found, state=PoseState.READING), must_last=False
        )
        # Daemons, so that a reading under way never holds up the end of the service.
        threading.Thread(
            target=self._answers.read, args=(session_id, number, since_s), name="slrig-reading", daemon=True
        ).start()
        self._go_on(session_id, self._register.pose(session_id, number).exposure_s)

    def _go_on(self, session_id: UUID, exposure_s: float | None) -> None:
        """Have the next pose of a script shot, exposed like the one before."""
        with self._register.lock:
            script = self._register.get(session_id).script
            if not script:
                return
            try:
                self._register.change(session_id, lambda found: replace(found, script=script[1:]))
                self.shoot(session_id, PoseRequest(script[0], exposure_s), wait=True)
            except SlrigError as error:
                _log.warning("the script of poses ends", calibration=str(session_id), cause=str(error))
                self._register.change(session_id, lambda found: replace(found, script=()), must_last=False)


def require_same_rig(record: SessionRecord, facts: RigFacts) -> None:
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


def _refuse_closed(record: SessionRecord) -> None:
    board_of(record)
    if record.state is SessionState.SOLVING:
        message = f"Calibration {record.id} is being solved. Shoot the next pose when that is over."
        raise CalibrationStateError(message)


def _kept(record: SessionRecord, request: PoseRequest) -> int | None:
    """The number of the pose that an earlier request with this key made. Raises IdempotencyError."""
    kept = None if request.key is None else record.keys.get(request.key)
    if kept is None:
        return None
    require_same_body(kept.fingerprint, request.fingerprint, made="pose")
    return kept.pose


def _with_new(record: SessionRecord, pose: PoseRecord, request: PoseRequest) -> SessionRecord:
    keys = dict(record.keys)
    if request.key is not None:
        keys[request.key] = KeptKey(request.fingerprint, pose.number)
    return replace(record.with_pose(pose), keys=keys, progress=None)


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
