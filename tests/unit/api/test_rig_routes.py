"""/rig/health, /rig/turntable and /acceptance over stand-ins for the service."""

from __future__ import annotations

import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from uuid import UUID

import pytest
from fastapi.testclient import TestClient

from slrig.accept.plan import AcceptanceRequest
from slrig.api import acceptance as router_module
from slrig.api import calibration, rig
from slrig.calibrate.store import PoseRecord, SessionRecord
from slrig.calibrate.verification import HealthStore
from slrig.calibration.board import DEFAULT_BOARD
from slrig.jobs.data_folder import DataFolder
from slrig.jobs.database import Database
from slrig.jobs.records import JobState
from slrig.jobs.store import RequestKeys
from slrig.model_jobs.turntable import TurntableStore
from slrig.multiview.turntable import BoardAxis, axis_from_board, find_turntable_planes
from tests.unit.accept.test_job import PLAN, Desk, desk, desks
from tests.unit.api.conftest import app_of, refusal
from tests.unit.calibrate.test_verification import Verifying, tame
from tests.unit.jobs.tame_compute import TameCompute
from tests.unit.multiview.test_turntable_axis import SIX_DEG, shot
from tests.unit.multiview.test_turntable_planes import AXIS, PLATE
from tests.unit.scan.bench import PIPELINE

__all__ = ["desk", "desks", "tame"]

BOARD = {"kind": "chessboard", "corners": [11, 8], "square_mm": 12.0}


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[DataFolder]:
    folder = DataFolder(tmp_path / "data")
    yield folder
    folder.release()


@pytest.fixture
def verifying(folder: DataFolder) -> Iterator[Verifying]:
    store = HealthStore(Database(folder.database))
    yield Verifying(folder, store)
    store.database.close()


@pytest.fixture
def health_client(folder: DataFolder, verifying: Verifying) -> Iterator[TestClient]:
    manager = verifying.manager
    service = SimpleNamespace(
        folder=folder, manager=manager, store=manager.store, health=verifying.health,
        keys=RequestKeys(manager.store.database), refuse_when_stale=True, calibrations=SimpleNamespace(active=None),
    )  # fmt: skip
    with TestClient(app_of(rig.health_router, service)) as found:
        yield found


def test_a_verification_changes_the_health(health_client: TestClient) -> None:
    before = health_client.get("/rig/health").json()
    assert before["state"] == "unknown"
    assert before["calibration"] == "0123456789ab"
    assert before["refuses_scans_when_stale"] is True
    told = {"watch_mean_px": 0.1, "stale_mean_px": 0.3, "watch_error_ratio": 1.4, "stale_error_ratio": 3.0}
    assert before["thresholds"].items() >= told.items()
    answer = health_client.post("/rig/verification", json={"board": BOARD}, headers={"Idempotency-Key": "k"})
    assert answer.status_code == 202
    again = health_client.post("/rig/verification", json={"board": BOARD}, headers={"Idempotency-Key": "k"})
    assert again.json() == answer.json()
    place = answer.headers["Location"]
    deadline = time.monotonic() + 20
    while health_client.get(place).json()["state"] not in ("succeeded", "failed"):
        assert time.monotonic() < deadline
    found = health_client.get(place).json()
    assert found["state"] == "succeeded"
    after = health_client.get("/rig/health").json()
    assert after["state"] == "good"
    assert after["latest"] == found["found"]
    assert after["latest"]["pairs"][0]["map_mean_px"][0][0] == 0.01
    (kept,) = health_client.get("/rig/health/history").json()["verifications"]
    assert kept == found["found"]
    assert (
        health_client.get("/rig/health/history", params={"since": "2100-01-01T00:00:00Z"}).json()["verifications"] == []
    )
    plot = health_client.get("/rig/health.svg")
    assert plot.headers["content-type"].startswith("image/svg+xml")
    assert "Change since calibration" in plot.text


def test_a_busy_rig_names_its_holder(health_client: TestClient, verifying: Verifying) -> None:
    verifying.manager.busy = "schedule 'nightly'"
    answer = health_client.post("/rig/verification", json={"board": BOARD})
    assert answer.status_code == 409
    assert "schedule 'nightly'" in answer.json()["detail"]


def test_missing_board_and_unknown_verification_are_refused(health_client: TestClient) -> None:
    no_board = health_client.post("/rig/verification")
    assert no_board.status_code == 422
    assert 'send "board"' in no_board.json()["detail"]
    assert health_client.get("/rig/health/history", params={"since": "2026-01-01T00:00:00"}).status_code == 422
    missing = health_client.get("/rig/verification/00000000-0000-0000-0000-000000000000")
    assert missing.status_code == 404


