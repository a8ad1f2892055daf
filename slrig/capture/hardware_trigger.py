"""Triggered capture: by wire, where frame i shows pattern i, or by software, one pattern at a time.

Nothing but their order tells such frames apart, so a play counts as a whole or not at all: exactly as many frames as
patterns, numbered without a gap, that agree with one another. One that does not is played again.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slrig.bundle import RefusedFrame
from slrig.capture.frame_checks import named, place
from slrig.capture.latency import shutter_skew_s, stable_from_ns
from slrig.capture.verifier import RetryPolicy, in_words
from slrig.devices import AppliedSettings, Rig, Shown, Trigger
from slrig.errors import FrameTimeoutError, ScanCancelledError, ScanEvidenceError, UnsupportedByDeviceError
from slrig.model import Frame, Gray, PatternSequence, Primary, Shot

SETTINGS_TOLERANCE = 0.01
"""How far a camera's exposure and gain may be from what was asked, as a fraction."""


@dataclass(frozen=True, slots=True)
class Session:
    """One capture. `applied` has the cameras that were set; `timeout_s` is how long a frame may take beyond that."""

    rig: Rig
    sequence: PatternSequence
    applied: Mapping[str, AppliedSettings]
    triggers: Mapping[str, Trigger]
    timeout_s: float
    cancelled: Callable[[], bool]

    def pattern(self, index: int) -> str:
        """Words for a pattern."""
        return named(index, self.sequence.patterns[index])

    def patience_s(self, name: str) -> float:
        """How long to wait for a frame of this camera."""
        return self.timeout_s + self.applied[name].exposure_s if name in self.applied else self.timeout_s

    def stop_if_cancelled(self, index: int) -> None:
        """Raise ScanCancelledError if somebody asked for it."""
        if self.cancelled():
            raise ScanCancelledError(f"the scan was cancelled at {self.pattern(index)} of {len(self.sequence)}")

    def settled_ns(self, shown: Shown) -> int:
        """Wait until a pattern's light is the only one, and return since when it is."""
        stable_ns = stable_from_ns(shown, self.rig.synchronisation)
        self.rig.clock.wait_until(stable_ns, threading.Event())
        return stable_ns

    def read(self, name: str, after_ns: int, timeout_s: float) -> Frame:
        """Return the next frame under the name that the rig gives its camera. Raises as `Camera.read` does."""
        return under_name(name, self.rig.cameras[name].read(after_ns, timeout_s))

    def own_fault(self, frame: Frame, after_ns: int, before: Frame | None) -> str | None:
        """Say why a frame was exposed too early, was delivered before, or was exposed otherwise than asked."""
        if frame.t_start_ns < after_ns or frame.t_end_ns < frame.t_start_ns:
            return (
                f"the frame was exposed from {frame.t_start_ns} to {frame.t_end_ns} ns (± {frame.t_err_ns} ns), its "
                f"light was stable from {after_ns} ns only: the driver delivered a stale frame; report it to the "
                "driver's maintainer, and use another driver for this camera"
            )
        if before is not None and frame.sequence_number <= before.sequence_number:
            return (
                f"frame number {frame.sequence_number} came after number {before.sequence_number}: a frame was "
                "delivered twice, or the camera restarted; scan again"
            )
        asked = self.applied.get(frame.camera)
        if asked is not None and differ(frame.exposure_s, asked.exposure_s):
            return (
                f"exposed for {frame.exposure_s:.6g} s, set to {asked.exposure_s:.6g} s: switch off automatic "
                "exposure, and scan again"
            )
        return None


def under_name(name: str, frame: Frame) -> Frame:
    """A frame under the name that the rig gives its camera."""
    return frame if frame.camera == name else replace(frame, camera=name)


def differ(got: float, asked: float) -> bool:
    """Whether a setting is not what was asked."""
    return abs(got - asked) > SETTINGS_TOLERANCE * abs(asked)


_Taken = tuple[int, str, Frame | str, str | None]
"""Pattern and camera, what it gave or why nothing came in time, and what the frame says against itself."""


