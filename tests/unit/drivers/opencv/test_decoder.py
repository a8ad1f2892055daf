"""What OpenCV hands over, as grey images; what is damaged is refused."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers.opencv.camera import FrameDecoder, image_decoder, raw_decoder
from drivers.v4l2.formats import CorruptFrameError
from slrig.model import CameraFormat, Pixels, Size

SIZE = Size(16, 8)
RAMP = np.arange(128, dtype=np.uint8).reshape(SIZE.shape)


def test_raw_grey_of_any_depth_keeps_its_values() -> None:
    assert np.array_equal(raw_decoder("GREY", SIZE, None).grey(RAMP), RAMP)
    deep = RAMP.astype(np.uint16) * 31
    for code, bit_depth in (("Y12 ", 12), ("Y16 ", 16)):
        picture = raw_decoder(code, SIZE, None)
        assert picture.format == CameraFormat(SIZE, bit_depth)
        assert np.array_equal(picture.grey(deep), deep)
    assert raw_decoder("Y16 ", SIZE, 12).format.bit_depth == 12
    assert raw_decoder("GREY", SIZE, 12).format.bit_depth == 8


def test_mosaics_come_in_one_row_of_bytes() -> None:
    # As measured: OpenCV gives every format that it does not know as 1 x N bytes.
    assert np.array_equal(raw_decoder("RGGB", SIZE, None).grey(np.full((1, 128), 77, np.uint8)), np.full((8, 16), 77))
    ten = np.full(128, 500, "<u2").view(np.uint8).reshape(1, -1)
    picture = raw_decoder("RG10", SIZE, None)
    assert picture.format.bit_depth == 10
    assert np.array_equal(picture.grey(ten), np.full((8, 16), 500))


def test_decoded_colour_becomes_grey_without_loss() -> None:
    picture = image_decoder(cv2.cvtColor(RAMP, cv2.COLOR_GRAY2BGR), None)
    assert picture == FrameDecoder(None, CameraFormat(SIZE, 8), has_colour=True)
    assert np.array_equal(picture.grey(cv2.cvtColor(RAMP, cv2.COLOR_GRAY2BGR)), RAMP)
    deep = image_decoder(RAMP.astype(np.uint16) * 8, 10)
    assert deep.format.bit_depth == 10
    with pytest.raises(CorruptFrameError, match="float"):
        image_decoder(RAMP.astype(np.float64), None)


def jpeg() -> Pixels:
    encoded, data = cv2.imencode(".jpg", RAMP, [cv2.IMWRITE_JPEG_QUALITY, 100])
    assert encoded
    return np.asarray(data, dtype=np.uint8).reshape(-1)


@pytest.mark.parametrize(
    ("picture", "image", "words"),
    [
        (
            FrameDecoder(None, CameraFormat(SIZE, 8)),
            np.zeros((8, 15), np.uint8),
            "15 x 8, the camera's frames are 16 x 8",
        ),
        (FrameDecoder(None, CameraFormat(SIZE, 8)), np.zeros((8, 16), np.uint16), "uint16"),
        (
            FrameDecoder(None, CameraFormat(SIZE, 12)),
            np.full((8, 16), 4096, np.uint16),
            "up to 4096, 12 bits end at 4095",
        ),
        (raw_decoder("RG10", SIZE, None), np.zeros((1, 200), np.uint8), "bytes"),
    ],
)
def test_frames_of_another_kind_are_refused(picture: FrameDecoder, image: Pixels, words: str) -> None:
    with pytest.raises(CorruptFrameError, match=words):
        picture.grey(image)


def test_formats_with_colour_give_colour() -> None:
    bgr = np.dstack([RAMP, RAMP // 2, 255 - RAMP])
    assert np.array_equal(image_decoder(bgr, None).colour(bgr), bgr)
    assert raw_decoder(None, SIZE, None).has_colour
    assert not image_decoder(RAMP, None).has_colour
    assert not raw_decoder("GREY", SIZE, None).has_colour
    for code, sent in (("MJPG", jpeg()), ("YUYV", np.dstack([RAMP, np.full(SIZE.shape, 128, np.uint8)]))):
        picture = raw_decoder(code, SIZE, None)
        assert picture.has_colour
        assert np.array_equal(picture.colour(sent), cv2.cvtColor(picture.grey(sent), cv2.COLOR_GRAY2BGR))
