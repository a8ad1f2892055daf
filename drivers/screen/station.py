"""One output of an X server, ours alone for as long as it is open: chosen, checked, kept awake and kept black."""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from drivers.display.pixels import coloured, require_same
from drivers.screen import guarding, randr
from drivers.screen.connection import Connection, RequestRefusedError
from drivers.screen.guard import Duty
from drivers.screen.options import ScreenOptions
from drivers.screen.power import Waking
from drivers.screen.refusals import chosen, require_exact, require_true_colour
from drivers.screen.requests import (
    VISIBILITY_NOTIFY,
    atom,
    black_window,
    free_pixmap,
    hidden_window,
    owner_of,
    property_of,
    raise_window,
    read_pixels,
    set_cardinal,
    take_selection,
    watch_visibility,
)
from slrig.errors import DeviceBusyError, DeviceError, UnsupportedByDeviceError
from slrig.model import Pixels

_COMPOSITE = "Composite"
_UNREDIRECTS_IN_S = 1.0
_LOOKS_EVERY_S = 0.05
_BAD_MATCH = 8
_MENDS_PIXELS = (
    "another window lies above, or the graphics driver scales or converts: try the other backend (backend = "
    '"x11" or "sdl"), and close other programs on that output'
)


class Station:
    """An output of an X server. Used by one thread, but for `cover`.

    Raises
    ------
    UnsupportedByDeviceError
        The output would not show patterns pixel for pixel, or there is none of that name. Lists everything.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another process shows patterns there.
    DeviceError
        There is no X server, or it does not let this user in.
    """

    def __init__(self, connection: Connection, options: ScreenOptions) -> None:
        self._options = options
        self.connection = connection
        randr.require(connection)
        require_true_colour(connection.screen)
        self.output, self.picture = self._inspected(probe=True)
        # Before anything is seen of us: another process may be at work there.
        self._take()
        self._changes = randr.watch(connection)
        self._guard = guarding.keep_dark(
            Duty(
                options.display,
                self.output.name,
                self.picture.x,
                self.picture.y,
                self.picture.size.width_px,
                self.picture.size.height_px,
                os.getpid(),
                options.dark_after_s,
            )
        )
        # Above the guard's, which was there first.
        self.window = black_window(connection, self.picture.x, self.picture.y, self.picture.size)
        self._waking = Waking(connection)
        self._covered: dict[int, bool] = {}
        self._changed = False

    @property
    def refresh_s(self) -> float:
        """One refresh period."""
        refresh_s = self.picture.mode.refresh_s
        if refresh_s is None:
            message = f"output {self.output.name}: its mode does not tell the time of a frame; choose another one"
            raise UnsupportedByDeviceError(message)
        return refresh_s

    def inspect(self, window: int) -> None:
        """See that the output still is what it was, and that nothing draws our window for us.

        Raises
        ------
        UnsupportedByDeviceError, DeviceGoneError
        """
        output, picture = self._inspected(probe=False)
        if (picture.x, picture.y, picture.size) != (self.picture.x, self.picture.y, self.picture.size):
            message = (
                f"output {output.name} showed {self.picture.size} pixels at +{self.picture.x}+{self.picture.y} when it "
                f"was opened, now {picture.size} at +{picture.x}+{picture.y}; open the rig again"
            )
            raise UnsupportedByDeviceError(message)
        self.output, self.picture = output, picture
        self._changed = False
        if not self._options.trust_compositor:
            self._require_direct(window)

    def ready(self, window: int) -> None:
        """See, before a picture is shown in a window, that it will be seen, and alone.

        Raises
        ------
        UnsupportedByDeviceError
            The output was changed so that it is not exact any more, or sleeps.
        DeviceBusyError
            Another program's window is above ours and stays there.
        """
        self._look()
        if self._changed:
            self.inspect(window)
        self._waking.require_awake()
        if self._covered.get(window, True):
            self._guard.step_back()
            raise_window(self.connection, window)
            self._covered.setdefault(window, False)
            self._look()
            if self._covered[window]:
                message = (
                    f"a window of another program is above the patterns on output {self.output.name} and stays there; "
                    "close it, or move it to another output"
                )
                raise DeviceBusyError(message)

    def require_server(self) -> None:
        """See that the server is there: libraries above Xlib may end the process otherwise. Raises DeviceGoneError."""
        self._look()

    def watch(self, window: int) -> None:
        """Have an eye on a window that this connection has not made."""
        watch_visibility(self.connection, window)

    def compare(self, levels: Pixels) -> None:
        """See that the frame buffer holds a picture, pixel for pixel.

        levels : (H, W) uint8.

        Raises
        ------
        UnsupportedByDeviceError
            It does not. Tells how many pixels differ, and where.
        """
        found = read_pixels(self.connection, self.picture.x, self.picture.y, self.picture.size)
        require_same(self.output.name, coloured(levels), found, _MENDS_PIXELS)

    def await_event(self, kind: int, timeout_s: float) -> Iterator[bytes]:
        """Yield events of one kind as they come, until the time is over; the others are taken note of."""
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            for event in self.connection.events():
                if event[0] & 0x7F == kind:
                    yield event
                else:
                    self._note(event)
            left_s = (until_ns - time.monotonic_ns()) / 1e9
            if left_s <= 0:
                return
            self.connection.wait(left_s)

    def cover(self) -> bool:
        """Make the output black without any of our own windows' help, from any thread; return whether it is."""
        return self._guard.cover()

    def close(self) -> None:
        """Leave the output to its guard, black. Idempotent."""
        self.cover()
        # The server may be gone.
        with suppress(DeviceError):
            self._waking.end()
        self.connection.close()

    def _inspected(self, *, probe: bool) -> tuple[randr.Output, randr.Picture]:
        outputs = randr.outputs(self.connection, probe=probe)
        output = chosen(outputs, self._options.output)
        picture = require_exact(output, outputs, native=self._options.native, monitor=self._options.monitor)
        return output, picture

    def _take(self) -> None:
        selection = atom(self.connection, f"_SLRIG_SCREEN_{self.output.name}")
        ours = hidden_window(self.connection)
        set_cardinal(self.connection, ours, "_NET_WM_PID", os.getpid())
        holder = take_selection(self.connection, selection, ours, from_another=False)
        if holder:
            data = property_of(self.connection, holder, "_NET_WM_PID")
            process = struct.unpack("<I", data)[0] if len(data) == 4 else 0
            name = ""
            with suppress(OSError):
                name = Path(f"/proc/{process}/comm").read_text().strip()
            message = (
                f"output {self.output.name} is in use by process {process or 'unknown'} "
                f"({name or 'of another machine'}); end that program, or wait for it"
            )
            raise DeviceBusyError(message)

    def _look(self) -> None:
        """Take note of what happened since the last look."""
        for event in self.connection.events():
            self._note(event)

    def _note(self, event: bytes) -> None:
        kind = event[0] & 0x7F
        if kind == VISIBILITY_NOTIFY:
            self._covered[struct.unpack_from("<I", event, 4)[0]] = event[8] != 0
        elif kind in (self._changes, self._changes + 1):
            self._changed = True

    def _require_direct(self, window: int) -> None:
        """Wait until no compositor draws our window, as it was asked not to."""
        until_s = time.monotonic() + _UNREDIRECTS_IN_S
        while self._is_redirected(window):
            if time.monotonic() > until_s:
                manager = owner_of(self.connection, atom(self.connection, "_NET_WM_CM_S0"))
                name = (
                    property_of(self.connection, manager, "_NET_WM_NAME").decode("utf-8", "replace") if manager else ""
                )
                message = (
                    f"output {self.output.name} is drawn by a compositor ({name or 'it does not tell its name'}), "
                    "which may delay, scale or tint what it is given, and does not let go of a window that asks for it "
                    "(_NET_WM_BYPASS_COMPOSITOR); switch compositing off (Xfce: xfconf-query -c xfwm4 -p "
                    "/general/use_compositing -s false; KDE: Shift+Alt+F12; picom: unredir-if-possible = true), or set "
                    "trust_compositor = true if patterns were seen to be right"
                )
                raise UnsupportedByDeviceError(message)
            time.sleep(_LOOKS_EVERY_S)

    def _is_redirected(self, window: int) -> bool:
        """Whether a window's pixels go to a compositor: only then they have a picture of their own to be named."""
        connection = self.connection
        if not connection.has(_COMPOSITE):
            return False
        connection.ask(0, struct.pack("<II", 0, 4), extension=_COMPOSITE)
        name = connection.new_id()
        try:
            connection.do(6, struct.pack("<II", window, name), extension=_COMPOSITE)
        except RequestRefusedError as refused:
            if refused.number == _BAD_MATCH:
                return False
            raise
        free_pixmap(connection, name)
        return True
