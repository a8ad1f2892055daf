"""Every step of a scan, made to fail on the real service in the ways that devices fail, one after the other.

After each fault the same is asked: is the scan over, and marked with what happened, where, and what to do; was the
projector told to be dark, where it still takes orders; does `GET /rig` tell a fault that stays; and is the next scan
well as soon as the fault is lifted, without anything being restarted or left lying about? `-s` prints the answers.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import pytest

from slrig.client import Client
from tests.e2e.conftest import ServiceProcess
from tests.e2e.faulty_rig.desk import WAIT_S, Desk, Step
from tests.e2e.faulty_rig.driver import PLAYER
from tests.e2e.faulty_rig.scenery import CAMERA_NAME
from tests.e2e.faulty_rig.service import ended, half_written, installed, scanned, write_rig

pytestmark = pytest.mark.slow

MIDDLE = 7
"""A pattern in the middle of the sequence."""

UNPLUG, BUSY, SILENT, ERROR, DEFECT = "unplug", "busy", "time-out", "input/output error", "defect"

_KINDS = {UNPLUG: "device-gone", BUSY: "device-busy", SILENT: "device", ERROR: "device", DEFECT: "driver-broken"}
_REMEDIES = {
    UNPLUG: "plug it in",
    BUSY: "end that program, then scan again",
    SILENT: "check",
    ERROR: "check cable, power and permissions, then scan again",
    DEFECT: "report it to the driver's maintainer",
}


@dataclass(frozen=True, slots=True)
class Case:
    """A fault at a step of a scan on a rig of one kind. `first` : a fault that brings the scan to that step."""

    rig: str
    step: Step
    what: str
    first: tuple[Step, str] | None = None

    def __str__(self) -> str:
        return f"{self.rig}-{self.step}-{self.what}".replace(" ", "_")

    @property
    def kind(self) -> str | None:
        """The kind of fault that the scan is to be marked with; None if it has all its frames and is to succeed."""
        what, at = (self.what, self.step) if self.first is None else (self.first[1], self.first[0])
        if at.name == "disarm":
            return None
        return "frame-timeout" if (what, at.name) == (SILENT, "read") else _KINDS[what]


def _cases() -> Iterator[Case]:
    # Camera first. What does not depend on how exposures are started is tried on one kind of rig only.
    camera = [Step(CAMERA_NAME, name) for name in ("configure", "arm", "disarm", "trigger")]
    camera += [Step(CAMERA_NAME, "read", number) for number in (0, MIDDLE)]
    projector = [Step(PLAYER, "load"), Step(PLAYER, "blank"), *(Step(PLAYER, "show", number) for number in (0, MIDDLE))]
    for step in (*camera, *projector):
        yield Case("software", step, UNPLUG)
        # An error of the system's, which is put into words where the step was asked for: the same for every pattern.
        if step.number != 0:
            yield Case("software", step, BUSY)
        # In the words of the driver, as the first, but the device stays: as a scan begins, within it, at its end.
        if step.number == MIDDLE or step.name in {"arm", "blank"}:
            yield Case("software", step, SILENT)
    reads = [Step(CAMERA_NAME, "arm"), *(Step(CAMERA_NAME, "read", number) for number in (0, MIDDLE))]
    for step in (*reads, Step(PLAYER, "show", MIDDLE)):
        yield Case("free", step, UNPLUG)
    yield Case("free", Step(CAMERA_NAME, "read", 0), SILENT)
    for step in (*reads, Step(PLAYER, "blank"), Step(PLAYER, "stop")):
        yield Case("hardware", step, UNPLUG)
    yield Case("hardware", Step(CAMERA_NAME, "read", MIDDLE), SILENT)
    yield from (Case("hardware", Step(PLAYER, "play"), what) for what in (UNPLUG, BUSY, SILENT))
    for step in (Step(CAMERA_NAME, "read", MIDDLE), Step(PLAYER, "show", MIDDLE), Step(PLAYER, "blank")):
        yield from (Case("software", step, what) for what in (ERROR, DEFECT))
    for device in (CAMERA_NAME, PLAYER):
        # A rig is opened when the one before was let go, and closed when it is.
        at = Step(CAMERA_NAME, "read", MIDDLE), ERROR
        yield from (Case("software", Step(device, "open"), what, at) for what in (UNPLUG, BUSY, ERROR))
        yield from (Case("software", Step(device, "close"), what, at) for what in (UNPLUG, ERROR))


CASES = tuple(_cases())


@dataclass(frozen=True, slots=True)
class Stand:
    """A running service, its rig's desk, and a client."""

    desk: Desk
    service: ServiceProcess
    client: Client


