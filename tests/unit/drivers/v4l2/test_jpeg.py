"""Damage in a JPEG that a decoder would fill in."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.v4l2.formats import LAYOUTS, CorruptFrameError, colour_image, grey_image
from slrig.model import Size

Bytes = NDArray[np.uint8]
SIZE = Size(640, 477)
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 90]
KINDS = {
    "colour": QUALITY,
    "halved colour": [*QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422],
    "own tables": [*QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "restarts": [*QUALITY, cv2.IMWRITE_JPEG_RST_INTERVAL, 5],
}


def picture(kind: str = "colour", size: Size = SIZE, *, grey: bool = False) -> Bytes:
    noise = np.random.default_rng(2).integers(0, 255, (*size.shape, 3)).astype(np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2.0)
    done, data = cv2.imencode(".jpg", image[..., 0] if grey else image, KINDS[kind])
    assert done
    return np.frombuffer(data.tobytes(), np.uint8)


def scan_of(data: Bytes) -> int:
    """Where the coded data begin."""
    return bytes(data).index(b"\xff\xda") + 14


def with_hole(data: Bytes, rng: np.random.Generator, length: int) -> Bytes:
    first = int(rng.integers(scan_of(data), len(data) - length - 2))
    return np.concatenate([data[:first], data[first + length :]])


def fault_of(data: Bytes, size: Size = SIZE) -> str:
    """The message with which a frame is refused; "" if it is decoded."""
    try:
        image = grey_image(data, LAYOUTS["MJPG"], size, stride_bytes=0)
    except CorruptFrameError as error:
        return str(error)
    assert image.shape == size.shape
    return ""


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_jpeg_is_decoded_as_opencv_does(kind: str, grey: bool) -> None:
    for size in (SIZE, Size(17, 9), Size(8, 8)):
        data = picture(kind, size, grey=grey)
        for convert, flag in ((grey_image, cv2.IMREAD_GRAYSCALE), (colour_image, cv2.IMREAD_COLOR)):
            image = convert(data, LAYOUTS["MJPG"], size, stride_bytes=0)
            assert np.array_equal(image, np.asarray(cv2.imdecode(data, flag)))


@pytest.mark.parametrize(
    "kind",
    ["halved colour", *(pytest.param(each, marks=pytest.mark.slow) for each in KINDS if each != "halved colour")],
)
def test_a_lost_packet_is_found(kind: str) -> None:
    rng, data = np.random.default_rng(7), picture(kind)
    # What a high-speed USB packet carries, and a scan of some sixty thousand bytes.
    found = [fault_of(with_hole(data, rng, 1012)) != "" for _ in range(200)]
    assert sum(found) >= 198


def test_frames_without_tables_have_the_usual_ones() -> None:
    data = bytes(picture())
    bare, at = bytearray(data[:2]), 2
    while data[at + 1] != 0xDA:
        length = 2 + (data[at + 2] << 8 | data[at + 3])
        if data[at + 1] != 0xC4:
            bare += data[at : at + length]
        at += length
    frame = np.frombuffer(bytes(bare) + data[at:], np.uint8)
    assert fault_of(frame) == ""
    assert fault_of(with_hole(frame, np.random.default_rng(1), 1012))


def test_a_few_bytes_behind_the_last_block_are_usual_and_many_are_not() -> None:
    data = bytes(picture())
    for count, whole in ((0, True), (4, True), (400, False)):
        for end in (data[-2:] + bytes(100), data[-2:], b""):
            if count and not end:
                continue
            frame = np.frombuffer(data[:-2] + b"\x55" * count + end, np.uint8)
            assert (fault_of(frame) == "") is whole


def test_zeros_before_the_end_are_padding_however_many() -> None:
    data = bytes(picture())
    for count in (24, 608, 5000):
        assert fault_of(np.frombuffer(data[:-2] + bytes(count) + data[-2:], np.uint8)) == ""
        assert "bytes are between" in fault_of(np.frombuffer(data[:-2] + bytes(count) + b"\1" + data[-2:], np.uint8))


def test_restart_markers_out_of_turn_and_a_cut_are_found() -> None:
    data = bytearray(bytes(picture("restarts")))
    data[data.index(b"\xff\xd3") + 1] = 0xD5
    assert "RST3" in fault_of(np.frombuffer(bytes(data), np.uint8))
    assert all("damaged" in fault_of(picture()[:length]) for length in (2, 30, 200, 600, 30_000))


def test_damage_anywhere_is_refused_or_decoded() -> None:
    rng, size = np.random.default_rng(3), Size(64, 48)
    data = picture(size=size)
    for _ in range(400):
        damaged = data.copy()
        damaged[rng.integers(2, len(data), 3)] = rng.integers(0, 256, 3)
        assert isinstance(fault_of(damaged, size), str)


def test_progressive_ones_are_decoded() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8)
    _, data = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert fault_of(np.frombuffer(data.tobytes(), np.uint8), Size(64, 48)) == ""
