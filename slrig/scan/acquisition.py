"""The first half of a scan: play the plan's patterns on a rig and record a bundle.

Apart from the pipeline because the process that owns the rig needs none of the mathematics, and does not load it. The
bundle is written on a thread of its own, so that the disk never holds up the camera. Frames wait in a queue of bounded
size: a disk that cannot keep up slows the capture down rather than fill the memory.
"""

from __future__ import annotations

import queue
import threading
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import geometric_mean
from types import TracebackType
from typing import Any, Self

import structlog

from slrig.bundle import (
    REFUSED_FOLDER,
    BundleWriter,
    RefusedFrame,
    TurntableAngle,
    write_health,
    write_notes,
    write_truth,
    write_turntable_angle,
)
from slrig.capture import (
    NOISE_FLOOR_DN,
    Evidence,
    EvidenceSummary,
    ExposureFault,
    ExposureSamples,
    ExposureVerdict,
    Sampler,
    Samples,
    bracket_summary,
    detect_movement,
    judge_exposure,
    round_to_refresh_s,
)
from slrig.capture.sequencer import capture, choose_triggers
from slrig.capture.triggering import differs_from_request
from slrig.devices import Camera, CameraSettings, Rig, Trigger, Turntable
from slrig.errors import (
    DeviceError,
    FrameTimeoutError,
    ScanCancelledError,
    ScanEvidenceError,
    UnsupportedByDeviceError,
    of_camera,
)
from slrig.failure import disk_errors
from slrig.jobs.job import FrameSink
from slrig.jobs.listener import SILENT, Listener
from slrig.model import Black, CaptureHeader, PatternSequence, Pixels, Shot, Truth, White
from slrig.rig.session import CountedTurntable
from slrig.scan.plan import ScanPlan, in_colour, no_turntable, rig_sequence


@dataclass(slots=True)
class _BracketRun:
    """One sequence at one exposure: what of it stands, how often each frame was refused, white and black as last seen,
    and samples for the comparison with other exposures.
    """

    exposure_s: float | None
    evidence: Evidence
    standing: set[tuple[int, str]] = field(default_factory=set)
    refused: Counter[tuple[int, str]] = field(default_factory=Counter)
    ends: dict[tuple[int, str], Pixels] = field(default_factory=dict)
    samples: dict[str, dict[int, Samples]] = field(default_factory=dict)


