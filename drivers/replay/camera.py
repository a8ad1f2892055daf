"""A camera of a recording: it delivers the frames recorded of the shown pattern."""

from __future__ import annotations

import math
import threading
import time
from collections import defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from slrig.bundle import Bundle
from slrig.devices import (
    COMPUTED_LIMITS,
    AppliedSettings,
    CameraInfo,
    CameraSettings,
    CameraState,
    DisplayedPattern,
    ProjectorInfo,
    ProjectorState,
    Trigger,
)
from slrig.errors import DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError, setting
from slrig.model import Black, Frame, Gray, LineShift, Pattern, PatternSequence, Primary, Shot, Sine, White

_TICK_NS = 1_000
_GLANCE_S = 0.05
_LEAD_NS = 1_000_000
"""From the first `show` to the recording's first frame: margin so that the frame is not late."""


class ReplayClock:
    """The rig's clock, ns. Devices advance it to the recorded times; it never runs on its own.

    Implements `slrig.devices.Clock`.

    At speed 0 it starts at 0 and jumps, so a replay is as fast as the disk. At a speed above 0 it starts at
    CLOCK_MONOTONIC, and a jump takes the recording's time divided by the speed. A caller that is slower than the
    recording is not delayed further, and still finds the recorded times.

    Parameters
    ----------
    speed
        Seconds of the recording per second; 0 for no pacing.
    real_ns, wait
        The pacing clock, and a function that waits for some seconds; by default until `release`.
    """

    def __init__(
        self,
        speed: float = 0.0,
        *,
        real_ns: Callable[[], int] = time.monotonic_ns,
        wait: Callable[[float], object] | None = None,
    ) -> None:
        self._speed = speed
        self._released = threading.Event()
        self._real_ns = real_ns
        self._wait = self._released.wait if wait is None else wait
        self._now_ns = real_ns() if speed else 0
        self._held_ns = self._now_ns
        self._paced_from_ns = (self._now_ns, self._now_ns)
        self._origin_ns: int | None = None
        self._rewound = True

    def now_ns(self) -> int:
        """See `slrig.devices.Clock`."""
        return self._now_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        """See `slrig.devices.Clock`."""
        while not stop.is_set() and (left_s := self._left_s(t_ns)) > 0:
            self._wait(min(left_s, _GLANCE_S))
        if not stop.is_set():
            self._now_ns = max(self._now_ns, t_ns)

    def rewind(self) -> None:
        """Restart the recording with the next shown pattern, unless that is still to come in it."""
        self._rewound = True

    def recorded_ns(self, time_s: float | None) -> int:
        """Return the time at which a frame of this recorded time is due; 0 if the recording has no time."""
        return 0 if time_s is None or self._origin_ns is None else self._origin_ns + round(time_s * 1e9)

    def hold(self, until_ns: int) -> None:
        """Keep the light unchanged until an exposure has ended."""
        self._held_ns = max(self._held_ns, until_ns)

    def change_light(self, time_s: float | None = None) -> int:
        """Advance to the end of all exposures, and at least to a recorded time; return the new time."""
        earliest_ns = max(self._now_ns, self._held_ns) + _TICK_NS
        if time_s is not None:
            if self._rewound and (self._origin_ns is None or self.recorded_ns(time_s) < earliest_ns):
                self._begin(earliest_ns, time_s)
            self._rewound = False
        self._now_ns = max(earliest_ns, self.recorded_ns(time_s))
        self._pace(self._now_ns)
        return self._now_ns

    def wait_until_reached(self, at_ns: int, within_s: float) -> bool:
        """Wait until the clock may be at `at_ns`; return False at once if that would take longer than `within_s`."""
        if self._left_s(at_ns) > within_s:
            return False
        self._pace(at_ns)
        return True

    def pass_time(self, seconds: float) -> None:
        """Advance the clock, also in real time if the replay is paced."""
        passed_ns = round(seconds * 1e9 * (self._speed or 1))
        self._now_ns = self._held_ns = max(self._now_ns + passed_ns, self._held_ns)
        if self._speed:
            self._wait(seconds)

    def release(self) -> None:
        """End all waits. For `close`, from any thread."""
        self._released.set()

    def _begin(self, earliest_ns: int, time_s: float) -> None:
        self._now_ns = max(earliest_ns, self._real_ns()) if self._speed else earliest_ns
        self._origin_ns = self._now_ns + _LEAD_NS - round(time_s * 1e9)
        self._paced_from_ns = (self._real_ns(), self._now_ns)

    def _left_s(self, at_ns: int) -> float:
        if not self._speed or self._released.is_set():
            return 0.0
        real_ns, rig_ns = self._paced_from_ns
        return (real_ns - self._real_ns() + math.ceil((at_ns - rig_ns) / self._speed)) / 1e9

    def _pace(self, at_ns: int) -> None:
        while (left_s := self._left_s(at_ns)) > 0:
            self._wait(left_s)


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


