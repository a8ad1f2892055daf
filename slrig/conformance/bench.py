"""Bench for a rig under examination: opens it, shares it among the checks, and measures its light with its cameras.

The level of a frame is its share of the projector's white: white is 1, black is 0, independent of the room's light, the
noise and the sensor.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import wraps
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.capture.latency import stable_from_ns
from slrig.devices import AppliedSettings, Camera, CameraSettings, DisplayedPattern, Projector, Rig, Trigger
from slrig.errors import SlrigError
from slrig.model import Black, Frame, PatternSequence, Pixels, White

SETTING_TOLERANCE = 0.01
"""Largest relative difference of an exposure or a gain from the requested one."""

STEPPED_TRIGGERS = (Trigger.SOFTWARE, Trigger.FREE)
"""Triggers with which a camera can follow a projector that steps; the better one first."""

ABSENT_FRAME_WAIT_S = 0.05
"""Wait for a frame that must not come."""

FRAME_WAIT_S = 5.0
"""Longest wait for a frame that must come, in addition to its exposure."""

MAX_FRAMES = 256
"""More frames than any check takes from a camera that it armed once."""

DEFAULT_EXPOSURE_S = 1 / 60  # one period of most projectors

MIN_WHITE_LEVEL = 0.8
"""A frame of this level or more shows white."""

MAX_BLACK_LEVEL = 0.2
"""A frame of this level or less shows black."""

_MIN_LIT_PIXELS = 16
_MIN_LIT_SHARE = 0.001
_MIN_CONTRAST_SHARE = 0.01
_MIN_CONTRAST_SNR = 6.0  # no pixel exceeds it by chance

_SETTLE_S = 0.1  # in addition to the declared and the measured latency
_MAX_DARK_FRAMES = 64  # a limit in case the times of frames do not advance
_STAYS_DARK_FRAMES = 3  # after which a dark projector is checked again
_REFERENCE_FRAMES = 3  # of white and of black; the last two give the noise


@dataclass(frozen=True, slots=True)
class Failure:
    """One violated expectation: the device, the expectation, the finding, and the remedy for the driver's author."""

    expected: str
    found: str
    remedy: str
    where: str = ""

    def __str__(self) -> str:
        device = f"{self.where}: " if self.where else ""
        return f"{device}{self.expected}; found {self.found}; {self.remedy}"


class ExpectationError(Exception):
    """A device violates the contract. Raised by checks only, and recorded in their result."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(str(failure))
        self.failure = failure


class NotApplicableError(Exception):
    """A running check finds that it does not apply to these devices. The message gives the reason."""


def expect(condition: object, *, expected: str, found: object, remedy: str) -> None:
    """Raise ExpectationError unless the condition holds."""
    if not condition:
        raise ExpectationError(Failure(expected, str(found), remedy))


@contextmanager
def expect_error(error: type[SlrigError], *, expected: str, remedy: str) -> Iterator[None]:
    """Expect that the block raises `error`. Raises ExpectationError if it raises another one, or none."""
    expected = f"{expected} is refused with {error.__name__}"
    try:
        yield
    except error:
        return
    except Exception as other:
        raise ExpectationError(Failure(expected, _describe_error(other), remedy)) from other
    raise ExpectationError(Failure(expected, "no error", remedy))


@contextmanager
def expect_no_error(*, expected: str, remedy: str) -> Iterator[None]:
    """Expect that the block raises nothing. Raises ExpectationError."""
    try:
        yield
    except Exception as error:
        raise ExpectationError(Failure(expected, _describe_error(error), remedy)) from error


@contextmanager
def on_device(where: str) -> Iterator[None]:
    """Add the device's name to failures within the block; errors of a driver become failures of the check."""
    try:
        yield
    except ExpectationError as error:
        if error.failure.where:
            raise
        raise ExpectationError(replace(error.failure, where=where)) from error
    except NotApplicableError:
        raise
    except Exception as error:
        raise ExpectationError(replace(failure_from(error), where=where)) from error


def failure_from(error: Exception) -> Failure:
    """Return the failure of an unexpected error from a device."""
    if isinstance(error, ExpectationError):
        return error.failure
    remedy = (
        "correct the rig as the message says, or the driver if it is wrong"
        if isinstance(error, SlrigError)
        else "a driver raises the errors of slrig.errors, and no others"
    )
    return Failure("no error comes from a call that the contract allows", _describe_error(error), remedy)


def is_close(applied: float, requested: float) -> bool:
    """True if a setting is the requested one within the tolerance, or unknown to the device (NaN).

    >>> is_close(0.01001, 0.01), is_close(0.02, 0.01), is_close(math.nan, 0.01)
    (True, False, True)
    """
    return math.isnan(applied) or abs(applied - requested) <= SETTING_TOLERANCE * abs(requested) + 1e-12


