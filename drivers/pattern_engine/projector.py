"""Projectors with a pattern engine: hold a shown pattern while the host lives, and darken the engine on every path.

Engines with a USB port are dim until the polarity of their LED current is known.
"""

from __future__ import annotations

import hashlib
import math
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from drivers.pattern_engine.options import LightOptions, UsbLightOptions
from drivers.pattern_engine.usb import UsbCommand, UsbEngine
from slrig.devices import Clock, DisplayedPattern, ProjectorInfo, ProjectorState, SystemClock
from slrig.errors import DeviceGoneError, SlrigError, UnsupportedByDeviceError
from slrig.model import Black, Gray, LineShift, Pattern, PatternSequence, Primary, Sine, White

MAX_UNATTENDED_S = 2.0
"""Time after the death of its host in which a shown pattern becomes dark."""


Plane = NDArray[np.bool_]
"""(H, W) bool: mirrors that send light."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Duration of each pattern's light and period of the patterns, whole microseconds."""

    exposure_us: int
    period_us: int

    @property
    def dark_between(self) -> bool:
        """True if the mirrors are cleared after each pattern."""
        return self.exposure_us < self.period_us


def light_duration_us(exposure_s: float, period_s: float, *, margin_s: float, least_us: int, dark_us: int = 0) -> int:
    """Duration of the light for an exposure of `exposure_s`, whole microseconds.

    margin_s : light beyond the exposure, for the camera's delay from the pulse to its first row. least_us : the
    engine's shortest light. dark_us : dark time that the engine needs between two patterns. Raises
    UnsupportedByDeviceError if it does not fit into the period.
    """
    period_us = round(period_s * 1e6)
    wanted_us = max(round((exposure_s + margin_s) * 1e6), least_us)
    if exposure_s <= 0 or wanted_us + dark_us > period_us:
        dark = f" and the dark after it {dark_us} µs" if dark_us else ""
        message = (
            f"requested {exposure_s:.6f} s of light every {period_s:.6f} s: with {margin_s:.6f} s for the cameras to "
            f"start, light takes {wanted_us} µs{dark}, the period is {period_us} µs; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)
    return wanted_us


def check_duty(timing: Timing, duty_limit: float) -> None:
    """Raise UnsupportedByDeviceError if the light exceeds the duty limit of the rig file."""
    duty = timing.exposure_us / timing.period_us
    if duty > duty_limit:
        message = (
            f"requested {timing.exposure_us} µs of light every {timing.period_us} µs: light is on for {duty:.0%} of "
            f"the time, duty_limit of the rig file allows {duty_limit:.0%}; lengthen the period, or shorten exposure_s"
        )
        raise UnsupportedByDeviceError(message)


def pattern_plane(sequence: PatternSequence, index: int) -> Plane:
    """Return the mirrors of pattern `index`. Raises UnsupportedByDeviceError unless it is black and white only."""
    profile = sequence.profiles[index]
    lit: NDArray[np.bool_] = profile == np.iinfo(profile.dtype).max
    if not (lit | (profile == 0)).all():
        message = (
            f"pattern {index} has shades of grey, and this driver plays patterns of 1 bit: use lines, or connect the "
            "engine's video input and drive it as a display (driver screen or kms), which shows 8 bits"
        )
        raise UnsupportedByDeviceError(message)
    return np.broadcast_to(lit, sequence.projector.shape)


def plane_keys(plane: Plane) -> tuple[bytes, bytes]:
    """Return keys of a plane and of its inverse: SHA-256 of their bits."""
    bits = np.packbits(plane)
    return hashlib.sha256(bits.tobytes()).digest(), hashlib.sha256((~bits).tobytes()).digest()


def describe_pattern(pattern: Pattern) -> str:
    """Return a short description of a pattern."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Primary():
            return pattern.description
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            return f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}, cell {pattern.cell_px} px{inverse}"
        case LineShift():
            width = f", {pattern.line_width_px} px wide" if pattern.line_width_px > 1 else ""
            return f"{pattern.axis} lines {pattern.shift} of {pattern.period_px}{width}"
        case Sine():
            return f"{pattern.axis} sinusoid, period {pattern.period_px:g} px, shift {pattern.shift} of {pattern.steps}"


WAKE_TIMEOUT_S = 10.0
"""Longest time for an engine to wake up."""
START_TIMEOUT_S = 2.0
COMMANDS_S = 0.04
"""Typical time for the commands of one `show`: a dozen, of about 3 ms each."""
DIM_TIMING = Timing(1_250, 15_000)
"""Light for a twelfth of the time: 4.2 % of the maximum at half current, and never above 5 % at 60 %."""
_HALF_CURRENT = 128
"""Half of the maximum current, for either polarity of the register."""
EngineT = TypeVar("EngineT", bound=UsbEngine)


class LightSource(Protocol):
    """Light control of an engine."""

    def switch_leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        ...

    def restart(self) -> None:
        """Stop the current sequence, and start it again."""
        ...

    def stop(self) -> None:
        """Stop the sequence."""
        ...

    def close(self) -> None:
        """Close the engine. Idempotent."""
        ...


SourceT = TypeVar("SourceT", bound=LightSource)


class EngineProjector(ABC, Generic[SourceT]):
    """Implements `slrig.devices.Projector` as far as all engines are alike.

    Subclasses call `_initialise` at the end of their constructor, and `_hold_pattern` when a shown pattern has begun.
    `_lock` keeps sequences of commands together. clock : the rig's; default: the system's.
    """

    def __init__(self, engine: SourceT, options: LightOptions, *, clock: Clock | None = None) -> None:
        self._engine = engine
        self._clock = clock or SystemClock()
        self._light = options
        self._state = ProjectorState("the light engine")
        self._lock = threading.RLock()
        self._held_until_s = self._next_restart_s = self._restart_interval_s = 0.0
        self._dark_at_s = math.inf
        self._info: ProjectorInfo

    @abstractmethod
    def _wake(self) -> None:
        """Darken the engine first, and return when it takes commands."""

    @abstractmethod
    def _prepare(self) -> ProjectorInfo:
        """Check the engine against the rig file, and set what never changes. It is awake and dark."""

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`. It steps, and it plays with a pulse on a trigger output per pattern."""
        return self._info

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. Switches the LEDs off, then stops the sequence; tries both even if one fails."""
        with self._lock:
            faults = [] if self._state.closed.is_set() else self._darken()
        # With the LEDs off it is dark, but an engine that disobeys is an error.
        if faults:
            raise faults[0]

    def close(self) -> None:
        """See `Projector`."""
        # End all waits for light.
        already = self._state.closed.is_set()
        self._state.closed.set()
        with self._lock:
            if not already:
                self._shut_down()

    def _initialise(self) -> None:
        """Wake the engine, darken it first, and prepare it; close it if that fails."""
        try:
            self._wake()
            self._info = self._prepare()
        except BaseException:
            self._shut_down()
            raise
        threading.Thread(target=self._hold_loop, name="light engine", daemon=True).start()

    def _hold_pattern(self, alone_s: float, *, again_s: float) -> None:
        """Hold the pattern that has just begun and ends on its own after `alone_s`; restart it every `again_s`."""
        now_s = self._now_s()
        self._held_until_s = now_s + self._light.hold_s
        self._next_restart_s, self._restart_interval_s = now_s + alone_s / 2, again_s

    def _wait_for_light(self, index: int, earliest_ns: int, latest_ns: int) -> DisplayedPattern:
        """Wait until the latest instant at which light can begin."""
        self._clock.wait_until(latest_ns, self._state.closed)
        self._state.require_open()
        return DisplayedPattern(index, (earliest_ns + latest_ns) // 2, (latest_ns - earliest_ns + 1) // 2)

    def _now_s(self) -> float:
        return self._clock.now_ns() / 1e9

    def _hold_loop(self) -> None:
        """Restart the shown pattern before the engine ends it, which proves that this program runs. End a sequence
        that does not end on its own at `_dark_at_s`. Runs until `close`.
        """
        while True:
            self._clock.wait_until(self._clock.now_ns() + round(MAX_UNATTENDED_S * 1e9 / 20), self._state.closed)
            if self._state.closed.is_set():
                return
            # Another call that has the lock changes the light; it may wait for the engine.
            if self._lock.acquire(blocking=False):
                try:
                    self._hold()
                finally:
                    self._lock.release()

    def _hold(self) -> None:
        now_s = self._now_s()
        if now_s >= self._dark_at_s:
            self._darken()
        if not self._next_restart_s <= now_s < self._held_until_s:
            return
        self._next_restart_s = now_s + self._restart_interval_s
        try:
            self._engine.restart()
        except SlrigError:
            # The next call of the user reports it; until then the engine goes dark on its own.
            self._held_until_s = 0.0

    def _darken(self) -> list[SlrigError]:
        """Switch the LEDs off, then stop; try both even if one fails. Return the errors."""
        self._held_until_s, self._dark_at_s = 0.0, math.inf
        faults: list[SlrigError] = []
        for darken in (partial(self._engine.switch_leds, by_sequence=False), self._engine.stop):
            try:
                darken()
            except SlrigError as error:
                faults.append(error)
        return faults

    def _before_close(self) -> None:
        """Hook called before the engine is closed. It is dark."""

    def _shut_down(self) -> None:
        """Darken the engine as far as possible, and close it."""
        self._darken()
        with suppress(SlrigError):
            self._before_close()
        self._state.loaded = None
        self._state.closed.set()
        self._engine.close()


class UsbEngineProjector(EngineProjector[EngineT], ABC):
    """Implements `slrig.devices.Projector` and `UnknownPolarityProjector` on an engine with a USB port."""

    def __init__(self, engine: EngineT, options: UsbLightOptions, *, clock: Clock | None = None) -> None:
        super().__init__(engine, options, clock=clock)
        self._light: UsbLightOptions = options

    @property
    def is_polarity_unknown(self) -> bool:
        """See `UnknownPolarityProjector`."""
        return self._light.led_current_inverted is None

    @property
    def light_period_s(self) -> float:
        """See `UnknownPolarityProjector`."""
        return DIM_TIMING.period_us / 1e6

    def set_trial_current(self, share: float) -> None:
        """See `UnknownPolarityProjector`."""
        if not self.is_polarity_unknown or not 0.4 <= share <= 0.6:
            message = f"cannot try a current of {share:g}: only 0.4 to 0.6 is allowed while its polarity is unknown"
            raise UnsupportedByDeviceError(message)
        with self._lock:
            self._state.require_open()
            self._stop_for_settings()
            self._engine.set_led_registers(bytes([round(share * 255)] * 3))

    def polarity_option(self, *, rises: bool) -> str:
        """See `UnknownPolarityProjector`."""
        inverted = rises == self._engine.is_led_polarity_inverted
        return f"led_current_inverted = {str(inverted).lower()}"

    def _wake(self) -> None:
        # An engine in standby is dark, and accepts no other command.
        if self._engine.byte(UsbCommand.POWER) & 1:
            self._engine.set_byte(UsbCommand.POWER, 0)
        else:
            for fault in self._darken():
                if isinstance(fault, DeviceGoneError):
                    raise fault
        self._engine.wait_until_initialised(WAKE_TIMEOUT_S)
        self.blank()

    def _enter_mode(self, mode: int) -> None:
        """Set the display mode, unless it is set. A change of mode may start the engine's default sequence: stop it."""
        if self._engine.byte(UsbCommand.DISPLAY_MODE) != mode:
            self._engine.settle_byte(UsbCommand.DISPLAY_MODE, mode)
        self._stop_for_settings()

    def _stop_for_settings(self) -> None:
        """Darken the engine, and wait until it takes settings."""
        self.blank()
        self._engine.wait_until_stopped()

    def _configure_leds(self) -> None:
        """Reset mirroring and inversion, and set the LED current: half of it if its polarity is unknown."""
        engine, light = self._engine, self._light
        for unchanged in (UsbCommand.FLIP_LONG, UsbCommand.FLIP_SHORT, UsbCommand.INVERT_DATA):
            engine.settle_byte(unchanged, 0)
        if light.led_current_inverted is None:
            engine.set_led_registers(bytes([_HALF_CURRENT] * 3))
        else:
            engine.set_led_current(light.colour, light.current_byte, inverted=light.led_current_inverted)

    def _require_known_polarity(self) -> None:
        if self.is_polarity_unknown:
            message = (
                "cannot play: the polarity of the LED current is unknown, and light is dim until then; "
                "run slrig doctor, which determines it and names the line for the rig file"
            )
            raise UnsupportedByDeviceError(message)
