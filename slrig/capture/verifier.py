"""Verification of the frames of a sequence against one another, with retries of frames that contradict."""

from __future__ import annotations

import math
import re
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import RefusedFrame
from slrig.capture import frame_checks
from slrig.capture.frame_checks import Chosen, Code, Contradiction, Lighting, Reference, Samples, named, place
from slrig.errors import FrameTimeoutError, ScanEvidenceError
from slrig.model import (
    Axis,
    Black,
    CameraFormat,
    Capture,
    Frame,
    Gray,
    LineShift,
    Pattern,
    PatternSequence,
    Pixels,
    Primary,
    Shot,
    Size,
    White,
    coarse_bits,
    divides_period,
)

_SAMPLES = 12_000
_BESIDE_PX = 3  # along rows and along columns


@dataclass(frozen=True, slots=True)
class Sampler:
    """A choice of pixels: random ones, so that no stripe pattern can lie in step with them.

    flat, row : (n,) index into the flattened image, and its row. The second half lies beside the first, on the
    diagonal: pairs cross edges of columns and of rows.
    """

    flat: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def of(cls, size: Size, candidates: NDArray[np.intp] | None = None) -> Sampler:
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


_WRONG, _WRONG_IN_BAND = 0.01, 0.03  # of the judged pixels; of twelve sound scenes 0.4 % in the worst band
_ALIKE = 0.7  # of the pixels that are wrong in one exposure or another: those that are in both
_FEW_SUSPECTS = 3  # frames that a message names
_OF_THE_SCENE = 0.25  # of the pixels that are told: a frame that shows another pattern is wrong at half of them


@dataclass(slots=True)
class Findings:
    """What the frames told so far: all of it follows from the frames, and is found again when one is taken back.

    verified : the patterns whose frames passed a test that another pattern would fail. light_drift : largest change of
    the light between two frames of one pattern, as a share of white. sums : of the last pair of a bit and its inverse.
    sound : a pair of a bit or of lines and their inverse has added up to white and black, which vouches for these two.
    lined : axes of which a line frame lay where the Gray code says, which vouches for the code.
    """

    firsts: dict[Pattern, int] = field(default_factory=dict)
    verified: set[int] = field(default_factory=set)
    noises: list[float] = field(default_factory=list)
    sums: list[Samples] = field(default_factory=list)
    codes: dict[Axis, tuple[Code, Gray]] = field(default_factory=dict)
    waiting_lines: list[int] = field(default_factory=list)
    light_drift: float | None = None
    sound: bool = False
    lined: set[Axis] = field(default_factory=set)

    @property
    def noise_dn(self) -> float | None:
        """Noise of a frame, DN; None where no pair told.

        The least that a pair told: behind a scaler finer bits do not add up, and by more than noise.
        """
        return min(self.noises, default=None)


