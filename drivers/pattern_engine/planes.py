"""Patterns as planes of mirrors: each mirror sends light or does not."""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from slrig.errors import UnsupportedByDeviceError
from slrig.model import Black, Gray, LineShift, Pattern, PatternSequence, Primary, White

Plane = NDArray[np.bool_]
"""(H, W) bool: which mirrors send light."""


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
