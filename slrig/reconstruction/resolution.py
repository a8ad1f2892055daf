"""Which of the finest code bits a camera resolves, and whether it resolves lines, block by block of its image.

Every cell of the bits above is halved by the next finer one: on the way across it that bit changes once, in the
direction that the code tells. Where the camera does not resolve the bit, it changes at random, or a cell passes within
one pixel. So the frames tell by themselves where a bit counts, whatever took it: blur, a projector finer than the
camera, a scaler, noise. Of lines the code tells how many there are to be found.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames

BLOCK_PX = 32
"""Across such a block of a usual surface the density of the code changes little, and a bit has hundreds of chances."""
_FEWEST_CHANCES = 48
"""Fewer tell nothing: the bit then counts as the pixels show it."""
_LEAST_RIGHT = 0.7
"""Of a cell's passages. Bits at random get a passage of two to four pixels right one time in four or five."""
_LEAST_PASSAGE_PX = 2.0
"""Of both halves of a cell: each pixel then sees one edge of the code at most."""
_MOST_BITS = 3
"""Where more would have to go the code itself is not seen."""
_LEAST_FOUND = 0.5
"""Of the lines' points. Resolved blocks of rendered plates have 0.9 to 1.0, those where lines blur into one another
0.02 to 0.15, and where the one passes into the other 0.6."""
_FEWEST_LINES = 200
"""Points to be found in a block and its neighbours; fewer tell nothing."""
_BLOCKS_AT_ONCE = 4  # rows of blocks, of which a band holds some numbers for every pixel
_WIDEST_STEP = 2.0  # cells from pixel to pixel; more is a step of depth


