"""A bracket as it is asked for: in a request, a rig file, on the command line; what is refused before it begins."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle.description import MOST_CAPTURE_BYTES
from slrig.bundle.scan_options import ScanDefaults
from slrig.cli import scan as scan_module
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.devices import CameraInfo, ProjectorInfo, Trigger
from slrig.errors import ConfigError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Size
from slrig.rig.session import RigFacts
from slrig.scan.plan import ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.records import plan_from_json, plan_json

RIG = """
name = "bench"
[head]
driver = "simulated"
[scan]
"""


def test_a_plan_keeps_its_exposures_and_plays_them_from_short_to_long() -> None:
    plan = ScanPlan(exposures_s=(0.08, 0.005, 0.02))
    assert plan.rising_exposures_s == (0.005, 0.02, 0.08)
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    assert ScanPlan(exposure_s=0.02).rising_exposures_s == (0.02,)
    assert ScanPlan().rising_exposures_s == ()
    earlier = plan_json(ScanPlan(exposure_s=0.02))
    del earlier["exposures_s"]
    assert plan_from_json(earlier) == ScanPlan(exposure_s=0.02)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"exposures_s": (0.01,)}, "exposures_s: expected 2 to 6 exposure times, found 1"),
        ({"exposures_s": (0.01, 0.0101)}, "exposures_s: expected times that differ by 10% at least"),
        ({"exposures_s": (0.01, 0.04), "exposure_s": 0.01}, "expected exposure_s or exposures_s, found both"),
    ],
)
def test_a_plan_refuses_what_is_no_bracket(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        ScanPlan(**options)


def test_a_request_comes_before_the_rig_file(client: TestClient) -> None:
    plan = client.post("/scan", json={"exposures_s": [0.08, 0.02]}).json()["plan"]
    assert (plan["exposures_s"], plan["exposure_s"]) == ([0.08, 0.02], None)
    usual = ScanDefaults(exposures_s=(0.01, 0.04))
    assert scan_plan(ScanRequest(), usual).exposures_s == (0.01, 0.04)
    assert scan_plan(ScanRequest(exposures_s=(0.02, 0.2)), usual).exposures_s == (0.02, 0.2)
    one = scan_plan(ScanRequest(exposure_s=0.03), usual)
    assert (one.exposure_s, one.exposures_s) == (0.03, None)


@pytest.mark.parametrize(
    ("request_body", "field", "words"),
    [
        ({"exposures_s": [0.02]}, "exposures_s", "2 to 6 exposure times, found 1"),
        ({"exposures_s": [0.01 * 2**step for step in range(7)]}, "exposures_s", "2 to 6 exposure times, found 7"),
        ({"exposures_s": [0.02, -1]}, "exposures_s.1", "greater than 0"),
        ({"exposures_s": [0.02, "0.08"]}, "exposures_s.1", "number"),
        ({"exposures_s": [0.02, 61]}, "exposures_s.1", "less than or equal to 60"),
        ({"exposures_s": [0.02, 0.0201]}, "exposures_s", "differ by 10%"),
        ({"exposures_s": 0.02}, "exposures_s", "valid"),
        ({"exposure_s": 0.02, "exposures_s": [0.02, 0.08]}, "exposures_s", "found both"),
    ],
)
def test_a_request_for_no_bracket_is_refused(client: TestClient, request_body: Any, field: str, words: str) -> None:
    response = client.post("/scan", json=request_body)
    assert response.status_code == 422
    (fault,) = response.json()["errors"]
    assert fault["field"] == field
    assert words in fault["message"]


def test_a_rig_file_may_ask_for_a_bracket(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG + "exposures_s = [0.005, 0.02, 0.08]\n")
    assert read_rig(path).scan.exposures_s == (0.005, 0.02, 0.08)
    for text in ("exposures_s = [0.02]", "exposures_s = [0.02, 0.02]", "exposures_s = [0.02, 0]", "exposures_s = 0.1"):
        path.write_text(RIG + text)
        with pytest.raises(ConfigError, match=r"scan\.exposures_s"):
            read_rig(path)


@pytest.mark.parametrize(
    ("arguments", "asked"),
    [
        ([], {}),
        (["--exposure-s", "0.02"], {"exposure_s": 0.02}),
        (["--exposure-s", "0.02", "--exposure-s", "0.08"], {"exposures_s": [0.02, 0.08]}),
    ],
)
def test_the_command_asks_for_one_exposure_or_for_a_bracket(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: list[str], asked: dict[str, Any]
) -> None:
    requests: list[dict[str, Any]] = []

    def scan_with(_client: object, request: dict[str, Any], *_: object, **__: object) -> dict[str, Any]:
        requests.append(request)
        return {"summary": None}

    monkeypatch.setattr(scan_module, "scan_with", scan_with)
    monkeypatch.setenv("SLRIG_KEY", "key")
    result = CliRunner().invoke(app, ["scan", "--output", str(tmp_path), *arguments])
    assert result.exit_code == 0, result.output
    (request,) = requests
    assert {name: request[name] for name in request if name.startswith("exposure")} == asked


SMALL = Size(200, 100)


def test_coloured_light_is_asked_for_by_request_rig_file_or_not_at_all() -> None:
    def asked(request: dict[str, Any], **defaults: Any) -> bool:
        return scan_plan(ScanRequest.model_validate(request), ScanDefaults(**defaults)).coloured_light

    assert not asked({})
    assert asked({}, coloured_light=True)
    assert asked({"coloured_light": True}, coloured_light=False)
    assert not asked({"coloured_light": False}, coloured_light=True)


def test_coloured_light_takes_three_frames_of_a_projector_that_has_lights() -> None:
    plan, plain = ScanPlan(coloured_light=True), facts()
    with pytest.raises(UnsupportedByDeviceError, match="no lights of its own"):
        check_plan(plan, plain)
    lit = replace(plain, projector=replace(plain.projector, lights=True))
    assert check_plan(plan, lit) == check_plan(ScanPlan(), plain) + 2 * 3 * 200 * 100


def facts(size: Size = SMALL, bit_depth: int = 8) -> RigFacts:
    info = CameraInfo(
        "left", "", "", CameraFormat(size, bit_depth), frozenset({Trigger.SOFTWARE}), (0.001, 0.1), (1.0, 1.0)
    )
    projector = ProjectorInfo("projector", "", "", Size(128, 96), False, 0.0)
    return RigFacts({"left": info, "right": replace(info, name="right")}, projector, None)


def test_a_bracket_takes_as_many_bytes_as_it_has_exposures() -> None:
    one = check_plan(ScanPlan(exposure_s=0.01), facts())
    assert one == check_plan(ScanPlan(), facts()) == 2 * 22 * 200 * 100
    assert check_plan(ScanPlan(exposures_s=(0.01, 0.02, 0.04)), facts()) == 3 * one
    assert check_plan(ScanPlan(exposures_s=(0.01, 0.02, 0.04)), facts(bit_depth=12)) == 6 * one


def test_every_exposure_must_be_one_that_every_camera_can_do() -> None:
    with pytest.raises(UnsupportedByDeviceError, match=r"exposures_s: 0\.2 s .*'left' can do 0\.001 s to 0\.1 s"):
        check_plan(ScanPlan(exposures_s=(0.01, 0.2)), facts())
    with pytest.raises(UnsupportedByDeviceError, match=r"exposure_s: 0\.0002 s .*'left' can do 0\.001 s to 0\.1 s"):
        check_plan(ScanPlan(exposure_s=0.0002), facts())


def test_more_frames_than_a_bundle_holds_are_refused_before_they_are_taken() -> None:
    large = facts(Size(8192, 5000))
    assert check_plan(ScanPlan(), large) < MOST_CAPTURE_BYTES
    with pytest.raises(UnsupportedByDeviceError, match=r"would take 10\.8 GB, a bundle holds 4\.3 GB.*fewer exposures"):
        check_plan(ScanPlan(exposures_s=(0.001, 0.002, 0.004, 0.008, 0.016, 0.032)), large)
