"""A connection to an X server through libxcb: requests and replies as bytes, laid out by the callers.

libxcb alone (package libxcb1 in Debian, there wherever X is) does for every extension: requests are made from their
description in the protocol's specifications (X.Org, xcb-proto), and need none of libxcb's libraries per extension.
"""

from __future__ import annotations

import ctypes
import select
import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any

from slrig.errors import DeviceError, DeviceGoneError, LibraryMissingError

_CHECKED = 1
_GENERIC_EVENT = 35
_SETUP = struct.Struct("<BxHHHIIIIHHBBBBBBBB4x")
_SCREEN = struct.Struct("<IIIIIHHHHHHIBBBB")


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Extension(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("number", ctypes.c_int))


class _Request(ctypes.Structure):
    _fields_ = (
        ("count", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
        ("opcode", ctypes.c_uint8),
        ("is_void", ctypes.c_uint8),
    )


class RequestRefusedError(DeviceError):
    """The X server answered a request with an error; `number` is that of the protocol (8 is BadMatch)."""

    def __init__(self, number: int, major: int, minor: int) -> None:
        super().__init__(
            f"the X server refused request {major}.{minor} with error {number}; see the server's log "
            "(/var/log/Xorg.0.log), and report it to slrig's maintainers"
        )
        self.number = number


@dataclass(frozen=True, slots=True)
class XScreen:
    """What the server says of its screen: the window behind all others, and how colours are made of bits."""

    root: int
    visual: int
    depth: int
    width_px: int
    height_px: int
    colour_masks: tuple[int, int, int]
    bits_per_pixel: int
    little_endian: bool


class Connection:
    """A client of an X server. One thread uses it.

    Parameters
    ----------
    display
        As in the environment variable DISPLAY, which is used where this is None.

    Raises
    ------
    LibraryMissingError
        libxcb is not installed.
    DeviceError
        There is no X server, or it does not let this user in.
    """

    def __init__(self, display: str | None = None) -> None:
        self._xcb = _library()
        number = ctypes.c_int(0)
        self._handle: int | None = self._xcb.xcb_connect(
            None if display is None else display.encode(), ctypes.byref(number)
        )
        if self._xcb.xcb_connection_has_error(self._handle):
            self._xcb.xcb_disconnect(self._handle)
            self._handle = None
            message = (
                f"no X server answers at display {display!r} (None: the environment's DISPLAY); start slrig within the "
                "graphical session, or set DISPLAY and XAUTHORITY as they are there (a service: Environment=DISPLAY=:0)"
            )
            raise DeviceError(message)
        self._present: dict[str, bool] = {}
        self._waiting: deque[bytes] = deque()
        self.screen = _screen(self._xcb, self._handle, number.value)
        self.most_bytes = 4 * int(self._xcb.xcb_get_maximum_request_length(self._handle))

    def has(self, extension: str) -> bool:
        """Whether the server has an extension."""
        if extension not in self._present:
            self._present[extension] = bool(self._data_of(extension)[8])
        return self._present[extension]

    def number_of(self, extension: str) -> int:
        """The major opcode under which the server knows an extension that it has; its events name it."""
        return self._data_of(extension)[9]

    def first_event_of(self, extension: str) -> int:
        """The number of the first of an extension's own events."""
        return self._data_of(extension)[10]

    def new_id(self) -> int:
        """A name for a window, pixmap or the like that is about to be made."""
        return int(self._xcb.xcb_generate_id(self._open()))

    def ask(self, opcode: int, body: bytes = b"", *, data: int = 0, extension: str | None = None) -> bytes:
        """Send a request and return its reply, whole. `data` is the request's second byte (core requests only).

        Raises
        ------
        RequestRefusedError, DeviceGoneError
        """
        sequence = self._send(opcode, body, b"", data, extension, is_void=False)
        error = ctypes.c_void_p()
        reply = self._xcb.xcb_wait_for_reply(self._open(), sequence, ctypes.byref(error))
        if not reply:
            self._raise(error.value)
        try:
            length = 32 + 4 * struct.unpack_from("<I", ctypes.string_at(reply, 8), 4)[0]
            return ctypes.string_at(reply, length)
        finally:
            _free(reply)

    def do(
        self, opcode: int, body: bytes = b"", *, payload: bytes = b"", data: int = 0, extension: str | None = None
    ) -> None:
        """Send a request that has no reply, and wait until the server has done it. Raises as `ask`."""
        sequence = self._send(opcode, body, payload, data, extension, is_void=True)
        error = self._xcb.xcb_request_check(self._open(), ctypes.c_uint(sequence))
        if error:
            self._raise(error)
        self._require_alive()

    def events(self) -> Iterator[bytes]:
        """The events that are here already, each as it came over the wire. Raises DeviceGoneError."""
        while self._waiting or (event := self._xcb.xcb_poll_for_event(self._open())):
            yield self._waiting.popleft() if self._waiting else _wire_bytes(event)
        self._require_alive()

    def wait(self, timeout_s: float, *others: int) -> frozenset[int]:
        """Return when the server, or one of these file descriptors, has something to read, or the time is over.

        Returns the descriptors that have, or have ended.
        """
        # Events that came with the reply to a request are here, and nothing more of them is to be read.
        while event := self._xcb.xcb_poll_for_queued_event(self._open()):
            self._waiting.append(_wire_bytes(event))
        timeout_s = 0.0 if self._waiting else timeout_s
        waiting = select.poll()
        for descriptor in (int(self._xcb.xcb_get_file_descriptor(self._open())), *others):
            waiting.register(descriptor, select.POLLIN)
        return frozenset(descriptor for descriptor, _ in waiting.poll(max(timeout_s, 0) * 1000))

    def close(self) -> None:
        """Leave the server, which then destroys everything that was made here. Idempotent."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self._xcb.xcb_disconnect(handle)

    def _data_of(self, extension: str) -> bytes:
        data = self._xcb.xcb_get_extension_data(self._open(), ctypes.byref(_extension(extension)))
        if not data:
            self._require_alive()
        return ctypes.string_at(data, 12) if data else bytes(12)

    def _open(self) -> int:
        if self._handle is None:
            message = "the connection to the X server is closed; open the rig again"
            raise DeviceGoneError(message)
        return self._handle

    def _send(
        self, opcode: int, body: bytes, payload: bytes, data: int, extension: str | None, *, is_void: bool
    ) -> int:
        head = ctypes.create_string_buffer(struct.pack("<BBH", opcode, data, 0) + _padded(body))
        parts: list[tuple[Any, int]] = [(head, len(head) - 1)]
        if payload:
            parts.append((ctypes.create_string_buffer(_padded(payload)), len(_padded(payload))))
        # libxcb writes into two vectors before the first one.
        vectors = (_IoVector * (len(parts) + 2))()
        for index, (part, length) in enumerate(parts):
            vectors[index + 2] = _IoVector(ctypes.addressof(part), length)
        which = None if extension is None else ctypes.pointer(_extension(extension))
        request = _Request(len(parts), which, opcode, is_void)
        first = ctypes.byref(vectors, 2 * ctypes.sizeof(_IoVector))
        sequence = int(self._xcb.xcb_send_request(self._open(), _CHECKED, first, ctypes.byref(request)))
        if sequence == 0:
            self._require_alive()
        return sequence

    def _raise(self, error: int | None) -> None:
        if error is None:
            self._require_alive()
            message = "the X server gave no reply; restart it"
            raise DeviceError(message)
        try:
            raw = ctypes.string_at(error, 32)
        finally:
            _free(error)
        raise RequestRefusedError(raw[1], raw[10], struct.unpack_from("<H", raw, 8)[0])

    def _require_alive(self) -> None:
        if self._xcb.xcb_connection_has_error(self._open()):
            message = "the X server is gone: it ended, or closed the connection; start it, and open the rig again"
            raise DeviceGoneError(message)


def _wire_bytes(event: int) -> bytes:
    """An event as it came over the wire; its memory is given back."""
    try:
        data = ctypes.string_at(event, 32)
        if data[0] & 0x7F == _GENERIC_EVENT:
            # libxcb puts the whole sequence number, 4 bytes, after the first 32.
            data += ctypes.string_at(event + 36, 4 * struct.unpack_from("<I", data, 4)[0])
        return data
    finally:
        _free(event)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _screen(xcb: Any, handle: int, number: int) -> XScreen:
    address = xcb.xcb_get_setup(handle)
    setup = ctypes.string_at(address, 8 + 4 * struct.unpack_from("<H", ctypes.string_at(address, 8), 6)[0])
    *_, vendor_length, _most, roots, formats, byte_order, _bits, _unit, _pad, _low, _high = _SETUP.unpack_from(setup)
    offset = _SETUP.size + vendor_length + (-vendor_length % 4)
    bits = {setup[offset + 8 * index]: setup[offset + 8 * index + 1] for index in range(formats)}
    offset += 8 * formats
    found: list[XScreen] = []
    for _ in range(roots):
        root, *_, width, height, _mm, _mm2, _least, _maps, visual, _store, _save, depth, depths = _SCREEN.unpack_from(
            setup, offset
        )
        offset += _SCREEN.size
        masks = (0, 0, 0)
        for _ in range(depths):
            (visuals,) = struct.unpack_from("<H", setup, offset + 2)
            offset += 8
            for _ in range(visuals):
                identity, red, green, blue = struct.unpack_from("<I4xIII", setup, offset)
                masks = (red, green, blue) if identity == visual else masks
                offset += 24
        found.append(XScreen(root, visual, depth, width, height, masks, bits.get(depth, 0), byte_order == 0))
    return found[min(number, len(found) - 1)]


@cache
def _extension(name: str) -> _Extension:
    return _Extension(name.encode(), 0)


@cache
def _library() -> Any:
    try:
        xcb = ctypes.CDLL("libxcb.so.1")
    except OSError as cause:
        install = "apt install libxcb1"
        message = f"the driver 'screen' speaks to X through libxcb, which is not installed ({cause}): {install}"
        raise LibraryMissingError(message, install=install) from cause
    pointer, unsigned = ctypes.c_void_p, ctypes.c_uint32
    for name, result, *arguments in (
        ("xcb_connect", pointer, ctypes.c_char_p, pointer),
        ("xcb_disconnect", None, pointer),
        ("xcb_connection_has_error", ctypes.c_int, pointer),
        ("xcb_get_file_descriptor", ctypes.c_int, pointer),
        ("xcb_get_setup", pointer, pointer),
        ("xcb_get_maximum_request_length", unsigned, pointer),
        ("xcb_generate_id", unsigned, pointer),
        ("xcb_get_extension_data", pointer, pointer, pointer),
        ("xcb_send_request", ctypes.c_uint, pointer, ctypes.c_int, pointer, pointer),
        ("xcb_wait_for_reply", pointer, pointer, ctypes.c_uint, pointer),
        ("xcb_request_check", pointer, pointer, ctypes.c_uint),
        ("xcb_poll_for_event", pointer, pointer),
        ("xcb_poll_for_queued_event", pointer, pointer),
    ):
        function = getattr(xcb, str(name))
        function.restype, function.argtypes = result, arguments
    return xcb


@cache
def _libc() -> Any:
    libc = ctypes.CDLL(None)
    libc.free.restype, libc.free.argtypes = None, [ctypes.c_void_p]
    return libc


def _free(address: int) -> None:
    _libc().free(address)
