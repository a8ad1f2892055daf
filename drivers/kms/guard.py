"""A process of its own that keeps an output black after the process that shows patterns has ended, however it did.

The kernel takes away the pictures of a program that ends, and puts the text console in their place: with light in it.
The guard has the same open card: as long as it has, the card stays ours, and nothing else is shown. It makes the output
black when the process that it watches has ended, or when it is told to (`cover` on its standard input, answered by the
same line); it ends when it is told to (`release`; no answer), or some time after that process.

A process of the same user may take the card over, after the one that is watched has ended: it connects to
`guard_address`, gets one line and the open card with it, and says when it has a guard of its own. No light is seen in
between.
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
_ANSWERS_IN_S = 2.0


@dataclass(frozen=True, slots=True)
class KmsGuardTask:
    """What to make black, by which open card, on behalf of which process, and for how long after its end.

    mode : as the kernel has it, in hexadecimal. black : the picture. pictures : all of them, as frame buffers with the
    handles of their memory.
    """

    handle: int
    output: str
    controller: int
    connector: int
    mode: str
    black: int
    pictures: list[tuple[int, int]]
    process: int
    dark_after_s: float


def guard_address(handle: int) -> str:
    """Where the guard of an open card is reached: a socket without a file, one for each card."""
    return f"\0slrig-kms-{os.fstat(handle).st_rdev}"


class _KmsGuard:
    def __init__(self, duty: KmsGuardTask) -> None:
        self._duty = duty
        self._listening = self._heard_of()
        self._process: int | None = None
        with suppress(OSError, AttributeError):
            # A child of the watched process may hold the other end of the pipe open.
            self._process = os.pidfd_open(duty.process)
        self._asked = b""
        self._orders: int | None = sys.stdin.fileno()
        self._until_s: float | None = None

    def run(self) -> None:
        """Keep the output black until somebody or something ends that."""
        self._say("ready")
        while self._until_s is None or time.monotonic() < self._until_s:
            left_s = None if self._until_s is None else max(self._until_s - time.monotonic(), 0)
            heard = [each for each in (self._orders, self._process, self._listening) if each is not None]
            ready = select.select(heard, [], [], left_s)[0]
            if self._orders in ready and self._released():
                return
            if self._process is not None and self._process in ready:
                self._mourn()
            if self._listening in ready and self._relieved():
                return

    def _released(self) -> bool:
        heard = os.read(sys.stdin.fileno(), 4096)
        *lines, self._asked = (self._asked + heard).split(b"\n")
        for line in lines:
            if line == b"release":
                return True
            # Whoever asked hears nothing where the kernel refuses.
            with suppress(OSError):
                self._darken()
                self._say(line.decode())
        if not heard:
            self._mourn()
        return False

    def _mourn(self) -> None:
        """The watched process is gone: stay for the time that was asked for."""
        self._orders = self._process = None
        # The display may be unplugged.
        with suppress(OSError):
            self._darken()
        if self._until_s is None:
            self._until_s = time.monotonic() + self._duty.dark_after_s

    def _darken(self) -> None:
        duty = self._duty
        kernel.set_mode(duty.handle, duty.controller, duty.connector, bytes.fromhex(duty.mode), duty.black)

    def _relieved(self) -> bool:
        """Whether another process has the card now."""
        visitor, _ = self._listening.accept()
        with visitor:
            visitor.settimeout(_ANSWERS_IN_S)
            # It may have given up, or be killed: then everything is as before.
            with suppress(OSError):
                credentials = visitor.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
                user = struct.unpack("3i", credentials)[1]
                watching = self._until_s is None
                told = json.dumps({"process": self._duty.process, "output": self._duty.output, "busy": watching})
                if watching or user not in (0, os.getuid()):
                    visitor.sendall(f"{told}\n".encode())
                    return False
                told = json.dumps({"busy": False, "pictures": self._duty.pictures})
                socket.send_fds(visitor, [f"{told}\n".encode()], [self._duty.handle])
                # As long as it takes: the other one sets a mode, and a guard of its own, before it answers.
                visitor.settimeout(None)
                self._listening.close()
                if visitor.recv(len(TAKEN)) == TAKEN:
                    return True
        try:
            self._listening = self._heard_of()
        except OSError:
            # It said nothing any more, but the guard that it has set is there.
            return True
        self._mourn()
        return False

    def _heard_of(self) -> socket.socket:
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listening.bind(guard_address(self._duty.handle))
        listening.listen(1)
        return listening

    def _say(self, word: str) -> None:
        # Nobody may be there to hear it.
        with suppress(OSError):
            os.write(sys.stdout.fileno(), f"{word}\n".encode())


def described(duty: KmsGuardTask) -> str:
    """A duty as the guard's argument."""
    return json.dumps(asdict(duty))


def main(arguments: Sequence[str]) -> None:
    """Do the duty that the first argument describes (JSON)."""
    _KmsGuard(KmsGuardTask(**json.loads(arguments[0]))).run()


if __name__ == "__main__":
    main(sys.argv[1:])
