"""The light engine's driver on a real hidraw node: the engine is a HID device of a guest's kernel (uhid). One boot."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from slrig.conformance import CHECKS, Check, Outcome
from slrig.conformance.check import Need
from tests.contract.dlpc350_bench import CHECKS as ON_A_NODE
from tests.contract.guest.machine import FILES, Module, require_guest, run_in_guest
from tests.contract.suite import COLOUR

pytestmark = pytest.mark.realtime

TIMEOUT_S = 420.0


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    require_guest()
    finished = run_in_guest(
        [sys.executable, "-m", "tests.contract.dlpc350_bench", f"{FILES}/told.json"],
        folder=tmp_path_factory.mktemp("guest"),
        modules=[Module("hid-generic"), Module("uhid")],
        timeout_s=TIMEOUT_S,
    )
    assert finished.exit_code == 0, finished.output[-4000:]
    found: dict[str, Any] = json.loads((finished.files / "told.json").read_text())
    sys.stdout.write(f"the guest ran {finished.total_s:.0f} s\n")
    return found


@pytest.mark.parametrize("check", CHECKS, ids=[check.name for check in CHECKS])
def test_contract_on_a_node(told: dict[str, Any], check: Check) -> None:
    result = next(each for each in told["contract"]["checks"] if each["name"] == check.name)
    sys.stdout.write(f"{result['seconds']:.2f} s\n")
    # The camera of the bench is mono, and triggered, by wire or by software.
    asks_nothing = not {Need.FREE, Need.POSITIONER}.isdisjoint(check.needs) or check.name == COLOUR
    assert result["outcome"] == (Outcome.NOT_APPLICABLE if asks_nothing else Outcome.PASSED), json.dumps(
        result["failure"], indent=1
    )


def test_the_engine_conforms(told: dict[str, Any]) -> None:
    assert told["contract"]["conforms"]
    assert told["contract"]["score"] == 1


@pytest.mark.parametrize("check", [check.__name__ for check in ON_A_NODE])
def test_on_a_node(told: dict[str, Any], check: str) -> None:
    outcome = told[check]
    sys.stdout.write(f"{outcome['seconds']} s, {outcome['notes']}\n")
    assert outcome["fault"] is None, outcome["fault"]
