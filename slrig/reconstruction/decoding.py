"""Gray-code decoding with a reason for every refused pixel.

A bit is read by comparing it with its inverse (or with the middle of white and black) against a margin that the
noise sets. A bit inside the margin is ambiguous; the pixel is then known to an interval of cells. One such bit at
its own code edge gives two neighbouring cells and does no harm; a finest bit lost in blur costs resolution only;
anywhere else the interval is wide and the pixel is refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import IntArray, Refusal
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
