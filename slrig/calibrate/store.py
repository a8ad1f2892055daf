"""Sessions and poses as values, and calibrations on disk, each a folder that is whole at every instant.

DATA/calibrations/ID/session.json      the session: board, devices, figures; its poses and solves are jobs on record
DATA/calibrations/ID/poses/NN/         a pose: bundle/, answer.json, picture-CAMERA.png, and reading.npz if accepted
DATA/calibrations/ID/solves/N/         a solve: calibration.json, report.html; never changed once it is there
DATA/calibrations/active.json          which solve of which calibration scans use

What is being made lies in DATA/.incoming, and is renamed into place once.
"""

from __future__ import annotations

import io
import json
import shutil
import threading
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import Any, cast
from uuid import UUID, uuid4

import numpy as np
import structlog
from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from slrig.bundle import (
    read_arrays,
    read_calibration,
    stored_json,
    sync_folder,
    sync_tree,
    write_durably,
    write_file,
)
from slrig.calibration import (
    PROJECTOR,
    Board,
    BoardShape,
    BoardView,
    Correspondences,
    ExpectedError,
    Observations,
    PoseObservation,
    Solution,
    ViewQuality,
)
from slrig.calibration.accuracy import OddEven, compare_halves
from slrig.calibration.judgement import Verdict, check_scale, judge_calibration
from slrig.calibration.poses import Coverage, coverage
from slrig.errors import (
    CalibrationError,
    CalibrationNotFoundError,
    CalibrationStateError,
    DamagedError,
    InvalidInputError,
    PoseRefusedError,
    SolveRefusedError,
    StorageError,
)
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.data_folder import BUNDLE, DataFolder, require_whole, write_entries
from slrig.jobs.listener import SILENT, Listener
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, read_record, utc_now
from slrig.jobs.store import JobStore
from slrig.model import Calibration, SequenceName, Size, SolveRecord
from slrig.rig.session import ActiveCalibration
from slrig.scan.plan import PatternPlan

USUAL_PATTERNS = PatternPlan(sequence=SequenceName.ROBUST, rows=True)
"""White, Gray code and line shift along both axes: the projector has columns and rows to be calibrated."""


class SessionState(StrEnum):
    """State of a session. Another pose opens a solved or failed one again."""

    OPEN = "open"
    SOLVING = "solving"
    SOLVED = "solved"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class PoseRecord:
    """One pose, as its job says. `number` counts from 1 within the session and is never given twice.

    state : one that is accepted has succeeded. position : index of the requested pose of the positioner, None where a
    person holds the board. answer : its findings, as JSON values, see `slrig.calibrate.report`;
    None until read. fault : why it was refused or failed. seconds : from the last frame to the answer.
    """

    number: int
    id: UUID
    state: JobState
    created_at: datetime
    position: int | None = None
    position_name: str | None = None
    exposure_s: float | None = None
    answer: Mapping[str, Any] | None = None
    fault: JobFailure | None = None
    seconds: float | None = None

    @property
    def name(self) -> str:
        """As a person calls it, and as the solve names it.

        >>> PoseRecord(3, UUID(int=0), JobState.QUEUED, datetime(2026, 11, 22)).name
        'pose 3'
        """
        return f"pose {self.number}"

    @property
    def accepted(self) -> bool:
        """Whether a solve takes it."""
        return self.state is JobState.SUCCEEDED

    @property
    def refused(self) -> bool:
        """Whether its frames show no pose that a solve could take."""
        return self.fault is not None and self.fault.code == PoseRefusedError.code


def pose_of(job: JobRecord) -> PoseRecord:
    """The pose that a job is."""
    found = job.summary or {}
    return PoseRecord(
        id=job.id,
        state=job.state,
        created_at=job.created_at,
        answer=found.get("answer"),
        fault=job.fault,
        seconds=found.get("seconds"),
        **{name: job.plan[name] for name in ("number", "position", "position_name", "exposure_s")},
    )


