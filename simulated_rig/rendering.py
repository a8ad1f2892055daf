"""Rendering for one camera: its expected image under any light, its ground truth, and the sensor that reads it out."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from simulated_rig import transport
from simulated_rig.bounces import Bounces, trace_bounces
from simulated_rig.light import Float32Array, LightTable, blur_image, radiance
from simulated_rig.optics import ALWAYS_SHARP, LEVELS_PX, Focus, lens_array, level_weights, vignetting, world_directions
from simulated_rig.scene import SceneSurface
from simulated_rig.transport import LightPaths, RayCaster, build_caster
from slrig.kernels import kernel
from slrig.model import CameraTruth, Pinhole, Pixels

_KEPT_BYTES = 64 * 2**20

Weights = dict[int, Float32Array]
"""Weights (H, W) by the index of a level of `optics.LEVELS_PX`: contribution of its image to each pixel."""


@dataclass(frozen=True, slots=True)
class SensorModel:
    """Linear sensor, optionally followed by a nonlinear camera response.

    value = pedestal_dn + gain * electrons * (full scale - pedestal_dn) / full_well_e, clipped; then full scale * (value
    / full scale) ^ response, rounded. response : 1 for machine vision cameras, about 0.45 for webcams.

    saturation_s : exposure at which a white diffuser at the working distance, facing the projector, saturates under a
    white pattern.
    """

    bit_depth: int
    full_well_e: float
    read_noise_e: float
    saturation_s: float
    pedestal_dn: float
    response: float = 1.0

    @property
    def full_scale(self) -> int:
        """Value of a saturated sample."""
        return int(2**self.bit_depth - 1)

    def dn_per_electron(self, gain: float) -> float:
        """Conversion gain: digital numbers per electron."""
        return gain * (self.full_scale - self.pedestal_dn) / self.full_well_e

    def electrons(self, radiance: NDArray[np.float32], exposure_s: float) -> NDArray[np.float32]:
        """Expected electrons, same shape as `radiance` (a white diffuser gives 1), not clipped at the full well."""
        return np.asarray(radiance * np.float32(self.full_well_e * exposure_s / self.saturation_s), np.float32)

    def read_out(self, electrons: NDArray[np.float32], *, gain: float, rng: np.random.Generator) -> Pixels:
        """Read expected electrons (H, W) float32 once, with noise: (H, W) uint8 or uint16.

        Shot noise is Gaussian with the variance of the Poisson law; read noise hides the difference at low light.
        """
        draws = rng.standard_normal(electrons.shape, dtype=np.float32)
        out = np.zeros(electrons.shape, np.uint8 if self.bit_depth <= 8 else np.uint16)
        _digitise(
            electrons,
            draws,
            np.float32(self.full_well_e),
            np.float32(self.read_noise_e**2),
            np.float32(self.dn_per_electron(gain)),
            np.float32(self.pedestal_dn),
            np.float32(self.full_scale),
            np.float32(self.response),
            out,
        )
        return out


@kernel(in_every_scan=False)
def _digitise(
    electrons: NDArray[np.float32],
    draws: NDArray[np.float32],
    full_well: np.float32,
    read_variance: np.float32,
    dn_per_electron: np.float32,
    pedestal: np.float32,
    full_scale: np.float32,
    response: np.float32,
    out: Pixels,
) -> None:
    for r in range(electrons.shape[0]):
        for c in range(electrons.shape[1]):
            # The well clips the electrons, shot noise included; read noise comes after it.
            mean = electrons[r, c]
            collected = min(mean + np.sqrt(mean + read_variance) * draws[r, c], full_well)
            value = pedestal + dn_per_electron * collected
            if response != np.float32(1):
                share = min(max(value, np.float32(0)), full_scale) / full_scale
                value = full_scale * share**response
            out[r, c] = int(min(max(value + np.float32(0.5), np.float32(0)), full_scale))


class SceneSnapshot:
    """A surface and a projector at fixed poses, and the ray caster of the surface."""

    def __init__(self, surface: SceneSurface, projector: Pinhole) -> None:
        self.surface = surface
        self.projector = projector
        self._rays: RayCaster | None = None
        self._lock = threading.Lock()

    @property
    def rays(self) -> RayCaster:
        """Ray caster of the surface, built on first use."""
        with self._lock:
            if self._rays is None:
                self._rays = build_caster(self.surface.vertices_mm, self.surface.faces)
            return self._rays


class SceneState:
    """Current surface and projector pose; replaced as a whole when something moves."""

    def __init__(
        self,
        surface: SceneSurface,
        projector: Pinhole,
        *,
        working_distance_mm: float,
        fall_off: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.snapshot = SceneSnapshot(surface, projector)
        self.fall_off = fall_off
        self.working_distance_mm = working_distance_mm

    @property
    def surface(self) -> SceneSurface:
        """Current surface."""
        return self.snapshot.surface

    @property
    def projector(self) -> Pinhole:
        """Current pose of the projector."""
        return self.snapshot.projector

    @property
    def rays(self) -> RayCaster:
        """Ray caster of the surface."""
        return self.snapshot.rays

    def change(self, *, surface: SceneSurface | None = None, projector: Pinhole | None = None) -> None:
        """Replace the surface or move the projector. Does nothing if the projector's pose is unchanged."""
        now = self.snapshot
        if surface is not None or (projector is not None and not is_same_pose(projector, now.projector)):
            self.snapshot = SceneSnapshot(surface or now.surface, projector or now.projector)


