"""POST /calibration and all that follows from it."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import pytest
from fastapi.testclient import TestClient

from slrig.bundle.calibration_file import write_calibration
from slrig.calibration.board import USUAL_BOARD, Board, BoardKind
from slrig.calibration.boards.printing import board_pdf
from slrig.errors import SolveRefusedError
from slrig.model import Calibration, Size
from slrig.scan.plan_check import pattern_sequence
from tests.unit.api.conftest import ServedBench, ended
from tests.unit.api.test_scans import events_of
from tests.unit.calibrate.calibration_bench import PNG, tame_calibration
from tests.unit.scan.fakes import WAIT_S

BOARD = {"kind": "chessboard", "corners": [4, 3], "square_mm": 10.0}


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
    """The calibration once nothing is under way in it."""
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


def solved(client: TestClient) -> str:
    """The id of a calibration that was solved."""
    made = opened(client)
    shot(client, made["id"])
    assert client.post(made["links"]["solve"]).status_code == 202
    assert settled(client, made["id"])["state"] == "solved"
    return str(made["id"])


def test_calibration_is_opened_shot_solved_and_used(calibrating: TestClient) -> None:
    client = calibrating
    answer = client.post("/calibration", json={"board": BOARD, "label": "spring", "patterns": {"line_width_px": 2}})
    made = answer.json()
    assert (answer.status_code, answer.headers["Location"]) == (201, made["links"]["self"])
    assert (made["state"], made["label"], made["poses"]) == ("open", "spring", 0)
    assert made["board"] == {
        "kind": "chessboard",
        "corners": [4, 3],
        "square_mm": 10.0,
        "marker_mm": None,
        "dictionary": None,
        "square_sigma": 0.001,
        "aspect": 1.0,
        "title": "chessboard 4x3, 10 mm",
    }
    # Both axes unless the request says otherwise; the rest as the rig file says.
    assert made["patterns"]["rows"] is True
    assert (made["patterns"]["line_width_px"], made["patterns"]["line_shift_period_px"]) == (2, 6)

    accepted = client.post(made["links"]["pose"])
    pose = accepted.json()
    assert (accepted.status_code, accepted.headers["Location"]) == (202, pose["links"]["self"])
    assert (pose["number"], pose["state"]) == (1, "queued")
    events = events_of(client.get(pose["links"]["events"]).text)
    assert [event["state"] for event in events if event["kind"] == "pose"] == [
        "queued",
        "capturing",
        "computing",
        "succeeded",
    ]
    assert [(event["pose"], event["state"]) for event in events if event["kind"] == "captured"] == [(1, "capturing")]
    pose = client.get(pose["links"]["self"]).json()
    assert (pose["state"], pose["accepted"]) == ("succeeded", True)
    assert (pose["answer"], pose["error"]) == ({"corners_found": {"cam0": 12}}, None)
    assert pose["seconds"] < 2
    picture = client.get(pose["links"]["pictures"]["cam0"])
    assert (picture.headers["content-type"], picture.content) == ("image/png", PNG)

    found = client.get(made["links"]["self"]).json()
    assert found["next_move"] == {"words": "tilt it", "enough": False}
    assert set(found["links"]["coverage"]) == {"cam0", "projector"}
    assert client.get(found["links"]["coverage"]["projector"]).content == b"projector 1"

    solving = client.post(made["links"]["solve"])
    assert (solving.status_code, solving.json()["state"]) == (202, "solving")
    done = settled(client, made["id"])
    assert (done["state"], done["verdict"], done["result"]["verdict"]["grade"]) == ("solved", "good", "good")
    assert set(done["links"]["files"]) == {"calibration.json", "calibration.yml", "calibration.xml", "report.html"}
    for name, path in done["links"]["files"].items():
        assert client.get(path).status_code == 200, name
    assert client.get(done["links"]["files"]["calibration.json"]).json()["solved"]["id"] == made["id"]
    assert "default-src 'none'" in client.get(done["links"]["files"]["report.html"]).headers["Content-Security-Policy"]

    assert client.get("/rig").json()["calibration"] is None
    assert client.post(made["links"]["activate"]).json()["active"] is True
    used = client.get("/rig").json()["calibration"]
    assert (used["source"], used["id"], used["solve"]) == ("session", made["id"], made["id"])
    assert used["expected_error_mm"] == 0.02
    assert used["age_s"] > 0
    assert used["error"] is None
    listed = client.get("/calibration").json()
    assert (listed["active"], [each["active"] for each in listed["calibrations"]]) == (made["id"], [True])
    refused = client.delete(made["links"]["self"])
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-state")


@pytest.mark.parametrize("request_body", [None, {}, {"label": "spring"}], ids=str)
def test_board_that_no_request_names_is_the_usual_one(
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
        "title": "charuco 11x8, 12 mm",
    }


def test_cameras_are_calibrated_alone_where_that_is_asked_for(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating, projector=False)
    assert made["patterns"]["codes"] is False
    assert shot(calibrating, made["id"])["accepted"] is True
    assert set(calibrating.get(made["links"]["self"]).json()["links"]["coverage"]) == {"cam0"}
    _, plan = served.tame.captured[-1]
    assert {str(each.kind) for each in pattern_sequence(plan.patterns, Size(64, 40)).patterns} == {"white", "black"}


def test_one_camera_alone_is_kept_and_no_scan_uses_it(calibrating: TestClient, tmp_path: Path) -> None:
    camera = Calibration(tame_calibration().cameras, None)
    write_calibration(tmp_path / "camera.json", camera)
    kept = calibrating.post("/calibration/import", json=json.loads((tmp_path / "camera.json").read_bytes())).json()
    assert kept["state"] == "solved"
    refused = calibrating.post(kept["links"]["activate"])
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/calibration")
    assert "of camera 'cam0' alone, without a projector: it tells no depth, and cannot scan" in refused.json()["detail"]
    assert calibrating.get("/calibration").json()["active"] is None


def test_solve_is_told_what_the_board_is_taken_for(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    shot(calibrating, made["id"])
    for request, shape in ((None, "auto"), ({"board_shape": "bowed"}, "bowed"), ({"board_shape": "flat"}, "flat")):
        assert calibrating.post(made["links"]["solve"], json=request).status_code == 202
        assert settled(calibrating, made["id"])["state"] == "solved"
        assert served.tame.board_shapes[-1] == shape
    assert calibrating.post(made["links"]["solve"], json={"board_shape": "round"}).status_code == 422


def test_refused_pose_keeps_its_cause_and_its_picture(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    served.tame.refusals = ("no camera sees the board: move it into the picture.",)
    pose = shot(calibrating, made["id"])
    assert (pose["state"], pose["accepted"]) == ("failed", False)
    assert pose["error"]["type"] == "/problems/pose-refused"
    assert "move it into the picture" in pose["error"]["detail"]
    assert calibrating.get(pose["links"]["pictures"]["cam0"]).content == PNG
    assert calibrating.get(f"/calibration/{made['id']}").json()["poses"] == 0
    refused = calibrating.post(made["links"]["solve"])
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/solve-refused")


def test_scan_while_a_pose_is_shot_and_a_pose_during_a_scan(calibrating: TestClient, served: ServedBench) -> None:
    client, made = calibrating, opened(calibrating)
    served.began.clear()
    served.gate.clear()
    pose = client.post(made["links"]["pose"]).json()
    assert served.began.wait(WAIT_S)
    busy = client.post("/scan")
    assert (busy.status_code, busy.json()["holder"]) == (409, f"calibration {made['id']}, pose 1")
    assert f"POST {pose['links']['cancel']}" in busy.json()["detail"]
    assert client.get("/rig").json()["holder"] == busy.json()["holder"]
    preview = client.get("/preview/cam0")
    assert (preview.status_code, preview.json()["type"]) == (409, "/problems/rig-busy")
    queued = client.post("/scan", json={"if_busy": "queue"})
    assert queued.status_code == 202
    served.gate.set()
    assert ended(client, queued.json()["id"])["state"] == "succeeded"
    assert settled(client, made["id"])["poses"] == 1

    scan = served.held(client)
    refused = client.post(made["links"]["pose"])
    assert (refused.status_code, refused.json()["holder"]) == (409, scan["id"])
    waiting = client.post(made["links"]["pose"], json={"if_busy": "queue"})
    assert waiting.status_code == 202
    served.gate.set()
    assert settled(client, made["id"])["poses"] == 2


def test_pose_is_cancelled_over_http(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    served.began.clear()
    served.gate.clear()
    pose = calibrating.post(made["links"]["pose"]).json()
    assert served.began.wait(WAIT_S)
    refused = calibrating.delete(pose["links"]["self"])
    assert (refused.status_code, refused.json()["type"]) == (409, "/problems/calibration-state")
    assert calibrating.get(f"{pose['links']['self']}/picture.png").status_code == 409
    assert calibrating.post(pose["links"]["cancel"]).status_code == 202
    settled(calibrating, made["id"])
    assert calibrating.get(pose["links"]["self"]).json()["state"] == "cancelled"
    assert calibrating.delete(pose["links"]["self"]).status_code == 204
    assert calibrating.get(pose["links"]["self"]).status_code == 404


def test_repeated_pose_request_gets_the_same_pose_and_the_same_answer(calibrating: TestClient) -> None:
    made = opened(calibrating)
    headers = {"Idempotency-Key": "pose one"}
    first = calibrating.post(made["links"]["pose"], headers=headers)
    settled(calibrating, made["id"])
    again = calibrating.post(made["links"]["pose"], headers=headers)
    assert (again.status_code, again.headers["Location"]) == (202, first.headers["Location"])
    assert again.json()["number"] == 1
    assert again.json()["state"] == "queued"
    other = calibrating.post(made["links"]["pose"], json={"exposure_s": 0.02}, headers=headers)
    assert (other.status_code, other.json()["type"]) == (422, "/problems/idempotency")
    assert len(calibrating.get(made["links"]["self"]).json()["shot"]) == 1


def test_progress_of_a_solve_is_told_and_its_failure_too(calibrating: TestClient, served: ServedBench) -> None:
    made = opened(calibrating)
    shot(calibrating, made["id"])
    served.tame.solving.clear()
    served.tame.solve_error = SolveRefusedError("All poses are parallel: tilt the board.")
    calibrating.post(made["links"]["solve"])
    register, told = served.service.calibrations.register, threading.Event()
    session_id = UUID(made["id"])

    def look() -> None:
        progress = register.get(session_id).progress
        if progress is not None and progress.stage == "adjust":
            told.set()

    unwatch = register.jobs.watch(session_id, look)
    look()
    assert told.wait(WAIT_S)
    unwatch()
    found = calibrating.get(made["links"]["self"]).json()
    assert (found["state"], found["progress"]["stage"], found["progress"]["fraction"]) == ("solving", "adjust", 0.5)
    busy = calibrating.post(made["links"]["pose"])
    assert (busy.status_code, busy.json()["type"]) == (409, "/problems/calibration-state")
    served.tame.solving.set()
    failed = settled(calibrating, made["id"])
    assert (failed["state"], failed["error"]["type"]) == ("failed", "/problems/solve-refused")
    assert calibrating.get(f"{made['links']['self']}/calibration.json").status_code == 409
    assert calibrating.get(f"{made['links']['self']}/report.html").status_code == 409
    assert calibrating.post(made["links"]["activate"]).status_code == 409


def test_import_export_and_comparison(calibrating: TestClient, tmp_path: Any) -> None:
    first = solved(calibrating)
    path = tmp_path / "other.json"
    write_calibration(path, tame_calibration(focal_px=80.8))
    imported = calibrating.post(
        "/calibration/import?label=bench", content=path.read_bytes(), headers={"Content-Type": "application/json"}
    )
    assert imported.status_code == 201
    second = imported.json()
    assert (second["imported"], second["label"], second["state"], second["board"]) == (True, "bench", "solved", None)
    found = calibrating.get("/calibration/compare", params={"first": first, "second": second["id"]}).json()
    focal = found["devices"]["cam0"]["focal_percent"]
    assert focal["value"] == pytest.approx(1.0)
    assert focal["sigmas"] == pytest.approx(0.8 / (0.1 * 2**0.5 / 2**0.5), rel=1e-3)
    assert "a real change" in focal["words"]
    assert found["devices"]["cam0"]["baseline_mm"] is None
    assert found["devices"]["projector"]["baseline_mm"]["value"] == 0
    assert 0 < found["moved_rms_mm"] <= found["moved_most_mm"]
    for name, kind in (("calibration.yml", "application/yaml"), ("calibration.xml", "text/xml; charset=utf-8")):
        text = calibrating.get(f"/calibration/{first}/{name}").content
        again = calibrating.post("/calibration/import", content=text, headers={"Content-Type": kind})
        assert again.status_code == 201, again.text
        assert calibrating.post(again.json()["links"]["activate"]).status_code == 200
    newest = [each["id"] for each in calibrating.get("/calibration").json()["calibrations"]]
    assert (newest[-1], newest[-2]) == (first, second["id"])
    assert len(calibrating.get("/calibration", params={"limit": 1}).json()["calibrations"]) == 1


def test_import_that_is_no_calibration_or_of_another_rig_is_refused(calibrating: TestClient, tmp_path: Any) -> None:
    json_type = {"Content-Type": "application/json"}
    for content in (b"{}", b"[", b"\xff"):
        refused = calibrating.post("/calibration/import", content=content, headers=json_type)
        assert (refused.status_code, refused.json()["type"]) == (422, "/problems/calibration"), content
        assert str(tmp_path.parent) not in refused.text
    strange = calibrating.post("/calibration/import", content=b"x", headers={"Content-Type": "text/plain"})
    assert (strange.status_code, strange.headers["content-type"]) == (415, "application/problem+json")
    path = tmp_path / "other.json"
    write_calibration(path, tame_calibration(camera=Size(640, 480)))
    other = calibrating.post("/calibration/import", content=path.read_bytes(), headers=json_type).json()
    ended(calibrating, calibrating.post("/scan").json()["id"])
    refused = calibrating.post(other["links"]["activate"])
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/calibration")
    mine = solved(calibrating)
    refused = calibrating.get("/calibration/compare", params={"first": mine, "second": other["id"]})
    assert (refused.status_code, refused.json()["type"]) == (422, "/problems/calibration")
    huge = calibrating.post("/calibration/import", content=bytes(5 * 2**20), headers=json_type)
    assert (huge.status_code, huge.json()["type"]) == (413, "/problems/content-too-large")
    assert calibrating.post("/calibration", content=bytes(5000), headers=json_type).status_code == 413


@pytest.mark.parametrize(
    ("body", "fields"),
    [
        ({"board": {}}, ["board.kind", "board.corners", "board.square_mm"]),
        ({"board": {"kind": "dots", "corners": [4, 3], "square_mm": 10}}, ["board.kind"]),
        ({"board": {**BOARD, "corners": [4]}}, ["board.corners"]),
        ({"board": {**BOARD, "corners": [4, 2]}}, ["board.corners.1"]),
        ({"board": {**BOARD, "square_mm": 0}}, ["board.square_mm"]),
        ({"board": {**BOARD, "square_mm": "10"}, "colour": 1}, ["board.square_mm", "colour"]),
    ],
)
def test_absurd_board_is_refused_with_every_fault_named(
    calibrating: TestClient, body: dict[str, Any], fields: list[str]
) -> None:
    response = calibrating.post("/calibration", json=body)
    assert (response.status_code, response.json()["type"]) == (422, "/problems/invalid-request")
    assert [fault["field"] for fault in response.json()["errors"]] == fields
    assert calibrating.get("/calibration").json()["calibrations"] == []


def test_board_that_cannot_be_is_refused(calibrating: TestClient) -> None:
    response = calibrating.post("/calibration", json={"board": {**BOARD, "marker_mm": 5.0}})
    assert (response.status_code, response.json()["type"]) == (422, "/problems/calibration")
    assert "belong to a ChArUco board" in response.json()["detail"]


def test_position_without_a_positioner_is_refused(calibrating: TestClient) -> None:
    ended(calibrating, calibrating.post("/scan").json()["id"])
    made = opened(calibrating)
    for path, body in (("pose", {"position": 0}), ("pose", {"position": "far"}), ("script", {})):
        refused = calibrating.post(f"/calibration/{made['id']}/{path}", json=body)
        assert (refused.status_code, refused.json()["type"]) == (422, "/problems/unsupported-by-device")
    assert calibrating.get("/rig").json()["positions"] == []


def test_what_is_not_there_is_not_found(calibrating: TestClient) -> None:
    unknown, made = uuid4(), opened(calibrating)
    for method, path in (
        ("GET", ""),
        ("GET", "/events"),
        ("GET", "/calibration.json"),
        ("GET", "/report.html"),
        ("GET", "/coverage.png"),
        ("POST", "/pose"),
        ("POST", "/script"),
        ("POST", "/solve"),
        ("POST", "/activate"),
        ("POST", "/deactivate"),
        ("GET", "/pose/1"),
        ("DELETE", ""),
    ):
        response = calibrating.request(method, f"/calibration/{unknown}{path}")
        assert (response.status_code, response.json()["type"]) == (404, "/problems/calibration-not-found"), path
    for path in ("/pose/1", "/pose/1/picture.png"):
        assert calibrating.get(f"{made['links']['self']}{path}").status_code == 404
    assert calibrating.get(f"{made['links']['self']}/coverage.png").status_code == 409
    shot(calibrating, made["id"])
    strange = calibrating.get(f"{made['links']['self']}/pose/1/picture.png", params={"camera": "other"})
    assert (strange.status_code, strange.json()["type"]) == (404, "/problems/camera-not-found")
    assert calibrating.get(f"{made['links']['self']}/pose/1/picture.png?camera=..%2Fx").status_code == 422
    assert calibrating.get(f"{made['links']['self']}/coverage.png", params={"device": "other"}).status_code == 404


def test_stream_of_a_quiet_calibration_is_empty(calibrating: TestClient) -> None:
    made = opened(calibrating)
    quiet = calibrating.get(made["links"]["events"])
    assert (quiet.status_code, quiet.content) == (204, b"")
    shot(calibrating, made["id"])
    everything = events_of(calibrating.get(made["links"]["events"]).text)
    rest = events_of(calibrating.get(made["links"]["events"], headers={"Last-Event-ID": str(everything[1]["id"])}).text)
    assert rest == everything[2:]
    last = calibrating.get(made["links"]["self"]).json()["last_event"]
    assert last == everything[-1]["id"]
    assert calibrating.get(made["links"]["events"], headers={"Last-Event-ID": str(last)}).status_code == 204


def test_sheet_of_a_board_is_what_the_command_writes(client: TestClient) -> None:
    found = client.get("/calibration/board.pdf")
    assert (found.status_code, found.headers["content-type"]) == (200, "application/pdf")
    assert found.content == board_pdf(USUAL_BOARD)
    asked = {"kind": "chessboard", "columns": "7", "rows": "5", "square_mm": "24.5", "page": "A3"}
    found = client.get("/calibration/board.pdf", params=asked)
    assert found.content == board_pdf(Board(BoardKind.CHESSBOARD, 7, 5, 24.5), page="A3")
    assert "board-chessboard-7x5-24.5mm.pdf" in found.headers["content-disposition"]


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"columns": "2"}, "greater than or equal to 3"),
        ({"kind": "hexagons"}, "'charuco', 'chessboard' or 'circles'"),
        ({"square_mm": "20"}, "the largest square that fits"),
        ({"page": "napkin"}, "WIDTHxHEIGHT in mm"),
        ({"kind": "circles", "marker_mm": "9"}, "belong to a ChArUco board"),
        ({"dictionary": "DICT_NONE"}, "DICT_"),
    ],
)
def test_sheet_that_cannot_be_printed_is_refused(client: TestClient, asked: dict[str, str], words: str) -> None:
    found = client.get("/calibration/board.pdf", params=asked)
    assert found.status_code == 422
    assert words in found.text