def _describe_error(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


# ---- Bench


@dataclass(frozen=True, slots=True)
class ReferenceLevels:
    """White and black of the projector in one camera.

    lit : (H, W) bool, pixels that the projector lights. white, black : their mean, DN.
    """

    lit: NDArray[np.bool_]
    white: float
    black: float

    def level(self, image: Pixels) -> float:
        """Return the level of a frame. Raises ExpectationError: its shape differs from that of earlier frames."""
        expect(
            image.shape == self.lit.shape,
            expected=f"every frame of a camera has one shape, {self.lit.shape}",
            found=image.shape,
            remedy="deliver frames of the extent that info.format declares",
        )
        return (float(image[self.lit].mean()) - self.black) / (self.white - self.black)


class RigBench:
    """A rig under examination. For use by one thread.

    open_rig : opens the rig; called again after `close`. sequence : patterns that its projector can show; most checks
    need white and black first.
    """

    def __init__(self, open_rig: Callable[[], Rig], sequence: PatternSequence) -> None:
        self._open_rig = open_rig
        self._rig: Rig | None = None
        self.reference_levels: dict[str, ReferenceLevels] = {}
        self.sequence = sequence
        self.now_ns = 0

    @property
    def rig(self) -> Rig:
        """The open rig. Raises the errors of opening it."""
        if self._rig is None:
            # A rendered rig starts a new clock.
            self.now_ns = 0
            self._rig = self._open_rig()
        return self._rig

    @property
    def short_sequence(self) -> PatternSequence:
        """The first patterns of the sequence, for checks that need only a few."""
        count = min(len(self.sequence), 4)
        return PatternSequence(self.sequence.projector, self.sequence.patterns[:count], self.sequence.profiles[:count])

    def reopen(self) -> Rig:
        """Return the rig, opened if it was closed. Raises ExpectationError if it does not open."""
        with expect_no_error(
            expected="a rig opens again after it was closed",
            remedy="release the device completely in close: handles, threads, locks",
        ):
            _ = self.rig
        return self.rig

    def close(self) -> None:
        """Close the rig, in any state. Idempotent."""
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()

    def set_to_rest(self) -> None:
        """Leave the rig, if it is open, dark and disarmed for the next check."""
        if self._rig is not None:
            for camera in self._rig.cameras.values():
                camera.disarm()
            self._rig.projector.blank()

    def remember_instant(self, t_ns: int) -> None:
        """Remember a past instant, ns on the rig's clock, after which later frames have to begin."""
        self.now_ns = max(self.now_ns, t_ns)

    def settings(self, name: str) -> CameraSettings:
        """Return the settings of the rig file for a camera or, without any, the defaults."""
        return self.rig.settings.get(name) or default_settings(self.rig.cameras[name])

    def stepped_cameras(self, *, every: bool = False) -> Iterator[tuple[str, Trigger]]:
        """Yield each camera that can follow a stepping projector with its best trigger, or with every trigger."""
        for name, camera in self.rig.cameras.items():
            possible = [trigger for trigger in STEPPED_TRIGGERS if trigger in camera.info.triggers]
            for trigger in possible if every else possible[:1]:
                yield name, trigger

    @contextmanager
    def arm_camera(self, name: str, trigger: Trigger, *, load: bool = True) -> Iterator[ArmedCamera]:
        """Configure and arm a camera, and load the sequence; disarm the camera afterwards."""
        with on_device(f"camera '{name}', {trigger} trigger"):
            camera = self.rig.cameras[name]
            camera.disarm()
            applied = camera.configure(self.settings(name))
            if load:
                self.rig.projector.load(self.sequence)
            camera.arm(MAX_FRAMES, trigger)
            try:
                yield ArmedCamera(self, name, trigger, self.rig.projector, camera, applied)
            except BaseException:
                # The error that ended the block matters most.
                with suppress(Exception):
                    camera.disarm()
                raise
            camera.disarm()


@dataclass(frozen=True, slots=True)
class ArmedCamera:
    """One armed camera, and the projector that it records."""

    bench: RigBench
    name: str
    trigger: Trigger
    projector: Projector
    camera: Camera
    applied: AppliedSettings

    @property
    def exposure_s(self) -> float:
        """The exposure in use; the default one if the camera does not know it."""
        return self.applied.exposure_s if np.isfinite(self.applied.exposure_s) else DEFAULT_EXPOSURE_S

    @property
    def timeout_s(self) -> float:
        """Longest wait for a frame."""
        return FRAME_WAIT_S + 2 * self.exposure_s

    def show(self, index: int) -> DisplayedPattern:
        """Show a pattern, and wait until its light is certain."""
        shown = self.projector.show(index)
        stable_ns = self.stable_ns(shown)
        self.bench.rig.clock.wait_until(stable_ns, threading.Event())
        self.bench.remember_instant(stable_ns)
        return shown

    def stable_ns(self, shown: DisplayedPattern) -> int:
        """Return the instant from which a pattern's light is the only one, by the known latency of the rig."""
        return stable_from_ns(shown, self.bench.rig.synchronisation)

    def start(self) -> None:
        """Start one exposure, if the camera does not run freely."""
        if self.trigger is Trigger.SOFTWARE:
            self.camera.trigger()

    def read(self, after_ns: int) -> Frame:
        """Return the next frame with its exposure after an instant."""
        frame = self.camera.read(after_ns, self.timeout_s)
        self.bench.remember_instant(frame.t_end_ns)
        return frame

    def expose(self, index: int) -> Frame:
        """Show a pattern and return a frame of it."""
        shown = self.show(index)
        self.start()
        return self.read(self.stable_ns(shown))

    def capture_current(self) -> Frame:
        """Return a frame of the present light."""
        self.start()
        # A free-running camera may still hold earlier frames; one that was triggered just now cannot.
        return self.read(self.bench.now_ns if self.trigger is Trigger.FREE else 0)

    def measure_reference(self) -> ReferenceLevels:
        """Show white and black once for each camera, and return their levels. Raises ExpectationError."""
        known = self.bench.reference_levels.get(self.name)
        if known is None:
            white, black = ([self.expose(index).image for _ in range(_REFERENCE_FRAMES)] for index in (0, 1))
            known = measure_reference_levels(white, black, full_scale=self.camera.info.format.full_scale)
            self.bench.reference_levels[self.name] = known
        return known

    def level(self, frame: Frame) -> float:
        """Return the level of a frame. Call `measure_reference` before the light that is to be measured."""
        return self.measure_reference().level(frame.image)

    def expect_level(self, frame: Frame, index: int, *, expected: str, remedy: str) -> None:
        """Expect a frame of pattern 0 to be white, one of pattern 1 to be black. Raises ExpectationError."""
        level = self.level(frame)
        expect(
            level >= MIN_WHITE_LEVEL if index == 0 else level <= MAX_BLACK_LEVEL,
            expected=expected,
            found=f"a frame of {'white' if index == 0 else 'black'} with {level:.0%} of white's light, exposed from "
            f"{frame.t_start_ns} to {frame.t_end_ns} ns",
            remedy=remedy,
        )

    def darkest_level(self) -> float:
        """Return the lowest level until it is dark, or until the projector has had its time to go dark."""
        measured = self.bench.rig.synchronisation
        late_s = 0.0 if measured is None else measured.latency_s + measured.latency_error_s
        allowed_s = min(self.projector.info.latency_s + max(late_s, 0.0), 1.0) + _SETTLE_S
        first = last = self.capture_current()
        level = self.level(first)
        for _ in range(_MAX_DARK_FRAMES):
            if level <= MAX_BLACK_LEVEL or last.t_start_ns - first.t_start_ns > allowed_s * 1e9:
                break
            last = self.capture_current()
            level = min(level, self.level(last))
        return level

    def expect_dark(self, when: str) -> None:
        """Expect that the projector is dark, and stays so. Raises ExpectationError."""
        level = self.darkest_level()
        if level <= MAX_BLACK_LEVEL:
            # A sequence that goes on has dark patterns, too.
            level = max(self.level(self.capture_current()) for _ in range(_STAYS_DARK_FRAMES))
        expect(
            level <= MAX_BLACK_LEVEL,
            expected=f"the projector is dark {when}",
            found=f"{level:.0%} of white's light",
            remedy="go dark before the call returns, in every state; a device that cannot shows a black picture",
        )

    def fill_buffers(self) -> None:
        """Wait without reading, so that a free-running camera fills its driver's buffers."""
        clock = self.bench.rig.clock
        waiting_s = min(max(6 * self.exposure_s, 0.1), 0.5)
        clock.wait_until(clock.now_ns() + round(waiting_s * 1e9), threading.Event())


def default_settings(camera: Camera) -> CameraSettings:
    """Return an exposure of one projector period and no gain, or the nearest that the camera can do."""
    min_s, max_s = camera.info.exposure_range_s
    min_gain, max_gain = camera.info.gain_range
    return CameraSettings(min(max(DEFAULT_EXPOSURE_S, min_s), max_s), min(max(1.0, min_gain), max_gain))


def measure_reference_levels(white: list[Pixels], black: list[Pixels], *, full_scale: int) -> ReferenceLevels:
    """Find the pixels that the projector lights, from two or more frames of each; the last ones count.
    Raises ExpectationError: white is not brighter than black anywhere.
    """
    shapes = {image.shape for image in (*white, *black)}
    expect(
        len(shapes) == 1,
        expected="every frame of a camera has one shape",
        found=sorted(shapes),
        remedy="deliver frames of the extent that info.format declares",
    )
    difference = _to_float(white[-1]) - _to_float(black[-1])
    threshold = max(_MIN_CONTRAST_SNR * _noise(white[-2:]), _MIN_CONTRAST_SHARE * full_scale, 2.0)
    lit = difference > threshold
    expect(
        np.count_nonzero(lit) >= max(_MIN_LIT_PIXELS, _MIN_LIT_SHARE * lit.size),
        expected="the white pattern makes the camera's image brighter than the black one",
        found=f"{np.count_nonzero(lit)} of {lit.size} pixels brighter by {threshold:.1f} DN of {full_scale}, means "
        f"{white[-1].mean():.1f} and {black[-1].mean():.1f} DN",
        remedy="point the camera at the projector's light, switch the lamp on, open the aperture, and shade the room; "
        "if the picture is right, the driver delivers frames of an earlier pattern",
    )
    return ReferenceLevels(lit, float(white[-1][lit].mean()), float(black[-1][lit].mean()))


def _to_float(image: NDArray[Any]) -> NDArray[np.float32]:
    return image.astype(np.float32)


def _noise(images: list[Pixels]) -> float:
    """Standard deviation of one frame, DN, from two of the same pattern; robust against motion."""
    difference = _to_float(images[-1]) - _to_float(images[0])
    return 1.4826 * float(np.median(np.abs(difference - np.median(difference)))) / float(np.sqrt(2))


# ---- Checks


class Need(Enum):
    """Property that a rig must have for a check to apply."""

    STEPPED = "a camera with software trigger or a free-running one"
    SOFTWARE = "a camera with software trigger"
    FREE = "a free-running camera"
    HARDWARE = "a camera that is triggered by wire"
    PLAYS = "a projector that plays sequences by itself, and a camera that it triggers by wire"
    WHITE_AND_BLACK = "a sequence that begins with white and black"
    POSITIONER = "a positioner"

    def unmet_reason(self, rig: Rig, sequence: PatternSequence) -> str | None:
        """Return the reason why the check does not apply to this rig; None if it does."""
        declared = {trigger for camera in rig.cameras.values() for trigger in camera.info.triggers}
        met: bool
        match self:
            case Need.STEPPED:
                met = not declared.isdisjoint(STEPPED_TRIGGERS)
            case Need.SOFTWARE:
                met = Trigger.SOFTWARE in declared
            case Need.FREE:
                met = Trigger.FREE in declared
            case Need.HARDWARE:
                met = Trigger.HARDWARE in declared
            case Need.PLAYS:
                met = rig.projector.info.plays and Trigger.HARDWARE in declared
            case Need.WHITE_AND_BLACK:
                met = sequence.patterns[:2] == (White(), Black())
            case Need.POSITIONER:
                met = rig.positioner is not None
        return None if met else f"it needs {self.value}"


@dataclass(frozen=True, slots=True)
class Check:
    """One requirement of the contract on the devices of a rig.

    needs : properties that the rig must have. fresh : True if the rig must have been opened just now, and is closed
    afterwards; other checks share one. function : raises ExpectationError or NotApplicableError.
    """

    name: str
    title: str
    needs: tuple[Need, ...]
    fresh: bool
    function: Callable[[RigBench], None]


def check(*needs: Need, fresh: bool = False) -> Callable[[Callable[[RigBench], None]], Check]:
    """Make a check of the decorated function: its name is the check's, its docstring's first line the title."""

    def decorate(function: Callable[[RigBench], None]) -> Check:
        name = function.__name__
        # Python may run without docstrings.
        title = (function.__doc__ or name.replace("_", " ")).splitlines()[0].removesuffix(".")
        return Check(name, title, needs, fresh, function)

    return decorate


def camera_check(*needs: Need, every: bool = False) -> Callable[[Callable[[ArmedCamera], None]], Check]:
    """Make a check that calls the decorated function for each camera of `RigBench.stepped_cameras`.

    It applies if it applies to one of them.
    """

    def decorate(function: Callable[[ArmedCamera], None]) -> Check:
        @wraps(function)
        def check_each(bench: RigBench) -> None:
            reasons: list[str] = []
            applies = False
            for name, trigger in bench.stepped_cameras(every=every):
                with bench.arm_camera(name, trigger) as armed:
                    try:
                        function(armed)
                        applies = True
                    except NotApplicableError as reason:
                        reasons.append(f"camera '{name}' {reason}")
            if not applies:
                raise NotApplicableError("; ".join(reasons))

        return check(Need.STEPPED, *needs)(check_each)

    return decorate
