"""Latency of the light behind the projector's clock, measured, for capture without a trigger wire.

`measure_latency` flashes the projector and times the light with each camera's own time stamps; `stable_from_ns` is
what a scan waits for. What matters for a scan is only the sum of what projector and camera state wrongly: whether the
light is late or the time stamps are early, a frame that begins `latency_s` later by its stamps has the new light alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.devices import Camera, CameraSettings, DisplayedPattern, Rig, Synchronisation, Trigger
from slrig.errors import FrameTimeoutError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import Black, FloatArray, Frame, PatternSequence, Pixels, Size, White

MIN_FLASHES = 8
STEADY_TOLERANCE = 0.02
"""Light counts as steady when no more of the row's way from black to white is missing than this."""

_MIN_ROW_PIXELS = 4  # usable ones of a row, for its mean
_MIN_ROWS = 8  # of a camera, and of one flash
_MAX_ROW_NOISE = 0.05  # standard deviation of a row's share, 1 is white less black
_STAMP_NOISE_S = 2e-5  # standard deviation that time stamps are taken to have
_MIN_SKEW_S = 1e-4  # of a whole shutter that counts as rolling
_T_TEST_LEVEL = 0.999  # level of the t test for a line time


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
class LightChange:
    """One change of light, to white or to black, and the n frames around it in the order of their exposure.

    since_s : (n,) float64, the start of each frame's first row, from the instant that the projector stated.
    exposures_s : (n,) float64. passed : (n, H) float64, the share of the way to the new light that each row has gone.
    """

    to_white: bool
    since_s: FloatArray
    exposures_s: FloatArray
    passed: FloatArray

    @classmethod
    def of(
        cls, to_white: bool, shown: DisplayedPattern, frames: Sequence[tuple[int, float, FloatArray]]
    ) -> LightChange:
        """Of each frame: t_start_ns, exposure_s, and the `RowLevels.shares` of its rows."""
        since_s = np.array([(t_start_ns - shown.t_visible_ns) / 1e9 for t_start_ns, _, _ in frames])
        shares = np.array([shares for _, _, shares in frames])
        return cls(to_white, since_s, np.array([e for _, e, _ in frames]), shares if to_white else 1 - shares)


@dataclass(frozen=True, slots=True)
class TransitionRows:
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
        known = (usable.sum(axis=1) >= _MIN_ROW_PIXELS) & (noise.max(axis=0) <= _MAX_ROW_NOISE)
        weight = np.where(known[:, None], usable / contrast[:, None], np.nan)
    if known.sum() < _MIN_ROWS:
        raise ScanEvidenceError(
            f"camera '{camera}': only {known.sum()} of {len(known)} rows tell white from black well enough to time a "
            f"flash, {_MIN_ROWS} are needed; expose longer, or aim the camera at the projected picture"
        )
    shares = np.array([((image - mean) * weight).sum(axis=1) for image in bright])[:, known]
    flicker = float(np.sqrt(max(np.mean(shares.var(axis=0, ddof=1) - noise[1, known] ** 2), 0.0)))
    return RowLevels(mean, weight, np.where(known, noise, np.nan), flicker)


def find_transition_rows(flash: LightChange, levels: RowLevels) -> TransitionRows | None:
    """Return the rows that were exposed while the light changed, None where there are too few to go by.

    A row counts when it was neither black nor white, old light in the frame before, and new light in the frame after.
    """
    passed, margin = flash.passed, levels.margin
    before = np.vstack([np.zeros_like(passed[:1]), passed[:-1]])
    after = np.vstack([passed[1:], np.full_like(passed[:1], np.nan)])
    part = (passed > margin) & (passed < 1 - margin) & (before < margin) & (after > 1 - margin)
    frames, rows = np.nonzero(part)
    if len(rows) < _MIN_ROWS:
        return None
    share, exposure_s = passed[frames, rows], flash.exposures_s[frames]
    white = share if flash.to_white else 1 - share
    variance = (1 - white) * levels.noise[0, rows] ** 2 + white * levels.noise[1, rows] ** 2
    return TransitionRows(
        rows.astype(np.float64),
        share,
        flash.since_s[frames] + exposure_s * (1 - share),
        1 / (exposure_s**2 * variance + _STAMP_NOISE_S**2),
    )


