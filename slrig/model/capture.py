"""Frames as cameras deliver them, captures of whole pattern sequences, and exposure brackets."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

from slrig.errors import BundleError
from slrig.model.geometry import Axis, Pixels, Size, require_array
from slrig.model.patterns import Gray, LineShift, Pattern, Sine

MIN_EXPOSURES, MAX_EXPOSURES = 2, 6
"""Number of exposures in a bracket."""

MAX_MISSING_BITS = 3
"""A code that lacks more bits has cells more than eight times as wide: decoding refuses it instead."""

_MIN_EXPOSURE_RATIO = 1.1
_SAME_EXPOSURE_RATIO = 1.05  # exposures that a camera reads back for one setting differ by less


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture of one camera, as its driver delivers it. Times are CLOCK_MONOTONIC or the rig's own clock, ns.

    image : (H, W) uint8 or uint16. t_start_ns, t_end_ns : exposure from the first row's start to the last row's end,
    exposure_s + shutter_skew_s, each known to ± t_err_ns. sequence_number : counts every frame of the sensor.
    dropped_count : frames lost since the camera was armed. shutter_skew_s : delay of the last row of a rolling shutter
    after the first; 0 for a global shutter, or if the driver does not know. colour : computes the same picture as
    (H, W, 3) blue, green, red of the image's dtype, on demand because it takes time; None for a mono camera.
    """

    camera: str
    image: Pixels
    t_start_ns: int
    t_end_ns: int
    t_err_ns: int
    sequence_number: int
    dropped_count: int
    exposure_s: float
    gain: float
    shutter_skew_s: float = 0.0
    colour: Callable[[], Pixels] | None = None

    def __post_init__(self) -> None:
        require_array(self.image, "Frame.image", (None, None), "u")


