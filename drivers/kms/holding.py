"""Graphics cards that this process alone has (DRM master), each with its guard, until the process ends.

Releasing a card would show the text console on it, so an opened card stays ours, black, for the next opening.
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
"""Programs that use graphics cards, by their process names."""

_ANSWER_TIMEOUT_S = 2.0
_MAX_ANSWER_BYTES = 4096
_held_cards: dict[Path, HeldCard] = {}
_held_cards_lock = threading.Lock()


def card_busy_error(path: Path, output: str) -> DeviceBusyError:
    """Return the error for a card that other programs use, with their names and what to do."""
    holders = ", ".join(_list_holders(path)) or "another program"
    message = (
        f"output {output}: {path} is held by {holders}; one program at a time controls a graphics card. Either show "
        "patterns through it: driver 'screen', in an X session, which may be an Xorg for the projector alone. Or make "
        "it release the card: end the desktop (sudo systemctl isolate multi-user.target), or switch to a text console "
        "(Ctrl+Alt+F3) and stay there. Or give the projector a graphics card of its own that the desktop ignores "
        "(config/deploy/README.md)"
    )
    return DeviceBusyError(message)


def _list_holders(path: Path) -> list[str]:
    """List processes that have the card open; if none is visible, those that are known to use cards."""
    opened: list[str] = []
    known: list[str] = []
    ours = str(os.getpid())
    for folder in PROCESSES.glob("[0-9]*"):
        # Processes may end meanwhile, and open files of other users are hidden.
        with suppress(OSError):
            name = (folder / "comm").read_text().strip()
            description = f"{name} (process {folder.name})"
            if name in _DESKTOPS:
                known.append(description)
            if folder.name != ours and any(_leads_to(link, path) for link in (folder / "fd").iterdir()):
                opened.append(description)
    return opened or known


def _leads_to(link: Path, path: Path) -> bool:
    try:
        return link.readlink() == path
    except OSError:
        return False


class HeldCard:
    """A card that this process has. `stale` are buffers to free once the next guard runs."""

    def __init__(
        self, path: Path, card: Card, *, predecessor: socket.socket | None, stale: list[tuple[int, int]]
    ) -> None:
        self.path = path
        self.card = card
        self.stale = stale
        self.output: str | None = None
        self._predecessor = predecessor
        self._task: KmsGuardTask | None = None
        self._guard: GuardProcess | None = None

    def keep_dark(self, task: KmsGuardTask) -> None:
        """Start a guard for this task, if none runs. Raises DeviceError."""
        if self._guard is not None and self._guard.is_alive and self._task == task:
            return
        if self._guard is not None:
            # Not visible: the card stays ours.
            self._guard.release()
        self._guard = GuardProcess(guard.__name__, guard.encode_task(task), task.output, (task.handle,))
        self._task = task
        if self._predecessor is not None:
            # The guard of a process that was killed has run until now.
            with suppress(OSError):
                self._predecessor.sendall(TAKEN)
            self._predecessor.close()
            self._predecessor = None
        self.card.free_buffers(self.stale)
        self.stale = []

    @property
    def is_guarded(self) -> bool:
        """True if a guard was started."""
        return self._guard is not None

    def cover(self) -> bool:
        """Make the output black through the guard, from any thread; return True if it did."""
        return self._guard is not None and self._guard.cover()

    def end(self) -> None:
        """Release the card: the console is visible again."""
        if self._guard is not None:
            self._guard.release()
        if self._predecessor is not None:
            self._predecessor.close()
        self.card.close()


def hold_card(path: Path, output: str) -> HeldCard:
    """Take a card for one of its outputs; `leave_card` gives it back.

    Raises
    ------
    DeviceBusyError
        Another program has it, or it shows patterns already. States which, and what to do.
    DeviceGoneError
        It was unplugged.
    UnsupportedByDeviceError
        It has no outputs.
    DeviceError
        This user may not open it.
    """
    with _held_cards_lock:
        found = _held_cards.get(path)
        if found is not None and found.output is not None:
            message = f"output {output}: this process shows patterns on output {found.output} of {path}; close that rig"
            raise DeviceBusyError(message)
        if found is None:
            found = _open_card(path, output)
        found.output = output
        _held_cards[path] = found
        return found


def leave_card(held: HeldCard) -> None:
    """End the reservation of a card; a guarded card stays ours, black, as long as this process runs."""
    with _held_cards_lock:
        held.output = None
        if not held.is_guarded:
            _held_cards.pop(held.path, None)
            held.end()


def release_card(path: Path) -> None:
    """Release a card if this process has it: the console is visible again."""
    with _held_cards_lock:
        found = _held_cards.pop(path, None)
    if found is not None:
        found.end()


def _open_card(path: Path, output: str) -> HeldCard:
    try:
        handle = kernel.open_card(str(path))
    except OSError as error:
        raise _open_error(error, path, output) from error
    card = Card(handle)
    if card.is_master():
        return HeldCard(path, card, predecessor=None, stale=[])
    try:
        return _take_over(path, handle, output)
    finally:
        card.close()


def _take_over(path: Path, handle: int, output: str) -> HeldCard:
    """Take the card over from the guard of a process that has ended."""
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        client.settimeout(_ANSWER_TIMEOUT_S)
        client.connect(guard_address(handle))
        data, handles, _, _ = socket.recv_fds(client, _MAX_ANSWER_BYTES, 1)
        answer = json.loads(data)
    except (OSError, ValueError) as error:
        client.close()
        raise card_busy_error(path, output) from error
    if not handles:
        client.close()
        message = (
            f"output {output}: process {answer['process']} shows patterns on output {answer['output']} of {path}, or "
            "did and belongs to another user; end it, or wait for it"
        )
        raise DeviceBusyError(message)
    os.set_inheritable(handles[0], False)
    stale = [(int(number), int(memory)) for number, memory in answer["pictures"]]
    return HeldCard(path, Card(handles[0]), predecessor=client, stale=stale)


def _open_error(error: OSError, path: Path, output: str) -> DeviceError:
    """Return the error for a card that could not be opened."""
    failure = f"output {output}: {path} cannot be opened ({error.strerror})"
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return DeviceGoneError(f"{failure}; the graphics card is gone, or this container has no access to {path}")
    if error.errno in (errno.EACCES, errno.EPERM):
        return DeviceError(
            f"{failure}; give this user access: sudo usermod -aG video $USER, and log in again; a service needs "
            "DeviceAllow=char-drm rw as well (config/deploy/slrig-kms.conf)"
        )
    if error.errno == errno.EBUSY:
        return card_busy_error(path, output)
    return UnsupportedByDeviceError(f"{failure}; see the kernel's log (dmesg)")
