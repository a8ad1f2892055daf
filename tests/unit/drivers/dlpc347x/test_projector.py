"""What only this driver does, above a peer that keeps the guides' rules, and the patterns in the flash."""

from __future__ import annotations

import fcntl
import hashlib
import socket
import struct
from pathlib import Path
from typing import Any

import pytest

from drivers.dlpc347x import open_projector
from drivers.dlpc347x.bus import I2cBus, I2cNode, open_bus
from drivers.dlpc347x.flash import LineEncoder, block_size, build_block, find_lines, locate_patterns
from drivers.dlpc347x.projector import MIRRORS as CONTROLLERS
from slrig.devices import UnknownPolarityProjector
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    UnsupportedByDeviceError,
)
from slrig.model import Axis, Black, Gray, LineShift, Pattern, PatternSequence, Primary, Size, White
from slrig.patterns.sequence import encode, merge_sequences, scan_patterns
from tests.contract.dlpc347x_bench import MIRRORS
from tests.contract.dlpc350_device import WHITE
from tests.unit.drivers.pattern_engine.engine_bench import Bench347x

COLUMNS = encode((White(), Black(), LineShift(Axis.COLUMN, 1, 8), LineShift(Axis.COLUMN, 2, 8)), MIRRORS)
BOTH = encode((*COLUMNS.patterns, LineShift(Axis.ROW, 1, 8)), MIRRORS)


class Bench(Bench347x):
    """An engine that holds lines of both axes, and shows columns."""

    sequence = COLUMNS

    def __init__(self, flashed: PatternSequence | None = BOTH, **engine: Any) -> None:
        super().__init__(flashed, **engine)

    def sent(self, command: int) -> list[str]:
        return [data.hex() for each, data in self.engine.commands if each == command]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_what_is_set_when_it_is_opened() -> None:
    bench = Bench(None)
    projector = bench.open(led_current=0.25, trigger_delay_us=300)
    # A quarter of each LED's most; TRIG_OUT_2 alone, 300 µs late.
    assert struct.unpack("<3H", bench.engine.registers[0x54]) == (250, 200, 150)
    assert bench.sent(0x92) == ["0000000000", "032c010000"]
    assert projector.info.model == "DLPC3478 light engine, DLP3010, firmware 8.0.1"
    assert not isinstance(projector, UnknownPolarityProjector)
    projector.close()
    assert bench.engine.commands[-2:] == [(0x52, b"\0"), (0x9E, b"\1\0")]
    bench.engine.commands.clear()
    bench.open(trigger_polarity="low").close()
    assert bench.sent(0x92) == ["0000000000", "0700000000"], "inverted"


def test_an_entry_is_25_bytes_as_the_guide_has_them(bench: Bench) -> None:
    projector = bench.loaded()
    projector.show(2)
    # Start of an order; set 0, one pattern, blue; none inverted; 7600, 171 and 31 µs; pattern 2 of the set.
    assert bench.sent(0x98) == ["010001040000000000000000b01d0000ab0000001f00000002"]
    assert bench.sent(0x9E) == ["0100", "00fe"]
    assert bench.sent(0x52) == ["00", "07"]


@pytest.mark.parametrize("counts_first", [False, True])
def test_a_sequence_is_ended_whichever_a_repeat_is(counts_first: bool) -> None:
    bench = Bench(counts_first=counts_first)
    projector = bench.loaded()
    projector.play(0.003, 0.01)
    bench.clock.advance(5)
    assert not bench.engine.running
    assert bench.engine.registers[0x52] == b"\0"
    lit = [profile.tobytes() for profile in bench.engine.shown if profile is not None and profile is not WHITE]
    assert lit == [profile.tobytes() for profile in COLUMNS.profiles]
    assert len(bench.pulses) == 4
    # Three patterns of one run, and the last one with a dark in which it is stopped.
    assert [data[2:6] + data[-2:] for data in bench.sent(0x98)] == ["000300", "000103"]


