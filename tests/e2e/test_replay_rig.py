"""A recording as a rig: its scans are the recorded scan, byte for byte, and its service loads no mathematics."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from drivers.replay import open_head
from slrig.bundle import read_capture
from slrig.calibrate.store import USUAL_PATTERNS
from slrig.config import read_rig
from slrig.devices import CameraSettings, Rig
from slrig.discovery import open_rig
from slrig.model import Capture
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from tests.e2e.conftest import ServiceProcess, scanned, serving, write_rig
from tests.e2e.test_calibration_walk import BOARD, Caller
from tests.e2e.test_calibration_walk import write_rig as write_board_rig

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
REPLAYED = 'name = "replayed"\n[head]\ndriver = "replay"\nbundle = "{bundle}"\nspeed = {speed}\n'
MATHEMATICS = ("numba", "llvmlite", "scipy/optimize", "scipy/linalg", "scipy/sparse", "scipy/spatial")


def recorded(rig: Rig, bundle: Path, plan: ScanPlan) -> Path:
    capture_frames(rig, plan, bundle).finish()
    return bundle


def meshes(bundle: Path, output: Path) -> dict[str, bytes]:
    reconstruct_bundle(bundle, output, plan=ReconstructionPlan())
    return written(output)


def written(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("mesh.ply", "points.ply")}


def frames(bundle: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((bundle / "bundle.json").read_text())["frames"]
    return found


def images(capture: Capture) -> dict[tuple[int, str], bytes]:
    return {(shot.pattern, shot.camera): shot.image.tobytes() for shot in capture.shots}


@pytest.mark.slow
def test_a_scan_of_a_recorded_scan_is_that_scan(tmp_path: Path) -> None:
    with open_rig(read_rig(write_rig(tmp_path / "rig", faults=SECOND_CAMERA))) as opened:
        bundle = recorded(opened, tmp_path / "bundle", ScanPlan())
    rig = tmp_path / "replayed.toml"
    rig.write_text(REPLAYED.format(bundle=bundle, speed=20))
    with serving(rig, tmp_path / "data") as service, service.client() as client:
        scan = scanned(client)
    assert scan["state"] == "succeeded", scan
    again = service.data / "scans" / scan["id"]
    # Times and exposures to the last digit, every pixel, and therefore every byte of the mesh.
    assert frames(again / "bundle") == frames(bundle)
    assert images(read_capture(again / "bundle")) == images(read_capture(bundle))
    assert written(again) == meshes(bundle, tmp_path / "reconstructed")


def keys(document: object) -> object:
    """The keys of a report at every depth."""
    return {key: keys(value) for key, value in document.items()} if isinstance(document, dict) else None


@pytest.mark.slow
def test_a_scan_by_sinusoids_gives_what_one_by_lines_gives_and_is_replayed(tmp_path: Path) -> None:
    with serving(write_rig(tmp_path / "rig", faults=SECOND_CAMERA), tmp_path / "data") as service:
        with service.client() as client:
            lines = scanned(client)
            sines = scanned(client, patterns={"sequence": "phase"})
        folders = [service.data / "scans" / scan["id"] for scan in (lines, sines)]
        by_lines, by_sines = (json.loads((folder / "report.json").read_text()) for folder in folders)
    assert (lines["state"], sines["state"]) == ("succeeded", "succeeded"), sines["error"]
    assert sines["links"]["files"].keys() == lines["links"]["files"].keys()
    assert by_sines.keys() == by_lines.keys()
    assert by_sines["evidence"].keys() == by_lines["evidence"].keys()
    for name in by_lines.keys() - {"evidence", "health", "stages_s"}:
        assert keys(by_sines[name]) == keys(by_lines[name]), name
    assert by_sines["truth"]["complete_0.3mm"] > 0.98 * by_lines["truth"]["complete_0.3mm"]
    rig = tmp_path / "replayed.toml"
    rig.write_text(REPLAYED.format(bundle=folders[1] / "bundle", speed=0))
    with serving(rig, tmp_path / "again") as service, service.client() as client:
        again = scanned(client)
        assert again["state"] == "succeeded", again
        assert written(service.data / "scans" / again["id"]) == written(folders[1])


@pytest.mark.shared
@pytest.mark.slow
def test_a_scan_of_another_programs_recording_gives_its_mesh(shared: Path, tmp_path: Path) -> None:
    bundle = shared / "bundles" / "gauge"
    head = open_head({"bundle": str(bundle)}, tmp_path)
    settings = {name: CameraSettings(camera.info.exposure_range_s[0]) for name, camera in head.cameras.items()}
    with Rig("replayed", head.cameras, head.projector, settings, head.calibration, head) as rig:
        again = recorded(rig, tmp_path / "again", ScanPlan())
    assert meshes(again, tmp_path / "new") == meshes(bundle, tmp_path / "old")


@pytest.mark.shared
@pytest.mark.slow
def test_a_scan_in_light_that_follows_the_picture_gives_the_mesh_of_its_recording(shared: Path, tmp_path: Path) -> None:
    bundle = shared / "cases" / "dynamic_contrast"
    if not bundle.is_dir():
        pytest.skip(f"no {bundle}")
    rig = tmp_path / "replayed.toml"
    rig.write_text(REPLAYED.format(bundle=bundle, speed=0))
    with serving(rig, tmp_path / "data") as service, service.client() as client:
        scan = scanned(client)
        assert scan["state"] == "succeeded", scan["error"]
    again = service.data / "scans" / scan["id"]
    report = json.loads((again / "report.json").read_text())
    assert written(again) == meshes(bundle, tmp_path / "reconstructed")
    assert report["evidence"]["shot_again"] == 0
    assert report["evidence"]["light"]["left"]["column Gray code"]["median"] == pytest.approx(4 / 3, rel=0.03)
    assert report["evidence"]["light"]["left"]["column lines"]["median"] == pytest.approx(1.6 * 4 / 3, rel=0.05)
    assert len([note for note in report["notes"] if "light" in note]) == 1


def libraries(process: int) -> set[str]:
    mapped = Path(f"/proc/{process}/maps").read_text()
    return {name for name in MATHEMATICS if f"/{name}/" in mapped}


def work(service: ServiceProcess) -> None:
    with service.client() as client, Caller(service) as caller:
        scan, other = scanned(client), scanned(client)
        assert scan["state"] == "succeeded"
        for name in (each for each in scan["links"]["files"] if each.startswith(("points-", "depth-", "mesh."))):
            assert caller.http.get(scan["links"]["files"][name]).status_code == 200, name
        assert caller.http.get("/calibration/board.pdf").content[:4] == b"%PDF"
        still = [[float(row == column) for column in range(4)] for row in range(4)]
        model = caller.post("/model", 202, scans=[scan["id"], other["id"]], poses=[still, still])
        caller.http.get(model["links"]["events"])
        assert caller.get(model["links"]["self"])["state"] == "succeeded", caller.get(model["links"]["self"])["error"]
        made = caller.post("/calibration", 201, board=BOARD)
        caller.post(made["links"]["pose"], 202)
        (pose,) = caller.settled(made)["shot"]
        assert pose["state"] == "succeeded", pose["error"]
        caller.post(made["links"]["solve"], 202)
        assert caller.settled(made)["error"]["type"] == "/problems/solve-refused"
        assert caller.http.get(caller.settled(made)["links"]["coverage"]["left"]).content[:4] == b"\x89PNG"
        known = json.loads((service.data / "scans" / scan["id"] / "bundle" / "calibration.json").read_text())
        first, second = (caller.post("/calibration/import", 201, **known)["id"] for _ in range(2))
        assert caller.get(f"/calibration/compare?first={first}&second={second}")["words"]
        begun = caller.post("/rig/verification", 202, board=BOARD)
        # The stream ends when the verification has.
        assert '"succeeded"' in caller.http.get(begun["links"]["events"]).text, caller.get(begun["links"]["self"])


@pytest.mark.slow
def test_the_process_that_holds_the_rig_loads_no_mathematics(tmp_path: Path) -> None:
    """A compiler or a solver, and whatever it may do to a process, belongs to the worker."""
    with open_rig(read_rig(write_board_rig(tmp_path / "rendered", carries="true"))) as opened:
        assert opened.positioner is not None
        opened.positioner.move(1)
        bundle = recorded(opened, tmp_path / "pose", ScanPlan(patterns=USUAL_PATTERNS))
    rig = tmp_path / "replayed.toml"
    rig.write_text(REPLAYED.format(bundle=bundle, speed=0))
    with serving(rig, tmp_path / "data") as service:
        work(service)
        assert "numba" in libraries(service.worker_id())
        assert libraries(service.process.pid) == set()
