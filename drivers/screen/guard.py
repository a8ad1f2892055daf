"""A process of its own that keeps an output black under the patterns, and after them.

The X server takes away the windows of a client that ends, however it ends: without this, what is under the patterns, a
desktop mostly, would light the scene from then on. The guard's black window is there already, so nothing shines in
between. The guard ends when it is told to, when the next one takes over, with the output or the X server, or some time
after the process that it watches.

It is told by lines on its standard input, each answered by the same line: `cover` (be above all other windows, and stay
there), `step back` (let windows be above it) and `release` (end; no answer).
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import dataclass

from drivers.screen import randr
from drivers.screen.connection import Connection
from drivers.screen.requests import (
    SELECTION_CLEAR,
    VISIBILITY_NOTIFY,
    atom,
    black_window,
    hidden_window,
    place_window,
    raise_window,
    take_selection,
)
from slrig.errors import DeviceGoneError
from slrig.model import Size

_AGAIN_S = 0.1
_IDLE_S = 3600.0
_OFF_FOR_GOOD_S = 3.0
_RELIEVED_S = 0.5
_FULLY = 2


@dataclass(frozen=True, slots=True)
class Duty:
    """What to keep black, on behalf of which process, and for how long after its end."""

    display: str | None
    output: str
    x: int
    y: int
    width_px: int
    height_px: int
    process: int
    dark_after_s: float


class _Guard:
    def __init__(self, duty: Duty) -> None:
        self._duty = duty
        self._connection = Connection(duty.display)
        selection = atom(self._connection, f"_SLRIG_DARK_{duty.output}")
        # Before the window is there: the guard before this one must not insist on being above it.
        take_selection(self._connection, selection, hidden_window(self._connection), from_another=True)
        self._window = black_window(self._connection, duty.x, duty.y, Size(duty.width_px, duty.height_px))
        self._watched: list[int] = [sys.stdin.fileno()]
        with suppress(OSError, AttributeError):
            # A child of the watched process may hold the other end of the pipe open.
            self._watched.append(os.pidfd_open(duty.process))
        self._changes = randr.watch(self._connection)
        self._covering = False
        self._until_s: float | None = None
        self._off_until_s: float | None = None
        self._relieved_s: float | None = None
        self._asked = b""

    def run(self) -> None:
        """Keep the output black until somebody or something ends that."""
        self._say("ready")
        while self._until_s is None or time.monotonic() < self._until_s:
            ends_s = [end_s for end_s in (self._until_s, self._off_until_s, self._relieved_s) if end_s is not None]
            left_s = min(ends_s, default=time.monotonic() + _IDLE_S) - time.monotonic()
            ready = self._connection.wait(left_s, *self._watched)
            if self._needless() or (self._watched and self._released(ready)):
                return

    def _needless(self) -> bool:
        """Whether another guard has taken over, or the output is off."""
        covered = changed = False
        for event in self._connection.events():
            kind = event[0] & 0x7F
            if kind == SELECTION_CLEAR:
                self._covering = False
                self._relieved_s = time.monotonic() + _RELIEVED_S
            covered = event[8] != 0 if kind == VISIBILITY_NOTIFY else covered
            if kind == VISIBILITY_NOTIFY and event[8] == _FULLY and self._relieved_s is not None:
                return True
            changed |= kind in (self._changes, self._changes + 1)
        if changed:
            self._follow()
        ends_s = [end_s for end_s in (self._off_until_s, self._relieved_s) if end_s is not None]
        if ends_s and time.monotonic() > min(ends_s):
            return True
        if covered and self._covering:
            # Not at once: another program may insist as well.
            time.sleep(_AGAIN_S)
            raise_window(self._connection, self._window)
        return False

    def _follow(self) -> None:
        """Be where the output is now, or out of everybody's way while it is off."""
        pictures = [
            output.picture
            for output in randr.outputs(self._connection, probe=False)
            if output.name == self._duty.output and output.picture is not None
        ]
        if pictures:
            self._off_until_s = None
            place_window(self._connection, self._window, pictures[0].x, pictures[0].y, pictures[0].size)
        elif self._off_until_s is None:
            # Whoever rearranges outputs switches them off for a moment.
            self._off_until_s = time.monotonic() + _OFF_FOR_GOOD_S
            place_window(self._connection, self._window, -1, -1, Size(1, 1))

    def _released(self, ready: frozenset[int]) -> bool:
        orders, process = self._watched[0], self._watched[1:]
        if orders in ready:
            heard = os.read(orders, 4096)
            *lines, self._asked = (self._asked + heard).split(b"\n")
            for line in lines:
                if line == b"release":
                    return True
                self._covering = line == b"cover"
                if self._covering:
                    raise_window(self._connection, self._window)
                self._say(line.decode())
            if not heard:
                self._mourn()
        elif ready.intersection(process):
            self._mourn()
        return False

    def _mourn(self) -> None:
        """The watched process is gone: stay for the time that was asked for."""
        self._covering = True
        raise_window(self._connection, self._window)
        self._watched = []
        self._until_s = time.monotonic() + self._duty.dark_after_s

    def _say(self, word: str) -> None:
        # Nobody may be there to hear it.
        with suppress(OSError):
            os.write(sys.stdout.fileno(), f"{word}\n".encode())


def main() -> None:
    """Do the duty that the first argument describes (JSON)."""
    # The X server is gone: so is the light.
    with suppress(DeviceGoneError):
        _Guard(Duty(**json.loads(sys.argv[1]))).run()


if __name__ == "__main__":
    main()
