"""A camera on a stage and at the end of a trigger wire, before a projector whose driver is under test."""

from __future__ import annotations

import threading
import time
from collections import deque
from dataclasses import dataclass

from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, CameraState, Trigger
from slrig.errors import FrameTimeoutError
from slrig.model import Frame
from tests.contract.stage import Stage

WIRE_NS = 20_000
_ERR_NS = 1_000


@dataclass(frozen=True, slots=True)
class _Exposure:
    number: int
    t_start_ns: int
    t_end_ns: int


class WiredCamera:
    """Implements `Camera` on a stage: exposes by software trigger, or at each pulse on its wire. Thread-safe.

    usual_s : its exposure until it is configured. exposures_s, gains : their ranges. readout_s : beside the next
    exposure; what comes before the sensor is ready is lost. tells : whether the camera says how long that takes.
    """

    def __init__(
        self,
        name: str,
        stage: Stage,
        *,
        usual_s: float = 0.01,
        exposures_s: tuple[float, float] = (0.0005, 0.05),
        gains: tuple[float, float] = (1.0, 4.0),
        readout_s: float = 0.0,
        tells: bool = True,
    ) -> None:
        self._stage, self._readout_s, self._tells = stage, readout_s, tells
        triggers = frozenset({Trigger.SOFTWARE, Trigger.HARDWARE})
        self.info = CameraInfo(name, "wired", "0", stage.format, triggers, exposures_s, gains)
        self._changed = threading.Condition()
        self._settings = CameraSettings(usual_s)
        self._state = CameraState(name)
        self._room = self._number = self._missed = self._busy_until_ns = 0
        self._exposures: deque[_Exposure] = deque()

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`."""
        with self._changed:
            self._state.check_settings(settings, self.info)
            self._settings = settings
            least_period_s = max(settings.exposure_s, self._readout_s) + WIRE_NS / 1e9
            return AppliedSettings(settings.exposure_s, settings.gain, least_period_s if self._tells else None)

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.check_arming(count, trigger, self.info)
            self._state.armed, self._room, self._missed = trigger, count, 0

    def trigger(self) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.require_armed(Trigger.SOFTWARE)
            # As many are under way as were triggered: each begins when the one before it has ended.
            self._expose(max(time.monotonic_ns(), self._busy_until_ns))

    def pulse(self, t_ns: int) -> None:
        """Take an edge on the wire. A sensor that is at work takes no notice."""
        with self._changed:
            if self._state.armed is Trigger.HARDWARE:
                self._expose(t_ns + WIRE_NS)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                self._state.require_armed()
                while self._exposures and self._exposures[0].t_start_ns < after_ns:
                    self._exposures.popleft()
                left_s = until_s - time.monotonic()
                under_way_s = 0.0
                if self._exposures:
                    under_way_s = (self._exposures[0].t_end_ns - time.monotonic_ns()) / 1e9
                    if under_way_s <= 0:
                        return self._frame(self._exposures.popleft())
                if left_s <= 0:
                    message = f"no frame began after {after_ns} ns within {timeout_s} s; see what triggers the camera"
                    raise FrameTimeoutError(message)
                self._changed.wait(min(left_s, under_way_s) if under_way_s > 0 else left_s)

    def disarm(self) -> None:
        """See `Camera`."""
        with self._changed:
            self._state.armed = None
            # An exposure under way ends here: the next trigger must not be lost to it.
            self._busy_until_ns = 0
            self._exposures.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """See `Camera`."""
        self._state.close()
        self.disarm()

    def _expose(self, begun_ns: int) -> None:
        if self._room == 0 or begun_ns < self._busy_until_ns:
            self._missed += 1
            return
        self._room -= 1
        end_ns = begun_ns + round(self._settings.exposure_s * 1e9)
        self._busy_until_ns = max(end_ns, begun_ns + round(self._readout_s * 1e9))
        self._exposures.append(_Exposure(self._number, begun_ns, end_ns))
        self._number += 1
        self._changed.notify_all()

    def _frame(self, exposure: _Exposure) -> Frame:
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
