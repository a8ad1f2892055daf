"""A rig that keeps the contract, on virtual time, and drivers that break it, each in one way."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from slrig.devices import (
    AppliedSettings,
    CameraInfo,
    CameraSettings,
    CameraState,
    DisplayedPattern,
    ProjectorInfo,
    ProjectorState,
    Rig,
    Trigger,
)
from slrig.errors import DeviceStateError, FrameTimeoutError
from slrig.model import Calibration, CameraFormat, Frame, PatternSequence, Pixels, Size
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
        world.on_wire.append(self.receive_pulse)

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

    def receive_pulse(self, at_ns: int) -> None:
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

    def show(self, index: int) -> DisplayedPattern:
        profile = self.profile(index)
        at_ns = self.world.at_ns + LATENCY_NS
        self.world.change(at_ns, profile)
        self.world.at_ns = at_ns + ERROR_NS
        return DisplayedPattern(index, at_ns, ERROR_NS)

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


Device = type[ModelCamera] | type[ModelProjector]
DeviceT = TypeVar("DeviceT", bound=Device)

BROKEN: list[tuple[Device, str, str]] = []
"""A broken driver, the check that finds it, and text of the failure."""


def breaks(check: str, text: str = "no error") -> Callable[[DeviceT], DeviceT]:
    """Note what a driver breaks; "no error" is of a call that should have been refused."""

    def register(device: DeviceT) -> DeviceT:
        BROKEN.append((device, check, text))
        return device

    return register


class RunsFreely(ModelCamera):
    """Breaks nothing: a camera that runs by itself only, as webcams do."""

    triggers = frozenset({Trigger.FREE})


@breaks("read_passes_over_stale_frames", "ms before")
@breaks("stale_frames_never_come_back")
class DeliversStale(ModelCamera):
    """Ignores how early a frame may begin."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        return super().read(min(after_ns, 0), timeout_s)


@breaks("read_passes_over_stale_frames", "free trigger")
class _DeliversStaleFreely(DeliversStale):
    triggers = RunsFreely.triggers


