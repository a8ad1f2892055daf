"""The first half of a scan: play the plan's patterns on a rig and record a bundle.

Apart from the pipeline because the process that owns the rig needs none of the mathematics, and does not load it. The
bundle is written on a thread of its own, so that the disk never holds up the camera. Frames wait in a queue of bounded
size: a disk that cannot keep up slows the capture down rather than fill the memory.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
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
from slrig.capture import SETTINGS_TOLERANCE, choose_triggers, round_to_refresh_s
from slrig.devices import Camera, Rig, Trigger, Turntable
from slrig.errors import FrameTimeoutError, ScanCancelledError, ScanEvidenceError
from slrig.failure import disk_errors
from slrig.jobs.frame_feed import FrameSink
from slrig.model import CaptureHeader, Shot, Truth
from slrig.rig.turn_count import CountedTurntable
from slrig.scan.bracketing import Exposing
from slrig.scan.plan import ProgressCallback, ScanPlan
from slrig.scan.plan_check import in_colour, no_turntable, rig_sequence

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

    def add(self, shot: Shot) -> None:
        """Have a frame written; waits while too many are waiting already. Raises as `BundleWriter.add` does."""
        self._put(shot)

    def refuse(self, refused: RefusedFrame) -> None:
        """Have a refused frame kept apart. Raises as `BundleWriter.refuse` does."""
        self._put(refused)

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

    def _put(self, item: Shot | RefusedFrame) -> None:
        if self._error is not None:
            raise self._error
        if self._thread is None:
            shot = item if isinstance(item, Shot) else item.shot
            size = _LEAST_FRAME_BYTES if shot is None else max(shot.image.nbytes, _LEAST_FRAME_BYTES)
            self._waiting = queue.Queue(max(1, self._most_bytes // size))
            self._thread = threading.Thread(target=self._write, name="slrig-recorder", daemon=True)
            self._thread.start()
        self._waiting.put(item)

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
    *,
    progress: ProgressCallback,
    cancelled: Callable[[], bool],
    frames: FrameSink | None = None,
    health: Mapping[str, Any] | None = None,
) -> Recording:
    """Play the plan's patterns on the rig, and return when the last frame is proven. What comes back brings the bundle
    to `folder`, which must not exist.

    Where the plan says at which angle of the rig's turntable, that turns there first.

    `frames` is shown each frame that has passed its test, and once more the frames that took another one's place.
    health : of the rig's calibration, for the bundle.

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
        `cancelled()` became true.
    StorageError
        The disk refused. In these cases nothing is left in `folder`. In every case the projector is dark.
    """
    sequence = rig_sequence(plan, rig)
    rig, exposures_s, told = exposed(rig, plan)
    told += _of_the_rig(rig)
    for words in told:
        _log.info(words, rig=rig.name)
        progress("capture", 0.0, words)
    formats = {name: camera.info.format for name, camera in rig.cameras.items()}
    colour = in_colour(plan, {name: camera.info for name, camera in rig.cameras.items()}, rig.projector.info)
    turntable = _turned(rig, plan, progress)
    writer = BundleWriter(
        folder, rig.projector.info.size, sequence.patterns, formats, rig.calibration, captured_at=datetime.now(UTC)
    )
    with ExitStack() as writing:
        writing.enter_context(writer)
        recorder = writing.enter_context(Recorder(writer))
        exposing = Exposing(rig, sequence, exposures_s, cancelled=cancelled, refused=recorder.refuse, colour=colour)
        if frames is not None:
            once = tuple((index, name) for index in range(len(sequence)) for name in formats)
            listed = once * max(len(exposures_s), 1)
            frames.begin(CaptureHeader(sequence.projector, sequence.patterns, formats, listed), rig.calibration)
        try:
            for shot in exposing.shots():
                if frames is not None:
                    frames.take(shot)
                recorder.add(shot)
                progress("capture", exposing.done / exposing.total, _detail(exposing))
        except (ScanEvidenceError, FrameTimeoutError) as error:
            recorder.finish()
            writer.keep(str(error))
            message = (
                f"{error}. The frames are kept: see bundle.json for those that counted, {REFUSED_FOLDER}/ for "
                "the others"
            )
            raise type(error)(message) from error
        if frames is not None:
            frames.end(exposing.summary())
        return Recording(folder, writing.pop_all(), told, rig.truth(), turntable, health)


def _turned(rig: Rig, plan: ScanPlan, progress: ProgressCallback) -> TurntableAngle | None:
    """Turn the object as planned; return the turntable's angle, None if the plan has none."""
    if plan.turn_deg is None:
        return None
    count: str | None = None
    if plan.turned_by == "table":
        if not isinstance(rig.positioner, Turntable):
            raise no_turntable(plan.turn_deg)
        progress("turn", 0.0, f"to {plan.turn_deg:g}°")
        rig.positioner.turn(plan.turn_deg)
        count = rig.positioner.count if isinstance(rig.positioner, CountedTurntable) else None
    return TurntableAngle(angle_deg=plan.turn_deg, turned_by=plan.turned_by, count=count)


def _of_the_rig(rig: Rig) -> list[str]:
    """What drivers tell of their cameras, and what was not measured."""
    told = [f"camera '{name}': {words}" for name, camera in rig.cameras.items() for words in camera.info.notes]
    free = [name for name, trigger in choose_triggers(rig).items() if trigger is Trigger.FREE]
    if free and rig.synchronisation is None:
        told.append(
            "how late the projector's light is was never measured on this rig, and it has cameras that run by "
            f"themselves ({', '.join(free)}): their frames are matched to patterns by what the drivers state. Run "
            "slrig latency, and write the [synchronisation] that it prints into the rig file"
        )
    return told


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
        if abs(exposure_s - asked_s) > SETTINGS_TOLERANCE * asked_s:
            told.append(f"{whose} exposes for {exposure_s:.6g} s instead of {asked_s:.6g} s: {why}")
        return exposure_s

    def scaled(asked_s: float, whose: str, cameras: Iterable[Camera]) -> float:
        least_s, most_s = zip(*(camera.info.exposure_range_s for camera in cameras), strict=True)
        return instead(min(max(asked_s, *least_s), *most_s), asked_s, whose, "what it can do")

    def snapped(asked_s: float, whose: str, cameras: Iterable[Camera]) -> float:
        if refresh_s is None:
            return asked_s
        why = f"whole periods of the projector ({refresh_s:.6g} s)"
        ranges_s = [camera.info.exposure_range_s for camera in cameras]
        return instead(round_to_refresh_s(asked_s, refresh_s, ranges_s), asked_s, whose, why)

    own_s = {name: each.exposure_s for name, each in rig.settings.items()}
    exposures_s, every, factors = plan.rising_exposures_s, "every camera", sorted(plan.exposure_factors or ())
    if len(factors) > 1:
        mean_s = geometric_mean(own_s.values())
        exposures_s = tuple(scaled(factor * mean_s, every, rig.cameras.values()) for factor in factors)
    if exposures_s:
        cameras = rig.cameras.values()
        return rig, tuple(dict.fromkeys(snapped(each, every, cameras) for each in exposures_s)), told
    for name in own_s if factors else ():
        own_s[name] = scaled(factors[0] * own_s[name], f"camera '{name}'", [rig.cameras[name]])
    settings = {
        name: replace(each, exposure_s=snapped(own_s[name], f"camera '{name}'", [rig.cameras[name]]))
        for name, each in rig.settings.items()
    }
    return replace(rig, settings=settings), (), told
