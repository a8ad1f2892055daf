"""The driver of the faulty rig. It runs inside the service, asks the desk (`Desk`) before every step, and obeys.

What happens to it there is what happens to drivers: the device is gone, held by another, silent, refused by the system.
It waits where the desk makes it wait, for as long as it does.

Its camera looks at a flat wall, half a metre away.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from slrig.bundle.validation import Strict
from slrig.devices import (
    DEFAULT_LIMITS,
    AppliedSettings,
    CallLimits,
    Camera,
    CameraInfo,
    CameraSettings,
    DisplayedPattern,
    Positioner,
    Projector,
    ProjectorInfo,
    Trigger,
    TurntableBase,
)
from slrig.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    UnsupportedByDeviceError,
)
from slrig.model import (
    Calibration,
    CameraFormat,
    FloatArray,
    Frame,
    PatternSequence,
    Pinhole,
    Pixels,
    RotationAxis,
    Size,
)
from tests.e2e.faulty_rig.foreign import RAISED, RETURNED

PROJECTOR = Size(64, 48)
CAMERA = Size(96, 72)
CAMERA_NAME = "left"

_DISTANCE_MM = 500.0
_BASELINE_MM = 120.0
_CAMERA_FOCAL_PX = 150.0
_PROJECTOR_FOCAL_PX = 100.0
_BLUR_PX = 0.5
_BLACK_DN, _WHITE_DN, _NOISE_DN = 6.0, 190.0, 1.0


def _device(size: Size, focal_px: float, shift_mm: float) -> Pinhole:
    """A device that looks along z from (`shift_mm`, 0, 0), aimed at the wall's middle by its principal point."""
    centre_px = (size.width_px - 1) / 2 + focal_px * shift_mm / _DISTANCE_MM
    matrix = np.array([[focal_px, 0.0, centre_px], [0.0, focal_px, (size.height_px - 1) / 2], [0.0, 0.0, 1.0]])
    return Pinhole(size, matrix, np.zeros(5), np.eye(3), np.array([-shift_mm, 0.0, 0.0]))


def calibration() -> Calibration:
    return Calibration(
        {CAMERA_NAME: _device(CAMERA, _CAMERA_FOCAL_PX, 0.0)}, _device(PROJECTOR, _PROJECTOR_FOCAL_PX, _BASELINE_MM)
    )


def photograph(profile: Pixels | None, noise: np.random.Generator) -> Pixels:
    """What the camera sees of a column pattern, or of the dark: (H, W) uint8."""
    light = np.zeros(CAMERA.width_px)
    if profile is not None:
        light = _SPREAD @ np.broadcast_to(profile[0], (PROJECTOR.width_px,)) / 255
    level = _BLACK_DN + (_WHITE_DN - _BLACK_DN) * np.broadcast_to(light, CAMERA.shape)
    return np.clip(np.rint(level + _NOISE_DN * noise.standard_normal(CAMERA.shape)), 0, 255).astype(np.uint8)


def _spread() -> FloatArray:
    """(camera columns, projector columns): how much of each projector column's light each camera column gets."""
    scale = _PROJECTOR_FOCAL_PX / _CAMERA_FOCAL_PX
    columns = (np.arange(CAMERA.width_px) - (CAMERA.width_px - 1) / 2) * scale + (PROJECTOR.width_px - 1) / 2
    # The wall beyond the projector's edge is lit by nothing: the columns out there take their share with them.
    beyond = np.arange(-4, PROJECTOR.width_px + 4)
    weights = np.exp(-((columns[:, None] - beyond[None, :]) ** 2) / (2 * _BLUR_PX**2))
    weights /= weights.sum(axis=1, keepdims=True)
    return np.asarray(weights[:, 4:-4])


_SPREAD = _spread()
_Device = TypeVar("_Device")


PLAYER, TABLE = "projector", "positioner"


class Options(Strict):
    """The driver's keys of a rig file. desk : the socket to ask; trigger : of the camera; plays : of the projector.
    call_s : the limit of each call, 0 for the usual ones.
    """

    desk: str
    trigger: str = Trigger.SOFTWARE
    plays: bool = False
    call_s: float = 0.0


