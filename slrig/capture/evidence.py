"""Evidence that each frame shows the pattern it claims, gathered frame by frame from a sample of pixels.

The tests need no model of the scene. White against black tells what is lit; light is additive, so a bit and its inverse
add up to white and black; line frames must be bright where the Gray code puts their lines; a frame that equals an
earlier frame of another pattern was not exposed for its own; the closing frames must equal the opening ones.
A pattern that is constant over the visible part of the projector is no contradiction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.capture import checks, code_checks
from slrig.capture.checks import Lighting, Reference, Samples
from slrig.capture.code_checks import Code
from slrig.errors import ScanEvidenceError
from slrig.model import Axis, Black, CameraFormat, Capture, Gray, LineShift, Pattern, Pixels, Shot, Size, White

_SAMPLES = 12_000
_BESIDE_PX = 3


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """What the frames of one sequence have proven.

    patterns : how many were seen. verified : how many of them passed, in every camera, a test that another pattern
    would fail. lit, light_drift, noise_dn : per camera, share of the image that the projector lights, largest change
    of the light as a share of white, noise of a frame in DN; missing where nothing tells. faults : contradictions.
    """

    patterns: int
    verified: int
    lit: Mapping[str, float]
    light_drift: Mapping[str, float]
    noise_dn: Mapping[str, float]
    faults: tuple[str, ...]


def named(index: int, pattern: Pattern) -> str:
    """Words for a pattern of a sequence.

    >>> named(7, Gray(Axis.COLUMN, 2, 9, inverted=True))
    'pattern 7 (column Gray bit 2 of 9, inverse)'
    """
    words: str
    match pattern:
        case White() | Black():
            words = pattern.kind
        case Gray():
            words = f"{pattern.axis} Gray bit {pattern.bit} of {pattern.bits}{', inverse' if pattern.inverted else ''}"
        case LineShift():
            words = f"{pattern.axis} lines, shift {pattern.shift} of {pattern.period_px}"
    return f"pattern {index} ({words})"


@dataclass(frozen=True, slots=True)
class _Sampler:
    """Which pixels of a camera are looked at: random ones, so that no stripe pattern can lie in step with them.

    flat, row : (n,) index into the flattened image, and its row. The second half lies beside the first, on the
    diagonal: pairs cross edges of columns and of rows.
    """

    flat: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def of(cls, size: Size, candidates: NDArray[np.intp] | None = None) -> _Sampler:
        """Draw from the flat indices `candidates`, or from the whole image."""
        rng = np.random.default_rng(0)
        height, width = size.shape
        # Each pixel once: a small image has fewer than are drawn.
        drawn = np.unique(rng.integers(0, height * width if candidates is None else len(candidates), _SAMPLES))
        rows, columns = np.divmod(drawn if candidates is None else candidates[drawn], width)
        all_rows = np.concatenate([rows, np.minimum(rows + _BESIDE_PX, height - 1)])
        all_columns = np.concatenate([columns, np.minimum(columns + _BESIDE_PX, width - 1)])
        return cls(all_rows * width + all_columns, all_rows)

    def take(self, image: Pixels) -> Samples:
        """The sampled pixels of an image."""
        return np.asarray(image.reshape(-1)[self.flat], dtype=np.float32)


@dataclass(slots=True)
class _Witness:
    """One camera's frames so far: whole until white and black tell what is lit, then at sampled lit pixels."""

    name: str
    format: CameraFormat
    patterns: Sequence[Pattern]
    firsts: dict[Pattern, int] = field(default_factory=dict)
    waiting: dict[int, Pixels] = field(default_factory=dict)
    lighting: Lighting | None = None
    sampler: _Sampler | None = None
    reference: Reference | None = None
    refused: bool = False
    seen: set[int] = field(default_factory=set)
    frames: dict[int, Samples] = field(default_factory=dict)
    waiting_lines: list[int] = field(default_factory=list)
    codes: dict[Axis, tuple[Code, Gray]] = field(default_factory=dict)
    noises: list[float] = field(default_factory=list)
    verified: set[int] = field(default_factory=set)
    light_drift: float | None = None

    @property
    def noise(self) -> float:
        return float(np.median(self.noises)) if self.noises else checks.NOISE_FLOOR_DN

    def faults(self, shot: Shot) -> list[str]:
        """Take a frame in; return the contradictions that it brings to light."""
        self.seen.add(shot.pattern)
        fault = self._format_fault(shot)
        if fault is not None:
            return [self._says(shot.pattern, fault)]
        self.firsts.setdefault(self.patterns[shot.pattern], shot.pattern)
        if self.refused:
            return []
        if self.sampler is None:
            self.waiting[shot.pattern] = shot.image
            return self._refer()
        self.frames[shot.pattern] = self.sampler.take(shot.image)
        return self._against_reference(shot.pattern)

    def _format_fault(self, shot: Shot) -> str | None:
        image, size = shot.image, self.format.size
        if image.shape != size.shape:
            return f"the frame is {image.shape[1]} x {image.shape[0]}, the camera is {size}: scan again"
        wanted = np.uint8 if self.format.bit_depth <= 8 else np.uint16
        if image.dtype != wanted:
            return f"the frame is {image.dtype}, {self.format.bit_depth} bits come as {np.dtype(wanted)}"
        brightest = int(image.max())
        if brightest > self.format.full_scale:
            return (
                f"a pixel has the value {brightest}, {self.format.bit_depth} bits end at {self.format.full_scale}: the "
                "frame was damaged, or the camera sends another format"
            )
        return None

    def _says(self, index: int, fault: str) -> str:
        return f"camera '{self.name}', {named(index, self.patterns[index])}: {fault}"

    def _refer(self) -> list[str]:
        """Once white and black are in: find what is lit, and judge the frames that waited."""
        first_white, first_black = self.firsts.get(White()), self.firsts.get(Black())
        if first_white is None or first_black is None:
            return []
        white, black = self.waiting[first_white], self.waiting[first_black]
        anywhere, full_scale = _Sampler.of(self.format.size), self.format.full_scale
        lighting = checks.lighting(anywhere.take(white), anywhere.take(black), full_scale=full_scale)
        if isinstance(lighting, str):
            self.refused = True
            return [self._says(max(first_white, first_black), lighting)]
        threshold = math.ceil(lighting.threshold_dn)
        lit = (white > black) & (white - black >= threshold) & (white < full_scale)
        self.lighting, self.sampler = lighting, _Sampler.of(self.format.size, np.flatnonzero(lit))
        self.reference = checks.reference(
            self.sampler.take(white),
            self.sampler.take(black),
            threshold_dn=threshold,
            full_scale=full_scale,
            row=self.sampler.row,
        )
        self.verified |= {first_white, first_black}
        self.frames = {index: self.sampler.take(image) for index, image in self.waiting.items()}
        waited, self.waiting = list(self.waiting), {}
        return [fault for index in waited for fault in self._against_reference(index)]

    def _against_reference(self, index: int) -> list[str]:
        ref, pattern = self.reference, self.patterns[index]
        if ref is None:
            return []
        first = self.firsts[pattern]
        if first != index:
            return self._again(index, first, ref)
        if isinstance(pattern, White | Black):
            return []
        found = self._gray(index, pattern, ref) if isinstance(pattern, Gray) else self._range([index], ref)
        if not found:
            found += self._repetition(index, pattern, ref)
        if not found and isinstance(pattern, LineShift):
            found += self._line(index, pattern, ref)
        return found

    def _again(self, index: int, first: int, ref: Reference) -> list[str]:
        seen = checks.drift(self.frames[first], self.frames[index], ref, noise=self.noise if self.noises else None)
        if self.light_drift is None or abs(seen.light) > abs(self.light_drift):
            self.light_drift = seen.light
        fault = checks.drift_fault(seen)
        if fault is not None:
            return [self._says(index, fault)]
        if first in self.verified:
            self.verified.add(index)
        return []

    def _range(self, indices: Sequence[int], ref: Reference) -> list[str]:
        noise = self.noise if self.noises else None
        judged = ((index, checks.range_fault(self.frames[index], ref, noise=noise)) for index in indices)
        return [self._says(index, fault) for index, fault in judged if fault is not None]

    def _gray(self, index: int, pattern: Gray, ref: Reference) -> list[str]:
        partner = self.firsts.get(_inverse(pattern))
        # A pair tells the noise, which the other tests need: the first of a pair waits for the second.
        if partner is not None:
            bit, inverse = self.frames[index], self.frames[partner]
            fault = checks.pair_fault(bit, inverse, ref, noise=self.noise)
            if fault is not None:
                return [self._says(index, f"beside {named(partner, self.patterns[partner])}, {fault}")]
            self.noises.append(checks.noise_dn(bit, inverse, ref))
            found = self._range([partner, index], ref)
            if not found:
                self.verified |= {index, partner}
        else:
            found = [] if _inverse(pattern) in self.patterns else self._range([index], ref)
        return found or self._complete_code(pattern, ref)

    def _complete_code(self, pattern: Gray, ref: Reference) -> list[str]:
        """Decode once the last frame of a code is in, and judge the line frames that waited for it."""
        if pattern.axis in self.codes:
            return []
        family = [p for p in self.patterns if isinstance(p, Gray) and _code_of(p) == _code_of(pattern)]
        if {p.bit for p in family} != set(range(pattern.bits)) or any(p not in self.firsts for p in family):
            return []
        differences = [self._difference(bit, family, ref) for bit in range(pattern.bits)]
        code = code_checks.read_code(differences, ref)
        exchanged = code_checks.swapped_bit(code)
        if exchanged is not None:
            fault = (
                f"bit {exchanged} of the {pattern.axis} code is exchanged with its inverse: codes jump where coarser "
                "bits change; check that the projector shows the patterns in the order they were loaded"
            )
            return [self._says(self.firsts[next(p for p in family if p.bit == exchanged)], fault)]
        self.codes[pattern.axis] = (code, pattern)
        waited, self.waiting_lines = self.waiting_lines, []
        found: list[str] = []
        for index in waited:
            line = self.patterns[index]
            if isinstance(line, LineShift):
                found += self._line(index, line, ref)
        return found

    def _difference(self, bit: int, family: Sequence[Gray], ref: Reference) -> Samples:
        frames = {p.inverted: self.frames[self.firsts[p]] for p in family if p.bit == bit}
        half = (ref.white + ref.black) / 2
        return np.asarray(frames.get(False, half) - frames.get(True, half)) * (1 if len(frames) == 2 else 2)

    def _repetition(self, index: int, pattern: Pattern, ref: Reference) -> list[str]:
        own = {pattern, White(), Black()}
        earlier = [i for i in self.frames if i != index and self.patterns[i] not in own]
        # Wide lines move by a small part of their width: tell neighbours apart only where noise leaves room for it.
        factor = max(40.0, 4.0 * pattern.line_width_px) if isinstance(pattern, LineShift) else 40.0
        frames = [self.frames[i] for i in earlier]
        found = checks.repeated(self.frames[index], frames, ref, noise=self.noise, factor=factor)
        if found is None:
            return []
        twin = earlier[found]
        fault = (
            f"the frame equals that of {named(twin, self.patterns[twin])}: it was not exposed while its own "
            "pattern was shown; check the trigger and the projector's latency, and scan again"
        )
        return [self._says(index, fault)]

    def _line(self, index: int, pattern: LineShift, ref: Reference) -> list[str]:
        known = self.codes.get(pattern.axis)
        if known is None:
            self.waiting_lines.append(index)
            return []
        code, gray = known
        expected = code_checks.expect_lines(
            code,
            ref,
            cell_px=gray.cell_px,
            offset_px=gray.offset_px,
            shift=pattern.shift,
            period_px=pattern.period_px,
            width_px=pattern.line_width_px,
        )
        others = [
            self.frames[i]
            for p, i in self.firsts.items()
            if isinstance(p, LineShift) and p.axis is pattern.axis and i != index
        ]
        duty = pattern.line_width_px / pattern.period_px
        compared, fault = code_checks.line_fault(self.frames[index], others, ref, expected, noise=self.noise, duty=duty)
        if fault is not None:
            return [self._says(index, fault)]
        if compared:
            self.verified.add(index)
        return self._line_order(index, pattern, ref)

    def _line_order(self, index: int, pattern: LineShift, ref: Reference) -> list[str]:
        """Judge the order of the line frames once the last one is in."""
        family = [replace(pattern, shift=shift) for shift in range(pattern.period_px)]
        if any(self.firsts.get(line) not in self.frames for line in family):
            return []
        frames = [self.frames[self.firsts[line]] for line in family]
        shows, shift = code_checks.line_order(frames, ref, noise=self.noise)
        if shift is None:
            members = {self.firsts[line] for line in family}
            # One frame that lies where the code says, and the right order, place them all.
            if shows and members & self.verified:
                self.verified |= members
            return []
        fault = (
            f"the {pattern.axis} line frames are out of order at shift {shift}: its lines overlap those of the frame "
            "before the last more than those of the last; check that the projector shows the patterns in the order "
            "they were loaded"
        )
        return [self._says(index, fault)]


