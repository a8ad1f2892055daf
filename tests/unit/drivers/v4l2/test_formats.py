"""Pixel formats: known bytes give known samples, and what is missing is found missing."""

from __future__ import annotations

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest

from drivers.v4l2.formats import (
    LAYOUTS,
    PREFERRED,
    CorruptFrameError,
    PixelLayout,
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


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
@pytest.mark.parametrize("bayer", ["BGGR", "GBRG", "GRBG", "RGGB"])
def test_a_mosaic_under_one_colour_has_that_colours_brightness(bayer: str, bit_depth: int) -> None:
    size, full = Size(16, 12), 2**bit_depth - 1
    packing = SamplePacking.BYTES if bit_depth == 8 else SamplePacking.WORDS
    for colour, weight in {"R": 0.299, "G": 0.587, "B": 0.114}.items():
        mosaic = np.zeros(size.shape, "<u2" if bit_depth > 8 else np.uint8)
        for (y, x), name in zip(itertools.product((0, 1), (0, 1)), bayer, strict=True):
            if name == colour:
                mosaic[y::2, x::2] = full
        data = np.frombuffer(mosaic.tobytes(), np.uint8)
        layout = PixelLayout(bit_depth, packing, bayer)
        image = grey_image(data, layout, size, stride_bytes=min_stride_bytes(layout, size))
        np.testing.assert_allclose(image[2:-2, 2:-2], weight * full, atol=2 + 0.002 * full)


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


def scene(size: Size) -> Pixels:
    noise = np.random.default_rng(0).integers(0, 255, size.shape).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), dtype=np.uint8)


def test_a_jpeg_is_decoded_and_one_that_is_cut_or_of_another_size_is_corrupt() -> None:
    size = Size(64, 48)
    sent = encoded(scene(size), "MJPG", 0)
    image = grey_image(np.frombuffer(sent, np.uint8), LAYOUTS["MJPG"], size, stride_bytes=0)
    assert np.abs(image.astype(int) - scene(size)).max() < 12
    for data, words in (
        (b"", "begin"),
        (sent[:200], "damaged"),
        (encoded(scene(Size(64, 40)), "MJPG", 0), "64 x 40"),
        (bytes([7] * 3000), "begin"),
    ):
        with pytest.raises(CorruptFrameError, match=words):
            grey_image(np.frombuffer(data, np.uint8), LAYOUTS["MJPG"], size, stride_bytes=0)


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


def test_grey_formats_have_no_colour() -> None:
    assert not any(LAYOUTS[code].has_colour for code in ("GREY", "Y10 ", "Y12P", "Y16 "))
