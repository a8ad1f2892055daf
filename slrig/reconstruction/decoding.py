"""Gray-code decoding with a cause for every refused pixel, unresolved bits and lines, and the mask of the scan region.

A bit is 1 where its frame is brighter than its inverse (without inverses: than `AxisFrames.middle`). Where the
difference is below a margin, the larger of a multiple of the noise and a fraction of the contrast, both values are
tried, and the pixel has an interval of cells. An uncertain bit at its own code edge gives two neighbouring cells and
does no harm; a finest bit lost in blur costs resolution only; otherwise the interval is wide and the pixel is refused.

Where the code itself gives the positions (`decode_edges`), the finest bits that a camera does not resolve are not read
(`unresolved_bits`), and a pixel with a wide interval leaves out further ones: it loses resolution, and stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError, setting
from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray, IntArray, NoiseModel, Refusal
from slrig.reconstruction.frames import AxisFrames, rows_per_band, stack_rows

_NONE = int(Refusal.NONE)
_NOT_LIT = int(Refusal.NOT_LIT)
_SATURATED = int(Refusal.SATURATED)
_AMBIGUOUS_BIT = int(Refusal.AMBIGUOUS_BIT)
_BEYOND_PROJECTOR = int(Refusal.BEYOND_PROJECTOR)
_MAX_UNCERTAIN_BITS = 4  # each doubles the number of words to look up
_MIN_BITS_LEFT = 3
_MAX_LEFT_OUT_BITS = 3  # at a pixel, beyond those that its block does not resolve

_REACH_PX = 8
"""Distance of pixels on which a point depends. A filter reaches 9 px, but its outermost pixel has hardly any weight."""

# Unresolved bits and lines.
BLOCK_PX = 32
"""Size of a block: small enough for an even density of the code, with hundreds of passages of each bit."""
_MIN_PASSAGES = 48
"""With fewer passages, a block does not show whether it resolves a bit, and its neighbours decide."""
_MIN_CORRECT = 0.7
"""Least share of passages (runs of pixels of one cell between its neighbours) in which the bit changes once, the right
way. Random bits do in a quarter."""
_MIN_PASSAGE_PX = 2.0
"""Least mean width of a stripe of the bit in camera pixels, so that no pixel holds two code edges."""
_MAX_STRIPE_PX = 32.0
"""Greatest mean width of a stripe of the finest bit that is read, if finer ones are not."""
_MAX_MORE_BITS = 3
"""Most bits that a block leaves out, more than the block of median light: more is light from elsewhere."""
_MIN_SWING = 0.05
"""Least mean difference of a bit and its inverse, over the contrast: stripes too fine for the camera leave a beat with
its pixels that swings less.
"""
_MIN_FOUND = 0.5
"""Share of the points of lines; chosen between 0.9 where lines are resolved and 0.15 where they blur into each other.
"""
_MIN_LINE_POINTS = 200
"""Points to expect in a block and its neighbours; with fewer, lines count as resolved."""
_BLOCK_ROWS_PER_BAND = 4  # rows of blocks in a band, which needs memory for each pixel
_MAX_STEP_CELLS = 2.0  # cells from pixel to pixel; more is a depth step


@dataclass(frozen=True, slots=True)
class DecodingLimits:
    """Thresholds for lit pixels and certain bits.

    lit_sigma : white must exceed black by this many standard deviations of their difference, lit_fraction : and by this
    fraction of full scale. bit_sigma : a bit must differ from its inverse by this many standard deviations of the
    difference, bit_fraction : and by this fraction of the pixel's contrast. Without inverses it must differ from the
    middle of white and black by as many standard deviations of that difference, and by half of that fraction.
    widest_interval : largest hi - lo, in cells, that counts as decoded.
    drop_finest_bits : number of finest bits not to read where the code gives the positions, whether they resolve or
    not.
    """

    lit_sigma: float = 6.0
    lit_fraction: float = 0.012
    bit_sigma: float = 3.0
    bit_fraction: float = 0.08
    widest_interval: int = 3
    drop_finest_bits: int = 0


class CodeMap(NamedTuple):
    """Interval of code cells of each camera pixel, both ends included.

    lowest, highest : (H, W) int32, -1 where refused; refusal : (H, W) uint8, `Refusal`.
    """

    lowest: IntArray
    highest: IntArray
    refusal: NDArray[np.uint8]

    def rows(self, rows: slice) -> CodeMap:
        """Select rows, as views."""
        return CodeMap(self.lowest[rows], self.highest[rows], self.refusal[rows])

    def centre(self) -> NDArray[np.float64]:
        """(H, W) float64: middle of the interval in cells, NaN where refused."""
        middle = (self.lowest + self.highest) / 2
        return np.where(self.refusal == 0, middle, np.nan)


def unread_code(lit: NDArray[np.bool_], /) -> CodeMap:
    """Return the map of lit pixels without cells. lit : (H, W) bool."""
    no_cells = np.broadcast_to(np.int32(-1), lit.shape)
    return CodeMap(no_cells, no_cells, np.where(lit, np.uint8(Refusal.NONE), np.uint8(Refusal.NOT_LIT)))


def lit_pixels(frames: AxisFrames, noise: NoiseModel, limits: DecodingLimits, /) -> NDArray[np.bool_]:
    """(H, W) bool: True where white exceeds black significantly."""
    spread = np.sqrt(noise.variance(frames.white) + noise.variance(frames.black))
    threshold = np.maximum(limits.lit_sigma * spread, limits.lit_fraction * frames.full_scale)
    return np.asarray(frames.contrast > threshold)


def decode(
    frames: AxisFrames, noise: NoiseModel, index_of_word: IntArray, cell_count: int, limits: DecodingLimits, /
) -> CodeMap:
    """Decode the Gray code of one axis.

    index_of_word : (2^bits,) int32, cell index of each Gray word; cell_count : number of cells of the projector.
    """
    unread = np.zeros(frames.white.shape, dtype=np.uint8)
    return _decode(frames, noise, index_of_word, cell_count, limits, unread, most_left_out=0)


def decode_edges(
    frames: AxisFrames,
    noise: NoiseModel,
    index_of_word: IntArray,
    cell_count: int,
    limits: DecodingLimits,
    /,
    *,
    unresolved: NDArray[np.uint8] | None = None,
) -> tuple[CodeMap, NDArray[np.uint8]]:
    """Decode the Gray code of one axis for positions on its edges. Arguments as for `decode`.

    Where bits are uncertain elsewhere than at their own edges, a pixel leaves out up to 3 further finest bits until one
    cell is left. unresolved : (H, W) uint8, number of finest bits not to read at each pixel; None
    for `unresolved_bits`. Also returns (H, W) uint8, number of finest bits that were not read at each pixel.

    Raises
    ------
    PatternError
        `limits.drop_finest_bits` leaves fewer than 3 bits of the code.
    """
    _require_bits_left(len(frames.bits), limits.drop_finest_bits)
    if unresolved is None:
        unresolved = unresolved_bits(frames, lit_pixels(frames, noise, limits))
    unread = np.maximum(unresolved, np.uint8(limits.drop_finest_bits))
    return _decode(frames, noise, index_of_word, cell_count, limits, unread, most_left_out=_MAX_LEFT_OUT_BITS), unread


def _require_bits_left(bits: int, dropped: int) -> None:
    """Raises PatternError: too few bits are left."""
    if dropped and bits - dropped < _MIN_BITS_LEFT:
        message = (
            f"{setting('drop_finest_bits')}: expected at most {max(bits - _MIN_BITS_LEFT, 0)} for a code of {bits} "
            f"bits, found {dropped}; at least {_MIN_BITS_LEFT} bits are needed to locate a pixel"
        )
        raise PatternError(message)


def _decode(
    frames: AxisFrames, noise: NoiseModel, index_of_word: IntArray, cell_count: int, limits: DecodingLimits,
    unread: NDArray[np.uint8], *, most_left_out: int,
) -> CodeMap:  # fmt: skip
    """Decode without the finest bits that `unread` counts; it is raised where a pixel leaves out more."""
    shape = frames.white.shape
    code = CodeMap(np.full(shape, -1, np.int32), np.full(shape, -1, np.int32), np.zeros(shape, np.uint8))
    words = index_of_word.astype(np.int32)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        part = frames.rows(rows), noise.rows(rows), words, cell_count, limits
        _decode_rows(*part, unread[rows], most_left_out, code.rows(rows))

    in_bands(band, shape[0], rows_at_most=rows_per_band(frames.bits, 2 * shape[1]))
    return code


def _decode_rows(
    frames: AxisFrames, noise: NoiseModel, words: IntArray, cell_count: int, limits: DecodingLimits,
    unread: NDArray[np.uint8], most_left_out: int, code: CodeMap,
) -> None:  # fmt: skip
    """Decode some rows into `code` and `unread`."""
    paired = frames.inverses is not None
    reference = stack_rows(frames.inverses) if frames.inverses is not None else frames.middle[None]
    both = noise.variance(frames.white) + noise.variance(frames.black)
    if paired:
        variance = both
    elif frames.lines_light_half:
        variance = noise.variance(frames.white) + noise.variance(reference[0]) / np.float32(len(frames.lines))
    else:
        # Of a bit close to the middle, and of the middle, which is half the sum of white and black.
        variance = both * np.float32(1 / 2 + 1 / (4 * frames.reference_repeats))
    # Against the middle of white and black a bit has half the swing that it has against its inverse.
    swing = 1.0 if paired else 0.5
    margin = np.maximum(limits.bit_sigma * np.sqrt(variance), limits.bit_fraction * swing * frames.contrast)
    _decode_kernel(
        0, len(unread), stack_rows(frames.bits), reference, paired, frames.white,
        lit_pixels(frames, noise, limits), unread, most_left_out,
        margin.astype(np.float32), np.float32(frames.clipped_at), words, cell_count, limits.widest_interval, *code,
    )  # fmt: skip


@kernel
def _decode_kernel(
    first: int, last: int, bit_images: Any, reference: Any, paired: bool, white: Any, lit: Any, unread: Any,
    most_left_out: int, margin: Any, clipped_at: Any, index_of_word: Any, cell_count: int, widest: int, lowest: Any,
    highest: Any, refusal: Any,
) -> None:  # fmt: skip
    bits, _, columns = bit_images.shape
    for y in range(first, last):
        uncertain = np.zeros(_MAX_UNCERTAIN_BITS, dtype=np.int32)
        for x in range(columns):
            if not lit[y, x]:
                refusal[y, x] = _NOT_LIT
                continue
            if not paired and white[y, x] >= clipped_at:
                refusal[y, x] = _SATURATED
                continue
            word = 0
            in_doubt = 0
            clipped = False
            for b in range(bits):
                value = bit_images[b, y, x]
                other = reference[b, y, x] if paired else reference[0, y, x]
                if value > other:
                    word |= 1 << (bits - 1 - b)
                if paired and value >= clipped_at and other >= clipped_at:
                    clipped = True
                if abs(value - other) < margin[y, x]:
                    in_doubt |= 1 << (bits - 1 - b)
            if clipped:
                refusal[y, x] = _SATURATED
                continue
            refusal[y, x] = _AMBIGUOUS_BIT
            left_out = min(np.int64(unread[y, x]), bits - 1)
            for more in range(max(min(most_left_out, bits - _MIN_BITS_LEFT - left_out), 0) + 1):
                skipped = left_out + more
                count = 0
                for k in range(skipped, bits):
                    if in_doubt >> k & 1:
                        if count < _MAX_UNCERTAIN_BITS:
                            uncertain[count] = k
                        count += 1
                if count > _MAX_UNCERTAIN_BITS:
                    continue
                # In cells of the bits that are read, which the others do not change.
                low = index_of_word[word] >> skipped
                high = low
                for choice in range(1, 1 << count):
                    other_word = word
                    for k in range(count):
                        if choice >> k & 1:
                            other_word ^= 1 << uncertain[k]
                    index = index_of_word[other_word] >> skipped
                    low = min(low, index)
                    high = max(high, index)
                if high - low > (widest if more == 0 else 0):
                    continue
                if low << skipped >= cell_count:
                    refusal[y, x] = _BEYOND_PROJECTOR
                else:
                    refusal[y, x] = _NONE
                    unread[y, x] = skipped
                    lowest[y, x] = low << skipped
                    highest[y, x] = min(((high + 1) << skipped) - 1, cell_count - 1)
                break


def cells_beyond(frames: AxisFrames, code: CodeMap, index_of_word: IntArray, /) -> IntArray:
    """(n,) int32: the cell of the code at each pixel where it names none of the projector's, after or before them."""
    beyond = code.refusal == _BEYOND_PROJECTOR
    first_cell = frames.gray.offset_px // frames.gray.cell_px
    if first_cell > 0:
        beyond |= (code.refusal == 0) & (code.highest < first_cell)
    word = np.zeros(int(np.count_nonzero(beyond)), dtype=np.int32)
    if len(word) == 0:
        return word
    reference = frames.inverses if frames.inverses is not None else [frames.middle] * len(frames.bits)
    for bit_image, other in zip(frames.bits, reference, strict=True):
        word = word << 1 | (bit_image[beyond] > other[beyond])
    return np.asarray(index_of_word[word], dtype=np.int32)


