"""When light comes: flashes between black and white, timed by the rows of the frames that saw them.

A frame's first row is exposed from s to s + e, as its time stamps say, and row r later by r·ℓ: the line time ℓ is that
of a rolling shutter, and 0 for a global one. When the light changes at T, row r has collected the share h of what it
will collect from now on:

    h = (s + r·ℓ + e - T)/e                                        where 0 < h < 1,

so each row that was exposed while the light changed gives one equation in the latency L = T - t of its flash (t is the
instant that the projector stated) and the line time:

    y = s - t + e·(1 - h) = L - ℓ·r.

Least squares over all rows of all flashes: with one L for each flash, they fall out when y and r are taken from their
weighted means within the flash (ỹ, r̃), and ℓ = -Σ w·r̃·ỹ / Σ w·r̃²; then L = ȳ + ℓ·r̄. Rows of one frame share their
errors (time stamps, a lamp that flickers), so the standard error of ℓ counts flashes, not rows: its variance is
Σ (Σ w·r̃·u)² / (Σ w·r̃²)², the outer sum over flashes, u the residuals.

h is read between the row's own levels in black and in white frames, so neither ambient light nor albedo matters; the
sensor must be linear. What a projector or a camera states wrongly by a constant is part of L, and cannot be told apart.
Light that comes as a ramp is timed at its centroid; how long it goes on after that is `settle_s`. A projector that
builds up its picture from top to bottom makes ℓ too small by the time it takes for the height of a row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slrig.devices import Shown
from slrig.errors import ScanEvidenceError
from slrig.model import FloatArray, Pixels

FEWEST_FLASHES = 8
STEADY = 0.02
"""Light counts as steady when no more of the row's way from black to white is missing than this."""

_FEWEST_PIXELS = 4  # usable ones of a row, for its mean
_FEWEST_ROWS = 8  # of a camera, and of one flash
_NOISIEST_SHARE = 0.05  # standard deviation of a row's share, 1 is white less black
_STAMP_NOISE_S = 2e-5  # standard deviation that time stamps are taken to have
_LEAST_SKEW_S = 1e-4  # of a whole shutter that counts as rolling
_ONE_SIDED = 0.999  # level of the t test for a line time


@dataclass(frozen=True, slots=True)
class RowLevels:
    """How bright each row is in black and in white frames, over its usable pixels.

    black_dn : (H, W) float64, mean black frame. weight : (H, W) float64, 1 for usable pixels over the row's sum of
    white less black; 0 for others, that see no light of the projector or are saturated by it. NaN rows have none.
    noise : (2, H) float64, standard deviation of a row's share in one black and in one white frame. flicker : what the
    shares of white frames vary beyond that noise.
    """

    black_dn: FloatArray
    weight: FloatArray
    noise: FloatArray
    flicker: float

    def shares(self, image: Pixels) -> FloatArray:
        """(H,) float64: where each row of an image lies between black, 0, and white, 1; NaN where that is unknown."""
        return np.asarray(((image - self.black_dn) * self.weight).sum(axis=1))

    @property
    def margin(self) -> FloatArray:
        """(H,) float64: how far from 0 and 1 a share must be to be neither black nor white."""
        return np.asarray(np.clip(np.maximum(4 * self.noise.max(axis=0), 3 * self.flicker), 0.1, 0.35))


@dataclass(frozen=True, slots=True)
class Flash:
    """One change of light, to white or to black, and the n frames around it in the order of their exposure.

    since_s : (n,) float64, the start of each frame's first row, from the instant that the projector stated.
    exposures_s : (n,) float64. passed : (n, H) float64, the share of the way to the new light that each row has gone.
    """

    to_white: bool
    since_s: FloatArray
    exposures_s: FloatArray
    passed: FloatArray

    @classmethod
    def of(cls, to_white: bool, shown: Shown, frames: Sequence[tuple[int, float, FloatArray]]) -> Flash:
        """Of each frame: t_start_ns, exposure_s, and the `RowLevels.shares` of its rows."""
        since_s = np.array([(t_start_ns - shown.t_visible_ns) / 1e9 for t_start_ns, _, _ in frames])
        shares = np.array([shares for _, _, shares in frames])
        return cls(to_white, since_s, np.array([e for _, e, _ in frames]), shares if to_white else 1 - shares)


