"""/rig/stage over HTTP: an axis from a session's poses, planes from a scan, the document kept and put back."""

from __future__ import annotations

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from uuid import UUID

import pytest
from fastapi.testclient import TestClient

from slrig.api import stage
from slrig.calibrate.records import PoseRecord, SessionRecord
from slrig.calibration.board import USUAL_BOARD
from slrig.combine.stage import StageStore
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.records import JobState
from slrig.views.stage_axis import BoardAxis, board_axis
from slrig.views.stage_planes import stage_planes
from tests.unit.api.conftest import app_of
from tests.unit.views.test_stage_axis import SIX_DEG, shot
from tests.unit.views.test_stage_planes import AXIS, PLATE

SESSION, SCAN = UUID(int=7), UUID(int=8)
POSES = tuple(PoseRecord(n, UUID(int=n), JobState.SUCCEEDED, datetime(2026, 11, 26, tzinfo=UTC)) for n in range(2, 8))


def found(observed: list[int], _board: object, _calibration: object, angles_deg: list[float] | None) -> BoardAxis:
    """The axis of those of six made poses that are asked for."""
    names, poses, covariance = shot(SIX_DEG)
    rows = [row for each in observed for row in range(6 * each, 6 * each + 6)]
    of = [names[each] for each in observed]
    return board_axis(of, poses[observed], covariance[rows][:, rows], USUAL_BOARD.points_mm, angles_deg)


@pytest.fixture
def client(tmp_path: Path) -> Iterator[TestClient]:
    folder = DataFolder(tmp_path / "data")
    folder.scan(SCAN).mkdir(parents=True)
    (folder.scan(SCAN) / "mesh.ply").write_bytes(b"of the empty stage")
    session = SessionRecord(1, SESSION, POSES[0].created_at, "rig", board=USUAL_BOARD, poses=POSES)
    readings = [SimpleNamespace(observation=number) for number in range(6)]
    service = SimpleNamespace(
        folder=folder,
        stage=StageStore(folder.root / "stage"),
        calibrations=SimpleNamespace(
            register=SimpleNamespace(get=lambda _: session), store=SimpleNamespace(readings=lambda _: readings)
        ),
        verifications=SimpleNamespace(health=lambda: (None, None, "the calibration in use")),
        store=SimpleNamespace(get=lambda _: SimpleNamespace(state=JobState.SUCCEEDED)),
        find_axis=found,
        find_planes=lambda _mesh, _axis: stage_planes(PLATE, AXIS),
    )
    with TestClient(app_of(stage.router, service)) as made:
        yield made
    folder.release()


def test_an_axis_and_planes_are_calibrated_kept_and_put_back(client: TestClient) -> None:
    before = client.get("/rig/stage").json()
    assert before["state"] == "unknown"
    assert "POST /rig/stage/axis" in before["remedy"]
    asked = {"calibration": str(SESSION), "angles_deg": SIX_DEG.tolist()}
    calibrated = client.post("/rig/stage/axis", json=asked).json()
    assert calibrated["state"] == "known"
    assert calibrated["point_sigma_mm"] < 1
    assert [pose["name"] for pose in calibrated["poses"]] == [f"pose {n}" for n in range(1, 7)]
    assert abs(calibrated["poses"][2]["error_deg"]) < 0.1
    with_plane = client.post("/rig/stage/planes", json={"scan": str(SCAN)}).json()
    assert with_plane["document"]["planes"][0]["kind"] == "plate"
    assert client.get("/rig/stage.svg").text.startswith("<svg")
    assert client.delete("/rig/stage").status_code == 204
    assert client.get("/rig/stage").json() == before
    assert client.put("/rig/stage", json=with_plane["document"]).json() == with_plane
    assert client.get("/rig/stage").json() == with_plane


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"poses": [2, 3, 99]}, "found [2, 3, 99]; there are 2, 3, 4, 5, 6, 7"),
        ({"angles_deg": [0.0]}, "expected one for each of 6 poses, found 1"),
        ({"poses": [2, 3]}, "expected 3 poses or more"),
    ],
)
def test_poses_that_give_no_axis_are_refused(client: TestClient, asked: dict[str, object], words: str) -> None:
    answer = client.post("/rig/stage/axis", json={"calibration": str(SESSION)} | asked)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert client.get("/rig/stage").json()["state"] == "unknown"


def test_a_document_that_is_none_is_refused_with_its_faults(client: TestClient) -> None:
    sent = {"format": "slrig-stage", "version": 1, "axis": {"point_mm": [0, 0, 0], "direction": [0, 0, 0]}}
    answer = client.put("/rig/stage", json=sent)
    assert answer.status_code == 422
    assert "covariance" in answer.text
