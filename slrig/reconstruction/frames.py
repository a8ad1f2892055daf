"""Frames of one camera and axis, sorted by pattern for decoding.

Repeats of a pattern at one exposure are averaged. Several exposures form a bracket: see `slrig.reconstruction.fusion`.

Images keep their integer type, since float32 would take four times the memory for large sensors. Computations convert a
few rows at a time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.errors import PatternError
from slrig.model import (
    Axis,
    Black,
    Capture,
    FloatArray,
    Gray,
    IntArray,
    LineShift,
    Pattern,
    Shot,
    Sine,
    White,
    diagnostic_bits,
    diagnostic_line_pairs,
    exposure_groups,
    has_even_shifts,
    sine_groups,
)

Image = NDArray[np.float32]
Images = Sequence[NDArray[Any]] | NDArray[np.float32]
"""(H, W) each, of one size, integers or float32."""

NEAR_SATURATION = 0.97
"""Share of full scale from which sensors are not linear."""

_NEAR_MIDDLE = 0.3  # of the contrast

_WORD = 1 << 16
_USUAL_BITS = (8, 10, 12, 14, 16)  # of samples in words of 16
_MIN_VALUES = 100  # different ones, of which some are then neighbours
_MIN_PILE = 4  # times the samples of the next value: noise has fewer at its end
_MAX_COUNTED = 200_000  # samples of an image
_BAND_BYTES = 2**22
"""Size of the part of images that is computed at a time: it fits the cache of a core."""


def stack_rows(images: Images, rows: slice = slice(None)) -> NDArray[np.float32]:
    """(n, rows, W) float32: some rows of all images."""
    stacked = np.zeros((len(images), *images[0][rows].shape), dtype=np.float32)
    for image, out in zip(images, stacked, strict=True):
        out[:] = image[rows]
    return stacked


def subsample(images: Images, row_step: int, column_step: int) -> NDArray[np.float32]:
    """(n, rows, columns) float32: pixels of all images at these steps."""
    return np.array([image[::row_step, ::column_step] for image in images], dtype=np.float32)


def rows_per_band(images: Images, columns: int) -> int:
    """Number of rows with this many columns, of all images, to process at a time."""
    return max(16, _BAND_BYTES // (4 * columns * max(len(images), 1)))


def select_rows(values: Any, rows: slice | IntArray) -> Any:
    """Select rows of (H, W) values; return a value that is not an array as it is."""
    return values[rows] if isinstance(values, np.ndarray) else values


def linearise(image: NDArray[Any], gamma: float, full_scale: float) -> Image:
    """Convert an image of a camera whose values are light to the power of 1/gamma to float32 in proportion to light."""
    if gamma == 1:
        return np.asarray(image, dtype=np.float32)
    share = np.maximum(image, 0).astype(np.float32) / np.float32(full_scale)
    return np.asarray(np.float32(full_scale) * share ** np.float32(gamma))


class SampleFormat(NamedTuple):
    """step : difference of neighbouring values of a sample; full_scale : value of a saturated sample."""

    step: float
    full_scale: float


def sample_format(images: Iterable[NDArray[Any]], full_scale: float) -> SampleFormat:
    """Find how 16-bit images use their words; for other images, or few different values, return `full_scale`.

    Cameras of 10 to 14 bits fill the upper bits of a word, whose lowest ones are then 0, or the lower ones. The step is
    the least difference of values. Full scale is that of the fewest usual bits which hold all values, if so many of
    them are the largest possible that they must be clipped, or if `full_scale` is that of the whole word.
    """
    counts = np.zeros(_WORD, dtype=np.int64)
    for image in images:
        if image.dtype == np.uint16:
            counts += np.bincount(image[:: max(1, image.size // _MAX_COUNTED)].ravel(), minlength=_WORD)
    values = np.flatnonzero(counts)
    if len(values) < _MIN_VALUES:
        return SampleFormat(1.0, full_scale)
    step, brightest = int(np.diff(values).min()), int(values[-1])
    scales = [step * (2**bits - 1) for bits in _USUAL_BITS]
    smallest = next((each for each in scales if each >= brightest), int(full_scale))
    piled = brightest == smallest and counts[brightest] > _MIN_PILE * counts[values[-2]]
    if piled or full_scale == _WORD - 1:
        return SampleFormat(float(step), float(min(smallest, full_scale)))
    return SampleFormat(float(step), full_scale // step * step)


@dataclass(frozen=True, slots=True)
class AxisFrames:
    """Images of the patterns of one axis from one camera, (H, W) in camera units; white and black are float32.

    bits : B images, most significant first; inverses : the same, or None without. lines : L images, one per shift, of
    the patterns line_patterns. full_scale : value of a saturated sample of one exposure. reference_repeats : number of
    frames that white and black are means of, over that of the others. exposure_ratio : light of the longest exposure of
    a bracket over that of its shortest; 1 without a bracket. sample_step : as in `SampleFormat`. sinusoids : images of
    the patterns sine_patterns. has_reference : False if white and black are level plus and minus modulation of
    sinusoids.

    Without Gray code there are no bits, and `gray` has cells of one position.
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
    reference_repeats: float = 1.0
    sample_step: float = 1.0
    sinusoids: Images = ()
    sine_patterns: tuple[Sine, ...] = ()
    has_reference: bool = True

    @property
    def clipped_at(self) -> float:
        """Least value of a clipped sample: a bracket is scaled to its longest exposure."""
        return self.full_scale * self.exposure_ratio

    @property
    def line_pairs(self) -> tuple[list[NDArray[Any]], list[NDArray[Any]]] | None:
        """Two line images and their inverses, to estimate the response of the camera from; None if bits have inverses,
        or lines have none.
        """
        pairs = () if self.inverses is not None else diagnostic_line_pairs(self.line_patterns)
        direct, inverted = ([self.lines[self.line_patterns.index(pair[i])] for pair in pairs] for i in (0, 1))
        return (direct, inverted) if pairs else None

    @property
    def lines_light_half(self) -> bool:
        """True if the mean of the lines is the middle of white and black: see `lights_half_period`."""
        return len(self.lines) > 0 and lights_half_period(self.line_patterns)

    @property
    def phase_frames(self) -> tuple[Images, FloatArray, float]:
        """Frames whose first harmonic shows the position: images, phase of each in radians, and their period, px.

        They are the lines, or the sinusoids of the finest period with three shifts.
        """
        if len(self.lines):
            period_px = self.line_patterns[0].period_px
            return self.lines, 2 * np.pi / period_px * np.array([p.centre_px for p in self.line_patterns]), period_px
        members = sine_groups(self.sine_patterns)[0]
        patterns = [self.sine_patterns[i] for i in members]
        angle = 2 * np.pi * np.array([p.shift / p.steps for p in patterns])
        return [self.sinusoids[i] for i in members], angle, patterns[0].period_px

    @property
    def middle(self) -> Image:
        """(H, W) float32: threshold for bits without inverses.

        It is the middle of white and black or, close to it, the mean of lines that light half of their period: the
        white of a projector may be dimmer than its other patterns.
        """
        middle = np.asarray(self.white + self.black, dtype=np.float32) / np.float32(2)
        if not self.lines_light_half:
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
        """(H, W) float32: white minus black, the light of the projector."""
        return self.white - self.black

    def rows(self, rows: slice | IntArray) -> AxisFrames:
        """Select rows of all images."""
        return replace(
            self,
            white=self.white[rows],
            black=self.black[rows],
            bits=[image[rows] for image in self.bits],
            inverses=None if self.inverses is None else [image[rows] for image in self.inverses],
            lines=[image[rows] for image in self.lines],
            sinusoids=[image[rows] for image in self.sinusoids],
        )


