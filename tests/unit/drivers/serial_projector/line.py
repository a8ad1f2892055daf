"""A serial line with a box at its end, in memory or on a pseudo-terminal, and everything that can happen to it."""

from __future__ import annotations

import os
import pty
import random
import select
import threading
import tty
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field

from slrig.errors import DeviceGoneError
from tests.unit.drivers.serial_projector.engines import CoreEngine
from tests.virtual_clock import VirtualClock


@dataclass
class Noise:
    """Loses and damages whole lines, in both directions. `lost` and `damaged` count them."""

    loss: float = 0.0
    corruption: float = 0.0
    seed: int = 0
    lost: int = 0
    damaged: int = 0
    rng: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)

    def through(self, line: bytes) -> bytes:
        """What arrives of a line (with its end)."""
        chance = self.rng.random()
        if chance < self.loss:
            self.lost += 1
            return b""
        if chance < self.loss + self.corruption:
            self.damaged += 1
            return self._damage(line)
        return line

    def _damage(self, line: bytes) -> bytes:
        at = self.rng.randrange(len(line))
        match self.rng.randrange(5):
            case 0:
                return line[:at] + bytes([line[at] ^ 1 << self.rng.randrange(8)]) + line[at + 1 :]
            case 1:
                return line[:at] + bytes([self.rng.randrange(256)]) + line[at + 1 :]
            case 2:
                return line[:at] + line[at + 1 :]
            case 3:
                return line[:at]
            case _:
                return line[:at] + self.rng.randbytes(self.rng.randrange(1, 9)) + line[at:]


class Line(ABC):
    """A box at the end of a line. The box goes on when the line is cut.

    boot_s : how long the box takes to start. on_command : called with each line from the host, how many came so far and
    its bytes; the line goes on to the box if it returns True.
    """

    def __init__(
        self,
        engine: CoreEngine,
        *,
        noise: Noise | None = None,
        boot_s: float = 0.0,
        on_command: Callable[[Line, int, bytes], bool] = lambda _line, _count, _data: True,
    ) -> None:
        self.engine = engine
        self.noise = noise or Noise()
        self.on_command = on_command
        self._boot_ns = round(boot_s * 1e9)
        self._deaf_until_ns = 0
        self._commands = 0
        self._rest = b""
        self._cut = False

    def restart(self) -> None:
        """The box loses its power for a moment."""
        self.engine.restart()
        self._rest = b""
        self._deaf_until_ns = self.engine.scene.now_ns() + self._boot_ns

    @abstractmethod
    def _deliver(self, data: bytes) -> None:
        """Send what comes through to the host."""

    def _take(self, data: bytes) -> None:
        """Let the box have what the host sent."""
        if self._is_deaf():
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._commands += 1
            data = self.noise.through(line + b"\n")
            if self.on_command(self, self._commands, data):
                self._send(self.engine.feed(data))
            if self._cut or self._is_deaf():
                return

    def _is_deaf(self) -> bool:
        return self.engine.scene.now_ns() < self._deaf_until_ns

    def _send(self, data: bytes) -> None:
        for line in data.splitlines(keepends=True):
            if not self._cut:
                self._deliver(self.noise.through(line))


class MemoryLine(Line):
    """A line in memory, on a clock of tests. Implements `drivers.serial_port.BytePort`.

    The box catches up with the clock whenever anybody looks: what was due meanwhile is done at the time when it was.
    """

    def __init__(self, engine: CoreEngine, clock: VirtualClock, **how: object) -> None:
        super().__init__(engine, **how)  # type: ignore[arg-type]
        self._clock = clock
        self._waiting = b""
        self._never = threading.Event()
        self._lock = threading.RLock()

    def opened(self) -> MemoryLine:
        if self._cut:
            message = "the line does not exist"
            raise DeviceGoneError(message)
        self._waiting = b""
        return self

    def catch_up(self) -> None:
        scene, now_ns = self.engine.scene, self._clock.now_ns()
        assert scene.at_ns is not None
        with self._lock:
            while (due_ns := self._due_ns()) is not None and due_ns <= now_ns:
                scene.at_ns = due_ns
                self._send(self.engine.poll())
            scene.at_ns = max(scene.at_ns, now_ns)

    def cut(self) -> None:
        """Pull the cable; the box has power of its own."""
        self._cut = True

    def plug_in(self) -> None:
        self._rest, self._cut = b"", False

    def read(self, timeout_s: float) -> bytes:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            self.catch_up()
            self._require_plugged()
            with self._lock:
                data, self._waiting = self._waiting, b""
            if data or self._clock.now_ns() >= until_ns:
                return data
            due_ns = self._due_ns()
            self._clock.wait_until(until_ns if due_ns is None else min(due_ns, until_ns), self._never)

    def write(self, data: bytes) -> None:
        self.catch_up()
        self._require_plugged()
        with self._lock:
            self._take(data)

    def close(self) -> None:
        """See `BytePort`."""

    def _due_ns(self) -> int | None:
        wait_s, at_ns = self.engine.wait_s(), self.engine.scene.at_ns
        return None if wait_s is None or at_ns is None else at_ns + max(round(wait_s * 1e9), 1000)

    def _deliver(self, data: bytes) -> None:
        self._waiting += data

    def _require_plugged(self) -> None:
        if self._cut:
            message = "cannot use the line, it is gone: it was unplugged"
            raise DeviceGoneError(message)


class SerialLine(Line):
    """A line on a pseudo-terminal, `path`, in real time; a thread serves the box."""

    def __init__(self, engine: CoreEngine, **how: object) -> None:
        super().__init__(engine, **how)  # type: ignore[arg-type]
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._woken, self._wake = os.pipe()
        self._asked: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, name="trigger box", daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """Pull the cable; the box has power of its own. In the box's own thread."""
        if not self._cut:
            self._cut = True
            os.close(self._master)
            os.close(self._slave)

    def do(self, what: Callable[[], None]) -> None:
        """Have something done in the box's own thread, and wait for it."""
        done = threading.Event()

        def told() -> None:
            what()
            done.set()

        with self._lock:
            self._asked.append(told)
        os.write(self._wake, b"\n")
        assert done.wait(10), "the box does not go on"

    def close(self) -> None:
        """Cut the line, and power the box off. Idempotent."""
        if self._thread.is_alive():
            self.do(self.unplug)
            os.close(self._wake)
            self._thread.join(10)
            self.engine.close()

    def _serve(self) -> None:
        while True:
            handles = [self._woken, *([] if self._cut else [self._master])]
            ready, _, _ = select.select(handles, [], [], self.engine.wait_s())
            if self._woken in ready:
                if not os.read(self._woken, 64):
                    os.close(self._woken)
                    return
                with self._lock:
                    asked, self._asked = self._asked, []
                for each in asked:
                    each()
            self._send(self.engine.poll())
            if not self._cut and self._master in ready:
                self._take(os.read(self._master, 4096))

    def _deliver(self, data: bytes) -> None:
        os.write(self._master, data)
