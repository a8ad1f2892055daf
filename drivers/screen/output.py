"""A projector's output on an X server: reserved, checked, kept awake and black, and shown through Present or SDL."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from drivers.display.projector import (
    PatternOutput,
    ScanoutStart,
    require_equal_pixels,
    rgb_pixels,
    start_of_copy,
    start_of_flip,
)
from drivers.screen.guard import ScreenGuardTask, start_guard
from drivers.screen.options import ScreenOptions
from drivers.screen.randr import (
    CrtcConfig,
    Output,
    find_output,
    list_outputs,
    require_exact,
    require_randr,
    require_true_colour,
    watch_outputs,
)
from drivers.screen.sdl import Canvas, SdlOutput, open_fullscreen, start_sdl
from drivers.screen.session import exact_session, exempting, session_name
from drivers.screen.x11 import (
    COMPLETE_NOTIFY,
    OUTPUT_CHANGES,
    VISIBILITY_NOTIFY,
    DisplayWakeLock,
    RequestRefusedError,
    XConnection,
    atom,
    black_window,
    create_pixmap,
    event_name,
    fill_tiled,
    free_pixmap,
    graphics_context,
    hidden_window,
    present_pixmap,
    put_levels,
    raise_window,
    read_pixels,
    selection_owner,
    set_cardinal,
    take_selection,
    watch_presentation,
    watch_visibility,
    window_property,
)
from slrig.errors import DeviceBusyError, DeviceError, UnsupportedByDeviceError
from slrig.model import Pattern, PatternSequence, Pixels, Size

_COMPOSITE, _PRESENT, _XWAYLAND = "Composite", "Present", "XWAYLAND"
_UNREDIRECT_TIMEOUT_S = 1.0
_POLL_INTERVAL_S = 0.05
_COMPLETE_TIMEOUT_S = 1.0
_PRESENTED_PIXMAP = 0
_FLIP_MODES = (1, 3)
_BLACK: Pixels = np.zeros((1, 1), np.uint8)
_PIXEL_REMEDY = (
    "another window is above, or the graphics driver scales or converts: try the other backend (backend = "
    '"x11" or "sdl"), and close other programs on that output'
)


class ReservedOutput:
    """An output of an X server that this process alone uses. One thread uses it, except for `cover`.

    Raises
    ------
    UnsupportedByDeviceError
        The output would not show patterns pixel for pixel, or no output has that name. Lists every fault.
    DeviceGoneError
        Nothing is connected to it.
    DeviceBusyError
        Another process shows patterns there.
    DeviceError
        No X server runs, or it refuses this user.
    """

    def __init__(self, connection: XConnection, options: ScreenOptions) -> None:
        self._options = options
        self.connection = connection
        require_randr(connection)
        require_true_colour(connection.screen)
        self.output, self.crtc = self._find_exact(probe=True)
        # Before our windows are visible: another process may use the output.
        self._reserve()
        watch_outputs(connection)
        crtc = self.crtc
        self._guard = start_guard(
            ScreenGuardTask(
                options.display,
                self.output.name,
                crtc.x,
                crtc.y,
                crtc.size.width_px,
                crtc.size.height_px,
                os.getpid(),
                options.dark_after_s,
            )
        )
        # Made after the guard's window, and so above it.
        self.window = black_window(connection, crtc.x, crtc.y, crtc.size)
        self._wake_lock = DisplayWakeLock(connection)
        self._covered: dict[int, bool] = {}
        self._changed = False

    @property
    def refresh_s(self) -> float:
        """One refresh period."""
        refresh_s = self.crtc.mode.refresh_s
        if refresh_s is None:
            message = f"output {self.output.name}: its mode does not state the duration of a frame; choose another one"
            raise UnsupportedByDeviceError(message)
        return refresh_s

    def recheck(self, window: int) -> None:
        """Check that the output is unchanged, and that no compositor draws our window.

        Raises
        ------
        UnsupportedByDeviceError, DeviceGoneError
        """
        output, crtc = self._find_exact(probe=False)
        if (crtc.x, crtc.y, crtc.size) != (self.crtc.x, self.crtc.y, self.crtc.size):
            message = (
                f"output {output.name} showed {self.crtc.size} pixels at +{self.crtc.x}+{self.crtc.y} when it "
                f"was opened, now {crtc.size} at +{crtc.x}+{crtc.y}; open the rig again"
            )
            raise UnsupportedByDeviceError(message)
        self.output, self.crtc = output, crtc
        self._changed = False
        if not self._options.trust_compositor:
            self._require_unredirected(window)

    def require_visible(self, window: int) -> None:
        """Check, before a picture is shown in a window, that it will be visible and unchanged.

        Raises
        ------
        UnsupportedByDeviceError
            The output was changed so that it is no longer exact, or sleeps.
        DeviceBusyError
            Another program's window is above ours and stays there.
        """
        self.require_server()
        if self._changed:
            self.recheck(window)
        self._wake_lock.require_awake()
        if self._covered.get(window, True):
            self._guard.step_back()
            raise_window(self.connection, window)
            self._covered.setdefault(window, False)
            self.require_server()
            if self._covered[window]:
                message = (
                    f"a window of another program is above the patterns on output {self.output.name} and stays there; "
                    "close it, or move it to another output"
                )
                raise DeviceBusyError(message)

    def require_server(self) -> None:
        """Handle the events that have arrived. Raises DeviceGoneError if the server has ended.

        To be called before Xlib is used, which may end the process where the server is gone.
        """
        for event in self.connection.events():
            self._handle(event)

    def compare(self, levels: Pixels) -> None:
        """Compare the frame buffer with a picture, (H, W) uint8, pixel for pixel.

        Raises
        ------
        UnsupportedByDeviceError
            They differ. States how many pixels differ, and where.
        """
        found = read_pixels(self.connection, self.crtc.x, self.crtc.y, self.crtc.size)
        require_equal_pixels(self.output.name, rgb_pixels(levels), found, _PIXEL_REMEDY)

    def wait_for_events(self, name: str, timeout_s: float) -> Iterator[Any]:
        """Yield events of one name as they arrive, until the time is over; others are handled."""
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            for event in self.connection.events():
                if event_name(event) == name:
                    yield event
                else:
                    self._handle(event)
            left_s = (until_ns - time.monotonic_ns()) / 1e9
            if left_s <= 0:
                return
            self.connection.wait(left_s)

    def cover(self) -> bool:
        """Make the output black through the guard process, from any thread; return True if it did."""
        return self._guard.cover()

    def close(self) -> None:
        """Leave the output to its guard, black. Idempotent."""
        self.cover()
        # The server may be gone.
        with suppress(DeviceError):
            self._wake_lock.release()
        self.connection.close()

    def _find_exact(self, *, probe: bool) -> tuple[Output, CrtcConfig]:
        outputs = list_outputs(self.connection, probe=probe)
        output = find_output(outputs, self._options.output)
        return output, require_exact(output, outputs, native=self._options.native, monitor=self._options.monitor)

    def _reserve(self) -> None:
        """Own the output's selection. Raises DeviceBusyError if another process has it."""
        selection = atom(self.connection, f"_SLRIG_SCREEN_{self.output.name}")
        ours = hidden_window(self.connection)
        set_cardinal(self.connection, ours, "_NET_WM_PID", os.getpid())
        owner = take_selection(self.connection, selection, ours, from_another=False)
        if owner:
            data = window_property(self.connection, owner, "_NET_WM_PID")
            process = int.from_bytes(data, "little") if len(data) == 4 else 0
            name = ""
            with suppress(OSError):
                name = Path(f"/proc/{process}/comm").read_text().strip()
            message = (
                f"output {self.output.name} is in use by process {process or 'unknown'} "
                f"({name or 'of another machine'}); end that program, or wait for it"
            )
            raise DeviceBusyError(message)

    def _handle(self, event: Any) -> None:
        name = event_name(event)
        if name == VISIBILITY_NOTIFY:
            self._covered[event.window] = event.state != 0
        elif name in OUTPUT_CHANGES:
            self._changed = True

    def _require_unredirected(self, window: int) -> None:
        """Wait until no compositor draws our window. Raises UnsupportedByDeviceError if one continues."""
        until_s = time.monotonic() + _UNREDIRECT_TIMEOUT_S
        while self._is_redirected(window):
            if time.monotonic() > until_s:
                manager = selection_owner(self.connection, atom(self.connection, "_NET_WM_CM_S0"))
                data = window_property(self.connection, manager, "_NET_WM_NAME") if manager else b""
                name = data.decode("utf-8", "replace")
                message = (
                    f"output {self.output.name} is drawn by a compositor "
                    f"({name or 'without a name'}), which may delay, scale or tint pictures and does not exempt a "
                    f"window that requests it (_NET_WM_BYPASS_COMPOSITOR); {exempting(name)}; or set trust_compositor "
                    "= true if you have checked that patterns come out right"
                )
                raise UnsupportedByDeviceError(message)
            time.sleep(_POLL_INTERVAL_S)

    def _is_redirected(self, window: int) -> bool:
        """True if a window's pixels go to a compositor: only then they have a pixmap that can be named."""
        connection = self.connection
        if not connection.has(_COMPOSITE):
            return False
        connection.ask("QueryVersion", 0, 4, extension=_COMPOSITE)
        pixmap = connection.new_id()
        try:
            connection.do("NameWindowPixmap", window, pixmap, extension=_COMPOSITE)
        except RequestRefusedError as refusal:
            if refusal.error == "MatchError":
                return False
            raise
        free_pixmap(connection, pixmap)
        return True


