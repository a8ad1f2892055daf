"""Measurement of the latency of the projector's light, for capture without hardware triggers.

`measure_latency` flashes the projector and times the light with each camera's time stamps; a scan waits until
`stable_from_ns`. Only the sum of the clock errors of projector and camera matters: whether the light is late or the
time stamps are early, a frame that starts `latency_s` later by its time stamps contains the new light only.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.devices import Camera, CameraSettings, DisplayedPattern, Rig, Synchronisation, Trigger
from slrig.errors import FrameTimeoutError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import Black, FloatArray, Frame, PatternSequence, Pixels, White

DEFAULT_TRIALS = 40
DEFAULT_SEARCH_S = 0.5
MIN_FLASHES = 8
STEADY_TOLERANCE = 0.02
"""Light counts as steady if at most this fraction of the way from black to white is missing."""

_MIN_ROW_PIXELS = 4  # usable ones, for the mean of a row
_MIN_ROWS = 8  # of a camera, and of one flash
_MAX_ROW_NOISE = 0.05  # standard deviation of a row, relative to white − black
_STAMP_NOISE_S = 2e-5  # assumed standard deviation of time stamps
_MIN_SKEW_S = 1e-4  # of a whole shutter that counts as rolling
_T_TEST_LEVEL = 0.999  # one-sided, for a line time

_MAX_LATE_FRACTION = 1 / 12
"""Of the flashes that may be left out as late ones: a scan shoots as many of its frames again."""
_MIN_GAP_SPREADS = 0.5
"""Between late flashes and the others, in spreads of the others. The last of n flashes of a uniform law is as far from
the others with probability (2/3)ⁿ⁻², which is 2 % for 12 of them."""
_MIN_GAP_S = 2e-3  # waiting for so little longer costs nothing

_STAND_ROWS = 8  # of a frame, for the fit of a stand
_MAX_STAND_S, _MIN_STAND_S, _STANDS_S = 0.1, 3e-3, (0.004, 0.012, 0.03)
_MIN_STAND_LIGHT = 0.1  # between black, 0, and white, 1
_BETTER = 0.65  # of the squares that a ramp leaves: 0.2 to 0.6 for one refresh at 60 Hz, 0.8 and more for all else

_WHITE, _BLACK = 0, 1
_STEADY_FRAMES = 8  # of white and of black, for mean, noise and period
_FRAMES_AFTER = 3  # in the new light, at the end of a flash
_CHANGED_FRACTION = 0.9  # of the way to the new light
_FLASHES_PER_TRIAL = 8  # at most; a flash counts only if it happens during an exposure
_MIN_USED_FRACTION = 0.25
"""Fraction of usable flashes below which the camera is restarted: if the rates of display and camera are multiples of
each other, their phase stays as it began, and may miss all flashes."""
_MAX_READS = 3  # for one frame that is lost
_TIMEOUT_S = 2.0  # of one frame


@dataclass(frozen=True, slots=True)
class RowLevels:
    """Levels of each row in black and white frames, over its usable pixels.

    black_dn : (H, W) float64, mean black frame. weight : (H, W) float64, for usable pixels 1 over the row's sum of
    white − black; 0 for pixels that are not lit or saturated; NaN in rows without usable pixels. noise : (2, H)
    float64, standard deviation of a row's level in one black and in one white frame. flicker : additional standard
    deviation of white frames.
    """

    black_dn: FloatArray
    weight: FloatArray
    noise: FloatArray
    flicker: float

    def shares(self, image: Pixels) -> FloatArray:
        """(H,) float64: level of each row of an image between black, 0, and white, 1; NaN if unknown."""
        return np.asarray(((image - self.black_dn) * self.weight).sum(axis=1))

    @property
    def margin(self) -> FloatArray:
        """(H,) float64: minimum distance from 0 and 1 of a level that is neither black nor white."""
        return np.asarray(np.clip(np.maximum(4 * self.noise.max(axis=0), 3 * self.flicker), 0.1, 0.35))


@dataclass(frozen=True, slots=True)
class LightChange:
    """One change of light to white or black, and the n frames around it in the order of exposure.

    starts_s : (n,) float64, start of each frame's first row since the instant stated by the projector. exposures_s :
    (n,) float64. progress : (n, H) float64, fraction of the change to the new light in each row.
    """

    to_white: bool
    starts_s: FloatArray
    exposures_s: FloatArray
    progress: FloatArray

    @classmethod
    def from_frames(
        cls, to_white: bool, displayed: DisplayedPattern, frames: Sequence[tuple[int, float, FloatArray]]
    ) -> LightChange:
        """Of each frame: t_start_ns, exposure_s, and the `RowLevels.shares` of its rows."""
        starts_s = np.array([(t_start_ns - displayed.t_visible_ns) / 1e9 for t_start_ns, _, _ in frames])
        shares = np.array([shares for _, _, shares in frames])
        return cls(to_white, starts_s, np.array([e for _, e, _ in frames]), shares if to_white else 1 - shares)


@dataclass(frozen=True, slots=True)
class TransitionRows:
    """The n rows of one flash that were exposed while the light changed.

    row, progress, y_s : (n,) float64, the equation y = L - ℓ·row, with latency L and line time ℓ. weight : (n,)
    float64, 1/s².
    """

    row: FloatArray
    progress: FloatArray
    y_s: FloatArray
    weight: FloatArray

    @property
    def mean_row(self) -> float:
        """Weighted mean row."""
        return float(np.average(self.row, weights=self.weight))

    def latency_s(self, line_time_s: float) -> float:
        """Latency L of this flash."""
        return float(np.average(self.y_s, weights=self.weight)) + line_time_s * self.mean_row


@dataclass(frozen=True, slots=True)
class CameraLatency:
    """Time from the instant stated by the projector to the light, by one camera's time stamps.

    A picture that missed its refresh is late once and again, and no scan waits for that: all but flashes, rows_used
    and residual_s are of the flashes without the `late` ones, the first of which came late_s after the last of the
    others. halfway_s : for how long the light stands between white and black; 0 where it does not.

    latency_s : mean of the flashes, ± standard_error_s; jitter_s : their standard deviation; latency_p95_s : their 95th
    percentile. rise_s, fall_s : means of the flashes to white and to black, NaN without any. settle_s : duration of the
    change after that. latest_s, earliest_s : bounds of the end and the start of a change in any row. line_time_s ±
    line_time_error_s : time between adjacent rows; rolling : it is significant; scanned : it is significantly
    negative, so the projector builds its image row by row. skew_s : of the whole rolling shutter. flashes : number of
    flashes; flashes_used, rows_used : numbers that were exposed during a change. residual_s : rms of the fit.
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
    late: int = 0
    late_s: float = 0.0
    halfway_s: float = 0.0

    @property
    def late_words(self) -> str:
        """What to say of the late flashes; "" without any."""
        if not self.late:
            return ""
        return (
            f"{self.late} of {self.flashes_used} flashes came late, by {self.late_s * 1e3:.3g} ms or more: pictures "
            "that missed their refresh, which scans do not wait for and shoot again"
        )


