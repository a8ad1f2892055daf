"""The outputs of an X server and what it does to their pixels (RandR 1.3 and later)."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from drivers.display.edid import Edid, parse
from drivers.screen.connection import Connection
from drivers.screen.requests import atom_name
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

IDENTITY = (65536, 0, 0, 0, 65536, 0, 0, 0, 65536)
"""The transform that leaves pixels where they are, in 1/65536."""

UPRIGHT = 1
"""The rotation that is none, and no reflection."""

_RANDR = "RANDR"
_ATOM, _INTEGER = 4, 19
_INTERLACE, _DOUBLE_SCAN = 1 << 4, 1 << 5
_MODE = struct.Struct("<IHHIHHHHHHHHI")
_ALL_CHANGES = 1 | 2 | 4 | 8


@dataclass(frozen=True, slots=True)
class Mode:
    """A video mode. `refresh_s` is one frame's time, None where the mode does not tell."""

    number: int
    size: Size
    refresh_s: float | None
    interlaced: bool = False

    def __str__(self) -> str:
        rate = "" if self.refresh_s is None else f" at {1 / self.refresh_s:.2f} Hz"
        return f"{self.size}{rate}{', interlaced' if self.interlaced else ''}"


@dataclass(frozen=True, slots=True)
class Picture:
    """What an output shows now: a rectangle of the screen, by a mode, and what is done to it on the way.

    x, y, size : the rectangle. rotation, transform, panning : as in RandR. gamma : (3, n) uint16, red, green, blue; n
    is 0 where the server has no ramp. outputs : every output that gets these very signals.
    """

    controller: int
    x: int
    y: int
    size: Size
    mode: Mode
    rotation: int
    transform: tuple[int, ...]
    panning: tuple[int, int, int, int]
    gamma: NDArray[np.uint16]
    outputs: tuple[str, ...]

    def overlaps(self, other: Picture) -> bool:
        """Whether two pictures have a pixel of the screen in common."""
        return (
            self.x < other.x + other.size.width_px
            and other.x < self.x + self.size.width_px
            and self.y < other.y + other.size.height_px
            and other.y < self.y + self.size.height_px
        )


@dataclass(frozen=True, slots=True)
class Output:
    """A connector. `picture` is None where it is switched off; `preferred` are the modes that its display prefers.

    properties : those of the driver of the graphics card, by name: a word, or numbers.
    """

    name: str
    connected: bool
    preferred: tuple[Mode, ...]
    picture: Picture | None
    edid: Edid | None = None
    properties: Mapping[str, str | tuple[int, ...]] = field(default_factory=dict)

    def __str__(self) -> str:
        if not self.connected:
            return f"{self.name} (nothing connected)"
        shown = "switched off" if self.picture is None else f"{self.picture.mode}"
        display = f"{self.edid}, " if self.edid is not None and str(self.edid) else ""
        return f"{self.name} ({display}{shown})"


def require(connection: Connection) -> None:
    """See that the server tells of its outputs. Raises UnsupportedByDeviceError."""
    if connection.has(_RANDR):
        major, minor = struct.unpack_from("<II", _ask(connection, 0, struct.pack("<II", 1, 5)), 8)
        if (major, minor) >= (1, 3):
            return
    message = "the X server does not tell of its outputs (no RandR 1.3); use Xorg 1.7 or later"
    raise UnsupportedByDeviceError(message)


def watch(connection: Connection) -> int:
    """Be told of every change of outputs. Return the number of the first of the two events that tell."""
    connection.do(4, struct.pack("<IHxx", connection.screen.root, _ALL_CHANGES), extension=_RANDR)
    return connection.first_event_of(_RANDR)


def outputs(connection: Connection, *, probe: bool) -> tuple[Output, ...]:
    """Every output of the screen, connected or not; as the server remembers them, unless it is to `probe` them anew."""
    reply = _ask(connection, 8 if probe else 25, struct.pack("<I", connection.screen.root))
    stamp, controllers, count, modes_count = (
        *struct.unpack_from("<I", reply, 12),
        *struct.unpack_from("<HHH", reply, 16),
    )
    offset = 32 + 4 * controllers
    numbers = struct.unpack_from(f"<{count}I", reply, offset)
    offset += 4 * count
    modes = {mode.number: mode for mode in (_mode(reply, offset + _MODE.size * i) for i in range(modes_count))}
    heads = {number: _Head.of(connection, number, stamp) for number in numbers}
    names = {number: head.name for number, head in heads.items()}
    return tuple(
        Output(
            head.name,
            head.connected,
            tuple(modes[mode] for mode in head.preferred if mode in modes),
            _picture(connection, head.controller, stamp, modes, names) if head.controller else None,
            *_told(connection, number),
        )
        for number, head in heads.items()
    )


