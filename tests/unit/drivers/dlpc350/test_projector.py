"""The light engine's driver above a peer that speaks its protocol, and is as unhelpful as its documents allow."""

from __future__ import annotations

import os
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from drivers.dlpc350.flash import Flash, write_pictures
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.planes import MIRRORS
from drivers.dlpc350.projector import DLPC350, LightEngine
from drivers.pattern_engine.link import Link
from slrig.devices import FlashedProjector, UnprovenLight
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, PatternSequence, Pixels, Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc350_device import WHITE, Cable, FakeEngine

LINES = LineShift(Axis.COLUMN, 1, 8)
SEQUENCE = encode((White(), Black(), LINES), MIRRORS)
START, STOP, LEDS, VALIDATE = 0x1A24, 0x1A24, 0x1A07, 0x1A1A


@pytest.fixture(scope="session")
def flash(tmp_path_factory: pytest.TempPathFactory) -> Flash:
    return write_pictures(tmp_path_factory.mktemp("pictures"), SEQUENCE)


class Bench:
    """An engine with the flash's pictures, and what opens it."""

    def __init__(self, flash: Flash, **engine: Any) -> None:
        self.flash = flash
        pictures = {picture.flash_index: picture.content for picture in flash.pictures}
        self.pulses: list[int] = []
        self.played = threading.Event()
        self.engine = FakeEngine(pictures, **{"tag": flash.tag, "pulse": self._pulse, **engine})

    def open(self, **options: object) -> LightEngine:
        self.cable = Cable(self.engine)
        usual = {"patterns": "p", "image_load_s": 0.0, "led_current_inverted": True}
        table = EngineOptions.model_validate({**usual, **options})
        return LightEngine(Link(self.cable.host, "light engine", DLPC350, answer_s=2.0), table, self.flash, serial="1")

    def _pulse(self, t_ns: int) -> None:
        self.pulses.append(t_ns)
        if len(self.pulses) == len(SEQUENCE):
            self.played.set()

    def commands(self) -> list[int]:
        """The numbers of the commands since they were last asked for."""
        found = [command for command, _ in self.engine.commands]
        self.engine.commands.clear()
        return found


@pytest.fixture
def bench(flash: Flash) -> Bench:
    return Bench(flash)


def test_an_engine_that_shines_is_dark_once_it_is_open(bench: Bench) -> None:
    assert bench.engine.shown == [WHITE]
    projector = bench.open()
    assert bench.engine.shown[-1] is None
    # The first thing that it was told.
    assert bench.engine.commands[0] == (LEDS, b"\0")
    # Not mirrored, in pattern mode, from the flash, triggered internally.
    registers = {key: bench.engine.registers[key][0] for key in (0x1008, 0x1009, 0x1A30, 0x1A1B, 0x1A22, 0x1A23)}
    assert registers == {0x1008: 0, 0x1009: 0, 0x1A30: 0, 0x1A1B: 1, 0x1A22: 3, 0x1A23: 1}
    assert (projector.info.size, projector.info.plays, projector.info.serial) == (Size(912, 1140), True, "1")
    projector.close()


