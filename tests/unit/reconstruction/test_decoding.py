"""Gray decoding pixel by pixel against a plain reading of its rules."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import Axis, Gray, IntArray, NoiseModel, Refusal
from slrig.patterns.codes import index_of_word
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, cells_beyond, decode, decode_edges
from slrig.reconstruction.frames import AxisFrames
from tests.unit.reconstruction.builders import code_frames

BITS = 6
WORDS = index_of_word(Gray(Axis.COLUMN, 0, BITS))
QUIET = NoiseModel(1.0, 0.0)
# An uneven fraction: no integer sample lies on the margin itself.
LIMITS = DecodingLimits(bit_fraction=0.0813)


def word_of(cell: int) -> list[int]:
    """The bits of a cell's code word, most significant first, by counting through the reflected code."""
    if cell == 0:
        return [0] * BITS
    words = [[]]  # type: list[list[int]]
    for _ in range(BITS):
        words = [[0, *word] for word in words] + [[1, *word] for word in reversed(words)]
    return words[cell]


def one_pixel(
    swings: list[float], *, white: float = 200.0, black: float = 20.0, paired: bool = True, ambient: float = 0.0
) -> AxisFrames:
    """A pixel whose bits are white (1), black (-1) or between."""
    middle, half = (white + black) / 2 + ambient, (white - black) / 2
    bits = np.array(swings, dtype=np.float32)[:, None, None] * half + middle
    return code_frames(
        bits=bits.astype(np.float32),
        inverses=(2 * middle - bits).astype(np.float32) if paired else None,
        white=np.full((1, 1), white, dtype=np.float32),
        black=np.full((1, 1), black, dtype=np.float32),
    )


def swings_of(cell: int) -> list[float]:
    return [2.0 * bit - 1.0 for bit in word_of(cell)]


def read(frames: AxisFrames, *, cells: int = 64) -> tuple[int, int, Refusal]:
    """(lowest, highest, refusal) of the only pixel."""
    code = decode(frames, QUIET, WORDS, cells, LIMITS)
    return int(code.lowest[0, 0]), int(code.highest[0, 0]), Refusal(int(code.refusal[0, 0]))


def expected(frames: AxisFrames, noise: NoiseModel, cells: int, limits: DecodingLimits) -> CodeMap:
    """The docstrings of `decode` and `DecodingLimits`, one pixel at a time."""
    rows, columns = frames.white.shape
    lowest: IntArray = np.full((rows, columns), -1, dtype=np.int32)
    highest: IntArray = np.full((rows, columns), -1, dtype=np.int32)
    refusal: NDArray[np.uint8] = np.zeros((rows, columns), dtype=np.uint8)
    cell_of = {tuple(word_of(cell)): cell for cell in range(2**BITS)}
    for y, x in product(range(rows), range(columns)):
        white, black = float(frames.white[y, x]), float(frames.black[y, x])
        spread = (2 * noise.read_variance + noise.slope * (white + black)) ** 0.5
        if white - black <= max(limits.lit_sigma * spread, limits.lit_fraction * frames.full_scale):
            refusal[y, x] = Refusal.NOT_LIT
            continue
        choices: list[tuple[int, ...]] = []
        clipped = frames.inverses is None and white >= frames.full_scale
        for b in range(BITS):
            seen = float(frames.bits[b][y, x])
            if frames.inverses is None:
                difference = 2 * (seen - (white + black) / 2)
            else:
                other = float(frames.inverses[b][y, x])
                difference = seen - other
                clipped |= min(seen, other) >= frames.full_scale
            deviation = spread if frames.inverses is not None else 2 * (0.75 * spread**2) ** 0.5
            margin = max(limits.bit_sigma * deviation, limits.bit_fraction * (white - black))
            choices.append((0, 1) if abs(difference) < margin else (int(difference > 0),))
        possible = sorted(cell_of[word] for word in product(*choices))
        if clipped:
            refusal[y, x] = Refusal.SATURATED
        elif possible[-1] - possible[0] > limits.widest_interval:
            refusal[y, x] = Refusal.AMBIGUOUS_BIT
        elif possible[0] >= cells:
            refusal[y, x] = Refusal.BEYOND_PROJECTOR
        else:
            lowest[y, x], highest[y, x] = possible[0], min(possible[-1], cells - 1)
    return CodeMap(lowest, highest, refusal)


