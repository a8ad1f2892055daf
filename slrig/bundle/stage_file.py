"""stage.json: a stage's axis, the planes that stand still behind what it turns, and how the axis came to be.

    {"format": "slrig-stage", "version": 1,
     "axis": {"point_mm": [4.0, 45.0, 512.0], "direction": [0.03, -0.94, -0.34], "covariance": [[…], …]},
     "planes": [{"kind": "plate", "point_mm": […], "normal": […], "sigma_mm": 0.04, "radius_mm": 80.0,
                 "margin_mm": 1.3}],
     "history": […]}

All of it is in the calibration's world frame. The covariance (6, 6) is of the point (mm) and of the direction (rad).
Each part may be absent.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from slrig.bundle.calibration_file import Vector3
from slrig.bundle.faults import Strict, read_description_of
from slrig.bundle.moments import AwareMoment
from slrig.bundle.poses_file import AxisEntry
from slrig.bundle.storage import json_bytes
from slrig.errors import ConfigError
from slrig.model import FloatArray, MeasuredAxis, PlaneKind, StagePlane

MOST_HISTORY = 500
"""Changes of the axis that are kept, the newest: a model an hour for three weeks."""
_MOST_BYTES = 2 * 2**20
_MOST_PLANES = 16

Row = Annotated[list[float], Field(min_length=6, max_length=6)]
Length = Annotated[float, Field(ge=0, le=1e6)]


class AxisSource(StrEnum):
    """What an axis was found by."""

    BOARD = "board"
    MODEL = "model"
    DOCUMENT = "document"


class MeasuredEntry(AxisEntry):
    """An axis, and how well it is known."""

    covariance: Annotated[list[Row], Field(min_length=6, max_length=6)]

    @model_validator(mode="after")
    def _is_covariance(self) -> Self:
        found = np.array(self.covariance)
        scale = np.abs(found).max()
        if not np.allclose(found, found.T, atol=1e-6 * scale) or np.linalg.eigvalsh(found)[0] < -1e-6 * scale:
            raise ValueError("covariance: expected a symmetric matrix without a negative variance; export it again")
        return self


class PlaneEntry(Strict):
    """A plane, behind which and within whose margin nothing belongs to an object."""

    kind: Annotated[PlaneKind, Field(strict=False)]
    point_mm: Vector3
    normal: Vector3
    sigma_mm: Length
    radius_mm: Length
    margin_mm: Length

    @model_validator(mode="after")
    def _faces_somewhere(self) -> Self:
        if not np.linalg.norm(self.normal) > 0:
            raise ValueError("normal: expected a vector with a length, found zeros")
        return self


class ChangeEntry(Strict):
    """What an axis that was found did to the one on record."""

    at: AwareMoment
    source: Annotated[AxisSource, Field(strict=False)] = Field(description="what it was found by")
    of: Annotated[str, Field(max_length=200)] = Field(description="the calibration session or the model, by its id")
    point_mm: Vector3 = Field(description="of the axis that was found")
    direction: Vector3
    point_sigma_mm: Length
    direction_sigma_deg: Length
    moved_mm: Length | None = Field(description="from the one on record, at most, up to 50 mm along it")
    moved_deg: Length | None
    sigmas: Annotated[float, Field(ge=0)] | None = Field(description="that distance over its deviation")
    taken: bool = Field(description="whether it is in the axis on record")


class StageEntry(Strict):
    """The whole of stage.json."""

    format: Literal["slrig-stage"]
    version: Literal[1]
    axis: MeasuredEntry | None = None
    planes: list[PlaneEntry] = Field(default_factory=list, max_length=_MOST_PLANES)
    history: list[ChangeEntry] = Field(default_factory=list, max_length=MOST_HISTORY)


@dataclass(frozen=True, slots=True)
class StageRecord:
    """What is known of a stage. history : from old to new."""

    axis: MeasuredAxis | None = None
    planes: tuple[StagePlane, ...] = ()
    history: tuple[ChangeEntry, ...] = ()


def read_stage(path: Path) -> StageRecord:
    """What a file says of a stage. Raises ConfigError: it cannot be read or is no such file, with every fault."""
    return stage_record(read_description_of(path, StageEntry, "stage", most_bytes=_MOST_BYTES, error=ConfigError))


def stage_record(entry: StageEntry) -> StageRecord:
    """The same of a document that was checked."""
    axis = entry.axis
    return StageRecord(
        None
        if axis is None
        else MeasuredAxis(np.array(axis.point_mm), _unit(axis.direction), np.array(axis.covariance)),
        tuple(
            StagePlane(
                each.kind, np.array(each.point_mm), _unit(each.normal), each.sigma_mm, each.radius_mm, each.margin_mm
            )
            for each in entry.planes
        ),
        tuple(entry.history),
    )


def stage_entry(record: StageRecord) -> StageEntry:
    """The inverse of `stage_record`."""
    axis, measured = record.axis, None
    if axis is not None:
        point, direction, covariance = (each.tolist() for each in (axis.point_mm, axis.direction, axis.covariance))
        measured = MeasuredEntry(point_mm=point, direction=direction, covariance=covariance)
    planes = [
        PlaneEntry(
            kind=each.kind,
            point_mm=each.point_mm.tolist(),
            normal=each.normal.tolist(),
            sigma_mm=each.sigma_mm,
            radius_mm=each.radius_mm,
            margin_mm=each.margin_mm,
        )
        for each in record.planes
    ]
    return StageEntry(
        format="slrig-stage", version=1, axis=measured, planes=planes, history=list(record.history[-MOST_HISTORY:])
    )


def encode_stage(record: StageRecord) -> bytes:
    """A stage as a file's bytes."""
    return json_bytes(stage_entry(record).model_dump(mode="json"))


def _unit(vector: list[float]) -> FloatArray:
    """The vector at length 1; one that was written so keeps its digits."""
    found = np.array(vector, dtype=np.float64)
    length = float(np.linalg.norm(found))
    return found if abs(length - 1) < 1e-12 else np.asarray(found / length)
