"""A guard process at work, as the process sees it that has set it: told what to do by lines, which it answers alike."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from slrig.errors import DeviceError

_STARTS_IN_S = 15.0
_ANSWERS_IN_S = 1.0


class Guard:
    """A guard at work. Safe between threads.

    module : the guard's program. duty : its argument. output : what it keeps black. handles : open files that it gets.
    """

    def __init__(self, module: str, duty: str, output: str, handles: Sequence[int] = ()) -> None:
        self._lock = threading.Lock()
        self._process = subprocess.Popen(  # noqa: S603 - our own program
            [sys.executable, "-m", module, duty],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=handles,
            # An interrupt from the keyboard is for the process that is watched.
            start_new_session=True,
        )
        if self._answer(_STARTS_IN_S) != b"ready\n":
            self.release()
            message = (
                f"no guard keeps output {output} black when slrig ends: its process ended or hangs; see what it "
                f"says: {sys.executable} -m {module}"
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
