"""One output of a graphics card: set to exact pixels, kept black between patterns, and timed by its flips.

Drivers with atomic commits get all changes in one commit, others the older requests. Everything that recolours, scales,
rotates or covers pictures is switched off: gamma and colour matrices, limited range, underscan, rotation, cursors and
other planes, and variable refresh.
"""

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
from drivers.kms.card import (
    Card,
    CardConnector,
    DumbBuffer,
    KmsMode,
    KmsOptions,
    KmsPlane,
    Property,
    PropertyChange,
    choose_mode,
)
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
from slrig.errors import DeviceBusyError, DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels

_CONNECTOR_VALUES = {"Broadcast RGB": "Full", "underscan": "off", "content type": "Graphics", "link-status": "Good"}
"""Levels 0 to 255, no border, no film processing by the display, and a link that is trained again if it failed."""
_CONTROLLER_OFF = ("GAMMA_LUT", "DEGAMMA_LUT", "CTM", "VRR_ENABLED")
"""Properties of a controller to set to 0: the identity (kernel documentation, "Color Management"), fixed refresh."""
_PLANE_VALUES = {"rotation": 1, "alpha": 0xFFFF}

Result = TypeVar("Result")
_FLIP_TIMEOUT_S = 1.0
_BLACK = 0
_NEXT_BUFFER = (1, 2, 1)
"""Index of the buffer to draw in after each: of the black one, and the two that patterns alternate between."""
_PIXEL_REMEDY = "another program or the graphics driver writes there; please report it, with the output of dmesg"


@dataclass(frozen=True, slots=True)
class OutputRoute:
    """A connector, the controller that drives it, and the mode."""

    connector: CardConnector
    controller: int
    index: int
    mode: KmsMode


def find_controller(card: Card, connector: CardConnector) -> tuple[int, int]:
    """Return a controller for this connector alone, and its index; the present one if it drives no other connector.

    Raises
    ------
    UnsupportedByDeviceError
        All suitable controllers drive other displays.
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
        f"output {connector.name}: all its controllers drive other displays ({busy or 'unknown'}); unplug a display"
    )
    raise UnsupportedByDeviceError(message)


class Scanout:
    """Scan-out to an output. Raises OSError where the kernel refuses."""

    def __init__(self, card: Card, route: OutputRoute) -> None:
        self._card = card
        self._route = route
        self._plane: KmsPlane | None = None
        self._buffer_property = 0
        self._blob = 0
        if card.atomic:
            self._plane = self._primary_plane()
            self._buffer_property = card.properties(self._plane.number, OBJECT_PLANE)["FB_ID"].number
            self._blob = card.blob(route.mode.content)

    def start(self, buffer: DumbBuffer) -> None:
        """Scan this buffer out unchanged; return when it is scanned out."""
        card, route = self._card, self._route
        connector = card.properties(route.connector.number, OBJECT_CONNECTOR)
        controller = card.properties(route.controller, OBJECT_CRTC)
        if self._plane is not None:
            changes = [
                *_connector_changes(route.connector.number, connector),
                (route.connector.number, connector["CRTC_ID"].number, route.controller),
                *((route.controller, controller[name].number, 0) for name in _CONTROLLER_OFF if name in controller),
                (route.controller, controller["MODE_ID"].number, self._blob),
                (route.controller, controller["ACTIVE"].number, 1),
                *self._plane_changes(self._plane, buffer),
            ]
            card.commit(changes, flags=ATOMIC_ALLOW_MODESET)
        else:
            card.set_mode(route.controller, route.connector.number, route.mode.content, buffer.number)
            for number, prop, value in _connector_changes(route.connector.number, connector):
                # An older driver may refuse properties that the display lacks.
                with suppress(OSError):
                    card.set_property(number, OBJECT_CONNECTOR, prop, value)
        if "GAMMA_LUT" not in controller or self._plane is None:
            card.reset_colours(route.controller)

    def flip(self, buffer: DumbBuffer, number: int) -> None:
        """Flip to another buffer at the next refresh; the kernel reports it by an event of that number."""
        if self._plane is not None:
            change = (self._plane.number, self._buffer_property, buffer.number)
            self._card.commit([change], flags=ATOMIC_NONBLOCK | PAGE_FLIP_EVENT, number=number)
        else:
            self._card.flip(self._route.controller, buffer.number, number)

    def is_showing(self, buffer: DumbBuffer) -> bool:
        """True if this buffer is scanned out."""
        return self._card.current_buffer(self._route.controller) == buffer.number

    def _primary_plane(self) -> KmsPlane:
        controller, bit = self._route.controller, 1 << self._route.index
        usable = [
            plane
            for plane in self._card.planes()
            if plane.controllers & bit
            and plane.controller in (0, controller)
            and self._card.properties(plane.number, OBJECT_PLANE)["type"].value == PLANE_PRIMARY
        ]
        if not usable:
            message = (
                f"output {self._route.connector.name}: all planes of the graphics card are in use; unplug a display"
            )
            raise UnsupportedByDeviceError(message)
        return next((plane for plane in usable if plane.controller == controller), usable[0])

    def _plane_changes(self, primary: KmsPlane, buffer: DumbBuffer) -> Iterator[PropertyChange]:
        """Return the changes that show the buffer on the primary plane, and nothing on the controller's others."""
        size, number = self._route.mode.size, primary.number
        properties = self._card.properties(number, OBJECT_PLANE)
        values = {
            **{"FB_ID": buffer.number, "CRTC_ID": self._route.controller},
            # In 1/65536 of a pixel of the buffer, and in pixels of the display.
            **{"SRC_X": 0, "SRC_Y": 0, "SRC_W": size.width_px << 16, "SRC_H": size.height_px << 16},
            **{"CRTC_X": 0, "CRTC_Y": 0, "CRTC_W": size.width_px, "CRTC_H": size.height_px},
            **{name: value for name, value in _PLANE_VALUES.items() if name in properties},
        }
        yield from ((number, properties[name].number, value) for name, value in values.items())
        for plane in self._card.planes():
            if plane.controller == self._route.controller and plane.number != number:
                others = self._card.properties(plane.number, OBJECT_PLANE)
                yield from ((plane.number, others[name].number, 0) for name in ("FB_ID", "CRTC_ID"))


