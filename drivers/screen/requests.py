"""The few requests of the X protocol that a black window with patterns needs, each as a function."""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray

from drivers.display.pixels import coloured
from drivers.screen.connection import Connection
from slrig.model import Pattern, Pixels, Size

CARDINAL, WINDOW = 6, 33
ABOVE = 0
VISIBILITY_CHANGE = 1 << 16
VISIBILITY_NOTIFY, SELECTION_CLEAR = 15, 29

_COPY_FROM_PARENT = 0
_BACK_PIXEL, _OVERRIDE_REDIRECT, _EVENT_MASK, _CURSOR = 1 << 1, 1 << 9, 1 << 11, 1 << 14
_FOREGROUND, _FILL_STYLE, _TILE, _GRAPHICS_EXPOSURES = 1 << 2, 1 << 8, 1 << 10, 1 << 16
_TILED = 1
_PLACE_AND_EXTENT, _STACK_MODE = 0b1111, 1 << 6
_WHOLE_PIXELS = 2
_ALL_PLANES = 0xFFFFFFFF


def atom(connection: Connection, name: str) -> int:
    """The server's number for a name."""
    body = struct.pack("<Hxx", len(name)) + name.encode()
    return int(struct.unpack_from("<I", connection.ask(16, body), 8)[0])


def atom_name(connection: Connection, number: int) -> str:
    """The name behind a number."""
    reply = connection.ask(17, struct.pack("<I", number))
    (length,) = struct.unpack_from("<H", reply, 8)
    return reply[32 : 32 + length].decode("latin-1")


def black_window(connection: Connection, x: int, y: int, size: Size) -> int:
    """Make and map a black window at this place of the screen, above the others, with no window manager's say.

    The pointer is invisible over it. Whoever composes the screen is asked to leave it alone.
    """
    window = connection.new_id()
    mask = _BACK_PIXEL | _OVERRIDE_REDIRECT | _EVENT_MASK | _CURSOR
    values = struct.pack("<IIII", 0, 1, VISIBILITY_CHANGE, _invisible_cursor(connection))
    connection.do(
        1,
        struct.pack(
            "<IIhhHHHHII",
            *(window, connection.screen.root, x, y, size.width_px, size.height_px, 0, 1, _COPY_FROM_PARENT, mask),
        )
        + values,
        data=_COPY_FROM_PARENT,
    )
    set_cardinal(connection, window, "_NET_WM_BYPASS_COMPOSITOR", 1)
    connection.do(8, struct.pack("<I", window))
    return window


def hidden_window(connection: Connection) -> int:
    """Make a window that is never seen, to own something by."""
    window = connection.new_id()
    body = struct.pack("<IIhhHHHHII", window, connection.screen.root, -1, -1, 1, 1, 0, 2, _COPY_FROM_PARENT, 0)
    connection.do(1, body, data=_COPY_FROM_PARENT)
    return window


def set_cardinal(connection: Connection, window: int, name: str, value: int) -> None:
    """Set a property of a window that is one number."""
    body = struct.pack("<IIIBxxxII", window, atom(connection, name), CARDINAL, 32, 1, value)
    connection.do(18, body)