def fit_latency(camera: str, flashes: Sequence[LightChange], levels: RowLevels) -> CameraLatency:
    """Return what the flashes tell: see the module.
    Raises ScanEvidenceError: too few flashes were seen while they happened.
    """
    # Here: it takes a tenth of a service's start to load, and few processes of those that capture measure a latency.
    from scipy.special import stdtrit

    found = [(flash, rows) for flash in flashes if (rows := find_transition_rows(flash, levels)) is not None]
    if len(found) < MIN_FLASHES:
        raise ScanEvidenceError(_too_few_flashes_message(camera, flashes, len(found)))
    used, rows_of_each = [flash for flash, _ in found], [rows for _, rows in found]
    line_time_s, error_s = _line_time(rows_of_each)
    last_row = len(levels.black_dn) - 1
    threshold_s = float(stdtrit(len(found) - 1, _T_TEST_LEVEL)) * error_s
    significant = abs(line_time_s) > threshold_s and abs(line_time_s) * last_row > _MIN_SKEW_S
    slope_s = line_time_s if significant else 0.0
    latencies = np.array([rows.latency_s(slope_s) for rows in rows_of_each])
    rising = np.array([flash.to_white for flash in used])
    residuals = np.concatenate(
        [rows.y_s - lag + slope_s * rows.row for rows, lag in zip(rows_of_each, latencies, strict=True)]
    )
    kinds = [latencies[which] for which in (rising, ~rising) if which.any()]
    end_s = max(_upper_bound(each) for each in kinds)
    # A flash that was not seen as it happened has frames right after it all the same: at the latest, it came then.
    known = {id(flash): float(lag) for flash, lag in zip(used, latencies, strict=True)}
    changed_s = [known.get(id(flash), end_s) for flash in flashes]
    settle_s = _settling_time_s(flashes, changed_s, slope_s, levels.flicker)
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
        earliest_s=-max(_upper_bound(-each) for each in kinds) - settle_s - scanned_s,
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


def _line_time(flashes: Sequence[TransitionRows]) -> tuple[float, float]:
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


def _upper_bound(latencies_s: FloatArray) -> float:
    """The upper end of a uniform law, from n samples of it: with 95 % it is not beyond that.

    The largest of n lies below 1 - x of the whole with the probability (1 - x)ⁿ: 5 % for x = 3/n.
    """
    highest, spread = float(latencies_s.max()), float(np.ptp(latencies_s))
    return highest + 3 * spread / (len(latencies_s) - 1) if len(latencies_s) > 1 else highest


def _settling_time_s(
    flashes: Sequence[LightChange], changed_s: Sequence[float], line_time_s: float, flicker: float
) -> float:
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
        if values.mean() <= max(STEADY_TOLERANCE, 4 * error, 2 * flicker):
            break
        end_s = (number + 1) * width_s
    return end_s


def _too_few_flashes_message(camera: str, flashes: Sequence[LightChange], used: int) -> str:
    """Why there are too few flashes to go by."""
    bounds = [bound for flash in flashes if (bound := _change_interval_s(flash)) is not None]
    head = f"camera '{camera}': {used} of {len(flashes)} flashes were seen as they happened, {MIN_FLASHES} are needed"
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


def _change_interval_s(flash: LightChange) -> tuple[float, float] | None:
    """From the end of the last frame in the old light to the start of the first frame in the new, s; None if unseen."""
    gone: NDArray[np.bool_] = np.nanmedian(flash.passed, axis=1) > 0.5
    if not gone.any():
        return None
    first = int(np.argmax(gone))
    start_s = float(flash.since_s[first])
    if first == 0:
        return start_s - float(flash.exposures_s[0]), start_s
    return float(flash.since_s[first - 1] + flash.exposures_s[first - 1]), start_s


DEFAULT_TRIALS = 40
DEFAULT_SEARCH_S = 0.5

_WHITE, _BLACK = 0, 1
_STEADY_FRAMES = 8  # of white and of black: mean, noise and period are taken from them
_FRAMES_AFTER = 3  # in the new light, before a flash is over
_CHANGED_FRACTION = 0.9  # of the way to the new light
_FLASHES_PER_TRIAL = 8  # at most: a flash counts only if it comes during an exposure
_MIN_USED_FRACTION = 0.25
"""Of the flashes. Where fewer are seen as they happen, the camera is started anew: a display and a camera whose rates
are multiples of each other keep the phase in which they began, and with it what they miss.
"""
_MAX_READS = 3  # for one frame that is lost
_TIMEOUT_S = 2.0  # of one frame


