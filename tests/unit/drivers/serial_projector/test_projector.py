"""The driver on a box at the end of a line: light, refusals, restarts, cables, other hosts."""

from __future__ import annotations

import importlib
import json
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.serial_port import SerialPort
from drivers.serial_projector import open_projector
from drivers.serial_projector.client import BoxClient, BoxLimits, pattern_checksums, sequence_checksum
from drivers.serial_projector.device import protocol
from drivers.serial_projector.link import BoxLink, SequenceMode
from drivers.serial_projector.projector import SerialProjector
from slrig.devices import StoredPatternProjector
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, DeviceStateError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Size
from tests.contract.suite import whole_scan
from tests.unit.drivers.serial_projector.conftest import CRC32, SEQUENCE, SIZE, Bench
from tests.unit.drivers.serial_projector.engines import (
    GAP_US,
    HOLD_US,
    LEAST_US,
    LIGHT_US,
    CoreEngine,
    Scene,
    description,
)
from tests.unit.drivers.serial_projector.line import SerialLine

ALL = list(range(26))


def part(first: int, count: int, step: int = 1) -> PatternSequence:
    chosen = slice(first, first + count * step if first + count * step >= 0 else None, step)
    return PatternSequence(SIZE, SEQUENCE.patterns[chosen], SEQUENCE.profiles[chosen])


BACKWARDS = part(25, 26, -1)


def calls(projector: SerialProjector) -> dict[str, Callable[[], object]]:
    return {
        "show": lambda: projector.show(4),
        "play": lambda: projector.play(0.004, 0.008),
        "blank": projector.blank,
        "stop": projector.stop,
    }


