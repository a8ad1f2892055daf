"""What a request for a scan may say, what it means beside a preset and the rig file, and what is refused."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_type_hints
from uuid import UUID

import cv2
import numpy as np
import pytest
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from pydantic import BaseModel

from slrig.api.app import bare_app
from slrig.api.scans import ScanQuery
from slrig.api.schemas import ScanRequest, scan_plan
from slrig.bundle import Strict
from slrig.bundle.description import MAX_CAPTURE_BYTES
from slrig.bundle.options import Preset, PresetDocument, ScanDefaults
from slrig.config import read_rig
from slrig.devices import CameraInfo, ProjectorInfo, Trigger
from slrig.errors import ConfigError, UnsupportedByDeviceError
from slrig.model import CameraFormat, Region, Size
from slrig.rig.session import RigFacts
from slrig.scan.job import plan_from_json, plan_json
from slrig.scan.plan import SHIPPED, PatternPlan, Presets, ReconstructionPlan, ScanPlan, check_plan
from tests.unit.api.conftest import ServedBench, ended, refusal

RIG = 'name = "bench"\n[head]\ndriver = "simulated"\n[scan]\n'
BOX = [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]]
JSON = {"Content-Type": "application/json"}
RUBBER = {"description": "rubber", "exposure_factors": [2.0, 8.0], "line_width_px": 2, "colour": False}


def mask_of(width_px: int, height_px: int) -> str:
    picture = np.full((height_px, width_px), 255, dtype=np.uint8)
    return base64.b64encode(cv2.imencode(".png", picture)[1].tobytes()).decode()


def in_region(**options: Any) -> dict[str, Any]:
    return {"reconstruction": {"region": options}}


def planned(request: dict[str, Any], **defaults: Any) -> ScanPlan:
    """The plan of a request on a rig whose file says `defaults`."""
    return scan_plan(ScanRequest.model_validate(request), ScanDefaults(**defaults))


@pytest.mark.parametrize(
    ("body", "field", "words"),
    [
        ({"exposure_s": -1}, "exposure_s", ""),
        ({"exposure_s": 1e9}, "exposure_s", ""),
        ({"exposure_s": "0.1"}, "exposure_s", ""),
        ({"patterns": {"line_shift_period_px": 3}}, "patterns.line_shift_period_px", ""),
        ({"patterns": {"rows": 1}}, "patterns.rows", ""),
        ({"patterns": {"gray_cells": 4}}, "patterns.gray_cells", "did you mean 'gray_cell_px'?"),
        ({"labl": "a"}, "labl", "did you mean 'label'?"),
        ({"gray_cell_px": 4}, "gray_cell_px", "it belongs into 'patterns'"),
        ({"qwxz": 1}, "qwxz", "no such field here; check its spelling"),
        ({"reconstruction": {"max_code_gap": 0}}, "reconstruction.max_code_gap", ""),
        ({"reconstruction": {"keep_holes": "yes"}}, "reconstruction.keep_holes", ""),
        ({"reconstruction": {"flip_rule": "dyer"}}, "reconstruction.flip_rule", ""),
        ({"if_busy": "wait"}, "if_busy", ""),
        ({"label": ""}, "label", ""),
        ({"label": "x" * 201}, "label", ""),
        ({"label": "a\x1b[2J"}, "label", ""),
        ({"colour": "red"}, "colour", ""),
        ([], "body", ""),
        ({"exposures_s": [0.02]}, "exposures_s", "2 to 6 exposure times, found 1"),
        ({"exposures_s": [0.02, -1]}, "exposures_s.1", "greater than 0"),
        ({"exposures_s": [0.02, "0.08"]}, "exposures_s.1", "number"),
        ({"exposures_s": [0.02, 61]}, "exposures_s.1", "less than or equal to 60"),
        ({"exposures_s": 0.02}, "exposures_s", "valid"),
        ({"exposure_s": 0.02, "exposures_s": [0.02, 0.08]}, "exposures_s", "found both"),
        (in_region(box_mm=BOX[::-1]), "reconstruction.region", "x: expected two rising numbers"),
        (in_region(box_mm=[[0, 0], [1, 1]]), "reconstruction.region.box_mm.0.2", "required"),
        (in_region(min_contrast=2), "reconstruction.region.min_contrast", "less than 1"),
        (in_region(roi=1), "reconstruction.region.roi", "no such field"),
        ({"every_s": 5}, "every_s", "expected repeat above 1"),
        ({"repeat": 0}, "repeat", ""),
        ({"repeat": 501}, "repeat", ""),
        ({"repeat": 2, "every_s": -1}, "every_s", ""),
        ({"turn_deg": 1e9}, "turn_deg", ""),
        ({"turn_deg": 1, "turned_by": 2}, "turned_by", ""),
    ],
)
def test_bad_request_is_refused_with_its_field(client: TestClient, body: Any, field: str, words: str) -> None:
    response = client.post("/scan", json=body)
    assert (response.status_code, response.headers["content-type"]) == (422, "application/problem+json")
    problem = response.json()
    assert problem["type"] == "/problems/invalid-request"
    faults = {fault["field"]: fault["message"] for fault in problem["errors"]}
    assert faults[field]
    assert words in faults[field]
    if words != "required":
        assert len(faults) == 1
    assert client.get("/scan").json()["scans"] == []


ZERO = [0.0, 0.0, 0.0]
PLANE = {"kind": "plate", "point_mm": ZERO, "sigma_mm": 0.0, "radius_mm": 0.0, "margin_mm": 0.0}
TURNTABLE = {"format": "slrig-turntable", "version": 1}
IDS = [str(UUID(int=1)), str(UUID(int=2))]


IMMENSE = 1.7e308
AXIS = {"point_mm": ZERO, "direction": [0.0, 1.0, 0.0]}


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/scan", in_region(box_mm=[[-IMMENSE, -1.0, -1.0], [IMMENSE, 1.0, 1.0]])),
        ("POST", "/model", {"scans": IDS, "angles_deg": [0.0, -IMMENSE]}),
        ("POST", "/model", {"scans": IDS, "axis": {**AXIS, "direction": [IMMENSE] * 3}}),
        ("POST", "/model", {"scans": IDS, "poses": [[[IMMENSE] * 4] * 4] * 2}),
        ("PUT", "/rig/turntable", {**TURNTABLE, "planes": [{**PLANE, "normal": [IMMENSE, 0.0, 0.0]}]}),
        ("PUT", "/rig/turntable", {**TURNTABLE, "axis": {**AXIS, "covariance": [[10**61] * 6] * 6}}),
    ],
)
def test_number_whose_square_overflows_is_refused(client: TestClient, method: str, path: str, body: Any) -> None:
    told = client.request(method, path, json=body)
    assert told.status_code == 422
    words = " ".join(each["message"] for each in told.json()["errors"])
    assert "expected numbers of at most 1e+60" in words or "less than or equal to 1000000000" in words


def test_every_body_is_strict() -> None:
    hints = [get_type_hints(each.endpoint) for each in iter_route_contexts(bare_app().routes) if each.endpoint]
    named = [each for hint in hints for name, each in hint.items() if name != "return" and isinstance(each, type)]
    bodies = [each for each in named if issubclass(each, BaseModel)]
    assert len(bodies) >= 20
    # All values of a query are text.
    assert [each for each in bodies if not issubclass(each, Strict | ScanQuery)] == []


def test_every_fault_of_a_request_is_named(client: TestClient) -> None:
    problem = client.post("/scan", json={"exposure_s": 0, "if_busy": 1, "paint": "red"}).json()
    assert [fault["field"] for fault in problem["errors"]] == ["exposure_s", "if_busy", "paint"]


@pytest.mark.parametrize(
    ("content", "field", "words"),
    [
        ('{"exposure_s": NaN}', "exposure_s", ""),
        ('{"exposure_s": Infinity}', "exposure_s", ""),
        ('{"exposure_s": 1e999}', "exposure_s", ""),
        ('{"turn_deg": NaN}', "turn_deg", ""),
        ('{"label": }', "body", "is not JSON: Expecting value at character 10"),
        (r'{"label": "\ud800"}', "label", ""),
        (r'{"\udfff": "a"}', "body", ""),
    ],
)
def test_text_that_is_no_json_is_refused_with_its_place(
    client: TestClient, content: str, field: str, words: str
) -> None:
    response = client.post("/scan", content=content, headers=JSON)
    assert (response.status_code, response.headers["content-type"]) == (422, "application/problem+json")
    (fault,) = response.json()["errors"]
    assert fault["field"] == field
    assert words in fault["message"]
    if r"\ud" in content:
        # Half a surrogate pair cannot be written in UTF-8: the answer shows it escaped.
        assert fault["found"] in content


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""])
@pytest.mark.parametrize("content", ['{"label": "a"}', "", iter([b"{}"])])
def test_body_that_is_not_called_json_is_refused(client: TestClient, content: Any, kind: str) -> None:
    if not kind and content == "":
        pytest.skip("nothing is sent: no page can send that, either, without its Origin")
    response = client.post("/scan", content=content, headers={"Content-Type": kind} if kind else {})
    assert (response.status_code, response.headers["content-type"]) == (415, "application/problem+json")
    assert "expected application/json, found" in response.json()["detail"]


def test_pattern_that_the_projector_cannot_show_is_refused(client: TestClient) -> None:
    ended(client, client.post("/scan").json()["id"])  # what the rig can do is known once it is open
    assert refusal(client, "POST", "/scan", json={"patterns": {"gray_cell_px": 64}}) == (422, "/problems/pattern")


def test_plan_is_the_request_over_the_rig_file_over_the_default(client: TestClient) -> None:
    request = {
        "patterns": {"line_width_px": 2},
        "reconstruction": {"keep_holes": True, "flip_rule": "delaunay", "region": {"box_mm": BOX}},
        "exposures_s": [0.08, 0.02],
    }
    plan = client.post("/scan", json=request).json()["plan"]
    patterns = plan["patterns"]
    assert (patterns["line_width_px"], patterns["line_shift_period_px"], patterns["rows"]) == (2, 6, None)
    assert plan["reconstruction"].pop("region")["box_mm"] == BOX
    sines = client.post("/scan", json={"patterns": {"sequence": "phase", "sine_period_px": 16}, "if_busy": "queue"})
    patterns = sines.json()["plan"]["patterns"]
    # The rig file's period is that of lines.
    assert (patterns["sine_period_px"], patterns["sine_steps"], patterns["line_shift_period_px"]) == (16, None, None)
    mixed = {"patterns": {"sequence": "phase", "line_width_px": 2}}
    assert refusal(client, "POST", "/scan", json=mixed) == (422, "/problems/config")
    assert plan["reconstruction"] == {
        "keep_holes": True,
        "depth_edge_ratio": 6.0,
        "max_code_gap": 1,
        "flip_rule": "delaunay",
        "smooth_boundary": True,
        "axis": None,
        "drop_finest_bits": 0,
        "mesh_axes": "upright",
        "uncalibrated": None,
        "rig_in_base": None,
    }
    assert planned({"reconstruction": {"uncalibrated": {"focal_px": {"cam0": 900}}}}).patterns.rows
    # The rig file's exposure belongs to its cameras, not to the plan.
    assert (plan["exposures_s"], plan["exposure_s"]) == ([0.08, 0.02], None)
    assert (plan["turn_deg"], plan["turned_by"]) == (None, "table")
    usual: dict[str, Any] = {"exposures_s": (0.01, 0.04), "region": {"depth_mm": (100, 200)}}
    assert planned({}, **usual).exposures_s == (0.01, 0.04)
    assert planned({}, **usual).reconstruction.region == Region(depth_mm=(100, 200))
    assert planned({"exposures_s": (0.02, 0.2)}, **usual).exposures_s == (0.02, 0.2)
    one = planned({"exposure_s": 0.03}, **usual)
    assert (one.exposure_s, one.exposures_s) == (0.03, None)
    chosen = planned(in_region(min_contrast=0.1), **usual)
    assert chosen.reconstruction.region == Region(min_contrast=0.1)
    assert planned({}).reconstruction.region is None
    assert not planned({}).coloured_light
    assert planned({}, coloured_light=True).coloured_light
    assert planned({"coloured_light": True}, coloured_light=False).coloured_light
    assert not planned({"coloured_light": False}, coloured_light=True).coloured_light


def test_mask_may_be_longer_than_other_requests(client: TestClient) -> None:
    camera = client.get("/rig").json()["cameras"][0]
    noise = np.random.default_rng(3).integers(0, 256, camera["size_px"][::-1], dtype=np.uint8)
    mask = base64.b64encode(cv2.imencode(".png", noise)[1].tobytes()).decode()
    assert len(mask) > 4096  # the limit of other requests here
    answer = client.post("/scan", json=in_region(masks={camera["name"]: mask}))
    assert answer.status_code == 202, answer.text
    assert answer.json()["plan"]["reconstruction"]["region"]["masks"] == {camera["name"]: mask}


def test_plan_on_record_keeps_its_exposures_and_its_region() -> None:
    region = Region(
        box_mm=((-1, -2, -3), (1, 2, 3)), depth_mm=(100, 200), polygons_px={"left": ((0, 0), (9, 0), (9, 9))},
        masks={"right": mask_of(4, 3)}, min_contrast=0.1, max_sigma_mm=0.02,
    )  # fmt: skip
    plan = ScanPlan(exposures_s=(0.08, 0.005, 0.02), reconstruction=ReconstructionPlan(region=region))
    assert plan.rising_exposures_s == (0.005, 0.02, 0.08)
    assert plan_from_json(json.loads(json.dumps(plan_json(plan)))) == plan
    assert ScanPlan(exposure_s=0.02).rising_exposures_s == (0.02,)
    assert ScanPlan().rising_exposures_s == ()
    # As an earlier version recorded it.
    earlier = plan_json(ScanPlan(exposure_s=0.02))
    del earlier["exposures_s"], earlier["reconstruction"]["region"]
    assert plan_from_json(earlier) == ScanPlan(exposure_s=0.02)


@pytest.mark.parametrize(
    ("make", "options", "words"),
    [
        (ScanPlan, {"exposures_s": (0.01, 0.0101)}, "exposures_s: expected times that differ by 10% at least"),
        (ScanPlan, {"exposures_s": (0.01, 0.04), "exposure_s": 0.01}, "expected exposure_s or exposures_s, found both"),
        (PatternPlan, {"sequence": "phase", "line_width_px": 2}, "^line_width_px: the sequence phase plays sinusoids"),
        (PatternPlan, {"sequence": "phase", "gray_cell_px": 2}, "^gray_cell_px: .* use sine_period_px"),
        (PatternPlan, {"sequence": "phase", "line_shift": False, "inverses": True}, "^line_shift and inverses: "),
        (PatternPlan, {"sine_steps": 4}, r"^sine_steps: the sequence standard plays lines .* \(--sequence\) phase"),
        (Region, {"box_mm": ((1, 0, 0), (0, 1, 1))}, "box_mm: x: expected two rising numbers, found 1 and 0"),
        (Region, {"box_mm": ((0, 0, float("nan")), (1, 1, 1))}, "box_mm: z: expected two rising numbers"),
        (Region, {"depth_mm": (300, 300)}, "depth_mm: expected two rising numbers"),
        (Region, {"depth_mm": (-2, -1)}, "expected depths in front of the camera"),
        (Region, {"polygons_px": {"left": ((0, 0), (1, 1))}}, "polygons_px.left: expected three corners or more"),
        (Region, {"masks": {"left": "bm90IGEgUE5H"}}, "masks.left: expected a PNG"),
        (Region, {"masks": {"left": "not base64"}}, "masks.left: expected a PNG"),
        (Region, {"masks": {"left": "A" * 300_000}}, "at most 262144 characters, found 300000"),
        (Region, {"min_contrast": 1.0}, "min_contrast: expected a number above 0 and below 1"),
        (Region, {"max_sigma_mm": 0.0}, "max_sigma_mm: expected a number above 0, found 0"),
    ],
)
def test_plan_and_region_refuse_what_makes_no_sense(
    make: Callable[..., object], options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        make(**options)


SMALL = Size(200, 100)


def facts(size: Size = SMALL, bit_depth: int = 8) -> RigFacts:
    info = CameraInfo(
        "left", "", "", CameraFormat(size, bit_depth), frozenset({Trigger.SOFTWARE}), (0.001, 0.1), (1.0, 1.0)
    )
    projector = ProjectorInfo("projector", "", "", Size(128, 96), False, 0.0)
    return RigFacts({"left": info, "right": replace(info, name="right")}, projector, None)


def test_plan_takes_as_many_bytes_as_it_plays_frames() -> None:
    plain = facts()
    one = check_plan(ScanPlan(exposure_s=0.01), plain)
    assert one == check_plan(ScanPlan(), plain) == 2 * 16 * 200 * 100
    assert check_plan(ScanPlan(exposures_s=(0.01, 0.02, 0.04)), plain) == 3 * one
    assert check_plan(ScanPlan(exposures_s=(0.01, 0.02, 0.04)), facts(bit_depth=12)) == 6 * one
    lit = replace(plain, projector=replace(plain.projector, lights=True))
    assert check_plan(ScanPlan(coloured_light=True), lit) == one + 2 * 3 * 200 * 100
    assert check_plan(ScanPlan(), facts(Size(8192, 5000))) < MAX_CAPTURE_BYTES


BRACKET_S = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032)


@pytest.mark.parametrize(
    ("plan", "words"),
    [
        (ScanPlan(exposures_s=(0.01, 0.2)), r"exposures_s: 0\.2 s .*'left' can do 0\.001 s to 0\.1 s"),
        (ScanPlan(exposure_s=0.0002), r"exposure_s: 0\.0002 s .*'left' can do 0\.001 s to 0\.1 s"),
        (ScanPlan(coloured_light=True), "no lights of its own"),
        (ScanPlan(exposures_s=BRACKET_S), r"would take 7\.9 GB, a bundle holds 4\.3 GB.*fewer exposures"),
    ],
)
def test_plan_must_fit_the_devices(plan: ScanPlan, words: str) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=words):
        check_plan(plan, facts(Size(8192, 5000)))


def test_region_must_fit_the_cameras() -> None:
    def asked(**options: Any) -> ScanPlan:
        return ScanPlan(reconstruction=ReconstructionPlan(region=Region(**options)))

    assert check_plan(asked(masks={"left": mask_of(200, 100)}), facts()) > 0
    with pytest.raises(ConfigError, match=r"masks\.left: expected 200 x 100 pixels as the camera has, found 10 x 20"):
        check_plan(asked(masks={"left": mask_of(10, 20)}), facts())
    with pytest.raises(ConfigError, match=r"expected one of the cameras \['left', 'right'\], found 'middle'"):
        check_plan(asked(polygons_px={"middle": ((0, 0), (1, 0), (1, 1))}), facts())


def test_rig_file_may_hold_a_bracket_a_region_and_presets(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    (tmp_path / "left.png").write_bytes(base64.b64decode(mask_of(20, 10)))
    path.write_text(
        f'{RIG}exposures_s = [0.005, 0.02, 0.08]\n[scan.region.masks]\nleft = "left.png"\n'
        "[presets.dark]\nexposure_factors = [4]\n[presets.dark.region]\ndepth_mm = [1, 2]\n"
    )
    rig = read_rig(path)
    assert rig.scan.exposures_s == (0.005, 0.02, 0.08)
    plan = scan_plan(ScanRequest(), rig.scan)
    assert plan.reconstruction.region == Region(masks={"left": mask_of(20, 10)})
    presets = Presets(tmp_path / "presets", rig.presets)
    assert presets.get("dark").scan.exposure_factors == (4.0,)
    assert [each.source for each in presets.listed() if each.name in {"dark", "matt"}] == ["rig", "shipped"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (f"{RIG}exposures_s = [0.02]", r"scan\.exposures_s"),
        (f"{RIG}[scan.region]\ndepth_mm = [200, 100]", "depth_mm: expected two rising numbers, found 200 and 100"),
        (f"{RIG}[presets.Dark]\nrows = true", "Dark"),
        (f"{RIG}[presets.dark]\nrow = true", "row"),
        (f"{RIG}[presets]\ndark = 1", "dark"),
        (f"presets = 1\n{RIG}", "presets"),
    ],
)
def test_rig_file_that_asks_for_what_makes_no_sense_is_refused(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "rig.toml").write_text(text)
    with pytest.raises(ConfigError, match=words):
        read_rig(tmp_path / "rig.toml")


def document(**options: Any) -> dict[str, Any]:
    return {"format": "slrig-preset", "version": 1, "scan": options}


def presets_of(client: TestClient) -> dict[str, dict[str, Any]]:
    return {each["name"]: each for each in client.get("/preset").json()["presets"]}


def sources(client: TestClient) -> dict[str, str]:
    return {name: each["source"] for name, each in presets_of(client).items()}


def test_preset_replaces_a_shipped_one_until_it_is_deleted(client: TestClient, served: ServedBench) -> None:
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
    # What one service answers, another takes as it is.
    sent = client.get("/preset/shiny").content
    assert client.put("/preset/chrome", content=sent, headers=JSON).status_code == 200
    found = presets_of(client)
    assert found["chrome"]["digest"] == found["shiny"]["digest"] != found["matt"]["digest"]
    assert client.delete("/preset/chrome").status_code == 204


@pytest.mark.parametrize(
    ("name", "sent", "words"),
    [
        ("dark", {**document(), "version": 2}, "reads version 1 of presets, found 2; update slrig"),
        ("dark", {**document(), "format": "slrig-bundle"}, "slrig-preset"),
        ("dark", document(exposure_factor=[2.0]), "no such field"),
        ("dark", document(exposure_factors=[]), "2 to 6 exposure times, found 0"),
        ("dark", document(exposure_s=0.1, exposure_factors=[2.0]), "exposure_s or exposure_factors, found both"),
        ("..%2Fdark", document(), ""),
    ],
)
def test_document_that_is_no_preset_is_refused(client: TestClient, name: str, sent: dict[str, Any], words: str) -> None:
    response = client.put(f"/preset/{name}", json=sent)
    assert response.status_code in ({422} if words else {404, 422})
    assert words in response.text
    assert set(sources(client).values()) == {"shipped"}


def test_preset_file_of_another_version_hides_no_other(tmp_path: Path) -> None:
    (tmp_path / "dark.json").write_text(json.dumps({**document(), "version": 3}))
    presets = Presets(tmp_path, {})
    with pytest.raises(ConfigError, match=r"dark\.json is not a valid preset[^$]*found 3; update slrig"):
        presets.get("dark")
    assert presets.get("matt").scan == SHIPPED["matt"]
    (tmp_path / "By hand.json").write_text(json.dumps(document()))
    listed = {each.name: each for each in presets.listed()}
    assert set(listed) == set(SHIPPED)
    assert (listed["dark"].digest, listed["matt"].fault) == (None, None)
    assert "update slrig" in (listed["dark"].fault or "")
    presets.delete("dark")
    assert presets.get("dark").scan == SHIPPED["dark"]


def test_plan_is_the_request_over_the_preset_over_the_rig_file(client: TestClient) -> None:
    client.put("/preset/rubber", json=document(**RUBBER, rows=True, depth_edge_ratio=9.0))
    # The rig file says 6 px.
    plan = client.post("/scan", json={"preset": "rubber", "patterns": {"rows": False}}).json()["plan"]
    patterns = plan["patterns"]
    assert (patterns["line_shift_period_px"], patterns["line_width_px"], patterns["rows"]) == (6, 2, False)
    assert (plan["exposure_factors"], plan["colour"]) == ([2.0, 8.0], False)
    assert plan["reconstruction"]["depth_edge_ratio"] == 9
    assert plan["preset"] == {"name": "rubber", "version": 1, "digest": presets_of(client)["rubber"]["digest"]}
    client.delete("/preset/rubber")
    missing = client.post("/scan", json={"preset": "rubber"})
    assert missing.status_code == 404
    assert "There are: dark, fast," in missing.json()["detail"]
    # Whichever says how long to expose says all of it.
    bracket, factors = ScanDefaults(exposures_s=(0.01, 0.04)), PresetDocument(scan=Preset(exposure_factors=(4.0,)))
    by_preset = scan_plan(ScanRequest(preset="dark"), bracket, factors)
    assert (by_preset.exposures_s, by_preset.exposure_factors) == (None, (4.0,))
    by_request = scan_plan(ScanRequest(preset="dark", exposure_s=0.02), bracket, factors)
    assert (by_request.exposure_s, by_request.exposures_s, by_request.exposure_factors) == (0.02, None, None)
    silent = scan_plan(ScanRequest(preset="dark"), bracket, PresetDocument(scan=Preset(rows=True)))
    assert (silent.exposures_s, silent.exposure_factors) == ((0.01, 0.04), None)