def row_levels(camera: str, black: Sequence[Pixels], white: Sequence[Pixels], *, full_scale: int) -> RowLevels:
    """Return the levels of steady black and white frames, at least two (H, W) of each.
    Raises ScanEvidenceError: white is not brighter than black, almost all lit pixels are saturated, or too few rows are
    lit.
    """
    dark, bright = np.stack(black).astype(np.float64), np.stack(white).astype(np.float64)
    mean, span = dark.mean(axis=0), bright.mean(axis=0) - dark.mean(axis=0)
    # Rounding limits the accuracy of a sample.
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
            "saturated, so the time of their light is unknown; expose shorter, or lower the gain"
        )
    contrast = np.where(usable, span, 0).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = np.sqrt(np.where(usable, variances, 0).sum(axis=2)) / contrast
        known = (usable.sum(axis=1) >= _MIN_ROW_PIXELS) & (noise.max(axis=0) <= _MAX_ROW_NOISE)
        weight = np.where(known[:, None], usable / contrast[:, None], np.nan)
    if known.sum() < _MIN_ROWS:
        raise ScanEvidenceError(
            f"camera '{camera}': only {known.sum()} of {len(known)} rows distinguish white from black well enough to "
            f"time a flash, {_MIN_ROWS} are needed; expose longer, or aim the camera at the projected picture"
        )
    shares = np.array([((image - mean) * weight).sum(axis=1) for image in bright])[:, known]
    flicker = float(np.sqrt(max(np.mean(shares.var(axis=0, ddof=1) - noise[1, known] ** 2), 0.0)))
    return RowLevels(mean, weight, np.where(known, noise, np.nan), flicker)


