"""What only this driver does, above a peer that speaks its protocol, and is as unhelpful as its documents allow."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.dlpc350.flash import Flash, write_pictures
from drivers.dlpc350.options import EngineOptions
from drivers.dlpc350.planes import MIRRORS
from drivers.dlpc350.projector import DLPC350, LightEngine
from drivers.pattern_engine.link import Link
from slrig.devices import FlashedProjector
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels
from tests.contract.dlpc350_device import Cable
from tests.unit.drivers.pattern_engine.engine_bench import LEDS, START_STOP
from tests.unit.drivers.pattern_engine.engine_bench import SEQUENCE_350 as SEQUENCE
from tests.unit.drivers.pattern_engine.engine_bench import Bench350 as Bench

START = STOP = START_STOP
VALIDATE = 0x1A1A


@pytest.fixture(scope="session")
def flash(tmp_path_factory: pytest.TempPathFactory) -> Flash:
    return write_pictures(tmp_path_factory.mktemp("pictures"), SEQUENCE)


@pytest.fixture
def bench(flash: Flash) -> Bench:
    return Bench(flash)


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


def test_light_is_waited_for_as_long_as_a_picture_takes(flash: Flash) -> None:
    bench = Bench(flash, load_s=0.1)
    projector = bench.open(image_load_s=0.15)
    projector.load(SEQUENCE)
    shown = projector.show(2)
    assert bench.engine.lit is not None
    assert (bench.engine.lit == SEQUENCE.profiles[2]).all()
    assert shown.t_err_ns >= 0.075e9
    projector.close()


def test_a_played_sequence_is_of_one_timing_and_one_picture(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(SEQUENCE)
    projector.play(0.01, 0.03)
    assert bench.engine.registers[0x1A29] == (12_000).to_bytes(4, "little") + (30_000).to_bytes(4, "little")
    assert bench.engine.registers[0x1A31] == bytes([2, 0, 2, 0])
    projector.close()


def test_the_longest_table_takes_several_reports(bench: Bench) -> None:
    projector = bench.open()
    long = PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 129, SEQUENCE.profiles[:1] * 129)
    with pytest.raises(UnsupportedByDeviceError, match="129 patterns, the engine's table takes 128"):
        projector.load(long)
    projector.load(PatternSequence(MIRRORS, SEQUENCE.patterns[:1] * 128, SEQUENCE.profiles[:1] * 128))
    projector.play(0.001, 0.002)
    assert bench.played.wait(5)
    (data,) = (data for command, data in bench.engine.commands if command == 0x1A34 and len(data) > 64)
    assert len(data) == 384
    projector.close()


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
        assert bench.shows(SEQUENCE.profiles[index])
    print(f"\n{min(took_s) * 1e3:.0f} ms a pattern, commands of 3 ms")  # noqa: T201 - the figure of the test
    assert min(took_s) <= 0.1
    projector.blank()
    projector.play(0.01, 0.02)
    projector.close()


# Which way the LEDs' current goes.


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
