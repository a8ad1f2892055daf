"""Verification of the frames of a sequence against one another."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import RefusedFrame
from slrig.capture import frame_checks, frame_light, frame_order, sine_evidence
from slrig.capture.findings import CameraFindings
from slrig.capture.frame_checks import (
    Contradiction,
    DecodedCode,
    Lighting,
    ReferenceFrames,
    SampleMask,
    Samples,
    describe_frame,
    describe_pattern,
)
from slrig.capture.frame_light import STEADY, STEADY_LIGHT, FrameLight
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    Gray,
    LineShift,
    Pattern,
    Pixels,
    Primary,
    Shot,
    Sine,
    Size,
    White,
    coarse_bit_count,
    has_even_shifts,
)

_SAMPLES = 12_000
_NEIGHBOUR_PX = 3  # along rows and along columns
_ADJACENT_PX = 1  # the same, to see the finest bits of a code change
_MAX_WRONG_FRACTION, _MAX_WRONG_FRACTION_IN_BAND = 0.01, 0.03  # of the pixels
_SAME_PIXELS_FRACTION = 0.7  # of the pixels wrong in either of two exposures, those wrong in both
_MAX_NAMED_SUSPECTS = 3  # in a message
_MAX_SCENE_FRACTION = 0.25  # of the compared pixels; a frame of another pattern is wrong at half of them
_MAX_SATURATED_FRACTION = 0.25  # of the tested pixels, in white
_MIN_LISTED = 3  # frames of one cause, to list them together
_COMPARED = re.compile(r"compared with pattern \d+ \([^)]*\), ")


@dataclass(frozen=True, slots=True)
class Sampler:
    """A random choice of pixels, which cannot align with any stripe pattern.

    flat, row : (n,) index into the flattened image, and image row. The second half are diagonal neighbours of the
    first, so that pairs cross edges of columns and of rows.
    """

    flat: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def from_size(
        cls, size: Size, candidates: NDArray[np.intp] | None = None, *, neighbour_px: int = _NEIGHBOUR_PX
    ) -> Sampler:
        """Draw samples from the flat indices `candidates`, or from the whole image."""
        rng = np.random.default_rng(0)
        height, width = size.shape
        # Drop duplicates, which a small image has.
        drawn = np.unique(rng.integers(0, height * width if candidates is None else len(candidates), _SAMPLES))
        rows, columns = np.divmod(drawn if candidates is None else candidates[drawn], width)
        all_rows = np.concatenate([rows, np.minimum(rows + neighbour_px, height - 1)])
        all_columns = np.concatenate([columns, np.minimum(columns + neighbour_px, width - 1)])
        return cls(all_rows * width + all_columns, all_rows)

    def take(self, image: Pixels) -> Samples:
        """Return the sampled pixels of an image."""
        return np.asarray(image.reshape(-1)[self.flat], dtype=np.float32)


class FrameVerifier:
    """Verifies the frames of one camera.

    Images are kept whole until white and black are known, and afterwards only at sampled lit pixels.
    """

    def __init__(
        self, name: str, form: CameraFormat, patterns: Sequence[Pattern], frame_names: Sequence[str] | None = None,
        projector: Size | None = None,
    ) -> None:  # fmt: skip
        self.name = name
        self._frame_names = frame_names
        self._projector = projector
        self.lighting: Lighting | None = None
        self.reported: list[Contradiction] = []
        self.pattern_indices: set[int] = set()
        self._format = form
        self._patterns = patterns
        self._whole_image = Sampler.from_size(form.size, neighbour_px=_ADJACENT_PX)
        self.findings = CameraFindings()
        self._pending: dict[int, Pixels] = {}
        self._overview: dict[int, Samples] = {}
        self._samples: dict[int, Samples] = {}
        self._sampler: Sampler | None = None
        self._reference: ReferenceFrames | None = None
        self._references: tuple[int, ...] = ()
        self._reference_rejected = False
        self._unreported: list[Contradiction] = []
        self._rejected: dict[int, Samples] = {}
        self._disputed: dict[Axis, SampleMask] = {}

    @property
    def _noise(self) -> float:
        measured = self.findings.noise_dn
        return frame_checks.NOISE_FLOOR_DN if measured is None else measured

    def add(self, shot: Shot) -> list[Contradiction]:
        """Add a frame; return the contradictions that it reveals."""
        self.pattern_indices.add(shot.pattern)
        fault = self._format_fault(shot)
        if fault is not None:
            found = [self._contradiction(shot.pattern, fault, [shot.pattern])]
        else:
            found = [*self._unreported, *self._add_samples(shot.pattern, shot.image)]
            self._unreported = []
        self.reported += found
        return found

    def retract(self, patterns: Collection[int]) -> tuple[int, ...]:
        """Remove the frames of some patterns and all conclusions from them; return the patterns removed.

        If the reference white or black is among them, all frames are removed, because it selected their pixels.
        """
        removes_reference = not set(self._references).isdisjoint(patterns)
        removed = tuple(sorted(i for i in self.pattern_indices if removes_reference or i in patterns))
        self.pattern_indices -= set(removed)
        for each in removed:
            self._pending.pop(each, None)
            if each in self._overview:
                self._rejected[each] = self._overview.pop(each)
            self._samples.pop(each, None)
        if removes_reference:
            self._sampler, self._reference, self._references, self.lighting = None, None, (), None
        self._reference_rejected = False
        remaining = self._recheck()
        self._unreported = [each for each in remaining if each not in self.reported]
        self.reported = [each for each in remaining if each in self.reported]
        return removed

    def findings_summary(self) -> CameraSummary:
        """Return what all frames prove: each cause once, and the frames that are proven wrong."""
        reported = self.findings.settled(self.reported)
        order = None if self.findings.explains(reported) else self._order_fault()
        if order is not None and order.is_sequence:
            return CameraSummary((f"camera '{self.name}': {order.cause}",), frozenset(), order.cause)
        if order is None:
            wrong = {index for each in reported for index in each.wrong}
            return CameraSummary(summarise(reported, self._patterns), frozenset(wrong))
        # Other contradictions of these frames are caused by them.
        others = [each for each in reported if order.shows.keys().isdisjoint(each.suspects)]
        wrong = {*order.shows, *(index for each in others for index in each.wrong)}
        faults = (f"camera '{self.name}': {order.cause}", *summarise(others, self._patterns))
        return CameraSummary(faults, frozenset(wrong))

    def _order_fault(self) -> frame_order.OrderFault | None:
        """Return the order of the frames that explains their contradictions, once all of them are there."""
        if self._overview.keys() != set(range(len(self._patterns))):
            return None
        relations = frame_order.relate_frames([self._overview[i] for i in range(len(self._patterns))])
        if relations is None:
            return None
        names = self._frame_names
        return frame_order.find_order_fault(
            self._patterns,
            relations,
            lambda index: describe_pattern(index, self._patterns[index]) if names is None else names[index],
            self._projector,
        )

    def light_factors(self) -> dict[str, LightFactor]:
        """Return the light of each kind of frames relative to the first white and black frame, as far as it is known.

        Lines have one only if the camera responds linearly and several of their periods are visible.
        """
        factors: defaultdict[str, list[float]] = defaultdict(list)
        findings, ref = self.findings, self._reference
        known = findings.measured_factors | {i: each.factor for i, each in findings.lights.items()}
        for index, factor in known.items():
            pattern = self._patterns[index]
            if not isinstance(pattern, LineShift) or index in findings.measured_factors:
                factors[_kind_of_light(pattern)].append(factor)
        is_linear = sum(findings.linear_edges) > len(findings.linear_edges) / 2
        if ref is not None and is_linear:
            for family in map(self._lines, findings.codes):
                indices = [findings.first_seen_index.get(line, -1) for line in family]
                if family and not family[0].is_half_lit and all(index in self._samples for index in indices):
                    duty = family[0].line_width_px / family[0].period_px
                    frames = [self._samples[index] for index in indices]
                    factors[_kind_of_light(family[0])] += frame_light.line_factors(frames, ref, duty=duty)
        return {kind: LightFactor(min(v), float(np.median(v)), max(v)) for kind, v in factors.items()}

    def take_rejected(self, previous: FrameVerifier) -> None:
        """Regard all frames of a verifier as the rejected exposures before those to come."""
        self._rejected = previous._rejected | previous._overview

    def came_alike(self, patterns: Iterable[int]) -> bool:
        """True if the frames of these patterns equal their rejected exposures, up to noise; chance, as damage in
        transfer, differs each time.
        """
        return all(
            each in self._rejected and frame_checks.are_exposures_alike(self._rejected[each], self._overview[each])
            for each in patterns
        )

    def _recheck(self) -> list[Contradiction]:
        """Check the remaining frames again in their original order."""
        waiting, frames = self._pending, self._samples
        self.findings, self._pending, self._samples = CameraFindings(), {}, {}
        found: list[Contradiction] = []
        for index in [*waiting, *frames]:
            self.findings.first_seen_index.setdefault(self._patterns[index], index)
            if index in waiting:
                self._pending[index] = waiting[index]
                found += self._check_unreferenced(index)
            else:
                self._samples[index] = frames[index]
                if index in self._references:
                    self.findings.verified.add(index)
                found += self._check_against_reference(index)
        return found

    def _add_samples(self, index: int, image: Pixels) -> list[Contradiction]:
        pattern = self._patterns[index]
        self.findings.first_seen_index.setdefault(pattern, index)
        self._overview[index] = self._whole_image.take(image)
        if self._sampler is None:
            self._pending[index] = image
            found = [] if self._reference_rejected else self._set_reference()
            return found or self._check_unreferenced(index)
        self._samples[index] = self._sampler.take(image)
        return self._check_against_reference(index)

    def _check_unreferenced(self, index: int) -> list[Contradiction]:
        """Check a frame of a sequence without white or black: sinusoids need neither."""
        pattern = self._patterns[index]
        if {White(), Black()} <= set(self._patterns) or not isinstance(pattern, Gray | Sine):
            return []
        return self._check_sines(pattern, [])

    def _format_fault(self, shot: Shot) -> str | None:
        image, size = shot.image, self._format.size
        if image.shape != size.shape:
            return f"the frame is {image.shape[1]} x {image.shape[0]}, the camera is {size}: scan again"
        wanted = np.uint8 if self._format.bit_depth <= 8 else np.uint16
        if image.dtype != wanted:
            return f"the frame is {image.dtype}, {self._format.bit_depth} bits come as {np.dtype(wanted)}"
        brightest = int(image.max())
        if brightest > self._format.full_scale:
            return (
                f"a pixel has the value {brightest}, {self._format.bit_depth} bits end at {self._format.full_scale}: "
                "the frame was damaged, or the camera sends another format"
            )
        return None

    def _contradiction(
        self,
        index: int,
        fault: str,
        suspects: Iterable[int],
        further: Iterable[int] = (),
        *,
        is_doubt: bool = False,
        wrong: Iterable[int] = (),
    ) -> Contradiction:
        where, rest = describe_frame(self.name, index, self._patterns[index]), set(further) - set(suspects)
        # Light beyond the camera's range is a wrong exposure, and no unusual light.
        is_doubt = is_doubt and not self._is_overexposed
        fault = fault if wrong or self.lighting is None else self.lighting.explain(fault)
        every = tuple(sorted(set(suspects)))
        return Contradiction(self.name, where, fault, every, tuple(sorted(rest)), is_doubt, tuple(wrong))

    def _corrected(self, index: int) -> Samples:
        """Return the samples of a frame with its own light undone."""
        samples, ref = self._samples[index], self._reference
        return samples if ref is None else self.findings.lights.get(index, STEADY).undo(samples, ref.black)

    @property
    def _is_overexposed(self) -> bool:
        """True if white is saturated at many of the tested pixels, because few others are lit: no measure of light."""
        if self._reference is None:
            return False
        white = self._reference.white[self._reference.tested]
        return bool(np.mean(white >= frame_checks.NEAR_SATURATION * self._format.full_scale) > _MAX_SATURATED_FRACTION)

    @property
    def _unconfirmed_references(self) -> tuple[int, ...]:
        """White and black, until a pair confirms them."""
        return () if self.findings.reference_confirmed else self._references

    def _set_reference(self) -> list[Contradiction]:
        """Find the lit pixels as soon as white and black are known, and check the frames that waited for them."""
        white_index, black_index = (self.findings.first_seen_index.get(pattern) for pattern in (White(), Black()))
        if white_index is None or black_index is None:
            return []
        white, black = self._pending[white_index], self._pending[black_index]
        full_scale = self._format.full_scale
        lighting = frame_checks.measure_lighting(
            self._overview[white_index], self._overview[black_index], full_scale=full_scale, row=self._whole_image.row
        )
        if isinstance(lighting, str):
            self._reference_rejected = True
            return [self._contradiction(max(white_index, black_index), lighting, [white_index, black_index])]
        threshold = math.ceil(lighting.threshold_dn)
        lit = (white > black) & (white - black >= threshold) & (white < full_scale)
        sampler = Sampler.from_size(self._format.size, np.flatnonzero(lit))
        self.lighting, self._sampler, self._references = lighting, sampler, (white_index, black_index)
        self._reference = frame_checks.build_reference(
            sampler.take(white), sampler.take(black), threshold_dn=threshold, full_scale=full_scale, row=sampler.row
        )
        self.findings.verified |= {white_index, black_index}
        self._samples = {index: sampler.take(image) for index, image in self._pending.items()}
        pending, self._pending = list(self._pending), {}
        return [each for index in pending for each in self._check_against_reference(index)]

    def _check_against_reference(self, index: int) -> list[Contradiction]:
        ref, pattern = self._reference, self._patterns[index]
        if ref is None:
            return []
        first = self.findings.first_seen_index[pattern]
        if first != index:
            return self._check_repeat(index, first, ref)
        if isinstance(pattern, White | Black):
            return []
        found = self._check_pair_or_single(index, pattern, ref)
        if not found and isinstance(pattern, Gray | LineShift):
            found += self._check_code(pattern, ref)
        if not found:
            found += self._check_repetition(index, pattern, ref)
        if isinstance(pattern, Gray | Sine):
            found += self._check_sines(pattern, found)
        if not found and isinstance(pattern, LineShift):
            found += self._check_line(index, pattern, ref) or self._check_line_set(pattern.axis, ref)
        # Frames cannot distinguish two primaries, because an object may reflect both equally.
        if not found and isinstance(pattern, Primary) and frame_checks.is_partly_lit(self._samples[index], ref):
            self.findings.verified.add(index)
        return found

    def _check_repeat(self, index: int, first: int, ref: ReferenceFrames) -> list[Contradiction]:
        noise, before, repeat = self.findings.noise_dn, self._corrected(first), self._samples[index]
        drift = frame_checks.measure_drift(before, repeat, ref, noise=noise)
        if self.findings.light_drift is None or abs(drift.light_change) > abs(self.findings.light_drift):
            self.findings.light_drift = drift.light_change
        fault = frame_checks.drift_fault(drift) or self._reference_change(index, first, STEADY)
        if fault is not None:
            light = frame_light.repeat_light(before, repeat, ref)
            drift = frame_checks.measure_drift(before, light.undo(repeat, ref.black), ref, noise=noise)
            left = frame_checks.drift_fault(drift) or self._reference_change(index, first, light)
            if left is None:
                self.findings.lights[index] = light
            fault = left
        if fault is not None:
            # Never suspect the first frame: a repetition after the change would hide the change.
            return [self._contradiction(index, fault, [index])]
        if first in self.findings.verified:
            self.findings.verified.add(index)
        return []

    def _reference_change(self, index: int, first: int, light: FrameLight) -> str | None:
        if not isinstance(self._patterns[index], White | Black) or self.lighting is None:
            return None
        white, black = (self._overview[i] for i in self._references)
        repeat, noise, row = light.undo(self._overview[index], black), self.findings.noise_dn, self._whole_image.row
        contrasts = (white - black, repeat - black if first == self._references[0] else white - repeat)
        return frame_checks.reference_change_fault(
            self._overview[first], repeat, contrasts, threshold_dn=self.lighting.threshold_dn, noise=noise, row=row
        )

    def _check_range(
        self, frames: Mapping[int, Samples], ref: ReferenceFrames, further: Iterable[int] | None = None
    ) -> list[Contradiction]:
        noise = self.findings.noise_dn
        further = self._unconfirmed_references if further is None else further
        faults = ((i, frame_checks.range_fault(frame, ref, noise=noise)) for i, frame in frames.items())
        found = []
        for index, fault in faults:
            if fault is not None:
                rough = self._is_rough(index, frames[index], ref)
                wrong = [index] if rough else []
                found.append(self._contradiction(index, fault, [index], further, is_doubt=not rough, wrong=wrong))
        return found

    def _is_rough(self, index: int, frame: Samples, ref: ReferenceFrames) -> bool:
        """True if a frame is rougher than every other frame so far, as one that was damaged in transfer."""
        others = [self._corrected(i) for i in self._samples if i != index]
        faults = (frame_checks.roughness_fault(frame, [other], ref, noise=self._noise) for other in others)
        return bool(others) and all(fault is not None for fault in faults)

    def _check_pair_or_single(self, index: int, pattern: Pattern, ref: ReferenceFrames) -> list[Contradiction]:
        """Check a frame together with its inverse, or alone if its pattern has none."""
        inverse = pattern.inverse if isinstance(pattern, Gray | LineShift) else None
        if isinstance(pattern, LineShift) and not self._lacks_inverses(pattern.axis):
            # Bits and their inverses confirm white and black, and the sum of all lines reveals a wrong one.
            inverse = None
        partner = None if inverse is None else self.findings.first_seen_index.get(inverse)
        if partner is None or not isinstance(pattern, Gray | LineShift):
            # The first frame of a pair waits for the second, because the other checks need the noise of a pair.
            return [] if inverse in self._patterns else self._check_single(index, pattern, ref)
        pair = (self._samples[index], self._samples[partner])
        found: list[Contradiction] = []
        # What is left after one factor of light for each frame counts.
        usual = self.findings.usual_factor
        possible = [(STEADY, STEADY)] if self._is_overexposed else frame_light.pair_lights(*pair, ref, usual=usual)
        for lights in possible:
            frame, other = (light.undo(each, ref.black) for light, each in zip(lights, pair, strict=True))
            found = self._check_pair(index, partner, frame, other, ref)
            if not found:
                self._accept_pair((index, partner), lights, (frame, other), ref)
                break
        return found

    def _check_pair(
        self, index: int, partner: int, frame: Samples, other: Samples, ref: ReferenceFrames
    ) -> list[Contradiction]:
        pattern = self._patterns[index]
        run_px = _run_px(pattern) if isinstance(pattern, Gray | LineShift) else 1
        fault = frame_checks.pair_fault(frame, other, ref, noise=self._noise, run_px=run_px)
        if fault is None:
            return self._check_range({partner: other, index: frame}, ref)
        fault = f"compared with {describe_pattern(partner, self._patterns[partner])}, {fault}"
        rough = [
            i for i, one, two in ((index, frame, other), (partner, other, frame))
            if frame_checks.roughness_fault(one, [two], ref, noise=self._noise) is not None
        ]  # fmt: skip
        is_doubt = not rough and not frame_checks.are_alike(frame, other, ref)
        suspects, further = [index, partner], self._unconfirmed_references
        return [self._contradiction(index, fault, suspects, further, is_doubt=is_doubt, wrong=rough)]

    def _accept_pair(
        self,
        indices: tuple[int, int],
        lights: tuple[FrameLight, FrameLight],
        frames: tuple[Samples, Samples],
        ref: ReferenceFrames,
    ) -> None:
        """Record what a pair proves that adds up to white and black."""
        pattern = self._patterns[indices[0]]
        self.findings.lights.update((i, each) for i, each in zip(indices, lights, strict=True) if each != STEADY)
        self.findings.noises.append(frame_checks.pair_noise_dn(*frames, ref, sums=self.findings.sums))
        self.findings.sums = [frames[0] + frames[1]]
        self.findings.reference_confirmed = True
        if isinstance(pattern, Gray):
            self.findings.verified |= set(indices)
        is_coarse = isinstance(pattern, Gray) and pattern.bit < coarse_bit_count(pattern.bits)
        raw = (self._samples[indices[0]], self._samples[indices[1]])
        fitted = frame_light.fit_pair_light(*raw, ref, is_exposure=lights[0].is_exposure)
        if fitted is not None and not self._is_overexposed:
            self.findings.fitted_lights.update(zip(indices, fitted, strict=True))
            # Coarse bits have few edges, which bias the factors of both frames of a pair.
            if is_coarse or lights != (STEADY, STEADY):
                self.findings.measured_factors.update((i, each.factor) for i, each in zip(indices, fitted, strict=True))
        linear = frame_light.is_linear_at_edges(*frames, ref)
        if linear is not None:
            self.findings.linear_edges.append(linear)

    def _check_single(self, index: int, pattern: Pattern, ref: ReferenceFrames) -> list[Contradiction]:
        """Check a frame whose pattern has no inverse in the sequence."""
        raw, found = self._samples[index], list[Contradiction]()
        light = STEADY
        for light in frame_light.single_lights(raw, ref, usual=self.findings.usual_factor):
            found = self._check_range({index: light.undo(raw, ref.black)}, ref)
            if not found:
                break
        if found or not isinstance(pattern, Gray):
            return found
        is_coarse = pattern.bit < coarse_bit_count(pattern.bits)
        if is_coarse:
            factor = frame_light.coarse_bit_factor(raw, ref)
            self.findings.measured_factors[index] = factor
            light = FrameLight(factor) if abs(factor - 1) > frame_light.STEADY_LIGHT else light
        if light != STEADY:
            self.findings.lights[index] = light
        frame = self._corrected(index)
        lines = [
            self._samples[i] for p, i in self.findings.first_seen_index.items()
            if isinstance(p, LineShift) and p.axis is pattern.axis and p.is_half_lit
        ]  # fmt: skip
        # Bits have fewer edges than lines. Edges of narrow lines are less high, so they cannot be compared.
        rough = frame_checks.roughness_fault(frame, lines, ref, noise=self._noise, by_lines=True) if lines else None
        if rough is not None:
            return [self._contradiction(index, rough, [index], self._unconfirmed_references, wrong=[index])]
        if is_coarse:
            self.findings.noises.append(frame_checks.bit_noise_dn(frame, ref))
        return []

    def _code_bits(self, pattern: Gray) -> list[Gray]:
        """Return the patterns of the sequence that belong to the same code."""
        return [p for p in self._patterns if isinstance(p, Gray) and _code_parameters(p) == _code_parameters(pattern)]

    def _lacks_inverses(self, axis: Axis) -> bool:
        """True if the bits of an axis come without their inverses."""
        return not any(isinstance(p, Gray) and p.axis is axis and p.inverted for p in self._patterns)

    def _lines(self, axis: Axis) -> list[LineShift]:
        """Return the lines of one axis, sorted by shift."""
        lines = {p for p in self._patterns if isinstance(p, LineShift) and p.axis is axis}
        return sorted(lines, key=lambda line: line.shift)

    def _check_code(self, pattern: Gray | LineShift, ref: ReferenceFrames) -> list[Contradiction]:
        """Decode a code as soon as its last frame is known, and check the line frames that waited for it.

        Bits without inverses are compared with the lines, and wait for these if there are any.
        """
        axis = pattern.axis
        gray = next((p for p in self._patterns if isinstance(p, Gray) and p.axis is axis), None)
        if axis in self.findings.codes or gray is None:
            return []
        family, first_index, lines = self._code_bits(gray), self.findings.first_seen_index, self._lines(axis)
        single = self._lacks_inverses(axis)
        if {p.bit for p in family} != set(range(gray.bits)) or any(p not in first_index for p in family):
            return []
        proving_lines = lines if single and has_even_shifts(lines) else []
        if any(first_index.get(line) not in self._samples for line in proving_lines):
            return []
        middle = np.asarray((ref.white + ref.black) / 2, dtype=np.float32)
        line_samples = [self._corrected(first_index[line]) for line in proving_lines]
        if line_samples and lines[0].is_half_lit:
            fault = self._reference_level_fault([first_index[line] for line in lines])
            if fault is not None:
                return [self._contradiction(self._references[0], fault, self._references)]
            middle = np.mean(np.stack(line_samples), axis=0).astype(np.float32)
        differences = [self._difference(bit, family, middle) for bit in range(gray.bits)]
        code = frame_checks.decode_samples(differences, ref)
        found = self._check_bit_order(family)
        if not found and line_samples:
            pairs = list(zip(proving_lines, line_samples, strict=True))
            found, wrong = self._check_against_lines(code, family, pairs, ref)
            code = replace(code, certain=code.certain & ~wrong)
        if found:
            return found
        self.findings.codes[axis] = (code, gray)
        pending, self.findings.pending_lines = self.findings.pending_lines, []
        for index in pending:
            line = self._patterns[index]
            if isinstance(line, LineShift):
                found += self._check_line(index, line, ref)
        if pending and not found:
            found += self._check_line_set(axis, ref)
        return found

    def _reference_level_fault(self, lines: Sequence[int]) -> str | None:
        if self.lighting is None or any(index not in self._overview for index in (*self._references, *lines)):
            return None
        white, black = (self._overview[index] for index in self._references)
        return frame_checks.reference_level_fault(
            white, black, [self._overview[index] for index in lines], threshold_dn=self.lighting.threshold_dn,
            full_scale=self._format.full_scale, row=self._whole_image.row,
        )  # fmt: skip

    def _check_bit_order(self, family: Sequence[Gray]) -> list[Contradiction]:
        """Check that no bit is exchanged, from the order of the code at adjacent pixels of the whole image."""
        first_index = self.findings.first_seen_index
        if self.lighting is None or any(first_index[p] not in self._overview for p in family):
            return []
        white, black = (self._overview[index] for index in self._references)
        lit = np.tile((white - black >= self.lighting.threshold_dn).reshape(2, -1).all(axis=0), 2)
        middle = np.asarray((white + black) / 2, dtype=np.float32)
        differences = [self._overview_difference(bit, family, middle)[lit] for bit in range(family[0].bits)]
        fault = frame_order.find_code_fault(np.stack(differences))
        if fault is None:
            return []
        axis, bits = family[0].axis, fault.inverted
        words = [f"bits {one} and {other} of the {axis} code are exchanged" for one, other in fault.exchanged]
        if len(bits) == family[0].bits:
            words.append(f"every bit of the {axis} code is exchanged with its inverse")
        else:
            words += [f"bit {bit} of the {axis} code is exchanged with its inverse" for bit in bits]
        blamed = {*bits, *(bit for pair in fault.exchanged for bit in pair)}
        pair = [first_index[p] for p in family if p.bit in blamed]
        cause = (
            f"{' and '.join(words)}: the code jumps from pixel to pixel, and exchanged back it does not; check that "
            "the projector shows the patterns in the order they were loaded"
        )
        return [self._contradiction(pair[0], cause, pair, [first_index[p] for p in family], wrong=pair)]

    def _overview_difference(self, bit: int, family: Sequence[Gray], middle: Samples) -> Samples:
        """Return a bit less its inverse, or less the middle of white and black, on the whole image."""
        findings, black = self.findings, self._overview[self._references[1]]
        frames = {}
        for pattern in family:
            if pattern.bit == bit:
                index = findings.first_seen_index[pattern]
                frames[pattern.inverted] = findings.lights.get(index, STEADY).undo(self._overview[index], black)
        return np.asarray(frames.get(False, middle) - frames.get(True, middle))

    def _check_against_lines(
        self, code: DecodedCode, family: Sequence[Gray], lines: list[tuple[LineShift, Samples]], ref: ReferenceFrames
    ) -> tuple[list[Contradiction], SampleMask]:
        """Compare the code with the lines, which verifies its bits. Also return the mask of pixels that contradict."""
        first_index, axis = self.findings.first_seen_index, family[0].axis
        agreement = frame_checks.compare_with_lines(code, family[0], lines, ref, noise=self._noise)
        members = [first_index[line] for line, _ in lines]
        if agreement.is_reversed:
            fault = (
                f"the {axis} line frames come in the opposite order: their positions jump from pixel to pixel; check "
                "that the projector shows the patterns in the order they were loaded"
            )
            return [self._contradiction(members[0], fault, members)], agreement.wrong
        where = frame_checks.describe_worst_lit(
            agreement.wrong, ref.row, max_total=_MAX_WRONG_FRACTION, max_in_band=_MAX_WRONG_FRACTION_IN_BAND
        )
        if where is None:
            if np.count_nonzero(agreement.compared) >= frame_checks.BAND_SAMPLES:
                self.findings.verified |= {first_index[p] for p in family}
            return [], agreement.wrong
        before = self._disputed.get(axis)
        self._disputed[axis] = agreement.wrong
        if before is not None and len(before) == len(agreement.wrong):
            common = np.count_nonzero(before & agreement.wrong) / np.count_nonzero(before | agreement.wrong)
            if common > _SAME_PIXELS_FRACTION and np.mean(agreement.wrong[agreement.compared]) < _MAX_SCENE_FRACTION:
                # Unchanged in a second exposure, so the scene causes it, for example by interreflections in a hollow.
                # No frame is suspect, and none is verified.
                return [], agreement.wrong
        bits = frame_checks.find_faulty_bits(code, agreement.wrong)
        suspects = [first_index[p] for p in family if p.bit in bits]
        names = " or ".join(describe_pattern(each, self._patterns[each]) for each in suspects)
        which = names if len(suspects) <= _MAX_NAMED_SUSPECTS else "the frame of a bit"
        fault = (
            f"{where} have a code that their lines contradict: {which} was not shown or was damaged, or something "
            "moved; check the cable and the projector's latency, and scan again; if it stays, light comes from "
            "elsewhere on the object: scan with the sequence robust"
        )
        members += [first_index[p] for p in family]
        return [self._contradiction(suspects[0], fault, suspects, members)], agreement.wrong

    def _difference(self, bit: int, family: Sequence[Gray], middle: Samples) -> Samples:
        frames = {p.inverted: self._corrected(self.findings.first_seen_index[p]) for p in family if p.bit == bit}
        return np.asarray(frames.get(False, middle) - frames.get(True, middle)) * (1 if len(frames) == 2 else 2)

    def _check_repetition(self, index: int, pattern: Pattern, ref: ReferenceFrames) -> list[Contradiction]:
        excluded = {pattern, White(), Black()}
        # A bit of narrow cells may be identical to lines.
        excluded |= {each for each in self._patterns if _equivalent_pattern(each) == _equivalent_pattern(pattern)}
        related = Primary if isinstance(pattern, Primary) else ()
        earlier = [
            i for i in self._samples
            if i != index and self._patterns[i] not in excluded and not isinstance(self._patterns[i], related)
        ]  # fmt: skip
        # Wide lines move by a small part of their width, which only low noise allows to distinguish.
        factor = max(40.0, 4.0 * pattern.line_width_px) if isinstance(pattern, LineShift) else 40.0
        frames = [self._corrected(i) for i in earlier]
        found = frame_checks.find_repeated(self._corrected(index), frames, ref, noise=self._noise, factor=factor)
        if found is None:
            return []
        twin = earlier[found]
        fault = (
            f"the frame equals that of {describe_pattern(twin, self._patterns[twin])}: it was not exposed while its "
            "own pattern was shown; check the trigger and the projector's latency, and scan again"
        )
        return [self._contradiction(index, fault, [index], [twin, *self._unconfirmed_references], wrong=[index])]

    def _check_line(self, index: int, pattern: LineShift, ref: ReferenceFrames) -> list[Contradiction]:
        known = self.findings.codes.get(pattern.axis)
        if known is None:
            if any(isinstance(each, Gray) and each.axis is pattern.axis for each in self._patterns):
                self.findings.pending_lines.append(index)
            elif frame_checks.is_partly_lit(self._samples[index], ref):  # crossing lines, which no code numbers
                self.findings.verified.add(index)
            return []
        code, gray = known
        first_index = self.findings.first_seen_index
        expected = frame_checks.predict_lines(code, gray, pattern, ref)
        lines = (i for p, i in first_index.items() if isinstance(p, LineShift) and p.axis is pattern.axis)
        others = [self._corrected(i) for i in lines if i != index]
        duty = pattern.line_width_px / pattern.period_px
        compared, fault = frame_checks.line_fault(
            self._corrected(index), others, ref, expected, noise=self._noise, duty=duty
        )
        if fault is not None:
            is_code_verified = pattern.axis in self.findings.verified_axes
            code_frames = [] if is_code_verified else [first_index[p] for p in self._code_bits(gray)]
            return [self._contradiction(index, fault, [index], code_frames)]
        if compared:
            self.findings.verified.add(index)
            self.findings.verified_axes.add(pattern.axis)
        return []

    def _check_sines(self, pattern: Gray | Sine, found: Sequence[Contradiction]) -> list[Contradiction]:
        """Check the frames of an axis against one position per pixel, as soon as a period of sinusoids is complete."""
        findings = self.findings
        sampler, known = (self._sampler, self._samples) if self._sampler else (self._whole_image, self._overview)
        frames = {i: known[i] for i in findings.first_seen_index.values() if i in known}
        if not sine_evidence.is_due(self._patterns, pattern, frames.keys()):
            return []
        is_last = sine_evidence.is_complete(self._patterns, pattern.axis, frames.keys())
        if found and not is_last:
            return []
        agreement = sine_evidence.check_axis(
            self._patterns, pattern.axis, frames, row=sampler.row, full_scale=self._format.full_scale,
            projector=self._projector,
        )  # fmt: skip
        findings.verified |= agreement.verified
        findings.lights.update(agreement.lights)
        findings.fitted_lights.update(agreement.lights)
        new = [
            self._contradiction(each.index, each.cause, each.suspects, agreement.members, wrong=each.wrong)
            for each in agreement.faults
        ]
        if is_last:
            findings.agreements[pattern.axis] = new
        else:
            findings.interim_agreements.setdefault(pattern.axis, []).extend(new)
        return new

    def _check_line_light(
        self, family: Sequence[LineShift], members: Sequence[int], frames: Sequence[Samples], ref: ReferenceFrames
    ) -> list[Contradiction]:
        """Check the sum and the shape of the light of all line frames of an axis."""
        half = family[0].is_half_lit
        unequal = frame_checks.line_sum_fault(frames, ref, noise=self._noise, half=half)
        if unequal is not None:
            blamed, fault = unequal
            suspects = [members[each] for each in blamed]
            rough = [i for i in suspects if self._is_rough(i, frames[members.index(i)], ref)]
            return [self._contradiction(max(members), fault, suspects, members, is_doubt=not rough, wrong=rough)]
        odd = frame_checks.line_shape_fault(family, frames, ref, noise=self._noise) if half else None
        if odd is not None:
            at, fault = odd
            return [self._contradiction(members[at], fault, [members[at]], members, is_doubt=True)]
        return []

    def _check_line_set(self, axis: Axis, ref: ReferenceFrames) -> list[Contradiction]:
        """Check the sum, shape and order of all line frames of an axis as soon as they and the code are known."""
        family, first_index = self._lines(axis), self.findings.first_seen_index
        if axis not in self.findings.codes or not has_even_shifts(family):
            return []
        if any(first_index.get(line) not in self._samples for line in family):
            return []
        members = [first_index[line] for line in family]
        frames = [self._corrected(each) for each in members]
        ref = frame_checks.within_the_light(ref, *self.findings.codes[axis], family[0], self._projector)
        found = self._check_line_light(family, members, frames, ref)
        if found:
            lights = frame_light.line_lights(frames, ref)
            matched = [light.undo(frame, ref.black) for light, frame in zip(lights, frames, strict=True)]
            # Shifted lines are alike to a lamp. A frame of which a part is damaged fits a factor of its own, too.
            factors = [light.factor for light in lights]
            is_even = max(factors) <= (1 + STEADY_LIGHT) * min(factors)
            if is_even and not self._check_line_light(family, members, matched, ref):
                self.findings.lights.update(zip(members, lights, strict=True))
                self.findings.fitted_lights.update(zip(members, lights, strict=True))
                found, frames = [], matched
        if found:
            return found
        index = max(members)
        shows, shift = frame_checks.check_line_order(frames, ref, noise=self._noise)
        if shift is None:
            # One frame that agrees with the code, and the right order, verify all lines.
            if shows and set(members) & self.findings.verified:
                self.findings.verified |= set(members)
            return []
        fault = (
            f"the {axis} line frames are out of order at shift {shift}: its lines overlap those of the frame "
            "before the last more than those of the last; check that the projector shows the patterns in the order "
            "they were loaded"
        )
        around = [members[(shift + step) % len(members)] for step in (-1, 0, 1)]
        return [self._contradiction(index, fault, around, members)]


def _run_px(pattern: Gray | LineShift) -> int:
    """Length of the pattern's inner runs of equal pixels: the finest bit of a Gray code changes every two cells."""
    if not isinstance(pattern, Gray):
        return pattern.line_width_px
    return pattern.cell_px << (pattern.bits - pattern.bit if pattern.bit else pattern.bits - 1)