@dataclass(frozen=True, slots=True)
class FlashRows:
    """The rows of one flash that were exposed while the light changed, one element each.

    row, passed, y_s : (n,) float64, the equation y = L - ℓ·row. weight : (n,) float64, 1/s².
    """

    row: FloatArray
    passed: FloatArray
    y_s: FloatArray
    weight: FloatArray

    @property
    def mean_row(self) -> float:
        """The weighted mean row."""
        return float(np.average(self.row, weights=self.weight))

    def latency_s(self, line_time_s: float) -> float:
        """L of this flash."""
        return float(np.average(self.y_s, weights=self.weight)) + line_time_s * self.mean_row


@dataclass(frozen=True, slots=True)
class CameraLatency:
    """What flashes tell of the time from the projector's stated instant to light, by one camera's time stamps.

    latency_s : mean over the flashes, ± standard_error_s; jitter_s : standard deviation; p95 : of the flashes.
    rise_s, fall_s : means of the flashes to white and to black, NaN without any. settle_s : how long the light goes on
    to change. latest_s : a later end of a change is not to be expected, for any row; earliest_s : nor an earlier begin.
    line_time_s ± line_time_error_s : as measured; `rolling` says that it is significant, `scanned` that it is so with
    the opposite sign: a projector that builds up its picture row by row. skew_s : of the whole shutter, if rolling.
    flashes : how many were shown; flashes_used, rows_used : were seen as they happened; residual_s : rms of the fit.
    """

    latency_s: float
    latency_p95_s: float
    jitter_s: float
    standard_error_s: float
    rise_s: float
    fall_s: float
    settle_s: float
    latest_s: float
    earliest_s: float
    line_time_s: float
    line_time_error_s: float
    rolling: bool
    scanned: bool
    skew_s: float
    flashes: int
    flashes_used: int
    rows_used: int
    residual_s: float
    flicker: float


