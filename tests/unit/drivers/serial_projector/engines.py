"""What runs in a trigger box, for tests: the reference core on a light engine in memory, in CPython or MicroPython."""

from __future__ import annotations

import itertools
import os
import selectors
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import pytest

from drivers.serial_projector.device.box import Description, Hardware, HardwareError
from drivers.serial_projector.device.protocol import Device
from tests.npm import npm_package

FIRMWARE = Path(__file__).resolve().parents[4] / "drivers" / "serial_projector" / "device"
RUNNER = Path(__file__).with_name("micropython_box.mjs")
PACKAGE = "@micropython/micropython-webassembly-pyscript@1.27.0"
LIGHT_US, GAP_US, HOLD_US, LEAST_US = 3000, 2000, 500, 100


@dataclass(frozen=True, slots=True)
class Change:
    """The light changed: to a pattern of the flash, or to darkness (None). t_ns : CLOCK_MONOTONIC."""

    pattern: int | None
    t_ns: int
    boot: int


@dataclass
class Scene:
    """Everything that a box did to the light and the cameras, over all its starts. `watch` is told of each change."""

    changes: list[Change] = field(default_factory=list)
    pulses_ns: list[int] = field(default_factory=list)
    watch: list[Callable[[int | None], None]] = field(default_factory=list)
    on_pulse: list[Callable[[], None]] = field(default_factory=list)

    def change(self, pattern: int | None, boot: int) -> None:
        if pattern is None and (not self.changes or self.changes[-1].pattern is None):
            return
        self.changes.append(Change(pattern, time.monotonic_ns(), boot))
        for tell in self.watch:
            tell(pattern)

    def pulse(self) -> None:
        self.pulses_ns.append(time.monotonic_ns())
        for tell in self.on_pulse:
            tell()

    @property
    def lit(self) -> int | None:
        return self.changes[-1].pattern if self.changes else None

    @property
    def shown(self) -> list[tuple[int, int]]:
        """(pattern, boot) of everything that was lit."""
        return [(change.pattern, change.boot) for change in self.changes if change.pattern is not None]


class Engine(Protocol):
    """What is in a box."""

    def feed(self, data: bytes) -> bytes:
        """Give it what came in; return what it sends at once."""
        ...

    def poll(self) -> bytes:
        """Let it do what is due; return what it sends."""
        ...

    def wait_s(self) -> float | None:
        """How long until it wants to be polled; None: whenever."""
        ...

    def handles(self) -> list[int]:
        """File descriptors from which it sends, beside."""
        ...

    def restart(self) -> None:
        """Power it off and on: dark, with another boot id, and its clock at 0."""
        ...

    def close(self) -> None:
        """Power it off."""
        ...


class FakeLight(Hardware):
    """A light engine in memory. drift : of its clock, a fraction. `broken` : the calls that fail."""

    def __init__(self, scene: Scene, boot: int, *, drift: float = 0.0, broken: Sequence[str] = ()) -> None:
        self._scene, self._boot = scene, boot
        self._drift = drift
        self._since_ns = time.monotonic_ns()
        self._selected: int | None = None
        self.broken = set(broken)
        self.dims = True
        self.bright = 1000

    def time_us(self) -> int:
        return round((time.monotonic_ns() - self._since_ns) * (1 + self._drift) / 1000)

    def select(self, pattern: int) -> None:
        self._maybe("select")
        self._selected = pattern

    def light(self) -> None:
        self._maybe("light")
        self._scene.change(self._selected, self._boot)

    def dark(self) -> None:
        self._maybe("dark")
        self._scene.change(None, self._boot)

    def pulse(self) -> None:
        self._maybe("pulse")
        self._scene.pulse()

    def dim(self, permille: int) -> int:
        self.bright = permille if self.dims else 1000
        return self.bright

    def _maybe(self, call: str) -> None:
        if call in self.broken:
            message = f"{call} failed"
            raise HardwareError(message)


def description(crc32: Sequence[int], *, width_px: int = 400, height_px: int = 300) -> Description:
    """A box with these patterns in its flash."""
    return Description(
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
    """Implements `Engine`: the core in this process. After `restart`, `device` and `light` are others."""

    def __init__(self, scene: Scene, about: Description, *, drift: float = 0.0) -> None:
        self._scene, self._about, self._drift = scene, about, drift
        self._boots = itertools.count(1)
        self.restart()

    def restart(self) -> None:
        boot = next(self._boots)
        self.light = FakeLight(self._scene, boot, drift=self._drift)
        self.device = Device(self.light, self._about, boot)

    def feed(self, data: bytes) -> bytes:
        return self.device.feed(data)

    def poll(self) -> bytes:
        return self.device.poll()

    def wait_s(self) -> float | None:
        wait_us = self.device.wait_us()
        return None if wait_us < 0 else wait_us / 1e6

    def handles(self) -> list[int]:
        return []

    def close(self) -> None:
        self._scene.change(None, 0)


class MicroPythonEngine:
    """Implements `Engine`: the core in MicroPython's interpreter, in a process of its own."""

    def __init__(self, scene: Scene, about: Description, folder: Path) -> None:
        self._scene, self._about, self._folder = scene, about, folder
        self._boots = itertools.count(1)
        self._process: subprocess.Popen[bytes] | None = None
        self.restart()

    def restart(self) -> None:
        self.close()
        self._boot = next(self._boots)
        about = self._about
        crc32 = ",".join(str(int.from_bytes(about.crc32[at : at + 4], "big")) for at in range(0, len(about.crc32), 4))
        command = ["node", str(RUNNER), str(self._folder), str(FIRMWARE), str(self._boot), crc32]
        command += [str(about.width_px), str(about.height_px)]
        self._process = subprocess.Popen(  # noqa: S603 - our own script
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._notes = b""
        assert self._process.stderr is not None
        # The first note says that it runs: until then, a box does not answer.
        ready = self._process.stderr.readline()
        assert b"MicroPython" in ready, ready + self._process.stderr.read()

    def feed(self, data: bytes) -> bytes:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(data)
        self._process.stdin.flush()
        return b""

    def poll(self) -> bytes:
        assert self._process is not None
        assert self._process.stdout is not None
        assert self._process.stderr is not None
        out = b""
        with selectors.DefaultSelector() as ready:
            ready.register(self._process.stdout, selectors.EVENT_READ)
            ready.register(self._process.stderr, selectors.EVENT_READ)
            for key, _ in ready.select(0):
                data = os.read(key.fd, 4096)
                if key.fileobj is self._process.stdout:
                    out += data
                else:
                    self._noted(data)
        return out

    def wait_s(self) -> float | None:
        return None

    def handles(self) -> list[int]:
        if self._process is None or self._process.stdout is None or self._process.stderr is None:
            return []
        return [self._process.stdout.fileno(), self._process.stderr.fileno()]

    def close(self) -> None:
        process, self._process = self._process, None
        if process is None:
            return
        process.kill()
        process.communicate()
        self._scene.change(None, self._boot)

    def _noted(self, data: bytes) -> None:
        *lines, self._notes = (self._notes + data).split(b"\n")
        for line in lines:
            match line.decode().split():
                case ["light", pattern]:
                    self._scene.change(int(pattern), self._boot)
                case ["dark"]:
                    self._scene.change(None, self._boot)
                case ["pulse"]:
                    self._scene.pulse()
                case _:
                    pytest.fail(f"MicroPython: {line!r}")


def micropython_package() -> Path:
    """The folder of MicroPython's interpreter for Node, fetched once into a cache. Skips where it cannot be had."""
    return npm_package(PACKAGE, "to run MicroPython")
