"""A projector, and the scene that pylon's emulated camera sees it light.

With `ImageFileMode` on and `ImageFilename` a folder, the emulated camera reads its next picture from the disk when it
is triggered. Just before, the picture is written here: as bright as the light and the exposure make it. There are two
files, because a single one is read once and then kept.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slrig.devices import DisplayedPattern, Projector, ProjectorInfo, ProjectorState, SystemClock
from slrig.model import PatternSequence, Pixels, Size

FULL_SCALE_S = 1 / 40
LATENCY_S = 0.004

_ERROR_NS = 50_000
_camera_class = importlib.import_module("pypylon.pylon").InstantCamera
_execute = _camera_class.ExecuteSoftwareTrigger


class SceneProjector:
    """Implements `slrig.devices.Projector`: its light is in the pictures of a folder. It steps; it does not play."""

    def __init__(self, scene: Path, projector: Size, camera: Size) -> None:
        self.info = ProjectorInfo("projector", "scene of pylon's camera", scene.name, projector, False, LATENCY_S)
        self._scene, self._camera = scene, camera
        self._state = ProjectorState()
        self._dark: Pixels = np.zeros((1, 1), np.uint8)
        self._before = self._now = self._dark
        self._since_ns = 0
        _camera_class.ExecuteSoftwareTrigger = lambda camera: self._trigger(camera)
        self._expose(0.0)

    def load(self, sequence: PatternSequence) -> None:
        """See `Projector`."""
        self._state.require_open()
        self._state.require_size(sequence, self.info.size)
        self.blank()
        self._state.loaded = sequence

    def show(self, index: int) -> DisplayedPattern:
        """See `Projector`."""
        rows = self._state.require_pattern(index).profiles[index]
        visible_ns = time.monotonic_ns() + round(LATENCY_S * 1e9)
        self._light(rows, visible_ns)
        SystemClock().wait_until(visible_ns + _ERROR_NS, self._state.closed)
        return DisplayedPattern(index, visible_ns, _ERROR_NS)

    def play(self, exposure_s: float, period_s: float) -> None:
        """See `Projector`."""
        self._state.refuse_to_play(exposure_s, period_s)

    def stop(self) -> None:
        """See `Projector`."""
        self.blank()

    def blank(self) -> None:
        """See `Projector`."""
        self._light(self._dark, time.monotonic_ns())

    def close(self) -> None:
        """See `Projector`."""
        self.blank()
        self._state.loaded = None
        self._state.closed.set()

    def _light(self, rows: Pixels, since_ns: int) -> None:
        self._before, self._now, self._since_ns = self._now, rows, since_ns

    def _trigger(self, camera: Any) -> None:
        self._expose(camera.ExposureTimeAbs.GetValue() / 1e6)
        _execute(camera)

    def _expose(self, exposure_s: float) -> None:
        """Write what a camera sees that exposes from now on."""
        rows = self._now if time.monotonic_ns() >= self._since_ns else self._before
        light = cv2.resize(np.atleast_2d(rows).astype(np.float64), (self._camera.width_px, self._camera.height_px))
        picture = np.clip(4 + light * exposure_s / FULL_SCALE_S, 0, 255).astype(np.uint8)
        _, data = cv2.imencode(".png", picture)
        for name in ("a", "b"):
            (self._scene / f"{name}.png").write_bytes(data.tobytes())


def open_projector(options: Mapping[str, object], folder: Path) -> Projector:
    """Open the projector; `scene` is the folder, `camera_px` the extent of the camera's picture."""
    scene, camera_px = options["scene"], options["camera_px"]
    assert isinstance(scene, str)
    assert isinstance(camera_px, list)
    return SceneProjector(folder / scene, Size(128, 96), Size(*camera_px))
