"""Which pattern each frame of a sequence shows: pure functions of sampled frames, without trust in any of them.

A pattern and its inverse are complementary: over the lit pixels their light has the correlation -1, at any exposure and
lamp. White and black are flat: their light is the same fraction of the lit pixels' range everywhere. Which orders of
the frames fulfil this shows a sequence that is shifted by some frames, exchanged frames and copies.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations_with_replacement

import numpy as np
from numpy.typing import NDArray

from slrig.capture.frame_checks import Samples
from slrig.capture.sine_checks import LightModel, fitted_patterns, order_misfit
from slrig.model import Axis, Black, FloatArray, Gray, Integers, LineShift, Pattern, Sine, Size, White, from_gray

_MIN_FRAMES = 6
_ENVELOPE_FRACTION = 0.12  # of the frames, above and below the range of a pixel, so that few frames may be damaged
_MIN_LIT_SAMPLES = 200
_MIN_LIT_FRACTION = 0.15  # of the 99th percentile of the range
_MIN_DEVIATION = 0.12  # of the range: frames with less are flat, or their pattern is not resolved
_BRIGHT = 0.5  # of the range: mean of a frame that is white everywhere
_COMPLEMENT, _COPY = -0.75, 0.97  # correlations
_MIN_TESTS = 3
_MIN_SHIFTED = 2  # tests that fail, for a shift of the sequence
_MAX_SWAPS = 2
_MAX_NAMED = 12
_MAX_CHANGES = 3  # of a code; more are no exchange of single frames
_MIN_CLOSER, _MAX_FURTHER_FRACTION = 12, 0.25  # pairs of adjacent pixels
_LIGHTER = 0.2  # of the range: white over black
_MAX_LEFT_FRACTION = 0.2  # of what does not fit of sinusoids as they are labelled

Names = Callable[[int], str]
"""Return the name of a frame by its place."""


@dataclass(frozen=True, slots=True)
class FrameRelations:
    """Light of n frames at m lit pixels, and how it is related. light : (n, m) float32, relative to the range of each
    pixel; the second half of the pixels are neighbours of the first. correlation : (n, n); deviation, mean : (n,).
    """

    light: Samples
    correlation: FloatArray
    deviation: FloatArray
    mean: FloatArray

    def is_flat(self, frame: int) -> bool:
        """True if a frame has the same light everywhere."""
        return bool(self.deviation[frame] < _MIN_DEVIATION)

    def are_complementary(self, one: int, other: int) -> bool:
        """True if one frame is lit where the other is dark."""
        return bool(self.correlation[one, other] < _COMPLEMENT)

    def are_equal(self, one: int, other: int) -> bool:
        """True if two frames with a pattern have the same."""
        return not self.is_flat(one) and not self.is_flat(other) and bool(self.correlation[one, other] > _COPY)


def relate_frames(frames: Sequence[Samples]) -> FrameRelations | None:
    """Compare n frames, each (m,) float32 of the same pixels of the whole image; None with too little light.

    The range of a pixel is that of its values over the frames, without the extreme ones: a code lights each pixel in
    about half of its frames.
    """
    if len(frames) < _MIN_FRAMES:
        return None
    stack = np.stack(frames)
    skipped = max(1, round(_ENVELOPE_FRACTION * len(frames)))
    ordered = np.partition(stack, (skipped, len(frames) - 1 - skipped), axis=0)
    low, high = ordered[skipped], ordered[len(frames) - 1 - skipped]
    span = high - low
    lit = span >= max(2.0, _MIN_LIT_FRACTION * float(np.percentile(span, 99)))
    lit = np.tile(lit.reshape(2, -1).all(axis=0), 2)
    if np.count_nonzero(lit) < _MIN_LIT_SAMPLES:
        return None
    light = (stack[:, lit] - low[lit]) / span[lit]
    half = light[:, : light.shape[1] // 2].astype(np.float64)
    mean = half.mean(axis=1)
    rest = half - mean[:, np.newaxis]
    covariance = rest @ rest.T / rest.shape[1]
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-12))
    return FrameRelations(light, covariance / np.outer(deviation, deviation), deviation, mean)


@dataclass(frozen=True, slots=True)
class CodeFault:
    """Bits of a code that were exchanged: each with its inverse (`inverted`), or with one another (`exchanged`)."""

    inverted: tuple[int, ...] = ()
    exchanged: tuple[tuple[int, int], ...] = ()


def find_code_fault(differences: Samples) -> CodeFault | None:
    """Find bits whose frames were exchanged, from the order of the code; None if there are none or they are not found.

    Adjacent pixels have equal or close indices. Inverting a bit back, or exchanging two bits back, that were confused
    brings many of them closer together, and few further apart. This cannot find the most significant bit exchanged with
    its inverse, which mirrors everything without a gap, bits that are constant over the lit area, nor bits that the
    camera does not resolve.

    differences : (bits, m) float32, of each bit and its inverse, most significant first; the second half of the pixels
    are neighbours of the first.
    """
    bits, distance = len(differences), _CodeDistance(len(differences))
    words = _differing_words(differences > 0)
    before, changes = distance(words), list[CodeFault]()
    inverted = words ^ (2**bits - 1)
    if _is_closer(after := distance(inverted), before):
        # Every bit is inverted, as by a projector that inverts.
        words, before, changes = inverted, after, [CodeFault(inverted=tuple(range(bits)))]
    for _ in range(_MAX_CHANGES):
        candidates: list[tuple[float, CodeFault, Integers, FloatArray]] = []
        for one, other in combinations_with_replacement(range(bits), 2):
            first, second = bits - 1 - one, bits - 1 - other
            if one == other:
                changed, fault = words ^ (1 << first), CodeFault(inverted=(one,))
            else:
                unlike = ((words >> first) ^ (words >> second)) & 1
                changed, fault = words ^ (unlike << first) ^ (unlike << second), CodeFault(exchanged=((one, other),))
            if _is_closer(after := distance(changed), before):
                candidates.append((float(after.mean()), fault, changed, after))
        if not candidates:
            break
        _, fault, words, before = min(candidates, key=lambda each: each[0])
        changes.append(fault)
    if not changes:
        return None
    found = [bit for each in changes for bit in each.inverted]
    return CodeFault(
        tuple(sorted(bit for bit in set(found) if found.count(bit) % 2)),
        tuple(pair for each in changes for pair in each.exchanged),
    )


def _differing_words(lit: NDArray[np.bool_]) -> Integers:
    """Return the code words of those adjacent pixels that differ, (2, pairs) int32. lit : (bits, m)."""
    weights = 2 ** np.arange(len(lit) - 1, -1, -1, dtype=np.int32)
    pair = np.sum(lit * weights[:, np.newaxis], axis=0, dtype=np.int32).reshape(2, -1)
    return np.asarray(pair[:, pair[0] != pair[1]])


class _CodeDistance:
    """Distance in the code of two pixels, by their words: log2(1 + cells), so that far jumps do not dominate."""

    def __init__(self, bits: int) -> None:
        self._index = from_gray(np.arange(2**bits, dtype=np.int32))
        self._log = np.log2(1.0 + np.arange(2**bits)).astype(np.float32)

    def __call__(self, words: Integers) -> FloatArray:
        one, other = self._index[words]
        return np.asarray(self._log[np.abs(one - other)])


def _is_closer(after: FloatArray, before: FloatArray) -> bool:
    """True if many adjacent pixels came closer together, and few further apart."""
    closer, further = int(np.count_nonzero(after < before)), int(np.count_nonzero(after > before))
    return closer >= _MIN_CLOSER and further < _MAX_FURTHER_FRACTION * closer


@dataclass(frozen=True, slots=True)
class OrderFault:
    """Frames that do not show their patterns. cause : description. shows : for each of these frames the pattern that it
    shows, by place in the sequence; None if that is not known. is_sequence : the whole sequence is concerned, so that
    nothing can be measured.
    """

    cause: str
    shows: Mapping[int, int | None] = field(default_factory=dict)
    is_sequence: bool = False


def find_order_fault(
    patterns: Sequence[Pattern], relations: FrameRelations, name: Names, projector: Size | None = None
) -> OrderFault | None:
    """Explain frames that contradict one another by an order of the frames; None if no order explains them.

    patterns : of the frames as they are labelled, each at its place. name : description of a frame by its place.
    projector : its size, if it is known.
    """
    checks = _Checks(patterns, relations, projector)
    identity = tuple(range(len(patterns)))
    failures = checks.failures(identity)
    if checks.count < _MIN_TESTS or not failures:
        return None
    if all(checks.is_inverted(axis) for axis in checks.code_axes) and checks.code_axes and checks.references_exchanged:
        return OrderFault(
            "all frames show the inverse of their patterns, white and black too: the projector or the images are "
            "inverted; set the projector's input to normal polarity, or invert the images",
            is_sequence=True,
        )
    swaps = _exchanged_frames(checks, identity)
    if swaps and len(swaps) <= _MAX_SWAPS:
        listed = "; ".join(f"{name(one)} and {name(other)} are exchanged" for one, other in swaps)
        order = _with_exchanges(identity, swaps)
        shows = {a: b for one, other in swaps for a, b in ((one, other), (other, one))}
        whole = any(isinstance(patterns[each], White | Black) for each in shows)
        return OrderFault(f"{listed}: with them exchanged back, {checks.agreement(order)}", shows, is_sequence=whole)
    if len(failures) >= _MIN_SHIFTED:
        for orders in (_shifted_orders(len(patterns)), _orders_with_a_gap(len(patterns), name)):
            # The labels of a shifted sequence may take white for black.
            fitting = [
                (order, cause)
                for order, cause in orders
                if not checks.failures(order) or not checks.failures(_with_exchanges(order, checks.references))
            ]
            if fitting:
                # The code tells which of the two frames of a pair is missing.
                order, cause = min(fitting, key=lambda each: checks.disorder(each[0]))
                return OrderFault(f"{cause}, {checks.agreement(order)}", is_sequence=True)
    copies = _copied_frames(checks, patterns)
    if copies:
        listed = "; ".join(_describe_copy(name, one, other, patterns) for one, other in copies.items())
        return OrderFault(f"{listed}: taken while another pattern was shown, or its file was replaced", copies)
    return None


class _Checks:
    """Tests of an order of frames: order[pattern] is the frame that shows it, -1 for none."""

    def __init__(self, patterns: Sequence[Pattern], relations: FrameRelations, projector: Size | None) -> None:
        self.relations = relations
        self._patterns = patterns
        self._projector = projector
        self._sine_axes = [axis for axis in Axis if any(isinstance(p, Sine) and p.axis is axis for p in patterns)]
        self._misfits = dict.fromkeys(self._sine_axes, np.inf)
        self._misfits = {axis: self._misfit(axis, range(len(patterns)))[0] for axis in self._sine_axes}
        place = {pattern: index for index, pattern in reversed(list(enumerate(patterns)))}
        inverses = {
            place[p]: place[p.inverse]
            for p in place
            if isinstance(p, Gray | LineShift) and p.inverse is not None and p.inverse in place
        }
        self.pairs = sorted({(min(pair), max(pair)) for pair in inverses.items()})
        self.flat = [index for index, pattern in enumerate(patterns) if isinstance(pattern, White | Black)]
        self.count = len(self.pairs) + len(self.flat) + sum(isinstance(p, Sine) for p in patterns)

    def pair_fails(self, one: int, other: int) -> bool:
        """True if two frames are not complementary, although at least one of them has a pattern."""
        relations = self.relations
        if relations.is_flat(one) and relations.is_flat(other):
            # A bit that is the same on all that is lit, or that the camera does not resolve.
            return False
        return not relations.are_complementary(one, other)

    @property
    def code_axes(self) -> list[Axis]:
        """Axes with a Gray code whose bits all have inverses."""
        return [axis for axis in Axis if self._code_frames(axis)]

    def _code_frames(self, axis: Axis) -> list[tuple[int, int]]:
        """Place of each bit and of its inverse, most significant first; empty unless all are there."""
        place = {(p.bit, p.inverted): i for i, p in enumerate(self._patterns) if isinstance(p, Gray) and p.axis is axis}
        bits = range(max((bit for bit, _ in place), default=-1) + 1)
        whole = all((bit, inverted) in place for bit in bits for inverted in (False, True))
        return [(place[bit, False], place[bit, True]) for bit in bits] if whole else []

    def _lit(self, axis: Axis, order: Sequence[int]) -> NDArray[np.bool_]:
        light, middle = self.relations.light, np.full(self.relations.light.shape[1], 0.5, np.float32)
        frames = [[light[order[i]] if order[i] >= 0 else middle for i in pair] for pair in self._code_frames(axis)]
        return np.stack([bit > inverse for bit, inverse in frames])

    def is_inverted(self, axis: Axis) -> bool:
        """True if the code of an axis has its order only if every bit is inverted."""
        lit = self._lit(axis, range(len(self._patterns)))
        words, distance = _differing_words(lit), _CodeDistance(len(lit))
        return _is_closer(distance(words ^ (2 ** len(lit) - 1)), distance(words))

    def _misfit(self, axis: Axis, order: Sequence[int]) -> tuple[float, bool]:
        """Return what does not fit of the frames of an axis with sinusoids in this order, and whether it is little."""
        places = [p for p in fitted_patterns(self._patterns, axis) if order[p] >= 0]
        shown = tuple(self._patterns[p] for p in places)
        if not any(isinstance(p, Sine) for p in shown):
            return 0.0, True
        model = LightModel.from_patterns(shown, self._projector and self._projector.along(axis))
        misfit, limit = order_misfit(self.relations.light[[order[p] for p in places]], model)
        return misfit, misfit < max(limit, _MAX_LEFT_FRACTION * self._misfits[axis])

    def disorder(self, order: Sequence[int]) -> float:
        """Sum of the distances of adjacent pixels in the codes that frames in this order have, and of what does not fit
        of sinusoids.
        """
        codes = [self._lit(axis, order) for axis in self.code_axes]
        misfit = sum((self._misfit(axis, order)[0] for axis in self._sine_axes), 0.0)
        distance = sum(float(_CodeDistance(len(lit))(_differing_words(lit)).sum()) for lit in codes)
        return float(distance + self.relations.light.shape[1] * misfit)

    @property
    def references(self) -> list[tuple[int, int]]:
        """Places of white and black where the one follows the other."""
        adjacent = zip(self.flat, self.flat[1:], strict=False)
        return [(a, b) for a, b in adjacent if b == a + 1 and type(self._patterns[a]) is not type(self._patterns[b])]

    @property
    def references_exchanged(self) -> bool:
        """True if black is brighter than white."""
        means = {
            kind: [self.relations.mean[i] for i in self.flat if isinstance(self._patterns[i], kind)]
            for kind in (White, Black)
        }
        return bool(means[White] and means[Black] and max(means[White]) < min(means[Black]))

    def flat_fails(self, pattern: int, order: Sequence[int]) -> bool:
        """True if the frame of white or black is not flat, or is not brighter or darker than those of the other."""
        kind = White if isinstance(self._patterns[pattern], White) else Black
        mean, frame = self.relations.mean, order[pattern]
        others = [mean[order[i]] for i in self.flat if not isinstance(self._patterns[i], kind) and order[i] >= 0]
        sign = 1 if kind is White else -1
        return not self.relations.is_flat(frame) or any(sign * (mean[frame] - each) < _LIGHTER for each in others)

    def failures(self, order: Sequence[int]) -> list[tuple[int, ...]]:
        """Return the patterns whose frames in this order contradict: pairs, and single ones that should be flat."""
        found: list[tuple[int, ...]] = []
        for one, other in self.pairs:
            a, b = order[one], order[other]
            if a >= 0 and b >= 0 and self.pair_fails(a, b):
                found.append((one, other))
        found += [(each,) for each in self.flat if order[each] >= 0 and self.flat_fails(each, order)]
        for axis in self._sine_axes:
            if not self._misfit(axis, order)[1]:
                found += [(i,) for i, p in enumerate(self._patterns) if isinstance(p, Sine) and p.axis is axis]
        return found

    def agreement(self, order: Sequence[int]) -> str:
        """Describe that all tests pass."""
        pairs = sum(order[one] >= 0 and order[other] >= 0 for one, other in self.pairs)
        words = [f"all {pairs} pairs of a pattern and its inverse add up"] if pairs or not self._sine_axes else []
        words += ["all sinusoids fit one position per pixel"] if self._sine_axes else []
        words += ["white and black are where they belong"] if self.flat else []
        return " and ".join(words)


def _shifted_orders(count: int) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield orders with all frames shifted."""
    for step in range(1, count // 2 + 1):
        frames = "one frame" if step == 1 else f"{step} frames"
        for shift in (step, -step):
            if shift > 0:
                way = f"ahead of their patterns: with the last {frames.removeprefix('one ')} moved to the front"
            else:
                way = f"behind their patterns: with the first {frames.removeprefix('one ')} moved to the end"
            yield tuple((pattern - shift) % count for pattern in range(count)), f"all frames are {frames} {way}"


def _orders_with_a_gap(count: int, name: Names) -> Iterator[tuple[tuple[int, ...], str]]:
    """Yield orders with one frame missing, or one too many."""
    for missing in range(1, count - 1):
        yield (
            tuple(p if p < missing else -1 if p == missing else p - 1 for p in range(count)),
            f"a frame is missing at {name(missing)}, all later ones are one ahead of their patterns: with a gap there",
        )
    for twice in range(1, count - 1):
        yield (
            tuple(p if p < twice else p + 1 if p + 1 < count else -1 for p in range(count)),
            f"{name(twice)} is one too many, all later ones are one behind their patterns: without it",
        )


def _exchanged_frames(checks: _Checks, identity: tuple[int, ...]) -> list[tuple[int, int]]:
    """Return pairs of frames that explain all failures if they are exchanged back; empty if there are none."""
    order, swaps = identity, list[tuple[int, int]]()
    while failures := checks.failures(order):
        suspects = sorted({each for failure in failures for each in failure})
        exchanges = [(one, other) for one in suspects for other in suspects if one < other]
        orders = {pair: _with_exchanges(order, [pair]) for pair in exchanges}
        left = {pair: len(checks.failures(each)) for pair, each in orders.items()}
        least = min(left.values(), default=len(failures))
        if least > len(failures) - 2:
            return []
        # Exchanging the inverses of two bits makes pairs as exchanging the bits does; the code tells which it was.
        best = min((pair for pair in exchanges if left[pair] == least), key=lambda pair: checks.disorder(orders[pair]))
        swaps.append(best)
        order = orders[best]
    return swaps


def _with_exchanges(order: Sequence[int], swaps: Sequence[tuple[int, int]]) -> tuple[int, ...]:
    frames = list(order)
    for one, other in swaps:
        frames[one], frames[other] = frames[other], frames[one]
    return tuple(frames)


def _copied_frames(checks: _Checks, patterns: Sequence[Pattern]) -> dict[int, int | None]:
    """Return frames of failing pairs that show another pattern: that of the frame which they equal, or white or black.
    Of two frames of one pair that are equal, the later one is the copy.
    """
    relations, found = checks.relations, dict[int, int | None]()
    for failure in checks.failures(tuple(range(len(patterns)))):
        if len(failure) != 2:
            continue
        one, other = failure
        if relations.are_equal(one, other):
            found[other] = one
            continue
        for frame in failure:
            if relations.is_flat(frame):
                wanted = White if relations.mean[frame] > _BRIGHT else Black
                found[frame] = next((i for i, p in enumerate(patterns) if isinstance(p, wanted)), None)
                continue
            twins = [i for i in range(len(patterns)) if i not in failure and relations.are_equal(frame, i)]
            twins = [i for i in twins if patterns[i] != patterns[frame]]
            if twins:
                found[frame] = min(twins, key=lambda twin: abs(twin - frame))
    return found


def _describe_copy(name: Names, frame: int, shown: int | None, patterns: Sequence[Pattern]) -> str:
    if shown is None or isinstance(patterns[shown], White | Black):
        what = "dark" if shown is None or isinstance(patterns[shown], Black) else "white"
        return f"{name(frame)} is {what} everywhere"
    return f"{name(frame)} is a copy of {name(shown)}"


def describe_indices(indices: Sequence[int]) -> str:
    """Describe indices with ranges.

    >>> describe_indices([3, 7, 8, 9, 12])
    '3, 7–9, 12'
    """
    runs: list[list[int]] = []
    for index in sorted(set(indices)):
        if runs and index == runs[-1][-1] + 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    named = [str(run[0]) if len(run) == 1 else f"{run[0]}{'–' if len(run) > 2 else ', '}{run[-1]}" for run in runs]
    return ", ".join(named[:_MAX_NAMED]) + (" …" if len(named) > _MAX_NAMED else "")
