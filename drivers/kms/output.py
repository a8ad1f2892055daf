"""One output of a graphics card, ours alone: chosen, made exact, kept black between patterns, timed by its flips."""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from drivers.display.projector import ScanoutStart, require_equal_pixels, rgb_pixels, start_of_flip
from drivers.kms import finding, holding
from drivers.kms.card import Card, CardConnector, DumbBuffer, KmsMode, KmsPlane, Property, PropertyChange, choose_mode
from drivers.kms.guard import KmsGuardTask
from drivers.kms.holding import HeldCard
from drivers.kms.kernel import (
    ATOMIC_ALLOW_MODESET,
    ATOMIC_NONBLOCK,
    OBJECT_CONNECTOR,
    OBJECT_CRTC,
    OBJECT_PLANE,
    PAGE_FLIP_EVENT,
    PLANE_PRIMARY,
)
from drivers.kms.options import KmsOptions
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels

_CONNECTOR_WORDS = {"Broadcast RGB": "Full", "underscan": "off", "content type": "Graphics", "link-status": "Good"}
"""Levels 0 to 255, no border, no improvement of films by the display, and a link that is trained anew if it failed."""
_CONTROLLER_OFF = ("GAMMA_LUT", "DEGAMMA_LUT", "CTM", "VRR_ENABLED")
"""0 is the identity, as the kernel's documentation of colour management has it; and no refresh that varies."""
_PLANE_PLAIN = {"rotation": 1, "alpha": 0xFFFF}


@dataclass(frozen=True, slots=True)
class OutputRoute:
    """A connector, the controller that drives it, and the mode."""

    connector: CardConnector
    controller: int
    index: int
    mode: KmsMode


def find_controller(card: Card, connector: CardConnector) -> tuple[int, int]:
    """A controller for this connector alone, and its index: the one that drives it now, if it drives no other.

    Raises
    ------
    UnsupportedByDeviceError
        All that could are at work for other displays.
    """
    numbers = card.controllers()
    others = {each.name: each.controller for each in card.connectors() if each.number != connector.number}
    usable = [(number, index) for index, number in enumerate(numbers) if index in connector.controllers]
    free = [pair for pair in usable if pair[0] not in others.values()]
    for pair in free:
        if pair[0] == connector.controller:
            return pair
    if free:
        return free[0]
    busy = ", ".join(name for name, number in others.items() if number)
    message = (
        f"output {connector.name}: the graphics card cannot show another picture there than on {busy or 'its others'}; "
        "unplug a display"
    )
    raise UnsupportedByDeviceError(message)


