"""The service, told to end or killed while its rig is at each step of a scan.

Told to end (SIGTERM) it leaves the projector dark, every scan marked as interrupted, and whoever follows one knows it.
Killed (SIGKILL) it can do none of that: then the light is the duty of the projector's own watchdog, if it has one,
until the service is started again and opens the projector, which darkens it; and the scan is marked at that start. One
that still waited for the rig waits again, and one whose frames were complete is reconstructed.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import STOP_LIMIT_S, ServiceProcess
from tests.e2e.faulty_rig.desk import Desk, Step
from tests.e2e.faulty_rig.driver import PLAYER
from tests.e2e.faulty_rig.following import Follower
from tests.e2e.faulty_rig.scenery import CAMERA_NAME
from tests.e2e.faulty_rig.service import gone, half_written, installed, scanned, write_rig

pytestmark = pytest.mark.slow

DARK_STEPS = {"open", "configure", "arm", "load"}
COMPLETED_STEPS = {"write", "read", "blank", "disarm", "sync"}
"""The light of the last pattern may be over by then."""
STEPS = (
    Step(PLAYER, "open"),
    Step(CAMERA_NAME, "open"),
    Step(CAMERA_NAME, "configure"),
    Step(PLAYER, "load"),
    Step(CAMERA_NAME, "arm"),
    Step(PLAYER, "show", 0),
    Step(CAMERA_NAME, "trigger"),
    Step("disk", "write"),
    Step(CAMERA_NAME, "read", 7),
    Step(PLAYER, "blank"),
    Step(CAMERA_NAME, "disarm"),
    Step("disk", "sync"),
    Step("disk", "commit"),
)
"""The first pattern is shown, a later one read: what is asked for each pattern is left in the same way at each."""

FOUND_AFTERWARDS = (
    Step(PLAYER, "open"),
    Step(CAMERA_NAME, "arm"),
    Step(PLAYER, "show", 0),
    Step("disk", "write"),
    Step(CAMERA_NAME, "read", 7),
    Step(PLAYER, "blank"),
    Step("disk", "sync"),
    Step("disk", "commit"),
)
"""Nothing of ours runs after a kill, so what counts is what it leaves: a scan that waits, one without a frame in the
dark and in the light, with a file begun, with some frames, with all frames, all written, all at their place."""


@pytest.fixture
def desk() -> Iterator[Desk]:
    with Desk() as desk:
        yield desk


@pytest.fixture
def serve(tmp_path: Path, desk: Desk) -> Iterator[Callable[[], ServiceProcess]]:
    """Start the service on one rig and one data folder, one after the other."""
    rig = write_rig(tmp_path / "rig", desk, "software")
    running: list[ServiceProcess] = []

    def served() -> ServiceProcess:
        running.append(ServiceProcess(rig, tmp_path / "data"))
        return running[-1]

    # Each driver returns here, late on a busy machine, and what it had opened is to be closed then.
    with installed(tmp_path / "site", shutdown_s=STOP_LIMIT_S / 2):
        yield served
    for service in running:
        if service.process.poll() is None:
            service.kill()


@contextmanager
def at(
    desk: Desk, step: Step, service: Callable[[], ServiceProcess], waiting: dict[str, Any] | None = None
) -> Iterator[tuple[ServiceProcess, dict[str, Any]]]:
    """A service whose rig is held at a step of a scan: of the one that waits since the last run, if there is one."""
    desk.forget()
    with desk.held(step) as hold:
        running = service()
        with running.client() as client:
            if step.name == "open":
                hold.until_reached()
            scan = client.scans.start() if waiting is None else waiting
        hold.until_reached()
        assert desk.was_lit() or step.name in DARK_STEPS
        yield running, scan


def marked(service: ServiceProcess, scan: dict[str, Any]) -> str:
    """The state of a scan, and the kind of what is on record as its cause."""
    with service.client() as client:
        record = client.get(scan["links"]["self"])
    if record["state"] == "succeeded":
        return "succeeded"
    assert record["error"]["type"] == "/problems/scan-interrupted", record
    assert "Start it again" in record["error"]["detail"]
    return str(record["state"])


def test_told_to_end_at_every_step(serve: Callable[[], ServiceProcess], desk: Desk) -> None:
    before: dict[str, Any] | None = None
    waiting: dict[str, Any] | None = None
    for step in STEPS:
        with at(desk, step, serve, waiting) as (service, scan):
            if before is not None:
                assert marked(service, before) == "interrupted"
            follower = Follower(service, scan)
            began_s = time.monotonic()
            service.process.send_signal(signal.SIGTERM)
            desk.lift()
            code = gone(service, STOP_LIMIT_S)
        took_s = time.monotonic() - began_s
        print(f"SIGTERM at {step!s:16} exit {code} in {took_s:.1f} s, {follower.last():12}", end="")  # noqa: T201
        print(f"projector {'lit' if desk.lit else 'dark'}")  # noqa: T201
        assert code == 0
        assert not (service.data / "service.json").exists()
        assert not desk.lit, desk.light
        assert {device for device, name, _ in desk.steps if name == "close"} >= _opened(desk)
        last = follower.last()
        # One that still waited for the rig to be opened waits on; one whose frames are all there is completed. A held
        # write holds no light: behind it all the others may be taken before the service is told.
        spared = "queued" if step.name == "open" else "computing" if step.name in COMPLETED_STEPS else None
        assert last in ("interrupted", spared) or step.name == "commit"
        assert half_written(service.data) == []
        before, waiting = (scan if last == "interrupted" else None), (scan if last == "queued" else None)
        if last == "computing":
            completing = serve()
            Follower(completing, scan).last()
            assert marked(completing, scan) == "succeeded"
            assert completing.stop() == 0
    with serve().client() as client:
        assert scanned(client)["state"] == "succeeded"


def _opened(desk: Desk) -> set[str]:
    """The devices that had been opened: their opening was not the last that was asked of them."""
    return {device for device in (PLAYER, CAMERA_NAME) if desk.steps.count((device, "open", 0))}


def test_killed_at_every_step(serve: Callable[[], ServiceProcess], desk: Desk) -> None:
    before: dict[str, Any] | None = None
    waiting: dict[str, Any] | None = None
    for step in FOUND_AFTERWARDS:
        with at(desk, step, serve, waiting) as (service, scan):
            if before is not None:
                print(marked(service, before), end="\n")  # noqa: T201
                assert marked(service, before) == "interrupted"
            service.kill()
        print(f"SIGKILL at {step!s:16} projector {'lit' if desk.lit else 'dark'}, then ", end="")  # noqa: T201
        before, waiting = (None, scan) if step.name == "open" else (scan, None)
    last = serve()
    assert before is not None
    Follower(last, before).last()
    print(marked(last, before))  # noqa: T201
    assert marked(last, before) == "succeeded"
    assert half_written(last.data) == []
    with last.client() as client:
        assert scanned(client)["state"] == "succeeded"
    assert desk.dark()
