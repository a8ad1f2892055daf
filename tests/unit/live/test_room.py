"""Who watches live depth: what each gets of it, and when its process and the rig hear of it."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from slrig.devices import CameraInfo, ProjectorInfo, Trigger
from slrig.errors import ConfigError, LiveStateError, SlrigError
from slrig.failure import job_failure
from slrig.live.process import DepthCame, GeometryCame, LiveFailed, NoDepth
from slrig.live.room import LiveOptions, LiveRoom, Viewer
from slrig.model import CameraFormat, Size
from tests.unit.live.scene import CAMERA, PROJECTOR, calibration

LEFT = CameraInfo("left", "l", "1", CameraFormat(CAMERA, 8), frozenset({Trigger.SOFTWARE}), (1e-4, 1.0), (1.0, 1.0))
BEAMER = ProjectorInfo("p", "p", "1", PROJECTOR, False, 0.0, shades=True)


class FakeProcess:
    """Stands for `LiveProcess`; `says` sends what the real one would."""

    def __init__(self, _task: object) -> None:
        self.messages, self._far = multiprocessing.Pipe()
        self.wanted: list[tuple[int, ...]] = []
        self.begun = 0

    def want(self, steps: tuple[int, ...]) -> None:
        self.wanted.append(steps)

    def begin(self) -> None:
        self.begun += 1

    def says(self, message: object) -> None:
        self._far.send(message)

    def close(self) -> None:
        # Also by two threads at once.
        with suppress(OSError):
            self._far.close()


class Watching:
    """A viewer, and how often it was notified."""

    def __init__(self, room: LiveRoom, step: int) -> None:
        self._news = threading.Semaphore(0)
        self.viewer: Viewer = room.watch(step, self._news.release)

    def notify(self) -> None:
        assert self._news.acquire(timeout=10)

    @property
    def notified_again(self) -> bool:
        return self._news.acquire(blocking=False)


@pytest.fixture
def begun(monkeypatch: pytest.MonkeyPatch) -> tuple[LiveRoom, FakeProcess]:
    made: list[FakeProcess] = []

    def make(task: object) -> FakeProcess:
        made.append(FakeProcess(task))
        return made[-1]

    monkeypatch.setattr("slrig.live.room.LiveProcess", make)
    room = LiveRoom(lambda: None)
    room.start(LiveOptions("left"), LEFT, BEAMER, calibration())
    return room, made[0]


def _came(number: int, *steps: int) -> DepthCame:
    return DepthCame(number, {step: b"%d of %d" % (number, step) for step in steps}, {})


def test_each_viewer_is_notified_once_of_its_own_and_the_slow_one_gets_the_newest(
    begun: tuple[LiveRoom, FakeProcess],
) -> None:
    room, process = begun
    fine, coarse = Watching(room, 2), Watching(room, 4)
    assert process.wanted == [(2,), (2, 4)]
    process.says(GeometryCame({2: b"rays", 4: b"few rays"}))
    for each in (fine, coarse):
        each.notify()
    assert (fine.viewer.message(-1), coarse.viewer.message(-1)) == ((0, b"rays"), (0, b"few rays"))
    for number in (1, 2):
        process.says(_came(number, 2, 4))
        fine.notify()
        assert fine.viewer.message(number - 1) == (number, b"%d of 2" % number)
    assert coarse.viewer.message(0) == (2, b"2 of 4")
    assert coarse.viewer.message(2) is None
    assert not fine.notified_again
    with coarse.viewer:
        pass
    assert process.wanted[-1] == (2,)


@pytest.mark.parametrize(
    ("found", "told"),
    [(ConfigError("nothing of it is seen"), "nothing of it is seen"), (KeyError("x"), "its process did")],
    ids=["known", "unexpected"],
)
def test_why_the_process_cannot_go_on_is_told_to_who_watches(
    begun: tuple[LiveRoom, FakeProcess], found: Exception, told: str
) -> None:
    room, process = begun
    watching = Watching(room, 1)
    process.says(LiveFailed(job_failure(found), "trace"))
    process.close()
    while room.wanted:
        watching.notify()
    with pytest.raises(SlrigError, match=told):
        watching.viewer.message(-1)


class FakeTimer:
    """Stands for `threading.Timer`: it fires when the test says so."""

    made: list[FakeTimer]
    daemon = False

    def __init__(self, _after_s: float, function: Callable[[], None]) -> None:
        self.fire = function
        self.made.append(self)

    def start(self) -> None:
        """It fires when the test says so."""

    def cancel(self) -> None:
        """As a timer that fires at that moment all the same."""


def test_only_the_time_since_the_last_viewer_left_ends_it(
    begun: tuple[LiveRoom, FakeProcess], monkeypatch: pytest.MonkeyPatch
) -> None:
    room, _ = begun
    FakeTimer.made = []
    monkeypatch.setattr("slrig.live.room.threading.Timer", FakeTimer)
    for _ in range(2):
        with Watching(room, 1).viewer:
            pass
    # Who begins anew has all the time to watch.
    room.start(LiveOptions("left"), LEFT, BEAMER, calibration())
    *earlier, last = FakeTimer.made
    for each in earlier:
        each.fire()
    assert room.status().viewers == 0
    last.fire()
    with pytest.raises(LiveStateError, match="There is no live depth"):
        room.status()


@pytest.mark.parametrize(
    ("cameras", "found"),
    [({}, "'left' is gone"), ({"left": replace(LEFT, format=CameraFormat(Size(120, 90), 8))}, "'left' gives 120")],
    ids=["gone", "another extent"],
)
def test_a_rig_that_changed_meanwhile_ends_it_and_says_so(
    begun: tuple[LiveRoom, FakeProcess], cameras: dict[str, CameraInfo], found: str
) -> None:
    room, _ = begun
    watching = Watching(room, 1)
    rig: Any = SimpleNamespace(cameras={name: SimpleNamespace(info=info) for name, info in cameras.items()})
    room.run(rig, calibration(), stop=lambda: False)
    with pytest.raises(LiveStateError, match=found):
        watching.viewer.message(-1)


def test_who_waits_learns_for_what(begun: tuple[LiveRoom, FakeProcess], monkeypatch: pytest.MonkeyPatch) -> None:
    room, process = begun
    watching = Watching(room, 1)
    assert "when the rig is free" in watching.viewer.waits_for
    said: list[str] = []

    def play(*_: object, **__: object) -> None:
        said.append(watching.viewer.waits_for)
        process.says(NoDepth("the frames came in another order"))
        watching.notify()
        said.append(watching.viewer.waits_for)
        process.says(_came(1, 1))
        watching.notify()
        said.append(watching.viewer.waits_for)

    monkeypatch.setattr("slrig.live.room.play", play)
    rig: Any = SimpleNamespace(cameras={"left": SimpleNamespace(info=LEFT)})
    room.run(rig, calibration(), stop=lambda: False)
    first, contradicted, later = said
    assert "on its way" in first
    assert contradicted == "No depth comes: the frames came in another order."
    assert later == "No depth image comes at the moment."
    assert process.begun == 1
