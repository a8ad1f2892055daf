"""The engine's rules of time, its tables, and the options of a rig file."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.dlpc350.flash import Place
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.tables import tables_of
from drivers.dlpc350.timing import MINIMUM_US, check_loading, check_timing, lit
from drivers.pattern_engine.options import Colour
from drivers.pattern_engine.timing import Timing
from slrig.bundle.faults import checked
from slrig.errors import ConfigError, UnsupportedByDeviceError
from slrig.model import Primary, White


@pytest.mark.parametrize(
    ("exposure_us", "period_us", "rule"),
    [
        (234, 500, "shortest exposure of a 1-bit pattern is 235 µs"),
        (1000, 1229, "shorter by 230 µs at least"),
        (1001, 1000, "shorter by 230 µs at least"),
        (200_000_000, 200_000_300, "the longest is 200000000 µs"),
    ],
)
def test_a_timing_is_judged_by_rules_with_names(exposure_us: int, period_us: int, rule: str) -> None:
    for sound in ((235, 235), (1000, 1230), (1000, 1000), (200_000_000, 200_000_000)):
        check_timing(Timing(*sound))
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        check_timing(Timing(exposure_us, period_us))


@pytest.mark.parametrize("bit_depth", MINIMUM_US)
def test_the_shortest_exposure_depends_on_the_bit_depth(bit_depth: int) -> None:
    least_us = MINIMUM_US[bit_depth]
    check_timing(Timing(least_us, least_us), bit_depth=bit_depth)
    with pytest.raises(UnsupportedByDeviceError, match=f"{bit_depth}-bit pattern is {least_us} µs"):
        check_timing(Timing(least_us - 1, least_us + 1000), bit_depth=bit_depth)


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "margin_s", "expected"),
    [
        (0.010, 0.020, 0.0005, Timing(10_500, 20_000)),
        (0.010, 0.0106, 0.0005, Timing(10_600, 10_600)),
        (0.010, 0.010, 0.0, Timing(10_000, 10_000)),
        (0.0001, 0.001, 0.0, Timing(235, 1000)),
    ],
)
def test_light_covers_the_exposure_and_the_camera_s_start(
    exposure_s: float, period_s: float, margin_s: float, expected: Timing
) -> None:
    assert lit(exposure_s, period_s, margin_s=margin_s, duty_limit=1.0) == expected


@pytest.mark.parametrize(
    ("timing", "margin_s", "duty_limit", "rule"),
    [
        ((0.010, 0.0104), 0.0005, 1.0, "light takes 10500 µs, the period is 10400 µs"),
        ((0.0, 0.01), 0.0, 1.0, "lengthen the period"),
        ((0.010, 0.020), 0.0, 0.4, r"light is on for 50% of the time, duty_limit .* 40%"),
    ],
)
def test_light_that_does_not_fit_is_refused(
    timing: tuple[float, float], margin_s: float, duty_limit: float, rule: str
) -> None:
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        lit(*timing, margin_s=margin_s, duty_limit=duty_limit)


def test_pictures_beyond_the_buffers_need_time() -> None:
    check_loading((1, 1), 235, 0.2)
    check_loading((24, 24, 1), 10_000, 0.2)
    with pytest.raises(UnsupportedByDeviceError, match=r"12 patterns every 10000 µs take 0\.12 s; .*0\.0167 s"):
        check_loading((24, 12, 1), 10_000, 0.2)


@pytest.mark.parametrize(
    ("places", "colours", "dark_between", "words"),
    [
        (
            [(3, 0, False), (3, 23, True), (3, 9, False)],
            [Colour.WHITE] * 3,
            True,
            [0b0110_0111_0001_000000_00, 0b0011_0111_0001_010111_00, 0b0010_0111_0001_001001_00],
        ),
        ([(0, 1, False)], [Colour.BLUE], False, [0b0100_0100_0001_000001_00]),
        # White in one light is lit by that LED alone.
        (
            [(0, 1, False)] * 3,
            [
                EngineOptions(patterns="p").colour_of(pattern)
                for pattern in (White(), Primary("green"), Primary("blue"))
            ],
            False,
            [0b0100_0111_0001_000001_00, 0b0000_0010_0001_000001_00, 0b0000_0100_0001_000001_00],
        ),
    ],
    ids=["dark between", "no dark between", "colours"],
)
def test_table_entries_are_laid_out_as_the_manual_says(
    places: list[tuple[int, int, bool]], colours: list[Colour], dark_between: bool, words: list[int]
) -> None:
    tables = tables_of(
        [Place(image, plane, inverted=inverted) for image, plane, inverted in places],
        colours,
        dark_between=dark_between,
    )
    assert [int.from_bytes(tables.patterns[3 * i : 3 * i + 3], "little") for i in range(len(places))] == words


@pytest.mark.parametrize(
    ("pictures", "swaps", "images", "counts"),
    [
        ([3, 3, 3], [1, 0, 0], [3], (3,)),
        ([5, 5, 2, 5], [1, 0, 1, 1], [5, 2, 5], (2, 1, 1)),
        # A table of two pictures is sent the other way round.
        ([7, 4], [1, 1], [4, 7], (1, 1)),
    ],
)
def test_each_change_of_picture_swaps_the_buffer(
    pictures: list[int], swaps: list[int], images: list[int], counts: tuple[int, ...]
) -> None:
    places = [Place(picture, 0, inverted=False) for picture in pictures]
    tables = tables_of(places, (Colour.RED,) * len(places), dark_between=False)
    assert [tables.patterns[3 * i + 2] >> 2 & 1 for i in range(len(places))] == swaps
    assert (list(tables.images), tables.counts, tables.length) == (images, counts, len(places))


def test_all_faults_of_the_options_are_reported_at_once() -> None:
    options: dict[str, Any] = {"patern": "p", "led": "ultraviolet", "hold_s": 1.0, "trigger_delay_us": 5.0}
    with pytest.raises(ConfigError) as refused:
        checked(EngineOptions, options, "the table")
    text = str(refused.value)
    for words in ("patern: unknown key; did you mean 'patterns'?", "patterns: missing", "led: ", "hold_s: ", "5.0"):
        assert words in text


def test_the_led_current_is_limited() -> None:
    assert EngineOptions(patterns="p", led_current=0.4).current_byte == 102
    with pytest.raises(ConfigError, match=r"led_current is 0\.6, led_current_limit allows 0\.5"):
        checked(EngineOptions, {"patterns": "p", "led_current": 0.6}, "the table")
    assert EngineOptions(patterns="p", led_current=0.6, led_current_limit=0.6).colour is Colour.WHITE