def find_transition_rows(flash: LightChange, levels: RowLevels) -> TransitionRows | None:
    """Return the rows that were exposed while the light changed; None if there are too few.

    Such a row has an intermediate level, the old light in the previous frame, and the new light in the next frame.
    """
    progress, margin = flash.progress, levels.margin
    before = np.vstack([np.zeros_like(progress[:1]), progress[:-1]])
    after = np.vstack([progress[1:], np.full_like(progress[:1], np.nan)])
    part = (progress > margin) & (progress < 1 - margin) & (before < margin) & (after > 1 - margin)
    frames, rows = np.nonzero(part)
    if len(rows) < _MIN_ROWS:
        return None
    share, exposure_s = progress[frames, rows], flash.exposures_s[frames]
    white = share if flash.to_white else 1 - share
    variance = (1 - white) * levels.noise[0, rows] ** 2 + white * levels.noise[1, rows] ** 2
    return TransitionRows(
        rows.astype(np.float64),
        share,
        flash.starts_s[frames] + exposure_s * (1 - share),
        1 / (exposure_s**2 * variance + _STAMP_NOISE_S**2),
    )


def fit_latency(camera: str, flashes: Sequence[LightChange], levels: RowLevels) -> CameraLatency:
    """Fit latency and line time to all flashes.
    Raises ScanEvidenceError: too few flashes were exposed during a change.
    """
    # Imported here because it is slow to load and only needed for this measurement.
    from scipy.special import stdtrit

    pairs = [(flash, rows) for flash in flashes if (rows := find_transition_rows(flash, levels)) is not None]
    if len(pairs) < MIN_FLASHES:
        raise ScanEvidenceError(_too_few_flashes_message(camera, flashes, len(pairs)))
    used, transitions = [flash for flash, _ in pairs], [rows for _, rows in pairs]
    line_time_s, error_s = _line_time(transitions)
    last_row = len(levels.black_dn) - 1
    threshold_s = float(stdtrit(len(pairs) - 1, _T_TEST_LEVEL)) * error_s
    significant = abs(line_time_s) > threshold_s and abs(line_time_s) * last_row > _MIN_SKEW_S
    slope_s = line_time_s if significant else 0.0
    latencies = np.array([rows.latency_s(slope_s) for rows in transitions])
    rising = np.array([flash.to_white for flash in used])
    late, late_s = _late_flashes(latencies, rising)
    residuals = np.concatenate(
        [rows.y_s - latency_s + slope_s * rows.row for rows, latency_s in zip(transitions, latencies, strict=True)]
    )
    usual, rise, fall = latencies[~late], latencies[rising & ~late], latencies[~rising & ~late]
    kinds = [each for each in (rise, fall) if len(each)]
    end_s = max(_upper_bound(each) for each in kinds)
    # A flash without transition rows also has frames after it, so it happened at the latest bound.
    latency_by_flash = {id(flash): float(latency_s) for flash, latency_s in zip(used, latencies, strict=True)}
    changed_s = [latency_by_flash.get(id(flash), end_s) for flash in flashes]
    settle_s = _settling_time_s(flashes, changed_s, slope_s, levels.flicker)
    scanned_s = max(-slope_s, 0.0) * last_row
    jitter_s = float(usual.std(ddof=1))
    return CameraLatency(
        latency_s=float(usual.mean()),
        latency_p95_s=float(np.percentile(usual, 95)),
        jitter_s=jitter_s,
        standard_error_s=jitter_s / len(usual) ** 0.5,
        rise_s=float(rise.mean()) if len(rise) else float("nan"),
        fall_s=float(fall.mean()) if len(fall) else float("nan"),
        settle_s=settle_s,
        latest_s=end_s + settle_s + scanned_s,
        # The instant of a change is the centroid of its light: it begins no earlier before it than it ends after it.
        earliest_s=-max(_upper_bound(-each) for each in kinds) - settle_s - scanned_s,
        line_time_s=line_time_s,
        line_time_error_s=error_s,
        rolling=significant and line_time_s > 0,
        scanned=significant and line_time_s < 0,
        skew_s=max(slope_s, 0.0) * last_row,
        flashes=len(flashes),
        flashes_used=len(pairs),
        rows_used=sum(len(rows.row) for rows in transitions),
        residual_s=float(np.sqrt(np.mean(residuals**2))),
        flicker=levels.flicker,
        late=int(late.sum()),
        late_s=late_s,
        halfway_s=_halfway_s([flash for flash, is_late in zip(used, late, strict=True) if not is_late], usual, slope_s),
    )