def _equivalent_pattern(pattern: Pattern) -> Pattern:
    """Return the lines that are identical to a bit, or else the pattern itself."""
    return (pattern.as_lines or pattern) if isinstance(pattern, Gray) else pattern


def _code_parameters(pattern: Gray) -> tuple[Axis, int, int, int]:
    return (pattern.axis, pattern.bits, pattern.cell_px, pattern.offset_px)


def _kind_of_light(pattern: Pattern) -> str:
    if isinstance(pattern, Gray):
        return f"{pattern.axis} Gray code"
    if isinstance(pattern, Sine):
        return f"{pattern.axis} sinusoids"
    return f"{pattern.axis} lines" if isinstance(pattern, LineShift) else pattern.kind


def summarise(found: Sequence[Contradiction], patterns: Sequence[Pattern]) -> tuple[str, ...]:
    """Describe the contradictions of one camera, those of one cause together."""
    groups: defaultdict[str, list[Contradiction]] = defaultdict(list)
    for each in found:
        groups[re.sub(r"[\d.]+", "", _COMPARED.sub("", each.cause))].append(each)
    words: list[str] = []
    for group in groups.values():
        suspects = sorted({index for each in group for index in each.suspects})
        if len(group) == 1 or len(suspects) < _MIN_LISTED:
            words += map(str, group)
            continue
        worst = max(group, key=lambda each: float((re.findall(r"(\d+)%", each.cause) or ["0"])[0]))
        words.append(
            f"camera '{worst.camera}', patterns {frame_order.describe_indices(suspects)}, most of all "
            f"{describe_pattern(worst.suspects[0], patterns[worst.suspects[0]])}: {_COMPARED.sub('', worst.cause)}"
        )
    return tuple(words)