class Line:
    """The way to the desk: one connection for each thread, since a thread may be held there while others go on."""

    def __init__(self, desk: str) -> None:
        self._desk = desk
        self._local = threading.local()

    def say(self, **message: Any) -> str:
        stream = getattr(self._local, "stream", None)
        if stream is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            connection.connect(self._desk)
            stream = self._local.stream = connection.makefile("rwb", buffering=0)
        stream.write(json.dumps(message).encode() + b"\n")
        answer: str = json.loads(stream.readline())
        return answer


class Wall:
    """What is lit now, for the camera to see. One for the process: it stays when devices are opened again."""

    def __init__(self) -> None:
        self.profile: Pixels | None = None
        self.play: tuple[PatternSequence, int, float, float] | None = None


WALL = Wall()
_OPEN: set[str] = set()
"""The devices that are open, gone or not. None can be opened twice, even by the service if it forgot one."""


class Handle:
    """A device while it is open. Once it is gone it stays gone: only opening it again helps."""

    def __init__(self, name: str, line: Line) -> None:
        self.name = name
        self.line = line
        self._gone = False
        self.closed = False
        self._spoil: Callable[[Any], Any] | None = None
        if name in _OPEN:
            raise DeviceBusyError(f"{name} is held by this service itself")
        self.step("open")
        _OPEN.add(name)

    def step(self, step: str, number: int = 0) -> None:
        """Ask whether a step may be done, and meet the fault that it is to meet."""
        answer = "unplug" if self._gone else self.line.say(device=self.name, step=step, number=number)
        self._gone = answer == "unplug"
        if answer in RETURNED:
            self._spoil = RETURNED[answer]
        elif answer != "go":
            raise self._fault(answer, step)

    def returned(self, value: Any) -> Any:
        """What the step that was done last is to return: the value, or what no device has."""
        spoil, self._spoil = self._spoil, None
        return value if spoil is None else spoil(value)

    def declared(self, value: Any, step: str = "info") -> Any:
        """The same for what can be asked of a device in every state."""
        answer = self.line.say(device=self.name, step=step, number=0)
        if answer in RAISED:
            raise RAISED[answer]()
        return RETURNED[answer](value) if answer in RETURNED else value

    def _fault(self, what: str, step: str) -> BaseException:
        if what in RAISED:
            return RAISED[what]()
        match what, step:
            case "unplug", _:
                return DeviceGoneError(f"{self.name} was unplugged; plug it in, then scan again")
            case "busy", "open":
                return DeviceBusyError(f"{self.name} is held by another program; end that program, then scan again")
            case "busy", _:
                return OSError(errno.EBUSY, os.strerror(errno.EBUSY), f"/dev/{self.name}")
            case "time-out", "read":
                return FrameTimeoutError(f"no frame from {self.name} in time")
            case "time-out", _:
                return DeviceError(f"{self.name} did not answer {step} within 0.15 s; check its cable and power")
            case "input/output error", _:
                return OSError(errno.EIO, os.strerror(errno.EIO))
            case "defect", _:
                return IndexError("list index out of range")
        raise AssertionError(what)

    def require_open(self) -> None:
        if self.closed:
            raise DeviceStateError(f"{self.name} is closed; open the rig again")

    def close(self) -> bool:
        """Close, once; return whether there was a device to close. One that is gone has none."""
        if self.closed:
            return False
        self.closed = True
        _OPEN.discard(self.name)
        if not self._gone:
            self.step("close")
        return not self._gone


