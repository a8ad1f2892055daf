"""Software synchronisation: how much later than the projector says its light is there, and for how long to wait.

`measure_latency` flashes the projector and times the light with each camera's own time stamps; `stable_from_ns` is
what a scan waits for. What matters for a scan is only the sum of what projector and camera state wrongly: whether the
light is late or the time stamps are early, a frame that begins `latency_s` later by its stamps has the new light alone.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from slrig.capture.latency_fit import CameraLatency, Flash, RowLevels, fitted, row_levels, rows_of
from slrig.devices import Camera, CameraSettings, Rig, Shown, Synchronisation, Trigger
from slrig.errors import FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Black, FloatArray, Frame, PatternSequence, Pixels, Size, White

USUAL_TRIALS = 40
USUAL_SEARCH_S = 0.5

_WHITE, _BLACK = 0, 1
_STEADY_FRAMES = 8  # of white and of black: mean, noise and period are taken from them
_FRAMES_AFTER = 3  # in the new light, before a flash is over
_GONE = 0.9  # of the way to the new light
_FLASHES_PER_TRIAL = 8  # at most: a flash counts only if it comes during an exposure
_RARELY = 0.25
"""Of the flashes. Where fewer are seen as they happen, the camera is started anew: a display and a camera whose rates
are multiples of each other keep the phase in which they began, and with it what they miss.
"""
_TRIES = 3  # for one frame that is lost
_TIMEOUT_S = 2.0  # of one frame


@dataclass(frozen=True, slots=True)
class LatencyMeasurement:
    """What a flash test found, for each camera. shown_error_s : the least error that the projector stated."""

    cameras: Mapping[str, CameraLatency]
    shown_error_s: float

    @property
    def slowest(self) -> CameraLatency:
        """What the camera tells by whose time stamps light is stable last: the one to wait for."""
        return max(self.cameras.values(), key=lambda found: found.latest_s)

    @property
    def line_time_s(self) -> Mapping[str, float]:
        """Of the cameras with a rolling shutter."""
        return {name: found.line_time_s for name, found in self.cameras.items() if found.rolling}

    @property
    def synchronisation(self) -> Synchronisation:
        """What a rig file keeps of it."""
        slowest = self.slowest
        late_s = max(slowest.latest_s - slowest.latency_s, 3 * slowest.standard_error_s)
        return Synchronisation(
            slowest.latency_s,
            late_s - self.shown_error_s,
            self.line_time_s,
            earliest_s=min(found.earliest_s for found in self.cameras.values()),
        )


def stable_from_ns(shown: Shown, synchronisation: Synchronisation | None) -> int:
    """Return the instant from which a pattern's light is the only one, the rig's clock, ns.

    Where latency was measured, that counts, later or earlier than what the projector states.
    """
    stated_ns = shown.t_visible_ns + shown.t_err_ns
    if synchronisation is None:
        return stated_ns
    return stated_ns + round((synchronisation.latency_s + synchronisation.latency_error_s) * 1e9)


def shutter_skew_s(camera: Camera, name: str, synchronisation: Synchronisation | None) -> float:
    """Return how much later than its first row a camera's last row is exposed, as far as that was measured."""
    line_time_s = 0.0 if synchronisation is None else synchronisation.line_time_s.get(name, 0.0)
    return line_time_s * (camera.info.format.size.height_px - 1)


def measure_latency(
    rig: Rig,
    *,
    trials: int = USUAL_TRIALS,
    search_s: float = USUAL_SEARCH_S,
    exposure_s: float | None = None,
    trigger: Trigger | None = None,
    told: Callable[[str, float, str], None] = lambda _stage, _fraction, _detail: None,
) -> LatencyMeasurement:
    """Flash the projector before each camera in turn, at random moments of its frame period, and time the light.

    However it ends, the projector is dark and the cameras are disarmed afterwards.

    trials : how many flashes each camera must see while they happen. search_s : how late light may be, from the instant
    that the projector states. exposure_s : for the test; None is that of the rig's settings; longer exposures see more
    flashes as they happen. trigger : how exposures are started; None prefers freely running cameras: they watch while
    the projector works.

    Raises ScanEvidenceError: no flash was seen, everything is saturated, or the light never changed during an exposure;
    UnsupportedByDeviceError: a camera can be triggered by wire only, or not in the way or with the exposure asked for;
    FrameTimeoutError, DeviceError: a device failed or is gone.
    """
    measured: dict[str, CameraLatency] = {}
    errors_s: list[float] = []
    projector = rig.projector
    try:
        projector.load(_white_and_black(projector.info.size))
        for index, (name, camera) in enumerate(rig.cameras.items()):
            settings = rig.settings.get(name)
            if settings is not None:
                camera.configure(settings if exposure_s is None else replace(settings, exposure_s=exposure_s))
            elif exposure_s is not None:
                camera.configure(CameraSettings(exposure_s))
            test = _FlashTest(rig, name, camera, _trigger(name, camera, trigger), search_s)
            rng = np.random.default_rng((0, index))
            try:
                measured[name] = test.run(trials, rng, told)
            finally:
                with suppress(Exception):
                    camera.disarm()
            errors_s.append(test.least_error_ns / 1e9)
    finally:
        with suppress(Exception):
            projector.blank()
    projector.blank()
    return LatencyMeasurement(measured, min(errors_s))


