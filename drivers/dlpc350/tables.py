"""The engine's pattern table and image table for a sequence.

An entry of the pattern table is 24 bits (DLPU010, "Pattern Display LUT Data"; TI's `DLPC350_AddToPatLut`):

    0-1   trigger: 0 internal, 1 and 2 external, 3 goes on from the pattern before
    2-7   number of the pattern: of the plane, for a bit depth of 1
    8-11  bit depth
    12-14 LEDs: red, green, blue
    16    inverted
    17    cleared to black afterwards, which takes 230 µs; needed where the exposure is shorter than the period
    18    takes the next picture of the image table before; so does the first entry of all
    19    shares the trigger output of the entry before

The image table has one byte per picture, in the order in which they are taken. A table of two pictures is sent with the
second one first: so do TI's own sources (`DLPC350_SendImageLut`, "special case of 2 entries").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

from drivers.dlpc350.flash import FlashedPlane
from drivers.pattern_engine.options import LedColour

INTERNAL = 0
_BIT_DEPTH = 1


@dataclass(frozen=True, slots=True)
class PatternTables:
    """What the engine is sent. counts : patterns per picture, in the order in which the pictures are taken."""

    patterns: bytes
    images: bytes
    counts: tuple[int, ...]

    @property
    def length(self) -> int:
        """Number of patterns."""
        return sum(self.counts)


def build_tables(places: Sequence[FlashedPlane], colours: Sequence[LedColour], *, dark_between: bool) -> PatternTables:
    """Return the tables that show these places one after the other, each lit by LEDs of its own."""
    words: list[int] = []
    previous: int | None = None
    for place, colour in zip(places, colours, strict=True):
        words.append(
            INTERNAL
            | place.plane << 2
            | _BIT_DEPTH << 8
            | colour << 12
            | place.inverted << 16
            | dark_between << 17
            | (place.image != previous) << 18
        )
        previous = place.image
    runs = [(image, len(list(run))) for image, run in groupby(places, key=lambda place: place.image)]
    images = [image for image, _ in runs]
    if len(images) == 2:
        images.reverse()
    return PatternTables(
        b"".join(word.to_bytes(3, "little") for word in words), bytes(images), tuple(count for _, count in runs)
    )
