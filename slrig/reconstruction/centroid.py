"""Where the light of a pixel comes from: not its centre, where the surface is brighter on one side.

A pixel's light is a mean over its blur, weighted by how brightly each place shines. With a Gaussian blur of variance
σ² and brightness L as the camera sees it (white - black), the centroid of that light lies σ² ∇ ln L beside the pixel's
centre: exactly, since x g(x) = -σ² g'(x). Whatever is measured there (a phase, a stripe's height) is that of the
centroid. On a checkered or half-shadowed surface this moves a stripe's centre by a tenth of a pixel, the bias of an
asymmetric bar, and normalising by white and black does not take it away.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.reconstruction.phase import PositionMap

_FLAT_PX = 1.0  # projector px of second difference over six pixels: more is two surfaces with a step between
_SIXTH_GAIN = 2 * (45**2 + 9**2 + 1) / 60**2  # variance of the sixth-order difference of unit noise


def at_pixel_centres(
    seen: PositionMap, contrast: NDArray[np.float32], deviation: NDArray[np.float32], blur_px: float, /
) -> PositionMap:
    """The position map moved from the centroids of the pixels' light to their centres, to first order.

    contrast, deviation : (H, W) float32, white minus black and the standard deviation of its noise; blur_px : standard
    deviation of the camera's own blur, its pixel's area included, px. The gradient of ln L is a difference of sixth
    order, that of the position one over six pixels, which the displacement at an edge of the albedo hardly bends;
    beside a border or a step both are plain central differences. Gradients g of ln L that noise may have made count
    little, g³/(g² + 4 σ²). A pixel that lacks a neighbour along an axis stays as it is along that axis.
    """
    brightness = np.full_like(contrast, np.nan)
    in_bands(_log_kernel, len(contrast), contrast, brightness)
    moved = seen.position.copy()
    in_bands(_moved_kernel, len(moved), seen.position, brightness, contrast, deviation, blur_px**2, moved)
    return PositionMap(moved, seen.sigma)


@kernel
def _log_kernel(first: int, last: int, contrast: Any, out: Any) -> None:
    """Fill in the logarithm where there is light."""
    for y in range(first, last):
        for x in range(contrast.shape[1]):
            if contrast[y, x] > 0:
                out[y, x] = np.log(contrast[y, x])


@kernel
def _moved_kernel(
    first: int, last: int, position: Any, brightness: Any, contrast: Any, deviation: Any, variance: float, out: Any
) -> None:
    rows, columns = position.shape
    for y in range(max(first, 1), min(last, rows - 1)):
        for x in range(1, columns - 1):
            here = position[y, x]
            if np.isnan(here):
                continue
            shift = 0.0
            noise = deviation[y, x] / max(contrast[y, x], np.float32(1e-6))
            for dy, dx in ((0, 1), (1, 0)):
                slope = 0.5 * (position[y + dy, x + dx] - position[y - dy, x - dx])
                rise = 0.5 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                doubt = 4 * 0.5 * noise * noise
                if 3 * dy <= y < rows - 3 * dy and 3 * dx <= x < columns - 3 * dx:
                    before, after = position[y - 3 * dy, x - 3 * dx], position[y + 3 * dy, x + 3 * dx]
                    # Of one surface, and not of two with a step between them.
                    if abs(before - 2 * here + after) < _FLAT_PX:
                        slope = (after - before) / 6
                        sixth = (
                            45 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                            - 9 * (brightness[y + 2 * dy, x + 2 * dx] - brightness[y - 2 * dy, x - 2 * dx])
                            + brightness[y + 3 * dy, x + 3 * dx] - brightness[y - 3 * dy, x - 3 * dx]
                        ) / 60  # fmt: skip
                        if np.isfinite(sixth):
                            rise = sixth
                            doubt = 4 * _SIXTH_GAIN * noise * noise
                if np.isfinite(slope) and np.isfinite(rise) and rise != 0:
                    shift += slope * rise * (rise * rise / (rise * rise + doubt))
            out[y, x] = here - variance * shift
