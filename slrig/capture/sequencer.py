"""Playing a pattern sequence on a rig: every frame lies wholly within its pattern's light, and the rig ends dark."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace

from slrig.capture.evidence import Evidence, named
from slrig.devices import AppliedSettings, Camera, CameraSettings, Rig, Shown, Trigger
from slrig.errors import (
    FrameTimeoutError,
    ScanCancelledError,
    ScanEvidenceError,
    UnsupportedByDeviceError,
)
from slrig.model import Frame, PatternSequence, Shot

SETTINGS_TOLERANCE = 0.01
"""How far a camera's exposure and gain may be from what was asked, as a fraction."""

_TRIES = 2


def capture(
    rig: Rig,
    sequence: PatternSequence,
    *,
    cancelled: Callable[[], bool] = lambda: False,
    timeout_s: float = 2.0,
    evidence: Evidence | None = None,
) -> Iterator[Shot]:
    """Show every pattern, expose every camera to it, and yield the frames as they come.

    A generator: nothing moves before the first frame is asked for. However it ends (the last frame, an error, a
    cancel, a consumer that stops or is interrupted) the projector is dark and the cameras are disarmed afterwards.
    Wire triggers are preferred to software triggers, these to free-running cameras, among what all devices declare.

    Parameters
    ----------
    rig
        Open devices. Cameras without settings are left as they are.
    sequence
        Patterns for this projector.
    cancelled
        Asked before every pattern and every frame.
    timeout_s
        How long a frame may take beyond its exposure. A frame that does not come is asked for once more.
    evidence
        Where the frames are judged; give one to read its summary afterwards.

    Yields
    ------
    Shot
        `time_s` counts from the start of the first frame's exposure.

    Raises
    ------
    UnsupportedByDeviceError
        A device cannot do what is asked: settings, size, no trigger in common.
    FrameTimeoutError
        A frame did not come twice. Names pattern, camera, times.
    ScanEvidenceError
        A frame was exposed too early, came twice, or contradicts what it should show.
    ScanCancelledError
        `cancelled` said so.
    DeviceError
        A device failed or is gone.
    """
    judge = evidence
    if judge is None:
        judge = Evidence(sequence.patterns, {name: camera.info.format for name, camera in rig.cameras.items()})
    triggers = choose_triggers(rig)
    with ExitStack() as leaving:
        # Last in, first out: the light goes off before anything else is tried.
        for camera in rig.cameras.values():
            leaving.callback(_whatever_happens, camera.disarm)
        leaving.callback(_whatever_happens, rig.projector.blank)
        rounds = _Session(rig, sequence, _configure(rig), triggers, timeout_s, cancelled)
        frames = rounds.played(leaving) if Trigger.HARDWARE in triggers.values() else rounds.stepped()
        t_first_ns: int | None = None
        for index, frame in frames:
            if t_first_ns is None:
                t_first_ns = frame.t_start_ns
            time_s = (frame.t_start_ns - t_first_ns) / 1e9
            shot = Shot(index, frame.camera, frame.image, frame.exposure_s, time_s)
            judge.add(shot)
            yield shot
        # Here a projector that will not go dark is an error of its own, not a footnote to another one.
        rig.projector.blank()


def choose_triggers(rig: Rig) -> dict[str, Trigger]:
    """Choose what starts each camera's exposures: hardware for all of them, or else the best that each can do.

    Raises
    ------
    UnsupportedByDeviceError
        The rig has no camera, or a camera can be triggered by wire only and the others or the projector cannot.
    """
    if not rig.cameras:
        message = f"rig '{rig.name}' has no camera; add a [[camera]] table to its rig file"
        raise UnsupportedByDeviceError(message)
    declared = {name: camera.info.triggers for name, camera in rig.cameras.items()}
    if rig.projector.info.plays and all(Trigger.HARDWARE in triggers for triggers in declared.values()):
        return dict.fromkeys(declared, Trigger.HARDWARE)
    chosen: dict[str, Trigger] = {}
    for name, triggers in declared.items():
        if Trigger.SOFTWARE in triggers:
            chosen[name] = Trigger.SOFTWARE
        elif Trigger.FREE in triggers:
            chosen[name] = Trigger.FREE
        else:
            offered = ", ".join(sorted(triggers)) or "none"
            message = (
                f"camera '{name}' can be triggered by: {offered}; projector '{rig.projector.info.name}' "
                f"{'plays' if rig.projector.info.plays else 'does not play'} sequences by wire, and every camera "
                "must take part: use a camera with software trigger, or a projector and cameras with wire trigger"
            )
            raise UnsupportedByDeviceError(message)
    return chosen


