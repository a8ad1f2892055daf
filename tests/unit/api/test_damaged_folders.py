"""What a disk does to a data folder: bits that flip, files that are cut, emptied or gone, and garbage."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient

from slrig.jobs.data_folder import check_files
from tests.core import parametrize_core
from tests.unit.api.conftest import ServedBench, client_of, ended
from tests.unit.api.test_calibration import BOARD, opened, settled, shot


@contextmanager
def serving(root: Path) -> Iterator[tuple[ServedBench, TestClient]]:
    """A service that starts on a data folder."""
    served = ServedBench(root)
    try:
        with client_of(served) as client:
            yield served, client
    finally:
        served.service.close()
        served.unpatch()


@dataclass(frozen=True)
class Sound:
    """A data folder before it was damaged. answers : what each path of the service gave."""

    root: Path
    answers: dict[str, bytes]

    @property
    def files(self) -> list[str]:
        """Its files, by their paths in it."""
        return sorted(path.relative_to(self.root).as_posix() for path in self.root.rglob("*") if path.is_file())


def fetched(client: TestClient) -> dict[str, tuple[int, bytes]]:
    """Every file of every job and calibration that the service lists, with its status."""
    paths = set()
    for each in (*client.get("/scan").json()["scans"], *client.get("/model").json()["models"]):
        paths.update(client.get(each["links"]["self"]).json()["links"]["files"].values())
    for each in client.get("/calibration").json()["calibrations"]:
        paths.update(f"/calibration/{each['id']}/{name}" for name in ("calibration.json", "report.html"))
        paths.add(f"/calibration/{each['id']}/pose/1/picture.png")
    return {path: ((answer := client.get(path)).status_code, answer.content) for path in sorted(paths)}


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Sound:
    root = tmp_path_factory.mktemp("sound") / "data"
    with serving(root) as (served, client):
        scans = [client.post("/scan", json={"if_busy": "queue", "label": f"part {i}"}).json()["id"] for i in range(2)]
        assert [ended(client, scan)["state"] for scan in scans] == ["succeeded"] * 2
        given = {"scans": scans, "poses": [[[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]] * 2}
        model = client.post("/model", json=given).json()
        assert "event: state" in client.get(model["links"]["events"]).text
        calibration = opened(client)["id"]
        for _ in range(3):
            assert shot(client, calibration)["state"] == "succeeded"
        client.post(f"/calibration/{calibration}/solve", json={})
        assert settled(client, calibration)["state"] == "solved"
        assert client.post(f"/calibration/{calibration}/activate").status_code == 200
        preset = client.get("/preset/fast").json()
        assert client.put("/preset/mine", json=preset).status_code == 200
        schedule = {"task": "verification", "cron": "0 3 * * *", "options": {"board": BOARD}}
        assert client.post("/schedule", json=schedule).status_code == 201
        assert client.post("/acceptance", json={}).status_code == 201
        assert all(found is None for _, found in check_files(served.service.folder.root))
        found = fetched(client)
        assert {status for status, _ in found.values()} == {200}
        answers = {path: content for path, (_, content) in found.items()}
    return Sound(root, answers)


def damage(path: Path, kind: str, rng: np.random.Generator) -> None:
    content = bytearray(path.read_bytes())
    match kind:
        case "flipped":
            content[rng.integers(len(content))] ^= 1 << int(rng.integers(8))
        case "cut":
            del content[rng.integers(len(content)) :]
        case "emptied":
            content.clear()
    path.unlink()
    if kind != "removed":
        path.write_bytes(content)


@pytest.mark.parametrize("count", [3, pytest.param(100, marks=pytest.mark.slow)])
def test_damaged_files_of_results_are_reported_never_served_and_made_anew(
    sound: Sound, tmp_path: Path, count: int
) -> None:
    rng = np.random.default_rng(count)
    results = [name for name, _ in check_files(sound.root)]
    assert {name.split("/")[0] for name in results} == {"scans", "models", "calibrations"}
    for number in range(count):
        name = str(rng.choice(results))
        kind = str(rng.choice(["flipped", "cut", "emptied", "removed"]))
        root = tmp_path / str(number)
        shutil.copytree(sound.root, root)
        damage(root / name, kind, rng)
        what = f"{name} {kind}"
        assert [each for each, found in check_files(root) if found is not None][:1], what
        with serving(root) as (served, client):
            found = fetched(client)
            for path, (status, content) in found.items():
                assert status != 200 or content == sound.answers[path], (what, path)
            refused = {path for path, (status, _) in found.items() if status == 410}
            at_fault = [each for each in client.get("/scan").json()["scans"] if each["error"] is not None]
            if name.startswith(("scans", "models")) and not name.endswith("/record.json"):
                listed = [*at_fault, *(each for each in client.get("/model").json()["models"] if each["error"])]
                assert [each["error"]["type"] for each in listed] == ["/problems/damaged"], what
                # A model that failed offers no file.
                assert refused or "files.json" in name or kind == "removed" or name.startswith("models"), what
                assert 'slrig_damaged_jobs{kind="' in client.get("/metrics").text
            if name.startswith("scans") and "/bundle/" not in name:
                scan = name.split("/")[1]
                again = client.post(f"/scan/{scan}/reconstruct")
                if name.endswith("/files.json"):
                    # Nothing says whether the frames are whole.
                    assert again.status_code == 410, what
                    continue
                assert again.status_code == 202, (what, again.text)
                assert ended(client, scan)["state"] == "succeeded", what
                assert all(each is None for _, each in check_files(served.service.folder.root)), what
                remade = fetched(client)
                assert remade.keys() == sound.answers.keys(), what
                assert {status for status, _ in remade.values()} == {200}, what
        shutil.rmtree(root)


@parametrize_core("kind", ["cut", "removed"], core=[1])
def test_damaged_files_that_were_made_on_request_are_made_anew(sound: Sound, tmp_path: Path, kind: str) -> None:
    root, rng = tmp_path / "data", np.random.default_rng(7)
    shutil.copytree(sound.root, root)
    made = sorted(root.glob("scans/*/view.glb")) + sorted(root.glob("scans/*/mesh.stl"))
    assert len(made) == 4
    for path in (*made, made[0].with_name("made.json")):
        damage(path, kind, rng)
    with serving(root) as (_, client):
        assert {path: content for path, (_, content) in fetched(client).items()} == sound.answers


LISTS = ("/scan", "/model", "/calibration", "/acceptance", "/schedule", "/audit", "/preset")

GARBAGE: dict[str, bytes | None] = {
    "emptied": b"",
    "opened": b"{",
    "list": b"[]",
    "null": b"null",
    "binary": b"\xff\xfe\x00\x80" * 50,
    "deep": b"[" * 100_000,
    "removed": None,
    "folder": None,
}


@pytest.mark.slow
@pytest.mark.parametrize("records", ["kept", "lost"])
def test_service_starts_on_any_damaged_folder_and_serves_what_is_whole(
    sound: Sound, tmp_path: Path, records: str
) -> None:
    count = 100
    rng = np.random.default_rng(count)
    names = [name for name in sound.files if not name.startswith(("keys.json", "lock", "slrig.sqlite-"))]
    if records == "lost":
        names.remove("slrig.sqlite")
    scans = [name.split("/")[1] for name in names if name.endswith("/mesh.ply")]
    for number in range(count):
        name, kind = str(rng.choice(names)), str(rng.choice(list(GARBAGE)))
        root = tmp_path / str(number)
        shutil.copytree(sound.root, root)
        path, content = root / name, GARBAGE[kind]
        path.unlink()
        if content is not None:
            path.write_bytes(content)
        elif kind == "folder":
            path.mkdir()
        if records == "lost":
            (root / "slrig.sqlite").unlink()
        with serving(root) as (_, client):
            for where in (*LISTS, "/rig", "/rig/turntable", "/rig/health", "/rig/examinations", "/metrics"):
                assert client.get(where).status_code == 200, (name, kind, where)
            for scan in scans:
                if scan not in name:
                    mesh = f"/scan/{scan}/mesh.ply"
                    assert client.get(mesh).content == sound.answers[mesh], (name, kind)
        shutil.rmtree(root)
