"""Light of the projector in one camera: exposure, structure of the patterns, and layout of the picture.

Also holds what every part of the examination shares: findings, and the session with one camera.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from enum import StrEnum

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.bundle import RefusedFrame
from slrig.capture import Contradiction, Evidence
from slrig.capture.latency import stable_from_ns
from slrig.devices import Camera, CameraSettings, Projector, Rig, Trigger, UnknownPolarityProjector
from slrig.doctor.measures import (
    MIN_SNR,
    LightLevels,
    Orientation,
    angle_between_deg,
    expected_orientation,
    fit_orientation,
    light_levels,
)
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import (
    Axis,
    Black,
    Calibration,
    FloatArray,
    Frame,
    Gray,
    Pattern,
    PatternSequence,
    Shot,
    White,
    gray_index,
)
from slrig.patterns import cell_centre_px

_NS = 1e9
_TRIES = 3
_MAX_FRAME_S = 2.0  # that a frame may take beyond its exposure

_FRAMES = 4
_MIN_LIT_SHARE = 0.01
_LOW_LIT_SHARE = 0.05
_DARK_SHARE = 0.05
_DIM = 0.3
_BLOCK_PX = 8
_STRUCTURE_BITS = (1, 2)
_MIN_STRUCTURE = 0.6
_MAX_SEARCH_EXPOSURE_S = 1.0
_SEARCH_FACTOR = 8.0
_MAX_EXPOSURES_TRIED = 8
_MIN_GROWTH = 1.02  # of the brightness by an exposure that is longer
_WELL_EXPOSED = (0.45, 0.97)
_NOTE_SATURATED_SHARE, _FAULT_SATURATED_SHARE = 0.01, 0.05
_SHORT_EXPOSURE_SHARE = 0.25
_MAX_AMBIENT_SHARE = 0.5

_COARSE_BITS = 6
MIN_CODE_SHARE = 0.25
MIN_CODE_SNR = 5.0
_MAX_TURN_DEG = 60.0
_MIN_CAMERA_PX = 0.5
_MIN_PROJECTOR_SHARE = 0.1

_CURRENT_SHARES = (0.4, 0.6)
_CURRENT_FRAMES = 8
_MIN_CURRENT_RATIO = 1.2
"""Half the change from 0.4 to 0.6, and more than the change if an exposure cuts pulses."""


# ---- Findings


class Severity(StrEnum):
    """Importance of a finding. Scans may be right in spite of a note; with a fault they are not."""

    OK = "ok"
    NOTE = "note"
    FAULT = "fault"


@dataclass(frozen=True, slots=True)
class Finding:
    """One result of an examination.

    name : for programs, such as `exposure.saturated`. subject : such as `camera 'left'`. found : the measurement in
    words and numbers. remedy : what to do; empty if nothing has to be done.
    """

    name: str
    subject: str
    severity: Severity
    found: str
    remedy: str = ""

    def __post_init__(self) -> None:
        if (self.severity is Severity.OK) == bool(self.remedy):
            message = f"finding {self.name}: a remedy belongs to every note and fault, and to nothing else"
            raise ValueError(message)


def ok(name: str, subject: str, found: str) -> Finding:
    """Return a finding that needs no action."""
    return Finding(name, subject, Severity.OK, found)


def note(name: str, subject: str, found: str, remedy: str) -> Finding:
    """Return a finding that is worth knowing or improving."""
    return Finding(name, subject, Severity.NOTE, found, remedy)


def fault(name: str, subject: str, found: str, remedy: str) -> Finding:
    """Return a finding that spoils scans."""
    return Finding(name, subject, Severity.FAULT, found, remedy)


def camera_label(name: str) -> str:
    """Name a camera in messages.

    >>> camera_label("left")
    "camera 'left'"
    """
    return f"camera '{name}'"


def format_ms(seconds: float) -> str:
    """Format a time in milliseconds, to three digits.

    >>> format_ms(0.0166667), format_ms(0.4), format_ms(0.00005)
    ('16.7 ms', '400 ms', '0.05 ms')
    """
    value = seconds * 1e3
    return f"{value:.0f} ms" if abs(value) >= 100 else f"{value:.3g} ms"


# ---- Session with one camera


class CameraSession:
    """Shows patterns, and takes frames of them with one camera of an open rig. For use by one thread.

    It waits for the rig's synchronisation, if there is one. wait_s : additional wait for each pattern while the latency
    is not measured. Raises UnsupportedByDeviceError if the camera can be triggered by wire only.
    """

    def __init__(self, rig: Rig, name: str, *, wait_s: float = 0.0) -> None:
        self.rig = rig
        self.name = name
        self.exposure_s = rig.settings[name].exposure_s
        self._wait_ns = round(wait_s * _NS)
        self._never = threading.Event()
        self._range_s = self.camera.info.exposure_range_s
        offered = self.camera.info.triggers
        possible = [trigger for trigger in (Trigger.SOFTWARE, Trigger.FREE) if trigger in offered]
        if not possible:
            message = (
                f"camera '{name}' can be triggered by wire only ({', '.join(sorted(offered)) or 'no trigger at all'}); "
                "the examination needs a software trigger or a free-running camera"
            )
            raise UnsupportedByDeviceError(message)
        self.trigger = possible[0]

    @property
    def camera(self) -> Camera:
        """The camera."""
        return self.rig.cameras[self.name]

    @property
    def projector(self) -> Projector:
        """The projector."""
        return self.rig.projector

    def clamp_exposure_s(self, exposure_s: float) -> float:
        """Return the nearest exposure in the range that the camera declares, as far as it was not found out to end."""
        min_s, max_s = self._range_s
        return min(max(exposure_s, min_s), max_s)

    def limit_exposure(self, good_s: float, refused_s: float) -> None:
        """Take note that the camera refused an exposure of its declared range, and took another one."""
        min_s, max_s = self._range_s
        self._range_s = (min_s, good_s) if refused_s > good_s else (good_s, max_s)

    @contextmanager
    def arm(self, sequence: PatternSequence | None, exposure_s: float, frames: int) -> Iterator[None]:
        """Load a sequence and arm the camera within the block; afterwards the projector is dark, the camera disarmed.

        `self.exposure_s` is then the exposure in use. Without a sequence, the one loaded last stays.
        """
        camera = self.camera
        camera.disarm()
        gain = self.rig.settings[self.name].gain
        self.exposure_s = camera.configure(CameraSettings(self.clamp_exposure_s(exposure_s), gain)).exposure_s
        if sequence is not None:
            self.projector.load(sequence)
        camera.arm(_TRIES * frames, self.trigger)
        try:
            yield
        finally:
            # Darkness first. The error that ended the block matters more than a device that does not answer.
            with suppress(Exception):
                self.projector.blank()
            with suppress(Exception):
                camera.disarm()

    def capture_frames(self, index: int, count: int = 1) -> list[Frame]:
        """Show a pattern and return frames of its light alone."""
        after_ns = self.show(index)
        return [self.next_frame(after_ns) for _ in range(count)]

    def show(self, index: int) -> int:
        """Show a pattern, wait for its light, and return the instant from which it is the only one, ns."""
        stable_ns = stable_from_ns(self.projector.show(index), self.rig.synchronisation) + self._wait_ns
        self.rig.clock.wait_until(stable_ns, self._never)
        return stable_ns

    def wait(self, seconds: float) -> None:
        """Wait on the rig's clock."""
        self.rig.clock.wait_until(self.rig.clock.now_ns() + round(seconds * _NS), self._never)

    def next_frame(self, after_ns: int) -> Frame:
        """Return the next frame that begins after an instant; a lost frame is taken again."""
        for attempt in range(_TRIES):
            if self.trigger is Trigger.SOFTWARE:
                self.camera.trigger()
            try:
                return self.camera.read(after_ns, _MAX_FRAME_S + self.exposure_s)
            except FrameTimeoutError:
                if attempt == _TRIES - 1:
                    raise
        raise AssertionError


