"""What the code alone says, without any calibration: positions in the projector, coverage, causes, what to change.

For each camera and each axis that was played: `position-CAMERA-AXIS.tiff`, (H, W) float32, the projector column or row
that each pixel sees, NaN where none is known; the same in colour as PNG; and a picture of why pixels were refused.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from slrig.bundle import read_capture, write_file
from slrig.disk import storage_errors
from slrig.errors import PatternError, setting
from slrig.model import Axis, Capture, Gray, NoiseModel, Refusal, Sine, trim_incomplete_codes
from slrig.patterns import cell_positions, index_of_word, require_numbered
from slrig.reconstruction import (
    AxisFrames,
    DecodingLimits,
    axis_frames,
    decode_edges,
    decode_sinusoids,
    estimate_noise,
    exposure_count,
    fuse_exposures,
    lit_pixels,
    position_map,
)
from slrig.scan.artefacts import REPORT, REPORT_FORMAT, staged_folder, write_report
from slrig.scan.pictures import encode_png, rejection_picture

_FEW, _MANY = 0.05, 0.25


@dataclass(frozen=True, slots=True)
class Decoded:
    """One camera and axis. Shares: lit, of the image; decoded, saturated, ambiguous and unresolved (the finest bit), of
    what is lit. contrast : median of white less black over full scale, of what is lit.
    """

    camera: str
    axis: Axis
    lit: float
    decoded: float
    saturated: float
    ambiguous: float
    unresolved: float
    contrast: float

    def __str__(self) -> str:
        lit = f"camera '{self.camera}', {self.axis.value}s: {self.lit:.0%} of the image is lit"
        return f"{lit}, {self.decoded:.0%} of that decoded"

    @property
    def advice(self) -> list[str]:
        """What to change, one sentence each."""
        told = []
        if self.lit < _FEW:
            told.append("hardly anything is lit: do camera and projector look at the same place? Lengthen the exposure")
        elif self.contrast < _FEW:
            told.append("the light is weak: lengthen the exposure, open the lens, or darken the room")
        if self.saturated > _FEW:
            told.append(
                f"{self.saturated:.0%} is saturated: shorten the exposure, or scan with "
                f"several: {setting('exposures_s')}"
            )
        if self.unresolved > _FEW:
            told.append(
                f"the finest bit does not resolve on {self.unresolved:.0%}: look at the focus of camera and projector, "
                f"or play wider cells: {setting('gray_cell_px')}"
            )
        if self.ambiguous > _MANY:
            told.append(
                f"bits are ambiguous on {self.ambiguous:.0%}: something moved, light is reflected from part to part, "
                "or the surface is translucent or dark"
            )
        return told


def decode_bundle(bundle: Path, output: Path) -> tuple[list[Decoded], tuple[str, ...]]:
    """Decode a recorded bundle into `output`, which appears whole or not at all. With words for codes cut short.

    Raises
    ------
    BundleError, PatternError
        The frames cannot be read or decoded.
    InvalidInputError, StorageError
        `output` holds something else, or the disk refused.
    """
    capture, cut_short = trim_incomplete_codes(read_capture(bundle))
    axes = [axis for axis in Axis if any(isinstance(p, Gray | Sine) and p.axis is axis for p in capture.patterns)]
    if not axes:
        message = f"{bundle}: no frames of Gray code or sinusoids: nothing can be decoded"
        raise PatternError(message)
    with staged_folder(output) as staging:
        found = [_decoded(capture, camera, axis, staging) for camera in capture.cameras for axis in axes]
        report: Mapping[str, object] = {
            "format": REPORT_FORMAT,
            "version": 1,
            "method": "decoding only",
            "notes": list(cut_short),
            "decoded": [asdict(each) | {"axis": each.axis.value, "advice": each.advice} for each in found],
        }
        write_report(report, staging / REPORT)
    return found, cut_short


def _decoded(capture: Capture, camera: str, axis: Axis, folder: Path) -> Decoded:
    frames, noise = _frames(capture, camera, axis)
    limits = DecodingLimits()
    lit = lit_pixels(frames, noise, limits)
    words = index_of_word(frames.gray)
    if frames.sine_patterns:
        if not len(frames.bits):
            require_numbered(frames.sine_patterns, capture.projector)
        found = decode_sinusoids(frames, noise, words, capture.projector.along(axis), limits)
        code, position, unresolved = found.code, found.measured.position, np.zeros(lit.shape, dtype=np.uint8)
    else:
        cells = cell_positions(frames.gray, capture.projector)
        code, unresolved = decode_edges(frames, noise, words, len(cells), limits)
        position = position_map(frames, noise, code, cells).position
    name = f"{camera}-{axis.value}"
    with storage_errors(folder):
        tifffile.imwrite(folder / f"position-{name}.tiff", position)
    coloured = encode_png(_coloured(position, capture.projector.along(axis)))
    write_file(folder / f"position-{name}.png", coloured)
    white = np.clip(np.rint(frames.white), 0, np.iinfo(np.uint16).max).astype(np.uint16)
    refused = encode_png(rejection_picture(code.refusal, white, int(frames.clipped_at)))
    write_file(folder / f"rejected-{name}.png", refused)
    count = max(int(lit.sum()), 1)
    return Decoded(
        camera=camera,
        axis=axis,
        lit=float(lit.mean()),
        decoded=float((code.refusal == Refusal.NONE).sum() / count),
        saturated=float((lit & (frames.white >= frames.clipped_at)).sum() / count),
        ambiguous=float((code.refusal == Refusal.AMBIGUOUS_BIT).sum() / count),
        unresolved=float((lit & (unresolved > 0)).sum() / count),
        contrast=float(np.median(frames.contrast[lit]) / frames.full_scale) if lit.any() else 0.0,
    )


def _frames(capture: Capture, camera: str, axis: Axis) -> tuple[AxisFrames, NoiseModel]:
    if exposure_count({shot.exposure_s for shot in capture.shots if shot.camera == camera}) > 1:
        fused = fuse_exposures(capture, camera, axis)
        return fused.frames, fused.noise
    frames = axis_frames(capture, camera, axis)
    return frames, estimate_noise(frames)


def _coloured(position: NDArray[np.float32], extent_px: int) -> NDArray[np.uint8]:
    """(H, W, 3) uint8, blue, green, red: from blue at the projector's first position to red at its last."""
    known = np.isfinite(position)
    grey = np.where(known, np.clip(np.nan_to_num(position) / extent_px, 0, 1) * 255, 0).astype(np.uint8)
    picture = cv2.applyColorMap(grey, cv2.COLORMAP_TURBO)
    picture[~known] = 0
    return np.asarray(picture, dtype=np.uint8)
