"""Which pattern each image of a folder shows: pure functions of sampled images, without trust in names.

Over the lit pixels, a bit and its inverse have the correlation -1 at any exposure, white and black are flat, and each
axis' stripes change along one direction of the image. A finer bit has twice as many edges. In a Gray code one bit
changes at an edge, there the next finer bit is lit and all finer ones are dark: this tells a bit from its inverse, a
code from others, and a missing bit. The place in the sequence decides only what the images leave open: bits that do not
change where there is light, and bits that the camera does not resolve.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, IntArray, Pixels, from_gray

Light = NDArray[np.float32]
Mask = NDArray[np.bool_]

_SAMPLES = 60_000  # of an image
_MIN_LIT = 300
_MIN_RANGE_SIGMAS = 12.0, 6.0
_MIN_STRONG = 0.6  # of the samples with the lower of these ranges, that have the higher one
_MIN_RANGE = 0.4, 0.2, 0.12  # of the 99th percentile of the range: the brightest samples tell exposures first
_MINORITY = 0.01  # of the lit samples, on the other side of the middle: fewer are a flat image
_MAX_NOISY, _ALONE = 0.3, 0.55  # share of a minority that may be noise; of its neighbours that are on the other side
_COMPLEMENT, _COPY = -0.55, 0.96  # correlations
_WEAK_SWING = 0.5, 0.22  # of a pattern alone, with its inverse, over the range: less is not resolved
_MAX_CROSSINGS = 0.42  # of adjacent pixels; stripes with more are not resolved
_SAME_DENSITY = 0.35  # in octaves, of shifted patterns of one period
_MIN_EDGES = 12  # pairs of pixels across an edge
_SURE = 0.5  # mean sign of a bit at the edges of coarser ones
_TOGETHER = 0.6  # of the edges of coarser bits, at which finer ones change too in a plain binary code
_TURNED = 0.8  # what a bit counts whose first image is another than those of the others
_MAX_WEIGHT = 15.0  # root of a number of edges: more are not surer
_FEW_EDGES, _HALF_LIT = -4.0, 0.22  # log2 per pixel; share of samples, of a pattern that changes smoothly
_MIN_FACTOR_SHARE = 0.08  # of the lit samples, that tell the light of an image
_MIN_LIGHT = 0.03  # of lines on the samples that they light, over that of white
_ABOVE_NOISE = 2.5  # standard deviations: fewer samples than that share have such noise
_MIN_FACTOR = 0.5  # of images that tell the range of a pixel: half of them have more
_CONTRAST = 3.0  # of the light of stripes and that between them
_MAX_HIDDEN = 3  # bits that are constant where there is light, or not resolved, at each end of a code
_MISSING, _EXTRA, _WRONG, _EXCHANGED = 1.3, 1.6, 4.0, 1.8  # costs of an order of images
_DARK = 0.15  # level of an image of no light, and distance from 1 of white
_UNEVEN, _APART = 1.6, 0.4  # cost over a difference of levels; least one of a constant bit and its inverse
_MAX_CHANGES = 4  # of the axis in a sequence that plays one after the other
_DROP, _MAX_DROP = 0.05, 4.0  # of the agreement with a Gray code, for each octave more that a finer bit has fewer edges
_UNUSUAL = 4.0  # cost of bits neither from coarse to fine nor from fine to coarse: more than two exchanged images
_MAX_COST = 6.0
_CLEAR = 0.72  # swing of a bit, after which the next finer one is still resolved
_MAX_WORSE = 1.2  # cost of an order over that of the best, that is kept
_BAND = 3  # images that an order may be ahead or behind, beyond those before and after the bits
RIVAL = 0.25  # of the costs of two readings that count as equally good
_REFUTED, _BACKWARD, _LEFT_HANDED, _CENTRED = 3.0, 0.5, 2.0, 0.35  # costs of a reading
_OFF_CENTRE = 3.0  # cost of a visible range whose middle is a projector's extent away from its middle


def sample_step_px(shape: tuple[int, ...]) -> int:
    """Distance from one sample of an image of (H, W) pixels to the next."""
    return max(1, math.ceil(math.sqrt(shape[0] * shape[1] / _SAMPLES)))


def sample_image(image: Pixels) -> Light:
    """Return samples of an image on a grid, with their right and lower neighbours: (3, h, w) float32."""
    step = sample_step_px(image.shape)
    rows, columns = (max(1, (length - 2) // step + 1) for length in image.shape[:2])
    planes = [image[y::step, x::step][:rows, :columns] for y, x in ((0, 0), (0, 1), (1, 0))]
    return np.stack(planes).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Lit:
    """Light of n images at k lit samples, 0 dark to 1 lit, each image by its own factor. light : (n, 3, k) float32 of
    the sample and its two neighbours. factor : (n,) light of an image over the usual one. level : (n,) median light
    without the factor. is_measured : (n,) False for images that tell no factor. sigma : standard deviation of the
    noise, in the unit of light. fraction : of samples that are lit. slots : (k,) place in the grid.
    """

    light: Light
    factor: FloatArray
    level: FloatArray
    is_measured: Mask
    sigma: float
    fraction: float
    slots: IntArray


def find_light(samples: Sequence[Light], *, trimmed: int = 1) -> Lit | None:
    """Return the light of images, (3, h, w) each, at the pixels that the projector lights; None with too few.

    The range of a pixel is that of all images but the extreme ones: brightest and darkest bits tell it as well as white
    and black.
    """
    stack = np.stack([each.reshape(3, -1) for each in samples])
    count = len(stack)
    if count < 4:
        return None
    skipped = min(trimmed if count > 5 else 0, (count - 2) // 2)
    factor, is_measured = np.ones(count), np.zeros(count, np.bool_)
    sigma = _noise(samples)
    recorded: Light | None = None
    for least in _MIN_RANGE:
        even = stack / factor[:, None, None].astype(np.float32)
        # Blurred lines say little of the range, and much of their noise.
        whole = even[factor > _MIN_FACTOR]
        ordered = np.partition(whole, (skipped, len(whole) - 1 - skipped), axis=0)
        low, high = ordered[skipped], ordered[len(whole) - 1 - skipped]
        span = high - low
        recorded = span if recorded is None else recorded
        # An image's factor also scales light of the room, which then changes where the projector lights nothing.
        both = [(each, float(np.percentile(each, 99))) for each in (span, recorded)]
        strong, lit = (
            np.all([(each >= max(sigmas * sigma, least * top, 1e-6)).all(axis=0) for each, top in both], axis=0)
            for sigmas in _MIN_RANGE_SIGMAS
        )
        # The calmer samples tell more, unless they are a few bright spots.
        lit = strong if np.count_nonzero(strong) > _MIN_STRONG * np.count_nonzero(lit) else lit
        if np.count_nonzero(lit) < _MIN_LIT:
            return None
        light = (even[:, :, lit] - low[:, lit]) / span[:, lit]
        found = _factors(light, sigma / span[0, lit])
        is_measured = np.isfinite(found)
        # Lines are dimmer than bits.
        measured = found[is_measured] if is_measured.any() else np.ones(1)
        usual = float(np.median(measured[measured > _MIN_FACTOR * np.percentile(measured, 85)]))
        factor = factor * np.where(is_measured, found, usual) / usual
    slots = np.flatnonzero(lit).astype(np.int32)
    raw = (stack[:, 0, lit] - low[0, lit]) / span[0, lit]
    noise = sigma / float(np.median(span[:, lit]))
    return Lit(light, factor, np.median(raw, axis=1), is_measured, noise, float(lit.mean()), slots)


def _noise(samples: Sequence[Light]) -> float:
    """Standard deviation of the noise: of differences between images at adjacent pixels, the median of the calmest."""
    rest = []
    for one, other in pairwise(samples):
        change = one - other
        rest.append(1.4826 * float(np.median(np.abs(change[0] - change[1]))) / 2)
    return max(0.3, float(np.percentile(rest, 25)))


def _factors(light: Light, noise: FloatArray) -> FloatArray:
    """(n,) light of those samples that an image lights, NaN for images that light few or all. noise : (k,) its standard
    deviation at each sample.
    """
    found = np.full(len(light), np.nan)
    for index, planes in enumerate(light):
        each = planes[0]
        top = float(np.percentile(each, 97))
        level = np.maximum(max(0.5 * top, _MIN_LIGHT), _ABOVE_NOISE * noise)
        bright, dark = each > level, each < 0.5 * top
        if min(bright.mean(), dark.mean()) < _MIN_FACTOR_SHARE or _is_noise(planes, level):
            continue
        # Light of the room at another exposure is bright nowhere.
        if np.median(each[bright]) > _CONTRAST * np.median(each[dark]):
            found[index] = min(max(float(np.median(each[bright])), 2 * _MIN_LIGHT), 4.0)
    return found


@dataclass(frozen=True, slots=True)
class Unit:
    """A pattern with its inverse, or alone. images : one or two. swing : (3, k) float32, above 0 where the first image
    is lit. strength : its median size. axis : None if it changes along both. density : log2 of the edges per pixel.
    is_weak : True if the camera hardly resolves it. is_loose : True if it lights some parts of the image and not
    others, without an edge of light.
    """

    images: tuple[int, ...]
    swing: Light
    strength: float
    axis: Axis | None
    density: float
    is_weak: bool
    is_loose: bool = False

    @property
    def place(self) -> int:
        """Of the first image in the sequence."""
        return self.images[0]

    @property
    def is_smooth(self) -> bool:
        """True if much of the image is half lit between few edges, as by a sinusoid."""
        half = np.abs(self.swing[0]) < 0.5 * np.percentile(np.abs(self.swing[0]), 95)
        return self.density < _FEW_EDGES and not self.is_weak and float(half.mean()) > _HALF_LIT


@dataclass(slots=True)
class Looks:
    """What single images are by themselves. copies : image and the earlier one that it repeats. flat : images with the
    same light everywhere. units : the others.
    """

    copies: dict[int, int] = field(default_factory=dict)
    flat: list[int] = field(default_factory=list)
    units: list[Unit] = field(default_factory=list)


def look_at(lit: Lit) -> Looks:
    """Sort images into flat ones, copies, and patterns with their inverses."""
    looks, light = Looks(), lit.light[:, 0]
    count = len(light)
    centred = light - light.mean(axis=1, keepdims=True)
    deviation = np.sqrt(np.maximum((centred**2).mean(axis=1), 1e-12))
    relation = (centred @ centred.T) / centred.shape[1] / np.outer(deviation, deviation)
    for index in range(count):
        margin = min(0.3, 2.5 * lit.sigma)
        sides = float((light[index] > 0.5 + margin).mean()), float((light[index] < 0.5 - margin).mean())
        grey = float(np.percentile(np.abs(light[index] - np.median(light[index])), 90))
        if min(sides) < _MINORITY or _is_noise(lit.light[index]) or grey < max(0.16, 2.5 * lit.sigma):
            looks.flat.append(index)
    striped = [index for index in range(count) if index not in looks.flat]
    for place, index in enumerate(striped):
        twins = [each for each in striped[:place] if relation[each, index] > _COPY and each not in looks.copies]
        same = [each for each in twins if _is_copy(light[each], light[index], lit.sigma)]
        if same:
            looks.copies[index] = max(same)
    left = [index for index in striped if index not in looks.copies]
    while left:
        index = left.pop(0)
        # The best complement of a pattern is its inverse, of equally good ones the nearest.
        others = sorted((float(relation[index, each]) + 0.002 * abs(each - index), each) for each in left)
        pair: tuple[int, ...] = (index,)
        if others and relation[index, others[0][1]] < _COMPLEMENT:
            pair = (index, others[0][1])
            left.remove(others[0][1])
        looks.units.append(_unit(lit, pair))
    known = [each for each in looks.units if each.axis is not None and not each.is_weak]
    for place, unit in enumerate(looks.units):
        # Few edges, as of coarse bits, need not tell the direction: that of the image before or after it does, of the
        # one that has nearly as many.
        if unit.axis is None and not unit.is_weak and not unit.is_loose and known:
            beside = [*[each for each in known if each.place < unit.place][-1:],
                      *[each for each in known if each.place > unit.place][:1]]  # fmt: skip
            axis = min(beside, key=lambda each: abs(each.density - unit.density)).axis
            looks.units[place] = replace(unit, axis=axis)
    return looks


def _is_noise(planes: Light, level: FloatArray | float = 0.5) -> bool:
    """True if the minority of samples, below or above a level of light, lies alone, in no direction next to another."""
    sign = planes > level
    share = float(sign[0].mean())
    apart = min(float((sign[0] != sign[plane]).mean()) for plane in (1, 2))
    return min(share, 1 - share) < _MAX_NOISY and apart > _ALONE * 2 * share * (1 - share)


def replace_units(looks: Looks, units: Sequence[Unit]) -> Looks:
    """Return the same with other patterns."""
    return Looks(looks.copies, looks.flat, list(units))


def _is_copy(one: Light, other: Light, sigma: float) -> bool:
    """True if two images differ by no more than their noise, at almost all samples."""
    return bool(np.percentile(np.abs(one - other), 98) < max(0.12, 6 * sigma))


def _unit(lit: Lit, images: tuple[int, ...]) -> Unit:
    light = lit.light[list(images)]
    swing = light[0] - light[1] if len(images) == 2 else 2 * light[0] - 1
    sign = swing > 0
    across, down = (float((sign[0] != sign[plane]).mean()) for plane in (1, 2))
    ratio = across / max(across + down, 1e-9)
    few = max(across, down) * sign.shape[1] < _MIN_EDGES
    axis = None if few or 0.42 <= ratio <= 0.58 else Axis.COLUMN if ratio > 0.5 else Axis.ROW
    # What the camera does not resolve has little swing; without an inverse, it may be far from the middle.
    strength = min(float(np.median(np.abs(swing[0]))), float(swing[0].std()))
    weak = strength < _WEAK_SWING[len(images) - 1] or max(across, down) > _MAX_CROSSINGS
    return Unit(images, swing, strength, axis, math.log2(max(across, down, 1e-6)), weak, few and not weak)


@dataclass(frozen=True, slots=True)
class Chain:
    """Bits of one axis from coarse to fine. levels : number of each unit's bit, 0 for the coarsest, with gaps where the
    code lacks a bit. polarity : +1 if the first image of a unit is the bit itself, -1 if it is the inverse, 0 if the
    code does not tell. sureness : mean agreement with a Gray code, 0 to 1. is_binary : True if bits change together, as
    those of a plain binary code.
    """

    axis: Axis
    units: tuple[Unit, ...]
    levels: tuple[int, ...]
    polarity: tuple[int, ...]
    sureness: float
    is_binary: bool


@dataclass(frozen=True, slots=True)
class _Nesting:
    """What a bit, the second index, is at the edges of another, the first. mean : (n, n) -1 to 1; weight : (n, n) root
    of the number of edges; shared : (n, n) share of the edges at which both change.
    """

    mean: FloatArray
    weight: FloatArray
    shared: FloatArray


def find_chain(units: Sequence[Unit], axis: Axis, *, direct_first: bool | None) -> Chain | None:
    """Order the resolved bits of one axis, and tell each from its inverse; None without any.

    direct_first : whether the first image of a unit is the bit, where that is known: then a single step tells a missing
    bit.
    """
    units = sorted((each for each in units if each.axis is axis and not each.is_weak), key=lambda each: each.density)
    if not units:
        return None
    nesting = _nesting(units, 1 if axis is Axis.COLUMN else 2)
    order = list(range(len(units)))
    backward = bool(np.sum(np.sign(np.diff([each.place for each in units]))) < 0)
    best = -math.inf
    while (found := max((_fitness(nesting, units, each, backward=backward), each) for each in _moved(order)))[0] > best:
        best, order = found
    alone = [len(each.images) == 1 for each in units]
    is_lone = [each and not all(alone) for each in alone]
    levels, polarity, sure = _numbered(nesting, order, is_lone, direct_first=direct_first)
    common = nesting.shared[np.triu_indices(len(units), 1)]
    is_binary = len(units) > 3 and float(np.median(common)) > _TOGETHER
    return Chain(axis, tuple(units[k] for k in order), levels, polarity, sure, is_binary)


def _moved(order: list[int]) -> Iterator[list[int]]:
    """Yield an order, and those with one bit moved elsewhere."""
    yield order
    for bit, place in product(order, range(len(order))):
        others = [each for each in order if each != bit]
        yield [*others[:place], bit, *others[place:]]


def _nesting(units: Sequence[Unit], plane: int) -> _Nesting:
    count = len(units)
    sign = np.stack([each.swing[[0, plane]] > 0 for each in units])
    edges = sign[:, 0] != sign[:, 1]
    # At steps in depth many bits change. Near any edge the finest bits may change too.
    finest = np.argsort([each.density for each in units])[max(3, count - 2) :]
    found = _Nesting(*np.zeros((3, count, count)))
    for one, other in product(range(count), repeat=2):
        rest = [k for k in range(count) if k not in (one, other) and k not in finest]
        clean = edges[one] & ~edges[rest].any(axis=0)
        found.shared[one, other] = float(edges[other][edges[one]].mean()) if edges[one].any() else 0.0
        if one == other or (number := int(np.count_nonzero(clean))) < _MIN_EDGES:
            continue
        bit = units[other]
        # A bit alone that the camera blurs is not around the middle between light and dark; half of it is lit.
        middle = float(bit.swing[0].mean()) if len(bit.images) == 1 and bit.density > _FEW_EDGES else 0.0
        swing = (bit.swing[[0, plane]][:, clean].mean(axis=0) - middle) / max(bit.strength, 1e-6)
        found.mean[one, other] = float(np.clip(swing, -1, 1).mean())
        found.weight[one, other] = math.sqrt(number)
    return found


def _fitness(nesting: _Nesting, units: Sequence[Unit], order: Sequence[int], *, backward: bool) -> float:
    """Agreement of an order of bits with a Gray code; among equals, that in the order of the sequence fits best.

    The first images of all units are bits, or of all are inverses, but where images are exchanged or missing.
    """
    mean, weight = (each[np.ix_(order, order)] for each in (nesting.mean, nesting.weight))
    expected = np.triu(np.full(mean.shape, -1.0), 1) + 2 * np.eye(len(order), k=1)
    weight = np.minimum(weight, _MAX_WEIGHT) * (expected != 0)
    votes = (weight * expected * mean).sum(axis=0)
    usual = math.copysign(1.0, float(votes.sum()))
    # Where a bit is missing, the next finer one is dark at the edges of the next coarser one too.
    without = usual * (weight * -np.abs(expected) * mean).sum(axis=0)
    agreement = float(np.maximum.reduce([usual * votes, _TURNED * np.abs(votes), _TURNED * without]).sum())
    # A finer bit has more edges than a coarser one; the coarsest have so few that chance decides.
    drops = -np.diff([units[k].density for k in order])
    agreement -= _DROP * float(np.maximum(drops - _MAX_DROP, 0).sum()) * float(weight.sum())
    steps = np.sign(np.diff([units[k].place for k in order])) * (-1 if backward else 1)
    bonus = 0.01 * float(np.mean(steps)) if len(steps) else 0.0
    return agreement / max(float(weight.sum()), 1e-9) + bonus


def _numbered(
    nesting: _Nesting, order: Sequence[int], is_lone: Sequence[bool], *, direct_first: bool | None
) -> tuple[tuple[int, ...], tuple[int, ...], float]:
    """Return levels and polarity of bits in an order from coarse to fine, and their mean agreement with a Gray code.

    is_lone : of a bit without the inverse that others have, so that it may be the inverse.
    """
    levels, polarity = [0], [0]
    agreement = weights = 0.0
    for finer in range(1, len(order)):
        mean, weight = (each[[order[k] for k in range(finer)], order[finer]] for each in (nesting.mean, nesting.weight))
        if not weight.any():
            levels.append(levels[-1] + 1)
            polarity.append(0)
            continue
        vote, jump = 0.0, 1
        for tried in (1, 2):
            expected = np.where((np.arange(finer) == finer - 1) & (tried == 1), 1.0, -1.0)
            value = float(np.sum(weight * expected * mean) / weight.sum())
            if abs(value) > abs(vote) + 0.15:
                vote, jump = value, tried
        if (
            not weight[:-1].any()
            and not is_lone[order[finer]]
            and direct_first is not None
            and vote * (1 if direct_first else -1) < -_SURE
        ):
            vote, jump = -vote, 2
        levels.append(levels[-1] + jump)
        polarity.append(0 if abs(vote) < _SURE else 1 if vote > 0 else -1)
        agreement += abs(vote) * float(weight.sum())
        weights += float(weight.sum())
    return tuple(levels), tuple(polarity), agreement / weights if weights else 0.0


@dataclass(frozen=True, slots=True)
class _Image:
    """What an image is by itself, for an order of images. level : of a flat one, NaN otherwise. bit : place in its
    chain, -1 if its axis' code has none of it. polarity : +1, -1, or 0 if unknown. is_loose : see `Unit`. is_close :
    True if another bit has as many edges. is_first : True for the first image of a unit.
    """

    axis: Axis | None = None
    bit: int = -1
    polarity: int = 0
    level: float = math.nan
    is_loose: bool = False
    is_close: bool = False
    is_first: bool = True


@dataclass(frozen=True, slots=True)
class CodeBit:
    """One bit of the code of an axis, most significant first; inverted : its inverse."""

    axis: Axis
    bit: int
    inverted: bool


@dataclass(frozen=True, slots=True)
class Order:
    """An order of bits that explains the images. shows : for each image its bit, "white", "black", or None if it is of
    no use. bits : number of bits of each axis. cost : how badly it explains them. turned : number of images that were
    moved from the end to the front. missing : bits without an image. exchanged : images in another's place.
    """

    shows: tuple[CodeBit | str | None, ...]
    bits: dict[Axis, int]
    cost: float
    turned: int = 0
    missing: tuple[CodeBit, ...] = ()
    exchanged: tuple[int, ...] = ()

    @property
    def absent(self) -> tuple[CodeBit, ...]:
        """Bits that neither an image of theirs nor of their inverse shows."""
        shown = {(each.axis, each.bit) for each in self.shows if isinstance(each, CodeBit)}
        return tuple(each for each in self.missing if not each.inverted and (each.axis, each.bit) not in shown)

    @property
    def is_like_scan3d(self) -> bool:
        """True for white and black, then equally many bits of both axes, each with its inverse."""
        has_inverses = any(isinstance(each, CodeBit) and each.inverted for each in self.shows)
        return self.shows[:2] == ("white", "black") and has_inverses and len(set(self.bits.values())) < len(self.bits)


@dataclass(frozen=True, slots=True)
class CodeLevels:
    """Bits of the code of each axis. resolved : levels of its chain; full : bits that the projector needs with cells of
    one pixel; finest : swing of the finest bit that is resolved, after which a bit may be that is not. direct_first :
    each bit comes before its inverse; pairs : each bit comes with its inverse.
    """

    resolved: Mapping[Axis, int]
    full: Mapping[Axis, int]
    finest: Mapping[Axis, float]
    direct_first: bool
    pairs: bool


def find_orders(images: Sequence[_Image], levels: CodeLevels, turns: Sequence[int]) -> list[Order]:
    """Return the orders of a code that explain the images, best first.

    turns : numbers of images that are moved from the end to the front.
    """
    found: list[Order] = []
    for turned in turns:
        moved = [images[(place - turned) % len(images)] for place in range(len(images))]
        for template, bits, prior in sorted(_templates(moved, levels), key=lambda each: each[2]):
            if found and prior > found[0].cost + _MAX_WORSE:
                break
            cost, shows, missing, exchanged = _align(
                moved, template, limit=min(_MAX_COST, found[0].cost + _MAX_WORSE if found else _MAX_COST)
            )
            if not math.isfinite(cost):
                continue
            back = tuple(shows[(place + turned) % len(images)] for place in range(len(images)))
            # More white than black images, or fewer, are rarer than as many.
            lone = 0.25 * (back.count("white") != back.count("black"))
            lone += _UNEVEN * _unevenness(images, back)
            strays = tuple((place - turned) % len(images) for place in exchanged)
            found.append(Order(back, bits, cost + prior + lone + 0.9 * abs(turned), turned, missing, strays))
            found += _other_halves(found[-1], images)
            found.sort(key=lambda each: each.cost)
    return found


def _unevenness(images: Sequence[_Image], shows: Sequence[CodeBit | str | None]) -> float:
    """Return how far levels of flat images are from those that they should have beside each other.

    White images have equal ones, black images too, and a bit and its inverse that are not resolved. A bit that is
    constant and its inverse are far apart.
    """
    levels: dict[object, list[float]] = {}
    resolved: dict[Axis, list[int]] = {}
    for image, shown in zip(images, shows, strict=True):
        if isinstance(shown, CodeBit):
            if image.bit >= 0:
                resolved.setdefault(shown.axis, []).append(shown.bit)
            elif math.isfinite(image.level):
                levels.setdefault((shown.axis, shown.bit), []).append(image.level)
        elif shown is not None:
            levels.setdefault(shown, []).append(image.level)
    found = 0.0
    for key, values in levels.items():
        apart = max(values) - min(values)
        is_coarse = isinstance(key, tuple) and key[1] < min(resolved.get(key[0], [0]))
        if len(values) > 1:
            found += max(0.0, _APART - apart) if is_coarse else apart
    return found


def _other_halves(order: Order, images: Sequence[_Image]) -> list[Order]:
    """Return orders in which a lone image of a bit or its inverse, which does not tell which it is, is the other."""
    found = []
    for bit in order.missing:
        other = replace(bit, inverted=not bit.inverted)
        for place, shown in enumerate(order.shows):
            if shown == other and not images[place].polarity:
                shows = (*order.shows[:place], bit, *order.shows[place + 1 :])
                missing = tuple(other if each == bit else each for each in order.missing)
                found.append(replace(order, shows=shows, missing=missing, cost=order.cost + 0.02))
    return found


def _templates(
    images: Sequence[_Image], levels: CodeLevels
) -> Iterator[tuple[list[tuple[CodeBit, float]], dict[Axis, int], float]]:
    """Yield codes in the order in which the images may show them, each bit with its place in its chain, how many bits
    each axis has, and what speaks against it.
    """
    resolved, full = levels.resolved, levels.full
    places = {axis: [i for i, each in enumerate(images) if each.axis is axis and each.bit >= 0 and each.is_first]
              for axis in resolved}  # fmt: skip
    axes = sorted(resolved, key=lambda axis: np.median(places[axis]))
    # A bit that is missing or moved may stand alone among those of the other axis.
    sequence = [axis for _, axis in sorted((place, axis) for axis in axes for place in places[axis])]
    mixed = sum(one is not other for one, other in pairwise(sequence)) > _MAX_CHANGES
    rising = sum(_trend(images, axis) for axis in axes) >= 0
    spare = sum(1 for each in images if each.bit < 0)
    each_takes = 2 if levels.pairs else 1
    gaps = {axis: _first_gap(images, axis) for axis in axes}
    # A small object hides many coarse bits: images that light parts of it, without an edge.
    loose = sum(each.is_loose for each in images) // each_takes
    first, last = range(max(_MAX_HIDDEN, loose) + 1), range(_MAX_HIDDEN + 1)
    ends = [
        [
            each
            for each in product(first, range(2) if gaps[axis] else (0,), last)
            if sum(each) * each_takes <= spare + 1 and resolved[axis] + sum(each) <= full[axis] + 3
        ]
        for axis in axes
    ]
    for hidden in product(*ends):
        if sum(map(sum, hidden)) * each_takes > spare + 1:
            continue
        bits = {axis: resolved[axis] + sum(each) for axis, each in zip(axes, hidden, strict=True)}
        prior = sum(_prior(bits[a], full[a], levels.finest[a], each) for a, each in zip(axes, hidden, strict=True))
        # Some programs give both axes the bits of the longer one; more than that are of no projector.
        prior += sum(count > max(full[axis] for axis in axes) for axis, count in bits.items())
        numbers: dict[Axis, list[tuple[int, float]]] = {}
        for axis, (coarse, more, _) in zip(axes, hidden, strict=True):
            every = list(range(bits[axis]))
            # Several bits without an edge may lie between two others: places between theirs stand for them.
            gap = gaps[axis] + coarse
            skipped = [0.0 if not more or bit < gap else 0.5 if bit == gap else more for bit in every]
            ordered = [(bit, bit - coarse - skip) for bit, skip in zip(every, skipped, strict=True)]
            numbers[axis] = ordered if rising else ordered[::-1]
        both = (not levels.direct_first, levels.direct_first) if levels.pairs else (not levels.direct_first,)
        for order in (axes, axes[::-1]) if mixed else (axes,):
            for template in _arrangements(order, numbers, both, mixed=mixed):
                yield template, bits, prior
        as_played = {axis: _as_played(images, axis, numbers[axis]) for axis in axes}
        if as_played != numbers and not mixed:
            for template in _arrangements(axes, as_played, both, mixed=False):
                yield template, bits, prior + _UNUSUAL


def _as_played(images: Sequence[_Image], axis: Axis, numbers: list[tuple[int, float]]) -> list[tuple[int, float]]:
    """Return the bits of an axis in the order of their images; bits without one stay behind the next coarser one."""
    first: dict[float, int] = {}
    for index, image in enumerate(images):
        if image.axis is axis and image.bit >= 0:
            first.setdefault(image.bit, index)
    at, places = -1, {}
    for bit, place in numbers:
        at = first.get(place, at)
        places[bit] = at
    return sorted(numbers, key=lambda each: places[each[0]])


def _first_gap(images: Sequence[_Image], axis: Axis) -> int:
    """Return the first place of an axis' chain that no image has, 0 without any."""
    places = {each.bit for each in images if each.axis is axis and each.bit >= 0}
    return next((place for place in range(max(places)) if place not in places), 0)


