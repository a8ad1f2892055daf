"""Checks of values that drivers return. A driver is third-party code: each function raises TypeError or ValueError for
values that no device has, which are a defect of the driver, and returns the value with its text safe to print.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from slrig.devices.camera import AppliedSettings, CallLimits, CameraInfo, Trigger
from slrig.devices.projector import DisplayedPattern, ProjectorInfo
from slrig.devices.rig import FoundDevice
from slrig.model import CameraFormat, Frame, Pixels, Size
from slrig.printable import foreign_text

MAX_AHEAD_S = 10.0
"""Largest time ahead of the rig's clock. A display lights its picture some refreshes after the request, and a camera's
own clock is read with some error; more is the time of another clock."""

_MAX_COUNT = 2**31
_MAX_NS = 2**62

_Value = TypeVar("_Value")
_Described = TypeVar("_Described", CameraInfo, ProjectorInfo, FoundDevice)


def require_kind(value: object, kind: type[_Value]) -> _Value:
    """Return a value of a kind."""
    if not isinstance(value, kind):
        message = f"it returned {foreign_text(repr(value))[:80]}, a {kind.__name__} is expected"
        raise TypeError(message)
    return value


def require_texts(values: Iterable[object]) -> tuple[str, ...]:
    """Return texts that are safe to print."""
    return tuple(foreign_text(require_kind(each, str)) for each in values)


def require_number(value: Any, what: str, *, least: float = -math.inf, most: float = math.inf) -> float:
    """Return a number that is finite and within a range."""
    is_number = isinstance(value, int | float | np.integer | np.floating)
    if not is_number or not math.isfinite(value) or not least <= value <= most:
        message = f"it returned {what} of {foreign_text(repr(value))[:80]}, which no device has"
        raise ValueError(message)
    return float(value)


def require_camera_info(value: object) -> CameraInfo:
    """Return a camera's declared data."""
    info = require_kind(value, CameraInfo)
    require_kind(info.format, CameraFormat)
    _require_size(info.format.size)
    triggers = [require_kind(each, Trigger) for each in info.triggers]
    if not triggers:
        raise ValueError("it returned a camera without any trigger")
    for name, each in (("an exposure", info.exposure_range_s), ("a gain", info.gain_range)):
        low, high = each
        require_number(high, name, least=require_number(low, name))
    require_number(info.exposure_range_s[0], "an exposure", least=0.0)
    _require_limits(info.limits)
    return _printable(replace(info, notes=require_texts(info.notes)))


def require_projector_info(value: object) -> ProjectorInfo:
    """Return a projector's declared data."""
    info = require_kind(value, ProjectorInfo)
    _require_size(info.size)
    require_number(info.latency_s, "a latency", least=0.0)
    require_number(info.gap_s, "a gap", least=0.0)
    require_number(info.duty, "a duty", least=1e-6, most=1.0)
    if info.refresh_s is not None:
        require_number(info.refresh_s, "a refresh period", least=1e-6)
    _require_limits(info.limits)
    return _printable(info)


def require_applied(value: object) -> AppliedSettings:
    """Return settings that a camera read back."""
    applied = require_kind(value, AppliedSettings)
    require_number(applied.exposure_s, "an exposure", least=1e-9)
    require_number(applied.gain, "a gain")
    if applied.min_period_s is not None:
        require_number(applied.min_period_s, "a period", least=0.0)
    return applied


