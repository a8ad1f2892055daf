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
from slrig.bundle.validation import MAX_NUMBER, AwareMoment, FreeText, Strict, read_json_model, read_toml, validate
from slrig.errors import ConfigError
from slrig.model import (
    MAX_EXPOSURES,
    MAX_MASK_CHARACTERS,
    MIN_EXPOSURES,
    Axis,
    FlipRule,
    FloatArray,
    MeasuredAxis,
    MeshAxes,
    PlaneKind,
    Region,
    SequenceName,
    TurntablePlane,
    bracket_fault,
)

MAX_VIEWS = 1000
_POSES_MAX_BYTES = 8 * 2**20
_ROTATION_TOLERANCE = 3e-5
"""Largest difference of R Rᵀ from 1 in a rotation written with five digits."""

PoseRow = Annotated[list[Annotated[float, Field(ge=-MAX_NUMBER, le=MAX_NUMBER)]], Field(min_length=4, max_length=4)]

MAX_HISTORY = 500
"""Number of changes of the axis that are kept: a model an hour for three weeks."""
_TURNTABLE_MAX_BYTES = 2 * 2**20
_MAX_PLANES = 16

MAX_REGION_BYTES = 2**20

PRESET_VERSION: Final = 1
EXPOSURE_KEYS = ("exposure_s", "exposures_s", "exposure_factors")
"""Alternative keys for the exposure; one of them replaces all others."""

T = TypeVar("T")

PRESET_NAME = r"[a-z][a-z0-9_-]{0,39}"


class AxisEntry(Strict):
    """An axis in the frame of the views; the turntable's angle is counted about its direction, right-handed."""

    point_mm: Vector3
    direction: Vector3

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        if not np.linalg.norm(self.direction) > 1e-30:
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
"""A rigid motion, 4 x 4, to its number of digits in the file."""


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
    """Return the poses and the axis in a file. Raises ConfigError: it cannot be read or is wrong; with every fault."""
    entry = read_json_model(path, PosesEntry, "file of poses", max_bytes=_POSES_MAX_BYTES, error=ConfigError)
    names = [view.name for view in entry.views]
    if len(set(names)) < len(names):
        duplicate = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{path}: expected each view once, found two poses of '{duplicate}'; leave one out")
    axis = None if entry.axis is None else (np.array(entry.axis.point_mm), np.array(entry.axis.direction))
    return Poses({view.name: orthonormalise_pose(view.pose) for view in entry.views}, axis)


def orthonormalise_pose(entry: Sequence[Sequence[float]]) -> FloatArray:
    """(4, 4): the pose with the nearest rotation to the rounded one in a file."""
    pose = np.array(entry)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right
    return pose


def encode_poses(poses: Poses) -> bytes:
    """Return poses as a file's bytes."""
    data: dict[str, Any] = {
        "format": "slrig-poses",
        "version": 1,
        "views": [{"name": name, "pose": pose.tolist()} for name, pose in poses.poses.items()],
    }
    if poses.axis is not None:
        data["axis"] = {"point_mm": poses.axis[0].tolist(), "direction": poses.axis[1].tolist()}
    return json_bytes(data)


TurntableRow = Annotated[list[float], Field(min_length=6, max_length=6)]
Length = Annotated[float, Field(ge=0, le=1e6)]


class AxisSource(StrEnum):
    """Origin of an axis."""

    BOARD = "board"
    MODEL = "model"
    DOCUMENT = "document"


class MeasuredEntry(AxisEntry):
    """An axis and its uncertainty."""

    covariance: Annotated[list[TurntableRow], Field(min_length=6, max_length=6)]

    @model_validator(mode="after")
    def _check_covariance(self) -> Self:
        found = np.array(self.covariance)
        scale = np.abs(found).max()
        if not np.allclose(found, found.T, atol=1e-6 * scale) or np.linalg.eigvalsh(found)[0] < -1e-6 * scale:
            raise ValueError("covariance: expected a symmetric matrix without a negative variance; export it again")
        return self


class PlaneEntry(Strict):
    """A plane; points behind it or within its margin do not belong to an object."""

    kind: Annotated[PlaneKind, Field(strict=False)]
    point_mm: Vector3
    normal: Vector3
    sigma_mm: Length
    radius_mm: Length
    margin_mm: Length

    @model_validator(mode="after")
    def _check_normal(self) -> Self:
        if not np.linalg.norm(self.normal) > 1e-30:
            raise ValueError("normal: expected a vector with a length, found zeros")
        return self


class ChangeEntry(Strict):
    """Effect of a newly found axis on the one on record."""

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


class TurntableEntry(Strict):
    """The whole of turntable.json."""

    format: Literal["slrig-turntable"]
    version: Literal[1]
    axis: MeasuredEntry | None = None
    planes: list[PlaneEntry] = Field(default_factory=list, max_length=_MAX_PLANES)
    history: list[ChangeEntry] = Field(default_factory=list, max_length=MAX_HISTORY)