def software_triggered(session: Session, retries: RetryPolicy) -> Iterator[Shot]:
    """Show each pattern, and again where frames failed, until every frame counts. Raises as `RetryPolicy` does."""
    rig = session.rig
    rig.projector.load(session.sequence)
    for name, camera in rig.cameras.items():
        camera.arm(retries.most_shots, session.triggers[name])
    ahead = iter(range(len(session.sequence)))
    last: dict[str, Frame] = {}
    waiting: list[_Taken] = []
    while True:
        if retries.again:
            # First what failed, in order.
            index = min(retries.again)
            names = retries.again.pop(index)
        elif (index := next(ahead, -1)) >= 0:
            names = list(rig.cameras)
        elif waiting:
            yield from _judged(retries, waiting)
            waiting = []
            continue
        else:
            return
        session.stop_if_cancelled(index)
        shown = rig.projector.show(index)
        stable_ns = session.settled_ns(shown)
        for name in names:
            retries.begin(name, index)
            if session.triggers[name] is Trigger.SOFTWARE:
                rig.cameras[name].trigger()
        # The sensors are at work now: there is time for the frames before.
        yield from _judged(retries, waiting)
        waiting = [_taken(session, name, shown, stable_ns, last) for name in names]


def _judged(retries: RetryPolicy, taken: list[_Taken]) -> Iterator[Shot]:
    for index, name, frame, fault in taken:
        if isinstance(frame, str):
            retries.missed(name, index, frame)
        elif (shot := retries.took(index, frame, fault)) is not None:
            yield shot


def _taken(session: Session, name: str, shown: Shown, after_ns: int, last: dict[str, Frame]) -> _Taken:
    session.stop_if_cancelled(shown.index)
    timeout_s = session.patience_s(name)
    try:
        frame = session.read(name, after_ns, timeout_s)
    except FrameTimeoutError as error:
        # Frames that are rendered or replayed have no cable.
        computed = session.rig.cameras[name].info.limits.computed
        cause = (
            f"no frame came within {timeout_s:.3f} s of its light, visible since {shown.t_visible_ns} ns "
            f"± {shown.t_err_ns} ns ({error}); "
            + ("is the machine busy?" if computed else "check the camera's cable, bandwidth and trigger")
        )
        return shown.index, name, cause, None
    fault = session.own_fault(frame, after_ns, last.get(name))
    last[name] = frame
    return shown.index, name, frame, fault


MOST_PLAYS = 3

_ALIKE = 0.9  # correlation of brightness that tells a shift: few cameras are linear
_BETTER = 0.05  # than without a shift


@dataclass(slots=True)
class _Play:
    """One play: what was delivered of it, each camera's frames by their brightness, and what is wrong with it."""

    levels: dict[str, list[float]]
    lit_s: float
    period_s: float
    starts_ns: dict[str, list[int]] = field(default_factory=dict)
    delivered: list[tuple[int, str]] = field(default_factory=list)
    withheld: list[Shot] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    missing: int = 0

    def halved(self, camera: str) -> bool:
        """Whether a camera took every second pulse only: its exposures begin two periods apart."""
        apart_ns = np.diff(self.starts_ns.get(camera, ()))
        return len(apart_ns) > 1 and 1.5 < float(np.median(apart_ns)) / (self.period_s * 1e9) < 2.5


