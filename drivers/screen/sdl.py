"""Windows of SDL 2, which runs on every system and reports no flip times.

SDL's present call returns when a picture is queued, up to `MAX_QUEUED_FRAMES` refreshes before it is visible. Each
picture is presented twice, so the first one is out when the second call returns; the rest is stated as error.
"""

from __future__ import annotations

import ctypes
import importlib
import time
import warnings
from contextlib import suppress
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.display.projector import ScanoutStart, rgb_pixels, start_of_queued
from drivers.libraries import loading
from drivers.screen.options import ScreenOptions
from slrig.errors import DeviceError, UnsupportedByDeviceError
from slrig.model import PatternSequence, Pixels, Size

_HINTS = (
    # The service handles signals.
    (b"SDL_NO_SIGNAL_HANDLERS", b"1"),
    (b"SDL_VIDEO_MINIMIZE_ON_FOCUS_LOSS", b"0"),
    (b"SDL_RENDER_SCALE_QUALITY", b"0"),
    (b"SDL_VIDEO_X11_NET_WM_BYPASS_COMPOSITOR", b"1"),
)
_RESIZE_TIMEOUT_S = 2.0
_POLL_INTERVAL_S = 0.02
_CENTRED = 0x2FFF0000
_OPAQUE = np.uint32(0xFF000000)

_IGNORE_IO_ERROR = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(lambda _display, _data: None)
_IGNORE_ERROR = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(lambda _display, _error: 0)


class SdlOutput:
    """A full-screen window on a display of SDL, without an X server. Implements `PatternOutput`."""

    def __init__(self, canvas: Canvas, name: str, refresh_s: float) -> None:
        self._canvas = canvas
        self.size = canvas.size
        self.refresh_s = refresh_s
        self.model = f"display {name}, {self.size} at {1 / refresh_s:.0f} Hz, through SDL ({canvas.driver})"
        self.serial = name
        self.show(None)

    def load(self, sequence: PatternSequence) -> None:
        """Take the patterns of a sequence."""
        self._canvas.sequence = sequence

    def show(self, index: int | None) -> ScanoutStart:
        """Show a pattern of the sequence, None for black."""
        return self._canvas.show(index, self.refresh_s)

    def compare(self, levels: Pixels) -> None:
        """Do nothing: no program may read what a Wayland compositor shows."""

    def cover(self) -> bool:
        """Return False: only this window's own thread can make it black."""
        return False

    def close(self) -> None:
        """Show black and destroy the window: the desktop behind it is visible again."""
        with suppress(DeviceError):
            self.show(None)
        self._canvas.close()


def open_fullscreen(options: ScreenOptions) -> SdlOutput:
    """Open a window over the display `options.output`. Raises UnsupportedByDeviceError, LibraryMissingError."""
    sdl = start_sdl()
    try:
        index, (name, size, rate_hz) = _choose_display(_displays(sdl), options)
        centre = _CENTRED | index
        canvas = Canvas(sdl, (centre, centre), size, sdl.SDL_WINDOW_FULLSCREEN_DESKTOP | sdl.SDL_WINDOW_BORDERLESS)
    except BaseException:
        _stop_sdl(sdl)
        raise
    return SdlOutput(canvas, name, 1 / rate_hz)


def _choose_display(found: list[tuple[str, Size, int]], options: ScreenOptions) -> tuple[int, tuple[str, Size, int]]:
    matching = [index for index, (name, _, _) in enumerate(found) if name == options.output]
    if len(matching) != 1:
        there = "; ".join(f"'{name}' ({size} at {rate_hz} Hz)" for name, size, rate_hz in found) or "none"
        count = f"{len(matching)} displays are" if matching else "no display is"
        message = f"output {options.output}: {count} of that name; there are: {there}; write one of these names"
        raise UnsupportedByDeviceError(message)
    name, size, rate_hz = found[matching[0]]
    if options.native is not None and options.native != size:
        message = (
            f"output {name} shows {size}, the projector's own raster is {options.native} (native_px): set the display "
            "to that size, with a scale of 100 %"
        )
        raise UnsupportedByDeviceError(message)
    if rate_hz < 1:
        message = f"output {name} does not state its refresh rate; set one in the system's display settings"
        raise UnsupportedByDeviceError(message)
    return matching[0], found[matching[0]]


