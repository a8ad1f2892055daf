"""Shifted lines and sinusoids among the images of a folder, measured against the code: pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from slrig.importers.detection import Lit, Looks, Mask, Unit
from slrig.model import MIN_LINE_STEPS, Axis, FloatArray, LineShift, Sine

_SAME_DENSITY = 0.4  # octaves
_NEAR_DENSITY = 0.8  # octaves, of patterns that come next to those of one period
_ALIKE = 0.6  # swing of lines over that of the clearest ones of the same period
_MAX_SPREAD = 1.5  # octaves, of lines of one period
_FINE = -5.5  # log2 of edges per pixel: coarser bits may have equally many by chance
_WINDOW, _MAX_WINDOW, _CELLS = 5, 61, 2.0  # samples and cells, over which the position of cells is averaged
_MIN_SHARE = 0.75  # of the samples around one, for a mean
_WHOLE = 0.004  # distance of a period from whole pixels that is none
_MIN_SINE, _MIN_SINE_PX = 0.8, 10.0  # coherence, period: lines of shorter ones may look like sinusoids
_FITTING = 0.03  # of a cell, that a whole number of cells differs from a period
_MAX_THIRD = 0.1  # of the first harmonic, at a third of the period
_MAX_STRAY = 0.35  # of a step
_MIN_COHERENCE = 0.2


def shifted_units(looks: Looks) -> list[list[Unit]]:
    """Return groups of patterns that have as many edges as each other, as no bits of a code have: three or more without
    inverses, or two or more with them.
    """
    groups: list[list[Unit]] = []
    of_bits = {1}
    for gap in {_gap(unit) for unit in looks.units if len(unit.images) == 2}:
        octaves = [unit.density for unit in looks.units if _gap(unit) == gap and not unit.is_weak]
        if len(octaves) > 2 and max(octaves) - min(octaves) > _MAX_SPREAD:
            of_bits.add(gap)
    for axis in Axis:
        # Inverses stand apart as far as those of bits do, or of lines of half their period.
        own = [u for u in looks.units if u.axis is axis and u.density > _FINE and _gap(u) not in of_bits]
        runs: list[list[Unit]] = [[]]
        for unit in sorted(own, key=lambda each: each.density):
            if runs[-1] and unit.density - runs[-1][0].density > _SAME_DENSITY:
                # Noise adds edges where there is little light: patterns of one period come one after the other.
                if _continues(unit, runs[-1]):
                    runs[-1].append(unit)
                    continue
                runs.append([])
            runs[-1].append(unit)
        groups += runs
    # The last bits of a code, which the camera hardly resolves, have as many edges as each other too.
    found = [
        run
        for run in groups
        if len(run) > 1
        and sum(len(each.images) for each in run) >= MIN_LINE_STEPS
        and min(each.strength for each in run) > _ALIKE * max(each.strength for each in run)
    ]
    for run in found:
        # What the camera hardly resolves stands between the others.
        first, last = min(unit.images[0] for unit in run), max(unit.images[-1] for unit in run)
        known = [unit for group in found for unit in group]
        run += [u for u in looks.units if u not in known and first < u.images[0] <= u.images[-1] < last]
    return found


def _continues(unit: Unit, run: Sequence[Unit]) -> bool:
    first, last = min(each.images[0] for each in run), max(each.images[-1] for each in run)
    near = first - 1 <= unit.images[0] <= unit.images[-1] <= last + 1
    return len(run) > 1 and near and unit.density - run[0].density <= _NEAR_DENSITY


def _gap(unit: Unit) -> int:
    return unit.images[-1] - unit.images[0]


@dataclass(frozen=True, slots=True)
class ShiftedLines:
    """Lines that images show. coherence : 0 to 1, of their light with the period. reversed : True if they run against
    the order of the images. stray_px : largest distance of a line from its even place.
    """

    axis: Axis
    patterns: Mapping[int, LineShift | Sine]
    coherence: float
    is_reversed: bool
    stray_px: float


def position_map(lit: Lit, index: FloatArray, sure: Mask, width: int) -> FloatArray:
    """(k,) position in cells, from 0, smoothed over neighbouring samples, so that it is finer than a cell; NaN at steps
    in depth. width : of the grid of samples.
    """
    height = int(lit.slots.max()) // width + 1
    grid, weight = np.zeros((2, height * width), np.float32)
    kept = lit.slots[sure]
    grid[kept], weight[kept] = index[sure], 1.0
    grid, weight = grid.reshape(height, width), weight.reshape(height, width)
    both = (weight[:, 1:] > 0) & (weight[:, :-1] > 0)
    across = np.abs(np.diff(grid, axis=1))[both]
    down = np.abs(np.diff(grid, axis=0))[(weight[1:] > 0) & (weight[:-1] > 0)]
    cells = max(float(np.mean(np.minimum(each, 3))) if each.size else 0.0 for each in (across, down))
    # A mean over several cells is finer than one of them.
    side = 2 * int(np.clip(_CELLS / max(cells, 1e-3), _WINDOW, _MAX_WINDOW) / 2) + 1
    size = (side, side)
    share = cv2.blur(weight, size, borderType=cv2.BORDER_CONSTANT)
    mean = cv2.blur(grid * weight, size, borderType=cv2.BORDER_CONSTANT) / np.maximum(share, 1e-6)
    high = cv2.dilate(np.where(weight > 0, grid, -1e9), np.ones(size, np.uint8))
    low = cv2.erode(np.where(weight > 0, grid, 1e9), np.ones(size, np.uint8))
    inside = share > _MIN_SHARE
    usable = inside & (high - low <= 1.5 * np.percentile((high - low)[inside], 90) + 2) if inside.any() else inside
    return np.where(usable, mean + 0.5, np.nan).ravel()[lit.slots].astype(np.float64)


def find_lines(
    lit: Lit, images: Sequence[int], axis: Axis, position_px: FloatArray, extent_px: int, *, cell_px: int
) -> ShiftedLines | None:
    """Find period, width and shift of lines or sinusoids in images, in their order, by the position of each sample;
    None if they are neither.

    position_px : (k,) of the samples, as columns or rows count; NaN where it is unknown. cell_px : of the
    code.
    """
    known = np.isfinite(position_px)
    if np.count_nonzero(known) < 200 or len(images) < MIN_LINE_STEPS:
        return None
    place = position_px[known]
    light = lit.light[list(images), 0][:, known].astype(np.float64)
    light = light - light.mean(axis=1, keepdims=True)
    count = len(images)
    sine = _find_sine(lit, images, axis, place, light, cell_px=cell_px)
    if sine is not None:
        return sine
    best: tuple[float, int, FloatArray] | None = None
    for period in range(max(4, count), min(8 * count, extent_px // 2) + 1):
        if period % count:
            continue
        wave, coherence = _fit_wave(light, place, period)
        if best is None or coherence > best[0]:
            best = coherence, period, wave
    if best is None or best[0] < _MIN_COHERENCE:
        return None
    coherence, period, wave = best
    step = period // count
    centre = (np.angle(wave) * period / (2 * np.pi)) % period
    turns = np.array([((b - a) / step + count / 2) % count - count / 2 for a, b in pairwise(centre)])
    is_reversed = bool(np.median(turns) < 0)
    # Blurred lines look wider than they are: the place of the first shift tells more than their light.
    share = float(np.mean(lit.light[list(images), 0].clip(0, 1) * lit.factor[list(images), None]))
    candidates = []
    for width in range(1, period):
        shift = np.rint(centre - (width - 1) / 2) % period
        stray = float(np.median(_apart(centre, shift + (width - 1) / 2, period)))
        even = sorted(shift.astype(int).tolist()) == (int(shift.min()) + step * np.arange(count)).tolist()
        first = shift[-1 if is_reversed else 0]
        against = (
            3.0 * stray + 1.5 * abs(width / period - share) + (0.0 if first == 0 else 0.5 if shift.min() == 0 else 1.0)
        )
        candidates.append((not even, against, width, shift))
    uneven, _, width, shift = min(candidates, key=lambda each: each[:2])
    if uneven:
        return None
    stray_px = float(_apart(centre, shift + (width - 1) / 2, period).max())
    patterns = {image: LineShift(axis, int(s), period, width) for image, s in zip(images, shift, strict=True)}
    return ShiftedLines(axis, patterns, coherence, is_reversed, stray_px)


def _find_sine(
    lit: Lit, images: Sequence[int], axis: Axis, place: FloatArray, light: FloatArray, *, cell_px: int
) -> ShiftedLines | None:
    """Return sinusoids: half of the light, and less of the third harmonic than lines have that a camera resolves."""
    count, span = len(images), float(np.ptp(place))
    frequencies = np.arange(1 / span, 1 / _MIN_SINE_PX, 0.2 / span)
    thin = slice(None, None, max(1, len(place) // 4000))
    coherence = [_fit_wave(light[:, thin], place[thin], 1 / each)[1] for each in frequencies]
    best = frequencies[int(np.argmax(coherence))]
    finer = best + np.linspace(-0.2, 0.2, 41) / span
    finer = finer[finer > 0]
    period = 1 / finer[int(np.argmax([_fit_wave(light[:, thin], place[thin], 1 / each)[1] for each in finer]))]
    # Positions between the edges of wide cells are less certain than that periods and cells fit each other.
    whole = cell_px * round(period / cell_px)
    if whole and abs(period - whole) < max(_WHOLE * period, _FITTING * cell_px):
        period = float(whole)
    elif abs(period - round(period)) < _WHOLE * period:
        period = float(round(period))
    wave, fits = _fit_wave(light, place, period)
    third = float(np.median(np.abs(_fit_wave(light, place, period / 3)[0]) / np.maximum(np.abs(wave), 1e-9)))
    share = float(np.mean(lit.light[list(images), 0].clip(0, 1)))
    if fits < _MIN_SINE or period < _MIN_SINE_PX or third > _MAX_THIRD or not 0.25 < share < 0.75:
        return None
    centre = (np.angle(wave) / (2 * np.pi)) % 1
    turns = np.array([((b - a) * count + count / 2) % count - count / 2 for a, b in pairwise(centre)])
    if np.abs(np.abs(turns) - 1).max() > _MAX_STRAY:
        return None
    # A program may begin with a sine or a cosine: a quarter of a period is a step of twice or four times as many.
    for steps in (count, 2 * count, 4 * count):
        stray = _apart(centre * steps, np.rint(centre * steps), steps)
        if stray.max() < _MAX_STRAY * steps / (4 * count) or steps == 4 * count:
            break
    shifts = np.rint(centre * steps).astype(int) % steps
    if len(set(shifts.tolist())) < count:
        return None
    patterns = {image: Sine(axis, float(period), int(each), steps) for image, each in zip(images, shifts, strict=True)}
    return ShiftedLines(axis, patterns, fits, bool(np.median(turns) < 0), float(stray.max() * period / steps))


def _fit_wave(light: FloatArray, place: FloatArray, period: float) -> tuple[FloatArray, float]:
    """Return amplitude and phase of each image's light by least squares, (n,) complex, and how much they explain."""
    angle = 2 * np.pi * place / period
    terms = np.stack([np.ones_like(angle), np.cos(angle), np.sin(angle)])
    fitted = np.linalg.lstsq(terms @ terms.T, terms @ light.T, rcond=None)[0]
    rest = light - fitted.T @ terms
    explained = 1 - (rest**2).sum(axis=1) / np.maximum((light**2).sum(axis=1), 1e-9)
    return fitted[1] + 1j * fitted[2], float(np.sqrt(np.maximum(explained, 0)).mean())


def _apart(one: FloatArray, other: FloatArray, period: float) -> FloatArray:
    """Distance of positions on a circle."""
    return np.asarray(np.abs((one - other + period / 2) % period - period / 2))