def hardware_triggered(session: Session, retries: RetryPolicy) -> Iterator[Shot]:
    """Play the sequence until every frame counts, three times at most.

    Frames are delivered as they come. Those of a play that failed are refused, and all come again.
    Raises UnsupportedByDeviceError: a camera has no exposure set; FrameTimeoutError, ScanEvidenceError: the third play
    failed.
    """
    rig, count = session.rig, len(session.sequence)
    unset = sorted(set(rig.cameras) - set(session.applied))
    if unset:
        raise UnsupportedByDeviceError(
            f"cameras {unset} have no exposure set, and the projector must know how long to show each pattern; "
            "write exposure_s into their tables of the rig file"
        )
    rig.projector.load(session.sequence)
    lit_s, period_s = play_times_s(session)
    last: dict[str, Frame] = {}
    causes: list[str] = []
    timed_out = 0
    for number in range(1, MOST_PLAYS + 1):
        for camera in rig.cameras.values():
            # Room for one more than there should be: it would tell.
            camera.arm(count + 1, Trigger.HARDWARE)
        play = _Play({name: [] for name in rig.cameras}, lit_s, period_s)
        yield from _frames(session, retries, play, last)
        rig.projector.stop()
        if not play.faults:
            return
        for camera in rig.cameras.values():
            camera.disarm()
        causes.append(_cause(play, session.sequence))
        timed_out += play.missing == len(play.faults)
        # Slow enough is better than not at all: the cause says what to write into the rig file.
        period_s *= 2 if any(play.halved(name) for name in rig.cameras) else 1
        retries.evidence.forget()
        for index, name in play.delivered:
            retries.refuse(RefusedFrame(index, name, number, causes[-1], delivered=True))
        for shot in play.withheld:
            retries.refuse(RefusedFrame(shot.pattern, shot.camera, number, causes[-1], shot))
    message = f"the sequence was played {MOST_PLAYS} times by wire: {in_words(causes)}"
    raise FrameTimeoutError(message) if timed_out == len(causes) else ScanEvidenceError(message)


def play_times_s(session: Session) -> tuple[float, float]:
    """Return how long each pattern is lit, and the time from one trigger pulse to the next, s.

    The longest wins: what the projector needs between patterns, what each camera says that it needs from one exposure
    to the next (one that does not say is given as long again as its exposure for read-out, unless the rig file knows),
    and `trigger_period_s` of the rig file.
    """
    rig, applied = session.rig, session.applied
    known = rig.synchronisation
    asked_s = None if known is None else known.trigger_period_s
    exposure_s = max(each.exposure_s for each in applied.values())
    skew_s = max(shutter_skew_s(camera, name, known) for name, camera in rig.cameras.items())
    # The last row of a rolling shutter must have had the pattern's light as long as the first.
    lit_s = exposure_s + skew_s
    unknown_s = lit_s + exposure_s if asked_s is None else asked_s
    needed_s = [unknown_s if each.least_period_s is None else each.least_period_s for each in applied.values()]
    projector = rig.projector.info
    return lit_s, max((lit_s + projector.gap_s) / projector.duty, asked_s or 0.0, *needed_s)


def _missed(session: Session, play: _Play, name: str, index: int, error: FrameTimeoutError) -> str:
    """Words for a frame that did not come."""
    count = len(session.sequence)
    if play.halved(name):
        return (
            f"camera '{name}' gave {index} of {count} frames and missed every second pulse: it cannot expose every "
            f"{play.period_s:.6g} s; write trigger_period_s = {2 * play.period_s:.6g} into [synchronisation] of the "
            "rig file, or shorten its exposure or its region"
        )
    return (
        f"camera '{name}' gave {index} of {count} frames, that of {session.pattern(index)} did not come ({error}): a "
        f"trigger pulse was missed; check the trigger cable, and that exposure and read-out fit into "
        f"{play.period_s:.4f} s, or write a longer trigger_period_s into [synchronisation] of the rig file"
    )


