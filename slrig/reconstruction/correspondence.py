"""Dense sub-pixel correspondences: which projector position each camera pixel of a smooth surface gets its light from.

Two sources, by what was shown. With every shift of a line pattern, the phase of their light tells the position at each
pixel. With a Gray code alone, it is known exactly where the camera sees a code edge; the middles of code cells, good to
no better than 1/√12 of a cell, are not used.

Either holds at the centroid of a pixel's light, which lies σ² ∇ ln L beside the pixel's centre where the surface shines
unevenly (`slrig.reconstruction.centroid`). On an even slope of ln L that is exact, and taken away here; beside an edge
of the print it is not, and pixels there are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.model import Axis, FloatArray, Refusal
from slrig.reconstruction.centroid import at_pixel_centres
from slrig.reconstruction.code_edges import EdgeCrossings, edge_crossings
from slrig.reconstruction.compression import compression_loss
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.frames import AxisFrames, FrameStacks
from slrig.reconstruction.limits import CodeTables
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.phase import has_phase, position_map
from slrig.reconstruction.response import gain, in_light

Mask = NDArray[np.bool_]

_WINDOW_PX = 15
_FEWEST_IN_WINDOW = 20
_SMOOTHED_PX = 1.0
_GRADIENT_GAIN = (8 * np.pi * _SMOOTHED_PX**4) ** -0.5  # deviation of a Gaussian's derivative of unit noise


@dataclass(frozen=True, slots=True)
class CorrespondenceLimits:
    """What a correspondence has to be worth.

    largest_sigma_px : standard deviation of the projector position that is still worth keeping.
    edge_sigma : what a bit's swing across a code edge has to be over its noise.
    print_share : a slope of ln L per px above which a place lies beside an edge of the print, print_sigma : unless that
    many standard deviations of the slope's noise are more; print_reach : how far from there on pixels are left out, in
    standard deviations of the camera's blur.
    """

    largest_sigma_px: float = 0.25
    edge_sigma: float = 8.0
    print_share: float = 0.06
    print_sigma: float = 5.0
    print_reach: float = 2.0
    decoding: DecodingLimits = field(default_factory=DecodingLimits)


@dataclass(frozen=True, slots=True)
class ProjectorPositions:
    """Correspondences of one camera along one axis.

    pixels_px : (n, 2) float64, (x, y) in the camera; position_px : (n,) float64, the projector column or row there;
    sigma_px : (n,) float64, its standard deviation from noise, projector px. lit, decoded : (H, W) bool, of every pixel
    whether the projector's light reaches it, and whether its code was read. by_phase : line frames told the positions,
    and code edges did otherwise.
    """

    axis: Axis
    pixels_px: FloatArray
    position_px: FloatArray
    sigma_px: FloatArray
    lit: Mask
    decoded: Mask
    by_phase: bool


def projector_positions(
    frames: AxisFrames,
    tables: CodeTables,
    asked: Mask,
    limits: CorrespondenceLimits,
    /,
    *,
    camera_blur_px: float,
    noise: NoiseModel | None = None,
) -> ProjectorPositions:
    """Find the correspondences of the pixels asked for, which are of one smooth surface.

    asked : (H, W) bool; camera_blur_px : standard deviation of the camera's own blur, its pixel's area included;
    noise : where it is known already. Positions outside those that `tables` knows, near the projector's border, are
    left out: see `slrig.patterns.positions`.
    """
    gamma = 1.0
    if noise is None:
        frames, noise, gamma = in_light(FrameStacks.of(frames), limits.decoding)
    code = decode(frames, noise, tables.index_of_word, len(tables.cell_position), limits.decoding)
    lit = np.asarray(code.refusal != Refusal.NOT_LIT)
    # Each pixel stands alone here, so that what compression took from all waves counts alike.
    told_by = frames.lines if has_phase(frames) else frames.bits
    loss = compression_loss(told_by, frames.bits, lit, frames.full_scale) if noise.loss is None else noise.loss
    noise = noise.with_more(float(np.mean(loss)) * gain(told_by, gamma, frames.full_scale))
    decoded = np.asarray(code.refusal == Refusal.NONE)
    contrast = frames.contrast
    ends = noise.variance(frames.white) + noise.variance(frames.black)
    deviation = np.sqrt(ends / np.float32(frames.ends_repeats))
    clear = asked & ~near_print(contrast, deviation, camera_blur_px, limits)
    if has_phase(frames):
        seen = position_map(frames, noise, code, tables.cell_position)
        seen = at_pixel_centres(seen, contrast, deviation, camera_blur_px)
        row, column = np.nonzero(clear & np.isfinite(seen.position) & (seen.sigma < limits.largest_sigma_px))
        pixels = np.column_stack([column, row]).astype(np.float64)
        position, sigma = seen.position[row, column].astype(np.float64), seen.sigma[row, column].astype(np.float64)
    else:
        pixels, position, sigma = _at_code_edges(
            frames, noise, code, tables, clear, contrast, camera_blur_px, limits
        )  # fmt: skip
    kept = (position >= np.nanmin(tables.position_of)) & (position <= np.nanmax(tables.position_of))
    return ProjectorPositions(
        frames.axis, pixels[kept], position[kept], sigma[kept], lit, decoded, by_phase=has_phase(frames)
    )


def near_print(
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    camera_blur_px: float,
    limits: CorrespondenceLimits,
    /,
) -> Mask:
    """(H, W) bool: pixels so near an edge of the print that their light's centroid is not told by its slope there.

    contrast, deviation : (H, W) float32, white minus black and its noise. Beside a black square the light of the white
    one next to it reaches further than it does the other way round, and so does the slope of ln L.
    """
    smooth = cv2.GaussianBlur(contrast, (0, 0), _SMOOTHED_PX)
    right, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    slope = cv2.magnitude(right, down)
    steep = slope > np.maximum(limits.print_share * smooth, limits.print_sigma * _GRADIENT_GAIN * deviation)
    # What Gaussian and difference have spread of an edge is no part of the reach.
    reach_px = max(limits.print_reach * camera_blur_px - _SMOOTHED_PX, 0.0)
    if not steep.any() or reach_px == 0:
        return np.asarray(steep)
    distance = cv2.distanceTransform((~steep).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(distance <= reach_px)


def _at_code_edges(
    frames: AxisFrames,
    noise: NoiseModel,
    code: CodeMap,
    tables: CodeTables,
    clear: Mask,
    contrast: NDArray[np.float32],
    camera_blur_px: float,
    limits: CorrespondenceLimits,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (n, 2), positions (n,) and deviations (n,) of the code edges that cross the pixels."""
    slopes = _slopes(code, tables.cell_position, clear)
    size = np.nanmedian(np.abs(slopes.reshape(2, -1)), axis=1) if np.isfinite(slopes).any() else np.zeros(2)
    found = edge_crossings(
        frames, noise, code, tables.position_of, clear, down=bool(size[1] > size[0]), least_sigma=limits.edge_sigma
    )
    slope = np.abs(slopes[int(found.down), found.row, found.column])
    sigma = found.sigma_px * slope
    kept = sigma < limits.largest_sigma_px
    pixels = found.pixels_px + camera_blur_px**2 * _rise(contrast, found)
    return pixels[kept], found.position_px[kept], sigma[kept]