# ---- White and black


@dataclass(frozen=True, slots=True)
class LightMeasurement:
    """Light of the projector as one camera measures it.

    own_levels : at the rig's own exposure, own_exposure_s. levels : at exposure_s, which suits the light.
    shortest_s, longest_s : limits of the exposure by noise and by saturation. skew_s : of the shutter, and
    stamp_error_s : of the time stamps, both as the driver states them. taken_s : the longest exposure that the camera
    takes, whatever it declares.
    """

    name: str
    own_exposure_s: float
    own_levels: LightLevels
    exposure_s: float
    levels: LightLevels
    shortest_s: float
    longest_s: float
    skew_s: float
    stamp_error_s: float = 0.0
    taken_s: float = math.inf

    def limited(self, taken_s: float) -> LightMeasurement:
        """Return the measurement of a camera that took no longer exposure than this."""
        exposure_s = min(self.exposure_s, taken_s)
        return replace(
            self,
            exposure_s=exposure_s,
            shortest_s=_shortest_s((self.own_exposure_s, self.own_levels), (exposure_s, self.levels)),
            longest_s=self.levels.longest_exposure_s(exposure_s),
            taken_s=taken_s,
        )


def measure_light(
    session: CameraSession, sequence: PatternSequence, *, displays: str
) -> tuple[LightMeasurement | None, list[Finding]]:
    """Measure white and black at a suitable exposure, and check that the camera sees the patterns' structure.
    Returns the measurement, None if the camera does not see the projector, and the findings.

    sequence : with white, black, and Gray patterns with their inverses. displays : sentence about the displays that
    were found, for remedies.
    """
    subject = camera_label(session.name)
    own_s = session.clamp_exposure_s(session.rig.settings[session.name].exposure_s)
    own_levels, frame = _measure_levels(session, sequence, own_s)
    own_s = session.exposure_s
    exposure_s, levels = own_s, own_levels
    for _ in range(_MAX_EXPOSURES_TRIED):
        next_s = session.clamp_exposure_s(_next_exposure_s(exposure_s, levels))
        is_dark_to_the_end = not _is_visible(levels) and next_s > max(_MAX_SEARCH_EXPOSURE_S, own_s)
        if abs(next_s / exposure_s - 1) < 0.02 or is_dark_to_the_end:
            break
        before = levels
        try:
            levels, frame = _measure_levels(session, sequence, next_s)
        except UnsupportedByDeviceError:
            # A declared range is a bound: between this exposure and the last one is where it ends.
            session.limit_exposure(exposure_s, next_s)
            break
        is_brighter = levels.bright_dn >= _MIN_GROWTH * before.bright_dn
        if session.exposure_s > exposure_s and _is_visible(before) and not is_brighter:
            # It takes no longer one, whatever its driver answers.
            levels = before
            break
        exposure_s = session.exposure_s
    if not _is_visible(levels):
        return None, [_explain_missing_light(subject, own_levels, levels, own_s, displays)]
    if _pattern_structure(session, sequence, exposure_s, levels) < _MIN_STRUCTURE:
        message = (
            f"{subject} sees light come and go with the patterns ({levels.contrast_dn:.0f} DN), but none of their "
            "structure: it is the glow of another display, and the projector shows something else or nothing"
        )
        remedy = (
            "the patterns go to the wrong output: name the projector's connector in the rig file, or exchange the "
            f"cables. {displays}"
        )
        return None, [fault("display.other", "projector", message, remedy)]
    light = LightMeasurement(
        name=session.name,
        own_exposure_s=own_s,
        own_levels=own_levels,
        exposure_s=exposure_s,
        levels=levels,
        shortest_s=_shortest_s((own_s, own_levels), (exposure_s, levels)),
        longest_s=levels.longest_exposure_s(exposure_s),
        skew_s=frame.shutter_skew_s,
        stamp_error_s=frame.t_err_ns / 1e9,
    )
    findings = [
        _check_lit_share(subject, light),
        _check_exposure(subject, light, session),
        _check_ambient_light(subject, light),
    ]
    return light, findings


