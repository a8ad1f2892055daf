"""Pixel formats: known bytes give known samples, and what is missing or damaged is found so."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.v4l2.formats import (
    LAYOUTS,
    PREFERRED,
    CorruptFrameError,
    SamplePacking,
    colour_image,
    grey_image,
    min_stride_bytes,
)
from slrig.model import Pixels, Size
from tests.contract.v4l2_sensor import BIT_DEPTHS, encoded

SIZE = Size(13, 6)


def ramp(bit_depth: int, size: Size = SIZE) -> Pixels:
    values = np.linspace(0, 2**bit_depth - 1, size.width_px * size.height_px).reshape(size.shape)
    return np.rint(values).astype(np.uint8 if bit_depth <= 8 else np.uint16)


@pytest.mark.parametrize("padding_bytes", [0, 7])
@pytest.mark.parametrize("code", [code for code in BIT_DEPTHS if code not in ("MJPG", "RG10")])
def test_samples_come_back_as_they_were_sent(code: str, padding_bytes: int) -> None:
    layout, size = LAYOUTS[code], Size(12, 6)
    sent = ramp(BIT_DEPTHS[code], size)
    stride = min_stride_bytes(layout, size) + padding_bytes
    data = np.frombuffer(encoded(sent, code, stride), np.uint8)
    image = grey_image(data, layout, size, stride_bytes=stride)
    np.testing.assert_array_equal(image, sent)
    assert image.dtype == sent.dtype
    assert image.flags.owndata or image.base is not data
    # The last row may come without its padding, and not with less.
    assert grey_image(data[: len(data) - padding_bytes], layout, size, stride_bytes=stride).shape == size.shape
    with pytest.raises(CorruptFrameError, match="of"):
        grey_image(data[: len(data) - padding_bytes - 1], layout, size, stride_bytes=stride)


@pytest.mark.parametrize(
    ("code", "row", "samples"),
    [
        # By the kernel's documentation of V4L2_PIX_FMT_Y10P: the low bits are in the fifth byte.
        ("Y10P", [0xFF, 0x00, 0x80, 0x01, 0b11_10_01_00], [0x3FC, 0x001, 0x202, 0x007]),
        # And of V4L2_PIX_FMT_SRGGB12P.
        ("Y12P", [0xFF, 0x01, 0xA5], [0xFF5, 0x01A]),
        ("Y12 ", [0x34, 0x02, 0xFF, 0x0F], [0x234, 0xFFF]),
        ("UYVY", [128, 10, 128, 20], [10, 20]),
        ("YVYU", [10, 128, 20, 128], [10, 20]),
        ("VYUY", [128, 10, 128, 20], [10, 20]),
    ],
)
def test_known_bytes_give_known_samples(code: str, row: list[int], samples: list[int]) -> None:
    size = Size(len(samples), 1)
    image = grey_image(np.array(row, np.uint8), LAYOUTS[code], size, stride_bytes=len(row))
    assert image.tolist() == [samples]


def planar(code: str, size: Size, stride: int) -> tuple[bytes, Pixels, Pixels]:
    """A frame of random samples in planes, by V4L2's documents: its bytes, grey and colour image."""
    rng = np.random.default_rng(1)
    half = (-(-size.height_px // 2), -(-size.width_px // 2))
    luma = rng.integers(60, 190, size.shape, np.uint8)
    blue, red = (rng.integers(112, 144, half, np.uint8) for _ in range(2))

    def padded(rows: Pixels, width: int) -> bytes:
        return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=0xEE).tobytes()

    first, second = (red, blue) if code in {"NV21", "YV12"} else (blue, red)
    pairs = np.stack([first, second], axis=-1).reshape(half[0], -1)
    rest = padded(pairs, stride) if code.startswith("NV") else padded(first, stride // 2) + padded(second, stride // 2)
    y, cb, cr = (
        luma.astype(float),
        *(each.repeat(2, 0).repeat(2, 1)[: size.height_px, : size.width_px] - 128.0 for each in (blue, red)),
    )
    # JFIF's matrix.
    colour = np.stack([y + 1.772 * cb, y - 0.344136 * cb - 0.714136 * cr, y + 1.402 * cr], axis=-1)
    return padded(luma, stride) + rest, luma, np.rint(colour).astype(np.uint8)


@pytest.mark.parametrize("code", ["NV12", "NV21", "YU12", "YV12"])
@pytest.mark.parametrize("stride", [32, 38])
def test_planes_give_grey_and_colour(code: str, stride: int) -> None:
    size, layout = Size(32, 24), LAYOUTS[code]
    sent, luma, colour = planar(code, size, stride)
    data = np.frombuffer(sent, np.uint8)
    np.testing.assert_array_equal(grey_image(data, layout, size, stride_bytes=stride), luma)
    seen = colour_image(data, layout, size, stride_bytes=stride).astype(int)
    np.testing.assert_allclose(seen, colour, atol=1)
    for read in (grey_image, colour_image):
        with pytest.raises(CorruptFrameError, match="bytes of"):
            read(data[: -stride // 2], layout, size, stride_bytes=stride)


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("code", ["RGB3", "BGR3"])
def test_triples_give_grey_and_colour(code: str, padding: int) -> None:
    size = Size(13, 6)
    colour = np.random.default_rng(2).integers(0, 256, (*size.shape, 3), np.uint8)
    rows = (colour[..., ::-1] if code == "RGB3" else colour).reshape(6, -1)
    data = np.frombuffer(np.pad(rows, ((0, 0), (0, padding))).tobytes(), np.uint8)
    stride = 39 + padding
    np.testing.assert_array_equal(colour_image(data, LAYOUTS[code], size, stride_bytes=stride), colour)
    grey = grey_image(data, LAYOUTS[code], size, stride_bytes=stride)
    np.testing.assert_allclose(grey.astype(float), colour @ [0.114, 0.587, 0.299], atol=1)


@pytest.mark.parametrize(("code", "bits"), [("Y10 ", 10), ("Y12 ", 12), ("RG10", 10)])
def test_samples_that_are_shifted_up_come_down_or_are_refused(code: str, bits: int) -> None:
    size, shift = Size(8, 4), 16 - bits
    samples = np.full(size.shape, 0x155, np.uint16)
    # By NVIDIA's technical reference: the upper bits again below the sample.
    sent = (samples << shift | samples >> (bits - shift)).astype("<u2")
    data = np.frombuffer(sent.tobytes(), np.uint8)
    shifted = replace(LAYOUTS[code], shift=shift)
    np.testing.assert_array_equal(grey_image(data, shifted, size, stride_bytes=16), samples)
    with pytest.raises(CorruptFrameError, match=f"write sample_shift = {shift}"):
        grey_image(data, LAYOUTS[code], size, stride_bytes=16)


def test_the_kernels_names_of_mosaics_are_not_confused() -> None:
    # SGRBG10 and SGRBG12 have the odd names BA10 and BA12, SBGGR8 is BA81 and SBGGR16 is BYR2.
    assert [LAYOUTS[code].bayer for code in ("BA81", "BA10", "BA12", "BYR2", "RG10", "GB12")] == [
        *("BGGR", "GRBG", "GRBG", "BGGR", "RGGB", "GBRG")
    ]


def test_every_format_that_can_be_read_has_its_rank() -> None:
    assert sorted(PREFERRED) == sorted(LAYOUTS)
    assert PREFERRED.index("GREY") < PREFERRED.index("YUYV") < PREFERRED.index("MJPG")


def test_limited_luma_is_expanded() -> None:
    row = np.array([16, 128, 235, 128, 0, 128, 255, 128], np.uint8)
    image = grey_image(row, LAYOUTS["YUYV"], Size(4, 1), stride_bytes=8, limited_luma=True)
    assert image.tolist() == [[0, 255, 0, 255]]
    grey = grey_image(row[:4].copy(), LAYOUTS["GREY"], Size(4, 1), stride_bytes=4, limited_luma=True)
    assert grey.tolist() == [[16, 128, 235, 128]]


def plain_colour(code: str, size: Size) -> tuple[bytes, int, Pixels]:
    """A buffer of a colour camera whose picture is a ramp of one hue, the bytes of a row, and the picture."""
    ramp_ = np.linspace(0.2, 0.9, size.height_px)[:, None, None] * np.array([40.0, 120.0, 200.0])
    colour = np.rint(np.broadcast_to(ramp_, (*size.shape, 3))).astype(np.uint8)
    layout = LAYOUTS[code]
    if layout.packing is SamplePacking.JPEG:
        done, data = cv2.imencode(".jpg", colour, [cv2.IMWRITE_JPEG_QUALITY, 100])
        assert done
        return data.tobytes(), 0, colour
    if layout.bayer is not None:
        scale = 2 ** (layout.bit_depth - 8)
        mosaic = np.zeros(size.shape, "<u2" if layout.bit_depth > 8 else np.uint8)
        for (y, x), name in zip(itertools.product((0, 1), (0, 1)), layout.bayer, strict=True):
            mosaic[y::2, x::2] = colour[y::2, x::2, "BGR".index(name)].astype(mosaic.dtype) * scale
        return mosaic.tobytes(), mosaic.strides[0], colour.astype(np.uint16) * scale if scale > 1 else colour
    luma, red, blue = cv2.split(cv2.cvtColor(colour, cv2.COLOR_BGR2YCrCb))
    rows = np.zeros((size.height_px, 2 * size.width_px), np.uint8)
    places = {"YUYV": (0, 1, 3), "YVYU": (0, 3, 1), "UYVY": (1, 0, 2), "VYUY": (1, 2, 0)}[code]
    rows[:, places[0] :: 2] = luma
    rows[:, places[1] :: 4], rows[:, places[2] :: 4] = blue[:, ::2], red[:, ::2]
    return rows.tobytes(), rows.shape[1], colour


@pytest.mark.parametrize("code", ["YUYV", "YVYU", "UYVY", "VYUY", "MJPG", "RGGB", "BA81", "GB10", "BA12", "BYR2"])
def test_colour_formats_give_blue_green_and_red(code: str) -> None:
    size, layout = Size(32, 24), LAYOUTS[code]
    data, stride, colour = plain_colour(code, size)
    sent = np.frombuffer(data, np.uint8)
    seen = colour_image(sent, layout, size, stride_bytes=stride)
    assert layout.has_colour
    assert (seen.shape, seen.dtype) == ((24, 32, 3), colour.dtype)
    full = 2**layout.bit_depth - 1
    # Interpolation of a mosaic follows the ramp but at its ends; JPEG halves the columns of colour, and rounds.
    np.testing.assert_allclose(seen[2:-2, 2:-2].astype(float), colour[2:-2, 2:-2], atol=0.013 * full)
    # Its grey is the one that stripes are found in.
    grey = grey_image(sent, layout, size, stride_bytes=stride)
    np.testing.assert_allclose(cv2.cvtColor(seen, cv2.COLOR_BGR2GRAY).astype(float), grey, atol=0.008 * full)
    assert cv2.cvtColor(seen, cv2.COLOR_BGR2GRAY).dtype == grey.dtype


def test_colour_of_limited_luma_is_expanded() -> None:
    rows = np.array([16, 128, 235, 128, 126, 128, 126, 128], np.uint8)
    seen = colour_image(rows, LAYOUTS["YUYV"], Size(4, 1), stride_bytes=8, limited_luma=True)
    assert seen.tolist() == [[[0] * 3, [255] * 3, [128] * 3, [128] * 3]]


# ---- JPEG: damage that a decoder would fill in

Bytes = NDArray[np.uint8]
JPEG_SIZE = Size(640, 477)
QUALITY = [cv2.IMWRITE_JPEG_QUALITY, 90]
KINDS = {
    "colour": QUALITY,
    "halved colour": [*QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422],
    "own tables": [*QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "restarts": [*QUALITY, cv2.IMWRITE_JPEG_RST_INTERVAL, 5],
}


def picture(kind: str = "colour", size: Size = JPEG_SIZE, *, grey: bool = False) -> Bytes:
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


def fault_of(data: Bytes, size: Size = JPEG_SIZE) -> str:
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
    for size in (JPEG_SIZE, Size(17, 9), Size(8, 8)):
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


def test_what_is_no_jpeg_and_one_of_another_size_are_corrupt() -> None:
    assert all("begin" in fault_of(np.frombuffer(data, np.uint8)) for data in (b"", bytes([7] * 3000)))
    assert "64 x 40" in fault_of(picture(size=Size(64, 40)), Size(64, 48))


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
