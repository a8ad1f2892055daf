"""The files that the worker makes of a finished scan when they are asked for: turns, waits, and what goes wrong."""

from __future__ import annotations

import importlib.util
import io
import json
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from uuid import UUID

import cv2
import numpy as np
import pytest
from fastapi.testclient import TestClient

from slrig.api import clouds
from slrig.bundle.calibration_file import write_calibration
from slrig.bundle.writing import BundleWriter
from slrig.jobs.worker_process import Task
from slrig.model import Calibration, CameraFormat, Pinhole, Shot, Size, White
from slrig.scan.offered import BAG
from tests.ros_readers import library, point_columns
from tests.unit.api.conftest import ServedBench, ended
from tests.unit.scan import fake_pipeline
from tests.unit.scan.fakes import WAIT_S

SIZE = Size(40, 30)
NAME = "points-left.npz"
PIPELINE = fake_pipeline.__name__


def camera() -> Pinhole:
    """Looks at the fake pipeline's triangle from 50 mm before it, a pixel for each millimetre."""
    matrix = np.array([[50.0, 0, 12], [0, 50, 10], [0, 0, 1]])
    return Pinhole(SIZE, matrix, np.zeros(5), np.eye(3), np.array([0.0, 0, 50]))


def prepare(served: ServedBench, scan_id: str) -> Path:
    """Give a scan of the fake pipeline what a real one has."""
    place = served.service.folder.scan(UUID(scan_id))
    write_calibration(place / "bundle" / "calibration.json", Calibration({"left": camera()}, camera()))
    report = json.loads((place / "report.json").read_text())
    (place / "report.json").write_text(json.dumps({**report, "causes": [{"name": "none"}, {"name": "not_lit"}]}))
    refused = np.zeros(SIZE.shape, dtype=np.uint8)
    refused[:12] = 1
    (place / "causes-left.png").write_bytes(cv2.imencode(".png", refused)[1].tobytes())
    return place


@pytest.fixture
def scan(client: TestClient, served: ServedBench) -> str:
    scan_id: str = client.post("/scan").json()["id"]
    assert ended(client, scan_id)["state"] == "succeeded"
    prepare(served, scan_id)
    return scan_id


@pytest.fixture
def busy(served: ServedBench, tmp_path: Path) -> Iterator[Path]:
    """Has the worker wait for this file."""
    gate = tmp_path / "gate"
    began = threading.Event()
    task = Task(f"{PIPELINE}:wait_for", (gate,), what="examination")

    def began_and_goes_on() -> bool:
        began.set()
        return False

    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(served.worker.run, task, cancelled=began_and_goes_on)
        try:
            assert began.wait(WAIT_S)
            yield gate
        finally:
            gate.touch()
            assert done.result(WAIT_S) == gate.name


def test_a_cloud_is_listed_made_when_asked_for_and_kept(client: TestClient, served: ServedBench, scan: str) -> None:
    place = served.service.folder.scan(UUID(scan))
    path = client.get(f"/scan/{scan}").json()["links"]["files"][NAME]
    assert path == f"/scan/{scan}/{NAME}"
    assert not (place / NAME).exists()
    first = client.get(path)
    assert first.status_code == 200, first.text
    assert first.content == (place / NAME).read_bytes()
    with np.load(io.BytesIO(first.content)) as cloud:
        assert (cloud["unit"], cloud["camera"]) == ("mm", "left")
        assert cloud["causes"].tolist() == ["none", "not_lit", "no_surface"]
        np.testing.assert_allclose(cloud["points_mm"][13, 15], (3, 3, 0), atol=1e-6)
        assert cloud["colour"][13, 15].tolist() == [94, 98, 102]
        assert [cloud["cause"][at] for at in ((11, 13), (13, 15), (29, 39))] == [1, 0, 2]
        assert (np.isfinite(cloud["points_mm"]).all(axis=2) == (cloud["cause"] == 0)).all()
    before = (place / NAME).stat()
    part = client.get(path, headers={"Range": "bytes=5-9"})
    assert (part.status_code, part.content) == (206, first.content[5:10])
    assert client.head(path).headers["Content-Length"] == str(len(first.content))
    assert client.get(path, headers={"If-None-Match": first.headers["ETag"]}).status_code == 304
    assert (place / NAME).stat().st_ino == before.st_ino


