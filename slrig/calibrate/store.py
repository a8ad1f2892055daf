"""Calibrations on disk, each a folder that is whole at every instant.

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
import uuid
import zipfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, cast
from uuid import UUID

import numpy as np

from slrig.bundle import read_calibration, sync_folder, sync_tree, write_durably, write_file
from slrig.calibrate.records import SessionRecord, pose_of, session_from_json, session_json
from slrig.calibrate.solving import ReadPose
from slrig.calibration import BoardView, Correspondences, PoseObservation, ViewQuality
from slrig.errors import CalibrationError, StorageError
from slrig.failure import disk_errors
from slrig.jobs.data_folder import BUNDLE, DataFolder
from slrig.jobs.records import JobRecord, read_record
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration

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

    Whatever writes raises StorageError when the disk refuses.
    """

    def __init__(self, folder: DataFolder) -> None:
        self._folder = folder

    def folder(self, session_id: UUID) -> Path:
        """Where a calibration lies."""
        return self._folder.calibrations / str(session_id)

    def pose(self, session_id: UUID, number: int) -> Path:
        """Where a pose lies once it was read."""
        return self.folder(session_id) / "poses" / f"{number:02d}"

    def solve(self, session_id: UUID, number: int) -> Path:
        """Where the results of a solve lie."""
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
            except (StorageError, FileNotFoundError):
                self._folder.orphans.mkdir(exist_ok=True)
                place.rename(self._folder.orphans / place.name)
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
        """Put a session on record in place of what it was."""
        write_file(self.folder(session.id) / SESSION, session_json(session))

    def delete(self, session_id: UUID) -> None:
        """Remove a calibration with all its files: by one rename out of place first."""
        self._folder.remove(self.folder(session_id))

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
        self._commit(staged, place)

    def discard(self, staged: Path) -> None:
        """Remove what was staged. Idempotent."""
        shutil.rmtree(staged, ignore_errors=True)

    def calibration(self, session_id: UUID, solve: int) -> Calibration:
        """Return what a solve gave. Raises CalibrationError."""
        path = self.solve(session_id, solve) / CALIBRATION
        if path.is_symlink():
            message = f"{path} is a link, and what it leads to is not ours. Put the file itself there."
            raise CalibrationError(message)
        return read_calibration(path)

    def active(self) -> ActivePointer | None:
        """Return which calibration is in use; None where none is. Raises StorageError if that cannot be read."""
        path = self._pointer
        try:
            with disk_errors(path):
                document = json.loads(path.read_bytes())
            if document["format"] != _ACTIVE_FORMAT:
                raise KeyError(document["format"])  # noqa: TRY301 - told with the other faults of the file
            return ActivePointer(UUID(document["id"]), int(document["solve"]))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            message = (
                f"{path} does not say which calibration is active. Remove it to scan with the rig's own calibration, "
                "then activate one again."
            )
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
        """Return what is in use, read. Raises StorageError with what to do where that is gone."""
        pointer = self.active()
        if pointer is None:
            return None
        try:
            return ActiveCalibration(str(pointer.id), self.calibration(pointer.id, pointer.solve))
        except CalibrationError as error:
            message = (
                f"The active calibration {pointer.id} cannot be read ({error}). Remove {self._pointer} to scan with "
                "the rig's own calibration."
            )
            raise StorageError(message) from error

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
    """What was read of the accepted poses of a session, by their numbers. Raises StorageError: it cannot be read."""
    return [_read_reading(_pose_place(folder, job) / READING) for job in _poses_on_disk(folder) if job.fault is None]


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
    """What was read of a pose as the bytes of an .npz file: one array per field of each part of each camera."""
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


def _read_reading(path: Path) -> ReadPose:
    fields: dict[str, dict[str, dict[str, Any]]] = {part: {} for part in _READ_PARTS}
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = dict(archive)
        name = str(arrays.pop("name"))
        for key, array in arrays.items():
            part, camera, field = key.split("/")
            fields[part].setdefault(camera, {})[field] = array if array.ndim else array.item()
        views, light, figures = (
            {camera: kind(**values) for camera, values in fields[part].items()} for part, kind in _READ_PARTS.items()
        )
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        message = f"{path} cannot be read ({error}). Drop that pose (DELETE …/pose/N) and shoot it again."
        raise StorageError(message) from error
    return ReadPose(PoseObservation(name, views, light), figures)
