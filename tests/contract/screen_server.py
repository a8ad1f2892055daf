"""Xorg without a graphics card: true RandR outputs, modes and gamma ramps, and a white desktop.

What a display would show is read from the frame buffer, through libX11 and through none of the driver's code.
"""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.model import Pixels, Size

PACKAGES = "xserver-xorg-core xserver-xorg-video-dummy x11-xserver-utils libx11-6 libxcb1"
REFRESH_HZ = 120

_SERVER = Path("/usr/lib/xorg/Xorg")
_CONFIGURATION = """
Section "ServerFlags"
  Option "AutoAddDevices" "false"
  Option "AutoAddGPU" "false"
EndSection
Section "Device"
  Identifier "card"
  Driver "dummy"
  VideoRam 256000
EndSection
Section "Monitor"
  Identifier "display"
  HorizSync 1-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "screen"
  Device "card"
  Monitor "display"
  DefaultDepth {depth}
  SubSection "Display"
    Depth {depth}
    Virtual 4096 2048
  EndSubSection
EndSection
"""


def require_xorg() -> None:
    """Skip where Xorg's dummy driver is not installed; fail instead where CI=true, which installs it."""
    lacking = [name for name in ("xrandr", "xsetroot", "xset") if shutil.which(name) is None]
    if not _SERVER.exists() or not _SERVER.parent.joinpath("modules/drivers/dummy_drv.so").exists():
        lacking.append("Xorg with its dummy driver")
    if lacking:
        reason = f"needs {', '.join(lacking)}: apt install {PACKAGES}"
        if os.environ.get("CI") == "true":
            pytest.fail(reason)
        pytest.skip(reason)


class DummyServer:
    """An Xorg server without a graphics card, its desktop white. A context manager."""

    def __init__(self, folder: Path, *, depth: int = 24) -> None:
        require_xorg()
        configuration = folder / "xorg.conf"
        configuration.write_text(_CONFIGURATION.format(depth=depth))
        told, tells = os.pipe()
        self._modes: set[str] = set()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - a program of the system, with our own arguments
                [
                    *(str(_SERVER), "-displayfd", str(tells), "-config", str(configuration), "-noreset"),
                    *("-logfile", str(folder / "xorg.log"), "-nolisten", "tcp", "-novtswitch", "-sharevts"),
                ],
                pass_fds=(tells,),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            os.close(tells)
            with os.fdopen(told) as number:
                line = number.readline().strip()
        except BaseException:
            self.close()
            raise
        if not line:
            self.close()
            pytest.fail(f"Xorg did not start: {(folder / 'xorg.log').read_text()[-2000:]}")
        self.display = f":{line}"
        self.run("xsetroot", "-solid", "white")

    def run(self, *command: str) -> str:
        """Run one of X's own programs on this server."""
        done = subprocess.run(  # noqa: S603 - programs of the system, with our own arguments
            command, env={**os.environ, "DISPLAY": self.display}, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, f"{command}: {done.stderr}"
        return done.stdout

    def arrange(self, **sizes: Size) -> dict[str, tuple[int, int]]:
        """Give outputs these sizes, side by side from the left, all others off; return where each of them is."""
        command, x_px, places = ["xrandr"], 0, {}
        for output, size in sizes.items():
            command += ["--output", output, "--mode", self.mode(output, size), "--pos", f"{x_px}x0"]
            # Another test may have left something else there.
            command += ["--rotate", "normal", "--reflect", "normal", "--gamma", "1:1:1", "--transform", "none"]
            places[output] = (x_px, 0)
            x_px += size.width_px
        for output in {"DUMMY0", "DUMMY1"} - set(sizes):
            command += ["--output", output, "--off"]
        self.run(*command)
        return places

    def mode(self, output: str, size: Size) -> str:
        """The name of a mode of this size, made known to an output."""
        name = f"{size.width_px}x{size.height_px}-own"
        columns, rows = size.width_px + 24, size.height_px + 8
        if name not in self._modes:
            clock_mhz = f"{columns * rows * REFRESH_HZ / 1e6:.4f}"
            horizontal = [str(size.width_px + more) for more in (0, 8, 16, 24)]
            vertical = [str(size.height_px + more) for more in (0, 2, 4, 8)]
            self.run("xrandr", "--newmode", name, clock_mhz, *horizontal, *vertical)
            self._modes.add(name)
        self.run("xrandr", "--addmode", output, name)
        return name

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(10)

    def close(self) -> None:
        self._process.terminate()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class _Image(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int) for name in ("width", "height", "xoffset", "format")),
        ("data", ctypes.c_void_p),
        *((name, ctypes.c_int) for name in ("byte_order", "unit", "bit_order", "pad", "depth", "bytes_per_line")),
    )


_PASSES_OVER = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p, ctypes.c_void_p)(lambda _display, _error: 0)
"""Xlib ends the process where no handler takes an error."""


class OutputPixels:
    """Reads what the frame buffer holds for one rectangle of the screen. One thread uses it."""

    def __init__(self, display: str, place: tuple[int, int], size: Size) -> None:
        xlib = ctypes.CDLL("libX11.so.6")
        pointer = ctypes.c_void_p
        xlib.XOpenDisplay.restype, xlib.XOpenDisplay.argtypes = pointer, [ctypes.c_char_p]
        xlib.XDefaultRootWindow.restype, xlib.XDefaultRootWindow.argtypes = ctypes.c_ulong, [pointer]
        xlib.XGetImage.restype = ctypes.POINTER(_Image)
        xlib.XGetImage.argtypes = [
            *(pointer, ctypes.c_ulong, ctypes.c_int, ctypes.c_int),
            *(ctypes.c_uint, ctypes.c_uint, ctypes.c_ulong, ctypes.c_int),
        ]
        xlib.XDestroyImage.argtypes = [pointer]
        xlib.XCloseDisplay.argtypes = [pointer]
        xlib.XSetErrorHandler.argtypes = [pointer]
        xlib.XSetErrorHandler(_PASSES_OVER)
        self._xlib: Any = xlib
        self._place, self.size = place, size
        self._display = xlib.XOpenDisplay(display.encode())
        assert self._display, f"no X server at {display}"
        self._root = xlib.XDefaultRootWindow(self._display)

    def colours(self) -> NDArray[np.uint8]:
        """(H, W, 3) uint8, blue, green, red."""
        image = self._xlib.XGetImage(
            *(self._display, self._root, *self._place, self.size.width_px, self.size.height_px, 0xFFFFFF, 2)
        )
        assert image, "the X server gives no image"
        try:
            found = image.contents
            data = ctypes.string_at(found.data, found.bytes_per_line * found.height)
            rows = np.frombuffer(data, np.uint8).reshape(found.height, found.bytes_per_line)
            return rows[:, : 4 * found.width].reshape(found.height, found.width, 4)[..., :3].copy()
        finally:
            self._xlib.XDestroyImage(image)

    def grey(self) -> Pixels:
        """(H, W) uint8: the light of each pixel, green where it has a colour."""
        return self.colours()[..., 1]

    def close(self) -> None:
        display, self._display = self._display, None
        if display:
            self._xlib.XCloseDisplay(display)
