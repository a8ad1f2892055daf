"""The rig is free when the light of a scan is over: the next one is shot while earlier ones are reconstructed."""

from __future__ import annotations

from uuid import UUID

import pytest

from slrig.errors import DeviceGoneError, RigBusyError, StorageError
from slrig.jobs.records import JobRecord, JobState
from slrig.rig.watchdog import Call
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json
from slrig.scan.sweep import sweep
from tests.unit.scan.bench import Bench, failure_code


def computing(bench: Bench) -> JobRecord:
    """A scan whose mesh is there, and whose reconstruction goes on until `go_on`."""
    bench.order = "mesh-first"
    scan = bench.until(bench.scan().id, JobState.COMPUTING)
    bench.order = "finish"
    return scan


def go_on(bench: Bench, scan_id: UUID) -> None:
    """Let a reconstruction come to its end."""
    (bench.folder.staging(scan_id) / "bundle" / "go-on").touch()


def test_the_next_scan_is_shot_while_one_is_reconstructed(bench: Bench) -> None:
    first = computing(bench)
    status = bench.runner.status()
    assert (status.holder, status.computing, status.backlog_length) == (None, (str(first.id),), 2)
    # Not in line: the rig is free.
    second = bench.until(bench.scan().id, JobState.COMPUTING)
    assert bench.runner.status().computing == (str(first.id), str(second.id))
    go_on(bench, first.id)
    for scan_id in (first.id, second.id):
        record = bench.until(scan_id)
        assert record.state is JobState.SUCCEEDED
        assert record.summary is not None
        assert record.summary["bundle"] == str(scan_id)
    assert bench.runner.status().computing == ()


def test_scans_in_a_row_take_their_frames_along(bench: Bench) -> None:
    first = computing(bench)
    second = bench.until(bench.scan().id, JobState.COMPUTING)
    go_on(bench, first.id)
    bench.until(second.id)
    bench.until(first.id)
    for scan_id in (first.id, second.id):
        assert b'"live": [2, 2, true]' in (bench.folder.scan(scan_id) / "report.json").read_bytes()


def test_no_further_scan_begins_while_as_many_are_reconstructed_as_may(bench: Bench) -> None:
    first, second = computing(bench), bench.until(bench.scan().id, JobState.COMPUTING)
    bench.began.clear()
    third = bench.scan()
    status = bench.runner.status()
    assert (status.holder, status.waiting, len(status.computing)) == (None, 1, 2)
    with pytest.raises(RigBusyError):
        bench.scan()
    assert not bench.began.is_set()
    assert bench.store.get(third.id).state is JobState.QUEUED
    go_on(bench, first.id)
    for scan in (first, second, third):
        assert bench.until(scan.id).state is JobState.SUCCEEDED


def test_cancel_reaches_a_scan_that_waits_to_be_reconstructed(bench: Bench) -> None:
    first, second = computing(bench), bench.until(bench.scan().id, JobState.COMPUTING)
    bench.runner.cancel(second.id)
    assert bench.until(second.id).state is JobState.CANCELLED
    assert not bench.folder.staging(second.id).exists()
    assert bench.store.get(first.id).state is JobState.COMPUTING
    go_on(bench, first.id)
    assert bench.until(first.id).state is JobState.SUCCEEDED


def test_a_capture_that_fails_costs_the_scans_before_it_nothing(bench: Bench) -> None:
    first = computing(bench)
    bench.error = DeviceGoneError("Camera 'cam0' was unplugged.")
    failed = bench.until(bench.scan().id)
    assert (failed.state, failure_code(failed)) == (JobState.FAILED, "device-gone")
    go_on(bench, first.id)
    assert bench.until(first.id).state is JobState.SUCCEEDED


def test_a_disk_that_refuses_after_the_light_fails_the_scan_in_words(bench: Bench) -> None:
    bench.recording.error = StorageError("recording/frames: the disk refused: No space left on device")
    failed = bench.until(bench.scan().id)
    assert (failed.state, failure_code(failed)) == (JobState.FAILED, "storage")
    assert not bench.folder.staging(failed.id).exists()
    bench.recording.error = None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED


def test_frames_are_a_bundle_only_when_they_are_all_on_the_disk(bench: Bench) -> None:
    """A kill between the light and the end of the recording leaves nothing to go on with."""
    scan = bench.store.create(plan_json(ScanPlan()), rig="bench", label=None)
    bench.store.advance(scan.id, JobState.COMPUTING)
    bench.folder.stage(scan.id)
    bench.folder.recording(scan.id).mkdir()
    assert sweep(bench.store, bench.folder).interrupted == (scan.id,)
    assert not bench.folder.staging(scan.id).exists()


def test_a_capture_that_was_given_up_and_ends_well_after_all_leaves_nothing(bench: Bench) -> None:
    scan = bench.held()
    call = Call("camera 'cam0'", "read", 10.0, 0.0)
    bench.runner.queue._give_up_on(call)
    assert failure_code(bench.until(scan.id)) == "device"
    bench.gate.set()
    # The rig is given on when the driver is back.
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    assert bench.recording.discarded == 1
    assert not bench.folder.staging(scan.id).exists()
    assert bench.store.get(scan.id).state is JobState.FAILED


def test_closing_leaves_all_that_are_reconstructed_to_the_next_start(bench: Bench) -> None:
    first, second = computing(bench), bench.until(bench.scan().id, JobState.COMPUTING)
    bench.runner.close()
    assert {bench.store.get(each.id).state for each in (first, second)} == {JobState.COMPUTING}
    assert sweep(bench.store, bench.folder).resumed == (first.id, second.id)


def test_the_mesh_is_announced_before_the_scan_is_over(bench: Bench) -> None:
    scan = computing(bench)
    bench.until_event(scan.id, "file")
    events = bench.store.events(scan.id, after=0)
    assert [event.data for event in events if event.kind == "file"] == [{"name": "mesh.ply", "state": "computing"}]
    assert (bench.folder.result(scan.id) / "mesh.ply").stat().st_size > 0
    assert not bench.folder.scan(scan.id).exists()
    go_on(bench, scan.id)
    assert bench.until(scan.id).state is JobState.SUCCEEDED
