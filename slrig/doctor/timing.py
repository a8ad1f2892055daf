"""Latency of the projector's light, shutters of the cameras, refresh of the display, and flicker of the light.

Refresh. A display changes at its refreshes only, so the instants at which patterns become visible lie on a grid. For
its frequency f all phases 2π f t agree: R = |Σ exp(2πi f t)|/n is near 1, also for multiples of f, and far below for
other frequencies if the patterns were requested at random moments. The true frequency has the highest R, because errors
of the instants weigh more in its multiples.

Flicker. Short exposures at uneven instants sample the brightness. The spectrum is that of Lomb and Scargle with a
floating mean (M. Zechmeister and M. Kürster, A&A 496, 2009), which has no aliases for uneven samples. A free-running
camera samples evenly, unless it has a rolling shutter, whose rows sample between its frames; frequencies that such
samples cannot distinguish are reported together. Oscillations are removed one by one, the strongest first. An exposure
of e seconds attenuates an oscillation of f hertz by sinc(f·e) = sin(π f e)/(π f e): whole periods cancel it.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from slrig.capture.latency import CameraLatency, LatencyMeasurement, measure_latency
from slrig.capture.pulses import measure_trigger_period
from slrig.devices import CameraSettings, Rig, Synchronisation
from slrig.doctor.light import CameraSession, Finding, LightMeasurement, camera_label, fault, format_ms, note, ok
from slrig.errors import FrameTimeoutError, PatternError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.jobs.listener import SILENT, Listener
from slrig.live.plan import live_plan
from slrig.live.player import play
from slrig.model import Axis, Black, FloatArray, Frame, PatternSequence, Shot, Size, White

_SHOWS = 48
_MAX_SHOW_PAUSE_S = 0.04
_FLASHES = 24
MAX_LATENESS_S = 1e-3
"""Light that comes later than a scan waits, by more than this, gets into the wrong frames."""

_MAX_NEEDLESS_WAIT_S = 0.03
_MAX_JITTER_S = 3e-3
_MAX_STRANGE_LIGHT = 0.02

_REFRESH_RANGE_HZ = (22.0, 260.0)
_MIN_AGREEMENT = 0.8
_REFRESH_OVERSAMPLING = 16
_NEARLY_HIGHEST = 0.97

_FLICKER_EXPOSURE_S = 0.002
_FLICKER_FRAMES = 128
_MAX_FLICKER_PAUSE_S = 0.025
_BANDS = 8
_MAINS_HZ = {100.0: 50, 120.0: 60, 50.0: 50, 60.0: 60}
_SAME_FREQUENCY = 0.01
_EXACT_FREQUENCY = 0.001
_NOTE_FLICKER, _FAULT_FLICKER = 0.004, 0.01

_LOWEST_HZ, _HIGHEST_HZ = 20.0, 400.0
_MAX_OSCILLATIONS = 4
_MAX_FALSE_ALARM = 1e-6
_SPECTRUM_OVERSAMPLING = 5
_ALIAS_SHARE = 0.9

_LIVE_CYCLES = 3
_MIN_SAMPLES = 16
_MIN_ATTENUATION = 0.1


# ---- Latency and refresh


def white_and_black(size: Size) -> PatternSequence:
    """White, then black."""
    profiles = tuple(np.full((1, 1), level, np.uint8) for level in (255, 0))
    return PatternSequence(size, (White(), Black()), profiles)


def measure_refresh(rig: Rig) -> tuple[float | None, list[Finding]]:
    """Show patterns at random moments, and return the display's refresh rate, Hz; None if it has no grid."""
    never, rng = threading.Event(), np.random.default_rng(0)
    visible_ns: list[int] = []
    try:
        rig.projector.load(white_and_black(rig.projector.info.size))
        for number in range(_SHOWS):
            visible_ns.append(rig.projector.show(number % 2).t_visible_ns)
            waiting_ns = round(float(rng.uniform(0, _MAX_SHOW_PAUSE_S)) * 1e9)
            rig.clock.wait_until(rig.clock.now_ns() + waiting_ns, never)
    finally:
        with suppress(Exception):
            rig.projector.blank()
    rate_hz = estimate_refresh_hz(visible_ns)
    if rate_hz is None:
        message = "according to its driver, patterns become visible at any instant, without refreshes to wait for"
    else:
        period = format_ms(1 / rate_hz)
        message = f"according to its driver, patterns become visible at refreshes of {rate_hz:.2f} Hz, {period} apart"
    return rate_hz, [ok("timing.refresh", "projector", message)]


