"""A pattern engine with a USB port as a projector, as far as these are alike: woken, and dim until proven."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from functools import partial
from typing import Generic, Protocol, TypeVar

from drivers.pattern_engine.options import LightOptions, UsbLightOptions
from drivers.pattern_engine.patterns import MAX_UNATTENDED_S, Timing
from drivers.pattern_engine.usb import UsbCommand, UsbEngine
from slrig.devices import Clock, ProjectorInfo, ProjectorState, Shown, SystemClock
from slrig.errors import DeviceGoneError, SlrigError, UnsupportedByDeviceError

WAKE_TIMEOUT_S = 10.0
"""How long an engine may take to wake up."""
START_TIMEOUT_S = 2.0
COMMANDS_S = 0.04
"""What the commands of one `show` take, typically: a dozen, of about 3 ms each."""
DIM_TIMING = Timing(1_250, 15_000)
"""Light for a twelfth of the time: at half current that is 4.2 % of the most, and never above 5 % at 60 %."""
_HALF_CURRENT = 128
"""A current that is half of the most, whichever way the register counts."""
EngineT = TypeVar("EngineT", bound=UsbEngine)


class LightSource(Protocol):
    """An engine, as far as light goes. `start` begins anew what was told last."""

    def switch_leds(self, *, by_sequence: bool) -> None:
        """Let the sequence switch the LEDs, or switch them all off."""
        ...

    def start(self) -> None:
        """Start the sequence that was set."""
        ...

    def stop(self) -> None:
        """Stop the sequence."""
        ...

    def close(self) -> None:
        """Let the engine go. Idempotent."""
        ...


SourceT = TypeVar("SourceT", bound=LightSource)


class EngineProjector(ABC, Generic[SourceT]):
    """What implements `slrig.devices.Projector` on any engine, as far as engines are alike.

    A kind of engine calls `_initialise` when it is constructed, and `_hold_pattern` when it has begun what it shows.
    `_lock` keeps the engine's commands together. clock : the rig's; else the system's.
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
        """Darken the engine first of all, and return when it takes commands."""

    @abstractmethod
    def _prepare(self) -> ProjectorInfo:
        """Look whether the engine is what the rig file says, and set what never changes. It is awake and dark."""

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`. It steps, and it plays, with a pulse on a trigger output per pattern."""
        return self._info

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. LEDs off, then the sequence stopped: each is tried, whatever becomes of the other."""
        with self._lock:
            faults = [] if self._state.closed.is_set() else self._darken()
        # With the LEDs off it is dark, but an engine that does not do as it is told is to be known.
        if faults:
            raise faults[0]

    def close(self) -> None:
        """See `Projector`."""
        # Whoever waits for light need not wait any more.
        already = self._state.closed.is_set()
        self._state.closed.set()
        with self._lock:
            if not already:
                self._shut_down()

    def _initialise(self) -> None:
        """Wake the engine, darken it first of all, and prepare it; close it if that fails."""
        try:
            self._wake()
            self._info = self._prepare()
        except BaseException:
            self._shut_down()
            raise
        threading.Thread(target=self._hold_loop, name="light engine", daemon=True).start()

    def _hold_pattern(self, alone_s: float, *, again_s: float) -> None:
        """Hold what was begun now, and ends by itself `alone_s` later; then each `again_s`."""
        now_s = self._now_s()
        self._held_until_s = now_s + self._light.hold_s
        self._next_restart_s, self._restart_interval_s = now_s + alone_s / 2, again_s

    def _wait_for_light(self, index: int, earliest_ns: int, latest_ns: int) -> Shown:
        """Wait until the latest instant at which light can begin."""
        self._clock.wait_until(latest_ns, self._state.closed)
        self._state.require_open()
        return Shown(index, (earliest_ns + latest_ns) // 2, (latest_ns - earliest_ns + 1) // 2)

    def _now_s(self) -> float:
        return self._clock.now_ns() / 1e9

    def _hold_loop(self) -> None:
        """Start what is shown anew, before the engine ends it: it says that this program lives. End what does not
        end by itself, from `_dark_at_s` on. Runs until `close`.
        """
        while True:
            self._clock.wait_until(self._clock.now_ns() + round(MAX_UNATTENDED_S * 1e9 / 20), self._state.closed)
            if self._state.closed.is_set():
                return
            with self._lock:
                now_s = self._now_s()
                if now_s >= self._dark_at_s:
                    self._darken()
                if not self._next_restart_s <= now_s < self._held_until_s:
                    continue
                self._next_restart_s = now_s + self._restart_interval_s
                try:
                    self._engine.stop()
                    self._engine.start()
                except SlrigError:
                    # The owner's next call finds out; until then the engine goes dark by itself.
                    self._held_until_s = 0.0

    def _darken(self) -> list[SlrigError]:
        """LEDs off, then stop, each tried whatever becomes of the other. Return what the engine said against it."""
        self._held_until_s, self._dark_at_s = 0.0, math.inf
        faults: list[SlrigError] = []
        for darken in (partial(self._engine.switch_leds, by_sequence=False), self._engine.stop):
            try:
                darken()
            except SlrigError as error:
                faults.append(error)
        return faults

    def _before_close(self) -> None:
        """What else is done before the engine is let go. It is dark."""

    def _shut_down(self) -> None:
        """Darken as far as the engine lets, and let it go."""
        self._darken()
        with suppress(SlrigError):
            self._before_close()
        self._state.loaded = None
        self._state.closed.set()
        self._engine.close()


class UsbEngineProjector(EngineProjector[EngineT], ABC):
    """What implements `slrig.devices.Projector` and `UnprovenLight` on an engine with a USB port."""

    def __init__(self, engine: EngineT, options: UsbLightOptions, *, clock: Clock | None = None) -> None:
        super().__init__(engine, options, clock=clock)
        self._light: UsbLightOptions = options

    @property
    def unproven(self) -> bool:
        """See `UnprovenLight`."""
        return self._light.led_current_inverted is None

    @property
    def light_period_s(self) -> float:
        """See `UnprovenLight`."""
        return DIM_TIMING.period_us / 1e6

    def try_current(self, share: float) -> None:
        """See `UnprovenLight`."""
        if not self.unproven or not 0.4 <= share <= 0.6:
            message = f"asked to try a current register at {share:g}: only 0.4 to 0.6, while its sense is not known"
            raise UnsupportedByDeviceError(message)
        with self._lock:
            self._state.require_open()
            self.blank()
            self._engine.set_led_registers(bytes([round(share * 255)] * 3))

    def option_for(self, *, rises: bool) -> str:
        """See `UnprovenLight`."""
        inverted = rises == self._engine.is_led_polarity_inverted
        return f"led_current_inverted = {str(inverted).lower()}"

    def _wake(self) -> None:
        # An engine in standby is dark, and takes no other command.
        if self._engine.byte(UsbCommand.POWER) & 1:
            self._engine.set_byte(UsbCommand.POWER, 0)
        else:
            for fault in self._darken():
                if isinstance(fault, DeviceGoneError):
                    raise fault
        self._engine.wait_until_initialised(WAKE_TIMEOUT_S)
        self.blank()

    def _configure_leds(self) -> None:
        """No mirroring, no inversion, and the current of the LEDs: half of it where its sense is not known."""
        engine, light = self._engine, self._light
        for unchanged in (UsbCommand.FLIP_LONG, UsbCommand.FLIP_SHORT, UsbCommand.INVERT_DATA):
            engine.settle_byte(unchanged, 0)
        if light.led_current_inverted is None:
            engine.set_led_registers(bytes([_HALF_CURRENT] * 3))
        else:
            engine.set_led_current(light.colour, light.current_byte, inverted=light.led_current_inverted)

    def _require_known_polarity(self) -> None:
        if self.unproven:
            message = (
                "asked to play, but it is not known which way the LEDs' current goes, and light is dim until it is: "
                "slrig doctor finds it out, and says what to write into the rig file"
            )
            raise UnsupportedByDeviceError(message)