@dataclass(frozen=True, slots=True)
class _Head:
    name: str
    connected: bool
    controller: int
    preferred: tuple[int, ...]

    @classmethod
    def of(cls, connection: Connection, number: int, stamp: int) -> _Head:
        reply = _ask(connection, 9, struct.pack("<II", number, stamp))
        (controller,) = struct.unpack_from("<I", reply, 12)
        controllers, modes, preferred, clones, length = struct.unpack_from("<HHHHH", reply, 26)
        offset = 36 + 4 * controllers
        numbers = struct.unpack_from(f"<{modes}I", reply, offset)
        offset += 4 * (modes + clones)
        name = reply[offset : offset + length].decode("latin-1")
        return cls(name, reply[24] == 0, controller, numbers[:preferred])


def _mode(reply: bytes, offset: int) -> Mode:
    number, width, height, clock, _, _, total_x, _, _, _, total_y, _, flags = _MODE.unpack_from(reply, offset)
    lines = total_y * (2 if flags & _DOUBLE_SCAN else 1)
    refresh_s = total_x * lines / clock if clock and total_x and lines else None
    if refresh_s is not None and flags & _INTERLACE:
        refresh_s /= 2
    return Mode(number, Size(max(width, 1), max(height, 1)), refresh_s, bool(flags & _INTERLACE))


def _picture(
    connection: Connection, controller: int, stamp: int, modes: Mapping[int, Mode], names: Mapping[int, str]
) -> Picture | None:
    reply = _ask(connection, 20, struct.pack("<II", controller, stamp))
    x, y, width, height, mode, rotation, _, count = struct.unpack_from("<hhHHIHHH", reply, 12)
    if mode not in modes or not width or not height:
        return None
    shown = struct.unpack_from(f"<{count}I", reply, 32)
    transform = struct.unpack_from("<9i", _ask(connection, 27, struct.pack("<I", controller)), 48)
    panned = _ask(connection, 28, struct.pack("<I", controller))
    ramps = _ask(connection, 23, struct.pack("<I", controller))
    (entries,) = struct.unpack_from("<H", ramps, 8)
    return Picture(
        controller,
        x,
        y,
        Size(width, height),
        modes[mode],
        rotation,
        transform,
        struct.unpack_from("<HHHH", panned, 12),
        np.frombuffer(ramps, "<u2", count=3 * entries, offset=32).reshape(3, entries).copy(),
        tuple(names.get(number, str(number)) for number in shown),
    )


def _told(connection: Connection, output: int) -> tuple[Edid | None, dict[str, str | tuple[int, ...]]]:
    """The display's EDID, and the properties that are words or numbers."""
    reply = _ask(connection, 10, struct.pack("<I", output))
    (count,) = struct.unpack_from("<H", reply, 8)
    edid: Edid | None = None
    properties: dict[str, str | tuple[int, ...]] = {}
    for number in struct.unpack_from(f"<{count}I", reply, 32):
        name = atom_name(connection, number)
        value = _ask(connection, 15, struct.pack("<IIIIIxxxx", output, number, 0, 0, 128))
        form, (kind,), (items,) = value[1], struct.unpack_from("<I", value, 8), struct.unpack_from("<I", value, 16)
        data = value[32 : 32 + items * form // 8]
        if name == "EDID":
            edid = parse(data)
        elif kind == _ATOM and items == 1:
            properties[name] = atom_name(connection, struct.unpack("<I", data)[0])
        elif form == 32:
            properties[name] = struct.unpack(f"<{items}I", data)
    return edid, properties


def _ask(connection: Connection, opcode: int, body: bytes) -> bytes:
    return connection.ask(opcode, body, extension=_RANDR)