def estimate_refresh_hz(t_visible_ns: Sequence[int]) -> float | None:
    """Return the refresh rate from 20 or more instants; None if they lie on no grid.

    >>> rng = np.random.default_rng(0)
    >>> on_a_grid = np.cumsum(rng.integers(1, 9, 40)) * 1e9 / 59.94
    >>> round(estimate_refresh_hz([round(t) for t in on_a_grid]), 2)
    59.94
    >>> estimate_refresh_hz([round(t) for t in np.cumsum(rng.uniform(0.01, 0.08, 40)) * 1e9]) is None
    True
    """
    t_s = (np.array(t_visible_ns, np.float64) - t_visible_ns[0]) / 1e9
    span_s = float(np.ptp(t_s))
    if span_s <= 0:
        return None
    step_hz = 1 / (_REFRESH_OVERSAMPLING * span_s)
    frequencies = np.arange(*_REFRESH_RANGE_HZ, step_hz)
    agreement = np.abs(np.exp(2j * np.pi * np.outer(frequencies, t_s)).mean(axis=1))
    highest = float(agreement.max())
    if highest < _MIN_AGREEMENT:
        return None
    # Multiples agree too if the instants are exact: take the lowest.
    first = int(np.argmax(agreement > _NEARLY_HIGHEST * highest))
    near = slice(max(first - _REFRESH_OVERSAMPLING, 0), first + _REFRESH_OVERSAMPLING)
    top_hz = float(frequencies[near][np.argmax(agreement[near])])
    finer = np.linspace(top_hz - step_hz, top_hz + step_hz, 4 * _REFRESH_OVERSAMPLING + 1)
    return float(finer[np.argmax(np.abs(np.exp(2j * np.pi * np.outer(finer, t_s)).mean(axis=1)))])


def measure_light_latency(
    rig: Rig,
    lights: Mapping[str, LightMeasurement],
    scans_s: Mapping[str, float],
    listener: Listener = SILENT,
    *,
    search_s: float,
) -> tuple[LatencyMeasurement | None, list[Finding]]:
    """Flash the projector before the cameras that see it; the measurement is None if no camera sees a flash happen.

    scans_s : exposure of each camera in scans.

    A camera that needs triggers while the projector works may miss all flashes. For such a camera, check that frames
    taken as soon as the projector states light hold the new light alone.
    """
    settings = {name: CameraSettings(each.exposure_s, rig.settings[name].gain) for name, each in lights.items()}
    watching = replace(rig, cameras={name: rig.cameras[name] for name in lights}, settings=settings)
    # As scans expose, if the light suffices: some time stamps are later with longer exposures.
    as_scanned = {name: replace(each, exposure_s=scans_s[name]) for name, each in settings.items()}
    scanning = replace(watching, settings=as_scanned)
    try:
        try:
            measured = measure_latency(scanning, trials=_FLASHES, search_s=search_s, on_progress=listener.step)
        except ScanEvidenceError:
            if scanning.settings == watching.settings:
                raise
            measured = measure_latency(watching, trials=_FLASHES, search_s=search_s, on_progress=listener.step)
    except ScanEvidenceError as error:
        return None, [check_punctuality(watching, each, error) for each in lights.values()]
    findings = [
        _check_latency(measured, rig.synchronisation),
        *_check_jitter(measured, lights),
        *_check_interpolation(measured),
    ]
    for name, camera in measured.cameras.items():
        findings.append(_describe_shutter(name, camera, lights[name].skew_s, rig.synchronisation))
    return measured, findings


def check_punctuality(rig: Rig, light: LightMeasurement, cause: ScanEvidenceError) -> Finding:
    """Alternate white and black as a scan does, and look for light of the previous pattern."""
    session = CameraSession(rig, light.name)
    strange = 0.0
    with session.arm(white_and_black(rig.projector.info.size), light.exposure_s, _SHOWS):
        for number in range(_SHOWS):
            level = light.levels.relative_level(session.capture_frames(number % 2)[0].image)
            strange = max(strange, abs(level - (1 - number % 2)))
    subject = camera_label(light.name)
    if strange <= _MAX_STRANGE_LIGHT:
        message = (
            f"frames exposed as soon as the projector states light hold {1 - strange:.1%} of their own pattern's "
            "light, or more; this trigger cannot show how much earlier they could be exposed"
        )
        return ok("timing.punctual", subject, message)
    message = (
        f"frames exposed as soon as the projector states light miss up to {strange:.0%} of their own pattern's "
        f"light; its delay could not be measured: {cause}"
    )
    remedy = (
        "measure it: slrig latency --exposure-s with more than the projector's latency, or --trigger free; write the "
        "result into [synchronisation]"
    )
    return fault("timing.late", subject, message, remedy)


