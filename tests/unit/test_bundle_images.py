"""Frames in PNG, BMP and JPEG files: as we and OpenCV write them, and as they come damaged."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from slrig.bundle import read_bundle, write_bundle
from slrig.bundle.description import DESCRIPTION
from slrig.bundle.images import encode_frame, read_pages, undo_up_filter
from slrig.errors import BundleError
from slrig.model import CameraFormat, Capture, Pixels, Shot, Size, White

# Rows of a BMP are padded to four bytes; 45 is no multiple of it, and neither is 3 x 45.
SIZE = Size(45, 27)
CAMERA = CameraFormat(SIZE, 8)
SIZES = [(1, 1), (1, 7), (9, 1), (37, 51)]


def noise(shape: tuple[int, ...], bits: int = 8) -> Pixels:
    values = np.random.default_rng(3).integers(0, 2**bits, shape)
    return values.astype(np.uint8 if bits == 8 else np.uint16)


def smooth() -> Pixels:
    x, y = np.meshgrid(np.arange(SIZE.width_px), np.arange(SIZE.height_px))
    return np.asarray(120 + 60 * np.sin(x / 5) * np.cos(y / 7), dtype=np.uint8)


def encode(ending: str, image: Pixels, *options: int) -> bytes:
    done, data = cv2.imencode(ending, image, options)
    assert done
    return data.tobytes()


def jpeg(image: Pixels, *options: int) -> bytes:
    return encode(".jpg", image, cv2.IMWRITE_JPEG_QUALITY, 90, *options)


def read(folder: Path, data: bytes | bytearray, camera: CameraFormat = CAMERA) -> Pixels:
    path = folder / "frame"
    path.write_bytes(data)
    return read_pages(path, [0], camera)[0]


def camera_of(image: Pixels) -> CameraFormat:
    rows, columns = image.shape
    return CameraFormat(Size(columns, rows), 8 * image.itemsize)


def by_opencv(data: bytes) -> Pixels:
    return np.asarray(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", SIZES)
def test_opencv_reads_the_png_that_we_write(shape: tuple[int, int], bits: int) -> None:
    image = noise(shape, bits)
    found = by_opencv(encode_frame(image, "frame"))
    assert found.dtype == image.dtype
    assert np.array_equal(found, image)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize(
    "filtered", [cv2.IMWRITE_PNG_FILTER_NONE, cv2.IMWRITE_PNG_FILTER_UP, cv2.IMWRITE_PNG_FILTER_PAETH, 0xF8]
)
def test_png_that_opencv_writes_is_read(tmp_path: Path, shape: tuple[int, int], bits: int, filtered: int) -> None:
    image = noise(shape, bits)
    found = read(tmp_path, encode(".png", image, cv2.IMWRITE_PNG_FILTER, filtered), camera_of(image))
    assert found.dtype == image.dtype
    assert np.array_equal(found, image)


def test_a_view_of_an_image_is_written_as_it_looks() -> None:
    image = noise((40, 60), 16)[::2, 10:50:3]
    assert np.array_equal(by_opencv(encode_frame(image, "frame")), image)


def test_png_of_our_own_needs_no_other_decoder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    image = noise((37, 51))
    monkeypatch.delattr(cv2, "imdecode")
    assert np.array_equal(read(tmp_path, encode_frame(image, "frame"), camera_of(image)), image)


def test_rows_of_several_filters_are_left_to_a_decoder() -> None:
    rows = bytearray(bytes(4) * 3)
    rows[0], rows[4], rows[8] = 2, 2, 1
    assert undo_up_filter(bytes(rows), 3, 8) is None


def test_png_of_our_own_is_at_most_a_quarter_larger_than_by_zlib() -> None:
    # Stripes that run down the image, with noise, as frames have them.
    stripes = 120 + 100 * np.sin(np.arange(640) / 5) + np.random.default_rng(5).normal(0, 2, (480, 640))
    image = np.clip(stripes, 0, 255).astype(np.uint8)
    plain = zlib.compress(np.vstack([image[:1], np.diff(image, axis=0)]).tobytes(), 6)
    assert len(encode_frame(image, "frame")) < 1.25 * len(plain)


@pytest.mark.parametrize(
    "image", [np.zeros((4, 5, 4), np.uint8), np.zeros((4, 5), np.float32), np.zeros((0, 5, 3), np.uint8)]
)
def test_an_array_that_is_not_a_frame_is_not_written(image: Pixels) -> None:
    with pytest.raises(BundleError, match="an image of 8 or 16 bits"):
        encode_frame(image, "frame.png")


def test_bmp_is_read_in_grey_in_colour_upside_down_and_by_its_palette(tmp_path: Path) -> None:
    grey, colour = noise(SIZE.shape), noise((*SIZE.shape, 3))
    np.testing.assert_array_equal(read(tmp_path, encode(".bmp", grey)), grey)
    np.testing.assert_array_equal(read(tmp_path, encode(".bmp", colour)), cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY))
    data = bytearray(encode(".bmp", grey))
    struct.pack_into("<i", data, 22, -SIZE.height_px)
    np.testing.assert_array_equal(read(tmp_path, data), grey[::-1])
    data = bytearray(encode(".bmp", grey))
    (first,) = struct.unpack_from("<I", data, 10)
    ramp = np.frombuffer(bytes(data[54:first]), np.uint8).reshape(256, 4)
    data[54:first] = (255 - ramp).tobytes()
    np.testing.assert_array_equal(read(tmp_path, data), 255 - grey)


@pytest.mark.parametrize("options", [(), (cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (cv2.IMWRITE_JPEG_RST_INTERVAL, 2)])
def test_jpeg_is_read_within_its_compression(tmp_path: Path, options: tuple[int, ...]) -> None:
    off = read(tmp_path, jpeg(smooth(), *options)).astype(float) - smooth()
    assert 0 < np.sqrt(np.mean(off**2)) < 3
    seen = read(tmp_path, jpeg(np.dstack([smooth()] * 3), *options))
    assert np.abs(seen.astype(float) - smooth()).max() < 12


def test_a_compression_noted_by_earlier_versions_is_accepted(tmp_path: Path) -> None:
    capture = Capture(Size(16, 8), (White(),), {"eye": CAMERA}, (Shot(0, "eye", smooth(), 0.01, 0.0),))
    write_bundle(tmp_path / "b", capture)
    description = tmp_path / "b" / DESCRIPTION
    noted = json.loads(description.read_text())
    noted["cameras"]["eye"]["compression_dn"] = 1.4
    description.write_text(json.dumps(noted))
    assert read_bundle(tmp_path / "b").capture.cameras == {"eye": CAMERA}


def overwrite(form: str, at: int, *values: int) -> Callable[[bytes], bytes]:
    """Writes numbers into a header."""

    def spoil(data: bytes) -> bytes:
        found = bytearray(data)
        struct.pack_into(form, found, at, *values)
        return bytes(found)

    return spoil


def without_quantisers(data: bytes) -> bytes:
    place = data.index(b"\xff\xdb")
    (length,) = struct.unpack_from(">H", data, place + 2)
    return data[:place] + data[place + 2 + length :]


START = jpeg(smooth()).index(b"\xff\xc0")


@pytest.mark.parametrize(
    ("ending", "spoil", "words"),
    [
        (".bmp", overwrite("<I", 30, 1), "8 bits, compressed"),
        (".bmp", overwrite("<H", 28, 4), "4 bits"),
        (".bmp", overwrite("<i", 18, -45), "-45 x 27"),
        (".bmp", overwrite("<i", 18, 44), "45 x 27 pixels as bundle.json declares"),
        (".bmp", overwrite("<I", 46, 16), "a palette of 16"),
        (".bmp", overwrite("<I", 46, 2**31 - 1), "a palette that overlaps"),
        (".bmp", overwrite("<I", 10, 60), "a palette that overlaps"),
        (".bmp", overwrite("<I", 10, 2**32 - 1), "cut after"),
        (".bmp", lambda data: data[:40], "without a header"),
        (".bmp", lambda data: data[:-5], "cut after"),
        (".jpg", lambda data: data[:-40], "cut after"),
        (".jpg", lambda data: data[:30], "breaks off"),
        (".jpg", overwrite("B", START + 4, 12), "12 bits"),
        (".jpg", overwrite("B", START + 1, 0xC9), "arithmetic"),
        (".jpg", without_quantisers, "quantisers"),
        (".jpg", overwrite(">HH", START + 5, 60_000, 60_000), "60000 x 60000"),
    ],
)
def test_a_damaged_or_strange_file_is_refused(
    tmp_path: Path, ending: str, spoil: Callable[[bytes], bytes], words: str
) -> None:
    data = jpeg(smooth()) if ending == ".jpg" else encode(ending, smooth())
    with pytest.raises(BundleError, match=words):
        read(tmp_path, spoil(data))


def test_any_cut_and_any_byte_of_a_jpeg_is_refused_or_read(tmp_path: Path) -> None:
    data = jpeg(smooth())
    random = np.random.default_rng(5)
    for _ in range(300):
        spoilt = bytearray(data[: int(random.integers(3, len(data) + 1))])
        spoilt[int(random.integers(3, max(len(spoilt), 4))) % len(spoilt)] = int(random.integers(256))
        try:
            assert read(tmp_path, spoilt).shape == SIZE.shape
        except BundleError as error:
            assert "frame" in str(error)  # noqa: PT017
