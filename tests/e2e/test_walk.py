"""From POST /scan to a mesh in millimetres, through the real service, over HTTP, on the rendered rig."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from slrig.cli.commands import app
from tests.e2e.conftest import KEY, Start, write_rig


def test_scan_of_the_rendered_rig_gives_a_mesh_whose_bundle_gives_it_again(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(write_rig(tmp_path / "rig"))
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    output = tmp_path / "scan"
    files = (
        "mesh.ply",
        "mesh.glb",
        "mesh.obj",
        "points.ply",
        "preview.png",
        "report.json",
        "rejected-left.png",
        "causes-left.png",
        "points-left.npz",
        "bundle.zip",
    )
    chosen = [argument for name in files for argument in ("--file", name)]
    result = CliRunner().invoke(
        app, ["scan", "--url", service.url, "--output", str(output), "--label", "walk", *chosen]
    )
    assert result.exit_code == 0, result.output
    assert {path.name for path in output.iterdir()} == set(files)
    assert "against the known truth" in result.stdout

    report = json.loads((output / "report.json").read_text())
    assert report["truth"]["rms_mm"] < 0.1
    with service.client() as client:
        (scan,) = client.get("/scan")["scans"]
    assert (scan["state"], scan["label"]) == ("succeeded", "walk")
    assert scan["summary"]["truth"]["rms_mm"] == report["truth"]["rms_mm"]

    with zipfile.ZipFile(output / "bundle.zip") as archive:
        archive.extractall(tmp_path / "bundle")
    again = tmp_path / "again"
    formats = ["--file", "mesh.obj", "--file", "mesh.stl", "--file", "points-left.npz"]
    result = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "bundle"), "--output", str(again), *formats])
    assert result.exit_code == 0, result.output
    assert f"obj       {again / 'mesh.obj'}" in result.stdout
    for name in ("mesh.ply", "mesh.glb", "mesh.obj", "points-left.npz"):
        assert (again / name).read_bytes() == (output / name).read_bytes()
    stl, ply = (trimesh.load(again / name, process=False) for name in ("mesh.stl", "mesh.ply"))
    np.testing.assert_array_equal(stl.triangles, ply.triangles)
    assert service.stop() == 0


GAP_MM = 4.0
TWO_PLATES = "".join(
    f"""
[[object]]
name = "{name}"
shape = "plane"
size_mm = [160.0, 50.0]
position_mm = [0.0, {side * (25.0 + GAP_MM / 2)}, 0.0]
albedo = 0.8
"""
    for name, side in (("upper", -1), ("lower", 1))
)


@pytest.mark.slow
def test_holes_are_kept_when_the_request_or_the_command_asks_for_it(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(write_rig(tmp_path / "rig", scene=f'name = "plates"{TWO_PLATES}'))
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    # A sampling distance is about half a millimetre, so this would span the gap.
    reach = ["--depth-edge-ratio", "60"]
    files = [argument for name in ("mesh.ply", "report.json", "bundle.zip") for argument in ("--file", name)]

    def outcome(folder: Path) -> tuple[bool, int, bool]:
        """What was asked, what was dropped, and whether a triangle spans the gap."""
        report = json.loads((folder / "report.json").read_text())
        mesh = trimesh.load(folder / "mesh.ply", process=False)
        height = np.asarray(mesh.vertices)[np.asarray(mesh.faces), 1]
        spans = (height.max(axis=1) - height.min(axis=1) > 0.8 * GAP_MM).any()
        return report["plan"]["keep_holes"], report["mesh"]["initial"]["dropped_at_bridges"], bool(spans)

    scanned = tmp_path / "scan"
    command = ["scan", "--url", service.url, "--output", str(scanned), "--keep-holes", *reach, *files]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0, result.output
    with zipfile.ZipFile(scanned / "bundle.zip") as archive:
        archive.extractall(tmp_path / "bundle")
    kept, dropped, spans = outcome(scanned)
    assert (kept, spans) == (True, False)
    assert dropped > 100

    bundle = str(tmp_path / "bundle")
    for option, wanted in (("--keep-holes", (True, dropped, False)), ("--close-holes", (False, 0, True))):
        again = tmp_path / option.strip("-")
        result = CliRunner().invoke(app, ["reconstruct", bundle, "--output", str(again), option, *reach])
        assert result.exit_code == 0, result.output
        assert outcome(again) == wanted
    assert service.stop() == 0


@pytest.mark.slow
def test_demo_ends_with_a_mesh_its_error_and_what_to_do_next(tmp_path: Path) -> None:
    rig = write_rig(tmp_path / "rig")
    output = tmp_path / "demo"
    for _ in range(2):
        result = CliRunner().invoke(app, ["demo", str(rig), "--output", str(output)])
        assert result.exit_code == 0, result.output
    for name in ("mesh.ply", "preview.png", "report.json"):
        assert str(output / name) in result.stdout
        assert (output / name).stat().st_size > 0
    assert "rms" in result.stdout
    assert f"removed   1 earlier demo scan of rig 'small' from {output / 'service'}" in result.stdout
    # What it tells to try next is there to be tried, and only the last run's scan is kept.
    (bundle,) = (output / "service" / "scans").glob("*/bundle")
    assert f"slrig reconstruct {bundle}" in result.stdout
    assert not (output / "service" / "service.json").exists()


@pytest.mark.slow
def test_failed_scan_tells_the_person_why(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = start(write_rig(tmp_path / "rig", faults="[head.faults]\nlamp_off = true"))
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    result = CliRunner().invoke(app, ["scan", "--url", service.url, "--output", str(tmp_path / "scan")])
    assert result.exit_code == 2
    assert "error: Scan" in result.stderr
    assert not (tmp_path / "scan").exists()


@pytest.mark.slow
def test_wrong_key_is_told_by_the_client(start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    service = start(write_rig(tmp_path / "rig"))
    monkeypatch.setenv("SLRIG_API_KEY", "wrong")
    result = CliRunner().invoke(app, ["scan", "--url", service.url, "--output", str(tmp_path / "scan")])
    assert result.exit_code == 2
    assert "API key" in result.stderr
