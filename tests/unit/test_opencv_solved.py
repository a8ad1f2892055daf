"""What a calibration says of its own error, to OpenCV FileStorage and back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import read_calibration, read_opencv_calibration, write_calibration, write_opencv_calibration
from slrig.errors import CalibrationError
from slrig.model import Calibration, Solved
from tests.samples import sample_calibration


def solved_calibration(seed: int = 0) -> Calibration:
    calibration = sample_calibration()
    count = 15 * (len(calibration.cameras) + (calibration.projector is not None))
    root = np.random.default_rng(seed).normal(size=(count, count)) * np.geomspace(1e-8, 1e2, count)[:, None]
    box = np.array([[-60.5, -40, 400], [60, 40.25, 520]])
    return replace(calibration, solved=Solved("a1b2", "2026-11-22T06:12:49+00:00", root @ root.T, box, 0.00712))


@pytest.mark.parametrize("ending", [".yml", ".yaml", ".xml"])
def test_all_of_it_comes_back_to_the_last_digit(tmp_path: Path, ending: str) -> None:
    calibration = solved_calibration()
    write_opencv_calibration(tmp_path / f"bench{ending}", calibration)
    found = read_calibration(tmp_path / f"bench{ending}")
    assert list(found.cameras) == list(calibration.cameras)
    assert found.solved is not None
    assert calibration.solved is not None
    assert (found.solved.id, found.solved.solved_at) == ("a1b2", "2026-11-22T06:12:49+00:00")
    assert np.array_equal(found.solved.covariance, calibration.solved.covariance)
    assert np.array_equal(found.solved.volume_mm, calibration.solved.volume_mm)
    assert found.solved.expected_error_mm == 0.00712


def test_by_way_of_opencv_it_is_the_same_as_json(tmp_path: Path) -> None:
    write_calibration(tmp_path / "a.json", solved_calibration())
    write_opencv_calibration(tmp_path / "b.yml", read_calibration(tmp_path / "a.json"))
    write_calibration(tmp_path / "c.json", read_calibration(tmp_path / "b.yml"))
    # FileStorage writes a negative zero as zero.
    found, before = ((tmp_path / name).read_text().replace("-0.0,", "0.0,") for name in ("c.json", "a.json"))
    assert found == before


def test_without_it_the_file_has_devices_only(tmp_path: Path) -> None:
    write_opencv_calibration(tmp_path / "bench.yml", sample_calibration())
    assert "solved" not in (tmp_path / "bench.yml").read_text()
    assert read_opencv_calibration(tmp_path / "bench.yml").solved is None


def test_another_program_reads_the_devices_all_the_same(tmp_path: Path) -> None:
    calibration = solved_calibration()
    write_opencv_calibration(tmp_path / "bench.yml", calibration)
    storage = cv2.FileStorage(str(tmp_path / "bench.yml"), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("left").getNode("camera_matrix").mat()
    deviations = np.sqrt(np.diagonal(storage.getNode("solved").getNode("covariance").mat()))
    storage.release()
    assert np.array_equal(matrix, calibration.cameras["left"].matrix)
    assert len(deviations) % 15 == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("solved_at:", "solved_on:", "no solved_at, the unknown key solved_on; leave the whole map out"),
        ("expected_error_mm: 0.0071", "expected_error_mm: -0.0071", "expected_error_mm of 0 or more, found -0.0"),
        (
            "expected_error_mm: 0.00711",
            'expected_error_mm: "x" # 0.00711',
            "numbers as expected_error_mm and scale_sigma",
        ),
        ("id: a1b2", "id: [ 1 ]", "text as id and solved_at"),
    ],
)
def test_a_fault_in_it_is_told_with_its_place(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "bench.yml"
    write_opencv_calibration(path, solved_calibration())
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(CalibrationError) as caught:
        read_opencv_calibration(path)
    assert str(path) in str(caught.value)
    assert words in str(caught.value)


def test_a_covariance_for_other_devices_is_refused(tmp_path: Path) -> None:
    calibration = solved_calibration()
    write_opencv_calibration(tmp_path / "bench.xml", calibration)
    storage = cv2.FileStorage(str(tmp_path / "bench.xml"), cv2.FILE_STORAGE_READ)
    covariance = storage.getNode("solved").getNode("covariance").mat()
    storage.release()
    assert covariance is not None
    fewer = Calibration(dict(list(calibration.cameras.items())[:1]), None, None)
    solved = calibration.solved
    assert solved is not None
    object.__setattr__(fewer, "solved", solved)
    write_opencv_calibration(tmp_path / "fewer.yml", fewer)
    with pytest.raises(CalibrationError, match=r"solved\.covariance: expected 15 rows for each of 1 devices"):
        read_opencv_calibration(tmp_path / "fewer.yml")


def test_a_camera_cannot_have_its_name(tmp_path: Path) -> None:
    calibration = sample_calibration()
    named = Calibration({"solved": next(iter(calibration.cameras.values()))}, None)
    with pytest.raises(CalibrationError, match="are not 'projector' or 'solved', found 'solved'"):
        write_opencv_calibration(tmp_path / "bench.yml", named)