def test_white_light_takes_600_µs_at_least_and_has_colours(bench: Bench) -> None:
    projector = bench.loaded(led="white", light_margin_s=0.0)
    assert projector.info.lights
    projector.load(encode((White(), Primary("red"), Black()), MIRRORS))
    projector.play(0.0002, 0.01)
    entries = [struct.unpack("<BBBQI", bytes.fromhex(data)[1:16]) for data in bench.sent(0x98)]
    assert [(leds, light_us) for _, _, leds, _, light_us in entries] == [(7, 600), (1, 600), (7, 600)]


def test_both_axes_are_shown_and_not_played(bench: Bench) -> None:
    projector = bench.open()
    projector.load(BOTH)
    projector.show(4)
    assert bench.engine.lit is not None
    assert bench.engine.lit.shape == (720, 1)
    with pytest.raises(UnsupportedByDeviceError, match="scan one axis only, or with software trigger"):
        projector.play(0.003, 0.01)


def test_patterns_are_written_once_and_nothing_is_lit_meanwhile() -> None:
    bench = Bench(None)
    projector = bench.open()
    assert "were written" in projector.write_patterns(BOTH)
    assert (bench.engine.erased, bench.engine.written_bytes) == (1, 20 + 28 + 12 + 2 * 8 + 4 * 160 + 3 * 96)
    # The mode is chosen when it is opened, and again, for what was written may have ended it.
    assert bench.sent(0x05) == ["04", "04"]
    assert "holds these 5 patterns already" in projector.write_patterns(BOTH)
    assert bench.engine.erased == 1
    assert "were written" in projector.write_patterns(COLUMNS)
    with pytest.raises(UnsupportedByDeviceError, match=r"lacks 1 of 5 patterns \(row lines 1 of 8\); .*slrig patterns"):
        projector.load(BOTH)
    projector.close()
    assert bench.engine.shown == [WHITE, None], "it shone as it woke up, and never again"


def test_a_mirrored_engine_is_written_again() -> None:
    bench = Bench(COLUMNS)
    projector = bench.open(mirror_columns=True)
    with pytest.raises(UnsupportedByDeviceError, match="lacks 2 of 4"):
        projector.load(COLUMNS)
    projector.write_patterns(COLUMNS)
    projector.load(COLUMNS)
    projector.show(2)
    assert bench.shows(COLUMNS.profiles[2][:, ::-1])


class Worn(bytearray):
    """Flash with a bit that stays."""

    def __setitem__(self, at: object, value: object) -> None:
        super().__setitem__(at, value)  # type: ignore[call-overload]
        super().__setitem__(100, super().__getitem__(100) & 0x7F | 1)


@pytest.mark.parametrize("worn", [False, True])
def test_a_flash_that_has_no_room_or_forgets_is_reported(worn: bool) -> None:
    bench = Bench(None, room=65536 if worn else 512)
    if worn:
        bench.engine.flash = Worn(bench.engine.flash)
    projector = bench.open()
    with pytest.raises(DeviceError, match="differs from the written data" if worn else "its flash has no room"):
        projector.write_patterns(BOTH)
    assert bench.engine.erased == int(worn)


@pytest.mark.parametrize(
    ("engine", "bent", "error", "told"),
    [
        ({"entry_bytes": 23}, {}, UnsupportedByDeviceError, "98h .*more or fewer parameters in its firmware: update"),
        ({"most_entries": 0}, {}, UnsupportedByDeviceError, "refuses the sequence: the order has too few entries"),
        ({}, {0x51: b"\1"}, UnsupportedByDeviceError, "requested led control 00, the engine gives 01"),
        ({}, {0x99: b""}, UnsupportedByDeviceError, "requested entry 0 of the order 00 01 04"),
        ({}, {0x9F: bytes(7)}, DeviceError, "is not ready for 1 entries"),
        ({}, {0x53: b"\7"}, UnsupportedByDeviceError, "requested led enable 00, the engine gives 07"),
        ({}, {0xD0: b"\x89", 0xD1: b"\0\x10\4\0"}, DeviceError, "reports: the green LED failed; its supply is low"),
    ],
)
def test_what_the_engine_does_not_take_or_gives_back_otherwise_is_reported_and_it_is_dark(
    engine: dict[str, Any], bent: dict[int, bytes], error: type[DeviceError], told: str
) -> None:
    bench = Bench(**engine)
    bench.engine.bent = bent
    with pytest.raises(error, match=told):
        bench.loaded().show(0)
    assert bench.engine.lit is None
    assert not bench.engine.running