def _late_flashes(latencies_s: FloatArray, rising: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
    """Which flashes came far later than the others of their direction, (n,) bool, and how far the first of them, s."""
    offset_s = latencies_s.copy()
    for which in (rising, ~rising):
        if which.any():
            offset_s[which] -= np.median(latencies_s[which])
    order = np.argsort(offset_s)
    for late in range(int(len(order) * _MAX_LATE_FRACTION), 0, -1):
        others_s = offset_s[order[:-late]]
        gap_s = float(offset_s[order[-late]] - others_s.max())
        if gap_s > max(_MIN_GAP_SPREADS * float(np.ptp(others_s)), _MIN_GAP_S):
            return np.isin(np.arange(len(order)), order[-late:]), gap_s
    return np.zeros(len(order), np.bool_), 0.0


def _halfway_s(flashes: Sequence[LightChange], latencies_s: FloatArray, line_time_s: float) -> float:
    """Return how long light stands halfway in each change: where that fits far better than a step or a ramp, which slow
    displays and uncertain instants give; else 0.
    """
    # Imported here as in `fit_latency`.
    from scipy.optimize import least_squares

    begin, exposure, progress, rising = np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, np.bool_)
    for to_white in (True, False):
        kind = [number for number, flash in enumerate(flashes) if flash.to_white is to_white]
        # Of all flashes: that of one depends on the part of the change that was exposed.
        latency_s = float(np.mean(latencies_s[kind])) if kind else 0.0
        for flash in (flashes[number] for number in kind):
            rows = np.flatnonzero(np.isfinite(flash.progress).all(axis=0))
            rows = rows[:: max(len(rows) // _STAND_ROWS, 1)]
            start = flash.starts_s[:, None] + line_time_s * rows - latency_s
            exposures = np.broadcast_to(flash.exposures_s[:, None], start.shape)
            near = (start < _MAX_STAND_S) & (start + exposures > -_MAX_STAND_S)
            begin, exposure = np.append(begin, start[near]), np.append(exposure, exposures[near])
            progress = np.append(progress, flash.progress[:, rows][near])
            rising = np.append(rising, np.full(np.count_nonzero(near), to_white))

    def share(light: Callable[[FloatArray], FloatArray]) -> FloatArray:
        """Share of the new light in each exposure, of the integral of the light since the change."""
        return (light(begin + exposure) - light(begin)) / exposure - progress

    # Each by the centroid of the change, which the latency is.
    def ramp(law: FloatArray) -> FloatArray:
        at_s, length_s = law[0] - law[1] / 2, law[1]
        return share(
            lambda t: np.clip(t - at_s, 0, length_s) ** 2 / (2 * length_s) + np.maximum(t - at_s - length_s, 0)
        )

    def stand(law: FloatArray) -> FloatArray:
        first = np.where(rising, law[2], 1 - law[2])
        at_s = law[0] - law[1] * (1 - first)
        return share(lambda t: first * np.maximum(t - at_s, 0) + (1 - first) * np.maximum(t - at_s - law[1], 0))

    def fitted(law: Callable[[FloatArray], FloatArray], *more: float) -> Any:
        limits = (-_MAX_STAND_S, 1e-5, *(0.0 for _ in more)), (_MAX_STAND_S, _MAX_STAND_S, *(1.0 for _ in more))
        fits = [
            least_squares(law, (0.0, length_s, *more), x_scale=(0.01, 0.01, *more), bounds=limits)
            for length_s in _STANDS_S
        ]
        return min(fits, key=lambda fit: float(fit.cost))

    by_ramp, by_stand = fitted(ramp), fitted(stand, 0.5)
    length_s, white = (float(each) for each in by_stand.x[1:])
    is_stand = length_s > _MIN_STAND_S and _MIN_STAND_LIGHT < white < 1 - _MIN_STAND_LIGHT
    return length_s if is_stand and by_stand.cost < _BETTER * by_ramp.cost else 0.0


def _line_time(flashes: Sequence[TransitionRows]) -> tuple[float, float]:
    """Return the line time ℓ and its standard error, s."""
    products: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for rows in flashes:
        off = rows.row - rows.mean_row
        products.append((off, rows.y_s - rows.latency_s(0.0), rows.weight))
    total = sum(float((w * x * x).sum()) for x, _, w in products)
    line_time_s = -sum(float((w * x * y).sum()) for x, y, w in products) / total
    scatter = sum(float((w * x * (y + line_time_s * x)).sum()) ** 2 for x, y, w in products)
    count = len(products)
    return line_time_s, (scatter * count / (count - 1)) ** 0.5 / total


def _upper_bound(latencies_s: FloatArray) -> float:
    """Return the 95 % upper bound of a uniform distribution from n samples.

    The largest of n samples is below 1 - x of the range with probability (1 - x)ⁿ, which is 5 % for x = 3/n.
    """
    highest, spread = float(latencies_s.max()), float(np.ptp(latencies_s))
    return highest + 3 * spread / (len(latencies_s) - 1) if len(latencies_s) > 1 else highest


def _settling_time_s(
    flashes: Sequence[LightChange], changed_s: Sequence[float], line_time_s: float, flicker: float
) -> float:
    """Return how long after a change rows still miss light: the end of the last slice of time that does."""
    width_s = max(float(flashes[0].exposures_s[0]) / 10, 5e-4)
    slices: dict[int, list[float]] = {}
    for flash, changed_at_s in zip(flashes, changed_s, strict=True):
        row_s = line_time_s * np.arange(flash.progress.shape[1])
        for start_s, progress in zip(flash.starts_s, flash.progress, strict=True):
            number = np.floor((start_s + row_s - changed_at_s) / width_s)
            counted = (number >= 0) & np.isfinite(progress)
            for each in np.unique(number[counted]):
                missing = 1 - progress[counted & (number == each)]
                slices.setdefault(int(each), []).append(float(missing.mean()))
    end_s = 0.0
    for number, missing_values in sorted(slices.items()):
        values = np.array(missing_values)
        error = float(values.std(ddof=1)) / len(values) ** 0.5 if len(values) > 2 else float("inf")
        if values.mean() <= max(STEADY_TOLERANCE, 4 * error, 2 * flicker):
            break
        end_s = (number + 1) * width_s
    return end_s


def _too_few_flashes_message(camera: str, flashes: Sequence[LightChange], used: int) -> str:
    """Explain why too few flashes are usable."""
    bounds = [bound for flash in flashes if (bound := _change_interval_s(flash)) is not None]
    head = f"camera '{camera}': {used} of {len(flashes)} flashes happened during an exposure, {MIN_FLASHES} are needed"
    if len(bounds) < len(flashes) / 2:
        return (
            f"{head}; in {len(flashes) - len(bounds)} the light did not change within the search time: search "
            "longer, and check that nothing else drives the projector (screen saver, desktop, another input)"
        )
    low_s, high_s = np.median(np.array(bounds), axis=0)
    exposure_s = float(flashes[0].exposures_s[0])
    return (
        f"{head}; in the others the light changed between two exposures ({low_s * 1e3:.1f} to {high_s * 1e3:.1f} ms "
        f"after the instant that the projector states), or for longer than the exposure of {exposure_s * 1e3:.3g} ms: "
        f"expose for {max(high_s - low_s + exposure_s, 2 * exposure_s) * 1e3:.0f} ms, let the camera run freely, or "
        "raise its frame rate"
    )


def _change_interval_s(flash: LightChange) -> tuple[float, float] | None:
    """Return the end of the last frame in the old light and the start of the first in the new, s; or None."""
    changed: NDArray[np.bool_] = np.nanmedian(flash.progress, axis=1) > 0.5
    if not changed.any():
        return None
    first = int(np.argmax(changed))
    start_s = float(flash.starts_s[first])
    if first == 0:
        return start_s - float(flash.exposures_s[0]), start_s
    return float(flash.starts_s[first - 1] + flash.exposures_s[first - 1]), start_s


@dataclass(frozen=True, slots=True)
class LatencyMeasurement:
    """Latency of each camera. shown_error_s : smallest error that the projector stated. stamp_error_s : largest error
    that each camera stated of its time stamps.
    """

    cameras: Mapping[str, CameraLatency]
    shown_error_s: float
    stamp_error_s: Mapping[str, float] = field(default_factory=dict)

    @property
    def slowest(self) -> CameraLatency:
        """The camera whose light is stable last, for which a scan waits."""
        return max(self.cameras.values(), key=lambda found: found.latest_s)

    @property
    def line_time_s(self) -> Mapping[str, float]:
        """Line times of the cameras with a rolling shutter."""
        return {name: found.line_time_s for name, found in self.cameras.items() if found.rolling}

    @property
    def synchronisation(self) -> Synchronisation:
        """The values for the rig file."""
        slowest = self.slowest
        late_s = max(slowest.latest_s - slowest.latency_s, 3 * slowest.standard_error_s)
        return Synchronisation(
            slowest.latency_s,
            late_s - self.shown_error_s,
            self.line_time_s,
            earliest_s=min(found.earliest_s for found in self.cameras.values()),
            stamp_error_s=self.stamp_error_s,
        )


def stable_from_ns(displayed: DisplayedPattern, synchronisation: Synchronisation | None) -> int:
    """Return the instant from which a pattern is the only light, in the rig's clock, ns.

    Uses the measured latency if there is one, otherwise the instant stated by the projector.
    """
    stated_ns = displayed.t_visible_ns + displayed.t_err_ns
    if synchronisation is None:
        return stated_ns
    return stated_ns + round((synchronisation.latency_s + synchronisation.latency_error_s) * 1e9)


def shutter_skew_s(camera: Camera, name: str, synchronisation: Synchronisation | None) -> float:
    """Return the measured delay of a camera's last row after its first; 0 if it was not measured."""
    line_time_s = 0.0 if synchronisation is None else synchronisation.line_time_s.get(name, 0.0)
    return line_time_s * (camera.info.format.size.height_px - 1)


def measure_latency(
    rig: Rig,
    *,
    trials: int = DEFAULT_TRIALS,
    search_s: float = DEFAULT_SEARCH_S,
    exposure_s: float | None = None,
    trigger: Trigger | None = None,
    on_progress: Callable[[str, float, str], None] = lambda _stage, _fraction, _detail: None,
) -> LatencyMeasurement:
    """Flash the projector for each camera in turn, at random phases of its frame period, and time the light.

    At the end, also after errors, the projector is dark and the cameras are disarmed.

    trials : number of usable flashes for each camera; `DEFAULT_TRIALS` where one of fewer came late.
    search_s : maximum latency to search for. exposure_s : for the test; None uses the rig's settings; longer exposures
    give more usable flashes. trigger : None prefers free-running cameras, which expose while the projector works.

    Raises ScanEvidenceError: no flash was visible, everything is saturated, or the light never changed during an
    exposure; UnsupportedByDeviceError: a camera supports hardware triggers only, or not the requested trigger or
    exposure; FrameTimeoutError, DeviceError: a device failed or is gone.
    """
    measured: dict[str, CameraLatency] = {}
    errors_s: list[float] = []
    stamp_errors_s: dict[str, float] = {}
    projector = rig.projector
    try:
        profiles = tuple(np.full((1, 1), level, np.uint8) for level in (255, 0))
        projector.load(PatternSequence(projector.info.size, (White(), Black()), profiles))
        for index, (name, camera) in enumerate(rig.cameras.items()):
            settings = rig.settings.get(name)
            if settings is not None:
                camera.configure(settings if exposure_s is None else replace(settings, exposure_s=exposure_s))
            elif exposure_s is not None:
                camera.configure(CameraSettings(exposure_s))
            test = _FlashTest(rig, name, camera, _choose_trigger(name, camera, trigger), search_s)
            rng = np.random.default_rng((0, index))
            try:
                measured[name] = test.run(trials, rng, on_progress)
            finally:
                with suppress(Exception):
                    camera.disarm()
            errors_s.append(test.least_error_ns / 1e9)
            stamp_errors_s[name] = test.stamp_error_ns / 1e9
    finally:
        with suppress(Exception):
            projector.blank()
    projector.blank()
    return LatencyMeasurement(measured, min(errors_s), stamp_errors_s)


def _choose_trigger(name: str, camera: Camera, requested: Trigger | None) -> Trigger:
    offered = camera.info.triggers
    for trigger in (Trigger.FREE, Trigger.SOFTWARE):
        if trigger in offered and requested in (None, trigger):
            return trigger
    raise UnsupportedByDeviceError(
        f"camera '{name}' can be triggered by: {', '.join(sorted(offered)) or 'none'}; latency is measured with "
        + ("a free-running or software-triggered camera" if requested is None else f"{requested} trigger as requested")
        + "; scans by wire need no latency, and how often pulses may come, trigger_period_s, slrig doctor measures"
    )


@dataclass
class _FlashTest:
    """Test of one camera: steady levels of white and black, then flashes."""

    rig: Rig
    name: str
    camera: Camera
    trigger: Trigger
    search_s: float
    least_error_ns: int = 2**62
    stamp_error_ns: int = 0
    period_ns: int = 0
    _never_set: threading.Event = field(default_factory=threading.Event)

    def run(
        self, trials: int, rng: np.random.Generator, on_progress: Callable[[str, float, str], None]
    ) -> CameraLatency:
        stage = f"flashes before {self.name}"
        on_progress(stage, 0.0, "steady light")
        frames = 2 * _STEADY_FRAMES + _FLASHES_PER_TRIAL * max(trials, DEFAULT_TRIALS) * (_FRAMES_AFTER + 3)
        self.camera.arm(frames, self.trigger)
        black, white = self._read_steady_frames(_BLACK), self._read_steady_frames(_WHITE)
        full_scale = self.camera.info.format.full_scale
        levels = row_levels(self.name, black, white, full_scale=full_scale)
        flashes: list[LightChange] = []
        used = 0
        # Stop early if no flash is usable.
        while used < trials and len(flashes) < (_FLASHES_PER_TRIAL * trials if used else max(2 * trials, 16)):
            flash = self._flash(levels, rng, to_white=len(flashes) % 2 == 1)
            flashes.append(flash)
            used += find_transition_rows(flash, levels) is not None
            if len(flashes) % trials == 0 and used < _MIN_USED_FRACTION * len(flashes):
                self.camera.disarm()
                self.camera.arm(frames, self.trigger)
            on_progress(stage, used / trials, f"{used} of {trials} flashes")
            if used == trials < DEFAULT_TRIALS and fit_latency(self.name, flashes, levels).late:
                # Of more flashes the bounds are closer.
                trials = DEFAULT_TRIALS
        return fit_latency(self.name, flashes, levels)

    def _read_steady_frames(self, index: int) -> list[Pixels]:
        """Return frames of a light after the time that a change may take."""
        displayed = self._show(index)
        steady_ns = displayed.t_visible_ns + round(self.search_s * 1e9)
        self.rig.clock.wait_until(steady_ns, self._never_set)
        frames = [self._read_next(after_ns=steady_ns) for _ in range(_STEADY_FRAMES)]
        self.period_ns = int(np.median(np.diff([frame.t_start_ns for frame in frames])))
        return [frame.image for frame in frames]

    def _flash(self, levels: RowLevels, rng: np.random.Generator, *, to_white: bool) -> LightChange:
        # The camera has just exposed a frame, so a random wait gives a random phase.
        waiting_ns = round(float(rng.random()) * self.period_ns)
        pending = self.trigger is Trigger.SOFTWARE
        if pending:
            self.camera.trigger()
        else:
            self._read_next(after_ns=self.rig.clock.now_ns())
        self._wait(waiting_ns)
        displayed = self._show(_WHITE if to_white else _BLACK)
        until_ns = displayed.t_visible_ns + round(self.search_s * 1e9)
        frames: list[tuple[int, float, FloatArray]] = []
        after = 0
        while after < _FRAMES_AFTER and not (frames and frames[-1][0] > until_ns):
            if pending:
                pending = False
                # The following exposures have a new phase, which is random again.
                resumed_ns = round(float(rng.random()) * self.period_ns)
                try:
                    frame = self._read(0)
                except FrameTimeoutError:
                    continue
                finally:
                    self._wait(resumed_ns)
            else:
                frame = self._read_next(after_ns=0)
            shares = levels.shares(frame.image)
            frames.append((frame.t_start_ns, frame.exposure_s, shares))
            share = float(np.nanmedian(shares))
            after += (share if to_white else 1 - share) > _CHANGED_FRACTION
        return LightChange.from_frames(to_white, displayed, frames)

    def _show(self, index: int) -> DisplayedPattern:
        displayed = self.rig.projector.show(index)
        self.least_error_ns = min(self.least_error_ns, displayed.t_err_ns)
        return displayed

    def _wait(self, span_ns: int) -> None:
        self.rig.clock.wait_until(self.rig.clock.now_ns() + span_ns, self._never_set)

    def _read_next(self, *, after_ns: int) -> Frame:
        """Return the next frame, after a trigger if one is needed; repeat if it is lost."""
        for _ in range(_MAX_READS - 1):
            if self.trigger is Trigger.SOFTWARE:
                self.camera.trigger()
            with suppress(FrameTimeoutError):
                return self._read(after_ns)
        if self.trigger is Trigger.SOFTWARE:
            self.camera.trigger()
        return self._read(after_ns)

    def _read(self, after_ns: int) -> Frame:
        frame = self.camera.read(after_ns, _TIMEOUT_S)
        self.stamp_error_ns = max(self.stamp_error_ns, frame.t_err_ns)
        return frame
