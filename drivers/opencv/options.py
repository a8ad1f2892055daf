"""Options of the driver `opencv`, and the source that they describe."""

from __future__ import annotations

import re
import stat
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated
from urllib.parse import urlsplit, urlunsplit

import cv2
from pydantic import Field, field_validator

from slrig.bundle import Strict, validate
from slrig.errors import ConfigError
from slrig.model import Size

Extent = Annotated[int, Field(ge=1, le=65_536)]
_NUMBERED = re.compile(r"%0?\d*d")


class SourceKind(StrEnum):
    """Kind of a source, which decides how the driver reads it."""

    DEVICE = "device"
    """A camera of the kernel, with controls: read from `arm` to `disarm`, timed by stamps, or else by arrival."""
    LIVE = "live"
    """A stream: read from opening to `close`, timed by arrival."""
    FILM = "film"
    """A recording: starts again at `arm`, with its own times."""


class OpenCvOptions(Strict, use_attribute_docstrings=True):
    """The keys of a `[[camera]]` table with `driver = "opencv"` (in addition to name, exposure_s and gain)."""

    device: Annotated[int, Field(ge=0, le=255)] | Annotated[str, Field(min_length=1)]
    """An index, a device's path, a URL, a file, or a numbered series ("frames/%03d.png")."""

    backend: str = "auto"
    """OpenCV's name of the backend (v4l2, ffmpeg, gstreamer, …). "auto" is v4l2 for cameras on Linux, ffmpeg for URLs
    and films, images for a series, and for others OpenCV's choice."""

    size_px: Annotated[tuple[Extent, Extent], Field(strict=False)] | None = None
    """[width, height]; else the source's own size."""

    fourcc: Annotated[str, Field(pattern=r"^[\x20-\x7e]{3,4}$")] | None = None
    """The pixel format's four characters."""

    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)] | None = None
    """Rate to set a camera to; highest rate of a live source; rate of a film, in place of its own."""

    bit_depth: Annotated[int, Field(ge=8, le=16)] | None = None
    """Number of low bits of a 16-bit sample that the sensor fills; else all of the format."""

    source_exposure_s: Annotated[float, Field(gt=0, le=60)] | None = None
    """Longest exposure of a source that OpenCV cannot set; unused where it can."""

    delay_s: Annotated[float, Field(ge=0, le=60)] | None = None
    """Longest time from the end of an exposure to the frame's arrival, including all buffers, for a source without time
    stamps; for a camera with time stamps, it replaces them."""

    settle_frames: Annotated[int, Field(ge=1, le=1000)] = 5
    """Frames of a camera discarded after it starts, until its settings have taken effect."""

    focus: float | None = None
    """Value of a camera's focus control, wanted of a lens with a motor; autofocus is off in any case."""

    skip_controls: Annotated[tuple[str, ...], Field(strict=False)] = ()
    """Controls of a camera to leave as they are, by their names in `v4l2-ctl --list-ctrls`."""

    @field_validator("backend")
    @classmethod
    def _check_backend(cls, name: str) -> str:
        known = sorted(_backends())
        if name not in {"auto", *known}:
            message = f"expected auto or one of {', '.join(known)}, found '{name}'; this OpenCV has no other"
            raise ValueError(message)
        return name

    @property
    def size(self) -> Size | None:
        """The requested size of frames, if any."""
        return None if self.size_px is None else Size(*self.size_px)


@dataclass(frozen=True, slots=True)
class CaptureSource:
    """A source: what OpenCV opens, with which backend, and how it is timed.

    `label` names it in messages, without the password that a URL may contain.
    """

    kind: SourceKind
    target: int | str
    backend: int
    label: str
    options: OpenCvOptions


class _LiveOptions(OpenCvOptions):
    source_exposure_s: Annotated[float, Field(gt=0, le=60)]
    delay_s: Annotated[float, Field(ge=0, le=60)]
    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)]