@dataclass(frozen=True, slots=True)
class LatencyMeasurement:
    """What a flash test found, for each camera. shown_error_s : the least error that the projector stated."""

    cameras: Mapping[str, CameraLatency]
    shown_error_s: float

    @property
    def slowest(self) -> CameraLatency:
        """What the camera tells by whose time stamps light is stable last: the one to wait for."""
        return max(self.cameras.values(), key=lambda found: found.latest_s)

    @property
    def line_time_s(self) -> Mapping[str, float]:
        """Of the cameras with a rolling shutter."""
        return {name: found.line_time_s for name, found in self.cameras.items() if found.rolling}

    @property
    def synchronisation(self) -> Synchronisation:
        """What a rig file keeps of it."""
        slowest = self.slowest
        late_s = max(slowest.latest_s - slowest.latency_s, 3 * slowest.standard_error_s)
        return Synchronisation(
            slowest.latency_s,
            late_s - self.shown_error_s,
            self.line_time_s,
            earliest_s=min(found.earliest_s for found in self.cameras.values()),
        )


def stable_from_ns(shown: DisplayedPattern, synchronisation: Synchronisation | None) -> int:
    """Return the instant from which a pattern's light is the only one, the rig's clock, ns.

    Where latency was measured, that counts, later or earlier than what the projector states.
    """
    stated_ns = shown.t_visible_ns + shown.t_err_ns
    if synchronisation is None:
        return stated_ns
    return stated_ns + round((synchronisation.latency_s + synchronisation.latency_error_s) * 1e9)


def shutter_skew_s(camera: Camera, name: str, synchronisation: Synchronisation | None) -> float:
    """Return how much later than its first row a camera's last row is exposed, as far as that was measured."""
    line_time_s = 0.0 if synchronisation is None else synchronisation.line_time_s.get(name, 0.0)
    return line_time_s * (camera.info.format.size.height_px - 1)


def measure_latency(
    rig: Rig,
    *,
    trials: int = DEFAULT_TRIALS,
    search_s: float = DEFAULT_SEARCH_S,
    exposure_s: float | None = None,
    trigger: Trigger | None = None,
    told: Callable[[str, float, str], None] = lambda _stage, _fraction, _detail: None,
) -> LatencyMeasurement:
    """Flash the projector before each camera in turn, at random moments of its frame period, and time the light.

    However it ends, the projector is dark and the cameras are disarmed afterwards.

    trials : how many flashes each camera must see while they happen. search_s : how late light may be, from the instant
    that the projector states. exposure_s : for the test; None is that of the rig's settings; longer exposures see more
    flashes as they happen. trigger : how exposures are started; None prefers freely running cameras: they watch while
    the projector works.

    Raises ScanEvidenceError: no flash was seen, everything is saturated, or the light never changed during an exposure;
    UnsupportedByDeviceError: a camera can be triggered by wire only, or not in the way or with the exposure asked for;
    FrameTimeoutError, DeviceError: a device failed or is gone.
    """
    measured: dict[str, CameraLatency] = {}
    errors_s: list[float] = []
    projector = rig.projector
    try:
        projector.load(_white_and_black(projector.info.size))
        for index, (name, camera) in enumerate(rig.cameras.items()):
            settings = rig.settings.get(name)
            if settings is not None:
                camera.configure(settings if exposure_s is None else replace(settings, exposure_s=exposure_s))
            elif exposure_s is not None:
                camera.configure(CameraSettings(exposure_s))
            test = _FlashTest(rig, name, camera, _choose_trigger(name, camera, trigger), search_s)
            rng = np.random.default_rng((0, index))
            try:
                measured[name] = test.run(trials, rng, told)
            finally:
                with suppress(Exception):
                    camera.disarm()
            errors_s.append(test.least_error_ns / 1e9)
    finally:
        with suppress(Exception):
            projector.blank()
    projector.blank()
    return LatencyMeasurement(measured, min(errors_s))


def _white_and_black(size: Size) -> PatternSequence:
    levels = (255, 0)
    return PatternSequence(size, (White(), Black()), tuple(np.full((1, 1), level, np.uint8) for level in levels))


def _choose_trigger(name: str, camera: Camera, asked: Trigger | None) -> Trigger:
    offered = camera.info.triggers
    for trigger in (Trigger.FREE, Trigger.SOFTWARE):
        if trigger in offered and asked in (None, trigger):
            return trigger
    raise UnsupportedByDeviceError(
        f"camera '{name}' can be triggered by: {', '.join(sorted(offered)) or 'none'}; latency is measured with "
        f"{'a free-running or software-triggered camera' if asked is None else f'{asked} trigger as asked'}, and a "
        "projector that triggers its cameras by wire needs no latency"
    )


