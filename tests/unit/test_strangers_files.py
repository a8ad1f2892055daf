"""Harmed files give a calibration or frames, or the one error that says what is wrong; never anything else."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest

from slrig.bundle import read_bundle, read_calibration, write_calibration
from slrig.bundle.images import read_pages
from slrig.errors import BundleError, CalibrationError
from slrig.model import CameraFormat
from tests.samples import CAMERA
from tests.strangers import good_bundle, good_frames, harm_bundle, harmed_calibrations

CALIBRATIONS, BUNDLES = 150, 80
"""`tests/e2e/campaigns/test_harmed_calibrations.py` sends more of them."""


def test_a_harmed_calibration_is_read_or_refused(tmp_path: Path) -> None:
    messages = []
    for number, (ending, text) in enumerate(harmed_calibrations(CALIBRATIONS, seed=1)):
        path = tmp_path / f"rig{ending}"
        path.write_bytes(text)
        try:
            found = read_calibration(path)
        except CalibrationError as cause:
            messages.append(str(cause).removeprefix(str(path)))
        else:
            # What is read can be kept, and is the same then.
            write_calibration(tmp_path / "kept.json", found)
            assert read_calibration(tmp_path / "kept.json").digest == found.digest, number
    assert CALIBRATIONS / 2 < len(messages) < CALIBRATIONS
    assert max(map(len, messages)) < 4000
    assert all(message.startswith((": ", " is not a valid calibration")) for message in messages)


@pytest.mark.usefixtures("capfd")
def test_a_harmed_bundle_is_read_or_refused(tmp_path: Path) -> None:
    good, frames = good_bundle(tmp_path / "good"), good_frames()
    messages = []
    shutil.copytree(good, tmp_path / "scan")
    for seed in range(BUNDLES):
        name = harm_bundle(tmp_path / "scan", frames, seed)
        try:
            read_bundle(tmp_path / "scan")
        except (BundleError, CalibrationError) as cause:
            messages.append(str(cause))
        shutil.copy(good / name, tmp_path / "scan" / name)
    assert BUNDLES / 2 < len(messages) < BUNDLES
    assert max(map(len, messages)) < 8000


def test_every_good_frame_is_read(tmp_path: Path) -> None:
    for data in good_frames():
        (tmp_path / "frame").write_bytes(data)
        assert read_pages(tmp_path / "frame", [0], CameraFormat(CAMERA, 8))[0].shape == CAMERA.shape


def test_a_tiff_with_a_circle_of_pages_is_refused(tmp_path: Path) -> None:
    # Longer than what the library for TIFF looks back over.
    count = 150
    pages = b"".join(struct.pack("<HI", 0, 8 + 6 * ((page + 1) % count)) for page in range(count))
    (tmp_path / "frame.tif").write_bytes(b"II*\0" + struct.pack("<I", 8) + pages)
    with pytest.raises(BundleError, match="chain of pages that does not end after 150"):
        read_pages(tmp_path / "frame.tif", [0], CameraFormat(CAMERA, 8))


def test_what_a_jpeg_remarks_is_not_for_the_decoder(tmp_path: Path) -> None:
    data = next(each for each in good_frames() if each.startswith(b"\xff\xd8"))
    (tmp_path / "frame.jpg").write_bytes(data)
    plain = read_pages(tmp_path / "frame.jpg", [0], CameraFormat(CAMERA, 8))[0]
    exif = b"\xff\xe1" + struct.pack(">H", 40) + b"Exif\0\0MM\0*" + b"\xff" * 28
    (tmp_path / "frame.jpg").write_bytes(data[:2] + exif + data[2:])
    np.testing.assert_array_equal(read_pages(tmp_path / "frame.jpg", [0], CameraFormat(CAMERA, 8))[0], plain)
