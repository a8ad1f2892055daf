"""Where a rig stands to be examined: opened when needed, shared by the checks, and looked at through its cameras.

How bright a camera sees the projector is told by its level: white is 1, black is 0, whatever the room, the noise and
the sensor are.
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

from slrig.capture import stable_from_ns
from slrig.devices import AppliedSettings, Camera, CameraSettings, DisplayedPattern, Projector, Rig, Trigger
from slrig.errors import SlrigError
from slrig.model import Black, Frame, PatternSequence, Pixels, White

TOLERANCE = 0.01
"""How far an exposure or a gain may be from what was asked, as a fraction."""

STEPPED = (Trigger.SOFTWARE, Trigger.FREE)
"""The triggers with which a camera can follow a projector that steps; the better one first."""


@dataclass(frozen=True, slots=True)
class Failure:
    """One broken expectation: which device, what was asked of it, what was found, and what its driver's author does."""

    asked: str
    found: str
    do: str
    where: str = ""

    def __str__(self) -> str:
        device = f"{self.where}: " if self.where else ""
        return f"{device}{self.asked}; found {self.found}; {self.do}"


class ExpectationError(Exception):
    """A device does not do what the contract asks of it. Raised by checks only, and kept in their result."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(str(failure))
        self.failure = failure


class NotApplicableError(Exception):
    """A check found out, once at work, that it has nothing to ask of these devices. The message says why."""


def expect(condition: object, *, asked: str, found: object, do: str) -> None:
    """Go on if the condition holds. Raises ExpectationError."""
    if not condition:
        raise ExpectationError(Failure(asked, str(found), do))


@contextmanager
def refused(error: type[SlrigError], *, asked: str, do: str) -> Iterator[None]:
    """Expect that the block raises `error`. Raises ExpectationError if it raises another, or none."""
    asked = f"{asked} is refused with {error.__name__}"
    try:
        yield
    except error:
        return
    except Exception as other:
        raise ExpectationError(Failure(asked, _named(other), do)) from other
    raise ExpectationError(Failure(asked, "no error", do))


@contextmanager
def works(*, asked: str, do: str) -> Iterator[None]:
    """Expect that the block raises nothing. Raises ExpectationError."""
    try:
        yield
    except Exception as error:
        raise ExpectationError(Failure(asked, _named(error), do)) from error


@contextmanager
def at(where: str) -> Iterator[None]:
    """Name the device in whatever goes wrong within the block; errors of a driver become failures of the check."""
    try:
        yield
    except ExpectationError as error:
        if error.failure.where:
            raise
        raise ExpectationError(replace(error.failure, where=where)) from error
    except NotApplicableError:
        raise
    except Exception as error:
        raise ExpectationError(replace(failure_of(error), where=where)) from error


def failure_of(error: Exception) -> Failure:
    """What an error means that came out of a device where none was due."""
    if isinstance(error, ExpectationError):
        return error.failure
    do = (
        "correct the rig as the message says, or the driver if it is wrong"
        if isinstance(error, SlrigError)
        else "a driver raises the errors of slrig.errors, and no others"
    )
    return Failure("no error comes from a call that the contract allows", _named(error), do)


def near(got: float, asked: float) -> bool:
    """Whether a setting is what was asked, within the tolerance. What a device cannot tell (NaN) is no contradiction.

    >>> near(0.01001, 0.01), near(0.02, 0.01), near(math.nan, 0.01)
    (True, False, True)
    """
    return math.isnan(got) or abs(got - asked) <= TOLERANCE * abs(asked) + 1e-12


def _named(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if str(error) else type(error).__name__


SHORT_S = 0.05
"""How long a frame is waited for that must not come."""

LONG_S = 5.0
"""How long a frame is waited for that must come, beyond its exposure."""

FRAMES = 256
"""Room for as many frames as any check takes from a camera that it armed once."""

USUAL_EXPOSURE_S = 1 / 60  # one period of a usual projector

LIT = 0.8
"""From this level on, a frame shows white."""

DARK = 0.2
"""Up to this level, a frame shows black."""

_LEAST_PIXELS = 16
_LEAST_SHARE = 0.001
_LEAST_OF_FULL_SCALE = 0.01
_NOISES = 6.0  # so far above it lies no pixel by chance

_SETTLE_S = 0.1  # beyond the latency that is declared and measured
_MOST_LOOKS = 64  # where the times of frames do not tell that it is over
_LEARNT_FROM = 3  # frames of each: the last two tell the noise


@dataclass(frozen=True, slots=True)
class Light:
    """What one camera sees of the projector, learnt from a white and a black frame.

    lit : (H, W) bool, pixels that the projector lights. white, black : their mean in DN.
    """

    lit: NDArray[np.bool_]
    white: float
    black: float

    def level(self, image: Pixels) -> float:
        """How much of the projector's white is in a frame: 0 for black, 1 for white.
        Raises ExpectationError: the frame has another shape than those before it.
        """
        expect(
            image.shape == self.lit.shape,
            asked=f"every frame of a camera has one shape, {self.lit.shape}",
            found=image.shape,
            do="deliver frames of the extent that info.format declares",
        )
        return (float(image[self.lit].mean()) - self.black) / (self.white - self.black)


class RigBench:
    """A rig under examination. One thread uses it.

    open_rig : opens the rig afresh; called again after `close`. sequence : patterns that its projector can show; most
    checks want white and black first.
    """

    def __init__(self, open_rig: Callable[[], Rig], sequence: PatternSequence) -> None:
        self._open_rig = open_rig
        self._rig: Rig | None = None
        self.lights: dict[str, Light] = {}
        self.sequence = sequence
        self.now_ns = 0

    @property
    def rig(self) -> Rig:
        """The open rig. Raises what opening it raises."""
        if self._rig is None:
            # A rendered rig begins a time of its own.
            self.now_ns = 0
            self._rig = self._open_rig()
        return self._rig

    @property
    def opening(self) -> PatternSequence:
        """The first patterns of the sequence, where a few are enough."""
        few = min(len(self.sequence), 4)
        return PatternSequence(self.sequence.projector, self.sequence.patterns[:few], self.sequence.profiles[:few])

    def opened_again(self) -> Rig:
        """Return the rig, opened if it was closed. Raises ExpectationError where it does not open."""
        with works(
            asked="a rig opens again after it was closed",
            do="close lets the device go entirely: handles, threads, locks",
        ):
            _ = self.rig
        return self.rig

    def close(self) -> None:
        """Close the rig, whatever state it is in. Idempotent."""
        rig, self._rig = self._rig, None
        if rig is not None:
            rig.close()

    def rest(self) -> None:
        """Leave the rig, if it is open, dark and disarmed for the next check."""
        if self._rig is not None:
            for camera in self._rig.cameras.values():
                camera.disarm()
            self._rig.projector.blank()

    def noted(self, t_ns: int) -> None:
        """Remember an instant that has passed, ns on the rig's clock: later frames may be asked to begin after it."""
        self.now_ns = max(self.now_ns, t_ns)

    def settings(self, name: str) -> CameraSettings:
        """What the rig file asks of a camera, else one period of a usual projector, within what the camera can."""
        return self.rig.settings.get(name) or usual_settings(self.rig.cameras[name])

    def ways(self, *, every: bool = False) -> Iterator[tuple[str, Trigger]]:
        """Each camera that can follow a stepping projector, with its best trigger for that, or with every one."""
        for name, camera in self.rig.cameras.items():
            possible = [trigger for trigger in STEPPED if trigger in camera.info.triggers]
            for trigger in possible if every else possible[:1]:
                yield name, trigger

    @contextmanager
    def view(self, name: str, trigger: Trigger, *, load: bool = True) -> Iterator[View]:
        """A camera, set and armed, before the projector with its sequence loaded; disarmed afterwards."""
        with at(f"camera '{name}', {trigger} trigger"):
            camera = self.rig.cameras[name]
            camera.disarm()
            applied = camera.configure(self.settings(name))
            if load:
                self.rig.projector.load(self.sequence)
            camera.arm(FRAMES, trigger)
            try:
                yield View(self, name, trigger, self.rig.projector, camera, applied)
            except BaseException:
                # The error that ended the block is the one to tell.
                with suppress(Exception):
                    camera.disarm()
                raise
            camera.disarm()


