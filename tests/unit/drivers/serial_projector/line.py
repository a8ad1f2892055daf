"""A serial line on a pseudo-terminal, with a box at its end, and everything that can happen to such a line."""

from __future__ import annotations

import os
import pty
import random
import select
import threading
import time
import tty
from collections.abc import Callable
from dataclasses import dataclass, field

from tests.unit.drivers.serial_projector.engines import Engine


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


class SerialLine:
    """A box on a pseudo-terminal, `path`, served by a thread. The box goes on when the line is cut.

    boot_s : how long the box takes to start. on_command : asked about each line from the host, with how many came so
    far and its bytes; the line goes on to the box if it returns True.
    """

    def __init__(
        self,
        engine: Engine,
        *,
        noise: Noise | None = None,
        boot_s: float = 0.0,
        on_command: Callable[[SerialLine, int, bytes], bool] = lambda _line, _count, _data: True,
    ) -> None:
        self.engine = engine
        self.noise = noise or Noise()
        self._boot_s = boot_s
        self._on_command = on_command
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.path = os.ttyname(self._slave)
        self._woken, self._wake = os.pipe()
        self._deaf_until_s = 0.0
        self._commands = 0
        self._rest = b""
        self._cut = False
        self._asked: list[Callable[[], None]] = []
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._serve, name="trigger box", daemon=True)
        self._thread.start()

    def restart(self) -> None:
        """The box loses its power for a moment; only from `on_command` or `do`."""
        self.engine.restart()
        self._rest = b""
        self._deaf_until_s = time.monotonic() + self._boot_s

    def unplug(self) -> None:
        """Pull the cable; the box has power of its own. Only from `on_command` or `do`."""
        if not self._cut:
            self._cut = True
            os.close(self._master)
            os.close(self._slave)

    def plug_in(self) -> None:
        """Plug the cable in again: `path` is another one. Only from `on_command` or `do`."""
        if self._cut:
            self._master, self._slave = pty.openpty()
            tty.setraw(self._slave)
            self.path = os.ttyname(self._slave)
            self._rest, self._cut = b"", False

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
            handles = [self._woken, *self.engine.handles(), *([] if self._cut else [self._master])]
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

    def _take(self, data: bytes) -> None:
        if time.monotonic() < self._deaf_until_s:
            return
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            self._commands += 1
            data = self.noise.through(line + b"\n")
            if self._on_command(self, self._commands, data):
                self._send(self.engine.feed(data))
            if self._cut or time.monotonic() < self._deaf_until_s:
                return

    def _send(self, data: bytes) -> None:
        for line in data.splitlines(keepends=True):
            if not self._cut:
                os.write(self._master, self.noise.through(line))