@dataclass(frozen=True, slots=True)
class SessionRecord:
    """A calibration: of a session that shot poses, or imported.

    number : rises with every calibration and orders lists. board : None where it was imported. cameras, projector :
    the extents of the rig's devices, from the first pose on. latest_pose : the highest number given. state : on disk
    never SOLVING. solve : the number of the last solve that went well, 0 before; result : its figures as JSON values.
    script : positions that are still to be taken. pinned : no retention removes it.

    The last four are of its jobs, and not on disk. fault : of the last solve. progress : of the job under way.
    under_way : whether a pose is being shot or read, or a solve runs.
    """

    number: int
    id: UUID
    created_at: datetime
    rig: str
    label: str | None = None
    board: Board | None = None
    patterns: PatternPlan = USUAL_PATTERNS
    cameras: Mapping[str, Size] = field(default_factory=dict)
    projector: Size | None = None
    state: SessionState = SessionState.OPEN
    latest_pose: int = 0
    solve: int = 0
    solved_at: datetime | None = None
    result: Mapping[str, Any] | None = None
    coverage: Mapping[str, Any] | None = None
    next_move: Mapping[str, Any] | None = None
    script: tuple[int, ...] = ()
    pinned: bool = False
    poses: tuple[PoseRecord, ...] = ()
    progress: JobProgress | None = None
    fault: JobFailure | None = None
    under_way: bool = False

    @property
    def accepted(self) -> tuple[PoseRecord, ...]:
        """The poses that a solve takes."""
        return tuple(pose for pose in self.poses if pose.accepted)


@dataclass(frozen=True, slots=True)
class Setting:
    """The board before the rig, and the extents of the devices; projector is None where only cameras are calibrated."""

    board: Board
    cameras: Mapping[str, Size]
    projector: Size | None

    @property
    def sizes(self) -> Mapping[str, Size]:
        """The extents of the devices, the projector among them where there is one."""
        return self.cameras if self.projector is None else {**self.cameras, PROJECTOR: self.projector}


def setting_of(record: SessionRecord) -> Setting:
    """The setting of a session. Raises CalibrationStateError for an imported calibration, which has no board."""
    if record.board is None:
        message = f"Calibration {record.id} was imported and has no board. Open a new one to shoot poses."
        raise CalibrationStateError(message)
    return Setting(record.board, record.cameras, record.projector)


def with_jobs(session: SessionRecord, jobs: Sequence[JobRecord]) -> SessionRecord:
    """A session as it is on disk, completed by what its jobs, oldest first, say."""
    # Without a plan, where its record is damaged.
    of_poses = [job for job in jobs if job.kind is JobKind.POSE and job.plan]
    poses = tuple(sorted(map(pose_of, of_poses), key=lambda pose: pose.number))
    solves = [job for job in jobs if job.kind is JobKind.SOLVE]
    running = [job for job in jobs if not job.state.final]
    state = SessionState.SOLVING if any(not job.state.final for job in solves) else session.state
    last = solves[-1].fault if solves else None
    fault = last if last is not None and (state is SessionState.FAILED or last.code == DamagedError.code) else None
    progress = next((job.progress for job in running if job.state is not JobState.QUEUED), None)
    return replace(session, state=state, poses=poses, progress=progress, fault=fault, under_way=bool(running))


_session_adapter = TypeAdapter(SessionRecord)


def session_json(session: SessionRecord) -> bytes:
    """A session as JSON text, without what its jobs say."""
    of_jobs = {"poses", "progress", "fault", "under_way"}
    return _session_adapter.dump_json(session, indent=1, exclude=of_jobs) + b"\n"


def session_from_json(text: bytes, source: str) -> SessionRecord:
    """The inverse of `session_json`. Raises StorageError when it is not that."""
    try:
        return _session_adapter.validate_json(text)
    except (ValidationError, InvalidInputError) as error:
        message = f"{source} is not a calibration session as this version of slrig writes it: {error}"
        raise StorageError(message) from error