@dataclass(frozen=True, slots=True)
class View:
    """One armed camera before the projector."""

    bench: RigBench
    name: str
    trigger: Trigger
    projector: Projector
    camera: Camera
    applied: AppliedSettings

    @property
    def exposure_s(self) -> float:
        """The exposure in use; a usual one where the camera cannot tell."""
        return self.applied.exposure_s if np.isfinite(self.applied.exposure_s) else USUAL_EXPOSURE_S

    @property
    def patience_s(self) -> float:
        """How long a frame may take."""
        return LONG_S + 2 * self.exposure_s

    def show(self, index: int) -> DisplayedPattern:
        """Show a pattern; the instant from which its light is certain is remembered."""
        shown = self.projector.show(index)
        stable_ns = self.stable_ns(shown)
        self.bench.rig.clock.wait_until(stable_ns, threading.Event())
        self.bench.noted(stable_ns)
        return shown

    def stable_ns(self, shown: DisplayedPattern) -> int:
        """The instant from which a pattern's light is the only one, as far as the rig's latency is known."""
        return stable_from_ns(shown, self.bench.rig.synchronisation)

    def start(self) -> None:
        """Start one exposure, if somebody has to."""
        if self.trigger is Trigger.SOFTWARE:
            self.camera.trigger()

    def read(self, after_ns: int) -> Frame:
        """Return the next frame that was exposed wholly after an instant."""
        frame = self.camera.read(after_ns, self.patience_s)
        self.bench.noted(frame.t_end_ns)
        return frame

    def expose(self, index: int) -> Frame:
        """Show a pattern and return a frame of it."""
        shown = self.show(index)
        self.start()
        return self.read(self.stable_ns(shown))

    def look(self) -> Frame:
        """Return a frame of whatever is shown now."""
        self.start()
        # A camera that runs by itself may still hold frames from before; one that was triggered just now cannot.
        return self.read(self.bench.now_ns if self.trigger is Trigger.FREE else 0)

    def learn(self) -> Light:
        """Find out how white and black look, once for each camera: shows both. Raises ExpectationError."""
        known = self.bench.lights.get(self.name)
        if known is None:
            white, black = ([self.expose(index).image for _ in range(_LEARNT_FROM)] for index in (0, 1))
            known = learn_light(white, black, full_scale=self.camera.info.format.full_scale)
            self.bench.lights[self.name] = known
        return known

    def level(self, frame: Frame) -> float:
        """How much of the projector's white is in a frame. Call `learn` first, before what is to be looked at."""
        return self.learn().level(frame.image)

    def expect_level(self, frame: Frame, index: int, *, asked: str, do: str) -> None:
        """Expect a frame of pattern 0 to be white, one of pattern 1 to be black. Raises ExpectationError."""
        level = self.level(frame)
        expect(
            level >= LIT if index == 0 else level <= DARK,
            asked=asked,
            found=f"a frame of {'white' if index == 0 else 'black'} with {level:.0%} of white's light, exposed from "
            f"{frame.t_start_ns} to {frame.t_end_ns} ns",
            do=do,
        )

    def darkest(self) -> float:
        """The level of what is shown now, looked at until it is dark or the projector has had its time to go dark."""
        measured = self.bench.rig.synchronisation
        late_s = 0.0 if measured is None else measured.latency_s + measured.latency_error_s
        allowed_s = min(self.projector.info.latency_s + max(late_s, 0.0), 1.0) + _SETTLE_S
        first = last = self.look()
        level = self.level(first)
        for _ in range(_MOST_LOOKS):
            if level <= DARK or last.t_start_ns - first.t_start_ns > allowed_s * 1e9:
                break
            last = self.look()
            level = min(level, self.level(last))
        return level

    def expect_dark(self, when: str) -> None:
        """Expect that the projector is dark now. Raises ExpectationError."""
        level = self.darkest()
        expect(
            level <= DARK,
            asked=f"the projector is dark {when}",
            found=f"{level:.0%} of white's light",
            do="go dark before the call returns, in whatever state; a device that cannot shows a black picture",
        )

    def let_frames_pile_up(self) -> None:
        """Let time pass in which nobody reads, so that a camera that runs by itself fills its driver's buffers."""
        clock = self.bench.rig.clock
        waited_s = min(max(6 * self.exposure_s, 0.1), 0.5)
        clock.wait_until(clock.now_ns() + round(waited_s * 1e9), threading.Event())


