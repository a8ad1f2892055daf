"""The driver kms in a guest with two graphics cards, against what QEMU scans out of them. One boot."""

from __future__ import annotations

from typing import Any

import pytest

from slrig.conformance import CHECKS as CONTRACT
from slrig.conformance import Check
from slrig.conformance.bench import Need
from tests.contract.guest.machine import Module
from tests.contract.guest.outcome import require_passed, require_sound, told_by
from tests.contract.kms_bench import CHECKS, DEVICES
from tests.contract.suite import COLOUR

pytestmark = pytest.mark.realtime

LACKING = {Need.FREE, Need.HARDWARE, Need.PLAYS, Need.POSITIONER}
"""What a screen, and the camera that photographs it, do not have."""


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("guest")
    machine = {"modules": [Module("virtio-gpu")], "devices": DEVICES, "monitor": True, "timeout_s": 540.0}
    return told_by("tests.contract.kms_bench", str(folder / "share"), folder=folder, **machine)


@pytest.mark.parametrize("check", [check.__name__ for check in CHECKS])
def test_on_a_guests_cards(told: dict[str, Any], check: str) -> None:
    require_sound(told[check])


@pytest.mark.parametrize("check", CONTRACT, ids=lambda check: check.name)
def test_contract_on_a_guests_card(told: dict[str, Any], check: Check) -> None:
    require_passed(told["contract"], check, lacking=LACKING, asks_nothing={COLOUR})