@dataclass(frozen=True, slots=True)
class AxisPatterns:
    """Patterns of one axis that one camera captures, in the order for decoding.

    gray : the code, as its first bit, or cells of one position without; direct, inverted : bits shown so; lines : by
    shift; reference : White and Black, as far as they are shown. sines : of sinusoids, by period and shift; none where
    there are lines.
    """

    gray: Gray
    direct: frozenset[int]
    inverted: frozenset[int]
    lines: tuple[LineShift, ...]
    reference: frozenset[White | Black]
    sines: tuple[Sine, ...] = ()

    @property
    def has_code(self) -> bool:
        """True if there is a Gray code."""
        return bool(self.direct or self.inverted)

    @property
    def has_inverses(self) -> bool:
        """True if every bit comes with its inverse."""
        return len(self.direct) == len(self.inverted) == self.gray.bits

    @property
    def noise_patterns(self) -> frozenset[Pattern]:
        """Patterns to estimate noise and response of the camera from.

        With inverses, white and black these are `diagnostic_bits`; without inverses `diagnostic_line_pairs`, or else
        lines of half their period and some bits; otherwise the whole code. With sinusoids these are all patterns.
        """
        if self.sines:
            return self.required
        if len(self.reference) == 2:
            pairs = diagnostic_line_pairs(self.lines)
            bits = [replace(self.gray, bit=bit) for bit in diagnostic_bits(self.gray.bits)]
            if self.has_inverses:
                return frozenset((*self.reference, *bits, *(replace(bit, inverted=True) for bit in bits)))
            if self.lines_light_half and not self.inverted:
                lines = [line for pair in pairs for line in pair] or self.lines
                return frozenset((*self.reference, *bits, *lines))
        return frozenset(each for each in self.required if not isinstance(each, LineShift))

    @property
    def code_patterns(self) -> frozenset[Pattern]:
        """Patterns that the code is read from."""
        if self.sines or (self.lines_light_half and not self.has_inverses):
            return self.required
        return frozenset(each for each in self.required if not isinstance(each, LineShift))

    @property
    def lines_light_half(self) -> bool:
        """True if lines light half of their period, and together every place alike."""
        return lights_half_period(self.lines)

    @property
    def required(self) -> frozenset[Pattern]:
        """Patterns whose images decoding uses."""
        direct = (replace(self.gray, bit=bit) for bit in self.direct)
        inverted = (replace(self.gray, bit=bit, inverted=True) for bit in self.inverted)
        return frozenset((*self.reference, *direct, *inverted, *self.lines, *self.sines))


