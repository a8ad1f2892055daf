"""bundle.json: the description of a scan bundle, validated before a single pixel is read."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidatorFunctionWrapHandler, WrapValidator, field_validator

from slrig.bundle.validation import MAX_FAULTS, AwareMoment, Strict, read_json_model
from slrig.errors import BundleError, PatternError
from slrig.model import CameraFormat, Pattern, Size

DESCRIPTION = "bundle.json"
MAX_DESCRIPTION_BYTES = 16 * 2**20
MAX_SIDE_PX = 2**15
MAX_CAMERA_PX = 2**26
MAX_CAPTURE_BYTES = 2**32
CAMERA_NAME = r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$"
"""Names of cameras become names of files."""
PROJECTOR = "projector"
"""Name of the projector among those of the cameras; no camera may have it."""

Side = Annotated[int, Field(ge=1, le=MAX_SIDE_PX)]
Extent = Annotated[list[Side], Field(min_length=2, max_length=2)]


def _refuse_projector_name(name: str) -> str:
    if name == PROJECTOR:
        message = f"expected a camera's own name, found '{name}', which is the projector's; rename the camera"
        raise ValueError(message)
    return name


CameraName = Annotated[str, Field(pattern=CAMERA_NAME), AfterValidator(_refuse_projector_name)]


class ProjectorEntry(Strict):
    """The projector: its number of columns and rows."""

    size_px: Extent


class CameraEntry(Strict):
    """One camera: extent and bit depth of its frames, and the focal length that imported pictures stated."""

    size_px: Extent
    bit_depth: Annotated[int, Field(ge=1, le=16)]
    focal_px: Annotated[float, Field(gt=0)] | None = None
    compression_dn: Annotated[
        float,
        Field(ge=0, le=1000, description="written by earlier versions; now measured in the frames"),
    ] = 0.0

    @field_validator("size_px")
    @classmethod
    def _check_frame_size(cls, size_px: list[int]) -> list[int]:
        if size_px[0] * size_px[1] > MAX_CAMERA_PX:
            raise ValueError(
                f"expected at most {MAX_CAMERA_PX} pixels per frame, found {size_px[0]} x {size_px[1]}; "
                "crop or bin the frames"
            )
        return size_px


def _validate_pattern(data: object, handler: ValidatorFunctionWrapHandler) -> Pattern:
    try:
        pattern: Pattern = handler(data)
    except PatternError as cause:
        raise ValueError(str(cause)) from cause
    return pattern


PatternEntry = Annotated[Pattern, Field(discriminator="kind"), WrapValidator(_validate_pattern)]


class FrameEntry(Strict):
    """One frame: its pattern, camera, file, page of the file, and time.

    colour_file : the same picture in colour, of a white or black frame.
    """

    pattern: Annotated[int, Field(ge=0)]
    camera: CameraName
    file: str
    page: Annotated[int, Field(ge=0, le=65535)] = 0
    colour_file: str | None = None
    exposure_s: Annotated[float, Field(gt=0)] | None = None
    time_s: float | None = None

    @field_validator("file", "colour_file")
    @classmethod
    def _check_path(cls, file: str | None) -> str | None:
        if file is None:
            return None
        path = PurePosixPath(file)
        if not path.parts or path.is_absolute() or ".." in path.parts or "\\" in file or ":" in file or "\0" in file:
            raise ValueError(
                f"expected a path inside the bundle with forward slashes, found {file!r}; "
                "copy the frame into the bundle and write its path relative to bundle.json"
            )
        return file


class Description(Strict):
    """The whole of bundle.json."""

    format: Literal["slrig-bundle"]
    version: Literal[1]
    projector: ProjectorEntry
    cameras: Annotated[dict[CameraName, CameraEntry], Field(min_length=1)]
    patterns: Annotated[list[PatternEntry], Field(min_length=1)]
    frames: Annotated[list[FrameEntry], Field(min_length=1)]
    captured_at: Annotated[
        AwareMoment | None, Field(description="when the capture began, ISO 8601 with the offset from UTC")
    ] = None

    def projector_size(self) -> Size:
        """Extent of the projector."""
        return Size(*self.projector.size_px)

    def camera_formats(self) -> dict[str, CameraFormat]:
        """Extent and bit depth of each camera."""
        return {name: CameraFormat(Size(*entry.size_px), entry.bit_depth) for name, entry in self.cameras.items()}

    def pattern_list(self) -> tuple[Pattern, ...]:
        """The patterns in order."""
        return tuple(self.patterns)


def read_description(folder: Path) -> Description:
    """Return the validated description of the bundle in `folder`.
    Raises BundleError: every fault of bundle.json in one message.
    """
    path = folder / DESCRIPTION
    if not path.is_file():
        found = f"there is no {DESCRIPTION} in it" if folder.is_dir() else "it is a file" if folder.is_file() else ""
        packed = f"unpack it (python3 -m zipfile -e {folder} NEW_FOLDER) and " if folder.suffix == ".zip" else ""
        why = f"{found}; {packed}give the folder that holds {DESCRIPTION}" if found else "the folder does not exist"
        message = f"{folder} is not a scan bundle: {why}"
        raise BundleError(message)
    name = "bundle description"
    description = read_json_model(path, Description, name, max_bytes=MAX_DESCRIPTION_BYTES, error=BundleError)
    faults = _find_inconsistencies(description)
    if faults:
        message = f"{path} is not a valid {name}:\n" + "\n".join(f"  {fault}" for fault in faults[:MAX_FAULTS])
        raise BundleError(message)
    return description


def _find_inconsistencies(description: Description) -> list[str]:
    """Return faults between different parts of the file."""
    faults = []
    cameras = description.camera_formats()
    size_bytes = 0
    for index, frame in enumerate(description.frames):
        if frame.pattern >= len(description.patterns):
            faults.append(
                f"frames[{index}].pattern: expected 0 to {len(description.patterns) - 1}, found {frame.pattern}; "
                "number the patterns from 0"
            )
        camera = cameras.get(frame.camera)
        if camera is None:
            faults.append(
                f"frames[{index}].camera: expected one of {', '.join(cameras)}, found '{frame.camera}'; "
                "name a camera of the list `cameras`"
            )
            continue
        images = 1 if frame.colour_file is None else 4
        size_bytes += images * camera.size.width_px * camera.size.height_px * (1 if camera.bit_depth <= 8 else 2)
    if size_bytes > MAX_CAPTURE_BYTES:
        faults.append(
            f"frames: expected at most {MAX_CAPTURE_BYTES / 1e9:.1f} GB of samples, "
            f"found {size_bytes / 1e9:.1f} GB in {len(description.frames)} frames; split the bundle or crop its frames"
        )
    return faults
