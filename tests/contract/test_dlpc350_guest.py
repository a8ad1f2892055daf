"""The light engine's driver on a real hidraw node: the engine is a HID device of a guest's kernel (uhid). One boot."""

from __future__ import annotations

from typing import Any

import pytest

from slrig.conformance import CHECKS, Check
from slrig.conformance.bench import Need
from tests.contract.dlpc350_bench import CHECKS as ON_A_NODE
from tests.contract.guest.machine import Module
from tests.contract.guest.outcome import require_passed, require_sound, told_by
from tests.contract.suite import COLOUR

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    modules = [Module("hid-generic"), Module("uhid")]
    folder = tmp_path_factory.mktemp("guest")
    return told_by("tests.contract.dlpc350_bench", folder=folder, modules=modules, timeout_s=420.0)


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract_on_a_node(told: dict[str, Any], check: Check) -> None:
    # The camera of the bench is mono, and triggered, by wire or by software.
    require_passed(told["contract"], check, lacking={Need.FREE, Need.POSITIONER}, asks_nothing={COLOUR})


@pytest.mark.parametrize("check", [check.__name__ for check in ON_A_NODE])
def test_on_a_node(told: dict[str, Any], check: str) -> None:
    require_sound(told[check])
