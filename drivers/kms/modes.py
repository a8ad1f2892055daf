"""Video modes of a display, and the one by which every pixel of a projector is one of the picture."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.kms.kernel import MODE_DOUBLE_CLOCK, MODE_DOUBLE_SCAN, MODE_INTERLACED, MODE_PREFERRED, ModeInfo
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

_CLOSE_HZ = 0.5
_SHOWN = 12


@dataclass(frozen=True, slots=True)
class Mode:
    """A video mode. content : as the kernel has it. plain : row after row, each once, each pixel once."""

    size: Size
    refresh_s: float
    plain: bool
    preferred: bool
    content: bytes

    @classmethod
    def of(cls, info: ModeInfo) -> Mode:
        """What the kernel tells."""
        lines = info.vtotal * (2 if info.flags & MODE_DOUBLE_SCAN else 1) * max(info.vscan, 1)
        pixels = info.htotal * lines / (2 if info.flags & MODE_INTERLACED else 1)
        return cls(
            Size(max(info.hdisplay, 1), max(info.vdisplay, 1)),
            pixels / (info.clock * 1000) if info.clock and pixels else 0.0,
            not info.flags & (MODE_INTERLACED | MODE_DOUBLE_SCAN | MODE_DOUBLE_CLOCK),
            bool(info.type & MODE_PREFERRED),
            bytes(info),
        )

    @property
    def info(self) -> ModeInfo:
        """As the kernel has it."""
        return ModeInfo.from_buffer_copy(self.content.ljust(ctypes.sizeof(ModeInfo), b"\0"))

    def __str__(self) -> str:
        rate = f" at {1 / self.refresh_s:.2f} Hz" if self.refresh_s else ""
        return f"{self.size}{rate}{'' if self.plain else ', interlaced or doubled'}"


def chosen_mode(output: str, modes: Sequence[Mode], *, native: Size | None, refresh_hz: float | None) -> Mode:
    """Return the mode of the projector's own raster.

    Parameters
    ----------
    modes
        In the kernel's order: the best of each size comes first.
    native, refresh_hz
        As in `KmsOptions`.

    Raises
    ------
    UnsupportedByDeviceError
        There is none, or nobody tells which it is.
    """
    there = ", ".join(dict.fromkeys(map(str, modes[:_SHOWN]))) or "none"
    size = native or next((mode.size for mode in modes if mode.preferred), None)
    if size is None:
        message = (
            f"output {output}: no EDID tells the projector's own raster; its modes are: {there}; write native_px = "
            "[width, height] from the data sheet into the rig file"
        )
        raise UnsupportedByDeviceError(message)
    fitting = [mode for mode in modes if mode.size == size and mode.plain and mode.refresh_s]
    if refresh_hz is not None:
        fitting = [mode for mode in fitting if abs(1 / mode.refresh_s - refresh_hz) <= _CLOSE_HZ]
    if not fitting:
        rate = "" if refresh_hz is None else f" at {refresh_hz:g} Hz"
        message = (
            f"output {output}: asked for {size}{rate}, row by row; its modes are: {there}; correct native_px or "
            "refresh_hz in the rig file, or check cable and adapter, which may not carry that mode"
        )
        raise UnsupportedByDeviceError(message)
    # Of equals, what the display itself prefers.
    return next((mode for mode in fitting if mode.preferred), fitting[0])
