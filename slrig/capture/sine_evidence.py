"""What the frames of sinusoids prove, and what contradicts them, in words."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.capture.frame_checks import CHECK_CABLE, Samples, assign_bands, describe_pattern, describe_rows
from slrig.capture.frame_light import FrameLight
from slrig.capture.sine_checks import (
    MIN_SPARE_FRAMES,
    FrameAgreement,
    LightModel,
    check_agreement,
    choose_pixels,
    fitted_patterns,
)
from slrig.model import Axis, Gray, Pattern, Sine, Size

_MAX_NAMED_SUSPECTS = 3  # in a message
_MAX_WHOLE_FRACTION = 0.9  # of the pixels; fewer are named by their rows


@dataclass(frozen=True, slots=True)
class SineFault:
    """Frames of one axis that do not fit the others. index : pattern that the message names first. suspects : patterns
    whose frames it concerns; wrong : those of them that are proven wrong.
    """

    index: int
    cause: str
    suspects: tuple[int, ...]
    wrong: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class AxisAgreement:
    """Result for one axis. members : patterns whose frames were compared. verified : those whose frames passed a test
    that another pattern would fail. lights : of the sinusoids, if they agree only after these are undone.
    """

    members: tuple[int, ...]
    faults: tuple[SineFault, ...]
    verified: frozenset[int]
    lights: Mapping[int, FrameLight]


_NOTHING = AxisAgreement((), (), frozenset(), {})


def is_due(patterns: Sequence[Pattern], latest: Gray | Sine, known: Collection[int]) -> bool:
    """True if the frame of `latest` completes the sinusoids of a period, or all frames of its axis."""
    if isinstance(latest, Sine):
        group = {p: i for i, p in enumerate(patterns) if isinstance(p, Sine) and _group(p) == _group(latest)}
        if all(patterns.index(pattern) in known for pattern in group):
            return True
    return is_complete(patterns, latest.axis, known)


def is_complete(patterns: Sequence[Pattern], axis: Axis, known: Collection[int]) -> bool:
    """True if an axis has sinusoids, and all of its frames are known."""
    members = fitted_patterns(patterns, axis)
    has_sines = any(isinstance(patterns[place], Sine) for place in members)
    return has_sines and all(place in known for place in members)


def _group(pattern: Sine) -> tuple[Axis, float]:
    return pattern.axis, pattern.period_px


def check_axis(
    patterns: Sequence[Pattern],
    axis: Axis,
    frames: Mapping[int, Samples],
    *,
    row: NDArray[np.intp],
    full_scale: int,
    projector: Size | None,
) -> AxisAgreement:
    """Compare the frames of an axis with one another; nothing follows if they are too few, or too few pixels are lit.

    patterns : of the sequence. frames : samples by pattern; the second half of the samples are neighbours of the first.
    row : image row of each sample. projector : its size, if it is known.
    """
    members = tuple(place for place in fitted_patterns(patterns, axis) if place in frames)
    shown = tuple(patterns[place] for place in members)
    if len(members) < 3 + MIN_SPARE_FRAMES or not any(isinstance(each, Sine) for each in shown):
        return _NOTHING
    stack = np.stack([frames[place] for place in members])
    chosen = choose_pixels(stack, shown, full_scale=full_scale)
    if chosen is None:
        return _NOTHING
    rows = np.tile(row[chosen[: len(chosen) // 2]], 2)
    found = check_agreement(
        stack[:, chosen], LightModel.from_patterns(shown, projector and projector.along(axis)), assign_bands(rows)
    )
    verified = frozenset(int(members[place]) for place in np.flatnonzero(found.fitting))
    lights = {i: light for i, light in zip(members, found.lights, strict=False) if isinstance(patterns[i], Sine)}
    return AxisAgreement(members, tuple(_faults(found, members, patterns, rows)), verified, lights)


def _faults(
    found: FrameAgreement, members: Sequence[int], patterns: Sequence[Pattern], row: NDArray[np.intp]
) -> Iterator[SineFault]:
    names = {place: describe_pattern(index, patterns[index]) for place, index in enumerate(members)}
    part = found.where.mean() < _MAX_WHOLE_FRACTION
    where = f"in {describe_rows(row[found.where])} " if part else ""
    if found.suspects:
        suspects = tuple(members[place] for place in found.suspects)
        named = " or ".join(names[place] for place in found.suspects)
        which = named if len(suspects) <= _MAX_NAMED_SUSPECTS else "one of them"
        if found.opposite:
            cause = (
                "its sinusoids run opposite to the others, from pixel to pixel: two frames of a period are exchanged; "
                "check that the projector shows the patterns in the order they were loaded"
            )
        else:
            cause = (
                f"{where}the frames of this axis do not fit one position per pixel: {which} shows another pattern or "
                f"was damaged, or something moved; {CHECK_CABLE} and the projector's latency, and scan again"
            )
        yield SineFault(suspects[-1], cause, suspects)
        return
    exchanged = [(a, b) for a, b in found.shows.items() if a < b and found.shows.get(b) == a]
    for one, other in exchanged:
        pair = (members[one], members[other])
        cause = (
            f"{where}it shows {names[other]}, and that one shows this: the two frames are exchanged; check that the "
            "projector shows the patterns in the order they were loaded, and its latency"
        )
        yield SineFault(pair[0], cause, pair, pair)
    for place in found.wrong:
        index = members[place]
        if any(place in pair for pair in exchanged):
            continue
        if place in found.shows:
            cause = (
                f"{where}the frame shows {names[found.shows[place]]} instead: it was not exposed while its own pattern "
                "was shown; check the trigger and the projector's latency, and scan again"
            )
        else:
            cause = (
                f"{where}its light does not fit the position that the other {_axis(patterns, members)} frames agree "
                f"on: it was damaged in transfer or shows another pattern; {CHECK_CABLE}, and scan again"
            )
        yield SineFault(index, cause, (index,), (index,))


def _axis(patterns: Sequence[Pattern], members: Sequence[int]) -> Axis:
    return next(pattern.axis for pattern in (patterns[index] for index in members) if isinstance(pattern, Sine))
