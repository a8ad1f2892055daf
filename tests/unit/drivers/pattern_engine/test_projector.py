"""What every pattern engine's driver promises, above peers that speak their protocols and are as unhelpful as allowed.

What only one of them has (flash, tables, uploads) is tested beside it: `tests.unit.drivers.dlpc350`, `dlpc900`.
"""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from slrig.devices import UnprovenLight
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc350_device import WHITE
from tests.unit.drivers.pattern_engine.engine_bench import BENCHES, LEDS, START_STOP, Bench

MakesBench = Callable[..., Bench]


@pytest.fixture(params=BENCHES)
def made(request: pytest.FixtureRequest, tmp_path: Path) -> MakesBench:
    """Makes a bench of each kind; its arguments are the fake engine's."""
    return partial(BENCHES[request.param], tmp_path)


@pytest.fixture
def bench(made: MakesBench) -> Bench:
    return made()


@pytest.mark.parametrize(
    ("made", "size", "mode"),
    [
        # From the flash, triggered internally.
        ("dlpc350", Size(912, 1140), {0x1A1B: 1, 0x1A22: 3, 0x1A23: 1}),
        ("dlpc900", Size(1920, 1080), {0x1A1B: 3}),
    ],
    indirect=["made"],
)
def test_an_engine_that_shines_is_dark_once_it_is_open(bench: Bench, size: Size, mode: dict[int, int]) -> None:
    assert bench.engine.shown == [WHITE]
    projector = bench.open()
    assert bench.engine.shown[-1] is None
    assert bench.engine.commands[0] == (LEDS, b"\0"), "the first thing that it was told"
    # Neither mirrored nor inverted, and in pattern mode.
    wanted = {0x1008: 0, 0x1009: 0, 0x1A30: 0, **mode}
    assert {key: bench.engine.registers[key][0] for key in wanted} == wanted
    assert (projector.info.size, projector.info.plays, projector.info.serial) == (size, True, "1")
    projector.close()


def test_each_pattern_is_shown_as_it_is(bench: Bench) -> None:
    projector = bench.open()
    projector.load(bench.sequence)
    for index in (0, 2, 1, 0):
        before_ns = time.monotonic_ns()
        shown = projector.show(index)
        assert before_ns <= shown.t_visible_ns - shown.t_err_ns
        assert shown.t_visible_ns + shown.t_err_ns <= time.monotonic_ns()
        assert bench.shows(bench.sequence.profiles[index])
    projector.close()
    assert bench.engine.lit is None