def _white_and_black(size: Size) -> PatternSequence:
    levels = (255, 0)
    return PatternSequence(size, (White(), Black()), tuple(np.full((1, 1), level, np.uint8) for level in levels))


def _trigger(name: str, camera: Camera, asked: Trigger | None) -> Trigger:
    offered = camera.info.triggers
    for trigger in (Trigger.FREE, Trigger.SOFTWARE):
        if trigger in offered and asked in (None, trigger):
            return trigger
    raise UnsupportedByDeviceError(
        f"camera '{name}' can be triggered by: {', '.join(sorted(offered)) or 'none'}; latency is measured with "
        f"{'a free-running or software-triggered camera' if asked is None else f'{asked} trigger as asked'}, and a "
        "projector that triggers its cameras by wire needs no latency"
    )


@dataclass
class _FlashTest:
    """One camera's test: steady levels of white and black, then flashes."""

    rig: Rig
    name: str
    camera: Camera
    trigger: Trigger
    search_s: float
    least_error_ns: int = 2**62
    period_ns: int = 0
    never: threading.Event = field(default_factory=threading.Event)

    def run(self, trials: int, rng: np.random.Generator, told: Callable[[str, float, str], None]) -> CameraLatency:
        stage = f"flashes before {self.name}"
        told(stage, 0.0, "steady light")
        most = _FLASHES_PER_TRIAL * trials
        frames = 2 * _STEADY_FRAMES + most * (_FRAMES_AFTER + 3)
        self.camera.arm(frames, self.trigger)
        black, white = self._steady(_BLACK), self._steady(_WHITE)
        full_scale = self.camera.info.format.full_scale
        levels = row_levels(self.name, black, white, full_scale=full_scale)
        flashes: list[Flash] = []
        used = 0
        while used < trials and len(flashes) < most and not self._is_hopeless(flashes, used, trials):
            flash = self._flash(levels, rng, to_white=len(flashes) % 2 == 1)
            flashes.append(flash)
            used += rows_of(flash, levels) is not None
            if len(flashes) % trials == 0 and used < _RARELY * len(flashes):
                self.camera.disarm()
                self.camera.arm(frames, self.trigger)
            told(stage, used / trials, f"{used} of {trials} flashes")
        return fitted(self.name, flashes, levels)

    def _is_hopeless(self, flashes: list[Flash], used: int, trials: int) -> bool:
        """Whether going on would only take longer to say that it cannot be measured."""
        return used == 0 and len(flashes) >= max(2 * trials, 16)

    def _steady(self, index: int) -> list[Pixels]:
        """Return frames of a light that has been shown for as long as a change may take."""
        shown = self._show(index)
        steady_ns = shown.t_visible_ns + round(self.search_s * 1e9)
        self.rig.clock.wait_until(steady_ns, self.never)
        frames = [self._next(after_ns=steady_ns) for _ in range(_STEADY_FRAMES)]
        self.period_ns = int(np.median(np.diff([frame.t_start_ns for frame in frames])))
        return [frame.image for frame in frames]

    def _flash(self, levels: RowLevels, rng: np.random.Generator, *, to_white: bool) -> Flash:
        # The camera's last frame is taken just now, so the wait falls anywhere in its period.
        waiting_ns = round(float(rng.random()) * self.period_ns)
        pending = self.trigger is Trigger.SOFTWARE
        if pending:
            self.camera.trigger()
        else:
            self._next(after_ns=self.rig.clock.now_ns())
        self._wait(waiting_ns)
        shown = self._show(_WHITE if to_white else _BLACK)
        until_ns = shown.t_visible_ns + round(self.search_s * 1e9)
        frames: list[tuple[int, float, FloatArray]] = []
        after = 0
        while after < _FRAMES_AFTER and not (frames and frames[-1][0] > until_ns):
            if pending:
                pending = False
                # The exposures after this one follow each other at a period of their own: again anywhere in it.
                resumed_ns = round(float(rng.random()) * self.period_ns)
                try:
                    frame = self._read(0)
                except FrameTimeoutError:
                    continue
                finally:
                    self._wait(resumed_ns)
            else:
                frame = self._next(after_ns=0)
            shares = levels.shares(frame.image)
            frames.append((frame.t_start_ns, frame.exposure_s, shares))
            share = float(np.nanmedian(shares))
            after += (share if to_white else 1 - share) > _GONE
        return Flash.of(to_white, shown, frames)

    def _show(self, index: int) -> Shown:
        shown = self.rig.projector.show(index)
        self.least_error_ns = min(self.least_error_ns, shown.t_err_ns)
        return shown

    def _wait(self, span_ns: int) -> None:
        self.rig.clock.wait_until(self.rig.clock.now_ns() + span_ns, self.never)

    def _next(self, *, after_ns: int) -> Frame:
        """Return the next frame, taken now where a trigger is needed; one that is lost is asked for again."""
        for _ in range(_TRIES - 1):
            if self.trigger is Trigger.SOFTWARE:
                self.camera.trigger()
            with suppress(FrameTimeoutError):
                return self._read(after_ns)
        if self.trigger is Trigger.SOFTWARE:
            self.camera.trigger()
        return self._read(after_ns)

    def _read(self, after_ns: int) -> Frame:
        return self.camera.read(after_ns, _TIMEOUT_S)