def test_what_has_no_cloud_says_so(client: TestClient, served: ServedBench, scan: str, tmp_path: Path) -> None:
    unknown = client.get(f"/scan/{scan}/points-top.npz")
    assert (unknown.status_code, unknown.json()["type"]) == (409, "/problems/artefact-not-ready")
    assert client.get(f"/scan/{scan}/points-..%2Fleft.npz").status_code in {404, 422}
    place = served.service.folder.scan(UUID(scan))
    for source in ("causes-left.png", "bundle/calibration.json", "report.json", "mesh.ply"):
        (place / source).rename(tmp_path / "moved")
        (place / source).symlink_to(tmp_path / "moved")
        assert NAME not in client.get(f"/scan/{scan}").json()["links"]["files"], source
        assert client.get(f"/scan/{scan}/{NAME}").status_code == 409, source
        (place / source).unlink()
        (tmp_path / "moved").rename(place / source)
    served.order = "fail"
    failed = client.post("/scan").json()["id"]
    assert list(ended(client, failed)["links"]["files"]) == ["bundle.zip"]
    assert client.get(f"/scan/{failed}/{NAME}").status_code == 409
    served.order = "finish"
    held = served.held(client)["id"]
    early = client.get(f"/scan/{held}/{NAME}")
    assert (early.status_code, "capturing" in early.json()["detail"]) == (409, True)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("causes-left.png", cv2.imencode(".png", np.zeros((5, 5), dtype=np.uint8))[1].tobytes()),
        ("causes-left.png", b"no picture"),
        ("report.json", b"{}"),
        ("report.json", b"[]"),
        ("mesh.ply", b"ply"),
        ("bundle/calibration.json", b"{}"),
    ],
)
def test_a_source_that_was_changed_is_told(
    client: TestClient, served: ServedBench, scan: str, name: str, content: bytes
) -> None:
    place = served.service.folder.scan(UUID(scan))
    (place / name).write_bytes(content)
    refused = client.get(f"/scan/{scan}/{NAME}")
    assert refused.status_code == 422
    assert Path(name).name in refused.json()["detail"]
    assert not [each for each in place.iterdir() if NAME in each.name]


def test_a_format_whose_library_is_missing_is_not_listed_and_says_what_to_install(
    client: TestClient, scan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "extra_of", lambda ending: "pip install" if ending == ".e57" else None)
    files = client.get(f"/scan/{scan}").json()["links"]["files"]
    assert {"points-left.pcd", "depth-left.tiff", NAME} < set(files)
    assert "points-left.e57" not in files
    answer = client.get(f"/scan/{scan}/points-left.e57")
    if importlib.util.find_spec("pye57") is None:
        assert (answer.status_code, answer.json()["type"]) == (501, "/problems/extra-missing")
        assert "pip install 'slrig[e57]'" in answer.json()["detail"]
    else:
        assert (answer.status_code, answer.headers["Content-Type"]) == (200, "model/e57")