@dataclass(frozen=True, slots=True)
class CameraSummary:
    """Faults of the frames of one camera, each cause once. wrong : patterns whose frames are proven wrong. misordered :
    why the whole sequence is of no use, or None.
    """

    faults: tuple[str, ...]
    wrong: frozenset[int]
    misordered: str | None = None


@dataclass(frozen=True, slots=True)
class LightFactor:
    """Light of the frames of one kind relative to white and black: the least, the median and the largest factor."""

    least: float
    median: float
    most: float

    def __str__(self) -> str:
        if self.most - self.least <= STEADY_LIGHT:
            return f"{self.median:.2f} times"
        return f"{self.least:.2f} to {self.most:.2f} times"

    @property
    def is_steady(self) -> bool:
        """True if no frame of this kind needs a note."""
        return max(abs(self.least - 1), abs(self.most - 1)) <= STEADY_LIGHT


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """Result of verifying the frames of one sequence.

    patterns : number of patterns with frames. verified : number of patterns that passed, in every camera, a test that
    another pattern would fail. lit, light_drift, noise_dn : by camera, fraction of the image that the projector lights,
    largest change of the light relative to white, noise of a frame in DN; missing if unknown. faults : unresolved
    contradictions, each cause once. shot_again : number of rejected and repeated exposures; causes : their distinct
    reasons. left_out : distinct reasons why exposures of a bracket were left out. wrong : by camera, patterns whose
    frames are proven wrong. misordered : why the frames of a camera cannot be used in their order, or None. light : by
    camera and kind of pattern, the light of its frames; frame_light : by camera and pattern, for comparison within a
    pair or the line frames of an axis.
    """

    patterns: int
    verified: int
    lit: Mapping[str, float]
    light_drift: Mapping[str, float]
    noise_dn: Mapping[str, float]
    faults: tuple[str, ...]
    shot_again: int = 0
    causes: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
    wrong: Mapping[str, frozenset[int]] = field(default_factory=dict)
    misordered: str | None = None
    light: Mapping[str, Mapping[str, LightFactor]] = field(default_factory=dict)
    frame_light: Mapping[str, Mapping[int, FrameLight]] = field(default_factory=dict)

    def __str__(self) -> str:
        again = f", {self.shot_again} frame{'s' * (self.shot_again != 1)} shot again" if self.shot_again else ""
        return f"{self.verified}/{self.patterns} patterns verified{again}"

    def with_refused(self, refused: Sequence[RefusedFrame], patterns: Sequence[Pattern]) -> EvidenceSummary:
        """Return the summary with the data of rejected exposures."""
        shot = [each for each in refused if not each.left_out]
        return replace(
            self,
            shot_again=len(shot),
            causes=tuple(
                dict.fromkeys(f"{describe_frame(r.camera, r.pattern, patterns[r.pattern])}: {r.cause}" for r in shot)
            ),
            left_out=tuple(dict.fromkeys(each.cause for each in refused if each.left_out)),
        )


