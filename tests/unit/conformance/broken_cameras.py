"""Cameras that break the contract, each in one way, as drivers in the field do."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, Trigger
from slrig.errors import DeviceStateError, FrameTimeoutError
from slrig.model import CameraFormat, Frame, Size
from tests.unit.conformance.model_rig import READ_OUT_NS, Exposure, ModelCamera


class RunsFreely(ModelCamera):
    """Breaks nothing: a camera that runs by itself only, as webcams do."""

    triggers = frozenset({Trigger.FREE})


class DeliversStale(ModelCamera):
    """Ignores how early a frame may begin."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        return super().read(min(after_ns, 0), timeout_s)


class DeliversStaleFreely(DeliversStale):
    """As above, running freely: what waits in the driver's buffers comes first."""

    triggers = RunsFreely.triggers


class FlushesOneFrame(RunsFreely):
    """Throws one frame away, and believes that the next one is new."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        super().read(0, timeout_s)
        frame = super().read(0, timeout_s)
        # As it believes.
        late_ns = max(after_ns - frame.t_start_ns, 0)
        return replace(frame, t_start_ns=frame.t_start_ns + late_ns, t_end_ns=frame.t_end_ns + late_ns)


class BringsBack(ModelCamera):
    """Keeps what it has passed over for the next read."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        waiting = list(self.pending)
        try:
            return super().read(after_ns, timeout_s)
        except FrameTimeoutError:
            self.pending.extend(waiting)
            raise


class NeverGivesUp(ModelCamera):
    """Returns its last frame once more where there is no other."""

    last: Frame | None = None

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        try:
            self.last = super().read(after_ns, timeout_s)
        except FrameTimeoutError:
            exposure = Exposure(self.made, self.world.at_ns, self.world.at_ns + READ_OUT_NS)
            return self.last or self.frame(exposure)
        return self.last


class Hangs(ModelCamera):
    """Does not return from a read until it is let go."""

    let_go = threading.Event()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        self.let_go.wait()
        return super().read(after_ns, timeout_s)


class TriggersUnarmed(ModelCamera):
    """Ignores a trigger in the wrong state."""

    def trigger(self) -> None:
        if self.armed is Trigger.SOFTWARE:
            super().trigger()


class TriggersWhileFree(ModelCamera):
    """Ignores a trigger that it does not need."""

    def trigger(self) -> None:
        if self.armed is not Trigger.FREE:
            super().trigger()


class FiresWithoutPulse(ModelCamera):
    """Runs freely while it is armed for wire triggers."""

    def next_exposure(self, deadline_ns: int) -> Exposure | None:
        if self.armed is Trigger.HARDWARE:
            self.run_freely()
        return super().next_exposure(deadline_ns)


class ArmsAnyTrigger(ModelCamera):
    """Arms for what it does not declare."""

    triggers = frozenset({Trigger.SOFTWARE})

    def arm(self, count: int, trigger: Trigger) -> None:
        super().arm(count, Trigger.SOFTWARE if count > 0 else trigger)


class ArmsForNothing(ModelCamera):
    """Arms for no frames."""

    def arm(self, count: int, trigger: Trigger) -> None:
        super().arm(max(count, 1), trigger)


class KeepsOldFrames(ModelCamera):
    """Does not throw away what waits, neither in disarm nor in arm."""

    def disarm(self) -> None:
        if self.armed is Trigger.FREE:
            self.run_freely()
        self.armed = None

    def arm(self, count: int, trigger: Trigger) -> None:
        waiting = list(self.pending)
        super().arm(count, trigger)
        self.pending.extend(waiting)


class KeepsOldFramesFreely(KeepsOldFrames):
    """As above, running freely."""

    triggers = RunsFreely.triggers


class SetWhileArmed(ModelCamera):
    """Takes settings while it is armed."""

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        armed, self.armed = self.armed, None
        applied = super().configure(settings)
        self.armed = armed
        return applied


