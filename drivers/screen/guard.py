"""A process that keeps an output black under the patterns and after them.

The X server removes the windows of a client that ends, even by a crash: without the guard, the desktop below
the patterns would light the scene from then on. The guard's black window is there already, so no light gets through in
between. The guard ends on request, when the next guard takes over, with the output or the X server, or some time after
the process that it watches.

It reads requests as lines from its standard input and answers each with the same line: `cover` (stay above all other
windows), `step back` (allow windows above it) and `release` (end; no answer).
"""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict, dataclass

from drivers.display.guard import GuardProcess
from drivers.screen.randr import list_outputs, watch_outputs
from drivers.screen.x11 import (
    OUTPUT_CHANGES,
    SELECTION_CLEAR,
    VISIBILITY_NOTIFY,
    XConnection,
    atom,
    black_window,
    event_name,
    hidden_window,
    place_window,
    raise_window,
    take_selection,
)
from slrig.errors import DeviceGoneError
from slrig.model import Size

_RAISE_INTERVAL_S = 0.1
_IDLE_S = 3600.0
_OUTPUT_OFF_TIMEOUT_S = 3.0
_SUCCESSOR_TIMEOUT_S = 0.5
_FULLY_OBSCURED = 2

_guards: dict[tuple[str | None, str], tuple[ScreenGuardTask, GuardProcess]] = {}
"""The guards that this process has started: one per display and output, kept until the process ends."""
_guards_lock = threading.Lock()


@dataclass(frozen=True, slots=True)
class ScreenGuardTask:
    """The area to keep black, the process that it is kept black for, and for how long after that process has ended."""

    display: str | None
    output: str
    x: int
    y: int
    width_px: int
    height_px: int
    process: int
    dark_after_s: float


def start_guard(task: ScreenGuardTask) -> GuardProcess:
    """Return the guard of an output; start it if it does not run. Raises DeviceError."""
    key = (task.display, task.output)
    with _guards_lock:
        before = _guards.get(key)
        if before is not None and before[1].is_alive and before[0] == task:
            before[1].step_back()
            return before[1]
        guard = GuardProcess("drivers.screen.guard", json.dumps(asdict(task)), task.output)
        if before is not None:
            # The new guard has taken over, or the old one ended before.
            before[1].wait()
        _guards[key] = (task, guard)
        return guard


def release_guard(display: str | None, output: str) -> None:
    """End the guard of an output if this process has started one: the desktop is visible again."""
    with _guards_lock:
        found = _guards.pop((display, output), None)
    if found is not None:
        found[1].release()


class _ScreenGuard:
    def __init__(self, task: ScreenGuardTask) -> None:
        self._task = task
        self._connection = XConnection(task.display)
        selection = atom(self._connection, f"_SLRIG_DARK_{task.output}")
        # Before our window exists: the previous guard must not raise its own above it.
        take_selection(self._connection, selection, hidden_window(self._connection), from_another=True)
        self._window = black_window(self._connection, task.x, task.y, Size(task.width_px, task.height_px))
        self._watched: list[int] = [sys.stdin.fileno()]
        with suppress(OSError, AttributeError):
            # A child of the watched process may hold the other end of the pipe open.
            self._watched.append(os.pidfd_open(task.process))
        watch_outputs(self._connection)
        self._covering = False
        self._end_s: float | None = None
        self._output_off_end_s: float | None = None
        self._successor_end_s: float | None = None
        self._input = b""

    def run(self) -> None:
        """Keep the output black until one of the reasons in the module's docstring ends it."""
        self._answer("ready")
        while self._end_s is None or time.monotonic() < self._end_s:
            ends_s = [self._end_s, self._output_off_end_s, self._successor_end_s]
            next_s = min((end_s for end_s in ends_s if end_s is not None), default=time.monotonic() + _IDLE_S)
            ready = self._connection.wait(next_s - time.monotonic(), *self._watched)
            if self._is_obsolete() or (self._watched and self._is_released(ready)):
                return

    def _is_obsolete(self) -> bool:
        """Handle events. True if another guard has taken over, or the output is off."""
        covered = changed = False
        for event in self._connection.events():
            name = event_name(event)
            if name == SELECTION_CLEAR:
                self._covering = False
                self._successor_end_s = time.monotonic() + _SUCCESSOR_TIMEOUT_S
            elif name == VISIBILITY_NOTIFY:
                covered = event.state != 0
                if event.state == _FULLY_OBSCURED and self._successor_end_s is not None:
                    return True
            elif name in OUTPUT_CHANGES:
                changed = True
        if changed:
            self._follow_output()
        ends_s = [end_s for end_s in (self._output_off_end_s, self._successor_end_s) if end_s is not None]
        if ends_s and time.monotonic() > min(ends_s):
            return True
        if covered and self._covering:
            # Not at once: another program may raise its window again and again as well.
            time.sleep(_RAISE_INTERVAL_S)
            raise_window(self._connection, self._window)
        return False

    def _follow_output(self) -> None:
        """Move the window to where the output is now, or off the screen while the output is off."""
        crtcs = [
            output.crtc
            for output in list_outputs(self._connection, probe=False)
            if output.name == self._task.output and output.crtc is not None
        ]
        if crtcs:
            self._output_off_end_s = None
            place_window(self._connection, self._window, crtcs[0].x, crtcs[0].y, crtcs[0].size)
        elif self._output_off_end_s is None:
            # A program that rearranges outputs switches them off for a moment.
            self._output_off_end_s = time.monotonic() + _OUTPUT_OFF_TIMEOUT_S
            place_window(self._connection, self._window, -1, -1, Size(1, 1))

    def _is_released(self, ready: frozenset[int]) -> bool:
        """Handle requests and the end of the watched process. True if the guard is to end."""
        requests, process = self._watched[0], self._watched[1:]
        if requests in ready:
            received = os.read(requests, 4096)
            *lines, self._input = (self._input + received).split(b"\n")
            for line in lines:
                if line == b"release":
                    return True
                self._covering = line == b"cover"
                if self._covering:
                    raise_window(self._connection, self._window)
                self._answer(line.decode())
            if not received:
                self._outlive_process()
        elif ready.intersection(process):
            self._outlive_process()
        return False

    def _outlive_process(self) -> None:
        """Cover the output for `dark_after_s`: the watched process has ended."""
        self._covering = True
        raise_window(self._connection, self._window)
        self._watched = []
        self._end_s = time.monotonic() + self._task.dark_after_s

    def _answer(self, line: str) -> None:
        # The other end of the pipe may be closed.
        with suppress(OSError):
            os.write(sys.stdout.fileno(), f"{line}\n".encode())


def main() -> None:
    """Run the task that the first argument describes (JSON)."""
    # Without the X server the output is dark.
    with suppress(DeviceGoneError):
        _ScreenGuard(ScreenGuardTask(**json.loads(sys.argv[1]))).run()


if __name__ == "__main__":
    main()
