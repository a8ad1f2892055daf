"""Damage in a JPEG that a decoder would paint over."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.v4l2 import jpeg
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


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_a_whole_jpeg_is_whole(kind: str, grey: bool) -> None:
    for size in (SIZE, Size(17, 9), Size(8, 8)):
        assert jpeg.fault_of(picture(kind, size, grey=grey)) == ""


@pytest.mark.parametrize("kind", KINDS)
def test_a_lost_packet_is_found(kind: str) -> None:
    rng, data = np.random.default_rng(7), picture(kind)
    # What a high-speed USB packet carries, and a scan of some sixty thousand bytes.
    found = [jpeg.fault_of(with_hole(data, rng, 1012)) != "" for _ in range(200)]
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
    assert jpeg.fault_of(frame) == ""
    assert jpeg.fault_of(with_hole(frame, np.random.default_rng(1), 1012))


def test_a_few_bytes_behind_the_last_block_are_usual_and_many_are_not() -> None:
    data = bytes(picture())
    for count, whole in ((4, True), (400, False)):
        frame = np.frombuffer(data[:-2] + b"\x55" * count + data[-2:] + bytes(100), np.uint8)
        assert (jpeg.fault_of(frame) == "") is whole


def test_restart_markers_out_of_turn_and_a_cut_are_found() -> None:
    data = bytearray(bytes(picture("restarts")))
    data[data.index(b"\xff\xd3") + 1] = 0xD5
    assert "restart" in jpeg.fault_of(np.frombuffer(bytes(data), np.uint8))
    assert all("early" in jpeg.fault_of(picture()[:kept]) for kept in (2, 30, 200, 600, 30_000))


def test_damage_anywhere_never_breaks_the_walk() -> None:
    rng, data = np.random.default_rng(3), picture(size=Size(64, 48))
    for _ in range(400):
        damaged = data.copy()
        damaged[rng.integers(2, len(data), 3)] = rng.integers(0, 256, 3)
        assert isinstance(jpeg.fault_of(damaged), str)


def test_the_compiled_walk_is_the_written_one(monkeypatch: pytest.MonkeyPatch) -> None:
    rng, data = np.random.default_rng(4), picture("restarts", Size(40, 24))
    frames = [data, *(with_hole(data, rng, int(rng.integers(1, 60))) for _ in range(25))]
    compiled = [jpeg.fault_of(frame) for frame in frames]
    monkeypatch.setattr(jpeg, "_walker", lambda: jpeg._walk)
    assert [jpeg.fault_of(frame) for frame in frames] == compiled
    assert len(set(compiled)) > 1


def test_other_kinds_are_left_to_the_decoder() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (48, 64)).astype(np.uint8)
    _, data = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])
    assert jpeg.fault_of(np.frombuffer(data.tobytes(), np.uint8)) == ""
