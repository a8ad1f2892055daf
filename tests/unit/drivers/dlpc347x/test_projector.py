"""The driver above a peer that keeps the guides' rules: what it sends, what it refuses, and when it is dark."""

from __future__ import annotations

import fcntl
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from drivers.dlpc347x import open_projector
from drivers.dlpc347x.bus import Bus, Node, open_bus
from drivers.dlpc347x.projector import LightEngine
from slrig.devices import FlashedProjector, UnprovenLight
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    UnsupportedByDeviceError,
)
from slrig.model import Axis, Black, LineShift, PatternSequence, Primary, Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc347x_bench import MIRRORS, Table
from tests.contract.dlpc347x_device import WHITE

COLUMNS = encode((White(), Black(), LineShift(Axis.COLUMN, 1, 8), LineShift(Axis.COLUMN, 2, 8)), MIRRORS)
BOTH = encode((*COLUMNS.patterns, LineShift(Axis.ROW, 1, 8)), MIRRORS)


def written(sequence: PatternSequence = BOTH, **engine: Any) -> Table:
    """A fake engine that holds a sequence."""
    table = Table(**engine)
    projector = table.opened()
    projector.write_patterns(sequence)
    projector.close()
    table.engine.commands.clear()
    return table


@pytest.fixture
def table() -> Table:
    return written()


@pytest.fixture
def projector(table: Table) -> Iterator[LightEngine]:
    projector = table.opened(start_s=0.02)
    projector.load(COLUMNS)
    table.engine.commands.clear()
    yield projector
    projector.close()


def until(true: Callable[[], bool], within_s: float = 5.0) -> bool:
    """Whether something becomes true: the fake plays on a thread."""
    end_s = time.monotonic() + within_s
    while not true() and time.monotonic() < end_s:
        os.sched_yield()
    return true()


def showing(table: Table) -> None:
    with closing(table.opened()) as projector:
        projector.load(COLUMNS)
        projector.show(0)


def sent(table: Table, command: int) -> list[str]:
    return [data.hex() for each, data in table.engine.commands if each == command]


def test_an_engine_that_shines_is_dark_once_it_is_open() -> None:
    table = Table()
    assert table.engine.shown == [WHITE]
    projector = table.opened(led_current=0.25, trigger_delay_us=300)
    assert table.engine.commands[0] == (0x52, b"\0"), "the first thing that it was told"
    assert table.engine.shown[-1] is None
    # Patterns from flash that wait for nobody; a quarter of each LED's most; TRIG_OUT_2 alone, 300 µs late.
    registers = table.engine.registers
    assert (registers[0x05], registers[0x90], registers[0x50]) == (b"\4", b"\0", b"\0")
    assert struct.unpack("<3H", registers[0x54]) == (250, 200, 150)
    assert sent(table, 0x92) == ["0000000000", "032c010000"]
    info = projector.info
    assert (info.size, info.plays, info.model) == (MIRRORS, True, "DLPC3478 light engine, DLP3010, firmware 8.0.1")
    assert info.gap_s == pytest.approx(0.001 + 202e-6)
    assert isinstance(projector, FlashedProjector)
    assert not isinstance(projector, UnprovenLight)
    projector.close()
    assert table.engine.commands[-2:] == [(0x52, b"\0"), (0x9E, b"\1\0")]


def test_low_active_triggers_are_told_inverted() -> None:
    table = Table()
    table.opened(trigger_polarity="low").close()
    assert sent(table, 0x92) == ["0000000000", "0700000000"]


def test_an_entry_is_25_bytes_as_the_guide_has_them(table: Table, projector: LightEngine) -> None:
    shown = projector.show(2)
    # Start of an order; set 0, one pattern, blue; none inverted; 7600, 171 and 31 µs; pattern 2 of the set.
    assert sent(table, 0x98) == ["010001040000000000000000b01d0000ab0000001f00000002"]
    assert sent(table, 0x9E) == ["0100", "00fe"]
    assert sent(table, 0x52) == ["00", "07"]
    assert shown.t_visible_ns + shown.t_err_ns <= time.monotonic_ns()
    assert until(lambda: table.engine.lit is not None and table.engine.lit.tobytes() == COLUMNS.profiles[2].tobytes())
    projector.blank()
    assert table.engine.lit is None
    assert not table.engine.running


