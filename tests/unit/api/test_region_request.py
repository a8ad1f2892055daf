"""A region as it is asked for: in a request, a rig file, a file of its own; and what is refused before it begins."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle.region_file import read_region
from slrig.bundle.scan_options import ScanDefaults
from slrig.cli import scan as scan_module
from slrig.cli.commands import app
from slrig.config import read_rig
from slrig.devices import CameraInfo, ProjectorInfo, Trigger
from slrig.errors import ConfigError
from slrig.model import CameraFormat, Region, Size
from slrig.rig.session import RigFacts
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.plan_check import check_plan
from slrig.scan.records import plan_from_json, plan_json

RIG = """
name = "bench"
[head]
driver = "simulated"
"""
BOX = [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]


def mask_of(width_px: int, height_px: int) -> str:
    """A mask as a request has it."""
    picture = np.full((height_px, width_px), 255, dtype=np.uint8)
    return base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()


def test_a_plan_keeps_its_region() -> None:
    region = Region(
        box_mm=((-1, -2, -3), (1, 2, 3)), depth_mm=(100, 200), polygons_px={"left": ((0, 0), (9, 0), (9, 9))},
        masks={"right": mask_of(4, 3)}, least_contrast=0.1, most_sigma_mm=0.02,
    )  # fmt: skip
    plan = ScanPlan(reconstruction=ReconstructionPlan(region=region))
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    earlier = plan_json(ScanPlan())
    del earlier["reconstruction"]["region"]
    assert plan_from_json(earlier) == ScanPlan()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"box_mm": ((1, 0, 0), (0, 1, 1))}, "box_mm: x: expected two rising numbers, found 1 and 0"),
        ({"box_mm": ((0, 0, float("nan")), (1, 1, 1))}, "box_mm: z: expected two rising numbers"),
        ({"depth_mm": (300, 300)}, "depth_mm: expected two rising numbers"),
        ({"depth_mm": (-2, -1)}, "expected depths before the camera"),
        ({"polygons_px": {"left": ((0, 0), (1, 1))}}, "polygons_px.left: expected three corners or more"),
        ({"masks": {"left": "bm90IGEgUE5H"}}, "masks.left: expected a PNG"),
        ({"masks": {"left": "not base64"}}, "masks.left: expected a PNG"),
        ({"masks": {"left": "A" * 300_000}}, "at most 262144 characters, found 300000"),
        ({"least_contrast": 1.0}, "least_contrast: expected a number above 0 and below 1"),
        ({"most_sigma_mm": 0.0}, "most_sigma_mm: expected a number above 0, found 0"),
    ],
)
def test_what_limits_to_nothing_is_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        Region(**options)


def test_a_request_comes_before_the_rig_file(client: TestClient, tmp_path: Path) -> None:
    answer = client.post("/scan", json={"reconstruction": {"region": {"box_mm": BOX}}})
    assert answer.json()["plan"]["reconstruction"]["region"]["box_mm"] == BOX
    path = tmp_path / "rig.toml"
    path.write_text(RIG + "[scan.region]\ndepth_mm = [100, 200.5]\n")
    usual = read_rig(path).scan
    assert scan_plan(ScanRequest(), usual).reconstruction.region == Region(depth_mm=(100, 200.5))
    request = ScanRequest.model_validate({"reconstruction": {"region": {"least_contrast": 0.1}}})
    assert scan_plan(request, usual).reconstruction.region == Region(least_contrast=0.1)
    assert scan_plan(ScanRequest(), ScanDefaults()).reconstruction.region is None
    (tmp_path / "left.png").write_bytes(base64.b64decode(mask_of(20, 10)))
    path.write_text(RIG + '[scan.region.masks]\nleft = "left.png"\n')
    assert scan_plan(ScanRequest(), read_rig(path).scan).reconstruction.region == Region(
        masks={"left": mask_of(20, 10)}
    )
    path.write_text(RIG + "[scan.region]\ndepth_mm = [200, 100]\n")
    with pytest.raises(ConfigError, match=r"depth_mm: expected two rising numbers, found 200 and 100"):
        read_rig(path)


@pytest.mark.parametrize(
    ("region", "field", "words"),
    [
        ({"box_mm": [BOX[1], BOX[0]]}, "reconstruction.region", "x: expected two rising numbers"),
        ({"box_mm": [[0, 0], [1, 1]]}, "reconstruction.region.box_mm.0.2", "required"),
        ({"masks": {"left": "A"}}, "reconstruction.region", "masks.left: expected a PNG"),
        ({"polygons_px": {"left": [[0, 0], [1, 1]]}}, "reconstruction.region", "three corners or more"),
        ({"least_contrast": 2}, "reconstruction.region.least_contrast", "less than 1"),
        ({"roi": 1}, "reconstruction.region.roi", "no such field"),
    ],
)
def test_a_request_for_no_region_is_refused(client: TestClient, region: Any, field: str, words: str) -> None:
    response = client.post("/scan", json={"reconstruction": {"region": region}})
    assert response.status_code == 422
    faults = {each["field"]: each["message"] for each in response.json()["errors"]}
    assert words in faults[field]


def test_a_mask_may_be_longer_than_requests_usually_are(client: TestClient) -> None:
    camera = client.get("/rig").json()["cameras"][0]
    noise = np.random.default_rng(3).integers(0, 256, camera["size_px"][::-1], dtype=np.uint8)
    mask = base64.b64encode(cv2.imencode(".png", noise)[1].tobytes()).decode()
    assert len(mask) > 4096  # the limit of other requests here
    answer = client.post("/scan", json={"reconstruction": {"region": {"masks": {camera["name"]: mask}}}})
    assert answer.status_code == 202, answer.text
    assert answer.json()["plan"]["reconstruction"]["region"]["masks"] == {camera["name"]: mask}


def test_a_region_must_fit_the_rig() -> None:
    info = CameraInfo(
        "left", "", "", CameraFormat(Size(20, 10), 8), frozenset({Trigger.SOFTWARE}), (0.001, 0.1), (1.0, 1.0)
    )
    facts = RigFacts({"left": info}, ProjectorInfo("projector", "", "", Size(128, 96), False, 0.0), None)

    def asked(**options: Any) -> ScanPlan:
        return ScanPlan(reconstruction=ReconstructionPlan(region=Region(**options)))

    assert check_plan(asked(masks={"left": mask_of(20, 10)}), facts) > 0
    with pytest.raises(ConfigError, match=r"masks\.left: expected 20 x 10 pixels as the camera has, found 10 x 20"):
        check_plan(asked(masks={"left": mask_of(10, 20)}), facts)
    with pytest.raises(ConfigError, match=r"names camera 'middle'; there are \['left'\]"):
        check_plan(asked(polygons_px={"middle": ((0, 0), (1, 0), (1, 1))}), facts)


def test_the_commands_read_a_region_from_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    requests: list[dict[str, Any]] = []

    def scan_with(_client: object, request: dict[str, Any], *_: object, **__: object) -> dict[str, Any]:
        requests.append(request)
        return {"summary": None}

    monkeypatch.setattr(scan_module, "scan_with", scan_with)
    path = tmp_path / "part.toml"
    path.write_text('depth_mm = [100, 200]\n[masks]\nleft = "left.png"\n')
    (tmp_path / "left.png").write_bytes(base64.b64decode(mask_of(20, 10)))
    scan = ["scan", "--output", str(tmp_path / "out"), "--region", str(path)]
    result = CliRunner().invoke(app, scan)
    assert result.exit_code == 0, result.output
    asked = {"depth_mm": [100, 200], "masks": {"left": mask_of(20, 10)}}
    assert requests[0]["reconstruction"] == {"region": asked}
    assert read_region(path).region() == Region(depth_mm=(100, 200), masks={"left": mask_of(20, 10)})
    (tmp_path / "left.png").unlink()
    result = CliRunner().invoke(app, scan)
    assert result.exit_code == 2
    assert "left.png: expected a mask as PNG, found: No such file or directory" in " ".join(result.output.split())
    path.write_text("depth = [100, 200]\n")
    result = CliRunner().invoke(
        app, ["reconstruct", str(tmp_path), "--output", str(tmp_path / "out"), "--region", str(path)]
    )
    assert result.exit_code == 2
    assert "did you mean 'depth_mm'?" in " ".join(result.output.split())