@dataclass(frozen=True, slots=True)
class RegionMask:
    """Scan region in the image of one camera.

    pixels : (H, W) bool, or None for all; lowest_px, highest_px : (H, W) float32, range of the light position in which
    the ray of the pixel is inside the region, or None for any; min_contrast : of white less black, as a share of full
    scale.
    """

    pixels: NDArray[np.bool_] | None = None
    lowest_px: NDArray[np.float32] | None = None
    highest_px: NDArray[np.float32] | None = None
    min_contrast: float = 0.0

    def mask(self, frames: AxisFrames, code: CodeMap, cell_position: FloatArray) -> NDArray[np.bool_]:
        """(H, W) bool: pixels of the region, pixels without code included.

        cell_position : (cells,) float64, middle of each cell of the code, px.
        """
        inside = np.ones(code.refusal.shape, dtype=np.bool_) if self.pixels is None else self.pixels.copy()
        if self.min_contrast:
            # Unlit pixels keep their own cause.
            strong = frames.contrast >= np.float32(self.min_contrast * frames.full_scale)
            inside &= strong | (code.refusal == Refusal.NOT_LIT)
        if self.lowest_px is not None and self.highest_px is not None:
            half = np.float32(frames.gray.cell_px / 2)
            position = cell_position.astype(np.float32)
            within = (position[code.lowest] - half <= self.highest_px) & (
                position[code.highest] + half >= self.lowest_px
            )
            inside &= within | (code.lowest < 0)
        return inside