def _trend(images: Sequence[_Image], axis: Axis) -> float:
    """Above 0 if the bits of an axis come from coarse to fine."""
    places = [(place, each.bit) for place, each in enumerate(images)
              if each.axis is axis and each.bit >= 0 and each.is_first]  # fmt: skip
    x, y = np.array(places, np.float64).T
    return float(np.sum((x - x.mean()) * (y - y.mean())))


def _prior(bits: int, full: int, finest: float, hidden: tuple[int, int, int]) -> float:
    coarse, more, fine = hidden
    against = 0.1 * (coarse + more) + 0.06 * fine + (3.0 * max(0.0, finest - _CLEAR) if fine else 0.0)
    return against + (0.0 if bits == full else 0.1 + 0.05 * (full - bits) if bits < full else 0.6)


def _arrangements(
    axes: Sequence[Axis], numbers: dict[Axis, list[tuple[int, float]]], both: Sequence[bool], *, mixed: bool
) -> Iterator[list[tuple[CodeBit, float]]]:
    """Yield orders of the bits of some axes: each bit and its inverse, or the inverses after the bits of an axis or
    after all bits; one axis after the other, or mixed.
    """

    def bit(axis: Axis, number: tuple[int, float], inverted: bool) -> tuple[CodeBit, float]:
        return CodeBit(axis, number[0], inverted), number[1]

    if mixed:
        longest = max(map(len, numbers.values()))
        turns = [(axis, numbers[axis][k]) for k in range(longest) for axis in axes if k < len(numbers[axis])]
    else:
        turns = [(axis, number) for axis in axes for number in numbers[axis]]
    yield [bit(axis, number, inverted) for axis, number in turns for inverted in both]
    if len(both) == 2:
        yield [bit(axis, number, inverted) for inverted in both for axis, number in turns]
        if len(axes) == 2 and not mixed:
            yield [bit(axis, number, inverted) for axis in axes for inverted in both for number in numbers[axis]]