class Scanout:
    """A place, and the pictures that are scanned out to it. Raises OSError where the kernel refuses."""

    def __init__(self, card: Card, place: OutputRoute) -> None:
        self._card = card
        self._place = place
        self._plane: KmsPlane | None = None
        self._picture_property = 0
        self._blob = 0
        if card.atomic:
            self._plane = self._primary()
            self._picture_property = card.properties(self._plane.number, OBJECT_PLANE)["FB_ID"].number
            self._blob = card.blob(place.mode.content)

    def begin(self, picture: DumbBuffer) -> None:
        """Have this picture scanned out, exactly; returns when it is."""
        card, place = self._card, self._place
        connector = card.properties(place.connector.number, OBJECT_CONNECTOR)
        controller = card.properties(place.controller, OBJECT_CRTC)
        if self._plane is not None:
            changes = [
                *_words(place.connector.number, connector),
                (place.connector.number, connector["CRTC_ID"].number, place.controller),
                *((place.controller, controller[name].number, 0) for name in _CONTROLLER_OFF if name in controller),
                (place.controller, controller["MODE_ID"].number, self._blob),
                (place.controller, controller["ACTIVE"].number, 1),
                *self._planes(self._plane, picture),
            ]
            card.commit(changes, flags=ATOMIC_ALLOW_MODESET)
        else:
            card.set_mode(place.controller, place.connector.number, place.mode.content, picture.number)
            for number, prop, value in _words(place.connector.number, connector):
                # An older driver has what the display has, and may refuse the rest.
                with suppress(OSError):
                    card.set_property(number, OBJECT_CONNECTOR, prop, value)
        if "GAMMA_LUT" not in controller or self._plane is None:
            card.straighten(place.controller)

    def flip(self, picture: DumbBuffer, number: int) -> None:
        """Have another picture scanned out from the next refresh on; the kernel tells by an event of that number."""
        if self._plane is not None:
            change = (self._plane.number, self._picture_property, picture.number)
            self._card.commit([change], flags=ATOMIC_NONBLOCK | PAGE_FLIP_EVENT, number=number)
        else:
            self._card.flip(self._place.controller, picture.number, number)

    def shows(self, picture: DumbBuffer) -> bool:
        """Whether this picture is scanned out now."""
        return self._card.scanned_out(self._place.controller) == picture.number

    def _primary(self) -> KmsPlane:
        controller, bit = self._place.controller, 1 << self._place.index
        usable = [
            plane
            for plane in self._card.planes()
            if plane.controllers & bit
            and plane.controller in (0, controller)
            and self._card.properties(plane.number, OBJECT_PLANE)["type"].value == PLANE_PRIMARY
        ]
        if not usable:
            message = (
                f"output {self._place.connector.name}: all planes of the graphics card are in use; unplug a display"
            )
            raise UnsupportedByDeviceError(message)
        return next((plane for plane in usable if plane.controller == controller), usable[0])

    def _planes(self, primary: KmsPlane, picture: DumbBuffer) -> Iterator[PropertyChange]:
        """The picture, as it is, on the primary plane, and nothing on the controller's others."""
        size, number = self._place.mode.size, primary.number
        told = self._card.properties(number, OBJECT_PLANE)
        whole = {
            **{"FB_ID": picture.number, "CRTC_ID": self._place.controller},
            # In 1/65536 of a pixel of the picture, and in pixels of the display.
            **{"SRC_X": 0, "SRC_Y": 0, "SRC_W": size.width_px << 16, "SRC_H": size.height_px << 16},
            **{"CRTC_X": 0, "CRTC_Y": 0, "CRTC_W": size.width_px, "CRTC_H": size.height_px},
            **{name: value for name, value in _PLANE_PLAIN.items() if name in told},
        }
        yield from ((number, told[name].number, value) for name, value in whole.items())
        for plane in self._card.planes():
            if plane.controller == self._place.controller and plane.number != number:
                others = self._card.properties(plane.number, OBJECT_PLANE)
                yield from ((plane.number, others[name].number, 0) for name in ("FB_ID", "CRTC_ID"))


def _words(number: int, told: Mapping[str, Property]) -> Iterator[PropertyChange]:
    """Properties of a connector that are words, those that it has."""
    for name, word in _CONNECTOR_WORDS.items():
        if name in told and word in told[name].words:
            yield number, told[name].number, told[name].words[word]


Result = TypeVar("Result")

_FLIPS_IN_S = 1.0
_BLACK = 0
_TURNS = (1, 2, 1)
"""Which picture comes after which, of the black one and the two that patterns are drawn in by turns."""
_MENDS_PIXELS = "another program writes there, or the graphics driver does; please report it, with what dmesg says"


