"""How late the projector's light is, how the cameras' shutters work, and at which rate the display refreshes."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace

import numpy as np

from slrig.capture import CameraLatency, LatencyMeasurement, measure_latency
from slrig.devices import CameraSettings, Rig, Synchronisation
from slrig.doctor.findings import Finding, camera_named, fault, ms, note, ok
from slrig.doctor.light import Seen
from slrig.doctor.measures.frequencies import refresh_hz
from slrig.doctor.viewing import Viewer
from slrig.errors import ScanEvidenceError
from slrig.model import Black, PatternSequence, Size, White

_SHOWS = 48
_LONGEST_PAUSE_S = 0.04
_FLASHES = 24
LATE_S = 1e-3
"""Light that comes later than a scan waits, by more than this, gets into the wrong frames."""

_NEEDLESS_S = 0.03
_JITTER_S = 3e-3
_STRANGE = 0.02


def white_and_black(size: Size) -> PatternSequence:
    """White, then black."""
    profiles = tuple(np.full((1, 1), level, np.uint8) for level in (255, 0))
    return PatternSequence(size, (White(), Black()), profiles)


def refresh(rig: Rig) -> tuple[float | None, list[Finding]]:
    """Show patterns at random moments: the rate of the grid on which they become visible, Hz, None without one."""
    never, rng = threading.Event(), np.random.default_rng(0)
    seen_ns: list[int] = []
    try:
        rig.projector.load(white_and_black(rig.projector.info.size))
        for number in range(_SHOWS):
            seen_ns.append(rig.projector.show(number % 2).t_visible_ns)
            waiting_ns = round(float(rng.uniform(0, _LONGEST_PAUSE_S)) * 1e9)
            rig.clock.wait_until(rig.clock.now_ns() + waiting_ns, never)
    finally:
        with suppress(Exception):
            rig.projector.blank()
    rate = refresh_hz(seen_ns)
    if rate is None:
        found = "patterns become visible at any instant, by the driver's word: no refresh is to be waited for"
    else:
        found = f"patterns become visible at refreshes of {rate:.2f} Hz, {ms(1 / rate)} apart, by the driver's word"
    return rate, [ok("timing.refresh", "projector", found)]


def latency(
    rig: Rig,
    seen: Mapping[str, Seen],
    *,
    search_s: float,
    told: Callable[[str, float, str], None],
) -> tuple[LatencyMeasurement | None, list[Finding]]:
    """Flash the projector before the cameras that see it; None where no flash can be seen as it happens.

    A camera that waits for triggers while the projector works may see none: what matters then is whether a frame that
    is taken right after the projector's word has the new light alone.
    """
    settings = {name: CameraSettings(each.exposure_s, rig.settings[name].gain) for name, each in seen.items()}
    watching = replace(rig, cameras={name: rig.cameras[name] for name in seen}, settings=settings)
    try:
        measured = measure_latency(watching, trials=_FLASHES, search_s=search_s, on_progress=told)
    except ScanEvidenceError as error:
        return None, [punctual(watching, each, error) for each in seen.values()]
    findings = [_late(measured, rig.synchronisation), *_jitter(measured, seen)]
    for name, found in measured.cameras.items():
        findings.append(_shutter(name, found, seen[name].skew_s, rig.synchronisation))
    return measured, findings


def punctual(rig: Rig, seen: Seen, cause: ScanEvidenceError) -> Finding:
    """Alternate white and black as a scan does, and look for light of the pattern before."""
    viewer = Viewer(rig, seen.name)
    strange = 0.0
    with viewer.armed(white_and_black(rig.projector.info.size), seen.exposure_s, _SHOWS):
        for number in range(_SHOWS):
            level = seen.levels.level(viewer.frames(number % 2)[0].image)
            strange = max(strange, abs(level - (1 - number % 2)))
    subject = camera_named(seen.name)
    if strange <= _STRANGE:
        found = (
            f"frames that are exposed right after the projector's word hold {1 - strange:.1%} of their own pattern's "
            "light, or more; how much earlier they could be is not told by its trigger"
        )
        return ok("timing.punctual", subject, found)
    found = (
        f"frames that are exposed right after the projector's word miss up to {strange:.0%} of their own pattern's "
        f"light; by how much it is late could not be measured: {cause}"
    )
    remedy = (
        "measure it: slrig latency --exposure-s with more than the projector's latency, or --trigger free; write what "
        "it says into [synchronisation]"
    )
    return fault("timing.late", subject, found, remedy)


def waited_s(synchronisation: Synchronisation | None) -> float:
    """How long a scan waits beyond what the projector states."""
    return 0.0 if synchronisation is None else synchronisation.latency_s + synchronisation.latency_error_s


def late_s(measured: LatencyMeasurement) -> float:
    """How much later than the projector states, its error included, light is stable at the latest."""
    return measured.slowest.latest_s - measured.shown_error_s


def _late(measured: LatencyMeasurement, known: Synchronisation | None) -> Finding:
    slowest = measured.slowest
    now_s = waited_s(known)
    words = (
        f"light comes {ms(slowest.latency_s)} ± {ms(slowest.standard_error_s)} after the instant that the projector "
        f"states, and is stable {ms(slowest.latest_s)} after it at the latest"
    )
    if late_s(measured) > now_s + LATE_S:
        table = "its rig file has no [synchronisation]" if known is None else f"its rig file waits {ms(now_s)}"
        remedy = (
            "use the table [synchronisation] of the rig file that --output writes; a game or low-latency mode of the "
            "projector, and no picture processing, make it faster"
        )
        return fault("timing.late", "projector", f"{words}; {table}: frames would show the pattern before", remedy)
    if now_s > waited_s(measured.synchronisation) + _NEEDLESS_S:
        remedy = "use the table [synchronisation] of the rig file that --output writes: scans get faster"
        waits = f"scans wait {ms(now_s - waited_s(measured.synchronisation))} longer than they must"
        return note("timing.needless", "projector", f"{words}; {waits}", remedy)
    return ok("timing.late", "projector", words)


def _jitter(measured: LatencyMeasurement, seen: Mapping[str, Seen]) -> list[Finding]:
    slowest = measured.slowest
    jitter_s = slowest.jitter_s
    if jitter_s <= max(_JITTER_S, 2 * measured.shown_error_s):
        return []
    found = (
        f"the instant of light varies by {ms(jitter_s)} (standard deviation), the projector states "
        f"± {ms(measured.shown_error_s)}"
    )
    [name] = [each for each, of_it in measured.cameras.items() if of_it is slowest]
    stamp_error_s = seen[name].stamp_error_s
    if stamp_error_s >= jitter_s:
        limit = (
            f"{found}; but the time stamps of {camera_named(name)} are right within ± {ms(stamp_error_s)} only, by its "
            "driver's word: they are the limit of what can be measured, and nothing says that the projector varies"
        )
        remedy = (
            "scans wait for the latest light and stay right, only slower; to scan faster or to examine the projector, "
            "use a camera whose frames carry time stamps of its own (drivers v4l2, genicam, depthai), or a trigger by "
            "wire; with v4l2, readout_s in its table narrows what its stamps leave open"
        )
        return [note("timing.stamps", camera_named(name), limit, remedy)]
    remedy = (
        "switch off the desktop's compositor and triple buffering, end other programs that draw; scans wait for "
        "the latest light and stay right"
    )
    return [note("timing.jitter", "projector", found, remedy)]


def _shutter(name: str, found: CameraLatency, skew_s: float, known: Synchronisation | None) -> Finding:
    subject, line_us = camera_named(name), found.line_time_s * 1e6
    if found.scanned:
        words = f"the projector builds up its picture row by row, {-line_us:.1f} µs per camera row"
        return ok("timing.shutter", subject, words)
    if not found.rolling:
        return ok("timing.shutter", subject, "global shutter, as far as the flashes tell")
    words = f"rolling shutter: {line_us:.1f} µs from row to row, {ms(found.skew_s)} from the first to the last"
    if skew_s > 0 or (known is not None and known.line_time_s.get(name, 0.0) > 0):
        return ok("timing.shutter", subject, words)
    where = f"{name} = {found.line_time_s:.9f} into [synchronisation.line_time_s], as the rig file of --output has it"
    return note("timing.shutter", subject, f"{words}; neither its driver nor the rig file says so", f"write {where}")