def _mismatch(image: _Image, bit: CodeBit, place: float, resolved: dict[Axis, set[int]]) -> float:
    """Cost of taking an image for a bit; place : of the bit in its axis' chain, beyond it for hidden bits."""
    is_fine = place > max(resolved[bit.axis])
    is_coarse = not is_fine and place not in resolved[bit.axis]
    if math.isfinite(image.level):
        ends, middle = min(abs(image.level), abs(1 - image.level)), abs(image.level - 0.5)
        # Stripes that the camera does not resolve are neither dark nor as bright as white; of the finest bit that it
        # does, one of two images may be so.
        blurred = 0.1 + 0.8 * middle + (0.0 if ends > _DARK else _EXTRA)
        is_finest = place == max(resolved[bit.axis])
        return 0.1 + 0.8 * ends if is_coarse else blurred if is_fine else 0.2 + blurred if is_finest else _WRONG
    turned = bool(image.polarity) and image.polarity != (-1 if bit.inverted else 1)
    if image.is_loose:
        return 0.1 + 0.6 * turned if is_coarse else _WRONG
    if image.bit < 0:
        return 0.3 * (image.axis not in (bit.axis, None)) + 0.3 * turned if is_fine else _WRONG
    if is_coarse or is_fine or image.axis is not bit.axis:
        return _WRONG
    apart = abs(image.bit - place)
    return (0.5 if apart == 1 and image.is_close else _EXCHANGED if apart else 0.0) + _EXCHANGED / 2 * turned


