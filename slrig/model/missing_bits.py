"""Recordings whose Gray code lacks a fine bit: the code without it, and without those finer still, is whole.

The cells of a code without its k finest bits are 2^k times as wide: ⌊i/2^k⌋ has the first bits of i's code word, for
(i ^ (i >> 1)) >> k = j ^ (j >> 1) with j = i >> k.
"""

from __future__ import annotations

from dataclasses import replace

from slrig.model.frames import Capture
from slrig.model.patterns import Gray, LineShift, Pattern
from slrig.model.rig import Axis

MOST_BITS = 3
"""Beyond that the cells are more than eight times as wide, and whoever shot the frames should know."""


def without_missing_bits(capture: Capture, /) -> tuple[Capture, tuple[str, ...]]:
    """The capture with a whole code on each axis, and words for each that was cut short; the same where none was.

    A bit is missing where a camera has no frame of it, direct or inverted; its finer ones go with it. A code that would
    lose more than `MOST_BITS` or half of its bits, or number lines no longer, is left as it is: decoding refuses it.
    """
    told = []
    for axis in Axis:
        shown = [_shown(capture, name, axis) for name in capture.cameras]
        codes = {(p.bits, p.cell_px, p.offset_px) for each in shown for p in each if isinstance(p, Gray)}
        if len(codes) != 1:
            continue
        ((bits, cell_px, offset_px),) = codes
        seen = [{p.bit for p in each if isinstance(p, Gray)} for each in shown]
        kept = next((bit for bit in range(bits) if not all(bit in each for each in seen)), bits)
        wide_px = cell_px << (bits - kept)
        periods = [p.period_px for each in shown for p in each if isinstance(p, LineShift)]
        if (
            kept == bits
            or bits - kept > min(MOST_BITS, bits // 2)
            or any(2 * wide_px > period_px for period_px in periods)
        ):
            continue
        capture = _cut(capture, Gray(axis, 0, kept, wide_px, offset_px))
        told.append(
            f"a camera has no frame of bit {kept + 1} of the {bits} of the {axis} code: the first {kept} are used, "
            f"with cells of {wide_px} px instead of {cell_px}; shoot it again with all of them for finer ones"
        )
    return capture, tuple(told)


def _shown(capture: Capture, camera: str, axis: Axis) -> set[Gray | LineShift]:
    """The patterns of an axis of which a camera has a frame."""
    patterns = (capture.patterns[shot.pattern] for shot in capture.shots if shot.camera == camera)
    return {p for p in patterns if isinstance(p, Gray | LineShift) and p.axis is axis}


def _cut(capture: Capture, code: Gray) -> Capture:
    """The capture with this code in place of that of its axis, without the frames of bits that it has not."""
    place: dict[int, int] = {}
    patterns: list[Pattern] = []
    for index, pattern in enumerate(capture.patterns):
        if isinstance(pattern, Gray) and pattern.axis is code.axis:
            if pattern.bit >= code.bits:
                continue
            pattern = replace(code, bit=pattern.bit, inverted=pattern.inverted)
        place[index] = len(patterns)
        patterns.append(pattern)
    shots = tuple(replace(s, pattern=place[s.pattern]) for s in capture.shots if s.pattern in place)
    return replace(capture, patterns=tuple(patterns), shots=shots)
