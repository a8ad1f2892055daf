"""Frames in JPEG files, as OpenCV writes them and as they come damaged."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.bundle.description import DESCRIPTION
from slrig.bundle.images import read_pages
from slrig.errors import BundleError
from slrig.model import CameraFormat, Capture, Pixels, Shot, Size, White

SIZE = Size(45, 27)
CAMERA = CameraFormat(SIZE, 8)


def picture() -> Pixels:
    x, y = np.meshgrid(np.arange(SIZE.width_px), np.arange(SIZE.height_px))
    return np.asarray(120 + 60 * np.sin(x / 5) * np.cos(y / 7), dtype=np.uint8)


def jpeg(image: Pixels, *options: int) -> bytes:
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 90, *options])
    assert done
    return data.tobytes()


def written(folder: Path, data: bytes) -> Path:
    path = folder / "frame.jpg"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2)])
def test_a_frame_is_what_was_written_within_its_compression(tmp_path: Path, options: tuple[int, ...]) -> None:
    path = written(tmp_path, jpeg(picture(), *options))
    off = read_pages(path, [0], CAMERA)[0].astype(float) - picture()
    assert 0 < np.sqrt(np.mean(off**2)) < 3


def test_colour_becomes_grey(tmp_path: Path) -> None:
    seen = read_pages(written(tmp_path, jpeg(np.dstack([picture()] * 3))), [0], CAMERA)[0]
    assert np.abs(seen.astype(float) - picture()).max() < 12


def test_a_bundle_may_hold_what_earlier_versions_noted_of_its_compression(tmp_path: Path) -> None:
    capture = Capture(Size(16, 8), (White(),), {"eye": CAMERA}, (Shot(0, "eye", picture(), 0.01, 0.0),))
    write_bundle(tmp_path / "b", capture)
    description = tmp_path / "b" / DESCRIPTION
    told = json.loads(description.read_text())
    told["cameras"]["eye"]["compression_dn"] = 1.4
    description.write_text(json.dumps(told))
    assert read_bundle(tmp_path / "b").capture.cameras == {"eye": CAMERA}


def without_end(data: bytes) -> bytes:
    return data[:-40]


def in_the_header(data: bytes) -> bytes:
    return data[:30]


def of_12_bits(data: bytes) -> bytes:
    place = data.index(b"\xff\xc0") + 4
    return data[:place] + b"\x0c" + data[place + 1 :]


def arithmetic(data: bytes) -> bytes:
    return data.replace(b"\xff\xc0", b"\xff\xc9", 1)


def without_quantisers(data: bytes) -> bytes:
    place = data.index(b"\xff\xdb")
    (length,) = struct.unpack_from(">H", data, place + 2)
    return data[:place] + data[place + 2 + length :]


def larger(data: bytes) -> bytes:
    place = data.index(b"\xff\xc0") + 5
    return data[:place] + struct.pack(">HH", 60_000, 60_000) + data[place + 4 :]


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (without_end, "cut after"),
        (in_the_header, "breaks off"),
        (of_12_bits, "12 bits"),
        (arithmetic, "arithmetic"),
        (without_quantisers, "quantisers"),
        (larger, "60000 x 60000"),
    ],
)
def test_a_damaged_or_strange_file_is_refused(tmp_path: Path, damage: object, words: str) -> None:
    assert callable(damage)
    path = written(tmp_path, damage(jpeg(picture())))
    with pytest.raises(BundleError, match=words):
        read_pages(path, [0], CAMERA)


def test_any_cut_and_any_byte_is_refused_or_read(tmp_path: Path) -> None:
    data = jpeg(picture())
    random = np.random.default_rng(5)
    for _ in range(300):
        spoilt = bytearray(data[: int(random.integers(3, len(data) + 1))])
        spoilt[int(random.integers(3, max(len(spoilt), 4))) % len(spoilt)] = int(random.integers(256))
        path = written(tmp_path, bytes(spoilt))
        try:
            assert read_pages(path, [0], CAMERA)[0].shape == SIZE.shape
        except BundleError as error:
            assert "frame.jpg" in str(error)  # noqa: PT017
