"""Header of a capture: its patterns and cameras, known before the first frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from slrig.model import Axis, CameraFormat, Capture, Gray, Pattern, Size


@dataclass(frozen=True, slots=True)
class CaptureHeader:
    """Everything that a `Capture` tells but the images. frames : pattern and camera of each, in order."""

    projector: Size
    patterns: tuple[Pattern, ...]
    cameras: Mapping[str, CameraFormat]
    frames: tuple[tuple[int, str], ...]

    @classmethod
    def of(cls, capture: Capture) -> CaptureHeader:
        """The header of frames that are there already."""
        frames = tuple((shot.pattern, shot.camera) for shot in capture.shots)
        return cls(capture.projector, capture.patterns, capture.cameras, frames)

    @property
    def shown(self) -> frozenset[Pattern]:
        """The patterns of which there are frames; a description may list more."""
        return frozenset(self.patterns[index] for index, _ in self.frames)

    @property
    def axes(self) -> frozenset[Axis]:
        """The axes whose code is shown."""
        return frozenset(pattern.axis for pattern in self.shown if isinstance(pattern, Gray))