def _align(
    images: Sequence[_Image], template: Sequence[tuple[CodeBit, float]], *, limit: float
) -> tuple[float, tuple[CodeBit | str | None, ...], tuple[CodeBit, ...], tuple[int, ...]]:
    """Return the least cost of aligning images with bits, what each image then shows, the bits without an image, and
    the images in another's place.

    Flat images before and after the bits are white and black; others that fit no bit are left out. Cost of an order by
    dynamic programming, as of an edit distance; infinite above `limit`.
    """
    count, length = len(images), len(template)
    resolved: dict[Axis, set[int]] = {}
    for image in images:
        if image.axis is not None and image.bit >= 0:
            resolved.setdefault(image.axis, set()).add(image.bit)
    extra = [[_spare(image, is_end=end) for image in images] for end in (False, True)]
    cost = [[math.inf] * (length + 1) for _ in range(count + 1)]
    step = [[""] * (length + 1) for _ in range(count + 1)]
    cost[0][0] = 0.0
    spare = count - length
    for i in range(count + 1):
        for j in range(max(0, i - max(spare, 0) - _BAND), min(length, i - min(spare, 0) + _BAND) + 1):
            best, how = cost[i][j], step[i][j]
            if i and (value := cost[i - 1][j] + extra[j in (0, length)][i - 1]) < best:
                best, how = value, "extra"
            if j and (value := cost[i][j - 1] + _MISSING) < best:
                best, how = value, "missing"
            if i and j and cost[i - 1][j - 1] < min(best, limit):
                bit, place = template[j - 1]
                if (value := cost[i - 1][j - 1] + _mismatch(images[i - 1], bit, place, resolved)) < best:
                    best, how = value, "shown"
            cost[i][j], step[i][j] = best, how
        if min(cost[i]) > limit:
            return math.inf, (), (), ()
    if cost[count][length] > limit:
        return math.inf, (), (), ()
    shows: list[CodeBit | str | None] = [None] * count
    missing: list[CodeBit] = []
    exchanged: list[int] = []
    i, j = count, length
    while i or j:
        how = step[i][j]
        if how == "shown":
            i, j = i - 1, j - 1
            shows[i] = _shown(images[i], template[j], template)
            exchanged += [i] if shows[i] != template[j][0] else []
        elif how == "missing":
            j -= 1
            missing.append(template[j][0])
        else:
            i -= 1
            level = images[i].level
            if math.isfinite(level) and j in (0, length):
                shows[i] = "white" if level > 0.35 else "black"
    return cost[count][length], tuple(shows), tuple(reversed(missing)), tuple(reversed(exchanged))


