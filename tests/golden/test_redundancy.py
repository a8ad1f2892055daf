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

from slrig.cli.quality import quality_lines
from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.model import FloatArray
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import ReconstructionPlan, ScanPlan
from slrig.scan.reconstruct import reconstruct_bundle
from slrig.scan.records import report_summary

RIG = Path(__file__).parents[2] / "config" / "rigs" / "two_cameras.toml"
DEGREES = 0.05
CalibrationChange = Callable[[dict[str, Any]], None]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded") / "bundle"
    with open_rig(read_rig(RIG)) as rig:
        capture_frames(rig, ScanPlan(), folder, progress=lambda *_: None, cancelled=lambda: False).finish()
    return folder


def report_of(recorded: Path, folder: Path, change: CalibrationChange | None = None) -> dict[str, Any]:
    """The report, read back from its file, for a calibration that was changed."""
    calibration = json.loads((recorded / "calibration.json").read_text())
    if change is not None:
        change(calibration)
    folder.mkdir(exist_ok=True)
    (folder / "calibration.json").write_text(json.dumps(calibration))
    reconstruct_bundle(
        recorded, folder / "out", plan=ReconstructionPlan(), calibration=folder / "calibration.json",
        progress=lambda *_: None, cancelled=lambda: False,
    )  # fmt: skip
    report: dict[str, Any] = json.loads((folder / "out" / "report.json").read_text())
    return report


def redundancy_of(recorded: Path, folder: Path, change: CalibrationChange | None = None) -> dict[str, Any]:
    """The section of `report_of` on what the cameras say of one another, which knows nothing of the truth."""
    bundle = folder / "bundle"
    shutil.copytree(recorded, bundle, ignore=shutil.ignore_patterns("truth*", "visible_points.npy"))
    section: dict[str, Any] = report_of(bundle, folder, change)["redundancy"]
    return section


@pytest.fixture(scope="module")
def sound(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The report by the right calibration."""
    return report_of(recorded, tmp_path_factory.mktemp("sound"))


@pytest.mark.slow
def test_a_right_calibration_leaves_the_noise_of_the_stripes(sound: dict[str, Any]) -> None:
    assert sound["notes"] == []
    section = sound["redundancy"]
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


def turned(calibration: dict[str, Any], name: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Turn a camera about its own upright axis, where it stands; the device before and after."""
    device = calibration["cameras"][name]
    before = json.loads(json.dumps(device))
    turn, _ = cv2.Rodrigues(np.array([0.0, math.radians(DEGREES), 0.0]))
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


@pytest.mark.slow
def test_a_camera_turned_by_a_twentieth_of_a_degree_shows_as_projective_geometry_says(
    recorded: Path, tmp_path: Path
) -> None:
    devices: list[dict[str, Any]] = []
    (pair,) = redundancy_of(recorded, tmp_path, lambda file: devices.extend(turned(file, "right")))["residual_px"]
    before, after = devices
    # Truth is seen where the camera stood; it is expected where the camera is believed to stand. Stripes of columns
    # run down this camera's image to within a few degrees, so the distance across them is that along x.
    truth = np.load(recorded / "visible_points.npy").astype(np.float64)
    predicted = float((pixels(before, truth) - pixels(after, truth))[:, 0].mean())
    assert abs(predicted) == pytest.approx(after["matrix"][0][0] * math.radians(DEGREES), rel=0.05)
    assert pair["mean"] == pytest.approx(predicted, rel=0.2)
    assert pair["median_absolute"] == pytest.approx(abs(predicted), rel=0.2)
    assert pair["pairs"] > 100_000
    cells = np.array(pair["map"]["mean"], dtype=float)
    np.testing.assert_allclose(cells[np.isfinite(cells)], predicted, rtol=0.2)


@pytest.mark.slow
def test_a_first_camera_that_is_turned_shows_in_the_second(recorded: Path, tmp_path: Path) -> None:
    devices: list[dict[str, Any]] = []
    (pair,) = redundancy_of(recorded, tmp_path, lambda file: devices.extend(turned(file, "left")))["residual_px"]
    projector = json.loads((recorded / "calibration.json").read_text())["projector"]
    right = json.loads((recorded / "calibration.json").read_text())["cameras"]["right"]
    before, after = devices
    truth = np.load(recorded / "visible_points.npy").astype(np.float64)
    # The point that the wrong ray gives: where it meets the light of the truth's column, to first order in the depth.
    centre = -np.array(after["rotation"]).T @ np.array(after["translation_mm"])
    undistorted = cv2.undistortPoints(
        pixels(before, truth).reshape(-1, 1, 2), np.array(after["matrix"]), np.array(after["distortion"])
    ).reshape(-1, 2)
    rays = np.column_stack([undistorted, np.ones(len(truth))]) @ np.array(after["rotation"])
    depth = ((truth - centre) * rays).sum(axis=1) / (rays**2).sum(axis=1)
    column = pixels(projector, truth)[:, 0]
    for _ in range(8):
        got, further = (pixels(projector, centre + each[:, None] * rays)[:, 0] for each in (depth, depth + 0.1))
        depth = depth + 0.1 * (column - got) / (further - got)
    wrong = centre + depth[:, None] * rays
    predicted = float((pixels(right, truth) - pixels(right, wrong))[:, 0].mean())
    assert abs(predicted) > 0.5
    assert pair["mean"] == pytest.approx(predicted, rel=0.2)


@pytest.mark.slow
def test_without_a_calibrated_projector_there_is_no_spare_equation(recorded: Path, tmp_path: Path) -> None:
    section = redundancy_of(recorded, tmp_path, lambda file: file.update(projector=None))
    assert section["residual_px"] is None
    assert "projector is not calibrated" in section["residual_px_absent"]
    assert section["points_by_source"]["camera_camera"] > 10_000


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["left", "right"])
def test_cameras_that_are_off_by_half_a_millimetre_are_told_and_their_error_is_stated(
    recorded: Path, tmp_path: Path, name: str
) -> None:
    def shifted(calibration: dict[str, Any]) -> None:
        calibration["cameras"][name]["translation_mm"][0] += 0.5

    wrong = report_of(recorded, tmp_path / "wrong", shifted)
    (told,) = wrong["notes"]
    assert "the cameras contradict each other" in told
    assert (told,) == tuple(report_summary(wrong)["notes"])
    assert f"{'note':<10}{told}" in quality_lines(report_summary(wrong))
    # One of the two is right, and whichever it is, 5 % of the mesh at least are the other's.
    actual_mm = wrong["truth"]["p95_mm"]
    assert actual_mm > 1.5
    assert 0.7 * actual_mm <= wrong["mesh"]["sigma_mm"]["p50"] <= 1.5 * actual_mm
