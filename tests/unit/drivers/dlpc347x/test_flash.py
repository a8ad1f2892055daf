"""The block of patterns in the flash: as TI's own source makes it, and read back as what it holds."""

from __future__ import annotations

import hashlib

import pytest

from drivers.dlpc347x.flash import Lines, block_of, places_in, places_of, size_of
from drivers.dlpc347x.projector import MIRRORS
from slrig.model import Axis, Gray, LineShift, Pattern, PatternSequence, Size
from slrig.patterns.sequence import encode, scan_patterns, united


def scanned(size: Size, *, period_px: int = 16) -> PatternSequence:
    patterns = scan_patterns(
        size, line_shift=True, period_px=period_px, line_width_px=2, gray_cell_px=8, gray_offset_px=0, rows=True
    )
    return united([encode(patterns, size)])


def as_compiled(pattern: Pattern) -> tuple[bool, bool, int]:
    """Sorts patterns by axis, then code before lines, then bits; white and black stay first."""
    if not isinstance(pattern, Gray | LineShift):
        return False, False, -1
    return pattern.axis is Axis.ROW, isinstance(pattern, LineShift), pattern.bit if isinstance(pattern, Gray) else 0


@pytest.mark.parametrize(
    ("controller", "length", "digest"),
    [
        (0x0F, 5452, "f0f9763ef262f0a52431036c95b6721c8c7f623d809b988ab7461a9950d3e50e"),
        (0x0B, 8588, "bbe4e531db9392805b491c2e378a1b536e43ce6a59022a1474f908a012e98839"),
    ],
)
def test_a_block_is_what_tis_own_source_makes_of_the_same_patterns(controller: int, length: int, digest: str) -> None:
    # dlpc347x_internal_patterns.c as `drivers.dlpc347x.flash` cites it, compiled and run once: of each axis all bits,
    # and then the lines.
    _, mirrors = MIRRORS[controller]
    found = scanned(mirrors.size)
    ordered = sorted(zip(found.patterns, found.profiles, strict=True), key=lambda each: as_compiled(each[0]))
    patterns, profiles = zip(*ordered, strict=True)
    block = block_of(PatternSequence(found.projector, patterns, profiles), Lines(mirrors, (False, False)))
    assert (len(block), hashlib.sha256(block).hexdigest()) == (length, digest)
    assert size_of(block[:20]) == length


def test_more_patterns_than_a_set_holds_go_into_further_ones_with_white_and_black() -> None:
    _, mirrors = MIRRORS[0x0B]
    lines = Lines(mirrors, (False, False))
    sequence = scanned(mirrors.size, period_px=80)
    held = places_in(block_of(sequence, lines))
    places = places_of(sequence, lines, held)
    assert len(held) > 2 * 80
    assert {place.set for place in places} == {0, 1, 2, 3}
    assert max(place.index for found in held.values() for place in found) == 63
    columns = encode(sequence.patterns[60:90], mirrors.size)
    assert {place.set for place in places_of(columns, lines, held)} == {0, 1}
    white_and_one = encode((sequence.patterns[0], sequence.patterns[90]), mirrors.size)
    assert {place.set for place in places_of(white_and_one, lines, held)} == {1}
