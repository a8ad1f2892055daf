"""The drivers v4l2 and opencv on a real kernel: vivid in a guest, its output looped to its camera. One boot."""

from __future__ import annotations

import json
import sys
from typing import Any

import pytest

from slrig.conformance import CHECKS, Check, Outcome
from slrig.conformance.check import Need
from tests.contract.guest.machine import FILES, require_guest, run_in_guest
from tests.contract.guest.vivid import modules
from tests.contract.guest.vivid_checks import ALL
from tests.contract.suite import COLOUR
from tests.contract.vivid_bench import DRIVERS

pytestmark = pytest.mark.realtime

TIMEOUT_S = 540.0
LACKING = {Need.SOFTWARE, Need.HARDWARE, Need.PLAYS, Need.POSITIONER}
"""What a V4L2 camera does not have."""
EXPOSURES = "a_longer_exposure_is_brighter"
"""The one check that asks for exposure control, which vivid does not have."""


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    require_guest()
    command = [sys.executable, "-m", "tests.contract.guest.vivid_checks", f"{FILES}/told.json"]
    finished = run_in_guest(command, folder=tmp_path_factory.mktemp("guest"), modules=modules(), timeout_s=TIMEOUT_S)
    assert finished.exit_code == 0, finished.output[-4000:]
    found: dict[str, Any] = json.loads((finished.files / "told.json").read_text())
    sys.stdout.write(f"the guest ran {finished.total_s:.0f} s\n")
    return found


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("check", CHECKS, ids=[check.name for check in CHECKS])
def test_contract_on_vivid(told: dict[str, Any], driver: str, check: Check) -> None:
    result = next(each for each in told[f"contract of {driver}"]["checks"] if each["name"] == check.name)
    sys.stdout.write(f"{result['seconds']:.2f} s\n")
    asks_nothing = not LACKING.isdisjoint(check.needs) or check.name in {EXPOSURES, COLOUR}
    assert result["outcome"] == (Outcome.NOT_APPLICABLE if asks_nothing else Outcome.PASSED), result


@pytest.mark.parametrize("driver", DRIVERS)
def test_vivid_conforms(told: dict[str, Any], driver: str) -> None:
    assert told[f"contract of {driver}"]["conforms"]
    assert told[f"contract of {driver}"]["score"] == 1


@pytest.mark.parametrize("check", ALL)
def test_vivid(told: dict[str, Any], check: str) -> None:
    outcome = told[check]
    sys.stdout.write(f"{outcome['seconds']} s, {outcome['notes']}\n")
    assert outcome["fault"] is None, outcome["fault"]