def _shown(image: _Image, expected: tuple[CodeBit, float], template: Sequence[tuple[CodeBit, float]]) -> CodeBit:
    """Return the bit that an image shows: what it is by itself counts more than its place in the order."""
    bit, place = expected
    if image.bit < 0 or image.is_close:
        return bit
    own = next((each for each, at in template if each.axis is image.axis and at == image.bit), bit)
    inverted = image.polarity < 0 if image.polarity else bit.inverted
    return replace(own, inverted=inverted) if place != image.bit or inverted != bit.inverted else bit


def _spare(image: _Image, *, is_end: bool) -> float:
    """Cost of an image that shows no bit: none for white and black before and after them."""
    if not math.isfinite(image.level) or not is_end:
        return _EXTRA
    return 0.1 + 1.2 * min(abs(image.level), abs(1 - image.level))


def describe_images(
    lit: Lit, looks: Looks, chains: Mapping[Axis, Chain], leave: Sequence[int], *, direct_first: bool
) -> dict[int, _Image]:
    """Return what each image but those in `leave` is by itself.

    direct_first : whether the first image of most units is the bit: so it may be in those where the code does not tell.
    """
    found = {index: _Image(level=float(lit.level[index])) for index in looks.flat}
    for unit in looks.units:
        usual = (1 if direct_first else -1) if len(unit.images) == 2 else 0
        for place, index in enumerate(unit.images):
            polarity = usual * (-1 if place else 1)
            found[index] = _Image(unit.axis, polarity=polarity, is_loose=unit.is_loose, is_first=not place)
    for axis, chain in chains.items():
        for place, (unit, bit) in enumerate(zip(chain.units, chain.levels, strict=True)):
            near = [abs(unit.density - chain.units[k].density) for k in (place - 1, place + 1)
                    if 0 <= k < len(chain.units)]  # fmt: skip
            close = min(near, default=9) < 0.6
            for index, sign in zip(unit.images, (1, -1), strict=False):
                polarity = sign * chain.polarity[place]
                found[index] = _Image(axis, bit, polarity, is_close=close, is_first=sign > 0)
    return {index: each for index, each in sorted(found.items()) if index not in leave}