@dataclass(frozen=True, slots=True)
class _Session:
    rig: Rig
    sequence: PatternSequence
    applied: Mapping[str, AppliedSettings]
    triggers: Mapping[str, Trigger]
    timeout_s: float
    cancelled: Callable[[], bool]

    def stepped(self) -> Iterator[tuple[int, Frame]]:
        """Show each pattern, and expose to it."""
        self.rig.projector.load(self.sequence)
        for name, camera in self.rig.cameras.items():
            # Room to take each frame once more.
            camera.arm(_TRIES * len(self.sequence), self.triggers[name])
        last: dict[str, Frame] = {}
        for index in range(len(self.sequence)):
            waiting = list(self.rig.cameras)
            for attempt in range(1, _TRIES + 1):
                self._stop_if_cancelled(index)
                shown = self.rig.projector.show(index)
                for name in waiting:
                    if self.triggers[name] is Trigger.SOFTWARE:
                        self.rig.cameras[name].trigger()
                missing: list[str] = []
                for name in waiting:
                    self._stop_if_cancelled(index)
                    frame = self._read(name, shown, attempt)
                    if frame is None:
                        missing.append(name)
                        continue
                    self._require_fresh(index, frame, _visible_ns(shown), last.get(name))
                    last[name] = frame
                    yield index, frame
                if not missing:
                    break
                waiting = missing

    def _read(self, name: str, shown: Shown, attempt: int) -> Frame | None:
        """Return the frame, or None when it may be asked for once more."""
        after_ns, timeout_s = _visible_ns(shown), self._patience_s(name)
        try:
            frame = self.rig.cameras[name].read(after_ns, timeout_s)
        except FrameTimeoutError as error:
            if attempt < _TRIES:
                return None
            message = (
                f"camera '{name}' gave no frame of {self._pattern(shown.index)}, visible since {shown.t_visible_ns} ns "
                f"± {shown.t_err_ns} ns: waited {timeout_s:.3f} s, {_TRIES} times ({error}); check the camera's cable, "
                "bandwidth and trigger"
            )
            raise FrameTimeoutError(message) from error
        return _under(name, frame)

    def played(self, leaving: ExitStack) -> Iterator[tuple[int, Frame]]:
        """Let the projector play the sequence and trigger the cameras by wire; frame i shows pattern i."""
        projector, count = self.rig.projector, len(self.sequence)
        unset = sorted(set(self.rig.cameras) - set(self.applied))
        if unset:
            message = (
                f"cameras {unset} have no exposure set, and the projector must know how long to show each pattern; "
                "write exposure_s into their tables of the rig file"
            )
            raise UnsupportedByDeviceError(message)
        projector.load(self.sequence)
        for camera in self.rig.cameras.values():
            camera.arm(count, Trigger.HARDWARE)
        exposure_s = max(applied.exposure_s for applied in self.applied.values())
        # As long again for the sensors to be read out: most cannot expose meanwhile.
        period_s = 2 * exposure_s
        self._stop_if_cancelled(0)
        leaving.callback(_whatever_happens, projector.stop)
        projector.play(exposure_s, period_s)
        last: dict[str, Frame] = {}
        for index in range(count):
            for name, camera in self.rig.cameras.items():
                self._stop_if_cancelled(index)
                after_ns = last[name].t_end_ns if name in last else 0
                try:
                    frame = _under(name, camera.read(after_ns, period_s + self._patience_s(name)))
                except FrameTimeoutError as error:
                    message = (
                        f"camera '{name}' gave {index} of {count} frames, that of {self._pattern(index)} did not come "
                        f"({error}): a trigger pulse was missed; check the trigger cable, and that exposure and read-"
                        f"out fit into {period_s:.4f} s"
                    )
                    raise FrameTimeoutError(message) from error
                self._require_fresh(index, frame, after_ns, last.get(name))
                self._require_next(index, frame, last.get(name))
                last[name] = frame
                yield index, frame
        projector.stop()

    def _patience_s(self, name: str) -> float:
        return self.timeout_s + self.applied[name].exposure_s if name in self.applied else self.timeout_s

    def _pattern(self, index: int) -> str:
        return named(index, self.sequence.patterns[index])

    def _stop_if_cancelled(self, index: int) -> None:
        if self.cancelled():
            message = f"the scan was cancelled at {self._pattern(index)} of {len(self.sequence)}"
            raise ScanCancelledError(message)

    def _require_fresh(self, index: int, frame: Frame, after_ns: int, before: Frame | None) -> None:
        """Refuse a frame that was exposed too early, was delivered before, or was exposed otherwise than asked."""
        where = f"camera '{frame.camera}', {self._pattern(index)}"
        if frame.t_start_ns < after_ns or frame.t_end_ns < frame.t_start_ns:
            message = (
                f"{where}: the frame was exposed from {frame.t_start_ns} to {frame.t_end_ns} ns (± {frame.t_err_ns} "
                f"ns), its light was stable from {after_ns} ns only: the driver delivered a stale frame; report it to "
                "the driver's maintainer, and use another driver for this camera"
            )
            raise ScanEvidenceError(message)
        if before is not None and frame.sequence_number <= before.sequence_number:
            message = (
                f"{where}: frame number {frame.sequence_number} came after number {before.sequence_number}: a frame "
                "was delivered twice, or the camera restarted; scan again"
            )
            raise ScanEvidenceError(message)
        asked = self.applied.get(frame.camera)
        if asked is not None and _differ(frame.exposure_s, asked.exposure_s):
            message = (
                f"{where}: exposed for {frame.exposure_s:.6g} s, set to {asked.exposure_s:.6g} s: switch off "
                "automatic exposure, and scan again"
            )
            raise ScanEvidenceError(message)

    def _require_next(self, index: int, frame: Frame, before: Frame | None) -> None:
        """Refuse a gap: frames that a wire triggered are told apart by their order alone."""
        skipped = before is not None and frame.sequence_number != before.sequence_number + 1
        if skipped or frame.dropped_count:
            message = (
                f"camera '{frame.camera}', {self._pattern(index)}: frame number {frame.sequence_number} follows "
                f"{before.sequence_number if before is not None else 'none'}, {frame.dropped_count} were lost: which "
                "frame shows which pattern cannot be told; lower the camera's load or lengthen the exposure, and scan "
                "again"
            )
            raise ScanEvidenceError(message)


