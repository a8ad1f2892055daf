"""The reflected binary (Gray) code: words of cells, and cells of words or of the bits that a pixel saw.

The code word of cell i is g = i ^ (i >> 1) (F. Gray, US patent 2 632 058, 1953). Neighbouring cells differ in exactly
one bit, so a pixel that sees the edge between two cells can be wrong by one cell at most.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Integers = NDArray[np.integer[Any]]


def to_gray(index: ArrayLike) -> Integers:
    """Code word g = i ^ (i >> 1) of each cell index; integers of any shape.

    >>> [format(word, "03b") for word in to_gray([0, 1, 2, 3, 4, 5])]
    ['000', '001', '011', '010', '110', '111']
    """
    cells = np.asarray(index)
    return np.asarray(cells ^ (cells >> 1))


def from_gray(word: ArrayLike) -> Integers:
    """Cell index of each code word, the inverse of `to_gray`: bit s of i is the parity of g's bits from s upwards.

    >>> from_gray([0, 1, 3, 2, 6, 7])
    array([0, 1, 2, 3, 4, 5])
    """
    cells = np.array(word)
    # Prefix exclusive-or by doubling: after shifts of 1, 2, 4 … every bit has met all bits above it.
    shift = 1
    while shift < 8 * cells.itemsize:
        cells ^= cells >> shift
        shift *= 2
    return cells


def gray_index(lit: NDArray[np.bool_]) -> Integers:
    """Cell index from the bits seen, the inverse of playing a code: lit (bits, …) bool, most significant bit first.

    >>> gray_index(np.array([[False, True], [True, True], [False, True]]))
    array([3, 5])
    """
    weights = 2 ** np.arange(len(lit) - 1, -1, -1, dtype=np.int64)
    return from_gray(np.tensordot(weights, lit.astype(np.int64), axes=1))
