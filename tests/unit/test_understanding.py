"""What images of a folder show, found from small images of a bent screen without any names."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from slrig.errors import BundleError
from slrig.importers.detection import sample_image
from slrig.importers.orders import ProjectorCode, slstudio_micro_sequence
from slrig.importers.understanding import Understanding, understand
from slrig.model import Axis, Black, FloatArray, Gray, LineShift, Pattern, Pixels, Sine, Size, White
from tests.core import parametrize_core
from tests.rendered_folders import pattern_light

PROJECTOR = Size(200, 75)
CAMERA = (105, 280)
ENDS: list[Pattern] = [White(), Black()]


def screen(camera: tuple[int, int]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Projector column and row at each pixel of a bent screen, and its albedo: the middle of the light."""
    y, x = np.mgrid[: camera[0], : camera[1]].astype(np.float64)
    column = 18 + 0.6 * x + 3 * np.sin(y / 35) + 0.02 * y
    row = 12 + 0.6 * y + 2 * np.sin(x / 50)
    return column, row, 0.65 + 0.3 * np.sin(x / 17) * np.cos(y / 23)


def photographed(
    patterns: Sequence[Pattern], *, noise: float = 1.0, factors: Sequence[float] = (), camera: tuple[int, int] = CAMERA
) -> list[Pixels]:
    """Images of patterns, blurred by the size of a pixel; factors : of the light of each."""
    column, row, albedo = screen(camera)
    lit = np.hypot(*(np.mgrid[: camera[0], : camera[1]] - np.array(camera)[:, None, None] / 2)) < 130
    rng, images = np.random.default_rng(3), []
    for place, pattern in enumerate(patterns):
        light = pattern_light(pattern, PROJECTOR).astype(np.float64) / 255
        steps = np.linspace(-0.4, 0.4, 5)
        if light.size == 1:
            value = np.full(camera, light[0, 0])
        else:
            at = column if light.shape[0] == 1 else row
            flat = light.ravel()
            value = np.mean([flat[np.clip(np.rint(at + step), 0, len(flat) - 1).astype(int)] for step in steps], axis=0)
        image = (8 + 170 * value * albedo * lit) * (factors[place] if len(factors) else 1.0)
        images.append(np.clip(image + rng.normal(0, noise, camera), 0, 255).astype(np.uint8))
    return images


