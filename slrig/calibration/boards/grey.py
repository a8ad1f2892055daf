"""An image as detectors take it, and what it says about light and focus where nothing was found in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray

_DARK, _FAINT, _CLIPPED = 0.06, 0.04, 0.15
_BLURRED_PX = 4.0


@dataclass(frozen=True, slots=True)
class Grey:
    """An image twice. level : (H, W) float64, 1 is full scale; eight : (H, W) uint8, its middle 99.8 % stretched."""

    level: FloatArray
    eight: NDArray[np.uint8]

    @classmethod
    def of(cls, image: NDArray[Any], full_scale: float) -> Grey:
        """The image and its stretched copy."""
        if image.ndim != 2 or min(image.shape) < 16 or not full_scale > 0:
            message = f"expected a grey image of 16 x 16 pixels or more, found {image.shape}, full scale {full_scale:g}"
            raise ValueError(message)
        level = image.astype(np.float64) / full_scale
        if not np.isfinite(level).all():
            message = "expected an image of finite grey levels, found NaN or infinity"
            raise ValueError(message)
        low, high = np.percentile(level[::2, ::2], [0.1, 99.9])
        stretched = (level - low) * (255 / max(high - low, 1e-6))
        return cls(level, np.clip(np.round(stretched), 0, 255).astype(np.uint8))

    def reduced(self, longest_px: int) -> tuple[NDArray[np.uint8], float]:
        """The 8-bit image with its longer side at most this long, and the factor it was scaled by."""
        factor = min(1.0, longest_px / max(self.eight.shape))
        if factor == 1.0:
            return self.eight, 1.0
        small = cv2.resize(self.eight, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
        return np.asarray(small, dtype=np.uint8), factor

    def likely_cause(self) -> str:
        """Why no board is found in this image, most likely, and what to do about it."""
        low, high = np.percentile(self.level, [1, 99])
        if high < _DARK:
            return (
                f"the image is too dark, its brightest hundredth begins at {100 * high:.1f} % of full scale: "
                "lengthen the exposure or bring light on the board"
            )
        clipped = float(np.mean(self.level >= 0.995))
        if clipped > _CLIPPED:
            return f"{100 * clipped:.0f} % of the image is clipped to white: shorten the exposure"
        if high - low < _FAINT:
            return (
                f"the image has next to no contrast, {100 * (high - low):.1f} % of full scale from its darkest to its "
                "brightest hundredth: take the lens cap off, or turn the board's printed side to the camera"
            )
        if self.blurred():
            return (
                f"the image is out of focus, or moved while it was taken: its sharpest edges are blurred over "
                f"{self._blur_px():.0f} pixels (standard deviation): focus the lens on the board and hold it still"
            )
        return (
            "light and focus look well, so the board is most likely not in view, covered in part, or too far away: "
            "bring all of it into the image, its squares at least 12 pixels wide, tilted by less than 60 degrees"
        )

    def blurred(self) -> bool:
        """Whether even its sharpest edges are blurred over several pixels."""
        return self._blur_px() > _BLURRED_PX

    def _blur_px(self) -> float:
        """Standard deviation of the blur of the image's steepest edges, from their slope over their height."""
        smooth = cv2.GaussianBlur(self.level, (0, 0), 1.0)
        slope = np.hypot(cv2.Sobel(smooth, cv2.CV_64F, 1, 0) / 8, cv2.Sobel(smooth, cv2.CV_64F, 0, 1) / 8)
        low, high = np.percentile(self.level, [1, 99])
        steepest = float(np.percentile(slope, 99.9))
        return float((high - low) / max(steepest * np.sqrt(2 * np.pi), 1e-9))