class PresentSurface:
    """Shows patterns in a reserved output's own window through Present. The output's thread uses it."""

    def __init__(self, reserved: ReservedOutput) -> None:
        connection = reserved.connection
        if not connection.has(_PRESENT):
            message = 'the X server has no Present extension; use Xorg 1.15 or later, or backend = "sdl"'
            raise UnsupportedByDeviceError(message)
        self._reserved = reserved
        self.window = reserved.window
        watch_presentation(connection, self.window)
        size = reserved.crtc.size
        # One may be on its way to the display while the other one is drawn.
        self._pixmaps = (create_pixmap(connection, size), create_pixmap(connection, size))
        self._context = graphics_context(connection, self.window)
        self._black = self._make_tile(_BLACK)
        self._tiles: tuple[int, ...] = ()
        self._serials = count(1)

    def load(self, sequence: PatternSequence) -> None:
        """Send one tile for each pattern, which the server repeats over the output."""
        tiles, self._tiles = self._tiles, ()
        for tile in tiles:
            free_pixmap(self._reserved.connection, tile)
        self._tiles = tuple(map(self._make_tile, sequence.profiles, sequence.patterns))

    def show(self, index: int | None) -> ScanoutStart:
        """Show a pattern of the sequence, None for black, and return when its scan-out began.

        Raises
        ------
        DeviceError
            The server did not report the presentation in time.
        """
        reserved, serial = self._reserved, next(self._serials)
        connection, pixmap = reserved.connection, self._pixmaps[serial % 2]
        tile = self._black if index is None else self._tiles[index]
        fill_tiled(connection, pixmap, self._context, tile, reserved.crtc.size)
        requested_ns = time.monotonic_ns()
        present_pixmap(connection, self.window, pixmap, serial, reserved.crtc.controller)
        mode, stamp_ns = self._wait_for_completion(serial)
        returned_ns = time.monotonic_ns()
        refresh_ns = round(reserved.refresh_s * 1e9)
        if not requested_ns - refresh_ns <= stamp_ns <= returned_ns + refresh_ns:
            # The graphics driver uses another clock: the presentation happened during the wait.
            return ScanoutStart(requested_ns, returned_ns + refresh_ns)
        return start_of_flip(stamp_ns) if mode in _FLIP_MODES else start_of_copy(stamp_ns, reserved.refresh_s)

    def close(self) -> None:
        """Do nothing: the server frees everything with the connection."""

    def _make_tile(self, profile: Pixels, pattern: Pattern | None = None) -> int:
        connection = self._reserved.connection
        tile = create_pixmap(connection, Size(profile.shape[1], profile.shape[0]))
        put_levels(connection, tile, self._context, profile, pattern)
        return tile

    def _wait_for_completion(self, serial: int) -> tuple[int, int]:
        """Return the mode and time stamp, ns, of a presentation."""
        for event in self._reserved.wait_for_events(COMPLETE_NOTIFY, _COMPLETE_TIMEOUT_S):
            if event.kind == _PRESENTED_PIXMAP and event.window == self.window and event.serial == serial:
                return event.mode, event.stamp_us * 1000
        message = (
            f"output {self._reserved.output.name} made no refresh in {_COMPLETE_TIMEOUT_S:g} s: it is switched off, "
            "asleep, or its graphics driver hangs; see xrandr, and: xset dpms force on"
        )
        raise DeviceError(message)