def refuse_outside_region(code: CodeMap, region: NDArray[np.bool_]) -> CodeMap:
    """Refuse lit pixels outside the region, except those on which points inside it depend."""
    box = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    outside = (cv2.dilate(region.view(np.uint8), box) == 0) & (code.refusal != Refusal.NOT_LIT)
    refusal = np.where(outside, np.uint8(Refusal.OUTSIDE_REGION), code.refusal)
    return CodeMap(np.where(outside, -1, code.lowest), np.where(outside, -1, code.highest), refusal)


def unresolved_bits(frames: AxisFrames, lit: NDArray[np.bool_], /) -> NDArray[np.uint8]:
    """(H, W) uint8: number of finest bits that the camera does not resolve.

    lit : (H, W) bool, pixels that the projector lights. A block of pixels resolves a bit if stripes of it are wide
    enough, swing, and change where the coarser bits say. The finest bit that it and the next coarser one pass is the
    first that is read: stripes too fine may beat with the pixels and pass by chance. It is 0 where no bit passes, or
    only one of stripes so wide that the lens does not explain it: such pixels do not show the code, but light from
    elsewhere.
    """
    lit = lit & (frames.white < frames.clipped_at)
    bits = len(frames.bits)
    reference = frames.inverses if frames.inverses is not None else [frames.middle] * bits
    word = np.zeros(lit.shape, dtype=np.int32)
    for bit_image, other in zip(frames.bits, reference, strict=True):
        word <<= 1
        word |= bit_image > other
    contrast = frames.contrast * np.float32(1.0 if frames.inverses is not None else 0.5)
    blocks = tuple(-(-extent // BLOCK_PX) for extent in lit.shape)
    unresolved, judged = np.zeros(blocks, dtype=np.uint8), np.zeros(blocks, dtype=np.bool_)
    open_blocks, finer_lost, finer_enough = (np.ones(blocks, dtype=np.bool_) for _ in range(3))
    stripe_px = np.full(blocks, np.inf)
    # Columns of a transposed copy are contiguous in memory.
    directions = (word, lit), (np.ascontiguousarray(word.T), np.ascontiguousarray(lit.T))
    for finest in range(bits):
        along_rows, along_columns = (_count_passages(*each, finest) for each in directions)
        across, down = (
            np.array([_add_neighbours(each) for each in counts])
            for counts in (along_rows, along_columns.swapaxes(1, 2))
        )
        # Across the stripes rather than along them.
        passages, pixels, long_passages, correct = np.where(across[0] >= down[0], across, down)
        swing = _mean_swing(frames.bits[-1 - finest], reference[-1 - finest], contrast, lit)
        enough = passages >= _MIN_PASSAGES
        lost = enough & (
            (correct < _MIN_CORRECT * long_passages) | (pixels < _MIN_PASSAGE_PX * passages) | (swing < _MIN_SWING)
        )
        # Stripes of the next finer bit are half as wide, where its own passages are too few.
        finer_narrow = enough & ~lost & ~finer_enough & (pixels < 2 * _MIN_PASSAGE_PX * passages)
        judged |= enough & open_blocks
        open_blocks &= lost | finer_lost | finer_narrow
        unresolved[open_blocks & finer_narrow] = finest
        unresolved[open_blocks & lost] = finest + 1
        first_read = open_blocks & ~lost & enough
        stripe_px[first_read] = pixels[first_read] / passages[first_read]
        if not open_blocks.any():
            break
        finer_lost, finer_enough = lost, enough
    is_lens = judged & ~open_blocks & ((unresolved == 0) | (stripe_px <= _MAX_STRIPE_PX))
    if is_lens.any():
        light = _sum_blocks(np.where(lit, contrast, np.float32(0)))
        is_lens &= unresolved <= _weighted_median(unresolved[is_lens], light[is_lens]) + _MAX_MORE_BITS
    unresolved[~is_lens] = 0
    rows, columns = (np.arange(extent) // BLOCK_PX for extent in lit.shape)
    return _follow_neighbours(unresolved, is_lens)[np.ix_(rows, columns)]


def _weighted_median(values: NDArray[np.uint8], weights: FloatArray) -> int:
    """The value below and above which half of the weight is."""
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return int(values[order[np.searchsorted(total, total[-1] / 2)]])


def _mean_swing(
    bit_image: NDArray[Any], reference: NDArray[Any], contrast: NDArray[np.float32], lit: NDArray[np.bool_]
) -> FloatArray:
    """(block rows, block columns): mean difference of a bit and its reference, over that of white and black."""
    difference = np.abs(np.subtract(bit_image, reference, dtype=np.float32))
    total, whole = (_add_neighbours(_sum_blocks(np.where(lit, each, np.float32(0)))) for each in (difference, contrast))
    return np.asarray(total / np.maximum(whole, 1))


def _follow_neighbours(unresolved: NDArray[np.uint8], judged: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Counts of the blocks, (rows, columns): a block with too few passages takes those of the blocks around it, and
    none has more, or fewer, than all its neighbours.
    """
    if not judged.any() or judged.size == 1:
        return unresolved
    around = np.ones((3, 3), dtype=np.uint8)
    known, counts = judged.view(np.uint8), np.where(judged, unresolved, np.uint8(0))
    while not known.all():
        near, filled = cv2.dilate(known, around), cv2.dilate(counts, around)
        counts = np.where(known > 0, counts, filled)
        known = near
    around[1, 1] = 0
    return np.clip(counts, cv2.erode(counts, around), cv2.dilate(counts, around))


def unresolved_lines(
    points_px: FloatArray, code: CodeMap, usable: NDArray[np.bool_], lines_per_cell: float, /
) -> NDArray[np.bool_] | None:
    """(H, W) bool: True where the camera does not resolve the lines that the code predicts; None if nowhere.

    points_px : (n, 2), numbered points of lines; usable : (H, W) bool, pixels whose light is of one surface;
    lines_per_cell : lines of all frames per code cell. Along a row of pixels each line makes one point, or along a
    column if stripes run rather across the image.
    """
    expected = _cells_per_block(code, usable) * lines_per_cell
    columns, rows = (np.rint(points_px).astype(np.intp) // BLOCK_PX).T
    found = np.bincount(rows * expected.shape[1] + columns, minlength=expected.size).reshape(expected.shape)
    expected, found = _add_neighbours(expected), _add_neighbours(found)
    unresolved = (found < _MIN_FOUND * expected) & (expected >= _MIN_LINE_POINTS)
    if not unresolved.any():
        return None
    rows, columns = (np.arange(extent) // BLOCK_PX for extent in usable.shape)
    return unresolved[np.ix_(rows, columns)]


def _cells_per_block(code: CodeMap, usable: NDArray[np.bool_]) -> FloatArray:
    """(block rows, block columns): code cells passed along the rows of pixels of each block, or along its columns if
    these are more.
    """
    shape = code.refusal.shape
    blocks = tuple(-(-extent // BLOCK_PX) for extent in shape)
    across, down = np.zeros(blocks), np.zeros(blocks)

    def band(first: int, last: int) -> None:
        # With the row above, for the step into the band.
        above, begin = max(first * BLOCK_PX - 1, 0), first * BLOCK_PX
        rows = slice(above, min(last * BLOCK_PX, shape[0]))
        known = usable[rows] & (code.refusal[rows] == 0)
        cell = np.where(known, (code.lowest[rows] + code.highest[rows]).astype(np.float32) / 2, np.float32(np.nan))
        band_cells = cell[begin - above :]
        across[first:last] = _sum_steps(np.diff(band_cells, axis=1, prepend=np.float32(np.nan)))
        down[first:last] = _sum_steps(np.diff(cell, axis=0) if begin else np.diff(cell, axis=0, prepend=cell[:1]))

    in_bands(band, blocks[0], rows_at_most=_BLOCK_ROWS_PER_BAND)
    return np.maximum(across, down)


def _sum_steps(steps: NDArray[np.float32]) -> FloatArray:
    """(block rows, block columns): code cells passed by steps between pixels, in each block."""
    steps = np.abs(steps, out=steps)
    steps[~(steps <= _MAX_STEP_CELLS)] = 0
    return _sum_blocks(steps)


def _sum_blocks(values: NDArray[np.float32]) -> FloatArray:
    """(block rows, block columns): sums over blocks of pixels."""
    rows, columns = (np.arange(0, extent, BLOCK_PX) for extent in values.shape)
    return np.add.reduceat(np.add.reduceat(values, rows, axis=0), columns, axis=1).astype(np.float64)


def _count_passages(word: NDArray[np.int32], lit: NDArray[np.bool_], finest: int) -> NDArray[np.int64]:
    """(4, block rows, block columns) int64: passages, their pixels, passages of several pixels, correct ones."""
    counts = np.zeros((4, *(-(-extent // BLOCK_PX) for extent in word.shape)), dtype=np.int64)
    in_bands(_passages_kernel, counts.shape[1], word, lit, finest, counts)
    return counts


def _add_neighbours(counts: NDArray[Any]) -> NDArray[Any]:
    """Sum of each block and its eight neighbours."""
    wide = np.pad(counts, 1)
    down = wide[:-2] + wide[1:-1] + wide[2:]
    return np.asarray(down[:, :-2] + down[:, 1:-1] + down[:, 2:])


@kernel(in_every_scan=False)
def _passages_kernel(first: int, last: int, word: Any, lit: Any, finest: int, counts: Any) -> None:
    """Count along the rows of pixels: see `_count_passages`."""
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
                # A passage leads from one neighbouring cell through this one to the other.
                if cell >= 0 and before >= 0 and here >= 0 and (before < cell) == (cell < here):
                    at = (begin + x - 1) // 2 // BLOCK_PX
                    counts[0, block, at] += 1
                    counts[1, block, at] += x - begin
                    if x - begin > 1:
                        counts[2, block, at] += 1
                        counts[3, block, at] += changes == 1 and rose == (before < cell)
                before, cell, begin = cell, here, x
                changes, half = 0, half_here
