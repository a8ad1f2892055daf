"""Scans on a rig: captured one after the other, reconstructed beside the next one, in a series, over a restart.

How a scan is cancelled or fails by itself, tests/unit/jobs/test_every_kind.py checks for every kind of job.
"""

from __future__ import annotations

import errno
import json
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
from sqlalchemy.orm import Session
from structlog.testing import capture_logs

from slrig.errors import (
    BundleError,
    CalibrationError,
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DriverNotFoundError,
    InvalidInputError,
    JobNotFoundError,
    NotCalibratedError,
    PatternError,
    RigBusyError,
    ScanStateError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.jobs import database, manager
from slrig.jobs.records import JobRecord, JobState, read_record, utc_now
from slrig.jobs.resume import resume
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration, RigSession
from slrig.scan.job import ScanJob, cancel_series, plan_from_json, plan_json, scans_of, series
from slrig.scan.plan import PatternPlan, ReconstructionPlan, RigGuess, ScanPlan, SeriesPlace, series_of
from tests.core import parametrize_core
from tests.unit.scan.bench import Bench, failure_code
from tests.unit.scan.fakes import WAIT_S, TameBench, tame_calibration


def test_scan_walks_to_its_mesh(bench: Bench) -> None:
    record = bench.until(bench.scan().id)
    assert record.state is JobState.SUCCEEDED
    assert record.progress.fraction == 1.0
    assert record.summary == {"bundle": str(record.id), "seconds": 1.5, "truth": {"rms_mm": 0.01}}
    files = {path.name for path in bench.folder.scan(record.id).iterdir()}
    assert files >= {"bundle", "mesh.ply", "report.json", "preview.png"}
    assert list(bench.folder.incoming.iterdir()) == []
    events = bench.store.events(record.id, after=0)
    states = [event.data["state"] for event in events if event.kind == "state"]
    assert states == ["queued", "capturing", "computing", "succeeded"]
    fractions = [event.data["fraction"] for event in events if event.kind == "progress"]
    assert fractions == sorted(fractions)
    assert bench.opened[0][1].dark


# What the rig and the disk refuse


@parametrize_core(
    "error",
    [
        BundleError("Frame 3 equals frame 2."),
        UnsupportedByDeviceError("asked for gain 9, it uses gain 8"),
        # As BundleWriter tells it: an OSError that comes out of a capture is a driver's.
        StorageError("000.png: the disk refused: No space left on device"),
    ],
)
def test_what_is_no_fault_of_a_device_leaves_the_rig_open(bench: Bench, error: SlrigError) -> None:
    bench.error = error
    assert failure_code(bench.until(bench.scan().id)) == error.code
    assert bench.manager.status().fault is None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 1


@parametrize_core("error", [OSError(errno.EIO, "Input/output error"), DeviceError("no"), ZeroDivisionError()], core=[1])
def test_driver_that_cannot_blank_or_close_stops_nothing(bench: Bench, error: Exception) -> None:
    scan = bench.held()
    camera, projector = bench.opened[0]
    projector.blank_error = camera.close_error = error
    bench.gate.set()
    assert bench.until(scan.id).state is JobState.SUCCEEDED
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    # Its last chance to go dark was its closing.
    assert (projector.dark, camera.closed, projector.closed) == (True, True, True)
    assert len(bench.opened) == 2


def test_projector_that_stays_lit_is_told(bench: Bench) -> None:
    scan = bench.held()
    camera, projector = bench.opened[0]
    projector.blank_error = DeviceError("The projector does not answer.")
    bench.open_error = DeviceGoneError("No projector on ttyUSB0.")
    with capture_logs() as logs:
        bench.manager.cancel(scan.id)
        assert bench.until(scan.id).state is JobState.CANCELLED
    told = [each for each in logs if "does not go dark" in each["event"]]
    assert [(each["log_level"], each["rig"]) for each in told] == [("error", "bench")]
    assert (camera.closed, projector.closed) == (True, True)
    silent = "The projector does not answer. (projector 'projector', in blank)"
    assert bench.manager.status().fault in {silent, "No projector on ttyUSB0."}


@parametrize_core(
    "error",
    [
        DeviceGoneError("No camera on usb-3."),
        ConfigError("size_px: unknown key"),
        DriverNotFoundError("no driver 'x'"),
        CalibrationError("not finite"),
    ],
    core=[1],
)
def test_rig_that_cannot_be_opened_fails_the_scan_and_a_wrong_rig_file_is_given_up(
    tmp_path: Path, error: SlrigError
) -> None:
    bench = Bench(tmp_path)
    bench.open_error = error
    bench.manager.start()
    assert failure_code(bench.until(bench.scan().id)) == error.code
    # Once: at the first opening, not at the scan's own.
    assert bench.given_up == ([error] if isinstance(error, InvalidInputError) else [])
    bench.open_error = None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    bench.close()


def test_error_of_the_system_at_opening_is_no_fault_of_the_disk() -> None:
    bench = TameBench()
    bench.open_error = PermissionError(errno.EACCES, "Permission denied", "/dev/video0")
    rig = RigSession("bench", bench.open_rig)
    with pytest.raises(DeviceError, match=r"rig 'bench' failed: .*'/dev/video0'; check cable, power and permissions"):
        rig.open()
    assert rig.fault is not None
    assert rig.fault.code == "device"


def fault_of(rig: RigSession) -> str | None:
    return None if rig.fault is None else rig.fault.message


def test_rig_that_was_let_go_is_opened_once_more_and_says_how_that_went() -> None:
    bench = TameBench()
    rig = RigSession("bench", bench.open_rig)
    rig.open()
    rig.release(DeviceGoneError("Camera 'cam0' was unplugged."))
    bench.open_error = DeviceGoneError("No camera on usb-3.")
    assert rig.recover() is bench.open_error
    assert fault_of(rig) == "No camera on usb-3."
    bench.open_error = None
    assert rig.recover() is None
    assert len(bench.opened) == 1, "one failure is answered by one opening"
    rig.open()
    rig.release(DeviceGoneError("Camera 'cam0' was unplugged."))
    assert rig.recover() is None
    assert fault_of(rig) is None
    assert len(bench.opened) == 3


def test_plan_is_held_against_the_open_rig_and_the_free_disk(bench: Bench) -> None:
    bench.until(bench.scan().id)
    with pytest.raises(PatternError):
        bench.scan(ScanPlan(patterns=PatternPlan(gray_cell_px=7)))
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s: 5 s .*'cam0' can do 0\.001 s to 1 s"):
        bench.scan(ScanPlan(exposure_s=5.0))
    known = tame_calibration()
    above = replace(known.cameras["cam0"], rotation=np.eye(3), translation_mm=np.array([0.0, 90.0, 0.0]))
    assert known.projector is not None
    level = replace(known.projector, rotation=np.eye(3), translation_mm=np.zeros(3))
    bench.manager.rig.use_calibration(ActiveCalibration("spring", Calibration({"cam0": above}, level)))
    with pytest.raises(PatternError, match="above or below the projector"):
        bench.scan(ScanPlan(patterns=PatternPlan(rows=False)))
    bench.free_bytes = 1000
    with pytest.raises(StorageError, match="are free"):
        bench.scan()
    assert len(bench.store.page(before=None, limit=10)) == 1
    bench.free_bytes = 10**9
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED


def test_nothing_is_shot_by_a_rig_without_calibration(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.calibration = None
    # Before the rig is open nobody knows.
    queued = bench.scan()
    bench.manager.start()
    record = bench.until(queued.id)
    assert (record.state, failure_code(record)) == (JobState.FAILED, "not-calibrated")
    with pytest.raises(NotCalibratedError, match="slrig calibrate run"):
        bench.scan()
    assert bench.captured == []
    # It calibrates itself by the scan, in the worker, and plays both axes for it.
    guess = ScanPlan(reconstruction=ReconstructionPlan(uncalibrated=RigGuess(focal_px={"cam0": 900.0})))
    assert guess.patterns.rows is True
    assert plan_from_json(plan_json(guess)) == guess
    assert bench.until(bench.scan(guess).id).state is JobState.SUCCEEDED
    bench.manager.rig.use_calibration(ActiveCalibration("spring", tame_calibration()))
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    bench.close()


def test_delete_removes_record_and_files_once_a_scan_is_over(bench: Bench) -> None:
    scan = bench.held()
    with pytest.raises(ScanStateError, match="capturing"):
        bench.manager.delete(scan.id)
    bench.gate.set()
    bench.until(scan.id)
    bench.manager.delete(scan.id)
    assert not bench.folder.scan(scan.id).exists()
    assert list(bench.folder.incoming.iterdir()) == []
    assert bench.store.page(before=None, limit=10) == []


# The next scan is shot while earlier ones are reconstructed


def computing(bench: Bench) -> JobRecord:
    """A scan whose mesh is there, and whose reconstruction goes on until `go_on`."""
    bench.order = "mesh-first"
    scan = bench.until(bench.scan().id, JobState.COMPUTING)
    bench.order = "finish"
    return scan


def go_on(bench: Bench, scan_id: UUID) -> None:
    """Let a reconstruction come to its end."""
    (bench.folder.staging(scan_id) / "bundle" / "go-on").touch()


def test_the_next_scan_is_shot_while_one_is_reconstructed_and_a_third_waits(bench: Bench) -> None:
    first = computing(bench)
    status = bench.manager.status()
    assert (status.holder, status.computing, status.backlog_length) == (None, (str(first.id),), 2)
    # Not in line: the rig is free.
    second = bench.until(bench.scan().id, JobState.COMPUTING)
    assert bench.manager.status().computing == (str(first.id), str(second.id))
    bench.began.clear()
    third = bench.scan()
    status = bench.manager.status()
    assert (status.holder, status.waiting, len(status.computing)) == (None, 1, 2)
    with pytest.raises(RigBusyError):
        bench.scan()
    assert not bench.began.is_set()
    assert bench.store.get(third.id).state is JobState.QUEUED
    go_on(bench, first.id)
    for scan_id in (first.id, second.id, third.id):
        record = bench.until(scan_id)
        assert record.state is JobState.SUCCEEDED
        assert_own(bench, record)
        # Each has its frames from its capture.
        assert b'"live": [2, 2, true]' in (bench.folder.scan(scan_id) / "report.json").read_bytes()
    assert bench.manager.status().computing == ()


def test_a_capture_that_fails_costs_the_scans_before_it_nothing(bench: Bench) -> None:
    first = computing(bench)
    bench.error = DeviceGoneError("Camera 'cam0' was unplugged.")
    assert failure_code(bench.until(bench.scan().id)) == "device-gone"
    go_on(bench, first.id)
    assert bench.until(first.id).state is JobState.SUCCEEDED


def test_the_mesh_is_announced_before_the_scan_is_over(bench: Bench) -> None:
    scan = computing(bench)
    bench.until_event(scan.id, "file")
    events = bench.store.events(scan.id, after=0)
    assert [event.data for event in events if event.kind == "file"] == [{"name": "mesh.ply", "state": "computing"}]
    assert (bench.folder.result(scan.id) / "mesh.ply").stat().st_size > 0
    assert not bench.folder.scan(scan.id).exists()
    go_on(bench, scan.id)
    assert bench.until(scan.id).state is JobState.SUCCEEDED


# A restart


def test_scans_that_a_kill_left_are_taken_up_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    cut_off = bench.manager.record(ScanJob(ScanPlan()), label="cut off")[0].id
    bench.store.advance(cut_off, JobState.COMPUTING)
    bundle = bench.folder.stage(cut_off) / "bundle"
    bundle.mkdir()
    (bundle / "order").write_text("finish")
    (bundle.parent / "result.part").mkdir()
    # More than may wait: they were accepted before.
    queued = [bench.manager.record(ScanJob(ScanPlan()))[0].id for _ in range(3)]
    resume(bench.manager)
    bench.manager.start()
    for scan_id in (cut_off, *queued):
        record = bench.until(scan_id)
        assert record.state is JobState.SUCCEEDED, record.fault
        assert_own(bench, record)
    states = [event.data["state"] for event in bench.store.events(cut_off, after=0) if event.kind == "state"]
    assert states == ["queued", "computing", "computing", "succeeded"]
    kept = read_record(bench.folder.scan(cut_off))
    assert kept is not None
    assert (kept.id, kept.label) == (cut_off, "cut off")
    assert not (bench.folder.scan(cut_off) / "result.part").exists()
    bench.close()


# A series


HOUR_S = 3600.0


def begun(bench: Bench, *, repeat: int, every_s: float = 0.0) -> list[JobRecord]:
    """The scans of a series that was sent."""
    first = bench.manager.submit(*scans_of(ScanPlan(), repeat=repeat, every_s=every_s), label="series")[0]
    assert first.parent is not None
    scans = series(bench.store, first.parent)
    assert scans[0].id == first.id
    return list(scans)


def place(record: JobRecord) -> SeriesPlace:
    found = plan_from_json(record.plan).series
    assert found is not None
    return found


def test_scans_of_a_series_are_shot_one_after_the_other_when_their_time_has_come(bench: Bench) -> None:
    scans = begun(bench, repeat=3, every_s=0.05)
    assert [(place(each).number, place(each).count, place(each).id) for each in scans] == [
        (number, 3, scans[0].parent) for number in (1, 2, 3)
    ]
    ended = [bench.until(each.id) for each in scans]
    assert {each.state for each in ended} == {JobState.SUCCEEDED}
    starts = [each.started_at for each in ended if each.started_at is not None]
    assert starts == sorted(starts)
    for start, scan in zip(starts, scans, strict=True):
        assert start >= place(scan).due_at - timedelta(milliseconds=1)


@pytest.mark.slow
def test_others_pass_a_scan_that_waits_for_its_time_and_a_series_is_cancelled_as_a_whole(bench: Bench) -> None:
    first, *others = begun(bench, repeat=3, every_s=HOUR_S)
    assert place(others[0]).due_at - place(first).due_at == timedelta(seconds=HOUR_S)
    bench.until(first.id)
    # The rig is free, and nothing waits for it now.
    status = bench.manager.status()
    assert (status.holder, status.waiting) == (None, 0)
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert bench.store.get(others[0].id).state is JobState.QUEUED
    assert first.parent is not None
    for _ in range(2):
        cancelled = [each.state for each in cancel_series(bench.manager, first.parent)]
        assert cancelled == [JobState.SUCCEEDED, JobState.CANCELLED, JobState.CANCELLED]
    with pytest.raises(JobNotFoundError, match="No series"):
        cancel_series(bench.manager, uuid4())


@pytest.mark.slow
def test_a_series_goes_on_after_a_restart(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    plans = series_of(ScanPlan(), UUID(int=7), count=2, every_s=HOUR_S, begins_at=utc_now() - timedelta(seconds=60))
    due, later = bench.manager.record(*map(ScanJob, plans))
    resume(bench.manager)
    bench.manager.start()
    assert bench.until(due.id).state is JobState.SUCCEEDED
    assert bench.store.get(later.id).state is JobState.QUEUED
    bench.close()
    # And once more, as the end of a service leaves it.
    assert bench.store.get(later.id).state is JobState.QUEUED


# Records that the disk refuses for a while


@parametrize_core("then", ["scan", "close", "cancel", "delete"])
def test_ending_that_the_disk_refused_is_recorded_before_what_comes_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, then: str
) -> None:
    real: Callable[..., bool] = bench.store.finish
    refused = threading.Event()

    def finish(*given: Any, **options: Any) -> bool:
        if not refused.is_set():
            refused.set()
            message = "The record of scans could not be used: disk is full."
            raise StorageError(message)
        return real(*given, **options)

    monkeypatch.setattr(bench.store, "finish", finish)
    scan_id = bench.scan().id
    assert refused.wait(WAIT_S)
    assert bench.store.get(scan_id).state is JobState.COMPUTING
    if then == "scan":
        assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    elif then == "close":
        bench.manager.close()
    elif then == "cancel":
        assert bench.manager.cancel(scan_id).state is JobState.SUCCEEDED
    else:
        bench.manager.delete(scan_id)
        assert bench.store.page(before=None, limit=10) == []
        return
    assert bench.store.get(scan_id).state is JobState.SUCCEEDED


@pytest.mark.slow
def test_worker_that_cannot_be_started_again_strands_no_scan(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = bench.held()
    waiting = bench.scan(wait=True)

    def start() -> None:
        monkeypatch.undo()
        message = "Cannot allocate memory"
        raise OSError(errno.ENOMEM, message)

    monkeypatch.setattr(bench.worker, "start", start)
    bench.manager.cancel(scan.id)
    assert bench.until(scan.id).state is JobState.CANCELLED
    bench.gate.set()
    assert bench.until(waiting.id).state is JobState.SUCCEEDED


MOST_WRITES = 12
"""More than a scan of the tame bench makes: created, three states, a few steps."""

Changing = Callable[..., AbstractContextManager[Session]]


def full(_bench: Bench, _real: Changing, **_options: Any) -> AbstractContextManager[Session]:
    message = "The service's records could not be used: database or disk is full."
    raise StorageError(message)


@contextmanager
def locked(bench: Bench, real: Changing, **options: Any) -> Iterator[Session]:
    """Another program has begun to write, and goes on for longer than anybody waits."""
    other = sqlite3.connect(bench.folder.database, isolation_level=None)
    try:
        other.execute("BEGIN IMMEDIATE")
        with real(**options) as session:
            yield session
    finally:
        other.close()


@contextmanager
def read_only(_: Bench, real: Changing, **options: Any) -> Iterator[Session]:
    with real(**options) as session:
        cursor = session.connection().connection.cursor()
        cursor.execute("PRAGMA query_only=ON")
        try:
            yield session
            session.flush()
        finally:
            cursor.execute("PRAGMA query_only=OFF")


def assert_own(bench: Bench, record: JobRecord) -> None:
    """The scan has its own files, and its own report."""
    report = json.loads((bench.folder.scan(record.id) / "report.json").read_bytes())
    assert (bench.folder.scan(record.id) / "mesh.ply").is_file()
    assert report["bundle"] == str(record.id)
    assert record.summary is not None
    assert record.summary["bundle"] == str(record.id)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("refused", "begins", "lasting"),
    [
        pytest.param(full, 1, 1, marks=pytest.mark.slow),
        pytest.param(locked, 2, 3, marks=pytest.mark.slow),
        (read_only, 2, 3),
    ],
)
def test_a_refused_record_poisons_no_later_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Any, begins: int, lasting: int
) -> None:
    monkeypatch.setattr(database, "PATIENCE_S", 0.01)
    monkeypatch.setattr(manager, "RETRY_S", 0.01)
    bench = Bench(tmp_path)
    bench.manager.start()
    real, writes = bench.store.database.changing, 0
    at: range = range(0)

    def changing(**options: Any) -> AbstractContextManager[Session]:
        nonlocal writes
        writes += 1
        return refused(bench, real, **options) if writes in at else real(**options)

    monkeypatch.setattr(bench.store.database, "changing", changing)
    seen = set()
    for first in range(begins, MOST_WRITES + 1, lasting):
        writes, at = 0, range(first, first + lasting)
        try:
            hurt = bench.scan(wait=True)
        except StorageError:
            # It was told, and nothing was begun.
            assert first == 1
            hurt = None
        if hurt is not None:
            record = bench.until(hurt.id)
            seen.add(record.state)
            assert record.state in {JobState.SUCCEEDED, JobState.FAILED}
            if record.state is JobState.SUCCEEDED:
                assert_own(bench, record)
        at = range(0)
        record = bench.until(bench.scan(wait=True).id)
        assert record.state is JobState.SUCCEEDED, record.fault
        assert_own(bench, record)
    assert seen == {JobState.SUCCEEDED, JobState.FAILED}
    assert list(bench.folder.incoming.iterdir()) == []
    bench.close()