def plain(value: Any) -> Any:
    """A value of dataclasses, arrays, tuples and mappings as JSON values; what JSON has no number for is null.

    >>> import numpy as np
    >>> plain({"a": np.array([1.5, np.nan]), "b": (Size(2, 3),)})
    {'a': [1.5, None], 'b': [{'width_px': 2, 'height_px': 3}]}
    """
    return to_jsonable_python(value, inf_nan_mode="null", fallback=lambda array: array.tolist())


_SOLVE_SHARE = 0.95


@dataclass(frozen=True, slots=True)
class ReadPose:
    """One pose, as it was read: its observation, and how well each camera saw it."""

    observation: PoseObservation
    figures: Mapping[str, ViewQuality]


@dataclass(frozen=True, slots=True)
class CalibrationResult:
    """A solved calibration with all of its figures.

    calibration : carries its own error (`solved`). odd_even : what the odd and the even poses differ by, solved apart,
    against what is stated for that; None where there are too few.
    """

    solution: Solution
    calibration: Calibration
    expected: ExpectedError
    verdict: Verdict
    coverage: Coverage
    odd_even: OddEven | None = None


def solve_poses(
    board: Board,
    cameras: Mapping[str, Size],
    projector: Size | None,
    poses: Sequence[ReadPose],
    listener: Listener = SILENT,
    /,
    *,
    earlier: Calibration | None = None,
    board_shape: BoardShape = BoardShape.AUTO,
    tolerance_mm: float | None = None,
) -> CalibrationResult:
    """Solve the poses, say how far the result may be trusted, and give it an identity.

    cameras : the first one's frame becomes the world; one is enough, also without a projector. projector : None where
    no light was captured. earlier : a calibration of the same devices, to compare the scale with. board_shape : whether
    the board may be bowed. tolerance_mm : what a point of a scan may be wrong by in 95 of 100 places; None goes by the
    volume.

    Raises
    ------
    SolveRefusedError
        The poses determine no calibration, or do not span a volume to state an error for.
    """
    # Late: the service knows these values, and loads no compiled kernel before the first solve.
    from slrig.calibration.accuracy import expected_error
    from slrig.calibration.solving import solve

    observed = tuple(pose.observation for pose in poses)
    observations = Observations(board, cameras, projector, observed)
    solution = solve(
        observations,
        progress=lambda stage, fraction, detail: listener.step(stage, _SOLVE_SHARE * fraction, detail),
        board_shape=board_shape,
    )
    listener.step("expected error", _SOLVE_SHARE, "")
    try:
        expected = expected_error(solution, observations)
    except CalibrationError as error:
        raise SolveRefusedError(str(error)) from error
    checked = compare_halves(solution, expected.grid_mm)
    sizes = dict(cameras) if projector is None else {**cameras, PROJECTOR: projector}
    used = [pose for pose in observed if pose.name not in solution.outliers]
    covered = coverage(used, board, sizes)
    solved = SolveRecord(
        id=uuid4().hex[:12],
        solved_at=utc_now().isoformat(timespec="seconds"),
        covariance=solution.covariance,
        volume_mm=expected.volume_mm,
        expected_error_mm=expected.point_mm,
        scale_sigma=solution.size.scale_sigma,
    )
    listener.step("done", 1.0, "")
    scale = None if earlier is None else check_scale(solution, earlier, board)
    return CalibrationResult(
        solution=solution,
        calibration=replace(solution.calibration, solved=solved),
        expected=expected,
        verdict=judge_calibration(
            solution, expected, covered, checked, board=board, scale=scale, tolerance_mm=tolerance_mm
        ),
        coverage=covered,
        odd_even=checked,
    )


SESSION = "session.json"
CALIBRATION = "calibration.json"
REPORT = "report.html"
ANSWER = "answer.json"
READING = "reading.npz"
COMPARED = "compared.json"
"""The calibration that a solve of the session is compared with."""

_ACTIVE_FORMAT = "slrig-active-calibration"


def picture_name(camera: str) -> str:
    """The file of a pose's picture in one camera."""
    return f"picture-{camera}.png"