def code_index(lit: Lit, shows: Sequence[CodeBit | str | None], axis: Axis, bits: int) -> tuple[IntArray, Mask]:
    """Return the index of the cell at each sample and its neighbours, (3, k), by the bits that images show, and which
    samples all resolved bits agree on. An image of every bit is needed, or of its inverse.
    """
    lit_bits = np.zeros((bits, *lit.light.shape[1:]), np.bool_)
    sure = np.ones(lit.light.shape[2], np.bool_)
    for bit in range(bits):
        own = {each.inverted: i for i, each in enumerate(shows)
               if isinstance(each, CodeBit) and (each.axis, each.bit) == (axis, bit)}  # fmt: skip
        if len(own) == 2:
            swing = lit.light[own[False]] - lit.light[own[True]]
        elif own:
            ((inverted, index),) = own.items()
            swing = (2 * lit.light[index] - 1) * (-1 if inverted else 1)
        else:
            sure[:] = False
            continue
        lit_bits[bit] = swing > 0
        if bit < bits - 3:
            sure &= np.abs(swing[0]) > 0.25
    weights = 2 ** np.arange(bits - 1, -1, -1, dtype=np.int32)
    return np.asarray(from_gray(np.tensordot(weights, lit_bits.astype(np.int32), axes=1)), np.int32), sure


