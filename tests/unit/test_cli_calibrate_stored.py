"""`slrig calibrate list`, `show`, `compare`, `activate`, `export`, `import`: the calibrations that a service keeps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import httpx2
import pytest

from slrig.api.calibration_schemas import ComparisonBody
from slrig.bundle import write_calibration, write_opencv_calibration
from slrig.cli.options import Service
from slrig.client import Client
from tests.unit.calibrate.solved import solved_result
from tests.unit.calibrate_command import refused, run
from tests.unit.calibration_desk import ID, Desk

OTHER = "77777777-9f0e-4c57-8a39-5f8a4f0c2b11"
BOARD_OPTIONS = ["--board", "chessboard", "--corners", "11x8", "--square-mm", "12"]


@pytest.fixture
def kept(monkeypatch: pytest.MonkeyPatch) -> list[httpx2.Request]:
    """A service that keeps two calibrations; what it was asked."""
    asked: list[httpx2.Request] = []
    desk = Desk()
    desk.state = "solved"
    first: Mapping[str, Any] = desk.session()
    second = {**first, "id": OTHER, "active": True, "links": {**first["links"], "self": f"/calibration/{OTHER}"}}
    difference = {"value": -0.02, "sigma": 0.011, "sigmas": 1.8, "words": "shorter"}
    unknown = {"value": 0.5, "sigma": None, "sigmas": None, "words": "farther"}
    compared = {
        "first": ID,
        "second": OTHER,
        "devices": {
            "left": {
                "focal_percent": difference,
                "principal_px": difference,
                "rotation_deg": None,
                "baseline_mm": None,
            },
            "projector": {
                "focal_percent": difference,
                "principal_px": unknown,
                "rotation_deg": difference,
                "baseline_mm": unknown,
            },
        },
        "missing": [],
        "moved_rms_mm": 0.01,
        "moved_most_mm": 0.03,
        "turn_deg": 0.002,
        "shift_mm": 0.1,
        "words": ["points move by 0.010 mm rms, 0.030 mm at most"],
    }
    ComparisonBody.model_validate(compared)

    def answer(request: httpx2.Request) -> httpx2.Response:
        asked.append(request)
        path = request.url.path
        if path == "/calibration/compare":
            return httpx2.Response(200, json=compared)
        if path == "/calibration":
            return httpx2.Response(200, json={"calibrations": [first, second], "active": OTHER})
        if path.endswith("/calibration.json"):
            return httpx2.Response(200, content=b"{}")
        if path == "/calibration/import":
            return httpx2.Response(201, json=first)
        return httpx2.Response(200, json=first)

    monkeypatch.setattr(
        Service,
        "client",
        lambda _self: Client("http://127.0.0.1:1", "key", transport=httpx2.MockTransport(answer)),
    )
    return asked


def test_list_names_the_calibration_in_use(kept: list[httpx2.Request]) -> None:
    result = run("list")
    assert result.exit_code == 0, result.output
    rows = result.stdout.splitlines()
    assert [row.split()[0] for row in rows] == ["id", ID[:8], OTHER[:8]]
    assert ["in use" in row for row in rows] == [False, False, True]
    assert json.loads(run("list", "--json").stdout)["active"] == OTHER
    assert len(kept) == 2


def test_show_tells_the_result(kept: list[httpx2.Request]) -> None:
    result = run("show", ID[:4])
    assert result.exit_code == 0, result.output
    assert "1810.40 ± 0.21" in result.stdout
    assert json.loads(run("show", ID, "--json").stdout)["id"] == ID
    assert kept[1].url.path == f"/calibration/{ID}"


def test_check_tells_what_the_solve_kept_of_its_halves(kept: list[httpx2.Request]) -> None:
    result = run("check", ID[:4])
    assert result.exit_code == 0, result.output
    told = " ".join(result.stdout.split())
    for words in ("differ by 0.017 mm at a point, 0.89 × what is stated", "10 odd, 9 even", "0.0193 mm (1 σ)"):
        assert words in told
    assert kept[-1].method == "GET"
    found = json.loads(run("check", ID, "--json").stdout)
    assert found["odd_even"]["ratio"] == pytest.approx(0.0171 / 0.0193)
    assert found["expected"]["point_mm"] > 0


def test_check_says_why_there_is_none(kept: list[httpx2.Request], monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Client.get
    lacking: dict[str, Any] = {"result": None}

    def get(client: Client, path: str) -> Any:
        found = whole.__get__(client, Client)(path)
        return {**found, **lacking} if path.endswith(ID) else found

    monkeypatch.setattr(Client, "get", get)
    assert "has no solve to check: it is solved" in run("check", ID).stderr
    lacking |= {"state": "solved", "imported": True}
    assert "it is imported, without its poses" in run("check", ID).stderr
    # A result on record from before solves were halved.
    lacking["result"] = {"poses": ["pose 1"] * 7, "verdict": {}}
    assert "expected 8 poses or more" in refused(run("check", ID))
    assert len(kept) == 6


def test_compare_tells_differences_in_their_deviations(kept: list[httpx2.Request]) -> None:
    result = run("compare", ID[:4], OTHER[:4])
    assert result.exit_code == 0, result.output
    assert dict(kept[-1].url.params) == {"first": ID, "second": OTHER}
    words = " ".join(result.stdout.split())
    assert "points move by 0.010 mm rms, 0.030 mm at most" in words
    assert "-0.0200 ± 0.0110 (1.8 σ)" in words
    assert "+0.5000" in words


def test_activate_and_deactivate_ask_the_service(kept: list[httpx2.Request]) -> None:
    for command in ("activate", "deactivate"):
        assert run(command, OTHER[:4]).exit_code == 0
        assert kept[-1].url.path == f"/calibration/{OTHER}/{command}"
        assert kept[-1].method == "POST"


def test_export_writes_the_file_that_the_ending_names(kept: list[httpx2.Request], tmp_path: Path) -> None:
    assert run("export", ID, tmp_path / "rig.json").exit_code == 0
    assert (tmp_path / "rig.json").read_bytes() == b"{}"
    assert kept[-1].url.path == f"/calibration/{ID}/calibration.json"
    assert "expected a name that ends in .json" in refused(run("export", ID, tmp_path / "rig.txt"))
    assert "has no report.html. It has: calibration.json" in refused(run("export", ID, tmp_path / "report.html"))
    assert [path.name for path in tmp_path.iterdir()] == ["rig.json"]


def test_import_sends_a_calibration_of_any_form(kept: list[httpx2.Request], tmp_path: Path) -> None:
    calibration = solved_result().calibration
    write_calibration(tmp_path / "rig.json", calibration)
    result = run("import", tmp_path / "rig.json", "--label", "from the shop & back")
    assert result.exit_code == 0, result.output
    assert dict(kept[-1].url.params) == {"label": "from the shop & back"}
    assert json.loads(kept[-1].content) == json.loads((tmp_path / "rig.json").read_text())
    write_opencv_calibration(tmp_path / "rig.yml", calibration)
    assert run("import", tmp_path / "rig.yml").exit_code == 0
    assert json.loads(kept[-1].content)["cameras"]["left"]["matrix"][0][0] == 1810.4
    (tmp_path / "bad.json").write_text('{"format": "slrig-calibration"}')
    assert "bad.json" in refused(run("import", tmp_path / "bad.json"))


def test_commands_that_need_a_service_say_how_to_start_one() -> None:
    for arguments in (["list"], ["show", "1"], ["compare", "1", "2"], ["activate", "1"], ["run", *BOARD_OPTIONS]):
        assert "slrig serve RIG" in refused(run(*arguments, "--url", "http://127.0.0.1:9"))
