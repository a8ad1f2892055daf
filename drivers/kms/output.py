"""One output of a graphics card, ours alone: chosen, made exact, kept black between patterns, timed by its flips."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np

from drivers.display.pixels import coloured, require_same
from drivers.display.timing import Presented, flipped
from drivers.kms import finding, holding
from drivers.kms.card import Picture
from drivers.kms.guard import Duty
from drivers.kms.holding import Holding
from drivers.kms.modes import chosen_mode
from drivers.kms.options import KmsOptions
from drivers.kms.scanning import Place, Scanning, free_controller
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels

Result = TypeVar("Result")

_FLIPS_IN_S = 1.0
_BLACK = 0
_TURNS = (1, 2, 1)
"""Which picture comes after which, of the black one and the two that patterns are drawn in by turns."""
_MENDS_PIXELS = "another program writes there, or the graphics driver does; please report it, with what dmesg says"


class KmsStage:
    """Implements `drivers.display.stage.Stage` by the kernel alone. Used by one thread, but for `cover`.

    Raises
    ------
    UnsupportedByDeviceError
        There is no output of that name, or it cannot show every pixel as it is.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another program has the graphics card.
    DeviceError
        This user may not open it, or the kernel refuses.
    """

    def __init__(self, options: KmsOptions) -> None:
        self._options = options
        self._name = options.output
        path = finding.chosen(self._name).card
        if finding.is_unplugged(self._name, path):
            raise finding.gone(self._name)
        self._holding: Holding = holding.hold(path, self._name)
        self._pictures: list[Picture] = []
        try:
            self._card = self._holding.card
            self._place = self._kernel(self._placed)
            self.size = self._place.mode.size
            for _ in range(3):
                self._pictures.append(self._kernel(lambda: self._card.picture(self.size)))
            self._scanning = self._kernel(lambda: Scanning(self._card, self._place))
            self._kernel(lambda: self._scanning.begin(self._pictures[_BLACK]))
            self._keep_dark()
            self._timed = self._card.counts_refreshes(self._place.controller)
        except BaseException:
            self._leave()
            raise
        edid = finding.display(self._name, path)
        self.refresh_s = self._place.mode.refresh_s
        told = "" if self._timed else ", whose driver does not tell when it refreshes"
        self.model = f"{edid or 'display'} on {self._name}, {self._place.mode}{told}"
        self.serial = edid.serial if edid is not None and edid.serial else self._name
        self._shown = _BLACK
        self._sequence: PatternSequence | None = None
        # A handle that was taken over from another process may have flips to tell of that it asked for.
        self._number = time.monotonic_ns()

    def load(self, sequence: PatternSequence) -> None:
        """See `Stage`. Makes the output exact again: a display that was switched off and on may need it."""
        self._require_plugged()
        there = self._kernel(lambda: self._card.connector(self._place.connector.number, probe=False))
        if self._place.mode not in there.modes:
            message = (
                f"output {self._name}: opened by the mode {self._place.mode}, which the display that is connected now "
                "does not have; open the rig again"
            )
            raise UnsupportedByDeviceError(message)
        self._kernel(lambda: self._scanning.begin(self._pictures[_BLACK]))
        self._shown = _BLACK
        self._keep_dark()
        self._sequence = sequence

    def show(self, index: int | None) -> Presented:
        """See `Stage`.

        Raises
        ------
        DeviceGoneError
            The display was unplugged.
        DeviceError
            The kernel did not flip to the picture in time.
        """
        turn = _BLACK
        if index is not None and self._sequence is not None:
            self._require_plugged()
            turn = _TURNS[self._shown]
            self._pictures[turn].pixels[:] = coloured(self._sequence.profiles[index], self._sequence.patterns[index])
        asked_ns = time.monotonic_ns()
        stamp_ns = self._kernel(lambda: self._flipped(self._pictures[turn]))
        returned_ns = time.monotonic_ns()
        self._shown = turn
        refresh_ns = round(self.refresh_s * 1e9)
        if not self._timed or not asked_ns - refresh_ns <= stamp_ns <= returned_ns + refresh_ns:
            # The stamp is when the driver was done with the request, or of another clock: nothing is known but that.
            return Presented(asked_ns, returned_ns + refresh_ns)
        return flipped(stamp_ns)

    def compare(self, levels: Pixels) -> None:
        """See `Stage`."""
        shown = self._pictures[self._shown]
        if not self._kernel(lambda: self._scanning.shows(shown)):
            message = f"output {self._name} shows another picture than the pattern; {_MENDS_PIXELS}"
            raise UnsupportedByDeviceError(message)
        require_same(self._name, coloured(levels), np.array(shown.pixels), _MENDS_PIXELS)

    def cover(self) -> bool:
        """See `Stage`: by the guard."""
        return self._holding.cover()

    def close(self) -> None:
        """See `Stage`. The card stays ours, black, for as long as the process lives."""
        self._leave()

    def _placed(self) -> Place:
        """Where patterns are to be shown: looks anew at what is connected."""
        found = next((each for each in self._card.connectors() if each.name == self._name), None)
        if found is None or not found.connected:
            raise finding.gone(self._name)
        connector = self._card.connector(found.number, probe=True)
        if not connector.connected:
            raise finding.gone(self._name)
        self._require_monitor()
        mode = chosen_mode(
            self._name, connector.modes, native=self._options.native, refresh_hz=self._options.refresh_hz
        )
        return Place(connector, *free_controller(self._card, connector), mode)

    def _require_monitor(self) -> None:
        monitor, edid = self._options.monitor, finding.display(self._name, self._holding.path)
        if monitor is not None and monitor not in (str(edid), edid and edid.name):
            message = (
                f"output {self._name}: the rig file says that '{monitor}' is connected, found "
                f"'{edid or 'a display without EDID'}'; swap the cables, or correct monitor (slrig devices lists what "
                "is where)"
            )
            raise UnsupportedByDeviceError(message)

    def _require_plugged(self) -> None:
        if finding.is_unplugged(self._name, self._holding.path):
            raise finding.gone(self._name)

    def _keep_dark(self) -> None:
        place = self._place
        self._holding.keep_dark(
            Duty(
                self._card.handle,
                self._name,
                place.controller,
                place.connector.number,
                place.mode.content.hex(),
                self._pictures[_BLACK].number,
                [(each.number, each.handle) for each in self._pictures],
                os.getpid(),
                self._options.dark_after_s,
            )
        )

    def _flipped(self, picture: Picture) -> int:
        """Flip to a picture, and return the kernel's time stamp."""
        self._number += 1
        until_s = time.monotonic() + _FLIPS_IN_S
        asked = False
        while (left_s := until_s - time.monotonic()) > 0:
            if not asked:
                try:
                    self._scanning.flip(picture, self._number)
                    asked = True
                except OSError as error:
                    # A flip before this one is not done yet.
                    if error.errno != errno.EBUSY:
                        raise
                    left_s = min(left_s, self.refresh_s)
            for flip in self._card.flips(left_s):
                if flip.number == self._number:
                    return flip.stamp_ns
        message = (
            f"output {self._name} made no refresh in {_FLIPS_IN_S:g} s: the display is off, or its graphics driver "
            "hangs; see the kernel's log (dmesg)"
        )
        raise DeviceError(message)

    def _leave(self) -> None:
        # Freed when there is another picture in their place; but memory that is mapped would keep the card open.
        self._holding.stale += [(each.number, each.handle) for each in self._pictures]
        self._pictures.clear()
        holding.leave(self._holding)

    def _kernel(self, attempt: Callable[[], Result]) -> Result:
        """Do something with the card, and say of a refusal what it means."""
        try:
            return attempt()
        except OSError as error:
            words = f"output {self._name}: the kernel refuses ({error.strerror})"
            if error.errno in (errno.ENODEV, errno.ENXIO):
                message = f"{words}; its graphics card was unplugged: plug it in, and open the rig again"
                raise DeviceGoneError(message) from error
            if error.errno == errno.EACCES:
                message = f"{words}; another program has taken the graphics card: end it, and open the rig again"
                raise DeviceBusyError(message) from error
            message = f"{words}: its driver may not have this mode, or lack memory for pictures; see dmesg"
            raise DeviceError(message) from error
