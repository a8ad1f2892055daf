"""A camera of a recording: it delivers the frames recorded of the shown pattern."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass

from drivers.replay.clock import ReplayClock
from slrig.bundle import Bundle
from slrig.devices import COMPUTED_LIMITS, AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Black, Frame, Pattern, Shot

_EXPOSURE_TOLERANCE = 0.01


@dataclass(slots=True)
class ReplayState:
    """The shown pattern, and how often it was shown before in the sequence."""

    pattern: tuple[Pattern, int] | None = None


class ReplayCamera:
    """Implements `slrig.devices.Camera` on one camera's recorded frames."""

    def __init__(self, name: str, bundle: Bundle, clock: ReplayClock, replay_state: ReplayState) -> None:
        capture = bundle.capture
        self._recorded: dict[Pattern, list[Shot]] = defaultdict(list)
        for shot in capture.shots:
            if shot.camera == name:
                self._recorded[capture.patterns[shot.pattern]].append(shot)
        exposures = sorted({shot.exposure_s for shot in capture.shots if shot.camera == name and shot.exposure_s})
        self._exposures_s = exposures
        self._info = CameraInfo(
            name=name,
            model="recorded camera",
            serial=f"{bundle.folder.name}-{name}",
            format=capture.cameras[name],
            triggers=frozenset({Trigger.SOFTWARE}),
            # A recording without exposure accepts every one.
            exposure_range_s=(exposures[0], exposures[-1]) if exposures else (1e-6, 3600.0),
            gain_range=(1.0, 1.0),
            limits=COMPUTED_LIMITS,
            colour=any(shot.colour is not None for shots in self._recorded.values() for shot in shots),
        )
        self._applied = AppliedSettings(exposures[0] if exposures else 0.01, 1.0)
        self._clock = clock
        self._replay_state = replay_state
        self._pending: deque[Frame] = deque()
        self._state = CameraState(name)
        self._number = 0
        self._busy_ns = 0

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`. Accepts an exposure that was recorded, within 1 %, and gain 1."""
        self._state.require_settable()
        nearest_s = min(self._exposures_s, key=lambda have: abs(have - settings.exposure_s), default=None)
        low_s, high_s = self._info.exposure_range_s
        if nearest_s is None:
            fits, had = low_s <= settings.exposure_s <= high_s, f"{low_s:g} to {high_s:g} s"
        else:
            fits = abs(nearest_s - settings.exposure_s) <= _EXPOSURE_TOLERANCE * nearest_s
            had = ", ".join(f"{exposure_s:.6g} s" for exposure_s in self._exposures_s)
        if not fits:
            message = (
                f"camera '{self._info.name}': requested an exposure of {settings.exposure_s:.6g} s, the recording was "
                f"made with {had}; write that as exposure_s into the rig file, or leave exposure_s out"
            )
            raise UnsupportedByDeviceError(message)
        if abs(settings.gain - 1) > _EXPOSURE_TOLERANCE:
            message = (
                f"camera '{self._info.name}': requested gain {settings.gain:g}, a recording has gain 1 only; use 1"
            )
            raise UnsupportedByDeviceError(message)
        self._applied = AppliedSettings(nearest_s if nearest_s is not None else settings.exposure_s, 1.0)
        return self._applied

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`. More than `count` frames are available: a caller may repeat one."""
        self._state.check_arming(count, trigger, self._info)
        self._state.armed = trigger

    def trigger(self) -> None:
        """See `Camera`. Takes the recorded frame of the shown pattern; in the dark, that of the black pattern."""
        self._state.require_armed()
        shot = self._recorded_shot()
        exposure_s = self._applied.exposure_s if shot.exposure_s is None else shot.exposure_s
        colour = shot.colour
        start_ns = max(self._clock.now_ns(), self._busy_ns, self._clock.recorded_ns(shot.time_s))
        end_ns = start_ns + round(exposure_s * 1e9)
        self._busy_ns = end_ns
        self._clock.hold(end_ns)
        self._pending.append(
            Frame(
                camera=self._info.name,
                image=shot.image,
                t_start_ns=start_ns,
                t_end_ns=end_ns,
                t_err_ns=0,
                sequence_number=self._number,
                dropped_count=0,
                exposure_s=exposure_s,
                gain=self._applied.gain,
                colour=None if colour is None else lambda: colour,
            )
        )
        self._number += 1

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`. Does not wait for a frame that was not triggered, since it will never arrive."""
        self._state.require_armed()
        while self._pending:
            frame = self._pending[0]
            if frame.t_start_ns >= after_ns:
                if not self._clock.wait_until_reached(frame.t_end_ns, timeout_s):
                    break
                self._state.require_armed()
                return self._pending.popleft()
            self._pending.popleft()
        self._clock.pass_time(timeout_s)
        message = (
            f"camera '{self._info.name}': no frame that began after {after_ns} ns was triggered and exposed within "
            f"{timeout_s} s; trigger after show"
        )
        raise FrameTimeoutError(message)

    def disarm(self) -> None:
        """See `Camera`."""
        self._state.armed = None
        self._pending.clear()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._recorded.clear()
        self._state.close()
        self._clock.release()

    def recorded_frames(self, pattern: Pattern) -> Sequence[Shot]:
        """Return the recorded frames of a pattern at the current exposure, or at any exposure if there are none."""
        shots = self._recorded.get(pattern, [])
        in_use_s = self._applied.exposure_s
        same_exposure = [
            s
            for s in shots
            if s.exposure_s is not None and abs(s.exposure_s - in_use_s) <= _EXPOSURE_TOLERANCE * in_use_s
        ]
        return same_exposure or shots

    def _recorded_shot(self) -> Shot:
        pattern, showing = self._replay_state.pattern if self._replay_state.pattern is not None else (Black(), 0)
        shots = self.recorded_frames(pattern)
        if not shots:
            message = (
                f"camera '{self._info.name}': triggered while the projector is dark, and the recording has no black "
                "frame; show a pattern first"
            )
            raise DeviceStateError(message)
        # A pattern shown more often than recorded repeats its last frame.
        return shots[min(showing, len(shots) - 1)]
