"""The rendered rig as an instrument: cameras and a projector on one world, opened from a rig file's `[head]` table."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from simulated_rig.camera import SimulatedCamera
from simulated_rig.options import HeadOptions
from simulated_rig.projector import SimulatedProjector
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import read_scene
from simulated_rig.staging import PoseScript, SceneController
from simulated_rig.turning import RenderedTurntable
from simulated_rig.world import LightFlicker, VirtualClock
from slrig.bundle.validation import checked
from slrig.devices import Camera, Clock, Head, Positioner, SystemClock, progress_reporter
from slrig.kernels import compilations_told
from slrig.model import Calibration, Surface, Truth


class SimulatedHead:
    """Implements `slrig.devices.Head` on the rendered world.

    The calibration it carries is exact. `clock` is the world's time; all time stamps count in it. `script` says what
    stands where.
    """

    def __init__(self, options: HeadOptions, script: PoseScript) -> None:
        self.clock: Clock = SystemClock() if options.realtime else VirtualClock()
        lens = options.projector.pinhole()
        self._stage = SceneState(
            script.surface(0),
            lens,
            working_distance_mm=options.projector.working_distance_mm or float(np.linalg.norm(lens.centre_mm)),
            fall_off=options.projector.fall_off,
        )
        swing = None
        if options.ambient_flicker_depth > 0:
            swing = LightFlicker(options.ambient_flicker_hz, options.ambient_flicker_depth)
        self._views = {
            camera.name: CameraView(
                camera.pinhole(),
                self._stage,
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
        self._staging = SceneController(options, script, self._stage, self._views, self.clock)
        self._positioner: Positioner | None = self._staging if self._staging.poses else None
        if options.turntable is not None:
            self._positioner = RenderedTurntable(options.turntable, self._staging.turn_table, seed=options.seed)
        self._projector = SimulatedProjector(
            options.projector, self.clock, faults=options.faults, seed=options.seed, staging=self._staging
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
        """See `Head`."""
        return self._cameras

    @property
    def projector(self) -> SimulatedProjector:
        """See `Head`. Also says what it shows: `showing`, `lit`."""
        return self._projector

    @property
    def calibration(self) -> Calibration | None:
        """See `Head`. None if the options say so."""
        return self._calibration if self._carries_calibration else None

    @property
    def exact_calibration(self) -> Calibration:
        """What the options say of the devices, whether or not the head carries it."""
        return self._calibration

    def prepare(self) -> None:
        """Do what takes long the first time, telling of it: compile kernels, trace the light of what stands there."""
        tell = progress_reporter()
        with compilations_told(lambda kernel: tell(f"preparing kernels, first time only: {kernel}")):
            for name, view in self._views.items():
                view.prepare(told=partial(_report_tracing, tell, name))

    @property
    def positioner(self) -> Positioner | None:
        """See `slrig.devices.Positions`. None where the options have neither poses nor a turntable."""
        return self._positioner

    def truth(self) -> Truth:
        """See `Head`. Of what stands there now. Works in every state, also after close."""
        cameras = {name: view.truth() for name, view in self._views.items()}
        shape = self._stage.setting.surface
        known = self._truth
        if (
            known is None
            or known.surface.vertices_mm is not shape.vertices_mm
            or any(known.cameras[name] is not camera for name, camera in cameras.items())
        ):
            known = self._truth = Truth(Surface(shape.vertices_mm, shape.faces), cameras)
        return known


def _report_tracing(tell: Callable[[str], None], camera: str, share: float) -> None:
    tell(f"tracing light for camera '{camera}', {share:.0%}")


def open_head(options: Mapping[str, object], folder: Path) -> Head:
    """Open the rendered rig described by a rig file's `[head]` table (without its `driver`).

    `folder` is the rig file's own: the scene's path counts from there.

    Raises
    ------
    ConfigError
        The options or the scene have faults: all of them, in one message.
    """
    head = open_simulated_head(options, folder)
    head.prepare()
    return head


def open_simulated_head(options: Mapping[str, object], folder: Path) -> SimulatedHead:
    """Return `open_head`'s instrument under its own type."""
    table = checked(HeadOptions, options, "the [head] table of the rendered rig")
    path = folder / table.scene
    return SimulatedHead(table, PoseScript(table, read_scene(path), path.parent))