def measure_pulses(rig: Rig, sequence: PatternSequence) -> tuple[float | None, list[Finding]]:
    """Return the least period of trigger pulses that a rig file has to name, and the findings; None if scans need not
    be told. Raises DeviceError.
    """
    asked_s, least_s = measure_trigger_period(rig, sequence)
    if least_s == asked_s:
        message = f"every camera takes a trigger pulse every {format_ms(asked_s)}, as scans send them"
        return None, [ok("timing.pulses", "cameras", message)]
    message = f"cameras miss trigger pulses every {format_ms(asked_s)}, as scans send them first, and take them every "
    remedy = (
        f"write trigger_period_s = {least_s:.6g} into [synchronisation], as in the rig file that --output writes: else "
        "the first scan is played again, more slowly"
    )
    return least_s, [note("timing.pulses", "cameras", f"{message}{format_ms(least_s)}", remedy)]


def measure_live(rig: Rig, camera: str, exposure_s: float | None) -> Finding:
    """Return how many depth images a second live depth gives of a camera, by a few cycles of it. Raises DeviceError."""
    begins_s: list[float] = []

    def take(_pattern: int, _shot: Shot, begin_s: float, _end_s: float) -> None:
        begins_s.append(begin_s)

    subject = camera_label(camera)
    try:
        plan = live_plan(rig.projector.info, Axis.COLUMN)
        wanted = _LIVE_CYCLES * len(plan.patterns) + 1
        play(rig, plan, camera, take, lambda: len(begins_s) >= wanted, exposure_s=exposure_s)
    except (PatternError, ScanEvidenceError, FrameTimeoutError, UnsupportedByDeviceError) as error:
        remedy = "aim by the live picture; scans do not need live depth"
        return note("timing.live", subject, f"live depth cannot be played: {error}", remedy)
    frame_s = (begins_s[-1] - begins_s[0]) / (len(begins_s) - 1)
    window_s = frame_s * len(plan.patterns)
    message = f"live depth gives {1 / frame_s:.1f} depth images a second, each of {window_s:.2f} s of light"
    return ok("timing.live", subject, message)


def waiting_time_s(synchronisation: Synchronisation | None) -> float:
    """Time that a scan waits in addition to the projector's own statement."""
    return 0.0 if synchronisation is None else synchronisation.latency_s + synchronisation.latency_error_s


def lateness_s(measured: LatencyMeasurement) -> float:
    """Longest time from the stated instant, its error included, until light is stable."""
    return measured.slowest.latest_s - measured.shown_error_s


def _check_latency(measured: LatencyMeasurement, known: Synchronisation | None) -> Finding:
    slowest = measured.slowest
    now_s = waiting_time_s(known)
    message = (
        f"light comes {format_ms(slowest.latency_s)} ± {format_ms(slowest.standard_error_s)} after the instant that "
        f"the projector states, and is stable {format_ms(slowest.latest_s)} after it at the latest"
    )
    if slowest.late:
        message = f"{message}; {slowest.late_words}"
    if lateness_s(measured) > now_s + MAX_LATENESS_S:
        table = "its rig file has no [synchronisation]" if known is None else f"its rig file waits {format_ms(now_s)}"
        remedy = (
            "use the table [synchronisation] of the rig file that --output writes; a game or low-latency mode of the "
            "projector, and no picture processing, make it faster"
        )
        message = f"{message}; {table}: frames would show the previous pattern"
        return fault("timing.late", "projector", message, remedy)
    needed_s = waiting_time_s(measured.synchronisation)
    if now_s > needed_s + _MAX_NEEDLESS_WAIT_S:
        remedy = "use the table [synchronisation] of the rig file that --output writes: scans get faster"
        message = f"{message}; scans wait {format_ms(now_s - needed_s)} longer than necessary"
        return note("timing.needless", "projector", message, remedy)
    return ok("timing.late", "projector", message)


