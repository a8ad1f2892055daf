"""`slrig calibrate run` on the rendered rig: from an empty service to a calibration that scans use."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from slrig.bundle import read_calibration
from slrig.cli.commands import app
from tests.e2e.conftest import KEY, Start
from tests.e2e.test_calibration_walk import Caller, write_rig

BOARD = ["--board", "chessboard", "--corners", "8x5", "--square-mm", "20"]


@pytest.mark.slow
def test_positioner_shoots_solves_and_scans_use_the_result(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(write_rig(tmp_path))
    with Caller(service) as call:
        call.ready()
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    monkeypatch.setenv("SLRIG_URL", service.url)

    def calibrate(*arguments: str) -> str:
        done = CliRunner().invoke(app, ["calibrate", *arguments])
        assert done.exit_code == 0, done.output
        return done.stdout

    told = calibrate("run", *BOARD, "--scripted", "--activate", "--label", "spring")
    # The script's first position puts the board behind the wall.
    assert "pose 1 refused" in told
    assert told.count(" accepted\n") >= 8
    assert "Scans use this calibration from now on." in told

    (listed,) = json.loads(calibrate("list", "--json"))["calibrations"]
    assert (listed["label"], listed["state"], listed["active"]) == ("spring", "solved", True)
    assert listed["verdict"].partition(":")[0].upper() in told
    shown = json.loads(calibrate("show", listed["id"][:8], "--json"))
    rms = {name: device["rms_px"] for name, device in shown["result"]["devices"].items()}
    for name in ("left", "projector"):
        assert f"{rms[name]:.3f}" in told, name

    calibrate("export", listed["id"], str(tmp_path / "rig.json"))
    exported = read_calibration(tmp_path / "rig.json")
    assert exported.solved is not None
    assert exported.solved.expected_error_mm == pytest.approx(shown["result"]["expected"]["point_mm"])
    calibrate("export", listed["id"], str(tmp_path / "report.html"))
    assert "data:image/jpeg" in (tmp_path / "report.html").read_text(encoding="utf-8")

    assert "imported" in calibrate("import", str(tmp_path / "rig.json"), "--label", "again")
    first, second = (each["id"] for each in json.loads(calibrate("list", "--json"))["calibrations"])
    compared = json.loads(calibrate("compare", first, second, "--json"))
    assert compared["moved_most_mm"] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_camera_is_calibrated_alone_by_the_service_and_again_from_its_poses(
    start: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = start(write_rig(tmp_path))
    with Caller(service) as call:
        call.ready()
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    monkeypatch.setenv("SLRIG_URL", service.url)

    def calibrate(*arguments: str, code: int = 0) -> str:
        done = CliRunner().invoke(app, ["calibrate", *arguments])
        assert done.exit_code == code, done.output
        return done.stdout if code == 0 else " ".join(done.stderr.split())

    refused = calibrate("run", *BOARD, "--cameras-alone", "--scripted", "--activate", code=2)
    assert "of camera 'left' alone, without a projector: it tells no depth, and cannot scan" in refused
    (listed,) = json.loads(calibrate("list", "--json"))["calibrations"]
    assert (listed["state"], listed["active"]) == ("solved", False)
    assert "across the line of sight" in listed["verdict"]
    shown = json.loads(calibrate("show", listed["id"][:8], "--json"))["result"]
    assert set(shown["devices"]) == {"left"}
    for name, truth in (("fx", 475.0), ("fy", 475.5), ("cx", 160.6), ("cy", 126.1)):
        value, sigma = shown["devices"]["left"]["values"][name]
        assert abs(value - truth) < 5 * sigma, name
    assert "across the line of sight" in " ".join(calibrate("show", listed["id"][:8]).split())
    calibrate("export", listed["id"], str(tmp_path / "report.html"))
    assert "data:image/jpeg" in (tmp_path / "report.html").read_text(encoding="utf-8")

    poses = service.data / "calibrations" / listed["id"] / "poses"
    output, report = tmp_path / "camera.json", tmp_path / "again.html"
    again = calibrate("solve", str(poses), *BOARD, "--output", str(output), "--report", str(report), "--json")
    assert json.loads(again)["expected"]["point_mm"] == pytest.approx(shown["expected"]["point_mm"], rel=1e-3)
    found = read_calibration(output)
    assert (list(found.cameras), found.projector) == (["left"], None)
    assert "Expected error across the line of sight" in report.read_text(encoding="utf-8")
