"""Pictures while the rig is idle, of a rig in memory."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slrig.devices import Rig
from slrig.errors import CameraNotFoundError, DeviceBusyError, DeviceError, DeviceGoneError, RigBusyError
from slrig.rig.preview import Light, Picture, Previews, Watch
from slrig.rig.session import RigSession
from tests.unit.capture.fake_rig import CameraFaults, Scene, fake_rig
from tests.unit.scan.bench import Bench
from tests.unit.scan.fakes import WAIT_S, TameProjector


class Room:
    """Previews of a rendered rig, on a thread of their own until the test ends."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.stopped = threading.Event()
        self.previews = Previews(lambda: None)
        self.error: Exception | None = None
        self._thread: threading.Thread | None = None

    def run(self) -> None:
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        try:
            self.previews.run(self.rig, stop=self.stopped.is_set)
        except DeviceError as error:
            self.error = error

    def join(self) -> None:
        assert self._thread is not None
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


def next_of(watch: Watch, after: int = 0) -> Picture:
    picture = watch.picture(after, WAIT_S)
    assert picture is not None
    return picture


def test_pictures_follow_one_another_and_the_light_that_is_asked_for() -> None:
    fake = fake_rig()
    # A camera of 12 bits is shown in eight.
    fake.cameras["right"].scene = Scene(bit_depth=12)
    room = Room(fake.rig)
    with room.previews.watch("left", Light.OFF) as dark, room.previews.watch("right", Light.OFF) as other:
        room.run()
        first = next_of(dark)
        assert (first.image.shape, first.image.dtype) == ((150, 200), np.dtype(np.uint8))
        assert next_of(dark, first.number).number > first.number
        assert next_of(other).image.dtype == np.uint8
        with room.previews.watch("left", Light.WHITE) as lit:
            now = next_of(dark).number
            # One picture may have been under way when the light was asked for.
            assert next_of(lit, now + 1).image.mean() > 4 * first.image.mean()
            assert fake.projector.lit
        now = next_of(dark).number
        assert next_of(dark, now + 1).image.mean() < 1.5 * first.image.mean()
    # When the last has left, it ends by itself.
    room.join()
    assert room.error is None
    assert fake.at_rest


def test_a_job_that_wants_the_rig_gets_it_dark_and_disarmed() -> None:
    fake = fake_rig()
    room = Room(fake.rig)
    with room.previews.watch("left", Light.WHITE) as watch:
        room.run()
        next_of(watch)
        room.stopped.set()
        room.previews.interrupt()
        room.join()
        assert fake.at_rest
        assert room.previews.wanted


def test_a_device_that_goes_away_ends_the_looking_and_says_why() -> None:
    room = Room(fake_rig(faults={"left": CameraFaults(unplug_at=2)}).rig)
    with room.previews.watch("left", Light.OFF) as watch:
        room.run()
        room.join()
        assert isinstance(room.error, DeviceGoneError)
        room.previews.fail(room.error)
        with pytest.raises(DeviceGoneError):
            watch.picture(99, WAIT_S)
    assert not room.previews.wanted


def test_no_picture_comes_while_nobody_takes_any() -> None:
    previews = Previews(lambda: None)
    with previews.watch("left", Light.OFF) as watch:
        assert watch.picture(0, 0.0) is None


def test_a_scan_goes_first_and_pictures_go_on_after_it(tmp_path: Path) -> None:
    """On the runner: looking is refused while a scan holds the rig, and yields to one that comes."""
    bench = Bench(tmp_path)
    # The tame capture asks nothing of these cameras, and lights the tame projector.
    rig = replace(fake_rig().rig, projector=TameProjector())
    bench.runner.queue.rig = RigSession("bench", lambda: rig)
    bench.runner.start()
    try:
        bench.until(bench.scan().id)
        with pytest.raises(CameraNotFoundError, match="left, right"):
            bench.runner.queue.watch("middle", Light.OFF)
        with bench.runner.queue.watch("left", Light.OFF) as watch:
            seen = next_of(watch).number
            held = bench.held()
            with pytest.raises(RigBusyError, match=str(held.id)):
                bench.runner.queue.watch("left", Light.OFF)
            stood = next_of(watch).number
            assert watch.picture(stood, 0.0) is None
            bench.gate.set()
            bench.until(held.id)
            assert next_of(watch, max(seen, stood)).number > stood
    finally:
        bench.close()


def test_before_the_rig_is_open_there_is_nothing_to_see(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        with pytest.raises(DeviceBusyError, match="being opened"):
            bench.runner.queue.watch("cam0", Light.OFF)
    finally:
        bench.close()
