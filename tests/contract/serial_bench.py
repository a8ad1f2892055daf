"""The serial projector on a trigger box at the end of a pseudo-terminal, before cameras that the box triggers by wire.

Everything above the wire is the real driver; below it is the reference core on a light engine in memory, whose light
falls on a stage.
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from drivers.serial_projector import open_projector
from drivers.serial_projector.pattern_set import crc32_of_each
from slrig.devices import AppliedSettings, Camera, CameraInfo, CameraSettings, Projector, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError, UnsupportedByDeviceError
from slrig.model import Calibration, Frame, PatternSequence, Size, Truth
from slrig.patterns.sequence import encode, scan_patterns
from tests.contract.stage import Stage
from tests.contract.suite import Bench
from tests.unit.capture.fake_rig import PROJECTOR
from tests.unit.capture.fake_rig import Scene as World
from tests.unit.drivers.serial_projector.engines import CoreEngine, Scene, description
from tests.unit.drivers.serial_projector.line import Noise, SerialLine

EXPOSURES_S = (0.0005, 0.05)
GAINS = (1.0, 4.0)


@dataclass(frozen=True, slots=True)
class _Exposure:
    number: int
    t_start_ns: int
    t_end_ns: int


class WiredCamera:
    """Implements `Camera` on a stage: exposes by software trigger, or at each pulse on its wire. Thread-safe."""

    def __init__(self, name: str, stage: Stage) -> None:
        self._stage = stage
        self._info = CameraInfo(
            name, "wired", "0", stage.format, frozenset({Trigger.SOFTWARE, Trigger.HARDWARE}), EXPOSURES_S, GAINS
        )
        self._changed = threading.Condition()
        self._settings = CameraSettings(0.01)
        self._armed: Trigger | None = None
        self._closed = False
        self._room = self._number = self._missed = 0
        self._exposures: deque[_Exposure] = deque()

    @property
    def info(self) -> CameraInfo:
        """See `Camera`."""
        return self._info

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        """See `Camera`."""
        with self._changed:
            if self._closed or self._armed is not None:
                message = "configure needs a camera that is open and disarmed; disarm it first"
                raise DeviceStateError(message)
            for what, asked, (least, most) in (
                ("exposure_s", settings.exposure_s, EXPOSURES_S),
                ("gain", settings.gain, GAINS),
            ):
                if not least <= asked <= most:
                    message = f"asked for {what} {asked}, the camera takes {least} to {most}; stay within that"
                    raise UnsupportedByDeviceError(message)
            self._settings = settings
            return AppliedSettings(settings.exposure_s, settings.gain)

    def arm(self, count: int, trigger: Trigger) -> None:
        """See `Camera`."""
        with self._changed:
            if self._closed or self._armed is not None:
                message = "arm needs a camera that is open and disarmed; disarm it first"
                raise DeviceStateError(message)
            if count < 1 or trigger not in self._info.triggers:
                message = (
                    f"asked for {count} frames by {trigger} trigger, the camera takes software and hardware; use one"
                )
                raise UnsupportedByDeviceError(message)
            self._armed, self._room, self._missed = trigger, count, 0
            self._exposures.clear()

    def trigger(self) -> None:
        """See `Camera`."""
        with self._changed:
            if self._armed is not Trigger.SOFTWARE:
                message = "trigger needs a camera that is armed for software triggers; arm it so"
                raise DeviceStateError(message)
            # As many are under way as were triggered: each begins when the one before it has ended.
            under_way = self._exposures[-1].t_end_ns if self._exposures else 0
            self._expose(max(time.monotonic_ns(), under_way))

    def pulse(self) -> None:
        """A pulse on the wire."""
        with self._changed:
            now_ns = time.monotonic_ns()
            if self._armed is not Trigger.HARDWARE:
                return
            if self._exposures and self._exposures[-1].t_end_ns > now_ns:
                # The sensor is at work, and nobody waits for it.
                self._missed += 1
                return
            self._expose(now_ns)

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        """See `Camera`."""
        until_s = time.monotonic() + timeout_s
        with self._changed:
            while True:
                if self._armed is None:
                    message = "read needs an armed camera; arm it first"
                    raise DeviceStateError(message)
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
            self._armed = None
            self._exposures.clear()
            self._changed.notify_all()

    def close(self) -> None:
        """See `Camera`."""
        self.disarm()
        self._closed = True

    def _expose(self, begun_ns: int) -> None:
        if self._room == 0:
            self._missed += 1
            return
        self._room -= 1
        self._exposures.append(_Exposure(self._number, begun_ns, begun_ns + round(self._settings.exposure_s * 1e9)))
        self._number += 1
        self._changed.notify_all()

    def _frame(self, exposure: _Exposure) -> Frame:
        image = self._stage.exposed(exposure.t_start_ns, exposure.t_end_ns, gain=self._settings.gain)
        return Frame(
            self._info.name,
            image,
            exposure.t_start_ns,
            exposure.t_end_ns,
            1_000,
            exposure.number,
            self._missed,
            self._settings.exposure_s,
            self._settings.gain,
        )


def sequence(projector: Size = PROJECTOR) -> PatternSequence:
    """A whole scan for a projector of this size."""
    patterns = scan_patterns(
        projector, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return encode(patterns, projector)


@dataclass
class TriggerBox:
    """A box with a sequence in its flash, its light on a stage and its wire to cameras."""

    stage: Stage
    flashed: PatternSequence
    noise: Noise = field(default_factory=Noise)
    drift: float = 30e-6
    cameras: dict[str, WiredCamera] = field(default_factory=dict)
    line: SerialLine = field(init=False)

    def __post_init__(self) -> None:
        size = self.flashed.projector
        scene = Scene(watch=[self._lit], on_pulse=[self._pulsed])
        about = description(crc32_of_each(self.flashed), width_px=size.width_px, height_px=size.height_px)
        self.line = SerialLine(CoreEngine(scene, about, drift=self.drift), noise=self.noise)
        atexit.register(self.line.close)

    def projector(self, **options: object) -> Projector:
        """Open it with the real driver."""
        return open_projector({"port": self.line.path, **options}, Path())

    def _lit(self, pattern: int | None) -> None:
        self.stage.show(None if pattern is None else self.flashed.profiles[pattern])

    def _pulsed(self) -> None:
        for camera in self.cameras.values():
            camera.pulse()


@dataclass
class SerialHead:
    """Implements `slrig.devices.Head`: a box and the cameras on its wire."""

    cameras: Mapping[str, Camera]
    projector: Projector

    @property
    def calibration(self) -> Calibration | None:
        return None

    def truth(self) -> Truth | None:
        return None


def bench(folder: Path, *, noise: Noise | None = None, **options: object) -> Bench:  # noqa: ARG001 - as every bench
    """A box and two cameras as an instrument for the contract suite; `options` are the driver's."""
    flashed = sequence()
    stage = Stage(World(noise_dn=0.8))
    box = TriggerBox(stage, flashed, noise or Noise())

    def open_head() -> SerialHead:
        projector = box.projector(**options)
        box.cameras = {name: WiredCamera(name, stage) for name in ("left", "right")}
        return SerialHead(dict(box.cameras), projector)

    return Bench(open_head, flashed)