def axis_patterns(patterns: Collection[Pattern], camera: str, axis: Axis) -> AxisPatterns:
    """Sort the patterns of one camera for one axis.

    Raises
    ------
    PatternError
        Bits are missing or of two codes, or there is neither a white-black pair nor inverses to threshold with. No
        period of sinusoids has three shifts.
    """
    grays = [p for p in patterns if isinstance(p, Gray) and p.axis is axis]
    lines = tuple(sorted((p for p in patterns if isinstance(p, LineShift) and p.axis is axis), key=lambda p: p.shift))
    sines = () if lines else _sines(patterns, camera, axis)
    reference = frozenset(p for p in patterns if isinstance(p, White | Black))
    if sines and not grays:
        return AxisPatterns(Gray(axis, 0, 1), frozenset(), frozenset(), (), reference, sines)
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
    if len(reference) < 2 and not (direct & inverted or sines):
        message = (
            f"camera '{camera}' has no white and black frames and no bit with its inverse: "
            "bits have no threshold; add a white and a black frame, or inverses"
        )
        raise PatternError(message)
    if len({(p.period_px, p.line_width_px) for p in lines}) > 1:
        message = f"camera '{camera}' has line-shift frames of two periods or widths on the {axis.value} axis; keep one"
        raise PatternError(message)
    gray = Gray(axis, 0, first.bits, first.cell_px, first.offset_px)
    return AxisPatterns(gray, direct, inverted, lines, reference, sines)


def _sines(patterns: Collection[Pattern], camera: str, axis: Axis) -> tuple[Sine, ...]:
    """Sinusoids of an axis, by period and shift. Raises PatternError: none of their periods has three shifts."""
    found = [p for p in patterns if isinstance(p, Sine) and p.axis is axis]
    sines = tuple(sorted(found, key=lambda p: (p.period_px, p.shift / p.steps)))
    if sines and not sine_groups(sines):
        message = (
            f"camera '{camera}' has {len(sines)} frames of sinusoids of the {axis.value} axis, and no period has "
            "three shifts, which brightness, modulation and phase need; play three shifts of one period at least"
        )
        raise PatternError(message)
    return sines


def lights_half_period(lines: Sequence[LineShift], /) -> bool:
    """Return True if lines light half of their period, and their shifts divide it evenly.

    Their mean is then the middle of white and black. lines : of one axis, period and width, by shift.
    """
    return has_even_shifts(lines) and lines[0].is_half_lit


def used_frames(patterns: Sequence[Pattern], exposures_s: Sequence[float | None]) -> list[bool]:
    """Return for each frame of a camera True if it is used for reconstruction; the others only prove that nothing
    changed.

    patterns, exposures_s : pattern and exposure of each frame, in the order of the sequence. If every code and line
    pattern is shown once, the white and black frames before the first of them are used, so that each frame can be
    processed as it comes; those that close the sequence are not. If patterns are repeated or bracketed, or the sequence
    does not open with white and black, all are used.
    """
    bodies = [i for i, p in enumerate(patterns) if isinstance(p, Gray | LineShift | Sine)]
    once = len({patterns[i] for i in bodies}) == len(bodies) and exposure_count(exposures_s) <= 1
    if not (once and bodies and {White(), Black()} <= set(patterns[: bodies[0]])):
        return [True] * len(patterns)
    return [i < bodies[0] or not isinstance(p, White | Black) for i, p in enumerate(patterns)]


