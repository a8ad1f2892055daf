"""Devices of a rig: guarded calls, pictures while it is idle, and the count of a table that keeps its zero."""

from __future__ import annotations

import errno
import math
import re
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from structlog.testing import capture_logs

from slrig import failure
from slrig.devices import (
    AppliedSettings,
    CallLimits,
    CameraSettings,
    DisplayedPattern,
    Rig,
    Trigger,
    TurntableBase,
    progress_reporter,
)
from slrig.errors import (
    CameraNotFoundError,
    ConfigError,
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    DriverBrokenError,
    FrameTimeoutError,
    SlrigError,
    StorageError,
    UnsupportedByDeviceError,
)
from slrig.failure import LastingThread
from slrig.model import Frame, RotationAxis
from slrig.rig.preview import Light, Picture, Previews, Watch
from slrig.rig.session import FROM_THE_START, CountedTurntable, RigSession
from slrig.rig.watchdog import (
    MOVE_LIMIT_S,
    OPEN,
    Call,
    Calls,
    GuardedPositioner,
    GuardedTurntable,
    SettingsInUse,
    Watchdog,
    guarded,
)
from tests.unit.capture.fake_rig import CameraFaults, Scene, fake_rig
from tests.unit.scan.bench import Bench
from tests.unit.scan.fakes import WAIT_S, TameBench, TameCamera, TameProjector, tame_calibration


def failing(error: BaseException) -> Callable[[], None]:
    def call() -> None:
        raise error

    return call


