"""What the drivers of all pattern engines do alike, above peers that speak their protocols."""

from __future__ import annotations

import struct
import threading
from collections import ChainMap
from collections.abc import Callable, Mapping
from itertools import pairwise
from typing import Any

import pytest

from slrig.devices import StoredPatternProjector, UnknownPolarityProjector
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Size
from tests.contract.dlpc350_device import WHITE, Times
from tests.unit.drivers.pattern_engine.engine_bench import BENCHES, LEDS, START_STOP, Bench, Bench900, UsbBench

MakesBench = Callable[..., Bench]
USB = pytest.mark.parametrize("made", ["dlpc350", "dlpc900"], indirect=True)


@pytest.fixture(params=BENCHES)
def made(request: pytest.FixtureRequest) -> MakesBench:
    """Makes a bench of each kind; its arguments are the fake engine's."""
    return BENCHES[request.param]


@pytest.fixture
def bench(made: MakesBench) -> Bench:
    return made()


@pytest.fixture
def usb_bench(made: MakesBench) -> UsbBench:
    bench = made()
    assert isinstance(bench, UsbBench)
    return bench


@pytest.mark.parametrize(
    ("made", "size", "registers", "dark_s"),
    [
        # Patterns from the flash that wait for no trigger.
        ("dlpc347x", Size(1280, 720), {0x05: 4, 0x90: 0, 0x50: 0}, 202e-6),
        # From the flash, triggered internally; neither mirrored nor inverted.
        ("dlpc350", Size(912, 1140), {0x1A1B: 1, 0x1A22: 3, 0x1A23: 1, 0x1008: 0, 0x1009: 0, 0x1A30: 0}, 0.0),
        # It is sent its pictures, and needs some dark for an edge of its trigger.
        ("dlpc900", Size(1920, 1080), {0x1A1B: 3, 0x1008: 0, 0x1009: 0, 0x1A30: 0}, 105e-6),
    ],
    indirect=["made"],
)
def test_an_engine_that_shines_is_dark_once_it_is_open(
    made: MakesBench, size: Size, registers: dict[int, int], dark_s: float
) -> None:
    bench = made(flashed=None) if size == Size(1280, 720) else made()
    assert bench.engine.shown == [WHITE]
    begun_ns = bench.clock.now_ns()
    projector = bench.open()
    assert bench.clock.now_ns() == begun_ns, "an engine that answers at once is not waited for"
    assert bench.engine.shown[-1] is None
    assert bench.engine.commands[0] == bench.leds[:2], "the first thing that it was told"
    assert {key: bench.engine.registers[key][0] for key in registers} == registers
    info, options = projector.info, projector._light
    assert (info.size, info.plays, info.lights) == (size, True, options.led == "white")
    assert info.gap_s == pytest.approx(options.light_margin_s + dark_s)
    assert info.duty == options.duty_limit
    assert isinstance(projector, StoredPatternProjector) is not isinstance(bench, Bench900)


def test_each_pattern_is_shown_as_it_is(bench: Bench) -> None:
    projector = bench.loaded()
    for index in (0, 2, 1, 0):
        before_ns = bench.clock.now_ns()
        shown = projector.show(index)
        assert before_ns <= shown.t_visible_ns - shown.t_err_ns
        assert shown.t_visible_ns + shown.t_err_ns <= bench.clock.now_ns()
        assert bench.shows(bench.sequence.profiles[index])
    projector.close()
    assert bench.engine.lit is None


def test_a_sequence_is_played_once_with_a_pulse_each(bench: Bench) -> None:
    projector = bench.loaded(light_margin_s=0.002)
    projector.play(0.003, 0.01)
    bench.clock.advance(5)
    assert bench.engine.lit is None
    assert [late - early for early, late in pairwise(bench.pulses)] == [10_000_000] * 2
    shown = [shown.tobytes() for shown in bench.engine.shown if shown is not None and shown is not WHITE]
    assert shown == [profile.tobytes() for profile in bench.sequence.profiles]
    projector.stop()
    # What was shown before is played with its own times again.
    projector.show(0)
    bench.pulses.clear()
    projector.play(0.003, 0.01)
    bench.clock.advance(5)
    assert [late - early for early, late in pairwise(bench.pulses)] == [10_000_000] * 2


