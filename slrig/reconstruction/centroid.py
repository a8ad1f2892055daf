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
from numba import njit, prange
from numpy.typing import NDArray

from slrig.reconstruction.phase import PositionMap


def at_pixel_centres(seen: PositionMap, contrast: NDArray[np.float32], blur_px: float, /) -> PositionMap:
    """The position map moved from the centroids of the pixels' light to their centres, to first order.

    contrast : (H, W) float32, white minus black; blur_px : standard deviation of the camera's own blur, its pixel's
    area included, px. The gradients are central differences; a pixel that lacks a neighbour along an axis stays as it
    is along that axis.
    """
    return PositionMap(_moved_kernel(seen.position, contrast, blur_px**2), seen.sigma)


@njit(cache=True, nogil=True, parallel=True)
def _moved_kernel(position: Any, contrast: Any, variance: float) -> Any:
    rows, columns = position.shape
    out = position.copy()
    for y in prange(1, rows - 1):
        for x in range(1, columns - 1):
            shift = 0.0
            for dy, dx in ((0, 1), (1, 0)):
                slope = 0.5 * (position[y + dy, x + dx] - position[y - dy, x - dx])
                before, after = contrast[y - dy, x - dx], contrast[y + dy, x + dx]
                if before > 0 and after > 0 and np.isfinite(slope):
                    shift += slope * 0.5 * np.log(after / before)
            out[y, x] -= variance * shift
    return out