class SdlSurface:
    """Shows patterns in an SDL window exactly over a reserved output's own. The output's thread uses it."""

    def __init__(self, reserved: ReservedOutput) -> None:
        sdl = start_sdl((b"SDL_VIDEODRIVER", b"x11"), (b"SDL_X11_FORCE_OVERRIDE_REDIRECT", b"1"))
        crtc = reserved.crtc
        self._canvas = Canvas(sdl, (crtc.x, crtc.y), crtc.size, sdl.SDL_WINDOW_BORDERLESS)
        self._refresh_s = reserved.refresh_s
        self.window = self._canvas.x11_window()
        watch_visibility(reserved.connection, self.window)

    def load(self, sequence: PatternSequence) -> None:
        """Take the patterns of a sequence."""
        self._canvas.sequence = sequence

    def show(self, index: int | None) -> ScanoutStart:
        """Show a pattern of the sequence, None for black, and return when its scan-out may have begun."""
        return self._canvas.show(index, self._refresh_s)

    def close(self) -> None:
        """Destroy the window."""
        self._canvas.close()


class X11Output:
    """An output of an X server. Implements `PatternOutput`."""

    def __init__(self, reserved: ReservedOutput, surface: PresentSurface | SdlSurface) -> None:
        self._reserved = reserved
        self._surface = surface
        output, edid = reserved.output, reserved.output.edid
        self.size = reserved.crtc.size
        self.refresh_s = reserved.refresh_s
        self.model = f"{str(edid) if edid is not None else 'display'} on {output.name}, {reserved.crtc.mode}"
        self.serial = edid.serial if edid is not None and edid.serial else output.name

    def load(self, sequence: PatternSequence) -> None:
        """See `PatternOutput`."""
        self._reserved.recheck(self._surface.window)
        self._surface.load(sequence)

    def show(self, index: int | None) -> ScanoutStart:
        """See `PatternOutput`. Raises as `ReservedOutput.require_visible`; for black only if the server is gone."""
        if index is not None:
            self._reserved.require_visible(self._surface.window)
        else:
            self._reserved.require_server()
        return self._surface.show(index)

    def compare(self, levels: Pixels) -> None:
        """See `PatternOutput`."""
        self._reserved.compare(levels)

    def cover(self) -> bool:
        """See `PatternOutput`."""
        return self._reserved.cover()

    def close(self) -> None:
        """See `PatternOutput`."""
        self._reserved.cover()
        try:
            self._reserved.require_server()
            self._surface.close()
        finally:
            self._reserved.close()