def test_the_order_is_stop_set_validate_start(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    bench.commands()
    projector.show(2)
    assert bench.engine.commands[-1] == (START, b"\2")
    assert bench.commands() == [
        *(LEDS, STOP),
        0x1A29,
        *(0x1A33, 0x1A32, 0x1A34, 0x1A33),
        *(0x1A33, 0x1A32, 0x1A34, 0x1A33),
        0x1A31,
        *(VALIDATE, LEDS, START),
    ]
    # The next one has the same timing, and another pattern of the same picture.
    projector.show(0)
    assert bench.commands() == [LEDS, STOP, 0x1A33, 0x1A32, 0x1A34, 0x1A33, VALIDATE, LEDS, START]
    projector.close()


def test_each_pattern_is_shown_as_it_is(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    for index in (0, 2, 1, 0):
        before_ns = time.monotonic_ns()
        shown = projector.show(index)
        assert before_ns <= shown.t_visible_ns - shown.t_err_ns
        assert shown.t_visible_ns + shown.t_err_ns <= time.monotonic_ns()
        # The fake's mirrors turn on a thread of their own, which a loaded machine may hold up.
        wanted, until_s = SEQUENCE.profiles[index], time.monotonic() + 2.0
        while not _shows(bench, wanted) and time.monotonic() < until_s:
            os.sched_yield()
        assert _shows(bench, wanted)
    projector.close()
    assert bench.engine.lit is None


def _shows(bench: Bench, profile: Pixels) -> bool:
    lit = bench.engine.lit
    return lit is not None and bool((lit == profile).all())


def test_light_is_waited_for_as_long_as_a_picture_takes(flash: Flash) -> None:
    bench = Bench(flash, load_s=0.1)
    projector = bench.open(image_load_s=0.15)
    projector.load(SEQUENCE)
    shown = projector.show(2)
    assert bench.engine.lit is not None
    assert (bench.engine.lit == SEQUENCE.profiles[2]).all()
    assert shown.t_err_ns >= 0.075e9
    projector.close()


def test_a_sequence_is_played_once_with_a_pulse_each(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(SEQUENCE)
    bench.engine.shown.clear()
    projector.play(0.01, 0.03)
    assert bench.played.wait(5)
    assert bench.engine.registers[0x1A29] == (12_000).to_bytes(4, "little") + (30_000).to_bytes(4, "little")
    assert bench.engine.registers[0x1A31] == bytes([2, 0, 2, 0])
    projector.stop()
    assert len(bench.pulses) == 3
    assert [b - a > 25e6 for a, b in zip(bench.pulses, bench.pulses[1:], strict=False)] == [True, True]
    profiles = [shown for shown in bench.engine.shown if shown is not None and shown is not WHITE]
    assert [profile.tobytes() for profile in profiles] == [profile.tobytes() for profile in SEQUENCE.profiles]
    assert bench.engine.lit is None
    projector.close()


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "options", "rule"),
    [
        (0.01, 0.005, {}, "lengthen the period"),
        (0.01, 0.02, {"duty_limit": 0.3}, "duty_limit"),
        (150.0, 300.0, {}, "the longest is"),
    ],
)
def test_a_timing_against_the_rules_never_reaches_the_engine(
    bench: Bench, exposure_s: float, period_s: float, options: dict[str, object], rule: str
) -> None:
    projector = bench.open(**options)
    projector.load(SEQUENCE)
    bench.commands()
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        projector.play(exposure_s, period_s)
    assert bench.commands() == []
    projector.close()


def test_calls_in_the_wrong_state_or_of_the_wrong_size_are_refused(bench: Bench) -> None:
    projector = bench.open()
    for call in (lambda: projector.show(0), lambda: projector.play(0.01, 0.02)):
        with pytest.raises(DeviceStateError, match="call load first"):
            call()
    for size in (Size(1280, 800), Size(912, 1141)):
        with pytest.raises(UnsupportedByDeviceError, match="encode it for 912 x 1140"):
            projector.load(encode((White(),), size))
    long = PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 129, SEQUENCE.profiles[:1] * 129)
    with pytest.raises(UnsupportedByDeviceError, match="129 patterns, the engine's table takes 128"):
        projector.load(long)
    projector.load(SEQUENCE)
    for index in (-1, 3):
        with pytest.raises(UnsupportedByDeviceError, match="patterns 0 to 2"):
            projector.show(index)
    projector.close()
    projector.blank()
    projector.stop()
    projector.close()
    for call in (lambda: projector.show(0), lambda: projector.play(0.01, 0.02), lambda: projector.load(SEQUENCE)):
        with pytest.raises(DeviceStateError, match="closed"):
            call()