def unresolved_bits(frames: AxisFrames, lit: NDArray[np.bool_], /) -> NDArray[np.uint8]:
    """(H, W) uint8: how many of the finest bits the camera does not resolve there.

    lit : (H, W) bool, pixels that the projector lights. Where more than 3 would have to be left out the code itself is
    not seen, as in light from elsewhere, and 0 stands.
    """
    lit = lit & (frames.white < frames.clipped_at)
    bits = len(frames.bits)
    against = frames.inverses if frames.inverses is not None else [frames.middle] * bits
    word = np.zeros(lit.shape, dtype=np.int32)
    for shown, other in zip(frames.bits, against, strict=True):
        word <<= 1
        word |= shown > other
    blocks = tuple(-(-extent // BLOCK_PX) for extent in lit.shape)
    unresolved = np.zeros(blocks, dtype=np.uint8)
    # Columns of a transposed copy lie behind one another in memory.
    both_ways = (word, lit), (np.ascontiguousarray(word.T), np.ascontiguousarray(lit.T))
    for finest in range(min(_MOST_BITS + 1, bits - 1)):
        along, down = (_tally(*each, finest) for each in both_ways)
        chances, pixels, several, right = (_with_neighbours(each) for each in along + down.swapaxes(1, 2))
        blind = (right < _LEAST_RIGHT * several) | (pixels < _LEAST_PASSAGE_PX * chances)
        blind &= (chances >= _FEWEST_CHANCES) & (unresolved == finest)
        if not blind.any():
            break
        unresolved[blind] += 1
    unresolved[unresolved > _MOST_BITS] = 0
    rows, columns = (np.arange(extent) // BLOCK_PX for extent in lit.shape)
    return unresolved[np.ix_(rows, columns)]


def lost_lines(
    points_px: FloatArray, code: CodeMap, usable: NDArray[np.bool_], lines_per_cell: float, /
) -> NDArray[np.bool_] | None:
    """(H, W) bool: where the camera does not resolve the lines that the code says are there; None if nowhere.

    points_px : (n, 2), the points of lines that were found and numbered; usable : (H, W) bool, where light of two
    surfaces does not mix; lines_per_cell : frames' lines whose centres lie in one code cell. On the way along a row of
    pixels each line makes one point, or along a column where stripes run rather across the image.
    """
    wanted = _passed(code, usable) * lines_per_cell
    columns, rows = (np.rint(points_px).astype(np.intp) // BLOCK_PX).T
    found = np.bincount(rows * wanted.shape[1] + columns, minlength=wanted.size).reshape(wanted.shape)
    wanted, found = _with_neighbours(wanted), _with_neighbours(found)
    lost = (found < _LEAST_FOUND * wanted) & (wanted >= _FEWEST_LINES)
    if not lost.any():
        return None
    rows, columns = (np.arange(extent) // BLOCK_PX for extent in usable.shape)
    return lost[np.ix_(rows, columns)]


def _passed(code: CodeMap, usable: NDArray[np.bool_]) -> FloatArray:
    """(block rows, block columns): cells of the code passed on the way along the rows of pixels in each block, or along
    the columns if those are more.
    """
    shape = code.refusal.shape
    blocks = tuple(-(-extent // BLOCK_PX) for extent in shape)
    across, down = np.zeros(blocks), np.zeros(blocks)

    def band(first: int, last: int) -> None:
        # And the row above, from which the way leads into the band.
        above, begin = max(first * BLOCK_PX - 1, 0), first * BLOCK_PX
        rows = slice(above, min(last * BLOCK_PX, shape[0]))
        known = usable[rows] & (code.refusal[rows] == 0)
        cell = np.where(known, (code.lowest[rows] + code.highest[rows]).astype(np.float32) / 2, np.float32(np.nan))
        own = cell[begin - above :]
        across[first:last] = _in_blocks(np.diff(own, axis=1, prepend=np.float32(np.nan)))
        down[first:last] = _in_blocks(np.diff(cell, axis=0) if begin else np.diff(cell, axis=0, prepend=cell[:1]))

    in_bands(band, blocks[0], rows_at_most=_BLOCKS_AT_ONCE)
    return np.maximum(across, down)


def _in_blocks(steps: NDArray[np.float32]) -> FloatArray:
    """(block rows, block columns): cells of the code that steps from pixel to pixel pass in each block."""
    steps = np.abs(steps, out=steps)
    steps[~(steps <= _WIDEST_STEP)] = 0
    rows, columns = (np.arange(0, extent, BLOCK_PX) for extent in steps.shape)
    return np.add.reduceat(np.add.reduceat(steps, rows, axis=0), columns, axis=1).astype(np.float64)


def _tally(word: NDArray[np.int32], lit: NDArray[np.bool_], finest: int) -> NDArray[np.int64]:
    """(4, block rows, block columns) int64: passages, their pixels, passages of several pixels, right ones."""
    counts = np.zeros((4, *(-(-extent // BLOCK_PX) for extent in word.shape)), dtype=np.int64)
    in_bands(_tally_kernel, counts.shape[1], word, lit, finest, counts)
    return counts


def _with_neighbours(counts: NDArray[Any]) -> NDArray[Any]:
    """The sums over each block and the eight about it."""
    wide = np.pad(counts, 1)
    down = wide[:-2] + wide[1:-1] + wide[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


@kernel(in_every_scan=False)
def _tally_kernel(first: int, last: int, word: Any, lit: Any, finest: int, counts: Any) -> None:
    """Walk the rows of blocks; see `_tally`."""
    rows, columns = word.shape
    for block in range(first, last):
        for y in range(block * BLOCK_PX, min((block + 1) * BLOCK_PX, rows)):
            begin, before, cell = 0, -1, -1
            changes, rose = 0, False
            half = 0
            for x in range(columns):
                here = -1
                if lit[y, x]:
                    here = word[y, x] >> (finest + 1)
                    shift = here >> 1
                    while shift:
                        here ^= shift
                        shift >>= 1
                half_here = (word[y, x] >> finest & 1) ^ (here & 1)
                if here == cell:
                    if half_here != half:
                        changes += 1
                        rose = half_here > half
                    half = half_here
                    continue
                # A passage: from one neighbouring cell through this one to the other.
                if cell >= 0 and before >= 0 and here >= 0 and (before < cell) == (cell < here):
                    at = (begin + x - 1) // 2 // BLOCK_PX
                    counts[0, block, at] += 1
                    counts[1, block, at] += x - begin
                    if x - begin > 1:
                        counts[2, block, at] += 1
                        counts[3, block, at] += changes == 1 and rose == (before < cell)
                before, cell, begin = cell, here, x
                changes, half = 0, half_here
