"""What holds a shown pattern while its host lives, and darkens an engine on every path, whatever its commands are."""

from __future__ import annotations

import math
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from functools import partial
from typing import Generic, Protocol, TypeVar

from drivers.pattern_engine.options import LightOptions
from drivers.pattern_engine.timing import MAX_UNATTENDED_S
from slrig.devices import Clock, ProjectorInfo, ProjectorState, Shown, SystemClock
from slrig.errors import SlrigError


class LightSource(Protocol):
    """An engine, as far as light goes. `start` begins anew what was told last."""

    def leds(self, *, by_sequence: bool) -> None:
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

    A kind of engine calls `_take_over` when it is constructed, and `_begin_holding` when it has begun what it shows.
    `_lock` keeps the engine's commands together. clock : the rig's; else the system's.
    """

    def __init__(self, engine: SourceT, options: LightOptions, *, clock: Clock | None = None) -> None:
        self._engine = engine
        self._clock = clock or SystemClock()
        self._light = options
        self._state = ProjectorState("the light engine")
        self._lock = threading.RLock()
        self._held_until_s = self._restart_at_s = self._restart_each_s = 0.0
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
                self._leave()

    def _take_over(self) -> None:
        """Wake the engine, darken it first of all, and prepare it; close it if that fails."""
        try:
            self._wake()
            self._info = self._prepare()
        except BaseException:
            self._leave()
            raise
        threading.Thread(target=self._hold, name="light engine", daemon=True).start()

    def _begin_holding(self, alone_s: float, *, again_s: float) -> None:
        """Hold what was begun now, and ends by itself `alone_s` later; then each `again_s`."""
        now_s = self._now_s()
        self._held_until_s = now_s + self._light.hold_s
        self._restart_at_s, self._restart_each_s = now_s + alone_s / 2, again_s

    def _shown(self, index: int, earliest_ns: int, latest_ns: int) -> Shown:
        """Wait until the latest instant at which light can begin."""
        self._clock.wait_until(latest_ns, self._state.closed)
        self._state.require_open()
        return Shown(index, (earliest_ns + latest_ns) // 2, (latest_ns - earliest_ns + 1) // 2)

    def _now_s(self) -> float:
        return self._clock.now_ns() / 1e9

    def _hold(self) -> None:
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
                if not self._restart_at_s <= now_s < self._held_until_s:
                    continue
                self._restart_at_s = now_s + self._restart_each_s
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
        for darken in (partial(self._engine.leds, by_sequence=False), self._engine.stop):
            try:
                darken()
            except SlrigError as error:
                faults.append(error)
        return faults

    def _rest(self) -> None:
        """What else is done before the engine is let go. It is dark."""

    def _leave(self) -> None:
        """Darken as far as the engine lets, and let it go."""
        self._darken()
        with suppress(SlrigError):
            self._rest()
        self._state.loaded = None
        self._state.closed.set()
        self._engine.close()
