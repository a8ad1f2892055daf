"""Triggered capture: by wire, where frame i shows pattern i, or by software, one pattern at a time.

Only their order assigns the frames of a wire-triggered play to patterns, so a play counts as a whole or not at all: it
needs exactly as many frames as patterns, numbered without a gap, that agree with one another. Otherwise it is repeated.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from slrig.bundle import RefusedFrame
from slrig.capture.frame_checks import Contradiction, describe_frame, describe_pattern
from slrig.capture.latency import shutter_skew_s, stable_from_ns
from slrig.capture.retries import RetryPolicy, describe_causes
from slrig.devices import AppliedSettings, DisplayedPattern, Rig, Trigger
from slrig.errors import FrameTimeoutError, ScanCancelledError, ScanEvidenceError, UnsupportedByDeviceError, of_camera
from slrig.model import Frame, Gray, PatternSequence, Primary, Shot

SETTINGS_TOLERANCE = 0.01
"""Relative tolerance of exposure and gain."""

_LEAST_SHIFT_NS = 500_000
"""A smaller difference of the errors of time stamps is their own: a measured period, or rounding."""

MAX_PLAYS = 3

SLOWER = {2: "second", 3: "third", 4: "fourth"}
"""How many times slower a sequence is played to a camera that takes every so many-th pulse only."""

_MIN_CORRELATION = 0.9  # of brightness, for a shift; few cameras are linear
_MIN_IMPROVEMENT = 0.05  # of the correlation, compared with no shift

_FrameResult = tuple[int, str, Frame | str, str | None]
"""Pattern index, camera, frame or the reason why none came, and the fault of the frame."""


@dataclass(frozen=True, slots=True)
class CaptureSession:
    """Parameters of one capture. applied : settings of the cameras that were configured. timeout_s : time that a frame
    may take beyond its exposure.
    """

    rig: Rig
    sequence: PatternSequence
    applied: Mapping[str, AppliedSettings]
    triggers: Mapping[str, Trigger]
    timeout_s: float
    cancelled: Callable[[], bool]

    def describe_pattern(self, index: int) -> str:
        """Return a description of a pattern."""
        return describe_pattern(index, self.sequence.patterns[index])

    def frame_timeout_s(self, name: str) -> float:
        """Return how long to wait for a frame of a camera."""
        return self.timeout_s + self.applied[name].exposure_s if name in self.applied else self.timeout_s

    def stop_if_cancelled(self, index: int) -> None:
        """Raise ScanCancelledError if the capture was cancelled."""
        if self.cancelled():
            raise ScanCancelledError(
                f"the scan was cancelled at {self.describe_pattern(index)} of {len(self.sequence)}"
            )

    def read(self, name: str, after_ns: int, timeout_s: float) -> Frame:
        """Return the next frame with the camera's name in the rig. Raises as `Camera.read` does."""
        with of_camera(name):
            frame = with_camera_name(name, self.rig.cameras[name].read(after_ns, timeout_s))
            shift_ns = self.stamp_shift_ns(frame)
            after_ns += shift_ns
            if shift_ns and self.triggers[name] is Trigger.FREE and frame.t_start_ns < after_ns + frame.t_err_ns:
                frame = with_camera_name(name, self.rig.cameras[name].read(after_ns, timeout_s))
        return frame

    def arm(self, count: int) -> None:
        """Arm every camera for as many frames. Raises as `Camera.arm` does."""
        for name, camera in self.rig.cameras.items():
            with of_camera(name):
                camera.arm(count, self.triggers[name])

    def stamp_shift_ns(self, frame: Frame) -> int:
        """By how much the offset of a camera's time stamps may differ from that when the latency was measured, ns.

        The offset is some share of the stated error, which depends on what the stamps mean, and which is larger for
        longer exposures. 0 where it is not known what the error was.
        """
        known_s = {} if self.rig.synchronisation is None else self.rig.synchronisation.stamp_error_s
        if frame.camera not in known_s:
            return 0
        shift_ns = abs(frame.t_err_ns - round(known_s[frame.camera] * 1e9))
        return shift_ns if shift_ns > _LEAST_SHIFT_NS else 0

    def frame_fault(self, frame: Frame, after_ns: int, previous: Frame | None) -> str | None:
        """Return a fault if a frame was exposed too early, was delivered before, or has another exposure than
        requested.
        """
        if frame.t_start_ns < after_ns or frame.t_end_ns < frame.t_start_ns:
            return (
                f"the frame was exposed from {frame.t_start_ns} to {frame.t_end_ns} ns (± {frame.t_err_ns} ns), its "
                f"light was stable from {after_ns} ns only: the driver delivered a stale frame; report it to the "
                "driver's maintainer, and use another driver for this camera"
            )
        if previous is not None and frame.sequence_number <= previous.sequence_number:
            return (
                f"frame number {frame.sequence_number} came after number {previous.sequence_number}: a frame was "
                "delivered twice, or the camera restarted; scan again"
            )
        applied = self.applied.get(frame.camera)
        if applied is not None and differs_from_request(frame.exposure_s, applied.exposure_s):
            return (
                f"exposed for {frame.exposure_s:.6g} s, set to {applied.exposure_s:.6g} s: switch off automatic "
                "exposure, and scan again"
            )
        return None