class _ViewCache:
    """Traced results for one scene snapshot and one camera pose.

    room : image under ambient light alone; lights : images under the projector lights requested last, as many as
    `_KEPT_BYTES` hold, and one at least.
    bounces : light by way of two surfaces, None if the scene has none.
    defocus_weights : weight of each level of defocus at every pixel, for the projector and for the camera.
    """

    def __init__(self, snapshot: SceneSnapshot, camera: Pinhole) -> None:
        self.snapshot = snapshot
        self.camera = camera
        self.paths: LightPaths | None = None
        self.bounces: Bounces | None = None
        self.room: Float32Array | None = None
        self.lights: dict[int, tuple[LightTable, Float32Array]] = {}
        self.defocus_weights: tuple[Weights, Weights] | None = None
        self.truth: CameraTruth | None = None


class CameraView:
    """View of one camera of the scene. Light paths are traced once per scene snapshot, by `prepare` or for an image."""

    def __init__(
        self,
        camera: Pinhole,
        scene: SceneState,
        *,
        blur_px: float,
        focus: tuple[Focus, Focus] = (ALWAYS_SHARP, ALWAYS_SHARP),
        ambient: float,
        samples_per_axis: int,
        jitter: bool,
        seed: int,
        workers: int,
    ) -> None:
        self._camera = camera
        self._scene = scene
        self._blur_px = blur_px
        self._focus = focus
        self._ambient = ambient
        self._samples_per_axis = samples_per_axis
        self._jitter = jitter
        self._seed = seed
        self._workers = workers
        self._cache = _ViewCache(scene.snapshot, camera)

    @property
    def camera(self) -> Pinhole:
        """Current pose of the camera."""
        return self._camera

    def move(self, camera: Pinhole) -> None:
        """Move the camera. Does nothing if the pose is unchanged."""
        if not is_same_pose(camera, self._camera):
            self._camera = camera

    @property
    def _current_cache(self) -> _ViewCache:
        """The cache for the current snapshot; empty if something has moved."""
        snapshot, camera = self._scene.snapshot, self._camera
        if self._cache.snapshot is not snapshot or self._cache.camera is not camera:
            self._cache = _ViewCache(snapshot, camera)
        return self._cache

    def prepare(self, *, report_progress: Callable[[float], None] = lambda _: None) -> LightPaths:
        """Trace the light paths, if not yet done, and return them. `report_progress` receives the fraction done."""
        return self._trace_paths(self._current_cache, report_progress)

    def _trace_paths(self, cache: _ViewCache, report_progress: Callable[[float], None] = lambda _: None) -> LightPaths:
        if cache.paths is None:
            cache.paths = transport.trace_paths(
                cache.camera,
                cache.snapshot.projector,
                cache.snapshot.surface,
                cache.snapshot.rays,
                samples_per_axis=self._samples_per_axis,
                jitter=self._jitter,
                seed=self._seed,
                working_distance_mm=self._scene.working_distance_mm,
                workers=self._workers,
                report_progress=report_progress,
            )
            if any(self._scene.fall_off):
                paths, projector = cache.paths, cache.snapshot.projector
                paths.weight[:] *= vignetting(paths.column_px, paths.row_px, projector, self._scene.fall_off)
            cache.bounces = trace_bounces(
                cache.camera,
                cache.snapshot.projector,
                cache.snapshot.surface,
                cache.snapshot.rays,
                samples_per_axis=self._samples_per_axis,
                jitter=self._jitter,
                seed=self._seed,
                working_distance_mm=self._scene.working_distance_mm,
                fall_off=self._scene.fall_off,
                workers=self._workers,
            )
        return cache.paths

    def image(
        self, lights: Sequence[tuple[float | Float32Array, LightTable]], *, ambient: Float32Array | None = None
    ) -> Float32Array:
        """Mean light on each pixel, (H, W) float32, when each light was on for its fraction of the exposure.

        A fraction is one number for the whole image, or (H, 1): one for each row. `ambient` is the ambient light of
        this exposure relative to its mean, (H, 1) or (1, 1); None for the mean. 1 is a white diffuser, at the working
        distance and facing the projector, under full white.
        """
        cache = self._current_cache
        paths = self._trace_paths(cache)
        if cache.room is None:
            cache.room = blur_image(paths.albedo * np.float32(self._ambient), self._blur_px)
        if ambient is None and len(lights) == 1 and np.ndim(lights[0][0]) == 0 and lights[0][0] == 1:
            return np.asarray(cache.room + self._cached_light(cache, paths, lights[0][1]))
        total = cache.room.copy() if ambient is None else cache.room * ambient
        for fraction, light in lights:
            total += np.asarray(fraction, np.float32) * self._cached_light(cache, paths, light)
        return total

    def colour(
        self, lights: Sequence[tuple[float | Float32Array, LightTable]], *, ambient: Float32Array | None = None
    ) -> Callable[[], Float32Array]:
        """Return a function that renders `image` in blue, green and red, (H, W, 3) float32, of the current scene."""
        cache = self._current_cache

        def channel(number: int) -> Float32Array:
            paths = self._trace_paths(cache).for_channel(number)
            total = blur_image(paths.albedo * np.float32(self._ambient), self._blur_px) * (
                1 if ambient is None else ambient
            )
            for fraction, light in lights:
                if light.channel not in (None, number):
                    continue
                total = total + np.asarray(fraction, np.float32) * self._render_light(cache, paths, light)
            return total

        return lambda: np.stack([channel(number) for number in range(3)], axis=2)

    def rehearse(self, lights: Sequence[tuple[float | Float32Array, LightTable]]) -> None:
        """Do the part of `image` that does not depend on fractions in advance, so that `image` is fast."""
        cache = self._current_cache
        paths = self._trace_paths(cache)
        for _, light in lights:
            self._cached_light(cache, paths, light)

    def _cached_light(self, cache: _ViewCache, paths: LightPaths, light: LightTable) -> Float32Array:
        # A free-running camera sees the same light repeatedly, and so does one before a sequence that is repeated.
        known = cache.lights.pop(id(light), None)
        if known is None:
            known = (light, self._render_light(cache, paths, light))
            while (len(cache.lights) + 1) * known[1].nbytes > _KEPT_BYTES and cache.lights:
                cache.lights.pop(next(iter(cache.lights)))
        cache.lights[id(light)] = known
        return known[1]

    def _render_light(self, cache: _ViewCache, paths: LightPaths, light: LightTable) -> Float32Array:
        if light.channel is not None:
            paths = paths.for_channel(light.channel)
        image = self._render_defocused(cache, paths, light)
        if cache.bounces is not None:
            image += blur_image(cache.bounces.image(light, paths.albedo), self._blur_px)
        image *= np.float32(light.power)
        if light.glow > 0:
            image += blur_image(paths.albedo * np.float32(light.glow), self._blur_px)
        return image

    def _render_defocused(self, cache: _ViewCache, paths: LightPaths, light: LightTable) -> Float32Array:
        """Projector light on each pixel, blended from images at several levels of defocus."""
        if not any(focus.far_px for focus in self._focus):
            return radiance(paths, light, blur_px=self._blur_px)
        if cache.defocus_weights is None:
            cache.defocus_weights = self._defocus_weights(cache)
        image = np.zeros(paths.albedo.shape, np.float32)
        tables = (light, *light.softer)
        for light_level, weight in cache.defocus_weights[0].items():
            for lens_level, share in cache.defocus_weights[1].items():
                combined = weight * share
                if combined.any():
                    blur_px = math.hypot(self._blur_px, LEVELS_PX[lens_level])
                    # A lamp that is off has no levels.
                    image += combined * radiance(paths, tables[min(light_level, len(tables) - 1)], blur_px=blur_px)
        return image

    def _defocus_weights(self, cache: _ViewCache) -> tuple[Weights, Weights]:
        """Level weights of projector and camera at each pixel, by the distance of the point at its centre."""
        if cache.truth is None:
            cache.truth = self._trace_truth(cache)
        camera, projector = cache.camera, cache.snapshot.projector
        centres = [(u, v) for _, u, v in transport.pixel_centres(camera)]
        u, v = (np.concatenate(each) for each in zip(*centres, strict=True))
        towards = world_directions(u, v, lens_array(camera), camera.rotation)
        from_eye = towards * (cache.truth.depth_mm.reshape(-1) / (towards @ camera.rotation[2]))[:, None]
        projector_focus, camera_focus = self._focus
        light_mm = np.linalg.norm(from_eye + camera.centre_mm - projector.centre_mm, axis=1).reshape(camera.size.shape)
        lens_mm = np.linalg.norm(from_eye, axis=1).reshape(camera.size.shape)
        return level_weights(projector_focus.spread_px(light_mm)), level_weights(camera_focus.spread_px(lens_mm))

    def truth(self) -> CameraTruth:
        """Return depth, projector coordinates and visible points of the current scene, by rays at the pixel centres."""
        cache = self._current_cache
        if cache.truth is None:
            cache.truth = self._trace_truth(cache)
        return cache.truth

    def _trace_truth(self, cache: _ViewCache) -> CameraTruth:
        camera, snapshot = cache.camera, cache.snapshot
        shape = camera.size.shape
        depth = np.full(shape, np.nan)
        projector_px = np.full((*shape, 2), np.nan)
        visible: list[NDArray[np.float64]] = []
        for rows, u, v in transport.pixel_centres(camera):
            hits = transport.trace_rays(
                u,
                v,
                camera,
                snapshot.projector,
                snapshot.surface,
                snapshot.rays,
                working_distance_mm=self._scene.working_distance_mm,
            )
            along = hits.points_mm @ camera.rotation[2] + camera.translation_mm[2]
            coordinates = np.column_stack([hits.column_px, hits.row_px])
            coordinates[~hits.is_lit] = np.nan
            depth[rows] = along.reshape(depth[rows].shape)
            projector_px[rows] = coordinates.reshape(projector_px[rows].shape)
            visible.append(hits.points_mm[hits.is_lit])
        return CameraTruth(depth, projector_px, np.concatenate(visible))


def is_same_pose(one: Pinhole, other: Pinhole) -> bool:
    """True if two devices have bitwise identical poses."""
    return np.array_equal(one.rotation, other.rotation) and np.array_equal(one.translation_mm, other.translation_mm)
