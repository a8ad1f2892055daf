"""The DLPC900's driver above a peer that speaks its protocol, and is as unhelpful as its guide allows."""

from __future__ import annotations

import os
import struct
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.dlpc900 import find_devices, open_projector
from drivers.dlpc900.options import EngineOptions
from drivers.dlpc900.projector import DLPC900, LightEngine
from drivers.pattern_engine.finding import engines
from drivers.pattern_engine.link import Link
from slrig.devices import FlashedProjector, UnprovenLight
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, Pixels, Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc350_device import WHITE, Cable
from tests.contract.dlpc900_bench import MIRRORS
from tests.contract.dlpc900_device import Fake900

LINES = LineShift(Axis.COLUMN, 1, 8)
SEQUENCE = encode((White(), Black(), LINES), MIRRORS)
LEDS, STOP, START = 0x1A07, 0x1A24, 0x1A24


class Bench:
    """An engine, and what opens it."""

    def __init__(self, **engine: Any) -> None:
        self.pulses: list[int] = []
        self.played = threading.Event()
        self.engine = Fake900(**{"pulse": self._pulse, **engine})

    def open(self, **options: object) -> LightEngine:
        self.cable = Cable(self.engine)
        table = EngineOptions.model_validate({"start_s": 0.02, "led_current_inverted": False, **options})
        return LightEngine(Link(self.cable.host, "light engine", DLPC900, answer_s=5.0), table, serial="1")

    def _pulse(self, t_ns: int) -> None:
        self.pulses.append(t_ns)
        if len(self.pulses) == len(SEQUENCE):
            self.played.set()

    def commands(self) -> list[int]:
        """The numbers of the commands since they were last asked for."""
        found = [command for command, _ in self.engine.commands]
        self.engine.commands.clear()
        return found

    def shows(self, profile: Pixels) -> bool:
        """Whether a pattern is lit, after a while: the fake's mirrors turn on a thread of their own."""
        until_s = time.monotonic() + 2.0
        while not self._lit_as(profile) and time.monotonic() < until_s:
            os.sched_yield()
        return self._lit_as(profile)

    def _lit_as(self, profile: Pixels) -> bool:
        lit = self.engine.lit
        return lit is not None and np.array_equal(lit, profile)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_an_engine_that_shines_is_dark_once_it_is_open(bench: Bench) -> None:
    assert bench.engine.shown == [WHITE]
    projector = bench.open()
    assert bench.engine.shown[-1] is None
    assert bench.engine.commands[0] == (LEDS, b"\0"), "the first thing that it was told"
    registers = {key: bench.engine.registers[key][0] for key in (0x1008, 0x1009, 0x1A30, 0x1A1B)}
    assert registers == {0x1008: 0, 0x1009: 0, 0x1A30: 0, 0x1A1B: 3}
    assert (projector.info.size, projector.info.plays, projector.info.serial) == (MIRRORS, True, "1")
    assert projector.info.gap_s == pytest.approx(0.0005 + 105e-6)
    assert not isinstance(projector, FlashedProjector)
    projector.close()


def test_the_table_comes_before_the_pictures_and_these_last_one_first(bench: Bench) -> None:
    projector = bench.open()
    bench.commands()
    projector.load(encode((White(), LINES, LineShift(Axis.ROW, 1, 8)), MIRRORS))
    sent = list(bench.engine.commands)
    first = [index for index, (command, _) in enumerate(sent) if command == 0x1A2A]
    assert [command for command, _ in sent[: first[0]]] == [LEDS, STOP, *[0x1A34] * 4, 0x1A31]
    assert [struct.unpack("<HI", data)[0] for command, data in sent if command == 0x1A2A] == [1, 0]
    assert bench.engine.lit is None
    bench.commands()
    projector.show(2)
    # The pattern, one without LEDs, the table, their order: nothing is sent again that the engine has.
    assert bench.commands() == [LEDS, STOP, 0x1A34, 0x1A34, 0x1A31, 0x1A32, LEDS, START]
    projector.show(2)
    assert bench.commands() == [LEDS, STOP, 0x1A31, 0x1A32, LEDS, START]
    projector.close()