def remeasure_light(
    session: CameraSession, sequence: PatternSequence, light: LightMeasurement, exposure_s: float
) -> LightMeasurement:
    """Measure again with another exposure, for the checks that follow."""
    levels, _ = _measure_levels(session, sequence, exposure_s)
    return replace(light, exposure_s=session.exposure_s, levels=levels)


def _measure_levels(session: CameraSession, sequence: PatternSequence, exposure_s: float) -> tuple[LightLevels, Frame]:
    """Return the levels of white and black, and one of the white frames."""
    patterns = sequence.patterns
    with session.arm(sequence, exposure_s, 2 * _FRAMES):
        white = session.capture_frames(patterns.index(White()), _FRAMES)
        black = session.capture_frames(patterns.index(Black()), _FRAMES)
    full_scale = session.camera.info.format.full_scale
    levels = light_levels([f.image for f in white], [f.image for f in black], full_scale=full_scale)
    return levels, white[0]


def _is_visible(levels: LightLevels) -> bool:
    return levels.lit_share >= _MIN_LIT_SHARE


def _shortest_s(*looks: tuple[float, LightLevels]) -> float:
    """Shortest exposure with MIN_SNR, s, by looks at several exposures: each that shows the light is an upper limit."""
    return min(levels.shortest_exposure_s(exposure_s) for exposure_s, levels in looks if _is_visible(levels))


