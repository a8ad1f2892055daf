"""From `slrig scan` to a mesh in millimetres, through the real service, over HTTP, on the rendered rig."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import httpx2
import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from slrig.cli.commands import app
from tests.e2e.conftest import KEY, serving, write_rig

FILES = (
    "mesh.ply", "mesh.glb", "mesh.obj", "points.ply", "preview.png", "report.json", "rejected-left.png",
    "causes-left.png", "points-left.npz", "bundle.zip",
)  # fmt: skip


def slrig(*words: str | Path) -> str:
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.mark.slow
def test_a_scan_of_the_rendered_rig_gives_a_mesh_and_its_bundle_gives_it_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, again = tmp_path / "scan", tmp_path / "again"
    with serving(write_rig(tmp_path / "rig"), tmp_path / "data") as service:
        monkeypatch.setenv("SLRIG_API_KEY", KEY)
        chosen = [word for name in FILES for word in ("--file", name)]
        said = slrig("scan", "--url", service.url, "--output", output, "--label", "walk", *chosen)
        with service.client() as client:
            (scan,) = client.get("/scan")["scans"]
        # The events of all jobs begin after the last one that a client has had.
        headers = {"X-API-Key": KEY, "Last-Event-ID": "2"}
        with httpx2.stream("GET", f"{service.url}/events?after=0", headers=headers, timeout=60) as events:
            assert next(line for line in events.iter_lines() if line.startswith("id:")) == "id: 3"
    assert {path.name for path in output.iterdir()} == set(FILES)
    assert "against the known truth" in said
    report = json.loads((output / "report.json").read_text())
    assert report["truth"]["rms_mm"] < 0.1
    assert (scan["state"], scan["label"]) == ("succeeded", "walk")
    assert scan["summary"]["truth"]["rms_mm"] == report["truth"]["rms_mm"]

    with zipfile.ZipFile(output / "bundle.zip") as archive:
        archive.extractall(tmp_path / "bundle")
    formats = ["--file", "mesh.obj", "--file", "mesh.stl", "--file", "points-left.npz"]
    said = slrig("reconstruct", tmp_path / "bundle", "--output", again, *formats)
    assert f"obj       {again / 'mesh.obj'}" in said
    for name in ("mesh.ply", "mesh.glb", "mesh.obj", "points-left.npz"):
        assert (again / name).read_bytes() == (output / name).read_bytes()
    stl, ply = (trimesh.load(again / name, process=False) for name in ("mesh.stl", "mesh.ply"))
    np.testing.assert_array_equal(stl.triangles, ply.triangles)
