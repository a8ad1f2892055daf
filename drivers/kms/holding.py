"""Graphics cards that this process alone has (DRM master), each with its guard: kept until the process ends.

Letting a card go would light the text console on it, so one that was opened stays ours, black, for the next opening.
"""

from __future__ import annotations

import errno
import json
import os
import socket
import threading
from contextlib import suppress
from pathlib import Path

from drivers.display.guarding import Guard
from drivers.kms import guard, kernel
from drivers.kms.card import Card
from drivers.kms.guard import TAKEN, Duty, address
from drivers.kms.holders import held
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

_ANSWERS_IN_S = 2.0
_LONGEST_ANSWER = 4096

_held: dict[Path, Holding] = {}
_holding = threading.Lock()


class Holding:
    """A card of ours. `stale` are pictures that are not needed once the next guard is set."""

    def __init__(self, path: Path, card: Card, *, before: socket.socket | None, stale: list[tuple[int, int]]) -> None:
        self.path = path
        self.card = card
        self.stale = stale
        self.output: str | None = None
        self._before = before
        self._duty: Duty | None = None
        self._guard: Guard | None = None

    def keep_dark(self, duty: Duty) -> None:
        """Set the guard, if there is none that does this duty. Raises DeviceError."""
        if self._guard is not None and self._guard.is_alive and self._duty == duty:
            return
        if self._guard is not None:
            # Nothing is seen of it: the card is ours all the time.
            self._guard.release()
        self._guard = Guard(guard.__name__, guard.described(duty), duty.output, (duty.handle,))
        self._duty = duty
        if self._before is not None:
            # The guard of a process that was killed has stayed until now.
            with suppress(OSError):
                self._before.sendall(TAKEN)
            self._before.close()
            self._before = None
        self.card.forget(self.stale)
        self.stale = []

    @property
    def is_guarded(self) -> bool:
        """Whether it was made black for good."""
        return self._guard is not None

    def cover(self) -> bool:
        """Have the guard make the output black, from any thread; return whether it did."""
        return self._guard is not None and self._guard.cover()

    def end(self) -> None:
        """Let the card go: the console is seen again."""
        if self._guard is not None:
            self._guard.release()
        if self._before is not None:
            self._before.close()
        self.card.close()


def hold(path: Path, output: str) -> Holding:
    """Take a card for one of its outputs; `leave` gives it back.

    Raises
    ------
    DeviceBusyError
        Another program has it, or it shows patterns already. Names who, and what to do.
    DeviceGoneError
        It was unplugged.
    UnsupportedByDeviceError
        It has no outputs.
    DeviceError
        This user may not open it.
    """
    with _holding:
        found = _held.get(path)
        if found is not None and found.output is not None:
            message = f"output {output}: this process shows patterns on output {found.output} of {path}; close that rig"
            raise DeviceBusyError(message)
        if found is None:
            found = _opened(path, output)
        found.output = output
        _held[path] = found
        return found


def leave(holding: Holding) -> None:
    """Show nothing more on a card; one that was made black stays ours for as long as this process lives."""
    with _holding:
        holding.output = None
        if not holding.is_guarded:
            _held.pop(holding.path, None)
            holding.end()


def release(path: Path) -> None:
    """Let a card go, if this process has it: what the kernel shows is seen again."""
    with _holding:
        found = _held.pop(path, None)
    if found is not None:
        found.end()


def _opened(path: Path, output: str) -> Holding:
    try:
        handle = kernel.opened(str(path))
    except OSError as error:
        raise _refused(error, path, output) from error
    card = Card(handle)
    if card.is_master():
        return Holding(path, card, before=None, stale=[])
    try:
        return _taken_over(path, handle, output)
    finally:
        card.close()


def _taken_over(path: Path, handle: int, output: str) -> Holding:
    """The card from the guard of a process that has ended."""
    visitor = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        visitor.settimeout(_ANSWERS_IN_S)
        visitor.connect(address(handle))
        data, handles, _, _ = socket.recv_fds(visitor, _LONGEST_ANSWER, 1)
        told = json.loads(data)
    except (OSError, ValueError) as error:
        visitor.close()
        raise held(path, output) from error
    if not handles:
        visitor.close()
        message = (
            f"output {output}: process {told['process']} shows patterns on output {told['output']} of {path}, or did "
            "and belongs to another user; end it, or wait for it"
        )
        raise DeviceBusyError(message)
    os.set_inheritable(handles[0], False)
    stale = [(int(number), int(memory)) for number, memory in told["pictures"]]
    return Holding(path, Card(handles[0]), before=visitor, stale=stale)


def _refused(error: OSError, path: Path, output: str) -> DeviceError:
    """Why a card could not be opened, and what to do."""
    words = f"output {output}: {path} cannot be opened ({error.strerror})"
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceGoneError(f"{words}; the graphics card is gone, or this container was not given {path}")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceError(
            f"{words}; let this user in: sudo usermod -aG video $USER, and log in again; a service of systemd needs "
            "DeviceAllow=char-drm rw besides (config/deploy/slrig-kms.conf)"
        )
    if error.errno == errno.EBUSY:
        return held(path, output)
    return UnsupportedByDeviceError(f"{words}; see the kernel's log (dmesg)")