@dataclass(frozen=True, slots=True)
class ActivePointer:
    """Which solve of which calibration is in use."""

    id: UUID
    solve: int


class CalibrationStore:
    """Reads and writes calibrations below a data folder. One process uses it; callers hold their own lock.

    Methods that write raise StorageError when the disk refuses.
    """

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder

    def folder(self, session_id: UUID) -> Path:
        """Folder of a calibration."""
        return self._folder.calibrations / str(session_id)

    def pose(self, session_id: UUID, number: int) -> Path:
        """Folder of a pose once it was read."""
        return self.folder(session_id) / "poses" / f"{number:02d}"

    def solve(self, session_id: UUID, number: int) -> Path:
        """Folder of the results of a solve."""
        return self.folder(session_id) / "solves" / str(number)

    def load(self) -> Sequence[SessionRecord]:
        """Return every calibration on record, oldest first. A folder that cannot be read is put aside."""
        found: list[SessionRecord] = []
        for place in sorted(self._folder.calibrations.iterdir()):
            if not place.is_dir() or place.is_symlink():
                continue
            try:
                text = self._folder.read(place / SESSION)
                found.append(session_from_json(text, str(place / SESSION)))
            except (StorageError, FileNotFoundError) as error:
                _log.error("a calibration cannot be read, and is put aside", folder=place.name, cause=str(error))
                self._folder.put_aside(place)
        return sorted(found, key=lambda session: session.number)

    def create(self, session: SessionRecord) -> None:
        """Make the folder of a new calibration."""
        staged = self._folder.incoming / f"calibration-{session.id}"
        with disk_errors(staged):
            try:
                for name in ("poses", "solves"):
                    (staged / name).mkdir(parents=True)
                write_durably(staged / SESSION, session_json(session))
                self._commit(staged, self.folder(session.id))
            except (OSError, StorageError):
                self.discard(staged)
                raise

    def save(self, session: SessionRecord) -> None:
        """Write the record of a session."""
        write_file(self.folder(session.id) / SESSION, session_json(session))

    def delete(self, session_id: UUID, trash: Path | None = None) -> None:
        """Remove a calibration with all its files, or move it to `trash`: by one rename out of place first."""
        self._folder.remove(self.folder(session_id), trash)

    def discard_pose(self, session_id: UUID, number: int) -> None:
        """Remove a pose. Idempotent."""
        self._folder.remove(self.pose(session_id, number))

    def stage_solve(self, session_id: UUID) -> Path:
        """Make a folder for the results of a solve."""
        staged = self._folder.incoming / f"solve-{session_id}-{uuid.uuid4().hex[:12]}"
        with disk_errors(staged):
            staged.mkdir()
        return staged

    def commit_solve(self, session_id: UUID, number: int, staged: Path) -> None:
        """Move the results of a solve into place, whole and durable."""
        place = self.solve(session_id, number)
        # A run that was cut off between this and its record may have left one.
        self._folder.remove(place)
        with disk_errors(staged):
            write_entries(staged)
        self._commit(staged, place)

    def discard(self, staged: Path) -> None:
        """Remove what was staged. Idempotent."""
        shutil.rmtree(staged, ignore_errors=True)

    def calibration(self, session_id: UUID, solve: int) -> Calibration:
        """Return what a solve gave. Raises CalibrationError; DamagedError: it is not as it was written."""
        path = self.solve(session_id, solve) / CALIBRATION
        if path.is_symlink():
            message = f"{path} is a link, and what it leads to is not ours. Put the file itself there."
            raise CalibrationError(message)
        self._folder.require_whole(path.parent, CALIBRATION)
        return read_calibration(path)

    def active(self) -> ActivePointer | None:
        """Return which calibration is in use; None where none is. Raises StorageError if that cannot be read."""
        path = self._pointer
        try:
            with disk_errors(path):
                document = stored_json(path.read_bytes())
            if document["format"] != _ACTIVE_FORMAT:
                raise KeyError(document["format"])  # noqa: TRY301 - reported with the other faults of the file
            return ActivePointer(UUID(document["id"]), int(document["solve"]))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            message = f"{path} does not say which calibration is active."
            raise StorageError(message) from error

    def activate(self, pointer: ActivePointer | None) -> None:
        """Put on record which calibration is in use."""
        if pointer is None:
            with disk_errors(self._pointer):
                self._pointer.unlink(missing_ok=True)
                sync_folder(self._folder.calibrations)
            return
        document = {"format": _ACTIVE_FORMAT, "version": 1, "id": str(pointer.id), "solve": pointer.solve}
        write_file(self._pointer, (json.dumps(document) + "\n").encode())

    def active_calibration(self) -> ActiveCalibration | None:
        """Return what is in use, read; where it cannot be, with what to do."""
        pointer = None
        try:
            pointer = self.active()
            return (
                None
                if pointer is None
                else ActiveCalibration(str(pointer.id), self.calibration(pointer.id, pointer.solve))
            )
        except (CalibrationError, StorageError, DamagedError) as error:
            name = "unknown" if pointer is None else str(pointer.id)
            remedy = f"Activate another one, or remove {self._pointer} and start again, for the rig's own calibration."
            fault = f"The active calibration cannot be read: {error} {remedy}"
            _log.error("the active calibration cannot be read", calibration=name, cause=str(error))
            return ActiveCalibration(name, None, fault)

    @property
    def _pointer(self) -> Path:
        return self._folder.calibrations / "active.json"

    def _commit(self, staged: Path, place: Path) -> None:
        with disk_errors(staged):
            sync_tree(staged, except_folder=BUNDLE)
            staged.rename(place)
            sync_folder(place.parent)


