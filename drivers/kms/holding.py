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

from drivers.display.guard import GuardProcess
from drivers.kms import guard, kernel
from drivers.kms.card import Card
from drivers.kms.guard import TAKEN, KmsGuardTask, guard_address
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError

PROCESSES = Path("/proc")

_DESKTOPS = frozenset(
    {
        *("Xorg", "X", "gnome-shell", "kwin_wayland", "kwin_x11", "sway", "weston", "labwc", "wayfire", "Hyprland"),
        *("cosmic-comp", "mutter", "cage", "phoc", "gamescope", "plymouthd"),
    }
)
"""Programs that take graphics cards, by the kernel's name of their processes."""


def card_busy_error(path: Path, output: str) -> DeviceBusyError:
    """Say who has a card, and what to do."""
    who = ", ".join(_list_holders(path)) or "another program"
    message = (
        f"output {output}: {path} is held by {who}; one program at a time says what a graphics card shows. Either show "
        "patterns through it: driver 'screen', in a session of X, as Xorg for the projector alone is, too. Or have it "
        "let the card go: end the desktop (sudo systemctl isolate multi-user.target), or go to a text console "
        "(Ctrl+Alt+F3) and stay there. Or give the projector a graphics card of its own, which the desktop is told to "
        "leave alone (config/deploy/README.md)"
    )
    return DeviceBusyError(message)


def _list_holders(path: Path) -> list[str]:
    """Processes that have the card open; where none is to be seen, those that are known to take cards."""
    opened: list[str] = []
    known: list[str] = []
    ours = str(os.getpid())
    for folder in PROCESSES.glob("[0-9]*"):
        # Processes end while we look, and those of other users hide what they have open.
        with suppress(OSError):
            name = (folder / "comm").read_text().strip()
            words = f"{name} (process {folder.name})"
            if name in _DESKTOPS:
                known.append(words)
            if folder.name != ours and any(_leads_to(link, path) for link in (folder / "fd").iterdir()):
                opened.append(words)
    return opened or known


def _leads_to(link: Path, path: Path) -> bool:
    try:
        return link.readlink() == path
    except OSError:
        return False


_ANSWERS_IN_S = 2.0
_LONGEST_ANSWER = 4096

_held: dict[Path, HeldCard] = {}
_holding = threading.Lock()


class HeldCard:
    """A card of ours. `stale` are pictures that are not needed once the next guard is set."""

    def __init__(self, path: Path, card: Card, *, before: socket.socket | None, stale: list[tuple[int, int]]) -> None:
        self.path = path
        self.card = card
        self.stale = stale
        self.output: str | None = None
        self._before = before
        self._duty: KmsGuardTask | None = None
        self._guard: GuardProcess | None = None

    def keep_dark(self, duty: KmsGuardTask) -> None:
        """Set the guard, if there is none that does this duty. Raises DeviceError."""
        if self._guard is not None and self._guard.is_alive and self._duty == duty:
            return
        if self._guard is not None:
            # Nothing is seen of it: the card is ours all the time.
            self._guard.release()
        self._guard = GuardProcess(guard.__name__, guard.described(duty), duty.output, (duty.handle,))
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


def hold_card(path: Path, output: str) -> HeldCard:
    """Take a card for one of its outputs; `leave_card` gives it back.

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
            found = _open_card(path, output)
        found.output = output
        _held[path] = found
        return found


def leave_card(holding: HeldCard) -> None:
    """Show nothing more on a card; one that was made black stays ours for as long as this process lives."""
    with _holding:
        holding.output = None
        if not holding.is_guarded:
            _held.pop(holding.path, None)
            holding.end()


def release_card(path: Path) -> None:
    """Let a card go, if this process has it: what the kernel shows is seen again."""
    with _holding:
        found = _held.pop(path, None)
    if found is not None:
        found.end()


def _open_card(path: Path, output: str) -> HeldCard:
    try:
        handle = kernel.open_card(str(path))
    except OSError as error:
        raise _open_error(error, path, output) from error
    card = Card(handle)
    if card.is_master():
        return HeldCard(path, card, before=None, stale=[])
    try:
        return _take_over(path, handle, output)
    finally:
        card.close()


def _take_over(path: Path, handle: int, output: str) -> HeldCard:
    """The card from the guard of a process that has ended."""
    visitor = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        visitor.settimeout(_ANSWERS_IN_S)
        visitor.connect(guard_address(handle))
        data, handles, _, _ = socket.recv_fds(visitor, _LONGEST_ANSWER, 1)
        told = json.loads(data)
    except (OSError, ValueError) as error:
        visitor.close()
        raise card_busy_error(path, output) from error
    if not handles:
        visitor.close()
        message = (
            f"output {output}: process {told['process']} shows patterns on output {told['output']} of {path}, or did "
            "and belongs to another user; end it, or wait for it"
        )
        raise DeviceBusyError(message)
    os.set_inheritable(handles[0], False)
    stale = [(int(number), int(memory)) for number, memory in told["pictures"]]
    return HeldCard(path, Card(handles[0]), before=visitor, stale=stale)


def _open_error(error: OSError, path: Path, output: str) -> DeviceError:
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
        return card_busy_error(path, output)
    return UnsupportedByDeviceError(f"{words}; see the kernel's log (dmesg)")
