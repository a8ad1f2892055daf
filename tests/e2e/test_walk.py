"""From `slrig scan` to a mesh in millimetres, through the real service, over HTTP, on the rendered rig."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import httpx2
import pytest

from tests.e2e.conftest import KEY, serving, write_rig
from tests.unit.command import done

FILES = (
    "mesh.ply", "mesh.glb", "mesh.obj", "points.ply", "preview.png", "report.json", "rejected-left.png",
    "causes-left.png", "points-left.npz", "bundle.zip",
)  # fmt: skip


FORMATS = ("mesh.ply", "mesh.glb", "mesh.obj", "points-left.npz")
"""Of these, those that `slrig reconstruct` writes, too."""


@pytest.mark.parametrize(
    "files", [("mesh.ply", "report.json", "bundle.zip"), pytest.param(FILES, marks=pytest.mark.slow)]
)
def test_a_scan_of_the_rendered_rig_gives_a_mesh_and_its_bundle_gives_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, files: tuple[str, ...]
) -> None:
    output, again = tmp_path / "scan", tmp_path / "again"
    with serving(write_rig(tmp_path / "rig"), tmp_path / "data") as service:
        monkeypatch.setenv("SLRIG_API_KEY", KEY)
        chosen = [word for name in files for word in ("--file", name)]
        said = done("scan", "--url", service.url, "--output", output, "--label", "walk", *chosen)
        with service.client() as client:
            (listed,) = client.get("/scan")["scans"]
            scan = client.get(listed["links"]["self"])
        # The events of all jobs begin after the last one that a client has had.
        headers = {"X-API-Key": KEY, "Last-Event-ID": "2"}
        with httpx2.stream("GET", f"{service.url}/events?after=0", headers=headers, timeout=60) as events:
            assert next(line for line in events.iter_lines() if line.startswith("id:")) == "id: 3"
    assert {path.name for path in output.iterdir()} == set(files)
    assert "against the known truth" in said
    report = json.loads((output / "report.json").read_text())
    assert report["truth"]["rms_mm"] < 0.1
    assert (scan["state"], scan["label"]) == ("succeeded", "walk")
    assert scan["summary"]["truth"]["rms_mm"] == report["truth"]["rms_mm"]

    with zipfile.ZipFile(output / "bundle.zip") as archive:
        archive.extractall(tmp_path / "bundle")
    more = [word for name in ("mesh.obj", "points-left.npz") if name in files for word in ("--file", name)]
    done("reconstruct", tmp_path / "bundle", "--output", again, *more)
    for name in set(FORMATS) & set(files):
        assert (again / name).read_bytes() == (output / name).read_bytes()