class ReplayProjector:
    """Implements `slrig.devices.Projector` on the patterns of a recording."""

    def __init__(
        self, bundle: Bundle, cameras: Mapping[str, ReplayCamera], clock: ReplayClock, replay_state: ReplayState
    ) -> None:
        self._info = ProjectorInfo(
            name="projector",
            model="recorded projector",
            serial=bundle.folder.name,
            size=bundle.capture.projector,
            plays=False,
            latency_s=0.0,
            limits=COMPUTED_LIMITS,
            recorded=tuple(
                pattern
                for pattern in bundle.capture.patterns
                if all(camera.recorded_frames(pattern) for camera in cameras.values())
            ),
            lights=any(isinstance(pattern, Primary) for pattern in bundle.capture.patterns),
        )
        self._recorded = tuple(dict.fromkeys(bundle.capture.patterns))
        self._cameras = cameras
        self._clock = clock
        self._replay_state = replay_state
        self._state = ProjectorState("the recording's projector")

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return self._info

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Refuses a pattern of which a camera has no frame."""
        self._state.require_open()
        self._state.require_size(sequence, self._info.size)
        for pattern in sequence.patterns:
            missing = [name for name, camera in self._cameras.items() if not camera.recorded_frames(pattern)]
            if missing:
                recorded = "; ".join(dict.fromkeys(map(_describe_family, self._recorded)))
                message = (
                    f"the recording '{self._info.serial}' has no frame of {_describe_pattern(pattern)} from camera "
                    f"{', '.join(missing)}; it has {recorded}. Leave the patterns out of the "
                    "request and of the rig file's [scan] to replay all recorded ones; or request some of them: "
                    f"{setting('sequence')}, {setting('line_shift_period_px')} and similar settings"
                )
                raise UnsupportedByDeviceError(message)
        self.blank()
        self._clock.rewind()
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`."""
        patterns = self._state.require_pattern(index).patterns
        pattern = patterns[index]
        showing = patterns[:index].count(pattern)
        self._replay_state.pattern = (pattern, showing)
        times_s = [
            shots[min(showing, len(shots) - 1)].time_s
            for shots in (camera.recorded_frames(pattern) for camera in self._cameras.values())
        ]
        first_s = min((time_s for time_s in times_s if time_s is not None), default=0.0)
        return DisplayedPattern(index, self._clock.change_light(first_s), 0)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Not supported."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        self._replay_state.pattern = None
        self._clock.change_light()

    def close(self) -> None:
        """See `Projector`."""
        self._clock.release()
        self.blank()
        self._state.loaded = None
        self._state.closed.set()


def _describe_pattern(pattern: Pattern) -> str:
    """Describe a pattern within its family."""
    match pattern:
        case Gray():
            return f"bit {pattern.bit} of {_describe_family(pattern)}"
        case LineShift() | Sine():
            return f"shift {pattern.shift} of {_describe_family(pattern)}"
        case _:
            return _describe_family(pattern)


def _describe_family(pattern: Pattern) -> str:
    """Describe the family of a pattern as in a request."""
    match pattern:
        case White() | Black():
            return pattern.kind
        case Primary():
            return pattern.description
        case Gray():
            inverse = ", inverted" if pattern.inverted else ""
            offset = f", offset {pattern.offset_px} px" if pattern.offset_px else ""
            return (
                f"a {pattern.axis} Gray code of {pattern.bits} bits with cells of {pattern.cell_px} px{offset}{inverse}"
            )
        case LineShift():
            return f"{pattern.axis} lines of {pattern.line_width_px} px, period {pattern.period_px} px"
        case Sine():
            return f"{pattern.axis} sinusoids in {pattern.steps} steps, period {pattern.period_px:g} px"