class FrameVerifier:
    """One camera's frames so far: whole until white and black tell what is lit, then at sampled lit pixels."""

    def __init__(self, name: str, form: CameraFormat, patterns: Sequence[Pattern]) -> None:
        self.name = name
        self.lighting: Lighting | None = None
        self.told: list[Contradiction] = []
        self.seen: set[int] = set()
        self._format = form
        self._patterns = patterns
        self._anywhere = Sampler.of(form.size)
        self.found = Findings()
        self._waiting: dict[int, Pixels] = {}
        self._overview: dict[int, Samples] = {}
        self._frames: dict[int, Samples] = {}
        self._sampler: Sampler | None = None
        self._reference: Reference | None = None
        self._referees: tuple[int, ...] = ()
        self._refused = False
        self._untold: list[Contradiction] = []
        self._disputed: dict[Axis, Chosen] = {}

    @property
    def _noise(self) -> float:
        measured = self.found.noise_dn
        return frame_checks.NOISE_FLOOR_DN if measured is None else measured

    def judge(self, shot: Shot) -> list[Contradiction]:
        """Take a frame in; return the contradictions that it brings to light."""
        self.seen.add(shot.pattern)
        fault = self._format_fault(shot)
        if fault is not None:
            found = [self._says(shot.pattern, fault, [shot.pattern])]
        else:
            found = [*self._untold, *self._admit(shot.pattern, shot.image)]
            self._untold = []
        self.told += found
        return found

    def retract(self, patterns: Collection[int]) -> tuple[int, ...]:
        """Forget the frames of some patterns and all that was concluded from them; return the patterns forgotten.

        With the white or the black frame that tells what is lit, every frame is forgotten: their pixels were chosen by
        these two.
        """
        everything = not set(self._referees).isdisjoint(patterns)
        gone = tuple(sorted(self.seen)) if everything else tuple(sorted(self.seen.intersection(patterns)))
        self.seen -= set(gone)
        for each in gone:
            self._waiting.pop(each, None)
            self._overview.pop(each, None)
            self._frames.pop(each, None)
        if everything:
            self._sampler, self._reference, self._referees, self.lighting = None, None, (), None
        self._refused = False
        standing = self._again_from_start()
        self._untold = [each for each in standing if each not in self.told]
        self.told = [each for each in standing if each in self.told]
        return gone

    def _again_from_start(self) -> list[Contradiction]:
        """Judge the frames that are left as if they came now, in the order in which they came."""
        waiting, frames = self._waiting, self._frames
        self.found, self._waiting, self._frames = Findings(), {}, {}
        found: list[Contradiction] = []
        for index in [*waiting, *frames]:
            self.found.firsts.setdefault(self._patterns[index], index)
            if index in waiting:
                self._waiting[index] = waiting[index]
            else:
                self._frames[index] = frames[index]
                if index in self._referees:
                    self.found.verified.add(index)
                found += self._against_reference(index)
        return found

    def _admit(self, index: int, image: Pixels) -> list[Contradiction]:
        pattern = self._patterns[index]
        self.found.firsts.setdefault(pattern, index)
        if isinstance(pattern, White | Black) or (isinstance(pattern, LineShift) and pattern.lights_half):
            self._overview[index] = self._anywhere.take(image)
        if self._sampler is None:
            self._waiting[index] = image
            return [] if self._refused else self._refer()
        self._frames[index] = self._sampler.take(image)
        return self._against_reference(index)

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

    def _says(self, index: int, fault: str, suspects: Iterable[int], beyond: Iterable[int] = ()) -> Contradiction:
        accused = tuple(sorted(set(suspects)))
        rest = tuple(sorted(set(beyond) - set(accused)))
        return Contradiction(self.name, place(self.name, index, self._patterns[index]), fault, accused, rest)

    @property
    def _unproven_reference(self) -> tuple[int, ...]:
        """White and black, until a pair has vouched for them."""
        return () if self.found.sound else self._referees

    def _refer(self) -> list[Contradiction]:
        """Once white and black are in: find what is lit, and judge the frames that waited."""
        first_white, first_black = self.found.firsts.get(White()), self.found.firsts.get(Black())
        if first_white is None or first_black is None:
            return []
        white, black = self._waiting[first_white], self._waiting[first_black]
        full_scale = self._format.full_scale
        lighting = frame_checks.lighting(
            self._overview[first_white], self._overview[first_black], full_scale=full_scale, row=self._anywhere.row
        )
        if isinstance(lighting, str):
            self._refused = True
            return [self._says(max(first_white, first_black), lighting, [first_white, first_black])]
        threshold = math.ceil(lighting.threshold_dn)
        lit = (white > black) & (white - black >= threshold) & (white < full_scale)
        sampler = Sampler.of(self._format.size, np.flatnonzero(lit))
        self.lighting, self._sampler, self._referees = lighting, sampler, (first_white, first_black)
        self._reference = frame_checks.reference(
            sampler.take(white), sampler.take(black), threshold_dn=threshold, full_scale=full_scale, row=sampler.row
        )
        self.found.verified |= {first_white, first_black}
        self._frames = {index: sampler.take(image) for index, image in self._waiting.items()}
        waited, self._waiting = list(self._waiting), {}
        return [each for index in waited for each in self._against_reference(index)]

    def _against_reference(self, index: int) -> list[Contradiction]:
        ref, pattern = self._reference, self._patterns[index]
        if ref is None:
            return []
        first = self.found.firsts[pattern]
        if first != index:
            return self._again(index, first, ref)
        if isinstance(pattern, White | Black):
            return []
        found = self._alone_or_paired(index, pattern, ref)
        if not found and isinstance(pattern, Gray | LineShift):
            found += self._complete_code(pattern, ref)
        if not found:
            found += self._repetition(index, pattern, ref)
        if not found and isinstance(pattern, LineShift):
            found += self._line(index, pattern, ref) or self._line_family(pattern.axis, ref)
        # One light from another is told by times alone: an object may send back as much of both.
        if not found and isinstance(pattern, Primary) and frame_checks.dimmed(self._frames[index], ref):
            self.found.verified.add(index)
        return found

    def _again(self, index: int, first: int, ref: Reference) -> list[Contradiction]:
        noise = self.found.noise_dn
        seen = frame_checks.drift(self._frames[first], self._frames[index], ref, noise=noise)
        if self.found.light_drift is None or abs(seen.light) > abs(self.found.light_drift):
            self.found.light_drift = seen.light
        fault = frame_checks.drift_fault(seen) or self._changed(index, first)
        if fault is not None:
            # Never the first one: shot again after a change, it would hide it.
            return [self._says(index, fault, [index])]
        if first in self.found.verified:
            self.found.verified.add(index)
        return []

    def _changed(self, index: int, first: int) -> str | None:
        if index not in self._overview or self.lighting is None:
            return None
        white, black = (self._overview[referee] for referee in self._referees)
        again = self._overview[index]
        brighter = again - black if first == self._referees[0] else white - again
        return frame_checks.changed_fault(
            self._overview[first],
            again,
            (white - black, brighter),
            threshold_dn=self.lighting.threshold_dn,
            noise=self.found.noise_dn,
            row=self._anywhere.row,
        )

    def _range(self, indices: Sequence[int], ref: Reference) -> list[Contradiction]:
        noise, beyond = self.found.noise_dn, self._unproven_reference
        judged = ((index, frame_checks.range_fault(self._frames[index], ref, noise=noise)) for index in indices)
        return [self._says(index, fault, [index], beyond) for index, fault in judged if fault is not None]

    def _alone_or_paired(self, index: int, pattern: Pattern, ref: Reference) -> list[Contradiction]:
        """Judge a frame beside that of the inverse of its pattern, or alone where there is none."""
        inverse = pattern.inverse if isinstance(pattern, Gray | LineShift) else None
        if isinstance(pattern, LineShift) and not self._single(pattern.axis):
            # Bits and their inverses vouch for white and black, and the sum of all lines names the one that is wrong.
            inverse = None
        partner = None if inverse is None else self.found.firsts.get(inverse)
        if partner is None or not isinstance(pattern, Gray | LineShift):
            # A pair tells the noise, which the other tests need: the first of a pair waits for the second.
            return [] if inverse in self._patterns else self._alone(index, pattern, ref)
        frame, other = self._frames[index], self._frames[partner]
        fault = frame_checks.pair_fault(frame, other, ref, noise=self._noise, run_px=_run_px(pattern))
        if fault is not None:
            words = f"beside {named(partner, self._patterns[partner])}, {fault}"
            return [self._says(index, words, [index, partner], self._unproven_reference)]
        self.found.noises.append(frame_checks.noise_dn(frame, other, ref, sums=self.found.sums))
        self.found.sums = [frame + other]
        found = self._range([partner, index], ref)
        if not found:
            if isinstance(pattern, Gray):
                self.found.verified |= {index, partner}
            self.found.sound = True
        return found

    def _alone(self, index: int, pattern: Pattern, ref: Reference) -> list[Contradiction]:
        """Judge a frame whose pattern has no inverse in the sequence."""
        found = self._range([index], ref)
        if found or not isinstance(pattern, Gray):
            return found
        lines = [
            self._frames[i] for p, i in self.found.firsts.items()
            if isinstance(p, LineShift) and p.axis is pattern.axis and p.lights_half
        ]  # fmt: skip
        # Lines have edges everywhere, and bits have fewer. Those of narrow lines are less high.
        rough = frame_checks.rougher(self._frames[index], lines, ref, noise=self._noise) if lines else None
        if rough is not None:
            return [self._says(index, rough, [index], self._unproven_reference)]
        if pattern.bit < coarse_bits(pattern.bits):
            self.found.noises.append(frame_checks.noise_of_bit(self._frames[index], ref))
        return []

    def _family(self, pattern: Gray) -> list[Gray]:
        """Every bit of the code that a pattern belongs to, as far as it is shown."""
        return [p for p in self._patterns if isinstance(p, Gray) and _code_of(p) == _code_of(pattern)]

    def _single(self, axis: Axis) -> bool:
        """Whether the bits of an axis come without their inverses."""
        return not any(isinstance(p, Gray) and p.axis is axis and p.inverted for p in self._patterns)

    def _lines(self, axis: Axis) -> list[LineShift]:
        """The lines of one axis, by shift."""
        lines = {p for p in self._patterns if isinstance(p, LineShift) and p.axis is axis}
        return sorted(lines, key=lambda line: line.shift)

    def _complete_code(self, pattern: Gray | LineShift, ref: Reference) -> list[Contradiction]:
        """Decode once the last frame of a code is in, and judge the line frames that waited for it.

        Bits without inverses are held against the lines, and wait for these where there are any.
        """
        axis = pattern.axis
        gray = next((p for p in self._patterns if isinstance(p, Gray) and p.axis is axis), None)
        if axis in self.found.codes or gray is None:
            return []
        family, firsts, lines = self._family(gray), self.found.firsts, self._lines(axis)
        single = self._single(axis)
        if {p.bit for p in family} != set(range(gray.bits)) or any(p not in firsts for p in family):
            return []
        proven_by = lines if single and divides_period(lines) else []
        if any(firsts.get(line) not in self._frames for line in proven_by):
            return []
        middle = np.asarray((ref.white + ref.black) / 2, dtype=np.float32)
        shown = [self._frames[firsts[line]] for line in proven_by]
        if shown and lines[0].lights_half:
            fault = self._ends_fault([firsts[line] for line in lines])
            if fault is not None:
                return [self._says(self._referees[0], fault, self._referees)]
            middle = np.mean(np.stack(shown), axis=0).astype(np.float32)
        differences = [self._difference(bit, family, middle) for bit in range(gray.bits)]
        code = frame_checks.read_code(differences, ref)
        found = self._exchanged(code, family, single=single)
        if not found and shown:
            found, wrong = self._agreement(code, gray, family, list(zip(proven_by, shown, strict=True)), ref)
            code = replace(code, sure=code.sure & ~wrong)
        if found:
            return found
        self.found.codes[axis] = (code, gray)
        waited, self.found.waiting_lines = self.found.waiting_lines, []
        for index in waited:
            line = self._patterns[index]
            if isinstance(line, LineShift):
                found += self._line(index, line, ref)
        if waited and not found:
            found += self._line_family(axis, ref)
        return found

    def _ends_fault(self, lines: Sequence[int]) -> str | None:
        if self.lighting is None or any(index not in self._overview for index in (*self._referees, *lines)):
            return None
        white, black = (self._overview[index] for index in self._referees)
        return frame_checks.ends_fault(
            white, black, [self._overview[index] for index in lines], threshold_dn=self.lighting.threshold_dn,
            full_scale=self._format.full_scale, row=self._anywhere.row,
        )  # fmt: skip

    def _exchanged(self, code: Code, family: Sequence[Gray], *, single: bool) -> list[Contradiction]:
        """Judge whether bits stand where they should, by their order alone."""
        firsts = self.found.firsts
        order = "check that the projector shows the patterns in the order they were loaded"
        if single:
            both = frame_checks.exchanged_bits(code)
            if both is None:
                return []
            blamed: tuple[int, ...] = both
            fault = f"bits {both[0]} and {both[1]} of the {family[0].axis} code are exchanged: codes jump; {order}"
        else:
            exchanged = frame_checks.swapped_bit(code)
            if exchanged is None:
                return []
            blamed = (exchanged,)
            fault = (
                f"bit {exchanged} of the {family[0].axis} code is exchanged with its inverse: codes jump where coarser "
                f"bits change; {order}"
            )
        pair = [firsts[p] for p in family if p.bit in blamed]
        return [self._says(pair[0], fault, pair, [firsts[p] for p in family])]

    def _agreement(
        self, code: Code, gray: Gray, family: Sequence[Gray], lines: list[tuple[LineShift, Samples]], ref: Reference
    ) -> tuple[list[Contradiction], Chosen]:
        """Hold the code against the lines, which proves its bits; also where they contradict it."""
        firsts, axis = self.found.firsts, gray.axis
        told = frame_checks.agreement(
            code, lines, ref, cell_px=gray.cell_px, offset_px=gray.offset_px, noise=self._noise
        )  # fmt: skip
        members = [firsts[line] for line, _ in lines]
        if told.reversed:
            fault = (
                f"the {axis} line frames come in the opposite order: the places that they tell jump from pixel to "
                "pixel; check that the projector shows the patterns in the order they were loaded"
            )
            return [self._says(members[0], fault, members)], told.wrong
        where = frame_checks.worst_of(told.wrong, ref.row, whole=_WRONG, quarter=_WRONG_IN_BAND)
        if where is None:
            if np.count_nonzero(told.told) >= frame_checks.BAND_SAMPLES:
                self.found.verified |= {firsts[p] for p in family}
            return [], told.wrong
        before = self._disputed.get(axis)
        self._disputed[axis] = told.wrong
        if before is not None and len(before) == len(told.wrong):
            alike = np.count_nonzero(before & told.wrong) / np.count_nonzero(before | told.wrong)
            if alike > _ALIKE and np.mean(told.wrong[told.told]) < _OF_THE_SCENE:
                # Exposed again it is the same: what stands there does it, light that walls of a hollow send to each
                # other, for one. No frame is to blame, and none is proven.
                return [], told.wrong
        bits = frame_checks.blamed_bits(code, told.wrong)
        suspects = [firsts[p] for p in family if p.bit in bits]
        few = len(suspects) <= _FEW_SUSPECTS
        which = " or ".join(named(each, self._patterns[each]) for each in suspects) if few else "the frame of a bit"
        fault = (
            f"{where} have a code that their lines contradict: {which} was not shown or was damaged, or something "
            "moved; check the cable and the projector's latency, and scan again; if it stays, light comes from "
            "elsewhere on the object: scan with the sequence robust"
        )
        return [self._says(suspects[0], fault, suspects, [*(firsts[p] for p in family), *members])], told.wrong

    def _difference(self, bit: int, family: Sequence[Gray], middle: Samples) -> Samples:
        frames = {p.inverted: self._frames[self.found.firsts[p]] for p in family if p.bit == bit}
        return np.asarray(frames.get(False, middle) - frames.get(True, middle)) * (1 if len(frames) == 2 else 2)

    def _repetition(self, index: int, pattern: Pattern, ref: Reference) -> list[Contradiction]:
        own = {pattern, White(), Black()}
        # A bit of narrow cells may light what lines do.
        own |= {each for each in self._patterns if _light_of(each) == _light_of(pattern)}
        kin = Primary if isinstance(pattern, Primary) else ()
        earlier = [
            i for i in self._frames
            if i != index and self._patterns[i] not in own and not isinstance(self._patterns[i], kin)
        ]  # fmt: skip
        # Wide lines move by a small part of their width: tell neighbours apart only where noise leaves room for it.
        factor = max(40.0, 4.0 * pattern.line_width_px) if isinstance(pattern, LineShift) else 40.0
        frames = [self._frames[i] for i in earlier]
        found = frame_checks.repeated(self._frames[index], frames, ref, noise=self._noise, factor=factor)
        if found is None:
            return []
        twin = earlier[found]
        fault = (
            f"the frame equals that of {named(twin, self._patterns[twin])}: it was not exposed while its own "
            "pattern was shown; check the trigger and the projector's latency, and scan again"
        )
        return [self._says(index, fault, [index], [twin, *self._unproven_reference])]

    def _line(self, index: int, pattern: LineShift, ref: Reference) -> list[Contradiction]:
        known = self.found.codes.get(pattern.axis)
        if known is None:
            self.found.waiting_lines.append(index)
            return []
        code, gray = known
        expected = frame_checks.expect_lines(
            code,
            ref,
            cell_px=gray.cell_px,
            offset_px=gray.offset_px,
            shift=pattern.shift,
            period_px=pattern.period_px,
            width_px=pattern.line_width_px,
        )
        others = [
            self._frames[i]
            for p, i in self.found.firsts.items()
            if isinstance(p, LineShift) and p.axis is pattern.axis and i != index
        ]
        duty = pattern.line_width_px / pattern.period_px
        compared, fault = frame_checks.line_fault(
            self._frames[index], others, ref, expected, noise=self._noise, duty=duty
        )
        if fault is not None:
            code_frames = [] if pattern.axis in self.found.lined else [self.found.firsts[p] for p in self._family(gray)]
            return [self._says(index, fault, [index], code_frames)]
        if compared:
            self.found.verified.add(index)
            self.found.lined.add(pattern.axis)
        return []

    def _line_family(self, axis: Axis, ref: Reference) -> list[Contradiction]:
        """Judge the sum, the shape and the order of the line frames of an axis once all and the code are in."""
        family, firsts = self._lines(axis), self.found.firsts
        if axis not in self.found.codes or not divides_period(family):
            return []
        if any(firsts.get(line) not in self._frames for line in family):
            return []
        frames = [self._frames[firsts[line]] for line in family]
        members = [firsts[line] for line in family]
        index, half = max(members), family[0].lights_half
        unequal = frame_checks.line_sum(frames, ref, noise=self._noise, half=half)
        if unequal is not None:
            blamed, fault = unequal
            return [self._says(index, fault, [members[each] for each in blamed], members)]
        odd = frame_checks.line_shape(family, frames, ref, noise=self._noise) if half else None
        if odd is not None:
            at, fault = odd
            return [self._says(members[at], fault, [members[at]], members)]
        shows, shift = frame_checks.line_order(frames, ref, noise=self._noise)
        if shift is None:
            # One frame that lies where the code says, and the right order, place them all.
            if shows and set(members) & self.found.verified:
                self.found.verified |= set(members)
            return []
        fault = (
            f"the {axis} line frames are out of order at shift {shift}: its lines overlap those of the frame "
            "before the last more than those of the last; check that the projector shows the patterns in the order "
            "they were loaded"
        )
        around = [members[(shift + step) % len(members)] for step in (-1, 0, 1)]
        return [self._says(index, fault, around, members)]


