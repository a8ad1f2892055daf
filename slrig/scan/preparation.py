"""Kernels prepared before there is a frame: by a small made-up scan that needs all that a usual scan needs.

Where they have to be compiled, two processes share that: this one begins with those that read the frames, another
with those that make a mesh (`slrig.meshing.preparation`). What that one cannot do is compiled here in the end.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import structlog
from numba import config

from slrig.bundle import write_bundle
from slrig.errors import StorageError
from slrig.kernels import KernelCount, count_prepared, rare_garbage_collection, report_compilations
from slrig.meshing import FIRST_STAGE
from slrig.model import Calibration, CameraFormat, Capture, FloatArray, Pinhole, Pixels, Shot, Size
from slrig.patterns import encode, scan_patterns
from slrig.scan.plan import ReconstructionPlan

_SIZE = Size(192, 144)
_FOCAL_PX = 192.0
_BASELINE_MM = 60.0
_DISTANCE_MM = 400.0
_CAMERA = "sample"

_log = structlog.get_logger(__name__)


def prepare_kernels(reconstruct: Callable[..., Any], told: Callable[[KernelCount], None]) -> None:
    """Load every kernel that a usual scan needs; the first time they are compiled.

    reconstruct : `slrig.scan.reconstruct.reconstruct_bundle`. `told` hears how far that is, once for every kernel or
    part of one that has to be compiled, on the thread that compiles it.
    """
    with rare_garbage_collection(), _MeshingCompiler() as beside:

        def compiling(_: str) -> None:
            beside.start()
            told(count_prepared())

        def entered(stage: str, *_: object) -> None:
            if stage == FIRST_STAGE:
                beside.join()

        try:
            with report_compilations(compiling), TemporaryDirectory(prefix="slrig-") as folder:
                bundle = Path(folder, "bundle")
                write_bundle(bundle, *sample_scan())
                reconstruct(
                    bundle, Path(folder, "result"), plan=ReconstructionPlan(), progress=entered,
                    cancelled=lambda: False,
                )  # fmt: skip
        except (OSError, StorageError) as error:
            # A full disk is told by the scan that meets it; kernels are then compiled while it waits.
            _log.warning("kernels could not be prepared", cause=str(error))


class _MeshingCompiler:
    """The other process, while there is need of it. A context manager: at the end of the block it is no more."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._late = config.NUMBA_NUM_THREADS < 2

    def start(self) -> None:
        """Begin, unless that was done, is too late, or no core is idle: where the rig is rendered, it compiles, too."""
        if self._late or not _has_idle_core():
            return
        self._late = True
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "slrig.meshing.preparation"],
                stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
            )  # fmt: skip
        except OSError as error:
            _log.warning("kernels are compiled by one process", cause=str(error))

    def join(self) -> None:
        """Wait until it has done what it can."""
        self._late = True
        if self._process is not None:
            self._process.wait()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.communicate()


def _has_idle_core() -> bool:
    """Whether fewer threads run now, this one among them, than there are cores; so it is where nobody can tell."""
    try:
        running, _ = Path("/proc/loadavg").read_text().split()[3].split("/")
        return bool(int(running) < config.NUMBA_NUM_THREADS)
    except (OSError, ValueError, IndexError):
        return True


def sample_scan() -> tuple[Capture, Calibration]:
    """Frames of a wavy sheet with a hole in it, as one camera beside a projector sees them, and the calibration."""
    camera, projector = _device(0.0), _device(_BASELINE_MM)
    patterns = scan_patterns(
        _SIZE, line_shift=True, period_px=8, line_width_px=None, gray_cell_px=None, gray_offset_px=0, rows=False,
        inverses=False, closing=1,
    )  # fmt: skip
    column, lit = _seen_columns(camera, projector)
    noise = np.random.default_rng(0)
    shots = []
    for index, profile in enumerate(encode(patterns, _SIZE).profiles):
        light = cv2.GaussianBlur(np.broadcast_to(profile, (1, _SIZE.width_px)).astype(np.float64), (0, 0), 0.8)
        seen = 12 + 0.75 * lit * np.interp(column, np.arange(_SIZE.width_px), light[0]) + noise.normal(0, 1, lit.shape)
        image: Pixels = np.clip(np.rint(seen), 0, 255).astype(np.uint8)
        shots.append(Shot(index, _CAMERA, image, exposure_s=0.0167, time_s=index / 30))
    capture = Capture(_SIZE, patterns, {_CAMERA: CameraFormat(_SIZE, 8)}, tuple(shots))
    return capture, Calibration({_CAMERA: camera}, projector)


def _device(x_mm: float) -> Pinhole:
    """A device that looks along z from (x_mm, 0, 0)."""
    centre = (_SIZE.width_px - 1) / 2, (_SIZE.height_px - 1) / 2
    matrix = np.array([[_FOCAL_PX, 0, centre[0]], [0, _FOCAL_PX, centre[1]], [0, 0, 1]])
    return Pinhole(_SIZE, matrix, np.zeros(5), np.eye(3), np.array([-x_mm, 0.0, 0.0]))


def _seen_columns(camera: Pinhole, projector: Pinhole) -> tuple[FloatArray, FloatArray]:
    """(H, W) each: the projector column that lights what each camera pixel sees, and 1 where there is a surface."""
    y, x = np.mgrid[: _SIZE.height_px, : _SIZE.width_px].astype(np.float64)
    depth_mm = _DISTANCE_MM + 15 * np.sin(x / 17) * np.cos(y / 13)
    x_mm = (x - camera.matrix[0, 2]) / _FOCAL_PX * depth_mm
    column = _FOCAL_PX * (x_mm - _BASELINE_MM) / depth_mm + projector.matrix[0, 2]
    hole = np.hypot(x - 110, y - 60) < 12
    return column, np.where(hole, 0.1, 1.0)
