"""Which patterns the images of one camera show, and what remains doubtful: `detection` and `shifted` together, or
`sinusoid_sets`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slrig.errors import BundleError
from slrig.importers.detection import (
    RIVAL,
    Chain,
    CodeBit,
    CodeLevels,
    CodePlace,
    Light,
    Lit,
    Looks,
    Order,
    Reading,
    Unit,
    code_index,
    describe_images,
    find_chain,
    find_light,
    find_orders,
    look_at,
    place_codes,
    replace_units,
)
from slrig.importers.shifted import ShiftedLines, find_lines, position_map, shifted_units
from slrig.importers.sinusoid_sets import SinusoidSet, find_sinusoids
from slrig.model import Axis, Black, Gray, LineShift, Pattern, Sine, Size, White
from slrig.patterns import gray_bits

Names = Callable[[int], str]

_MAX_READ = 6  # orders whose codes are placed on the projector
_USUAL_ORDERS = ("coarse to fine", "fine to coarse")
_MAX_PHOTOGRAPHS = 2
_DARK = 0.12  # level of black images at a usual exposure
_LINES_FIT = 1.0  # cost of a reading over the best, that lines of a period of its code outweigh
_PLAUSIBLE = 1.6  # cost of a reading, above which images may have been turned
_MIN_SURENESS = 0.45
_MAX_DISORDER = 2.2
_UNEVEN_LIGHT = 0.12
_MAX_LEFT_OUT = 2
_MAX_NAMED = 4


@dataclass(frozen=True, slots=True)
class Doubt:
    """Something in a folder that is unusual, and the images that it concerns. is_fault : True for images that do not
    show what their place says.
    """

    text: str
    images: tuple[int, ...] = ()
    is_fault: bool = False


@dataclass(slots=True)
class Understanding:
    """What images show. patterns : of each, None for one that is left out. facts : what was found, in words. left_out :
    why images are of no use. cost : how unlike a capture the best explanation is.
    """

    patterns: list[Pattern | None]
    facts: list[str] = field(default_factory=list)
    doubts: list[Doubt] = field(default_factory=list)
    left_out: dict[int, str] = field(default_factory=dict)
    cost: float = 0.0


def understand(
    samples: Sequence[Light],
    projector: Size,
    name: Names,
    *,
    cell_px: int | None = None,
    offset_px: int | None = None,
    step_px: int = 1,
) -> Understanding:
    """Return what the images of one camera show, in the order of the sequence.

    samples : (3, h, w) of each image, see `sample_image`; step_px : pixels from one sample to the next. name : of an
    image by its place. cell_px, offset_px : of the code, where they are known.

    Raises BundleError: the images are neither a Gray code nor sinusoids that number positions, with what they seem to
    be.
    """
    code: Understanding | None = None
    failure: BundleError | None = None
    try:
        code = _understand_code(samples, projector, name, cell_px=cell_px, offset_px=offset_px)
    except BundleError as cause:
        failure = cause
    if code is not None and not code.doubts:
        return code
    sinusoids = find_sinusoids(samples, projector, step_px=step_px)
    if isinstance(sinusoids, SinusoidSet):
        return _describe_sinusoids(sinusoids, len(samples), projector, name)
    if code is None:
        raise BundleError(f"{failure}; as sinusoids alone: {sinusoids}") from failure
    return code


def _understand_code(
    samples: Sequence[Light], projector: Size, name: Names, *, cell_px: int | None, offset_px: int | None
) -> Understanding:
    """Return which bits of a Gray code, lines and sinusoids beside it images show. Raises BundleError: none."""
    lit = find_light(samples)
    if lit is None:
        raise BundleError(
            f"found {len(samples)} images that differ nowhere by more than their noise: expected a Gray code of light "
            "and dark; expose longer, darken the room, or check that the folder holds one capture"
        )
    looks = look_at(lit)
    width = samples[0].shape[2]
    groups = shifted_units(looks)
    shifted = {image for group in groups for unit in group for image in unit.images}
    smooth = [unit for unit in looks.units if unit.is_smooth and unit.images[0] not in shifted]
    # One or two images without stripes are photographs of the scene, not bits.
    photographs = {unit.images[0] for unit in smooth if len(unit.images) == 1 and len(smooth) <= _MAX_PHOTOGRAPHS}
    outside = shifted | photographs
    code = replace_units(looks, [unit for unit in looks.units if unit.images[0] not in outside])
    chains, direct_first, pairs = _chains(code)
    if not chains or 2 * len(smooth) > sum(len(chain.units) for chain in chains.values()):
        raise BundleError(_nothing_found(looks, len(samples)))
    for axis, chain in chains.items():
        if chain.is_binary:
            raise BundleError(
                f"the code of {axis}s is plain binary: several bits change at one edge; slrig reads Gray codes, whose "
                "edges tell positions between pixels; record a Gray code"
            )
    readings = _read(
        lit, code, chains, projector, leave=outside, direct_first=direct_first, pairs=pairs, hints=(cell_px, offset_px)
    )
    if groups:
        near = [each for each in readings if each.cost < readings[0].cost + _LINES_FIT]
        fits = [
            all(_lines(lit, group, looks, each, chains, projector, width) is not None for group in groups)
            for each in near
        ]
        best = fits.index(True) if True in fits else 0
        readings = [readings[best], *readings[:best], *readings[best + 1 :]]
    for group in groups:
        lines = _lines(lit, group, looks, readings[0], chains, projector, width)
        if lines is not None and lines.is_reversed:
            readings = _forward(readings, lines.axis)
    reading = readings[0]
    rivals = [each for each in readings[1:] if each.cost < reading.cost + RIVAL and each.explains != reading.explains]
    found = Understanding([None] * len(samples), cost=reading.cost)
    for index, shown in enumerate(reading.order.shows):
        found.patterns[index] = _pattern(shown, reading.places)
    for group in groups:
        lines = _lines(lit, group, looks, reading, chains, projector, width)
        images = _line_images(group, looks)
        if lines is None:
            text = "change as often as each other, as shifted lines or sinusoids do, but fit no period of the code"
            found.doubts.append(Doubt(f"{_listed(images, name)} {text}: left out", tuple(images)))
            found.left_out |= dict.fromkeys(images, "shifted, of unknown period")
            continue
        for image, pattern in lines.patterns.items():
            found.patterns[image] = pattern
        _describe_lines(found, lines, name)
    _describe(found, lit, reading, projector, name, pairs=pairs)
    _doubt(found, lit, looks, reading, rivals, chains, projector, name, hint=cell_px)
    return found


def _describe_sinusoids(sinusoids: SinusoidSet, count: int, projector: Size, name: Names) -> Understanding:
    """Say which sinusoids images show, and what else they may be."""
    found = Understanding([sinusoids.references.get(index) for index in range(count)])
    for kind in (White(), Black()):
        named = [name(index) for index, shown in sinusoids.references.items() if shown == kind]
        found.facts.append(f"{kind.kind}: {', '.join(named)}" if named else f"no {kind.kind} image")
    for copy, original in sinusoids.copies.items():
        found.doubts.append(Doubt(f"{name(copy)} is a copy of {name(original)}: left out", (copy,), is_fault=True))
        found.left_out[copy] = "a copy"
    for each in sinusoids.axes:
        axis, images = each.axis, tuple(sorted(each.shown))
        for image, sine in each.shown.items():
            found.patterns[image] = sine
        steps = [sum(sine.period_px == period for sine in each.shown.values()) for period in each.periods_px]
        first, last = (min(max(round(end), 0), projector.along(axis) - 1) for end in each.visible_px)
        found.facts.append(
            f"sinusoids of {axis}s without a code, periods of {_numbers(each.periods_px)} px in {_numbers(steps)} "
            f"steps: {name(images[0])} to {name(images[-1])}; {axis}s {first} to {last} of {projector.along(axis)} are "
            "visible to a camera that stands upright"
        )
        if each.other_periods_px:
            others = " or ".join(map(_numbers, each.other_periods_px[:2]))
            text = (
                f"the periods of {axis}s are taken as {_numbers(each.periods_px)} px, by the projector's extent; the "
                f"images fit {others} px as well: if they are others, state them by --pattern, as "
                f"'{axis}s-sine:{each.periods_px[0]:g}/{steps[0]}', or by --list"
            )
            found.doubts.append(Doubt(text, images))
        if each.is_start_unsure:
            sine = each.shown[images[0]]
            text = (
                f"the sinusoids of {axis}s may begin at another place than {sine.shift}/{sine.steps} of their periods, "
                "which moves all positions: if so, state them by --list"
            )
            found.doubts.append(Doubt(text, images))
        if each.is_mixed:
            text = f"some sinusoids of {axis}s are shifted forward and others backward: no program is known to do so"
            found.doubts.append(Doubt(text, images))
    return found


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{each:.6g}" for each in values)


def _chains(looks: Looks) -> tuple[dict[Axis, Chain], bool, bool]:
    """Return the code of each axis, whether the first of two images is the bit, and whether bits have inverses."""
    resolved = [unit for unit in looks.units if not unit.is_weak]
    pairs = 2 * sum(len(unit.images) == 2 for unit in resolved) > len(resolved)
    direct_first = True
    chains: dict[Axis, Chain] = {}
    for known in (None, True):
        own = {axis: find_chain(looks.units, axis, direct_first=direct_first if known else None) for axis in Axis}
        chains = {axis: chain for axis, chain in own.items() if chain is not None and len(chain.units) > 1}
        signs = [sign for chain in chains.values() for sign in chain.polarity]
        direct_first = sum(signs) >= 0
    return chains, direct_first, pairs


def _read(
    lit: Lit,
    looks: Looks,
    chains: Mapping[Axis, Chain],
    projector: Size,
    *,
    leave: set[int],
    direct_first: bool,
    pairs: bool,
    hints: tuple[int | None, int | None],
) -> list[Reading]:
    """Return explanations of the images, best first. Raises BundleError: there is none."""
    images = describe_images(lit, looks, chains, [*looks.copies, *leave], direct_first=direct_first)
    places = list(images)
    levels = CodeLevels(
        resolved={axis: chain.levels[-1] + 1 for axis, chain in chains.items()},
        full={axis: gray_bits(projector.along(axis), 1, 0) for axis in Axis},
        finest={axis: chain.units[-1].strength for axis, chain in chains.items()},
        direct_first=direct_first,
        pairs=pairs,
    )
    extents = {axis: projector.along(axis) for axis in chains}
    orders: list[Order] = []
    readings: list[Reading] = []
    for turns in ((0,), (1, -1, 2, -2)):
        orders += find_orders([images[place] for place in places], levels, turns)
        orders.sort(key=lambda each: each.cost)
        readings.clear()
        for order in orders[:_MAX_READ]:
            shows: list[CodeBit | str | None] = [None] * len(lit.light)
            for place, shown in zip(places, order.shows, strict=True):
                shows[place] = shown
            exchanged = tuple(places[each] for each in order.exchanged)
            whole = replace(order, shows=tuple(shows), exchanged=exchanged)
            readings += place_codes(lit, whole, extents, cell_px=hints[0], offset_px=hints[1])[:4]
        if any(each.cost < _PLAUSIBLE for each in readings):
            break
    readings.sort(key=lambda each: each.cost)
    lacking = orders[0].absent if orders else ()
    if lacking and (not readings or readings[0].order.cost > orders[0].cost + RIVAL):
        bits = ", ".join(f"{each.axis} bit {each.bit} of {orders[0].bits[each.axis]}" for each in lacking)
        raise BundleError(
            f"no image shows {bits}, nor its inverse: a frame is missing, and without it the code numbers nothing; "
            "record it again, or copy the missing image"
        )
    if not readings:
        raise BundleError(_no_order(chains, looks, projector, orders))
    return readings


def _forward(readings: list[Reading], axis: Axis) -> list[Reading]:
    """Return explanations, those first in which the code of an axis runs with lines that are shifted against it now.

    Where the code also runs backward in the image, it is mirrored; otherwise the lines may be.
    """
    best = readings[0]
    direction = best.directions[axis] * (-1 if best.places[axis].mirrored else 1)
    if direction > 0:
        return readings
    is_mirrored = best.places[axis].mirrored
    forward = [each for each in readings if axis in each.places and each.places[axis].mirrored != is_mirrored]
    return [replace(each, cost=best.cost) for each in forward[:1]] + forward[1:] if forward else readings


def _pattern(shown: CodeBit | str | None, places: Mapping[Axis, CodePlace]) -> Pattern | None:
    match shown:
        case "white":
            return White()
        case "black":
            return Black()
        case CodeBit(axis, bit, inverted):
            place = places[axis]
            is_inverse = inverted != (place.mirrored and bit == 0)
            return Gray(axis, bit, place.bits, place.cell_px, place.offset_px, is_inverse)
    return None


def _line_images(group: Sequence[Unit], looks: Looks) -> list[int]:
    """Images of a group of shifted patterns; one of them may show the same as a bit of the code."""
    own = [image for unit in group for image in unit.images]
    near = range(min(own) - 1, max(own) + 2)
    return sorted([*own, *(copy for copy, first in looks.copies.items() if copy in near and first not in own)])


def _lines(
    lit: Lit,
    group: Sequence[Unit],
    looks: Looks,
    reading: Reading,
    chains: Mapping[Axis, Chain],
    projector: Size,
    width: int,
) -> ShiftedLines | None:
    axis = group[0].axis
    if axis is None or axis not in reading.places:
        return None
    place, shows = reading.places[axis], reading.order.shows
    index, sure = code_index(lit, shows, axis, place.bits)
    resolved = [shown.bit for unit in chains[axis].units if isinstance(shown := shows[unit.place], CodeBit)]
    # Bits that the camera does not resolve displace a position.
    unresolved = place.bits - 1 - max(resolved)
    cells = (index[0] >> unresolved).astype(np.float64)
    if place.mirrored:
        cells = (1 << place.bits >> unresolved) - 1 - cells
    position = position_map(lit, cells, sure, width) * (place.cell_px << unresolved) - 0.5 - place.offset_px
    images = _line_images(group, looks)
    return find_lines(lit, images, axis, position, projector.along(axis), cell_px=place.cell_px)


def _describe_lines(found: Understanding, lines: ShiftedLines, name: Names) -> None:
    images = list(lines.patterns)
    one = next(iter(lines.patterns.values()))
    what = (
        f"sinusoids of {lines.axis}s, {one.steps} steps of a period of {one.period_px:.5g} px"
        if isinstance(one, Sine)
        else f"shifted lines of {lines.axis}s, {one.line_width_px} px wide, every {one.period_px} px"
    )
    found.facts.append(f"{len(images)} {what}: {name(images[0])} to {name(images[-1])}")
    if lines.is_reversed:
        text = (
            f"the lines of {lines.axis}s run against the code: either the lines are shifted backward, or the first bit "
            "of the code is inverted, so that it is mirrored"
        )
        found.doubts.append(Doubt(text, tuple(images)))
    if lines.stray_px > max(0.35, 0.03 * one.period_px):
        text = f"the lines of {lines.axis}s are up to {lines.stray_px:.1f} px from their even places in the code"
        found.doubts.append(Doubt(text, tuple(images)))


def _describe(
    found: Understanding,
    lit: Lit,
    reading: Reading,
    projector: Size,
    name: Names,
    *,
    pairs: bool,
) -> None:
    facts = []
    for kind in (White(), Black()):
        images = [name(index) for index, each in enumerate(found.patterns) if each == kind]
        facts.append(f"{kind.kind}: {', '.join(images)}" if images else f"no {kind.kind} image")
    for axis, place in reading.places.items():
        images_of = [i for i, each in enumerate(found.patterns) if isinstance(each, Gray) and each.axis is axis]
        first, last = reading.cells[axis]
        if place.mirrored:
            first, last = (1 << place.bits) - 1 - last, (1 << place.bits) - 1 - first
        start, end = first * place.cell_px - place.offset_px, (last + 1) * place.cell_px - 1 - place.offset_px
        facts.append(
            f"{place.bits} bits of {axis}s, {'each with its inverse' if pairs else 'without inverses'}, "
            f"{_bit_order(found.patterns, axis)}, cells of {place.cell_px} px"
            f"{f', offset {place.offset_px} px' if place.offset_px else ''}: {name(images_of[0])} to "
            f"{name(images_of[-1])}; {axis}s {max(start, 0)} to {min(end, projector.along(axis) - 1)} of "
            f"{projector.along(axis)} are visible"
        )
    found.facts[:0] = facts
    coded = [i for i, each in enumerate(found.patterns) if isinstance(each, Gray) and 0 < each.bit < each.bits // 2]
    coded = [index for index in coded if lit.is_measured[index]]
    if len(coded) > 1:
        light = lit.factor[coded] / np.median(lit.factor[coded])
        spread = float(light.max() / light.min())
        if spread > 1 + _UNEVEN_LIGHT:
            found.facts.append(
                f"the light of images differs by a factor of {spread:.2f}: automatic exposure or a lamp that follows "
                "the picture; set a fixed exposure"
            )


def _bit_order(patterns: Sequence[Pattern | None], axis: Axis) -> str:
    bits = list(dict.fromkeys(each.bit for each in patterns if isinstance(each, Gray) and each.axis is axis))
    if bits == sorted(bits):
        return _USUAL_ORDERS[0]
    if bits == sorted(bits, reverse=True):
        return _USUAL_ORDERS[1]
    return f"in the order {', '.join(map(str, bits))}"


def _doubt(
    found: Understanding,
    lit: Lit,
    looks: Looks,
    reading: Reading,
    rivals: Sequence[Reading],
    chains: Mapping[Axis, Chain],
    projector: Size,
    name: Names,
    *,
    hint: int | None,
) -> None:
    doubts, order = found.doubts, reading.order
    resolved = {image for unit in looks.units if not unit.is_weak for image in unit.images}
    striped = {
        (each.axis, each.bit) for i, each in enumerate(found.patterns) if isinstance(each, Gray) and i in resolved
    }
    for copy, original in looks.copies.items():
        if found.patterns[copy] is not None:
            continue
        doubts.append(Doubt(f"{name(copy)} is a copy of {name(original)}: left out", (copy,), is_fault=True))
        found.left_out[copy] = "a copy"
    if order.turned:
        count = abs(order.turned)
        frames = "one frame" if count == 1 else f"{count} frames"
        moved = frames.removeprefix("one ")
        way = (
            f"ahead of their patterns: with the last {moved} moved to the front"
            if order.turned > 0
            else f"behind their patterns: with the first {moved} moved to the end"
        )
        doubts.append(Doubt(f"all frames are {frames} {way}, the code is in order"))
    if order.missing:
        bits = ", ".join(f"{each.axis} bit {each.bit}{' inverse' if each.inverted else ''}" for each in order.missing)
        doubts.append(Doubt(f"no image shows {bits}: a frame is missing"))
    if order.exchanged:
        text = f"{_listed(order.exchanged, name)} are in the places of other images: taken for what they show"
        doubts.append(Doubt(text, order.exchanged, is_fault=True))
    for axis, place in reading.places.items():
        signed = -reading.directions[axis] if place.mirrored else reading.directions[axis]
        if place.mirrored:
            images = [i for i, e in enumerate(found.patterns) if isinstance(e, Gray) and e.axis is axis and e.bit == 0]
            text = (
                f"the code of {axis}s is mirrored: its first bit is taken as inverted, so that {axis}s do not run from "
                f"{'right to left' if axis is Axis.COLUMN else 'bottom to top'} in the image"
            )
            doubts.append(Doubt(text, tuple(images)))
        elif signed < -0.5 and len(reading.places) == 1:
            side = "right to left" if axis is Axis.COLUMN else "bottom to top"
            doubts.append(Doubt(f"{axis}s run from {side} in the image: a camera upside down, or a mirrored code"))
        has_lines = any(isinstance(each, LineShift | Sine) and each.axis is axis for each in found.patterns)
        whole = gray_bits(projector.along(axis), 1, 0)
        if place.bits < whole - 1 and not has_lines and hint is None:
            reach = 1 << place.bits
            doubts.append(Doubt(
                f"{place.bits} bits with cells of 1 px would end at {axis} {reach - 1}, the projector has "
                f"{projector.along(axis)}: taken as cells of {place.cell_px} px; if they are others, state --cell-px"
            ))  # fmt: skip
        finest = max((bit for own, bit in striped if own is axis), default=-1)
        if place.bits == whole - 1 > finest + 1 and not has_lines and hint is None:
            doubts.append(Doubt(
                f"the camera does not resolve {axis} bit {finest + 1} and finer ones, so cells of 1 px, of which the "
                "images of one bit are missing, would look the same: state --cell-px"
            ))  # fmt: skip
        if (text := _bit_order(found.patterns, axis)) not in _USUAL_ORDERS and not order.exchanged:
            doubts.append(Doubt(f"the bits of {axis}s come {text}, by what they show: no program is known to do so"))
        if chains[axis].sureness < _MIN_SURENESS or reading.disorder[axis] > _MAX_DISORDER:
            doubts.append(
                Doubt(f"the bits of {axis}s hardly nest as a Gray code does: too much noise, or another code")
            )
    for index in looks.flat:
        shown = found.patterns[index]
        if isinstance(shown, Gray) and (shown.axis, shown.bit) in striped:
            text = f"{name(index)} shows no stripes: by its place it is {shown.axis} bit {shown.bit}"
            doubts.append(Doubt(text + (", inverse" if shown.inverted else ""), (index,)))
    flat = {kind: [i for i, each in enumerate(found.patterns) if each == kind] for kind in (White(), Black())}
    lone = [(kind.kind, images[0]) for kind, images in flat.items() if images]
    if len(lone) == 1:
        (taken, image), other = lone[0], "black" if flat[White()] else "white"
        doubts.append(Doubt(f"{name(image)} is taken for {taken}, and no image for {other}", (image,)))
    grey = [image for image in flat[Black()] if lit.level[image] > _DARK]
    if grey and len(grey) == len(flat[Black()]) and any(place.cell_px > 1 for place in reading.places.values()):
        text = "is taken for black, but is lighter than between stripes, as a bit is that the camera does not resolve"
        doubts.append(Doubt(f"{_listed(grey, name)} {text}", tuple(grey)))
    for kind, images in flat.items():
        numbered = [image for image in images if re.search(r"\d", name(image))]
        if numbered and len(numbered) < len(images):
            others = sorted(set(images) - set(numbered))
            text = (
                f"{_listed(others, name)} is taken for {kind.kind}, and has no number as {_listed(numbered, name)} has"
            )
            doubts.append(Doubt(text, tuple(others)))
    strange = [i for i, each in enumerate(found.patterns) if each is None and i not in found.left_out]
    found.left_out |= dict.fromkeys(strange, "fits no pattern of the set")
    if strange:
        doubts.append(Doubt(f"{_listed(strange, name)} fit no pattern of the code: left out", tuple(strange)))
    if rivals:
        doubts.append(_rivalry(reading, rivals[0], name))


def _rivalry(reading: Reading, rival: Reading, name: Names) -> Doubt:
    """Say how another explanation differs that is as good."""
    words = []
    for axis, place in rival.places.items():
        if axis in reading.places and place != reading.places[axis]:
            other = f"{place.bits} bits of {axis}s with cells of {place.cell_px} px and offset {place.offset_px} px"
            words.append(other + (", mirrored" if place.mirrored else ""))
    differing = [i for i, (a, b) in enumerate(zip(reading.order.shows, rival.order.shows, strict=True)) if a != b]
    if differing and not words:
        words.append(f"another meaning of {_listed(differing, name)}")
    return Doubt(f"the images fit {' and '.join(words)} as well", tuple(differing))


def _listed(images: Sequence[int], name: Names) -> str:
    some = ", ".join(name(each) for each in images[:_MAX_NAMED])
    return f"{some} and {len(images) - _MAX_NAMED} more" if len(images) > _MAX_NAMED else some


def _nothing_found(looks: Looks, count: int) -> str:
    pairs = sum(len(unit.images) == 2 for unit in looks.units)
    smooth = sum(len(unit.images) for unit in looks.units if unit.is_smooth)
    found = f"{smooth} images change smoothly, as phase shifts of several periods do" if smooth else "no Gray code"
    return (
        f"found {count} images, {len(looks.flat)} of them with the same light everywhere, {pairs} pairs of a pattern "
        f"and its inverse: {found}; expected bits of stripes, each twice as fine as the one before, and with them "
        "lines or sinusoids of one period; list others by --list, as 'column sine 0 of 4 period 18.5'"
    )


def _no_order(chains: Mapping[Axis, Chain], looks: Looks, projector: Size, orders: Sequence[Order]) -> str:
    found = ", ".join(f"{len(chain.units)} bits of {axis}s" for axis, chain in chains.items())
    needed = ", ".join(
        f"{gray_bits(projector.along(axis), 1, 0)} for {projector.along(axis)} {axis}s" for axis in chains
    )
    why = "their extent does not fit the projector" if orders else "in no order that a program would show"
    return (
        f"found {found} ({needed} at most), {why}, and {len(looks.flat)} images with the same light everywhere; "
        "correct --projector, or describe the images by --pattern, --names or --list"
    )