def _configure(rig: Rig) -> dict[str, AppliedSettings]:
    """Set every camera that has settings, and compare what it reads back."""
    applied: dict[str, AppliedSettings] = {}
    for name, settings in rig.settings.items():
        applied[name] = _apply(rig.cameras[name], name, settings)
    return applied


def _apply(camera: Camera, name: str, settings: CameraSettings) -> AppliedSettings:
    applied = camera.configure(settings)
    for what, asked, got, unit in (
        ("exposure", settings.exposure_s, applied.exposure_s, " s"),
        ("gain", settings.gain, applied.gain, ""),
    ):
        if _differ(got, asked):
            message = (
                f"camera '{name}': asked for {what} {asked:.6g}{unit}, it uses {got:.6g}{unit}; write a value that "
                f"the camera can use into the rig file ({got:.6g}, for example)"
            )
            raise UnsupportedByDeviceError(message)
    return applied


def _differ(got: float, asked: float) -> bool:
    return abs(got - asked) > SETTINGS_TOLERANCE * abs(asked)


def _visible_ns(shown: Shown) -> int:
    return shown.t_visible_ns + shown.t_err_ns


def _under(name: str, frame: Frame) -> Frame:
    """The frame under the name that the rig gives its camera."""
    return frame if frame.camera == name else replace(frame, camera=name)


def _whatever_happens(action: Callable[[], None]) -> None:
    """Do it as far as the device lets; the error that led here matters more than a device that is gone."""
    # Drivers raise what the operating system gives them, too, and no device may keep the next one from its turn.
    with suppress(Exception):
        action()
