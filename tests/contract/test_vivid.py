"""The drivers v4l2 and opencv on a real kernel: vivid in a guest, its output looped to its camera. One boot."""

from __future__ import annotations

from typing import Any

import pytest

from slrig.conformance import CHECKS, Check
from slrig.conformance.bench import Need
from tests.contract.guest.outcome import require_passed, require_sound, told_by
from tests.contract.guest.vivid import modules
from tests.contract.guest.vivid_checks import ALL
from tests.contract.suite import COLOUR
from tests.contract.vivid_bench import DRIVERS

pytestmark = pytest.mark.realtime

LACKING = {Need.SOFTWARE, Need.HARDWARE, Need.PLAYS, Need.POSITIONER}
"""What a V4L2 camera does not have."""
EXPOSURES = "a_longer_exposure_is_brighter"
"""The one check that asks for exposure control, which vivid does not have."""


@pytest.fixture(scope="session")
def told(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder = tmp_path_factory.mktemp("guest")
    return told_by("tests.contract.guest.vivid_checks", folder=folder, modules=modules(), timeout_s=540.0)


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_contract_on_vivid(told: dict[str, Any], driver: str, check: Check) -> None:
    require_passed(told[f"contract of {driver}"], check, lacking=LACKING, asks_nothing={EXPOSURES, COLOUR})


@pytest.mark.parametrize("check", ALL)
def test_vivid(told: dict[str, Any], check: str) -> None:
    require_sound(told[check])
