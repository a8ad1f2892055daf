"""Two rendered cameras watch one another: the residual in pixels, with the right calibration and with a wrong one."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slrig.cli.display import quality_lines
from slrig.model import FloatArray
from slrig.scan.artefacts import report_summary
from tests.golden.conftest import Scan
from tests.golden.test_bundles import reconstructed

pytestmark = pytest.mark.slow
DEGREES = 0.05
CalibrationChange = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def sound(scan_of: Callable[[str], Scan]) -> Scan:
    """Two cameras with the right calibration."""
    return scan_of("two_cameras")


def report_of(recorded: Path, folder: Path, change: CalibrationChange | None = None) -> dict[str, Any]:
    """The report, read back from its file, for a calibration that was changed."""
    calibration = json.loads((recorded / "calibration.json").read_text())
    if change is not None:
        change(calibration)
    folder.mkdir(exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps(calibration))
    reconstructed(recorded, folder / "out", calibration=folder / "calibration.json")
    report: dict[str, Any] = json.loads((folder / "out" / "report.json").read_text())
    return report


def redundancy_of(recorded: Path, folder: Path, change: CalibrationChange | None = None) -> dict[str, Any]:
    """The section of `report_of` on what the cameras say of one another, which knows nothing of the truth."""
    bundle = folder / "bundle"
    shutil.copytree(recorded, bundle, ignore=shutil.ignore_patterns("truth*", "visible_points.npy"))
    section: dict[str, Any] = report_of(bundle, folder, change)["redundancy"]
    return section


def test_a_right_calibration_leaves_the_noise_of_the_stripes(sound: Scan) -> None:
    assert sound.report["notes"] == []
    section = sound.report["redundancy"]
    (pair,) = section["residual_px"]
    assert (pair["reference"], pair["camera"]) == ("left", "right")
    assert "residual_px_absent" not in section
    assert pair["pairs"] > 100_000
    assert pair["outlying"] < 1e-3 * pair["pairs"]
    assert abs(pair["mean"]) < 0.002
    assert pair["rms"] < 0.04
    # The sphere's silhouettes add what no noise model states.
    assert 0.7 < pair["rms"] / pair["stated_rms"] < 1.5
    mean, rms, count = (np.array(pair["map"][name], dtype=float) for name in ("mean", "rms", "pairs"))
    assert mean.shape == rms.shape == count.shape == (6, 6)
    assert count.sum() == pair["pairs"]
    assert np.nansum(mean * count) / pair["pairs"] == pytest.approx(pair["mean"], abs=1e-4)
    assert np.nanmax(np.abs(mean)) < 0.05


def turned(calibration: dict[str, Any], name: str, degrees: float = DEGREES) -> tuple[dict[str, Any], dict[str, Any]]:
    """Turn a camera about its own upright axis, where it stands; the device before and after."""
    device = calibration["cameras"][name]
    before = json.loads(json.dumps(device))
    turn, _ = cv2.Rodrigues(np.array([0.0, math.radians(degrees), 0.0]))
    device["rotation"] = (turn @ np.array(device["rotation"])).tolist()
    device["translation_mm"] = (turn @ np.array(device["translation_mm"])).tolist()
    return before, device


def pixels(device: dict[str, Any], points_mm: FloatArray) -> FloatArray:
    """(n, 2): where a device of calibration.json sees points, by OpenCV."""
    turn, _ = cv2.Rodrigues(np.array(device["rotation"]))
    found, _ = cv2.projectPoints(
        points_mm, turn, np.array(device["translation_mm"]), np.array(device["matrix"]), np.array(device["distortion"])
    )
    return np.asarray(found, dtype=np.float64).reshape(-1, 2)


@pytest.mark.shared
def test_the_gauge_of_another_renderer_tells_a_turned_camera_apart(shared: Path, tmp_path: Path) -> None:
    gauge = shared / "bundles" / "gauge"
    (pair,) = redundancy_of(gauge, tmp_path / "right")["residual_px"]
    assert abs(pair["mean"]) < 0.003
    assert pair["rms"] < 0.06
    devices: list[dict[str, Any]] = []
    (pair,) = redundancy_of(gauge, tmp_path / "wrong", lambda file: devices.extend(turned(file, "right")))[
        "residual_px"
    ]
    truth = np.load(gauge / "visible_points.npy").astype(np.float64)
    predicted = float((pixels(devices[0], truth) - pixels(devices[1], truth))[:, 0].mean())
    assert abs(predicted) > 1
    assert pair["mean"] == pytest.approx(predicted, rel=0.2)


@pytest.mark.parametrize("name", ["left", "right"])
def test_a_camera_that_moved_is_found_and_the_surface_is_as_good_as_stated(
    sound: Scan, tmp_path: Path, name: str
) -> None:
    def shifted(calibration: dict[str, Any]) -> None:
        calibration["cameras"][name]["translation_mm"][0] += 0.5

    wrong = report_of(sound.bundle, tmp_path / "wrong", shifted)
    note, *_ = wrong["notes"]
    assert "since its calibration: cameras 'left' and 'right' contradict each other" in note
    assert wrong["notes"] == report_summary(wrong)["notes"]
    assert f"{'note':<10}{note}" in quality_lines(report_summary(wrong))
    assert wrong["redundancy"]["disagreement"]["decision"] == "pose refined"
    # Which of the two cameras moved cannot be told from so small a move; the stated deviation holds both.
    assert wrong["redundancy"]["disagreement"]["could_be_instead"]
    assert wrong["truth"]["p95_mm"] < 3 * wrong["mesh"]["sigma_mm"]["p50"]


def test_after_a_turn_by_a_third_of_a_degree_the_surface_is_that_of_the_right_calibration(
    sound: Scan, tmp_path: Path
) -> None:
    def turn(calibration: dict[str, Any]) -> None:
        turned(calibration, "right", 0.3)

    wrong = report_of(sound.bundle, tmp_path / "wrong", turn)
    assert "camera 'right' was turned by 0.30°" in wrong["notes"][0]
    assert wrong["truth"]["p95_mm"] < 1.1 * sound.report["truth"]["p95_mm"]
    assert wrong["mesh"]["sigma_mm"]["p50"] < 1.1 * sound.report["mesh"]["sigma_mm"]["p50"]