def _inverse(pattern: Gray) -> Gray:
    return replace(pattern, inverted=not pattern.inverted)


def _code_of(pattern: Gray) -> tuple[Axis, int, int, int]:
    return (pattern.axis, pattern.bits, pattern.cell_px, pattern.offset_px)


class Evidence:
    """The evidence of one sequence: feed it every frame, in any order; white and black first is cheapest.

    Parameters
    ----------
    patterns
        The whole sequence.
    cameras
        Every camera by name.
    """

    def __init__(self, patterns: Sequence[Pattern], cameras: Mapping[str, CameraFormat]) -> None:
        self._witnesses = {name: _Witness(name, form, tuple(patterns)) for name, form in cameras.items()}
        self._faults: list[str] = []

    def add(self, shot: Shot) -> None:
        """Take a frame in.

        Raises
        ------
        ScanEvidenceError
            The frames so far contradict what they should show.
        """
        found = self.contradictions(shot)
        if found:
            raise ScanEvidenceError("; ".join(found))

    def contradictions(self, shot: Shot) -> list[str]:
        """Take a frame in; return the contradictions that it brings to light, one sentence each."""
        found = self._witnesses[shot.camera].faults(shot)
        self._faults += found
        return found

    def summary(self) -> EvidenceSummary:
        """Sum up what was found so far."""
        witnesses = self._witnesses.values()
        seen = {index for witness in witnesses for index in witness.seen}
        unproven = {index for witness in witnesses for index in witness.seen - witness.verified}
        return EvidenceSummary(
            patterns=len(seen),
            verified=len(seen - unproven),
            lit={w.name: w.lighting.lit for w in witnesses if w.lighting is not None},
            light_drift={w.name: w.light_drift for w in witnesses if w.light_drift is not None},
            noise_dn={w.name: w.noise for w in witnesses if w.noises},
            faults=tuple(self._faults),
        )


def check_capture(capture: Capture) -> EvidenceSummary:
    """Judge a recorded capture. Contradictions are listed in the summary, not raised: somebody kept these frames.

    Of a pattern that was exposed for different times, the exposure that most patterns share is judged.
    """
    evidence = Evidence(capture.patterns, capture.cameras)
    for shot in _one_exposure(capture):
        evidence.contradictions(shot)
    return evidence.summary()


def _one_exposure(capture: Capture) -> list[Shot]:
    chosen: list[Shot] = []
    for camera in capture.cameras:
        shots = [shot for shot in capture.shots if shot.camera == camera]
        exposures = [shot.exposure_s for shot in shots]
        most = max(exposures, key=exposures.count, default=None)
        by_pattern: dict[int, Shot] = {}
        for shot in shots:
            if shot.exposure_s == most:
                by_pattern.setdefault(shot.pattern, shot)
        # One white and one black first: every other test refers to them.
        opening = [next((i for i in by_pattern if capture.patterns[i] == p), -1) for p in (White(), Black())]
        chosen += [by_pattern[i] for i in opening if i in by_pattern]
        chosen += [shot for i, shot in by_pattern.items() if i not in opening]
    return chosen
