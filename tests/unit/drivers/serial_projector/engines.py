"""What runs in a trigger box, for tests: the reference core on a light engine in memory,."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.serial_projector.device.box import BoxDescription, BoxHardware, HardwareError
from drivers.serial_projector.device.protocol import TriggerBox

LIGHT_US, GAP_US, HOLD_US, LEAST_US = 3000, 2000, 500, 100


@dataclass(frozen=True, slots=True)
class Change:
    """The light changed: to a pattern of the flash, or to darkness (None)."""

    pattern: int | None
    t_ns: int
    boot: int


@dataclass
class Scene:
    """Everything that a box did to the light and the cameras, over all its starts. `watch` is called at each change.

    at_ns : the box's time, where it is not CLOCK_MONOTONIC: set by what runs the box.
    """

    changes: list[Change] = field(default_factory=list)
    pulses_ns: list[int] = field(default_factory=list)
    watch: list[Callable[[int | None], None]] = field(default_factory=list)
    on_pulse: list[Callable[[int], None]] = field(default_factory=list)
    at_ns: int | None = None

    def now_ns(self) -> int:
        return time.monotonic_ns() if self.at_ns is None else self.at_ns

    def change(self, pattern: int | None, boot: int) -> None:
        if pattern is None and (not self.changes or self.changes[-1].pattern is None):
            return
        self.changes.append(Change(pattern, self.now_ns(), boot))
        for tell in self.watch:
            tell(pattern)

    def pulse(self, us: int) -> None:
        self.pulses_ns.append(self.now_ns())
        for tell in self.on_pulse:
            tell(us)

    @property
    def lit(self) -> int | None:
        return self.changes[-1].pattern if self.changes else None

    @property
    def shown(self) -> list[tuple[int, int]]:
        """(pattern, boot) of everything that was lit."""
        return [(change.pattern, change.boot) for change in self.changes if change.pattern is not None]


class FakeLight(BoxHardware):
    """A light engine in memory. drift : of its clock, a fraction. `broken` : the calls that fail."""

    def __init__(self, scene: Scene, boot: int, *, drift: float = 0.0) -> None:
        self._scene, self._boot = scene, boot
        self._drift = drift
        self._since_ns = scene.now_ns()
        self._selected: int | None = None
        self.broken: set[str] = set()
        self.dims = True
        self.bright = 1000

    def time_us(self) -> int:
        return round((self._scene.now_ns() - self._since_ns) * (1 + self._drift) / 1000)

    def select(self, pattern: int) -> None:
        self._maybe("select")
        self._selected = pattern

    def light(self) -> None:
        self._maybe("light")
        self._scene.change(self._selected, self._boot)

    def switch_off(self) -> None:
        self._maybe("dark")
        self._scene.change(None, self._boot)

    def pulse(self, us: int) -> None:
        self._maybe("pulse")
        self._scene.pulse(us)

    def set_brightness(self, permille: int) -> int:
        self.bright = permille if self.dims else 1000
        return self.bright

    def _maybe(self, call: str) -> None:
        if call in self.broken:
            message = f"{call} failed"
            raise HardwareError(message)


def description(crc32: Sequence[int], *, width_px: int = 400, height_px: int = 300) -> BoxDescription:
    return BoxDescription(
        "test-box",
        "1.0.0",
        width_px,
        height_px,
        list(crc32),
        light_us=LIGHT_US,
        error_us=20,
        gap_us=GAP_US,
        hold_us=HOLD_US,
        least_us=LEAST_US,
    )


class CoreEngine:
    """The core in this process. After `restart`, `device` and `light` are others."""

    def __init__(self, scene: Scene, about: BoxDescription, *, drift: float = 0.0) -> None:
        self.scene, self.about, self._drift = scene, about, drift
        self._boots = itertools.count(1)
        self.restart()

    def restart(self) -> None:
        """Power it off and on: dark, with another boot id, and its clock at 0."""
        boot = next(self._boots)
        self.light = FakeLight(self.scene, boot, drift=self._drift)
        self.device = TriggerBox(self.light, self.about, boot)

    def feed(self, data: bytes) -> bytes:
        return self.device.feed(data)

    def poll(self) -> bytes:
        return self.device.poll()

    def wait_s(self) -> float | None:
        """How long until it wants to be polled; None: whenever."""
        wait_us = self.device.wait_us()
        return None if wait_us < 0 else wait_us / 1e6

    def close(self) -> None:
        self.scene.change(None, 0)
