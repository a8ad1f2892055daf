"""Scans of columns and rows by right and wrong calibrations: a wrong one is refused and its cause named."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from scipy.spatial.transform import Rotation

from slrig.bundle import CALIBRATION, read_bundle, read_calibration, write_bundle, write_calibration
from slrig.model import Axis, Gray, Pattern
from tests.golden.test_bundles import reconstructed
from tests.unit.command import slrig

pytestmark = [pytest.mark.shared, pytest.mark.slow]


def imported(shared: Path, folder: Path, calibration: str) -> Path:
    """The foreign capture with one of its calibrations and the truth."""
    case = shared / "cases" / "two_axes"
    made = slrig(
        "import", str(case / "capture"), "--output", str(folder), "--projector", "640x400",
        "--calibration", str(case / "calibrations" / f"{calibration}.yml"),
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    for name in ("truth.ply", "visible_points.npy"):
        shutil.copy(case / name, folder)
    return folder


@pytest.fixture(scope="module")
def bundle(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return imported(shared, tmp_path_factory.mktemp("axes") / "bundle", "right")


def test_right_calibration_agrees(bundle: Path, tmp_path: Path) -> None:
    report = reconstructed(bundle, tmp_path / "mesh")

    agreement = report["redundancy"]["second_axis"]["cam0"]
    assert agreement["median_px"] < 0.1
    assert agreement["systematic_px"] < 0.1
    assert not any("contradict" in note for note in report["notes"])
    assert (tmp_path / "mesh" / "agreement-cam0.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("calibration", "cause"),
    [
        ("inverse_pose", "the inverse pose"),
        ("devices_exchanged", "the lenses of camera and projector are exchanged"),
        ("projector_turned_1_degree", "turned by 0.99° and shifted by 4.2 mm"),
    ],
)
def test_wrong_calibration_gives_no_mesh(shared: Path, tmp_path: Path, calibration: str, cause: str) -> None:
    bundle = imported(shared, tmp_path / "bundle", calibration)

    refused = slrig("reconstruct", str(bundle), "--output", str(tmp_path / "mesh"))

    assert refused.exit_code == 2
    assert "contradicts the frames of camera 'cam0'" in refused.output
    assert cause in " ".join(refused.output.split())
    assert not (tmp_path / "mesh").exists()


def test_small_error_is_reported_and_added_to_the_standard_deviations(bundle: Path, tmp_path: Path) -> None:
    right = read_calibration(bundle / CALIBRATION)
    assert right.projector is not None
    turn = Rotation.from_euler("y", 0.1, degrees=True).as_matrix() @ right.projector.rotation
    moved = replace(right.projector, rotation=turn, translation_mm=-turn @ right.projector.centre_mm)
    write_calibration(tmp_path / "turned.json", replace(right, projector=moved))

    report = reconstructed(bundle, tmp_path / "mesh", calibration=tmp_path / "turned.json")

    (note,) = (each for each in report["notes"] if "contradict the calibration" in each)
    assert "turned by 0.10°" in note
    assert report["truth"]["p95_mm"] > 1
    assert 0.7 < report["truth"]["error_over_sigma_p68"] < 1.4
    assert "that rows show" in report["mesh"]["sigma_holds"]


def test_one_frame_of_rows_tests_the_calibration(shared: Path, bundle: Path, tmp_path: Path) -> None:
    files = read_bundle(bundle)
    # Of the row code, only the bit whose stripes are 16 rows wide.
    used: dict[int, Pattern] = {}
    for index, pattern in enumerate(files.capture.patterns):
        if not isinstance(pattern, Gray) or pattern.axis is Axis.COLUMN:
            used[index] = pattern
        elif not pattern.inverted and (lines := pattern.as_lines) is not None and lines.line_width_px == 16:
            used[index] = lines
    place = {index: place for place, index in enumerate(used)}
    shots = tuple(replace(shot, pattern=place[shot.pattern]) for shot in files.capture.shots if shot.pattern in used)
    capture = replace(files.capture, patterns=tuple(used.values()), shots=shots)
    write_bundle(tmp_path / "right", capture, files.calibration)
    wrong = read_bundle(imported(shared, tmp_path / "inverse", "inverse_pose")).calibration
    write_bundle(tmp_path / "wrong", capture, wrong)

    report = reconstructed(tmp_path / "right", tmp_path / "mesh")
    refused = slrig("reconstruct", str(tmp_path / "wrong"), "--output", str(tmp_path / "none"))

    assert report["redundancy"]["second_axis"]["cam0"]["median_px"] < 0.1
    assert "rows agree with the calibration" in report["mesh"]["sigma_holds"]
    assert report["identity"] == "23/23 patterns verified"
    assert refused.exit_code == 2
    assert "the inverse pose" in " ".join(refused.output.split())
