"""/calibration over HTTP: what the routes add to a session (tests/unit/calibrate), and its files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from fastapi.testclient import TestClient

from slrig.bundle.calibration import write_calibration
from slrig.calibration.board import DEFAULT_BOARD, Board, BoardKind
from slrig.calibration.printing import board_pdf
from slrig.errors import SolveRefusedError
from slrig.model import Size
from slrig.scan.plan import pattern_sequence
from tests.unit.api.conftest import ServedBench, ended, refusal
from tests.unit.api.test_scans import events_of
from tests.unit.calibrate.calibration_bench import PNG
from tests.unit.scan.fakes import WAIT_S, tame_calibration

BOARD = {"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}
JSON = {"Content-Type": "application/json"}
STATE = (409, "/problems/calibration-state")


@pytest.fixture
def calibrating(client: TestClient, served: ServedBench) -> Iterator[TestClient]:
    """A client; afterwards no calibration is in use, and none is left."""
    yield client
    served.gate.set()
    served.tame.solving.set()
    served.tame.refusals, served.tame.solve_error = (), None
    found = client.get("/calibration").json()
    if found["active"]:
        client.post(f"/calibration/{found['active']}/deactivate")
    for each in found["calibrations"]:
        settled(client, each["id"])
        assert client.delete(f"/calibration/{each['id']}").status_code == 204


def settled(client: TestClient, calibration: str) -> dict[str, Any]:
    client.get(f"/calibration/{calibration}/events")
    found: dict[str, Any] = client.get(f"/calibration/{calibration}").json()
    return found


def opened(client: TestClient, **request: object) -> dict[str, Any]:
    made: dict[str, Any] = client.post("/calibration", json={"board": BOARD, **request}).json()
    return made


def shot(client: TestClient, calibration: str) -> dict[str, Any]:
    pose = client.post(f"/calibration/{calibration}/pose").json()
    settled(client, calibration)
    found: dict[str, Any] = client.get(pose["links"]["self"]).json()
    return found


def test_calibration_is_opened_shot_solved_and_used(calibrating: TestClient, served: ServedBench) -> None:
    client = calibrating
    answer = client.post("/calibration", json={"board": BOARD, "label": "spring", "patterns": {"line_width_px": 2}})
    made = answer.json()
    here = made["links"]["self"]
    assert (answer.status_code, answer.headers["Location"]) == (201, here)
    assert (made["state"], made["label"], made["poses"]) == ("open", "spring", 0)
    named = {"marker_mm": None, "dictionary": None, "square_sigma": 0.001, "aspect": 1.0}
    scales = {"rulers_mm": [50, 40], "measured": False}
    assert made["board"] == {**BOARD, **named, **scales, "title": "chessboard 4x3, 10 mm"}
    # Both axes, and each bit with its inverse, unless the request says otherwise; the rest as the rig file says.
    assert made["patterns"]["rows"] is True
    assert made["patterns"]["sequence"] == "robust"
    assert (made["patterns"]["line_width_px"], made["patterns"]["line_shift_period_px"]) == (2, 6)
    # Poses are read by code, also on a rig that scans by sinusoids.
    assert refusal(client, "POST", "/calibration", json={"patterns": {"sequence": "phase"}}) == (
        422,
        "/problems/config",
    )
    assert refusal(client, "GET", f"{here}/coverage.png")[0] == 409
    quiet = client.get(made["links"]["events"])
    assert (quiet.status_code, quiet.content) == (204, b"")

    key = {"Idempotency-Key": "pose one"}
    accepted = client.post(made["links"]["pose"], headers=key)
    pose = accepted.json()
    assert (accepted.status_code, accepted.headers["Location"]) == (202, pose["links"]["self"])
    assert (pose["number"], pose["state"]) == (1, "queued")
    events = events_of(client.get(pose["links"]["events"]).text)
    states = [event["state"] for event in events if event["kind"] == "pose"]
    assert states == ["queued", "capturing", "computing", "succeeded"]
    assert [(event["pose"], event["state"]) for event in events if event["kind"] == "captured"] == [(1, "capturing")]
    again = {"Last-Event-ID": str(events[1]["id"])}
    assert events_of(client.get(made["links"]["events"], headers=again).text) == events[2:]
    assert client.get(here).json()["last_event"] == events[-1]["id"]
    over = {"Last-Event-ID": str(events[-1]["id"])}
    assert client.get(made["links"]["events"], headers=over).status_code == 204
    # A request that is sent twice shoots once, and gets its first answer.
    repeated = client.post(made["links"]["pose"], headers=key)
    assert (repeated.status_code, repeated.headers["Location"]) == (202, pose["links"]["self"])
    assert (repeated.json()["number"], repeated.json()["state"]) == (1, "queued")
    other = {"headers": key, "json": {"exposure_s": 0.02}}
    assert refusal(client, "POST", made["links"]["pose"], **other) == (422, "/problems/idempotency")
    pose = client.get(pose["links"]["self"]).json()
    assert (pose["state"], pose["accepted"]) == ("succeeded", True)
    assert (pose["answer"], pose["error"]) == ({"corners_found": {"cam0": 12}}, None)
    picture = client.get(pose["links"]["pictures"]["cam0"])
    assert (picture.headers["content-type"], picture.content) == ("image/png", PNG)
    found = client.get(here).json()
    assert len(found["shot"]) == 1
    assert found["next_move"] == {"words": "tilt it", "enough": False}
    assert set(found["links"]["coverage"]) == {"cam0", "projector"}
    assert client.get(found["links"]["coverage"]["projector"]).content == b"projector 1"

    solving = client.post(made["links"]["solve"])
    assert (solving.status_code, solving.json()["state"]) == (202, "solving")
    done = settled(client, made["id"])
    assert served.tame.board_shapes[-1] == "auto"
    assert client.post(made["links"]["solve"], json={"board_shape": "round"}).status_code == 422
    assert (done["state"], done["verdict"], done["result"]["verdict"]["grade"]) == ("solved", "good", "good")
    assert set(done["links"]["files"]) == {"calibration.json", "calibration.yml", "calibration.xml", "report.html"}
    for name, path in done["links"]["files"].items():
        assert client.get(path).status_code == 200, name
    assert client.get(done["links"]["files"]["calibration.json"]).json()["solved"]["id"] == made["id"]
    assert "default-src 'none'" in client.get(done["links"]["files"]["report.html"]).headers["Content-Security-Policy"]

    assert client.get("/rig").json()["calibration"]["source"] == "rig"
    assert client.post(made["links"]["activate"]).json()["active"] is True
    used = client.get("/rig").json()["calibration"]
    assert (used["source"], used["id"], used["expected_error_mm"], used["error"]) == ("session", made["id"], 0.02, None)
    assert used["age_s"] > 0
    listed = client.get("/calibration").json()
    assert (listed["active"], [each["active"] for each in listed["calibrations"]]) == (made["id"], [True])
    assert refusal(client, "DELETE", here) == STATE
    client.post(made["links"]["solve"], json={"board_shape": "bowed"})
    settled(client, made["id"])
    assert served.tame.board_shapes[-1] == "bowed"


@pytest.mark.parametrize("request_body", [None, {}, {"label": "spring"}], ids=str)
def test_board_is_the_usual_one_unless_it_is_named(
    calibrating: TestClient, request_body: dict[str, Any] | None
) -> None:
    answer = calibrating.post("/calibration", json=request_body)
    assert answer.status_code == 201, answer.text
    assert answer.json()["board"] == {
        "kind": "charuco",
        "corners": [11, 8],
        "square_mm": 12.0,
        "marker_mm": 9.0,
        "dictionary": "DICT_5X5_250",
        "square_sigma": 0.001,
        "aspect": 1.0,
        "rulers_mm": [140, 100],
        "measured": False,
        "title": "charuco 11x8, 12 mm",
    }


def test_cameras_may_be_calibrated_without_the_projector(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating, projector=False)
    assert made["patterns"]["codes"] is False
    assert shot(calibrating, made["id"])["accepted"] is True
    assert set(calibrating.get(made["links"]["self"]).json()["links"]["coverage"]) == {"cam0"}
    _, plan, _ = served.captured[-1]
    assert {str(each.kind) for each in pattern_sequence(plan.patterns, Size(64, 40)).patterns} == {"white", "black"}


def test_refused_pose_keeps_its_cause_and_its_picture(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    served.tame.refusals = ("no camera sees the board: move it into the picture.",)
    pose = shot(calibrating, made["id"])
    assert (pose["state"], pose["accepted"]) == ("failed", False)
    assert pose["error"]["type"] == "/problems/pose-refused"
    assert "move it into the picture" in pose["error"]["detail"]
    assert calibrating.get(pose["links"]["pictures"]["cam0"]).content == PNG
    assert calibrating.get(f"/calibration/{made['id']}").json()["poses"] == 0
    assert refusal(calibrating, "POST", made["links"]["solve"]) == (422, "/problems/solve-refused")


def test_pose_holds_the_rig_until_it_is_cancelled(calibrating: TestClient, served: ServedBench) -> None:
    client, made = calibrating, opened(calibrating)
    served.began.clear()
    served.gate.clear()
    pose = client.post(made["links"]["pose"]).json()
    assert served.began.wait(WAIT_S)
    assert client.get("/rig").json()["holder"] == f"calibration {made['id']}, pose 1"
    assert refusal(client, "DELETE", pose["links"]["self"]) == STATE
    assert refusal(client, "GET", f"{pose['links']['self']}/picture.png")[0] == 409
    assert refusal(client, "POST", made["links"]["pose"]) == (409, "/problems/rig-busy")
    assert client.post(made["links"]["pose"], json={"if_busy": "queue"}).status_code == 202
    assert client.post(pose["links"]["cancel"]).status_code == 202
    served.gate.set()
    assert settled(client, made["id"])["poses"] == 1
    assert client.get(pose["links"]["self"]).json()["state"] == "cancelled"
    assert client.delete(pose["links"]["self"]).status_code == 204
    assert client.get(pose["links"]["self"]).status_code == 404


def test_failed_solve_gives_its_error_and_no_files(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    here = made["links"]["self"]
    shot(calibrating, made["id"])
    served.tame.solving.clear()
    served.tame.solve_error = SolveRefusedError("All poses are parallel: tilt the board.")
    calibrating.post(made["links"]["solve"])
    assert refusal(calibrating, "POST", made["links"]["pose"]) == STATE
    served.tame.solving.set()
    failed = settled(calibrating, made["id"])
    assert (failed["state"], failed["error"]["type"]) == ("failed", "/problems/solve-refused")
    for method, path in (("GET", "/calibration.json"), ("GET", "/report.html"), ("POST", "/activate")):
        assert refusal(calibrating, method, f"{here}{path}")[0] == 409, path


@pytest.mark.slow
def test_calibrations_are_imported_compared_and_refused(calibrating: TestClient, tmp_path: Path) -> None:
    client, path = calibrating, tmp_path / "sent.json"

    def sent(focal_px: float, **options: Any) -> dict[str, Any]:
        write_calibration(path, tame_calibration(focal_px=focal_px, **options))
        answer = client.post("/calibration/import?label=bench", content=path.read_bytes(), headers=JSON)
        assert answer.status_code == 201
        made: dict[str, Any] = answer.json()
        return made

    first, second = sent(80.0), sent(80.8)
    assert (second["imported"], second["label"], second["state"], second["board"]) == (True, "bench", "solved", None)
    found = client.get("/calibration/compare", params={"first": first["id"], "second": second["id"]}).json()
    assert found["devices"]["cam0"]["focal_percent"]["value"] == pytest.approx(1.0)
    assert "a real change" in found["devices"]["cam0"]["focal_percent"]["words"]
    assert found["devices"]["cam0"]["baseline_mm"] is None
    assert found["devices"]["projector"]["baseline_mm"]["value"] == 0
    assert 0 < found["moved_rms_mm"] <= found["moved_max_mm"]
    for name, kind in (("calibration.yml", "application/yaml"), ("calibration.xml", "text/xml; charset=utf-8")):
        text = client.get(f"/calibration/{first['id']}/{name}").content
        again = client.post("/calibration/import", content=text, headers={"Content-Type": kind})
        assert again.status_code == 201, again.text
        assert client.post(again.json()["links"]["activate"]).status_code == 200
    ids = [each["id"] for each in client.get("/calibration").json()["calibrations"]]
    assert ids[-2:] == [second["id"], first["id"]]
    assert len(client.get("/calibration", params={"limit": 1}).json()["calibrations"]) == 1

    no_calibration = (422, "/problems/calibration")
    for content in (b"{}", b"[", b"\xff"):
        assert refusal(client, "POST", "/calibration/import", content=content, headers=JSON) == no_calibration
    in_metres = tame_calibration()
    assert in_metres.projector is not None
    there = replace(in_metres.projector, translation_mm=in_metres.projector.translation_mm / 1000)
    write_calibration(path, replace(in_metres, projector=there))
    answer = client.post("/calibration/import", content=path.read_bytes(), headers=JSON)
    assert answer.status_code == 422
    assert "are 0.1 mm apart. Metres?" in answer.json()["detail"]
    strange = client.post("/calibration/import", content=b"x", headers={"Content-Type": "text/plain"})
    assert (strange.status_code, strange.headers["content-type"]) == (415, "application/problem+json")
    too_large = (413, "/problems/content-too-large")
    assert refusal(client, "POST", "/calibration/import", content=bytes(5 * 2**20), headers=JSON) == too_large
    assert refusal(client, "POST", "/calibration", content=bytes(5000), headers=JSON) == too_large
    other = sent(80.0, camera=Size(640, 480))
    ended(client, client.post("/scan").json()["id"])  # the devices of the rig are known once it is open
    assert refusal(client, "POST", other["links"]["activate"]) == no_calibration
    of_two_rigs = {"first": first["id"], "second": other["id"]}
    assert refusal(client, "GET", "/calibration/compare", params=of_two_rigs) == no_calibration


@pytest.mark.parametrize(
    ("body", "fields"),
    [
        ({"board": {}}, ["board.kind", "board.corners", "board.square_mm"]),
        ({"board": {"kind": "dots", "corners": [4, 3], "square_mm": 10}}, ["board.kind"]),
        ({"board": {**BOARD, "corners": [4]}}, ["board.corners"]),
        ({"board": {**BOARD, "corners": [4, 2]}}, ["board.corners.1"]),
        ({"board": {**BOARD, "square_mm": 0}}, ["board.square_mm"]),
        ({"board": {**BOARD, "square_mm": "10"}, "colour": 1}, ["board.square_mm", "colour"]),
        ({"board": {**BOARD, "marker_mm": 5.0}}, None),
    ],
)
def test_bad_board_is_refused_with_every_fault(
    calibrating: TestClient, body: dict[str, Any], fields: list[str] | None
) -> None:
    response = calibrating.post("/calibration", json=body)
    if fields is None:
        assert (response.status_code, response.json()["type"]) == (422, "/problems/calibration")
        assert "belong to a ChArUco board" in response.json()["detail"]
    else:
        assert (response.status_code, response.json()["type"]) == (422, "/problems/invalid-request")
        assert [fault["field"] for fault in response.json()["errors"]] == fields
    assert calibrating.get("/calibration").json()["calibrations"] == []


def test_unknown_calibration_pose_camera_or_device_is_not_found(calibrating: TestClient) -> None:
    unknown = f"/calibration/{uuid4()}"
    for method, path in (
        ("GET", ""), ("GET", "/events"), ("GET", "/calibration.json"), ("GET", "/report.html"),
        ("GET", "/coverage.png"), ("POST", "/pose"), ("POST", "/script"), ("POST", "/solve"), ("POST", "/activate"),
        ("POST", "/deactivate"), ("GET", "/pose/1"), ("DELETE", ""),
    ):  # fmt: skip
        assert refusal(calibrating, method, f"{unknown}{path}") == (404, "/problems/calibration-not-found"), path
    made = opened(calibrating)
    here = made["links"]["self"]
    for path in ("/pose/1", "/pose/1/picture.png"):
        assert calibrating.get(f"{here}{path}").status_code == 404
    shot(calibrating, made["id"])
    picture = f"{here}/pose/1/picture.png"
    assert refusal(calibrating, "GET", f"{picture}?camera=other") == (404, "/problems/camera-not-found")
    assert calibrating.get(f"{picture}?camera=..%2Fx").status_code == 422
    assert calibrating.get(f"{here}/coverage.png", params={"device": "other"}).status_code == 404


def test_sheet_of_a_board_is_what_the_command_writes(client: TestClient) -> None:
    found = client.get("/calibration/board.pdf")
    assert (found.status_code, found.headers["content-type"]) == (200, "application/pdf")
    assert found.content == board_pdf(DEFAULT_BOARD)
    asked = {"kind": "chessboard", "columns": "7", "rows": "5", "square_mm": "24.5", "page": "A3"}
    found = client.get("/calibration/board.pdf", params=asked)
    assert found.content == board_pdf(Board(BoardKind.CHESSBOARD, 7, 5, 24.5), page="A3")
    assert "board-chessboard-7x5-24.5mm.pdf" in found.headers["content-disposition"]
    for asked, words in (
        ({"columns": "2"}, "greater than or equal to 3"),
        ({"kind": "hexagons"}, "'charuco', 'chessboard' or 'circles'"),
        ({"square_mm": "20"}, "the largest square that fits"),
        ({"page": "napkin"}, "WIDTHxHEIGHT in mm"),
        ({"kind": "circles", "marker_mm": "9"}, "belong to a ChArUco board"),
        ({"dictionary": "DICT_NONE"}, "DICT_"),
    ):
        refused = client.get("/calibration/board.pdf", params=asked)
        assert (refused.status_code, words in refused.text) == (422, True), refused.text
