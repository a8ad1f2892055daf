"""Devices as the service calls them: errors name device and call, no call hangs unnoticed, settings are remembered.

Drivers raise errors of the operating system; a record needs a message that a person can act on. A call that does not
return, because a driver or the kernel hangs, must not leave a job under way with the projector's light on.
"""

from __future__ import annotations

import errno
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Generic, TypeVar

import structlog

from slrig.capture.triggering import differs_from_request
from slrig.devices import (
    DEFAULT_LIMITS,
    AppliedSettings,
    Camera,
    CameraSettings,
    Clock,
    DisplayedPattern,
    Positioner,
    Projector,
    Rig,
    Trigger,
    Turntable,
    UnknownPolarityProjector,
    listen_for_progress,
    require_applied,
    require_camera_info,
    require_colour,
    require_displayed,
    require_frame,
    require_kind,
    require_number,
    require_projector_info,
    require_texts,
)
from slrig.errors import (
    DeviceBusyError,
    DeviceError,
    DeviceGoneError,
    DriverBrokenError,
    FrameTimeoutError,
    SlrigError,
    UnsupportedByDeviceError,
)
from slrig.failure import JobFailure, LastingThread, error_of
from slrig.model import Frame, PatternSequence, RotationAxis
from slrig.printable import foreign_text


@dataclass(frozen=True, slots=True)
class SettingsInUse:
    """applied : as read back from the camera; None before it took any. refused : why it did not take the latest
    settings, and so goes on with those before.
    """

    requested: CameraSettings
    applied: AppliedSettings | None
    refused: str | None = None

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for a person; none where the camera uses what was requested.

        >>> SettingsInUse(CameraSettings(0.02), AppliedSettings(0.015, 1.0)).notes
        ('It uses an exposure of 15 ms instead of 20 ms: write a value that it can use into the rig file.',)
        """
        if self.refused is not None:
            return (f"It refused the latest settings: {self.refused}",)
        if self.applied is None:
            return ()
        wanted, uses, found = self.requested, self.applied, []
        if differs_from_request(uses.exposure_s, wanted.exposure_s):
            found.append(f"an exposure of {1e3 * uses.exposure_s:.4g} ms instead of {1e3 * wanted.exposure_s:.4g} ms")
        if differs_from_request(uses.gain, wanted.gain):
            found.append(f"a gain of {uses.gain:.4g} instead of {wanted.gain:.4g}")
        return tuple(f"It uses {each}: write a value that it can use into the rig file." for each in found)


OPEN = "open"
"""The step of opening a whole rig."""

OPEN_LIMIT_S = 60.0
"""Longest time to open a rig without a report of progress: network cameras are searched, some projectors boot."""

MOVE_LIMIT_S = 120.0
"""Longest move of the board: a stage crosses its whole travel, a robot goes round an obstacle."""

CHECK_S = 0.5
"""Interval of the watchdog's checks."""

_GONE = {errno.ENODEV, errno.ENXIO, errno.ESHUTDOWN}

_log = structlog.get_logger(__name__)

_Value = TypeVar("_Value")
_Device = TypeVar("_Device", bound=Camera | Projector)


@dataclass(slots=True)
class Call:
    """A call of a device that is under way. `since_s` : when it was begun, or last reported progress; `doing` : that
    report; `late` : number of checks that found it late; `given_up` : its result is no longer awaited.
    """

    device: str
    step: str
    limit_s: float
    since_s: float
    computed: bool = False
    doing: str = ""
    late: int = 0
    given_up: bool = False

    def hangs(self) -> str:
        """Message about a call that does not return."""
        what = f"{self.device}: its driver has not come back from {self.step} for {self.limit_s:.0f} s"
        if self.computed:
            return f"{what}, nor reported progress; restart the service, and report this to the driver's maintainer"
        if self.step == OPEN:
            return (
                f"{what}, nor reported progress; unplug every device of the rig that is on a cable and plug it in "
                "again, restart the service, and report this to the driver's maintainer"
            )
        return (
            f"{what} and does not keep its time-out; unplug the device, plug it in again and scan again; if that is "
            "refused, restart the service, and report this to the driver's maintainer"
        )