SESSION, SCAN = UUID(int=7), UUID(int=8)
POSES = tuple(PoseRecord(n, UUID(int=n), JobState.SUCCEEDED, datetime(2026, 11, 26, tzinfo=UTC)) for n in range(2, 8))


def found(observed: list[int], _board: object, _calibration: object, angles_deg: list[float] | None) -> BoardAxis:
    """The axis of those of six made poses that are asked for."""
    names, poses, covariance = shot(SIX_DEG)
    rows = [row for each in observed for row in range(6 * each, 6 * each + 6)]
    of = [names[each] for each in observed]
    return axis_from_board(of, poses[observed], covariance[rows][:, rows], DEFAULT_BOARD.points_mm, angles_deg)


@pytest.fixture
def turntable_client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    folder = DataFolder(tmp_path / "data")
    folder.scan(SCAN).mkdir(parents=True)
    (folder.scan(SCAN) / "mesh.ply").write_bytes(b"of the empty turntable")
    session = SessionRecord(1, SESSION, POSES[0].created_at, "rig", board=DEFAULT_BOARD, poses=POSES)
    readings = [SimpleNamespace(observation=number) for number in range(6)]
    service = SimpleNamespace(
        folder=folder,
        turntable=TurntableStore(folder.root / "turntable"),
        calibrations=SimpleNamespace(
            register=SimpleNamespace(get=lambda _: session), store=SimpleNamespace(folder=lambda _: tmp_path)
        ),
        health=SimpleNamespace(health=lambda: (None, None, "the calibration in use")),
        store=SimpleNamespace(get=lambda *_: SimpleNamespace(state=JobState.SUCCEEDED)),
        worker=TameCompute(PIPELINE),
        manager=SimpleNamespace(rig=SimpleNamespace(axis=None)),
    )
    monkeypatch.setattr(calibration, "session_readings", lambda _: readings)
    monkeypatch.setattr(rig, "turntable_axis", found)
    monkeypatch.setattr(rig, "turntable_planes", lambda *_: find_turntable_planes(PLATE, AXIS))
    with TestClient(app_of(rig.turntable_router, service)) as made:
        yield made
    folder.release()


def test_an_axis_and_planes_are_calibrated_kept_and_put_back(turntable_client: TestClient) -> None:
    before = turntable_client.get("/rig/turntable").json()
    assert before["state"] == "unknown"
    assert "POST /rig/turntable/shoot" in before["remedy"]
    asked = {"calibration": str(SESSION), "angles_deg": SIX_DEG.tolist()}
    calibrated = turntable_client.post("/rig/turntable/axis", json=asked).json()
    assert calibrated["state"] == "known"
    assert calibrated["point_sigma_mm"] < 1
    assert [pose["name"] for pose in calibrated["poses"]] == [f"pose {n}" for n in range(1, 7)]
    assert abs(calibrated["poses"][2]["error_deg"]) < 0.1
    with_plane = turntable_client.post("/rig/turntable/planes", json={"scan": str(SCAN)}).json()
    assert with_plane["document"]["planes"][0]["kind"] == "plate"
    assert turntable_client.get("/rig/turntable.svg").text.startswith("<svg")
    assert turntable_client.delete("/rig/turntable").status_code == 204
    assert turntable_client.get("/rig/turntable").json() == before
    assert turntable_client.put("/rig/turntable", json=with_plane["document"]).json() == with_plane
    assert turntable_client.get("/rig/turntable").json() == with_plane


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"poses": [2, 3, 99]}, "found [2, 3, 99]; there are 2, 3, 4, 5, 6, 7"),
        ({"angles_deg": [0.0]}, "expected one for each of 6 poses, found 1"),
        ({"poses": [2, 3]}, "expected 3 poses or more"),
    ],
)
def test_poses_that_give_no_axis_are_refused(
    turntable_client: TestClient, asked: dict[str, object], words: str
) -> None:
    answer = turntable_client.post("/rig/turntable/axis", json={"calibration": str(SESSION)} | asked)
    assert answer.status_code == 422
    assert words in answer.json()["detail"]
    assert turntable_client.get("/rig/turntable").json()["state"] == "unknown"


def test_a_document_that_is_none_is_refused_with_its_faults(turntable_client: TestClient) -> None:
    sent = {"format": "slrig-turntable", "version": 1, "axis": {"point_mm": [0, 0, 0], "direction": [0, 0, 0]}}
    answer = turntable_client.put("/rig/turntable", json=sent)
    assert answer.status_code == 422
    assert "covariance" in answer.text


EXACT = {
    "sphere": {"value_mm": 30, "uncertainty_mm": 0.001},
    "bar": {"value_mm": 110, "uncertainty_mm": 0.002},
    "plane_mm": [160, 110],
    "sphere_form_mm": 0.001,
    "plane_form_mm": 0.002,
}
VOLUME = [[-100, -75, -40], [100, 75, 40]]


