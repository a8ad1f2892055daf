"""A driver of somebody else for a vendor's SDK: a package of its own, examined on the camera that pylon emulates.

The emulated camera exposes for as long as it is told to, ignores triggers that come meanwhile, gives no time stamps,
and reads what it sees from a folder (`pylon_scene_package`).
"""

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
features = {{ Width = 320, Height = 240, {more} }}
"""
SEES = 'TestImageSelector = "Off", ImageFilename = "{scene}", ImageFileMode = "On"'
CANNOT = (
    "a free-running camera",
    "a positioner",
    "a camera that is triggered by wire",
    "a projector that plays sequences by itself, and a camera that it triggers by wire",
)


def run(*arguments: str, path: str, folder: Path, cameras: int = 1) -> subprocess.CompletedProcess[str]:
    return slrig(*arguments, path=path, folder=folder, environment={"PYLON_CAMEMU": str(cameras)})


def rig_file(folder: Path, *, device: str = DEVICE, more: str | None = None) -> str:
    (folder / "scene").mkdir()
    seen = SEES.format(scene=folder / "scene")
    (folder / "rig.toml").write_text(RIG.format(device=device, more=more or seen))
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


@pytest.mark.parametrize(
    ("device", "more", "told"),
    [
        ("4711", None, f"no camera '4711'; found {DEVICE}"),
        (DEVICE, "OffsetX = 100000", "setting OffsetX"),
    ],
)
def test_what_is_wrong_is_refused_in_slrigs_words(
    pylon_site: str, tmp_path: Path, device: str, more: str | None, told: str
) -> None:
    done = run("conform", rig_file(tmp_path, device=device, more=more), path=pylon_site, folder=tmp_path)
    assert done.returncode != 0
    assert told in done.stderr + done.stdout
    assert "Traceback" not in done.stderr
