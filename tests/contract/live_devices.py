"""A display and webcams on a stage, in its time, by the timing rules of the drivers `screen` and `v4l2`."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from drivers.display.projector import UNMEASURED_LATENCY_S, full_light_time, start_of_flip
from drivers.v4l2.stream import BufferStamp, ExposureInterval, SensorDurations, StampSource, exposure_interval
from slrig.devices import (
    AppliedSettings,
    CameraInfo,
    CameraSettings,
    CameraState,
    DisplayedPattern,
    ProjectorInfo,
    Rig,
    Trigger,
)
from slrig.errors import FrameTimeoutError
from slrig.model import Frame, Pixels
from tests.contract.stage import Stage, StagedProjector
from tests.contract.wired_camera import Exposure as Exposed

BUFFERS = 4
EYES = ("eye", "other eye")
READERS = tuple(f"slrig-frames of {name}" for name in EYES)
"""Threads that read them, as a `VirtualClock` has to know."""


class LiveDisplay(StagedProjector):
    """A display of this refresh rate, whose delay is the stage's latency. It states what the driver `screen` does of a
    display that nobody measured.
    """

    def __init__(self, stage: Stage, *, refresh_hz: float = 60.0) -> None:
        super().__init__(stage)
        self.refresh_ns = round(1e9 / refresh_hz)
        self._begun_ns = self._stage.clock.now_ns()

    @property
    def info(self) -> ProjectorInfo:
        refresh_s = self.refresh_ns / 1e9
        return replace(super().info, latency_s=2 * UNMEASURED_LATENCY_S + 2 * refresh_s, refresh_s=refresh_s)

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`. Waits for the next refresh."""
        flip_ns = self._flip(self._state.require_pattern(index).profiles[index])
        t_visible_ns, t_err_ns = full_light_time(
            start_of_flip(flip_ns),
            refresh_s=self.refresh_ns / 1e9,
            latency_s=UNMEASURED_LATENCY_S,
            latency_error_s=UNMEASURED_LATENCY_S,
        )
        return DisplayedPattern(index, t_visible_ns, t_err_ns)

    def blank(self) -> None:
        if not self._state.closed.is_set():
            self._flip(None)

    def _flip(self, profile: Pixels | None) -> int:
        """Hand a picture over, and return at the refresh that takes it, however late this thread wakes up for that."""
        since_ns = self._stage.clock.now_ns() - self._begun_ns
        flip_ns = self._begun_ns + -(-since_ns // self.refresh_ns) * self.refresh_ns
        self._stage.show(profile, asked_ns=flip_ns)
        self._stage.clock.wait_until(flip_ns, self._state.closed)
        return flip_ns


@dataclass(frozen=True, slots=True)
class Webcam:
    """What a camera on USB is like. Times in s; jitter_s: its stamps come later by up to so much, at random; the
    probabilities are of one frame. damaged: rows of it are noise, and nothing says so. start_s: from arming to its
    first frame, which arming waits for; 0: it begins at once, and where in its period is chance.
    """

    fps: float = 30.0
    start_s: float = 0.0
    delivery_s: float = 0.02
    jitter_s: float = 0.0005
    lost: float = 0.0
    damaged: float = 0.0


class LiveCamera:
    """Implements `Camera` on a stage: one thread uses it at a time."""

    def __init__(self, name: str, stage: Stage, webcam: Webcam, *, seed: int = 0) -> None:
        self.info = CameraInfo(
            name, "live", "0", stage.format, frozenset({Trigger.FREE}), (1e-3, 1 / webcam.fps), (1.0, 1.0)
        )
        self._stage, self._webcam = stage, webcam
        self._rng = np.random.default_rng(seed)
        self._state = CameraState(name)
        self._exposure_ns = 10_000_000
        self._period_ns = round(1e9 / webcam.fps)
        self._begun_ns = self._next = self._number = self._dropped = 0
        self._kept: deque[tuple[Exposed, int]] = deque()

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self._state.check_settings(settings, self.info)
        self._exposure_ns = round(settings.exposure_s * 1e9)
        return AppliedSettings(settings.exposure_s, settings.gain, self._period_ns / 1e9)

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`."""
        self._state.check_arming(count, trigger, self.info)
        self._state.armed = trigger
        start_s = self._webcam.start_s
        starts_ns = round(start_s * 1e9) or round(self._period_ns * float(self._rng.random()))
        self._begun_ns = self._stage.clock.now_ns() + starts_ns
        if start_s:
            self._stage.clock.wait_until(self._begun_ns, self._state.closed)
        self._next, self._number, self._dropped = 0, -1, 0
        self._kept.clear()

    def trigger(self) -> None:
        self._state.require_armed(Trigger.SOFTWARE)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        give_up_ns = self._stage.clock.now_ns() + round(timeout_s * 1e9)
        while True:
            self._state.require_armed()
            self._fill()
            while self._kept:
                kept, stamp_ns = self._kept.popleft()
                self._dropped += kept.number - self._number - 1
                self._number = kept.number
                exposure = self._claimed(kept, stamp_ns)
                if exposure.earliest_ns >= after_ns:
                    start_ns, end_ns, error_ns = exposure.centred_exposure(self._exposure_ns)
                    image = self._image(kept)
                    exposure_s = self._exposure_ns / 1e9
                    return Frame(
                        self.info.name, image, start_ns, end_ns, error_ns, self._number, self._dropped, exposure_s, 1.0
                    )
            if self._stage.clock.now_ns() >= give_up_ns:
                message = f"no frame in {timeout_s} s"
                raise FrameTimeoutError(message)
            self._stage.clock.wait_until(min(self._delivered_ns(self._next), give_up_ns), self._state.closed)

    def disarm(self) -> None:
        self._state.armed = None

    def close(self) -> None:
        self._state.close()

    def _delivered_ns(self, number: int) -> int:
        end_ns = self._begun_ns + number * self._period_ns + self._exposure_ns
        return end_ns + round(self._webcam.delivery_s * 1e9)

    def _fill(self) -> None:
        """Take what was delivered until now into the buffers; what finds none is lost."""
        while self._delivered_ns(self._next) <= self._stage.clock.now_ns():
            number, self._next = self._next, self._next + 1
            if self._rng.random() < self._webcam.lost or len(self._kept) == BUFFERS:
                continue
            start_ns = self._begun_ns + number * self._period_ns
            end_ns = start_ns + self._exposure_ns
            stamp_ns = end_ns + round(self._webcam.jitter_s * float(self._rng.random()) * 1e9)
            self._kept.append((Exposed(number, start_ns, end_ns), stamp_ns))

    def _claimed(self, kept: Exposed, stamp_ns: int) -> ExposureInterval:
        stamp = BufferStamp(StampSource.EXPOSURE_START, stamp_ns, kept.t_start_ns, self._stage.clock.now_ns())
        return exposure_interval(stamp, SensorDurations(self._exposure_ns, self._period_ns))

    def _image(self, kept: Exposed) -> Pixels:
        image = self._stage.exposed(kept.t_start_ns, kept.t_end_ns)
        if self._rng.random() < self._webcam.damaged:
            rows = slice(image.shape[0] // 3, 2 * image.shape[0] // 3)
            image[rows] = self._rng.integers(0, self.info.format.full_scale, image[rows].shape, image.dtype)
        return image


def live_rig(stage: Stage, *webcams: Webcam, refresh_hz: float, exposure_s: float) -> Rig:
    """A rig of one camera or two, on the stage's clock."""
    cameras = {
        name: LiveCamera(name, stage, each, seed=seed)
        for seed, (name, each) in enumerate(zip(EYES, webcams, strict=False))
    }
    settings = dict.fromkeys(cameras, CameraSettings(exposure_s))
    return Rig("live", cameras, LiveDisplay(stage, refresh_hz=refresh_hz), settings, clock=stage.clock)
