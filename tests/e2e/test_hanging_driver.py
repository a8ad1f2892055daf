"""A driver whose call does not return: nobody can end it, and still the light goes off and everybody is told."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from slrig.errors import ServiceError
from tests.e2e.conftest import STOP_LIMIT_S, ServiceProcess
from tests.e2e.faulty_rig.desk import Desk, Step
from tests.e2e.faulty_rig.driver import PLAYER
from tests.e2e.faulty_rig.following import Follower
from tests.e2e.faulty_rig.scenery import CAMERA_NAME
from tests.e2e.faulty_rig.service import ended, gone, half_written, installed, scanned, write_rig

pytestmark = pytest.mark.realtime

READ = Step(CAMERA_NAME, "read", 7)


@pytest.fixture
def desk() -> Iterator[Desk]:
    with Desk() as desk:
        yield desk


@pytest.fixture
def service(tmp_path: Path, desk: Desk) -> Iterator[ServiceProcess]:
    with installed(tmp_path / "site"):
        service = ServiceProcess(write_rig(tmp_path / "rig", desk, "software"), tmp_path / "data")
    yield service
    if service.process.poll() is None:
        service.kill()


def test_read_that_does_not_return_ends_the_scan(service: ServiceProcess, desk: Desk) -> None:
    with service.client() as client, desk.held(READ) as hold:
        scan = client.scans.start()
        hold.until_reached()
        assert desk.lit
        # A frame has 2 s; what takes more than twice that, and 5 s, does not keep its time-out.
        record = ended(client, scan)
        assert record["state"] == "failed"
        assert record["error"]["type"] == "/problems/device"
        for words in ("camera 'left'", "not come back from read for 9 s", "plug it in again", "restart the service"):
            assert words in record["error"]["detail"]
        assert desk.light[-1] == ("blank", False)
        assert client.get("/rig")["error"] == record["error"]["detail"]
        assert client.system.readiness() is not None
        with pytest.raises(ServiceError, match="has not come back from read"):
            client.scans.start(if_busy="queue")
        hold.go.set()
        # Now that it has returned, the rig is opened afresh by itself.
        assert desk.came(PLAYER, "open")
        assert scanned(client)["state"] == "succeeded"
        assert client.get("/rig")["error"] is None
        assert client.get(scan["links"]["self"]) == record
        assert half_written(service.data) == []


@pytest.mark.parametrize("step", [READ, Step(PLAYER, "show", 7), Step(CAMERA_NAME, "open")], ids=str)
def test_driver_that_does_not_return_cannot_hold_back_the_end(service: ServiceProcess, desk: Desk, step: Step) -> None:
    with desk.held(step) as hold:
        with service.client() as client:
            if step.name == "open":
                hold.until_reached()
            scan = client.scans.start()
        hold.until_reached()
        follower = Follower(service, scan)
        began_s = time.monotonic()
        service.process.send_signal(signal.SIGTERM)
        assert gone(service, STOP_LIMIT_S) == 0
        print(f"SIGTERM, {step} never returns: gone after {time.monotonic() - began_s:.1f} s")  # noqa: T201
    # One that waited for the rig to be opened goes on waiting for the next service.
    assert follower.last() == ("queued" if step.name == "open" else "interrupted")
    assert not desk.lit
    assert not (service.data / "service.json").exists()
