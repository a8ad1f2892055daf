"""Frames of one camera and axis, sorted by pattern, ready for decoding.

Repeats of a pattern at one exposure are averaged. Several exposures are a bracket: see `slrig.reconstruction.fusion`.

Images stay as they came, of whole numbers: as float32 those of a large sensor would take four times the memory. What is
computed takes them so a few rows at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    Capture,
    Gray,
    IntArray,
    LineShift,
    Pattern,
    Shot,
    White,
    diagnostic_bits,
    diagnostic_line_pairs,
    exposure_groups,
    has_even_shifts,
)

Image = NDArray[np.float32]
Images = Sequence[NDArray[Any]] | NDArray[np.float32]
"""(H, W) each, of one extent, of whole numbers or float32."""

NEARLY_FULL = 0.97
"""Of full scale: from here on sensors bend."""

_NEAR_MIDDLE = 0.3  # of the contrast

_BAND_BYTES = 2**22
"""Of what is made of images at a time: it stays in a core's cache."""


def rows_of(images: Images, rows: slice = slice(None)) -> NDArray[np.float32]:
    """(n, rows, W) float32: some rows of all images."""
    found = np.zeros((len(images), *images[0][rows].shape), dtype=np.float32)
    for image, out in zip(images, found, strict=True):
        out[:] = image[rows]
    return found


def sampled(images: Images, row_step: int, column_step: int) -> NDArray[np.float32]:
    """(n, rows, columns) float32: every so many pixels of all images."""
    return np.array([image[::row_step, ::column_step] for image in images], dtype=np.float32)


