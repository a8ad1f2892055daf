"""Options in files: `[scan]` of a rig file and presets, turntables, poses of views, scan regions."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self, TypeVar

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from slrig.bundle.calibration import Vector3
from slrig.bundle.description import CameraName
from slrig.bundle.storage import json_bytes
from slrig.bundle.validation import AwareMoment, FreeText, Strict, read_json_model, read_toml, validate
from slrig.errors import ConfigError
from slrig.model import (
    FEWEST_EXPOSURES,
    MOST_EXPOSURES,
    Axis,
    FlipRule,
    FloatArray,
    MeasuredAxis,
    PlaneKind,
    SequenceName,
    StagePlane,
    bracket_fault,
)
from slrig.model.region import MOST_MASK_CHARACTERS, Region

MAX_VIEWS = 1000
_POSES_MAX_BYTES = 8 * 2**20
_ROTATION_TOLERANCE = 3e-5
"""How far R Rᵀ of numbers with five digits may be from 1: at most 2e-5 was found of 20 000 rotations."""

PoseRow = Annotated[list[float], Field(min_length=4, max_length=4)]


class AxisEntry(Strict):
    """An axis in the frame of the views, the stage's angle counted about its direction, right-handed."""

    point_mm: Vector3
    direction: Vector3

    @model_validator(mode="after")
    def _points_somewhere(self) -> Self:
        if not np.linalg.norm(self.direction) > 0:
            raise ValueError("direction: expected a vector with a length, found zeros")
        return self


def _check_rigid(rows: list[PoseRow]) -> list[PoseRow]:
    pose = np.array(rows)
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < _ROTATION_TOLERANCE and np.linalg.det(turn) > 0
    if not rigid or (pose[3] != [0, 0, 0, 1]).any():
        raise ValueError(f"expected a rotation and a shift, and 0 0 0 1 below, found {rows}")
    return rows


PoseEntry = Annotated[list[PoseRow], Field(min_length=4, max_length=4), AfterValidator(_check_rigid)]
"""A rigid motion, 4 x 4, to the digits that it is written with."""


class ViewEntry(Strict):
    """One view and its pose."""

    name: Annotated[str, Field(min_length=1, max_length=200)]
    pose: PoseEntry


class PosesEntry(Strict):
    """The whole of poses.json."""

    format: Literal["slrig-poses"]
    version: Literal[1]
    views: list[ViewEntry] = Field(default_factory=list, max_length=MAX_VIEWS)
    axis: AxisEntry | None = None


@dataclass(frozen=True, slots=True)
class Poses:
    """poses : (4, 4) float64 of each view by its name. axis : a point, mm, and the direction, (3,) each, or None."""

    poses: Mapping[str, FloatArray] = field(default_factory=dict)
    axis: tuple[FloatArray, FloatArray] | None = None


def read_poses(path: Path) -> Poses:
    """The poses and the axis in a file. Raises ConfigError: it cannot be read or is no such file, with every fault."""
    entry = read_json_model(path, PosesEntry, "file of poses", most_bytes=_POSES_MAX_BYTES, error=ConfigError)
    names = [view.name for view in entry.views]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{path}: expected each view once, found two poses of '{twice}'; leave one out")
    axis = None if entry.axis is None else (np.array(entry.axis.point_mm), np.array(entry.axis.direction))
    return Poses({view.name: orthonormalise_pose(view.pose) for view in entry.views}, axis)


def orthonormalise_pose(entry: Sequence[Sequence[float]]) -> FloatArray:
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


MAX_HISTORY = 500
"""Changes of the axis that are kept, the newest: a model an hour for three weeks."""
_TURNTABLE_MAX_BYTES = 2 * 2**20
_MAX_PLANES = 16

TurntableRow = Annotated[list[float], Field(min_length=6, max_length=6)]
Length = Annotated[float, Field(ge=0, le=1e6)]


class AxisSource(StrEnum):
    """What an axis was found by."""

    BOARD = "board"
    MODEL = "model"
    DOCUMENT = "document"


class MeasuredEntry(AxisEntry):
    """An axis, and how well it is known."""

    covariance: Annotated[list[TurntableRow], Field(min_length=6, max_length=6)]

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
    planes: list[PlaneEntry] = Field(default_factory=list, max_length=_MAX_PLANES)
    history: list[ChangeEntry] = Field(default_factory=list, max_length=MAX_HISTORY)


@dataclass(frozen=True, slots=True)
class StageRecord:
    """What is known of a stage. history : from old to new."""

    axis: MeasuredAxis | None = None
    planes: tuple[StagePlane, ...] = ()
    history: tuple[ChangeEntry, ...] = ()


def read_stage(path: Path) -> StageRecord:
    """What a file says of a stage. Raises ConfigError: it cannot be read or is no such file, with every fault."""
    return stage_record(read_json_model(path, StageEntry, "stage", most_bytes=_TURNTABLE_MAX_BYTES, error=ConfigError))


