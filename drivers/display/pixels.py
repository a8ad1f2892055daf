"""Grey levels as a display's pixels, and how two pictures differ."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.errors import UnsupportedByDeviceError
from slrig.model import Pattern, Pixels, Primary

_LIGHTS = {"red": 0x010000, "green": 0x000100, "blue": 0x000001}


def coloured(levels: Pixels, pattern: Pattern | None = None) -> NDArray[np.uint32]:
    """Grey levels as pixels: (H, W) uint8 to (H, W) uint32, 0x00RRGGBB; in its light, of a `Primary`.

    >>> [hex(word) for word in coloured(np.array([[0, 255, 7]], np.uint8))[0]]
    ['0x0', '0xffffff', '0x70707']
    """
    light = _LIGHTS[pattern.colour] if isinstance(pattern, Primary) else 0x010101
    return np.asarray(levels.astype("<u4") * np.uint32(light))


def require_same(output: str, wanted: NDArray[np.uint32], found: NDArray[np.uint32], remedy: str) -> None:
    """See that a frame buffer holds what it was given, both (H, W) as of `coloured`.

    Raises
    ------
    UnsupportedByDeviceError
        It does not. Tells how many pixels differ, and where.
    """
    wrong = np.argwhere(found != wanted)
    if len(wrong):
        row, column = (int(place) for place in wrong[0])
        message = (
            f"output {output}: {len(wrong)} of {wanted.size} pixels are not the pattern's: at (row {row}, column "
            f"{column}) #{int(wanted[row, column]):06x} was shown, the frame buffer has "
            f"#{int(found[row, column]):06x}; {remedy}"
        )
        raise UnsupportedByDeviceError(message)