def _check_jitter(measured: LatencyMeasurement, lights: Mapping[str, LightMeasurement]) -> list[Finding]:
    slowest = measured.slowest
    jitter_s = slowest.jitter_s
    if jitter_s <= max(_MAX_JITTER_S, 2 * measured.shown_error_s):
        return []
    message = (
        f"the instant of light varies by {format_ms(jitter_s)} (standard deviation), the projector states "
        f"± {format_ms(measured.shown_error_s)}"
    )
    [name] = [name for name, camera in measured.cameras.items() if camera is slowest]
    stamp_error_s = lights[name].stamp_error_s
    if stamp_error_s >= jitter_s:
        message = (
            f"{message}; but according to its driver, the time stamps of {camera_label(name)} are right within "
            f"± {format_ms(stamp_error_s)} only: they limit the measurement, and the projector may be regular"
        )
        remedy = (
            "scans wait for the latest light and stay right, only slower; to scan faster or to examine the projector, "
            "use a camera whose frames carry time stamps of the device (drivers v4l2, genicam, depthai), or a trigger "
            "by wire; with v4l2, readout_s in its table makes the stamps more exact"
        )
        return [note("timing.stamps", camera_label(name), message, remedy)]
    remedy = (
        "switch off the desktop's compositor and triple buffering, end other programs that draw; scans wait for "
        "the latest light and stay right"
    )
    return [note("timing.jitter", "projector", message, remedy)]


def _check_interpolation(measured: LatencyMeasurement) -> list[Finding]:
    halfway_s = max(camera.halfway_s for camera in measured.cameras.values())
    if not halfway_s:
        return []
    message = (
        f"between white and black its light stands halfway for {format_ms(halfway_s)}: it shows pictures that nobody "
        "sent, mixed from one pattern and the next"
    )
    remedy = (
        "switch off frame interpolation (motion smoothing, frame creation) in its menu, or choose its game or PC mode; "
        "scans wait for it and stay right, only slower"
    )
    return [note("timing.interpolated", "projector", message, remedy)]


def _describe_shutter(name: str, camera: CameraLatency, skew_s: float, known: Synchronisation | None) -> Finding:
    subject, line_us = camera_label(name), camera.line_time_s * 1e6
    if camera.scanned:
        message = f"the projector builds up its picture row by row, {-line_us:.1f} µs per camera row"
        return ok("timing.shutter", subject, message)
    if not camera.rolling:
        return ok("timing.shutter", subject, "global shutter, within the accuracy of the flashes")
    skew = format_ms(camera.skew_s)
    message = f"rolling shutter: {line_us:.1f} µs from row to row, {skew} from the first to the last"
    if skew_s > 0 or (known is not None and known.line_time_s.get(name, 0.0) > 0):
        return ok("timing.shutter", subject, message)
    remedy = (
        f"write {name} = {camera.line_time_s:.9f} into [synchronisation.line_time_s], as in the rig file that --output "
        "writes"
    )
    return note("timing.shutter", subject, f"{message}; neither its driver nor the rig file states that", remedy)


# ---- Flicker


@dataclass(frozen=True, slots=True)
class LightFlicker:
    """Periodic change of the light. share : amplitude over the projector's white, not averaged by an exposure."""

    source: str
    frequency_hz: float
    share: float
    aliases_hz: tuple[float, ...] = ()

    def remaining_share(self, exposure_s: float) -> float:
        """Return the amplitude that exposures of this length keep, over the projector's white."""
        return self.share * exposure_attenuation(self.frequency_hz, exposure_s)


@dataclass(frozen=True, slots=True)
class Oscillation:
    """Periodic part of samples. amplitude : from mean to peak, unit of the samples, not averaged by an exposure.

    power : share of the samples' variance that it explains. aliases_hz : frequencies that explain them as well.
    """

    frequency_hz: float
    amplitude: float
    power: float
    aliases_hz: tuple[float, ...] = ()


def measure_flicker(
    session: CameraSession, light: LightMeasurement, *, line_time_s: float
) -> tuple[tuple[LightFlicker, ...], list[Finding]]:
    """Watch black, then white, with short exposures at random moments, and return the flicker and the findings."""
    pair = white_and_black(session.projector.info.size)
    (dark_dn, dark), (bright_dn, bright) = (
        _measure_oscillations(session, pair, index, light, line_time_s) for index in (1, 0)
    )
    white_dn = max(bright_dn - dark_dn, 1e-6)

    def flicker(source: str, oscillation: Oscillation) -> LightFlicker:
        share = oscillation.amplitude / white_dn
        return LightFlicker(source, _prefer_mains_hz(oscillation), share, oscillation.aliases_hz)

    def is_in_room(oscillation: Oscillation) -> bool:
        hz = _prefer_mains_hz(oscillation)
        return any(
            abs(hz - each.frequency_hz) < _SAME_FREQUENCY * each.frequency_hz
            and each.share * white_dn > oscillation.amplitude / 2
            for each in room
        )

    room = [flicker("room", each) for each in dark]
    lamp = [flicker("projector", each) for each in bright if not is_in_room(each)]
    flickers = tuple(each for each in (*room, *lamp) if each.share >= _NOTE_FLICKER)
    findings = [_describe_flicker(each, light, session.name) for each in flickers]
    if not findings:
        message = f"neither the room's light nor the projector's flickers by {_NOTE_FLICKER:.1%} of white"
        findings = [ok("flicker.none", camera_label(session.name), message)]
    return flickers, findings