def code_disorder(index: IntArray, sure: Mask, plane: int) -> float:
    """Mean log2(1 + cells) between adjacent pixels that differ: about 1 in a code whose bits are in order."""
    pair = index[[0, plane]][:, sure]
    pair = pair[:, pair[0] != pair[1]]
    return float(np.mean(np.log2(1.0 + np.abs(pair[0] - pair[1])))) if pair.shape[1] >= _MIN_EDGES else math.nan


def seen_range(index: IntArray, sure: Mask) -> tuple[int, int]:
    """First and last cell of a code that enough samples show, (0, -1) without any."""
    cells = index[0, sure]
    if not len(cells):
        return 0, -1
    counts = np.bincount(cells)
    # One stray sample is no cell: neighbouring cells confirm each other.
    wide = np.convolve(counts > 0, np.ones(5), mode="same") * np.convolve(counts, np.ones(5), mode="same")
    found = np.flatnonzero(wide >= max(8, 0.0005 * len(cells)))
    return (int(found[0]), int(found[-1])) if len(found) else (0, -1)


def direction(index: IntArray, sure: Mask, plane: int) -> float:
    """Share of adjacent pixels whose cell grows to the right (plane 1) or down (plane 2), less that where it falls."""
    change = index[plane, sure] - index[0, sure]
    steps = change[(change != 0) & (np.abs(change) < max(4, np.ptp(index[0, sure]) // 8))] if sure.any() else change[:0]
    return float(np.mean(np.sign(steps))) if len(steps) >= _MIN_EDGES else 0.0


@dataclass(frozen=True, slots=True)
class CodePlace:
    """Where a code is on the projector. mirrored : True if its first bit is inverted, so that it runs backward."""

    bits: int
    cell_px: int
    offset_px: int
    mirrored: bool = False


@dataclass(frozen=True, slots=True)
class Reading:
    """One explanation of the images. cells : first and last cell of each axis that is visible. directions : of the code
    in the image, -1 to 1. disorder : see `code_disorder`. costs : what speaks against it.
    """

    order: Order
    places: dict[Axis, CodePlace]
    cells: dict[Axis, tuple[int, int]]
    directions: dict[Axis, float]
    disorder: dict[Axis, float]
    cost: float

    @property
    def explains(self) -> object:
        """What it means for the images, to compare readings."""
        return self.order.shows, tuple(sorted(self.places.items()))


def place_codes(
    lit: Lit,
    order: Order,
    extents_px: dict[Axis, int],
    *,
    cell_px: int | None = None,
    offset_px: int | None = None,
) -> list[Reading]:
    """Return where the codes of an order of images may be on the projector, the most plausible first.

    The cells that are visible must be on the projector. An object is likelier in the middle of the light than at its
    border, and a code likelier starts at the first pixel, with cells of a power of two. Columns and rows of a camera
    that looks at the side which the projector lights have one handedness.
    cell_px, offset_px : where they are known.
    """
    per_axis: dict[Axis, list[tuple[CodePlace, float]]] = {}
    cells, directions, disorder = {}, {}, {}
    for axis, bits in order.bits.items():
        index, sure = code_index(lit, order.shows, axis, bits)
        if not sure.any():
            return []
        plane = 1 if axis is Axis.COLUMN else 2
        cells[axis] = seen_range(index, sure)
        directions[axis] = direction(index, sure, plane)
        disorder[axis] = code_disorder(index, sure, plane)
        found_places = []
        for place, prior in _places(bits, extents_px[axis], cell_px, offset_px):
            first, last = cells[axis]
            if place.mirrored:
                first, last = (1 << bits) - 1 - last, (1 << bits) - 1 - first
            ends_px = first * place.cell_px - place.offset_px, (last + 1) * place.cell_px - place.offset_px
            margin_px = 2 * place.cell_px + 2
            beyond = ends_px[0] < -margin_px or ends_px[1] > extents_px[axis] + margin_px
            middle = abs(sum(ends_px) / 2 / extents_px[axis] - 0.5)
            found_places.append((place, prior + _OFF_CENTRE * max(0.0, middle - 0.12) + (_REFUTED if beyond else 0.0)))
        per_axis[axis] = sorted(found_places, key=lambda each: each[1])[:6]
    found = []
    for combination in product(*per_axis.values()):
        cost = order.cost + sum(prior for _, prior in combination)
        signs = [-directions[axis] if place.mirrored else directions[axis]
                 for axis, (place, _) in zip(per_axis, combination, strict=True)]  # fmt: skip
        backward = sum(each < -0.5 for each in signs)
        cost += (0.0, _BACKWARD, 0.2)[backward] if len(signs) < 2 or backward != 1 else _LEFT_HANDED
        places = {axis: place for axis, (place, _) in zip(per_axis, combination, strict=True)}
        # scan3d-capture centres both codes, of equally many bits, after white and black.
        if any(place.offset_px and not place.mirrored for place in places.values()) and order.is_like_scan3d:
            centred = {axis: ((1 << p.bits) * p.cell_px - extents_px[axis]) // 2 for axis, p in places.items()}
            if all(place.offset_px == centred[axis] for axis, place in places.items()):
                cost += 0.15 - _CENTRED * sum(place.offset_px > 0 for place in places.values())
        found.append(Reading(order, places, cells, directions, disorder, cost))
    return sorted(found, key=lambda each: each.cost)


def _places(bits: int, extent_px: int, cell_px: int | None, offset_px: int | None) -> Iterator[tuple[CodePlace, float]]:
    """Yield cells and offsets of a code of so many bits on a projector, and what speaks against each."""
    whole = max(1, (extent_px - 1).bit_length())
    usual = 1 << max(whole - bits, 0)
    for cell in sorted({usual, *(range(1, extent_px // max(1, (1 << bits) // 4) + 2)), *filter(None, [cell_px])}):
        if cell_px is not None and cell != cell_px:
            continue
        width = (1 << bits) * cell
        tried: set[tuple[int, bool]] = set()
        for offset, mirrored, against in (
            (0, False, 0.0),
            (0, True, 0.4),
            (width - extent_px, True, 0.4),
            ((width - extent_px) // 2, False, _CENTRED),
            ((width - extent_px) // 2, True, 0.4 + _CENTRED),
            *(((offset_px, False, 0.0),) if offset_px else ()),
        ):
            if offset < 0 or (offset, mirrored) in tried or (offset_px is not None and offset != offset_px):
                continue
            needed = max(1, ((extent_px - 1 + offset) // cell).bit_length())
            # The shorter axis may have the bits of the longer one, of which the first are constant.
            if needed != bits and not (needed < bits and cell == 1 and not offset and not mirrored):
                continue
            tried.add((offset, mirrored))
            is_power = cell & (cell - 1) == 0
            yield (
                CodePlace(bits, cell, offset, mirrored),
                against + (0.0 if cell == usual else 0.3 if is_power else 0.6),
            )
