"""Acceptance tests on a service's rig: lent for each position, kept in between, cancelled, refused."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID, uuid4

import pytest

from slrig.calibration.artefacts import Decision
from slrig.devices import Rig
from slrig.errors import (
    ArtefactNotReadyError,
    CalibrationError,
    DeviceBusyError,
    InvalidInputError,
    NothingToReconstructError,
    RigBusyError,
    ScanNotFoundError,
    ScanStateError,
    UnsupportedByDeviceError,
)
from slrig.model import Calibration
from slrig.scan.artefacts import encode_mesh_ply
from slrig.scan.work import Holder
from slrig.sessions.acceptance import running as acceptance
from slrig.sessions.acceptance.desk import AcceptanceDesk, AcceptanceState
from slrig.sessions.acceptance.plan import AcceptancePlan
from tests.unit.sessions.acceptance.test_running import RIG, SHORT, TamePositioner, scan_of

PLAN = replace(SHORT, rendered=False)


class TameLender:
    """Lends a rig on the caller's own thread; `holder` is whom it is lent to meanwhile."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.facts: object = SimpleNamespace(calibration=rig.calibration)
        self.busy = False
        self.cancelled: Callable[[], bool] = lambda: False
        self.holders: list[str] = []

    def borrow(
        self,
        work: Callable[[Rig, Callable[[], bool]], None],
        *,
        holder: Holder,
        wait: bool,
        ended: Callable[[Exception | None], None],
        begun: Callable[[UUID], None],
    ) -> UUID:
        if self.busy and not wait:
            message = "The rig is held by scan 1."
            raise RigBusyError(message, holder="1", since="")
        loan = uuid4()
        begun(loan)
        self.holders.append(holder.name)
        try:
            work(self.rig, self.cancelled)
        except Exception as error:  # noqa: BLE001 - as the real one
            ended(error)
        else:
            ended(None)
        return loan

    def recall(self, loan: UUID) -> None:
        """Nothing is under way between two calls."""

    def status(self) -> Any:
        return SimpleNamespace(rig="tame", facts=self.facts, active=None)


@pytest.fixture
def lender() -> TameLender:
    positioner = TamePositioner(tuple(step.name for step in PLAN.steps))
    return TameLender(Rig("tame", {}, None, {}, RIG, positioner=positioner))  # type: ignore[arg-type]


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, lender: TameLender) -> AcceptanceDesk:
    monkeypatch.setattr(acceptance, "capture_bundle", lambda _rig, _plan, folder, **_: folder.mkdir())

    def reconstruct(bundle: Path, output: Path, /, **_: object) -> Mapping[str, Any]:
        name = bundle.parent.name.lstrip(".").rsplit("-", 1)[0]
        output.mkdir()
        step = next(step for step in PLAN.steps if step.name == name)
        (output / "mesh.ply").write_bytes(encode_mesh_ply(scan_of(step)))
        return {}

    return AcceptanceDesk(tmp_path / "acceptance", lender, reconstruct=reconstruct)


def the_plan(_: Calibration) -> AcceptancePlan:
    return PLAN


def test_by_hand_one_position_is_measured_at_a_time_with_its_repeats(desk: AcceptanceDesk, lender: TameLender) -> None:
    test = desk.open(the_plan)
    done = []
    while (record := desk.get(test.id)).state is AcceptanceState.OPEN:
        following = record.next_take
        assert following is not None
        assert following[1] == 0
        done.append(following[0].name)
        desk.measure(test.id, wait=False, scripted=False)
    assert done == ["sphere-1", "sphere-2", "bar-1", "plane-1"]
    assert lender.rig.positioner.moves == []  # type: ignore[union-attr]
    result = desk.get(test.id).result
    assert result is not None
    assert result.decision is Decision.PASSES
    assert desk.get(test.id).state is AcceptanceState.FINISHED
    assert desk.file(test.id, "report.html").is_file()
    assert set(lender.holders) == {f"acceptance test {test.id}"}
    with pytest.raises(ScanStateError, match="is finished"):
        desk.measure(test.id, wait=False, scripted=False)


def test_a_script_measures_all_that_are_left_in_one_loan(desk: AcceptanceDesk, lender: TameLender) -> None:
    test = desk.open(the_plan)
    desk.measure(test.id, wait=False, scripted=True)
    assert desk.get(test.id).state is AcceptanceState.FINISHED
    assert len(lender.holders) == 1
    assert lender.rig.positioner.moves == [0, 1, 2, 3]  # type: ignore[union-attr]
    assert desk.latest() == (desk.get(test.id),)


def test_a_position_that_went_wrong_may_be_measured_again(
    desk: AcceptanceDesk, monkeypatch: pytest.MonkeyPatch
) -> None:
    test = desk.open(the_plan)

    def lost(*_: object, **__: object) -> None:
        message = "nothing there"
        raise NothingToReconstructError(message)

    with monkeypatch.context() as patched:
        patched.setattr(acceptance, "reading", lost)
        desk.measure(test.id, wait=False, scripted=False)
    record = desk.get(test.id)
    assert record.state is AcceptanceState.OPEN
    assert isinstance(record.error, NothingToReconstructError)
    assert record.readings == ()
    desk.measure(test.id, wait=False, scripted=False)
    assert desk.get(test.id).error is None
    assert len(desk.get(test.id).readings) == PLAN.repeats


def test_a_cancelled_test_is_over(desk: AcceptanceDesk, lender: TameLender) -> None:
    waiting, running = desk.open(the_plan), desk.open(the_plan)
    assert desk.cancel(waiting.id).state is AcceptanceState.CANCELLED
    lender.cancelled = lambda: True
    desk.measure(running.id, wait=False, scripted=True)
    assert desk.get(running.id).state is AcceptanceState.CANCELLED
    with pytest.raises(ScanStateError, match="is cancelled"):
        desk.measure(running.id, wait=False, scripted=True)
    with pytest.raises(ArtefactNotReadyError, match="is cancelled"):
        desk.file(running.id, "report.json")


def test_a_held_rig_is_refused_and_the_test_stays_open(desk: AcceptanceDesk, lender: TameLender) -> None:
    test = desk.open(the_plan)
    lender.busy = True
    with pytest.raises(RigBusyError):
        desk.measure(test.id, wait=False, scripted=False)
    assert desk.get(test.id).state is AcceptanceState.OPEN


def test_what_cannot_be_tested_is_refused(desk: AcceptanceDesk, lender: TameLender) -> None:
    with pytest.raises(ScanNotFoundError, match="no acceptance test"):
        desk.get(uuid4())
    exact = desk.open(lambda _: replace(PLAN, rendered=True))
    desk.measure(exact.id, wait=False, scripted=True)
    assert isinstance(desk.get(exact.id).error, InvalidInputError)
    lender.rig.positioner.poses = ("sphere-1",)  # type: ignore[union-attr, misc]
    test = desk.open(the_plan)
    desk.measure(test.id, wait=False, scripted=True)
    assert isinstance(desk.get(test.id).error, UnsupportedByDeviceError)
    lender.facts = SimpleNamespace(calibration=None)
    with pytest.raises(CalibrationError, match="has no calibration"):
        desk.open(the_plan)
    lender.facts = None
    with pytest.raises(DeviceBusyError, match="being opened"):
        desk.open(the_plan)