def test_a_scan_is_one_bag_of_all_its_cameras(
    client: TestClient, served: ServedBench, scan: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library("rosbags.rosbag2")
    place = served.service.folder.scan(UUID(scan))
    (place / "bundle" / "bundle.json").unlink()
    assert BAG not in client.get(f"/scan/{scan}").json()["links"]["files"]
    assert client.get(f"/scan/{scan}/{BAG}").status_code == 409
    white = np.arange(SIZE.width_px * SIZE.height_px, dtype=np.uint16).reshape(SIZE.shape).astype(np.uint8)
    moment = datetime(2026, 3, 4, 5, 6, 7, tzinfo=UTC)
    forms = {"left": CameraFormat(SIZE, 8)}
    with BundleWriter(tmp_path / "bundle", SIZE, [White()], forms, captured_at=moment) as bundle:
        bundle.add(Shot(0, "left", white))
    shutil.copytree(tmp_path / "bundle", place / "bundle", dirs_exist_ok=True)
    files = client.get(f"/scan/{scan}").json()["links"]["files"]
    assert client.get(files["calibration.json"]).json()["cameras"]["left"]["size_px"] == [40, 30]
    fetched = client.get(files[BAG])
    assert fetched.status_code == 200, fetched.text
    assert fetched.content == (place / BAG).read_bytes()
    with library("rosbags.highlevel").AnyReader([place / BAG]) as reader:
        said = {each.topic: (at, reader.deserialize(data, each.msgtype)) for each, at, data in reader.messages()}
    assert {at for at, _ in said.values()} == {int(moment.timestamp()) * 10**9}
    columns = point_columns(said["/slrig/left/points"][1])
    np.testing.assert_allclose([columns[axis][13, 15] for axis in "xyz"], (0.003, 0.003, 0), atol=1e-9)
    np.testing.assert_array_equal(said["/slrig/left/image_raw"][1].data.reshape(SIZE.shape), white)
    monkeypatch.setattr(clouds, "extra_of", lambda ending: "pip install" if ending == ".mcap" else None)
    assert BAG not in client.get(f"/scan/{scan}").json()["links"]["files"]


def test_a_request_waits_for_its_turn_and_not_for_ever(
    client: TestClient, scan: str, busy: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(clouds, "LONGEST_WAIT_S", 0.05)
    refused = client.get(f"/scan/{scan}/{NAME}")
    assert (refused.status_code, refused.json()["type"]) == (503, "/problems/worker-busy")
    assert (refused.headers["Retry-After"], NAME in refused.json()["detail"]) == ("5", True)
    monkeypatch.setattr(clouds, "LONGEST_WAIT_S", WAIT_S)
    with ThreadPoolExecutor(2) as pool:
        asked = [pool.submit(client.get, f"/scan/{scan}/{NAME}") for _ in range(2)]
        assert not any(each.done() for each in asked)
        busy.touch()
        assert [each.result(WAIT_S).status_code for each in asked] == [200, 200]


def test_few_requests_wait_at_once(client: TestClient, scan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    places = threading.BoundedSemaphore(1)
    monkeypatch.setattr(clouds, "_places", places)
    with places:
        refused = client.get(f"/scan/{scan}/{NAME}")
        assert (refused.status_code, refused.json()["type"]) == (503, "/problems/worker-busy")
    for _ in range(2):
        assert client.get(f"/scan/{scan}/{NAME}").status_code == 200


def test_a_scan_that_is_deleted_meanwhile_is_not_found(
    client: TestClient, served: ServedBench, scan: str, busy: Path
) -> None:
    before = served.worker.jobs
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(client.get, f"/scan/{scan}/{NAME}")
        while served.worker.jobs == before:
            assert not asked.done()
            threading.Event().wait(0.01)
        assert client.delete(f"/scan/{scan}").status_code == 204
        busy.touch()
        gone = asked.result(WAIT_S)
    assert (gone.status_code, gone.json()["type"]) == (404, "/problems/job-not-found")
    assert not served.service.folder.scan(UUID(scan)).exists()


def test_a_full_disk_and_a_lost_worker_leave_nothing_behind(
    client: TestClient, served: ServedBench, scan: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = served.service.folder.scan(UUID(scan))
    before = sorted(place.iterdir())
    with monkeypatch.context() as patched:
        patched.setattr(served, "free_bytes", 10)
        full = client.get(f"/scan/{scan}/{NAME}")
        assert (full.status_code, full.json()["type"]) == (507, "/problems/storage")
    with monkeypatch.context() as patched:
        patched.setattr(clouds, "MAKER", f"{PIPELINE}:crash")
        lost = client.get(f"/scan/{scan}/{NAME}")
        assert (lost.status_code, lost.json()["type"]) == (500, "/problems/worker-lost")
        assert "Ask again." in lost.json()["detail"]
    assert sorted(place.iterdir()) == before
    assert client.get(f"/scan/{scan}/{NAME}").status_code == 200
