"""How a controller is made to scan pictures out as they are, and to change from one to the next at a refresh.

By atomic commits where the driver has them: everything at once, or a refusal and nothing. Else by the older requests.
Whatever recolours, scales, turns or covers a picture is switched off: gamma and colour matrices, limited range,
underscan, rotation, cursors and other planes, and a refresh that varies.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass

from drivers.kms.card import Card, Change, Connector, Picture, Plane, Property
from drivers.kms.kernel import (
    ATOMIC_ALLOW_MODESET,
    ATOMIC_NONBLOCK,
    OBJECT_CONNECTOR,
    OBJECT_CRTC,
    OBJECT_PLANE,
    PAGE_FLIP_EVENT,
    PLANE_PRIMARY,
)
from drivers.kms.modes import Mode
from slrig.errors import UnsupportedByDeviceError

_CONNECTOR_WORDS = {"Broadcast RGB": "Full", "underscan": "off", "content type": "Graphics", "link-status": "Good"}
"""Levels 0 to 255, no border, no improvement of films by the display, and a link that is trained anew if it failed."""
_CONTROLLER_OFF = ("GAMMA_LUT", "DEGAMMA_LUT", "CTM", "VRR_ENABLED")
"""0 is the identity, as the kernel's documentation of colour management has it; and no refresh that varies."""
_PLANE_PLAIN = {"rotation": 1, "alpha": 0xFFFF}


@dataclass(frozen=True, slots=True)
class Place:
    """A connector, the controller that drives it, and the mode."""

    connector: Connector
    controller: int
    index: int
    mode: Mode


def free_controller(card: Card, connector: Connector) -> tuple[int, int]:
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


class Scanning:
    """A place, and the pictures that are scanned out to it. Raises OSError where the kernel refuses."""

    def __init__(self, card: Card, place: Place) -> None:
        self._card = card
        self._place = place
        self._plane: Plane | None = None
        self._picture_property = 0
        self._blob = 0
        if card.atomic:
            self._plane = self._primary()
            self._picture_property = card.properties(self._plane.number, OBJECT_PLANE)["FB_ID"].number
            self._blob = card.blob(place.mode.content)

    def begin(self, picture: Picture) -> None:
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

    def flip(self, picture: Picture, number: int) -> None:
        """Have another picture scanned out from the next refresh on; the kernel tells by an event of that number."""
        if self._plane is not None:
            change = (self._plane.number, self._picture_property, picture.number)
            self._card.commit([change], flags=ATOMIC_NONBLOCK | PAGE_FLIP_EVENT, number=number)
        else:
            self._card.flip(self._place.controller, picture.number, number)

    def shows(self, picture: Picture) -> bool:
        """Whether this picture is scanned out now."""
        return self._card.scanned_out(self._place.controller) == picture.number

    def _primary(self) -> Plane:
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

    def _planes(self, primary: Plane, picture: Picture) -> Iterator[Change]:
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


def _words(number: int, told: Mapping[str, Property]) -> Iterator[Change]:
    """Properties of a connector that are words, those that it has."""
    for name, word in _CONNECTOR_WORDS.items():
        if name in told and word in told[name].words:
            yield number, told[name].number, told[name].words[word]