class Calls:
    """Makes all calls of a rig's devices: one at a time by the thread that owns the rig, and one by each thread that
    reads a camera for it. Any thread may read its state.
    """

    def __init__(self, *, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._current: dict[int, Call] = {}
        self.failure: DeviceError | None = None
        """The last error of a device that leaves its state unknown, also where the caller ignored it."""

    def make(
        self, device: str, step: str, limit_s: float, function: Callable[[], _Value], *, computed: bool = False
    ) -> _Value:
        """Call a device. It may take limit_s without a report of progress. computed : see `CallLimits`.

        Raises
        ------
        SlrigError
            What the driver raised, with the device and the call in its text.
        DeviceBusyError, DeviceGoneError, DeviceError
            The system's error of the driver, by its number.
        DriverBrokenError
            The driver has a defect.
        DeviceError
            The call took so long that it was given up; its result is no longer awaited.
        """
        call = Call(device, step, limit_s, self._now_s(), computed)
        self._current[threading.get_ident()] = call

        def heard(doing: str) -> None:
            call.doing, call.since_s, call.late = doing, self._now_s(), 0

        try:
            with listen_for_progress(heard):
                value = function()
        except SlrigError as raised:
            error = _plain(raised)
            # The code that opens a device names it; and capture has its own message for a frame that did not come.
            if isinstance(error, DeviceError) and not isinstance(error, FrameTimeoutError) and step != OPEN:
                error.place = f"{device}, in {step}"
            self._note(error)
            raise error from raised.__cause__
        except OSError as error:
            found = _of_the_system(error, call)
            self._note(found)
            raise found from error
        except BaseException as error:
            # A driver may raise anything, even SystemExit: this thread is the service's, and goes on.
            if call.given_up:
                self.failure = DeviceError(call.hangs())
                raise self.failure from error
            # A driver may raise the same error again and again, and not every renderer bears the ring that this makes.
            trace = foreign_text("".join(_trace(error)))
            _log.error("a driver failed with an error of its own", device=device, step=step, exception=trace)
            cause = f"{type(error).__name__}: {foreign_text(error)}"
            message = (
                f"{device}: its driver failed in {step} ({cause}); scan again, and report it to the driver's "
                "maintainer with the service's log"
            )
            self.failure = DriverBrokenError(message)
            raise self.failure from error
        finally:
            self._current.pop(threading.get_ident(), None)
        if call.given_up:
            self.failure = DeviceError(call.hangs())
            raise self.failure
        return value

    def overdue(self) -> Call | None:
        """Return the call under way if it has taken too long, once, and give it up. For the watchdog, which checks
        twice before it believes that: the whole process may have been stopped meanwhile.
        """
        for call in self._under_way():
            if call.given_up or self._now_s() - call.since_s <= call.limit_s:
                continue
            call.late += 1
            call.given_up = call.late > 1
            if call.given_up:
                return call
        return None

    @property
    def doing(self) -> str:
        """Latest report of a call under way; "" without one."""
        return next((call.doing for call in self._under_way() if call.doing), "")

    @property
    def stuck(self) -> Call | None:
        """The call that was given up, as long as it does not return."""
        return next((call for call in self._under_way() if call.given_up), None)

    def _under_way(self) -> list[Call]:
        # A copy: other threads begin and end calls meanwhile.
        return list(self._current.values())

    def _note(self, error: SlrigError) -> None:
        # After these the device is as it was before.
        if isinstance(error, DeviceError) and not isinstance(error, (FrameTimeoutError, UnsupportedByDeviceError)):
            self.failure = error


class Watchdog:
    """Supervises the calls of a rig on a thread of its own; `on_hang` gets each one that hangs there, once."""

    def __init__(self, calls: Calls, on_hang: Callable[[Call], None], *, check_s: float = CHECK_S) -> None:
        self._calls = calls
        self._on_hang = on_hang
        self._check_s = check_s
        self._ended = threading.Event()
        self._thread = LastingThread(self._watch, "slrig-watchdog")

    def start(self) -> None:
        """Begin to check."""
        self._thread.start()

    def stop(self) -> None:
        """Stop. Idempotent."""
        self._ended.set()

    def _watch(self) -> None:
        while not self._ended.wait(self._check_s):
            call = self._calls.overdue()
            if call is not None:
                try:
                    self._on_hang(call)
                except Exception:  # noqa: BLE001 - the watch over later calls goes on
                    _log.exception("the end of a call that hangs went wrong", device=call.device, step=call.step)


def guarded(rig: Rig, calls: Calls, settings: dict[str, SettingsInUse]) -> Rig:
    """The same rig, all calls of its devices and of what moves the board by way of `calls`. settings : where those of
    each camera are kept, by its name.
    """
    return replace(
        rig,
        cameras={
            name: _GuardedCamera(camera, name, calls, settings, rig.clock) for name, camera in rig.cameras.items()
        },
        projector=_guarded_projector(rig.projector, calls, rig.clock),
        positioner=_guarded_positioner(rig.positioner, calls),
    )


def _guarded_projector(projector: Projector, calls: Calls, clock: Clock) -> Projector:
    if isinstance(projector, UnknownPolarityProjector):
        return _GuardedUnknownPolarityProjector(projector, calls, clock)
    return _GuardedProjector(projector, calls, clock)


def _guarded_positioner(positioner: Positioner | None, calls: Calls) -> GuardedPositioner | None:
    if isinstance(positioner, Turntable):
        return GuardedTurntable(positioner, calls)
    return None if positioner is None else GuardedPositioner(positioner, calls)


class _Guarded(Generic[_Device]):
    """A device called by way of `calls`. name : its name in errors."""

    def __init__(self, device: _Device, name: str, calls: Calls) -> None:
        self._device = device
        self._name = name
        self._calls = calls
        self._limits = DEFAULT_LIMITS

    def close(self) -> None:
        self._made("close", self._device.close)

    def _made(self, step: str, function: Callable[[], _Value], *, limit_s: float | None = None) -> _Value:
        limits = self._limits
        limit_s = limits.call_s if limit_s is None else limit_s
        return self._calls.make(self._name, step, limit_s, function, computed=limits.computed)


class _GuardedCamera(_Guarded[Camera]):
    """Implements `slrig.devices.Camera` by another one."""

    def __init__(
        self, camera: Camera, name: str, calls: Calls, settings: dict[str, SettingsInUse], clock: Clock
    ) -> None:
        super().__init__(camera, f"camera '{name}'", calls)
        self._key = name
        self._settings = settings
        self._clock = clock
        # It does not change.
        self.info = self._made("info", lambda: require_camera_info(camera.info))
        self._limits = self.info.limits

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        try:
            applied = self._made("configure", lambda: require_applied(self._device.configure(settings)))
        except UnsupportedByDeviceError as error:
            before = self._settings.get(self._key)
            kept = None if before is None else before.applied
            self._settings[self._key] = SettingsInUse(settings, kept, str(error))
            raise
        self._settings[self._key] = SettingsInUse(settings, applied)
        return applied

    def arm(self, count: int, trigger: Trigger) -> None:
        self._made("arm", lambda: self._device.arm(count, trigger))

    def trigger(self) -> None:
        self._made("trigger", self._device.trigger)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        limit_s = 2 * timeout_s + self._limits.read_slack_s

        def read() -> Frame:
            frame = self._device.read(after_ns, timeout_s)
            return require_frame(frame, self.info.name, self._clock.now_ns())

        frame = self._made("read", read, limit_s=limit_s)
        colour = frame.colour
        if colour is None:
            return frame
        return replace(frame, colour=lambda: self._made("read", lambda: require_colour(colour(), frame)))

    def disarm(self) -> None:
        self._made("disarm", self._device.disarm)


class _GuardedProjector(_Guarded[Projector]):
    """Implements `slrig.devices.Projector` by another one."""

    def __init__(self, projector: Projector, calls: Calls, clock: Clock) -> None:
        super().__init__(projector, "projector", calls)
        self._clock = clock
        self.info = self._made("info", lambda: require_projector_info(projector.info))
        self._limits = self.info.limits
        self._name = f"projector '{self.info.name}'"

    def load(self, sequence: PatternSequence) -> None:
        self._made("load", lambda: self._device.load(sequence))

    def show(self, index: int) -> DisplayedPattern:
        def show() -> DisplayedPattern:
            shown = self._device.show(index)
            return require_displayed(shown, index, self._clock.now_ns())

        return self._made("show", show)

    def play(self, exposure_s: float, period_s: float) -> None:
        self._made("play", lambda: self._device.play(exposure_s, period_s))

    def stop(self) -> None:
        self._made("stop", self._device.stop)

    def blank(self) -> None:
        self._made("blank", self._device.blank)


class _GuardedUnknownPolarityProjector(_GuardedProjector):
    """Implements `slrig.devices.UnknownPolarityProjector` by another one."""

    def __init__(self, projector: UnknownPolarityProjector, calls: Calls, clock: Clock) -> None:
        super().__init__(projector, calls, clock)
        self._projector = projector

    @property
    def is_polarity_unknown(self) -> bool:
        return self._made("is_polarity_unknown", lambda: require_kind(self._projector.is_polarity_unknown, bool))

    @property
    def light_period_s(self) -> float:
        return self._made(
            "light_period_s", lambda: require_number(self._projector.light_period_s, "a period", least=1e-9)
        )

    def set_trial_current(self, share: float) -> None:
        self._made("set_trial_current", lambda: self._projector.set_trial_current(share))

    def polarity_option(self, *, rises: bool) -> str:
        return self._made("polarity_option", lambda: require_texts([self._projector.polarity_option(rises=rises)])[0])


class GuardedPositioner:
    """Implements `slrig.devices.Positioner` by another one, all calls by way of `calls`."""

    def __init__(self, positioner: Positioner, calls: Calls) -> None:
        self._positioner = positioner
        self._made = partial(calls.make, "the positioner")

    def _read(self, step: str, function: Callable[[], _Value]) -> _Value:
        return self._made(step, DEFAULT_LIMITS.call_s, function)

    @property
    def poses(self) -> Sequence[str]:
        """See `Positioner`."""
        return self._read("poses", lambda: require_texts(self._positioner.poses))

    def move(self, index: int) -> None:
        """See `Positioner`."""
        self._made("move", MOVE_LIMIT_S, lambda: self._positioner.move(index))

    def close(self) -> None:
        """See `Positioner`."""
        self._made("close", DEFAULT_LIMITS.call_s, self._positioner.close)


class GuardedTurntable(GuardedPositioner):
    """Implements `slrig.devices.Turntable` by another one, all calls by way of `calls`."""

    def __init__(self, turntable: Turntable, calls: Calls) -> None:
        super().__init__(turntable, calls)
        self._turntable = turntable

    @property
    def axis(self) -> RotationAxis | None:
        """See `Turntable`."""

        def axis() -> RotationAxis | None:
            found = self._turntable.axis
            return None if found is None else require_kind(found, RotationAxis)

        return self._read("axis", axis)

    @property
    def angles_deg(self) -> Sequence[float]:
        """See `Turntable`."""

        def angles_deg() -> Sequence[float]:
            return tuple(require_number(each, _ANGLE) for each in self._turntable.angles_deg)

        return self._read("angles_deg", angles_deg)

    @property
    def opened_at_deg(self) -> float | None:
        """See `Turntable`."""

        def opened_at_deg() -> float | None:
            found = self._turntable.opened_at_deg
            return None if found is None else require_number(found, _ANGLE)

        return self._read("opened_at_deg", opened_at_deg)

    def turn(self, angle_deg: float) -> None:
        """See `Turntable`."""
        self._made("turn", MOVE_LIMIT_S, lambda: self._turntable.turn(angle_deg))


_ANGLE = "an angle"


def _plain(error: SlrigError) -> SlrigError:
    """The same error, of a class of slrig's own, with a text that is safe to print."""
    own = (each for each in type(error).__mro__ if each.__module__ == SlrigError.__module__)
    kind = next(each for each in own if issubclass(each, SlrigError))
    # Not `str`, which adds the place where it was raised before.
    text = foreign_text(error.args[0] if len(error.args) == 1 else error.args or "")
    if type(error) is kind:
        error.args = (text,)
        return error
    return error_of(JobFailure(kind.code, foreign_text(error)))


def _trace(error: BaseException) -> list[str]:
    try:
        return traceback.format_exception(error)
    except BaseException:  # noqa: BLE001 - of a class that has no text
        return [type(error).__name__]


def _of_the_system(error: OSError, call: Call) -> DeviceError:
    """The system's error of a driver, with advice for a person."""
    device, step, cause = call.device, call.step, foreign_text(error)
    number = error.errno if isinstance(error.errno, int) else None
    if call.computed:
        return DeviceError(f"{device} failed in {step}: {cause}; check its files and permissions, then scan again")
    if number == errno.EBUSY:
        return DeviceBusyError(
            f"{device} is held by another program (in {step}: {cause}); end that program, then scan again"
        )
    if number in _GONE:
        return DeviceGoneError(
            f"{device} is gone (in {step}: {cause}); check its cable and power, plug it in, then scan again"
        )
    return DeviceError(f"{device} failed in {step}: {cause}; check cable, power and permissions, then scan again")