@dataclass(frozen=True, slots=True)
class TurntableRecord:
    """Axis, planes and history of a turntable. history : from old to new."""

    axis: MeasuredAxis | None = None
    planes: tuple[TurntablePlane, ...] = ()
    history: tuple[ChangeEntry, ...] = ()


def read_turntable(path: Path) -> TurntableRecord:
    """Return the record of a turntable in a file. Raises ConfigError: it cannot be read or is invalid, with every
    fault.
    """
    return turntable_record(
        read_json_model(path, TurntableEntry, "turntable", max_bytes=_TURNTABLE_MAX_BYTES, error=ConfigError)
    )


def turntable_record(entry: TurntableEntry) -> TurntableRecord:
    """Convert a validated document to a record."""
    axis = entry.axis
    return TurntableRecord(
        None
        if axis is None
        else MeasuredAxis(np.array(axis.point_mm), _normalise(axis.direction), np.array(axis.covariance)),
        tuple(
            TurntablePlane(
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


def turntable_entry(record: TurntableRecord) -> TurntableEntry:
    """Convert a record to a document, as the inverse of `turntable_record`."""
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
    return TurntableEntry(
        format="slrig-turntable", version=1, axis=measured, planes=planes, history=list(record.history[-MAX_HISTORY:])
    )


def encode_turntable(record: TurntableRecord) -> bytes:
    """Return a turntable as a file's bytes."""
    return json_bytes(turntable_entry(record).model_dump(mode="json"))


def _normalise(vector: list[float]) -> FloatArray:
    """Return the vector at length 1; one that has it already keeps its digits."""
    array = np.array(vector, dtype=np.float64)
    length = float(np.linalg.norm(array))
    return array if abs(length - 1) < 1e-12 else np.asarray(array / length)


# A list in TOML and in JSON.
_Corner = Annotated[tuple[float, float, float], Field(strict=False)]
_Range = Annotated[tuple[float, float], Field(strict=False)]
_Box = Annotated[tuple[_Corner, _Corner], Field(strict=False)]
_Polygon = Annotated[
    tuple[_Range, ...], Field(strict=False, json_schema_extra={"minItems": 3, "maxItems": 1000}, max_length=1000)
]


class RegionTable(Strict):
    """A part of the scene, and limits of valid measurements; everything else is omitted before it costs time."""

    box_mm: _Box | None = Field(
        default=None, description="minimum and maximum corner of a box in the world, [[x, y, z], [x, y, z]]"
    )
    depth_mm: _Range | None = Field(
        default=None, description="nearest and furthest depth along each camera's optical axis"
    )
    polygons_px: dict[CameraName, _Polygon] = Field(
        default_factory=dict, description="by camera, corners [x, y] of the valid part of its image"
    )
    masks: dict[CameraName, Annotated[str, Field(max_length=MAX_MASK_CHARACTERS)]] = Field(
        default_factory=dict,
        description="by camera, the same as a PNG of the image's extent, in base64: black is invalid",
    )
    min_contrast: Annotated[float, Field(gt=0, lt=1)] | None = Field(
        default=None, description="minimum of white less black of a pixel, as a share of full scale"
    )
    max_sigma_mm: Annotated[float, Field(gt=0)] | None = Field(
        default=None, description="maximum stated standard deviation of a vertex"
    )

    @model_validator(mode="after")
    def _check_region(self) -> Self:
        try:
            self.region()
        except ConfigError as error:
            raise ValueError(str(error)) from error
        return self

    def region(self) -> Region:
        """Return the region as a frozen value. Raises ConfigError: see there."""
        return Region(**self.__dict__)


def read_region(path: Path) -> RegionTable:
    """Return the region in a TOML file with the same keys. A mask may be the path of a PNG, relative to the file.
    Raises ConfigError: the file cannot be read or is not a region, with every fault in one message.
    """
    return validate(RegionTable, embed_masks(read_toml(path, MAX_REGION_BYTES), path.parent), str(path))


def embed_masks(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a region table with the contents of the masks that it names by paths relative to `folder`.
    Raises ConfigError: a mask cannot be read.
    """
    masks = table.get("masks")
    if not isinstance(masks, Mapping):
        return dict(table)
    embedded = {
        camera: base64.b64encode(_read_mask(folder / mask)).decode()
        if isinstance(mask, str) and mask.lower().endswith(".png")
        else mask
        for camera, mask in masks.items()
    }
    return {**table, "masks": embedded}


def _read_mask(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        message = (
            f"{path}: expected a mask as PNG, found: {error.strerror}; the path counts from the file that names it"
        )
        raise ConfigError(message) from error


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
    # A list in TOML and in JSON. `_check_bracket` checks its length, so that one wrong time is one fault only.
    Field(strict=False, json_schema_extra={"minItems": MIN_EXPOSURES, "maxItems": MAX_EXPOSURES}),
    AfterValidator(_check_bracket),
]
ExposureFactors = Annotated[
    tuple[Annotated[float, Field(gt=0, le=1000)], ...],
    Field(strict=False, json_schema_extra={"minItems": 1, "maxItems": MAX_EXPOSURES}),
    AfterValidator(_check_factors),
]
PresetName = Annotated[str, Field(pattern=f"^{PRESET_NAME}$")]


def refuse_alternatives(value: T, info: ValidationInfo, keys: Sequence[str] = EXPOSURE_KEYS) -> T:
    """Validate one of several alternative keys. Raises ValueError: another one was given before it."""
    given = [key for key in keys if info.data.get(key) is not None]
    if value is not None and given:
        message = f"expected {given[0]} or {info.field_name}, found both; keep one of them"
        raise ValueError(message)
    return value


class ScanDefaults(Strict):
    """Defaults of scans on this rig; a request may override them. The keys are those of a scan's plan."""

    sequence: Annotated[SequenceName, Field(strict=False)] | None = Field(
        default=None, description="values of the pattern options that are not given. Default: standard"
    )
    line_shift: bool | None = None
    line_shift_period_px: Annotated[int, Field(ge=4)] | None = None
    line_steps: Annotated[int, Field(ge=3)] | None = None
    line_width_px: Annotated[int, Field(ge=1)] | None = None
    sine_period_px: Annotated[int, Field(ge=4)] | None = None
    sine_steps: Annotated[int, Field(ge=3)] | None = None
    inverses: bool | None = None
    gray_cell_px: Annotated[int, Field(ge=1)] | None = None
    gray_offset_px: Annotated[int, Field(ge=0)] | None = None
    rows: bool | None = None
    cross_lines: bool | None = None
    keep_holes: bool | None = None
    depth_edge_ratio: Annotated[float, Field(gt=1)] | None = None
    max_code_gap: Annotated[int, Field(ge=1)] | None = None
    flip_rule: Annotated[FlipRule, Field(strict=False)] | None = None
    smooth_boundary: bool | None = None
    axis: Annotated[Axis, Field(strict=False)] | None = None
    region: RegionTable | None = None
    drop_finest_bits: Annotated[int, Field(ge=0)] | None = None
    mesh_axes: Annotated[MeshAxes, Field(strict=False)] | None = None
    exposure_s: ExposureSeconds | None = None
    exposures_s: BracketSeconds | None = Field(
        default=None,
        description="a bracket: play the sequence once for each of these exposures, and fuse the frames. On a video "
        "projector, whole refresh periods",
    )
    exposure_factors: ExposureFactors | None = Field(
        default=None,
        description="in place of the others, factors of the cameras' own exposures, so that they mean the same on "
        "another rig: one, or two to six for a bracket. If cameras differ, a bracket uses their geometric mean. An "
        "exposure that a camera cannot do becomes the nearest that it can",
    )
    colour: bool | None = Field(
        default=None, description="keep white and black frames in colour. Default: if a camera has colour"
    )
    coloured_light: bool | None = Field(
        default=None, description="play white in red, green and blue too, for cameras without colour. Default: false"
    )

    @field_validator("mesh_axes")
    @classmethod
    def _of_any_scan(cls, axes: MeshAxes | None) -> MeshAxes | None:
        if axes is MeshAxes.ROBOT:
            raise ValueError("expected upright or rig, found robot, which is asked for scan by scan; leave it out")
        return axes

    @field_validator("exposure_factors")
    @classmethod
    def _refuse_two_brackets(cls, factors: tuple[float, ...] | None, info: ValidationInfo) -> tuple[float, ...] | None:
        # exposure_s may be given too: in a rig file it is the cameras' own exposure.
        return refuse_alternatives(factors, info, EXPOSURE_KEYS[1:])


class Preset(ScanDefaults):
    """Options for a kind of object. They override the rig file's `[scan]`; a request overrides them."""

    description: FreeText | None = Field(default=None, description="purpose of the preset")

    _one_exposure = field_validator("exposures_s", "exposure_factors")(refuse_alternatives)

    def apply_to(self, defaults: ScanDefaults) -> ScanDefaults:
        """Return the defaults with these options; one exposure key replaces all exposure keys."""
        own = {key: value for key in ScanDefaults.model_fields if (value := getattr(self, key)) is not None}
        cleared = dict.fromkeys(EXPOSURE_KEYS) if own.keys() & set(EXPOSURE_KEYS) else {}
        return defaults.model_copy(update={**cleared, **own})


def _check_version(version: object) -> object:
    if version != PRESET_VERSION:
        message = (
            f"this slrig reads version {PRESET_VERSION} of presets, found {version!r}; update slrig, or write the "
            "preset with the version that runs here"
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
        """Twelve hexadecimal digits that depend on every option, but not on the description."""
        options: dict[str, Any] = self.scan.model_dump(mode="json", exclude_none=True, exclude={"description"})
        return hashlib.sha256(json_bytes(dict(sorted(options.items())))).hexdigest()[:12]