def with_camera_name(name: str, frame: Frame) -> Frame:
    """Return a frame with the camera's name in the rig."""
    return frame if frame.camera == name else replace(frame, camera=name)


def differs_from_request(actual: float, requested: float) -> bool:
    """True if a setting differs from the requested one by more than the tolerance."""
    return abs(actual - requested) > SETTINGS_TOLERANCE * abs(requested)


def capture_by_software(session: CaptureSession, retries: RetryPolicy) -> Iterator[Shot]:
    """Show each pattern, and again if frames fail, until every frame counts. Raises as `RetryPolicy` does."""
    rig = session.rig
    rig.projector.load(session.sequence)
    session.arm(retries.max_exposures)
    ahead = iter(range(len(session.sequence)))
    last: dict[str, Frame] = {}
    waiting: list[_FrameResult] = []
    while True:
        if retries.pending:
            # Failed patterns come first, in order.
            index = min(retries.pending)
            names = retries.pending.pop(index)
        elif (index := next(ahead, -1)) >= 0:
            names = list(rig.cameras)
        elif waiting:
            yield from _submit_frames(retries, waiting)
            waiting = []
            continue
        else:
            return
        session.stop_if_cancelled(index)
        displayed = rig.projector.show(index)
        stable_ns = stable_from_ns(displayed, rig.synchronisation)
        rig.clock.wait_until(stable_ns, threading.Event())
        for name in names:
            retries.start_exposure(name, index)
            if session.triggers[name] is Trigger.SOFTWARE:
                with of_camera(name):
                    rig.cameras[name].trigger()
        # The sensors are exposing: check the previous frames meanwhile.
        yield from _submit_frames(retries, waiting)
        waiting = [_read_frame(session, name, displayed, stable_ns, last) for name in names]


def _submit_frames(retries: RetryPolicy, results: list[_FrameResult]) -> Iterator[Shot]:
    for index, name, frame, fault in results:
        if isinstance(frame, str):
            retries.report_missing(name, index, frame)
        elif (shot := retries.submit(index, frame, fault)) is not None:
            yield shot


def _read_frame(
    session: CaptureSession, name: str, displayed: DisplayedPattern, after_ns: int, last: dict[str, Frame]
) -> _FrameResult:
    session.stop_if_cancelled(displayed.index)
    timeout_s = session.frame_timeout_s(name)
    try:
        frame = session.read(name, after_ns, timeout_s)
    except FrameTimeoutError as error:
        # Rendered and replayed cameras have no cable.
        computed = session.rig.cameras[name].info.limits.computed
        cause = (
            f"no frame came within {timeout_s:.3f} s of its light, visible since {displayed.t_visible_ns} ns "
            f"± {displayed.t_err_ns} ns ({error}); "
            + ("is the machine busy?" if computed else "check the camera's cable, bandwidth and trigger")
        )
        return displayed.index, name, cause, None
    fault = session.frame_fault(frame, after_ns, last.get(name))
    last[name] = frame
    return displayed.index, name, frame, fault


