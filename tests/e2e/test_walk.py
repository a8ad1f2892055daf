"""From POST /scan to a mesh in millimetres, through the real service, over HTTP, on the rendered rig."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slrig.cli.commands import app
from tests.e2e.conftest import KEY, Start, write_rig


def test_scan_of_the_rendered_rig_gives_a_mesh_whose_bundle_gives_it_again(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(write_rig(tmp_path / "rig"))
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    output = tmp_path / "scan"
    files = ("mesh.ply", "mesh.glb", "points.ply", "preview.png", "report.json", "rejected-left.png", "bundle.zip")
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
    result = CliRunner().invoke(app, ["reconstruct", str(tmp_path / "bundle"), "--output", str(again)])
    assert result.exit_code == 0, result.output
    assert (again / "mesh.ply").read_bytes() == (output / "mesh.ply").read_bytes()
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
