"""The guard process of an output, as its parent uses it: requests are lines, answered by the same line."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from slrig.errors import DeviceError

_START_TIMEOUT_S = 15.0
_ANSWER_TIMEOUT_S = 1.0


class GuardProcess:
    """A running guard. Safe between threads.

    module : the guard's program. task : its argument. output : the output that it keeps black. handles : open files
    that it inherits.
    """

    def __init__(self, module: str, task: str, output: str, handles: Sequence[int] = ()) -> None:
        self._lock = threading.Lock()
        # Not ours: the guard outlives this process, and a reader of our errors to their end would wait for it.
        with tempfile.TemporaryFile() as errors:
            self._process = subprocess.Popen(  # noqa: S603 - our own program
                [sys.executable, "-m", module, task],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                pass_fds=handles,
                # An interrupt from the keyboard is for the watched process.
                start_new_session=True,
            )
            if self._read_line(_START_TIMEOUT_S) != b"ready\n":
                self.release()
                errors.seek(0)
                *_, cause = ["it hangs", *errors.read().decode(errors="replace").strip().splitlines()]
                message = f"no guard keeps output {output} black when slrig ends: its process did not start ({cause})"
                raise DeviceError(message)

    @property
    def is_alive(self) -> bool:
        """True while it keeps the output black."""
        return self._process.poll() is None

    def cover(self) -> bool:
        """Put the guard's black window above all others, to stay there; return True if it did."""
        return self._request(b"cover\n")

    def step_back(self) -> bool:
        """Allow other windows above the guard's again; return True if it does."""
        return self._request(b"step back\n")

    def release(self) -> None:
        """End it: the content below the black is visible again. Idempotent."""
        with self._lock:
            with suppress(OSError, ValueError):
                self._send(b"release\n")
            self.wait()

    def wait(self) -> None:
        """Wait for its end, which was requested; kill it if it does not end in time."""
        try:
            self._process.wait(_ANSWER_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _request(self, line: bytes) -> bool:
        with self._lock, suppress(OSError, ValueError):
            self._send(line)
            return self._read_line(_ANSWER_TIMEOUT_S) == line
        return False

    def _send(self, line: bytes) -> None:
        if self._process.stdin is None or self._process.stdout is None:
            return
        while select.select([self._process.stdout], [], [], 0)[0]:
            # Discard an answer that came too late.
            if not os.read(self._process.stdout.fileno(), 4096):
                break
        os.write(self._process.stdin.fileno(), line)

    def _read_line(self, timeout_s: float) -> bytes:
        """Return the next line of its output, or the part of it that came in time."""
        received = b""
        until_s = time.monotonic() + timeout_s
        pipe = self._process.stdout
        while pipe is not None and not received.endswith(b"\n"):
            left_s = until_s - time.monotonic()
            if left_s <= 0 or not select.select([pipe], [], [], left_s)[0]:
                break
            part = os.read(pipe.fileno(), 1)
            if not part:
                break
            received += part
        return received