class _UnstampedOptions(OpenCvOptions):
    delay_s: Annotated[float, Field(ge=0, le=60)]
    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)]


class _FilmOptions(OpenCvOptions):
    source_exposure_s: Annotated[float, Field(gt=0, le=60)]
    delay_s: None = None


class _SeriesOptions(_FilmOptions):
    frame_rate_hz: Annotated[float, Field(gt=0, le=100_000)]


_NEEDED: Mapping[type[OpenCvOptions], str] = {
    OpenCvOptions: "",
    _LiveOptions: "\n(This source has no time stamps. For exposure times, the driver needs the longest exposure "
    "(source_exposure_s), the longest delay (delay_s) and the highest frame rate (frame_rate_hz).)",
    _UnstampedOptions: "\n(With delay_s, time stamps are not used. For exposure times, the driver then also needs the "
    "highest frame rate: frame_rate_hz.)",
    _FilmOptions: "\n(For a film, the driver needs the exposure of its frames: source_exposure_s.)",
    _SeriesOptions: "\n(For a series of images, the driver needs their exposure, source_exposure_s, and their rate, "
    "frame_rate_hz.)",
}


def parse_source(name: str, options: Mapping[str, object], folder: Path) -> CaptureSource:
    """Return the source that a camera's options describe. Raises ConfigError with all their faults."""
    device = options.get("device")
    model: type[OpenCvOptions] = OpenCvOptions
    kind, default_backend, target = SourceKind.LIVE, cv2.CAP_ANY, device
    if isinstance(device, str) and "://" in device:
        kind, model, default_backend = SourceKind.LIVE, _LiveOptions, cv2.CAP_FFMPEG
    elif isinstance(device, str) and device and not device.startswith("/dev/"):
        target = str(folder / device)
        kind, model, default_backend = _classify_file(name, folder / device)
    elif sys.platform == "linux" and options.get("backend", "auto") in {"auto", "v4l2"}:
        kind, default_backend = SourceKind.DEVICE, cv2.CAP_V4L2
        if "delay_s" in options:
            model = _UnstampedOptions
    elif device is not None:
        model = _LiveOptions
    parsed = validate(model, options, f"the table of camera '{name}'", hint=_NEEDED[model])
    backend = {**_backends(), "auto": default_backend}[parsed.backend]
    return CaptureSource(
        kind, target if isinstance(target, int) else str(target), backend, _label(parsed.device, target), parsed
    )


def _backends() -> dict[str, int]:
    found = cv2.videoio_registry.getBackends()
    named = {cv2.videoio_registry.getBackendName(number).lower(): number for number in found}
    return {**named, "images": cv2.CAP_IMAGES}


def _label(device: int | str, target: object) -> str:
    if isinstance(device, int):
        return f"/dev/video{device}" if sys.platform == "linux" else f"camera {device}"
    return _without_password(device) if "://" in device else str(target)


def _classify_file(name: str, path: Path) -> tuple[SourceKind, type[OpenCvOptions], int]:
    if _NUMBERED.search(path.name):
        return SourceKind.FILM, _SeriesOptions, cv2.CAP_IMAGES
    try:
        mode = path.stat().st_mode
    except OSError as error:
        message = f"camera '{name}': device = \"{path}\": expected a file, found: {error.strerror}; correct the path"
        raise ConfigError(message) from error
    if stat.S_ISREG(mode):
        return SourceKind.FILM, _FilmOptions, cv2.CAP_FFMPEG
    if stat.S_ISFIFO(mode):
        return SourceKind.LIVE, _LiveOptions, cv2.CAP_FFMPEG
    message = f"camera '{name}': device = \"{path}\": expected a film or a pipe, found another kind of file; correct it"
    raise ConfigError(message)


def _without_password(url: str) -> str:
    parts = urlsplit(url)
    host = parts.netloc.rpartition("@")[2]
    return urlunsplit(parts._replace(netloc=host, query=""))