def bits(axis: Axis, *, cell: int = 1, offset: int = 0, inverses: bool = True) -> list[Gray]:
    count = ((PROJECTOR.along(axis) - 1 + offset) // cell).bit_length()
    both = (False, True) if inverses else (False,)
    return [Gray(axis, bit, count, cell, offset, inverted) for bit in range(count) for inverted in both]


def understood(images: Sequence[Pixels], **options: int) -> Understanding:
    return understand([sample_image(each) for each in images], PROJECTOR, "image {}".format, **options)


COLUMNS, ROWS = bits(Axis.COLUMN), bits(Axis.ROW)
LINES = [LineShift(Axis.COLUMN, shift, 8, 4) for shift in range(8)]
ORDERS: dict[str, list[Pattern]] = {
    "white and black first": [*ENDS, *COLUMNS],
    "both axes, references last": [*COLUMNS, *ROWS, *ENDS],
    "rows first, fine to coarse": [*ENDS, *ROWS[::-1], *COLUMNS[::-1]],
    "inverses after all bits": [*ENDS, *COLUMNS[::2], *COLUMNS[1::2]],
    "axes mixed": [*ENDS, *(each for k in range(8) for axis in (COLUMNS, ROWS) for each in axis[2 * k : 2 * k + 2])],
    "neither white nor black nor inverses": list(bits(Axis.COLUMN, inverses=False)),
    "wider cells": [*ENDS, *bits(Axis.COLUMN, cell=2)],
    "centred": [*ENDS, *bits(Axis.COLUMN, offset=28), *bits(Axis.ROW, offset=90)],
    "as many bits of rows as of columns": [
        *COLUMNS,
        *(Gray(Axis.ROW, bit, 8, inverted=inverted) for bit in range(8) for inverted in (False, True)),
    ],
    "lines": [*ENDS, *bits(Axis.COLUMN, cell=4), *LINES],
}


@pytest.mark.parametrize("order", [pytest.param(each, marks=[pytest.mark.slow] * (each != "lines")) for each in ORDERS])
def test_orders_are_found_from_the_images(order: str) -> None:
    shown = ORDERS[order]
    found = understood(photographed(shown, noise=4.0))
    assert found.patterns == shown


@parametrize_core("inverses", [True, False])
def test_bits_in_an_order_of_no_program_are_taken_for_what_they_show_and_doubted(*, inverses: bool) -> None:
    columns = bits(Axis.COLUMN, inverses=inverses)
    per_bit = 2 if inverses else 1
    shown = [*ENDS, *(each for bit in (0, 1, 2, 6, 7, 5, 3, 4) for each in columns[per_bit * bit :][:per_bit])]
    found = understood(photographed(shown))
    assert found.patterns == shown
    assert [doubt.text for doubt in found.doubts] == [
        "the bits of columns come in the order 0, 1, 2, 6, 7, 5, 3, 4, by what they show: no program is known to do so"
    ]


@pytest.mark.slow
def test_one_factor_of_light_per_image_is_free_and_named() -> None:
    shown = ORDERS["both axes, references last"]
    found = understood(photographed(shown, factors=[1 + 0.3 * np.sin(2.1 * place) for place in range(len(shown))]))
    assert found.patterns == shown
    assert not found.doubts
    assert any("automatic exposure" in fact for fact in found.facts)


def test_an_image_that_is_missing_doubled_or_out_of_place_is_doubtful() -> None:
    shown = ORDERS["white and black first"]
    images = photographed(shown)
    missing = understood([*images[:7], *images[8:]])
    assert missing.patterns == [*shown[:7], *shown[8:]]
    assert [doubt.text for doubt in missing.doubts] == ["no image shows column bit 2 inverse: a frame is missing"]
    doubled = understood([*images[:8], images[7], *images[8:]])
    assert doubled.patterns == [*shown[:8], None, *shown[8:]]
    assert [(doubt.text, doubt.images) for doubt in doubled.doubts] == [
        ("image 8 is a copy of image 7: left out", (8,))
    ]  # fmt: skip
    exchanged = [*images[:9], images[11], images[10], images[9], *images[12:]]
    found = understood(exchanged)
    assert found.patterns == [*shown[:9], shown[11], shown[10], shown[9], *shown[12:]]
    assert [doubt.images for doubt in found.doubts] == [(9, 11)]


def test_a_bit_without_any_image_is_named() -> None:
    shown = ORDERS["neither white nor black nor inverses"]
    with pytest.raises(BundleError, match="no image shows column bit 3 of 8, nor its inverse"):
        understood(photographed([*shown[:3], *shown[4:]]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "rest",
    [pytest.param([], id="alone"), *(pytest.param(each, marks=pytest.mark.slow) for each in (LINES, ROWS))],
)
def test_a_code_with_an_inverted_first_bit_is_mirrored(rest: list[Pattern]) -> None:
    code = bits(Axis.COLUMN, inverses=True)
    played: list[Pattern] = [*ENDS, *code, *rest]
    first = (Gray(Axis.COLUMN, 0, 8), Gray(Axis.COLUMN, 0, 8, inverted=True))
    wrong = [each.inverse if isinstance(each, Gray) and each in first else each for each in played]
    found = understood(photographed(wrong))
    assert found.patterns == wrong
    assert any("the code of columns is mirrored" in doubt.text for doubt in found.doubts)


@pytest.mark.parametrize(("cell", "period", "steps"), [(8, 32.0, 8), pytest.param(16, 16.0, 3, marks=pytest.mark.slow)])
def test_sinusoids_beside_a_code_are_named(cell: int, period: float, steps: int) -> None:
    shown = [*ENDS, *bits(Axis.COLUMN, cell=cell), *(Sine(Axis.COLUMN, period, k, steps) for k in range(steps))]
    assert understood(photographed(shown)).patterns == shown


def shifted(axis: Axis, *periods: float, steps: int, backward: bool = False) -> list[list[Pattern]]:
    """Images of each period."""
    return [[Sine(axis, period, -k % steps if backward else k, steps) for k in range(steps)] for period in periods]


def joined(groups: Iterable[Sequence[Pattern]]) -> list[Pattern]:
    return [each for group in groups for each in group]


SINUSOIDS: dict[str, list[Pattern]] = {
    "three periods": [*ENDS, *joined(shifted(Axis.COLUMN, 200, 50, 10, steps=4))],
    "two periods in three steps": joined(shifted(Axis.COLUMN, 20, 200, steps=3)),
    "shifted backward, references last": [*joined(shifted(Axis.COLUMN, 200, 40, 10, steps=5, backward=True)), *ENDS],
    "no period over the projector": [*ENDS, *joined(shifted(Axis.COLUMN, 200 / 13, 200 / 11, 20, steps=4))],
    "both axes, a step of each period": [
        *ENDS,
        *joined(zip(*shifted(Axis.COLUMN, 200, 25, steps=4), strict=True)),
        *joined(zip(*shifted(Axis.ROW, 75, 15, steps=4), strict=True)),
    ],
    "micro phase shift": list(slstudio_micro_sequence(ProjectorCode(PROJECTOR), 12)),
}


@pytest.mark.parametrize(
    "kind", [pytest.param(each, marks=[pytest.mark.slow] * (each != "three periods")) for each in SINUSOIDS]
)
def test_sinusoids_of_several_periods_are_found_from_the_images(kind: str) -> None:
    images = [(255 * (each / 255) ** 2.2).astype(np.uint8) for each in photographed(SINUSOIDS[kind])]
    found = understood(images)
    assert found.patterns == SINUSOIDS[kind]
    assert not found.doubts


@pytest.mark.slow
def test_periods_that_the_images_do_not_determine_are_doubtful() -> None:
    found = understood(photographed([*ENDS, *joined(shifted(Axis.COLUMN, 256, 64, 16, steps=4))]))
    assert len(found.doubts) == 1
    assert "256, 64, 16" in found.doubts[0].text
    assert "state them by --pattern" in found.doubts[0].text


def test_sinusoids_that_nothing_numbers_are_refused_by_name() -> None:
    with pytest.raises(BundleError, match="one period of columns, and nothing numbers its periods"):
        understood(photographed(joined(shifted(Axis.COLUMN, 25, steps=4))))
    with pytest.raises(BundleError, match="2 periods of columns, as 1 : 2 in number, turn more than once"):
        understood(photographed(joined(shifted(Axis.COLUMN, 25, 12.5, steps=4))))


def test_too_few_bits_for_the_projector_are_said() -> None:
    code = [replace(each, cell_px=8) for each in bits(Axis.COLUMN, cell=8)]
    found = understood(photographed([*ENDS, *code]))
    assert found.patterns == [*ENDS, *code]
    assert "5 bits with cells of 1 px would end at column 31, the projector has 200: taken as cells of 8 px" in (
        found.doubts[0].text
    )


def test_plain_binary_codes_are_refused() -> None:
    binary = [LineShift(Axis.COLUMN, 2**s, 2 ** (s + 1), 2**s) for s in range(6, 0, -1)]
    images = photographed([*ENDS, Gray(Axis.COLUMN, 0, 8), *binary])
    with pytest.raises(BundleError, match="plain binary"):
        understood(images)
