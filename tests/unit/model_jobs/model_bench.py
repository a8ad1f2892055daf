"""Models over a tame bench: scans that are on record, and a combination that writes what a test says."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

from slrig.bundle.options import AxisSource
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.listener import Listener
from slrig.jobs.records import JobKind, JobProgress, JobRecord, JobState, utc_now
from slrig.jobs.resume import resume
from slrig.jobs.store import JobStore
from slrig.model import MeasuredAxis, TurntablePlane
from slrig.model_jobs.job import TURNTABLE, Models
from slrig.model_jobs.plan import MEDIA_TYPES, REPORT, StartingPoses
from slrig.model_jobs.turntable import TurntableStore
from slrig.scan.job import plan_json
from slrig.scan.plan import ScanPlan
from tests.samples import put_database
from tests.unit.scan.bench import Bench, wait_for
from tests.unit.stand_ins import stand_ins


def kept_scan(store: JobStore, folder: DataFolder, *, angle_deg: float | None = None, mesh: bytes = b"ply") -> UUID:
    """A scan that succeeded, on a turntable if there is an angle."""
    scan_id = uuid4()
    folder.scan(scan_id).mkdir()
    (folder.scan(scan_id) / "mesh.ply").write_bytes(mesh)
    turntable = {} if angle_deg is None else {"turntable": {"angle_deg": angle_deg, "turned_by": "table"}}
    (folder.scan(scan_id) / "report.json").write_text(json.dumps({"format": "slrig-report", **turntable}))
    now = utc_now()
    nothing = JobProgress("", 0.0, "")
    record = JobRecord(
        0, scan_id, JobKind.SCAN, JobState.SUCCEEDED, None, "bench", plan_json(ScanPlan()), now, now, now, nothing,
        None, {},
    )  # fmt: skip
    store.restore(record)
    store.pin(scan_id, pinned=False)
    return scan_id


class TameCombining:
    """Combines nothing. asked : what each model was to be made of; planes : of the last one. error : raised in place of
    the next one. axis : what it says it found. While `gate` is clear it goes on; `began` is set when one does.
    """

    def __init__(self) -> None:
        self.asked: list[tuple[Mapping[str, Path], StartingPoses, float, float | None]] = []
        self.planes: Sequence[TurntablePlane] = ()
        self.axis: Mapping[str, Any] | None = None
        self.error: Exception | None = None
        self.gate = threading.Event()
        self.gate.set()
        self.began = threading.Event()

    def __call__(
        self,
        meshes: Mapping[str, Path],
        folder: Path,
        poses: StartingPoses,
        listener: Listener,
        /,
        *,
        start_error_mm: float,
        voxel_mm: float | None,
        planes: Sequence[TurntablePlane],
        notes: Sequence[str],
    ) -> None:
        self.planes = planes
        self.asked.append((meshes, poses, start_error_mm, voxel_mm))
        assert list(folder.iterdir()) == []
        listener.report("registering", 0.2, f"{len(meshes)} views")
        self.began.set()
        while not self.gate.wait(0.01):
            listener.check("the model was cancelled")
        if self.error is not None:
            error, self.error = self.error, None
            raise error
        model_files(folder, list(meshes), self.axis, notes)


def model_files(
    folder: Path, names: list[str], axis: Mapping[str, Any] | None = None, notes: Sequence[str] = ()
) -> None:
    """The files of a model, as far as they are looked at."""
    for name in MEDIA_TYPES:
        (folder / name).write_bytes(name.encode())
    told = {
        "format": "slrig-model",
        "views": [{"name": name, "sigma_mm": 0.002 * number} for number, name in enumerate(names)],
        "pairs": [{"first": names[0], "second": name} for name in names[1:]],
        "free": [],
        "axis": axis,
        "notes": list(notes),
        "model": {"vertices": 9, "triangles": 12, "voxel_mm": 0.5, "sigma_mm": 0.01},
    }
    (folder / REPORT).write_text(json.dumps(told))


class ModelBench(Bench):
    """Models over a tame bench. start : begin at once; else what is on record waits for that."""

    def __init__(self, root: Path, *, start: bool = True, axis: MeasuredAxis | None = None) -> None:
        put_database(root / "data" / "slrig.sqlite")
        super().__init__(root)
        self.tame = TameCombining()
        self.patched.enter_context(stand_ins({"model_jobs.combining.combine_into": self.tame}))
        self.turntable = TurntableStore(self.folder.root / TURNTABLE)
        if axis is not None:
            self.turntable.put_axis(axis, source=AxisSource.BOARD, of="a board")
        self.models = Models(self.manager, turntable=self.turntable)
        if start:
            self.start()

    def start(self) -> None:
        """Go on with what is on record."""
        resume(self.manager)
        self.manager.start()

    def delete_scan(self, scan_id: UUID) -> None:
        """As the service does."""
        self.manager.delete(scan_id, self.models.unused(scan_id))

    def kept_scans(self, *angles_deg: float | None) -> tuple[UUID, ...]:
        return tuple(kept_scan(self.store, self.folder, angle_deg=angle) for angle in angles_deg)

    def over(self, model_id: UUID) -> JobRecord:
        """The model once it is in a final state."""
        return until(self.store, model_id, lambda model: model.state.final)

    def close(self) -> None:
        self.tame.gate.set()
        super().close()


def until(models: JobStore, model_id: UUID, reached: Callable[[JobRecord], bool]) -> JobRecord:
    """A model once `reached` says so of it."""
    wait_for(models, model_id, lambda: reached(models.get(model_id)))
    return models.get(model_id)


def until_told(models: JobStore, model_id: UUID, words: str) -> JobRecord:
    """A model once its progress says this."""
    return until(models, model_id, lambda model: words in model.progress.detail)
