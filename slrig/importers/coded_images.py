"""What the images of a capture say of a calibration: each pixel's code, read roughly, against where rays meet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Generic, TypeVar

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

if TYPE_CHECKING:
    from slrig.reconstruction import PixelPairs

_MAX_PIXELS = 100_000
_MIN_PAIRS = 200
_LIT = 0.25  # of the contrast that few pixels exceed
_CERTAIN = 0.2  # difference of a bit over the contrast

Image = TypeVar("Image")


class CodedImages(Generic[Image]):
    """Gray codes of a capture. Images are read when they are needed.

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
        self._codes: dict[str, tuple[FloatArray, FloatArray]] = {}

    def disagreement_px(self, calibration: Calibration) -> float | None:
        """Median distance from the epipolar line, the worst of all cameras; None without both axes."""
        from slrig.reconstruction import disagreement_px

        pairs = [each for each in self._pairs(calibration) if np.isfinite(each[2].projector_px).all()]
        return max((disagreement_px(*each) for each in pairs), default=None)

    def share_in_front(self, calibration: Calibration) -> float | None:
        """Share of the points that lie in front of both devices, the least of all cameras."""
        from slrig.reconstruction import share_in_front

        pairs = [each for each in self._pairs(calibration) if each[1] is calibration.projector]
        return min((share_in_front(*each) for each in pairs), default=None)

    def _pairs(self, calibration: Calibration) -> Iterator[tuple[Pinhole, Pinhole, PixelPairs]]:
        """Yield pixels of each camera and the projector, or of each two cameras, that show the same point."""
        from slrig.reconstruction import PixelPairs

        codes = {name: self._decoded(name) for name in calibration.cameras if name in self._cameras}
        views = [(calibration.cameras[name], calibration.projector, codes[name]) for name in codes]
        if calibration.projector is None:
            views = [
                (calibration.cameras[a], calibration.cameras[b], _same_codes(codes[a], codes[b]))
                for a, b in combinations(codes, 2)
            ]
        for first, second, (pixels, coded) in views:
            if second is not None and len(pixels) >= _MIN_PAIRS:
                axis = Axis.ROW if np.isnan(coded[:, 0]).all() else Axis.COLUMN
                yield first, second, PixelPairs(pixels, coded, np.zeros(len(pixels)), axis)

    def _decoded(self, name: str) -> tuple[FloatArray, FloatArray]:
        """(n, 2) pixels of a camera, and (n, 2) coded columns and rows, NaN for an axis without a code."""
        if name not in self._codes:
            form = self._formats[name]
            step = int(np.ceil(np.sqrt(form.size.width_px * form.size.height_px / _MAX_PIXELS)))
            images: dict[Pattern, FloatArray] = {
                pattern: self._read_image(image, form)[::step, ::step].astype(np.float64)
                for image, pattern in self._cameras[name]
                if isinstance(pattern, White | Black | Gray)
            }
            pixels, coded = _decode(images, self._projector)
            self._codes[name] = pixels * step, coded
        return self._codes[name]


def _decode(images: Mapping[Pattern, FloatArray], projector: Size) -> tuple[FloatArray, FloatArray]:
    codes = {axis: [p for p in images if isinstance(p, Gray) and p.axis is axis and not p.inverted] for axis in Axis}
    if not any(codes.values()):
        return np.zeros((0, 2)), np.zeros((0, 2))
    stack = list(images.values())
    brightest = images.get(White(), np.maximum.reduce(stack))
    darkest = images.get(Black(), np.minimum.reduce(stack))
    contrast = brightest - darkest
    usable = contrast > max(1.0, _LIT * float(np.percentile(contrast, 98)))
    coded = []
    for axis, bits in codes.items():
        word, position = np.zeros(contrast.shape, dtype=np.int64), np.full(contrast.shape, np.nan)
        for gray in bits:
            inverse = Gray(axis, gray.bit, gray.bits, gray.cell_px, gray.offset_px, inverted=True)
            # Without its inverse, a bit is compared with the middle, and differs half as much.
            level = 2 * images[gray] - brightest - darkest if inverse not in images else images[gray] - images[inverse]
            word |= (level > 0).astype(np.int64) << (gray.bits - 1 - gray.bit)
            usable &= np.abs(level) > _CERTAIN * contrast
            position = np.asarray(from_gray(word)) * gray.cell_px - gray.offset_px + (gray.cell_px - 1) / 2
        usable &= np.isnan(position) | ((position >= 0) & (position < projector.along(axis)))
        coded.append(position)
    rows, columns = np.nonzero(usable)
    return np.column_stack([columns, rows]).astype(np.float64), np.column_stack([each[usable] for each in coded])


def _same_codes(
    first: tuple[FloatArray, FloatArray], second: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """(n, 2) mean pixels of two cameras that have the same column and row."""
    middles: list[dict[tuple[float, ...], FloatArray]] = []
    for pixels, coded in (first, second):
        known = np.isfinite(coded).all(axis=1)
        codes, index, counts = np.unique(coded[known], axis=0, return_inverse=True, return_counts=True)
        sums = np.column_stack([np.bincount(index.ravel(), pixels[known, i], len(codes)) for i in (0, 1)])
        middles.append(dict(zip(map(tuple, codes.tolist()), sums / counts[:, None], strict=True)))
    common = [code for code in middles[0] if code in middles[1]]
    one, other = (np.array([each[code] for code in common]).reshape(-1, 2) for each in middles)
    return one, other
