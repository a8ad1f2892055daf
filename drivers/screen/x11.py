"""X11 for a black window that shows patterns: connection, requests and display power, through xcffib and libxcb."""

from __future__ import annotations

import select
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from io import BytesIO
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.display.projector import rgb_pixels
from drivers.libraries import loading
from slrig.errors import DeviceError, DeviceGoneError, UnsupportedByDeviceError
from slrig.model import Pattern, Pixels, Size

VISIBILITY_NOTIFY, SELECTION_CLEAR = "VisibilityNotifyEvent", "SelectionClearEvent"
COMPLETE_NOTIFY = "CompleteNotifyEvent"
OUTPUT_CHANGES = frozenset({"NotifyEvent", "ScreenChangeNotifyEvent"})
"""Names of events, as `event_name` returns them; the last ones are those of `watch_outputs`."""
CARDINAL = 6

_INSTALL = "apt install libxcb1 && pip install 'slrig[screen]'"
_EXTENSIONS = {
    "Composite": "composite",
    "DPMS": "dpms",
    "MIT-SCREEN-SAVER": "screensaver",
    "Present": "present",
    "RANDR": "randr",
}
_SAVER, _DPMS = "MIT-SCREEN-SAVER", "DPMS"
_REPLY_HEADER_BYTES = 32

_COPY_FROM_PARENT = 0
_INPUT_OUTPUT, _INPUT_ONLY = 1, 2
_BACK_PIXEL, _OVERRIDE_REDIRECT, _EVENT_MASK, _CURSOR = 1 << 1, 1 << 9, 1 << 11, 1 << 14
_VISIBILITY_CHANGE = 1 << 16
_FOREGROUND, _FILL_STYLE, _TILE, _GRAPHICS_EXPOSURES = 1 << 2, 1 << 8, 1 << 10, 1 << 16
_TILED = 1
_PLACE_AND_EXTENT, _STACK_MODE, _ABOVE = 0b1111, 1 << 6, 0
_Z_PIXMAP = 2
_ALL_PLANES = 0xFFFFFFFF
_COMPLETE_MASK = 2

_PUT_IMAGE_OPCODE = 72
_PUT_IMAGE = struct.Struct("<IIHHhhBBxx")
_PRESENT_PIXMAP = struct.Struct("<IIIIIhhIIIIxxxxQQQ")
_COMPLETE_NOTIFY = struct.Struct("<BBIIIQ")

_POWER_ON = 0
_POWER_LEVELS = {1: "stand-by", 2: "suspended", 3: "off"}


class RequestRefusedError(DeviceError):
    """The X server answered a request with an error; `error` is its name in xcffib, such as MatchError."""

    def __init__(self, request: str, error: str) -> None:
        super().__init__(
            f"the X server refused the request {request} with {error}; see the server's log (/var/log/Xorg.0.log), "
            "and report it to slrig's maintainers"
        )
        self.error = error


@dataclass(frozen=True, slots=True)
class XScreen:
    """The X server's screen: its root window and pixel format."""

    root: int
    depth: int
    colour_masks: tuple[int, int, int]
    bits_per_pixel: int
    little_endian: bool