def random_frames(seed: int, *, paired: bool) -> AxisFrames:
    """Pixels of every kind: certain, uncertain, clipped, dark, of cells beyond the projector."""
    rng = np.random.default_rng(seed)
    shape = (24, 32)
    black = rng.integers(0, 60, shape).astype(np.float32)
    white = np.minimum(black + rng.choice([2, 8, 40, 120, 230], shape), 255).astype(np.float32)
    cells = rng.integers(0, 2**BITS, shape)
    bits = np.array([[word_of(int(cell)) for cell in row] for row in cells]).transpose(2, 0, 1)
    swing = np.where(bits == 1, 1.0, -1.0) * rng.choice([1.0, 0.9, 0.05, 0.0], (BITS, *shape), p=[0.6, 0.25, 0.1, 0.05])
    middle, half = (white + black) / 2, (white - black) / 2
    direct = np.rint(middle + half * swing)
    inverse = np.rint(middle - half * swing)
    both = rng.random(shape) < 0.03
    direct[2, both] = inverse[2, both] = 255
    return code_frames(
        bits=direct.astype(np.float32),
        inverses=inverse.astype(np.float32) if paired else None,
        white=white,
        black=black,
    )


@pytest.mark.parametrize("paired", [True, False], ids=["inverses", "threshold"])
@pytest.mark.parametrize("noise", [NoiseModel(0.3, 0.0), NoiseModel(2.0, 0.037)], ids=["quiet", "loud"])
def test_every_pixel_is_read_as_the_rules_say(*, paired: bool, noise: NoiseModel) -> None:
    for seed in range(3):
        frames = random_frames(seed, paired=paired)
        got = decode(frames, noise, WORDS, 50, LIMITS)
        want = expected(frames, noise, 50, LIMITS)
        np.testing.assert_array_equal(got.refusal, want.refusal)
        np.testing.assert_array_equal(got.lowest, want.lowest)
        np.testing.assert_array_equal(got.highest, want.highest)
        met = {Refusal(int(value)) for value in np.unique(got.refusal)}
        assert met == {
            Refusal.NONE, Refusal.NOT_LIT, Refusal.SATURATED, Refusal.AMBIGUOUS_BIT, Refusal.BEYOND_PROJECTOR,
        }  # fmt: skip


@pytest.mark.parametrize("paired", [True, False], ids=["inverses", "threshold"])
def test_a_cell_is_read_exactly_and_at_its_edge_as_one_of_two_neighbours(*, paired: bool) -> None:
    for cell in range(63):
        swings = swings_of(cell)
        assert read(one_pixel(swings, paired=paired)) == (cell, cell, Refusal.NONE)
        swings[turning(cell)] = 0.0
        assert read(one_pixel(swings, paired=paired)) == (cell, cell + 1, Refusal.NONE)


def turning(cell: int) -> int:
    """The bit that changes between a cell and the next."""
    return next(b for b in range(BITS) if swings_of(cell)[b] != swings_of(cell + 1)[b])


def with_bits(cell: int, **changed: float) -> AxisFrames:
    """A pixel of a cell, some of its bits (b0 is the most significant) between black (-1) and white (1)."""
    swings = swings_of(cell)
    for name, swing in changed.items():
        swings[int(name[1:])] = swing
    return one_pixel(swings)


def clipped() -> AxisFrames:
    """Light from elsewhere lifts bit and inverse over full scale: they are equal, and no noise is to blame."""
    frames = one_pixel(swings_of(9), ambient=400.0)
    assert frames.inverses is not None
    full = np.float32(255)
    return code_frames(
        bits=np.minimum(frames.bits, full), inverses=np.minimum(frames.inverses, full), white=frames.white,
        black=frames.black,
    )  # fmt: skip


REFUSED = (-1, -1)
READ: dict[str, tuple[AxisFrames, tuple[int, int], Refusal]] = {
    # Bit 0 changes between cells 31 and 32 only; in doubt at cell 5 it could mean 5 or 58.
    "a coarse bit in doubt away from its edge": (with_bits(5, b0=0.0), REFUSED, Refusal.AMBIGUOUS_BIT),
    "the finest bits lost in blur": (with_bits(21, b4=0.0, b5=0.0), (20, 23), Refusal.NONE),
    "just outside the margin": (with_bits(20, b5=-0.09), (20, 20), Refusal.NONE),
    "just inside the margin": (with_bits(20, b5=-0.07), (20, 21), Refusal.NONE),
    "more doubts than are followed": (one_pixel([1.0, *[0.0] * 5]), REFUSED, Refusal.AMBIGUOUS_BIT),
    "the projector's last cell": (with_bits(39, **{f"b{turning(39)}": 0.0}), (39, 39), Refusal.NONE),
    "beyond the projector": (with_bits(40), REFUSED, Refusal.BEYOND_PROJECTOR),
    "not lit, with any bits": (one_pixel([0.0] * BITS, white=23.0, black=20.0), REFUSED, Refusal.NOT_LIT),
    "clipped": (clipped(), REFUSED, Refusal.SATURATED),
    "clipped white, which leaves no middle": (
        one_pixel(swings_of(9), white=255.0, paired=False), REFUSED, Refusal.SATURATED,
    ),
    "clipped white with inverses": (one_pixel(swings_of(9), white=255.0), (9, 9), Refusal.NONE),
}  # fmt: skip