class Evidence:
    """Verification of one sequence by all its frames, in any order; starting with white and black saves memory.

    patterns : the whole sequence. cameras : all cameras. refused : exposures already rejected. frame_names : by camera,
    what messages on the order of the frames call the frame of each pattern; None: the pattern. projector : its size,
    which sinusoids without a code need to number their periods as far as it goes and no further.
    """

    def __init__(
        self,
        patterns: Sequence[Pattern],
        cameras: Mapping[str, CameraFormat],
        refused: Sequence[RefusedFrame] = (),
        *,
        frame_names: Mapping[str, Sequence[str]] | None = None,
        projector: Size | None = None,
    ) -> None:
        self._frame_names = frame_names or {}
        self._projector = projector
        self._patterns = tuple(patterns)
        self._cameras = dict(cameras)
        self._refused = [replace(each, shot=None) for each in refused if each.pattern < len(self._patterns)]
        self._verifiers: dict[str, FrameVerifier] = {}
        self.clear()

    def add_shot(self, shot: Shot) -> tuple[Contradiction, ...]:
        """Add a frame; return the contradictions that it reveals."""
        return tuple(self._verifiers[shot.camera].add(shot))

    def retract(self, camera: str, patterns: Collection[int]) -> tuple[int, ...]:
        """Remove frames and all conclusions from them, and check the remaining ones again.

        Returns the patterns removed: these, or all of that camera if one is the reference white or black. New
        contradictions of the remaining frames are returned with the next frame.
        """
        return self._verifiers[camera].retract(patterns)

    def came_alike(self, camera: str, patterns: Iterable[int]) -> bool:
        """True if the frames of these patterns equal their rejected exposures, up to noise."""
        return self._verifiers[camera].came_alike(patterns)

    def clear(self) -> None:
        """Remove all frames. The record of rejected exposures remains."""
        previous = self._verifiers
        self._verifiers = {
            name: FrameVerifier(name, form, self._patterns, self._frame_names.get(name), self._projector)
            for name, form in self._cameras.items()
        }
        for name, each in previous.items():
            self._verifiers[name].take_rejected(each)

    def record_refused(self, refused: RefusedFrame) -> None:
        """Record a rejected exposure."""
        self._refused.append(replace(refused, shot=None))

    def summary(self) -> EvidenceSummary:
        """Return the summary of all frames so far."""
        verifiers = self._verifiers.values()
        added = {index for each in verifiers for index in each.pattern_indices}
        found = {each.name: each.findings for each in verifiers}
        results = {each.name: each.findings_summary() for each in verifiers}
        unverified = {index for each in verifiers for index in each.pattern_indices - each.findings.verified}
        unverified |= {index for each in results.values() for index in each.wrong}
        summary = EvidenceSummary(
            patterns=len(added),
            verified=len(added - unverified),
            lit={each.name: each.lighting.lit for each in verifiers if each.lighting is not None},
            light_drift={name: each.light_drift for name, each in found.items() if each.light_drift is not None},
            noise_dn={name: each.noise_dn for name, each in found.items() if each.noise_dn is not None},
            faults=tuple(fault for each in results.values() for fault in each.faults),
            wrong={name: each.wrong for name, each in results.items() if each.wrong},
            misordered=next((each.misordered for each in results.values() if each.misordered is not None), None),
            frame_light={each.name: dict(each.findings.fitted_lights) for each in verifiers},
            light={each.name: factors for each in verifiers if (factors := each.light_factors())},
        )
        return summary.with_refused(self._refused, self._patterns)