def _connector_changes(number: int, properties: Mapping[str, Property]) -> Iterator[PropertyChange]:
    """Return the changes of a connector's enumerated properties, of those that it has."""
    for name, value in _CONNECTOR_VALUES.items():
        if name in properties and value in properties[name].enum_values:
            yield number, properties[name].number, properties[name].enum_values[value]


class KmsOutput:
    """Implements `drivers.display.projector.PatternOutput` through the kernel. One thread uses it, except for `cover`.

    Raises
    ------
    UnsupportedByDeviceError
        No output has that name, or it cannot show every pixel unchanged.
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
        self._held: HeldCard = holding.hold_card(path, self._name)
        self._buffers: list[DumbBuffer] = []
        try:
            self._card = self._held.card
            self._route = self._translate_errors(self._find_route)
            self.size = self._route.mode.size
            for _ in range(3):
                self._buffers.append(self._translate_errors(lambda: self._card.create_buffer(self.size)))
            self._scanout = self._translate_errors(lambda: Scanout(self._card, self._route))
            self._translate_errors(lambda: self._scanout.start(self._buffers[_BLACK]))
            self._keep_dark()
            self._has_stamps = self._card.counts_refreshes(self._route.controller)
        except BaseException:
            self._leave()
            raise
        edid = finding.read_edid(self._name, path)
        self.refresh_s = self._route.mode.refresh_s
        note = "" if self._has_stamps else ", whose driver does not count refreshes"
        self.model = f"{edid or 'display'} on {self._name}, {self._route.mode}{note}"
        self.serial = edid.serial if edid is not None and edid.serial else self._name
        self._shown = _BLACK
        self._sequence: PatternSequence | None = None
        # A handle taken over from another process may still report that process's flips.
        self._flip_number = time.monotonic_ns()

    def load(self, sequence: PatternSequence) -> None:
        """See `PatternOutput`. Sets the output again, which a display that was switched off and on may need."""
        self._require_plugged()
        connector = self._translate_errors(lambda: self._card.connector(self._route.connector.number, probe=False))
        if self._route.mode not in connector.modes:
            message = (
                f"output {self._name}: opened in the mode {self._route.mode}, which the display that is connected now "
                "lacks; open the rig again"
            )
            raise UnsupportedByDeviceError(message)
        self._translate_errors(lambda: self._scanout.start(self._buffers[_BLACK]))
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
        position = _BLACK
        if index is not None and self._sequence is not None:
            self._require_plugged()
            position = _NEXT_BUFFER[self._shown]
            self._buffers[position].pixels[:] = rgb_pixels(
                self._sequence.profiles[index], self._sequence.patterns[index]
            )
        requested_ns = time.monotonic_ns()
        stamp_ns = self._translate_errors(lambda: self._flip(self._buffers[position]))
        returned_ns = time.monotonic_ns()
        self._shown = position
        refresh_ns = round(self.refresh_s * 1e9)
        if not self._has_stamps or not requested_ns - refresh_ns <= stamp_ns <= returned_ns + refresh_ns:
            # The stamp is of the end of the request, or of another clock: only the duration of the call is known.
            return ScanoutStart(requested_ns, returned_ns + refresh_ns)
        return start_of_flip(stamp_ns)

    def compare(self, levels: Pixels) -> None:
        """See `PatternOutput`."""
        buffer = self._buffers[self._shown]
        if not self._translate_errors(lambda: self._scanout.is_showing(buffer)):
            message = f"output {self._name} shows another picture than the pattern; {_PIXEL_REMEDY}"
            raise UnsupportedByDeviceError(message)
        require_equal_pixels(self._name, rgb_pixels(levels), np.array(buffer.pixels), _PIXEL_REMEDY)

    def cover(self) -> bool:
        """See `PatternOutput`. Through the guard."""
        return self._held.cover()

    def close(self) -> None:
        """See `PatternOutput`. The card stays ours, black, as long as the process runs."""
        self._leave()

    def _find_route(self) -> OutputRoute:
        """Return where to show patterns, after detecting displays again."""
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
        monitor, edid = self._options.monitor, finding.read_edid(self._name, self._held.path)
        if monitor is not None and monitor not in (str(edid), edid and edid.name):
            message = (
                f"output {self._name}: the rig file requests the display '{monitor}', found "
                f"'{edid or 'a display without EDID'}'; swap the cables, or correct monitor (slrig devices lists "
                "the connected displays)"
            )
            raise UnsupportedByDeviceError(message)

    def _require_plugged(self) -> None:
        if finding.is_unplugged(self._name, self._held.path):
            raise finding.not_connected_error(self._name)

    def _keep_dark(self) -> None:
        route = self._route
        self._held.keep_dark(
            KmsGuardTask(
                self._card.handle,
                self._name,
                route.controller,
                route.connector.number,
                route.mode.content.hex(),
                self._buffers[_BLACK].number,
                [(each.number, each.handle) for each in self._buffers],
                os.getpid(),
                self._options.dark_after_s,
            )
        )

    def _flip(self, buffer: DumbBuffer) -> int:
        """Flip to a buffer and return the kernel's time stamp, ns."""
        self._flip_number += 1
        until_s = time.monotonic() + _FLIP_TIMEOUT_S
        requested = False
        while (left_s := until_s - time.monotonic()) > 0:
            if not requested:
                try:
                    self._scanout.flip(buffer, self._flip_number)
                    requested = True
                except OSError as error:
                    # An earlier flip has not happened yet.
                    if error.errno != errno.EBUSY:
                        raise
                    left_s = min(left_s, self.refresh_s)
            for flip in self._card.read_flips(left_s):
                if flip.number == self._flip_number:
                    return flip.stamp_ns
        message = (
            f"output {self._name} made no refresh in {_FLIP_TIMEOUT_S:g} s: the display is off, or its graphics driver "
            "hangs; see the kernel's log (dmesg)"
        )
        raise DeviceError(message)

    def _leave(self) -> None:
        # Freed when another buffer is shown; unmapped now, since mapped memory would keep the card open.
        self._held.stale += [(each.number, each.handle) for each in self._buffers]
        self._buffers.clear()
        holding.leave_card(self._held)

    def _translate_errors(self, attempt: Callable[[], Result]) -> Result:
        """Call a function that uses the card, and translate the kernel's errors."""
        try:
            return attempt()
        except OSError as error:
            failure = f"output {self._name}: the kernel refuses ({error.strerror})"
            if error.errno in (errno.ENODEV, errno.ENXIO):
                message = f"{failure}; its graphics card was unplugged: plug it in, and open the rig again"
                raise DeviceGoneError(message) from error
            if error.errno == errno.EACCES:
                message = f"{failure}; another program has taken the graphics card: end it, and open the rig again"
                raise DeviceBusyError(message) from error
            message = f"{failure}: its driver may lack this mode, or memory for pictures; see dmesg"
            raise DeviceError(message) from error
