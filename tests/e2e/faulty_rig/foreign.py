"""What a driver should never do: errors that are no errors of a device, and values that no device has."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from slrig.devices import CallLimits, FoundDevice
from slrig.errors import DeviceError


class VendorError(BaseException):
    """Not even an Exception."""


class WordlessError(Exception):
    """It has no text."""

    def __str__(self) -> str:
        raise SystemExit(3)


class WordlessDeviceError(DeviceError):
    """One of slrig's tree that has no text, either."""

    def __str__(self) -> str:
        raise ValueError("no text")


class TextlessError(Exception):
    """Its text is none."""

    def __str__(self) -> str:
        return 5  # type: ignore[return-value]


RAISED: Mapping[str, Callable[[], BaseException]] = {
    "SystemExit": lambda: SystemExit("the vendor's library ended"),
    "KeyboardInterrupt": KeyboardInterrupt,
    "GeneratorExit": GeneratorExit,
    "VendorError": lambda: VendorError(5),
    "MemoryError": lambda: MemoryError("no buffers"),
    "RecursionError": lambda: RecursionError("too deep"),
    "StopIteration": lambda: StopIteration(1),
    "OSError": lambda: OSError(errno.EPROTO, "a wrong answer"),
    "odd OSError": lambda: OSError(["no number"], "a wrong answer"),
    "wordless": WordlessError,
    "textless": TextlessError,
    "wordless DeviceError": lambda: WordlessDeviceError(WordlessError()),
    "half character": lambda: RuntimeError("/dev/cam\udcff"),
    "half character of a DeviceError": lambda: DeviceError("/dev/cam\udcff is away"),
    "control characters": lambda: RuntimeError("a\x1b[2Jb\0c\u202ed\x9bm"),
    "10 MB": lambda: RuntimeError("x" * 10_000_000),
}

OTHER_CLOCK_NS = 10_000 * 10**9


def _later(frame: Any) -> Any:
    return replace(frame, t_start_ns=frame.t_start_ns + OTHER_CLOCK_NS, t_end_ns=frame.t_end_ns + OTHER_CLOCK_NS)


def _as(**others: Any) -> Callable[[Any], Any]:
    return lambda value: replace(value, **others)


RETURNED: Mapping[str, Callable[[Any], Any]] = {
    "nothing": lambda _: None,
    "a number": lambda _: 7,
    "a dict": lambda _: {"image": None},
    "a generator": lambda _: iter(()),
    # Frames
    "a cut image": lambda frame: replace(frame, image=frame.image[:-1]),
    "a huge image": lambda frame: replace(frame, image=np.zeros((3000, 4000), np.uint8)),
    "an empty image": lambda frame: replace(frame, image=frame.image[:0]),
    "wide samples": lambda frame: replace(frame, image=frame.image.astype(np.uint64)),
    "a list for an image": lambda frame: replace(frame, image=frame.image.tolist()),
    "turned memory": lambda frame: replace(frame, image=np.asfortranarray(frame.image)),
    "every second sample": lambda frame: replace(frame, image=np.repeat(frame.image, 2, axis=1)[:, ::2]),
    "NaN for a time": _as(t_start_ns=math.nan),
    "an endless time": _as(t_end_ns=math.inf),
    "2^70 ns": _as(t_end_ns=2**70),
    "an end before the start": lambda frame: replace(frame, t_end_ns=frame.t_start_ns - 1),
    "-5 ns of error": _as(t_err_ns=-5),
    "text for a time": _as(t_start_ns="now"),
    "times of another clock": _later,
    "times of 1970": lambda frame: replace(frame, t_start_ns=5, t_end_ns=6),
    "another camera's name": _as(camera="right"),
    "a name of bytes": _as(camera=b"left"),
    "-5 dropped": _as(dropped_count=-5),
    "2^40 dropped": _as(dropped_count=2**40),
    "the same number": _as(sequence_number=1),
    "NaN for an exposure": _as(exposure_s=math.nan),
    "text for an exposure": _as(exposure_s="short"),
    "an endless gain": _as(gain=math.inf),
    "colour that is none": _as(colour=lambda: None),
    # Settings
    "NaN s": _as(exposure_s=math.nan),
    "0 s": _as(exposure_s=0.0),
    "text for a gain": _as(gain="high"),
    # Light
    "another pattern": _as(index=99),
    "light in 10 000 s": lambda shown: replace(shown, t_visible_ns=shown.t_visible_ns + OTHER_CLOCK_NS),
    "NaN for the light": _as(t_visible_ns=math.nan),
    "an endless error": _as(t_err_ns=2**61),
    # What a device declares
    "no size": _as(size=None),
    "no format": _as(format=None),
    "no triggers": _as(triggers=()),
    "NaN for a range": _as(exposure_range_s=(math.nan, 1.0)),
    "NaN for a delay": _as(latency_s=math.nan),
    "endless limits": _as(limits=CallLimits(math.inf, math.nan)),
    "a serial of a number": _as(serial=5),
    "half a character": _as(model="\udcff"),
    # Turntables
    "NaN for an angle": lambda _: [math.nan],
    "endless angles": lambda _: [math.inf, 1e308],
    # Finders
    "devices of text": lambda _: ["usb-1"],
    "devices without words": lambda _: [FoundDevice("faulty", 5, None)],  # type: ignore[arg-type]
    "half characters": lambda _: [FoundDevice("faulty", "usb\udcff", "a\x1b[2Jb")],
}
