"""What becomes of a service whose data folder holds links, or is gone."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator
from pathlib import Path
from uuid import UUID

import pytest
from fastapi.testclient import TestClient

from tests.unit.api.conftest import KEY, ServedBench, ended
from tests.unit.api.test_methods import DOCUMENT, filled

FOREIGN = "what is not ours to show"


def test_link_among_the_files_of_a_scan_is_not_served(client: TestClient, served: ServedBench, tmp_path: Path) -> None:
    secret = tmp_path / "secret"
    secret.write_text(FOREIGN)
    scan = client.post("/scan").json()["id"]
    ended(client, scan)
    place = served.service.folder.scan(UUID(scan))
    for name in ("report.json", "preview.png", "mesh.obj", "mesh.ply"):
        (place / name).unlink(missing_ok=True)
        (place / name).symlink_to(secret)
    (place / "bundle" / "frame.png").symlink_to(secret)
    (place / "bundle" / "more").symlink_to(tmp_path)
    files = client.get(f"/scan/{scan}").json()["links"]["files"]
    assert sorted(files) == ["bundle.zip", "mesh.glb", "points.ply"]
    for name in ("report.json", "preview.png", "mesh.obj", "mesh.stl", "view.glb", "mesh.ply"):
        answer = client.get(f"/scan/{scan}/{name}")
        assert (answer.status_code, answer.json()["type"]) == (409, "/problems/artefact-not-ready"), name
    with zipfile.ZipFile(io.BytesIO(client.get(files["bundle.zip"]).content)) as archive:
        names = archive.namelist()
        assert "frame.png" not in names
        assert not [name for name in names if name.startswith("more")]
        assert all(FOREIGN.encode() not in archive.read(name) for name in names)
    assert client.delete(f"/scan/{scan}").status_code == 204
    assert secret.read_text() == FOREIGN


@pytest.fixture
def idle(tmp_path: Path) -> Iterator[ServedBench]:
    """A service that was not started: nothing but requests uses its folder."""
    served = ServedBench(tmp_path / "data")
    yield served
    served.service.close()


def test_service_whose_data_folder_is_gone_says_so(idle: ServedBench) -> None:
    headers = {"Authorization": f"Bearer {KEY}"}
    client = TestClient(idle.app, base_url="http://127.0.0.1", headers=headers, raise_server_exceptions=False)
    root = idle.service.folder.root
    away = root.with_name("away")
    root.rename(away)
    without = {"/livez", "/device", "/problems/{name}", "/calibration/board.pdf"}
    for path, operations in DOCUMENT.items():
        for method in operations:
            if path in without or path.startswith("/session"):
                continue
            answer = client.request(method, filled(path))
            assert answer.status_code in ({422, 503} if method in {"post", "get"} else {503}), (method, path)
            if path == "/readyz":
                assert "is gone, or empty" in answer.json()["checks"]["disk"]
            elif answer.status_code == 503:
                assert answer.json()["type"] == "/problems/data-folder-gone"
    assert client.get("/livez").status_code == 200
    away.rename(root)
    assert client.get("/scan").status_code == 200