@dataclass(slots=True)
class _Play:
    """One play of the sequence. levels : mean of each frame, by camera. delivered : pattern and camera of each frame
    that was yielded. withheld : frames after the first fault. doubts : frames that differ in light, none of which is
    proven wrong. missing : number of faults that are missing frames. culprits : cameras with a
    fault.
    """

    levels: dict[str, list[float]]
    lit_s: float
    period_s: float
    starts_ns: dict[str, list[int]] = field(default_factory=dict)
    delivered: list[tuple[int, str]] = field(default_factory=list)
    withheld: list[Shot] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    doubts: list[Contradiction] = field(default_factory=list)
    missing: int = 0
    culprits: set[str] = field(default_factory=set)

    def periods_apart(self, camera: str) -> int:
        """How many periods lie between a camera's exposures: 2 to 4 if it misses pulses, as one does whose read-out is
        not over when they come, or whose rolling shutter is slower by wire; else 1.
        """
        apart_ns = np.diff(self.starts_ns.get(camera, ()))
        # A camera that is nearly fast enough misses some pulses only; a disturbed wire, single ones.
        periods = round(float(np.quantile(apart_ns, 0.8)) / (self.period_s * 1e9)) if len(apart_ns) > 1 else 1
        return periods if periods in SLOWER else 1


def capture_by_wire(session: CaptureSession, retries: RetryPolicy) -> Iterator[Shot]:
    """Play the sequence until every frame counts, at most three times.

    Frames are yielded as they come. The frames of a failed play are rejected, and all come again: more slowly if a
    camera missed pulses, because the rate that cameras state is a bound that not all reach by wire. What worked is kept
    in `Rig.paces_s`.
    Raises UnsupportedByDeviceError: a camera has no exposure set, or the pulses do not give it; FrameTimeoutError,
    ScanEvidenceError: the third play failed.
    """
    rig, count = session.rig, len(session.sequence)
    unset = sorted(set(rig.cameras) - set(session.applied))
    if unset:
        raise UnsupportedByDeviceError(
            f"cameras {unset} have no exposure set, and the projector must know how long to show each pattern; "
            "write exposure_s into their tables of the rig file"
        )
    rig.projector.load(session.sequence)
    lit_s, asked_s = play_times_s(session)
    period_s = rig.paces_s.get((lit_s, asked_s), asked_s)
    _require_exposing_pulses(session, lit_s)
    last: dict[str, Frame] = {}
    causes: list[str] = []
    timed_out = 0
    culprits: set[str] = set()
    for number in range(1, MAX_PLAYS + 1):
        # Leave room for one frame too many, which would be a fault.
        session.arm(count + 1)
        play = _Play({name: [] for name in rig.cameras}, lit_s, period_s)
        yield from _read_play(session, retries, play, last)
        rig.projector.stop()
        if len(causes) == MAX_PLAYS - 1:
            # What came alike in each play is how the rig or the scene is.
            alike = retries.evidence.came_alike
            play.doubts = [each for each in play.doubts if not alike(each.camera, each.suspects)]
        play.faults += map(str, play.doubts)
        if not play.faults:
            rig.paces_s[lit_s, asked_s] = period_s
            return
        for camera in rig.cameras.values():
            camera.disarm()
        causes.append(_describe_faults(play, session.sequence))
        timed_out += play.missing == len(play.faults)
        culprits |= {*play.culprits, *(each.camera for each in play.doubts)}
        period_s *= max(map(play.periods_apart, rig.cameras))
        retries.evidence.clear()
        for index, name in play.delivered:
            retries.refuse(RefusedFrame(index, name, number, causes[-1], delivered=True))
        for shot in play.withheld:
            retries.refuse(RefusedFrame(shot.pattern, shot.camera, number, causes[-1], shot))
    message = f"the sequence was played {MAX_PLAYS} times by wire: {describe_causes(causes)}"
    error = FrameTimeoutError(message) if timed_out == len(causes) else ScanEvidenceError(message)
    error.camera = min(culprits) if len(culprits) == 1 else None
    raise error


