"""Drivers of other people's packages, installed by pip: found, examined, served and scanned with; some of them fail."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from slrig.bundle import write_calibration
from slrig.cli.commands import app
from slrig.model import Calibration, Pinhole, Size
from tests.e2e.conftest import KEY, ServiceProcess, Start, start
from tests.plugin.conftest import path_with, slrig

__all__ = ["start"]

pytestmark = pytest.mark.slow

DISTANCE_MM = 500.0
RIG = """
name = "chart"
calibration = "chart.json"
[projector]
driver = "example_lamp"
light = "light.jsonl"
[[camera]]
name = "left"
driver = "{driver}"
device = "chart-1"
light = "light.jsonl"
exposure_s = 0.01
"""


def chart_rig(folder: Path, *, driver: str = "example_chart") -> Path:
    """A rig file for the example camera and projector: the chart is a plane that faces both of them.

    The lamp's rows are stretched over the camera's pixels, which is what such a plane does at the distance that these
    focal lengths and centres stand for.
    """
    folder.mkdir(parents=True, exist_ok=True)
    camera, projector, focal_px, baseline_mm = Size(320, 240), Size(128, 96), 400.0, 100.0
    share = projector.width_px / camera.width_px
    devices = [
        Pinhole(
            size,
            np.array([[scale * focal_px, 0, centre_px], [0, scale * focal_px, (size.height_px - 1) / 2], [0, 0, 1]]),
            np.zeros(5),
            np.eye(3),
            np.array([-x_mm, 0.0, 0.0]),
        )
        for size, scale, x_mm, centre_px in (
            (camera, 1.0, 0.0, (camera.width_px - 1) / 2),
            (
                projector,
                share,
                baseline_mm,
                (projector.width_px - 1) / 2 + share * focal_px * baseline_mm / DISTANCE_MM,
            ),
        )
    ]
    write_calibration(folder / "chart.json", Calibration({"left": devices[0]}, devices[1]))
    (folder / "rig.toml").write_text(RIG.format(driver=driver))
    return folder / "rig.toml"


@pytest.fixture
def serves(
    start: Start, example_site: Path, broken_site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], ServiceProcess]:
    """Starts a service of a camera driver, next to broken plug-ins."""
    monkeypatch.setenv("PYTHONPATH", path_with(example_site, broken_site))
    monkeypatch.setenv("SLRIG_API_KEY", KEY)
    return lambda driver: start(chart_rig(tmp_path / "rig", driver=driver))


def test_devices_lists_what_is_installed_found_broken_and_missing(
    example_site: Path, broken_site: Path, tmp_path: Path
) -> None:
    path = path_with(example_site, broken_site)
    done = slrig("devices", "--json", path=path, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    # What a plug-in prints is not part of our answer.
    assert "Vendor SDK" in done.stderr
    document: dict[str, Any] = json.loads(done.stdout)
    drivers = {(driver["kind"], driver["name"]): driver for driver in document["drivers"]}
    example = drivers["camera", "example_chart"]
    assert (example["package"], example["version"], example["fault"]) == ("example-slrig-camera", "1.0", None)
    assert {"driver": "example_chart", "device": "chart-0", "label": "test chart, soft squares"} in document["devices"]
    assert drivers["head", "simulated"]["fault"] is None

    (broken,) = document["broken"]
    assert (broken["package"], broken["drivers"]) == ("slrig-broken-import", ["broken_import"])
    assert "RuntimeError: built for firmware [2.x], found 3.1" in broken["fault"]
    assert broken["remove"] == "pip uninstall slrig-broken-import"
    assert any("'broken_finder' failed: OSError: [Errno 5] the bus does not" in fault for fault in document["faults"])
    # A factory is only called when a rig names it.
    assert drivers["camera", "broken_factory"]["fault"] is None
    lacking = {library["driver"]: library["install"] for library in document["missing"]}
    assert lacking["lacking"] == "pip install 'slrig-lacking-library[vendor]'"


def test_options_are_listed_if_a_driver_describes_them(example_site: Path, tmp_path: Path) -> None:
    path = path_with(example_site)
    done = slrig("devices", "--options", "example_chart", path=path, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "speed_px_s  number      px/s  0\n    How fast the chart moves to the right.\n" in done.stdout
    done = slrig("devices", "--options", "example_lamp", path=path, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "'example_lamp' does not describe its options" in done.stdout


def test_init_writes_a_rig_of_plug_ins_that_opens(example_site: Path, tmp_path: Path) -> None:
    path = path_with(example_site)
    settings = ["--exposure-s", "0.01", "--set", "camera.light=light.jsonl", "--set", "projector.light=light.jsonl"]
    named = ["--camera", "example_chart:chart-1", "--projector", "example_lamp", *settings]
    done = slrig("init", *named, path=path, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    code = (
        "from pathlib import Path; from slrig.config import read_rig; from slrig.discovery import open_rig\n"
        "with open_rig(read_rig(Path('rig.toml'))) as rig: print(rig.cameras['camera'].info.serial)"
    )
    opened = subprocess.run(  # noqa: S603 - our own command
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert opened.stdout == "chart-1\n", opened.stderr


def test_the_example_conforms(example_site: Path, tmp_path: Path) -> None:
    done = slrig("conform", str(chart_rig(tmp_path)), "--json", path=path_with(example_site), folder=tmp_path)
    report = json.loads(done.stdout)
    failures = [check["failure"] for check in report["checks"] if check["outcome"] == "failed"]
    assert done.returncode == 0, failures
    assert report["conforms"]
    assert report["passed"] >= 30


def test_a_scan_with_the_example_beside_broken_plug_ins_is_a_plane_at_its_distance(
    serves: Callable[[str], ServiceProcess], tmp_path: Path
) -> None:
    service = serves("example_chart")
    output = tmp_path / "scan"
    result = CliRunner().invoke(app, ["scan", "--url", service.url, "--output", str(output)])
    assert result.exit_code == 0, result.output
    mesh = trimesh.load(output / "mesh.ply", process=False)
    off_mm = np.abs(np.asarray(mesh.vertices)[:, 2] + DISTANCE_MM)
    assert len(off_mm) > 20_000
    assert np.median(off_mm) < 0.2
    assert np.percentile(off_mm, 99) < 1.0
    with service.client() as client:
        rig, device = client.get("/rig"), client.get("/device")
    assert rig["open"]
    assert [(camera["name"], camera["model"], camera["triggers"]) for camera in rig["cameras"]] == [
        ("left", "test chart camera", ["free"])
    ]
    assert rig["projector"]["model"] == "test chart lamp"
    assert "example_chart" in {driver["name"] for driver in device["drivers"]}
    assert "chart-0" in {found["device"] for found in device["devices"]}
    faults = {driver["name"]: driver["fault"] for driver in device["drivers"] if driver["kind"] == "camera"}
    assert "firmware [2.x]" in faults["broken_import"]
    assert any("the bus does not answer" in fault for fault in device["faults"])
    assert "lacking" in {library["driver"] for library in device["missing"]}
    assert service.stop() == 0


@pytest.mark.parametrize(
    ("driver", "told"),
    [
        ("broken_import", "cannot be loaded (slrig_broken_import:open_camera): RuntimeError"),
        ("broken_factory", "camera driver 'broken_factory' failed to open its device: KeyError: 'no handle for left'"),
        ("lacking", "run: pip install 'slrig-lacking-library[vendor]'"),
    ],
)
def test_a_rig_that_names_a_broken_driver_says_why_and_the_service_goes_on(
    serves: Callable[[str], ServiceProcess], tmp_path: Path, driver: str, told: str
) -> None:
    service = serves(driver)
    result = CliRunner().invoke(app, ["scan", "--url", service.url, "--output", str(tmp_path / "scan")])
    assert result.exit_code == 2
    assert told in result.stderr.replace("\n", " ")
    with service.client() as client:
        rig = client.get("/rig")
    assert not rig["open"]
    assert told in rig["error"]
    assert service.stop() == 0
