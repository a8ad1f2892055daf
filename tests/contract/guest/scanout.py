"""What the guest's displays get: QEMU is asked for it, from inside the guest, through its monitor on a serial port."""

from __future__ import annotations

import json
import os
import select
import threading
import time
import tty
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.model import Pixels
from tests.contract.guest.machine import SHARE

PORT = "/dev/ttyS1"
_ANSWERS_IN_S = 20.0


class Monitor:
    """QEMU's monitor (QMP). Safe between threads."""

    def __init__(self, host_folder: str) -> None:
        self._host_folder = host_folder
        self._lock = threading.Lock()
        self._port = os.open(PORT, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self._port)
        # The port has said the monitor's greeting back until now; this byte has the monitor forget what it heard.
        os.write(self._port, b"\xff")
        self._heard = b""
        self._number = 0
        self.ask("qmp_capabilities")

    def ask(self, command: str, **arguments: Any) -> Any:
        """Have it do something, and return what it returns."""
        with self._lock:
            self._number += 1
            order = json.dumps({"execute": command, "arguments": arguments, "id": self._number})
            os.write(self._port, f"{order}\n".encode())
            until_s = time.monotonic() + _ANSWERS_IN_S
            while True:
                while b"\n" in self._heard:
                    line, self._heard = self._heard.split(b"\n", 1)
                    # Else a part of the greeting, what the monitor thought of that, or an event.
                    if f'"id": {self._number}'.encode() in line:
                        answer = json.loads(line)
                        assert "return" in answer, answer
                        return answer["return"]
                if not select.select([self._port], [], [], until_s - time.monotonic())[0]:
                    message = f"the monitor did not answer {command}: {self._heard!r}"
                    raise OSError(message)
                self._heard += os.read(self._port, 4096)

    def dump(self, device: str, head: int, name: str) -> Path:
        self.ask("screendump", filename=f"{self._host_folder}/{name}", device=device, head=head)
        return Path(SHARE) / name


class HeadPixels:
    """What one head of a graphics card of the guest gets to show."""

    def __init__(self, monitor: Monitor, device: str, head: int = 0) -> None:
        self._monitor, self._device, self._head = monitor, device, head

    def colours(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, red, green, blue."""
        path = self._monitor.dump(self._device, self._head, f"{self._device}-{self._head}.ppm")
        data = path.read_bytes()
        kind, width, height, full, start = _header(data)
        assert (kind, full) == (b"P6", 255)
        return np.frombuffer(data, np.uint8, offset=start).reshape(height, width, 3)

    def grey(self) -> Pixels:
        """(H, W) uint8; all three colours are the same."""
        found = self.colours()
        assert (found == found[..., :1]).all()
        return found[..., 0]

    def close(self) -> None:
        """Nothing remains."""


def _header(data: bytes) -> tuple[bytes, int, int, int, int]:
    """Kind, width, height, full scale, and where the pixels of a portable pixmap begin."""
    words: list[bytes] = []
    at = 0
    while len(words) < 4:
        end = at
        while data[end : end + 1] not in (b" ", b"\n"):
            end += 1
        words.append(data[at:end])
        at = end + 1
    return words[0], int(words[1]), int(words[2]), int(words[3]), at