def require_frame(value: object, camera: str, now_ns: int) -> Frame:
    """Return a frame. camera : the name that its camera declares. now_ns : by the rig's clock, after it was read."""
    frame = require_kind(value, Frame)
    if frame.camera != camera:
        message = f"camera '{camera}' returned a frame of camera '{foreign_text(frame.camera)[:80]}'"
        raise ValueError(message)
    if frame.image.size == 0 or frame.image.dtype not in (np.uint8, np.uint16):
        message = f"it returned an image {frame.image.shape} {frame.image.dtype}; 8 or 16 bits are expected"
        raise ValueError(message)
    times: tuple[object, ...] = (frame.t_start_ns, frame.t_end_ns, frame.t_err_ns)
    whole = all(_is_whole(each, _MAX_NS) for each in (*times, frame.sequence_number))
    counts = whole and _is_whole(frame.dropped_count, _MAX_COUNT) and frame.dropped_count >= 0
    if not counts or frame.t_end_ns < frame.t_start_ns or frame.t_err_ns < 0:
        raise ValueError(f"it returned a frame {_described(frame)}, which no exposure has")
    if frame.t_end_ns - frame.t_err_ns > now_ns + MAX_AHEAD_S * 1e9:
        raise ValueError(
            f"it returned a frame {_described(frame)}, when the rig's clock was at {now_ns} ns: those are times of "
            "another clock"
        )
    require_number(frame.exposure_s, "an exposure", least=0.0)
    require_number(frame.gain, "a gain")
    require_number(frame.shutter_skew_s, "a shutter skew", least=0.0)
    if not (frame.colour is None or callable(frame.colour)):
        raise TypeError("it returned a frame whose colour cannot be called")
    return frame


def require_colour(value: object, frame: Frame) -> Pixels:
    """Return the colour of a frame."""
    colour = require_kind(value, np.ndarray)
    if colour.shape != (*frame.image.shape, 3) or colour.dtype != frame.image.dtype:
        message = (
            f"it returned colours {colour.shape} {colour.dtype} of a frame {frame.image.shape} {frame.image.dtype}"
        )
        raise ValueError(message)
    return colour


def require_displayed(value: object, index: int, now_ns: int) -> DisplayedPattern:
    """Return when a pattern is lit. index : of the pattern. now_ns : by the rig's clock, after the request."""
    shown = require_kind(value, DisplayedPattern)
    whole = _is_whole(shown.t_visible_ns, _MAX_NS) and _is_whole(shown.t_err_ns, _MAX_NS)
    if not whole or shown.index != index or shown.t_err_ns < 0:
        raise ValueError(f"requested pattern {index}, it returned {foreign_text(repr(shown))[:200]}")
    if shown.t_visible_ns + shown.t_err_ns > now_ns + MAX_AHEAD_S * 1e9:
        raise ValueError(
            f"pattern {index} is to be lit {(shown.t_visible_ns + shown.t_err_ns - now_ns) / 1e9:.6g} s after the "
            "answer: those are times of another clock"
        )
    return shown


def require_found(value: object) -> FoundDevice:
    """Return a device that was found."""
    found = _printable(require_kind(value, FoundDevice))
    for name, option in require_kind(found.options, dict).items():
        require_kind(name, str)
        require_kind(option, str) if isinstance(option, str) else require_number(option, f"the option {name}")
    return found


def _is_whole(value: object, limit: int) -> bool:
    return isinstance(value, int | np.integer) and abs(int(value)) < limit


def _described(frame: Frame) -> str:
    numbers = (frame.t_start_ns, frame.t_end_ns, frame.t_err_ns, frame.sequence_number, frame.dropped_count)
    start, end, error, number, dropped = (foreign_text(repr(each))[:40] for each in numbers)
    return f"from {start} to {end} ns ± {error}, number {number}, {dropped} lost before"


def _require_size(size: object) -> None:
    found = require_kind(size, Size)
    for each in (found.width_px, found.height_px):
        if not _is_whole(each, _MAX_COUNT) or each < 1:
            raise ValueError(f"it returned a size of {foreign_text(found)}, which no device has")


def _require_limits(limits: object) -> None:
    found = require_kind(limits, CallLimits)
    require_number(found.call_s, "a time limit", least=0.0)
    require_number(found.read_slack_s, "a time limit", least=0.0)


def _printable(value: _Described) -> _Described:
    """The same, with its texts safe to print."""
    names = [each.name for each in fields(value) if each.type == "str"]
    texts: dict[str, Any] = {each: foreign_text(require_kind(getattr(value, each), str)) for each in names}
    return replace(value, **texts)