def exposure_count(exposures_s: Collection[float | None]) -> int:
    """Number of different exposure times."""
    return len(set(exposure_groups(exposures_s).values()))


class FrameStacks:
    """Frames of one camera and axis while they arrive, sorted for decoding.

    shape : (rows, columns) of the images; reference_repeats : as in `AxisFrames`.
    """

    def __init__(
        self,
        patterns: AxisPatterns,
        shape: tuple[int, int],
        *,
        full_scale: float,
        exposure_ratio: float = 1.0,
        reference_repeats: float = 1.0,
    ) -> None:
        self.patterns = patterns
        self._scales = {
            "full_scale": full_scale,
            "exposure_ratio": exposure_ratio,
            "reference_repeats": reference_repeats,
            "sample_step": 1.0,
        }
        bits = patterns.gray.bits if patterns.has_code else 0
        dark = np.broadcast_to(np.zeros(1, dtype=np.uint8), shape)
        self._bits: list[NDArray[Any]] = [dark] * bits
        self._inverses: list[NDArray[Any]] = [dark] * (bits if patterns.inverted else 0)
        self._lines: list[NDArray[Any]] = [dark] * len(patterns.lines)
        self._sinusoids: list[NDArray[Any]] = [dark] * len(patterns.sines)
        self._reference: dict[Pattern, Image] = {}
        self._missing = set(patterns.required)
        self._gamma = 1.0
        self._is_format_known = False

    @classmethod
    def from_frames(cls, frames: AxisFrames) -> FrameStacks:
        """Return the stacks of a complete set of frames."""
        bits = frozenset(range(len(frames.bits)))
        stacks = cls(
            AxisPatterns(
                frames.gray, bits, bits if frames.inverses is not None else frozenset(), frames.line_patterns,
                frozenset((White(), Black())) if frames.has_reference else frozenset(), frames.sine_patterns,
            ),
            (0, 0), full_scale=frames.full_scale, exposure_ratio=frames.exposure_ratio,
            reference_repeats=frames.reference_repeats,
        )  # fmt: skip
        stacks._bits, stacks._lines = list(frames.bits), list(frames.lines)
        stacks._sinusoids = list(frames.sinusoids)
        stacks._inverses = [] if frames.inverses is None else list(frames.inverses)
        stacks._reference = {White(): frames.white, Black(): frames.black} if frames.has_reference else {}
        stacks._missing = set()
        stacks._scales["sample_step"] = frames.sample_step
        stacks._is_format_known = True
        return stacks

    def put(self, pattern: Pattern, image: NDArray[Any]) -> None:
        """Take the (H, W) image of a pattern, which must not change later; ignore patterns that this axis does not
        need.
        """
        if pattern not in self._missing:
            return
        if self._gamma != 1:
            image = self._linearise_image(image)
        if isinstance(pattern, Gray):
            (self._inverses if pattern.inverted else self._bits)[pattern.bit] = image
        elif isinstance(pattern, LineShift):
            self._lines[self.patterns.lines.index(pattern)] = image
        elif isinstance(pattern, Sine):
            self._sinusoids[self.patterns.sines.index(pattern)] = image
        else:
            self._reference[pattern] = image.astype(np.float32)
        self._missing.discard(pattern)

    def release_line_images(self) -> None:
        """Drop the line images, those of returned frames included."""
        self._lines.clear()
        self._sinusoids.clear()

    def release(self) -> None:
        """Drop the images of code and lines, those of returned frames included."""
        for images in (self._bits, self._inverses, self._lines, self._sinusoids):
            images.clear()

    def linearise(self, gamma: float) -> None:
        """Make the images proportional to light, those that are there and those to come.

        gamma : values are light to the power of 1/gamma.
        """
        self._gamma = gamma
        for images in (self._bits, self._inverses, self._lines, self._sinusoids):
            images[:] = [self._linearise_image(each) for each in images]
        self._reference = {pattern: self._linearise_image(image) for pattern, image in self._reference.items()}

    def _linearise_image(self, image: NDArray[Any]) -> NDArray[np.float32]:
        return linearise(image, self._gamma, self._scales["full_scale"])

    def has(self, pattern: Pattern) -> bool:
        """True if the image of a pattern is there."""
        return pattern not in self._missing

    @property
    def missing(self) -> frozenset[Pattern]:
        """Patterns whose images are missing."""
        return frozenset(self._missing)

    @property
    def has_noise_patterns(self) -> bool:
        """True if all patterns are there that noise and response are estimated from."""
        return self._missing.isdisjoint(self.patterns.noise_patterns)

    @property
    def has_code_patterns(self) -> bool:
        """True if all patterns are there that the code is read from."""
        return self._missing.isdisjoint(self.patterns.code_patterns)

    def frames(self) -> AxisFrames:
        """Return the frames, once `has_noise_patterns`; missing ones are black until they arrive."""
        patterns = self.patterns
        self._find_sample_format()
        pairs = sorted(patterns.direct & patterns.inverted)
        white, black = self._reference.get(White()), self._reference.get(Black())
        both = [each for bit in pairs for each in (self._bits[bit], self._inverses[bit])]
        has_reference = bool(both) or (white is not None and black is not None)
        if not has_reference:
            white, black = _brightest_and_darkest(self._sinusoids, patterns.sines)
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
            inverses=self._inverses if patterns.has_inverses else None,
            gray=patterns.gray,
            lines=self._lines,
            line_patterns=patterns.lines,
            sinusoids=self._sinusoids,
            sine_patterns=patterns.sines,
            has_reference=has_reference,
            **self._scales,
        )

    def _find_sample_format(self) -> None:
        """Set step and full scale by the code images for the noise: the same in any order of frames."""
        if self._is_format_known:
            return
        self._is_format_known = True
        used = [each for each in self.patterns.noise_patterns if isinstance(each, Gray)]
        images = [(self._inverses if each.inverted else self._bits)[each.bit] for each in used] + self._sinusoids
        step, full_scale = sample_format(images, self._scales["full_scale"])
        self._scales |= {"sample_step": step, "full_scale": full_scale}