def _frames(session: Session, retries: RetryPolicy, play: _Play, last: dict[str, Frame]) -> Iterator[Shot]:
    rig, count = session.rig, len(session.sequence)
    lit_s, period_s = play.lit_s, play.period_s
    before: dict[str, Frame] = {}
    waiting_for, spoilt = list(rig.cameras), set[str]()
    session.stop_if_cancelled(0)
    rig.projector.play(lit_s, period_s)
    for index in range(count):
        for name in list(waiting_for):
            session.stop_if_cancelled(index)
            after_ns = last[name].t_end_ns if name in last else 0
            try:
                frame = session.read(name, after_ns, period_s + session.patience_s(name))
            except FrameTimeoutError as error:
                play.faults.append(_missed(session, play, name, index, error))
                play.missing += 1
                waiting_for.remove(name)
                continue
            play.levels[name].append(float(frame.image.mean()))
            play.starts_ns.setdefault(name, []).append(frame.t_start_ns)
            where = place(name, index, session.sequence.patterns[index])
            own = session.own_fault(frame, after_ns, before.get(name)) or _gap(frame, before.get(name))
            last[name] = before[name] = frame
            shot = retries.shot(index, frame)
            if own is not None:
                if name not in spoilt:
                    # One is enough: what is lost stays lost.
                    play.faults.append(f"{where}: {own}")
                spoilt.add(name)
            elif not play.faults:
                # After the first fault there is nothing left to prove, only to understand.
                play.faults += map(str, retries.evidence.contradictions(shot))
            if play.faults:
                play.withheld.append(shot)
            else:
                play.delivered.append((index, name))
                yield shot
    for name in waiting_for:
        extra = _extra(session, name, last[name], period_s)
        if extra is not None:
            play.levels[name].append(float(extra.image.mean()))
            play.faults.append(
                f"camera '{name}' gave more than the {count} frames of the sequence: something else triggers it; check "
                "the trigger cable and its polarity, and shield it from the projector's other outputs"
            )


def _extra(session: Session, name: str, last: Frame, period_s: float) -> Frame | None:
    """The frame beyond the last one. It would come within one period, as all of them did."""
    try:
        return session.read(name, last.t_end_ns, 1.5 * period_s)
    except FrameTimeoutError:
        return None


def _gap(frame: Frame, before: Frame | None) -> str | None:
    skipped = before is not None and frame.sequence_number != before.sequence_number + 1
    if not skipped and not frame.dropped_count:
        return None
    return (
        f"frame number {frame.sequence_number} follows {before.sequence_number if before is not None else 'none'}, "
        f"{frame.dropped_count} were lost: which frame shows which pattern cannot be told; lower the camera's load or "
        "lengthen the exposure, and scan again"
    )


def _cause(play: _Play, sequence: PatternSequence) -> str:
    """What is wrong with a play: a shift of all frames, where their brightness shows one, explains everything else."""
    shifts = {name: frame_shift(levels, sequence) for name, levels in play.levels.items()}
    words = [
        f"the frames of camera '{name}' are shifted by one: its frame 0 shows pattern 1. It missed the first trigger "
        "pulse; let the projector wait longer before its first pattern, or arm the camera earlier"
        if shift == 1
        else f"the frames of camera '{name}' are shifted by one: its frame 1 shows pattern 0. It was triggered once "
        "before the first pattern; check the polarity and the idle level of the trigger output"
        for name, shift in shifts.items()
        if shift
    ]
    return "; ".join([*words, *dict.fromkeys(play.faults)])


def frame_shift(levels: Sequence[float], sequence: PatternSequence) -> int:
    """By how many patterns the frames of a play are ahead of their numbers: 1, 0 or -1; 0 where it does not show.

    levels : mean of each frame. They are held against white, black and line frames, whose brightness does not depend
    on which part of the pattern a camera sees.
    """
    expected = np.array([profile.mean() for profile in sequence.profiles])
    telling = np.array([not isinstance(pattern, Gray | Primary) for pattern in sequence.patterns])
    agreement: dict[int, float] = {}
    for shift in (0, 1, -1):
        frames, shown = np.asarray(levels[max(-shift, 0) :]), expected[max(shift, 0) :]
        length = min(len(frames), len(shown))
        where = telling[max(shift, 0) :][:length]
        frames, shown = frames[:length][where], shown[:length][where]
        apart = len(frames) > 2 and np.ptp(frames) > 0 and np.ptp(shown) > 0
        agreement[shift] = float(np.corrcoef(frames, shown)[0, 1]) if apart else 0.0
    best = max(agreement, key=lambda shift: agreement[shift])
    return best if agreement[best] > _ALIKE and agreement[best] > agreement[0] + _BETTER else 0