def usual_settings(camera: Camera) -> CameraSettings:
    """One period of a usual projector and no gain, within what a camera can."""
    least_s, most_s = camera.info.exposure_range_s
    least, most = camera.info.gain_range
    return CameraSettings(min(max(USUAL_EXPOSURE_S, least_s), most_s), min(max(1.0, least), most))


def learn_light(white: list[Pixels], black: list[Pixels], *, full_scale: int) -> Light:
    """Find out which pixels the projector lights, from two or more frames of each; the last ones count.
    Raises ExpectationError: white is not brighter than black anywhere.
    """
    shapes = {image.shape for image in (*white, *black)}
    expect(
        len(shapes) == 1,
        asked="every frame of a camera has one shape",
        found=sorted(shapes),
        do="deliver frames of the extent that info.format declares",
    )
    difference = _signed(white[-1]) - _signed(black[-1])
    threshold = max(_NOISES * _noise(white[-2:]), _LEAST_OF_FULL_SCALE * full_scale, 2.0)
    lit = difference > threshold
    expect(
        np.count_nonzero(lit) >= max(_LEAST_PIXELS, _LEAST_SHARE * lit.size),
        asked="the white pattern makes the camera's image brighter than the black one",
        found=f"{np.count_nonzero(lit)} of {lit.size} pixels brighter by {threshold:.1f} DN of {full_scale}, means "
        f"{white[-1].mean():.1f} and {black[-1].mean():.1f} DN",
        do="point the camera at what the projector lights, switch the lamp on, open the aperture, and shade the room; "
        "if the picture is right, the driver delivers frames of an earlier pattern",
    )
    return Light(lit, float(white[-1][lit].mean()), float(black[-1][lit].mean()))