def _require_exposing_pulses(session: CaptureSession, lit_s: float) -> None:
    """Raise UnsupportedByDeviceError if the pulses would expose a camera for another time than it is set to."""
    projector = session.rig.projector.info
    for name, camera in session.rig.cameras.items():
        if not camera.info.exposed_by_pulse:
            continue
        set_s = session.applied[name].exposure_s
        if not projector.pulses_expose:
            raise UnsupportedByDeviceError(
                f"camera '{name}' exposes for as long as the pulse on its wire lasts, and those of {projector.model} "
                "have a length of their own; use a trigger box with the firmware of this version of slrig"
            )
        if differs_from_request(lit_s, set_s):
            raise UnsupportedByDeviceError(
                f"camera '{name}' exposes for as long as the pulse on its wire lasts, which is {lit_s:.6g} s for this "
                f"rig's cameras together, and its exposure_s is {set_s:.6g} s; write the same exposure_s into each "
                "camera's table, and put no rolling shutter on the same wire"
            )


def play_times_s(session: CaptureSession) -> tuple[float, float]:
    """Return how long each pattern is lit, and the time from one trigger pulse to the next, s.

    The period is the longest of those that the projector, each camera and `trigger_period_s` of the rig file require.
    For a camera that does not state its period, read-out is assumed to take as long as the exposure, unless the rig
    file has `trigger_period_s`.
    """
    rig, applied = session.rig, session.applied
    known = rig.synchronisation
    requested_s = None if known is None else known.trigger_period_s
    exposure_s = max(each.exposure_s for each in applied.values())
    skew_s = max(shutter_skew_s(camera, name, known) for name, camera in rig.cameras.items())
    # The last row of a rolling shutter needs the pattern's light as long as the first.
    lit_s = exposure_s + skew_s
    unknown_s = lit_s + exposure_s if requested_s is None else requested_s
    needed_s = [unknown_s if each.min_period_s is None else each.min_period_s for each in applied.values()]
    projector = rig.projector.info
    return lit_s, max((lit_s + projector.gap_s) / projector.duty, requested_s or 0.0, *needed_s)


def _missing_frame_fault(session: CaptureSession, play: _Play, name: str, index: int, error: FrameTimeoutError) -> str:
    """Describe a frame that did not come."""
    count = len(session.sequence)
    if (periods := play.periods_apart(name)) > 1:
        return (
            f"camera '{name}' gave {index} of {count} frames and took every {SLOWER[periods]} pulse "
            f"only: by wire it cannot expose every {play.period_s:.6g} s; write trigger_period_s = "
            f"{periods * play.period_s:.6g} into [synchronisation] of the rig file, or shorten its "
            "exposure or its region"
        )
    return (
        f"camera '{name}' gave {index} of {count} frames, that of {session.describe_pattern(index)} did not come "
        f"({error}): a trigger pulse was missed; check the trigger cable, and that exposure and read-out fit into "
        f"{play.period_s:.4f} s, or write a longer trigger_period_s into [synchronisation] of the rig file"
    )