class KmsOutput:
    """Implements `drivers.display.projector.PatternOutput` by the kernel alone. Used by one thread, but for `cover`.

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
        path = finding.find_connector(self._name).card
        if finding.is_unplugged(self._name, path):
            raise finding.not_connected_error(self._name)
        self._holding: HeldCard = holding.hold_card(path, self._name)
        self._pictures: list[DumbBuffer] = []
        try:
            self._card = self._holding.card
            self._place = self._kernel(self._placed)
            self.size = self._place.mode.size
            for _ in range(3):
                self._pictures.append(self._kernel(lambda: self._card.picture(self.size)))
            self._scanning = self._kernel(lambda: Scanout(self._card, self._place))
            self._kernel(lambda: self._scanning.begin(self._pictures[_BLACK]))
            self._keep_dark()
            self._timed = self._card.counts_refreshes(self._place.controller)
        except BaseException:
            self._leave()
            raise
        edid = finding.read_edid(self._name, path)
        self.refresh_s = self._place.mode.refresh_s
        told = "" if self._timed else ", whose driver does not tell when it refreshes"
        self.model = f"{edid or 'display'} on {self._name}, {self._place.mode}{told}"
        self.serial = edid.serial if edid is not None and edid.serial else self._name
        self._shown = _BLACK
        self._sequence: PatternSequence | None = None
        # A handle that was taken over from another process may have flips to tell of that it asked for.
        self._number = time.monotonic_ns()

    def load(self, sequence: PatternSequence) -> None:
        """See `PatternOutput`. Makes the output exact again: a display that was switched off and on may need it."""
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

    def show(self, index: int | None) -> ScanoutStart:
        """See `PatternOutput`.

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
            self._pictures[turn].pixels[:] = rgb_pixels(self._sequence.profiles[index], self._sequence.patterns[index])
        asked_ns = time.monotonic_ns()
        stamp_ns = self._kernel(lambda: self._flipped(self._pictures[turn]))
        returned_ns = time.monotonic_ns()
        self._shown = turn
        refresh_ns = round(self.refresh_s * 1e9)
        if not self._timed or not asked_ns - refresh_ns <= stamp_ns <= returned_ns + refresh_ns:
            # The stamp is when the driver was done with the request, or of another clock: nothing is known but that.
            return ScanoutStart(asked_ns, returned_ns + refresh_ns)
        return start_of_flip(stamp_ns)

    def compare(self, levels: Pixels) -> None:
        """See `PatternOutput`."""
        shown = self._pictures[self._shown]
        if not self._kernel(lambda: self._scanning.shows(shown)):
            message = f"output {self._name} shows another picture than the pattern; {_MENDS_PIXELS}"
            raise UnsupportedByDeviceError(message)
        require_equal_pixels(self._name, rgb_pixels(levels), np.array(shown.pixels), _MENDS_PIXELS)

    def cover(self) -> bool:
        """See `PatternOutput`: by the guard."""
        return self._holding.cover()

    def close(self) -> None:
        """See `PatternOutput`. The card stays ours, black, for as long as the process lives."""
        self._leave()

    def _placed(self) -> OutputRoute:
        """Where patterns are to be shown: looks anew at what is connected."""
        found = next((each for each in self._card.connectors() if each.name == self._name), None)
        if found is None or not found.connected:
            raise finding.not_connected_error(self._name)
        connector = self._card.connector(found.number, probe=True)
        if not connector.connected:
            raise finding.not_connected_error(self._name)
        self._require_monitor()
        mode = choose_mode(
            self._name, connector.modes, native=self._options.native, refresh_hz=self._options.refresh_hz
        )
        return OutputRoute(connector, *find_controller(self._card, connector), mode)

    def _require_monitor(self) -> None:
        monitor, edid = self._options.monitor, finding.read_edid(self._name, self._holding.path)
        if monitor is not None and monitor not in (str(edid), edid and edid.name):
            message = (
                f"output {self._name}: the rig file says that '{monitor}' is connected, found "
                f"'{edid or 'a display without EDID'}'; swap the cables, or correct monitor (slrig devices lists what "
                "is where)"
            )
            raise UnsupportedByDeviceError(message)

    def _require_plugged(self) -> None:
        if finding.is_unplugged(self._name, self._holding.path):
            raise finding.not_connected_error(self._name)

    def _keep_dark(self) -> None:
        place = self._place
        self._holding.keep_dark(
            KmsGuardTask(
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

    def _flipped(self, picture: DumbBuffer) -> int:
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
        holding.leave_card(self._holding)

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
