"""The rendered rig as an instrument: cameras and a projector on one world, opened from a rig file's `[head]` table."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from simulated_rig.camera import SimulatedCamera
from simulated_rig.options import HeadOptions
from simulated_rig.projector import SimulatedProjector
from simulated_rig.rendering import Stage, View
from simulated_rig.scene import SceneSurface, read_scene, surface_of
from simulated_rig.tables import checked
from simulated_rig.world import Flicker, VirtualClock
from slrig.devices import Camera, Clock, Head, SystemClock
from slrig.model import Calibration, Surface, Truth


class SimulatedHead:
    """Implements `slrig.devices.Head` on the rendered world.

    The calibration it carries is exact. `clock` is the world's time; all time stamps count in it.
    """

    def __init__(self, options: HeadOptions, surface: SceneSurface) -> None:
        self.clock: Clock = SystemClock() if options.realtime else VirtualClock()
        lens = options.projector.pinhole()
        stage = Stage(
            surface,
            lens,
            working_distance_mm=options.projector.working_distance_mm or float(np.linalg.norm(lens.centre_mm)),
        )
        self._surface = surface
        self._projector = SimulatedProjector(options.projector, self.clock, faults=options.faults, seed=options.seed)
        swing = None
        if options.ambient_flicker_depth > 0:
            swing = Flicker(options.ambient_flicker_hz, options.ambient_flicker_depth)
        self._views = {
            camera.name: View(
                camera.pinhole(),
                stage,
                blur_px=camera.blur_px,
                ambient=options.ambient,
                samples_per_axis=options.samples_per_axis,
                jitter=options.jitter,
                seed=options.seed,
                workers=options.workers,
            )
            for camera in options.camera
        }
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
    def calibration(self) -> Calibration:
        """See `Head`."""
        return self._calibration

    def truth(self) -> Truth:
        """See `Head`. Works in every state, also after close."""
        if self._truth is None:
            surface = Surface(self._surface.vertices_mm, self._surface.faces)
            self._truth = Truth(surface, {name: view.truth() for name, view in self._views.items()})
        return self._truth


def open_head(options: Mapping[str, object], folder: Path) -> Head:
    """Open the rendered rig described by a rig file's `[head]` table (without its `driver`).

    `folder` is the rig file's own: the scene's path counts from there.

    Raises
    ------
    ConfigError
        The options or the scene have faults: all of them, in one message.
    """
    return simulated_head(options, folder)


def simulated_head(options: Mapping[str, object], folder: Path) -> SimulatedHead:
    """Return `open_head`'s instrument under its own type."""
    table = checked(HeadOptions, options, source="the [head] table of the rendered rig")
    path = folder / table.scene
    return SimulatedHead(table, surface_of(read_scene(path), path.parent))