def _read_play(session: CaptureSession, retries: RetryPolicy, play: _Play, last: dict[str, Frame]) -> Iterator[Shot]:
    rig, count = session.rig, len(session.sequence)
    lit_s, period_s = play.lit_s, play.period_s
    previous: dict[str, Frame] = {}
    active, faulty = list(rig.cameras), set[str]()
    session.stop_if_cancelled(0)
    rig.projector.play(lit_s, period_s)
    for index in range(count):
        for name in list(active):
            session.stop_if_cancelled(index)
            after_ns = last[name].t_end_ns if name in last else 0
            try:
                frame = session.read(name, after_ns, period_s + session.frame_timeout_s(name))
            except FrameTimeoutError as error:
                play.faults.append(_missing_frame_fault(session, play, name, index, error))
                play.missing += 1
                play.culprits.add(name)
                active.remove(name)
                continue
            play.levels[name].append(float(frame.image.mean()))
            play.starts_ns.setdefault(name, []).append(frame.t_start_ns)
            where = describe_frame(name, index, session.sequence.patterns[index])
            fault = session.frame_fault(frame, after_ns, previous.get(name)) or _numbering_fault(
                frame, previous.get(name)
            )
            last[name] = previous[name] = frame
            shot = retries.make_shot(index, frame)
            if fault is not None:
                if name not in faulty:
                    # Report the first fault only, because lost frames shift all later ones.
                    play.faults.append(f"{where}: {fault}")
                faulty.add(name)
                play.culprits.add(name)
            elif not play.faults:
                # After the first fault, frames are only recorded.
                found = retries.evidence.add_shot(shot)
                proven = [each for each in found if not each.is_doubt]
                play.faults += map(str, proven)
                play.culprits |= {each.camera for each in proven}
                play.doubts += [each for each in found if each.is_doubt]
            if play.faults:
                play.withheld.append(shot)
            else:
                play.delivered.append((index, name))
                yield shot
    for name in active:
        # A frame too many would come within one period.
        with suppress(FrameTimeoutError):
            extra = session.read(name, last[name].t_end_ns, 1.5 * period_s)
            play.levels[name].append(float(extra.image.mean()))
            play.culprits.add(name)
            play.faults.append(
                f"camera '{name}' gave more than the {count} frames of the sequence: something else triggers it; check "
                "the trigger cable and its polarity, and shield it from the projector's other outputs"
            )


def _numbering_fault(frame: Frame, previous: Frame | None) -> str | None:
    skipped = previous is not None and frame.sequence_number != previous.sequence_number + 1
    if not skipped and not frame.dropped_count:
        return None
    return (
        f"frame number {frame.sequence_number} follows {previous.sequence_number if previous is not None else 'none'}, "
        f"{frame.dropped_count} were lost: the patterns of the frames are unknown; lower the camera's load or lengthen "
        "the exposure, and scan again"
    )


def _describe_faults(play: _Play, sequence: PatternSequence) -> str:
    """Describe the faults of a play. A shift of all frames, visible in their brightness, explains all other faults."""
    shifts = {name: frame_shift(levels, sequence) for name, levels in play.levels.items()}
    descriptions = [
        f"the frames of camera '{name}' are shifted by one: its frame 0 shows pattern 1. It missed the first trigger "
        "pulse; let the projector wait longer before its first pattern, or arm the camera earlier"
        if shift == 1
        else f"the frames of camera '{name}' are shifted by one: its frame 1 shows pattern 0. It was triggered once "
        "before the first pattern; check the polarity and the idle level of the trigger output"
        for name, shift in shifts.items()
        if shift
    ]
    return "; ".join([*descriptions, *dict.fromkeys(play.faults)])


def frame_shift(levels: Sequence[float], sequence: PatternSequence) -> int:
    """Return by how many patterns the frames of a play are ahead of their numbers: 1, 0 or -1; 0 if unknown.

    levels : mean of each frame. They are correlated with white, black and line frames, whose brightness does not depend
    on the part of the pattern that a camera sees.
    """
    expected = np.array([profile.mean() for profile in sequence.profiles])
    usable = np.array([not isinstance(pattern, Gray | Primary) for pattern in sequence.patterns])
    correlation: dict[int, float] = {}
    for shift in (0, 1, -1):
        frames, pattern_levels = np.asarray(levels[max(-shift, 0) :]), expected[max(shift, 0) :]
        length = min(len(frames), len(pattern_levels))
        mask = usable[max(shift, 0) :][:length]
        frames, pattern_levels = frames[:length][mask], pattern_levels[:length][mask]
        is_defined = len(frames) > 2 and np.ptp(frames) > 0 and np.ptp(pattern_levels) > 0
        correlation[shift] = float(np.corrcoef(frames, pattern_levels)[0, 1]) if is_defined else 0.0
    best = max(correlation, key=lambda shift: correlation[shift])
    return best if correlation[best] > _MIN_CORRELATION and correlation[best] > correlation[0] + _MIN_IMPROVEMENT else 0
