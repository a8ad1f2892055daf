"""Gray-code decoding with a cause for every refused pixel, unresolved bits, and the mask of the scan region.

A bit is read by comparing it with its inverse (or with the middle of white and black) against a margin that the
noise sets. A bit inside the margin is ambiguous; the pixel is then known to an interval of cells. One such bit at
its own code edge gives two neighbouring cells and does no harm; a finest bit lost in blur costs resolution only;
anywhere else the interval is wide and the pixel is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray, IntArray, Refusal
from slrig.reconstruction.frames import AxisFrames, band_rows, rows_of
from slrig.reconstruction.noise import NoiseModel

_NOT_LIT = int(Refusal.NOT_LIT)
_SATURATED = int(Refusal.SATURATED)
_AMBIGUOUS_BIT = int(Refusal.AMBIGUOUS_BIT)
_BEYOND_PROJECTOR = int(Refusal.BEYOND_PROJECTOR)
_MOST_UNCERTAIN_BITS = 4  # each doubles the words that a pixel may show, all of which are looked up


@dataclass(frozen=True, slots=True)
class DecodingLimits:
    """When a pixel is lit and a bit is certain.

    lit_sigma : white must exceed black by this many standard deviations of their difference,
    lit_fraction : and by this fraction of full scale.
    bit_sigma : a bit must differ from its inverse by this many standard deviations of the difference,
    bit_fraction : and by this fraction of the pixel's contrast.
    widest_interval : the greatest hi - lo, in cells, that still counts as decoded.
    """

    lit_sigma: float = 6.0
    lit_fraction: float = 0.012
    bit_sigma: float = 3.0
    bit_fraction: float = 0.08
    widest_interval: int = 3


class CodeMap(NamedTuple):
    """For each camera pixel the interval of code cells that it may show, both ends included.

    lowest, highest : (H, W) int32, -1 where refused; refusal : (H, W) uint8, `Refusal`.
    """

    lowest: IntArray
    highest: IntArray
    refusal: NDArray[np.uint8]

    def rows(self, rows: slice) -> CodeMap:
        """Some rows of the map, to look at or to fill in."""
        return CodeMap(self.lowest[rows], self.highest[rows], self.refusal[rows])

    def centre(self) -> NDArray[np.float64]:
        """(H, W) float64: the middle of the interval in cells, NaN where refused."""
        middle = (self.lowest + self.highest) / 2
        return np.where(self.refusal == 0, middle, np.nan)


def lit_pixels(frames: AxisFrames, noise: NoiseModel, limits: DecodingLimits, /) -> NDArray[np.bool_]:
    """(H, W) bool: where white stands out of black."""
    spread = np.sqrt(noise.variance(frames.white) + noise.variance(frames.black))
    least = np.maximum(limits.lit_sigma * spread, limits.lit_fraction * frames.full_scale)
    return np.asarray(frames.contrast > least)


def decode(
    frames: AxisFrames,
    noise: NoiseModel,
    index_of_word: IntArray,
    cell_count: int,
    limits: DecodingLimits,
    /,
    *,
    unresolved: NDArray[np.uint8] | None = None,
) -> CodeMap:
    """Decode the Gray code of one axis.

    index_of_word : (2^bits,) int32, the cell index of each Gray word; cell_count : cells that the projector shows.
    unresolved : (H, W) uint8, how many of the finest bits are not read at each pixel; all are read without it.
    """
    shape = frames.white.shape
    code = CodeMap(np.full(shape, -1, np.int32), np.full(shape, -1, np.int32), np.zeros(shape, np.uint8))
    unread = np.zeros(shape, dtype=np.uint8) if unresolved is None else unresolved
    words = index_of_word.astype(np.int32)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        _decode_rows(frames.rows(rows), noise.rows(rows), words, cell_count, limits, unread[rows], code.rows(rows))

    in_bands(band, shape[0], rows_at_most=band_rows(frames.bits, 2 * shape[1]))
    return code


def _decode_rows(
    frames: AxisFrames, noise: NoiseModel, words: IntArray, cell_count: int, limits: DecodingLimits,
    unread: NDArray[np.uint8], code: CodeMap,
) -> None:  # fmt: skip
    """Fill in the code of some rows."""
    paired = frames.inverses is not None
    against = rows_of(frames.inverses) if frames.inverses is not None else frames.middle[None]
    spread = np.sqrt(noise.variance(frames.white) + noise.variance(frames.black))
    # Against the middle of white and black a bit swings half as far as against its inverse.
    swing = 1.0 if paired else 0.5
    margin = np.maximum(limits.bit_sigma * swing * spread, limits.bit_fraction * swing * frames.contrast)
    if not paired and frames.lines_halve:
        alone = np.sqrt(noise.variance(frames.white) + noise.variance(against[0]) / np.float32(len(frames.lines)))
        margin = np.maximum(limits.bit_sigma * alone, limits.bit_fraction * swing * frames.contrast)
    _decode_kernel(
        0, len(unread), rows_of(frames.bits), against, paired, frames.white, lit_pixels(frames, noise, limits), unread,
        margin.astype(np.float32), np.float32(frames.clipped_at), words, cell_count, limits.widest_interval, *code,
    )  # fmt: skip


@kernel
def _decode_kernel(
    first: int, last: int, shown: Any, against: Any, paired: bool, white: Any, lit: Any, unread: Any, margin: Any,
    full_scale: Any, index_of_word: Any,
    cell_count: int, widest: int, lowest: Any, highest: Any, refusal: Any,
) -> None:  # fmt: skip
    bits, _, columns = shown.shape
    for y in range(first, last):
        uncertain = np.zeros(2 * _MOST_UNCERTAIN_BITS, dtype=np.int32)
        for x in range(columns):
            if not lit[y, x]:
                refusal[y, x] = _NOT_LIT
                continue
            if not paired and white[y, x] >= full_scale:
                refusal[y, x] = _SATURATED
                continue
            word = 0
            count = 0
            read = bits - unread[y, x]
            clipped = False
            for b in range(bits):
                seen = shown[b, y, x]
                other = against[b, y, x] if paired else against[0, y, x]
                if seen > other:
                    word |= 1 << (bits - 1 - b)
                if paired and seen >= full_scale and other >= full_scale:
                    clipped = True
                if b >= read or abs(seen - other) < margin[y, x]:
                    if count < len(uncertain):
                        uncertain[count] = bits - 1 - b
                    count += 1
            if clipped:
                refusal[y, x] = _SATURATED
                continue
            if count > min(_MOST_UNCERTAIN_BITS + unread[y, x], len(uncertain)):
                refusal[y, x] = _AMBIGUOUS_BIT
                continue
            low = index_of_word[word]
            high = low
            for choice in range(1, 1 << count):
                other_word = word
                for k in range(count):
                    if choice >> k & 1:
                        other_word ^= 1 << uncertain[k]
                index = index_of_word[other_word]
                low = min(low, index)
                high = max(high, index)
            # In cells of the bits that are read.
            if (high >> unread[y, x]) - (low >> unread[y, x]) > widest:
                refusal[y, x] = _AMBIGUOUS_BIT
            elif low >= cell_count:
                refusal[y, x] = _BEYOND_PROJECTOR
            else:
                lowest[y, x] = low
                highest[y, x] = min(high, cell_count - 1)


_REACH_PX = 8
"""What is found at a pixel depends on pixels so far away: fits reach 2 px, and filters 9 px, with next to no weight."""


@dataclass(frozen=True, slots=True)
class AskedPixels:
    """What is asked of a camera.

    pixels : (H, W) bool, or None for all; lowest_px, highest_px : (H, W) float32, between which the light's position
    lies where the pixel's ray is in the region, or None for anywhere; least_contrast : of white less black, as a share
    of full scale.
    """

    pixels: NDArray[np.bool_] | None = None
    lowest_px: NDArray[np.float32] | None = None
    highest_px: NDArray[np.float32] | None = None
    least_contrast: float = 0.0

    def told(self, frames: AxisFrames, code: CodeMap, cell_position: FloatArray) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels that are asked for. One that shows no code may be.

        cell_position : (cells,) float64, the middle of each cell of the code, px.
        """
        asked = np.ones(code.refusal.shape, dtype=np.bool_) if self.pixels is None else self.pixels.copy()
        if self.least_contrast:
            # What has no light at all is told as that.
            strong = frames.contrast >= np.float32(self.least_contrast * frames.full_scale)
            asked &= strong | (code.refusal == Refusal.NOT_LIT)
        if self.lowest_px is not None and self.highest_px is not None:
            half = np.float32(frames.gray.cell_px / 2)
            position = cell_position.astype(np.float32)
            within = (position[code.lowest] - half <= self.highest_px) & (
                position[code.highest] + half >= self.lowest_px
            )
            asked &= within | (code.lowest < 0)
        return asked


def without_others(code: CodeMap, asked: NDArray[np.bool_]) -> CodeMap:
    """The code without the lit pixels that are not asked for, save those on which points that are asked for depend."""
    box = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    others = (cv2.dilate(asked.view(np.uint8), box) == 0) & (code.refusal != Refusal.NOT_LIT)
    refusal = np.where(others, np.uint8(Refusal.OUTSIDE_REGION), code.refusal)
    return CodeMap(np.where(others, -1, code.lowest), np.where(others, -1, code.highest), refusal)


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
