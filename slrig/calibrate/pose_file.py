"""What was read of a pose, kept beside it, so that a solve need not read the frames again."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from slrig.calibrate.solving import ReadPose
from slrig.calibration.observations import BoardView, Correspondences, PoseObservation, ViewFigures
from slrig.errors import StorageError

_PARTS: Mapping[str, type[Any]] = {"view": BoardView, "light": Correspondences, "figures": ViewFigures}


def reading_bytes(pose: ReadPose) -> bytes:
    """A pose as the bytes of an .npz file: one array per field of each part of each camera."""
    arrays: dict[str, Any] = {"name": np.array(pose.observation.name)}
    for part, camera, value in _parts(pose):
        for each in fields(_PARTS[part]):
            arrays[f"{part}/{camera}/{each.name}"] = np.asarray(getattr(value, each.name))
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def read_reading(path: Path) -> ReadPose:
    """Return the pose that a file holds. Raises StorageError."""
    found: dict[str, dict[str, dict[str, Any]]] = {part: {} for part in _PARTS}
    try:
        with np.load(path, allow_pickle=False) as archive:
            name = str(archive["name"])
            for key in archive.files:
                if key != "name":
                    part, camera, field = key.split("/")
                    found[part].setdefault(camera, {})[field] = archive[key]
        figures = {
            camera: ViewFigures(**{field: float(value) for field, value in values.items()})
            for camera, values in found["figures"].items()
        }
        views = {camera: _view(**values) for camera, values in found["view"].items()}
        light = {camera: Correspondences(**values) for camera, values in found["light"].items()}
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile) as error:
        message = f"{path} cannot be read ({error}). Drop that pose (DELETE …/pose/N) and shoot it again."
        raise StorageError(message) from error
    return ReadPose(PoseObservation(name, views, light), figures)


def _view(light_first: Any = False, **values: Any) -> BoardView:
    return BoardView(**values, light_first=bool(light_first))


def _parts(pose: ReadPose) -> Iterator[tuple[str, str, Any]]:
    for camera, view in pose.observation.views.items():
        yield "view", camera, view
    for camera, light in pose.observation.correspondences.items():
        yield "light", camera, light
    for camera, figures in pose.figures.items():
        yield "figures", camera, figures
