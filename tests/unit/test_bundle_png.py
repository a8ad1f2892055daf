"""Frames as PNG: packed and unpacked without a general decoder, held against OpenCV's."""

from __future__ import annotations

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle.images import read_pages
from slrig.bundle.png import encode_frame, rows_above_added
from slrig.errors import BundleError
from slrig.model import CameraFormat, Pixels, Size

SIZES = [(1, 1), (1, 7), (9, 1), (37, 51)]


def frame(shape: tuple[int, int], bits: int) -> Pixels:
    values = np.random.default_rng(3).integers(0, 2**bits, shape)
    return values.astype(np.uint8 if bits == 8 else np.uint16)


def written(folder: Path, data: bytes) -> Path:
    (folder / "frame.png").write_bytes(data)
    return folder / "frame.png"


def by_opencv(data: bytes) -> Pixels:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


def camera(image: Pixels) -> CameraFormat:
    rows, columns = image.shape
    return CameraFormat(Size(columns, rows), 8 * image.itemsize)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", SIZES)
def test_what_is_written_is_read_by_opencv(shape: tuple[int, int], bits: int) -> None:
    image = frame(shape, bits)
    read = by_opencv(encode_frame(image, "frame"))
    assert read.dtype == image.dtype
    assert np.array_equal(read, image)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(
    "filtered", [cv2.IMWRITE_PNG_FILTER_NONE, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_FILTER_PAETH, 0xF8]
)
def test_what_opencv_writes_is_read(tmp_path: Path, shape: tuple[int, int], bits: int, filtered: int) -> None:
    image = frame(shape, bits)
    done, data = cv2.imencode(".png", image, (cv2.IMWRITE_PNG_FILTER, filtered))
    assert done
    read = read_pages(written(tmp_path, bytes(data)), [0], camera(image))[0]
    assert read.dtype == image.dtype
    assert np.array_equal(read, image)


def test_a_view_of_an_image_is_written_as_it_looks() -> None:
    image = frame((40, 60), 16)[::2, 10:50:3]
    read = by_opencv(encode_frame(image, "frame"))
    assert np.array_equal(read, image)


def test_frames_of_our_own_need_no_other_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = frame((37, 51), 8)
    path = written(tmp_path, encode_frame(image, "frame"))
    monkeypatch.delattr(cv2, "imdecode")
    assert np.array_equal(read_pages(path, [0], camera(image))[0], image)


def test_rows_of_several_filters_are_left_to_a_decoder() -> None:
    rows = bytearray(bytes(4) * 3)
    rows[0], rows[4], rows[8] = 2, 2, 1
    assert rows_above_added(bytes(rows), 3, 8) is None


def test_frames_are_as_small_as_by_zlib_but_for_a_quarter() -> None:
    # Stripes that run down the image, with noise, as frames have them.
    at = np.arange(640)
    stripes = 120 + 100 * np.sin(at / 5) + np.random.default_rng(5).normal(0, 2, (480, 640))
    image = np.clip(stripes, 0, 255).astype(np.uint8)
    plain = zlib.compress(np.vstack([image[:1], np.diff(image, axis=0)]).tobytes(), 6)
    assert len(encode_frame(image, "frame")) < 1.25 * len(plain)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5), np.float32), np.zeros((0, 5, 3), np.uint8)]
)
def test_what_is_no_frame_is_refused(image: Pixels) -> None:
    with pytest.raises(BundleError, match="an image of 8 or 16 bits"):
        encode_frame(image, "frame.png")