class Exposing:
    """Plays the sequence of a plan on a rig.

    Parameters
    ----------
    exposures_s
        From short to long, for every camera; empty leaves each as its rig file has it.
    recorder
        Is given every exposure that does not count.
    colour
        Cameras whose white and black frames are kept in colour, too.
    may_lose
        Whether to go on without a camera that fails or sees nothing, if the others can measure.
    """

    def __init__(
        self,
        rig: Rig,
        sequence: PatternSequence,
        exposures_s: Sequence[float],
        listener: Listener,
        recorder: Recorder,
        *,
        colour: Collection[str] = (),
        may_lose: bool = False,
    ) -> None:
        self.lost: dict[str, str] = {}
        """Cameras that the scan goes on without, each with the cause."""
        self._may_lose = may_lose
        self._rig = rig
        self._sequence = sequence
        self._exposures_s: tuple[float | None, ...] = tuple(exposures_s) or (None,)
        self._listener = listener
        self._recorder = recorder
        self._colour = colour
        self._formats = {name: camera.info.format for name, camera in rig.cameras.items()}
        self._samplers = (
            {name: Sampler.from_size(form.size) for name, form in self._formats.items()} if self._bracket else {}
        )
        self._runs: list[_BracketRun] = []
        self._compared: dict[str, ExposureSamples] = {}
        self._refused: list[RefusedFrame] = []
        self._done: set[tuple[float | None, int, str]] = set()
        self._begun_s: float | None = None
        self._causes: dict[str, str] = {}
        self._verdicts: dict[str, ExposureVerdict] = {}

    @property
    def _bracket(self) -> bool:
        return len(self._exposures_s) > 1

    @property
    def total(self) -> int:
        """How many frames there will be, those that are left out among them."""
        return len(self._exposures_s) * len(self._sequence) * len(self._formats)

    @property
    def done(self) -> int:
        """How many of them are there, or left out."""
        return len(self._done)

    @property
    def refused_count(self) -> int:
        """How many exposures were refused."""
        return len(self._refused)

    def shots(self) -> Iterator[Shot]:
        """Yield the frames as `slrig.capture.sequencer.capture` does, and raise what that raises.

        Raises
        ------
        ScanEvidenceError
            Also: no exposure of a bracket is of use to a camera, or something moved between two of them.
        """
        since_ns = self._rig.clock.now_ns() if self._bracket else None
        while True:
            try:
                yield from self._all_exposed(since_ns)
            except (DeviceError, ScanEvidenceError) as error:
                if not self._goes_on_after(error):
                    if not self.lost:
                        raise
                    words = "; ".join(lost_words(self.lost))
                    message = f"{error}. Before that, {words}"
                    raise type(error)(message) from error
            else:
                return

    def _all_exposed(self, since_ns: int | None) -> Iterator[Shot]:
        cameras = list(self._formats)
        for exposure_s in self._exposures_s:
            yield from self._exposed(exposure_s, cameras, since_ns)
        unseen = [name for name in self._formats if name not in self._compared]
        if self._bracket and unseen:
            message = f"no exposure of the bracket is of use to camera '{unseen[0]}': {self._causes[unseen[0]]}"
            with of_camera(unseen[0]):
                raise ScanEvidenceError(message)

    def _goes_on_after(self, error: DeviceError | ScanEvidenceError) -> bool:
        """Whether the sequence can begin again without the camera that failed. If so, what there is of it is taken
        back, and of the others, which are shot again.

        A camera that cannot do what the rig file asks is no lost one; nor is one whose frames are wrong: whatever that
        is, it may be wrong for all.
        """
        name = error.camera
        others = [each for each in self._formats if each != name]
        if not self._may_lose or name is None or not _measure(self._rig, others):
            return False
        if isinstance(error, UnsupportedByDeviceError):
            return False
        if isinstance(error, ScanEvidenceError) and not self._sees_nothing(name):
            return False
        self.lost[name] = str(error)
        (words,) = lost_words({name: str(error)})
        _log.warning(words, rig=self._rig.name)
        for run in reversed(self._runs):
            for pattern, camera in sorted(run.standing):
                cause = words if camera == name else f"the sequence was begun again without camera '{name}'"
                attempt = run.refused[pattern, camera] + 1
                self._note(RefusedFrame(pattern, camera, attempt, cause, delivered=True))
        self._runs.clear()
        self._compared.clear()
        del self._formats[name]
        self._done = {each for each in self._done if each[2] != name}
        return True

    def _sees_nothing(self, name: str) -> bool:
        found = self._judged(self._runs[-1], name)
        if found is None and name not in self._compared:
            found = self._verdicts.get(name)
        return found is not None and found.fault is ExposureFault.TOO_DARK

    def summary(self) -> EvidenceSummary:
        """Sum up what the frames have proven, once all are there."""
        if not self._bracket:
            return self._runs[0].evidence.summary()
        parts = [(run.exposure_s or 0.0, run.evidence.summary()) for run in self._runs]
        return bracket_summary(parts, self._refused, (), self._sequence.patterns)

    def _exposed(self, exposure_s: float | None, cameras: list[str], since_ns: int | None) -> Iterator[Shot]:
        """One sequence at one exposure, without the cameras that it is of no use to; those for which it is too long
        are taken from `cameras`.
        """
        taking = list(cameras)
        self._skip(exposure_s, set(self._formats) - set(cameras))
        while taking:
            formats = {name: self._formats[name] for name in taking}
            # The summary of a bracket has what was refused by itself.
            earlier = () if self._bracket else tuple(self._refused)
            run = _BracketRun(
                exposure_s, Evidence(self._sequence.patterns, formats, earlier, projector=self._sequence.projector)
            )
            self._runs.append(run)
            try:
                yield from self._run(run, taking, since_ns)
            except ScanEvidenceError as error:
                unfit = self._unfit(run, taking)
                if not unfit:
                    raise self._placed(error, run) from error
                self._leave_out(self._runs.pop(), unfit)
                taking = [name for name in taking if name not in unfit]
                cameras[:] = [n for n in cameras if n not in unfit or unfit[n].fault is not ExposureFault.TOO_BRIGHT]
                continue
            self._compare(run, taking)
            # Whole images: nobody asks for them again.
            run.ends.clear()
            return

    def _run(self, run: _BracketRun, taking: Sequence[str], since_ns: int | None) -> Iterator[Shot]:
        shots = capture(
            self._set_to(run.exposure_s, taking),
            self._sequence,
            cancelled=self._listener.cancelled,
            evidence=run.evidence,
            refused=lambda refused: self._take_refusal(run, refused),
            since_ns=since_ns,
            colour=self._colour,
        )
        for taken in shots:
            shot = self._timed(taken)
            self._see(run, shot)
            run.standing.add((shot.pattern, shot.camera))
            self._done.add((run.exposure_s, shot.pattern, shot.camera))
            yield shot

    def _set_to(self, exposure_s: float | None, taking: Sequence[str]) -> Rig:
        rig = self._rig
        known = {name: each for name, each in rig.settings.items() if name in taking}
        if exposure_s is not None:
            # A rig file without a gain means 1.
            whole = {name: known.get(name, CameraSettings(exposure_s)) for name in taking}
            known = {name: replace(each, exposure_s=exposure_s) for name, each in whole.items()}
        return replace(rig, cameras={name: rig.cameras[name] for name in taking}, settings=known)

    def _timed(self, shot: Shot) -> Shot:
        """The frame with its time counted from the first frame of all."""
        if not self._bracket or shot.time_s is None:
            return shot
        if self._begun_s is None:
            self._begun_s = shot.time_s
        return replace(shot, time_s=round(shot.time_s - self._begun_s, 9))

    def _see(self, run: _BracketRun, shot: Shot) -> None:
        patterns = self._sequence.patterns
        pattern = patterns[shot.pattern]
        if isinstance(pattern, White | Black) and shot.pattern == patterns.index(pattern):
            run.ends[shot.pattern, shot.camera] = shot.image
        if self._bracket:
            samples = self._samplers[shot.camera].take(shot.image)
            run.samples.setdefault(shot.camera, {})[shot.pattern] = samples

    def _take_refusal(self, run: _BracketRun, refused: RefusedFrame) -> None:
        shot = None if refused.shot is None else self._timed(refused.shot)
        if shot is not None:
            self._see(run, shot)
        if self._bracket:
            refused = replace(refused, shot=shot, cause=f"at {run.exposure_s:g} s, {refused.cause}")
        run.standing.discard((refused.pattern, refused.camera))
        run.refused[refused.pattern, refused.camera] += 1
        self._note(refused)

    def _note(self, refused: RefusedFrame) -> None:
        self._refused.append(refused)
        self._recorder.add(refused)

    def _unfit(self, run: _BracketRun, taking: Sequence[str]) -> dict[str, ExposureVerdict]:
        """The cameras to which this exposure is of no use, and why."""
        if not self._bracket:
            return {}
        found: dict[str, ExposureVerdict] = {}
        for name in taking:
            told = self._judged(run, name)
            # Light that a shorter exposure has seen cannot be too little for a longer one: then it went off.
            if told is not None and (told.fault is ExposureFault.TOO_BRIGHT or name not in self._compared):
                found[name] = told
        return found

    def _judged(self, run: _BracketRun, name: str) -> ExposureVerdict | None:
        patterns = self._sequence.patterns
        white, black = (
            run.ends.get((patterns.index(kind) if kind in patterns else -1, name)) for kind in (White(), Black())
        )
        return None if white is None or black is None else judge_exposure(white, black, self._formats[name])

    def _leave_out(self, run: _BracketRun, unfit: dict[str, ExposureVerdict]) -> None:
        """Take back what there is of a sequence, and say why."""
        again = f"at {run.exposure_s:g} s, the sequence was begun again without camera {', '.join(unfit)}"
        for name, told in unfit.items():
            longer = "; it was not exposed longer than that" if told.fault is ExposureFault.TOO_BRIGHT else ""
            cause = f"{run.exposure_s:g} s is {told.fault} for camera '{name}': {told.description}{longer}"
            self._causes[name], self._verdicts[name] = cause, told
            white = self._sequence.patterns.index(White())
            self._note(RefusedFrame(white, name, run.refused[white, name] + 1, cause, left_out=True))
        for pattern, name in sorted(run.standing):
            cause = self._causes[name] if name in unfit else again
            attempt = run.refused[pattern, name] + 1
            self._note(RefusedFrame(pattern, name, attempt, cause, delivered=True, left_out=name in unfit))
        self._skip(run.exposure_s, set(unfit))

    def _skip(self, exposure_s: float | None, cameras: set[str]) -> None:
        self._done.update((exposure_s, index, name) for name in cameras for index in range(len(self._sequence)))

    def _compare(self, run: _BracketRun, taking: Sequence[str]) -> None:
        """Raise ScanEvidenceError if something moved since the exposure before."""
        if not self._bracket:
            return
        noises = run.evidence.summary().noise_dn
        for name in taking:
            exposed = ExposureSamples(run.exposure_s or 0.0, run.samples[name], noises.get(name, NOISE_FLOOR_DN))
            before = self._compared.get(name)
            if before is not None:
                fault = detect_movement(before, exposed, self._sequence.patterns, self._formats[name].full_scale)
                if fault is not None:
                    message = f"camera '{name}', {fault}"
                    raise ScanEvidenceError(message)
            self._compared[name] = exposed

    def _placed(self, error: ScanEvidenceError, run: _BracketRun) -> ScanEvidenceError:
        if not self._bracket:
            return error
        placed = ScanEvidenceError(f"at an exposure of {run.exposure_s:g} s, {error}")
        placed.camera = error.camera
        return placed


