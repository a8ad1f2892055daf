"""The driver on a box at the end of a pseudo-terminal: light, refusals, restarts, cables, other hosts."""

from __future__ import annotations

import importlib
import json
import statistics
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from drivers.serial_port import SerialPort
from drivers.serial_projector import open_projector
from drivers.serial_projector.client import Client, Limits
from drivers.serial_projector.device import protocol
from drivers.serial_projector.frames import Mode
from drivers.serial_projector.link import Link
from drivers.serial_projector.pattern_set import crc32_of_all, crc32_of_each
from drivers.serial_projector.projector import SerialProjector
from slrig.devices import FlashedProjector
from slrig.errors import (
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    UnsupportedByDeviceError,
)
from slrig.model import PatternSequence, Size
from tests.unit.drivers.serial_projector.conftest import SEQUENCE, SIZE, Bench, whole_sequence
from tests.unit.drivers.serial_projector.engines import GAP_US, HOLD_US, LEAST_US, Scene

LONG_S = 10.0


def part(first: int, count: int) -> PatternSequence:
    return PatternSequence(SIZE, SEQUENCE.patterns[first : first + count], SEQUENCE.profiles[first : first + count])


class Watch:
    """Waits for light and darkness without a busy loop."""

    def __init__(self, scene: Scene) -> None:
        self._changed = threading.Condition()
        self._scene = scene
        scene.watch.append(self._told)

    def until(self, holds: Callable[[Scene], bool], timeout_s: float = LONG_S) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: holds(self._scene), timeout_s)

    def stays(self, holds: Callable[[Scene], bool], for_s: float) -> bool:
        """Whether it holds for so long."""
        with self._changed:
            return not self._changed.wait_for(lambda: not holds(self._scene), for_s)

    def _told(self, _pattern: int | None) -> None:
        with self._changed:
            self._changed.notify_all()


def test_it_is_dark_after_opening_and_tells_what_it_is(bench: Bench) -> None:
    projector = bench.open()
    assert bench.scene.lit is None
    status = projector.client.status()
    assert (status.state, status.index, status.shows) == ("idle", None, 0)
    info = projector.info
    assert (info.size, info.plays, info.model) == (SIZE, True, "test-box 1.0.0")
    assert info.serial == bench.line.path
    assert info.latency_s == 0.003