class TakesAnything(ModelCamera):
    """Takes every setting, and bends it into range."""

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        exposure_s, gain = (
            float(np.clip(value, low, high))
            for value, (low, high) in (
                (settings.exposure_s, self.info.exposure_range_s),
                (settings.gain, self.info.gain_range),
            )
        )
        return super().configure(CameraSettings(exposure_s, gain))


class RefusesTooLate(ModelCamera):
    """Refuses a setting once the device has it."""

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        try:
            return super().configure(settings)
        except DeviceStateError:
            raise
        except Exception:
            self.applied = AppliedSettings(1e-4, 1.0)
            raise


class StepsCoarsely(ModelCamera):
    """Takes whole hundredths of a second, and does not say so."""

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        super().configure(settings)
        self.applied = AppliedSettings(max(round(settings.exposure_s, 2), 1e-4), settings.gain)
        return self.applied


class ExposesAutomatically(ModelCamera):
    """Says that it uses what was set, and exposes as it sees fit."""

    def frame(self, exposure: Exposure) -> Frame:
        said, self.applied = self.applied, AppliedSettings(1 / 60, 1.0)
        frame = super().frame(exposure)
        self.applied = said
        return replace(frame, exposure_s=said.exposure_s, gain=said.gain)


class ForgetsItself(ModelCamera):
    """Asks the device for its data, and has none after close."""

    @property
    def info(self) -> CameraInfo:
        self.require()
        return super().info


class DeclaresNoLimit(ModelCamera):
    """Does not know its longest exposure."""

    @property
    def info(self) -> CameraInfo:
        return replace(super().info, exposure_range_s=(0.0, float("inf")))


class DeclaresTenBits(ModelCamera):
    """Sends samples of 16 bits, aligned to the left."""

    @property
    def info(self) -> CameraInfo:
        info = super().info
        return replace(info, format=CameraFormat(info.format.size, 10))

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        return replace(frame, image=frame.image.astype(np.uint16) * np.uint16(256))


class HasAnotherName(ModelCamera):
    """Calls itself as it likes."""

    @property
    def info(self) -> CameraInfo:
        return replace(super().info, name="camera0")


class IgnoresClose(ModelCamera):
    """Goes on after close."""

    def close(self) -> None:
        self.disarm()


class ClosesOnce(ModelCamera):
    """Cannot be closed again."""

    def close(self) -> None:
        self.require()
        super().close()


def delivering(change: Callable[[Frame], Frame]) -> type[ModelCamera]:
    """A camera that does this to every frame."""

    class Delivers(ModelCamera):
        """Delivers frames that are not as they should be."""

        def frame(self, exposure: Exposure) -> Frame:
            return change(super().frame(exposure))

    return Delivers


class ReusesItsBuffer(ModelCamera):
    """Hands out the same memory with every frame."""

    buffer = np.zeros((1, 1), np.uint8)

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        if self.buffer.shape != frame.image.shape:
            self.buffer = frame.image.copy()
        self.buffer[:] = frame.image
        return replace(frame, image=self.buffer)


class ColoursItsBuffer(ReusesItsBuffer):
    """Makes colour of the memory that the next frames are written to."""

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        return replace(frame, image=frame.image.copy(), colour=lambda: np.dstack([frame.image] * 3))


class DeclaresAnotherSize(ModelCamera):
    """Declares what its data sheet says, and sends what its mode gives."""

    @property
    def info(self) -> CameraInfo:
        return replace(super().info, format=CameraFormat(Size(1920, 1080), 8))


class MissesAPulse(ModelCamera):
    """Is still reading out when a pulse comes, now and then."""

    pulses = 0

    def pulsed(self, at_ns: int) -> None:
        self.pulses += 1
        if self.pulses % 5:
            super().pulsed(at_ns)
        elif self.armed is Trigger.HARDWARE:
            self.made += 1