def open_output(options: ScreenOptions) -> PatternOutput:
    """Open the output that a rig file describes; it is black. To be called on the thread that uses it.

    Raises
    ------
    UnsupportedByDeviceError, DeviceGoneError, DeviceBusyError, DeviceError, LibraryMissingError
    """
    wayland = bool(os.environ.get("WAYLAND_DISPLAY")) and options.display is None
    if sys.platform != "linux" or wayland or not (options.display or os.environ.get("DISPLAY")):
        return _open_without_x(options)
    connection = XConnection(options.display)
    try:
        if connection.has(_XWAYLAND):
            _require_trust(options, "X on top of Wayland (XWayland)")
        reserved = ReservedOutput(connection, options)
        try:
            return X11Output(reserved, _open_surface(reserved, options))
        except BaseException:
            reserved.close()
            raise
    except BaseException:
        connection.close()
        raise


def _open_surface(reserved: ReservedOutput, options: ScreenOptions) -> PresentSurface | SdlSurface:
    if options.backend == "x11" or (options.backend == "auto" and reserved.connection.has(_PRESENT)):
        return PresentSurface(reserved)
    if options.display not in (None, os.environ.get("DISPLAY")):
        message = (
            f"backend sdl takes its X server from the environment (DISPLAY={os.environ.get('DISPLAY')}), the rig file "
            f'requests {options.display}; leave display out, or take backend = "x11"'
        )
        raise UnsupportedByDeviceError(message)
    return SdlSurface(reserved)


def _open_without_x(options: ScreenOptions) -> SdlOutput:
    system = session_name()
    if options.backend == "x11":
        message = f"backend x11 needs an X server, found {system}; {exact_session()}"
        raise UnsupportedByDeviceError(message)
    _require_trust(options, system)
    return open_fullscreen(options)


def _require_trust(options: ScreenOptions, system: str) -> None:
    if not options.trust_compositor:
        message = (
            f"output {options.output}: found {system}, where no program can find out whether its pixels are scaled, "
            f"tinted or delayed, or which output they go to; {exact_session()}; or, if you have checked that patterns "
            "come out right here (scaling 100 %, night light off, not mirrored), set trust_compositor = true"
        )
        raise UnsupportedByDeviceError(message)