def _measure(rig: Rig, names: Collection[str]) -> bool:
    """Whether these cameras of a rig have two rays for each point."""
    if rig.calibration is None:
        return len(names) > 0
    known = [name for name in names if name in rig.calibration.cameras]
    return len(known) > (0 if rig.calibration.projector is not None else 1)


def lost_words(lost: Mapping[str, str]) -> list[str]:
    """A sentence on each camera that a scan goes on without, by its cause."""
    return [f"camera '{name}' was lost, and the scan went on without it: {cause}" for name, cause in lost.items()]


MOST_WAITING_BYTES = 256 * 2**20
"""How much of frames may wait for the disk."""

_LEAST_FRAME_BYTES = 2**18  # a smaller camera's frames do not wait in thousands

_log = structlog.get_logger(__name__)


class Recording:
    """A bundle whose frames are all taken, and may still be on their way to the disk. `finish` or `discard` it, once,
    on any thread: the rig is not needed for either.
    """

    def __init__(
        self,
        folder: Path,
        writing: ExitStack,
        notes: Sequence[str],
        truth: Truth | None,
        turntable: TurntableAngle | None,
        health: Mapping[str, Any] | None,
    ) -> None:
        self._folder = folder
        self._writing = writing
        self._notes = notes
        self._truth = truth
        self._turntable = turntable
        self._health = health

    def finish(self) -> None:
        """Wait until the bundle is in its place, and write what belongs to it. Raises StorageError: the disk refused,
        and nothing is left.
        """
        self._writing.close()
        write_notes(self._folder, self._notes)
        if self._truth is not None:
            write_truth(self._folder, self._truth)
        if self._turntable is not None:
            write_turntable_angle(self._folder, self._turntable)
        if self._health is not None:
            with disk_errors(self._folder):
                write_health(self._folder, self._health)

    def discard(self) -> None:
        """Let it go. Nothing is left of it."""
        ended = ScanCancelledError("the recording is not wanted any more")
        self._writing.__exit__(ScanCancelledError, ended, None)


