"""Scans of columns and rows by right and wrong calibrations: a wrong one is refused and its cause named."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.golden.test_bundles import reconstructed
from tests.unit.command import slrig

pytestmark = [pytest.mark.shared, pytest.mark.slow]


@pytest.fixture(scope="module")
def bundle(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The foreign capture with its right calibration."""
    folder, case = tmp_path_factory.mktemp("axes") / "bundle", shared / "cases" / "two_axes"
    made = slrig(
        "import", str(case / "capture"), "--output", str(folder), "--projector", "640x400",
        "--calibration", str(case / "calibrations" / "right.yml"),
    )  # fmt: skip
    assert made.exit_code == 0, made.output
    return folder


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
def test_wrong_calibration_gives_no_mesh(
    shared: Path, bundle: Path, tmp_path: Path, calibration: str, cause: str
) -> None:
    wrong = shared / "cases" / "two_axes" / "calibrations" / f"{calibration}.yml"

    refused = slrig("reconstruct", str(bundle), "--calibration", str(wrong), "--output", str(tmp_path / "mesh"))

    assert refused.exit_code == 2
    assert "contradicts the frames of camera 'cam0'" in refused.output
    assert cause in " ".join(refused.output.split())
    assert not (tmp_path / "mesh").exists()