@dataclass
class _FlashTest:
    """One camera's test: steady levels of white and black, then flashes."""

    rig: Rig
    name: str
    camera: Camera
    trigger: Trigger
    search_s: float
    least_error_ns: int = 2**62
    period_ns: int = 0
    never: threading.Event = field(default_factory=threading.Event)

    def run(self, trials: int, rng: np.random.Generator, told: Callable[[str, float, str], None]) -> CameraLatency:
        stage = f"flashes before {self.name}"
        told(stage, 0.0, "steady light")
        most = _FLASHES_PER_TRIAL * trials
        frames = 2 * _STEADY_FRAMES + most * (_FRAMES_AFTER + 3)
        self.camera.arm(frames, self.trigger)
        black, white = self._steady(_BLACK), self._steady(_WHITE)
        full_scale = self.camera.info.format.full_scale
        levels = row_levels(self.name, black, white, full_scale=full_scale)
        flashes: list[LightChange] = []
        used = 0
        while used < trials and len(flashes) < most and not self._is_hopeless(flashes, used, trials):
            flash = self._flash(levels, rng, to_white=len(flashes) % 2 == 1)
            flashes.append(flash)
            used += find_transition_rows(flash, levels) is not None
            if len(flashes) % trials == 0 and used < _MIN_USED_FRACTION * len(flashes):
                self.camera.disarm()
                self.camera.arm(frames, self.trigger)
            told(stage, used / trials, f"{used} of {trials} flashes")
        return fit_latency(self.name, flashes, levels)

    def _is_hopeless(self, flashes: list[LightChange], used: int, trials: int) -> bool:
        """Whether going on would only take longer to say that it cannot be measured."""
        return used == 0 and len(flashes) >= max(2 * trials, 16)

    def _steady(self, index: int) -> list[Pixels]:
        """Return frames of a light that has been shown for as long as a change may take."""
        shown = self._show(index)
        steady_ns = shown.t_visible_ns + round(self.search_s * 1e9)
        self.rig.clock.wait_until(steady_ns, self.never)
        frames = [self._next(after_ns=steady_ns) for _ in range(_STEADY_FRAMES)]
        self.period_ns = int(np.median(np.diff([frame.t_start_ns for frame in frames])))
        return [frame.image for frame in frames]

    def _flash(self, levels: RowLevels, rng: np.random.Generator, *, to_white: bool) -> LightChange:
        # The camera's last frame is taken just now, so the wait falls anywhere in its period.
        waiting_ns = round(float(rng.random()) * self.period_ns)
        pending = self.trigger is Trigger.SOFTWARE
        if pending:
            self.camera.trigger()
        else:
            self._next(after_ns=self.rig.clock.now_ns())
        self._wait(waiting_ns)
        shown = self._show(_WHITE if to_white else _BLACK)
        until_ns = shown.t_visible_ns + round(self.search_s * 1e9)
        frames: list[tuple[int, float, FloatArray]] = []
        after = 0
        while after < _FRAMES_AFTER and not (frames and frames[-1][0] > until_ns):
            if pending:
                pending = False
                # The exposures after this one follow each other at a period of their own: again anywhere in it.
                resumed_ns = round(float(rng.random()) * self.period_ns)
                try:
                    frame = self._read(0)
                except FrameTimeoutError:
                    continue
                finally:
                    self._wait(resumed_ns)
            else:
                frame = self._next(after_ns=0)
            shares = levels.shares(frame.image)
            frames.append((frame.t_start_ns, frame.exposure_s, shares))
            share = float(np.nanmedian(shares))
            after += (share if to_white else 1 - share) > _CHANGED_FRACTION
        return LightChange.of(to_white, shown, frames)

    def _show(self, index: int) -> DisplayedPattern:
        shown = self.rig.projector.show(index)
        self.least_error_ns = min(self.least_error_ns, shown.t_err_ns)
        return shown

    def _wait(self, span_ns: int) -> None:
        self.rig.clock.wait_until(self.rig.clock.now_ns() + span_ns, self.never)

    def _next(self, *, after_ns: int) -> Frame:
        """Return the next frame, taken now where a trigger is needed; one that is lost is asked for again."""
        for _ in range(_MAX_READS - 1):
            if self.trigger is Trigger.SOFTWARE:
                self.camera.trigger()
            with suppress(FrameTimeoutError):
                return self._read(after_ns)
        if self.trigger is Trigger.SOFTWARE:
            self.camera.trigger()
        return self._read(after_ns)

    def _read(self, after_ns: int) -> Frame:
        return self.camera.read(after_ns, _TIMEOUT_S)
