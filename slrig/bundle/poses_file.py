"""poses.json: where views of one object belong, and the axis that a stage turned it about; read and written.

    {"format": "slrig-poses", "version": 1,
     "views": [{"name": "front", "pose": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, …],
     "axis": {"point_mm": [4.0, 45.0, 12.0], "direction": [0.03, -0.94, -0.34]}}

A pose takes a view's coordinates, mm, to those of the first view; its upper left 3 x 3 is a rotation. Either part may
be absent: who knows the axis alone writes that.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from slrig.bundle.calibration_file import Vector3
from slrig.bundle.faults import Strict, read_description_of
from slrig.bundle.storage import json_bytes
from slrig.errors import ConfigError
from slrig.model import FloatArray

MOST_VIEWS = 1000
_MOST_BYTES = 8 * 2**20
_ROUNDED = 3e-5
"""How far R Rᵀ of numbers with five digits may be from 1: at most 2e-5 was found of 20 000 rotations."""

Row = Annotated[list[float], Field(min_length=4, max_length=4)]


class AxisEntry(Strict):
    """An axis in the frame of the views, the stage's angle counted about its direction, right-handed."""

    point_mm: Vector3
    direction: Vector3

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not np.linalg.norm(self.direction) > 0:
            raise ValueError("direction: expected a vector with a length, found zeros")
        return self


def _rigid(rows: list[Row]) -> list[Row]:
    pose = np.array(rows)
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _ROUNDED and np.linalg.det(turn) > 0
    if not rigid or (pose[3] != [0, 0, 0, 1]).any():
        raise ValueError(f"expected a rotation and a shift, and 0 0 0 1 below, found {rows}")
    return rows


PoseEntry = Annotated[list[Row], Field(min_length=4, max_length=4), AfterValidator(_rigid)]
"""A rigid motion, 4 x 4, to the digits that it is written with."""


class ViewEntry(Strict):
    """One view and its pose."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    pose: PoseEntry


class PosesEntry(Strict):
    """The whole of poses.json."""

    format: Literal["slrig-poses"]
    version: Literal[1]
    views: list[ViewEntry] = Field(default_factory=list, max_length=MOST_VIEWS)
    axis: AxisEntry | None = None


@dataclass(frozen=True, slots=True)
class Poses:
    """poses : (4, 4) float64 of each view by its name. axis : a point, mm, and the direction, (3,) each, or None."""

    poses: Mapping[str, FloatArray] = field(default_factory=dict)
    axis: tuple[FloatArray, FloatArray] | None = None


def read_poses(path: Path) -> Poses:
    """The poses and the axis in a file. Raises ConfigError: it cannot be read or is no such file, with every fault."""
    entry = read_description_of(path, PosesEntry, "file of poses", most_bytes=_MOST_BYTES, error=ConfigError)
    names = [view.name for view in entry.views]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{path}: expected each view once, found two poses of '{twice}'; leave one out")
    axis = None if entry.axis is None else (np.array(entry.axis.point_mm), np.array(entry.axis.direction))
    return Poses({view.name: rotating(view.pose) for view in entry.views}, axis)


def rotating(entry: Sequence[Sequence[float]]) -> FloatArray:
    """(4, 4): the pose with the nearest rotation to what was written of it: the two agree to the digits that were."""
    pose = np.array(entry)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return pose


def encode_poses(poses: Poses) -> bytes:
    """The same as a file's bytes."""
    data: dict[str, Any] = {
        "format": "slrig-poses",
        "version": 1,
        "views": [{"name": name, "pose": pose.tolist()} for name, pose in poses.poses.items()],
    }
    if poses.axis is not None:
        data["axis"] = {"point_mm": poses.axis[0].tolist(), "direction": poses.axis[1].tolist()}
    return json_bytes(data)
