"""A rig in memory, below the protocols: a smooth world seen by a small camera, on virtual time, with faults on demand.

The camera pixel (y, x) sees projector column `column_px[y, x]` and row `row_px[y, x]`; light is blurred, reflected by
an albedo, and read with noise.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.capture.verifier import Evidence
from slrig.devices import AppliedSettings, CameraInfo, CameraSettings, DisplayedPattern, ProjectorInfo, Rig, Trigger
from slrig.errors import (
    DeviceGoneError,
    DeviceStateError,
    FrameTimeoutError,
    ScanEvidenceError,
    UnsupportedByDeviceError,
)
from slrig.model import CameraFormat, Frame, Pattern, PatternSequence, Pixels, RotationAxis, Shot, Size
from slrig.patterns.sequence import encode, scan_patterns

EXPOSURE_S = 0.01
LATENCY_NS = 5_000_000
PROJECTOR = Size(128, 96)
CAMERA = Size(200, 150)


def patterns_for(
    size: Size = PROJECTOR,
    *,
    line_shift: bool = True,
    rows: bool = False,
    cell_px: int | None = None,
    offset_px: int = 0,
) -> tuple[Pattern, ...]:
    return scan_patterns(
        size,
        line_shift=line_shift,
        period_px=8,
        line_width_px=1,
        gray_cell_px=cell_px,
        gray_offset_px=offset_px,
        rows=rows,
    )


@dataclass
class Scene:
    """What a camera sees. Levels are fractions of full scale; `noise_dn` is per frame; gamma is the camera's.

    scaler_px : standard deviation of a scaler's blur of the pattern's values, of which the display's own gamma of 2.2
    makes light afterwards.
    """

    camera: Size = CAMERA
    bit_depth: int = 8
    projector: Size = PROJECTOR
    first_column_px: float = 4.0
    columns_per_px: float = 0.6
    rows_per_px: float = 0.6
    white: float = 0.6
    ambient: float = 0.02
    blur_px: float = 0.7
    noise_dn: float = 0.0
    gamma: float = 1.0
    scaler_px: float = 0.0
    shadow_until_px: int = 0
    seed: int = 0
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(self.seed)
        y, x = np.mgrid[: self.camera.height_px, : self.camera.width_px].astype(np.float64)
        # A slanted, slightly bent surface with a texture.
        self.column_px = self.first_column_px + self.columns_per_px * (x + 0.02 * y + 3 * np.sin(y / 60))
        self.row_px = 2 + self.rows_per_px * y
        self.albedo = 0.7 + 0.3 * np.sin(x / 17) * np.cos(y / 23)

    @property
    def format(self) -> CameraFormat:
        return CameraFormat(self.camera, self.bit_depth)

    def light(self, profile: Pixels) -> NDArray[np.float64]:
        """(H, W) float64, 0 to 1: what the projector sends to each camera pixel."""
        along_columns = profile.shape[0] == 1
        position_px = self.column_px if along_columns else self.row_px
        extent_px = self.projector.width_px if along_columns else self.projector.height_px
        fine = 8
        sent = np.broadcast_to(profile.ravel(), (extent_px,)) if profile.size == 1 else profile.ravel()
        values = sent.astype(np.float64) / 255
        if self.scaler_px:
            values = _blur(values, self.scaler_px, reach=round(4 * self.scaler_px)) ** 2.2
        steps = np.repeat(values, fine)
        blurred = _blur(steps, self.blur_px * fine, reach=6 * fine)
        centres_px = (np.arange(len(steps)) + 0.5) / fine - 0.5
        seen = np.interp(position_px, centres_px, blurred, left=0.0, right=0.0)
        on_projector = (np.abs(self.column_px - (self.projector.width_px - 1) / 2) <= self.projector.width_px / 2) & (
            np.abs(self.row_px - (self.projector.height_px - 1) / 2) <= self.projector.height_px / 2
        )
        seen[~on_projector] = 0.0
        seen[:, : self.shadow_until_px] = 0.0
        return np.asarray(seen)

    def image(self, profile: Pixels | None) -> Pixels:
        """One exposure under a pattern; None is the dark projector."""
        seen = self.light(profile if profile is not None else np.zeros((1, 1), np.uint8))
        level = self.albedo * (self.ambient + self.white * seen)
        full_scale = self.format.full_scale
        values = full_scale * np.clip(level, 0, 1) ** (1 / self.gamma)
        values = values + self.noise_dn * self.rng.standard_normal(values.shape)
        whole: Pixels = np.clip(np.rint(values), 0, full_scale).astype(np.uint8 if self.bit_depth <= 8 else np.uint16)
        return whole

    def shots(self, patterns: Sequence[Pattern], camera: str = "left") -> list[Shot]:
        sequence = encode(patterns, self.projector)
        return [Shot(i, camera, self.image(profile)) for i, profile in enumerate(sequence.profiles)]


def _blur(values: NDArray[np.float64], sigma: float, *, reach: int) -> NDArray[np.float64]:
    """Values under a Gaussian, (n,) float64; beyond their ends they go on as they end.

    By numpy: an emulated guest takes ten seconds and more to load scipy.ndimage.
    """
    offsets = np.arange(-reach, reach + 1)
    kernel = np.exp(-0.5 * (offsets / sigma) ** 2)
    return np.convolve(np.pad(values, reach, mode="edge"), kernel / kernel.sum(), mode="valid")


@dataclass
class World:
    """Time and light, shared by the fakes. `calls` is everything that was asked of them, in order."""

    now_ns: int = 1_000
    light: Pixels | None = None
    calls: list[str] = field(default_factory=list)
    on_wire: list[Callable[[], None]] = field(default_factory=list)
    periods_s: list[tuple[float, float]] = field(default_factory=list)


@dataclass
class WorldClock:
    """Implements `slrig.devices.Clock`: the time of a world."""

    world: World

    def now_ns(self) -> int:
        return self.world.now_ns

    def wait_until(self, t_ns: int, _stop: object) -> None:
        self.world.now_ns = max(self.world.now_ns, t_ns)


@dataclass
class FakeProjector:
    """Implements `Projector`. `swaps` shows another pattern than was asked for, and says nothing.

    missing_pulses, extra_pulses : indices of patterns that a wire trigger does not tell of, or before which it comes
    once too often; in the first `spoilt_plays` plays. dark_from_show : the showing at which its lamp goes off.
    """

    world: World
    size: Size = PROJECTOR
    plays: bool = False
    inverted: bool = False
    lamp_off: bool = False
    swaps: Mapping[int, int] = field(default_factory=dict)
    gone_at_show: int | None = None
    dark_from_show: int | None = None
    interrupt_at_show: int | None = None
    missing_pulses: frozenset[int] = frozenset()
    extra_pulses: frozenset[int] = frozenset()
    spoilt_plays: int = 99
    played: int = 0
    sequence: PatternSequence | None = None
    shows: int = 0
    gone: bool = False

    @property
    def info(self) -> ProjectorInfo:
        return ProjectorInfo("fake", "fake", "0", self.size, self.plays, LATENCY_NS / 1e9)

    @property
    def lit(self) -> bool:
        return self.world.light is not None

    def load(self, sequence: PatternSequence) -> None:
        self.world.calls.append("load")
        if sequence.projector != self.size:
            message = f"the projector is {self.size}, the sequence is for {sequence.projector}"
            raise UnsupportedByDeviceError(message)
        self.sequence = sequence

    def show(self, index: int) -> DisplayedPattern:
        self.world.calls.append(f"show {index}")
        if self.sequence is None:
            message = "show before load"
            raise DeviceStateError(message)
        if self.shows == self.gone_at_show:
            self.gone, self.world.light = True, None
            message = "the projector is gone"
            raise DeviceGoneError(message)
        if self.shows == self.interrupt_at_show:
            raise KeyboardInterrupt
        self.lamp_off = self.lamp_off or self.shows == self.dark_from_show
        self.shows += 1
        self._light(index)
        self.world.now_ns += LATENCY_NS
        return DisplayedPattern(index, self.world.now_ns, 1_000)

    def _light(self, index: int) -> None:
        assert self.sequence is not None
        profile = self.sequence.profiles[self.swaps.get(index, index)]
        profile = 255 - profile if self.inverted else profile
        self.world.light = np.zeros_like(profile) if self.lamp_off else profile

    def play(self, exposure_s: float, period_s: float) -> None:
        self.world.calls.append("play")
        self.world.periods_s.append((exposure_s, period_s))
        assert period_s > exposure_s
        assert self.sequence is not None
        spoilt = self.played < self.spoilt_plays
        self.played += 1
        for index in range(len(self.sequence)):
            if spoilt and index in self.extra_pulses:
                self._pulse(period_s)
            self._light(index)
            if not (spoilt and index in self.missing_pulses):
                self._pulse(0.0)
            self.world.now_ns += round(period_s * 1e9)

    def _pulse(self, wait_s: float) -> None:
        for expose in self.world.on_wire:
            expose()
        self.world.now_ns += round(wait_s * 1e9)

    def stop(self) -> None:
        self.world.calls.append("stop")
        self.world.light = None

    def blank(self) -> None:
        self.world.calls.append("blank")
        if self.gone:
            message = "the projector is gone"
            raise DeviceGoneError(message)
        self.world.light = None

    def close(self) -> None:
        self.world.light = None


@dataclass
class FakeTurntable:
    """Implements `Turntable`. turned_deg : every requested angle, in order."""

    turned_deg: list[float] = field(default_factory=list)
    error: Exception | None = None
    axis: RotationAxis | None = None
    opened_at_deg: float | None = None

    @property
    def angles_deg(self) -> Sequence[float]:
        return (0.0, 90.0)

    @property
    def poses(self) -> Sequence[str]:
        return ("0°", "90°")

    def move(self, index: int) -> None:
        self.turn(self.angles_deg[index])

    def turn(self, angle_deg: float) -> None:
        if self.error is not None:
            raise self.error
        self.turned_deg.append(angle_deg)

    def close(self) -> None:
        pass


@dataclass
class CameraFaults:
    """Each set holds numbers of frames, counted from 0. readout_s : after each exposure the camera takes no notice of
    pulses for so long; None: it always does.
    """

    drop: frozenset[int] = frozenset()
    stale: frozenset[int] = frozenset()
    early: frozenset[int] = frozenset()
    same_number: frozenset[int] = frozenset()
    garbled: frozenset[int] = frozenset()
    over_exposed: frozenset[int] = frozenset()
    unplug_at: int | None = None
    readback: float = 1.0
    min_period_s: float | None = None
    readout_s: float | None = None


@dataclass
class FakeCamera:
    """Implements `Camera`. coloured : how often a frame was asked for its colour; None of a mono camera.

    white : light under the white pattern in 10 ms, over full scale: frames are brighter, the longer they are exposed.
    None: as the scene has it. pushed_at : the setting of an exposure at which the camera is pushed aside.
    """

    name: str
    world: World
    scene: Scene
    triggers: frozenset[Trigger] = frozenset({Trigger.SOFTWARE})
    faults: CameraFaults = field(default_factory=CameraFaults)
    armed: Trigger | None = None
    made: int = 0
    pending: deque[Frame] = field(default_factory=deque)
    last_image: Pixels | None = None
    dropped: int = 0
    gone: bool = False
    coloured: int | None = None
    white: float | None = None
    pushed_at: int | None = None
    exposures_s: list[float] = field(default_factory=list)
    busy_until_ns: int = 0

    def __post_init__(self) -> None:
        self.world.on_wire.append(self._on_wire)

    @property
    def info(self) -> CameraInfo:
        info = CameraInfo(self.name, "fake", "0", self.scene.format, self.triggers, (1e-5, 1.0), (1.0, 1.0))
        return replace(info, colour=self.coloured is not None)

    def _in_colour(self, image: Pixels) -> Pixels:
        self.coloured = (self.coloured or 0) + 1
        return np.dstack([image // 2, image, image // 4])

    def configure(self, settings: CameraSettings) -> AppliedSettings:
        self.world.calls.append(f"configure {self.name}")
        self.exposures_s.append(settings.exposure_s)
        if self.white is not None:
            times = settings.exposure_s / EXPOSURE_S
            self.scene.white, self.scene.ambient = self.white * times, 0.02 * times
        if len(self.exposures_s) == self.pushed_at:
            self.scene.column_px = self.scene.column_px + 2 * self.scene.columns_per_px
        faults = self.faults
        return AppliedSettings(settings.exposure_s * faults.readback, settings.gain, faults.min_period_s)

    def arm(self, count: int, trigger: Trigger) -> None:
        self.world.calls.append(f"arm {self.name} {trigger}")
        assert count > 0
        assert trigger in self.triggers
        self.armed, self.dropped = trigger, 0

    def trigger(self) -> None:
        assert self.armed is Trigger.SOFTWARE
        self._expose()

    def _on_wire(self) -> None:
        if self.armed is not Trigger.HARDWARE or self.world.now_ns < self.busy_until_ns:
            return
        self._expose()
        if self.faults.readout_s is not None:
            self.busy_until_ns = self.world.now_ns + round((self.exposures_s[-1] + self.faults.readout_s) * 1e9)

    def _expose(self) -> None:
        number, self.made = self.made, self.made + 1
        if number in self.faults.drop:
            self.dropped += 1
            return
        image = self.scene.image(self.world.light)
        if number in self.faults.stale and self.last_image is not None:
            image = self.last_image
        if number in self.faults.garbled:
            image = image.copy()
            rows = image.shape[0] // 3
            image[rows : 2 * rows] = self.scene.rng.integers(
                0, self.scene.format.full_scale, image[rows : 2 * rows].shape, image.dtype
            )
        self.last_image = image
        exposure_s = self.exposures_s[-1] if self.exposures_s else EXPOSURE_S
        start_ns = self.world.now_ns - LATENCY_NS if number in self.faults.early else self.world.now_ns + 2_000
        self.pending.append(
            Frame(
                camera=self.name,
                image=image,
                t_start_ns=start_ns,
                t_end_ns=start_ns + round(exposure_s * 1e9),
                t_err_ns=100,
                sequence_number=number - 1 if number in self.faults.same_number else number,
                dropped_count=self.dropped,
                exposure_s=exposure_s * (1.5 if number in self.faults.over_exposed else 1.0),
                gain=1.0,
                colour=None if self.coloured is None else lambda: self._in_colour(image),
            )
        )

    def read(self, after_ns: int, timeout_s: float) -> Frame:
        if self.faults.unplug_at is not None and self.made > self.faults.unplug_at:
            self.gone = True
            message = f"camera '{self.name}' is gone"
            raise DeviceGoneError(message)
        if self.armed is Trigger.FREE:
            self._expose()
        while self.pending:
            frame = self.pending.popleft()
            if frame.t_start_ns >= after_ns or frame.sequence_number in self.faults.early:
                self.world.now_ns = max(self.world.now_ns, frame.t_end_ns)
                return frame
        self.world.now_ns += round(timeout_s * 1e9)
        message = f"no frame in {timeout_s} s"
        raise FrameTimeoutError(message)

    def disarm(self) -> None:
        self.world.calls.append(f"disarm {self.name}")
        self.armed = None
        self.pending.clear()
        if self.gone:
            message = f"camera '{self.name}' is gone"
            raise DeviceGoneError(message)

    def close(self) -> None:
        self.armed = None


@dataclass
class FakeRig:
    """The fakes together, and as a `Rig`."""

    world: World
    projector: FakeProjector
    cameras: dict[str, FakeCamera]
    rig: Rig

    @property
    def at_rest(self) -> bool:
        return not self.projector.lit and all(camera.armed is None for camera in self.cameras.values())


def add_agreeing_shot(evidence: Evidence, shot: Shot) -> None:
    """Feed a frame that must contradict nothing."""
    found = evidence.add_shot(shot)
    if found:
        raise ScanEvidenceError("; ".join(map(str, found)))


def fake_rig(
    *,
    projector: Mapping[str, object] | None = None,
    faults: Mapping[str, CameraFaults] | None = None,
    triggers: Mapping[str, frozenset[Trigger]] | None = None,
    cameras: Sequence[str] | Mapping[str, float] = ("left", "right"),
    noise_dn: float = 0.8,
) -> FakeRig:
    """A rig of these cameras. cameras : with the `white` of each, if exposures matter."""
    world = World()
    shown_by = FakeProjector(world, **(projector or {}))  # type: ignore[arg-type]
    fakes = {
        name: FakeCamera(
            name,
            world,
            Scene(noise_dn=noise_dn, seed=index, first_column_px=4.0 + 3 * index),
            (triggers or {}).get(name, frozenset({Trigger.SOFTWARE})),
            (faults or {}).get(name, CameraFaults()),
            white=cameras[name] if isinstance(cameras, Mapping) else None,
        )
        for index, name in enumerate(cameras)
    }
    settings = {name: CameraSettings(EXPOSURE_S) for name in cameras}
    return FakeRig(world, shown_by, fakes, Rig("fake", fakes, shown_by, settings, clock=WorldClock(world)))
