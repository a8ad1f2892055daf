"""One rig, one scan at a time, every scan ends in a final state, and the projector is dark afterwards."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime
from pathlib import Path
from uuid import UUID

import numpy as np
import pytest

from slrig.errors import (
    BundleError,
    DeviceGoneError,
    PatternError,
    QueueFullError,
    RigBusyError,
    ScanInterruptedError,
    ScanStateError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.jobs.records import JobState
from slrig.model import Calibration
from slrig.rig.session import ActiveCalibration
from slrig.scan.plan import PatternPlan, ScanPlan
from slrig.scan.records import plan_json, read_record
from slrig.scan.sweep import sweep
from tests.unit.calibrate.calibration_bench import tame_calibration
from tests.unit.scan.bench import Bench, failure_code
from tests.unit.scan.fakes import WAIT_S


def test_scans_that_a_kill_left_are_taken_up_again(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    cut_off = bench.store.create(plan_json(ScanPlan()), rig="bench", label="cut off").id
    bench.store.advance(cut_off, JobState.COMPUTING)
    bundle = bench.folder.stage(cut_off) / "bundle"
    bundle.mkdir()
    (bundle / "order").write_text("finish")
    (bundle.parent / "result.part").mkdir()
    # More than may wait: whoever asked was answered long ago.
    queued = [bench.store.create(plan_json(ScanPlan()), rig="bench", label=None).id for _ in range(3)]
    resumed = sweep(bench.store, bench.folder).resumed
    assert resumed == (cut_off, *queued)
    bench.runner.take_up(resumed)
    bench.runner.start()
    for scan_id in (cut_off, *queued):
        record = bench.until(scan_id)
        assert record.state is JobState.SUCCEEDED, record.fault
        assert record.summary is not None
        assert record.summary["bundle"] == str(scan_id)
    states = [event.data["state"] for event in bench.store.events(cut_off, after=0) if event.kind == "state"]
    assert states == ["queued", "computing", "computing", "succeeded"]
    kept = read_record(bench.folder.scan(cut_off))
    assert kept is not None
    assert (kept.id, kept.label) == (cut_off, "cut off")
    assert not (bench.folder.scan(cut_off) / "result.part").exists()
    bench.close()


def test_scan_walks_to_its_mesh(bench: Bench) -> None:
    record = bench.until(bench.scan().id)
    assert record.state is JobState.SUCCEEDED
    assert record.progress.fraction == 1.0
    assert record.summary == {"bundle": str(record.id), "seconds": 1.5, "truth": {"rms_mm": 0.01}}
    files = {path.name for path in bench.folder.scan(record.id).iterdir()}
    assert files >= {"bundle", "mesh.ply", "report.json", "preview.png"}
    assert list(bench.folder.incoming.iterdir()) == []
    events = bench.store.events(record.id, after=0)
    assert [event.data["state"] for event in events if event.kind == "state"] == [
        "queued",
        "capturing",
        "computing",
        "succeeded",
    ]
    fractions = [event.data["fraction"] for event in events if event.kind == "progress"]
    assert fractions == sorted(fractions)
    assert bench.opened[0][1].dark


def test_held_rig_is_refused_by_the_name_of_its_holder(bench: Bench) -> None:
    holder = bench.held()
    with pytest.raises(RigBusyError) as busy:
        bench.scan()
    assert busy.value.holder == str(holder.id)
    started = bench.store.get(holder.id).started_at
    assert started is not None
    assert busy.value.since == started.isoformat(timespec="seconds")
    assert bench.runner.status().holder == str(holder.id)
    bench.gate.set()
    bench.until(holder.id)
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED


def test_queue_is_short_and_served_in_order(bench: Bench) -> None:
    first = bench.held()
    second = bench.scan(wait=True)
    with pytest.raises(QueueFullError):
        bench.scan(wait=True)
    assert bench.store.get(second.id).state is JobState.QUEUED
    bench.gate.set()
    later = bench.until(second.id)
    earlier = bench.until(first.id)
    assert later.state is earlier.state is JobState.SUCCEEDED
    assert computing_since(bench, first.id) <= computing_since(bench, second.id)
    assert later.started_at is not None
    # The rig is given on when the light of the first is over, and at the earliest then.
    assert later.started_at <= computing_since(bench, second.id)


def computing_since(bench: Bench, scan_id: UUID) -> datetime:
    """When the reconstruction of a scan began."""
    states = [each.data for each in bench.store.events(scan_id, after=0) if each.kind == "state"]
    return datetime.fromisoformat(next(each["time"] for each in states if each["state"] == "computing"))


def test_cancel_stops_a_capture_and_darkens_the_projector(bench: Bench) -> None:
    scan = bench.held()
    bench.runner.cancel(scan.id)
    assert bench.until(scan.id).state is JobState.CANCELLED
    assert bench.opened[0][1].dark
    assert not bench.opened[0][1].closed
    assert list(bench.folder.incoming.iterdir()) == []
    assert bench.runner.cancel(scan.id).state is JobState.CANCELLED


def test_cancel_takes_a_waiting_scan_out_of_the_line(bench: Bench) -> None:
    first = bench.held()
    second = bench.scan(wait=True)
    assert bench.runner.cancel(second.id).state is JobState.CANCELLED
    bench.gate.set()
    assert bench.until(first.id).state is JobState.SUCCEEDED


def test_cancel_reaches_the_reconstruction(bench: Bench) -> None:
    bench.order = "hang"
    scan = bench.scan()
    bench.until(scan.id, JobState.COMPUTING)
    bench.runner.cancel(scan.id)
    assert bench.until(scan.id).state is JobState.CANCELLED
    assert not bench.folder.scan(scan.id).exists()


def test_failed_reconstruction_keeps_the_bundle_for_a_second_look(bench: Bench) -> None:
    bench.order = "fail"
    record = bench.until(bench.scan().id)
    assert (record.state, failure_code(record)) == (JobState.FAILED, "nothing-to-reconstruct")
    assert [path.name for path in bench.folder.scan(record.id).iterdir()] == ["bundle"]


def test_lost_worker_fails_its_scan_and_no_other(bench: Bench) -> None:
    bench.order = "die"
    record = bench.until(bench.scan().id)
    assert (record.state, failure_code(record)) == (JobState.FAILED, "worker-lost")
    bench.order = "finish"
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED


def test_defect_is_told_without_its_traceback(bench: Bench) -> None:
    bench.order = "break"
    record = bench.until(bench.scan().id)
    assert record.fault is not None
    assert record.fault.code == "unexpected"
    assert "Traceback" not in record.fault.message


def test_vanished_device_is_opened_again_for_the_next_scan(bench: Bench) -> None:
    bench.error = DeviceGoneError("Camera 'cam0' was unplugged.")
    record = bench.until(bench.scan().id)
    assert (record.state, failure_code(record)) == (JobState.FAILED, "device-gone")
    assert bench.opened[0][1].closed
    # Nobody has to scan first to learn whether the rig is well again.
    assert bench.opened_again.wait(WAIT_S)
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 2
    assert bench.runner.status().fault is None


def test_fault_in_the_frames_leaves_the_rig_open(bench: Bench) -> None:
    bench.error = BundleError("Frame 3 equals frame 2.")
    bench.until(bench.scan().id)
    bench.until(bench.scan().id)
    assert len(bench.opened) == 1


def test_rig_that_cannot_be_opened_fails_the_scan_with_its_cause(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.open_error = DeviceGoneError("No camera on usb-3.")
    bench.runner.start()
    record = bench.until(bench.scan().id)
    assert failure_code(record) == "device-gone"
    bench.open_error = None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    bench.close()


def test_plan_is_held_against_the_open_rig(bench: Bench) -> None:
    bench.until(bench.scan().id)
    with pytest.raises(PatternError):
        bench.runner.submit(ScanPlan(patterns=PatternPlan(gray_cell_px=7)), label=None, wait=False)
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s: 5 s .*'cam0' can do 0\.001 s to 1 s"):
        bench.runner.submit(ScanPlan(exposure_s=5.0), label=None, wait=False)


def test_columns_alone_are_refused_for_a_camera_above_the_projector(bench: Bench) -> None:
    bench.until(bench.scan().id)
    known = tame_calibration()
    above = replace(known.cameras["cam0"], rotation=np.eye(3), translation_mm=np.array([0.0, 90.0, 0.0]))
    assert known.projector is not None
    level = replace(known.projector, rotation=np.eye(3), translation_mm=np.zeros(3))
    bench.runner.use_calibration(ActiveCalibration("spring", Calibration({"cam0": above}, level)))
    with pytest.raises(PatternError, match="above or below the projector"):
        bench.runner.submit(ScanPlan(patterns=PatternPlan(rows=False)), label=None, wait=False)
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED


def test_small_disk_is_noticed_before_the_scan(bench: Bench) -> None:
    bench.until(bench.scan().id)
    bench.free_bytes = 1000
    with pytest.raises(StorageError, match="are free"):
        bench.scan()
    assert len(bench.store.page(before=None, limit=10)) == 1


def test_full_disk_in_the_middle_is_a_storage_error(bench: Bench) -> None:
    # As BundleWriter tells it: an OSError that comes out of a capture is a driver's.
    bench.error = StorageError("000.png: the disk refused: No space left on device")
    record = bench.until(bench.scan().id)
    assert failure_code(record) == "storage"
    assert list(bench.folder.incoming.iterdir()) == []
    assert not bench.opened[0][1].closed


def test_delete_removes_record_and_files_once_a_scan_is_over(bench: Bench) -> None:
    scan = bench.held()
    with pytest.raises(ScanStateError, match="capturing"):
        bench.runner.delete(scan.id)
    bench.gate.set()
    bench.until(scan.id)
    bench.runner.delete(scan.id)
    assert not bench.folder.scan(scan.id).exists()
    assert list(bench.folder.incoming.iterdir()) == []
    assert bench.store.page(before=None, limit=10) == []


def test_closing_interrupts_what_captures_and_leaves_what_waits(bench: Bench) -> None:
    active = bench.held()
    waiting = bench.scan(wait=True)
    bench.runner.close()
    record = bench.store.get(active.id)
    assert (record.state, failure_code(record)) == (JobState.INTERRUPTED, "scan-interrupted")
    assert bench.store.get(waiting.id).state is JobState.QUEUED
    _, projector = bench.opened[0]
    assert projector.dark
    assert projector.closed
    with pytest.raises(ScanInterruptedError):
        bench.scan()


def test_closing_leaves_a_reconstruction_to_the_next_start(bench: Bench) -> None:
    bench.order = "hang-deaf"
    scan = bench.scan()
    bench.until(scan.id, JobState.COMPUTING)
    bench.runner.close()
    assert bench.store.get(scan.id).state is JobState.COMPUTING
    assert sweep(bench.store, bench.folder).resumed == (scan.id,)
    assert (bench.folder.staging(scan.id) / "bundle" / "bundle.json").is_file()
