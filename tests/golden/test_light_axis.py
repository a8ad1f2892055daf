"""Scans by rows against their twins by columns: the same scene and devices, with x and y exchanged throughout.

Camera and projector stand above one another instead of side by side, images and picture are transposed, and the scene
is symmetric. Whatever differs between two twins but for the noise is an axis that was mistaken for the other one.
"""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slrig.config import read_rig
from slrig.discovery import open_rig
from slrig.errors import NothingToReconstructError
from slrig.model import Calibration
from slrig.scan.acquisition import capture_frames
from slrig.scan.plan import PatternPlan, ScanPlan
from tests.golden.test_bundles import reconstructed

pytestmark = pytest.mark.slow
# Plates that float before one another by less than the depth-edge limit of a spacing that is taken twice too large.
TERRACES = """name = "terraces"
[[object]]
shape = "plane"
position_mm = [0.0, 0.0, 6.4]
size_mm = [160.0, 160.0]
[[object]]
shape = "plane"
position_mm = [0.0, 0.0, 3.2]
size_mm = [84.0, 84.0]
[[object]]
shape = "plane"
size_mm = [60.0, 60.0]
[[object]]
shape = "plane"
position_mm = [0.0, 0.0, -3.2]
size_mm = [36.0, 36.0]
"""
BALL = """name = "ball"
[[object]]
shape = "sphere"
radius_mm = 30.0
[[object]]
shape = "plane"
position_mm = [0.0, 0.0, 32.0]
size_mm = [200.0, 200.0]
"""
Device = Mapping[str, Any]
CAMERA: Device = {
    "size_px": (320, 288), "focal_px": (1500.0, 1500.0), "distortion": (-0.1, 0.12, 0.0003, -0.0005, 0.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.6, "saturation_s": 0.02,
}  # fmt: skip
PROJECTOR: Device = {
    "size_px": (192, 192), "focal_px": (900.0, 900.0), "distortion": (0.03, -0.02, 0.0, 0.0003, 0.0),
    "target_mm": (0.0, 0.0, 0.0), "blur_px": 0.5,
}  # fmt: skip
# As a diamond array of mirrors is addressed: every other row is half a mirror aside. Columns are those of the twin.
FINE_COLUMNS = {"size_px": (384, 192), "focal_px": (1800.0, 900.0)}


def exchanged(device: Device) -> Device:
    """The device with x and y exchanged."""
    other = dict(device)
    for key in ("size_px", "focal_px"):
        other[key] = device[key][::-1]
    x, y, z = device["position_mm"]
    k1, k2, p1, p2, k3 = device["distortion"]
    return other | {"position_mm": (y, x, z), "distortion": (k1, k2, p2, p1, k3)}


def rig_file(folder: Path, scene: str, projector: Device, *cameras: Device, **head: float) -> Path:
    """A rig of these devices before a scene; head : options in place of the usual."""
    folder.mkdir()
    (folder / "scene.toml").write_text(scene)

    def table(device: Device) -> str:
        return "\n".join(
            f"{key} = {list(value) if isinstance(value, tuple) else value}" for key, value in device.items()
        )

    usual = {"seed": 5, "ambient": 0.01, "samples_per_axis": 2}
    parts = ['name = "twins"\n[head]\ndriver = "simulated"\nscene = "scene.toml"', table(usual | head)]
    parts += ["[head.projector]", table(projector)]
    for number, camera in enumerate(cameras):
        parts += ["[[head.camera]]", f'name = "camera{number}"', table(camera)]
    (folder / "rig.toml").write_text("\n".join(parts) + "\n")
    return folder / "rig.toml"


def scanned(rig: Path, *, plan: PatternPlan | None = None, projector_known: bool = True) -> Mapping[str, Any]:
    """Capture and reconstruct with the rig's calibration, or with that of its cameras only; the report."""
    bundle = rig.parent / "bundle"
    with open_rig(read_rig(rig)) as opened:
        assert opened.calibration is not None
        known = opened.calibration if projector_known else Calibration(opened.calibration.cameras, None)
        capture_frames(replace(opened, calibration=known), ScanPlan(patterns=plan or PatternPlan()), bundle).finish()
    report: Mapping[str, Any] = reconstructed(bundle, rig.parent / "out")
    return report


DIAMOND = {**PROJECTOR, **FINE_COLUMNS, "position_mm": (105.0, 0.0, -590.0)}
CENTRAL = {**PROJECTOR, "position_mm": (0.0, -20.0, -600.0)}
LEFT = {**CAMERA, "position_mm": (-150.0, 0.0, -560.0)}
RIGHT = {**CAMERA, "position_mm": (150.0, 0.0, -570.0)}


def alike(one: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """See that two scans of twins differ by their noise only."""
    mine, theirs = one["truth"], other["truth"]
    assert mine["rms_mm"] == pytest.approx(theirs["rms_mm"], rel=0.05)
    assert mine["p99_mm"] == pytest.approx(theirs["p99_mm"], rel=0.05)
    for figure in ("complete_0.1mm", "complete_0.3mm"):
        assert mine[figure] == pytest.approx(theirs[figure], abs=0.002)
    assert mine["false_area_0.5mm"] == theirs["false_area_0.5mm"] == 0
    assert one["mesh"]["points"] == pytest.approx(other["mesh"]["points"], rel=0.002)


def test_rows_of_a_diamond_array_of_mirrors_are_meshed_like_the_columns_of_its_twin(tmp_path: Path) -> None:
    columns = scanned(rig_file(tmp_path / "columns", TERRACES, DIAMOND, LEFT))
    rows = scanned(rig_file(tmp_path / "rows", TERRACES, exchanged(DIAMOND), exchanged(LEFT)))
    # Neither scan was told its axis: by itself each plays the one that tells depth, and no other.
    assert (columns["axis"], rows["axis"]) == ("column", "row")
    assert rows["frames"]["patterns"] == columns["frames"]["patterns"]
    assert columns["truth"]["rms_mm"] < 0.007
    alike(columns, rows)
    dropped = [each["mesh"]["initial"]["dropped_at_depth_edges"] for each in (columns, rows)]
    assert dropped[0] == pytest.approx(dropped[1], rel=0.02)


def test_two_cameras_meet_on_fine_rows_as_on_coarse_ones(tmp_path: Path) -> None:
    def seen_by_two(name: str, size_px: tuple[int, int], focal_px: tuple[float, float]) -> float:
        # A camera's pixel is as wide as two columns, and as high as two coarse rows or four fine ones.
        coarse = {"size_px": (160, 144), "focal_px": (750.0, 750.0)}
        fine = {**CENTRAL, "size_px": size_px, "focal_px": focal_px}
        report = scanned(rig_file(tmp_path / name, BALL, fine, {**LEFT, **coarse}, {**RIGHT, **coarse}))
        by_source = report["redundancy"]["points_by_source"]
        return float(by_source["all"] / sum(by_source.values()))

    coarse = seen_by_two("square", (384, 384), (1800.0, 1800.0))
    assert coarse > 0.5
    assert seen_by_two("fine_rows", (384, 768), (1800.0, 3600.0)) == pytest.approx(coarse, abs=0.02)


def test_cameras_above_one_another_need_no_projector_calibration_either(tmp_path: Path) -> None:
    # Lying stripes with one axis played; standing ones with both, of which the right one is taken.
    above = scanned(rig_file(tmp_path / "above", BALL, *map(exchanged, (CENTRAL, LEFT, RIGHT))), projector_known=False)
    rig = rig_file(tmp_path / "beside", BALL, CENTRAL, LEFT, RIGHT)
    beside = scanned(rig, plan=PatternPlan(rows=True), projector_known=False)
    assert (beside["axis"], above["axis"]) == ("column", "row")
    assert beside["truth"]["rms_mm"] < 0.012
    alike(beside, above)
    assert beside["notes"] == above["notes"] == []
    for report in (beside, above):
        assert 0.8 < report["truth"]["error_over_sigma_p68"] < 1.25
        assert report["truth"]["facing_camera_area"] == pytest.approx(1, abs=1e-5)


def test_a_projector_that_lies_on_its_side_shows_in_its_stripes(tmp_path: Path) -> None:
    lying = {**exchanged(CENTRAL), "down": (1.0, 0.0, 0.0)}
    rig = rig_file(tmp_path / "lying", BALL, lying, exchanged(LEFT), exchanged(RIGHT))
    with pytest.raises(NothingToReconstructError, match=r"the light of the rows .* 0° only.*--rows") as caught:
        scanned(rig, projector_known=False)
    assert "more than" in str(caught.value)
    shutil.rmtree(tmp_path / "lying" / "bundle")
    both = scanned(rig, plan=PatternPlan(rows=True), projector_known=False)
    shutil.rmtree(tmp_path / "lying" / "bundle")
    columns = scanned(rig, plan=PatternPlan(rows=False), projector_known=False)
    assert both["axis"] == columns["axis"] == "column"
    assert both["truth"]["rms_mm"] < 0.012
    alike(both, columns)
