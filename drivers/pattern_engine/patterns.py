"""Patterns of a pattern engine: as planes of mirrors that send light or not, and the timing of their light."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.errors import UnsupportedByDeviceError
from slrig.model import Black, Gray, LineShift, Pattern, PatternSequence, Primary, White

MAX_UNATTENDED_S = 2.0
"""Time after the death of its host in which a shown pattern becomes dark."""


Plane = NDArray[np.bool_]
"""(H, W) bool: mirrors that send light."""


@dataclass(frozen=True, slots=True)
class Timing:
    """Duration of each pattern's light and period of the patterns, whole microseconds."""

    exposure_us: int
    period_us: int

    @property
    def dark_between(self) -> bool:
        """True if the mirrors are cleared after each pattern."""
        return self.exposure_us < self.period_us


def light_duration_us(exposure_s: float, period_s: float, *, margin_s: float, least_us: int, dark_us: int = 0) -> int:
    """Duration of the light for an exposure of `exposure_s`, whole microseconds.

    margin_s : light beyond the exposure, for the camera's delay from the pulse to its first row. least_us : the
    engine's shortest light. dark_us : dark time that the engine needs between two patterns. Raises
    UnsupportedByDeviceError if it does not fit into the period.
    """
    period_us = round(period_s * 1e6)
    wanted_us = max(round((exposure_s + margin_s) * 1e6), least_us)
    if exposure_s <= 0 or wanted_us + dark_us > period_us:
        dark = f" and the dark after it {dark_us} µs" if dark_us else ""
        message = (
            f"requested {exposure_s:.6f} s of light every {period_s:.6f} s: with {margin_s:.6f} s for the cameras to "
            f"start, light takes {wanted_us} µs{dark}, the period is {period_us} µs; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)
    return wanted_us


def check_duty(timing: Timing, duty_limit: float) -> None:
    """Raise UnsupportedByDeviceError if the light exceeds the duty limit of the rig file."""
    duty = timing.exposure_us / timing.period_us
    if duty > duty_limit:
        message = (
            f"requested {timing.exposure_us} µs of light every {timing.period_us} µs: light is on for {duty:.0%} of "
            f"the time, duty_limit of the rig file allows {duty_limit:.0%}; lengthen the period, or shorten exposure_s"
        )
        raise UnsupportedByDeviceError(message)


def pattern_plane(sequence: PatternSequence, index: int) -> Plane:
    """Return the mirrors of pattern `index`. Raises UnsupportedByDeviceError unless it is black and white only."""
    profile = sequence.profiles[index]
    lit: NDArray[np.bool_] = profile == np.iinfo(profile.dtype).max
    if not (lit | (profile == 0)).all():
        message = (
            f"pattern {index} has shades of grey; a mirror is on or off: use Gray code and shifted lines, "
            "which are black and white"
        )
        raise UnsupportedByDeviceError(message)
    return np.broadcast_to(lit, sequence.projector.shape)


def plane_keys(plane: Plane) -> tuple[bytes, bytes]:
    """Return keys of a plane and of its inverse: SHA-256 of their bits."""
    bits = np.packbits(plane)
    return hashlib.sha256(bits.tobytes()).digest(), hashlib.sha256((~bits).tobytes()).digest()


def describe_pattern(pattern: Pattern) -> str:
    """Return a short description of a pattern."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Primary():
            return pattern.description
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            return f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}, cell {pattern.cell_px} px{inverse}"
        case LineShift():
            width = f", {pattern.line_width_px} px wide" if pattern.line_width_px > 1 else ""
            return f"{pattern.axis} lines {pattern.shift} of {pattern.period_px}{width}"
