"""What the runner bears: drivers that raise anything, lamps that stay on, a disk that is full for a moment."""

from __future__ import annotations

import errno
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any
from uuid import UUID

import pytest
from structlog.testing import capture_logs

from slrig.errors import (
    CalibrationError,
    ConfigError,
    DeviceError,
    DeviceGoneError,
    DriverNotFoundError,
    InvalidInputError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.jobs.records import JobState
from slrig.rig.session import RigSession
from slrig.scan.plan import ScanPlan
from slrig.scan.records import plan_json
from tests.unit.scan.bench import Bench, failure_code
from tests.unit.scan.fakes import WAIT_S, TameBench


def input_output_error() -> OSError:
    return OSError(errno.EIO, "Input/output error")


def told(rig: RigSession) -> str | None:
    return None if rig.fault is None else rig.fault.message


def stranded(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> UUID:
    """The id of a scan whose end was refused by a disk that was full for a second."""
    real: Callable[..., bool] = bench.store.finish
    refused = threading.Event()

    def finish(*given: Any, **options: Any) -> bool:
        if not refused.is_set():
            refused.set()
            message = "The record of scans could not be used: disk is full."
            raise StorageError(message)
        return real(*given, **options)

    monkeypatch.setattr(bench.store, "finish", finish)
    scan = bench.scan()
    assert refused.wait(WAIT_S)
    return scan.id


@pytest.mark.parametrize("error", [input_output_error(), DeviceError("no answer"), ZeroDivisionError()])
def test_driver_that_cannot_blank_or_close_stops_nothing(bench: Bench, error: Exception) -> None:
    scan = bench.held()
    camera, projector = bench.opened[0]
    projector.blank_error = camera.close_error = error
    bench.gate.set()
    assert bench.until(scan.id).state is JobState.SUCCEEDED
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    # Its last chance to go dark was its closing.
    assert projector.dark
    assert (camera.closed, projector.closed) == (True, True)
    assert len(bench.opened) == 2


def test_projector_that_stays_lit_is_told(bench: Bench) -> None:
    scan = bench.held()
    camera, projector = bench.opened[0]
    projector.blank_error = DeviceError("The projector does not answer.")
    bench.open_error = DeviceGoneError("No projector on ttyUSB0.")
    with capture_logs() as logs:
        bench.runner.cancel(scan.id)
        assert bench.until(scan.id).state is JobState.CANCELLED
    told = [each for each in logs if "does not go dark" in each["event"]]
    assert [(each["log_level"], each["rig"]) for each in told] == [("error", "bench")]
    assert (camera.closed, projector.closed) == (True, True)
    silent = "The projector does not answer. (projector 'projector', in blank)"
    assert bench.runner.status().fault in {silent, "No projector on ttyUSB0."}


def test_driver_that_never_returns_is_darkened_past(bench: Bench) -> None:
    bench.deaf = True
    scan = bench.held()
    _, projector = bench.opened[0]
    lit_before = not projector.dark
    bench.runner.close(timeout_s=0.01)
    assert (lit_before, projector.dark) == (True, True)
    assert bench.store.get(scan.id).state is JobState.INTERRUPTED


def test_closing_again_does_nothing(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.deaf = True
    bench.held()
    bench.runner.close(timeout_s=0.01)

    def finish(*_: object, **__: object) -> bool:
        raise AssertionError

    monkeypatch.setattr(bench.store, "finish", finish)
    _, projector = bench.opened[0]
    projector.dark = False
    bench.runner.close(timeout_s=WAIT_S)
    assert not projector.dark
    monkeypatch.undo()


def test_error_of_the_system_in_a_driver_is_no_fault_of_the_disk(bench: Bench) -> None:
    bench.error = input_output_error()
    record = bench.until(bench.scan().id)
    assert failure_code(record) == "device"
    assert record.fault is not None
    assert "a driver of rig 'bench' failed: [Errno 5] Input/output error; check cable" in record.fault.message
    assert bench.opened[0][0].closed
    assert bench.opened_again.wait(WAIT_S)


def test_error_of_the_system_at_opening_is_no_fault_of_the_disk() -> None:
    bench = TameBench()
    bench.open_error = PermissionError(errno.EACCES, "Permission denied", "/dev/video0")
    rig = RigSession("bench", bench.open_rig)
    with pytest.raises(DeviceError, match=r"rig 'bench' failed: .*'/dev/video0'; check cable, power and permissions"):
        rig.open()
    assert rig.fault is not None
    assert rig.fault.code == "device"


def test_request_that_the_devices_cannot_do_leaves_the_rig_open(bench: Bench) -> None:
    bench.error = UnsupportedByDeviceError("asked for gain 9, it uses gain 8")
    assert failure_code(bench.until(bench.scan().id)) == "unsupported-by-device"
    assert bench.runner.status().fault is None
    assert bench.until(bench.scan().id).state is JobState.SUCCEEDED
    assert len(bench.opened) == 1


def test_rig_that_was_let_go_is_opened_once_more_and_says_how_that_went() -> None:
    bench = TameBench()
    rig = RigSession("bench", bench.open_rig)
    rig.open()
    rig.let_go(DeviceGoneError("Camera 'cam0' was unplugged."))
    bench.open_error = DeviceGoneError("No camera on usb-3.")
    assert rig.recover() is bench.open_error
    assert told(rig) == "No camera on usb-3."
    bench.open_error = None
    assert rig.recover() is None
    assert len(bench.opened) == 1, "one failure is answered by one opening"
    rig.open()
    rig.let_go(DeviceGoneError("Camera 'cam0' was unplugged."))
    assert rig.recover() is None
    assert told(rig) is None
    assert len(bench.opened) == 3


@pytest.mark.parametrize(
    "error", [ConfigError("size_px: unknown key"), DriverNotFoundError("no driver 'x'"), CalibrationError("not finite")]
)
def test_rig_file_that_is_wrong_is_given_up(tmp_path: Path, error: InvalidInputError) -> None:
    bench = Bench(tmp_path)
    bench.open_error = error
    bench.runner.start()
    assert failure_code(bench.until(bench.scan().id)) == error.code
    # Once: at the first opening, not at the scan's own.
    assert bench.given_up == [error]
    bench.close()


def test_device_that_is_absent_is_not_given_up(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.open_error = DeviceGoneError("No camera on usb-3.")
    bench.runner.start()
    bench.until(bench.scan().id)
    assert bench.given_up == []
    bench.close()


def test_ending_that_the_disk_refused_is_recorded_before_the_next_scan(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    scan_id = stranded(bench, monkeypatch)
    assert bench.store.get(scan_id).state is JobState.COMPUTING
    assert bench.until(bench.scan(wait=True).id).state is JobState.SUCCEEDED
    assert bench.store.get(scan_id).state is JobState.SUCCEEDED


def test_ending_that_the_disk_refused_is_recorded_at_the_close(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    scan_id = stranded(bench, monkeypatch)
    bench.runner.close()
    assert bench.store.get(scan_id).state is JobState.SUCCEEDED


@pytest.mark.parametrize("how", ["cancel", "delete"])
def test_ending_that_the_disk_refused_is_recorded_when_somebody_asks(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    scan_id = stranded(bench, monkeypatch)
    if how == "cancel":
        assert bench.runner.cancel(scan_id).state is JobState.SUCCEEDED
    else:
        bench.runner.delete(scan_id)
        assert bench.store.page(before=None, limit=10) == []


def test_scan_that_nobody_works_on_can_be_cancelled(bench: Bench) -> None:
    lost = bench.store.create(plan_json(ScanPlan()), rig="bench", label=None)
    record = bench.runner.cancel(lost.id)
    assert (record.state, failure_code(record)) == (JobState.INTERRUPTED, "scan-interrupted")
    bench.runner.delete(lost.id)


def test_worker_that_cannot_be_started_again_strands_no_scan(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    scan = bench.held()
    waiting = bench.scan(wait=True)

    def start() -> None:
        monkeypatch.undo()
        message = "Cannot allocate memory"
        raise OSError(errno.ENOMEM, message)

    monkeypatch.setattr(bench.worker, "start", start)
    bench.runner.cancel(scan.id)
    assert bench.until(scan.id).state is JobState.CANCELLED
    bench.gate.set()
    assert bench.until(waiting.id).state is JobState.SUCCEEDED
