"""A driver call that does not return: nothing can end it, and still the light goes off and every client hears why."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

from slrig.errors import ServiceError
from tests.e2e.campaigns.test_faults import READ
from tests.e2e.conftest import ServiceProcess, ended, scanned
from tests.e2e.faulty_rig.driver import CAMERA_NAME, PLAYER
from tests.e2e.faulty_rig.service import Desk, Follower, Step, half_written

pytestmark = pytest.mark.realtime

Serve = Callable[..., ServiceProcess]


def test_a_read_that_does_not_return_ends_the_scan(serve_again: Serve, desk: Desk) -> None:
    service = serve_again()
    with service.client() as client, desk.held(READ) as hold:
        scan = client.scans.start()
        hold.until_reached()
        assert desk.lit
        # A frame has 2 s; what takes more than twice that, and 5 s, does not keep its time-out.
        record = ended(client, scan)
        assert (record["state"], record["error"]["type"]) == ("failed", "/problems/device")
        for words in ("camera 'left'", "not come back from read for 9 s", "plug it in again", "restart the service"):
            assert words in record["error"]["detail"]
        assert desk.light[-1] == ("blank", False)
        assert client.get("/rig")["error"] == record["error"]["detail"]
        assert client.system.readiness() is not None
        with pytest.raises(ServiceError, match="has not come back from read"):
            client.scans.start(if_busy="queue")
        hold.go.set()
        # Now that it has returned, the service opens the rig again by itself.
        assert desk.came(PLAYER, "open")
        assert scanned(client)["state"] == "succeeded"
        assert client.get("/rig")["error"] is None
        assert client.get(scan["links"]["self"]) == record
        assert half_written(service.data) == []


@pytest.mark.parametrize("step", [Step(PLAYER, "show", 7), Step(CAMERA_NAME, "open")], ids=str)
def test_a_driver_that_does_not_return_cannot_delay_the_end(serve_again: Serve, desk: Desk, step: Step) -> None:
    with desk.held(step) as hold:
        service = serve_again()
        with service.client() as client:
            if step.name == "open":
                hold.until_reached()
            scan = client.scans.start()
        hold.until_reached()
        follower = Follower(service, scan)
        assert service.stop(signal.SIGTERM) == 0
    # A scan that waits for the rig to be opened waits for the next service.
    assert follower.last() == ("queued" if step.name == "open" else "interrupted")
    assert not desk.lit
    assert not (service.data / "service.json").exists()
