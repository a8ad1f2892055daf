"""Presets over HTTP: where they come from, which of them stands, what a scan makes of one, what is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle.scan_options import Preset, PresetDocument, ScanDefaults
from slrig.config import read_rig
from slrig.errors import ConfigError
from slrig.scan.presets import SHIPPED, Presets
from tests.unit.api.conftest import ServedBench

RUBBER = {"description": "rubber", "exposure_factors": [2.0, 8.0], "line_width_px": 2, "colour": False}


def document(**options: Any) -> dict[str, Any]:
    return {"format": "slrig-preset", "version": 1, "scan": options}


def sources(client: TestClient) -> dict[str, str]:
    return {each["name"]: each["source"] for each in client.get("/preset").json()["presets"]}


def test_one_that_is_put_takes_the_place_of_a_shipped_one_until_it_is_deleted(
    client: TestClient, served: ServedBench
) -> None:
    assert sources(client) == dict.fromkeys(SHIPPED, "shipped")
    shipped = client.get("/preset/dark").json()
    put = client.put("/preset/dark", json=document(**RUBBER))
    assert put.json() == client.get("/preset/dark").json() == document(**RUBBER)
    assert sources(client)["dark"] == "kept"
    kept = served.service.folder.root / "presets"
    assert [path.name for path in kept.iterdir()] == ["dark.json"]
    assert client.delete("/preset/dark").status_code == 204
    assert client.get("/preset/dark").json() == shipped
    refused = client.delete("/preset/dark")
    assert refused.status_code == 404
    assert "comes from slrig itself, and cannot be deleted" in refused.json()["detail"]


def test_what_one_service_tells_another_takes_as_it_is(client: TestClient) -> None:
    sent, headers = client.get("/preset/shiny").content, {"Content-Type": "application/json"}
    assert client.put("/preset/chrome", content=sent, headers=headers).status_code == 200
    told = {each["name"]: each for each in client.get("/preset").json()["presets"]}
    assert told["chrome"]["digest"] == told["shiny"]["digest"] != told["matt"]["digest"]
    assert client.delete("/preset/chrome").status_code == 204


@pytest.mark.parametrize(
    ("name", "sent", "words"),
    [
        (
            "dark",
            {**document(), "version": 2},
            "slrig reads version 1 of presets, found 2; bring slrig up to date",
        ),
        ("dark", {**document(), "format": "slrig-bundle"}, "slrig-preset"),
        ("dark", document(exposure_factor=[2.0]), "no such field"),
        ("dark", document(exposure_factors=[]), "2 to 6 exposure times, found 0"),
        (
            "dark",
            document(exposure_s=0.1, exposure_factors=[2.0]),
            "exposure_s or exposure_factors, found both",
        ),
        ("..%2Fdark", document(), "match pattern"),
    ],
)
def test_what_is_no_preset_is_refused_and_nothing_is_kept(
    client: TestClient, name: str, sent: dict[str, Any], words: str
) -> None:
    response = client.put(f"/preset/{name}", json=sent)
    assert response.status_code in {404, 422}
    assert words in response.text or response.status_code == 404
    assert set(sources(client).values()) == {"shipped"}


def test_a_file_of_another_version_is_told_and_hides_no_other(tmp_path: Path) -> None:
    (tmp_path / "dark.json").write_text(json.dumps({**document(), "version": 3}))
    presets = Presets(tmp_path, {})
    with pytest.raises(ConfigError, match=r"dark\.json is not a valid preset[^$]*found 3; bring slrig up to date"):
        presets.get("dark")
    assert presets.get("matt").scan == SHIPPED["matt"]
    (tmp_path / "By hand.json").write_text(json.dumps(document()))
    listed = {each.name: each for each in presets.listed()}
    assert set(listed) == set(SHIPPED)
    assert (listed["dark"].digest, listed["matt"].fault) == (None, None)
    assert "bring slrig up to date" in (listed["dark"].fault or "")
    presets.delete("dark")
    assert presets.get("dark").scan == SHIPPED["dark"]


def test_a_scan_takes_what_the_request_says_then_the_preset_then_the_rig_file(client: TestClient) -> None:
    client.put("/preset/rubber", json=document(**RUBBER, rows=True, depth_edge_ratio=9.0))
    # The rig file says 6 px.
    plan = client.post("/scan", json={"preset": "rubber", "patterns": {"rows": False}}).json()["plan"]
    patterns = plan["patterns"]
    assert (patterns["line_shift_period_px"], patterns["line_width_px"], patterns["rows"]) == (6, 2, False)
    assert (plan["exposure_factors"], plan["colour"]) == ([2.0, 8.0], False)
    assert plan["reconstruction"]["depth_edge_ratio"] == 9
    told = client.get("/preset").json()["presets"]
    digest = next(each["digest"] for each in told if each["name"] == "rubber")
    assert plan["preset"] == {"name": "rubber", "version": 1, "digest": digest}
    client.delete("/preset/rubber")
    missing = client.post("/scan", json={"preset": "rubber"})
    assert missing.status_code == 404
    assert "There are: dark, fast," in missing.json()["detail"]


def test_who_says_how_long_to_expose_says_all_of_it() -> None:
    bracket, factors = ScanDefaults(exposures_s=(0.01, 0.04)), PresetDocument(scan=Preset(exposure_factors=(4.0,)))
    by_preset = scan_plan(ScanRequest(preset="dark"), bracket, factors)
    assert (by_preset.exposures_s, by_preset.exposure_factors) == (None, (4.0,))
    by_request = scan_plan(ScanRequest(preset="dark", exposure_s=0.02), bracket, factors)
    assert (by_request.exposure_s, by_request.exposures_s, by_request.exposure_factors) == (0.02, None, None)
    silent = scan_plan(ScanRequest(preset="dark"), bracket, PresetDocument(scan=Preset(rows=True)))
    assert (silent.exposures_s, silent.exposure_factors) == ((0.01, 0.04), None)


def test_a_rig_file_may_hold_presets(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    rig = 'name = "bench"\n[head]\ndriver = "simulated"\n[scan]\nexposure_s = 0.02\n'
    path.write_text(f"{rig}[presets.dark]\nexposure_factors = [4]\n[presets.dark.region]\ndepth_mm = [1, 2]\n")
    of_rig = read_rig(path).presets
    presets = Presets(tmp_path / "presets", of_rig)
    assert presets.get("dark").scan.exposure_factors == (4.0,)
    assert [each.source for each in presets.listed() if each.name in {"dark", "matt"}] == ["rig", "shipped"]
    for wrong in ("[presets.Dark]\nrows = true", "[presets.dark]\nrow = true", "[presets]\ndark = 1"):
        path.write_text(rig + wrong)
        with pytest.raises(ConfigError):
            read_rig(path)
    for wrong in ("presets = 1", 'presets = ["dark"]'):
        path.write_text(f"{wrong}\n{rig}")
        with pytest.raises(ConfigError):
            read_rig(path)