def stage_record(entry: StageEntry) -> StageRecord:
    """The same of a document that was checked."""
    axis = entry.axis
    return StageRecord(
        None
        if axis is None
        else MeasuredAxis(np.array(axis.point_mm), _normalise(axis.direction), np.array(axis.covariance)),
        tuple(
            StagePlane(
                each.kind,
                np.array(each.point_mm),
                _normalise(each.normal),
                each.sigma_mm,
                each.radius_mm,
                each.margin_mm,
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
        format="slrig-stage", version=1, axis=measured, planes=planes, history=list(record.history[-MAX_HISTORY:])
    )


def encode_stage(record: StageRecord) -> bytes:
    """A stage as a file's bytes."""
    return json_bytes(stage_entry(record).model_dump(mode="json"))


def _normalise(vector: list[float]) -> FloatArray:
    """The vector at length 1; one that was written so keeps its digits."""
    found = np.array(vector, dtype=np.float64)
    length = float(np.linalg.norm(found))
    return found if abs(length - 1) < 1e-12 else np.asarray(found / length)


MAX_REGION_BYTES = 2**20

# A list in TOML and in JSON.
_Corner = Annotated[tuple[float, float, float], Field(strict=False)]
_Range = Annotated[tuple[float, float], Field(strict=False)]
_Box = Annotated[tuple[_Corner, _Corner], Field(strict=False)]
_Polygon = Annotated[
    tuple[_Range, ...], Field(strict=False, json_schema_extra={"minItems": 3, "maxItems": 1000}, max_length=1000)
]


class RegionTable(Strict):
    """A part of the scene, and limits of what counts as measured; all else is left out, before it costs time."""

    box_mm: _Box | None = Field(
        default=None, description="least and greatest corner of a box in the world, [[x, y, z], [x, y, z]]"
    )
    depth_mm: _Range | None = Field(
        default=None, description="nearest and furthest depth along each camera's optical axis"
    )
    polygons_px: dict[CameraName, _Polygon] = Field(
        default_factory=dict, description="by camera, corners [x, y] of the part of its image that counts"
    )
    masks: dict[CameraName, Annotated[str, Field(max_length=MOST_MASK_CHARACTERS)]] = Field(
        default_factory=dict,
        description="by camera, the same as a PNG of the image's extent, in base64: what is not black counts",
    )
    least_contrast: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        default=None, description="least white less black of a pixel, as a share of full scale"
    )
    most_sigma_mm: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="greatest stated standard deviation of a vertex"
    )

    @model_validator(mode="after")
    def _limits_to_something(self) -> Self:
        try:
            self.region()
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return self

    def region(self) -> Region:
        """The same as a frozen value. Raises ConfigError: see there."""
        return Region(**self.__dict__)


def read_region(path: Path) -> RegionTable:
    """What a TOML file of the same keys describes. A mask may be the path of a PNG, beside the file.

    Raises
    ------
    ConfigError
        The file cannot be read, or is no region, with every fault in one message.
    """
    return validate(RegionTable, embed_masks(read_toml(path, MAX_REGION_BYTES), path.parent), str(path))


