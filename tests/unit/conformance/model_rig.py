"""A rig that keeps the contract, on virtual time: every trigger there is, and a projector that plays."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slrig.devices import (
    AppliedSettings,
    CameraInfo,
    CameraSettings,
    CameraState,
    ProjectorInfo,
    ProjectorState,
    Rig,
    Shown,
    Trigger,
)
from slrig.errors import FrameTimeoutError
from slrig.model import Calibration, Frame, PatternSequence, Pixels, Size
from slrig.patterns.sequence import encode
from tests.contract.stage import REFERENCE_EXPOSURE_S, Stage
from tests.contract.suite import BenchHead
from tests.unit.capture.fake_rig import Scene, patterns_for

PROJECTOR = Size(64, 48)
CAMERA = Size(110, 80)
EXPOSURE_S = 1 / 60
LATENCY_NS = 5_000_000
ERROR_NS = 20_000
READ_OUT_NS = 1_000_000
BUFFERS = 4
ALL = frozenset(Trigger)


def sequence() -> PatternSequence:
    return encode(patterns_for(PROJECTOR), PROJECTOR)


class World(Stage):
    """Time that passes when somebody waits, and the light in it. Implements `slrig.devices.Clock`."""

    def __init__(self) -> None:
        self.at_ns = 10**9
        self.on_wire: list[Callable[[int], None]] = []
        super().__init__(Scene(camera=CAMERA, projector=PROJECTOR, noise_dn=0.8), clock=self)

    def now_ns(self) -> int:
        return self.at_ns

    def wait_until(self, t_ns: int, stop: threading.Event) -> None:
        if not stop.is_set():
            self.at_ns = max(self.at_ns, t_ns)

    def change(self, at_ns: int, profile: Pixels | None) -> None:
        self.changes.append((at_ns, self.dark if profile is None else profile))

    def darken(self) -> None:
        self.changes = [change for change in self.changes if change[0] < self.at_ns]
        self.change(self.at_ns, None)


@dataclass(frozen=True)
class Exposure:
    """One exposure of the sensor."""

    number: int
    start_ns: int
    end_ns: int


class ModelCamera(CameraState):
    """Implements `slrig.devices.Camera`."""

    triggers = ALL

    def __init__(self, world: World, name: str = "left") -> None:
        super().__init__(name)
        self.world = world
        self.applied = AppliedSettings(EXPOSURE_S, 1.0)
        self.pending: deque[Exposure] = deque()
        self.made = 0
        self.next_free_ns = 0
        self.busy_ns = 0
        world.on_wire.append(self.pulsed)

    @property
    def info(self) -> CameraInfo:
        form = self.world.scene.format
        return CameraInfo(self.name, "model", "1", form, self.triggers, (1e-4, 0.5), (1.0, 8.0), colour=True)

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self.check_settings(settings, self.info)
        self.applied = AppliedSettings(settings.exposure_s, settings.gain)
        return self.applied

    def arm(self, count: int, trigger: Trigger) -> None:
        self.check_arming(count, trigger, self.info)
        self.pending.clear()
        self.armed = trigger
        self.next_free_ns = self.world.at_ns

    def trigger(self) -> None:
        self.require_armed(Trigger.SOFTWARE)
        self.start(self.world.at_ns + 1_000)

    def pulsed(self, at_ns: int) -> None:
        if self.armed is Trigger.HARDWARE:
            self.start(at_ns)

    def cut_off(self, at_ns: int) -> None:
        """Pulses of the wire after an instant do not come."""
        while self.armed is Trigger.HARDWARE and self.pending and self.pending[-1].start_ns > at_ns:
            self.pending.pop()
            self.made -= 1
        self.busy_ns = min(self.busy_ns, max((e.end_ns for e in self.pending), default=at_ns))

    def start(self, at_ns: int) -> None:
        start_ns = max(at_ns, self.busy_ns)
        self.busy_ns = start_ns + round(self.applied.exposure_s * 1e9)
        self.pending.append(Exposure(self.made, start_ns, self.busy_ns))
        self.made += 1

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        self.require_armed()
        deadline_ns = self.world.at_ns + round(timeout_s * 1e9)
        while (exposure := self.next_exposure(deadline_ns)) is not None:
            self.world.at_ns = max(self.world.at_ns, exposure.end_ns + READ_OUT_NS)
            if exposure.start_ns >= after_ns:
                return self.frame(exposure)
        self.world.at_ns = max(self.world.at_ns, deadline_ns)
        message = f"no frame in {timeout_s} s"
        raise FrameTimeoutError(message)

    def next_exposure(self, deadline_ns: int) -> Exposure | None:
        if self.armed is Trigger.FREE:
            self.run_freely()
        if self.pending and self.pending[0].end_ns <= deadline_ns:
            return self.pending.popleft()
        return None

    def run_freely(self) -> None:
        """Expose as often as there was time for, keep as many as there are buffers, and begin the next one."""
        period_ns = round(self.applied.exposure_s * 1e9) + READ_OUT_NS
        while not self.pending or self.pending[-1].end_ns <= self.world.at_ns:
            start_ns = self.next_free_ns
            self.pending.append(Exposure(self.made, start_ns, start_ns + period_ns - READ_OUT_NS))
            self.made += 1
            self.next_free_ns += period_ns
        while len(self.pending) > BUFFERS + 1:
            self.pending.popleft()

    def frame(self, exposure: Exposure) -> Frame:
        end_ns = exposure.start_ns + round(self.applied.exposure_s * 1e9)
        gain = self.applied.gain * REFERENCE_EXPOSURE_S / EXPOSURE_S
        image = self.world.exposed(exposure.start_ns, end_ns, gain=gain)
        return Frame(
            self.name,
            image,
            exposure.start_ns,
            exposure.end_ns,
            1_000,
            exposure.number,
            0,
            self.applied.exposure_s,
            self.applied.gain,
            colour=lambda: np.dstack([image // 2, image, image // 3]),
        )

    def disarm(self) -> None:
        self.armed = None
        self.pending.clear()

    def close(self) -> Any:
        self.disarm()
        super().close()


class ModelProjector(ProjectorState):
    """Implements `slrig.devices.Projector`."""

    plays = True

    def __init__(self, world: World) -> None:
        super().__init__("the model")
        self.world = world

    @property
    def info(self) -> ProjectorInfo:
        return ProjectorInfo("projector", "model", "1", PROJECTOR, self.plays, LATENCY_NS / 1e9)

    def load(self, sequence: PatternSequence) -> None:
        self.require_open()
        self.require_size(sequence, PROJECTOR)
        self.blank()
        self.loaded = sequence

    def show(self, index: int) -> Shown:
        profile = self.profile(index)
        at_ns = self.world.at_ns + LATENCY_NS
        self.world.change(at_ns, profile)
        self.world.at_ns = at_ns + ERROR_NS
        return Shown(index, at_ns, ERROR_NS)

    def profile(self, index: int) -> Pixels:
        return self.require_pattern(index).profiles[index]

    def play(self, exposure_s: float, period_s: float) -> None:
        if not self.plays:
            self.refuse_to_play(exposure_s, period_s)
        assert exposure_s < period_s
        sequence = self.require_loaded("play")
        begin_ns = self.world.at_ns + LATENCY_NS
        for index, profile in enumerate(sequence.profiles):
            at_ns = begin_ns + round(index * period_s * 1e9)
            self.world.change(at_ns, profile)
            self.pulse(index, at_ns)
        self.world.change(begin_ns + round(len(sequence) * period_s * 1e9), None)

    def pulse(self, _index: int, at_ns: int) -> None:
        for expose in self.world.on_wire:
            expose(at_ns)

    def stop(self) -> None:
        for camera in self.cameras:
            camera.cut_off(self.world.at_ns)
        self.blank()

    @property
    def cameras(self) -> list[ModelCamera]:
        owners = (getattr(expose, "__self__", None) for expose in self.world.on_wire)
        return [camera for camera in owners if isinstance(camera, ModelCamera)]

    def blank(self) -> None:
        if not self.closed.is_set():
            self.world.darken()

    def close(self) -> None:
        self.blank()
        self.loaded = None
        self.closed.set()


@dataclass
class Maker:
    """Opens a rig of these classes, each time one in a world of its own; `rigs` are those that were opened.

    change : what becomes of each.
    """

    camera: type[ModelCamera] = ModelCamera
    projector: type[ModelProjector] = ModelProjector
    calibration: Calibration | None = None
    rigs: list[Rig] = field(default_factory=list)
    change: Callable[[Rig], Rig] = field(default=lambda rig: rig)

    def __call__(self) -> Rig:
        world = World()
        head = BenchHead({"left": self.camera(world)}, self.projector(world), clock=world)
        settings = {"left": CameraSettings(EXPOSURE_S)}
        rig = Rig("model", head.cameras, head.projector, settings, self.calibration, head, clock=world)
        self.rigs.append(self.change(rig))
        return self.rigs[-1]
