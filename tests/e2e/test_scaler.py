"""A projector behind a scaler, which blurs the pattern's values before its gamma makes light of them: POST /scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx2
import pytest

from tests.e2e.conftest import KEY, Start

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).parents[2] / "config"

# The values of a bit with runs of two pixels go from 0.22 to 0.78; with gamma 2.2 it and its inverse add up to 0.6.
SCALER = "gamma = 2.2\nsignal_blur_px = 0.65"
PLANS = {
    "Gray only": {"patterns": {"line_shift": False}},
    "lines": {"patterns": {"line_width_px": 3}},
}


def scanned(start: Start, folder: Path, plan: dict[str, Any], projector: str) -> dict[str, Any]:
    """The report of a scan of the rendered plane with another projector."""
    folder.mkdir()
    rig = folder / "rig.toml"
    text = (CONFIG / "rigs" / "plane.toml").read_text().replace("../scenes", str(CONFIG / "scenes"))
    assert text.count("gamma = 1.8") == 1
    rig.write_text(text.replace("gamma = 1.8", projector))
    service = start(rig, folder / "data")
    with service.client() as client:
        scan = client.start(plan)
        with httpx2.stream(
            "GET", f"{service.url}/scan/{scan['id']}/events", headers={"Authorization": f"Bearer {KEY}"}, timeout=120
        ) as events:
            for _ in events.iter_lines():
                pass
        record = client.get(scan["links"]["self"])
    assert record["state"] == "succeeded", record["error"]
    assert service.stop() == 0
    report: dict[str, Any] = json.loads((folder / "data" / "scans" / scan["id"] / "report.json").read_text())
    return report


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_a_scan_behind_a_scaler_succeeds_and_nothing_is_shot_again(
    start: Start, tmp_path: Path, plan: dict[str, Any]
) -> None:
    straight = scanned(start, tmp_path / "straight", plan, "gamma = 2.2")
    scaled = scanned(start, tmp_path / "scaled", plan, SCALER)
    assert scaled["evidence"]["shot_again"] == 0
    assert scaled["evidence"]["contradictions"] == []
    assert scaled["evidence"]["patterns_verified"] == straight["evidence"]["patterns_verified"]
    for report in (straight, scaled):
        assert 0.8 <= report["truth"]["error_over_sigma_p68"] <= 1.25
    assert scaled["truth"]["complete_0.3mm"] >= straight["truth"]["complete_0.3mm"] - 0.005
    # With cells of 1 px it is 1.28 times: half of the edges are the finest bit's, whose slope is 0.55 of what it was.
    assert scaled["truth"]["rms_mm"] <= 1.2 * straight["truth"]["rms_mm"]