@pytest.fixture
def acceptance_client(desk: Desk) -> TestClient:
    store, folder = desk.manager.store, SimpleNamespace(require_present=lambda: None)
    service = SimpleNamespace(acceptance=desk, store=store, keys=RequestKeys(store.database), folder=folder)
    return TestClient(app_of(router_module.router, service))


def test_positions_are_measured_to_the_end_and_the_report_is_fetched(
    acceptance_client: TestClient, desk: Desk, tmp_path: Path
) -> None:
    answer = acceptance_client.post("/acceptance", json={"artefacts": EXACT, "volume_mm": VOLUME, "repeats": 2})
    body = answer.json()
    assert (answer.status_code, acceptance_client.get(answer.headers["location"]).json()) == (201, body)
    assert (body["captures"], body["captures_done"], body["state"]) == (26, 0, "open")
    assert body["next"]["words"] == "Put the sphere in the middle of the volume."
    assert len(body["positions"]) == 23
    test = desk.open(lambda *_: PLAN)
    path = f"/acceptance/{test.id}"
    assert refusal(acceptance_client, "GET", f"{path}/report.json") == (409, "/problems/artefact-not-ready")
    measured = acceptance_client.post(f"{path}/position").json()
    assert measured["captures_done"] == PLAN.repeats
    assert set(measured["readings"][0]["errors_mm"]) == {"PF", "PS"}
    acceptance_client.post(f"{path}/position", json={"scripted": True})
    body = acceptance_client.get(path).json()
    assert (body["state"], body["decision"], body["next"]) == ("finished", "passes", None)
    assert acceptance_client.get(body["files"]["report.json"]).json()["decision"] == "passes"
    assert "No conformity" in acceptance_client.get(body["files"]["report.html"]).text
    assert acceptance_client.post(f"{path}/position").status_code == 409
    first, second = acceptance_client.get("/acceptance").json()["tests"]
    assert (first["id"], first["decision"], second["decision"]) == (str(test.id), "passes", None)
    assert acceptance_client.get("/acceptance?limit=1").json()["tests"] == [first]
    assert (tmp_path / "acceptance" / str(test.id) / "positions").is_dir()
    assert acceptance_client.delete(path).status_code == 204
    assert acceptance_client.get(path).status_code == 404


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ({"artefacts": {**EXACT, "sphere": {"value_mm": 3, "uncertainty_mm": 0}}}, "expected a diameter of"),
        ({"artefacts": {**EXACT, "sphere": {"value_mm": 30}}}, "uncertainty_mm"),
        ({"artefacts": EXACT, "volume_mm": VOLUME[::-1]}, "least corner"),
        ({"repeats": 0}, "repeats"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_bad_request_for_a_test_is_refused(acceptance_client: TestClient, body: dict[str, object], words: str) -> None:
    answer = acceptance_client.post("/acceptance", json={"volume_mm": VOLUME, **body})
    assert answer.status_code == 422
    assert words in answer.text


def test_held_rig_answers_409_and_an_unknown_test_404(acceptance_client: TestClient, desk: Desk) -> None:
    test = desk.open(lambda *_: PLAN)
    desk.manager.busy = "1"
    answer = acceptance_client.post(f"/acceptance/{test.id}/position")
    assert (answer.status_code, answer.json()["holder"]) == (409, "1")
    assert acceptance_client.get("/acceptance/00000000-0000-0000-0000-000000000000").status_code == 404
    assert acceptance_client.post(f"/acceptance/{test.id}/cancel").json()["state"] == "cancelled"


def test_repeated_request_opens_and_measures_nothing_new(
    acceptance_client: TestClient, desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(AcceptanceRequest, "plan", lambda *_: PLAN)
    key = {"Idempotency-Key": "once"}
    first = acceptance_client.post("/acceptance", headers=key)
    path = first.headers["location"]
    measured = acceptance_client.post(f"{path}/position", headers=key)
    assert (measured.status_code, measured.json()["captures_done"]) == (202, PLAN.repeats)
    again = acceptance_client.post("/acceptance", headers=key)
    assert (again.status_code, again.headers["location"], again.json()) == (201, path, first.json())
    assert acceptance_client.post(f"{path}/position", headers=key).json() == acceptance_client.get(path).json()
    assert (len(desk.manager.holders), len(desk.latest())) == (1, 1)
    for where in ("/acceptance", f"{path}/position"):
        other = {"repeats": 2} if where == "/acceptance" else {"scripted": True}
        assert refusal(acceptance_client, "POST", where, headers=key, json=other) == (422, "/problems/idempotency")