@pytest.mark.parametrize("counts_first", [False, True])
def test_a_sequence_is_played_once_and_ended_whichever_a_repeat_is(counts_first: bool) -> None:
    table = written(counts_first=counts_first)
    projector = table.opened(start_s=0.02)
    projector.load(COLUMNS)
    table.engine.shown.clear()
    projector.play(0.003, 0.01)
    assert until(lambda: not table.engine.running, 3.0)
    assert until(lambda: table.engine.registers[0x52] == b"\0")
    # LEDs are on before the start: what the mirrors had before may be lit until then.
    lit = [profile.tobytes() for profile in table.engine.shown if profile is not None and profile is not WHITE]
    assert lit == [profile.tobytes() for profile in COLUMNS.profiles]
    pulses = table.engine.pulses
    assert [late - early for early, late in pairwise(pulses)] == [10_000_000] * 3
    # Three patterns of one run, and the last one with a dark in which it is stopped.
    assert [data[2:6] + data[-2:] for data in sent(table, 0x98)] == ["000300", "000103"]
    projector.close()


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "options", "rule"),
    [
        (0.01, 0.02, {}, "asked for 11000 µs of blue light, the engine has none; .* cameras by software"),
        (0.005, 0.006, {}, "the dark after it 202 µs, the period is 6000 µs; lengthen the period"),
        (0.005, 0.01, {"duty_limit": 0.5}, "duty_limit of the rig file allows 50%"),
    ],
)
def test_a_timing_that_cannot_be_is_refused_before_the_first_light(
    table: Table, exposure_s: float, period_s: float, options: dict[str, object], rule: str
) -> None:
    projector = table.opened(**options)
    projector.load(COLUMNS)
    table.engine.commands.clear()
    with pytest.raises(UnsupportedByDeviceError, match=rule):
        projector.play(exposure_s, period_s)
    assert table.engine.commands == []
    projector.close()


def test_white_light_takes_600_µs_at_least_and_has_colours(table: Table) -> None:
    projector = table.opened(led="white", light_margin_s=0.0)
    assert projector.info.lights
    projector.load(encode((White(), Primary("red"), Black()), MIRRORS))
    projector.play(0.0002, 0.01)
    entries = [struct.unpack("<BBBQI", bytes.fromhex(data)[1:16]) for data in sent(table, 0x98)]
    assert [(leds, light_us) for _, _, leds, _, light_us in entries] == [(7, 600), (1, 600), (7, 600)]
    projector.close()


def test_both_axes_are_shown_and_not_played(table: Table) -> None:
    projector = table.opened(start_s=0.02)
    projector.load(BOTH)
    projector.show(4)
    assert until(lambda: table.engine.lit is not None and table.engine.lit.shape == (720, 1))
    with pytest.raises(UnsupportedByDeviceError, match="scan one axis only, or without the wire"):
        projector.play(0.003, 0.01)
    projector.close()


def test_patterns_are_written_once_and_nothing_is_lit_meanwhile(table: Table) -> None:
    assert (table.engine.erased, table.engine.written_bytes) == (1, 20 + 28 + 12 + 2 * 8 + 4 * 160 + 3 * 96)
    projector = table.opened()
    assert "holds these 5 patterns already" in projector.write_patterns(BOTH)
    assert table.engine.erased == 1
    assert "were written" in projector.write_patterns(COLUMNS)
    with pytest.raises(UnsupportedByDeviceError, match=r"lacks 1 of 5 patterns \(row lines 1 of 8\); .*slrig patterns"):
        projector.load(BOTH)
    projector.close()
    assert table.engine.shown.count(None) == 1, "it shone as it woke up, and never again"


def test_a_mirrored_engine_is_written_anew() -> None:
    table = written(COLUMNS)
    projector = table.opened(mirror_columns=True)
    with pytest.raises(UnsupportedByDeviceError, match="lacks 2 of 4"):
        projector.load(COLUMNS)
    projector.write_patterns(COLUMNS)
    projector.load(COLUMNS)
    projector.show(2)
    assert until(lambda: table.engine.lit is not None)
    assert table.engine.lit is not None
    assert (table.engine.lit == COLUMNS.profiles[2][:, ::-1]).all()
    projector.close()


def test_a_flash_that_has_no_room_or_forgets_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    small = Table(room=512)
    projector = small.opened()
    with pytest.raises(UnsupportedByDeviceError, match="its flash has no room"):
        projector.write_patterns(BOTH)
    assert small.engine.erased == 0
    projector.close()
    worn = Table()
    monkeypatch.setattr(worn.engine, "flash", Worn(worn.engine.flash))
    projector = worn.opened()
    with pytest.raises(DeviceError, match="does not give back what was written"):
        projector.write_patterns(BOTH)
    projector.close()


