"""What a buffer holds, as an image: every format, against an encoder that shares nothing with the decoder."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.genicam.pixels import FORMATS, PfncFormat, PixelPacking, decode_pixels
from slrig.model import Pixels, Size

SIZES = [Size(12, 5), Size(7, 3), Size(5, 1)]


def encoded(image: Pixels, name: str) -> bytes:
    """The bytes of an (H, W) image in a PFNC format."""
    samples = [int(sample) for sample in image.ravel()]
    if name.endswith("Packed"):
        depth = 10 if "10" in name else 12
        low_bits = depth - 8
        if len(samples) % 2:
            samples.append(0)
        pairs = zip(samples[::2], samples[1::2], strict=True)
        mask = (1 << low_bits) - 1
        packed = b"".join(
            bytes([one >> low_bits, (one & mask) | (other & mask) << 4, other >> low_bits]) for one, other in pairs
        )
        return packed[: -(-12 * image.size // 8)]
    if name.endswith("p"):
        depth = 10 if "10" in name else 12
        stream = sum(sample << depth * index for index, sample in enumerate(samples))
        return stream.to_bytes(-(-depth * len(samples) // 8), "little")
    if name.endswith("8"):
        return image.astype(np.uint8).tobytes()
    return image.astype("<u2").tobytes()


def image_of(size: Size, bit_depth: int, seed: int = 3) -> Pixels:
    kind = np.uint8 if bit_depth <= 8 else np.uint16
    return np.random.default_rng(seed).integers(0, 2**bit_depth, size.shape).astype(kind)


@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.parametrize("form", [form for form in FORMATS.values() if not form.mosaic], ids=lambda form: form.name)
def test_a_mono_image_comes_out_as_it_went_in(form: PfncFormat, size: Size) -> None:
    image = image_of(size, form.bit_depth)
    data = encoded(image, form.name)
    assert len(data) == form.size_bytes(size)
    got = decode_pixels(data + b"rest", form, size)
    assert got.dtype == image.dtype
    np.testing.assert_array_equal(got, image)


@pytest.mark.parametrize("mosaic", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize("kind", ["8", "10", "12", "16", "12p", "10Packed"])
def test_a_mosaic_is_weighted_as_luma(mosaic: str, kind: str) -> None:
    form = FORMATS[f"Bayer{mosaic}{kind}"]
    size = Size(16, 12)
    full = 2**form.bit_depth - 1
    luma = {"R": 0.299, "G": 0.587, "B": 0.114}
    cells = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}[mosaic]
    for colour, weight in luma.items():
        lit = np.array([cell == colour for cell in cells]).reshape(2, 2)
        image = (np.tile(lit, (6, 8)) * full).astype(np.uint8 if form.bit_depth <= 8 else np.uint16)
        got = decode_pixels(encoded(image, form.name), form, size)
        assert got.shape == size.shape
        assert got.dtype == image.dtype
        np.testing.assert_allclose(got[2:-2, 2:-2], weight * full, atol=0.01 * full)
        seen = decode_pixels(encoded(image, form.name), form, size, in_colour=True)
        assert seen.dtype == image.dtype
        expected = np.broadcast_to(full * (np.array(list("BGR")) == colour), (8, 12, 3))
        np.testing.assert_array_equal(seen[2:-2, 2:-2], expected)


@pytest.mark.parametrize(("name", "first"), [("RGB8", 0.299), ("BGR8", 0.114)])
def test_colour_is_weighted_as_luma(name: str, first: float) -> None:
    size = Size(3, 2)
    data = (np.array([[[200, 0, 0]] * 3] * 2, np.uint8)).tobytes()
    np.testing.assert_allclose(decode_pixels(data, FORMATS[name], size), 200 * first, atol=1)
    assert (
        decode_pixels(data, FORMATS[name], size, in_colour=True)[1, 2].tolist()
        == [0, 0, 200][:: 1 if name == "RGB8" else -1]
    )


def test_padding_after_rows_is_cut_off() -> None:
    size = Size(6, 4)
    image = image_of(size, 12)
    rows = image.astype("<u2").view(np.uint8).reshape(4, 12)
    padded = np.hstack([rows, np.full((4, 4), 0xAB, np.uint8)]).tobytes()
    np.testing.assert_array_equal(decode_pixels(padded, FORMATS["Mono12"], size, padding_bytes=4), image)
    np.testing.assert_array_equal(decode_pixels(padded[:-4], FORMATS["Mono12"], size, padding_bytes=4), image)
    with pytest.raises(ValueError, match="cannot be"):
        decode_pixels(padded, FORMATS["Mono12p"], size, padding_bytes=4)


@pytest.mark.parametrize("form", FORMATS.values(), ids=lambda form: form.name)
def test_a_short_buffer_is_refused(form: PfncFormat) -> None:
    size = Size(8, 4)
    with pytest.raises(ValueError, match=form.name):
        decode_pixels(bytes(form.size_bytes(size) - 1), form, size)


def test_samples_above_the_bit_depth_are_cut_off() -> None:
    words = np.array([[4096, 65535, 17]], "<u2")
    assert decode_pixels(words.tobytes(), FORMATS["Mono12"], Size(3, 1)).tolist() == [[4095, 4095, 17]]


def test_every_format_says_how_it_is_packed() -> None:
    for form in FORMATS.values():
        assert form.name.endswith("p") == (form.packing is PixelPacking.LSB)
        assert form.name.endswith("Packed") == (form.packing is PixelPacking.GIGE)