def test_show_tells_when_its_light_came(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(drift=80e-6)
    projector = bench.open()
    projector.load(SEQUENCE)
    shown = []
    for index in range(26):
        shown.append(projector.show(index))
        assert time.monotonic_ns() >= shown[-1].t_visible_ns + shown[-1].t_err_ns
        assert bench.scene.lit == index
    changes = [change for change in bench.scene.changes if change.pattern is not None]
    assert [change.pattern for change in changes] == list(range(26))
    for each, change in zip(shown, changes, strict=True):
        assert each.t_visible_ns - change.t_ns >= -200_000
        assert change.t_ns <= each.t_visible_ns + each.t_err_ns
    # The engine notes its change just before the box reads its clock, and a busy machine may halt it there.
    late_ns = [each.t_visible_ns - change.t_ns - each.t_err_ns for each, change in zip(shown, changes, strict=True)]
    assert statistics.median(late_ns) <= 5_000_000
    assert min(each.t_err_ns for each in shown) < 5_000_000


def test_a_play_lights_every_pattern_once_and_pulses_the_cameras(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.play(0.004, 0.008)
    watch.until(lambda scene: len(scene.shown) == 26 and scene.lit is None)
    assert [pattern for pattern, _ in bench.scene.shown] == list(range(26))
    assert len(bench.scene.pulses_ns) == 26
    for pulse_ns, (on, off) in zip(
        bench.scene.pulses_ns, zip(bench.scene.changes[0::2], bench.scene.changes[1::2], strict=True), strict=True
    ):
        assert on.t_ns <= pulse_ns
        assert off.t_ns - pulse_ns >= 4_000_000, "lit for the whole exposure"
    status = projector.client.status()
    assert (status.state, status.index) == ("ready", 25)
    projector.stop()
    played = projector.played
    assert [each.index for each in played] == list(range(26))
    for each, on in zip(played, bench.scene.changes[0::2], strict=True):
        assert on.t_ns <= each.t_visible_ns + each.t_err_ns


def test_a_play_that_is_stopped_is_dark_and_another_one_begins_at_the_beginning(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.play(0.004, 0.04)
    watch.until(lambda scene: len(scene.shown) == 3)
    projector.stop()
    assert bench.scene.lit is None
    assert len(bench.scene.shown) == 3
    projector.load(part(0, 4))
    projector.play(0.004, 0.008)
    watch.until(lambda scene: len(scene.shown) == 7 and scene.lit is None)
    assert [pattern for pattern, _ in bench.scene.shown] == [0, 1, 2, 0, 1, 2, 3]


def test_patterns_can_be_stepped_by_trigger(either_bench: Bench) -> None:
    client = either_bench.open().client
    assert client.load(crc32_of_each(SEQUENCE)[8:11]) == ()
    client.sequence(0, 3, 4_000, 8_000, Mode.STEP)
    watch = Watch(either_bench.scene)
    for index in range(3):
        t_ns, error_ns = client.trigger(index)
        watch.until(lambda scene, lit=2 * index + 2: len(scene.changes) >= lit)  # type: ignore[misc]
        assert abs(t_ns - either_bench.scene.changes[2 * index].t_ns) <= error_ns + 20_000_000
    assert [pattern for pattern, _ in either_bench.scene.shown] == [8, 9, 10]


@pytest.mark.parametrize(("first", "count"), [(0, 26), (0, 2), (2, 14), (24, 2)])
def test_any_run_of_what_is_flashed_can_be_shown(bench: Bench, first: int, count: int) -> None:
    projector = bench.open()
    projector.load(part(first, count))
    # White and black come twice: the first run that fits is taken.
    flashed = 0 if (first, count) == (24, 2) else first
    for index in (0, count - 1):
        projector.show(index)
        assert bench.scene.lit == flashed + index


def backwards() -> PatternSequence:
    return PatternSequence(SIZE, SEQUENCE.patterns[::-1], SEQUENCE.profiles[::-1])


def test_patterns_are_shown_in_any_order_and_as_often_as_asked_for(either_bench: Bench) -> None:
    projector = either_bench.open()
    projector.load(PatternSequence(SIZE, SEQUENCE.patterns[::-1] * 2, SEQUENCE.profiles[::-1] * 2))
    for index in (0, 3, 51, 26):
        projector.show(index)
    # White and black come twice in the flash, too: the first place is taken.
    assert [pattern for pattern, _ in either_bench.scene.shown] == [1, 22, 0, 1]


def test_a_box_of_old_firmware_takes_runs_and_nothing_else(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(protocol, "MOST_PICKED", 0)
    projector = bench.open()
    assert projector.client.box.pick == 0
    projector.load(part(2, 14))
    projector.show(0)
    assert bench.scene.lit == 2
    with pytest.raises(UnsupportedByDeviceError, match=r"runs of its flash only.*slrig patterns"):
        projector.load(backwards())


def test_patterns_that_are_not_flashed_are_refused_dark_and_nothing_is_written(bench: Bench, tmp_path: Path) -> None:
    projector = bench.open(tmp_path)
    projector.load(SEQUENCE)
    projector.show(0)
    wider = whole_sequence(SIZE, line_width_px=2)
    with pytest.raises(UnsupportedByDeviceError, match=r"it lacks 8 of them, pattern 12 the first\..*slrig patterns"):
        projector.load(wider)
    assert bench.scene.lit is None
    with pytest.raises(DeviceStateError, match="no sequence is loaded"):
        projector.show(0)
    assert list(tmp_path.iterdir()) == []


def test_each_set_of_patterns_is_written_into_a_folder_of_its_own(bench: Bench, tmp_path: Path) -> None:
    projector = bench.open(tmp_path)
    assert isinstance(projector, FlashedProjector)
    told = [projector.write_patterns(each) for each in (SEQUENCE, backwards(), SEQUENCE)]
    first, second = (crc32_of_all(crc32_of_each(each)) for each in (SEQUENCE, backwards()))
    assert {folder.name for folder in (tmp_path / "patterns").iterdir()} == {f"{first:08X}", f"{second:08X}"}
    folder = tmp_path / "patterns" / f"{second:08X}"
    assert str(folder) in told[1]
    description = json.loads((folder / "patterns.json").read_text())
    assert description["size_px"] == [400, 300]
    assert [int(each, 16) for each in description["crc32"]] == list(crc32_of_each(backwards()))
    for index in (0, 7, 25):
        image = cv2.imread(str(folder / f"{index:03d}.png"), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert np.array_equal(image, backwards().image(index))
    with pytest.raises(UnsupportedByDeviceError, match="shows 400 x 300"):
        projector.write_patterns(whole_sequence(Size(408, 300)))


def test_a_sequence_of_another_size_is_refused(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    with pytest.raises(UnsupportedByDeviceError, match="shows 400 x 300, the sequence was made for 408 x 300"):
        projector.load(whole_sequence(Size(408, 300)))
    assert bench.scene.lit is None


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
    projector = bench.open(max_on_s=0.8, max_duty=0.6)
    projector.load(SEQUENCE)
    with pytest.raises(UnsupportedByDeviceError, match=found):
        projector.play(exposure_s, period_s)
    assert bench.scene.shown == []


def test_brightness_that_the_box_cannot_keep_is_refused(bench: Bench) -> None:
    bench.core.light.dims = False
    with pytest.raises(UnsupportedByDeviceError, match="cannot dim"):
        bench.open(brightness=0.5)
    bench.core.light.dims = True
    bench.open(brightness=0.5)
    assert bench.core.light.bright == 500


def test_options_are_checked_all_at_once() -> None:
    with pytest.raises(ConfigError) as told:
        open_projector({"port": "", "baud": 1, "watchdog": 1.0, "max_duty": 2.0}, Path())
    assert all(each in str(told.value) for each in ("port", "baud", "did you mean 'watchdog_s'?", "max_duty"))


def test_the_light_stays_for_as_long_as_the_host_lives(bench: Bench) -> None:
    # Long enough for a busy machine to come to the sign of life in time.
    projector = bench.open(watchdog_s=0.5)
    projector.load(SEQUENCE)
    projector.show(1)
    watch = Watch(bench.scene)
    assert watch.stays(lambda scene: scene.lit is not None, 1.5)
    projector.show(2)


def test_without_its_sign_of_life_the_box_goes_dark_and_the_next_show_says_so(bench: Bench) -> None:
    projector = bench.open(watchdog_s=0.1)
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.show(1)
    # The host is too busy: its thread does not come to it.
    projector._keeping.stop()
    watch.until(lambda scene: scene.lit is None)
    lit, dark = bench.scene.changes
    assert 0.09 <= (dark.t_ns - lit.t_ns) / 1e9 <= 0.4
    with pytest.raises(DeviceError, match="watchdog_s"):
        projector.show(2)
    assert bench.scene.lit is None
    projector.show(2)


def test_a_pattern_that_nobody_changes_goes_out(bench: Bench) -> None:
    projector = bench.open(max_on_s=0.1)
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.show(1)
    watch.until(lambda scene: scene.lit is None)
    with pytest.raises(DeviceError, match="max_on_s"):
        projector.show(2)


def test_an_engine_that_fails_is_an_error_and_dark(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    bench.core.light.broken = {"select"}
    with pytest.raises(DeviceError, match="select failed"):
        projector.show(1)
    assert bench.scene.lit is None
    bench.core.light.broken = set()
    projector.show(1)


def test_show_while_a_sequence_plays_is_refused_and_dark(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.play(0.05, 0.2)
    with pytest.raises(DeviceStateError, match="stop what it does first"):
        projector.show(1)
    assert bench.scene.lit is None


# Restarts and cables.


def test_a_box_that_restarts_in_the_dark_is_loaded_again(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    bench.line.do(bench.line.restart)
    assert projector.show(3).index == 3
    assert bench.scene.shown == [(3, 2)]
    projector.blank()
    bench.line.do(bench.line.restart)
    watch = Watch(bench.scene)
    projector.play(0.004, 0.008)
    watch.until(lambda scene: len(scene.shown) == 27 and scene.lit is None)


@pytest.mark.parametrize("call", ["show", "play", "blank", "stop"])
def test_a_box_that_restarts_while_it_is_lit_is_gone(bench: Bench, call: str) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    projector.show(3)
    bench.line.do(bench.line.restart)
    calls: dict[str, Callable[[], object]] = {
        "show": lambda: projector.show(4),
        "play": lambda: projector.play(0.004, 0.008),
        "blank": projector.blank,
        "stop": projector.stop,
    }
    with pytest.raises(DeviceGoneError, match=r"restarted \(boot 00000001, now 00000002\) while pattern 3 was lit"):
        calls[call]()
    assert bench.scene.lit is None
    projector.close()
    again = bench.open()
    again.load(SEQUENCE)
    again.show(4)


def test_a_box_that_restarts_while_it_plays_is_gone(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.play(0.02, 0.05)
    watch.until(lambda scene: len(scene.shown) == 3)
    bench.line.do(bench.line.restart)
    assert bench.scene.lit is None
    with pytest.raises(DeviceGoneError, match="while a sequence played"):
        projector.stop()
    assert len(bench.scene.shown) <= 4


def test_a_box_that_takes_time_to_start_is_waited_for(make_bench: Callable[..., Bench]) -> None:
    bench = make_bench(boot_s=0.5)
    bench.line.do(bench.line.restart)
    projector = bench.open(open_s=5.0)
    projector.load(SEQUENCE)
    projector.show(0)


def test_another_box_behind_the_same_port_is_refused(bench: Bench) -> None:
    projector = bench.open()
    projector.load(SEQUENCE)

    def swap() -> None:
        bench.core._about.width_px = 640
        bench.line.restart()

    bench.line.do(swap)
    with pytest.raises(DeviceGoneError, match="projects 640 x 300 instead of 400 x 300"):
        projector.show(0)


@pytest.mark.parametrize("doing", ["show", "play"])
def test_a_cable_that_is_pulled_ends_in_darkness(bench: Bench, doing: str) -> None:
    projector = bench.open(watchdog_s=0.2)
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    if doing == "show":
        projector.show(3)
    else:
        projector.play(0.02, 0.04)
        watch.until(lambda scene: len(scene.shown) == 3)
    pulled_ns = time.monotonic_ns()
    bench.line.do(bench.line.unplug)
    with pytest.raises(DeviceGoneError, match="unplugged"):
        projector.show(4)
    with pytest.raises(DeviceGoneError):
        projector.blank()
    shown = len(bench.scene.shown)
    # Between two patterns of a play it is dark for 0.02 s.
    while not watch.stays(lambda scene: scene.lit is None, 0.1):
        assert len(bench.scene.shown) <= shown + 10
        watch.until(lambda scene: scene.lit is None)
    assert bench.scene.changes[-1].t_ns - pulled_ns < 0.2e9 + 0.3e9
    assert len(bench.scene.shown) <= shown + 10
    projector.close()
    projector.close()
    with pytest.raises(DeviceStateError):
        projector.show(4)
    projector.blank()


def test_a_box_that_was_plugged_in_again_in_the_dark_goes_on(bench: Bench, tmp_path: Path) -> None:
    port = tmp_path / "port"
    port.symlink_to(bench.line.path)
    projector = bench.open(port=str(port), watchdog_s=0.2)
    projector.load(SEQUENCE)
    projector.show(3)
    projector.blank()
    bench.line.do(bench.line.unplug)
    with pytest.raises(DeviceGoneError, match="there is none such"):
        projector.load(SEQUENCE)
    bench.line.do(bench.line.plug_in)
    port.unlink()
    port.symlink_to(bench.line.path)
    projector.load(SEQUENCE)
    projector.show(4)
    watch = Watch(bench.scene)
    assert watch.stays(lambda scene: scene.lit == 4, 0.5), "its sign of life goes over the new port"


def test_a_line_that_falls_silent_is_left_to_the_watchdog(make_bench: Callable[..., Bench]) -> None:
    cut = threading.Event()
    bench = make_bench(on_command=lambda _line, _count, _data: not cut.is_set())
    projector = bench.open(watchdog_s=0.2, reply_s=0.01, deadline_s=0.1)
    projector.load(SEQUENCE)
    watch = Watch(bench.scene)
    projector.show(3)
    cut.set()
    with pytest.raises(DeviceError, match="found no answer"):
        projector.show(4)
    watch.until(lambda scene: scene.lit is None)
    cut.clear()
    # Nobody knows what it does: it must be loaded again.
    with pytest.raises(DeviceStateError):
        projector.show(4)
    projector.load(SEQUENCE)
    projector.show(4)
    assert watch.stays(lambda scene: scene.lit is not None, 0.6)


# Other hosts.


def test_a_second_host_cannot_open_the_port(bench: Bench) -> None:
    bench.open()
    with pytest.raises(DeviceBusyError, match=r"is held by .*\(process \d+\)"):
        bench.open()


def test_a_second_host_that_gets_in_anyway_is_turned_away(bench: Bench) -> None:
    projector = bench.open(reply_s=0.05)
    projector.load(SEQUENCE)
    outcome: list[BaseException] = []

    def intrude() -> None:
        # Where the other host takes what was about to be read, pyserial takes the port for gone.
        for _ in range(20):
            try:
                Client(
                    Link(Unlocked(bench.line.path), 0.05, 1.0), Limits(1000, 1000, 1000, 1000), label="x", open_s=0.5
                )
            except DeviceBusyError as error:
                outcome.append(error)
                return
            except DeviceGoneError:
                continue
            return

    intruder = threading.Thread(target=intrude)
    intruder.start()
    shown: list[int] = []
    while intruder.is_alive():
        # Each reads what is meant for the other; the answer comes again.
        shown.append(projector.show(len(shown) % 26).index)
    intruder.join()
    assert len(outcome) == 1
    assert "in a session with another host" in str(outcome[0])
    assert [pattern for pattern, _ in bench.scene.shown] == shown


class Unlocked(SerialPort):
    """A program that does not ask whether somebody has the port."""

    def __init__(self, path: str) -> None:
        self._name, self._device, self._driver = path, "trigger box", "serial_projector"
        self._serial = importlib.import_module("serial").Serial(path, timeout=0.02, exclusive=False)


def test_the_session_of_a_host_that_died_is_taken_over(bench: Bench) -> None:
    dead = bench.open(watchdog_s=0.3)
    dead.load(SEQUENCE)
    dead.show(1)
    # Killed: no farewell, and the system closes its port.
    dead._keeping.stop()
    dead._client.link.port.close()
    begun_s = time.monotonic()
    projector = bench.open()
    assert 0.1 <= time.monotonic() - begun_s <= 2
    assert bench.scene.lit is None
    projector.load(SEQUENCE)
    projector.show(2)


def test_no_box_at_all_is_told(bench: Bench) -> None:
    bench.line.do(lambda: setattr(bench.line, "_on_command", lambda _line, _count, _data: False))
    with pytest.raises(DeviceError, match=r"nothing on .* answered as a trigger box that speaks SLTP/1"):
        bench.open(open_s=0.3)


@pytest.mark.parametrize("port", ["/dev/serial/by-id/usb-none", "ttyNONE"])
def test_a_port_that_is_not_there_is_told(port: str) -> None:
    with pytest.raises(DeviceGoneError, match="there is none such"):
        open_projector({"port": port}, Path())


def test_what_is_no_port_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DeviceError, match="does not open"):
        open_projector({"port": str(tmp_path / "file")}, Path())
    with pytest.raises(DeviceError, match="does not open"):
        open_projector({"port": "nonsense://x"}, Path())


def test_close_from_another_thread_ends_a_wait(make_bench: Callable[..., Bench]) -> None:
    stuck, cut = threading.Event(), threading.Event()

    def on_command(_line: object, _count: int, data: bytes) -> bool:
        if cut.is_set() and b"SHOW" in data:
            stuck.set()
            return False
        return True

    bench = make_bench(on_command=on_command)
    projector = bench.open(reply_s=5.0, deadline_s=60.0)
    projector.load(SEQUENCE)
    projector.show(0)
    cut.set()
    raised: list[BaseException] = []

    def show() -> None:
        try:
            projector.show(1)
        except DeviceStateError as error:
            raised.append(error)

    owner = threading.Thread(target=show)
    owner.start()
    assert stuck.wait(LONG_S)
    projector.close()
    owner.join(LONG_S)
    assert not owner.is_alive()
    assert len(raised) == 1
    assert bench.scene.lit is None
    bench.open()


def test_everything_after_close_is_refused_or_nothing(bench: Bench) -> None:
    projector: SerialProjector = bench.open()
    projector.load(SEQUENCE)
    projector.show(0)
    info = projector.info
    projector.close()
    assert bench.scene.lit is None
    for call in (
        lambda: projector.load(SEQUENCE),
        lambda: projector.show(0),
        lambda: projector.play(0.01, 0.02),
    ):
        with pytest.raises(DeviceStateError, match="closed"):
            call()
    projector.stop()
    projector.blank()
    projector.close()
    assert projector.info == info
