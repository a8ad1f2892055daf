"""/hand-eye: solved from poses of a session, checked, kept with the calibration in use, and used by scans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from uuid import UUID

import numpy as np
import pytest
from fastapi.testclient import TestClient

from slrig.api import calibration, hand_eye
from slrig.bundle import write_calibration
from slrig.calibrate.hand_eye import HandEyeDocument, hand_eye_document
from slrig.calibrate.store import PoseRecord, SessionRecord
from slrig.calibration import PROJECTOR, BoardPose
from slrig.calibration.hand_eye import HandEyeKind, solve_hand_eye
from slrig.errors import CalibrationError, CalibrationNotFoundError
from slrig.jobs.records import JobState
from slrig.model import Calibration, FloatArray
from slrig.scan.artefacts import encode_mesh_ply
from tests.unit.api.conftest import ServedBench, app_of, ended
from tests.unit.calibration.posed_boards import CHESSBOARD, Shooting, two_cameras_and_projector
from tests.unit.calibration.robot_cells import cell, error_of, pose, sphere_mesh
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.scan.bench import PIPELINE

SESSION = UUID(int=7)
# Two cameras tell a pose, and take less time than the projector's light.
DEVICES = {name: each for name, each in two_cameras_and_projector().items() if name != PROJECTOR}
CALIBRATION = Calibration(DEVICES, None)
MADE = cell(
    HandEyeKind.IN_HAND, 6, count=10, turns_deg=(25.0, 25.0, 20.0), spread_mm=15.0, place_mm=(20.0, -45.0, 600.0)
)


@pytest.fixture
def service(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    # Poses 1 and 3 were refused.
    shooting, at = Shooting(CHESSBOARD, DEVICES), datetime(2026, 11, 26, tzinfo=UTC)
    numbers = [2, *range(4, 13)]
    poses = tuple(PoseRecord(number, UUID(int=number), JobState.SUCCEEDED, at) for number in numbers)
    session = SessionRecord(1, SESSION, at, "rig", board=CHESSBOARD, poses=poses)
    readings = [
        SimpleNamespace(observation=shooting.shot(f"pose {number}", BoardPose(each[:3, :3], each[:3, 3])))
        for number, each in zip(numbers, MADE.shown, strict=True)
    ]
    monkeypatch.setattr(calibration, "session_readings", lambda _: readings)
    return SimpleNamespace(
        folder=SimpleNamespace(
            root=tmp_path,
            require_present=lambda: None,
            scan=lambda each: tmp_path / str(each),
            require_whole=lambda *_: None,
        ),
        store=SimpleNamespace(get=lambda each, _: SimpleNamespace(id=each)),
        calibrations=SimpleNamespace(
            register=SimpleNamespace(get=lambda _: session), store=SimpleNamespace(folder=lambda _: tmp_path)
        ),
        health=SimpleNamespace(health=lambda: (None, None, CALIBRATION)),
        worker=TameCompute(PIPELINE),
    )


@pytest.fixture
def client(service: SimpleNamespace) -> Iterator[TestClient]:
    with TestClient(app_of(hand_eye.router, service)) as made:
        yield made


def request(robot: FloatArray, **others: Any) -> dict[str, Any]:
    numbers = [2, *range(4, 13)]
    poses = [
        {"pose": number, "robot_pose": each.tolist()} for number, each in zip(numbers[: len(robot)], robot, strict=True)
    ]
    return {"calibration": str(SESSION), "poses": poses, **others}


def test_hand_eye_is_solved_kept_checked_and_forgotten(client: TestClient, service: Any) -> None:
    missing = client.get("/hand-eye")
    assert missing.status_code == 404
    assert "POST /hand-eye" in missing.json()["detail"]
    found = client.post("/hand-eye", json=request(MADE.robot.poses, kind="in-hand", flange_frame="tcp"))
    assert found.status_code == 200, found.text
    document = HandEyeDocument.model_validate_json(found.text)
    assert (document.calibration, document.flange_frame) == (CALIBRATION.solve_id, "tcp")
    error = error_of(np.array(document.rig), MADE.rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diagonal(document.covariance)))
    assert client.get("/hand-eye").json() == found.json()
    flange = MADE.robot.poses[3]
    placed = hand_eye.rig_in_base(service, flange.tolist(), needed=True)
    np.testing.assert_allclose(np.array(placed), flange @ np.array(document.rig))
    with pytest.raises(CalibrationError, match="give robot_pose"):
        hand_eye.rig_in_base(service, None, needed=True)
    assert hand_eye.rig_in_base(service, None, needed=False) is None
    held = client.post("/hand-eye/check", json=request(MADE.robot.poses[:2])).json()
    assert held["holds"]
    assert len(held["residual_mm"]) == 2
    # The tool that the robot reports is another one.
    other = MADE.robot.poses[:2] @ pose([0.0, 0.0, 0.0], [0.0, 0.0, 3.0])
    drift = client.post("/hand-eye/check", json=request(other)).json()
    assert not drift["holds"]
    assert abs(drift["shift_mm"] - 3) < 3 * drift["sigma_mm"]
    assert client.delete("/hand-eye").status_code == 204
    with pytest.raises(CalibrationNotFoundError):
        hand_eye.rig_in_base(service, flange.tolist(), needed=False)


def test_scans_of_a_sphere_do_as_well(client: TestClient, service: Any, tmp_path: Path) -> None:
    made = cell(HandEyeKind.FIXED, 7, sphere=True)
    write_calibration(tmp_path / "rig.json", CALIBRATION)
    poses = []
    for number, (robot, shown) in enumerate(zip(made.robot.poses, made.shown, strict=True)):
        folder = tmp_path / str(UUID(int=number))
        (folder / "bundle").mkdir(parents=True)
        (folder / "bundle" / "calibration.json").write_bytes((tmp_path / "rig.json").read_bytes())
        (folder / "mesh.ply").write_bytes(encode_mesh_ply(sphere_mesh(shown[:3, 3], 38.1, number)))
        poses.append({"scan": str(UUID(int=number)), "robot_pose": robot.tolist()})
    found = client.post("/hand-eye", json={"sphere_mm": 38.1, "poses": poses, "kind": "fixed"})
    assert found.status_code == 200, found.text
    document = HandEyeDocument.model_validate_json(found.text)
    error = error_of(np.array(document.rig), made.rig)
    assert np.all(np.abs(error) < 4 * np.sqrt(np.diagonal(document.covariance)))
    assert client.post("/hand-eye/check", json={"sphere_mm": 38.1, "poses": poses[:1]}).json()["holds"]
    service.health = SimpleNamespace(health=lambda: (None, None, Calibration({"left": DEVICES["left"]}, None)))
    other = client.post("/hand-eye", json={"sphere_mm": 38.1, "poses": poses, "kind": "fixed"})
    assert "scan the sphere again" in other.json()["detail"]
    mixed = client.post("/hand-eye/check", json=request(MADE.robot.poses[:1], sphere_mm=38.1))
    assert "sphere_mm and the id `scan` of each" in mixed.text


def test_what_does_not_fit_is_refused(client: TestClient) -> None:
    unknown = request(MADE.robot.poses, kind="in-hand")
    unknown["poses"][0]["pose"] = 3
    assert "found [3, 4," in client.post("/hand-eye", json=unknown).json()["detail"]
    inverted = client.post("/hand-eye", json=request(MADE.robot.poses, kind="fixed"))
    assert inverted.status_code == 422
    assert "the rig is in-hand and not fixed" in inverted.json()["detail"]
    scaled = request(MADE.robot.poses * 1.1, kind="in-hand")
    assert client.post("/hand-eye", json=scaled).status_code == 422
    solved = solve_hand_eye(MADE.robot, MADE.seen, MADE.kind)
    other = hand_eye_document(solved, "another").model_dump(mode="json")
    refused = client.put("/hand-eye", json=other)
    assert refused.status_code == 422
    broken = other | {"calibration": CALIBRATION.solve_id, "joint_covariance": [[-1.0] * 12] * 12}
    assert "expected a covariance" in client.put("/hand-eye", json=broken).text
    small = broken | {"joint_covariance": np.eye(7).tolist()}
    assert "found (6, 6, 7)" in client.put("/hand-eye", json=small).text
    assert f"expected {CALIBRATION.solve_id}, which is in use, found another" in refused.json()["detail"]


def test_scans_are_asked_for_in_the_robots_axes(served: ServedBench, session: TestClient) -> None:
    asked = {"reconstruction": {"mesh_axes": "robot"}, "robot_pose": MADE.robot.poses[0].tolist()}
    assert session.post("/scan", json=asked).status_code == 404
    own = served.service.health.health()[2]
    assert own is not None
    solved = replace(solve_hand_eye(MADE.robot, MADE.seen, MADE.kind), rig=MADE.rig)
    document = hand_eye_document(solved, own.solve_id).model_dump(mode="json")
    assert session.put("/hand-eye", json=document).status_code == 200
    answer = session.post("/scan", json=asked)
    assert answer.status_code == 202, answer.text
    ended(session, answer.json()["id"])
    placed = answer.json()["plan"]["reconstruction"]["rig_in_base"]
    np.testing.assert_allclose(np.array(placed), MADE.robot.poses[0] @ MADE.rig)
    session.delete(answer.headers["Location"])
    assert session.delete("/hand-eye").status_code == 204