def _slopes(code: CodeMap, cell_position: FloatArray, clear: Mask) -> FloatArray:
    """(2, H, W) float64: by how much the projector position rises per camera pixel to the right, and per pixel down.

    A plane is fitted to the decoded pixels of a window, whose two axes are taken as independent: what a window at a
    border tells wrong for that is a small part of a slope that only scales a deviation. NaN where pixels are few.
    """
    known = clear & (code.refusal == Refusal.NONE)
    weight = known.astype(np.float64)
    low, high = cell_position[code.lowest[known]], cell_position[code.highest[known]]
    middle = np.zeros(known.shape)
    middle[known] = 0.5 * (low + high)
    row, column = np.indices(known.shape, sparse=True)

    def mean(values: FloatArray) -> FloatArray:
        return np.asarray(cv2.boxFilter(values, cv2.CV_64F, (_WINDOW_PX, _WINDOW_PX), borderType=cv2.BORDER_CONSTANT))

    share = mean(weight)
    enough = share * _WINDOW_PX**2 >= _FEWEST_IN_WINDOW
    share = np.where(enough, share, np.nan)
    mean_position = mean(middle) / share
    slopes = []
    for place in (column, row):
        along = place * weight
        mean_place = mean(along) / share
        both = mean(place * middle) / share - mean_place * mean_position
        spread = mean(place * along) / share - mean_place**2
        slopes.append(both / np.where(spread > 0.5, spread, np.nan))
    return np.stack(slopes)


def _rise(contrast: NDArray[np.float32], found: EdgeCrossings) -> FloatArray:
    """(n, 2) float64: slope of ln L to the right and down, per px, at each crossing."""
    level = np.maximum(contrast[found.row, found.column], np.float32(1e-6))
    both = (cv2.Sobel(contrast, cv2.CV_32F, *step, scale=1 / 8)[found.row, found.column] for step in ((1, 0), (0, 1)))
    return np.column_stack([each / level for each in both]).astype(np.float64)