def _signed(image: NDArray[Any]) -> NDArray[np.float32]:
    return image.astype(np.float32)


def _noise(images: list[Pixels]) -> float:
    """Standard deviation of one frame, DN, from two of the same pattern; robust against what moves."""
    off = _signed(images[-1]) - _signed(images[0])
    return 1.4826 * float(np.median(np.abs(off - np.median(off)))) / float(np.sqrt(2))


class Need(Enum):
    """What a rig must have for a check to say anything."""

    STEPPED = "a camera with software trigger or a free-running one"
    SOFTWARE = "a camera with software trigger"
    FREE = "a free-running camera"
    HARDWARE = "a camera that is triggered by wire"
    PLAYS = "a projector that plays sequences by itself, and a camera that it triggers by wire"
    WHITE_AND_BLACK = "a sequence that begins with white and black"
    POSITIONER = "a positioner"

    def unmet(self, rig: Rig, sequence: PatternSequence) -> str | None:
        """Why the check does not apply to this rig, in words; None if it does."""
        declared = {trigger for camera in rig.cameras.values() for trigger in camera.info.triggers}
        met: bool
        match self:
            case Need.STEPPED:
                met = not declared.isdisjoint(STEPPED)
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
    """One thing that the contract asks of the devices of a rig.

    title : in plain words. needs : what the rig must have. fresh : whether it wants a rig that was opened just now, and
    is closed afterwards; the others share one. function : raises ExpectationError or NotApplicableError.
    """

    name: str
    title: str
    needs: tuple[Need, ...]
    fresh: bool
    function: Callable[[RigBench], None]


def check(*needs: Need, fresh: bool = False) -> Callable[[Callable[[RigBench], None]], Check]:
    """Make a check of the function below: its name is the check's, its docstring's first line the title."""

    def made(function: Callable[[RigBench], None]) -> Check:
        name = function.__name__
        # Python may be told to leave docstrings out.
        title = (function.__doc__ or name.replace("_", " ")).splitlines()[0].removesuffix(".")
        return Check(name, title, needs, fresh, function)

    return made


def view_check(*needs: Need, every: bool = False) -> Callable[[Callable[[View], None]], Check]:
    """Make a check of what the function below asks of one camera before the projector: each of `RigBench.ways`.

    It applies where it does to one of them.
    """

    def made(function: Callable[[View], None]) -> Check:
        @wraps(function)
        def of_each(bench: RigBench) -> None:
            reasons: list[str] = []
            applies = False
            for name, trigger in bench.ways(every=every):
                with bench.view(name, trigger) as view:
                    try:
                        function(view)
                        applies = True
                    except NotApplicableError as reason:
                        reasons.append(f"camera '{name}' {reason}")
            if not applies:
                raise NotApplicableError("; ".join(reasons))

        return check(Need.STEPPED, *needs)(of_each)

    return made