class XConnection:
    """A client of an X server. One thread uses it.

    Parameters
    ----------
    display
        As in the environment variable DISPLAY, which is used where this is None.

    Raises
    ------
    LibraryMissingError
        xcffib or libxcb is not installed.
    DeviceError
        No X server runs, or it refuses this user.
    """

    def __init__(self, display: str | None = None) -> None:
        self._xcffib = _import_xcffib()
        try:
            self._connection: Any = self._xcffib.Connection(display)
        except self._xcffib.XcffibException as cause:
            message = (
                f"no X server answers at display {display!r} (None: the environment's DISPLAY); start slrig within the "
                "graphical session, or set DISPLAY and XAUTHORITY as they are there (a service: Environment=DISPLAY=:0)"
            )
            raise DeviceError(message) from cause
        self._closed = False
        self._has: dict[str, bool] = {}
        self._queue: deque[Any] = deque()
        self.screen = _describe_screen(self._connection)

    def has(self, extension: str) -> bool:
        """True if the server has an extension."""
        if extension not in self._has:
            self._has[extension] = bool(self.ask("QueryExtension", len(extension), extension).present)
        return self._has[extension]

    def new_id(self) -> int:
        """Return an unused number for a window, pixmap or other object that is about to be made."""
        with self._translate_errors("GenerateID"):
            return int(self._connection.generate_id())

    def ask(self, request: str, *arguments: Any, extension: str | None = None) -> Any:
        """Send a request by its name in xcffib and return its reply.

        Raises
        ------
        RequestRefusedError, DeviceGoneError
        """
        with self._translate_errors(request):
            return getattr(self._api(extension), request)(*arguments).reply()

    def ask_bytes(self, request: str, *arguments: Any) -> bytes:
        """Send a core request and return the data of its reply. Faster than `ask` for images. Raises as `ask`."""
        with self._translate_errors(request):
            cookie = getattr(self._connection.core, request)(*arguments)
            reply = self._connection.wait_for_reply(cookie.sequence)
            return bytes(self._xcffib.ffi.buffer(reply.cdata, reply.known_max)[_REPLY_HEADER_BYTES:])

    def do(self, request: str, *arguments: Any, extension: str | None = None) -> None:
        """Send a request that has no reply, and wait until the server has done it. Raises as `ask`."""
        with self._translate_errors(request):
            getattr(self._api(extension), request)(*arguments, is_checked=True).check()

    def do_packed(self, opcode: int, body: bytes, *, data: int = 0, extension: str | None = None) -> None:
        """Send a request given as bytes after its header, of which `data` is the second byte. Waits and raises as `do`.

        For requests that xcffib lacks, and for images, which it packs slowly.
        """
        with self._translate_errors(f"{extension or 'core'} {opcode}"):
            request = BytesIO(bytes((0, data, 0, 0)) + body)
            self._api(extension).send_request(opcode, request, is_checked=True).check()

    def events(self) -> Iterator[Any]:
        """Yield the events that have arrived. Raises DeviceGoneError."""
        self._receive()
        while self._queue:
            yield self._queue.popleft()

    def wait(self, timeout_s: float, *others: int) -> frozenset[int]:
        """Wait until the server, or one of these file descriptors, has something to read, or the time is over.

        Returns the descriptors that can be read or have ended.
        """
        self._receive()
        poll = select.poll()
        for descriptor in (int(self._connection.get_file_descriptor()), *others):
            poll.register(descriptor, select.POLLIN)
        timeout_s = 0.0 if self._queue else max(timeout_s, 0)
        return frozenset(descriptor for descriptor, _ in poll.poll(timeout_s * 1000))

    def close(self) -> None:
        """Disconnect; the server then destroys everything that was made here. Idempotent."""
        if not self._closed:
            self._closed = True
            self._connection.disconnect()

    def _receive(self) -> None:
        """Move the events that have arrived into our queue: libxcb reads ahead, so the socket alone proves nothing."""
        with self._translate_errors("events"):
            while (event := self._connection.poll_for_event()) is not None:
                self._queue.append(event)

    def _api(self, extension: str | None) -> Any:
        if extension is None:
            return self._connection.core
        return self._connection(import_module(f"xcffib.{_EXTENSIONS[extension]}").key)

    @contextmanager
    def _translate_errors(self, request: str) -> Iterator[None]:
        if self._closed:
            message = "the connection to the X server is closed; open the rig again"
            raise DeviceGoneError(message)
        try:
            yield
        except self._xcffib.Error as error:
            raise RequestRefusedError(request, type(error).__name__) from error
        except self._xcffib.XcffibException as error:
            message = "the X server is gone: it ended, or closed the connection; start it, and open the rig again"
            raise DeviceGoneError(message) from error