def _displays(sdl: Any) -> list[tuple[str, Size, int]]:
    """Return name, extent and refresh rate in Hz (0: unknown) of each display of SDL."""
    found = []
    for index in range(sdl.SDL_GetNumVideoDisplays()):
        mode = sdl.SDL_DisplayMode()
        if sdl.SDL_GetCurrentDisplayMode(index, ctypes.byref(mode)) == 0:
            name = (sdl.SDL_GetDisplayName(index) or b"").decode("utf-8", "replace")
            found.append((name, Size(max(mode.w, 1), max(mode.h, 1)), int(mode.refresh_rate)))
    return found


def list_displays() -> list[tuple[str, Size, int]]:
    """List name, extent and refresh rate in Hz of each display. Raises LibraryMissingError, DeviceError."""
    sdl = start_sdl()
    try:
        return _displays(sdl)
    finally:
        _stop_sdl(sdl)


class Canvas:
    """An SDL window with a renderer and one texture of exactly its size, black at first."""

    def __init__(self, sdl: Any, place: tuple[int, int], size: Size, flags: int) -> None:
        self._sdl = sdl
        self.size = size
        self.sequence: PatternSequence | None = None
        self.driver = (sdl.SDL_GetCurrentVideoDriver() or b"").decode()
        self._renderer = self._texture = None
        width_px, height_px = size.width_px, size.height_px
        self._window = sdl.SDL_CreateWindow(b"slrig", *place, width_px, height_px, flags | sdl.SDL_WINDOW_SHOWN)
        try:
            self._require_created(self._window, "window")
            sdl.SDL_ShowCursor(0)
            self._renderer = sdl.SDL_CreateRenderer(self._window, -1, sdl.SDL_RENDERER_PRESENTVSYNC)
            if not self._renderer:
                self._renderer = sdl.SDL_CreateRenderer(self._window, -1, 0)
            self._require_created(self._renderer, "renderer")
            self._require_size()
            self._texture = sdl.SDL_CreateTexture(
                self._renderer, sdl.SDL_PIXELFORMAT_ARGB8888, sdl.SDL_TEXTUREACCESS_STREAMING, width_px, height_px
            )
            self._require_created(self._texture, "texture")
            sdl.SDL_SetTextureBlendMode(self._texture, sdl.SDL_BLENDMODE_NONE)
        except BaseException:
            self._destroy()
            raise

    def show(self, index: int | None, refresh_s: float) -> ScanoutStart:
        """Show a pattern of the sequence, None for black."""
        sdl = self._sdl
        if index is None or self.sequence is None:
            words: NDArray[np.uint32] = np.full(self.size.shape, _OPAQUE, np.uint32)
        else:
            words = np.ascontiguousarray(
                rgb_pixels(self.sequence.image(index), self.sequence.patterns[index]) | _OPAQUE
            )
        sdl.SDL_PumpEvents()
        code = sdl.SDL_UpdateTexture(self._texture, None, words.ctypes.data, words.strides[0])
        self._require_success(code, "take a picture")
        requested_ns = time.monotonic_ns()
        for _ in range(2):
            self._require_success(sdl.SDL_RenderCopy(self._renderer, self._texture, None, None), "draw")
            sdl.SDL_RenderPresent(self._renderer)
        return start_of_queued(requested_ns, time.monotonic_ns(), refresh_s)

    def x11_window(self) -> int:
        """Return the X server's number for the window."""
        info = self._sdl.SDL_SysWMinfo()
        self._sdl.SDL_VERSION(info.version)
        self._require_created(self._sdl.SDL_GetWindowWMInfo(self._window, ctypes.byref(info)), "window of X")
        _survive_server_end(info.info.x11.display)
        return int(info.info.x11.window)

    def close(self) -> None:
        """Destroy the window and leave SDL."""
        self._destroy()
        _stop_sdl(self._sdl)

    def _require_size(self) -> None:
        """Wait until the window has its extent, which some window systems set late."""
        until_s = time.monotonic() + _RESIZE_TIMEOUT_S
        while True:
            self._sdl.SDL_PumpEvents()
            width_px, height_px = ctypes.c_int(), ctypes.c_int()
            self._sdl.SDL_GetRendererOutputSize(self._renderer, ctypes.byref(width_px), ctypes.byref(height_px))
            if (width_px.value, height_px.value) == (self.size.width_px, self.size.height_px):
                return
            if time.monotonic() > until_s:
                message = (
                    f"requested an SDL window of {self.size} pixels, got {width_px.value} x {height_px.value}: the "
                    "desktop scales; set the projector's scale to 100 %"
                )
                raise UnsupportedByDeviceError(message)
            time.sleep(_POLL_INTERVAL_S)

    def _destroy(self) -> None:
        sdl = self._sdl
        for destroy, handle in (
            (sdl.SDL_DestroyTexture, self._texture),
            (sdl.SDL_DestroyRenderer, self._renderer),
            (sdl.SDL_DestroyWindow, self._window),
        ):
            if handle:
                destroy(handle)
        self._window = self._renderer = self._texture = None

    def _require_created(self, handle: object, name: str) -> None:
        if not handle:
            self._fail(f"make a {name}")

    def _require_success(self, code: int, what: str) -> None:
        if code:
            self._fail(what)

    def _fail(self, what: str) -> None:
        message = (
            f"SDL cannot {what}: {(self._sdl.SDL_GetError() or b'').decode('utf-8', 'replace')}; update the graphics "
            'driver, or take backend = "x11"'
        )
        raise DeviceError(message)


