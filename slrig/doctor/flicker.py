"""Does the room's light, or the projector's, flicker, and what is left of it in the rig's exposure?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slrig.doctor.findings import Finding, camera_named, fault, ms, note, ok
from slrig.doctor.light import Seen
from slrig.doctor.measures.frequencies import Swing, passed, swings
from slrig.doctor.timing import white_and_black
from slrig.doctor.viewing import Viewer
from slrig.model import FloatArray, Frame, PatternSequence

_SHORT_S = 0.002
_FRAMES = 128
_LONGEST_PAUSE_S = 0.025
_BANDS = 8
_MAINS_HZ = {100.0: 50, 120.0: 60, 50.0: 50, 60.0: 60}
_SAME = 0.01
_EXACT = 0.001
_NOTE, _FAULT = 0.004, 0.01


@dataclass(frozen=True, slots=True)
class Flicker:
    """Light that swings. `share` : from mean to peak, of the projector's white, before any exposure averaged it."""

    source: str
    frequency_hz: float
    share: float
    aliases_hz: tuple[float, ...] = ()

    def left(self, exposure_s: float) -> float:
        """What exposures of this length show, of the projector's white."""
        return self.share * passed(self.frequency_hz, exposure_s)


def flicker(viewer: Viewer, seen: Seen, *, line_time_s: float) -> tuple[tuple[Flicker, ...], list[Finding]]:
    """Watch black, then white, with short exposures at random moments: what swings, and the findings."""
    pair = white_and_black(viewer.projector.info.size)
    (dark_dn, dark), (bright_dn, bright) = (_watched(viewer, pair, index, seen, line_time_s) for index in (1, 0))
    white_dn = max(bright_dn - dark_dn, 1e-6)
    room = [Flicker("room", _told(s), s.amplitude / white_dn, s.aliases_hz) for s in dark]
    lamp = [
        Flicker("projector", _told(s), s.amplitude / white_dn, s.aliases_hz)
        for s in bright
        if not any(_alike(s, other) and other.share * white_dn > s.amplitude / 2 for other in room)
    ]
    found = tuple(each for each in (*room, *lamp) if each.share >= _NOTE)
    findings = [_judged(each, seen, viewer.name) for each in found]
    if not findings:
        words = f"neither the room's light nor the projector's flickers by {_NOTE:.1%} of white"
        findings = [ok("flicker.none", camera_named(viewer.name), words)]
    return found, findings


def _watched(
    viewer: Viewer, pair: PatternSequence, index: int, seen: Seen, line_time_s: float
) -> tuple[float, tuple[Swing, ...]]:
    """The mean of the usable pixels, DN, and what swings in them."""
    rng = np.random.default_rng(index)
    times_s: list[FloatArray] = []
    values: list[FloatArray] = []
    with viewer.armed(pair, min(_SHORT_S, seen.exposure_s), _FRAMES):
        after_ns = viewer.show(index)
        first_ns = after_ns
        for _ in range(_FRAMES):
            viewer.pause(float(rng.uniform(0, _LONGEST_PAUSE_S)))
            frame = viewer.next(after_ns)
            after_ns = frame.t_end_ns
            at_s, value = _bands(frame, seen, line_time_s)
            times_s.append(at_s + (frame.t_start_ns - first_ns) / 1e9)
            values.append(value)
    by_band = np.array(values)
    means = np.maximum(by_band.mean(axis=0), 1e-3)
    mean_dn = float(by_band.mean())
    found = swings(np.concatenate(times_s), (by_band / means).ravel() * mean_dn, exposure_s=viewer.exposure_s)
    return mean_dn, found


def _bands(frame: Frame, seen: Seen, line_time_s: float) -> tuple[FloatArray, FloatArray]:
    """When each band of rows was exposed, from the start of the frame, s, and its mean, DN: one band if all at once."""
    usable = seen.levels.usable
    lit_rows = np.flatnonzero(usable.any(axis=1))
    bands = np.array_split(lit_rows, _BANDS if line_time_s > 0 else 1)
    half_s = frame.exposure_s / 2
    times_s = np.array([float(rows.mean()) * line_time_s + half_s for rows in bands if len(rows)])
    values = np.array([float(frame.image[rows][usable[rows]].mean()) for rows in bands if len(rows)])
    return times_s, values


def _told(swing: Swing) -> float:
    """The frequency to name: that of the mains where it is among those that cannot be told apart."""
    for mains_hz in _MAINS_HZ:
        for candidate_hz in (swing.frequency_hz, *swing.aliases_hz):
            if abs(candidate_hz - mains_hz) < _SAME * mains_hz:
                return mains_hz if abs(candidate_hz - mains_hz) < _EXACT * mains_hz else candidate_hz
    return swing.frequency_hz


def _alike(swing: Swing, other: Flicker) -> bool:
    return abs(_told(swing) - other.frequency_hz) < _SAME * other.frequency_hz


def _judged(each: Flicker, seen: Seen, name: str) -> Finding:
    own_s = seen.own_exposure_s
    left = each.left(own_s)
    words = (
        f"swings {each.frequency_hz:.1f} times a second by ±{each.share:.1%} of the projector's white; at the rig's "
        f"exposure of {ms(own_s)} ±{left:.2%} of it is left, as {camera_named(name)} sees it"
    )
    if each.aliases_hz:
        words += " (it samples evenly: the frequency may be another one)"
    kind = fault if left > _FAULT else note
    wanted = f"expose for a multiple of {ms(1 / each.frequency_hz)}"
    if each.source == "room":
        mains = [hz for light_hz, hz in _MAINS_HZ.items() if abs(each.frequency_hz - light_hz) < _SAME * light_hz]
        lamps = f"lamps on mains of {mains[0]} Hz" if mains else "a lamp"
        remedy = f"{wanted}, or switch them off or shade them"
        return kind("flicker.room", "room light", f"{lamps}: the light {words}", remedy)
    remedy = (
        f"{wanted}: a colour wheel or dimmed lamp shows its whole cycle only then; a static mode without colour wheel "
        "or dimming (bright, single colour) avoids it"
    )
    return kind("flicker.projector", "projector", f"its light {words}", remedy)
