"""The frames of one pose of a calibration board: which show it whole, which carry codes, whose they are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.bundle import read_description
from slrig.calibration import PROJECTOR
from slrig.errors import PoseRefusedError
from slrig.model import Axis, Black, Capture, Gray, LineShift, Pattern, Pixels, Shot, Size, White
from slrig.reconstruction import exposure_count

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]
"""A cut of an image: its rows and its columns."""

_MOST_VIEWS = 6
_SHOOT = "shoot white, black, the Gray bits and their inverses of columns and of rows, with line shift if it is offered"


@dataclass(frozen=True, slots=True)
class PoseFrames:
    """One camera's frames of one pose.

    white : (H, W) float32, mean of its white frames; clipped : (H, W) bool, pixels at full scale in one of them.
    black : (H, W) float32, mean of its black frames, None where there are none.
    views : (H, W) float32 each, frames in which the whole board is lit, in the order in which they were taken: white
    ones, and where inverses were shown the sum of a bit and its inverse, less black.
    """

    white: Image
    clipped: Mask
    black: Image | None
    views: tuple[Image, ...]


def bundle_device_sizes(folder: Path) -> dict[str, Size]:
    """The sizes of the devices that a bundle is of: cameras by name, and PROJECTOR where it played codes.

    From its description alone. `slrig.calibration.poses.checks.check_same_devices` compares those of two poses.
    Raises BundleError.
    """
    description = read_description(folder)
    cameras = {name: form.size for name, form in description.camera_formats().items()}
    coded = any(isinstance(pattern, Gray | LineShift) for pattern in description.pattern_list())
    return {**cameras, PROJECTOR: description.projector_size()} if coded else cameras


def window_about(region: Mask, margin_px: int) -> Window:
    """The box about what is True in an image, and a margin round it."""
    spans = []
    for axis, length in enumerate(region.shape):
        (places,) = np.nonzero(region.any(axis=1 - axis))
        spans.append(slice(max(int(places[0]) - margin_px, 0), min(int(places[-1]) + 1 + margin_px, length)))
    return spans[0], spans[1]


def coded_axes(capture: Capture, camera: str, name: str) -> tuple[Axis, ...]:
    """The axes whose codes a camera saw: both, or none.

    Raises
    ------
    PoseRefusedError
        One axis only, or there are several exposures.
    """
    shots = [shot for shot in capture.shots if shot.camera == camera]
    if exposure_count([shot.exposure_s for shot in shots]) > 1:
        message = (
            f"pose '{name}', camera '{camera}': expected frames of one exposure, found several; a board needs no "
            "bracket: shoot the pose with one exposure at which its paper is bright and not clipped"
        )
        raise PoseRefusedError(message)
    shown = {capture.patterns[shot.pattern] for shot in shots}
    axes = tuple(axis for axis in Axis if any(isinstance(p, Gray) and p.axis is axis for p in shown))
    if len(axes) == 1:
        (only,) = axes
        other = next(axis for axis in Axis if axis is not only)
        message = (
            f"pose '{name}', camera '{camera}': expected codes of both axes, found those of {only}s alone; a point of "
            f"the projector has a column and a row. Shoot the pose again with the {other} patterns as well: {_SHOOT}"
        )
        raise PoseRefusedError(message)
    return axes


def pose_frames(capture: Capture, camera: str, name: str) -> PoseFrames:
    """Sort out the frames of one camera that show the whole board.

    Raises
    ------
    PoseRefusedError
        The camera has no white frame.
    """
    shots = [shot for shot in capture.shots if shot.camera == camera]
    whites = [shot.image for shot in shots if isinstance(capture.patterns[shot.pattern], White)]
    blacks = [shot.image for shot in shots if isinstance(capture.patterns[shot.pattern], Black)]
    if not whites:
        message = (
            f"pose '{name}': camera '{camera}' has no white frame, and in the others the board is lit in stripes; "
            f"{_SHOOT}"
        )
        raise PoseRefusedError(message)
    full_scale = capture.cameras[camera].full_scale
    clipped = np.any([image >= full_scale for image in whites], axis=0)
    black = _mean(blacks) if blacks else None
    return PoseFrames(_mean(whites), np.asarray(clipped), black, tuple(_views(capture.patterns, shots, black)))


def cut_capture(capture: Capture, camera: str, window: Window) -> Capture:
    """The frames of one camera, cut to a window of its image."""
    form = capture.cameras[camera]
    shots = tuple(replace(shot, image=shot.image[window]) for shot in capture.shots if shot.camera == camera)
    rows, columns = window
    size = Size(columns.stop - columns.start, rows.stop - rows.start)
    return Capture(capture.projector, capture.patterns, {camera: replace(form, size=size)}, shots)


def _views(patterns: tuple[Pattern, ...], shots: list[Shot], black: Image | None) -> list[Image]:
    """At most six evenly chosen frames in which all is lit, the first and the last among them."""
    dark = np.zeros((1, 1), dtype=np.float32) if black is None else black
    waiting: dict[Pattern, Shot] = {}
    lit: list[tuple[Shot, Shot | None]] = []
    for shot in shots:
        pattern = patterns[shot.pattern]
        if isinstance(pattern, White):
            lit.append((shot, None))
        elif isinstance(pattern, Gray) and black is not None:
            inverse = waiting.pop(replace(pattern, inverted=not pattern.inverted), None)
            if inverse is None:
                waiting[pattern] = shot
            else:
                lit.append((shot, inverse))
    chosen = np.unique(np.linspace(0, len(lit) - 1, min(_MOST_VIEWS, len(lit))).round().astype(int))
    return [
        shot.image.astype(np.float32) if other is None else shot.image + other.image.astype(np.float32) - dark
        for shot, other in (lit[index] for index in chosen)
    ]


def _mean(images: list[Pixels]) -> Image:
    return np.asarray(np.mean(images, axis=0, dtype=np.float32), dtype=np.float32)
