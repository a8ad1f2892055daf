"""Pixels near the border of a shadow or of a depth step, where light of two surfaces mixes and stripes are displaced.

A dense map of projector positions tells: between the border of the lit area and the nearest bend of that map sharper
than a surface makes, a stripe's own neighbourhood is one surface.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.reconstruction.phase import PositionMap

_BESIDE_STEPS_PX = (0.04, 0.015)
"""What the light of the other surface displaces a point by in the first and the second pixel beside a step of depth.
Beside edges of terraces and boxes, rendered by others and by us, errors were 1.7 to 2.3 and 1.3 to 1.9 times what noise
alone states, 95 % of them below 4.8 and 3.7."""


@dataclass(frozen=True, slots=True)
class EdgeLimits:
    """How far from a border a stripe point must be, and what a border is.

    shadow_px, depth_px : radius of refusal round the lit area's border, and round a depth step, for a fit to pixels;
    filter_px : for a filter, whose window must be clear of the border.
    bend_px : a second difference of the projector position, over two camera pixels, that no surface makes,
    bend_share : unless it is below this share of the first difference, as on a surface seen at a grazing angle,
    bend_sigma : and this many standard deviations above that limit, so that the noise of a dark surface is none.
    smallest_shadow_px : unlit specks of fewer pixels than this are noise or dust, not shadow.
    """

    shadow_px: float = 2.0
    depth_px: float = 0.7
    filter_px: float = 2.0
    bend_px: float = 0.9
    bend_share: float = 0.5
    bend_sigma: float = 4.0
    smallest_shadow_px: int = 4

    def for_filters(self, blur_px: float) -> EdgeLimits:
        """The same limits for a filter; light mixes the further, the more than 1 px the stripes' width is."""
        reach_px = self.filter_px * max(1.0, blur_px)
        return replace(self, shadow_px=reach_px, depth_px=reach_px)


def near_edges(
    seen: PositionMap, unlit: NDArray[np.bool_], resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels near the lit area's border, and pixels near a depth step: two (H, W) bool maps.

    unlit : (H, W) bool; resolution_px : step of the position map (0 where phase makes it continuous), (H, W) if it
    varies.
    """
    return near_shadows(unlit, limits), near_steps(seen, resolution_px, limits)


def near_shadows(unlit: NDArray[np.bool_], limits: EdgeLimits, /) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the lit area's border; see `near_edges`."""
    return _within(_without_specks(unlit, limits.smallest_shadow_px), limits.shadow_px)


_SHADOW_BLURS = 3.0
"""Standard deviations of the camera's blur within which light fades out at a border: 2 px of the usual 0.65 px."""


def near_shadows_of(
    blur_px: float, near_shadow: NDArray[np.bool_], unlit: NDArray[np.bool_], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near the lit area's border by a camera of this blur; near_shadow : by a usual one."""
    if _SHADOW_BLURS * blur_px <= limits.shadow_px:
        return near_shadow
    return near_shadows(unlit, replace(limits, shadow_px=_SHADOW_BLURS * blur_px))


def near_steps(
    seen: PositionMap, resolution_px: float | NDArray[np.float32], limits: EdgeLimits, /
) -> NDArray[np.bool_]:
    """(H, W) bool: pixels near a depth step; see `near_edges`."""
    limit_px = np.full(seen.position.shape, limits.bend_px + 2 * resolution_px, dtype=np.float32)
    bends = np.zeros(seen.position.shape, dtype=np.bool_)
    in_bands(
        _bend_kernel, len(bends), seen.position, np.nan_to_num(seen.sigma), limit_px, limits.bend_share,
        limits.bend_sigma, bends,
    )  # fmt: skip
    return _within(bends, limits.depth_px)


def _without_specks(unlit: NDArray[np.bool_], smallest: int) -> NDArray[np.bool_]:
    _, labels, figures, _ = cv2.connectedComponentsWithStats(unlit.astype(np.uint8), connectivity=8)
    large = figures[:, cv2.CC_STAT_AREA] >= smallest
    large[0] = False
    return np.asarray(large[labels])


def beside_steps_px(near_step: NDArray[np.bool_], /) -> NDArray[np.float32]:
    """(H, W): a standard deviation of points, beside steps; see `_BESIDE_STEPS_PX`."""
    sigma_px, inside = np.zeros(near_step.shape, dtype=np.float32), near_step.view(np.uint8)
    for displaced_px in _BESIDE_STEPS_PX:
        wider = cv2.dilate(inside, np.ones((3, 3), np.uint8))
        sigma_px[wider > inside] = displaced_px
        inside = wider
    return sigma_px


def _within(mask: NDArray[np.bool_], radius_px: float) -> NDArray[np.bool_]:
    if not mask.any():
        return mask
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance <= radius_px)


@kernel
def _bend_kernel(
    first: int, last: int, position: Any, sigma: Any, limits: Any, share: float, sigmas: float, out: Any
) -> None:
    rows, columns = position.shape
    for y in range(max(first, 1), min(last, rows - 1)):
        for x in range(1, columns - 1):
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
                limit = limits[y, x]
                before, after = position[y - dy, x - dx], position[y + dy, x + dx]
                bend = abs(before - 2 * position[y, x] + after)
                if bend > limit and bend > share * abs(after - before):
                    s0, s1, s2 = sigma[y - dy, x - dx], sigma[y, x], sigma[y + dy, x + dx]
                    if bend > limit + sigmas * np.sqrt(s0 * s0 + 4 * s1 * s1 + s2 * s2):
                        out[y, x] = True
