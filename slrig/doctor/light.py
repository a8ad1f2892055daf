"""Does the camera see the projector at all, and at which exposures does it see it well?"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from slrig.doctor.findings import Finding, Severity, camera_named, fault, judged, ms, note, ok
from slrig.doctor.measures.levels import USUAL_SNR, LightLevels, light_levels
from slrig.doctor.viewing import Viewer
from slrig.model import Black, FloatArray, Frame, Gray, PatternSequence, White

_FRAMES = 4
_LEAST_LIT = 0.01
_SMALL_PART = 0.05
_DARK_SHARE = 0.05
_DIM = 0.3
_BLOCK_PX = 8
_STRUCTURE_BITS = (1, 2)
_GLOW = 0.6
_LONGEST_S = 1.0
_SEARCH_FACTOR = 8.0
_MOST_LOOKS = 8
_WELL_EXPOSED = (0.45, 0.97)
_SATURATED_NOTE, _SATURATED_FAULT = 0.01, 0.05
_SHORT = 0.25
_BRIGHT_ROOM = 0.5


@dataclass(frozen=True, slots=True)
class Seen:
    """What one camera sees of the projector.

    own : at the rig's own exposure, own_exposure_s; levels : at exposure_s, which suits the light. shortest_s,
    longest_s : exposures at which noise, or saturation, leaves enough of the light. skew_s : of the shutter, and
    stamp_error_s, of the time stamps, as the driver states them.
    """

    name: str
    own_exposure_s: float
    own: LightLevels
    exposure_s: float
    levels: LightLevels
    shortest_s: float
    longest_s: float
    skew_s: float
    stamp_error_s: float = 0.0


def look(viewer: Viewer, sequence: PatternSequence, *, others: str) -> tuple[Seen | None, list[Finding]]:
    """Look at white and black, and at whether the patterns' structure arrives: what was seen, None if nothing was, and
    the findings. sequence : with white, black, and Gray patterns with their inverses. others : words on other displays
    that were found, for a remedy.
    """
    subject = camera_named(viewer.name)
    own_s = viewer.within(viewer.rig.settings[viewer.name].exposure_s)
    own, frame = _measured(viewer, sequence, own_s)
    own_s = viewer.exposure_s
    exposure_s, levels = own_s, own
    for _ in range(_MOST_LOOKS):
        wanted_s = viewer.within(_better_s(exposure_s, levels))
        if abs(wanted_s / exposure_s - 1) < 0.02 or (not _visible(levels) and wanted_s > max(_LONGEST_S, own_s)):
            break
        exposure_s = wanted_s
        levels, frame = _measured(viewer, sequence, exposure_s)
        exposure_s = viewer.exposure_s
    if not _visible(levels):
        return None, [_nothing(subject, own, levels, own_s, others)]
    if _structure(viewer, sequence, exposure_s, levels) < _GLOW:
        found = (
            f"{subject} sees light come and go with the patterns ({levels.contrast_dn:.0f} DN), but none of their "
            "structure: it is the glow of another display, and the projector shows something else or nothing"
        )
        remedy = "the patterns go to the wrong output: name the projector's connector in the rig file, or exchange the"
        return None, [fault("display.other", "projector", found, f"{remedy} cables. {others}")]
    usable_s = (levels.shortest_exposure_s(exposure_s), levels.longest_exposure_s(exposure_s))
    timing = (frame.shutter_skew_s, frame.t_err_ns / 1e9)
    seen = Seen(viewer.name, own_s, own, exposure_s, levels, *usable_s, *timing)
    return seen, [_part(subject, seen), _exposure(subject, seen, viewer), _room(subject, seen)]


def at_exposure(viewer: Viewer, sequence: PatternSequence, seen: Seen, exposure_s: float) -> Seen:
    """The same, looked at again with another exposure for what follows."""
    levels, _ = _measured(viewer, sequence, exposure_s)
    return replace(seen, exposure_s=viewer.exposure_s, levels=levels)


def _measured(viewer: Viewer, sequence: PatternSequence, exposure_s: float) -> tuple[LightLevels, Frame]:
    """The levels of white and black, and one of the white frames."""
    patterns = sequence.patterns
    with viewer.armed(sequence, exposure_s, 2 * _FRAMES):
        white = viewer.frames(patterns.index(White()), _FRAMES)
        black = viewer.frames(patterns.index(Black()), _FRAMES)
    full_scale = viewer.camera.info.format.full_scale
    levels = light_levels([f.image for f in white], [f.image for f in black], full_scale=full_scale)
    return levels, white[0]


def _visible(levels: LightLevels) -> bool:
    return levels.lit_share >= _LEAST_LIT


def _better_s(exposure_s: float, levels: LightLevels) -> float:
    """The exposure to try next; the same where this one is good."""
    low, high = _WELL_EXPOSED
    if levels.saturated_share > 0.005 or levels.black_saturated_share > 0.02:
        return exposure_s / 4
    if not _visible(levels):
        return exposure_s * (_SEARCH_FACTOR if levels.bright_dn < _DIM * levels.full_scale else 1.0)
    if low * levels.full_scale <= levels.bright_dn <= high * levels.full_scale:
        return exposure_s
    return exposure_s * min(0.8 * levels.full_scale / max(levels.bright_dn, 1.0), _SEARCH_FACTOR)


def _structure(viewer: Viewer, sequence: PatternSequence, exposure_s: float, levels: LightLevels) -> float:
    """How much of white − black coarse bits show against their inverses, in the middle lit part of the image.

    Glow shows what they differ by in all, a third at most with these bits, however wide the projector is.
    """
    patterns = sequence.patterns
    coarse = [p for p in patterns if isinstance(p, Gray) and p.bit in _STRUCTURE_BITS and not p.inverted]
    shares = []
    with viewer.armed(sequence, exposure_s, 2 * len(coarse)):
        for bit in coarse:
            inverse = Gray(bit.axis, bit.bit, bit.bits, bit.cell_px, bit.offset_px, inverted=True)
            pair = [viewer.frames(patterns.index(each))[0].image.astype(np.float64) for each in (bit, inverse)]
            difference, contrast = (_in_blocks(each * levels.lit) for each in (pair[0] - pair[1], levels.contrast))
            lit = contrast > 0.5 * np.median(contrast[contrast > 0])
            shares.append(float(np.median(np.abs(difference[lit]) / contrast[lit])))
    return max(shares)


def _in_blocks(image: FloatArray) -> FloatArray:
    """Means over squares of the image: coarse bits are even there, and noise is less."""
    height, width = image.shape
    size = (max(width // _BLOCK_PX, 1), max(height // _BLOCK_PX, 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float64)


def _nothing(subject: str, own: LightLevels, levels: LightLevels, exposure_s: float, others: str) -> Finding:
    """Why there is no light of the projector to be seen."""
    darker = float(np.mean(own.contrast < -max(2.0, 0.05 * own.full_scale)))
    means = f"white {own.white.mean():.1f} DN, black {own.black.mean():.1f} DN of {own.full_scale}"
    if darker >= _LEAST_LIT:
        found = f"{subject} sees white darker than black on {darker:.0%} of its image ({means})"
        remedy = (
            "set the projector's picture to normal, not inverted, polarity; if it is, see whether its light comes "
            "later than it says: slrig latency"
        )
        return fault("display.inverted", "projector", found, remedy)
    if levels.black_saturated_share > 0.5:
        found = (
            f"even black frames are saturated on {levels.black_saturated_share:.0%} of the image, at the shortest "
            "exposure that was tried"
        )
        remedy = "shade the room's light, close the lens's aperture, or lower the gain"
        return fault("exposure.ambient", subject, found, remedy)
    if own.bright_dn <= _DARK_SHARE * own.full_scale:
        found = (
            f"white and black frames are both dark at {ms(exposure_s)} ({means}), and longer exposures do not tell "
            "them apart"
        )
        remedy = (
            "switch the projector's lamp on and choose its input; take the lens caps off; turn the camera to what the "
            f"projector lights. {others}"
        )
        return fault("light.none", subject, found, remedy)
    found = (
        f"{subject} sees a bright picture that does not change with the patterns ({means}): what lights it is not "
        "what slrig shows"
    )
    remedy = (
        "if the projector shows a desktop or another source, the patterns go to another display: name the "
        "projector's connector in the rig file, or exchange the cables, or choose its other input. Cover the "
        f"projector's lens to be sure: if nothing changes, its lamp is off, and this is the room's light. {others}"
    )
    return fault("display.other", "projector", found, remedy)


def _part(subject: str, seen: Seen) -> Finding:
    (top, bottom, left, right), share = seen.levels.box, seen.levels.lit_share
    found = f"the projector lights {share:.0%} of the image, rows {top} to {bottom} and columns {left} to {right}"
    remedy = "aim camera and projector at the same place; see that nothing stands before one of the lenses"
    return judged(Severity.NOTE if share < _SMALL_PART else None, "light.part", subject, found, remedy)


def _exposure(subject: str, seen: Seen, viewer: Viewer) -> Finding:
    own, own_s = seen.own, seen.own_exposure_s
    usable = f"usable exposures are {ms(min(seen.shortest_s, seen.longest_s))} to {ms(seen.longest_s)}"
    bright = f"{own.bright_dn / own.full_scale:.0%} of full scale"
    if own.black_saturated_share > _SATURATED_NOTE:
        found = f"black frames are saturated on {own.black_saturated_share:.1%} of the image at {ms(own_s)}"
        return fault("exposure.ambient", subject, found, f"shade the room's light, or expose shorter: {usable}")
    if own.saturated_share > _SATURATED_NOTE:
        kind = fault if own.saturated_share > _SATURATED_FAULT else note
        found = f"white is saturated on {own.saturated_share:.1%} of what the projector lights, at {ms(own_s)}"
        remedy = (
            f"expose for {ms(seen.longest_s)} at most, close the lens's aperture or lower the gain; {usable}. If "
            "only glints are saturated, take several exposures per pattern"
        )
        return kind("exposure.saturated", subject, found, remedy)
    if seen.shortest_s > seen.longest_s:
        found = (
            f"noise is {seen.levels.noise_dn:.1f} DN where white less black is {seen.levels.contrast_dn:.1f} DN, "
            f"at the longest exposure that does not saturate ({ms(seen.longest_s)})"
        )
        remedy = "shade the room's light, open the lens's aperture, bring the projector nearer, or lower the gain and"
        return fault("exposure.noise", subject, found, f"{remedy} expose longer")
    if not _visible(own) or own_s < 0.98 * seen.shortest_s:
        found = (
            f"at {ms(own_s)} the projector's light is too little for the camera's noise: signal over noise is "
            f"{max(own.snr, 0.0) if _visible(own) else 0.0:.1f}, {USUAL_SNR:.0f} is needed"
        )
        remedy = f"expose longer, open the lens's aperture, or raise the gain; {usable}"
        return fault("exposure.dark", subject, found, remedy)
    if own.bright_dn < _SHORT * own.full_scale and viewer.within(seen.longest_s) > 2 * own_s:
        remedy = f"expose up to {seen.longest_s / own_s:.1f} times longer for less noise; {usable}"
        return note("exposure.short", subject, f"the brightest parts reach {bright} at {ms(own_s)}", remedy)
    found = f"{ms(own_s)} exposes well: signal over noise is {own.snr:.0f}, the brightest parts reach {bright}"
    return ok("exposure.range", subject, f"{found}; {usable}")


def _room(subject: str, seen: Seen) -> Finding:
    share = seen.levels.ambient_dn / seen.levels.contrast_dn
    found = f"a black frame holds {share:.1%} of what the projector's white adds"
    remedy = "shade the room's light; check the camera's black level, and that the projector's black is dark"
    return judged(Severity.NOTE if share > _BRIGHT_ROOM else None, "light.room", subject, found, remedy)
