"""Health over seeds of its own: `SLRIG_HEALTH_SEED=9000 pytest -m slow tests/bench/test_health_seeds.py -s`.

Rigs, calibrations and looks at the board are made up as in the tests of `slrig.calibration.health`, from seeds that no
threshold was ever chosen by: choose another SLRIG_HEALTH_SEED (9000) after a change of the method. Every rig is off by
a draw of its own calibration's covariance. SLRIG_HEALTH_RIGS (12) rigs have each change planted, about an axis drawn at
random where it has one; 200 clean captures are judged as the service judges them, by all looks before; 6 rigs are
warmed up. A line per rig; figures at the end, which go into health-*.json of the folder SLRIG_BENCH_OUT as well.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
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
CLEAN_RIGS, CLEAN_CAPTURES = 4, 50
WARM_RIGS, WARM_CAPTURES = 6, 60
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


def written(name: str, rows: list[dict[str, Any]], summary: dict[str, Any]) -> None:
    """Print a table's figures, and keep them where asked."""
    print(name, json.dumps(summary, indent=1))  # noqa: T201
    target = os.environ.get("SLRIG_BENCH_OUT")
    if target:
        Path(target).mkdir(parents=True, exist_ok=True)
        text = json.dumps({"seed": SEED, "summary": summary, "rows": rows}, indent=1)
        (Path(target) / f"health-{name}-{SEED}.json").write_text(text + "\n", encoding="utf-8")


@pytest.mark.parametrize("cameras", [1, 2])
def test_planted_changes_are_stale_named_and_foretold(cameras: int) -> None:
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
    written(f"planted-{cameras}", rows, summary)
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


def test_no_alarm_on_clean_captures() -> None:
    rows: list[dict[str, Any]] = []
    for number in range(CLEAN_RIGS):
        rig = bench(SEED + 100 + number, cameras=1 + number % 2)
        verifications: list[Verification] = []
        for capture in range(CLEAN_CAPTURES):
            seed = 100 * SEED + CLEAN_CAPTURES * number + capture
            verifications.append(verify_by_board([look_of(rig.devices, seed)], BOARD, rig.calibration))
            health = judged(verifications)
            rows.append({"rig": number, "capture": capture, "state": str(health.state), "reasons": health.reasons})
            if health.state is not HealthState.GOOD:
                print(rows[-1], flush=True)  # noqa: T201
        print(f"clean rig {number}: {len(verifications)} captures", flush=True)  # noqa: T201
    alarms = [each for each in rows if each["state"] != HealthState.GOOD]
    written("clean", alarms, {"captures": len(rows), "alarms": len(alarms)})
    assert not alarms


def test_a_warm_up_is_watched_before_the_error_doubles() -> None:
    rows: list[dict[str, Any]] = []
    for number in range(WARM_RIGS):
        rig = bench(SEED + 200 + number, known_px=0.05)
        verifications: list[Verification] = []
        alarm, doubled, before_mm, late = None, None, 0.0, 0
        for capture in range(WARM_CAPTURES):
            share = 1.6 * (1 - np.exp(-capture / 60))
            lamp = zoomed(turned(rig.devices[PROJECTOR], (0.001 * share, 0.006 * share, 0)), 1e-4 * share)
            now = {**rig.devices, PROJECTOR: lamp}
            seed = 200 * SEED + WARM_CAPTURES * number + capture
            verifications.append(verify_by_board([look_of(now, seed)], BOARD, rig.calibration))
            state, error_mm = judged(verifications).state, true_error_mm(now, rig.calibration)
            before_mm = before_mm or max(error_mm, float(verifications[0].stated_mm or 0))
            if state is not HealthState.GOOD and alarm is None:
                alarm = capture
            if error_mm > 2 * before_mm and doubled is None:
                doubled = capture
            late += doubled is not None and state is HealthState.GOOD
        rows.append({"seed": SEED + 200 + number, "alarm": alarm, "doubled": doubled, "good_after": late})
        print("warm-up", rows[-1], flush=True)  # noqa: T201
    in_time = [
        each["alarm"] is not None and (each["doubled"] is None or each["alarm"] < each["doubled"]) for each in rows
    ]
    written("warm-up", rows, {"rigs": len(rows), "watched_in_time": sum(in_time)})
    assert all(in_time)
    assert not [each for each in rows if each["good_after"]]