def test_a_sequence_is_played_once_with_a_pulse_each(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(bench.sequence)
    bench.engine.shown.clear()
    projector.play(0.01, 0.03)
    assert bench.played.wait(5)
    assert not threading.Event().wait(0.1), "time for a pulse too many"
    projector.stop()
    assert len(bench.pulses) == 3
    assert [b - a > 25e6 for a, b in zip(bench.pulses, bench.pulses[1:], strict=False)] == [True, True]
    profiles = [shown for shown in bench.engine.shown if shown is not None and shown is not WHITE]
    assert [profile.tobytes() for profile in profiles] == [profile.tobytes() for profile in bench.sequence.profiles]
    assert bench.engine.lit is None
    # What was shown before is played with its own times again.
    projector.show(0)
    bench.played.clear()
    bench.pulses.clear()
    projector.play(0.01, 0.03)
    assert bench.played.wait(5)
    projector.close()


@pytest.mark.parametrize(
    ("made", "exposure_s", "period_s", "options", "rule"),
    [
        ("dlpc350", 0.01, 0.005, {}, "lengthen the period"),
        ("dlpc350", 0.01, 0.02, {"duty_limit": 0.3}, "duty_limit"),
        ("dlpc350", 150.0, 300.0, {}, "the longest is"),
        ("dlpc900", 0.01, 0.005, {}, "lengthen the period"),
        # Without dark between, TRIG_OUT_1 has no edge.
        ("dlpc900", 0.01, 0.0105, {}, "the dark after it 105 µs, the period is 10500 µs"),
        ("dlpc900", 0.01, 0.02, {"duty_limit": 0.3}, "duty_limit"),
        ("dlpc900", 17.0, 40.0, {}, "the longest is 16777215"),
    ],
    indirect=["made"],
)
def test_a_timing_against_the_rules_never_reaches_the_engine(
    bench: Bench, exposure_s: float, period_s: float, options: dict[str, object], rule: str
) -> None:
    projector = bench.open(**options)
    projector.load(bench.sequence)
    bench.commands()
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        projector.play(exposure_s, period_s)
    assert bench.commands() == []
    projector.close()


def test_calls_in_the_wrong_state_or_of_the_wrong_size_are_refused(bench: Bench) -> None:
    projector = bench.open()
    uses: tuple[Callable[[], object], ...] = (lambda: projector.show(0), lambda: projector.play(0.01, 0.02))
    for use in uses:
        with pytest.raises(DeviceStateError, match="call load first"):
            use()
    own = bench.sequence.projector
    for size in (Size(1280, 800), Size(own.width_px, own.height_px + 1)):
        with pytest.raises(UnsupportedByDeviceError, match=f"encode it for {own}"):
            projector.load(encode((White(),), size))
    projector.load(bench.sequence)
    for index in (-1, 3):
        with pytest.raises(UnsupportedByDeviceError, match="patterns 0 to 2"):
            projector.show(index)
    projector.close()
    projector.blank()
    projector.stop()
    projector.close()
    for use in (*uses, lambda: projector.load(bench.sequence)):
        with pytest.raises(DeviceStateError, match="closed"):
            use()


@pytest.mark.parametrize(
    ("option", "polarity", "sent"),
    [(True, 0, [204, 255, 255]), (False, 0, [51, 0, 0]), (True, 1, [51, 0, 0]), (False, 1, [204, 255, 255])],
)
def test_the_led_current_is_set_in_the_sense_of_the_board(
    bench: Bench, option: bool, polarity: int, sent: list[int]
) -> None:
    bench.engine.registers[0x1A05] = bytes([polarity])
    bench.open(led="red", led_current=0.2, led_current_inverted=option).close()
    assert list(bench.engine.registers[0x0B01]) == sent


@pytest.mark.parametrize(
    ("made", "options", "sent"),
    [
        ("dlpc350", {}, bytes([0, 0xBB, 0xBB])),
        ("dlpc350", {"trigger_polarity": "low"}, bytes([1, 0xBB, 0xBB])),
        ("dlpc350", {"trigger_delay_us": -20.05}, bytes([0, 0, 0])),
        ("dlpc350", {"trigger_delay_us": 2.78}, bytes([0, 0xD5, 0xD5])),
        ("dlpc900", {}, struct.pack("<Bhh", 0, 0, 0)),
        ("dlpc900", {"trigger_polarity": "low", "trigger_delay_us": 300}, struct.pack("<Bhh", 1, 300, 300)),
        ("dlpc900", {"trigger_delay_us": -20}, struct.pack("<Bhh", 0, -20, -20)),
    ],
    indirect=["made"],
)
def test_the_trigger_output_is_set(bench: Bench, options: dict[str, object], sent: bytes) -> None:
    bench.open(**options).close()
    assert bench.engine.registers[0x1A1D] == sent


@pytest.mark.parametrize(
    ("made", "command", "got", "words"),
    [
        ("dlpc350", 0x0B01, bytes(3), "asked for led current b3 b3 b3, the engine gives 00 00 00"),
        ("dlpc350", 0x1A1B, b"\0", "asked for display mode 01, the engine gives 00"),
        ("dlpc350", 0x1008, b"\1", "asked for flip long 00, the engine gives 01"),
        ("dlpc900", 0x0B01, bytes(3), "asked for led current"),
        ("dlpc900", 0x1A1B, b"\1", "asked for display mode 03, the engine gives 01"),
        ("dlpc900", 0x1008, b"\1", "asked for flip long 00, the engine gives 01"),
    ],
    indirect=["made"],
)
def test_a_setting_that_the_engine_bends_is_refused_and_it_is_dark(
    bench: Bench, command: int, got: bytes, words: str
) -> None:
    bench.engine.faults.bent = {command: got}
    with pytest.raises(UnsupportedByDeviceError, match=words):
        bench.open()
    assert bench.engine.lit is None


def test_one_way_to_go_dark_is_enough_and_the_other_is_told(bench: Bench) -> None:
    projector = bench.open()
    projector.load(bench.sequence)
    projector.show(0)
    bench.engine.faults.refused.add(START_STOP)
    with pytest.raises(DeviceError, match="refused the command 0x1a24"):
        projector.blank()
    assert bench.engine.lit is None
    projector.close()


@pytest.mark.parametrize("used", ["show", "play", "load", "blank", "show load blank"])
def test_an_unplugged_engine_is_gone_and_can_be_closed(bench: Bench, used: str) -> None:
    projector = bench.open()
    projector.load(bench.sequence)
    projector.show(0)
    bench.cable.unplug()
    uses: dict[str, Callable[[], object]] = {
        "show": lambda: projector.show(2),
        "play": lambda: projector.play(0.01, 0.02),
        "load": lambda: projector.load(bench.sequence),
        "blank": projector.blank,
    }
    for use in used.split():
        with pytest.raises(DeviceGoneError, match="is gone"):
            uses[use]()
    projector.close()
    projector.close()
    projector.blank()


# Which way the LEDs' current goes.


@pytest.mark.parametrize("inverted", [True, False])
def test_until_the_sense_of_the_current_is_known_light_is_a_twentieth(made: MakesBench, inverted: bool) -> None:
    bench = made(led_inverted=inverted)
    projector = bench.open(led_current_inverted=None, led_current=0.5)
    assert isinstance(projector, UnprovenLight)
    assert (projector.unproven, projector.info.plays) == (True, False)
    projector.load(bench.sequence)
    with pytest.raises(UnsupportedByDeviceError, match="slrig doctor finds it out"):
        projector.play(0.01, 0.02)
    most = {}
    for share in (None, 0.5, 0.4, 0.6):
        if share is not None:
            projector.try_current(share)
        bench.engine.shown.clear()
        projector.show(0)
        exposure_us, period_us, periods = bench.held_us()
        assert periods * period_us <= 2_000_000
        while not (lit := [each for each in bench.engine.shown if each is not None]):
            os.sched_yield()
        most[share] = int(lit[0].max()) / 255
        assert most[share] * exposure_us / period_us <= 0.0501
    assert (most[0.6] > most[0.4]) is not inverted
    for share in (0.39, 0.61):
        with pytest.raises(UnsupportedByDeviceError, match=r"only 0\.4 to 0\.6"):
            projector.try_current(share)
    told = projector.option_for(rises=most[0.6] > most[0.4])
    assert told == f"led_current_inverted = {str(inverted).lower()}"
    projector.close()


@pytest.mark.parametrize(("turned", "rises", "option"), [(1, True, "true"), (1, False, "false"), (0, False, "true")])
def test_the_polarity_register_turns_what_is_to_be_written(bench: Bench, turned: int, rises: bool, option: str) -> None:
    bench.engine.registers[0x1A05] = bytes([turned])
    projector = bench.open(led_current_inverted=None)
    assert projector.option_for(rises=rises) == f"led_current_inverted = {option}"
    projector.close()


def test_a_current_whose_sense_is_known_is_not_tried(bench: Bench) -> None:
    projector = bench.open()
    assert not projector.unproven
    with pytest.raises(UnsupportedByDeviceError, match="asked to try"):
        projector.try_current(0.5)
    projector.close()
