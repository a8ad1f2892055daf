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

_RATE_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True)
class Agreed:
    """What driver and person agreed on. `period_ns`: from frame to frame."""

    layout: Layout
    size: Size
    stride_bytes: int
    period_ns: int


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
        code = _chosen(node, options, offered)
        size = options.size or _largest(handle, code)
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
        period_ns = _period_ns(handle, node, options)
    except OSError as error:
        raise kernel.fault(node, "setting format and frame rate", error) from error
    layout = _layout(code, options, node)
    return Agreed(layout, size, int(pix.bytesperline), period_ns)


def _chosen(node: Path, options: V4L2Options, offered: tuple[str, ...]) -> str:
    if options.pixel_format is not None:
        return options.pixel_format.ljust(4)
    for code in PREFERRED:
        if code in offered:
            return code
    message = (
        f"{node}: offers the pixel formats {_list(offered)}, none of which can be read; "
        f"those that can: {_list(tuple(LAYOUTS))}"
    )
    raise UnsupportedByDeviceError(message)


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


def _largest(handle: int, code: str) -> Size | None:
    return max(_sizes(handle, code), key=lambda size: size.width_px * size.height_px, default=None)


def _period_ns(handle: int, node: Path, options: V4L2Options) -> int:
    asked = options.frame_rate_hz
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    if asked is not None:
        period = Fraction(1 / asked).limit_denominator(1_000_000)
        answer.parm.capture.timeperframe = kernel.Fraction(period.numerator, period.denominator)
        _ask_if_known(handle, kernel.S_PARM, answer)
    answer = kernel.StreamParameters(type=kernel.CAPTURE)
    _ask_if_known(handle, kernel.G_PARM, answer)
    told = answer.parm.capture.timeperframe
    if not told.numerator or not told.denominator:
        if asked is None:
            message = (
                f"{node}: the driver does not tell its frame rate, which bounds when a frame was exposed; write "
                "frame_rate_hz into the camera's table"
            )
            raise UnsupportedByDeviceError(message)
        return round(1e9 / asked)
    rate_hz = float(told.denominator / told.numerator)
    if asked is not None and abs(rate_hz - asked) > _RATE_TOLERANCE * asked:
        message = (
            f"{node}: asked {asked:g} frames per second, driver gives {rate_hz:.6g}; write frame_rate_hz = "
            f"{rate_hz:.6g}, or choose another size_px or pixel_format (v4l2-ctl -d {node} --list-formats-ext)"
        )
        raise UnsupportedByDeviceError(message)
    return round(1e9 / rate_hz)


def _ask_if_known(handle: int, request: int, answer: kernel.StreamParameters) -> None:
    try:
        kernel.ask(handle, request, answer)
    except OSError as error:
        if error.errno not in kernel.REFUSED:
            raise


def _list(codes: tuple[str, ...]) -> str:
    return ", ".join(code.strip() for code in codes) or "none"