@pytest.fixture(scope="module")
def stands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str], Stand]]:
    """One service for each kind of rig, started when it is first asked for."""
    folder = tmp_path_factory.mktemp("faulty")
    made: dict[str, Stand] = {}
    with ExitStack() as leaving, installed(folder / "site"):

        def start(rig: str) -> Stand:
            if rig not in made:
                desk = leaving.enter_context(Desk())
                service = ServiceProcess(write_rig(folder / rig, desk, rig), folder / rig / "data")
                leaving.callback(service.kill)
                made[rig] = Stand(desk, service, leaving.enter_context(service.client()))
                assert scanned(made[rig].client)["state"] == "succeeded", service.log.read_text()
            return made[rig]

        yield start


@pytest.fixture
def stand(stands: Callable[[str], Stand], case: Case) -> Iterator[Stand]:
    found = stands(case.rig)
    yield found
    found.desk.lift()


@pytest.mark.parametrize("case", CASES, ids=str)
def test_fault_ends_the_scan_and_nothing_else(stand: Stand, case: Case) -> None:
    desk, client = stand.desk, stand.client
    desk.forget()
    for step, what in filter(None, (case.first, (case.step, case.what))):
        desk.fault(step, what)
    record = ended(client, client.scans.start())
    answers = _is_dark(desk, case), _rig_tells(client, case)
    if case.step.name == "open":
        _check_unopened(scanned(client), case)
    desk.lift()
    again = scanned(client)
    print(f"{case.rig:9}{case.step!s:17}{case.what:20}{record['state']:10}", end="")  # noqa: T201 - the table
    print(f"{_marked(record):15}{answers[0]:12}{answers[1]:24}next: {again['state']}")  # noqa: T201
    _check_mark(record, case)
    assert again["state"] == "succeeded", again
    assert desk.dark()
    assert half_written(stand.service.data) == []


def _marked(record: dict[str, object]) -> str:
    error = record.get("error")
    return str(error["type"]).removeprefix("/problems/") if isinstance(error, dict) else "-"


def _check_mark(record: dict[str, object], case: Case) -> None:
    if case.kind is None:
        assert record["state"] == "succeeded", record
        return
    assert record["state"] == "failed", record
    assert _marked(record) == case.kind, record
    what, step = (case.what, case.step) if case.first is None else (case.first[1], case.first[0])
    error = record["error"]
    assert isinstance(error, dict)
    assert step.device in error["detail"]
    if case.kind == "frame-timeout":
        # Three times, and each time it is told which pattern's frame did not come.
        assert f"pattern {step.number} (" in error["detail"]
        assert "check the " in error["detail"]
        assert " 3 times" in error["detail"]
    else:
        assert f"in {step.name}" in error["detail"], record
        assert _REMEDIES[what] in error["detail"], record


def _check_unopened(record: dict[str, object], case: Case) -> None:
    """A scan on a rig that cannot be opened is told why."""
    # What a factory lets through of the system's own errors may count as a defect of the driver.
    kinds = {_KINDS[case.what], "driver-broken" if case.what == ERROR else _KINDS[case.what]}
    assert record["state"] == "failed", record
    assert _marked(record) in kinds, record


def _is_dark(desk: Desk, case: Case) -> str:
    """Whether the projector was dark when the scan was over; one that is unplugged takes no orders."""
    if case.step.device == PLAYER and case.what == UNPLUG and case.step.name not in {"open", "close"}:
        return "unplugged"
    assert not desk.lit, desk.light
    assert desk.was_lit() or case.step.name in {"configure", "arm", "load"}, desk.light
    return "dark"


def _rig_tells(client: Client, case: Case) -> str:
    """What GET /rig says while the fault stays. A rig that opens again looks well: nobody can know better."""
    if case.what != UNPLUG and case.step.name != "open":
        return "/rig: opens again"
    until_s = time.monotonic() + WAIT_S
    # Where two things failed, the first is told until it was tried to open the rig again.
    while not _names(error := client.get("/rig")["error"], case.step.device):
        assert time.monotonic() < until_s, error
    return "/rig: cannot be opened"


def _names(error: str | None, device: str) -> bool:
    return error is not None and (device in error or "driver 'faulty' failed" in error)