def event_name(event: Any) -> str:
    """Return the name of an event's class in xcffib."""
    return type(event).__name__


@cache
def _import_xcffib() -> Any:
    with loading("screen", "xcffib and libxcb to speak to X", install=_INSTALL, packages="xcffib"):
        xcffib = import_module("xcffib")
        for module in ("xproto", *_EXTENSIONS.values()):
            # Before connecting: a connection has the events of extensions that are imported.
            import_module(f"xcffib.{module}")
    _add_complete_notify(xcffib)
    return xcffib


def _add_complete_notify(xcffib: Any) -> None:
    """Add the Present event CompleteNotify to xcffib, which lacks it: it skips events with 64-bit fields."""

    class CompleteNotifyEvent(xcffib.Event):  # type: ignore[misc]
        xge = True

        def __init__(self, unpacker: Any) -> None:
            super().__init__(unpacker)
            fields = _COMPLETE_NOTIFY.unpack_from(unpacker.buf, 10)
            self.kind, self.mode, _, self.window, self.serial, self.stamp_us = fields

    present = import_module("xcffib.present")
    extension, events, errors = xcffib.extensions[present.key]
    xcffib.extensions[present.key] = (extension, {**events, 1: CompleteNotifyEvent}, errors)


def _describe_screen(connection: Any) -> XScreen:
    setup = connection.setup
    root = setup.roots[min(connection.pref_screen, len(setup.roots) - 1)]
    visuals = [each for depth in root.allowed_depths for each in depth.visuals if each.visual_id == root.root_visual]
    masks = (visuals[0].red_mask, visuals[0].green_mask, visuals[0].blue_mask) if visuals else (0, 0, 0)
    bits = {form.depth: form.bits_per_pixel for form in setup.pixmap_formats}
    return XScreen(
        root=root.root,
        depth=root.root_depth,
        colour_masks=masks,
        bits_per_pixel=bits.get(root.root_depth, 0),
        little_endian=setup.image_byte_order == 0,
    )


def atom(connection: XConnection, name: str) -> int:
    """Return the server's number for a name."""
    return int(connection.ask("InternAtom", False, len(name), name).atom)


def atom_name(connection: XConnection, number: int) -> str:
    """Return the name of an atom."""
    return bytes(connection.ask("GetAtomName", number).name.raw).decode("latin-1")


def black_window(connection: XConnection, x: int, y: int, size: Size) -> int:
    """Make and map a black window at this place of the screen, above the others, without a window manager.

    The pointer is invisible over it, and compositors are requested not to redirect it.
    """
    window = connection.new_id()
    connection.do(
        "CreateWindow",
        *(_COPY_FROM_PARENT, window, connection.screen.root, x, y, size.width_px, size.height_px, 0),
        *(_INPUT_OUTPUT, _COPY_FROM_PARENT, _BACK_PIXEL | _OVERRIDE_REDIRECT | _EVENT_MASK | _CURSOR),
        [0, 1, _VISIBILITY_CHANGE, _invisible_cursor(connection)],
    )
    set_cardinal(connection, window, "_NET_WM_BYPASS_COMPOSITOR", 1)
    connection.do("MapWindow", window)
    return window


def hidden_window(connection: XConnection) -> int:
    """Make a window that is never visible, to own selections."""
    window = connection.new_id()
    connection.do(
        "CreateWindow",
        *(_COPY_FROM_PARENT, window, connection.screen.root, -1, -1, 1, 1, 0, _INPUT_ONLY, _COPY_FROM_PARENT, 0, []),
    )
    return window


def set_cardinal(connection: XConnection, window: int, name: str, value: int) -> None:
    """Set a property of a window that is one number."""
    data = value.to_bytes(4, "little")
    connection.do("ChangeProperty", 0, window, atom(connection, name), CARDINAL, 32, 1, data)