def start_sdl(*hints: tuple[bytes, bytes]) -> Any:
    """Start SDL's video with these hints and return its module. Raises LibraryMissingError, DeviceError."""
    sdl = _import_sdl()
    for name, value in (*_HINTS, *hints):
        sdl.SDL_SetHint(name, value)
    if sdl.SDL_InitSubSystem(sdl.SDL_INIT_VIDEO):
        message = (
            f"SDL finds no display: {(sdl.SDL_GetError() or b'').decode('utf-8', 'replace')}; start slrig within the "
            "graphical session, or set DISPLAY or WAYLAND_DISPLAY as they are there"
        )
        raise DeviceError(message)
    return sdl


def _stop_sdl(sdl: Any) -> None:
    sdl.SDL_QuitSubSystem(sdl.SDL_INIT_VIDEO)


@cache
def _import_sdl() -> Any:
    install = "pip install 'slrig[screen]'"
    with loading("screen", "PySDL2", install=install, packages="PySDL2 pysdl2-dll"), warnings.catch_warnings():
        # PySDL2 reports the library that it found by a warning.
        warnings.simplefilter("ignore")
        return importlib.import_module("sdl2")


def _survive_server_end(display: int) -> None:
    """Keep Xlib from ending the whole process when the server ends (libX11 1.7 and later) or refuses a request."""
    with suppress(OSError, AttributeError):
        xlib = ctypes.CDLL("libX11.so.6")
        xlib.XSetIOErrorExitHandler.argtypes = [ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p]
        xlib.XSetIOErrorExitHandler.restype = None
        xlib.XSetIOErrorExitHandler(display, _IGNORE_IO_ERROR, None)
        xlib.XSetErrorHandler.argtypes, xlib.XSetErrorHandler.restype = [ctypes.c_void_p], ctypes.c_void_p
        xlib.XSetErrorHandler(_IGNORE_ERROR)