def test_show_returns_when_its_light_came(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(drift=80e-6)
    projector = bench.loaded()
    info, status = projector.info, projector.client.status()
    assert (info.size, info.plays, info.model, info.serial) == (SIZE, True, "test-box 1.0.0", "the line")
    assert (info.latency_s, info.gap_s, info.duty) == (LIGHT_US / 1e6, GAP_US / 1e6, 1.0)
    assert (status.state, status.index, status.shows) == ("ready", None, 0)
    for index in ALL:
        shown = projector.show(index)
        change = bench.scene.changes[-1]
        assert change.pattern == index
        assert abs(shown.t_visible_ns - change.t_ns) <= shown.t_err_ns + 1_000, "the box counts whole µs"
        assert shown.t_err_ns < 100_000
        assert bench.clock.now_ns() >= shown.t_visible_ns + shown.t_err_ns
        bench.advance(0.5)


def test_a_play_lights_every_pattern_once_and_pulses_the_cameras(bench: Bench) -> None:
    projector = bench.loaded()
    projector.play(0.004, 0.008)
    bench.advance(0.3)
    assert bench.patterns == ALL
    lights, ends = bench.scene.changes[0::2], bench.scene.changes[1::2]
    # Each pattern's pulse comes with its light, which lasts for the whole exposure.
    for pulse_ns, on, off in zip(bench.scene.pulses_ns, lights, ends, strict=True):
        assert on.t_ns <= pulse_ns
        assert 4_000_000 <= off.t_ns - pulse_ns <= 5_000_000
    assert np.diff([on.t_ns for on in lights]) == pytest.approx(8_000_000, abs=10_000)
    assert (projector.client.status().state, projector.client.status().index) == ("ready", 25)
    projector.stop()
    assert [each.index for each in projector.played_patterns] == ALL
    for each, on in zip(projector.played_patterns, lights, strict=True):
        assert abs(each.t_visible_ns - on.t_ns) <= each.t_err_ns + 1_000
    # Another one that is stopped, and one more, which begins at the beginning.
    projector.play(0.004, 0.04)
    bench.advance(0.1)
    projector.stop()
    assert bench.lit is None
    assert bench.patterns[26:] == [0, 1, 2]
    projector.load(part(0, 4))
    projector.play(0.004, 0.008)
    bench.advance(0.1)
    assert bench.patterns[29:] == [0, 1, 2, 3]


def test_patterns_can_be_stepped_by_trigger(bench: Bench) -> None:
    client = bench.open().client
    assert client.load(CRC32[8:11]) == ()
    client.sequence(0, 3, 4_000, 8_000, SequenceMode.STEP)
    for index in range(3):
        t_ns, error_ns = client.trigger(index)
        assert abs(t_ns - bench.scene.changes[-1].t_ns) <= error_ns + 1_000
        bench.advance(0.01)
        assert bench.lit is None
    assert bench.patterns == [8, 9, 10]


@pytest.mark.parametrize(
    ("sequence", "indices", "lit"),
    [
        (part(2, 14), (0, 13), [2, 15]),
        # White and black come twice: the first run that fits is taken, and the first place.
        (part(24, 2), (0, 1), [0, 1]),
        (PatternSequence(SIZE, BACKWARDS.patterns * 2, BACKWARDS.profiles * 2), (0, 3, 51, 26), [1, 22, 0, 1]),
    ],
    ids=["a run", "the last two", "backwards, twice"],
)
def test_what_is_flashed_is_shown_in_any_order_and_as_often_as_wanted(
    bench: Bench, sequence: PatternSequence, indices: tuple[int, ...], lit: list[int]
) -> None:
    projector = bench.open()
    projector.load(sequence)
    for index in indices:
        projector.show(index)
    assert bench.patterns == lit


def test_a_box_of_old_firmware_takes_runs_and_nothing_else(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "MAX_PICKED", 0)
    projector = bench.open()
    assert projector.client.box.pick == 0
    projector.load(part(2, 14))
    projector.show(0)
    assert bench.lit == 2
    with pytest.raises(UnsupportedByDeviceError, match=r"supports only runs of its flash.*slrig patterns"):
        projector.load(BACKWARDS)


def test_patterns_that_are_not_flashed_are_refused_dark_and_nothing_is_written(bench: Bench, tmp_path: Path) -> None:
    projector = bench.open(tmp_path)
    projector.load(SEQUENCE)
    projector.show(0)
    wider = whole_scan(SIZE, period_px=8)
    with pytest.raises(UnsupportedByDeviceError, match=r"it lacks 8 of them, pattern 12 first\..*slrig patterns"):
        projector.load(wider)
    assert bench.lit is None
    with pytest.raises(DeviceStateError, match="no sequence is loaded"):
        projector.show(0)
    assert list(tmp_path.iterdir()) == []


def test_each_set_of_patterns_is_written_into_a_folder_of_its_own(bench: Bench, tmp_path: Path) -> None:
    projector = bench.open(tmp_path)
    assert isinstance(projector, StoredPatternProjector)
    told = [projector.write_patterns(each) for each in (SEQUENCE, BACKWARDS, SEQUENCE)]
    first, second = (sequence_checksum(pattern_checksums(each)) for each in (SEQUENCE, BACKWARDS))
    assert {folder.name for folder in (tmp_path / "patterns").iterdir()} == {f"{first:08X}", f"{second:08X}"}
    folder = tmp_path / "patterns" / f"{second:08X}"
    assert str(folder) in told[1]
    listed = json.loads((folder / "patterns.json").read_text())
    assert listed["size_px"] == [400, 300]
    assert [int(each, 16) for each in listed["crc32"]] == list(pattern_checksums(BACKWARDS))
    for index in (0, 7, 25):
        image = cv2.imread(str(folder / f"{index:03d}.png"), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert np.array_equal(image, BACKWARDS.image(index))
    with pytest.raises(UnsupportedByDeviceError, match="shows 400 x 300"):
        projector.write_patterns(whole_scan(Size(408, 300)))


@pytest.mark.parametrize(
    ("exposure_s", "period_s", "found"),
    [
        (LEAST_US / 2e6, 0.1, "at least 0.0001 s"),
        (0.01, 0.01 + GAP_US / 2e6, "between exposures"),
        (1.0, 3.0, "max_on_s"),
        (0.01, 0.0125, r"84.0% of the time, where 60.0% are allowed \(max_duty\)"),
    ],
)
def test_a_play_that_the_box_cannot_do_is_refused(bench: Bench, exposure_s: float, period_s: float, found: str) -> None:
    assert HOLD_US == 500
    projector = bench.loaded(max_on_s=0.8, max_duty=0.6)
    with pytest.raises(UnsupportedByDeviceError, match=found):
        projector.play(exposure_s, period_s)
    assert bench.patterns == []


def test_brightness_that_the_box_cannot_keep_is_refused(bench: Bench) -> None:
    bench.engine.light.dims = False
    with pytest.raises(UnsupportedByDeviceError, match="cannot dim"):
        bench.open(brightness=0.5)
    bench.engine.light.dims = True
    bench.open(brightness=0.5)
    assert bench.engine.light.bright == 500


def test_the_light_stays_for_as_long_as_the_host_gives_signs_of_life(bench: Bench) -> None:
    projector = bench.loaded(watchdog_s=0.1)
    projector.show(1)
    bench.advance(30)
    assert [change.pattern for change in bench.scene.changes] == [1]
    # The host is too busy: its thread does not come to it.
    projector._keep_alive.stop()
    stopped_ns = bench.clock.now_ns()
    bench.advance(1)
    _, dark = bench.scene.changes
    assert 0.08e9 <= dark.t_ns - stopped_ns <= 0.1e9 + 1_000_000
    with pytest.raises(DeviceError, match="watchdog_s"):
        projector.show(2)
    assert bench.lit is None
    projector.show(2)
    assert bench.lit == 2


def stays_on(bench: Bench, _projector: SerialProjector) -> None:
    bench.advance(0.2)
    assert bench.lit is None


def fails(bench: Bench, _projector: SerialProjector) -> None:
    bench.engine.light.broken = {"select"}


def plays(_bench: Bench, projector: SerialProjector) -> None:
    projector.play(0.05, 0.2)


@pytest.mark.parametrize(
    ("happens", "error", "words"),
    [
        (stays_on, DeviceError, "max_on_s"),
        (fails, DeviceError, "select failed"),
        (plays, DeviceStateError, "stop its current action first"),
    ],
)
def test_a_pattern_that_the_box_cannot_show_is_an_error_and_dark(
    bench: Bench, happens: Callable[[Bench, SerialProjector], None], error: type[DeviceError], words: str
) -> None:
    projector = bench.loaded(max_on_s=0.1)
    projector.show(0)
    happens(bench, projector)
    with pytest.raises(error, match=words):
        projector.show(1)
    assert bench.lit is None
    bench.engine.light.broken = set()
    projector.show(1)


# Restarts and cables.


def test_a_box_that_restarts_in_the_dark_is_loaded_again(bench: Bench) -> None:
    projector = bench.loaded()
    bench.line.restart()
    assert projector.show(3).index == 3
    assert bench.scene.shown == [(3, 2)]
    projector.blank()
    bench.line.restart()
    projector.play(0.004, 0.008)
    bench.advance(0.3)
    assert bench.patterns == [3, *ALL]


@pytest.mark.parametrize("call", ["show", "play", "blank", "stop"])
@pytest.mark.parametrize("lit", ["pattern 3 was lit", "a sequence played"])
def test_a_box_that_restarts_while_it_is_lit_is_gone(bench: Bench, call: str, lit: str) -> None:
    projector = bench.loaded()
    if lit == "a sequence played":
        projector.play(0.02, 0.05)
        bench.advance(0.12)
    else:
        projector.show(3)
    bench.line.restart()
    with pytest.raises(DeviceGoneError, match=rf"restarted \(boot 00000001, now 00000002\) while {lit}"):
        calls(projector)[call]()
    assert bench.lit is None
    projector.close()
    bench.loaded().show(4)


def test_a_box_that_takes_time_to_start_is_waited_for(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(boot_s=4.0)
    bench.line.restart()
    bench.loaded(open_s=5.0).show(0)
    bench.close()
    bench.line.restart()
    with pytest.raises(DeviceError, match=r"no trigger box that speaks SLTP/1 answered on"):
        bench.open(open_s=3.0)


def test_another_box_behind_the_same_port_is_refused(bench: Bench) -> None:
    projector = bench.loaded()
    bench.engine.about.width_px = 640
    bench.line.restart()
    with pytest.raises(DeviceGoneError, match="projects 640 x 300 instead of 400 x 300"):
        projector.show(0)


@pytest.mark.parametrize("doing", ["show", "play"])
def test_a_cable_that_is_pulled_ends_in_darkness(bench: Bench, doing: str) -> None:
    projector = bench.loaded(watchdog_s=0.2)
    if doing == "show":
        projector.show(3)
    else:
        projector.play(0.02, 0.04)
        bench.advance(0.1)
    pulled_ns = bench.clock.now_ns()
    bench.line.cut()
    for call in ("show", "blank"):
        with pytest.raises(DeviceGoneError, match=r"unplugged|does not exist"):
            calls(projector)[call]()
    bench.advance(1)
    assert bench.lit is None
    assert bench.scene.changes[-1].t_ns - pulled_ns <= 0.2e9 + 1_000_000
    projector.close()
    projector.close()
    with pytest.raises(DeviceStateError):
        projector.show(4)
    projector.blank()


def test_a_box_that_was_plugged_in_again_in_the_dark_goes_on(bench: Bench) -> None:
    projector = bench.loaded(watchdog_s=0.2)
    projector.show(3)
    projector.blank()
    bench.line.cut()
    with pytest.raises(DeviceGoneError, match="does not exist"):
        projector.load(SEQUENCE)
    bench.line.plug_in()
    projector.load(SEQUENCE)
    projector.show(4)
    bench.advance(2)
    assert bench.lit == 4, "its sign of life goes over the new port"


def test_a_line_that_falls_silent_is_left_to_the_watchdog(bench: Bench) -> None:
    projector = bench.loaded(watchdog_s=0.2, reply_s=0.01, deadline_s=0.1)
    projector.show(3)
    bench.line.on_command = lambda _line, _count, _data: False
    with pytest.raises(DeviceError, match="did not answer"):
        projector.show(4)
    bench.advance(0.2)
    assert bench.lit is None
    bench.line.on_command = lambda _line, _count, _data: True
    # It is not known what it does: it must be loaded again.
    with pytest.raises(DeviceStateError):
        projector.show(4)
    projector.load(SEQUENCE)
    projector.show(4)
    bench.advance(1)
    assert bench.lit == 4


def test_close_from_another_thread_ends_a_wait(bench: Bench) -> None:
    projector = bench.loaded(reply_s=5.0, deadline_s=60.0)
    projector.show(0)
    closing = threading.Thread(target=projector.close)

    def lost(_line: object, _count: int, data: bytes) -> bool:
        if b"SHOW" in data:
            closing.start()
            assert projector.client.link.closing.wait(10)
        return b"SHOW" not in data

    bench.line.on_command = lost
    with pytest.raises(DeviceStateError):
        projector.show(1)
    closing.join(10)
    assert not closing.is_alive()
    assert bench.lit is None
    bench.line.on_command = lambda _line, _count, _data: True
    bench.open()


# Other hosts, and the system's ports.


def test_a_second_host_that_gets_in_anyway_is_turned_away(bench: Bench) -> None:
    projector = bench.loaded()
    projector.show(0)
    second = BoxLink(bench.line, 0.05, 1.0, clock=bench.clock)
    begun_ns = bench.clock.now_ns()
    with pytest.raises(DeviceBusyError, match="in a session with another host"):
        BoxClient(second, BoxLimits(1000, 1000, 1000, 1000), label="x", open_s=0.5)
    assert 0.5e9 <= bench.clock.now_ns() - begun_ns <= 0.7e9
    projector.show(1)
    assert bench.patterns == [0, 1]


def test_the_session_of_a_host_that_died_is_taken_over(bench: Bench) -> None:
    dead = bench.loaded(watchdog_s=0.3)
    dead.show(1)
    # Killed: no farewell.
    dead._keep_alive.stop()
    begun_ns = bench.clock.now_ns()
    projector = bench.open()
    assert 0.1e9 <= bench.clock.now_ns() - begun_ns <= 0.5e9
    assert bench.lit is None
    projector.load(SEQUENCE)
    projector.show(2)


@pytest.fixture
def terminal() -> Any:
    line = SerialLine(CoreEngine(Scene(), description(CRC32)))
    yield line
    line.close()


def test_a_port_of_the_system_has_one_holder_and_may_be_pulled(terminal: SerialLine) -> None:
    projector = open_projector({"port": terminal.path}, Path())
    projector.load(SEQUENCE)
    projector.show(3)
    with pytest.raises(DeviceBusyError, match=r"is held by .*\(process \d+\)"):
        open_projector({"port": terminal.path}, Path())
    terminal.do(terminal.unplug)
    with pytest.raises(DeviceGoneError, match="unplugged"):
        projector.show(4)
    projector.close()


def test_bytes_that_another_program_took_first_are_no_unplug(terminal: SerialLine) -> None:
    port = SerialPort(terminal.path, baud=115_200, device="trigger box", driver="serial_projector")

    class Robbed:
        """As pyserial, told of bytes that are gone."""

        is_open, in_waiting, fileno = True, 1, port._serial.fileno

        def read(self, _count: int) -> bytes:
            raise importlib.import_module("serial").SerialException

    taken, port._serial = port._serial, Robbed()
    assert port.read(0.0) == b""
    taken.close()
    with pytest.raises(DeviceGoneError, match="unplugged"):
        port.read(0.0)


@pytest.mark.parametrize(
    ("port", "error", "words"),
    [
        ("/dev/serial/by-id/usb-none", DeviceGoneError, "does not exist"),
        ("ttyNONE", DeviceGoneError, "does not exist"),
        (__file__, DeviceError, "does not open"),
        ("nonsense://x", DeviceError, "does not open"),
    ],
)
def test_what_is_no_port_is_reported(port: str, error: type[DeviceError], words: str) -> None:
    with pytest.raises(error, match=words):
        open_projector({"port": port}, Path())