def _measure_oscillations(
    session: CameraSession, pair: PatternSequence, index: int, light: LightMeasurement, line_time_s: float
) -> tuple[float, tuple[Oscillation, ...]]:
    """Return the mean of the usable pixels, DN, and their oscillations."""
    rng = np.random.default_rng(index)
    times_s: list[FloatArray] = []
    values: list[FloatArray] = []
    with session.arm(pair, min(_FLICKER_EXPOSURE_S, light.exposure_s), _FLICKER_FRAMES):
        after_ns = session.show(index)
        first_ns = after_ns
        for _ in range(_FLICKER_FRAMES):
            session.wait(float(rng.uniform(0, _MAX_FLICKER_PAUSE_S)))
            frame = session.next_frame(after_ns)
            after_ns = frame.t_end_ns
            band_times_s, band_means = _band_means(frame, light, line_time_s)
            times_s.append(band_times_s + (frame.t_start_ns - first_ns) / 1e9)
            values.append(band_means)
    by_band = np.array(values)
    means = np.maximum(by_band.mean(axis=0), 1e-3)
    mean_dn = float(by_band.mean())
    samples = (by_band / means).ravel() * mean_dn
    return mean_dn, find_oscillations(np.concatenate(times_s), samples, exposure_s=session.exposure_s)


