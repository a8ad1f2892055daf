"""What a scan may be asked for in files: `[scan]` of a rig file, and presets, which rigs may share."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field, ValidationInfo, field_validator

from slrig.bundle.faults import Strict
from slrig.bundle.free_text import FreeText
from slrig.bundle.region_file import RegionTable
from slrig.bundle.storage import json_bytes
from slrig.model import FEWEST_EXPOSURES, MOST_EXPOSURES, Axis, FlipRule, SequenceName, bracket_fault

PRESET_VERSION: Final = 1
EXPOSURE_KEYS = ("exposure_s", "exposures_s", "exposure_factors")
"""Three ways to say how long to expose: who says one of them says it all."""

T = TypeVar("T")


def _a_bracket(exposures_s: tuple[float, ...]) -> tuple[float, ...]:
    fault = bracket_fault(exposures_s)
    if fault is not None:
        raise ValueError(fault)
    return exposures_s


def _factors(factors: tuple[float, ...]) -> tuple[float, ...]:
    return factors if len(factors) == 1 else _a_bracket(factors)


ExposureSeconds = Annotated[float, Field(gt=0, le=60)]
BracketSeconds = Annotated[
    tuple[ExposureSeconds, ...],
    # A list in TOML and in JSON. Its length is checked with the rest, or one wrong time would be told as two faults.
    Field(strict=False, json_schema_extra={"minItems": FEWEST_EXPOSURES, "maxItems": MOST_EXPOSURES}),
    AfterValidator(_a_bracket),
]
ExposureFactors = Annotated[
    tuple[Annotated[float, Field(gt=0, le=1000)], ...],
    Field(strict=False, json_schema_extra={"minItems": 1, "maxItems": MOST_EXPOSURES}),
    AfterValidator(_factors),
]
PRESET_NAME = r"[a-z][a-z0-9_-]{0,39}"
PresetName = Annotated[str, Field(pattern=f"^{PRESET_NAME}$")]


def alone(asked: T, info: ValidationInfo, keys: Sequence[str] = EXPOSURE_KEYS) -> T:
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
        return alone(factors, info, EXPOSURE_KEYS[1:])


class Preset(ScanDefaults):
    """Options for a kind of object. They stand above the rig file's `[scan]`, and below what a request says itself."""

    description: FreeText | None = Field(default=None, description="what it is for")

    _one_exposure = field_validator("exposures_s", "exposure_factors")(alone)

    def over(self, usual: ScanDefaults) -> ScanDefaults:
        """The usual options, but for what this one says; who says how long to expose says all of it."""
        own = {key: value for key in ScanDefaults.model_fields if (value := getattr(self, key)) is not None}
        other = dict.fromkeys(EXPOSURE_KEYS) if own.keys() & set(EXPOSURE_KEYS) else {}
        return usual.model_copy(update={**other, **own})


def _a_known_version(version: object) -> object:
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
    version: Annotated[Literal[1], BeforeValidator(_a_known_version)] = PRESET_VERSION
    scan: Preset

    @property
    def digest(self) -> str:
        """Twelve hexadecimal digits that change with any option, and not with the description."""
        options: dict[str, Any] = self.scan.model_dump(mode="json", exclude_none=True, exclude={"description"})
        return hashlib.sha256(json_bytes(dict(sorted(options.items())))).hexdigest()[:12]