@pytest.mark.parametrize("case", READ)
def test_a_pixel_is_read_as_an_interval_or_refused_for_one_cause(case: str) -> None:
    frames, interval, refusal = READ[case]
    assert read(frames, cells=40) == (*interval, refusal)


@pytest.mark.parametrize("paired", [True, False], ids=["inverses", "threshold"])
def test_a_bit_is_certain_from_three_standard_deviations_of_what_it_is_compared_by(*, paired: bool) -> None:
    # Of a bit and its inverse, or of a bit and of the middle of white and black.
    deviation = (1 + (1 if paired else 1 / 2)) ** 0.5
    cell = 20
    for sigmas, wide in ((2.9, True), (3.1, False)):
        swings = swings_of(cell)
        half_contrast = 15.0
        off = sigmas * deviation / half_contrast / (2 if paired else 1)
        swings[5] = off if swings[5] > 0 else -off
        seen = one_pixel(swings, white=50.0, black=20.0, paired=paired)
        low, high, _ = read(seen)
        assert (high > low) == wide


def spread_of_read(frames: AxisFrames, limits: DecodingLimits = LIMITS) -> tuple[int, int, Refusal, int]:
    """(lowest, highest, refusal, bits not read) of the only pixel, for positions on code edges."""
    code, unread = decode_edges(frames, QUIET, WORDS, 64, limits)
    return int(code.lowest[0, 0]), int(code.highest[0, 0]), Refusal(int(code.refusal[0, 0])), int(unread[0, 0])


def test_a_pixel_leaves_out_the_finest_bits_until_its_interval_is_narrow() -> None:
    # Bit 3 changes between cells 19 and 20, not at 21, so that cell 18 is possible, too.
    doubtful = with_bits(21, b3=0.0)
    assert read(doubtful) == (18, 21, Refusal.NONE)
    assert spread_of_read(doubtful) == (18, 21, Refusal.NONE, 0)
    # At 23 it is further from its edge: cell 23, or 16.
    doubtful = with_bits(23, b3=0.0)
    assert read(doubtful) == (*REFUSED, Refusal.AMBIGUOUS_BIT)
    assert spread_of_read(doubtful) == (16, 23, Refusal.NONE, 3)
    # Bits coarser than that say nothing of the place.
    assert spread_of_read(with_bits(5, b0=0.0)) == (*REFUSED, Refusal.AMBIGUOUS_BIT, 0)
    # One in doubt at its own edge leaves nothing out.
    assert spread_of_read(with_bits(31, b0=0.0)) == (31, 32, Refusal.NONE, 0)


def test_bits_dropped_by_hand_are_not_read() -> None:
    limits = DecodingLimits(bit_fraction=0.0813, drop_finest_bits=2)
    assert spread_of_read(with_bits(21), limits) == (20, 23, Refusal.NONE, 2)
    assert spread_of_read(with_bits(21, b4=0.0, b5=0.0), limits) == (20, 23, Refusal.NONE, 2)
    assert decode(with_bits(21), QUIET, WORDS, 64, limits).highest[0, 0] == 21
    with pytest.raises(PatternError, match="expected at most 3 for a code of 6 bits, found 4"):
        spread_of_read(with_bits(21), DecodingLimits(drop_finest_bits=4))


def test_the_centre_of_an_interval_is_nan_where_refused() -> None:
    code = CodeMap(
        np.array([[4, -1]], dtype=np.int32), np.array([[5, -1]], dtype=np.int32), np.array([[0, 3]], dtype=np.uint8)
    )
    np.testing.assert_array_equal(code.centre(), [[4.5, np.nan]])


@pytest.mark.parametrize(("cell", "offset_px", "beyond"), [(39, 0, []), (40, 0, [40]), (63, 0, [63]), (7, 32, [7])])
def test_cells_before_and_after_the_projectors_are_counted(cell: int, offset_px: int, beyond: list[int]) -> None:
    """Cells of 4 px: the first of the projector is that of the offset, and there are 40 in all."""
    frames = one_pixel(swings_of(cell))
    frames = replace(frames, gray=replace(frames.gray, offset_px=offset_px))
    code = decode(frames, QUIET, WORDS, 40, LIMITS)
    assert cells_beyond(frames, code, WORDS).tolist() == beyond
