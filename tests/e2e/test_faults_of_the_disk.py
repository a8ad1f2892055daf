"""A disk that refuses at every place where a scan writes, and a reconstruction that is cut off, on the real service."""

from __future__ import annotations

import os
import resource
import select
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

import pytest

from slrig.client.events import StateChange
from tests.e2e.conftest import STOP_LIMIT_S, ServiceProcess
from tests.e2e.faulty_rig.desk import Desk, Step
from tests.e2e.faulty_rig.scenery import CAMERA_NAME
from tests.e2e.faulty_rig.service import ended, gone, half_written, installed, scanned, write_rig

pytestmark = pytest.mark.slow

READ = Step(CAMERA_NAME, "read", 7)


@pytest.fixture(scope="module")
def desk() -> Iterator[Desk]:
    with Desk() as desk:
        yield desk


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, desk: Desk) -> Iterator[ServiceProcess]:
    """A service that has done its first scan well. The last test ends it."""
    folder = tmp_path_factory.mktemp("disk")
    with installed(folder / "site"):
        service = ServiceProcess(write_rig(folder / "rig", desk, "software"), folder / "data")
        try:
            with service.client() as client:
                assert scanned(client)["state"] == "succeeded", service.log.read_text()
            yield service
        finally:
            if service.process.poll() is None:
                service.kill()


@contextmanager
def no_file_longer(process_id: int, most_bytes: int) -> Iterator[None]:
    """Have the kernel refuse a process whatever would make a file longer than so much: as a full disk does, to all."""
    soft, hard = resource.prlimit(process_id, resource.RLIMIT_FSIZE)
    resource.prlimit(process_id, resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.prlimit(process_id, resource.RLIMIT_FSIZE, (soft, hard))


def refused(record: dict[str, Any]) -> str:
    """The detail of a scan that the disk refused."""
    assert record["state"] == "failed", record
    assert record["error"]["type"] == "/problems/storage", record
    return str(record["error"]["detail"])


def test_disk_that_is_full_at_any_step_fails_the_scan_only(service: ServiceProcess, desk: Desk) -> None:
    with service.client() as client:
        for name in ("write", "rename", "sync", "commit"):
            desk.forget()
            desk.fault(Step("disk", name), "full")
            detail = refused(scanned(client))
            print(f"full at {name:8}{detail}")  # noqa: T201
            assert "No space left on device" in detail
            assert "free some space" in detail
            assert (desk.was_lit(), desk.lit) == (True, False)
            assert half_written(service.data) == []
            desk.lift()
            assert scanned(client)["state"] == "succeeded"


def test_disk_that_is_full_for_everything_is_on_record_once_it_is_not(service: ServiceProcess, desk: Desk) -> None:
    with service.client() as client:
        desk.forget()
        with desk.held(READ) as hold:
            scan = client.scans.start()
            hold.until_reached()
            limit = no_file_longer(service.process.pid, 0)
            limit.__enter__()
        # Nothing can be written: no frame, no record of the end, no log. The rig is free all the same.
        while client.get("/rig")["holder"] is not None:
            assert service.process.poll() is None
        assert not desk.lit
        assert client.get(scan["links"]["self"])["state"] == "capturing"
        limit.__exit__(None, None, None)
        assert scanned(client)["state"] == "succeeded"
        refused(ended(client, scan))
    assert half_written(service.data) == []


def test_disk_that_is_full_for_the_mesh_keeps_the_bundle(service: ServiceProcess, desk: Desk) -> None:
    with service.client() as client:
        with no_file_longer(service.worker_id(), 1000):
            record = scanned(client)
        refused(record)
        assert list(record["links"]["files"]) == ["bundle.zip"]
        assert not desk.lit
        assert half_written(service.data) == []
        assert scanned(client)["state"] == "succeeded"


def test_ended_in_the_middle_of_the_reconstruction(service: ServiceProcess, desk: Desk) -> None:
    rig, data = service.data.parent / "rig" / "software.toml", service.data
    for how in (signal.SIGTERM, signal.SIGKILL):
        worker = service.worker_id()
        alive = os.pidfd_open(worker)
        os.kill(worker, signal.SIGSTOP)
        with service.client() as client:
            scan = client.scans.start()
            for event in client.follow(scan["links"]["events"]):
                if isinstance(event, StateChange) and event.state == "computing":
                    break
            assert not desk.lit
        service.process.send_signal(how)
        assert gone(service, STOP_LIMIT_S) == (0 if how is signal.SIGTERM else -how)
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(alive, signal.SIGCONT)
        # Whichever way the service ended, its child does not stay.
        assert select.select([alive], [], [], STOP_LIMIT_S)[0]
        os.close(alive)
        service = ServiceProcess(rig, data)
        try:
            with service.client() as client:
                # Nobody was told that it ended: it goes on.
                for _ in client.follow(scan["links"]["events"]):
                    pass
                assert client.get(scan["links"]["self"])["state"] == "succeeded"
                assert half_written(data) == []
                assert scanned(client)["state"] == "succeeded"
        except BaseException:
            service.kill()
            raise
    assert service.stop() == 0