def embed_masks(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What a file says of a region, with the masks that it names by their paths, from its own folder on, in it.
    Raises ConfigError: one of them cannot be read.
    """
    masks = table.get("masks")
    if not isinstance(masks, Mapping):
        return dict(table)
    read = {
        camera: base64.b64encode(_read_mask(folder / named)).decode()
        if isinstance(named, str) and named.lower().endswith(".png")
        else named
        for camera, named in masks.items()
    }
    return {**table, "masks": read}


def _read_mask(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        message = (
            f"{path}: expected a mask as PNG, found: {error.strerror}; the path counts from the file that names it"
        )
        raise ConfigError(message) from error


PRESET_VERSION: Final = 1
EXPOSURE_KEYS = ("exposure_s", "exposures_s", "exposure_factors")
"""Three ways to say how long to expose: who says one of them says it all."""

T = TypeVar("T")


def _check_bracket(exposures_s: tuple[float, ...]) -> tuple[float, ...]:
    fault = bracket_fault(exposures_s)
    if fault is not None:
        raise ValueError(fault)
    return exposures_s


def _check_factors(factors: tuple[float, ...]) -> tuple[float, ...]:
    return factors if len(factors) == 1 else _check_bracket(factors)


ExposureSeconds = Annotated[float, Field(gt=0, le=60)]
BracketSeconds = Annotated[
    tuple[ExposureSeconds, ...],
    # A list in TOML and in JSON. Its length is checked with the rest, or one wrong time would be told as two faults.
    Field(strict=False, json_schema_extra={"minItems": FEWEST_EXPOSURES, "maxItems": MOST_EXPOSURES}),
    AfterValidator(_check_bracket),
]
ExposureFactors = Annotated[
    tuple[Annotated[float, Field(gt=0, le=1000)], ...],
    Field(strict=False, json_schema_extra={"minItems": 1, "maxItems": MOST_EXPOSURES}),
    AfterValidator(_check_factors),
]
PRESET_NAME = r"[a-z][a-z0-9_-]{0,39}"
PresetName = Annotated[str, Field(pattern=f"^{PRESET_NAME}$")]


def refuse_alternatives(asked: T, info: ValidationInfo, keys: Sequence[str] = EXPOSURE_KEYS) -> T:
    """A validator of one of the keys. Raises ValueError: another one was given before it."""
    before = [key for key in keys if info.data.get(key) is not None]
    if asked is not None and before:
        message = f"expected {before[0]} or {info.field_name}, found both; keep one of them"
        raise ValueError(message)
    return asked


class ScanDefaults(Strict):
    """What a scan on this rig does unless its request says otherwise. The keys are those of a scan's plan."""

    sequence: Annotated[SequenceName, Field(strict=False)] | None = Field(
        default=None, description="what stands where the other pattern options say nothing. Default: standard"
    )
    line_shift: bool | None = None
    line_shift_period_px: Annotated[int, Field(ge=4)] | None = None
    line_steps: Annotated[int, Field(ge=3)] | None = None
    line_width_px: Annotated[int, Field(ge=1)] | None = None
    inverses: bool | None = None
    gray_cell_px: Annotated[int, Field(ge=1)] | None = None
    gray_offset_px: Annotated[int, Field(ge=0)] | None = None
    rows: bool | None = None
    keep_holes: bool | None = None
    depth_edge_ratio: Annotated[float, Field(gt=1)] | None = None
    max_code_gap: Annotated[int, Field(ge=1)] | None = None
    flip_rule: Annotated[FlipRule, Field(strict=False)] | None = None
    smooth_boundary: bool | None = None
    axis: Annotated[Axis, Field(strict=False)] | None = None
    region: RegionTable | None = None
    exposure_s: ExposureSeconds | None = None
    exposures_s: BracketSeconds | None = Field(
        default=None,
        description="a bracket: play the sequence once for each of these exposures, and fuse the frames. On a video "
        "projector, whole refresh periods",
    )
    exposure_factors: ExposureFactors | None = Field(
        default=None,
        description="in place of the others, times the exposure that the rig's cameras have by themselves, so that it "
        "means the same on another rig: one, or two to six for a bracket. Where cameras differ, a bracket is of their "
        "geometric mean. What a camera cannot do becomes the nearest that it can",
    )
    colour: bool | None = Field(
        default=None, description="keep white and black frames in colour. Default: where a camera has it"
    )
    coloured_light: bool | None = Field(
        default=None, description="play white in red, green and blue too, for cameras without colour. Default: false"
    )

    @field_validator("exposure_factors")
    @classmethod
    def _one_bracket(cls, factors: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        # Beside exposure_s, which in a rig file is what the cameras have by themselves.
        return refuse_alternatives(factors, info, EXPOSURE_KEYS[1:])


class Preset(ScanDefaults):
    """Options for a kind of object. They stand above the rig file's `[scan]`, and below what a request says itself."""

    description: FreeText | None = Field(default=None, description="what it is for")

    _one_exposure = field_validator("exposures_s", "exposure_factors")(refuse_alternatives)

    def over(self, usual: ScanDefaults) -> ScanDefaults:
        """The usual options, but for what this one says; who says how long to expose says all of it."""
        own = {key: value for key in ScanDefaults.model_fields if (value := getattr(self, key)) is not None}
        other = dict.fromkeys(EXPOSURE_KEYS) if own.keys() & set(EXPOSURE_KEYS) else {}
        return usual.model_copy(update={**other, **own})


def _check_version(version: object) -> object:
    if version != PRESET_VERSION:
        message = (
            f"this slrig reads version {PRESET_VERSION} of presets, found {version!r}; bring slrig up to date, or have "
            "the preset written by the version that runs here"
        )
        raise ValueError(message)
    return version


class PresetDocument(Strict):
    """A preset as a file that rigs may share. Its name is not in it."""

    format: Literal["slrig-preset"] = "slrig-preset"
    version: Annotated[Literal[1], BeforeValidator(_check_version)] = PRESET_VERSION
    scan: Preset

    @property
    def digest(self) -> str:
        """Twelve hexadecimal digits that change with any option, and not with the description."""
        options: dict[str, Any] = self.scan.model_dump(mode="json", exclude_none=True, exclude={"description"})
        return hashlib.sha256(json_bytes(dict(sorted(options.items())))).hexdigest()[:12]
