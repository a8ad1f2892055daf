"""Frames in BMP files, as OpenCV writes them and as they come damaged."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle.images import read_pages
from slrig.errors import BundleError
from slrig.model import CameraFormat, Pixels, Size

# Rows of a BMP are padded to four bytes; 13 and 26 are not multiples of it.
SIZE = Size(13, 7)
CAMERA = CameraFormat(SIZE, 8)


def picture(*, colour: bool = False) -> Pixels:
    shape = (*SIZE.shape, 3) if colour else SIZE.shape
    return np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)


def bitmap(image: Pixels) -> bytearray:
    done, data = cv2.imencode(".bmp", image)
    assert done
    return bytearray(data.tobytes())


def read(folder: Path, data: bytes | bytearray) -> Pixels:
    path = folder / "frame.bmp"
    path.write_bytes(data)
    return read_pages(path, [0], CAMERA)[0]


def test_grey_samples_are_those_that_were_written(tmp_path: Path) -> None:
    np.testing.assert_array_equal(read(tmp_path, bitmap(picture())), picture())


def test_colour_becomes_grey(tmp_path: Path) -> None:
    image = picture(colour=True)
    np.testing.assert_array_equal(read(tmp_path, bitmap(image)), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))


def test_the_first_row_may_come_first(tmp_path: Path) -> None:
    data = bitmap(picture())
    struct.pack_into("<i", data, 22, -SIZE.height_px)
    np.testing.assert_array_equal(read(tmp_path, data), picture()[::-1])


def test_a_palette_that_is_no_ramp_is_looked_up(tmp_path: Path) -> None:
    data = bitmap(picture())
    (first,) = struct.unpack_from("<I", data, 10)
    ramp = np.frombuffer(bytes(data[54:first]), np.uint8).reshape(256, 4)
    data[54:first] = (255 - ramp).tobytes()
    np.testing.assert_array_equal(read(tmp_path, data), 255 - picture())


@pytest.mark.parametrize(
    ("form", "at", "value", "words"),
    [
        ("<I", 30, 1, "8 bits, compressed"),
        ("<H", 28, 4, "4 bits"),
        ("<i", 18, -13, "-13 x 7"),
        ("<i", 18, 12, "13 x 7 pixels as bundle.json declares"),
        ("<I", 46, 16, "a palette of 16"),
        ("<I", 46, 2**31 - 1, "a palette that overlaps"),
        ("<I", 10, 60, "a palette that overlaps"),
        ("<I", 10, 2**32 - 1, "cut after"),
    ],
)
def test_a_header_that_cannot_be_right_is_told(tmp_path: Path, form: str, at: int, value: int, words: str) -> None:
    data = bitmap(picture())
    struct.pack_into(form, data, at, value)
    with pytest.raises(BundleError, match=words):
        read(tmp_path, data)


@pytest.mark.parametrize(("length", "words"), [(40, "without a header"), (-5, "cut after")])
def test_a_file_that_is_cut_is_told(tmp_path: Path, length: int, words: str) -> None:
    with pytest.raises(BundleError, match=words):
        read(tmp_path, bitmap(picture())[:length])