def _band_means(frame: Frame, light: LightMeasurement, line_time_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the time of each band of rows from the start of the frame, s, and its mean, DN.

    A global shutter has one band.
    """
    usable = light.levels.usable
    lit_rows = np.flatnonzero(usable.any(axis=1))
    bands = np.array_split(lit_rows, _BANDS if line_time_s > 0 else 1)
    half_s = frame.exposure_s / 2
    times_s = np.array([float(rows.mean()) * line_time_s + half_s for rows in bands if len(rows)])
    values = np.array([float(frame.image[rows][usable[rows]].mean()) for rows in bands if len(rows)])
    return times_s, values


def _prefer_mains_hz(oscillation: Oscillation) -> float:
    """Return the frequency to report: that of the mains if it is one of the possible ones."""
    for mains_hz in _MAINS_HZ:
        for candidate_hz in (oscillation.frequency_hz, *oscillation.aliases_hz):
            if abs(candidate_hz - mains_hz) < _SAME_FREQUENCY * mains_hz:
                return mains_hz if abs(candidate_hz - mains_hz) < _EXACT_FREQUENCY * mains_hz else candidate_hz
    return oscillation.frequency_hz


def _describe_flicker(flicker: LightFlicker, light: LightMeasurement, name: str) -> Finding:
    own_s, hz = light.own_exposure_s, flicker.frequency_hz
    remaining = flicker.remaining_share(own_s)
    message = (
        f"oscillates {hz:.1f} times a second by ±{flicker.share:.1%} of the projector's white; the rig's exposure of "
        f"{format_ms(own_s)} leaves ±{remaining:.2%} of it, as {camera_label(name)} sees it"
    )
    if flicker.aliases_hz:
        message += " (it samples evenly: the frequency may be another one)"
    kind = fault if remaining > _FAULT_FLICKER else note
    remedy = f"expose for a multiple of {format_ms(1 / hz)}"
    if flicker.source == "room":
        mains = [mains for mains_hz, mains in _MAINS_HZ.items() if abs(hz - mains_hz) < _SAME_FREQUENCY * mains_hz]
        lamps = f"lamps on mains of {mains[0]} Hz" if mains else "a lamp"
        remedy = f"{remedy}, or switch them off or shade them"
        return kind("flicker.room", "room light", f"{lamps}: the light {message}", remedy)
    remedy = (
        f"{remedy}: a colour wheel or dimmed lamp shows its whole cycle only then; a static mode without colour wheel "
        "or dimming (bright, single colour) avoids it"
    )
    return kind("flicker.projector", "projector", f"its light {message}", remedy)


def exposure_attenuation(frequency_hz: float, exposure_s: float) -> float:
    """Return the share of an oscillation that remains in an exposure, 0 to 1.

    >>> round(exposure_attenuation(100.0, 0.01), 6), round(exposure_attenuation(100.0, 0.005), 4)
    (0.0, 0.6366)
    """
    return abs(float(np.sinc(frequency_hz * exposure_s)))


def find_oscillations(t_s: FloatArray, samples: FloatArray, *, exposure_s: float) -> tuple[Oscillation, ...]:
    """Return the significant oscillations of samples of light, the strongest first.

    t_s : (n,) float64, middle of each sample's exposure. samples : (n,) float64, brightness; 16 or more are needed.
    exposure_s : of every sample.
    """
    # Takes half a second to import, and is needed here only.
    from scipy.signal import lombscargle

    if len(t_s) < _MIN_SAMPLES:
        return ()
    span_s = float(np.ptp(t_s))
    frequencies = np.arange(_LOWEST_HZ, _HIGHEST_HZ, 1 / (_SPECTRUM_OVERSAMPLING * span_s))
    rest, peaks = samples - samples.mean(), []
    for _ in range(_MAX_OSCILLATIONS):
        if not np.ptp(rest) > 0:
            break
        power = np.nan_to_num(lombscargle(t_s, rest, 2 * np.pi * frequencies, normalize=True, floating_mean=True))
        top = int(np.argmax(power))
        if _false_alarm_probability(float(power[top]), len(t_s), span_s) > _MAX_FALSE_ALARM:
            break
        refined_hz = _refine_frequency(t_s, rest, float(frequencies[top]), span_s)
        peaks.append((refined_hz, float(power[top]), _aliases(frequencies, power, top, span_s)))
        rest = samples - _fit_sines(t_s, samples, [hz for hz, _, _ in peaks])[0]
    _, amplitudes = _fit_sines(t_s, samples, [hz for hz, _, _ in peaks])
    return tuple(
        Oscillation(hz, amplitude / max(exposure_attenuation(hz, exposure_s), _MIN_ATTENUATION), power, aliases)
        for (hz, power, aliases), amplitude in zip(peaks, amplitudes, strict=True)
    )


def _refine_frequency(t_s: FloatArray, samples: FloatArray, frequency_hz: float, span_s: float) -> float:
    """Return the exact top of a peak: a fitted sine that misses it would leave a part of the oscillation."""
    from scipy.optimize import minimize_scalar

    def residual(candidate_hz: float) -> float:
        return float(np.sum((samples - _fit_sines(t_s, samples, [candidate_hz])[0]) ** 2))

    half_hz = 1 / (_SPECTRUM_OVERSAMPLING * span_s)
    limits = (frequency_hz - half_hz, frequency_hz + half_hz)
    return float(minimize_scalar(residual, bounds=limits, method="bounded", options={"xatol": half_hz / 1000}).x)


def _false_alarm_probability(power: float, samples: int, span_s: float) -> float:
    """Return the probability that noise alone has such a peak anywhere in the spectrum."""
    independent = span_s * (_HIGHEST_HZ - _LOWEST_HZ)
    return independent * math.exp(0.5 * (samples - 3) * math.log(max(1 - power, 1e-300)))


def _aliases(frequencies: FloatArray, power: FloatArray, top: int, span_s: float) -> tuple[float, ...]:
    """Return the other peaks that are nearly as high."""
    inner = power[1:-1]
    is_peak = (inner >= power[:-2]) & (inner >= power[2:]) & (inner > _ALIAS_SHARE * power[top])
    peaks = frequencies[1:-1][is_peak]
    return tuple(float(each) for each in peaks[np.abs(peaks - frequencies[top]) > 2 / span_s])


def _fit_sines(t_s: FloatArray, samples: FloatArray, frequencies: list[float]) -> tuple[FloatArray, list[float]]:
    """Fit a constant and one sine per frequency by least squares: (n,) values, and the amplitudes."""
    turns = [2 * np.pi * frequency * t_s for frequency in frequencies]
    base = np.column_stack([np.ones_like(t_s), *(wave(turn) for turn in turns for wave in (np.cos, np.sin))])
    weights = np.linalg.lstsq(base, samples, rcond=None)[0]
    amplitudes = [float(np.hypot(*weights[1 + 2 * i : 3 + 2 * i])) for i in range(len(frequencies))]
    return np.asarray(base @ weights, np.float64), amplitudes