def test_each_pattern_is_shown_as_it_is(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    for index in (0, 2, 1, 0):
        before_ns = time.monotonic_ns()
        shown = projector.show(index)
        assert before_ns <= shown.t_visible_ns - shown.t_err_ns
        assert shown.t_visible_ns + shown.t_err_ns <= time.monotonic_ns()
        assert bench.shows(SEQUENCE.profiles[index])
    projector.close()
    assert bench.engine.lit is None


def test_two_controllers_share_the_columns() -> None:
    bench = Bench(mirrors=2)
    projector = bench.open()
    size = Size(2560, 1600)
    assert projector.info.size == size
    sequence = encode((White(), Black(), LineShift(Axis.COLUMN, 3, 7)), size)
    projector.load(sequence)
    assert {0x1A2A, 0x1A2C} <= set(bench.commands())
    projector.show(2)
    assert bench.shows(sequence.profiles[2])
    projector.close()
    bench.engine.second_ready = False
    with pytest.raises(DeviceError, match="the second one does not answer"):
        bench.open()


def test_a_sequence_is_played_once_with_a_pulse_each(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(SEQUENCE)
    bench.pulses.clear()
    bench.engine.shown.clear()
    projector.play(0.01, 0.03)
    assert bench.played.wait(5)
    entries = [bench.engine.entries[index] for index in range(3)]
    assert {(entry.exposure_us, entry.dark_us, entry.leds, entry.cleared) for entry in entries} == {
        (12_000, 18_000, 7, True)
    }
    assert not threading.Event().wait(0.1), "time for a pulse too many"
    projector.stop()
    assert len(bench.pulses) == 3
    profiles = [shown for shown in bench.engine.shown if shown is not None and shown is not WHITE]
    assert [profile.tobytes() for profile in profiles] == [profile.tobytes() for profile in SEQUENCE.profiles]
    assert bench.engine.lit is None
    # What was shown before is played with its own times again.
    projector.show(0)
    bench.played.clear()
    bench.pulses.clear()
    projector.play(0.01, 0.03)
    assert bench.played.wait(5)
    projector.close()


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "options", "rule"),
    [
        (0.01, 0.005, {}, "lengthen the period"),
        # Without dark between, TRIG_OUT_1 has no edge.
        (0.01, 0.0105, {}, "the dark after it 105 µs, the period is 10500 µs"),
        (0.01, 0.02, {"duty_limit": 0.3}, "duty_limit"),
        (17.0, 40.0, {}, "the longest is 16777215"),
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
    with pytest.raises(UnsupportedByDeviceError, match="encode it for 1920 x 1080"):
        projector.load(encode((White(),), Size(1920, 1081)))
    projector.load(SEQUENCE)
    with pytest.raises(UnsupportedByDeviceError, match="patterns 0 to 2"):
        projector.show(3)
    projector.close()
    projector.close()
    for call in (lambda: projector.show(0), lambda: projector.play(0.01, 0.02), lambda: projector.load(SEQUENCE)):
        with pytest.raises(DeviceStateError, match="closed"):
            call()


@pytest.mark.parametrize(
    ("options", "sent"),
    [
        ({}, (0, 0, 0)),
        ({"trigger_polarity": "low", "trigger_delay_us": 300}, (1, 300, 300)),
        ({"trigger_delay_us": -20}, (0, -20, -20)),
    ],
)
def test_the_trigger_output_is_set(bench: Bench, options: dict[str, object], sent: tuple[int, ...]) -> None:
    bench.open(**options).close()
    assert struct.unpack("<Bhh", bench.engine.registers[0x1A1D]) == sent


@pytest.mark.parametrize(("version", "mirrors"), [((5, 9), 1), ((6, 0), 9)])
def test_what_is_not_known_is_refused_and_left_dark(version: tuple[int, int], mirrors: int) -> None:
    bench = Bench(version=version)
    bench.engine.mirrors = mirrors
    told = "firmware 5.9, this driver needs 6.0" if mirrors == 1 else "mirrors of type 9, this driver knows DLP6500"
    with pytest.raises(UnsupportedByDeviceError, match=told):
        bench.open()
    assert bench.engine.lit is None


@pytest.mark.parametrize(
    ("command", "got", "words"),
    [(0x1A1B, b"\1", "asked for display mode 03, the engine gives 01"), (0x0B01, bytes(3), "asked for led current")],
)
def test_a_setting_that_the_engine_bends_is_refused_and_it_is_dark(
    bench: Bench, command: int, got: bytes, words: str
) -> None:
    bench.engine.faults.bent = {command: got}
    with pytest.raises(UnsupportedByDeviceError, match=words):
        bench.open()
    assert bench.engine.lit is None


def test_a_mode_that_the_engine_tells_of_later_is_waited_for(bench: Bench) -> None:
    bench.engine.faults.bent = {0x1A1B: b"\1"}
    late = threading.Timer(0.2, bench.engine.faults.bent.clear)
    late.start()
    bench.open().close()
    assert not late.is_alive()
    late.join()


def test_what_the_engine_refuses_is_told_in_its_words_and_it_is_dark(bench: Bench) -> None:
    projector = bench.open()
    bench.engine.refusing = {0x1A34: 8}
    with pytest.raises(UnsupportedByDeviceError, match=r"take definition .*its memory is full"):
        projector.load(SEQUENCE)
    with pytest.raises(DeviceStateError):
        projector.show(0)
    # Data is not answered: what is wrong with it is found in the error code.
    bench.engine.refusing = {0x1A2B: 9}
    with pytest.raises(UnsupportedByDeviceError, match="take picture 0, and says: it does not know the packing"):
        projector.load(SEQUENCE)
    bench.engine.refusing = {}
    projector.load(SEQUENCE)
    bench.engine._hardware |= 128
    for use in (lambda: projector.show(0), lambda: projector.play(0.01, 0.02)):
        with pytest.raises(DeviceError, match="the sequencer failed"):
            use()
        assert bench.engine.lit is None
        assert not bench.engine.running
    projector.close()


def test_a_piece_of_a_picture_that_went_wrong_is_not_hidden_by_the_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    projector = bench.open()
    bench.commands()
    projector.load(SEQUENCE)
    assert bench.commands().count(0x1A2B) > 2
    answers = iter((6, *[0] * 100))
    monkeypatch.setattr(bench.engine, "_load", lambda _half, _data: next(answers))
    with pytest.raises(UnsupportedByDeviceError, match="take picture 0, and says: a parameter is not one that it has"):
        projector.load(SEQUENCE)
    assert bench.commands().count(0x1A2B) == 1
    projector.close()


@pytest.mark.slow
def test_two_seconds_after_its_host_has_died_it_is_dark(bench: Bench) -> None:
    dark = threading.Event()
    projector = bench.open(hold_s=60.0)
    projector.load(SEQUENCE)
    projector.show(0)
    assert not projector._state.closed.wait(3.0)
    assert bench.shows(SEQUENCE.profiles[0]), "held by its host"
    bench.engine._light = lambda profile: dark.set() if profile is None else None
    # As if the process were killed: nothing goes over the cable any more.
    with projector._lock:
        assert dark.wait(2.2)
        assert not dark.wait(0.1) or bench.engine.lit is None
        assert bench.engine.registers[LEDS] == b"\x08", "nobody switched the LEDs off"
    projector.close()


def test_an_engine_in_standby_is_told_nothing_before_it_is_woken() -> None:
    bench = Bench(standby=True)
    projector = bench.open()
    assert bench.engine.commands[0] == (0x0200, b"\0")
    assert bench.engine.lit is None
    projector.close()


@pytest.mark.parametrize("inverted", [True, False])
def test_until_the_sense_of_the_current_is_known_light_is_a_twentieth(inverted: bool) -> None:
    bench = Bench(led_inverted=inverted)
    projector = bench.open(led_current_inverted=None, led_current=0.5)
    assert isinstance(projector, UnprovenLight)
    assert (projector.unproven, projector.info.plays) == (True, False)
    projector.load(SEQUENCE)
    with pytest.raises(UnsupportedByDeviceError, match="slrig doctor finds it out"):
        projector.play(0.01, 0.02)
    most = {}
    for share in (0.5, 0.4, 0.6):
        projector.try_current(share)
        bench.engine.shown.clear()
        projector.show(0)
        while not (lit := [each for each in bench.engine.shown if each is not None]):
            os.sched_yield()
        most[share] = int(lit[0].max()) / 255
        pattern, end = bench.engine.entries[0], bench.engine.entries[3]
        period_us = pattern.exposure_us + end.exposure_us
        assert (end.leds, pattern.dark_us, end.dark_us) == (0, 0, 0)
        assert bench.engine._shown_of_order // 2 * period_us <= 2_000_000
        assert most[share] * pattern.exposure_us / period_us <= 0.0501
    assert (most[0.6] > most[0.4]) is not inverted
    assert projector.option_for(rises=most[0.6] > most[0.4]) == f"led_current_inverted = {str(inverted).lower()}"
    projector.close()


def test_an_unplugged_engine_is_gone_and_can_be_closed(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    bench.cable.unplug()
    for use in (lambda: projector.show(2), lambda: projector.load(SEQUENCE), projector.blank):
        with pytest.raises(DeviceGoneError, match="is gone"):
            use()
    projector.close()
    projector.blank()


def test_the_first_interface_of_an_engine_is_found(tmp_path: Path) -> None:
    for number, port in enumerate(("usb-1/input1", "usb-1/input0")):
        folder = tmp_path / f"hidraw{number}" / "device"
        folder.mkdir(parents=True)
        (folder / "uevent").write_text(f"HID_ID=0003:00000451:0000C900\nHID_PHYS={port}\nHID_UNIQ=LCR3\n")
    assert [(node.name, str(node.path)) for node in engines(DLPC900, tmp_path)] == [("LCR3", "/dev/hidraw1")]


def test_without_an_engine_it_is_gone(tmp_path: Path) -> None:
    assert find_devices() == ()
    with pytest.raises(DeviceGoneError, match="plugged in: none"):
        open_projector({}, tmp_path)