class Recorder:
    """Hands frames to a writer in the order in which they came. A context manager, within the writer's own.

    Leaving it well waits until everything is written; leaving it with an error writes no more. Either way nobody uses
    the writer afterwards. What the writer raises is raised by the next call, or at the end.
    """

    def __init__(self, writer: BundleWriter, *, most_bytes: int = MOST_WAITING_BYTES) -> None:
        self._writer = writer
        self._most_bytes = most_bytes
        self._waiting: queue.Queue[Shot | RefusedFrame | None] = queue.Queue()
        self._thread: threading.Thread | None = None
        self._stopped = False
        self._error: Exception | None = None

    def __enter__(self) -> Self:
        return self

    def add(self, item: Shot | RefusedFrame) -> None:
        """Have a frame written, a refused one apart; waits while too many are waiting already. Raises as
        `BundleWriter.add` and `BundleWriter.refuse` do.
        """
        if self._error is not None:
            raise self._error
        if self._thread is None:
            shot = item if isinstance(item, Shot) else item.shot
            size = _LEAST_FRAME_BYTES if shot is None else max(shot.image.nbytes, _LEAST_FRAME_BYTES)
            self._waiting = queue.Queue(max(1, self._most_bytes // size))
            self._thread = threading.Thread(target=self._write, name="slrig-recorder", daemon=True)
            self._thread.start()
        self._waiting.put(item)

    def finish(self) -> None:
        """Wait until everything is written. Idempotent. Raises what the writer raised."""
        if self._thread is not None:
            self._waiting.put(None)
            self._thread.join()
            self._thread = None
        if self._error is not None:
            raise self._error

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.finish()
        elif self._thread is not None:
            self._stopped = True
            self._waiting.put(None)
            self._thread.join()

    def _write(self) -> None:
        while (item := self._waiting.get()) is not None:
            if self._stopped:
                continue
            try:
                if isinstance(item, Shot):
                    self._writer.add(item)
                else:
                    self._writer.refuse(item)
            except Exception as error:  # noqa: BLE001 - it is raised again on the thread that captures
                # Go on taking frames, so that whoever captures never waits for room, and write none of them.
                self._error, self._stopped = error, True


def capture_frames(
    rig: Rig,
    plan: ScanPlan,
    folder: Path,
    listener: Listener = SILENT,
    *,
    frames: FrameSink | None = None,
    health: Mapping[str, Any] | None = None,
    may_lose: bool = False,
) -> Recording:
    """Play the plan's patterns on the rig, and return when the last frame is proven. What comes back brings the bundle
    to `folder`, which must not exist.

    Where the plan says at which angle of the rig's turntable, that turns there first.

    `frames` is shown each frame that has passed its test, and once more the frames that took another one's place.
    health : of the rig's calibration, for the bundle. may_lose : whether to go on without a camera that fails or
    sees nothing, as long as the others measure; the bundle's notes then say so, as of cameras that `rig` lacks.

    Raises
    ------
    ScanEvidenceError, FrameTimeoutError
        Frames contradict their patterns, or do not come, however often they are shot. What there is of them is kept
        for whoever looks for the cause: `folder` holds the frames that counted, and in `refused` those that did not.
    PatternError
        The plan does not fit the projector, or its patterns tell no depth by the rig's calibration.
    DeviceError
        The rig failed, or has no turntable, colour or coloured light where the plan asks for it.
    ScanCancelledError
        The listener had it cancelled.
    StorageError
        The disk refused. In these cases nothing is left in `folder`. In every case the projector is dark.
    """
    sequence = rig_sequence(plan, rig)
    rig, exposures_s, told = exposed(rig, plan)
    told = [*lost_words(rig.lost), *told, *_of_the_rig(rig)]
    for words in told:
        _log.info(words, rig=rig.name)
        listener.report("capture", 0.0, words)
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    colour = in_colour(plan, {name: camera.info for name, camera in rig.cameras.items()}, rig.projector.info)
    turntable = _turned(rig, plan, listener)
    writer = BundleWriter(
        folder, rig.projector.info.size, sequence.patterns, formats, rig.calibration, captured_at=datetime.now(UTC)
    )
    with ExitStack() as writing:
        writing.enter_context(writer)
        recorder = writing.enter_context(Recorder(writer))
        exposing = Exposing(rig, sequence, exposures_s, listener, recorder, colour=colour, may_lose=may_lose)
        if frames is not None:
            once = tuple((index, name) for index in range(len(sequence)) for name in formats)
            listed = once * max(len(exposures_s), 1)
            frames.begin(CaptureHeader(sequence.projector, sequence.patterns, formats, listed), rig.calibration)
        try:
            for shot in exposing.shots():
                if frames is not None:
                    frames.take(shot)
                recorder.add(shot)
                listener.report("capture", exposing.done / exposing.total, _detail(exposing))
        except (ScanEvidenceError, FrameTimeoutError) as error:
            recorder.finish()
            writer.keep(str(error))
            # Light that comes later than the projector states gives frames of the pattern before.
            late = "".join(f". Or {words}" for words in _unmeasured(rig) if isinstance(error, ScanEvidenceError))
            message = (
                f"{error}{late}. The frames are kept: see bundle.json for those that counted, {REFUSED_FOLDER}/ for "
                "the others"
            )
            raise type(error)(message) from error
        for name in exposing.lost:
            writer.lose(name)
        if frames is not None:
            frames.end(exposing.summary())
        notes = [*lost_words(exposing.lost), *told]
        return Recording(folder, writing.pop_all(), notes, rig.truth(), turntable, health)


def _turned(rig: Rig, plan: ScanPlan, listener: Listener) -> TurntableAngle | None:
    """Turn the object as planned; return the turntable's angle, None if the plan has none."""
    if plan.turn_deg is None:
        return None
    count: str | None = None
    if plan.turned_by == "table":
        if not isinstance(rig.positioner, Turntable):
            raise no_turntable(plan.turn_deg)
        listener.report("turn", 0.0, f"to {plan.turn_deg:g}°")
        rig.positioner.turn(plan.turn_deg)
        count = rig.positioner.count if isinstance(rig.positioner, CountedTurntable) else None
    return TurntableAngle(angle_deg=plan.turn_deg, turned_by=plan.turned_by, count=count)


def _of_the_rig(rig: Rig) -> list[str]:
    """What drivers tell of their cameras, and what was not measured."""
    told = [f"camera '{name}': {words}" for name, camera in rig.cameras.items() for words in camera.info.notes]
    return told + _unmeasured(rig)


def _unmeasured(rig: Rig) -> list[str]:
    """That the light's delay was not measured, where it counts."""
    free = [name for name, trigger in choose_triggers(rig).items() if trigger is Trigger.FREE]
    if not free or rig.synchronisation is not None:
        return []
    return [
        "how late the projector's light is was never measured on this rig, and it has cameras that run by themselves "
        f"({', '.join(free)}): their frames are matched to patterns by what the drivers state. Run slrig latency, and "
        "write the [synchronisation] that it prints into the rig file"
    ]


def _detail(exposing: Exposing) -> str:
    again = exposing.refused_count
    return f"frame {exposing.done} of {exposing.total}" + (f", {again} shot again" if again else "")


def exposed(rig: Rig, plan: ScanPlan) -> tuple[Rig, tuple[float, ...], list[str]]:
    """The rig as a plan exposes it: its cameras' settings, or exposures for all cameras, from short to long, in whole
    refresh periods of its projector; and words for what is not as it was asked for.

    One factor is times each camera's own exposure; those of a bracket, which all cameras share, are times the geometric
    mean. What a camera cannot do of them becomes the nearest that it can.
    """
    refresh_s = rig.projector.info.refresh_s
    told = [] if plan.preset is None else [f"the scan was asked for by {plan.preset}"]

    def instead(exposure_s: float, asked_s: float, whose: str, why: str) -> float:
        if differs_from_request(exposure_s, asked_s):
            told.append(f"{whose} exposes for {exposure_s:.6g} s instead of {asked_s:.6g} s: {why}")
        return exposure_s

    def scaled(asked_s: float, whose: str, cameras: Iterable[Camera]) -> float:
        least_s, most_s = zip(*(camera.info.exposure_range_s for camera in cameras), strict=True)
        return instead(min(max(asked_s, *least_s), *most_s), asked_s, whose, "what it can do")

    def snapped(asked_s: float, whose: str, names: Collection[str]) -> float:
        if refresh_s is None:
            return asked_s
        why = f"whole periods of the projector ({refresh_s:.6g} s)"
        whole_s = round_to_refresh_s(asked_s, refresh_s, [rig.cameras[name].info.exposure_range_s for name in names])
        if differs_from_request(whole_s, asked_s):
            for name in names:
                taken_s = rig.cameras[name].configure(replace(rig.settings[name], exposure_s=whole_s)).exposure_s
                if differs_from_request(taken_s, whole_s):
                    told.append(
                        f"{whose} exposes for {asked_s:.6g} s, not {why}: camera '{name}' takes {taken_s:.6g} s"
                    )
                    return asked_s
        return instead(whole_s, asked_s, whose, why)

    own_s = {name: each.exposure_s for name, each in rig.settings.items()}
    exposures_s, every, factors = plan.rising_exposures_s, "every camera", sorted(plan.exposure_factors or ())
    if len(factors) > 1:
        mean_s = geometric_mean(own_s.values())
        exposures_s = tuple(scaled(factor * mean_s, every, rig.cameras.values()) for factor in factors)
    if exposures_s:
        return rig, tuple(dict.fromkeys(snapped(each, every, rig.cameras) for each in exposures_s)), told
    for name in own_s if factors else ():
        own_s[name] = scaled(factors[0] * own_s[name], f"camera '{name}'", [rig.cameras[name]])
    settings = {
        name: replace(each, exposure_s=snapped(own_s[name], f"camera '{name}'", [name]))
        for name, each in rig.settings.items()
    }
    return replace(rig, settings=settings), (), told
