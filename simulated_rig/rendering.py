"""What one camera of the rendered rig sees: its expected image under any light, and its truth."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from simulated_rig import transport
from simulated_rig.casting import Caster, caster
from simulated_rig.light import Float32Array, LightTable, blurred, radiance
from simulated_rig.scene import SceneSurface
from simulated_rig.transport import Paths
from slrig.model import CameraTruth, Pinhole


class Stage:
    """The scene's surface before the projector, and the caster that finds it. Built once, when first needed."""

    def __init__(self, surface: SceneSurface, projector: Pinhole, *, working_distance_mm: float) -> None:
        self.surface = surface
        self.projector = projector
        self.working_distance_mm = working_distance_mm
        self._rays: Caster | None = None
        self._lock = threading.Lock()

    @property
    def rays(self) -> Caster:
        """The caster of the surface."""
        with self._lock:
            if self._rays is None:
                self._rays = caster(self.surface.vertices_mm, self.surface.faces)
            return self._rays


class View:
    """One camera's view of a stage. Its light paths are traced once, by `prepare` or the first image."""

    def __init__(
        self,
        camera: Pinhole,
        stage: Stage,
        *,
        blur_px: float,
        ambient: float,
        samples_per_axis: int,
        jitter: bool,
        seed: int,
        workers: int,
    ) -> None:
        self._camera = camera
        self._stage = stage
        self._blur_px = blur_px
        self._ambient = ambient
        self._samples_per_axis = samples_per_axis
        self._jitter = jitter
        self._seed = seed
        self._workers = workers
        self._paths: Paths | None = None
        self._last: tuple[LightTable, Float32Array] | None = None
        self._truth: CameraTruth | None = None

    def prepare(self) -> Paths:
        """Trace the light paths, unless that is done, and return them."""
        if self._paths is None:
            self._paths = transport.paths(
                self._camera,
                self._stage.projector,
                self._stage.surface,
                self._stage.rays,
                samples_per_axis=self._samples_per_axis,
                jitter=self._jitter,
                seed=self._seed,
                working_distance_mm=self._stage.working_distance_mm,
                workers=self._workers,
            )
        return self._paths

    def image(
        self, lights: Sequence[tuple[float | Float32Array, LightTable]], *, ambient: Float32Array | None = None
    ) -> Float32Array:
        """(H, W) float32: the mean light on each pixel when each light was on for its fraction of the exposure.

        A fraction is one number for the whole image, or (H, 1): one for each row. `ambient` is the room's light in
        this exposure over its mean, (H, 1) or (1, 1); absent, the mean.
        1 is a white diffuser, at the working distance and facing the projector, under full white.
        """
        paths = self.prepare()
        total = blurred(paths.albedo * np.float32(self._ambient), self._blur_px)
        if ambient is not None:
            total *= ambient
        for fraction, light in lights:
            total += np.asarray(fraction, np.float32) * self._under(paths, light)
        return total

    def _under(self, paths: Paths, light: LightTable) -> Float32Array:
        # A free-running camera sees the same light many times over: keep the last image.
        if self._last is None or self._last[0] is not light:
            image = radiance(paths, light, blur_px=self._blur_px)
            if light.glow > 0:
                image += blurred(paths.albedo * np.float32(light.glow), self._blur_px)
            self._last = (light, image)
        return self._last[1]

    def truth(self) -> CameraTruth:
        """Return depth, projector coordinates and visible points, from rays of their own at the pixel centres."""
        if self._truth is None:
            self._truth = self._traced_truth()
        return self._truth

    def _traced_truth(self) -> CameraTruth:
        shape = self._camera.size.shape
        depth = np.full(shape, np.nan)
        projector_px = np.full((*shape, 2), np.nan)
        visible: list[NDArray[np.float64]] = []
        for rows, u, v in transport.pixel_centres(self._camera):
            hits = transport.trace(
                u,
                v,
                self._camera,
                self._stage.projector,
                self._stage.surface,
                self._stage.rays,
                working_distance_mm=self._stage.working_distance_mm,
            )
            along = hits.points_mm @ self._camera.rotation[2] + self._camera.translation_mm[2]
            coordinates = np.column_stack([hits.column_px, hits.row_px])
            coordinates[~hits.lit] = np.nan
            depth[rows] = along.reshape(depth[rows].shape)
            projector_px[rows] = coordinates.reshape(projector_px[rows].shape)
            visible.append(hits.points_mm[hits.lit])
        return CameraTruth(depth, projector_px, np.concatenate(visible))