def read_session(folder: Path) -> SessionRecord:
    """A session as its folder has it. Raises StorageError."""
    with disk_errors(folder):
        return session_from_json((folder / SESSION).read_bytes(), str(folder / SESSION))


def session_readings(folder: Path) -> list[ReadPose]:
    """Readings of the accepted poses of a session, by their numbers. Raises StorageError: it cannot be read."""
    found = [_pose_place(folder, job) for job in _poses_on_disk(folder) if job.fault is None]
    for place in found:
        require_whole(place, READING, remedy="Drop that pose (DELETE …/pose/N) and shoot it again.")
    return [_read_reading(place / READING) for place in found]


def with_poses_on_disk(session: SessionRecord, folder: Path) -> SessionRecord:
    """A session with the poses in its folder, each as it was judged there."""
    return replace(session, poses=tuple(pose_of(job) for job in _poses_on_disk(folder)))


def _poses_on_disk(folder: Path) -> list[JobRecord]:
    """The poses in the folder of a session, by their numbers, without links and copies."""
    places = sorted(place for place in (folder / "poses").iterdir() if not place.is_symlink())
    found = [(read_record(place), place) for place in places]
    return [job for job, place in found if job is not None and _pose_place(folder, job) == place]


def _pose_place(folder: Path, job: JobRecord) -> Path:
    return folder / "poses" / f"{job.plan['number']:02d}"


_READ_PARTS: dict[str, type[Any]] = {"view": BoardView, "light": Correspondences, "figures": ViewQuality}


def reading_bytes(pose: ReadPose) -> bytes:
    """The reading of a pose as the bytes of an .npz file: one array per field of each part of each camera."""
    parts = zip(_READ_PARTS, (pose.observation.views, pose.observation.correspondences, pose.figures), strict=True)
    arrays = {
        f"{part}/{camera}/{field}": np.asarray(value)
        for part, cameras in parts
        for camera, found in cameras.items()
        for field, value in asdict(cast("Any", found)).items()
    }
    buffer = io.BytesIO()
    np.savez(buffer, name=np.array(pose.observation.name), **arrays)  # type: ignore[arg-type] # none is allow_pickle
    return buffer.getvalue()


_MAX_READING_BYTES = 2**28


