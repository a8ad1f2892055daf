"""A driver of somebody else for a vendor's SDK: a package of its own, examined on the camera that pylon emulates."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from tests.plugin.conftest import slrig

pytestmark = pytest.mark.slow

DEVICE = "0815-0000"
RIG = """
name = "emulated"
[projector]
driver = "pylon_scene"
scene = "scene"
camera_px = [320, 240]
[[camera]]
name = "left"
driver = "pylon"
device = "{device}"
exposure_s = 0.01
features = {{ Width = 320, Height = 240, TestImageSelector = "Off", ImageFilename = "{scene}", ImageFileMode = "On" }}
"""
CANNOT = (
    "a free-running camera",
    "a positioner",
    "a camera that is triggered by wire",
    "a projector that plays sequences by itself, and a camera that it triggers by wire",
)


def run(*arguments: str, path: str, folder: Path, cameras: int = 1) -> subprocess.CompletedProcess[str]:
    return slrig(*arguments, path=path, folder=folder, environment={"PYLON_CAMEMU": str(cameras)})


def rig_file(folder: Path) -> str:
    (folder / "scene").mkdir()
    (folder / "rig.toml").write_text(RIG.format(device=DEVICE, scene=folder / "scene"))
    return "rig.toml"


def test_the_driver_for_a_vendors_library_conforms(pylon_site: str, tmp_path: Path) -> None:
    done = run("conform", rig_file(tmp_path), "--json", path=pylon_site, folder=tmp_path)
    report = json.loads(done.stdout)
    failures = [check["failure"] for check in report["checks"] if check["outcome"] == "failed"]
    assert done.returncode == 0, failures
    assert report["conforms"]
    assert report["passed"] >= 31
    reasons = [check["reason"] for check in report["checks"] if check["outcome"] == "not applicable"]
    assert set(reasons) == {*(f"it needs {what}" for what in CANNOT), "camera 'left' has no colour"}


def test_its_devices_are_listed(pylon_site: str, tmp_path: Path) -> None:
    listed = json.loads(run("devices", "--json", path=pylon_site, folder=tmp_path, cameras=2).stdout)
    found = [device["device"] for device in listed["devices"] if device["driver"] == "pylon"]
    assert found == [DEVICE, "0815-0001"]