def _next_exposure_s(exposure_s: float, levels: LightLevels) -> float:
    """Return the exposure to try next; the same if it is good."""
    low, high = _WELL_EXPOSED
    if levels.saturated_share > 0.005 or levels.black_saturated_share > 0.02:
        return exposure_s / 4
    if not _is_visible(levels):
        return exposure_s * (_SEARCH_FACTOR if levels.bright_dn < _DIM * levels.full_scale else 1.0)
    if low * levels.full_scale <= levels.bright_dn <= high * levels.full_scale:
        return exposure_s
    return exposure_s * min(0.8 * levels.full_scale / max(levels.bright_dn, 1.0), _SEARCH_FACTOR)


def _pattern_structure(
    session: CameraSession, sequence: PatternSequence, exposure_s: float, levels: LightLevels
) -> float:
    """Return the contrast of coarse bits and their inverses over white − black: median of the lit part of the image.

    Glow reaches a third at most with these bits, however wide the projector is: it follows their mean alone.
    """
    patterns = sequence.patterns
    coarse = [p for p in patterns if isinstance(p, Gray) and p.bit in _STRUCTURE_BITS and not p.inverted]
    shares = []
    with session.arm(sequence, exposure_s, 2 * len(coarse)):
        for bit in coarse:
            inverse = Gray(bit.axis, bit.bit, bit.bits, bit.cell_px, bit.offset_px, inverted=True)
            pair = [session.capture_frames(patterns.index(each))[0].image.astype(np.float64) for each in (bit, inverse)]
            difference, contrast = (_block_means(each * levels.lit) for each in (pair[0] - pair[1], levels.contrast))
            lit = contrast > 0.5 * np.median(contrast[contrast > 0])
            shares.append(float(np.median(np.abs(difference[lit]) / contrast[lit])))
    return max(shares)