class FaultyCamera:
    """Implements `slrig.devices.Camera`."""

    def __init__(self, name: str, options: Options) -> None:
        self._handle = Handle(name, Line(options.desk))
        self._way = Trigger(options.trigger)
        self._noise = np.random.default_rng(1)
        self._exposure_s = 0.002
        self._armed = False
        self._triggered_ns: int | None = None
        self._count = self._read = 0
        self._pace = threading.Event()
        limits = CallLimits(options.call_s, options.call_s) if options.call_s else DEFAULT_LIMITS
        form, ways = CameraFormat(CAMERA, 8), frozenset({self._way})
        self._info = CameraInfo(name, "faulty camera", "c1", form, ways, (0.001, 1.0), (1.0, 4.0), limits)

    @property
    def info(self) -> CameraInfo:
        info: CameraInfo = self._handle.declared(self._info)
        return info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self._handle.require_open()
        self._handle.step("configure")
        self._exposure_s = settings.exposure_s
        applied: AppliedSettings = self._handle.returned(AppliedSettings(settings.exposure_s, settings.gain))
        return applied

    def arm(self, count: int, trigger: Trigger) -> None:
        self._handle.require_open()
        if self._armed or trigger is not self._way or count < 1:
            message = f"{self._handle.name} is {'armed' if self._armed else 'not armed'}, asked {count} by {trigger}"
            raise DeviceStateError(message)
        self._handle.step("arm")
        self._armed, self._read, self._triggered_ns = True, 0, None

    def trigger(self) -> None:
        self._handle.require_open()
        self._handle.step("trigger")
        self._triggered_ns = time.monotonic_ns()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """Without a frame to wait for, fail at once: no test is about the time it takes."""
        self._handle.require_open()
        if not self._armed:
            raise DeviceStateError(f"{self._handle.name} is not armed")
        self._handle.step("read", self._read)
        start_ns = max(after_ns, time.monotonic_ns())
        if self._way is Trigger.SOFTWARE:
            if self._triggered_ns is None:
                message = f"{self._handle.name} was not triggered, and gave nothing within {timeout_s:g} s"
                raise FrameTimeoutError(message)
            start_ns, self._triggered_ns = self._triggered_ns, None
        elif self._way is Trigger.HARDWARE:
            start_ns = max(self._pulse(timeout_s), after_ns)
        end_ns = start_ns + round(self._exposure_s * 1e9)
        while (left_ns := end_ns - time.monotonic_ns()) > 0:
            # Closing ends the wait.
            if self._pace.wait(left_ns / 1e9):
                break
        self._handle.require_open()
        self._read += 1
        self._count += 1
        image = photograph(WALL.profile, self._noise)
        frame = Frame(self._handle.name, image, start_ns, end_ns, 0, self._count, 0, self._exposure_s, 1.0)
        returned: Frame = self._handle.returned(frame)
        return returned

    def disarm(self) -> None:
        if self._armed and not self._handle.closed:
            self._handle.step("disarm")
        self._armed = False

    def close(self) -> None:
        self._armed = False
        self._pace.set()
        self._handle.close()

    def _pulse(self, timeout_s: float) -> int:
        """When the wire's next pulse came, and with it the next pattern of the play."""
        if WALL.play is None or self._read >= len(WALL.play[0]):
            raise FrameTimeoutError(f"no pulse came to {self._handle.name} within {timeout_s:g} s")
        sequence, began_ns, _, period_s = WALL.play
        WALL.profile = sequence.profiles[self._read]
        return max(began_ns + round(self._read * period_s * 1e9), time.monotonic_ns())