def check_capture(capture: Capture, refused: Sequence[RefusedFrame] = ()) -> EvidenceSummary:
    """Verify a recorded capture. Contradictions are listed in the summary, not raised.

    If a pattern has several exposure times, the one that most patterns share is checked. refused : exposures rejected
    during the capture.
    """
    evidence = Evidence(capture.patterns, capture.cameras, refused, projector=capture.projector)
    for index in checked_frames(capture):
        evidence.add_shot(capture.shots[index])
    return evidence.summary()


def checked_frames(capture: Capture) -> list[int]:
    """Return the indices of the frames of a capture that `check_capture` checks, in its order."""
    chosen: list[int] = []
    for camera in capture.cameras:
        indices = [index for index, shot in enumerate(capture.shots) if shot.camera == camera]
        exposures = [capture.shots[index].exposure_s for index in indices]
        most = max(exposures, key=exposures.count, default=None)
        by_pattern: dict[int, int] = {}
        for index, exposure_s in zip(indices, exposures, strict=True):
            if exposure_s == most:
                by_pattern.setdefault(capture.shots[index].pattern, index)
        # One white and one black first, because every other check refers to them.
        opening = [next((i for i in by_pattern if capture.patterns[i] == p), -1) for p in (White(), Black())]
        chosen += [by_pattern[i] for i in opening if i in by_pattern]
        chosen += [index for i, index in by_pattern.items() if i not in opening]
    return chosen
