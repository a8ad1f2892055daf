"""The guards that this process has set on its outputs: one per output, kept until the process ends."""

from __future__ import annotations

import json
import os
import select
import subprocess
import sys
import threading
import time
from contextlib import suppress
from dataclasses import asdict

from drivers.screen import guard
from drivers.screen.guard import Duty
from slrig.errors import DeviceError

_STARTS_IN_S = 15.0
_ANSWERS_IN_S = 1.0

_kept: dict[tuple[str | None, str], Guard] = {}
_keeping = threading.Lock()


class Guard:
    """A guard at work. Safe between threads."""

    def __init__(self, duty: Duty) -> None:
        self.duty = duty
        self._lock = threading.Lock()
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, "-m", guard.__name__, json.dumps(asdict(duty))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            # An interrupt from the keyboard is for the process that is watched.
            start_new_session=True,
        )
        if self._answer(_STARTS_IN_S) != b"ready\n":
            self.release()
            message = (
                f"no guard keeps output {duty.output} black when slrig ends: its process ended or hangs; see what it "
                f"says: {sys.executable} -m {guard.__name__}"
            )
            raise DeviceError(message)

    @property
    def is_alive(self) -> bool:
        """Whether it still keeps the output black."""
        return self._process.poll() is None

    def cover(self) -> bool:
        """Put the guard's black window above all others, to stay there; return whether that was done."""
        return self._do(b"cover\n")

    def step_back(self) -> bool:
        """Let other windows be above the guard's again; return whether it does."""
        return self._do(b"step back\n")

    def release(self) -> None:
        """End it: what is under the black is seen again. Idempotent."""
        with self._lock:
            with suppress(OSError, ValueError):
                self._order(b"release\n")
            self.leave()

    def leave(self) -> None:
        """Wait for its end, which something else has brought about."""
        try:
            self._process.wait(_ANSWERS_IN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _do(self, order: bytes) -> bool:
        with self._lock, suppress(OSError, ValueError):
            self._order(order)
            return self._answer(_ANSWERS_IN_S) == order
        return False

    def _order(self, line: bytes) -> None:
        if self._process.stdin is None or self._process.stdout is None:
            return
        while select.select([self._process.stdout], [], [], 0)[0]:
            # An answer that came too late.
            if not os.read(self._process.stdout.fileno(), 4096):
                break
        os.write(self._process.stdin.fileno(), line)

    def _answer(self, timeout_s: float) -> bytes:
        """The next line that it says; what came in time of it."""
        heard = b""
        until_s = time.monotonic() + timeout_s
        pipe = self._process.stdout
        while pipe is not None and not heard.endswith(b"\n"):
            left_s = until_s - time.monotonic()
            if left_s <= 0 or not select.select([pipe], [], [], left_s)[0]:
                break
            part = os.read(pipe.fileno(), 1)
            if not part:
                break
            heard += part
        return heard


def keep_dark(duty: Duty) -> Guard:
    """Return the guard of an output, set now if there is none. Raises DeviceError."""
    key = (duty.display, duty.output)
    with _keeping:
        before = _kept.get(key)
        if before is not None and before.is_alive and before.duty == duty:
            before.step_back()
            return before
        new = Guard(duty)
        if before is not None:
            # The new one has relieved it, or it ended before.
            before.leave()
        _kept[key] = new
        return new


def release(display: str | None, output: str) -> None:
    """End the guard of an output, if this process has set one: what is under its black is seen again."""
    with _keeping:
        found = _kept.pop((display, output), None)
    if found is not None:
        found.release()