class FaultyProjector:
    """Implements `slrig.devices.Projector`. It reports its light to the desk, which decides the faults."""

    def __init__(self, options: Options) -> None:
        self._handle = Handle(PLAYER, Line(options.desk))
        self._sequence: PatternSequence | None = None
        limits = CallLimits(options.call_s, options.call_s) if options.call_s else DEFAULT_LIMITS
        self._info = ProjectorInfo(PLAYER, "faulty projector", "p1", PROJECTOR, options.plays, 0.001, limits=limits)
        self._light(None, "open")

    @property
    def info(self) -> ProjectorInfo:
        info: ProjectorInfo = self._handle.declared(self._info)
        return info

    def load(self, sequence: PatternSequence) -> None:
        self._handle.require_open()
        self._handle.step("load")
        self._light(None, "load")
        self._sequence = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. A fault comes when it has lit the pattern already: its answer is what is lost."""
        self._handle.require_open()
        if self._sequence is None:
            raise DeviceStateError(f"asked to show pattern {index}, nothing is loaded")
        self._light(self._sequence.profiles[index], f"show {index}")
        self._handle.step("show", index)
        shown: DisplayedPattern = self._handle.returned(DisplayedPattern(index, time.monotonic_ns(), 0))
        return shown

    def play(self, exposure_s: float, period_s: float) -> None:
        self._handle.require_open()
        if not self._info.plays or self._sequence is None:
            raise UnsupportedByDeviceError("this projector does not play, or has nothing to")
        WALL.play = (self._sequence, time.monotonic_ns(), exposure_s, period_s)
        self._light(self._sequence.profiles[0], "play")
        self._handle.step("play")

    def stop(self) -> None:
        self._dark("stop")

    def blank(self) -> None:
        self._dark("blank")

    def close(self) -> None:
        if self._handle.close():
            self._light(None, "close")

    def _dark(self, step: str) -> None:
        if not self._handle.closed:
            self._handle.step(step)
            self._light(None, step)

    def _light(self, profile: Pixels | None, command: str) -> None:
        if profile is None:
            WALL.play = None
        WALL.profile = profile
        lit = profile is not None and bool(profile.any())
        self._handle.line.say(device=PLAYER, light=lit, command=command)


class FaultyTable(TurntableBase):
    """Implements `slrig.devices.Turntable`."""

    def __init__(self, options: Options) -> None:
        super().__init__(4)
        self._handle = Handle(TABLE, Line(options.desk))

    @property
    def axis(self) -> RotationAxis | None:
        return None

    @property
    def angles_deg(self) -> Sequence[float]:
        angles: Sequence[float] = self._handle.declared(super().angles_deg, "angles")
        return angles

    @property
    def poses(self) -> Sequence[str]:
        poses: Sequence[str] = self._handle.declared(super().poses, "poses")
        return poses

    @property
    def opened_at_deg(self) -> float | None:
        angle: float | None = self._handle.declared(None, "angle")
        return angle

    def turn(self, angle_deg: float) -> None:
        del angle_deg
        self._handle.require_open()
        self._handle.step("turn")

    def close(self) -> None:
        self._handle.close()


class DiskHook:
    """Meets faults where the service writes below `.incoming`, as the system would raise them: an audit hook.

    Steps of "disk": `write` a new file, `rename` it, `sync` the whole bundle after the capture, `commit` a whole scan
    by its last rename.
    """

    def __init__(self, desk: str) -> None:
        self._line = Line(desk)
        self._asking = threading.local()

    def __call__(self, event: str, given: tuple[Any, ...]) -> None:
        if event not in {"open", "os.rename"} or getattr(self._asking, "now", False):
            return
        path = os.fsdecode(given[0]) if isinstance(given[0], (str, bytes, os.PathLike)) else ""
        _, incoming, below = path.partition("/.incoming/")
        if event == "os.rename":
            step = "rename" if "/" in below else "commit"
        else:
            step = "write" if "x" in str(given[1] or "") else "sync"
        # Folders are opened to be removed, too, and no disk refuses that.
        if not incoming or (step == "sync" and below.split("/")[1:2] != ["recording"]):
            return
        self._asking.now = True
        try:
            answer = self._line.say(device="disk", step=step, number=0, path=path)
        finally:
            self._asking.now = False
        if answer == "full":
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


_HOOKED: set[str] = set()


def open_camera(name: str, options: Mapping[str, object], folder: Path) -> Camera:
    del folder
    camera = FaultyCamera(name, Options.model_validate(dict(options)))
    return _opened(camera, camera._handle)


def open_positioner(options: Mapping[str, object], folder: Path) -> Positioner:
    del folder
    table = FaultyTable(Options.model_validate(dict(options)))
    return _opened(table, table._handle)


def _opened(device: _Device, handle: Handle) -> _Device:
    """What a factory returns. It does not hold what it opened if it returns something else."""
    returned: _Device = handle.returned(device)
    if returned is not device:
        _OPEN.discard(handle.name)
    return returned


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open the projector; the first one brings the hook that makes disks full."""
    del folder
    table = Options.model_validate(dict(options))
    if table.desk not in _HOOKED:
        _HOOKED.add(table.desk)
        sys.addaudithook(DiskHook(table.desk))
    projector = FaultyProjector(table)
    return _opened(projector, projector._handle)