def _run_px(pattern: Gray | LineShift) -> int:
    """Length of the pattern's inner runs of equal pixels: the finest bit of a Gray code changes every two cells."""
    if not isinstance(pattern, Gray):
        return pattern.line_width_px
    return pattern.cell_px << (pattern.bits - pattern.bit if pattern.bit else pattern.bits - 1)


def _light_of(pattern: Pattern) -> Pattern:
    """The pattern, or the lines that light the same."""
    return (pattern.as_lines or pattern) if isinstance(pattern, Gray) else pattern


def _code_of(pattern: Gray) -> tuple[Axis, int, int, int]:
    return (pattern.axis, pattern.bits, pattern.cell_px, pattern.offset_px)


@dataclass(frozen=True, slots=True)
class EvidenceSummary:
    """What the frames of one sequence have proven.

    patterns : how many were seen. verified : how many of them passed, in every camera, a test that another pattern
    would fail. lit, light_drift, noise_dn : per camera, share of the image that the projector lights, largest change
    of the light as a share of white, noise of a frame in DN; missing where nothing tells. faults : contradictions that
    stand. shot_again : how many exposures were refused and made again; causes : why, each once. left_out : why
    whole exposures of a bracket were left out, each once.
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

    def __str__(self) -> str:
        again = f", {self.shot_again} frame{'s' * (self.shot_again != 1)} shot again" if self.shot_again else ""
        return f"{self.verified}/{self.patterns} patterns verified{again}"

    def with_refused(self, refused: Sequence[RefusedFrame], patterns: Sequence[Pattern]) -> EvidenceSummary:
        """The summary with what refused exposures come to."""
        shot = [each for each in refused if not each.left_out]
        return replace(
            self,
            shot_again=len(shot),
            causes=tuple(dict.fromkeys(f"{place(r.camera, r.pattern, patterns[r.pattern])}: {r.cause}" for r in shot)),
            left_out=tuple(dict.fromkeys(each.cause for each in refused if each.left_out)),
        )


class Evidence:
    """The evidence of one sequence: feed it every frame, in any order; white and black first is cheapest.

    patterns : the whole sequence. cameras : every camera by name. refused : what is on record as refused already.
    """

    def __init__(
        self, patterns: Sequence[Pattern], cameras: Mapping[str, CameraFormat], refused: Sequence[RefusedFrame] = ()
    ) -> None:
        self._patterns = tuple(patterns)
        self._cameras = dict(cameras)
        self._refused = [replace(each, shot=None) for each in refused if each.pattern < len(self._patterns)]
        self._verifiers: dict[str, FrameVerifier] = {}
        self.forget()

    def contradictions(self, shot: Shot) -> tuple[Contradiction, ...]:
        """Take a frame in; return the contradictions that it brings to light."""
        return tuple(self._verifiers[shot.camera].judge(shot))

    def retract(self, camera: str, patterns: Collection[int]) -> tuple[int, ...]:
        """Forget frames and what was concluded from them, as if they had never come; those left are judged again.

        Returns the patterns whose frames are forgotten: these, and all of that camera if one tells what is lit. What
        the others now contradict is returned with the next frame.
        """
        return self._verifiers[camera].retract(patterns)

    def forget(self) -> None:
        """Forget every frame. What was refused stays on record."""
        self._verifiers = {name: FrameVerifier(name, form, self._patterns) for name, form in self._cameras.items()}

    def note(self, refused: RefusedFrame) -> None:
        """Put on record that an exposure was refused."""
        self._refused.append(replace(refused, shot=None))

    def summary(self) -> EvidenceSummary:
        """Sum up what was found so far."""
        verifiers = self._verifiers.values()
        seen = {index for each in verifiers for index in each.seen}
        unproven = {index for each in verifiers for index in each.seen - each.found.verified}
        found = {each.name: each.found for each in verifiers}
        summary = EvidenceSummary(
            patterns=len(seen),
            verified=len(seen - unproven),
            lit={each.name: each.lighting.lit for each in verifiers if each.lighting is not None},
            light_drift={name: each.light_drift for name, each in found.items() if each.light_drift is not None},
            noise_dn={name: each.noise_dn for name, each in found.items() if each.noise_dn is not None},
            faults=tuple(str(told) for each in verifiers for told in each.told),
        )
        return summary.with_refused(self._refused, self._patterns)


def check_capture(capture: Capture, refused: Sequence[RefusedFrame] = ()) -> EvidenceSummary:
    """Judge a recorded capture. Contradictions are listed in the summary, not raised: somebody kept these frames.

    Of a pattern that was exposed for different times, the exposure that most patterns share is judged. `refused` is
    what was shot again while it was captured.
    """
    evidence = Evidence(capture.patterns, capture.cameras, refused)
    for index in judged_frames(capture):
        evidence.contradictions(capture.shots[index])
    return evidence.summary()


def judged_frames(capture: Capture) -> list[int]:
    """Of the frames of a capture those that `check_capture` judges, by their indices, in the order in which it does."""
    chosen: list[int] = []
    for camera in capture.cameras:
        indices = [index for index, shot in enumerate(capture.shots) if shot.camera == camera]
        exposures = [capture.shots[index].exposure_s for index in indices]
        most = max(exposures, key=exposures.count, default=None)
        by_pattern: dict[int, int] = {}
        for index, exposure_s in zip(indices, exposures, strict=True):
            if exposure_s == most:
                by_pattern.setdefault(capture.shots[index].pattern, index)
        # One white and one black first: every other test refers to them.
        opening = [next((i for i in by_pattern if capture.patterns[i] == p), -1) for p in (White(), Black())]
        chosen += [by_pattern[i] for i in opening if i in by_pattern]
        chosen += [index for i, index in by_pattern.items() if i not in opening]
    return chosen


MOST_FAILURES = 3
"""A pattern whose frame failed so often ends the scan."""

_ORDINALS = ("first", "second", "third")


class RetryPolicy:
    """Takes every frame of a capture once, and knows which patterns have to be shown again to which cameras.

    refused : is told of every exposure that does not count. since_ns : when times count from; None stands for the start
    of the first frame. colour : cameras whose white and black frames are kept in colour, too.
    """

    def __init__(
        self,
        sequence: PatternSequence,
        evidence: Evidence,
        refused: Callable[[RefusedFrame], None],
        *,
        since_ns: int | None = None,
        colour: Collection[str] = (),
    ) -> None:
        self.evidence = evidence
        self.again: dict[int, list[str]] = {}
        self._sequence = sequence
        self._tell = refused
        self._shots: Counter[tuple[str, int]] = Counter()
        self._made: Counter[str] = Counter()
        self._causes: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._missing: defaultdict[tuple[str, int], list[str]] = defaultdict(list)
        self._t_first_ns = since_ns
        self._colour = colour
        self._last_cause = ""

    @property
    def most_shots(self) -> int:
        """How many exposures one camera may need at most."""
        return MOST_FAILURES * len(self._sequence)

    def begin(self, camera: str, index: int) -> None:
        """Count an exposure that is about to be made. Raises ScanEvidenceError when there were too many."""
        self._shots[camera, index] += 1
        self._made[camera] += 1
        if self._made[camera] > self.most_shots:
            raise ScanEvidenceError(
                f"camera '{camera}': {self.most_shots} exposures gave no {len(self._sequence)} frames that agree with "
                f"one another; the last cause: {self._last_cause}"
            )

    def shot(self, index: int, frame: Frame) -> Shot:
        """The frame as a shot; its time counts from the start of the first frame."""
        if self._t_first_ns is None:
            self._t_first_ns = frame.t_start_ns
        time_s = (frame.t_start_ns - self._t_first_ns) / 1e9
        wanted = frame.camera in self._colour and isinstance(self._sequence.patterns[index], White | Black)
        colour = frame.colour() if wanted and frame.colour is not None else None
        return Shot(index, frame.camera, frame.image, frame.exposure_s, time_s, colour)

    def took(self, index: int, frame: Frame, fault: str | None) -> Shot | None:
        """Judge a frame; return it if it counts. `fault` is what it says against itself.
        Raises ScanEvidenceError: it was the third failure of a pattern.
        """
        shot = self.shot(index, frame)
        # Frames that are lost now and then say nothing against those that come.
        self._missing[shot.camera, index].clear()
        if fault is not None:
            self._causes[shot.camera, index].append(fault)
            self._shoot_again(RefusedFrame(index, shot.camera, self._shots[shot.camera, index], fault, shot))
            self._end_at_third(shot.camera, [index])
            return None
        found = self.evidence.contradictions(shot)
        return shot if not found or index not in self._answer(shot, found) else None

    def missed(self, camera: str, index: int, cause: str) -> None:
        """Take note that no frame came. Raises FrameTimeoutError when none came three times running."""
        missing = self._missing[camera, index]
        missing.append(cause)
        self._shoot_again(RefusedFrame(index, camera, self._shots[camera, index], cause))
        if len(missing) >= MOST_FAILURES:
            raise FrameTimeoutError(self._failed(camera, index, missing))

    def _answer(self, shot: Shot, found: tuple[Contradiction, ...]) -> frozenset[int]:
        """Have the suspects shot again; return the patterns whose frames count no more."""
        camera = shot.camera
        accused: dict[int, str] = {}
        for each in found:
            for suspect in each.suspects:
                accused.setdefault(suspect, each.cause)
        for suspect, cause in accused.items():
            self._causes[camera, suspect].append(cause)
        beyond = {
            pattern: each.cause
            for each in found
            if any(len(self._causes[camera, suspect]) > 1 for suspect in each.suspects)
            for pattern in each.beyond
        }
        gone = self.evidence.retract(camera, {*accused, *beyond})
        for pattern in gone:
            cause = accused.get(pattern) or beyond.get(pattern) or found[0].cause
            own = pattern == shot.pattern
            attempt = self._shots[camera, pattern]
            self._shoot_again(RefusedFrame(pattern, camera, attempt, cause, shot if own else None, delivered=not own))
        self._end_at_third(camera, accused)
        return frozenset(gone)

    def refuse(self, refused: RefusedFrame) -> None:
        """Put an exposure on record as one that does not count, and tell of it."""
        self.evidence.note(refused)
        self._tell(refused)

    def _shoot_again(self, refused: RefusedFrame) -> None:
        cameras = self.again.setdefault(refused.pattern, [])
        if refused.camera not in cameras:
            cameras.append(refused.camera)
        self._last_cause = refused.cause
        self.refuse(refused)

    def _end_at_third(self, camera: str, patterns: Iterable[int]) -> None:
        for index in patterns:
            causes = self._causes[camera, index]
            if len(causes) >= MOST_FAILURES:
                raise ScanEvidenceError(self._failed(camera, index, causes))

    def _failed(self, camera: str, index: int, causes: list[str]) -> str:
        return f"{place(camera, index, self._sequence.patterns[index])}: {in_words(causes)}"


def in_words(causes: list[str]) -> str:
    """Words for several failures of one thing; those that differ in numbers only are told once.

    >>> in_words(["frame 7 is dark", "frame 9 is dark"])
    'it failed 2 times, each time alike: frame 9 is dark'
    >>> in_words(["it is dark", "it came twice"])
    'it failed 2 times. The first time: it is dark. The second time: it came twice'
    """
    if len({re.sub(r"\d+", "", cause) for cause in causes}) == 1:
        return f"it failed {len(causes)} times, each time alike: {causes[-1]}"
    listed = [f"The {_ORDINALS[number]} time: {cause}" for number, cause in enumerate(causes)]
    return f"it failed {len(causes)} times. {'. '.join(listed)}"
