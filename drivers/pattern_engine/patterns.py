"""Patterns as planes of mirrors: each mirror sends light or does not."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.errors import UnsupportedByDeviceError
from slrig.model import Black, Gray, LineShift, Pattern, PatternSequence, Primary, White

MAX_UNATTENDED_S = 2.0
"""So long after its host has died a shown pattern is dark."""


Plane = NDArray[np.bool_]
"""(H, W) bool: which mirrors send light."""


@dataclass(frozen=True, slots=True)
class Timing:
    """How long each pattern is lit, and from one pattern to the next, whole microseconds."""

    exposure_us: int
    period_us: int

    @property
    def dark_between(self) -> bool:
        """Whether the mirrors are cleared after each pattern."""
        return self.exposure_us < self.period_us


def light_duration_us(exposure_s: float, period_s: float, *, margin_s: float, least_us: int, dark_us: int = 0) -> int:
    """How long to light patterns of which cameras take `exposure_s`, whole microseconds.

    Parameters
    ----------
    margin_s
        Light beyond the exposure: it covers what a camera takes from the pulse to its first row.
    least_us
        The engine's shortest light.
    dark_us
        What the engine needs of dark between two patterns.

    Raises
    ------
    UnsupportedByDeviceError
        It does not fit into the period.
    """
    period_us = round(period_s * 1e6)
    wanted_us = max(round((exposure_s + margin_s) * 1e6), least_us)
    if exposure_s <= 0 or wanted_us + dark_us > period_us:
        dark = f" and the dark after it {dark_us} µs" if dark_us else ""
        message = (
            f"asked for {exposure_s:.6f} s of light every {period_s:.6f} s: with {margin_s:.6f} s for the cameras to "
            f"start, light takes {wanted_us} µs{dark}, the period is {period_us} µs; lengthen the period"
        )
        raise UnsupportedByDeviceError(message)
    return wanted_us


def check_duty(timing: Timing, duty_limit: float) -> None:
    """Raise UnsupportedByDeviceError if light would be on for more of the time than the rig file allows."""
    duty = timing.exposure_us / timing.period_us
    if duty > duty_limit:
        message = (
            f"asked for {timing.exposure_us} µs of light every {timing.period_us} µs: light is on for {duty:.0%} of "
            f"the time, duty_limit of the rig file allows {duty_limit:.0%}; lengthen the period, or shorten exposure_s"
        )
        raise UnsupportedByDeviceError(message)


def pattern_plane(sequence: PatternSequence, index: int) -> Plane:
    """Return the mirrors of pattern `index`. Raises UnsupportedByDeviceError unless it is black and white only."""
    profile = sequence.profiles[index]
    lit: NDArray[np.bool_] = profile == np.iinfo(profile.dtype).max
    if not (lit | (profile == 0)).all():
        message = (
            f"asked for pattern {index} with shades of grey; a mirror is on or off: use Gray code and shifted lines, "
            "which are black and white"
        )
        raise UnsupportedByDeviceError(message)
    return np.broadcast_to(lit, sequence.projector.shape)


def plane_keys(plane: Plane) -> tuple[bytes, bytes]:
    """Return what tells a plane and its inverse from all others: SHA-256 of their bits."""
    bits = np.packbits(plane)
    return hashlib.sha256(bits.tobytes()).digest(), hashlib.sha256((~bits).tobytes()).digest()


def describe_pattern(pattern: Pattern) -> str:
    """Words for a pattern."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Primary():
            return pattern.words
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            return f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}, cell {pattern.cell_px} px{inverse}"
        case LineShift():
            width = f", {pattern.line_width_px} px wide" if pattern.line_width_px > 1 else ""
            return f"{pattern.axis} lines {pattern.shift} of {pattern.period_px}{width}"
