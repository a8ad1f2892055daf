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
        (235, 235, None),
        (234, 500, "shortest exposure of a 1-bit pattern is 235 µs"),
        (1000, 1229, "shorter by 230 µs at least"),
        (1000, 1230, None),
        (1000, 1000, None),
        (1001, 1000, "shorter by 230 µs at least"),
        (200_000_000, 200_000_000, None),
        (200_000_000, 200_000_300, "the longest is 200000000 µs"),
    ],
)
def test_a_timing_is_judged_by_rules_with_names(exposure_us: int, period_us: int, rule: str | None) -> None:
    timing = Timing(exposure_us, period_us)
    if rule is None:
        check_timing(timing)
    else:
        with pytest.raises(UnsupportedByDeviceError, match=rule):
            check_timing(timing)


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


def test_light_that_does_not_fit_is_refused() -> None:
    with pytest.raises(UnsupportedByDeviceError, match="light takes 10500 µs, the period is 10400 µs"):
        lit(0.010, 0.0104, margin_s=0.0005, duty_limit=1.0)
    with pytest.raises(UnsupportedByDeviceError, match="lengthen the period"):
        lit(0.0, 0.01, margin_s=0.0, duty_limit=1.0)


def test_the_duty_limit_is_held() -> None:
    with pytest.raises(UnsupportedByDeviceError, match=r"light is on for 50% of the time, duty_limit .* 40%"):
        lit(0.010, 0.020, margin_s=0.0, duty_limit=0.4)
    assert lit(0.010, 0.025, margin_s=0.0, duty_limit=0.4) == Timing(10_000, 25_000)


def test_pictures_beyond_the_buffers_need_time() -> None:
    check_loading((1, 1), 235, 0.2)
    check_loading((24, 24, 1), 10_000, 0.2)
    with pytest.raises(UnsupportedByDeviceError, match=r"12 patterns every 10000 µs take 0\.12 s; .*0\.0167 s"):
        check_loading((24, 12, 1), 10_000, 0.2)


def test_table_entries_are_laid_out_as_the_manual_says() -> None:
    places = (Place(3, 0, inverted=False), Place(3, 23, inverted=True), Place(3, 9, inverted=False))
    tables = tables_of(places, (Colour.WHITE,) * len(places), dark_between=True)
    words = [int.from_bytes(tables.patterns[3 * i : 3 * i + 3], "little") for i in range(3)]
    assert words == [
        0b0110_0111_0001_000000_00,
        0b0011_0111_0001_010111_00,
        0b0010_0111_0001_001001_00,
    ]
    assert (tables.images, tables.counts, tables.length) == (b"\3", (3,), 3)


def test_colour_and_a_pattern_without_dark_between() -> None:
    tables = tables_of((Place(0, 1, inverted=False),), (Colour.BLUE,), dark_between=False)
    assert int.from_bytes(tables.patterns, "little") == 0b0100_0100_0001_000001_00


def test_white_in_one_light_is_lit_by_that_led_alone() -> None:
    options = EngineOptions(patterns="p")
    colours = [options.colour_of(pattern) for pattern in (White(), Primary("green"), Primary("blue"))]
    tables = tables_of([Place(0, 1, inverted=False)] * 3, colours, dark_between=False)
    words = [int.from_bytes(tables.patterns[3 * i : 3 * i + 3], "little") for i in range(3)]
    assert [word >> 12 & 7 for word in words] == [0b111, 0b010, 0b100]


def test_each_change_of_picture_swaps_the_buffer() -> None:
    places = [Place(image, 0, inverted=False) for image in (5, 5, 2, 5)]
    tables = tables_of(places, (Colour.RED,) * len(places), dark_between=False)
    assert [tables.patterns[3 * i + 2] >> 2 & 1 for i in range(4)] == [1, 0, 1, 1]
    assert (tables.images, tables.counts) == (bytes([5, 2, 5]), (2, 1, 1))


def test_a_table_of_two_pictures_is_sent_the_other_way_round() -> None:
    tables = tables_of(
        [Place(7, 0, inverted=False), Place(4, 0, inverted=False)], (Colour.RED, Colour.RED), dark_between=False
    )
    assert tables.images == bytes([4, 7])
    assert tables.counts == (1, 1)


def test_all_faults_of_the_options_are_told_at_once() -> None:
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