def test_the_longest_table_takes_several_reports(bench: Bench) -> None:
    projector = bench.open()
    projector.load(PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 128, SEQUENCE.profiles[:1] * 128))
    projector.play(0.001, 0.002)
    assert bench.played.wait(5)
    (data,) = (data for command, data in bench.engine.commands if command == 0x1A34 and len(data) > 64)
    assert len(data) == 384
    projector.close()


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
    ("options", "sent"),
    [
        ({}, [0, 0xBB, 0xBB]),
        ({"trigger_polarity": "low"}, [1, 0xBB, 0xBB]),
        ({"trigger_delay_us": -20.05}, [0, 0, 0]),
        ({"trigger_delay_us": 2.78}, [0, 0xD5, 0xD5]),
    ],
)
def test_the_trigger_output_is_set(bench: Bench, options: dict[str, object], sent: list[int]) -> None:
    bench.open(**options).close()
    assert list(bench.engine.registers[0x1A1D]) == sent


@pytest.mark.parametrize(
    ("command", "got", "words"),
    [
        (0x0B01, b"\0\0\0", "asked for led current b3 b3 b3, the engine gives 00 00 00"),
        (0x1A1B, b"\0", "asked for display mode 01, the engine gives 00"),
        (0x1008, b"\1", "asked for flip long 00, the engine gives 01"),
    ],
)
def test_a_setting_that_the_engine_bends_is_refused_and_it_is_dark(
    bench: Bench, command: int, got: bytes, words: str
) -> None:
    bench.engine.faults.bent = {command: got}
    with pytest.raises(UnsupportedByDeviceError, match=words):
        bench.open()
    assert bench.engine.lit is None


