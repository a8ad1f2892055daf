"""Faults of devices, disk and worker on the real service, one after the other.

Each fault fails its scan with its cause and its remedy, leaves the projector dark where it still obeys, and leaves no
files behind. `GET /rig` reports a fault that stays. The next scan succeeds as soon as the fault is gone, without a
restart.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPResponse
from typing import Any
from urllib.error import HTTPError

import pytest

from tests.e2e.campaigns.conftest import Stand
from tests.e2e.conftest import KEY, ended, followed_to, scanned
from tests.e2e.faulty_rig.driver import CAMERA_NAME, PLAYER
from tests.e2e.faulty_rig.service import Desk, Step, half_written
from tests.e2e.schedules import awaited

pytestmark = pytest.mark.slow

MIDDLE = 7
"""A pattern in the middle of the sequence."""

READ = Step(CAMERA_NAME, "read", MIDDLE)
UNPLUG, BUSY, SILENT, ERROR, DEFECT, FULL = "unplug", "busy", "time-out", "input/output error", "defect", "full"
MARKS = {
    UNPLUG: ("device-gone", "plug it in"),
    BUSY: ("device-busy", "end that program, then scan again"),
    SILENT: ("device", "check"),
    ERROR: ("device", "check cable, power and permissions, then scan again"),
    DEFECT: ("driver-broken", "report it to the driver's maintainer"),
    FULL: ("storage", "free some space"),
}
"""What each fault marks a scan with: the kind of problem, and a remedy."""


@dataclass(frozen=True, slots=True)
class Case:
    """A fault at a step of a scan on a rig of one kind. `first` : a fault that brings the scan to that step."""

    rig: str
    device: str
    name: str
    what: str
    number: int = -1
    first: tuple[Step, str] | None = None

    def __str__(self) -> str:
        return f"{self.rig}-{self.step}-{self.what}".replace(" ", "_")

    @property
    def step(self) -> Step:
        return Step(self.device, self.name, self.number)


BROKEN = READ, ERROR
"""The rig is closed after this fault, and opened for the next scan."""

# Each phase of a scan, and each kind of fault with each device. The trigger matters to few of them.
CASES = (
    Case("software", CAMERA_NAME, "configure", UNPLUG),
    Case("software", PLAYER, "load", BUSY),
    Case("software", CAMERA_NAME, "arm", SILENT),
    Case("software", CAMERA_NAME, "trigger", ERROR),
    Case("software", PLAYER, "show", UNPLUG, 0),
    Case("software", PLAYER, "show", DEFECT, MIDDLE),
    Case("software", CAMERA_NAME, "read", SILENT, MIDDLE),
    Case("software", CAMERA_NAME, "read", UNPLUG, MIDDLE),
    Case("software", PLAYER, "blank", ERROR),
    Case("software", CAMERA_NAME, "disarm", BUSY),
    Case("software", CAMERA_NAME, "open", BUSY, first=BROKEN),
    Case("software", PLAYER, "open", ERROR, first=BROKEN),
    Case("software", PLAYER, "close", UNPLUG, first=BROKEN),
    *(Case("software", "disk", name, FULL) for name in ("write", "rename", "sync", "commit")),
    Case("free", CAMERA_NAME, "read", SILENT, 0),
    Case("hardware", PLAYER, "play", BUSY),
    Case("hardware", CAMERA_NAME, "read", UNPLUG, MIDDLE),
)


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_fault_ends_its_scan_and_nothing_else(stands: Callable[[str], Stand], case: Case) -> None:
    stand = stands(case.rig)
    desk, client = stand.desk, stand.client
    for step, what in filter(None, (case.first, (case.step, case.what))):
        desk.fault(step, what)
    record = scanned(client)
    projector_is_dark(desk, case)
    if case.device != "disk" and (case.what == UNPLUG or case.name == "open"):
        rig_names(stand, case.device)
    if case.name == "open":
        unopened = scanned(client)
        # A system's error that a factory lets pass may count as a defect of the driver.
        kinds = {MARKS[case.what][0], "driver-broken" if case.what == ERROR else MARKS[case.what][0]}
        assert (unopened["state"], marked(unopened) in kinds) == ("failed", True), unopened
    desk.lift()
    again = scanned(client)
    check_mark(record, case)
    assert again["state"] == "succeeded", again
    assert desk.dark()
    assert half_written(stand.service.data) == []


def marked(record: dict[str, Any]) -> str:
    return str((record.get("error") or {}).get("type")).removeprefix("/problems/")


def check_mark(record: dict[str, Any], case: Case) -> None:
    step, what = case.first or (case.step, case.what)
    if step.name == "disarm":
        # All frames are there.
        assert record["state"] == "succeeded", record
        return
    kind, remedy = MARKS[what]
    words = [f"in {step.name}", step.device, remedy]
    if what == FULL:
        words = ["No space left on device", remedy]
    elif (what, step.name) == (SILENT, "read"):
        kind, words = "frame-timeout", [f"pattern {step.number} (", step.device, "check the ", " 3 times"]
    assert (record["state"], marked(record)) == ("failed", kind), record
    assert [word for word in words if word not in record["error"]["detail"]] == [], record


def projector_is_dark(desk: Desk, case: Case) -> None:
    """After the scan the projector is dark; one that is unplugged obeys no more."""
    if case.device != PLAYER or case.what != UNPLUG or case.name == "close":
        assert not desk.lit, desk.light
        assert desk.was_lit() or case.name in {"configure", "arm", "load"}, desk.light


def rig_names(stand: Stand, device: str) -> None:
    """GET /rig names the device, at the latest once the service has tried to open the rig again."""
    words = device, "driver 'faulty' failed"
    awaited(lambda: any(each in (stand.client.get("/rig")["error"] or "") for each in words), "the fault")


@contextmanager
def no_file_longer(process_id: int, most_bytes: int) -> Iterator[None]:
    """Have the kernel refuse to make any file of a process longer than this: as a full disk does."""
    soft, hard = resource.prlimit(process_id, resource.RLIMIT_FSIZE)
    resource.prlimit(process_id, resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.prlimit(process_id, resource.RLIMIT_FSIZE, (soft, hard))


def test_a_disk_that_takes_nothing_leaves_the_rig_free_and_records_the_fault_later(stand: Stand) -> None:
    with stand.desk.held(READ) as hold:
        scan = stand.client.scans.start()
        hold.until_reached()
        with no_file_longer(stand.service.process.pid, 0):
            hold.go.set()
            # Nothing can be written: no frame, no record of the end, no log. The rig is free all the same.
            while stand.client.get("/rig")["holder"] is not None:
                assert stand.service.process.poll() is None
            assert not stand.desk.lit
            assert stand.client.get(scan["links"]["self"])["state"] == "capturing"
    assert scanned(stand.client)["state"] == "succeeded"
    assert marked(ended(stand.client, scan)) == "storage"
    assert half_written(stand.service.data) == []


def test_a_disk_without_space_for_the_mesh_keeps_the_bundle(stand: Stand) -> None:
    with no_file_longer(stand.service.worker_id(), 1000):
        record = scanned(stand.client)
    assert (record["state"], marked(record)) == ("failed", "storage")
    assert list(record["links"]["files"]) == ["bundle.zip"]
    assert not stand.desk.lit
    assert half_written(stand.service.data) == []
    assert scanned(stand.client)["state"] == "succeeded"


def test_a_killed_worker_is_replaced_and_its_scan_computed_once_more(stand: Stand) -> None:
    worker = stand.service.worker_id()
    os.kill(worker, signal.SIGSTOP)
    scan = stand.client.scans.start()
    followed_to(stand.client, scan, "computing")
    os.kill(worker, signal.SIGKILL)
    record = ended(stand.client, scan)
    assert (record["state"], record.get("error")) == ("succeeded", None)
    assert {"bundle.zip", "mesh.ply"} <= set(record["links"]["files"])
    assert scanned(stand.client)["state"] == "succeeded"


def test_a_cancelled_scan_leaves_the_rig_dark_and_ready(stand: Stand) -> None:
    with stand.desk.held(READ) as hold:
        scan = stand.client.scans.start()
        hold.until_reached()
        stand.client.post(scan["links"]["cancel"], None)
    assert ended(stand.client, scan)["state"] == "cancelled"
    assert (stand.desk.was_lit(), stand.desk.lit) == (True, False)
    assert half_written(stand.service.data) == []
    assert scanned(stand.client)["state"] == "succeeded"


def preview(stand: Stand, light: str = "white") -> HTTPResponse:
    address = f"{stand.service.url}/preview/{CAMERA_NAME}?light={light}"
    request = urllib.request.Request(address, headers={"X-API-Key": KEY})  # noqa: S310 - loopback
    answer = urllib.request.urlopen(request, timeout=60)  # noqa: S310 - loopback
    assert isinstance(answer, HTTPResponse)
    return answer


@pytest.mark.parametrize(
    ("step", "what"),
    [(Step(CAMERA_NAME, "read"), UNPLUG), (Step(CAMERA_NAME, "trigger"), ERROR), (Step(PLAYER, "show", 0), SILENT)],
    ids=str,
)
def test_a_fault_ends_the_preview_and_its_light(stand: Stand, step: Step, what: str) -> None:
    begins = step.device == PLAYER
    if begins:
        stand.desk.fault(step, what)
    with preview(stand) as stream:
        if not begins:
            assert stand.desk.shines()
            assert b"image/jpeg" in stream.read(200)
            # A second client is sent away as well, whatever light it wants.
            with preview(stand, "off") as second:
                stand.desk.fault(step, what)
                second.read()
        # Both streams end in good order.
        stream.read()
    assert not stand.desk.lit
    if what == UNPLUG:
        assert step.device in stand.client.get("/rig")["error"]
        with pytest.raises(HTTPError, match="502") as refused:
            preview(stand)
        assert "plug it in" in json.load(refused.value)["detail"]
    stand.desk.lift()
    assert scanned(stand.client)["state"] == "succeeded"
    with preview(stand) as stream:
        assert stand.desk.shines()
    assert stand.desk.dark()
