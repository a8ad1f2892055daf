"""The region that a scan is limited to, as a request, a rig file or a file of its own describes it."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import Field, model_validator

from slrig.bundle.description import CameraName
from slrig.bundle.faults import Strict, checked, read_toml
from slrig.errors import ConfigError
from slrig.model.region import MOST_MASK_CHARACTERS, Region

MOST_REGION_BYTES = 2**20

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
    return checked(RegionTable, with_masks(read_toml(path, MOST_REGION_BYTES), path.parent), str(path))


def with_masks(table: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """What a file says of a region, with the masks that it names by their paths, from its own folder on, in it.
    Raises ConfigError: one of them cannot be read.
    """
    masks = table.get("masks")
    if not isinstance(masks, Mapping):
        return dict(table)
    read = {
        camera: base64.b64encode(_bytes_of(folder / named)).decode()
        if isinstance(named, str) and named.lower().endswith(".png")
        else named
        for camera, named in masks.items()
    }
    return {**table, "masks": read}


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        message = (
            f"{path}: expected a mask as PNG, found: {error.strerror}; the path counts from the file that names it"
        )
        raise ConfigError(message) from error