def test_a_timing_that_the_engine_bends_is_refused_and_it_is_dark(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    bench.engine.faults.bent = {0x1A29: bytes(8)}
    with pytest.raises(UnsupportedByDeviceError, match="asked for exposure period"):
        projector.show(0)
    assert bench.engine.lit is None
    projector.close()


def test_a_flash_of_another_name_is_refused(flash: Flash) -> None:
    bench = Bench(flash, tag="factory")
    with pytest.raises(UnsupportedByDeviceError, match=f'tagged "{flash.tag}", the engine says "factory"'):
        bench.open()
    assert bench.engine.lit is None
    bench.flash = Flash(flash.folder, None, flash.pictures)
    bench.open().close()


def test_a_flash_with_too_few_pictures_is_refused(flash: Flash) -> None:
    bench = Bench(flash)
    bench.flash = write_pictures(flash.folder.parent / "more", SEQUENCE, flash.pictures)
    bench.engine.tag = bench.flash.tag or ""
    with pytest.raises(UnsupportedByDeviceError, match="names picture 1 of its flash, it holds 1"):
        bench.open()


def test_tables_that_the_engine_refuses_are_told_in_words_and_it_is_dark(flash: Flash) -> None:
    bench = Bench(flash)
    bench.engine._planes[7] = bench.engine._planes.pop(0)
    projector = bench.open()
    projector.load(SEQUENCE)
    with pytest.raises(UnsupportedByDeviceError, match="a pattern number in the table is not one that it has"):
        projector.show(0)
    assert bench.engine.lit is None
    projector.close()


def test_a_flash_without_a_list_asks_for_pictures(bench: Bench, tmp_path: Path) -> None:
    bench.flash = Flash(tmp_path)
    projector = bench.open()
    with pytest.raises(UnsupportedByDeviceError, match=r"lacks 3 of 3 patterns.*slrig patterns"):
        projector.load(SEQUENCE)
    assert list(tmp_path.iterdir()) == [], "what is only tried is not written"
    assert isinstance(projector, FlashedProjector)
    assert str(tmp_path / "to_flash") in projector.write_patterns(SEQUENCE)
    assert (tmp_path / "to_flash" / "images.json").is_file()
    with pytest.raises(DeviceStateError):
        projector.show(0)
    projector.close()


def test_an_engine_in_standby_is_woken_and_may_be_sent_back(flash: Flash) -> None:
    bench = Bench(flash, standby=True)
    projector = bench.open(standby=True)
    assert bench.engine.registers[0x0200] == b"\0"
    projector.load(SEQUENCE)
    projector.show(0)
    projector.close()
    assert bench.engine.registers[0x0200] == b"\1"
    assert bench.engine.lit is None


@pytest.mark.parametrize("command", [0x1A29, 0x1A34, 0x1A31, VALIDATE])
def test_whatever_is_refused_on_the_way_to_light_leaves_it_dark(bench: Bench, command: int) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    bench.engine.faults.refused.add(command)
    with pytest.raises(DeviceError, match=f"refused the command {command:#06x}"):
        projector.play(0.01, 0.03)
    assert bench.engine.lit is None
    assert not bench.engine.running
    bench.engine.faults.refused.clear()
    projector.show(2)
    projector.close()


def test_a_sequence_that_does_not_start_is_an_error_and_dark(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.dlpc350.projector.RUNNING_S", 0.05)
    projector = bench.open()
    projector.load(SEQUENCE)
    bench.engine.faults.never_runs = True
    bench.engine._hardware |= 8
    with pytest.raises(DeviceError, match="did not start the sequence in time, and says: a picture was taken before"):
        projector.show(0)
    assert bench.engine.lit is None
    projector.close()


def test_one_way_to_go_dark_is_enough_and_the_other_is_told(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    bench.engine.faults.refused.add(STOP)
    with pytest.raises(DeviceError, match="refused the command 0x1a24"):
        projector.blank()
    assert bench.engine.lit is None
    projector.close()


class Darkness:
    """Notes when the engine went dark, and waits for it."""

    def __init__(self, bench: Bench) -> None:
        self._changed = threading.Condition()
        self._since_s: float | None = None
        bench.engine._light = self._told

    def wait(self, timeout_s: float) -> float | None:
        """CLOCK_MONOTONIC, since when it is dark; None if it is not."""
        with self._changed:
            self._changed.wait_for(lambda: self._since_s is not None, timeout_s)
            return self._since_s

    def _told(self, profile: Pixels | None) -> None:
        with self._changed:
            self._since_s = time.monotonic() if profile is None else None
            self._changed.notify_all()


@pytest.mark.slow
def test_a_held_pattern_stays_for_as_long_as_asked_and_goes_dark_by_itself(bench: Bench) -> None:
    dark = Darkness(bench)
    projector = bench.open(hold_s=3.0, image_load_s=0.1)
    projector.load(SEQUENCE)
    shown_s = time.monotonic()
    projector.show(0)
    since_s = dark.wait(7)
    assert since_s is not None
    # The engine ends what was begun before hold_s was over: that is 1.9 s of light at the most.
    assert 3.0 <= since_s - shown_s <= 3.0 + 1.9 + 0.3
    # Nobody switched the LEDs off.
    assert bench.engine.registers[LEDS] == b"\x08"
    projector.close()


@pytest.mark.slow
def test_two_seconds_after_its_host_has_died_it_is_dark(flash: Flash) -> None:
    bench = Bench(flash, load_s=0.2)
    dark = Darkness(bench)
    projector = bench.open(image_load_s=0.2, hold_s=60.0)
    projector.load(SEQUENCE)
    projector.show(0)
    # As if the process were killed: nothing goes over the cable any more, and it is not pulled out.
    with projector._lock:
        died_s = time.monotonic()
        since_s = dark.wait(5)
    assert since_s is not None
    assert since_s - died_s <= 2.0
    projector.close()


@pytest.mark.parametrize("gone", ["blank", "stop", "load"])
def test_what_is_dark_is_not_started_again(bench: Bench, gone: str) -> None:
    projector = bench.open(image_load_s=1.0, image_kept_s=0.0)
    projector.load(SEQUENCE)
    projector._picture = 0
    projector.show(0)
    calls: dict[str, Callable[[], object]] = {
        "blank": projector.blank,
        "stop": projector.stop,
        "load": lambda: projector.load(SEQUENCE),
    }
    calls[gone]()
    bench.commands()
    assert not projector._state.closed.wait(0.7), "longer than half of what was begun"
    assert bench.commands() == []
    projector.close()


def test_a_pattern_of_the_same_picture_is_not_waited_for(flash: Flash) -> None:
    bench = Bench(flash, load_s=0.2, keeps=True, command_s=0.003)
    projector = bench.open(image_load_s=0.2, image_kept_s=0.01)
    projector.load(SEQUENCE)
    first = projector.show(0)
    assert first.t_err_ns >= 0.1e9
    took_s = []
    for index in (2, 0, 2, 1, 0):
        begun_s = time.monotonic()
        shown = projector.show(index)
        took_s.append(time.monotonic() - begun_s)
        assert shown.t_err_ns <= 0.05e9
        assert _shows(bench, SEQUENCE.profiles[index])
    print(f"\n{min(took_s) * 1e3:.0f} ms a pattern, commands of 3 ms")  # noqa: T201 - the figure of the test
    assert min(took_s) <= 0.1
    projector.blank()
    projector.play(0.01, 0.02)
    projector.close()


# Which way the LEDs' current goes.


@pytest.mark.parametrize("inverted", [True, False])
def test_until_the_sense_of_the_current_is_known_light_is_a_twentieth(flash: Flash, inverted: bool) -> None:
    bench = Bench(flash, led_inverted=inverted)
    projector = bench.open(led_current_inverted=None, led_current=0.5)
    assert isinstance(projector, UnprovenLight)
    assert (projector.unproven, projector.info.plays) == (True, False)
    projector.load(SEQUENCE)
    with pytest.raises(UnsupportedByDeviceError, match="slrig doctor finds it out"):
        projector.play(0.01, 0.02)
    most = {}
    for share in (None, 0.4, 0.6):
        if share is not None:
            projector.try_current(share)
        bench.engine.shown.clear()
        projector.show(0)
        exposure_us, period_us = struct.unpack("<II", bench.engine.registers[0x1A29])
        assert len(bench.engine._entries()) * period_us <= 2_000_000
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


@pytest.mark.parametrize("use", ["show", "play", "load", "blank"])
def test_an_unplugged_engine_is_gone_and_can_be_closed(bench: Bench, use: str) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    bench.cable.unplug()
    uses: dict[str, Callable[[], object]] = {
        "show": lambda: projector.show(2),
        "play": lambda: projector.play(0.01, 0.02),
        "load": lambda: projector.load(SEQUENCE),
        "blank": projector.blank,
    }
    with pytest.raises(DeviceGoneError, match="is gone"):
        uses[use]()
    projector.close()
    projector.close()
    projector.blank()


def test_an_engine_that_is_gone_while_it_is_opened_is_gone(bench: Bench) -> None:
    bench.cable = Cable(bench.engine)
    bench.cable.unplug()
    with pytest.raises(DeviceGoneError):
        LightEngine(Link(bench.cable.host, "light engine", DLPC350), EngineOptions(patterns="p"), bench.flash)


def test_closing_from_another_thread_ends_a_wait_for_light(bench: Bench) -> None:
    projector = bench.open(image_load_s=1.0)
    projector.load(SEQUENCE)
    errors: list[Exception] = []
    lit = threading.Event()
    bench.engine._light = lambda profile: lit.set() if profile is not None else None

    def show() -> None:
        try:
            projector.show(2)
        except DeviceStateError as error:
            errors.append(error)

    showing = threading.Thread(target=show)
    showing.start()
    assert lit.wait(5)
    projector.close()
    showing.join(3)
    assert not showing.is_alive()
    assert len(errors) == 1
    assert bench.engine.lit is None