def band_rows(images: Images, columns: int) -> int:
    """How many rows of all images, of so many columns, are worked on at a time."""
    return max(16, _BAND_BYTES // (4 * columns * max(len(images), 1)))


def at_rows(values: Any, rows: slice | IntArray) -> Any:
    """Some rows of (H, W) values; what is not an array holds for all."""
    return values[rows] if isinstance(values, np.ndarray) else values


def straight(image: NDArray[Any], gamma: float, full_scale: float) -> Image:
    """The image in proportion to light, float32, of a camera whose values are light to the power of 1/gamma."""
    if gamma == 1:
        return np.asarray(image, dtype=np.float32)
    share = np.maximum(image, 0).astype(np.float32) / np.float32(full_scale)
    return np.asarray(np.float32(full_scale) * share ** np.float32(gamma))


@dataclass(frozen=True, slots=True)
class AxisFrames:
    """What one camera saw of the patterns of one axis. Images are (H, W) in camera units, white and black float32.

    bits : B images, most significant first; inverses : the same, or None where none were shown.
    lines : L images, one per shift; line_patterns says which.
    full_scale : the value of a saturated sample of one exposure.
    ends_repeats : white and black are means of so many times more frames than the others.
    exposure_ratio : the light of a bracket's longest exposure over that of its shortest; 1 without a bracket.
    """

    axis: Axis
    white: Image
    black: Image
    bits: Images
    inverses: Images | None
    gray: Gray
    lines: Images
    line_patterns: tuple[LineShift, ...]
    full_scale: float
    exposure_ratio: float = 1.0
    ends_repeats: float = 1.0

    @property
    def clipped_at(self) -> float:
        """The least value of a clipped sample: a bracket's are scaled to the longest exposure."""
        return self.full_scale * self.exposure_ratio

    @property
    def telling_lines(self) -> tuple[list[NDArray[Any]], list[NDArray[Any]]] | None:
        """Of single bits, two line images and their inverses, which tell what the camera makes of light; None where
        there are none.
        """
        pairs = () if self.inverses is not None else diagnostic_line_pairs(self.line_patterns)
        direct, inverted = ([self.lines[self.line_patterns.index(pair[i])] for pair in pairs] for i in (0, 1))
        return (direct, inverted) if pairs else None

    @property
    def lines_halve(self) -> bool:
        """Whether the lines' mean is the middle of white and black: see `halving`."""
        return len(self.lines) > 0 and halving(self.line_patterns)

    @property
    def middle(self) -> Image:
        """(H, W) float32: what single bits are held against: the middle of white and black, or near it the mean of
        lines that light half of their period: a projector's white may be dimmer than its other patterns.
        """
        middle = np.asarray(self.white + self.black, dtype=np.float32) / np.float32(2)
        if not self.lines_halve:
            return middle
        average = np.zeros(middle.shape, dtype=np.float32)
        for line in self.lines:
            average += line
        average /= len(self.lines)
        near = np.abs(average - middle) < _NEAR_MIDDLE * self.contrast
        average[~near] = middle[~near]
        return average

    @property
    def contrast(self) -> Image:
        """(H, W) float32: white minus black, the light that the projector adds."""
        return self.white - self.black

    def rows(self, rows: slice | IntArray) -> AxisFrames:
        """Some rows of all images."""
        return replace(
            self,
            white=self.white[rows],
            black=self.black[rows],
            bits=[image[rows] for image in self.bits],
            inverses=None if self.inverses is None else [image[rows] for image in self.inverses],
            lines=[image[rows] for image in self.lines],
        )


@dataclass(frozen=True, slots=True)
class AxisPatterns:
    """What one camera is shown along one axis, in the order in which decoding wants it.

    gray : the code, as its first bit; direct, inverted : the bits shown so; lines : by shift; ends : White and Black as
    far as they are shown.
    """

    gray: Gray
    direct: frozenset[int]
    inverted: frozenset[int]
    lines: tuple[LineShift, ...]
    ends: frozenset[White | Black]

    @property
    def paired(self) -> bool:
        """Whether every bit comes with its inverse."""
        return len(self.direct) == len(self.inverted) == self.gray.bits

    @property
    def showing_noise(self) -> frozenset[Pattern]:
        """The patterns that tell the camera's noise and response: with inverses and ends `diagnostic_bits`; without
        inverses `diagnostic_line_pairs`, or else lines of half their period and some bits; otherwise all of the code.
        """
        if len(self.ends) == 2:
            told = diagnostic_line_pairs(self.lines)
            bits = [replace(self.gray, bit=bit) for bit in diagnostic_bits(self.gray.bits)]
            if self.paired:
                return frozenset((*self.ends, *bits, *(replace(bit, inverted=True) for bit in bits)))
            if self.halving and not self.inverted:
                lines = [line for pair in told for line in pair] or self.lines
                return frozenset((*self.ends, *bits, *lines))
        return frozenset(each for each in self.needed if not isinstance(each, LineShift))

    @property
    def showing_code(self) -> frozenset[Pattern]:
        """The patterns that the code is read from."""
        if self.halving and not self.paired:
            return self.needed
        return frozenset(each for each in self.needed if not isinstance(each, LineShift))

    @property
    def halving(self) -> bool:
        """Whether lines light half of their period, and all of them together every place alike."""
        return halving(self.lines)

    @property
    def needed(self) -> frozenset[Pattern]:
        """The patterns whose images decoding takes."""
        direct = (replace(self.gray, bit=bit) for bit in self.direct)
        inverted = (replace(self.gray, bit=bit, inverted=True) for bit in self.inverted)
        return frozenset((*self.ends, *direct, *inverted, *self.lines))


def axis_patterns(shown: Collection[Pattern], camera: str, axis: Axis) -> AxisPatterns:
    """Sort the patterns that one camera is shown, as far as one axis needs them.

    Raises
    ------
    PatternError
        Bits are missing or of two codes, or there is neither a white-black pair nor inverses to threshold with.
    """
    grays = [p for p in shown if isinstance(p, Gray) and p.axis is axis]
    if not grays:
        message = (
            f"camera '{camera}' has no Gray-code frames of the {axis.value} axis; a scan needs them to number lines"
        )
        raise PatternError(message)
    codes = {(p.bits, p.cell_px, p.offset_px) for p in grays}
    if len(codes) > 1:
        message = (
            f"camera '{camera}' has Gray-code frames of {len(codes)} different codes on the {axis.value} axis "
            f"(bits, cell, offset): {sorted(codes)}; keep one"
        )
        raise PatternError(message)
    first = grays[0]
    direct = frozenset(p.bit for p in grays if not p.inverted)
    inverted = frozenset(p.bit for p in grays if p.inverted)
    missing = [b for b in range(first.bits) if b not in direct | inverted]
    if missing:
        message = (
            f"camera '{camera}', {axis.value} axis: bits {missing} of {first.bits} have no frame; "
            "shoot them again or lower the number of bits"
        )
        raise PatternError(message)
    ends = frozenset(p for p in shown if isinstance(p, White | Black))
    if len(ends) < 2 and not direct & inverted:
        message = (
            f"camera '{camera}' has no white and black frames and no bit with its inverse: "
            "nothing tells lit from dark; add a white and a black frame, or inverses"
        )
        raise PatternError(message)
    lines = tuple(sorted((p for p in shown if isinstance(p, LineShift) and p.axis is axis), key=lambda p: p.shift))
    if len({(p.period_px, p.line_width_px) for p in lines}) > 1:
        message = f"camera '{camera}' has line-shift frames of two periods or widths on the {axis.value} axis; keep one"
        raise PatternError(message)
    return AxisPatterns(Gray(axis, 0, first.bits, first.cell_px, first.offset_px), direct, inverted, lines, ends)


def halving(lines: Sequence[LineShift], /) -> bool:
    """Whether lines light half of their period, and their shifts divide it evenly: their mean is then the middle of
    white and black. lines : of one axis, period and width, by shift.
    """
    return has_even_shifts(lines) and lines[0].is_half_lit


def telling(shown: Sequence[Pattern], exposures_s: Sequence[float | None]) -> list[bool]:
    """Which of a camera's frames are reconstructed from; the others prove only that nothing has changed.

    shown, exposures_s : pattern and exposure of each frame, in the order of the sequence.
    Where every code and line pattern is shown once, the white and black frames before the first of them tell, so that
    each frame can be used as it comes; those that close the sequence do not. Where patterns are repeated or bracketed,
    or nothing opens the sequence, all do.
    """
    bodies = [i for i, p in enumerate(shown) if isinstance(p, Gray | LineShift)]
    once = len({shown[i] for i in bodies}) == len(bodies) and exposure_count(exposures_s) <= 1
    if not (once and bodies and {White(), Black()} <= set(shown[: bodies[0]])):
        return [True] * len(shown)
    return [i < bodies[0] or not isinstance(p, White | Black) for i, p in enumerate(shown)]


def exposure_count(exposures_s: Collection[float | None]) -> int:
    """How many different exposure times these are."""
    return len(set(exposure_groups(exposures_s).values()))


class FrameStacks:
    """The frames of one camera and axis while they come, each put where decoding wants it.

    shape : (rows, columns) of the images; ends_repeats : as in `AxisFrames`.
    """

    def __init__(
        self,
        patterns: AxisPatterns,
        shape: tuple[int, int],
        *,
        full_scale: float,
        exposure_ratio: float = 1.0,
        ends_repeats: float = 1.0,
    ) -> None:
        self.patterns = patterns
        self._scales = {"full_scale": full_scale, "exposure_ratio": exposure_ratio, "ends_repeats": ends_repeats}
        bits = patterns.gray.bits
        dark = np.broadcast_to(np.zeros(1, dtype=np.uint8), shape)
        self._bits: list[NDArray[Any]] = [dark] * bits
        self._inverses: list[NDArray[Any]] = [dark] * (bits if patterns.inverted else 0)
        self._lines: list[NDArray[Any]] = [dark] * len(patterns.lines)
        self._ends: dict[Pattern, Image] = {}
        self._missing = set(patterns.needed)
        self._gamma = 1.0

    @classmethod
    def of(cls, frames: AxisFrames) -> FrameStacks:
        """The stacks of frames that are all in."""
        bits = frozenset(range(frames.gray.bits))
        stacks = cls(
            AxisPatterns(
                frames.gray, bits, bits if frames.inverses is not None else frozenset(), frames.line_patterns,
                frozenset((White(), Black())),
            ),
            (0, 0), full_scale=frames.full_scale, exposure_ratio=frames.exposure_ratio,
            ends_repeats=frames.ends_repeats,
        )  # fmt: skip
        stacks._bits, stacks._lines = list(frames.bits), list(frames.lines)
        stacks._inverses = [] if frames.inverses is None else list(frames.inverses)
        stacks._ends = {White(): frames.white, Black(): frames.black}
        stacks._missing = set()
        return stacks

    def put(self, pattern: Pattern, image: NDArray[Any]) -> None:
        """Take the (H, W) image of a pattern, which nobody may change; of one that this axis does not need, nothing is
        kept.
        """
        if pattern not in self._missing:
            return
        if self._gamma != 1:
            image = self._straight(image)
        if isinstance(pattern, Gray):
            (self._inverses if pattern.inverted else self._bits)[pattern.bit] = image
        elif isinstance(pattern, LineShift):
            self._lines[self.patterns.lines.index(pattern)] = image
        else:
            self._ends[pattern] = image.astype(np.float32)
        self._missing.discard(pattern)

    def let_lines_go(self) -> None:
        """Drop the images of lines, of the frames that were given out, too."""
        self._lines.clear()

    def let_go(self) -> None:
        """Drop the images of code and lines, of the frames that were given out, too."""
        for images in (self._bits, self._inverses, self._lines):
            images.clear()

    def straighten(self, gamma: float) -> None:
        """Make all values proportional to light, of the images that are in and of those that come.

        gamma : of a camera whose values are light to the power of 1/gamma.
        """
        self._gamma = gamma
        for images in (self._bits, self._inverses, self._lines):
            images[:] = [self._straight(each) for each in images]
        self._ends = {pattern: self._straight(image) for pattern, image in self._ends.items()}

    def _straight(self, image: NDArray[Any]) -> NDArray[np.float32]:
        return straight(image, self._gamma, self._scales["full_scale"])

    def has(self, pattern: Pattern) -> bool:
        """Whether the image of a pattern is in."""
        return pattern not in self._missing

    @property
    def missing(self) -> frozenset[Pattern]:
        """The patterns whose images are not in."""
        return frozenset(self._missing)

    @property
    def noise_shown(self) -> bool:
        """Whether all is in that tells the camera's noise and response."""
        return self._missing.isdisjoint(self.patterns.showing_noise)

    @property
    def coded(self) -> bool:
        """Whether all is in that the code is read from."""
        return self._missing.isdisjoint(self.patterns.showing_code)

    def frames(self) -> AxisFrames:
        """The frames, once `noise_shown`; those that are not in are black until they are."""
        patterns = self.patterns
        pairs = sorted(patterns.direct & patterns.inverted)
        white, black = self._ends.get(White()), self._ends.get(Black())
        both = [each for bit in pairs for each in (self._bits[bit], self._inverses[bit])]
        if white is None:
            white = reduce(np.maximum, both).astype(np.float32)
        if black is None:
            black = reduce(np.minimum, both).astype(np.float32)
        for bit in patterns.inverted - patterns.direct:
            self._bits[bit] = white + black - self._inverses[bit]
        return AxisFrames(
            axis=patterns.gray.axis,
            white=white,
            black=black,
            bits=self._bits,
            inverses=self._inverses if patterns.paired else None,
            gray=patterns.gray,
            lines=self._lines,
            line_patterns=patterns.lines,
            **self._scales,
        )


def axis_frames(capture: Capture, camera: str, axis: Axis) -> AxisFrames:
    """Sort the frames of one camera, all of one exposure, for decoding along one axis.

    Raises
    ------
    PatternError
        As `axis_patterns` does, or there are several exposures, which have to be fused.
    """
    shots = telling_shots(capture, camera)
    if exposure_count([shot.exposure_s for shot in shots]) > 1:
        message = (
            f"camera '{camera}': expected frames of one exposure, found "
            f"{sorted({str(shot.exposure_s) for shot in shots})} s; fuse them first"
        )
        raise PatternError(message)
    repeats: dict[Pattern, list[NDArray[Any]]] = {}
    for shot in shots:
        repeats.setdefault(capture.patterns[shot.pattern], []).append(shot.image)
    stacks = FrameStacks(
        axis_patterns(repeats, camera, axis),
        capture.cameras[camera].size.shape,
        full_scale=float(capture.cameras[camera].full_scale),
        ends_repeats=ends_repeats([capture.patterns[shot.pattern] for shot in shots], axis),
    )
    for pattern, images in repeats.items():
        if not stacks.has(pattern):
            stacks.put(pattern, mean_image(images))
    return stacks.frames()


def telling_shots(capture: Capture, camera: str) -> list[Shot]:
    """The frames of a camera that are reconstructed from; see `telling`."""
    shots = [shot for shot in capture.shots if shot.camera == camera]
    tells = telling([capture.patterns[shot.pattern] for shot in shots], [shot.exposure_s for shot in shots])
    return [shot for shot, used in zip(shots, tells, strict=True) if used]


def ends_repeats(shown: Sequence[Pattern], axis: Axis) -> float:
    """How many times more frames white and black are means of than the others; 1 where there are none of one."""
    counts = Counter(shown)
    others = [n for p, n in counts.items() if isinstance(p, Gray | LineShift) and p.axis is axis]
    return max(1.0, min(counts[White()], counts[Black()]) / max(others, default=1))


def mean_image(repeats: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """The mean of images of one pattern, float32; a single one as it is."""
    if len(repeats) == 1:
        return repeats[0]
    return np.asarray(np.mean(repeats, axis=0, dtype=np.float64), dtype=np.float32)
