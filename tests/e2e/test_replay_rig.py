"""A recording as a rig: POST /scan on it gives the recording again, and from it the original mesh, byte for byte."""

from __future__ import annotations

import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from drivers.replay import open_head
from slrig.bundle import read_capture
from slrig.devices import CameraSettings, Rig
from slrig.model import Capture
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.e2e.conftest import ServiceProcess, Start, write_rig

SECOND_CAMERA = """
[[head.camera]]
name = "right"
size_px = [240, 192]
saturation_s = 0.02
focal_px = [952.0, 950.0]
position_mm = [160.0, 10.0, -560.0]
target_mm = [0.0, 0.0, 0.0]
blur_px = 0.6
bit_depth = 12
"""
MESHES = ("mesh.ply", "points.ply")


def scanned(start: Start, rig: Path, data: Path) -> Path:
    """Serve a rig, POST one scan; the folder of its files."""
    service = start(rig, data)
    with service.client() as client:
        scan = client.scans.start()
        for _ in client.follow(scan["links"]["events"]):
            pass
        record = client.get(scan["links"]["self"])
    assert record["state"] == "succeeded", record
    assert service.stop() == 0
    return data / "scans" / str(record["id"])


def reconstructed(bundle: Path, output: Path) -> Path:
    """What `slrig reconstruct` writes."""
    reconstruct_bundle(bundle, output, plan=ReconstructionPlan(), progress=lambda *_: None, cancelled=lambda: False)
    return output


def frames(bundle: Path) -> list[dict[str, Any]]:
    description: dict[str, Any] = json.loads((bundle / "bundle.json").read_text())
    found: list[dict[str, Any]] = description["frames"]
    return found


def images(capture: Capture) -> dict[tuple[int, str], bytes]:
    return {(shot.pattern, shot.camera): shot.image.tobytes() for shot in capture.shots}


def require_equal_meshes(first: Path, second: Path) -> None:
    for name in MESHES:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """The bundle of a scan, the folder of that scan's other files, and what is reconstructed from the bundle."""
    folder = tmp_path_factory.mktemp("recording")
    with ExitStack() as leaving:

        def start(rig: Path, data: Path) -> ServiceProcess:
            service = ServiceProcess(rig, data)
            leaving.callback(lambda: service.kill() if service.process.poll() is None else None)
            return service

        original = scanned(start, write_rig(folder / "rig", faults=SECOND_CAMERA), folder / "first")
    bundle = folder / "bundle"
    (original / "bundle").rename(bundle)
    return bundle, original, reconstructed(bundle, folder / "reconstructed")


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0, 20])
def test_a_scan_of_a_recorded_scan_is_that_scan(
    start: Start, tmp_path: Path, recording: tuple[Path, Path, Path], speed: int
) -> None:
    bundle, original, from_bundle = recording
    rig = tmp_path / "replayed.toml"
    rig.write_text(f'name = "replayed"\n[head]\ndriver = "replay"\nbundle = "{bundle}"\nspeed = {speed}\n')
    again = scanned(start, rig, tmp_path / "second")
    # Times and exposures to the last digit, every pixel, and therefore every byte of the mesh.
    assert frames(again / "bundle") == frames(bundle)
    assert images(read_capture(again / "bundle")) == images(read_capture(bundle))
    require_equal_meshes(again, original)
    require_equal_meshes(again, from_bundle)


@pytest.mark.shared
@pytest.mark.slow
def test_a_scan_of_somebody_elses_recording_gives_its_mesh(shared: Path, tmp_path: Path) -> None:
    bundle = shared / "bundles" / "gauge"
    head = open_head({"bundle": str(bundle)}, tmp_path)
    settings = {name: CameraSettings(camera.info.exposure_range_s[0]) for name, camera in head.cameras.items()}
    plan = ScanPlan()
    again = tmp_path / "again"
    with Rig("replayed", head.cameras, head.projector, settings, head.calibration, head) as rig:
        capture_frames(rig, plan, again, progress=lambda *_: None, cancelled=lambda: False).finish()
    require_equal_meshes(reconstructed(again, tmp_path / "new"), reconstructed(bundle, tmp_path / "old"))
