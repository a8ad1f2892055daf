"""What the images of a capture say of a calibration: each pixel's code, read roughly, against where rays meet."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import Generic, TypeVar

import numpy as np

from slrig.model import (
    Axis,
    Black,
    Calibration,
    CameraFormat,
    FloatArray,
    Gray,
    Pattern,
    Pinhole,
    Pixels,
    Size,
    White,
    from_gray,
)
from slrig.reconstruction import PixelPairs, disagreement_px, share_in_front

_MAX_PIXELS = 100_000
_MIN_PAIRS = 200
_LIT = 0.25  # of the contrast that few pixels exceed
_CERTAIN = 0.2  # difference of a bit over the contrast


Image = TypeVar("Image")


class CodedImages(Generic[Image]):
    """Gray codes of a capture, as `slrig.importers.recognition.CodedCapture`. Images are read when they are needed.

    read : returns the (H, W) pixels of an image in the format of its camera.
    """

    def __init__(
        self,
        cameras: Mapping[str, Sequence[tuple[Image, Pattern]]],
        formats: Mapping[str, CameraFormat],
        projector: Size,
        read: Callable[[Image, CameraFormat], Pixels],
    ) -> None:
        self._cameras, self._formats, self._projector, self._read_image = cameras, formats, projector, read
        self._read: dict[str, tuple[FloatArray, FloatArray]] = {}

    def disagreement_px(self, calibration: Calibration) -> float | None:
        """Median distance from the epipolar line, the worst of all cameras; None without both axes."""
        found = [
            disagreement_px(first, second, pairs)
            for first, second, pairs in self._pairs(calibration)
            if np.isfinite(pairs.projector_px).all()
        ]
        return max(found) if found else None

    def share_in_front(self, calibration: Calibration) -> float | None:
        """Share of the points of one axis in front of both devices, the least of all cameras."""
        found = [
            share_in_front(first, second, pairs)
            for first, second, pairs in self._pairs(calibration)
            if second is calibration.projector
        ]
        return min(found) if found else None

    def _pairs(self, calibration: Calibration) -> list[tuple[Pinhole, Pinhole, PixelPairs]]:
        """Return pixels of each camera and the projector, or of each two cameras, that show the same point."""
        known = {name: self._codes(name) for name in calibration.cameras if name in self._cameras}
        if calibration.projector is not None:
            return [
                (calibration.cameras[name], calibration.projector, _pairs(pixels, coded))
                for name, (pixels, coded) in known.items()
                if len(pixels) >= _MIN_PAIRS
            ]
        found = []
        for a, b in combinations(known, 2):
            pairs = _same_codes(known[a], known[b])
            if len(pairs) >= _MIN_PAIRS:
                found.append((calibration.cameras[a], calibration.cameras[b], pairs))
        return found

    def _codes(self, name: str) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels of a camera, and (n, 2) coded columns and rows, NaN for an axis without a code."""
        if name not in self._read:
            files, form = self._cameras[name], self._formats[name]
            step = int(np.ceil(np.sqrt(form.size.width_px * form.size.height_px / _MAX_PIXELS)))
            images: dict[Pattern, FloatArray] = {}
            for image, pattern in files:
                if isinstance(pattern, White | Black | Gray) and pattern not in images:
                    images[pattern] = self._read_image(image, form)[::step, ::step].astype(np.float64)
            self._read[name] = _decode(images, step, self._projector)
        return self._read[name]


def _decode(images: Mapping[Pattern, FloatArray], step: int, projector: Size) -> tuple[FloatArray, FloatArray]:
    codes = {axis: [p for p in images if isinstance(p, Gray) and p.axis is axis and not p.inverted] for axis in Axis}
    if not images or not any(codes.values()):
        return np.zeros((0, 2)), np.zeros((0, 2))
    stack = list(images.values())
    brightest = images.get(White(), np.maximum.reduce(stack))
    darkest = images.get(Black(), np.minimum.reduce(stack))
    contrast = brightest - darkest
    usable = contrast > max(1.0, _LIT * float(np.percentile(contrast, 98)))
    coded = []
    for axis in Axis:
        word = np.zeros(contrast.shape, dtype=np.int64)
        for gray in codes[axis]:
            inverse = Gray(axis, gray.bit, gray.bits, gray.cell_px, gray.offset_px, inverted=True)
            # Without its inverse, a bit is compared with the middle, and differs half as much.
            level = 2 * images[gray] - brightest - darkest if inverse not in images else images[gray] - images[inverse]
            word |= (level > 0).astype(np.int64) << (gray.bits - 1 - gray.bit)
            usable &= np.abs(level) > _CERTAIN * contrast
        if codes[axis]:
            gray = codes[axis][0]
            position = np.asarray(from_gray(word)) * gray.cell_px - gray.offset_px + (gray.cell_px - 1) / 2
            usable &= (position >= 0) & (position < projector.along(axis))
        coded.append(position if codes[axis] else np.full(contrast.shape, np.nan))
    rows, columns = np.nonzero(usable)
    pixels = np.column_stack([columns, rows]).astype(np.float64) * step
    return pixels, np.column_stack([each[usable] for each in coded])


def _pairs(pixels: FloatArray, coded: FloatArray) -> PixelPairs:
    axis = Axis.ROW if np.isnan(coded[:, 0]).all() else Axis.COLUMN
    return PixelPairs(pixels, coded, np.zeros(len(pixels)), axis)


def _same_codes(first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]) -> PixelPairs:
    """Mean pixels of two cameras that have the same column and row."""
    middles = []
    for pixels, coded in (first, second):
        if not np.isfinite(coded).all():
            return _pairs(np.zeros((0, 2)), np.zeros((0, 2)))
        codes, index, counts = np.unique(coded, axis=0, return_inverse=True, return_counts=True)
        sums = np.column_stack([np.bincount(index.ravel(), weights=pixels[:, i]) for i in (0, 1)])
        middles.append({tuple(code): mean for code, mean in zip(codes.tolist(), sums / counts[:, None], strict=True)})
    common = [code for code in middles[0] if code in middles[1]]
    if not common:
        return _pairs(np.zeros((0, 2)), np.zeros((0, 2)))
    return _pairs(*(np.array([each[code] for code in common]) for each in middles))
