"""A projector behind a scaler, which blurs the pattern's values before its gamma makes light of them: POST /scan."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import Start
from tests.e2e.test_survival import ended

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).parents[2] / "config"

# The values of a bit with runs of two pixels go from 0.22 to 0.78; with gamma 2.2 it and its inverse add up to 0.6.
SCALER = "gamma = 2.2\nsignal_blur_px = 0.65"
PLANS: dict[str, dict[str, Any]] = {
    "Gray only": {"patterns": {"line_shift": False}},
    "lines": {"patterns": {"line_width_px": 3}},
}


def scanned(start: Start, folder: Path, projector: str) -> dict[str, dict[str, Any]]:
    """The reports of scans of the rendered plane with another projector, by the names of `PLANS`."""
    folder.mkdir()
    rig = folder / "rig.toml"
    text = (CONFIG / "rigs" / "plane.toml").read_text().replace("../scenes", str(CONFIG / "scenes"))
    assert text.count("gamma = 1.8") == 1
    rig.write_text(text.replace("gamma = 1.8", projector))
    service = start(rig, folder / "data")
    reports: dict[str, dict[str, Any]] = {}
    with service.client() as client:
        for name, plan in PLANS.items():
            record = ended(client, client.scans.start(**plan))
            assert record["state"] == "succeeded", record["error"]
            reports[name] = json.loads((folder / "data" / "scans" / record["id"] / "report.json").read_text())
    assert service.stop() == 0
    return reports


def test_a_scan_behind_a_scaler_succeeds_and_nothing_is_shot_again(start: Start, tmp_path: Path) -> None:
    both = scanned(start, tmp_path / "straight", "gamma = 2.2"), scanned(start, tmp_path / "scaled", SCALER)
    for name in PLANS:
        straight, scaled = (each[name] for each in both)
        assert scaled["evidence"]["shot_again"] == 0, name
        assert scaled["evidence"]["contradictions"] == [], name
        assert scaled["evidence"]["patterns_verified"] == straight["evidence"]["patterns_verified"], name
        for report in (straight, scaled):
            assert 0.8 <= report["truth"]["error_over_sigma_p68"] <= 1.25, name
        assert scaled["truth"]["complete_0.3mm"] >= straight["truth"]["complete_0.3mm"] - 0.005, name
        # With cells of 1 px it is 1.28 times: half of the edges are the finest bit's, whose slope is 0.55 of what it
        # was.
        assert scaled["truth"]["rms_mm"] <= 1.2 * straight["truth"]["rms_mm"], name