def property_of(connection: Connection, window: int, name: str) -> bytes:
    """The bytes of a window's property; empty where it has none."""
    reply = connection.ask(20, struct.pack("<IIIII", window, atom(connection, name), 0, 0, 1024))
    form, (count,) = reply[1], struct.unpack_from("<I", reply, 16)
    return reply[32 : 32 + count * form // 8]


def raise_window(connection: Connection, window: int) -> None:
    """Put a window above all others."""
    connection.do(12, struct.pack("<IHxxI", window, _STACK_MODE, ABOVE))


def place_window(connection: Connection, window: int, x: int, y: int, size: Size) -> None:
    """Move a window, and give it an extent."""
    connection.do(12, struct.pack("<IHxxiiII", window, _PLACE_AND_EXTENT, x, y, size.width_px, size.height_px))


def watch_visibility(connection: Connection, window: int) -> None:
    """Be told when a window, of whatever client, is covered or uncovered."""
    connection.do(2, struct.pack("<III", window, _EVENT_MASK, VISIBILITY_CHANGE))


def pixmap(connection: Connection, size: Size) -> int:
    """Make room for a picture of the screen's depth."""
    return _pixmap(connection, size, connection.screen.depth)


def free_pixmap(connection: Connection, number: int) -> None:
    """Give a picture's room back."""
    connection.do(54, struct.pack("<I", number))


def graphics_context(connection: Connection, drawable: int) -> int:
    """Make a set of drawing options, for pictures of the same depth as this one."""
    number = connection.new_id()
    connection.do(55, struct.pack("<IIIII", number, drawable, _FOREGROUND | _GRAPHICS_EXPOSURES, 0, 0))
    return number


def put_levels(
    connection: Connection, drawable: int, context: int, levels: Pixels, pattern: Pattern | None = None
) -> None:
    """Write a pattern's levels, (H, W) uint8, in its light into a picture of 24 bits in 32, at its upper left."""
    height_px, width_px = levels.shape
    rows = max(1, (connection.most_bytes - 64) // (4 * width_px))
    for first in range(0, height_px, rows):
        part = coloured(levels[first : first + rows], pattern)
        head = struct.pack(
            "<IIHHhhBBxx", drawable, context, width_px, part.shape[0], 0, first, 0, connection.screen.depth
        )
        connection.do(72, head, payload=part.tobytes(), data=_WHOLE_PIXELS)


def fill_tiled(connection: Connection, drawable: int, context: int, tile: int, size: Size) -> None:
    """Fill a picture with repetitions of a small one, pixel for pixel, from its upper left corner."""
    connection.do(56, struct.pack("<IIII", context, _FILL_STYLE | _TILE, _TILED, tile))
    connection.do(70, struct.pack("<IIhhHH", drawable, context, 0, 0, size.width_px, size.height_px))


def read_pixels(connection: Connection, x: int, y: int, size: Size) -> NDArray[np.uint32]:
    """What the screen's frame buffer holds at this place: (H, W) uint32, 0x00RRGGBB. The pointer is not in it."""
    body = struct.pack("<IhhHHI", connection.screen.root, x, y, size.width_px, size.height_px, _ALL_PLANES)
    reply = connection.ask(73, body, data=_WHOLE_PIXELS)
    words = np.frombuffer(reply, "<u4", count=size.width_px * size.height_px, offset=32)
    return words.reshape(size.shape) & np.uint32(0xFFFFFF)


def owner_of(connection: Connection, selection: int) -> int:
    """The window that owns a selection; 0 where none does."""
    return int(struct.unpack_from("<I", connection.ask(23, struct.pack("<I", selection)), 8)[0])


def take_selection(connection: Connection, selection: int, window: int, *, from_another: bool) -> int:
    """Own a selection. Return the window that owned it before; it is left alone unless taken `from_another`."""
    connection.do(36)
    try:
        before = owner_of(connection, selection)
        if before == 0 or from_another:
            connection.do(22, struct.pack("<III", window, selection, 0))
        return before
    finally:
        connection.do(37)


def _pixmap(connection: Connection, size: Size, depth: int) -> int:
    number = connection.new_id()
    body = struct.pack("<IIHH", number, connection.screen.root, size.width_px, size.height_px)
    connection.do(53, body, data=depth)
    return number


def _invisible_cursor(connection: Connection) -> int:
    shape = _pixmap(connection, Size(1, 1), 1)
    context = graphics_context(connection, shape)
    # What a fresh pixmap holds is undefined.
    connection.do(70, struct.pack("<IIhhHH", shape, context, 0, 0, 1, 1))
    cursor = connection.new_id()
    connection.do(93, struct.pack("<III8H", cursor, shape, shape, *([0] * 8)))
    connection.do(60, struct.pack("<I", context))
    free_pixmap(connection, shape)
    return cursor
