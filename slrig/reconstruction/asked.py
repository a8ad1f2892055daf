"""The pixels that a scan is asked for, as far as a camera's own frames tell: the others cost no time."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, Refusal
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames

_REACH_PX = 8
"""What is found at a pixel depends on pixels so far away: fits reach 2 px, and filters 9 px, with next to no weight."""


@dataclass(frozen=True, slots=True)
class AskedPixels:
    """What is asked of a camera.

    pixels : (H, W) bool, or None for all; lowest_px, highest_px : (H, W) float32, between which the light's position
    lies where the pixel's ray is in the region, or None for anywhere; least_contrast : of white less black, as a share
    of full scale.
    """

    pixels: NDArray[np.bool_] | None = None
    lowest_px: NDArray[np.float32] | None = None
    highest_px: NDArray[np.float32] | None = None
    least_contrast: float = 0.0

    def told(self, frames: AxisFrames, code: CodeMap, cell_position: FloatArray) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels that are asked for. One that shows no code may be.

        cell_position : (cells,) float64, the middle of each cell of the code, px.
        """
        asked = np.ones(code.refusal.shape, dtype=np.bool_) if self.pixels is None else self.pixels.copy()
        if self.least_contrast:
            # What has no light at all is told as that.
            strong = frames.contrast >= np.float32(self.least_contrast * frames.full_scale)
            asked &= strong | (code.refusal == Refusal.NOT_LIT)
        if self.lowest_px is not None and self.highest_px is not None:
            half = np.float32(frames.gray.cell_px / 2)
            position = cell_position.astype(np.float32)
            within = (position[code.lowest] - half <= self.highest_px) & (
                position[code.highest] + half >= self.lowest_px
            )
            asked &= within | (code.lowest < 0)
        return asked


def without_others(code: CodeMap, asked: NDArray[np.bool_]) -> CodeMap:
    """The code without the lit pixels that are not asked for, save those on which points that are asked for depend."""
    box = np.ones((2 * _REACH_PX + 1, 2 * _REACH_PX + 1), dtype=np.uint8)
    others = (cv2.dilate(asked.view(np.uint8), box) == 0) & (code.refusal != Refusal.NOT_LIT)
    refusal = np.where(others, np.uint8(Refusal.OUTSIDE_REGION), code.refusal)
    return CodeMap(np.where(others, -1, code.lowest), np.where(others, -1, code.highest), refusal)
