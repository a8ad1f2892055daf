"""Health over seeds of its own: `SLRIG_HEALTH_SEED=9000 pytest -m slow tests/bench/test_health_seeds.py -s`.

Rigs, calibrations and looks at the board are made up as in the tests of `slrig.calibration.health`, from seeds that no
threshold was ever chosen by: choose another SLRIG_HEALTH_SEED (9000) after a change of the method. Every rig is off by
a draw of its own calibration's covariance. SLRIG_HEALTH_RIGS (12) rigs have each change planted, about an axis drawn at
random where it has one. A line per rig, figures at the end. Clean captures and warm-ups of as many seeds:
`SLRIG_HEALTH_RIGS=6 SLRIG_CLEAN_CAPTURES=200 pytest -m slow tests/unit/calibration/health`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from slrig.calibration.health.verdict import HealthState, judged
from slrig.calibration.health.verification import Verification
from slrig.calibration.health.verifying import verify_by_board
from slrig.calibration.solution import PROJECTOR
from slrig.model import Pinhole
from tests.unit.calibration.health.drifting import (
    BOARD,
    bench,
    further_apart,
    look_of,
    true_error_mm,
    turned,
    zoomed,
)

pytestmark = pytest.mark.slow

SEED = int(os.environ.get("SLRIG_HEALTH_SEED") or 9000)
RIGS = int(os.environ.get("SLRIG_HEALTH_RIGS") or 12)
GOAL_ERROR_SHARE = 0.3
MOST_BEYOND_SHARE = 0.1
"""Of the looks that leave open what changed, so many may miss the goal; none of the others."""

ALIKE = 9.0
CHANGES = ("camera turned", "projector turned", "baseline", "focal")


def planted(devices: Mapping[str, Pinhole], change: str, rng: np.random.Generator) -> tuple[Mapping[str, Pinhole], str]:
    """The rig after a change, and the device that changed."""
    if change == "baseline":
        return further_apart(devices, 0.1), PROJECTOR
    name = PROJECTOR if change == "projector turned" or (change == "focal" and rng.random() < 0.5) else "left"
    if change == "focal":
        return {**devices, name: zoomed(devices[name], 5e-4)}, name
    axis = rng.normal(size=3)
    x, y, z = 0.05 * axis / np.linalg.norm(axis)
    return {**devices, name: turned(devices[name], (float(x), float(y), float(z)))}, name


def told(found: Verification, device: str) -> str:
    """Whether the right device was named: "named", "open" (it is among those that cannot be told apart), "wrong"."""
    if not found.drifts:
        return "nothing"
    likely = {each.device for each in found.drifts if each.evidence > found.evidence - ALIKE}
    if found.open is not None:
        return "open" if device in likely else "wrong"
    return "named" if found.drifts[0].device == device else "wrong"


@pytest.mark.parametrize("cameras", [1, 2])
def test_planted_changes_make_stale_are_named_and_predict_their_error(cameras: int) -> None:
    rows: list[dict[str, Any]] = []
    for change in CHANGES:
        for number in range(RIGS):
            seed = SEED + number
            rng = np.random.default_rng((seed, CHANGES.index(change)))
            rig = bench(seed, cameras=cameras)
            now, device = planted(rig.devices, change, rng)
            found = verify_by_board([look_of(now, seed + 50_000)], BOARD, rig.calibration)
            true_mm = true_error_mm(now, rig.calibration)
            rows.append(
                {
                    "change": change,
                    "seed": seed,
                    "state": str(judged([found]).state),
                    "device": told(found, device),
                    "expected_mm": found.expected_mm,
                    "true_mm": true_mm,
                    "before_mm": true_error_mm(rig.devices, rig.calibration),
                    "stated_mm": found.stated_mm,
                    "ratio": (found.expected_mm or 0) / true_mm,
                    "evidence": found.evidence,
                }
            )
            print(cameras, {k: round(v, 4) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)  # noqa: T201
    summary = {}
    for change in CHANGES:
        of = [each for each in rows if each["change"] == change]
        ratios = [each["ratio"] for each in of]
        summary[change] = {
            "looks": len(of),
            "stale": sum(each["state"] == HealthState.STALE for each in of),
            "device": {
                what: sum(each["device"] == what for each in of) for what in ("named", "open", "wrong", "nothing")
            },
            "expected_over_true": [round(float(each), 3) for each in np.quantile(ratios, [0, 0.5, 1])],
            "within_30_percent": sum(abs(each - 1) <= GOAL_ERROR_SHARE for each in ratios),
        }
    print(json.dumps(summary, indent=1))  # noqa: T201
    assert not [each for each in rows if each["state"] != HealthState.STALE]
    assert not [each for each in rows if each["device"] in ("wrong", "nothing")]
    beyond = [each for each in rows if abs(each["ratio"] - 1) > GOAL_ERROR_SHARE]
    # Where the geometry leaves open what changed, a few looks miss the goal. One camera foretells the error of a
    # baseline 0.1 mm longer with a deviation of 5 % from look to look, and of 10 % from rig to rig: the calibration's
    # own error, a draw that no look tells, moves the truth by as much; and a turn that matters twice as much is now and
    # then about as likely. 13 of 204 such looks were beyond 30 % (seeds 9000 to 9011, 13000 to 13059, 31000 to 31011,
    # one look each; 41000 to 41039, three each), most of them too high.
    assert not [each for each in beyond if each["device"] == "named"]
    assert len(beyond) <= MOST_BEYOND_SHARE * len([each for each in rows if each["device"] == "open"])
    for change in CHANGES:
        assert abs(float(np.median([each["ratio"] for each in rows if each["change"] == change])) - 1) < 0.15
