"""A camera on a stage and at the end of a trigger wire, before a projector whose driver is under test."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass

from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, SystemClock, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame
from tests.contract.stage import Stage

WIRE_NS = 20_000
_ERR_NS = 1_000


@dataclass(frozen=True, slots=True)
class Exposure:
    """One exposure of the sensor."""

    number: int
    t_start_ns: int
    t_end_ns: int


class WiredCamera:
    """Implements `Camera` on a stage: exposes by software trigger, or at each pulse on its wire. Thread-safe.

    usual_s : its exposure until it is configured. exposures_s, gains : their ranges.
    """

    def __init__(
        self,
        name: str,
        stage: Stage,
        *,
        usual_s: float = 0.01,
        exposures_s: tuple[float, float] = (0.0005, 0.05),
        gains: tuple[float, float] = (1.0, 4.0),
    ) -> None:
        self._stage, self._clock = stage, SystemClock()
        triggers = frozenset({Trigger.SOFTWARE, Trigger.HARDWARE})
        self.info = CameraInfo(name, "wired", "0", stage.format, triggers, exposures_s, gains)
        self._lock, self._changed = threading.RLock(), threading.Event()
        self._settings = CameraSettings(usual_s)
        self._state = CameraState(name)
        self._room = self._number = self._missed = self._busy_until_ns = 0
        self._exposures: deque[Exposure] = deque()

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        with self._lock:
            self._state.check_settings(settings, self.info)
            self._settings = settings
            return AppliedSettings(settings.exposure_s, settings.gain, settings.exposure_s + WIRE_NS / 1e9)

    def arm(self, count: int, trigger: Trigger) -> None:
        with self._lock:
            self._state.check_arming(count, trigger, self.info)
            self._state.armed, self._room, self._missed = trigger, count, 0

    def trigger(self) -> None:
        with self._lock:
            self._state.require_armed(Trigger.SOFTWARE)
            # As many are under way as were triggered: each begins when the one before it has ended.
            self._expose(max(self._clock.now_ns(), self._busy_until_ns))

    def pulse(self, t_ns: int) -> None:
        """Take an edge on the wire. A sensor that is at work takes no notice."""
        with self._lock:
            if self._state.armed is Trigger.HARDWARE:
                self._expose(t_ns + WIRE_NS)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        until_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while True:
            with self._lock:
                self._changed.clear()
                self._state.require_armed()
                while self._exposures and self._exposures[0].t_start_ns < after_ns:
                    self._exposures.popleft()
                now_ns = self._clock.now_ns()
                next_ns = self._exposures[0].t_end_ns if self._exposures else until_ns
                if self._exposures and next_ns <= now_ns:
                    return self._frame(self._exposures.popleft())
                if now_ns >= until_ns:
                    message = f"no frame began after {after_ns} ns within {timeout_s} s; see what triggers the camera"
                    raise FrameTimeoutError(message)
            self._clock.wait_until(min(next_ns, until_ns), self._changed)

    def disarm(self) -> None:
        with self._lock:
            self._state.armed = None
            # An exposure under way ends here: the next trigger must not be lost to it.
            self._busy_until_ns = 0
            self._exposures.clear()
            self._changed.set()

    def close(self) -> None:
        self._state.close()
        self.disarm()

    def _expose(self, begun_ns: int) -> None:
        if self._room == 0 or begun_ns < self._busy_until_ns:
            self._missed += 1
            return
        self._room -= 1
        end_ns = begun_ns + round(self._settings.exposure_s * 1e9)
        self._busy_until_ns = end_ns
        self._exposures.append(Exposure(self._number, begun_ns, end_ns))
        self._number += 1
        self._changed.set()

    def _frame(self, exposure: Exposure) -> Frame:
        settings = self._settings
        image = self._stage.exposed(exposure.t_start_ns, exposure.t_end_ns, gain=settings.gain)
        return Frame(
            self.info.name,
            image,
            exposure.t_start_ns,
            exposure.t_end_ns,
            _ERR_NS,
            exposure.number,
            self._missed,
            settings.exposure_s,
            settings.gain,
        )
