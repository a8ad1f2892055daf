"""The driver kms in a guest with two graphics cards, against what QEMU scans out of them. One boot."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from slrig.conformance import CHECKS as CONTRACT
from slrig.conformance import Check, Outcome
from slrig.conformance.check import Need
from tests.contract.guest.machine import FILES, Module, require_guest, run_in_guest
from tests.contract.kms_bench import CHECKS, DEVICES
from tests.contract.suite import COLOUR

pytestmark = pytest.mark.realtime

TIMEOUT_S = 540.0
LACKING = {Need.FREE, Need.HARDWARE, Need.PLAYS, Need.POSITIONER}
"""What a screen, and the camera that photographs it, do not have."""


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    require_guest()
    folder = tmp_path_factory.mktemp("guest")
    finished = run_in_guest(
        [sys.executable, "-m", "tests.contract.kms_bench", f"{FILES}/told.json", str(folder / "share")],
        folder=folder,
        modules=[Module("virtio-gpu")],
        devices=DEVICES,
        monitor=True,
        timeout_s=TIMEOUT_S,
    )
    assert finished.exit_code == 0, finished.output[-4000:]
    found: dict[str, Any] = json.loads((finished.files / "told.json").read_text())
    sys.stdout.write(f"the guest ran {finished.total_s:.0f} s\n")
    return found


@pytest.mark.parametrize("check", [check.__name__ for check in CHECKS])
def test_on_a_guests_cards(told: dict[str, Any], check: str) -> None:
    outcome = told[check]
    sys.stdout.write(f"{outcome['seconds']} s, {outcome['notes']}\n")
    assert outcome["fault"] is None, outcome["fault"]


@pytest.mark.parametrize("check", CONTRACT, ids=[check.name for check in CONTRACT])
def test_contract_on_a_guests_card(told: dict[str, Any], check: Check) -> None:
    result = next(each for each in told["contract"]["checks"] if each["name"] == check.name)
    sys.stdout.write(f"{result['seconds']:.2f} s\n")
    asks_nothing = not LACKING.isdisjoint(check.needs) or check.name == COLOUR
    expected = Outcome.NOT_APPLICABLE if asks_nothing else Outcome.PASSED
    assert result["outcome"] == expected, json.dumps(result["failure"], indent=1)