def test_other_controllers_are_refused_and_left_dark() -> None:
    bench = Bench(None, controller=0x0C)
    with pytest.raises(UnsupportedByDeviceError, match=r"controller 0x0c.*DLPC3479 is not supported"):
        bench.open()
    assert bench.engine.lit is None


def test_what_is_no_bus_is_reported(tmp_path: Path) -> None:
    with pytest.raises(DeviceGoneError, match=r"No such file.*available buses: .*modprobe i2c-dev"):
        open_projector({"device": str(tmp_path / "i2c-9")}, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(DeviceGoneError, match="not an I²C bus"):
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
        bus = I2cBus(I2cNode(near.detach()), "light engine")
        far.send(b"\x0b")
        assert bus.read(0xD3, 1, b"\2") == b"\x0b"
        bus.write(0x9E, b"\1\0")
        assert [far.recv(99) for _ in range(2)] == [b"\xd3\2", b"\x9e\1\0"]
        far.send(b"\1")
        with pytest.raises(DeviceGoneError, match="incomplete read"):
            bus.read(0xD1, 4)
        bus.close()
        with pytest.raises(DeviceStateError, match="closed"):
            bus.write(0x9E)


def scanned(size: Size, *, period_px: int = 16) -> PatternSequence:
    patterns = scan_patterns(
        size, line_shift=True, period_px=period_px, line_width_px=2, gray_cell_px=8, gray_offset_px=0, rows=True
    )
    return merge_sequences([encode(patterns, size)])


def as_compiled(pattern: Pattern) -> tuple[bool, bool, int]:
    """Sorts patterns by axis, then code before lines, then bits; white and black stay first."""
    if not isinstance(pattern, Gray | LineShift):
        return False, False, -1
    return pattern.axis is Axis.ROW, isinstance(pattern, LineShift), pattern.bit if isinstance(pattern, Gray) else 0


@pytest.mark.parametrize(
    ("controller", "length", "digest"),
    [
        (0x0F, 5452, "f0f9763ef262f0a52431036c95b6721c8c7f623d809b988ab7461a9950d3e50e"),
        (0x0B, 8588, "bbe4e531db9392805b491c2e378a1b536e43ce6a59022a1474f908a012e98839"),
    ],
)
def test_a_block_is_what_tis_own_source_makes_of_the_same_patterns(controller: int, length: int, digest: str) -> None:
    # dlpc347x_internal_patterns.c as `drivers.dlpc347x.flash` cites it, compiled and run once: of each axis all bits,
    # and then the lines.
    _, mirrors = CONTROLLERS[controller]
    found = scanned(mirrors.size)
    ordered = sorted(zip(found.patterns, found.profiles, strict=True), key=lambda each: as_compiled(each[0]))
    patterns, profiles = zip(*ordered, strict=True)
    block = build_block(PatternSequence(found.projector, patterns, profiles), LineEncoder(mirrors, (False, False)))
    assert (len(block), hashlib.sha256(block).hexdigest()) == (length, digest)
    assert block_size(block[:20]) == length


def test_more_patterns_than_a_set_holds_go_into_further_ones_with_white_and_black() -> None:
    _, mirrors = CONTROLLERS[0x0B]
    lines = LineEncoder(mirrors, (False, False))
    sequence = scanned(mirrors.size, period_px=80)
    held = find_lines(build_block(sequence, lines))
    places = locate_patterns(sequence, lines, held)
    assert len(held) > 2 * 80
    assert {place.set for place in places} == {0, 1, 2, 3}
    assert max(place.index for found in held.values() for place in found) == 63
    columns = encode(sequence.patterns[60:90], mirrors.size)
    assert {place.set for place in locate_patterns(columns, lines, held)} == {0, 1}
    white_and_one = encode((sequence.patterns[0], sequence.patterns[90]), mirrors.size)
    assert {place.set for place in locate_patterns(white_and_one, lines, held)} == {1}