@pytest.mark.parametrize(
    ("raised", "kind", "text", "in_doubt"),
    [
        (DeviceGoneError("no answer"), DeviceGoneError, r"^no answer \(camera 'left', in read\)$", True),
        (DeviceStateError("armed"), DeviceStateError, r"^armed \(camera 'left', in read\)$", True),
        (UnsupportedByDeviceError("long"), UnsupportedByDeviceError, r"^long \(camera 'left', in read\)$", False),
        (FrameTimeoutError("no frame"), FrameTimeoutError, r"^no frame$", False),
        (ConfigError("no key"), ConfigError, r"^no key$", False),
        (
            OSError(errno.EBUSY, "busy"),
            DeviceBusyError,
            r"^camera 'left' is held .*in read: \[Errno 16\].*end that",
            True,
        ),
        (
            OSError(errno.ENODEV, "gone"),
            DeviceGoneError,
            r"^camera 'left' is gone \(in read: .*plug it in, then scan",
            True,
        ),
        (OSError(errno.EIO, "bad"), DeviceError, r"^camera 'left' failed in read: \[Errno 5\] bad; check cable", True),
        (
            IndexError("5"),
            DriverBrokenError,
            r"^camera 'left': its driver failed in read \(IndexError: 5\).*maintainer",
            True,
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Exception) else "",
)
def test_error_says_which_device_which_call_and_what_to_do_and_is_noted_if_the_device_is_in_doubt(
    raised: Exception, kind: type[SlrigError], text: str, in_doubt: bool
) -> None:
    calls = Calls()
    with capture_logs(), pytest.raises(SlrigError, match=text) as caught:
        calls.make("camera 'left'", "read", 1.0, failing(raised))
    assert type(caught.value) is kind
    assert (calls.failure is not None) == in_doubt


def test_error_is_placed_once_and_not_where_the_call_that_opens_names_the_device() -> None:
    error, calls = DeviceGoneError("no answer"), Calls()
    for _ in range(2):
        with pytest.raises(DeviceGoneError):
            calls.make("projector 'p'", "blank", 1.0, failing(error))
    assert str(error) == "no answer (projector 'p', in blank)"
    with pytest.raises(DeviceGoneError, match=r"^no camera on usb-3$"):
        calls.make("rig 'bench'", OPEN, 1.0, failing(DeviceGoneError("no camera on usb-3")))


def test_call_is_given_up_at_the_second_look_and_raises_when_it_returns() -> None:
    now_s = [100.0]
    calls = Calls(now_s=lambda: now_s[0])
    found: list[Call | None] = []

    def slow() -> int:
        found.append(calls.overdue())
        now_s[0] += 9.1
        # One look may find a process that was stopped for a while, and goes on now.
        found.extend(calls.overdue() for _ in range(3))
        assert calls.stuck is found[2]
        return 1

    with pytest.raises(DeviceError, match=r"camera 'left': its driver has not come back from read for 9 s.*restart"):
        calls.make("camera 'left'", "read", 9.0, slow)
    assert [call is not None for call in found] == [False, False, True, False]
    assert calls.stuck is None
    assert calls.overdue() is None
    assert calls.failure is not None


def test_a_call_that_tells_how_far_it_is_is_not_hung() -> None:
    now_s = [100.0]
    calls = Calls(now_s=lambda: now_s[0])
    shown: list[str] = []
    overdue: list[Call | None] = []

    def opening() -> None:
        tell = progress_reporter()
        for share in ("10 %", "60 %", "90 %"):
            now_s[0] += 50.0
            overdue.extend((calls.overdue(), calls.overdue()) if share == "90 %" else (calls.overdue(),))
            tell(f"tracing light, {share}")
            shown.append(calls.doing)

    calls.make("rig 'demo'", OPEN, 60.0, opening)
    assert overdue == [None, None, None, None]
    assert shown == ["tracing light, 10 %", "tracing light, 60 %", "tracing light, 90 %"]
    assert calls.doing == ""
    # Nobody listens outside of a call.
    progress_reporter()("nothing")


def test_limits_are_those_that_a_device_declares_and_nothing_computed_is_unplugged() -> None:
    now_s = [100.0]
    calls = Calls(now_s=lambda: now_s[0])
    camera = TameCamera()
    camera.info = replace(camera.info, limits=CallLimits(call_s=200.0, read_slack_s=90.0, computed=True))
    found: list[Call | None] = []

    def slow(*_: object) -> None:
        for seconds in (91.0, 2.0):
            now_s[0] += seconds
            found.append(calls.overdue())
            found.append(calls.overdue())

    camera.read = slow  # type: ignore[assignment, method-assign]
    rig = guarded(Rig("bench", {"cam0": camera}, TameProjector(), {}), calls, {})
    with pytest.raises(DeviceError) as told:
        rig.cameras["cam0"].read(0, 1.0)
    assert [call is not None for call in found] == [False, False, False, True]
    assert "restart the service" in str(told.value)
    assert "plug" not in str(told.value)
    with pytest.raises(DeviceError, match="check its files") as refused:
        calls.make("camera 'cam0'", "read", 1.0, failing(OSError(errno.EIO, "bad")), computed=True)
    assert "cable" not in str(refused.value)


def test_watchdog_barks_once_for_each_call_that_hangs() -> None:
    now_s = [100.0]
    calls = Calls(now_s=lambda: now_s[0])
    barked: list[str] = []
    heard = threading.Event()

    def on_hang(call: Call) -> None:
        barked.append(f"{call.device} {call.step}")
        heard.set()

    def hang() -> None:
        now_s[0] += 2.0
        assert heard.wait(WAIT_S)

    dog = Watchdog(calls, on_hang, check_s=0.001)
    dog.start()
    for step in ("show", "blank"):
        heard.clear()
        with pytest.raises(DeviceError, match=f"not come back from {step}"):
            calls.make("projector 'p'", step, 1.0, hang)
    dog.stop()
    assert barked == ["projector 'p' show", "projector 'p' blank"]


def test_a_loop_that_an_error_ends_is_begun_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(failure, "_RESTART_S", 0.0)
    begun: list[int] = []

    def loop() -> None:
        begun.append(1)
        if len(begun) < 4:
            raise (SystemExit(3), GeneratorExit(), ValueError("\udcff"))[len(begun) - 1]

    thread = LastingThread(loop, "slrig-test")
    with capture_logs() as logs:
        thread.start()
        thread.join(WAIT_S)
    assert (thread.is_alive(), thread.daemon, len(begun)) == (False, True, 4)
    assert [(line["event"], line["thread"]) for line in logs] == [
        ("a loop ended by an error, and is restarted", "slrig-test")
    ] * 3


def test_every_call_of_a_device_is_guarded(monkeypatch: pytest.MonkeyPatch) -> None:
    camera, projector, calls = TameCamera(), TameProjector(), Calls()
    made: list[str] = []
    real = calls.make

    def make(
        device: str, step: str, limit_s: float, function: Callable[[], object], *, computed: bool = False
    ) -> object:
        made.append(f"{device} {step}")
        return real(device, step, limit_s, function, computed=computed)

    monkeypatch.setattr(calls, "make", make)
    rig = guarded(Rig("bench", {"cam0": camera}, projector, {}), calls, {})
    eye = rig.cameras["cam0"]
    assert (eye.info, rig.projector.info) == (camera.info, projector.info)
    assert eye.configure(CameraSettings(0.01)).exposure_s == 0.01
    assert rig.projector.show(3).index == 3
    refused: list[Callable[[], object]] = [
        lambda: eye.arm(1, Trigger.FREE),
        eye.trigger,
        lambda: eye.read(0, 1.0),
        eye.disarm,
        lambda: rig.projector.play(0.1, 0.2),
    ]
    for call in refused:
        with capture_logs(), pytest.raises(DriverBrokenError):
            call()
    rig.projector.stop()
    assert rig.close() == ()
    steps = ["info", "configure", "arm", "trigger", "read", "disarm"]
    assert [step for step in made if "camera" in step] == [f"camera 'cam0' {step}" for step in [*steps, "close"]]
    shown = ["show", "play", "stop", "blank", "close"]
    assert [step for step in made if "projector" in step] == [
        "projector info",
        *(f"projector 'projector' {step}" for step in shown),
    ]


class WordlessError(Exception):
    """An error that has no text."""

    def __str__(self) -> str:
        raise SystemExit(3)


class WordlessDeviceError(DeviceError):
    """One of slrig's tree, of a driver's own class."""

    def __str__(self) -> str:
        raise SystemExit(3)


@pytest.mark.parametrize(
    ("raised", "words"),
    [
        (SystemExit(3), "SystemExit: 3"),
        (KeyboardInterrupt(), "KeyboardInterrupt: )"),
        (GeneratorExit(), "GeneratorExit: )"),
        (RuntimeError("/dev/cam\udcff\x1b[2J"), "RuntimeError: /dev/cam\\udcff\\u001b[2J)"),
        (WordlessError(), "WordlessError: WordlessError)"),
        (ValueError("x" * 10**6), " …)"),
        (OSError(["no number"], "odd\udcff"), "odd\\udcff; check"),
        (WordlessDeviceError(WordlessError()), "WordlessDeviceError"),
        (DeviceError("/dev/cam\udcff"), "/dev/cam\\udcff (camera 'cam0', in read)"),
    ],
    ids=lambda each: type(each).__name__,
)
def test_whatever_a_driver_raises_is_an_error_of_the_device_in_words(raised: BaseException, words: str) -> None:
    calls = Calls()
    with capture_logs(), pytest.raises(DeviceError) as told:
        calls.make("camera 'cam0'", "read", 1.0, failing(raised))
    text = str(told.value)
    assert words in text
    assert len(text) < 3000
    text.encode("utf-8")
    assert calls.failure is told.value


@pytest.mark.parametrize(
    ("step", "returned", "words"),
    [
        ("read", None, "returned None, a Frame is expected"),
        ("read", {"t_start_ns": 5, "t_end_ns": 4}, "from 5 to 4 ns"),
        ("read", {"t_err_ns": -5}, "± -5"),
        ("read", {"dropped_count": 2**40}, f"{2**40} lost before"),
        ("read", {"t_end_ns": math.inf}, "to inf ns"),
        ("read", {"t_start_ns": 0, "t_end_ns": 10**30}, "from 0 to 1000000000000000000000000000000 ns"),
        ("read", {"t_end_ns": 2**61}, "times of another clock"),
        ("read", {"camera": "cam1"}, "camera 'cam0' returned a frame of camera 'cam1'"),
        ("read", {"exposure_s": math.nan}, "an exposure of nan"),
        ("read", {"gain": "high"}, "a gain of 'high'"),
        ("read", {"image": np.zeros((2, 2), np.uint64)}, "(2, 2) uint64"),
        ("read", {"image": np.zeros((0, 2), np.uint8)}, "(0, 2) uint8"),
        ("read", {"colour": 5}, "colour cannot be called"),
        ("configure", 3, "returned 3, a AppliedSettings is expected"),
        ("configure", AppliedSettings(math.inf, 1.0), "an exposure of inf"),
        ("configure", AppliedSettings(0.01, math.nan), "a gain of nan"),
        ("info", None, "returned None, a CameraInfo is expected"),
        ("info", {"exposure_range_s": (2.0, 1.0)}, "an exposure of 1.0"),
        ("info", {"triggers": frozenset()}, "without any trigger"),
        ("info", {"limits": CallLimits(math.nan)}, "a time limit of nan"),
        ("info", {"serial": 5}, "returned 5, a str is expected"),
        ("show", DisplayedPattern(7, 0, 0), "requested pattern 3"),
        ("show", DisplayedPattern(3, 2**61, 0), "times of another clock"),
        ("show", DisplayedPattern(3, 0, 2**61), "times of another clock"),
    ],
    ids=str,
)
def test_values_that_no_device_has_are_a_defect_of_the_driver(step: str, returned: Any, words: str) -> None:
    camera, projector = TameCamera(), TameProjector()
    frame = Frame("cam0", np.zeros((2, 2), np.uint8), 0, 1, 0, 1, 0, 0.01, 1.0)
    right: Any = camera.info if step == "info" else frame
    value = replace(right, **returned) if isinstance(returned, dict) else returned
    device = projector if step == "show" else camera
    setattr(device, step, value if step == "info" else lambda *_: value)

    def used() -> None:
        rig = guarded(Rig("bench", {"cam0": camera}, projector, {}), Calls(), {})
        eye = rig.cameras["cam0"]
        calls: dict[str, Callable[[], object]] = {
            "read": lambda: eye.read(0, 1.0),
            "configure": lambda: eye.configure(CameraSettings(0.01)),
            "show": lambda: rig.projector.show(3),
        }
        calls[step]()

    with capture_logs(), pytest.raises(DriverBrokenError, match=re.escape(words)):
        used()


def test_colour_of_a_frame_is_asked_for_by_way_of_the_calls() -> None:
    camera = TameCamera()
    answers: list[object] = [np.zeros((2, 2, 3), np.uint8), None]
    image = np.zeros((2, 2), np.uint8)
    frame = Frame("cam0", image, 0, 1, 0, 1, 0, 0.01, 1.0, colour=lambda: answers.pop(0))  # type: ignore[arg-type, return-value]
    camera.read = lambda *_: frame  # type: ignore[method-assign]
    colour = (
        guarded(Rig("bench", {"cam0": camera}, TameProjector(), {}), Calls(), {}).cameras["cam0"].read(0, 1.0).colour
    )
    assert colour is not None
    assert colour().shape == (2, 2, 3)
    with capture_logs(), pytest.raises(DriverBrokenError, match="camera 'cam0': its driver failed in read"):
        colour()


def test_what_a_turntable_declares_goes_by_way_of_the_calls() -> None:
    whole = {"poses": ["0°"], "angles_deg": [0.0], "axis": None, "opened_at_deg": None}
    calls = dict.fromkeys(("move", "turn", "close"), lambda *_: None)
    for name, value in (("poses", [5]), ("angles_deg", [math.nan]), ("axis", 5), ("opened_at_deg", math.inf)):
        declared: Any = SimpleNamespace(**{**calls, **whole, name: value})
        table = guarded(Rig("bench", {}, TameProjector(), {}, positioner=declared), Calls(), {}).positioner
        with capture_logs(), pytest.raises(DriverBrokenError, match=f"the positioner: its driver failed in {name}"):
            getattr(table, name)


def test_settings_are_kept_as_applied_with_what_was_refused_or_bent() -> None:
    camera, kept = TameCamera(), dict[str, SettingsInUse]()
    eye = guarded(Rig("bench", {"cam0": camera}, TameProjector(), {}), Calls(), kept).cameras["cam0"]
    refusal = failing(UnsupportedByDeviceError("asked for gain 9, it takes 1 only"))

    def refuse(settings: CameraSettings) -> AppliedSettings:
        refusal()
        raise AssertionError(settings)

    def bend(settings: CameraSettings) -> AppliedSettings:
        return AppliedSettings(0.9 * settings.exposure_s, 2.0)

    camera.configure, usual = refuse, camera.configure  # type: ignore[method-assign]
    for taken in (False, True):
        with pytest.raises(UnsupportedByDeviceError):
            eye.configure(CameraSettings(0.02, 9.0))
        found = kept["cam0"]
        assert found.applied == (AppliedSettings(0.01, 1.0) if taken else None)
        assert found.notes == (
            "It refused the latest settings: asked for gain 9, it takes 1 only (camera 'cam0', in configure)",
        )
        camera.configure = usual  # type: ignore[method-assign]
        eye.configure(CameraSettings(0.01))
        assert (kept["cam0"].applied, kept["cam0"].notes) == (AppliedSettings(0.01, 1.0), ())
        camera.configure = refuse  # type: ignore[method-assign]
    camera.configure = bend  # type: ignore[method-assign]
    eye.configure(CameraSettings(0.01))
    assert kept["cam0"].notes == (
        "It uses an exposure of 9 ms instead of 10 ms: write a value that it can use into the rig file.",
        "It uses a gain of 2 instead of 1: write a value that it can use into the rig file.",
    )


def test_settings_of_a_rig_that_is_opened_afresh_are_not_those_of_before() -> None:
    bench = TameBench()
    held = RigSession("bench", bench.open_rig)
    next(iter(held.open().cameras.values())).configure(CameraSettings(0.01))
    assert [each.requested.exposure_s for each in held.settings.values()] == [0.01]
    held.release()
    held.open()
    assert held.settings == {}


def test_rig_with_a_failure_that_nobody_was_told_of_is_opened_afresh() -> None:
    bench = TameBench()
    held = RigSession("bench", bench.open_rig)
    held.open()
    with capture_logs(), pytest.raises(DriverBrokenError):
        held.open().cameras["cam0"].disarm()
    assert held.open() is held.open()
    assert len(bench.opened) == 2
    assert bench.opened[0][0].closed
    with capture_logs(), pytest.raises(DriverBrokenError):
        held.open().cameras["cam0"].disarm()
    assert held.recover() is None
    assert len(bench.opened) == 3


def test_a_lost_camera_is_looked_for_by_each_work_and_refuses_what_needs_all() -> None:
    bench, lost = TameBench(), {"cam1": "no such camera"}
    held = RigSession("bench", lambda: replace(bench.open_rig(), lost=dict(lost)))
    with capture_logs() as logs:
        held.open()
    assert [each["camera"] for each in logs] == ["cam1"]
    assert held.facts is not None
    assert held.facts.lost == lost
    with pytest.raises(DeviceError, match="needs every camera of the rig: no such camera"):
        held.open_whole()
    with pytest.raises(DeviceError, match="no such camera"):
        held.open_for_checks()
    assert bench.opened[-1][0].closed
    with capture_logs():
        held.open()
    held.find_lost()
    lost.clear()
    assert held.open_whole() is held.open()
    assert held.facts.lost == {}
    held.find_lost()
    assert len(bench.opened) == 4


def test_light_is_put_out_past_a_call_that_hangs() -> None:
    bench = TameBench()
    held = RigSession("bench", bench.open_rig)
    projector = held.open().projector
    tame = bench.opened[0][1]
    reached, go = threading.Event(), threading.Event()

    def show() -> None:
        tame.dark = False
        reached.set()
        assert go.wait(WAIT_S)

    owner = threading.Thread(target=lambda: held.calls.make("projector 'projector'", "show", 1.0, show))
    owner.start()
    assert reached.wait(WAIT_S)
    held.darken_from_outside()
    assert tame.dark
    assert projector is held.open().projector, "the rig stays with its owner"
    go.set()
    owner.join(WAIT_S)


def test_calls_of_several_threads_are_looked_after_at_once() -> None:
    now_s, reading, ended = [0.0], threading.Event(), threading.Event()
    calls = Calls(now_s=lambda: now_s[0])

    def read() -> None:
        reading.set()
        ended.wait()

    def reader() -> None:
        with pytest.raises(DeviceError):
            calls.make("camera 'left'", "read", 1.0, read)

    thread = threading.Thread(target=reader)
    thread.start()
    reading.wait()
    # Another call that begins and ends beside it changes nothing.
    assert calls.make("projector 'beamer'", "show", 1.0, lambda: 7) == 7
    now_s[0] = 1.5
    found = [calls.overdue(), calls.overdue()]
    ended.set()
    thread.join()
    assert found[0] is None
    assert found[1] is not None
    assert (found[1].device, found[1].step) == ("camera 'left'", "read")
    assert calls.stuck is None


def test_a_turn_that_hangs_is_told_as_a_move_that_hangs() -> None:
    now_s = [100.0]
    calls = Calls(now_s=lambda: now_s[0])
    asked: list[float] = []
    found: list[Call | None] = []

    class Table:
        poses, angles_deg, axis, opened_at_deg = ("0°", "180°"), (0.0, 180.0), None, 7.0

        def move(self, index: int) -> None:
            self.turn(self.angles_deg[index])

        def turn(self, angle_deg: float) -> None:
            asked.append(angle_deg)
            if angle_deg > 90:
                now_s[0] += MOVE_LIMIT_S + 1
                found.extend((calls.overdue(), calls.overdue()))

        def close(self) -> None:
            return

    table = guarded(Rig("bench", {}, TameProjector(), {}, positioner=Table()), calls, {}).positioner
    assert isinstance(table, GuardedTurntable)
    assert (table.axis, table.angles_deg, table.poses) == (None, (0.0, 180.0), ("0°", "180°"))
    assert table.opened_at_deg == 7.0
    table.turn(45.0)
    with pytest.raises(DeviceError, match=r"^the positioner: its driver has not come back from turn for 120 s and"):
        table.turn(100.0)
    with pytest.raises(DeviceError, match=r"^the positioner: its driver has not come back from move for 120 s and"):
        table.move(1)
    assert asked == [45.0, 100.0, 180.0]
    assert [None if call is None else call.step for call in found] == [None, "turn", None, "move"]
    table.close()


def test_positioner_is_watched_like_the_other_devices() -> None:
    seen: list[tuple[str, str, float]] = []
    calls = Calls()

    class Stage:
        poses = ("home",)

        def move(self, index: int) -> None:
            (call,) = calls._current.values()
            seen.append((call.device, call.step, call.limit_s))
            if index:
                raise OSError(errno.ENODEV, "No such device")

        def close(self) -> None:
            return

    stage = guarded(Rig("bench", {}, TameProjector(), {}, positioner=Stage()), calls, {}).positioner
    assert type(stage) is GuardedPositioner
    assert tuple(stage.poses) == ("home",)
    stage.move(0)
    with pytest.raises(DeviceGoneError, match="the positioner is gone"):
        stage.move(1)
    stage.close()
    assert seen[0] == ("the positioner", "move", MOVE_LIMIT_S)


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


def test_the_exposure_is_that_of_whoever_asked_last_within_what_the_camera_can() -> None:
    fake = fake_rig()
    room = Room(fake.rig)
    own_s, camera = fake.rig.settings["left"].exposure_s, fake.cameras["left"]
    camera.white = camera.scene.white
    with room.previews.watch("left", Light.WHITE) as first:
        room.run()
        usual = next_of(first)
        with room.previews.watch("left", Light.WHITE, 2 * own_s), room.previews.watch("left", Light.WHITE, 1e-9):
            assert next_of(first, next_of(first).number + 1).image.mean() < usual.image.mean() / 2
            assert camera.exposures_s[-1] == camera.info.exposure_range_s[0]
        next_of(first, next_of(first).number + 1)
        assert camera.exposures_s[-1] == own_s
    room.join()
    assert fake.at_rest


def test_a_picture_is_encoded_once_for_all_who_look() -> None:
    picture, made = Picture(np.zeros((2, 3), np.uint8), 1), []

    def make(image: NDArray[np.uint8]) -> bytes:
        made.append(image.shape)
        return b"jpeg"

    assert [picture.made("plain", make) for _ in range(20)] == 20 * [b"jpeg"]
    picture.made("marked", make)
    assert made == [(2, 3), (2, 3)]


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
    """By the job manager: pictures wait while a scan holds the rig, whether asked for before or during it."""
    bench = Bench(tmp_path)
    # The tame capture asks nothing of these cameras, and lights the tame projector.
    rig = replace(fake_rig().rig, projector=TameProjector(), calibration=tame_calibration())
    bench.manager.rig = RigSession("bench", lambda: rig)
    bench.manager.start()
    try:
        bench.until(bench.scan().id)
        with pytest.raises(CameraNotFoundError, match="left, right"):
            bench.manager.watch("middle", Light.OFF)
        with bench.manager.watch("left", Light.OFF) as watch:
            seen = next_of(watch).number
            held = bench.held()
            with bench.manager.watch("left", Light.OFF) as late:
                stood = next_of(watch).number
                assert watch.picture(stood, 0.0) is None
                assert late.picture(stood, 0.0) is None
                bench.gate.set()
                bench.until(held.id)
                assert next_of(watch, max(seen, stood)).number > stood
                assert next_of(late, stood).number > stood
    finally:
        bench.close()


def test_before_the_rig_is_open_there_is_nothing_to_see(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    try:
        with pytest.raises(DeviceBusyError, match="being opened"):
            bench.manager.watch("cam0", Light.OFF)
    finally:
        bench.close()


class Motor:
    """A table that outlives its openings. own_deg : its own count; at_deg : where it stands in the world."""

    def __init__(self) -> None:
        self.own_deg, self.at_deg = 12.0, 0.0
        self.fails = False


class Table(TurntableBase):
    """One opening of it."""

    def __init__(self, motor: Motor, *, homed: bool = False) -> None:
        super().__init__(4)
        self._motor = motor
        self._opened_deg = motor.own_deg
        self._homed = homed

    @property
    def axis(self) -> RotationAxis | None:
        return None

    @property
    def opened_at_deg(self) -> float | None:
        return None if self._homed else self._opened_deg

    def turn(self, angle_deg: float) -> None:
        moved = self._opened_deg + angle_deg - self._motor.own_deg
        if self._motor.fails:
            self._motor.own_deg, self._motor.at_deg = self._motor.own_deg + moved / 2, self._motor.at_deg + moved / 2
            raise DeviceError("stuck")
        self._motor.own_deg, self._motor.at_deg = self._motor.own_deg + moved, self._motor.at_deg + moved

    def close(self) -> None:
        return


@pytest.fixture
def motor() -> Motor:
    return Motor()


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "stage" / "table.json"


def test_angles_go_on_where_the_table_kept_its_place(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    second = CountedTurntable(Table(motor), path)
    assert second.count == first.count != FROM_THE_START
    second.turn(135.0)
    assert motor.at_deg == pytest.approx(135.0)
    third = CountedTurntable(Table(motor), path)
    third.move(2)
    assert third.count == first.count
    assert motor.at_deg == pytest.approx(180.0)
    with pytest.raises(UnsupportedByDeviceError, match="pose 4"):
        third.move(4)


def test_a_table_that_restarted_or_was_moved_counts_anew(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    motor.own_deg = 0.0
    second = CountedTurntable(Table(motor), path)
    assert second.count != first.count
    second.turn(45.0)
    assert motor.at_deg == pytest.approx(135.0)


def test_a_turn_that_did_not_end_leaves_no_count_to_go_on_with(motor: Motor, path: Path) -> None:
    first = CountedTurntable(Table(motor), path)
    motor.fails = True
    with pytest.raises(DeviceError, match="stuck"):
        first.turn(90.0)
    motor.fails = False
    assert CountedTurntable(Table(motor), path).count != first.count


@pytest.mark.parametrize("what", ["{", '{"at_deg": 3}', "[]"])
def test_a_file_that_is_damaged_is_not_believed(motor: Motor, path: Path, what: str) -> None:
    first = CountedTurntable(Table(motor), path)
    first.turn(90.0)
    path.write_text(what)
    assert CountedTurntable(Table(motor), path).count != first.count


def test_a_disk_that_refuses_turns_nothing(motor: Motor, path: Path) -> None:
    path.parent.write_text("a file in the folder's place")
    with pytest.raises(StorageError):
        CountedTurntable(Table(motor), path).turn(90.0)
    assert motor.at_deg == 0.0


def test_a_table_that_each_opening_brings_to_one_place_has_one_count(motor: Motor, path: Path) -> None:
    table = CountedTurntable(Table(motor, homed=True), path)
    table.turn(30.0)
    assert (table.count, path.exists()) == (FROM_THE_START, False)
    assert CountedTurntable(Table(motor, homed=True), path).count == FROM_THE_START
