"""GET /preview while things go wrong: the stream ends, the light goes off, and the rig can be used again."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from http.client import HTTPResponse
from pathlib import Path
from urllib.error import HTTPError

import pytest

from tests.e2e.conftest import STOP_LIMIT_S, ServiceProcess
from tests.e2e.faulty_rig.desk import ANY, Desk, Step
from tests.e2e.faulty_rig.driver import PLAYER
from tests.e2e.faulty_rig.scenery import CAMERA_NAME
from tests.e2e.faulty_rig.service import gone, installed, scanned, write_rig
from tests.e2e.test_preview import next_picture, opened

pytestmark = pytest.mark.slow


@pytest.fixture
def desk() -> Iterator[Desk]:
    with Desk() as desk:
        yield desk


@pytest.fixture
def service(tmp_path: Path, desk: Desk) -> Iterator[ServiceProcess]:
    """A service whose rig is open: it has done a scan."""
    with installed(tmp_path / "site"):
        service = ServiceProcess(write_rig(tmp_path / "rig", desk, "software"), tmp_path / "data")
    try:
        with service.client() as client:
            assert scanned(client)["state"] == "succeeded", service.log.read_text()
        desk.forget()
        yield service
    finally:
        if service.process.poll() is None:
            service.kill()


def test_fault_ends_the_stream_and_the_rig_is_usable_again(service: ServiceProcess, desk: Desk) -> None:
    for step, what in (
        (Step(CAMERA_NAME, "read", ANY), "unplug"),
        (Step(CAMERA_NAME, "read", ANY), "time-out"),
        (Step(CAMERA_NAME, "trigger"), "input/output error"),
        (Step(CAMERA_NAME, "arm"), "busy"),
        (Step(PLAYER, "show", 0), "time-out"),
        (Step(PLAYER, "load"), "unplug"),
    ):
        desk.forget()
        begins = step.name in {"arm", "show", "load"}
        if begins:
            desk.fault(step, what)
        with opened(f"{service.url}/preview/left?light=white") as stream:
            if not begins:
                watched(stream, desk)
                # Whoever looks is sent away, whatever they asked for.
                with opened(f"{service.url}/preview/left?light=off") as second:
                    desk.fault(step, what)
                    ended(second)
            ended(stream)
        print(f"preview, {step!s:15}{what:20}stream ended, projector {'lit' if desk.lit else 'dark'}")  # noqa: T201
        assert not desk.lit
        with service.client() as client:
            if what == "unplug":
                assert step.device in client.get("/rig")["error"]
                with pytest.raises(HTTPError, match="502") as refused:
                    opened(f"{service.url}/preview/left")
                assert "plug it in" in json.load(refused.value)["detail"]
            desk.lift()
            assert scanned(client)["state"] == "succeeded"
        with opened(f"{service.url}/preview/left?light=white") as stream:
            watched(stream, desk)
        assert desk.dark()


def watched(stream: HTTPResponse, desk: Desk) -> None:
    """See a lit picture, while the light is on."""
    assert desk.shines()
    assert next_picture(stream).mean() > 100


def ended(stream: HTTPResponse) -> None:
    """Read a stream up to its end, which must come in good order."""
    while stream.read(2**16):
        pass


def test_end_of_the_service_ends_the_stream_and_the_light(service: ServiceProcess, desk: Desk) -> None:
    with opened(f"{service.url}/preview/left?light=white") as stream:
        watched(stream, desk)
        service.process.send_signal(signal.SIGTERM)
        ended(stream)
        assert gone(service, STOP_LIMIT_S) == 0
    assert not desk.lit
    assert "Cancel" not in service.log.read_text()


def test_killed_with_its_light_on_the_next_service_darkens_it(
    service: ServiceProcess, desk: Desk, tmp_path: Path
) -> None:
    with opened(f"{service.url}/preview/left?light=white") as stream:
        watched(stream, desk)
        service.kill()
        assert desk.lit
    with installed(tmp_path / "again"):
        second = ServiceProcess(tmp_path / "rig" / "software.toml", service.data)
    try:
        assert desk.dark()
        with second.client() as client:
            assert scanned(client)["state"] == "succeeded"
        with opened(f"{second.url}/preview/left?light=white") as stream:
            watched(stream, desk)
        assert second.stop() == 0
        assert not desk.lit
    finally:
        if second.process.poll() is None:
            second.kill()