def window_property(connection: XConnection, window: int, name: str) -> bytes:
    """Return the bytes of a window's property; empty where it has none."""
    return bytes(connection.ask("GetProperty", False, window, atom(connection, name), 0, 0, 1024).value.raw)


def raise_window(connection: XConnection, window: int) -> None:
    """Put a window above all others."""
    connection.do("ConfigureWindow", window, _STACK_MODE, [_ABOVE])


def place_window(connection: XConnection, window: int, x: int, y: int, size: Size) -> None:
    """Move a window and set its extent."""
    connection.do("ConfigureWindow", window, _PLACE_AND_EXTENT, [x, y, size.width_px, size.height_px])


def watch_visibility(connection: XConnection, window: int) -> None:
    """Receive events when a window, of any client, is covered or uncovered."""
    connection.do("ChangeWindowAttributes", window, _EVENT_MASK, [_VISIBILITY_CHANGE])


def create_pixmap(connection: XConnection, size: Size, depth: int | None = None) -> int:
    """Make a pixmap, of the screen's depth unless another one is given."""
    number, depth = connection.new_id(), connection.screen.depth if depth is None else depth
    connection.do("CreatePixmap", depth, number, connection.screen.root, size.width_px, size.height_px)
    return number


def free_pixmap(connection: XConnection, number: int) -> None:
    """Free a pixmap."""
    connection.do("FreePixmap", number)


def graphics_context(connection: XConnection, drawable: int) -> int:
    """Make a graphics context for drawables of the same depth as this one."""
    number = connection.new_id()
    connection.do("CreateGC", number, drawable, _FOREGROUND | _GRAPHICS_EXPOSURES, [0, 0])
    return number


def put_levels(
    connection: XConnection, drawable: int, context: int, levels: Pixels, pattern: Pattern | None = None
) -> None:
    """Draw a pattern's levels, (H, W) uint8, in its colour at the upper left of a drawable with 24 bits in 32."""
    height_px, width_px = levels.shape
    head = _PUT_IMAGE.pack(drawable, context, width_px, height_px, 0, 0, 0, connection.screen.depth)
    connection.do_packed(_PUT_IMAGE_OPCODE, head + rgb_pixels(levels, pattern).tobytes(), data=_Z_PIXMAP)


def fill_tiled(connection: XConnection, drawable: int, context: int, tile: int, size: Size) -> None:
    """Fill a drawable with repetitions of a small pixmap, pixel for pixel, from its upper left corner."""
    connection.do("ChangeGC", context, _FILL_STYLE | _TILE, [_TILED, tile])
    _fill(connection, drawable, context, size)


def watch_presentation(connection: XConnection, window: int) -> None:
    """Receive an event when a pixmap has been presented in a window, after announcing Present 1.0."""
    connection.ask("QueryVersion", 1, 0, extension="Present")
    connection.do("SelectInput", connection.new_id(), window, _COMPLETE_MASK, extension="Present")


def present_pixmap(connection: XConnection, window: int, pixmap: int, serial: int, controller: int) -> None:
    """Present a pixmap in a window at the next refresh of this controller, without fences or further windows."""
    body = _PRESENT_PIXMAP.pack(window, pixmap, serial, 0, 0, 0, 0, controller, 0, 0, 0, 0, 0, 0)
    connection.do_packed(1, body, extension="Present")


def read_pixels(connection: XConnection, x: int, y: int, size: Size) -> NDArray[np.uint32]:
    """Return a part of the screen's frame buffer, without the pointer: (H, W) uint32, 0x00RRGGBB."""
    root = connection.screen.root
    data = connection.ask_bytes("GetImage", _Z_PIXMAP, root, x, y, size.width_px, size.height_px, _ALL_PLANES)
    words = np.frombuffer(data, "<u4", count=size.width_px * size.height_px)
    return words.reshape(size.shape) & np.uint32(0xFFFFFF)