def sine_weights(patterns: Sequence[Sine], /) -> FloatArray:
    """(3, n) float64: weights of frames of one period for level, and cosine and sine part of the modulation."""
    angle = 2 * np.pi * np.array([each.shift / each.steps for each in patterns])
    return np.asarray(np.linalg.pinv(np.stack([np.ones(len(angle)), np.cos(angle), np.sin(angle)], axis=1)))


def _brightest_and_darkest(images: Images, patterns: Sequence[Sine]) -> tuple[Image, Image]:
    """Level plus and minus modulation of the coarsest period with three shifts, which blur reduces least."""
    members = sine_groups(patterns)[-1]
    weights = sine_weights([patterns[i] for i in members]).astype(np.float32)
    level, cosine, sine = np.zeros((3, *images[0].shape), dtype=np.float32)
    for index, i in enumerate(members):
        for part, weight in zip((level, cosine, sine), weights[:, index], strict=True):
            part += weight * images[i]
    swing = np.hypot(cosine, sine)
    return level + swing, np.maximum(level - swing, 0)


def axis_frames(capture: Capture, camera: str, axis: Axis) -> AxisFrames:
    """Sort the frames of one camera, all of one exposure, for decoding along one axis.

    Raises
    ------
    PatternError
        As `axis_patterns` does, or there are several exposures, which have to be fused.
    """
    shots = used_shots(capture, camera)
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
        reference_repeats=reference_repeats([capture.patterns[shot.pattern] for shot in shots], axis),
    )
    for pattern, images in repeats.items():
        if not stacks.has(pattern):
            stacks.put(pattern, mean_image(images))
    return stacks.frames()


def used_shots(capture: Capture, camera: str) -> list[Shot]:
    """Frames of a camera that are used for reconstruction: see `used_frames`."""
    shots = [shot for shot in capture.shots if shot.camera == camera]
    is_used = used_frames([capture.patterns[shot.pattern] for shot in shots], [shot.exposure_s for shot in shots])
    return [shot for shot, used in zip(shots, is_used, strict=True) if used]


def reference_repeats(patterns: Sequence[Pattern], axis: Axis) -> float:
    """Number of frames that white and black are means of, over that of the other patterns; 1 if any are missing."""
    counts = Counter(patterns)
    others = [n for p, n in counts.items() if isinstance(p, Gray | LineShift | Sine) and p.axis is axis]
    return max(1.0, min(counts[White()], counts[Black()]) / max(others, default=1))


def mean_image(repeats: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Mean of images of one pattern, float32; a single image as it is."""
    if len(repeats) == 1:
        return repeats[0]
    return np.asarray(np.mean(repeats, axis=0, dtype=np.float64), dtype=np.float32)
