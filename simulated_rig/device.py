"""The simulated rig as a device: its projector, and cameras and projector opened from a rig file's `[head]` table."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from simulated_rig.camera import SimulatedCamera
from simulated_rig.light import (
    NS_PER_S,
    Lamp,
    LampFlicker,
    LightTable,
    VirtualClock,
    dark_table,
    desktop_table,
    light_table,
    nanoseconds,
)
from simulated_rig.movements import SimulatedTurntable
from simulated_rig.options import Faults, HeadOptions, SimulatedProjectorOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import read_scene
from simulated_rig.staging import PoseScript, SceneController
from slrig.bundle import validate
from slrig.devices import (
    COMPUTED_LIMITS,
    Camera,
    Clock,
    DisplayedPattern,
    Positioner,
    ProjectorInfo,
    ProjectorState,
    ScannerHead,
    SystemClock,
    progress_reporter,
)
from slrig.errors import DeviceGoneError, UnsupportedByDeviceError
from slrig.kernels import report_compilations
from slrig.model import Calibration, Pattern, PatternSequence, Primary, Surface, Truth

NAME = "projector"
_REPEAT_S = 10.0
CHANNELS = ("blue", "green", "red")


class SimulatedProjector:
    """Implements `slrig.devices.Projector` in the simulated world. Notifies the scene controller of captures and
    patterns.
    """

    def __init__(
        self,
        options: SimulatedProjectorOptions,
        clock: Clock,
        *,
        faults: Faults,
        seed: int,
        scene_controller: SceneController | None = None,
    ) -> None:
        self._options = options
        self._clock = clock
        self._faults = faults
        self._scene_controller = scene_controller
        self._response = options.response()
        self._dark = self._table(np.zeros((1, 1), np.uint8))
        swing = LampFlicker(options.flicker_hz, options.flicker_depth) if options.flicker_depth > 0 else None
        self.lamp = Lamp(self._dark, swing)
        self._rng = np.random.default_rng((seed, 0x70726F6A))
        self._state = ProjectorState("the simulated projector")
        self._tables: dict[tuple[Pattern, bytes], LightTable] = {}
        self._shows = 0
        self._shown_pattern: int | None = None
        self._gone = False

    @property
    def info(self) -> ProjectorInfo:
        """See `Projector`."""
        return ProjectorInfo(
            name=NAME,
            model="rendered projector",
            serial="simulated",
            size=self._options.size,
            plays=False,
            latency_s=self._options.latency_s,
            refresh_s=None if self._options.refresh_hz is None else 1 / self._options.refresh_hz,
            limits=COMPUTED_LIMITS,
            lights=self._options.lights is not None,
        )

    @property
    def shown_pattern(self) -> int | None:
        """Index of the requested pattern, None if dark."""
        return self._shown_pattern

    @property
    def is_lit(self) -> bool:
        """True if the scene receives more light than the dark projector's leak."""
        return self.lamp.light_at(self._clock.now_ns()).peak > self._dark.peak * (1 + 1e-6)

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`. Goes dark."""
        self._require_usable()
        self._state.require_size(sequence, self._options.size)
        if len(sequence) > self._options.max_patterns:
            message = (
                f"the sequence has {len(sequence)} patterns, the projector holds {self._options.max_patterns}; "
                "shorten it or raise max_patterns"
            )
            raise UnsupportedByDeviceError(message)
        for index, profile in enumerate(sequence.profiles):
            if min(profile.shape) > 1:
                message = (
                    f"pattern {index} varies along both axes ({profile.shape}); the simulated projector shows patterns "
                    "that vary along one axis only"
                )
                raise UnsupportedByDeviceError(message)
        self.blank()
        self._state.loaded, self._tables = sequence, {}
        if self._scene_controller is not None:
            self._scene_controller.start_capture(len(sequence))

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`."""
        self._require_usable()
        sequence = self._state.require_pattern(index)
        if self._faults.unplug_projector_at_show is not None and self._shows >= self._faults.unplug_projector_at_show:
            self._gone, self._shown_pattern = True, None
            self.lamp.darken(at_ns=self._clock.now_ns())
            self._require_usable()
        self._shows += 1
        if self._scene_controller is not None:
            self._scene_controller.advance_pattern()
        # A sequence may repeat its patterns, and may show several profiles under one name.
        pattern, profile = sequence.patterns[index], sequence.profiles[index]
        key = pattern, profile.tobytes()
        if key not in self._tables:
            table = self._table(profile)
            if isinstance(pattern, Primary) and self._options.lights is not None:
                channel = CHANNELS.index(pattern.colour)
                table = replace(table, channel=channel, power=self._options.lights[channel])
            self._tables[key] = table
        error_s = self._options.visible_error_s
        t_visible_ns = self._at_refresh(self._clock.now_ns() + nanoseconds(self._options.latency_s))
        off_s = float(self._rng.uniform(-error_s, error_s)) + self._faults.light_delay_s
        self.lamp.show(self._tables[key], at_ns=t_visible_ns + nanoseconds(off_s))
        self._shown_pattern = index
        self._clock.wait_until(t_visible_ns + nanoseconds(error_s), self._state.closed)
        return DisplayedPattern(index, t_visible_ns, nanoseconds(error_s))

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`. Not supported."""
        self._require_usable()
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`. Raises DeviceGoneError after an unplug, since the state of the light is unknown."""
        if self._state.closed.is_set():
            return
        if self._gone:
            self._require_usable()
        self._shown_pattern = None
        self.lamp.darken(at_ns=self._clock.now_ns())

    def close(self) -> None:
        """See `Projector`."""
        if not self._gone:
            self.blank()
        self._shown_pattern, self._state.loaded, self._tables = None, None, {}
        self._state.closed.set()

    def _at_refresh(self, t_ns: int) -> int:
        refresh_hz = self._options.refresh_hz
        return t_ns if refresh_hz is None else round(-(-t_ns * refresh_hz // NS_PER_S) / refresh_hz * NS_PER_S)

    def _table(self, profile: np.ndarray[tuple[int, ...], np.dtype[np.unsignedinteger]]) -> LightTable:
        if self._faults.lamp_off:
            return dark_table(self._options.size)
        if self._faults.picture in ("mirrored", "rotated"):
            profile = profile[:, ::-1]
        if self._faults.picture in ("upside_down", "rotated"):
            profile = profile[::-1]
        if self._faults.other_display:
            glow = self._faults.other_display_glow * float(self._response.light(profile).mean())
            return replace(desktop_table(self._options.size, self._response), glow=glow)
        return light_table(profile, self._options.size, self._response)

    def _require_usable(self) -> None:
        self._state.require_open()
        if self._gone:
            message = "the projector is gone (unplugged or powered off); plug it in and open the rig again"
            raise DeviceGoneError(message)


class SimulatedHead:
    """Implements `slrig.devices.ScannerHead` on the simulated world.

    Its calibration is exact. `clock` is the world's time, in which all time stamps count. `script` gives the object
    poses.
    """

    def __init__(self, options: HeadOptions, script: PoseScript) -> None:
        self.clock: Clock = SystemClock() if options.realtime else VirtualClock()
        lens = options.projector.pinhole()
        self._scene_state = SceneState(
            script.surface(0),
            lens,
            working_distance_mm=options.projector.working_distance_mm or float(np.linalg.norm(lens.centre_mm)),
            fall_off=options.projector.fall_off,
        )
        swing = None
        if options.ambient_flicker_depth > 0:
            swing = LampFlicker(options.ambient_flicker_hz, options.ambient_flicker_depth)
        self._views = {
            camera.name: CameraView(
                camera.pinhole(),
                self._scene_state,
                blur_px=camera.blur_px,
                focus=(options.projector.focus, camera.focus),
                ambient=options.ambient,
                samples_per_axis=options.samples_per_axis,
                jitter=options.jitter,
                seed=options.seed,
                workers=options.workers,
            )
            for camera in options.camera
        }
        self._scene_controller = SceneController(options, script, self._scene_state, self._views, self.clock)
        self._positioner: Positioner | None = self._scene_controller if self._scene_controller.poses else None
        if options.turntable is not None:
            self._positioner = SimulatedTurntable(
                options.turntable, self._scene_controller.turn_table, seed=options.seed
            )
        self._projector = SimulatedProjector(
            options.projector,
            self.clock,
            faults=options.faults,
            seed=options.seed,
            scene_controller=self._scene_controller,
        )
        self._cameras = {
            camera.name: SimulatedCamera(
                camera,
                self._views[camera.name],
                self._projector.lamp,
                self.clock,
                faults=options.faults,
                seed=(options.seed, index),
                ambient_flicker=swing,
            )
            for index, camera in enumerate(options.camera)
        }
        self._calibration = Calibration({camera.name: camera.pinhole() for camera in options.camera}, lens)
        self._carries_calibration = options.carries_calibration
        self._truth: Truth | None = None

    @property
    def cameras(self) -> Mapping[str, Camera]:
        """See `ScannerHead`."""
        return self._cameras

    @property
    def projector(self) -> SimulatedProjector:
        """See `ScannerHead`. Also has `shown_pattern` and `is_lit`."""
        return self._projector

    @property
    def calibration(self) -> Calibration | None:
        """See `ScannerHead`. None if the options leave it out."""
        return self._calibration if self._carries_calibration else None

    @property
    def exact_calibration(self) -> Calibration:
        """Calibration of the options, regardless of `carries_calibration`."""
        return self._calibration

    def prepare(self) -> None:
        """Compile kernels and trace the light of the current scene, reporting progress."""
        with (
            _repeating(progress_reporter()) as report,
            report_compilations(lambda kernel: report(f"preparing kernels, first time only: {kernel}")),
        ):
            for name, view in self._views.items():
                view.prepare(report_progress=partial(_report_tracing, report, name))

    @property
    def positioner(self) -> Positioner | None:
        """See `slrig.devices.HasPositioner`. None without poses or turntable."""
        return self._positioner

    def truth(self) -> Truth:
        """See `ScannerHead`. Ground truth of the current scene. Works in every state, also after close."""
        cameras = {name: view.truth() for name, view in self._views.items()}
        shape = self._scene_state.snapshot.surface
        known = self._truth
        if (
            known is None
            or known.surface.vertices_mm is not shape.vertices_mm
            or any(known.cameras[name] is not camera for name, camera in cameras.items())
        ):
            known = self._truth = Truth(Surface(shape.vertices_mm, shape.faces), cameras, self._calibration)
        return known


@contextmanager
def _repeating(report: Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Repeat the last report while the block runs: on a slow computer one kernel compiles for longer than a device may
    be silent.
    """
    last, over = [""], threading.Event()

    def report_and_keep(text: str) -> None:
        last[0] = text
        report(text)

    def repeat() -> None:
        while not over.wait(_REPEAT_S):
            report(last[0])

    threading.Thread(target=repeat, name="slrig-preparing", daemon=True).start()
    try:
        yield report_and_keep
    finally:
        over.set()


def _report_tracing(report: Callable[[str], None], camera: str, share: float) -> None:
    report(f"tracing light for camera '{camera}', {share:.0%}")


def open_head(options: Mapping[str, object], folder: Path) -> ScannerHead:
    """Open the simulated rig described by a rig file's `[head]` table (without its `driver`).

    `folder` is that of the rig file: the scene's path is relative to it.

    Raises
    ------
    ConfigError
        The options or the scene have faults: all of them, in one message.
    """
    head = open_simulated_head(options, folder)
    head.prepare()
    return head


def open_simulated_head(options: Mapping[str, object], folder: Path) -> SimulatedHead:
    """Open the rig as `open_head` does, typed as `SimulatedHead` and without preparing it."""
    table = validate(HeadOptions, options, "the [head] table of the simulated rig")
    path = folder / table.scene
    return SimulatedHead(table, PoseScript(table, read_scene(path), path.parent))
