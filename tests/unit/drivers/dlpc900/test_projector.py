"""What only this driver does, above a peer that speaks its protocol, and is as unhelpful as its guide allows."""

from __future__ import annotations

import struct
import threading
from pathlib import Path

import pytest

from drivers.dlpc900 import find_devices, open_projector
from drivers.dlpc900.projector import DLPC900
from drivers.pattern_engine.finding import engines
from slrig.devices import FlashedProjector
from slrig.errors import DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import Axis, Black, LineShift, Size, White
from slrig.patterns.sequence import encode
from tests.contract.dlpc900_bench import MIRRORS
from tests.unit.drivers.pattern_engine.engine_bench import LEDS, LINES, START_STOP
from tests.unit.drivers.pattern_engine.engine_bench import SEQUENCE_900 as SEQUENCE
from tests.unit.drivers.pattern_engine.engine_bench import Bench900 as Bench

START = STOP = START_STOP


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_dark_between_is_declared_and_nothing_is_flashed(bench: Bench) -> None:
    projector = bench.open()
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


def test_each_entry_of_a_played_sequence_has_its_light_and_the_dark_after_it(bench: Bench) -> None:
    projector = bench.open(light_margin_s=0.002)
    projector.load(SEQUENCE)
    projector.play(0.01, 0.03)
    entries = [bench.engine.entries[index] for index in range(3)]
    assert {(entry.exposure_us, entry.dark_us, entry.leds, entry.cleared) for entry in entries} == {
        (12_000, 18_000, 7, True)
    }
    projector.close()


@pytest.mark.parametrize(("version", "mirrors"), [((5, 9), 1), ((6, 0), 9)])
def test_what_is_not_known_is_refused_and_left_dark(version: tuple[int, int], mirrors: int) -> None:
    bench = Bench(version=version)
    bench.engine.mirrors = mirrors
    told = "firmware 5.9, this driver needs 6.0" if mirrors == 1 else "mirrors of type 9, this driver knows DLP6500"
    with pytest.raises(UnsupportedByDeviceError, match=told):
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