def row_levels(camera: str, black: Sequence[Pixels], white: Sequence[Pixels], *, full_scale: int) -> RowLevels:
    """Return the levels of steady black and white frames, two or more (H, W) of each.
    Raises ScanEvidenceError: white is not brighter than black, nearly everything that it lights is saturated, or too
    few rows are lit.
    """
    dark, bright = np.stack(black).astype(np.float64), np.stack(white).astype(np.float64)
    mean, span = dark.mean(axis=0), bright.mean(axis=0) - dark.mean(axis=0)
    # A sample is never known better than its rounding.
    variances = np.stack([dark.var(axis=0, ddof=1), bright.var(axis=0, ddof=1)]) + 1 / 12
    typical = np.sqrt(np.median(variances.sum(axis=0)) / len(black))
    lit = span > 6 * typical
    if lit.mean() < 0.01:
        raise ScanEvidenceError(
            f"camera '{camera}' sees no flash: white frames are brighter than black ones by {span.mean():.2f} of "
            f"{full_scale} on average, noise is {typical:.2f}; check that the lamp is on, its lens cap off, and the "
            "camera sees the projected picture; expose longer, or search longer for late light"
        )
    saturated = lit & (bright.max(axis=0) >= full_scale)
    usable = lit & ~saturated & (span >= 0.25 * np.percentile(span[lit], 90))
    if saturated.sum() > 0.9 * lit.sum():
        raise ScanEvidenceError(
            f"camera '{camera}': {saturated.sum() / lit.sum():.0%} of the pixels that the projector lights are "
            f"saturated, so when their light came cannot be told; expose shorter, or lower the gain"
        )
    contrast = np.where(usable, span, 0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = np.sqrt(np.where(usable, variances, 0).sum(axis=2)) / contrast
        known = (usable.sum(axis=1) >= _FEWEST_PIXELS) & (noise.max(axis=0) <= _NOISIEST_SHARE)
        weight = np.where(known[:, None], usable / contrast[:, None], np.nan)
    if known.sum() < _FEWEST_ROWS:
        raise ScanEvidenceError(
            f"camera '{camera}': only {known.sum()} of {len(known)} rows tell white from black well enough to time a "
            f"flash, {_FEWEST_ROWS} are needed; expose longer, or aim the camera at the projected picture"
        )
    shares = np.array([((image - mean) * weight).sum(axis=1) for image in bright])[:, known]
    flicker = float(np.sqrt(max(np.mean(shares.var(axis=0, ddof=1) - noise[1, known] ** 2), 0.0)))
    return RowLevels(mean, weight, np.where(known, noise, np.nan), flicker)


def rows_of(flash: Flash, levels: RowLevels) -> FlashRows | None:
    """Return the rows that were exposed while the light changed, None where there are too few to go by.

    A row counts when it was neither black nor white, old light in the frame before, and new light in the frame after.
    """
    passed, margin = flash.passed, levels.margin
    before = np.vstack([np.zeros_like(passed[:1]), passed[:-1]])
    after = np.vstack([passed[1:], np.full_like(passed[:1], np.nan)])
    part = (passed > margin) & (passed < 1 - margin) & (before < margin) & (after > 1 - margin)
    frames, rows = np.nonzero(part)
    if len(rows) < _FEWEST_ROWS:
        return None
    share, exposure_s = passed[frames, rows], flash.exposures_s[frames]
    white = share if flash.to_white else 1 - share
    variance = (1 - white) * levels.noise[0, rows] ** 2 + white * levels.noise[1, rows] ** 2
    return FlashRows(
        rows.astype(np.float64),
        share,
        flash.since_s[frames] + exposure_s * (1 - share),
        1 / (exposure_s**2 * variance + _STAMP_NOISE_S**2),
    )


def fitted(camera: str, flashes: Sequence[Flash], levels: RowLevels) -> CameraLatency:
    """Return what the flashes tell: see the module.
    Raises ScanEvidenceError: too few flashes were seen while they happened.
    """
    # Here: it takes a tenth of a service's start to load, and few processes of those that capture measure a latency.
    from scipy.special import stdtrit

    found = [(flash, rows) for flash in flashes if (rows := rows_of(flash, levels)) is not None]
    if len(found) < FEWEST_FLASHES:
        raise ScanEvidenceError(_missed(camera, flashes, len(found)))
    used, rows_of_each = [flash for flash, _ in found], [rows for _, rows in found]
    line_time_s, error_s = _line_time(rows_of_each)
    last_row = len(levels.black_dn) - 1
    threshold_s = float(stdtrit(len(found) - 1, _ONE_SIDED)) * error_s
    significant = abs(line_time_s) > threshold_s and abs(line_time_s) * last_row > _LEAST_SKEW_S
    slope_s = line_time_s if significant else 0.0
    latencies = np.array([rows.latency_s(slope_s) for rows in rows_of_each])
    rising = np.array([flash.to_white for flash in used])
    residuals = np.concatenate(
        [rows.y_s - lag + slope_s * rows.row for rows, lag in zip(rows_of_each, latencies, strict=True)]
    )
    kinds = [latencies[which] for which in (rising, ~rising) if which.any()]
    end_s = max(_end(each) for each in kinds)
    # A flash that was not seen as it happened has frames right after it all the same: at the latest, it came then.
    known = {id(flash): float(lag) for flash, lag in zip(used, latencies, strict=True)}
    changed_s = [known.get(id(flash), end_s) for flash in flashes]
    settle_s = _settle_s(flashes, changed_s, slope_s, levels.flicker)
    scanned_s = max(-slope_s, 0.0) * last_row
    jitter_s = float(latencies.std(ddof=1))
    return CameraLatency(
        latency_s=float(latencies.mean()),
        latency_p95_s=float(np.percentile(latencies, 95)),
        jitter_s=jitter_s,
        standard_error_s=jitter_s / len(found) ** 0.5,
        rise_s=float(latencies[rising].mean()) if rising.any() else float("nan"),
        fall_s=float(latencies[~rising].mean()) if (~rising).any() else float("nan"),
        settle_s=settle_s,
        latest_s=end_s + settle_s + scanned_s,
        # The instant of a change is the centroid of its light: it begins before it by no more than it goes on after it.
        earliest_s=-max(_end(-each) for each in kinds) - settle_s - scanned_s,
        line_time_s=line_time_s,
        line_time_error_s=error_s,
        rolling=significant and line_time_s > 0,
        scanned=significant and line_time_s < 0,
        skew_s=max(slope_s, 0.0) * last_row,
        flashes=len(flashes),
        flashes_used=len(found),
        rows_used=sum(len(rows.row) for rows in rows_of_each),
        residual_s=float(np.sqrt(np.mean(residuals**2))),
        flicker=levels.flicker,
    )


def _line_time(flashes: Sequence[FlashRows]) -> tuple[float, float]:
    """ℓ and its standard error, s."""
    products: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for rows in flashes:
        off = rows.row - rows.mean_row
        products.append((off, rows.y_s - rows.latency_s(0.0), rows.weight))
    total = sum(float((w * x * x).sum()) for x, _, w in products)
    line_time_s = -sum(float((w * x * y).sum()) for x, y, w in products) / total
    scatter = sum(float((w * x * (y + line_time_s * x)).sum()) ** 2 for x, y, w in products)
    count = len(products)
    return line_time_s, (scatter * count / (count - 1)) ** 0.5 / total


def _end(latencies_s: FloatArray) -> float:
    """The upper end of a uniform law, from n samples of it: with 95 % it is not beyond that.

    The largest of n lies below 1 - x of the whole with the probability (1 - x)ⁿ: 5 % for x = 3/n.
    """
    highest, spread = float(latencies_s.max()), float(np.ptp(latencies_s))
    return highest + 3 * spread / (len(latencies_s) - 1) if len(latencies_s) > 1 else highest


def _settle_s(flashes: Sequence[Flash], changed_s: Sequence[float], line_time_s: float, flicker: float) -> float:
    """How long after each change rows that begin then still miss light: the end of the last such slice of time."""
    width_s = max(float(flashes[0].exposures_s[0]) / 10, 5e-4)
    slices: dict[int, list[float]] = {}
    for flash, at_s in zip(flashes, changed_s, strict=True):
        row_s = line_time_s * np.arange(flash.passed.shape[1])
        for start_s, passed in zip(flash.since_s, flash.passed, strict=True):
            number = np.floor((start_s + row_s - at_s) / width_s)
            counted = (number >= 0) & np.isfinite(passed)
            for each in np.unique(number[counted]):
                missing = 1 - passed[counted & (number == each)]
                slices.setdefault(int(each), []).append(float(missing.mean()))
    end_s = 0.0
    for number, missing_of in sorted(slices.items()):
        values = np.array(missing_of)
        error = float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 2 else float("inf")
        if values.mean() <= max(STEADY, 4 * error, 2 * flicker):
            break
        end_s = (number + 1) * width_s
    return end_s


def _missed(camera: str, flashes: Sequence[Flash], used: int) -> str:
    """Why there are too few flashes to go by."""
    bounds = [bound for flash in flashes if (bound := _between(flash)) is not None]
    head = (
        f"camera '{camera}': {used} of {len(flashes)} flashes were seen as they happened, {FEWEST_FLASHES} are needed"
    )
    if len(bounds) < len(flashes) / 2:
        return (
            f"{head}; in {len(flashes) - len(bounds)} the light did not change while it was watched: search "
            "longer, and see that nothing else drives the projector (screen saver, desktop, another input)"
        )
    low_s, high_s = np.median(np.array(bounds), axis=0)
    exposure_s = float(flashes[0].exposures_s[0])
    return (
        f"{head}; in the others the light changed between two exposures ({low_s * 1e3:.1f} to {high_s * 1e3:.1f} ms "
        f"after the instant that the projector states), or for longer than the exposure of {exposure_s * 1e3:.3g} ms: "
        f"expose for {max(high_s - low_s + exposure_s, 2 * exposure_s) * 1e3:.0f} ms, let the camera run freely, or "
        "raise its frame rate"
    )


def _between(flash: Flash) -> tuple[float, float] | None:
    """From the end of the last frame in the old light to the start of the first frame in the new, s; None if unseen."""
    gone: NDArray[np.bool_] = np.nanmedian(flash.passed, axis=1) > 0.5
    if not gone.any():
        return None
    first = int(np.argmax(gone))
    start_s = float(flash.since_s[first])
    if first == 0:
        return start_s - float(flash.exposures_s[0]), start_s
    return float(flash.since_s[first - 1] + flash.exposures_s[first - 1]), start_s