def _read_reading(path: Path) -> ReadPose:
    fields: dict[str, dict[str, dict[str, Any]]] = {part: {} for part in _READ_PARTS}
    try:
        arrays = read_arrays(path, _MAX_READING_BYTES)
        name = str(arrays.pop("name"))
        for key, array in arrays.items():
            part, camera, field = key.split("/")
            fields[part].setdefault(camera, {})[field] = array if array.ndim else array.item()
        views, light, figures = (
            {camera: kind(**values) for camera, values in fields[part].items()} for part, kind in _READ_PARTS.items()
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{path} cannot be read ({error}). Drop that pose (DELETE …/pose/N) and shoot it again."
        raise StorageError(message) from error
    return ReadPose(PoseObservation(name, views, light), figures)


_log = structlog.get_logger(__name__)


class CalibrationRegister:
    """Holds every session in memory, and each change of one on disk before it is visible.

    jobs : the poses and the solves. `lock` may be held over several calls. Only the process that holds the data folder
    makes one.
    """

    def __init__(self, store: CalibrationStore, jobs: JobStore) -> None:
        self.store = store
        self.jobs = jobs
        self.lock = threading.RLock()
        self._sessions = {session.id: session for session in store.load()}

    def all(self) -> Sequence[SessionRecord]:
        """Return every calibration, newest first."""
        with self.lock:
            sessions = sorted(self._sessions.values(), key=lambda session: session.number, reverse=True)
            jobs = self.jobs.by_parent(JobKind.POSE, JobKind.SOLVE)
        return [with_jobs(session, jobs.get(session.id, ())) for session in sessions]

    def get(self, session_id: UUID) -> SessionRecord:
        """Return a calibration. Raises CalibrationNotFoundError."""
        with self.lock:
            return with_jobs(self._session(session_id), self.jobs.of(session_id))

    def pose(self, session_id: UUID, number: int) -> PoseRecord:
        """Return a pose. Raises CalibrationNotFoundError."""
        poses = {pose.number: pose for pose in self.get(session_id).poses}
        if number not in poses:
            numbers = ", ".join(str(each) for each in poses) or "none"
            message = f"Calibration {session_id} has no pose {number}; its poses: {numbers}."
            raise CalibrationNotFoundError(message)
        return poses[number]

    def add(self, session_id: UUID, rig: str, label: str | None, **fields: Any) -> SessionRecord:
        """Put a new calibration on record, and return it. Raises StorageError."""
        with self.lock:
            number = max((session.number for session in self._sessions.values()), default=0) + 1
            session = SessionRecord(number, session_id, utc_now(), rig, label, **fields)
            self.store.create(session)
            self._sessions[session_id] = session
            return session

    def remove(self, session_id: UUID, trash: Path | None = None) -> None:
        """Forget a calibration with its jobs, and remove its files, or move them to `trash`. Raises StorageError."""
        with self.lock:
            self.store.delete(session_id, trash)
            del self._sessions[session_id]
        self.jobs.delete_of(session_id)

    def change(self, session_id: UUID, *, must_last: bool = True, **fields: Any) -> None:
        """Replace fields of a session, first on disk.

        Where `must_last` is False, a disk that refuses leaves the change in memory alone, to be saved with the next:
        the way something ended is not lost because the disk is full.

        Raises CalibrationNotFoundError if it was deleted, StorageError if the disk refused and nothing has changed.
        """
        with self.lock:
            before = self._session(session_id)
            after = replace(before, **fields)
            if after == before:
                return
            try:
                self.store.save(after)
            except StorageError as error:
                if must_last:
                    raise
                _log.warning(
                    "a change of a calibration is kept until the disk takes it",
                    calibration=str(session_id), cause=str(error),
                )  # fmt: skip
            self._sessions[session_id] = after

    def _session(self, session_id: UUID) -> SessionRecord:
        if session_id not in self._sessions:
            message = f"No calibration {session_id} is on record here. GET /calibration lists those that are."
            raise CalibrationNotFoundError(message)
        return self._sessions[session_id]
