"""Pixel format, size and frame rate: asked for, and read back."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

from drivers.v4l2 import kernel
from drivers.v4l2.formats import LAYOUTS, PREFERRED, Layout
from drivers.v4l2.options import V4L2Options
from slrig.errors import UnsupportedByDeviceError
from slrig.model import Size

LEAST_RATE_HZ = 15.0
"""Frames per second below which scanning is slow: every pattern waits for a frame or two."""

_RATE_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class Agreed:
    """What driver and person agreed on. `period_ns`: from frame to frame. `notes`: what a person should know of it."""

    layout: Layout
    size: Size
    stride_bytes: int
    period_ns: int
    notes: tuple[str, ...] = ()


def agree(handle: int, node: Path, options: V4L2Options) -> Agreed:
    """Set pixel format, size and frame rate as the options ask, and compare what the driver gives.

    Raises
    ------
    UnsupportedByDeviceError
        The driver gives something else: "asked MJPG 640 x 360, driver gives YUYV 640 x 360".
    DeviceBusyError
        Another program streams from the device.
    DeviceError
        The device failed.
    """
    try:
        offered = _offered_formats(handle)
        code, size = _chosen(handle, node, options, offered)
        answer = kernel.Format(type=kernel.CAPTURE)
        if size is None:
            kernel.ask(handle, kernel.G_FMT, answer)
            size = Size(answer.fmt.pix.width, answer.fmt.pix.height)
        pix = answer.fmt.pix
        pix.width, pix.height = size.width_px, size.height_px
        pix.pixelformat, pix.field = kernel.code_of(code), kernel.FIELD_NONE
        # The driver fills in the rest; what was there belonged to another format.
        pix.bytesperline = pix.sizeimage = 0
        try:
            kernel.ask(handle, kernel.S_FMT, answer)
        except OSError as error:
            raise kernel.fault(node, f"asking for {code.strip()} {size}", error) from error
        _require_format(handle, node, code, size, pix)
        period_ns = _period_ns(handle, node, options, _rates_hz(handle, code, size))
    except OSError as error:
        raise kernel.fault(node, "setting format and frame rate", error) from error
    layout = _layout(code, options, node)
    notes: tuple[str, ...] = ()
    if options.frame_rate_hz is None and not _reaches(1e9 / period_ns, LEAST_RATE_HZ):
        notes = (
            f"gives {1e9 / period_ns:.3g} frames per second in {code.strip()} {size}, which makes scans slow: choose a "
            f"smaller size_px or another pixel_format (v4l2-ctl -d {node} --list-formats-ext lists what is faster)",
        )
    return Agreed(layout, size, int(pix.bytesperline), period_ns, notes)


def _chosen(handle: int, node: Path, options: V4L2Options, offered: tuple[str, ...]) -> tuple[str, Size | None]:
    """Pixel format and size: as asked for, else the first that is preferred of those that are fast enough.

    A format is passed over for the next one if it is fast with less than half of its pixels only.
    """
    codes = tuple(code for code in PREFERRED if code in offered)
    if options.pixel_format is not None:
        codes = (options.pixel_format.ljust(4),)
    if not codes:
        message = (
            f"{node}: offers the pixel formats {_list(offered)}, none of which can be read; "
            f"those that can: {_list(tuple(LAYOUTS))}"
        )
        raise UnsupportedByDeviceError(message)
    wanted_hz = options.frame_rate_hz or LEAST_RATE_HZ
    found: list[tuple[str, Size]] = []
    for code in codes:
        sizes = (options.size,) if options.size is not None else _sizes(handle, code)
        if not sizes:
            break
        fast = [size for size in sizes if _is_fast(handle, code, size, wanted_hz)]
        if fast:
            found.append((code, max(fast, key=_pixels)))
            if 2 * _pixels(found[-1][1]) >= max(map(_pixels, sizes)):
                return found[-1]
    if found:
        return max(found, key=lambda each: _pixels(each[1]))
    return codes[0], options.size or max(_sizes(handle, codes[0]), key=_pixels, default=None)


def _pixels(size: Size) -> int:
    return size.width_px * size.height_px


def _is_fast(handle: int, code: str, size: Size, wanted_hz: float) -> bool:
    """Whether a size comes at this rate, or the driver does not tell."""
    rates_hz = _rates_hz(handle, code, size)
    return not rates_hz or _reaches(max(rates_hz), wanted_hz)


def _reaches(rate_hz: float, wanted_hz: float) -> bool:
    return rate_hz >= wanted_hz * (1 - _RATE_TOLERANCE)


def _layout(code: str, options: V4L2Options, node: Path) -> Layout:
    layout = LAYOUTS[code]
    if options.bit_depth is None or options.bit_depth == layout.bit_depth:
        return layout
    if layout.bit_depth != 16:
        message = (
            f"{node}: asked bit_depth {options.bit_depth}, but {code.strip()} has {layout.bit_depth} bits; leave "
            "bit_depth out, it is for 16-bit formats that the sensor does not fill"
        )
        raise UnsupportedByDeviceError(message)
    return Layout(options.bit_depth, layout.packing, layout.bayer)


def _require_format(handle: int, node: Path, code: str, size: Size, pix: kernel.PixelFormat) -> None:
    got = kernel.text_of(pix.pixelformat)
    if (got, pix.width, pix.height) != (code, size.width_px, size.height_px):
        sizes = ", ".join(str(have) for have in _sizes(handle, code)) or "no size that it tells"
        message = (
            f"{node}: asked {code.strip()} {size}, driver gives {got.strip()} {pix.width} x {pix.height}; it offers "
            f"{_list(_offered_formats(handle))}, and {code.strip()} in {sizes}: write one of these as pixel_format and "
            "size_px"
        )
        raise UnsupportedByDeviceError(message)
    if pix.field not in (kernel.FIELD_ANY, kernel.FIELD_NONE):
        message = (
            f"{node}: asked whole frames, driver gives interlaced ones (field {pix.field}): two instants in one image; "
            "choose a progressive size_px, or another camera"
        )
        raise UnsupportedByDeviceError(message)


def _offered_formats(handle: int) -> tuple[str, ...]:
    found: list[str] = []
    while True:
        answer = kernel.FormatDescription(index=len(found), type=kernel.CAPTURE)
        try:
            kernel.ask(handle, kernel.ENUM_FMT, answer)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return tuple(found)
            raise
        found.append(kernel.text_of(answer.pixelformat))


def _sizes(handle: int, code: str) -> tuple[Size, ...]:
    """The sizes of a format; of a range, its largest. Empty where the driver does not tell."""
    found: list[Size] = []
    while True:
        answer = kernel.FrameSize(index=len(found), pixel_format=kernel.code_of(code))
        try:
            kernel.ask(handle, kernel.ENUM_FRAMESIZES, answer)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return tuple(found)
            raise
        if answer.type != kernel.SIZES_DISCRETE:
            return (Size(answer.size.stepwise.max_width, answer.size.stepwise.max_height),)
        found.append(Size(answer.size.discrete.width, answer.size.discrete.height))


def _rates_hz(handle: int, code: str, size: Size) -> tuple[float, ...]:
    """The frame rates of a format and size; of a range, its fastest. Empty where the driver does not tell."""
    found: list[float] = []
    while True:
        answer = kernel.FrameInterval(
            index=len(found), pixel_format=kernel.code_of(code), width=size.width_px, height=size.height_px
        )
        try:
            kernel.ask(handle, kernel.ENUM_FRAMEINTERVALS, answer)
        except OSError as error:
            if error.errno in kernel.REFUSED:
                return tuple(found)
            raise
        is_discrete = answer.type == kernel.SIZES_DISCRETE
        period = answer.interval.discrete if is_discrete else answer.interval.stepwise.min
        found.append(float("inf") if not period.numerator else period.denominator / period.numerator)
        if not is_discrete:
            return tuple(found)


def _period_ns(handle: int, node: Path, options: V4L2Options, offered_hz: tuple[float, ...]) -> int:
    asked = options.frame_rate_hz
    rate_hz = _rate_hz(handle) if asked is None else _set_rate_hz(handle, asked)
    if asked is None and rate_hz is not None and not _reaches(rate_hz, LEAST_RATE_HZ):
        # As slow as is fast enough: exposures may be as long as a frame.
        fast_hz = [each for each in offered_hz if _reaches(each, LEAST_RATE_HZ) and each != float("inf")]
        rate_hz = _set_rate_hz(handle, min(fast_hz)) if fast_hz else rate_hz
    if rate_hz is None:
        if asked is None:
            message = (
                f"{node}: the driver does not tell its frame rate, which bounds when a frame was exposed; write "
                "frame_rate_hz into the camera's table"
            )
            raise UnsupportedByDeviceError(message)
        return round(1e9 / asked)
    if asked is not None and abs(rate_hz - asked) > _RATE_TOLERANCE * asked:
        message = (
            f"{node}: asked {asked:g} frames per second, driver gives {rate_hz:.6g}; write frame_rate_hz = "
            f"{rate_hz:.6g}, or choose another size_px or pixel_format (v4l2-ctl -d {node} --list-formats-ext)"
        )
        raise UnsupportedByDeviceError(message)
    return round(1e9 / rate_hz)


def _set_rate_hz(handle: int, asked_hz: float) -> float | None:
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    period = Fraction(1 / asked_hz).limit_denominator(1_000_000)
    answer.parm.capture.timeperframe = kernel.Fraction(period.numerator, period.denominator)
    _ask_if_known(handle, kernel.S_PARM, answer)
    return _rate_hz(handle)


def _rate_hz(handle: int) -> float | None:
    """The frame rate in use; None where the driver does not tell."""
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    _ask_if_known(handle, kernel.G_PARM, answer)
    told = answer.parm.capture.timeperframe
    return float(told.denominator / told.numerator) if told.numerator and told.denominator else None


def _ask_if_known(handle: int, request: int, answer: kernel.StreamParameters) -> None:
    try:
        kernel.ask(handle, request, answer)
    except OSError as error:
        if error.errno not in kernel.REFUSED:
            raise


def _list(codes: tuple[str, ...]) -> str:
    return ", ".join(code.strip() for code in codes) or "none"