def _block_means(image: FloatArray) -> FloatArray:
    """Return means over squares of the image: coarse bits are even within them, and noise is lower."""
    height, width = image.shape
    size = (max(width // _BLOCK_PX, 1), max(height // _BLOCK_PX, 1))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.float64)


def _explain_missing_light(
    subject: str, own: LightLevels, levels: LightLevels, exposure_s: float, displays: str
) -> Finding:
    """Return the reason why the camera does not see the projector's light."""
    darker = float(np.mean(own.contrast < -max(2.0, 0.05 * own.full_scale)))
    means = f"white {own.white.mean():.1f} DN, black {own.black.mean():.1f} DN of {own.full_scale}"
    if darker >= _MIN_LIT_SHARE:
        message = f"{subject} sees white darker than black on {darker:.0%} of its image ({means})"
        remedy = (
            "set the projector's picture to normal, not inverted, polarity; if it is normal, check with slrig latency "
            "whether its light comes later than it states"
        )
        return fault("display.inverted", "projector", message, remedy)
    if levels.black_saturated_share > 0.5:
        message = (
            f"even black frames are saturated on {levels.black_saturated_share:.0%} of the image, at the shortest "
            "exposure that was tried"
        )
        remedy = "shade the room's light, close the lens's aperture, or lower the gain"
        return fault("exposure.ambient", subject, message, remedy)
    if own.bright_dn <= _DARK_SHARE * own.full_scale:
        message = (
            f"white and black frames are both dark at {format_ms(exposure_s)} ({means}), and do not differ at longer "
            "exposures"
        )
        remedy = (
            "switch the projector's lamp on and choose its input; take the lens caps off; turn the camera to the area "
            f"that the projector lights. {displays}"
        )
        return fault("light.none", subject, message, remedy)
    message = (
        f"{subject} sees a bright picture that does not change with the patterns ({means}): its light is not from "
        "slrig's patterns"
    )
    remedy = (
        "if the projector shows a desktop or another source, the patterns go to another display: name the "
        "projector's connector in the rig file, or exchange the cables, or choose its other input. Cover the "
        f"projector's lens to be sure: if nothing changes, its lamp is off, and this is the room's light. {displays}"
    )
    return fault("display.other", "projector", message, remedy)


def _check_lit_share(subject: str, light: LightMeasurement) -> Finding:
    (top, bottom, left, right), share = light.levels.lit_box, light.levels.lit_share
    message = f"the projector lights {share:.0%} of the image, rows {top} to {bottom} and columns {left} to {right}"
    if share >= _LOW_LIT_SHARE:
        return ok("light.part", subject, message)
    remedy = "aim camera and projector at the same place; clear the view of both lenses"
    return note("light.part", subject, message, remedy)


def _check_exposure(subject: str, light: LightMeasurement, session: CameraSession) -> Finding:
    own, own_s = light.own_levels, light.own_exposure_s
    usable = f"usable exposures are {format_ms(min(light.shortest_s, light.longest_s))} to {format_ms(light.longest_s)}"
    bright = f"{own.bright_dn / own.full_scale:.0%} of full scale"
    if own.black_saturated_share > _NOTE_SATURATED_SHARE:
        message = f"black frames are saturated on {own.black_saturated_share:.1%} of the image at {format_ms(own_s)}"
        return fault("exposure.ambient", subject, message, f"shade the room's light, or expose shorter: {usable}")
    if own.saturated_share > _NOTE_SATURATED_SHARE:
        kind = fault if own.saturated_share > _FAULT_SATURATED_SHARE else note
        message = f"white is saturated on {own.saturated_share:.1%} of the projector's light, at {format_ms(own_s)}"
        remedy = (
            f"expose for {format_ms(light.longest_s)} at most, close the lens's aperture or lower the gain; {usable}. "
            "If only glints are saturated, take several exposures per pattern"
        )
        return kind("exposure.saturated", subject, message, remedy)
    if light.shortest_s > light.longest_s:
        message = (
            f"noise is {light.levels.noise_dn:.1f} DN where white less black is {light.levels.contrast_dn:.1f} DN, "
            f"at the longest exposure that does not saturate ({format_ms(light.longest_s)})"
        )
        remedy = (
            "shade the room's light, open the lens's aperture, bring the projector nearer, or lower the gain and "
            "expose longer"
        )
        return fault("exposure.noise", subject, message, remedy)
    if not _is_visible(own) or own_s < 0.98 * light.shortest_s:
        message = (
            f"at {format_ms(own_s)} the projector's light is too weak for the camera's noise: signal over noise is "
            f"{max(own.snr, 0.0) if _is_visible(own) else 0.0:.1f}, {MIN_SNR:.0f} is needed"
        )
        remedy = f"expose longer, open the lens's aperture, or raise the gain; {usable}"
        return fault("exposure.dark", subject, message, remedy)
    is_short = own.bright_dn < _SHORT_EXPOSURE_SHARE * own.full_scale
    if is_short and session.clamp_exposure_s(light.longest_s) > 2 * own_s:
        remedy = f"expose up to {light.longest_s / own_s:.1f} times longer for less noise; {usable}"
        return note("exposure.short", subject, f"the brightest parts reach {bright} at {format_ms(own_s)}", remedy)
    message = f"{format_ms(own_s)} exposes well: signal over noise is {own.snr:.0f}, the brightest parts reach {bright}"
    return ok("exposure.range", subject, f"{message}; {usable}")


def _check_ambient_light(subject: str, light: LightMeasurement) -> Finding:
    share = light.levels.ambient_dn / light.levels.contrast_dn
    message = f"a black frame holds {share:.1%} of the light that the projector's white adds"
    if share <= _MAX_AMBIENT_SHARE:
        return ok("light.room", subject, message)
    remedy = "shade the room's light; check the camera's black level, and that the projector's black is dark"
    return note("light.room", subject, message, remedy)


# ---- Layout of the picture


@dataclass(frozen=True, slots=True)
class BitDifference:
    """One Gray bit less its inverse, (H, W) float32, DN."""

    pattern: Gray
    difference: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class LocatedPicture:
    """The projector's picture in a camera's image.

    bars : every Gray bit with its inverse. position_px : for each axis that the patterns encode, (H, W) float64, the
    centre of a coarse cell; cell_px : width of these cells. known : (H, W) bool, pixels whose coarse bits are all
    certain.
    """

    bars: tuple[BitDifference, ...]
    position_px: Mapping[Axis, FloatArray]
    cell_px: Mapping[Axis, int]
    known: NDArray[np.bool_]
    orientation: Orientation | None


def locate_picture(
    session: CameraSession, sequence: PatternSequence, light: LightMeasurement, calibration: Calibration | None
) -> tuple[LocatedPicture, list[Finding]]:
    """Show every pattern once, and decode the position of the projector's picture in the camera's image."""
    bars, verified = _capture_bits(session, sequence, light)
    position_px: dict[Axis, FloatArray] = {}
    cell_px: dict[Axis, int] = {}
    known = light.levels.usable.copy()
    for axis in Axis:
        coarse = sorted((each for each in bars if each.pattern.axis is axis), key=lambda each: each.pattern.bit)
        coarse = coarse[:_COARSE_BITS]
        if not coarse:
            continue
        first = coarse[0].pattern
        cell_px[axis] = first.cell_px * 2 ** (first.bits - len(coarse))
        index = gray_index(np.stack([each.difference > 0 for each in coarse]))
        position_px[axis] = cell_centre_px(index, cell_px=cell_px[axis], offset_px=first.offset_px)
        threshold = np.maximum(MIN_CODE_SHARE * light.levels.contrast, MIN_CODE_SNR * light.levels.noise_dn)
        for each in coarse:
            known &= np.abs(each.difference) > threshold
    orientation = None
    if len(position_px) == len(Axis):
        orientation = fit_orientation(position_px[Axis.COLUMN], position_px[Axis.ROW], known)
    picture = LocatedPicture(bars, position_px, cell_px, known, orientation)
    return picture, [verified, *_check_orientation(session, sequence, picture, calibration)]


def _capture_bits(
    session: CameraSession, sequence: PatternSequence, light: LightMeasurement
) -> tuple[tuple[BitDifference, ...], Finding]:
    """Return every Gray bit less its inverse, and whether the frames show the patterns that were requested."""
    patterns = sequence.patterns
    evidence = Evidence(patterns, {session.name: session.camera.info.format})
    bars: dict[Gray, BitDifference] = {}
    with session.arm(sequence, light.exposure_s, 2 * len(sequence)):
        found = _shoot_bits(session, patterns, range(len(patterns)), evidence, bars)
        if found:
            # A picture that missed its refresh is no fault of the rig: a scan shoots its frame again, too.
            suspects = {patterns[each] for one in found for each in (*one.suspects, *one.further_suspects)}
            suspects |= {each.inverse for each in suspects if isinstance(each, Gray)}
            again = [index for index, each in enumerate(patterns) if each in suspects]
            again = sorted({*again, *evidence.retract(session.name, again)})
            for each in again:
                evidence.record_refused(RefusedFrame(each, session.name, 1, found[0].cause, delivered=True))
            found = _shoot_bits(session, patterns, again, evidence, bars)
    subject = camera_label(session.name)
    if not found:
        message = f"{evidence.summary()}: it sees our patterns in their order"
        return tuple(bars.values()), ok("patterns.verified", subject, message)
    message = (
        f"frames contradict one another, those that were shot again, too ({len(again)} of {len(patterns)}); the first "
        f"of them: {found[0]}"
    )
    remedy = "correct the other findings, and run the doctor again; slrig conform finds faults of drivers"
    return tuple(bars.values()), fault("patterns.contradicted", subject, message, remedy)


def _shoot_bits(
    session: CameraSession,
    patterns: Sequence[Pattern],
    indices: Iterable[int],
    evidence: Evidence,
    bars: dict[Gray, BitDifference],
) -> list[Contradiction]:
    """Shoot some patterns, each bit with its inverse, into `evidence` and `bars`; return what contradicts."""
    found: list[Contradiction] = []
    waiting: dict[Gray, NDArray[np.float32]] = {}
    for index in indices:
        pattern = patterns[index]
        image = session.capture_frames(index)[0].image
        found += evidence.add_shot(Shot(index, session.name, image))
        if not isinstance(pattern, Gray):
            continue
        positive = replace(pattern, inverted=False)
        other = waiting.pop(positive, None)
        if other is None:
            waiting[positive] = image.astype(np.float32)
        else:
            difference = image.astype(np.float32) - other
            bars[positive] = BitDifference(positive, -difference if pattern.inverted else difference)
    return found


def _check_orientation(
    session: CameraSession, sequence: PatternSequence, picture: LocatedPicture, calibration: Calibration | None
) -> Iterator[Finding]:
    subject, orientation = camera_label(session.name), picture.orientation
    if orientation is None:
        is_one_axis = len(picture.position_px) < len(Axis)
        cause = "its patterns encode one axis only" if is_one_axis else "too few codes can be read"
        yield ok("picture.unmeasured", subject, f"the layout of the picture in the image is unknown: {cause}")
        return
    expected = None
    if calibration is not None and calibration.projector is not None and session.name in calibration.cameras:
        expected = expected_orientation(calibration.cameras[session.name], calibration.projector)
    turn_deg = 0.0 if expected is None else angle_between_deg(orientation, expected)
    if orientation.is_mirrored:
        # Relative to the calibration or, without one, to an upright picture.
        relative = orientation.jacobian if expected is None else orientation.jacobian @ np.linalg.inv(expected.jacobian)
        way = "left and right" if relative[0, 0] < relative[1, 1] else "top and bottom"
        message = f"{subject} sees its picture mirrored, {way} exchanged: no calibration can describe that"
        remedy = (
            "set the projector's menu to front projection (rear projection and ceiling mount each mirror the picture). "
            "If light does pass through a screen or over one mirror, choose the setting that compensates it. If the "
            "camera's driver flips its image, switch that off"
        )
        yield fault("picture.mirrored", "projector", message, remedy)
        return
    if turn_deg > _MAX_TURN_DEG:
        message = f"{subject} sees its picture turned by {turn_deg:.0f}° against the calibration"
        remedy = (
            "set the projector's menu to the projection that it was calibrated with (upright, not ceiling mount; "
            "on a computer's output: rotation normal), or turn the camera's image back in its driver's options, "
            "or calibrate again"
        )
        yield fault("picture.turned", "projector", message, remedy)
        return
    against = "" if expected is None else f", {turn_deg:.0f}° from the calibration"
    message = (
        f"the projector's picture is not mirrored, and turned by {orientation.turn_deg:.0f}° in the image{against}; "
        f"one of its pixels is {orientation.camera_px:.2f} camera pixels long"
    )
    yield ok("picture.upright", subject, message)
    yield _check_coverage(subject, sequence, picture)
    if orientation.camera_px < _MIN_CAMERA_PX:
        message = f"one projector pixel is only {orientation.camera_px:.2f} camera pixels long: it loses fine patterns"
        remedy = (
            "bring the camera nearer or give it a longer lens, or choose line_shift_period_px (of the sequence phase: "
            f"sine_period_px) = {int(np.ceil(4 / orientation.camera_px))} or more in [scan]"
        )
        yield note("picture.resolution", subject, message, remedy)


def _check_coverage(subject: str, sequence: PatternSequence, picture: LocatedPicture) -> Finding:
    ranges, share = [], 1.0
    for axis, position_px in picture.position_px.items():
        half_px, last_px = picture.cell_px[axis] / 2, sequence.projector.along(axis) - 1
        low, high = np.percentile(position_px[picture.known], (0.5, 99.5))
        first_px, final_px = max(low - half_px, 0.0), min(high + half_px, last_px)
        ranges.append(f"{axis}s {first_px:.0f} to {final_px:.0f} of {last_px + 1}")
        share *= (final_px - first_px) / last_px
    message = f"it sees the projector's {' and '.join(ranges)}, about {share:.0%} of its pixels"
    if share >= _MIN_PROJECTOR_SHARE:
        return ok("picture.part", subject, message)
    remedy = "use more of the projector: bring it nearer, zoom it, or turn it to the camera's field of view"
    return note("picture.part", subject, message, remedy)


# ---- Direction of the LED current


def find_current_direction(session: CameraSession, sequence: PatternSequence, light: LightMeasurement) -> Finding:
    """Show white at two currents, below and above half of the range, and find which number is brighter.

    sequence : with white. The projector is an `UnknownPolarityProjector`: light may fall as the number for the current
    rises.
    """
    projector = session.projector
    if not isinstance(projector, UnknownPolarityProjector):
        message = f"expected a projector with an unknown direction of its current, found {projector.info.model}"
        raise TypeError(message)
    period_s = projector.light_period_s
    exposure_s = session.clamp_exposure_s(math.ceil(light.exposure_s / period_s) * period_s)
    low, high = (_contrast_at(session, projector, sequence, light, exposure_s, share) for share in _CURRENT_SHARES)
    ratio = high / low if low > 0 else math.nan
    message = (
        f"white is {ratio:.2f} times as bright with its current's number at {_CURRENT_SHARES[1]:.0%} as at "
        f"{_CURRENT_SHARES[0]:.0%}"
    )
    if not (ratio > _MIN_CURRENT_RATIO or 0 < ratio < 1 / _MIN_CURRENT_RATIO):
        remedy = "shade the room's light, see that nothing moves and nothing is saturated, and run the doctor again"
        return fault("light.current", "projector", f"{message}: the direction of the current is not certain", remedy)
    remedy = (
        f"write {projector.polarity_option(rises=ratio > 1)} into the [projector] table of the rig file, choose "
        f"led_current "
        "there, and run the doctor again: it measures the rest then, because until then light is dim and pulses"
    )
    return note("light.current", "projector", message, remedy)


def _contrast_at(
    session: CameraSession,
    projector: UnknownPolarityProjector,
    sequence: PatternSequence,
    light: LightMeasurement,
    exposure_s: float,
    share: float,
) -> float:
    """Return white less black at one current, mean of the lit pixels, DN."""
    with session.arm(sequence, exposure_s, 2 * _CURRENT_FRAMES):
        projector.set_trial_current(share)
        frames = session.capture_frames(sequence.patterns.index(White()), _CURRENT_FRAMES)
        projector.blank()
        dark = [session.next_frame(session.rig.clock.now_ns() + round(1e9 * exposure_s)) for _ in range(2)]
    lit = light.levels.lit
    return float(np.mean([f.image[lit].mean() for f in frames]) - np.mean([f.image[lit].mean() for f in dark]))