class Worn(bytearray):
    """Flash with a bit that stays."""

    def __setitem__(self, at: object, value: object) -> None:
        super().__setitem__(at, value)  # type: ignore[call-overload]
        super().__setitem__(100, super().__getitem__(100) & 0x7F | 1)


@pytest.mark.parametrize(
    ("engine", "told"),
    [
        ({"entry_bytes": 23}, "98h .*more or fewer parameters in its firmware: update it"),
        ({"most_entries": 1}, "does not take the sequence: its order has fewer entries"),
    ],
)
def test_what_the_engine_does_not_take_is_told_in_its_words_and_it_is_dark(engine: dict[str, Any], told: str) -> None:
    table = written(**engine)
    projector = table.opened()
    projector.load(COLUMNS)
    with pytest.raises(UnsupportedByDeviceError, match=told):
        projector.play(0.003, 0.01)
    assert table.engine.lit is None
    assert (0x9E, b"\0\1") not in table.engine.commands
    projector.close()


@pytest.mark.parametrize(
    ("bent", "error", "told"),
    [
        ({0x51: b"\1"}, UnsupportedByDeviceError, "asked for led control 00, the engine gives 01"),
        ({0x99: b""}, UnsupportedByDeviceError, "entry 0 was 00 01 04"),
        ({0x9F: bytes(7)}, DeviceError, "is not ready for 1 entries"),
        ({0x53: b"\7"}, UnsupportedByDeviceError, "asked for led enable 00, the engine gives 07"),
        ({0xD0: b"\x89", 0xD1: b"\0\x10\4\0"}, DeviceError, "says: the green LED failed; its supply is low"),
    ],
)
def test_what_is_read_back_otherwise_is_not_believed(
    bent: dict[int, bytes], error: type[DeviceError], told: str
) -> None:
    table = written()
    table.engine.bent = bent
    with pytest.raises(error, match=told):
        showing(table)
    assert table.engine.lit is None


def test_other_controllers_are_refused_and_left_dark() -> None:
    table = Table(controller=0x0C)
    with pytest.raises(UnsupportedByDeviceError, match=r"controller 0x0c.*DLPC3479.*it is not served"):
        table.opened()
    assert table.engine.lit is None


def test_without_power_it_is_gone_and_can_be_closed(table: Table, projector: LightEngine) -> None:
    projector.show(0)
    table.engine.unplug()
    for use in (lambda: projector.show(1), lambda: projector.play(0.003, 0.01), projector.blank):
        with pytest.raises(DeviceGoneError, match="does not answer"):
            use()
    projector.close()
    projector.close()
    with pytest.raises(DeviceStateError, match="closed"):
        projector.show(0)


@pytest.mark.slow
def test_two_seconds_after_its_host_has_died_it_is_dark(table: Table) -> None:
    projector = table.opened(hold_s=60.0)
    projector.load(COLUMNS)
    projector.show(0)
    assert not threading.Event().wait(3.0)
    assert table.engine.running, "held by its host"
    # As if the process were killed: nothing goes over the bus any more.
    with projector._lock:
        assert until(lambda: not table.engine.running, 2.2)
        assert (table.engine.lit, table.engine.registers[0x52]) == (None, b"\7")
    projector.close()


def test_what_is_no_bus_is_told_of(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match=r"No such file.*buses that are there: .*modprobe i2c-dev"):
        open_projector({"device": str(tmp_path / "i2c-9")}, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DeviceGoneError, match="this is no I²C bus"):
        open_bus(tmp_path / "file", 0x1B)
    with (tmp_path / "file").open() as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        with pytest.raises(DeviceBusyError, match="another program"):
            open_bus(tmp_path / "file", 0x1B)
    with pytest.raises(ConfigError, match="device"):
        open_projector({}, tmp_path)


def test_each_command_and_each_answer_is_a_transaction_of_its_own() -> None:
    near, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with far:
        bus = Bus(Node(near.detach()), "light engine")
        far.send(b"\x0b")
        assert bus.read(0xD3, 1, b"\2") == b"\x0b"
        bus.write(0x9E, b"\1\0")
        assert [far.recv(99) for _ in range(2)] == [b"\xd3\2", b"\x9e\1\0"]
        far.send(b"\1")
        with pytest.raises(DeviceGoneError, match="a part of an answer"):
            bus.read(0xD1, 4)
        bus.close()
        with pytest.raises(DeviceStateError, match="closed"):
            bus.write(0x9E)


def test_a_sequence_of_another_size_or_with_grey_is_refused(projector: LightEngine) -> None:
    with pytest.raises(UnsupportedByDeviceError, match="encode it for 1280 x 720"):
        projector.load(encode((White(),), Size(854, 480)))