def selection_owner(connection: XConnection, selection: int) -> int:
    """Return the window that owns a selection; 0 where none does."""
    return int(connection.ask("GetSelectionOwner", selection).owner)


def take_selection(connection: XConnection, selection: int, window: int, *, from_another: bool) -> int:
    """Own a selection; from another owner only if `from_another`. Return the window that owned it before, or 0."""
    connection.do("GrabServer")
    try:
        before = selection_owner(connection, selection)
        if before == 0 or from_another:
            connection.do("SetSelectionOwner", window, selection, 0)
        return before
    finally:
        connection.do("UngrabServer")


def _fill(connection: XConnection, drawable: int, context: int, size: Size) -> None:
    rectangle = import_module("xcffib.xproto").RECTANGLE.synthetic(0, 0, size.width_px, size.height_px)
    connection.do("PolyFillRectangle", drawable, context, 1, [rectangle])


def _invisible_cursor(connection: XConnection) -> int:
    shape = create_pixmap(connection, Size(1, 1), 1)
    context = graphics_context(connection, shape)
    # The content of a new pixmap is undefined.
    _fill(connection, shape, context, Size(1, 1))
    cursor = connection.new_id()
    connection.do("CreateCursor", cursor, shape, shape, *([0] * 8))
    connection.do("FreeGC", context)
    free_pixmap(connection, shape)
    return cursor


class DisplayWakeLock:
    """Keeps the displays of an X server awake until `release`.

    The server's MIT-SCREEN-SAVER extension suspends its saver and its power management (DPMS) while this client is
    connected, so a crash does not leave them off. On a server without that extension both are switched off, and set
    as before by `release`.
    """

    def __init__(self, connection: XConnection) -> None:
        self._connection = connection
        self._suspends = False
        self._saver_before: tuple[int, int, int, int] | None = None
        self._power_before = False
        if connection.has(_SAVER):
            version = connection.ask("QueryVersion", 1, 1, extension=_SAVER)
            self._suspends = (version.server_major_version, version.server_minor_version) >= (1, 1)
        if self._suspends:
            connection.do("Suspend", True, extension=_SAVER)
        else:
            saver = connection.ask("GetScreenSaver")
            self._saver_before = (saver.timeout, saver.interval, saver.prefer_blanking, saver.allow_exposures)
            connection.do("SetScreenSaver", 0, *self._saver_before[1:])
            self._power_before = connection.has(_DPMS) and bool(connection.ask("Info", extension=_DPMS).state)
            if self._power_before:
                connection.do("Disable", extension=_DPMS)
        # Wake a display that is asleep: its picture is black.
        connection.do("ForceScreenSaver", 0)
        if self.power_level() != _POWER_ON:
            connection.do("ForceLevel", _POWER_ON, extension=_DPMS)

    def power_level(self) -> int:
        """Return the DPMS power level of the displays: 0 is on."""
        connection = self._connection
        return int(connection.ask("Info", extension=_DPMS).power_level) if connection.has(_DPMS) else _POWER_ON

    def require_awake(self) -> None:
        """Raise UnsupportedByDeviceError unless the displays are on."""
        level = self.power_level()
        if level != _POWER_ON:
            message = (
                f"the displays are put to sleep ({_POWER_LEVELS.get(level, level)}), by another program than the X "
                "server's own saver; switch automatic blanking off in the desktop's power settings, and: xset dpms "
                "force on"
            )
            raise UnsupportedByDeviceError(message)

    def release(self) -> None:
        """Allow the displays to sleep again as before."""
        if self._suspends:
            self._connection.do("Suspend", False, extension=_SAVER)
        if self._saver_before is not None:
            self._connection.do("SetScreenSaver", *self._saver_before)
        if self._power_before:
            self._connection.do("Enable", extension=_DPMS)
