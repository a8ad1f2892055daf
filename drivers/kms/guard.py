"""A process that keeps an output black after the process that shows patterns has ended, even by a crash.

The kernel removes the pictures of a program that ends and shows the text console, which is not black. The guard has the
same card open, so that nothing else is shown. It makes the output black when the process that it watches has ended, or
on request (`cover` on its standard input, answered by the same line); it ends on request (`release`; no answer), or
some time after that process.

A process of the same user may take the card over after the watched process has ended: it connects to `guard_address`,
receives one line and the open card with it, and confirms when its own guard runs. No light is visible in between.
"""

from __future__ import annotations

import json
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass

from drivers.kms import kernel

TAKEN = b"taken\n"
_ANSWER_TIMEOUT_S = 2.0


@dataclass(frozen=True, slots=True)
class KmsGuardTask:
    """The output to make black, its open card, the process it is done for, and for how long after that process's end.

    mode : the kernel's mode structure in hexadecimal. black : frame buffer of the black picture. buffers : all frame
    buffers with the handles of their memory.
    """

    handle: int
    output: str
    controller: int
    connector: int
    mode: str
    black: int
    buffers: list[tuple[int, int]]
    process: int
    dark_after_s: float


def guard_address(handle: int) -> str:
    """Return the abstract socket address of the guard of an open card."""
    return f"\0slrig-kms-{os.fstat(handle).st_rdev}"


class _KmsGuard:
    def __init__(self, task: KmsGuardTask) -> None:
        self._task = task
        self._socket = self._listen()
        self._process: int | None = None
        with suppress(OSError, AttributeError):
            # A child of the watched process may hold the other end of the pipe open.
            self._process = os.pidfd_open(task.process)
        self._input = b""
        self._requests: int | None = sys.stdin.fileno()
        self._end_s: float | None = None

    def run(self) -> None:
        """Keep the output black until one of the reasons in the module's docstring ends it."""
        self._answer("ready")
        while self._end_s is None or time.monotonic() < self._end_s:
            left_s = None if self._end_s is None else max(self._end_s - time.monotonic(), 0)
            watched = [each for each in (self._requests, self._process, self._socket) if each is not None]
            ready = select.select(watched, [], [], left_s)[0]
            if self._requests in ready and self._is_released():
                return
            if self._process is not None and self._process in ready:
                self._outlive_process()
            if self._socket in ready and self._is_relieved():
                return

    def _is_released(self) -> bool:
        """Handle requests. True if the guard is to end."""
        received = os.read(sys.stdin.fileno(), 4096)
        *lines, self._input = (self._input + received).split(b"\n")
        for line in lines:
            if line == b"release":
                return True
            # No answer where the kernel refuses.
            with suppress(OSError):
                self._darken()
                self._answer(line.decode())
        if not received:
            self._outlive_process()
        return False

    def _outlive_process(self) -> None:
        """Show black for `dark_after_s`: the watched process has ended."""
        self._requests = self._process = None
        # The display may be unplugged.
        with suppress(OSError):
            self._darken()
        if self._end_s is None:
            self._end_s = time.monotonic() + self._task.dark_after_s

    def _darken(self) -> None:
        task = self._task
        kernel.set_mode(task.handle, task.controller, task.connector, bytes.fromhex(task.mode), task.black)

    def _is_relieved(self) -> bool:
        """Handle a connection. True if another process has taken the card over."""
        client, _ = self._socket.accept()
        with client:
            client.settimeout(_ANSWER_TIMEOUT_S)
            # If the client has given up or was killed, everything stays as before.
            with suppress(OSError):
                credentials = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
                user = struct.unpack("3i", credentials)[1]
                watching = self._end_s is None
                answer = json.dumps({"process": self._task.process, "output": self._task.output, "busy": watching})
                if watching or user not in (0, os.getuid()):
                    client.sendall(f"{answer}\n".encode())
                    return False
                answer = json.dumps({"busy": False, "pictures": self._task.buffers})
                socket.send_fds(client, [f"{answer}\n".encode()], [self._task.handle])
                # Without limit: the client sets a mode and starts its own guard before it answers.
                client.settimeout(None)
                self._socket.close()
                if client.recv(len(TAKEN)) == TAKEN:
                    return True
        try:
            self._socket = self._listen()
        except OSError:
            # The client did not answer, but its guard runs.
            return True
        self._outlive_process()
        return False

    def _listen(self) -> socket.socket:
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listener.bind(guard_address(self._task.handle))
        listener.listen(1)
        return listener

    def _answer(self, line: str) -> None:
        # The other end of the pipe may be closed.
        with suppress(OSError):
            os.write(sys.stdout.fileno(), f"{line}\n".encode())


def encode_task(task: KmsGuardTask) -> str:
    """Return a task as the guard's argument."""
    return json.dumps(asdict(task))


def main(arguments: Sequence[str]) -> None:
    """Run the task that the first argument describes (JSON)."""
    _KmsGuard(KmsGuardTask(**json.loads(arguments[0]))).run()


if __name__ == "__main__":
    main(sys.argv[1:])