@breaks("a_frame_lies_wholly_in_its_pattern", "of white's light")
class FlushesOneFrame(RunsFreely):
    """Throws one frame away, and believes that the next one is new."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        super().read(0, timeout_s)
        frame = super().read(0, timeout_s)
        # As it believes.
        late_ns = max(after_ns - frame.t_start_ns, 0)
        return replace(frame, t_start_ns=frame.t_start_ns + late_ns, t_end_ns=frame.t_end_ns + late_ns)


@breaks("stale_frames_never_come_back")
class BringsBack(ModelCamera):
    """Keeps what it has passed over for the next read."""

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        waiting = list(self.pending)
        try:
            return super().read(after_ns, timeout_s)
        except FrameTimeoutError:
            self.pending.extend(waiting)
            raise


@breaks("read_times_out_in_time")
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
    """Does not return from a read until it is released."""

    released = threading.Event()

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        self.released.wait()
        return super().read(after_ns, timeout_s)


@breaks("trigger_and_read_need_an_armed_camera")
class _TriggersUnarmed(ModelCamera):
    def trigger(self) -> None:
        if self.armed is Trigger.SOFTWARE:
            super().trigger()


@breaks("a_free_running_camera_needs_no_trigger")
class _TriggersWhileFree(ModelCamera):
    def trigger(self) -> None:
        if self.armed is not Trigger.FREE:
            super().trigger()


@breaks("a_wire_without_pulses_gives_no_frame")
class _FiresWithoutPulse(ModelCamera):
    def next_exposure(self, deadline_ns: int) -> Exposure | None:
        if self.armed is Trigger.HARDWARE:
            self.run_freely()
        return super().next_exposure(deadline_ns)


@breaks("triggers_that_are_not_declared_are_refused")
class _ArmsAnyTrigger(ModelCamera):
    triggers = frozenset({Trigger.SOFTWARE})

    def arm(self, count: int, trigger: Trigger) -> None:
        super().arm(count, Trigger.SOFTWARE if count > 0 else trigger)


@breaks("triggers_that_are_not_declared_are_refused")
class _ArmsForNothing(ModelCamera):
    def arm(self, count: int, trigger: Trigger) -> None:
        super().arm(max(count, 1), trigger)


@breaks("arming_again_starts_afresh")
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


@breaks("arming_again_starts_afresh", "of white's light")
class _KeepsOldFramesFreely(KeepsOldFrames):
    triggers = RunsFreely.triggers


@breaks("an_armed_camera_refuses_to_be_set_or_armed")
class _SetWhileArmed(ModelCamera):
    def configure(self, settings: CameraSettings) -> AppliedSettings:
        armed, self.armed = self.armed, None
        applied = super().configure(settings)
        self.armed = armed
        return applied


@breaks("settings_out_of_range_are_refused")
class _TakesAnything(ModelCamera):
    def configure(self, settings: CameraSettings) -> AppliedSettings:
        exposure_s, gain = (
            float(np.clip(value, low, high))
            for value, (low, high) in (
                (settings.exposure_s, self.info.exposure_range_s),
                (settings.gain, self.info.gain_range),
            )
        )
        return super().configure(CameraSettings(exposure_s, gain))


@breaks("settings_out_of_range_are_refused", "0.0001 s")
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


@breaks("settings_are_read_back", "0.02 s")
class _StepsCoarsely(ModelCamera):
    def configure(self, settings: CameraSettings) -> AppliedSettings:
        super().configure(settings)
        self.applied = AppliedSettings(max(round(settings.exposure_s, 2), 1e-4), settings.gain)
        return self.applied


@breaks("a_longer_exposure_is_brighter", "DN above black")
class ExposesAutomatically(ModelCamera):
    """Says that it uses what was set, and exposes as it sees fit."""

    def frame(self, exposure: Exposure) -> Frame:
        said, self.applied = self.applied, AppliedSettings(1 / 60, 1.0)
        frame = super().frame(exposure)
        self.applied = said
        return replace(frame, exposure_s=said.exposure_s, gain=said.gain)


@breaks("info_is_readable_in_every_state", "DeviceStateError")
class ForgetsItself(ModelCamera):
    """Asks the device for its data, and has none after close."""

    @property
    def info(self) -> CameraInfo:
        self.require_open()
        return super().info


@breaks("frames_are_as_declared", "no sample is above 1023")
class _DeclaresTenBits(ModelCamera):
    @property
    def info(self) -> CameraInfo:
        info = super().info
        return replace(info, format=CameraFormat(info.format.size, 10))

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        return replace(frame, image=frame.image.astype(np.uint16) * np.uint16(256))


@breaks("nothing_works_after_close")
class _IgnoresClose(ModelCamera):
    def close(self) -> Any:
        self.disarm()


@breaks("close_may_be_called_twice", "DeviceStateError")
class _ClosesOnce(ModelCamera):
    def close(self) -> Any:
        self.require_open()
        super().close()


@breaks("a_frame_keeps_its_pixels", "pixels changed")
class _ReusesItsBuffer(ModelCamera):
    buffer = np.zeros((1, 1), np.uint8)

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        if self.buffer.shape != frame.image.shape:
            self.buffer = frame.image.copy()
        self.buffer[:] = frame.image
        return replace(frame, image=self.buffer)


@breaks("frames_come_in_colour_where_it_is_declared", "0.0 DN of blue, green and red")
class ColoursItsBuffer(ModelCamera):
    """Makes colour of memory that the fourth frame after it is written to."""

    def __init__(self, world: World, name: str = "left") -> None:
        super().__init__(world, name)
        self.buffers: dict[int, Pixels] = {}

    def frame(self, exposure: Exposure) -> Frame:
        frame = super().frame(exposure)
        buffer = self.buffers.setdefault(exposure.number % 4, frame.image.copy())
        buffer[:] = frame.image
        return replace(frame, colour=lambda: np.dstack([buffer] * 3))


@breaks("a_played_sequence_gives_every_frame_in_order", "pulses make")
class MissesAPulse(ModelCamera):
    """Is still reading out when a pulse comes, now and then."""

    pulses = 0

    def receive_pulse(self, at_ns: int) -> None:
        self.pulses += 1
        if self.pulses % 5:
            super().receive_pulse(at_ns)
        elif self.armed is Trigger.HARDWARE:
            self.made += 1


@breaks("every_end_of_a_capture_is_dark_and_leaves_the_rig_usable", "dark after")
@breaks("the_projector_is_dark_unless_it_shows", "after blank")
class StaysLit(ModelProjector):
    """Does not go dark."""

    def blank(self) -> None:
        """Do nothing."""


@breaks("the_projector_is_dark_unless_it_shows", "after load")
class _StaysLitWhileLoading(ModelProjector):
    def load(self, sequence: PatternSequence) -> None:
        changes = list(self.world.changes)
        super().load(sequence)
        self.world.changes = changes


@breaks("the_projector_is_dark_after_opening_and_close", "after close")
class _StaysLitAfterClose(ModelProjector):
    def close(self) -> None:
        self.loaded = None
        self.closed.set()


@breaks("the_projector_is_dark_after_opening_and_close", "after opening")
class _ShinesFromTheStart(ModelProjector):
    def __init__(self, world: World) -> None:
        super().__init__(world)
        world.change(0, sequence().profiles[0])


@breaks("a_frame_lies_wholly_in_its_pattern", "of white's light")
class LightsLate(ModelProjector):
    """A display that is slower than its driver believes."""

    def show(self, index: int) -> DisplayedPattern:
        profile = self.profile(index)
        at_ns = self.world.at_ns + LATENCY_NS
        self.world.change(at_ns + 40_000_000, profile)
        self.world.at_ns = at_ns + ERROR_NS
        return DisplayedPattern(index, at_ns, ERROR_NS)


@breaks("show_tells_which_pattern_is_lit_since_when", "ms after the return")
class _ReturnsEarly(ModelProjector):
    def show(self, index: int) -> DisplayedPattern:
        shown = super().show(index)
        return replace(shown, t_visible_ns=shown.t_visible_ns + 10**9)


@breaks("show_tells_which_pattern_is_lit_since_when", "index=1")
class _TellsTheNextPattern(ModelProjector):
    def show(self, index: int) -> DisplayedPattern:
        shown = super().show(index)
        return DisplayedPattern(index + 1, shown.t_visible_ns, shown.t_err_ns)


@breaks("show_needs_a_loaded_sequence")
class _ShowsWithoutSequence(ModelProjector):
    def show(self, index: int) -> DisplayedPattern:
        if self.loaded is None and not self.closed.is_set():
            return DisplayedPattern(index, self.world.at_ns, 0)
        return super().show(index)


@breaks("show_needs_a_loaded_sequence")
class CountsFromTheEnd(ModelProjector):
    """Takes index -1 for the last pattern, as lists do."""

    def profile(self, index: int) -> Pixels:
        return super().profile(index % len(self.loaded) if self.loaded is not None else index)


@breaks("a_sequence_of_another_size_is_refused")
class _ScalesPatterns(ModelProjector):
    def load(self, sequence: PatternSequence) -> None:
        super().load(PatternSequence(self.info.size, sequence.patterns, sequence.profiles))


@breaks("a_projector_plays_only_if_it_says_so")
class _PlaysSilently(ModelProjector):
    plays = False

    def play(self, exposure_s: float, period_s: float) -> None:
        self.require_open()
        assert exposure_s < period_s


@breaks("a_projector_plays_only_if_it_says_so")
class PlaysUnloaded(ModelProjector):
    """Plays nothing where nothing is loaded."""

    def play(self, exposure_s: float, period_s: float) -> None:
        if self.loaded is not None or self.closed.is_set():
            super().play(exposure_s, period_s)


@breaks("a_played_sequence_gives_every_frame_in_order")
class PulsesOnceMore(ModelProjector):
    """Makes a pulse when it is ready, and so one more than there are patterns."""

    def pulse(self, index: int, at_ns: int) -> None:
        super().pulse(index, at_ns)
        if self.loaded is not None and index + 1 == len(self.loaded):
            super().pulse(index, at_ns + 1)


@breaks("a_play_can_be_stopped", "frames")
class _PlaysOn(ModelProjector):
    def stop(self) -> None:
        self.blank()


@breaks("a_whole_sequence_is_proven", "pattern")
class _SwapsPatterns(ModelProjector):
    def profile(self, index: int) -> Pixels:
        return super().profile({6: 8, 8: 6}.get(index, index))
