"""Small captures and calibrations for tests, with no meaning beyond their shape."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np

from slrig.jobs.database import Database
from slrig.model import (
    Axis,
    Black,
    Calibration,
    CameraFormat,
    Capture,
    Gray,
    LineShift,
    Pinhole,
    Pixels,
    Shot,
    Size,
    White,
)

CAMERA = Size(40, 30)
PROJECTOR = Size(32, 24)


def noise(camera: CameraFormat, seed: int) -> Pixels:
    """An image of random samples over the camera's whole scale."""
    kind = np.uint8 if camera.bit_depth <= 8 else np.uint16
    samples = np.random.default_rng(seed).integers(0, camera.full_scale + 1, camera.size.shape)
    return samples.astype(kind)


def sample_capture(*, bit_depth: int = 8, cameras: tuple[str, ...] = ("left", "right")) -> Capture:
    """One frame per pattern and camera: white, black, two Gray bits, one line shift."""
    camera = CameraFormat(CAMERA, bit_depth)
    patterns = (
        White(),
        Black(),
        Gray(Axis.COLUMN, 0, 5),
        Gray(Axis.ROW, 1, 4, cell_px=2, offset_px=3, inverted=True),
        LineShift(Axis.COLUMN, 3, 8, line_width_px=2),
    )
    shots = tuple(
        Shot(index, name, noise(camera, 100 * place + index), exposure_s=0.0167, time_s=0.05 * index)
        for index in range(len(patterns))
        for place, name in enumerate(cameras)
    )
    return Capture(PROJECTOR, patterns, dict.fromkeys(cameras, camera), shots)


def pinhole(size: Size = CAMERA, *, turn_rad: float = 0.1) -> Pinhole:
    """A device turned about the vertical axis, half a metre from the world's origin."""
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    return Pinhole(
        size,
        np.array([[50.0, 0.0, size.width_px / 3], [0.0, 51.0, size.height_px / 3], [0.0, 0.0, 1.0]]),
        np.array([-0.1, 0.02, 1 / 3000, -1e-4, 1e-17]),
        np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]),
        np.array([1 / 3, -2.0, 500.0]),
    )


def sample_calibration(*, cameras: tuple[str, ...] = ("left", "right")) -> Calibration:
    """A calibration for `sample_capture`."""
    devices = {name: pinhole(turn_rad=0.1 * place) for place, name in enumerate(cameras)}
    return Calibration(devices, pinhole(PROJECTOR, turn_rad=-0.2))


@cache
def _empty_database() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "slrig.sqlite"
        Database(path).close()
        return path.read_bytes()


def put_database(path: Path) -> Path:
    """Put the file of an empty database there, unless one is there: to make its tables takes three times as long."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists():
        path.write_bytes(_empty_database())
    return path
