"""Array types, and the check of their shape that every value makes on construction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.unsignedinteger[Any]]
"""A raw image: (H, W) uint8 or uint16."""

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]


def require(array: NDArray[Any], name: str, shape: tuple[int | None, ...], kind: str) -> None:
    """Raise ValueError unless an array has this shape (None: any length) and one of these dtype kinds."""
    fits = array.ndim == len(shape) and all(
        want is None or got == want for got, want in zip(array.shape, shape, strict=True)
    )
    if not fits or array.dtype.kind not in kind:
        wanted = ", ".join("n" if want is None else str(want) for want in shape)
        raise ValueError(f"{name}: expected an array ({wanted}) of kind '{kind}', found {array.shape} {array.dtype}")