@pytest.mark.parametrize(
    ("made", "exposure_s", "period_s", "options", "rule"),
    [
        ("dlpc347x", 0.01, 0.02, {}, "requested 11000 µs of blue light, .* cameras by software"),
        ("dlpc347x", 0.005, 0.006, {}, "the dark after it 202 µs, the period is 6000 µs; lengthen the period"),
        ("dlpc347x", 0.005, 0.01, {"duty_limit": 0.5}, "duty_limit of the rig file allows 50%"),
        ("dlpc350", 0.01, 0.02, {"duty_limit": 0.3}, r"light is on for 5[0-9]% of the time, duty_limit .* 30%"),
        ("dlpc350", 0.01, 0.0104, {}, "light takes 10500 µs, the period is 10400 µs; lengthen the period"),
        ("dlpc350", 0.0, 0.02, {}, "requested 0.000000 s of light"),
        ("dlpc350", 150.0, 300.0, {}, "the longest is"),
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
    projector = bench.loaded(**options)
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        projector.play(exposure_s, period_s)
    assert bench.commands() == []


def test_an_unplugged_engine_is_gone_and_can_be_closed(bench: Bench) -> None:
    projector = bench.loaded()
    projector.show(0)
    bench.unplug()
    uses: tuple[Callable[[], object], ...] = (
        lambda: projector.show(2),
        lambda: projector.play(0.003, 0.01),
        lambda: projector.load(bench.sequence),
        projector.blank,
    )
    for use in uses:
        with pytest.raises(DeviceGoneError):
            use()
    projector.close()
    projector.close()
    projector.blank()
    for use in uses[:3]:
        with pytest.raises(DeviceStateError, match="closed"):
            use()


# How long a pattern is held.


def test_a_pattern_is_held_for_as_long_as_set_and_goes_dark_by_itself(bench: Bench) -> None:
    projector = bench.loaded(hold_s=3.0)
    shown = projector.show(0)
    bench.clock.advance(2.9)
    assert bench.shows(bench.sequence.profiles[0])
    bench.clock.advance(2.1)
    assert bench.engine.lit is None
    assert bench.clock.now_ns() - shown.t_visible_ns < 5.1e9


def test_two_seconds_after_its_host_has_died_it_is_dark(bench: Bench) -> None:
    projector = bench.loaded(hold_s=60.0)
    projector.show(0)
    bench.clock.advance(10)
    assert bench.shows(bench.sequence.profiles[0]), "held by its host"
    bench.died(projector)
    bench.clock.advance(2)
    assert bench.engine.lit is None
    leds, _, by_sequence = bench.leds
    assert bench.engine.registers[leds] == by_sequence, "it went dark by itself"


@pytest.mark.parametrize("call", ["blank", "stop", "load", "close"])
def test_what_is_dark_is_not_started_again(bench: Bench, call: str) -> None:
    projector = bench.loaded()
    projector.show(0)
    calls: dict[str, Callable[[], object]] = {
        "blank": projector.blank,
        "stop": projector.stop,
        "load": lambda: projector.load(bench.sequence),
        "close": projector.close,
    }
    calls[call]()
    bench.commands()
    bench.clock.advance(10)
    assert bench.commands() == []
    assert bench.engine.lit is None


def test_closing_from_another_thread_ends_a_wait_for_light(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    projector = bench.loaded()
    wait_until, owner = bench.clock.wait_until, threading.current_thread()

    def closed_meanwhile(t_ns: int, stop: threading.Event) -> None:
        if threading.current_thread() is owner:
            projector.close()
        wait_until(t_ns, stop)

    monkeypatch.setattr(bench.clock, "wait_until", closed_meanwhile)
    with pytest.raises(DeviceStateError):
        projector.show(2)
    assert bench.engine.lit is None


# Engines that take their time.


@pytest.mark.parametrize(
    ("made", "command", "before"),
    [
        ("dlpc347x", 0x06, b"\0"),
        ("dlpc347x", 0x55, bytes(6)),
        ("dlpc347x", 0x99, bytes(24)),
        ("dlpc350", 0x1A1B, b"\0"),
        ("dlpc350", 0x0B01, bytes(3)),
        ("dlpc350", 0x1A29, bytes(8)),
        ("dlpc900", 0x1A1B, b"\1"),
        ("dlpc900", 0x1A1D, b"\1" * 5),
    ],
    indirect=["made"],
)
def test_what_reads_as_before_for_a_while_is_asked_again(bench: Bench, command: int, before: bytes) -> None:
    bench.engine.bent = bent = {command: before}
    bench.clock.call_at(bench.clock.now_ns() + 900_000_000, bent.clear)
    bench.loaded().show(0)
    assert bench.shows(bench.sequence.profiles[0])


LATE: tuple[dict[str, float], ...] = ({"mode": 0.15}, {"stop": 0.1}, {"start": 0.2})
CHECK = {"check_begins": 0.009, "check": 0.3}


@pytest.mark.parametrize(
    ("made", "late"),
    [
        ("dlpc350", ChainMap(CHECK, *LATE)),
        ("dlpc900", ChainMap(*LATE)),
        *(pytest.param("dlpc350", late, marks=pytest.mark.slow) for late in (*LATE, CHECK)),
        *(pytest.param("dlpc900", late, marks=pytest.mark.slow) for late in LATE),
    ],
    indirect=["made"],
)
def test_an_engine_that_takes_its_time_opens_shows_and_plays(made: MakesBench, late: Mapping[str, float]) -> None:
    bench = made(times=Times(**late))
    for _ in range(2):
        projector = bench.loaded()
        for index in (0, 2, 1, 0):
            projector.show(index)
            assert bench.shows(bench.sequence.profiles[index])
        bench.clock.advance(10)
        assert bench.shows(bench.sequence.profiles[0]), "it is started again while it is held"
        bench.pulses.clear()
        projector.play(0.003, 0.01)
        bench.clock.advance(1)
        assert len(bench.pulses) == 3
        # The next host finds it as this one left it: in its mode, and showing.
        projector.show(2)
        bench.died(projector)
    assert bench.clock.now_ns() < 40e9


@USB
def test_it_is_dark_from_a_stop_until_the_start(made: MakesBench) -> None:
    bench = made(times=Times(stop=0.5))
    projector = bench.loaded()
    projector.show(0)
    bench.clock.advance(1.3)
    assert bench.engine.running
    assert bench.engine.lit is None, "its host may die now"
    bench.clock.advance(0.4)
    assert bench.shows(bench.sequence.profiles[0])


@pytest.mark.parametrize(
    ("made", "told"),
    [("dlpc350", "did not stop the sequence in time"), ("dlpc900", "did not take definition .* not in this mode")],
    indirect=["made"],
)
def test_a_sequence_that_never_ends_is_an_error_and_dark(usb_bench: UsbBench, told: str) -> None:
    projector = usb_bench.loaded()
    projector.show(0)
    usb_bench.engine.times.stop = 1e6
    with pytest.raises(DeviceError, match=told):
        projector.show(2)
    assert usb_bench.engine.lit is None


# Engines with a USB port.


@USB
def test_one_way_to_go_dark_is_enough_and_the_other_is_reported(usb_bench: UsbBench) -> None:
    projector = usb_bench.loaded()
    projector.show(0)
    usb_bench.engine.faults.refused.add(START_STOP)
    with pytest.raises(DeviceError, match="refused the command 0x1a24"):
        projector.blank()
    assert usb_bench.engine.lit is None


@USB
@pytest.mark.parametrize(
    ("inverted", "polarity", "sent"),
    [(True, 0, [204, 255, 255]), (False, 0, [51, 0, 0]), (True, 1, [51, 0, 0]), (False, 1, [204, 255, 255])],
)
def test_the_led_current_is_set_in_the_sense_of_the_board(
    usb_bench: UsbBench, inverted: bool, polarity: int, sent: list[int]
) -> None:
    usb_bench.engine.registers[0x1A05] = bytes([polarity])
    usb_bench.open(led="red", led_current=0.2, led_current_inverted=inverted).close()
    assert list(usb_bench.engine.registers[0x0B01]) == sent
    # What it says to write into the rig file, once the doctor knows which way light goes.
    projector = usb_bench.open(led_current_inverted=None)
    assert (
        projector.polarity_option(rises=inverted is bool(polarity)) == f"led_current_inverted = {str(inverted).lower()}"
    )


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
def test_the_trigger_output_is_set(usb_bench: UsbBench, options: dict[str, Any], sent: bytes) -> None:
    usb_bench.open(**options).close()
    assert usb_bench.engine.registers[0x1A1D] == sent


@USB
@pytest.mark.parametrize(
    ("command", "got", "words"),
    [
        (0x0B01, bytes(3), r"requested led current .. .. .., the engine gives 00 00 00"),
        (
            0x1A1B,
            b"\0",
            r"display mode 0., the engine gives 00 after 1 s; switch it off and on, and update its firmware",
        ),
        (0x1008, b"\1", "requested flip long 00, the engine gives 01"),
    ],
)
def test_a_setting_that_the_engine_bends_is_refused_and_it_is_dark(
    usb_bench: UsbBench, command: int, got: bytes, words: str
) -> None:
    usb_bench.engine.registers[0x0B01] = b"\1\1\1"
    usb_bench.engine.bent = {command: got}
    with pytest.raises(UnsupportedByDeviceError, match=words):
        usb_bench.open()
    assert usb_bench.engine.lit is None


@pytest.mark.parametrize(
    ("made", "standby"), [("dlpc350", True), ("dlpc350", False), ("dlpc900", False)], indirect=["made"]
)
def test_an_engine_in_standby_is_woken_and_may_be_sent_back(made: MakesBench, standby: bool) -> None:
    bench = made(standby=True)
    options = {"standby": True} if standby else {}
    projector = bench.loaded(**options)
    assert bench.engine.registers[0x0200] == b"\0"
    projector.show(0)
    projector.close()
    assert bench.engine.registers[0x0200] == bytes([standby])
    assert bench.engine.lit is None
    assert LEDS in bench.commands()


# Which way the LEDs' current goes.


@USB
@pytest.mark.parametrize("inverted", [True, False])
def test_until_the_sense_of_the_current_is_known_light_is_a_twentieth(made: MakesBench, inverted: bool) -> None:
    bench = made(led_inverted=inverted)
    assert isinstance(bench, UsbBench)
    projector = bench.open(led_current_inverted=None, led_current=0.5)
    assert isinstance(projector, UnknownPolarityProjector)
    assert (projector.is_polarity_unknown, projector.info.plays) == (True, False)
    projector.load(bench.sequence)
    with pytest.raises(UnsupportedByDeviceError, match="run slrig doctor"):
        projector.play(0.01, 0.02)
    most = {}
    for share in (None, 0.5, 0.4, 0.6):
        if share is not None:
            projector.set_trial_current(share)
        bench.engine.shown.clear()
        projector.show(0)
        exposure_us, period_us, periods = bench.held_us()
        assert periods * period_us <= 2_000_000
        bench.clock.advance(0.1)
        lit = next(each for each in bench.engine.shown if each is not None)
        most[share] = int(lit[0].max()) / 255
        assert most[share] * exposure_us / period_us <= 0.0501
    assert (most[0.6] > most[0.4]) is not inverted
    for share in (0.39, 0.61):
        with pytest.raises(UnsupportedByDeviceError, match=r"only 0\.4 to 0\.6"):
            projector.set_trial_current(share)
    told = projector.polarity_option(rises=most[0.6] > most[0.4])
    assert told == f"led_current_inverted = {str(inverted).lower()}"


@USB
def test_a_current_whose_sense_is_known_is_not_tried(usb_bench: UsbBench) -> None:
    projector = usb_bench.open()
    assert not projector.is_polarity_unknown
    with pytest.raises(UnsupportedByDeviceError, match="cannot try"):
        projector.set_trial_current(0.5)
