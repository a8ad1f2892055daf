"""Acceptance tests as values, and on disk, each a folder.

DATA/acceptance/ID/test.json   its record
DATA/acceptance/ID/positions/POSITION/   a position that was measured: readings.json, and CAPTURE.npz, the points
DATA/acceptance/ID/report.html, report.json   when every position is measured; the second is written last
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from enum import StrEnum
from io import BytesIO
from pathlib import Path
from uuid import UUID

import numpy as np
import structlog
from pydantic import TypeAdapter

from slrig.accept.evaluation import Reading, ReadingPoints
from slrig.accept.plan import AcceptancePlan, Step
from slrig.bundle import stored_json, write_file
from slrig.calibrate.store import plain
from slrig.calibration import Decision
from slrig.disk import storage_errors
from slrig.errors import StorageError
from slrig.failure import JobFailure, disk_errors
from slrig.jobs.data_folder import DataFolder, remove
from slrig.jobs.records import JobProgress, JobRecord, JobState

_FORMAT = "slrig-acceptance-test"


class AcceptanceState(StrEnum):
    """State of a test.

    OPEN waits for its next position. INTERRUPTED was cut off by the end of the service while it was measured, and goes
    on, like an open one, when its next position is measured.
    """

    OPEN = "open"
    MEASURING = "measuring"
    INTERRUPTED = "interrupted"
    FINISHED = "finished"
    CANCELLED = "cancelled"

    @property
    def waiting(self) -> bool:
        """True while the next position may be measured."""
        return self in {AcceptanceState.OPEN, AcceptanceState.INTERRUPTED}


@dataclass(frozen=True, slots=True)
class AcceptanceRecord:
    """One test.

    number : rises with every test and orders lists. calibration : id of the one that it is done with. readings : of
    every capture so far, in the order of the plan. state : on disk OPEN, FINISHED or CANCELLED. decision : None before
    the end.

    The last two are of its jobs, and not on disk. fault : why the last position was not measured, None where it was; it
    may be measured again. progress : of the job under way.
    """

    number: int
    id: UUID
    created_at: datetime
    rig: str
    calibration: str
    plan: AcceptancePlan
    state: AcceptanceState = AcceptanceState.OPEN
    readings: tuple[Reading, ...] = ()
    decision: Decision | None = None
    fault: JobFailure | None = None
    progress: JobProgress | None = None

    @property
    def next_take(self) -> tuple[Step, int] | None:
        """The position to measure next, and how many times it was measured before; None when all are."""
        takes = self.plan.takes
        return takes[len(self.readings)] if len(self.readings) < len(takes) else None

    def from_first_take(self) -> AcceptanceRecord:
        """The record without the captures of a position that was not captured as often as planned.

        Between repeats nothing may be moved, which is not certain since: the position begins again.
        """
        following = self.next_take
        return self if following is None else replace(self, readings=self.readings[: len(self.readings) - following[1]])


_AFTER = {JobState.INTERRUPTED: AcceptanceState.INTERRUPTED, JobState.CANCELLED: AcceptanceState.CANCELLED}
"""State of a test by the end of its newest job."""


def with_jobs(record: AcceptanceRecord, jobs: Sequence[JobRecord]) -> AcceptanceRecord:
    """A test as it is on disk, completed by what its jobs, oldest first, say."""
    if not record.state.waiting or not jobs:
        return record
    job = jobs[-1]
    if not job.state.final:
        return replace(record, state=AcceptanceState.MEASURING, progress=job.progress)
    return replace(record, state=_AFTER.get(job.state, record.state), fault=job.fault)


_records = TypeAdapter(AcceptanceRecord)


def record_json(record: AcceptanceRecord) -> bytes:
    """A record as JSON text, without what its jobs say."""
    document = {"format": _FORMAT, "version": 3, **plain(record), "created_at": record.created_at.isoformat()}
    del document["progress"], document["fault"]
    return (json.dumps(document, indent=1, allow_nan=False) + "\n").encode()


def record_from_json(text: bytes, source: str) -> AcceptanceRecord:
    """The inverse of `record_json`. Raises StorageError when it is not that."""
    try:
        found = stored_json(text)
        if found["format"] != _FORMAT:
            raise KeyError(found["format"])  # noqa: TRY301 - reported with the other faults of the file
        return _records.validate_python(found)
    except (ValueError, KeyError, TypeError) as error:
        message = f"{source} is not an acceptance test as this version of slrig writes it: {error!r}"
        raise StorageError(message) from error


RECORD, HTML, JSON = "test.json", "report.html", "report.json"
POSITIONS = "positions"
"""Below the folder of a test: a folder of each position that was measured."""

READINGS = "readings.json"
"""In the folder of a position: what was measured in each capture."""

_readings = TypeAdapter(list[Reading])

_log = structlog.get_logger(__name__)


class AcceptanceStore:
    """Reads and writes tests below a data folder. One process uses it; callers hold their own lock."""

    def __init__(self, folder: DataFolder) -> None:
        self._data = folder
        self._root = folder.root / "acceptance"

    def folder(self, test_id: UUID) -> Path:
        """Folder of a test."""
        return self._root / str(test_id)

    def load(self) -> Sequence[AcceptanceRecord]:
        """Return every test on record, oldest first, after what was cut off has been marked as such.

        For the start of the service, when none can be under way. A folder that cannot be read is put aside. Raises
        StorageError.
        """
        found: list[AcceptanceRecord] = []
        with disk_errors(self._root):
            self._root.mkdir(exist_ok=True)
            for place in sorted(each for each in self._root.iterdir() if each.is_dir() and not each.is_symlink()):
                try:
                    record = record_from_json(self._data.read(place / RECORD), str(place / RECORD))
                except (StorageError, FileNotFoundError) as error:
                    _log.warning("an acceptance test is put aside", folder=place.name, cause=str(error))
                    self._data.put_aside(place)
                    continue
                for stray in place.glob(".*"):
                    # Frames of a capture that was cut off, or a part of a file.
                    remove(stray)
                settled = self._settled(record)
                if settled is not record:
                    self.save(settled)
                found.append(settled)
        return sorted(found, key=lambda record: record.number)

    def readings(self, test_id: UUID, step: str) -> list[Reading]:
        """Readings of a position. Raises StorageError."""
        path = self.folder(test_id) / POSITIONS / step / READINGS
        with disk_errors(path):
            return _readings.validate_json(path.read_bytes())

    def save(self, record: AcceptanceRecord) -> None:
        """Write the record of a test. Raises StorageError."""
        place = self.folder(record.id)
        with disk_errors(place):
            (place / POSITIONS).mkdir(parents=True, exist_ok=True)
        write_file(place / RECORD, record_json(record))

    def delete(self, test_id: UUID) -> None:
        """Remove a test with all its files: by one rename out of place first. Raises StorageError."""
        self._data.remove(self.folder(test_id))

    def _settled(self, record: AcceptanceRecord) -> AcceptanceRecord:
        """The record of a test that was cut off between its report and its record; the same object if it was not."""
        report = self.folder(record.id) / JSON
        if record.state is not AcceptanceState.OPEN or not report.is_file():
            return record
        try:
            decided = Decision(stored_json(report.read_bytes())["decision"])
        except (ValueError, KeyError, TypeError, OSError) as error:
            _log.warning("the report of an acceptance test is damaged", test=str(record.id), cause=str(error))
            return record
        return replace(record, state=AcceptanceState.FINISHED, decision=decided)


def read_test(folder: Path) -> AcceptanceRecord:
    """A test as its folder has it. Raises StorageError."""
    with disk_errors(folder):
        return record_from_json((folder / RECORD).read_bytes(), str(folder / RECORD))


def readings_json(readings: Sequence[Reading]) -> bytes:
    """Readings of a position, as JSON text."""
    return (json.dumps(plain(readings), indent=1, allow_nan=False) + "\n").encode()


def points_file(step: str, take: int) -> str:
    """File of the points of a capture, below the folder of their test.

    >>> points_file("sphere-1", 0)
    'positions/sphere-1/1.npz'
    """
    return f"{POSITIONS}/{step}/{take + 1}.npz"


def keep_points(evidence: ReadingPoints, folder: Path, step: str, take: int) -> None:
    """Write the points of a capture into the folder of its test. Raises StorageError."""
    packed = BytesIO()
    np.savez_compressed(
        packed,
        points_mm=evidence.points_mm.astype(np.float32),
        artefact=evidence.artefact,
        distances_mm=evidence.distances_mm,
        sigma_mm=evidence.sigma_mm.astype(np.float32),
    )
    path = folder / points_file(step, take)
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, packed.getvalue())


def kept_points(folder: Path, step: str, take: int) -> ReadingPoints:
    """The points of a capture, coordinates and deviations to single precision. Raises StorageError."""
    path = folder / points_file(step, take)
    with storage_errors(path), np.load(path) as kept:
        return ReadingPoints(
            kept["points_mm"].astype(np.float64),
            kept["artefact"],
            kept["distances_mm"],
            kept["sigma_mm"].astype(np.float64),
        )