@dataclass(frozen=True, slots=True)
class CameraFormat:
    """Extent and bit depth of a camera's frames; full scale is 2^bit_depth - 1."""

    size: Size
    bit_depth: int

    def __post_init__(self) -> None:
        if not 1 <= self.bit_depth <= 16:
            raise BundleError(f"bit_depth: expected 1 to 16, found {self.bit_depth}")

    @property
    def full_scale(self) -> int:
        """Value of a saturated sample."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True, slots=True)
class Shot:
    """A frame together with the pattern that it shows. `time_s` counts from the first frame.

    pattern : index into the capture's patterns. colour : (H, W, 3) blue, green, red of the image's dtype, for white
    and black frames of colour cameras; None otherwise. Decoding uses `image` only.
    """

    pattern: int
    camera: str
    image: Pixels
    exposure_s: float | None = None
    time_s: float | None = None
    colour: Pixels | None = None

    def __post_init__(self) -> None:
        require_array(self.image, "Shot.image", (None, None), "u")
        if self.colour is not None:
            require_array(self.colour, "Shot.colour", (*self.image.shape, 3), "u")


@dataclass(frozen=True, slots=True)
class Capture:
    """All frames of one pattern sequence, with the patterns as data.

    Raises BundleError: a shot refers to an unknown pattern or camera, or has another size than its camera.
    """

    projector: Size
    patterns: tuple[Pattern, ...]
    cameras: Mapping[str, CameraFormat]
    shots: tuple[Shot, ...]

    def __post_init__(self) -> None:
        for shot in self.shots:
            if not 0 <= shot.pattern < len(self.patterns) or shot.camera not in self.cameras:
                message = f"a frame names pattern {shot.pattern} of camera '{shot.camera}', which is not in the list"
                raise BundleError(message)
            size = self.cameras[shot.camera].size
            if shot.image.shape != size.shape:
                rows, columns = shot.image.shape
                raise BundleError(f"a frame of camera '{shot.camera}' is {columns} x {rows}, the camera is {size}")


@dataclass(frozen=True, slots=True)
class CaptureHeader:
    """A `Capture` without its images, known before the first frame. frames : pattern and camera of each, in order."""

    projector: Size
    patterns: tuple[Pattern, ...]
    cameras: Mapping[str, CameraFormat]
    frames: tuple[tuple[int, str], ...]

    @classmethod
    def from_capture(cls, capture: Capture) -> CaptureHeader:
        """Build the header of a complete capture."""
        frames = tuple((shot.pattern, shot.camera) for shot in capture.shots)
        return cls(capture.projector, capture.patterns, capture.cameras, frames)

    @property
    def displayed_patterns(self) -> frozenset[Pattern]:
        """Patterns that have frames; `patterns` may list more."""
        return frozenset(self.patterns[index] for index, _ in self.frames)

    @property
    def axes(self) -> frozenset[Axis]:
        """Axes with frames of Gray code or sinusoids."""
        return frozenset(pattern.axis for pattern in self.displayed_patterns if isinstance(pattern, Gray | Sine))


def bracket_fault(exposures_s: Sequence[float]) -> str | None:
    """Return why these exposure times are not a bracket, and which ones to use; None if they are one.

    >>> bracket_fault([0.005, 0.02, 0.08]) is None
    True
    """
    found = ", ".join(f"{each:g}" for each in exposures_s)
    if not MIN_EXPOSURES <= len(exposures_s) <= MAX_EXPOSURES:
        return (
            f"expected {MIN_EXPOSURES} to {MAX_EXPOSURES} exposure times, found {len(exposures_s)} ({found}); "
            "three, each four times as long as the one before, are usual, and one alone is exposure_s"
        )
    if not all(0 < each < float("inf") for each in exposures_s):
        return f"expected finite times above 0 s, found {found}; 0.005, 0.02, 0.08 are usual"
    # 0.011 is slightly less than 1.1 times 0.01 in binary.
    if any(longer < (_MIN_EXPOSURE_RATIO - 1e-9) * shorter for shorter, longer in pairwise(sorted(exposures_s))):
        return (
            f"expected times that differ by {_MIN_EXPOSURE_RATIO - 1:.0%} at least, found {found}; four times as long "
            "as the one before is usual"
        )
    return None


def exposure_groups(exposures_s: Iterable[float | None]) -> dict[float | None, float | None]:
    """Map each exposure time to the shortest one that is nearly equal; None maps to None.

    A camera that measures the exposure of each frame returns slightly different times for one setting.

    >>> exposure_groups([0.02, 0.005, 0.0201, None])
    {None: None, 0.005: 0.005, 0.02: 0.02, 0.0201: 0.02}
    """
    distinct = set(exposures_s)
    groups: dict[float | None, float | None] = {None: None} if None in distinct else {}
    shortest = 0.0
    for each in sorted(e for e in distinct if e is not None):
        if each > _SAME_EXPOSURE_RATIO * shortest:
            shortest = each
        groups[each] = shortest
    return groups


def trim_incomplete_codes(capture: Capture, /) -> tuple[Capture, tuple[str, ...]]:
    """Return the capture with a complete Gray code on each axis, and a note for each code that was shortened.

    A bit is missing if one camera has no frame of it, direct or inverted. It is removed together with all finer bits.
    A code without its k finest bits is complete again with cells 2^k times as wide, because the first bits of the code
    word of i are the code word of ⌊i/2^k⌋: (i ^ (i >> 1)) >> k = j ^ (j >> 1) with j = i >> k.

    A code is left unchanged, for decoding to refuse, if it would lose more than `MAX_MISSING_BITS` or half of its bits,
    or could no longer number the lines.
    """
    notes = []
    for axis in Axis:
        by_camera = [_patterns_with_frames(capture, name, axis) for name in capture.cameras]
        codes = {(p.bits, p.cell_px, p.offset_px) for each in by_camera for p in each if isinstance(p, Gray)}
        if len(codes) != 1:
            continue
        ((bits, cell_px, offset_px),) = codes
        present = [{p.bit for p in each if isinstance(p, Gray)} for each in by_camera]
        remaining = next((bit for bit in range(bits) if not all(bit in each for each in present)), bits)
        wide_px = cell_px << (bits - remaining)
        periods_px = [p.period_px for each in by_camera for p in each if isinstance(p, LineShift)]
        if (
            remaining == bits
            or bits - remaining > min(MAX_MISSING_BITS, bits // 2)
            or any(2 * wide_px > period_px for period_px in periods_px)
        ):
            continue
        capture = _shorten_code(capture, Gray(axis, 0, remaining, wide_px, offset_px))
        notes.append(
            f"a camera has no frame of bit {remaining + 1} of the {bits} of the {axis} code: the first {remaining} are "
            f"used, with cells of {wide_px} px instead of {cell_px}; scan again with all bits for finer cells"
        )
    return capture, tuple(notes)


def _patterns_with_frames(capture: Capture, camera: str, axis: Axis) -> set[Gray | LineShift]:
    patterns = (capture.patterns[shot.pattern] for shot in capture.shots if shot.camera == camera)
    return {p for p in patterns if isinstance(p, Gray | LineShift) and p.axis is axis}


def _shorten_code(capture: Capture, code: Gray) -> Capture:
    """Replace the code of an axis by a shorter one, and drop the frames of bits that it lacks."""
    new_index: dict[int, int] = {}
    patterns: list[Pattern] = []
    for index, pattern in enumerate(capture.patterns):
        if isinstance(pattern, Gray) and pattern.axis is code.axis:
            if pattern.bit >= code.bits:
                continue
            pattern = replace(code, bit=pattern.bit, inverted=pattern.inverted)
        new_index[index] = len(patterns)
        patterns.append(pattern)
    shots = tuple(replace(s, pattern=new_index[s.pattern]) for s in capture.shots if s.pattern in new_index)
    return replace(capture, patterns=tuple(patterns), shots=shots)
