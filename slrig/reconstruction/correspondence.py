"""Dense sub-pixel correspondences: the projector position at each camera pixel of a smooth surface.

Two sources, by what was shown. With every shift of a line pattern, the phase of their light tells the position at each
pixel. With a Gray code alone, it is known exactly where the camera sees a code edge; the middles of code cells, good to
no better than 1/√12 of a cell, are not used.

Either holds at the centroid of a pixel's light, which lies σ² ∇ ln L beside the pixel's centre where the surface shines
unevenly (`slrig.reconstruction.phase`). On an even slope of ln L that is exact, and taken away here; beside an edge
of the print it is not, and pixels there are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, FloatArray, Refusal
from slrig.reconstruction.camera_response import compression_loss, gain, in_light
from slrig.reconstruction.coded import CodeTables
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.frames import AxisFrames, FrameStacks, Images, band_rows, rows_of
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.phase import at_pixel_centres, has_phase, position_map


@dataclass(frozen=True, slots=True)
class EdgeCrossings:
    """Where the rows of an image (its columns, if `down`) cross code edges.

    row, column : (n,) int32, the last pixel before the crossing; fraction : (n,) float64, 0 to 1, how far beyond that
    pixel the crossing lies, along the row (or down the column), px; sigma_px : (n,) float64, standard deviation of that
    from noise; position_px : (n,) float64, the projector position of the edge.
    """

    row: NDArray[np.int32]
    column: NDArray[np.int32]
    fraction: FloatArray
    sigma_px: FloatArray
    position_px: FloatArray
    down: bool

    @property
    def pixels_px(self) -> FloatArray:
        """(n, 2) float64: (x, y) of each crossing in the camera."""
        x, y = self.column.astype(np.float64), self.row.astype(np.float64)
        return np.column_stack([x, y + self.fraction] if self.down else [x + self.fraction, y])


def edge_crossings(
    frames: AxisFrames,
    noise: NoiseModel,
    code: CodeMap,
    edge_position: FloatArray,
    asked: NDArray[np.bool_],
    /,
    *,
    down: bool,
    least_sigma: float,
) -> EdgeCrossings:
    """Every crossing of a code edge between two decoded pixels that are asked for.

    edge_position : (bits, cells) float64, px, the edge that a crossing of each bit is when its pixel shows a cell, NaN
    where there is none; asked : (H, W) bool; down : look along columns instead of rows; least_sigma : what a bit's
    swing across the edge has to be over its noise.

    The crossing is the root of the cubic through the two pixels on either side; pixels are taken only where the sign
    does not change again, so that an edge lost in noise gives nothing rather than several. Its variance is
    Σ w² v / s² + (x - x₁)²: w the cubic's weights there, v the variances of the four differences, s the cubic's slope,
    and x - x₁ how far the cubic's root lies from the straight line's. That is about what the cubic itself is off by on
    an edge with a Gaussian blur of 0.65 px (0.5 of the error) to 1.3 px (2.4 of it), up to 0.03 px; the sign of it goes
    round with the crossing's place between the pixels.
    """
    paired = frames.inverses is not None
    against = frames.inverses if frames.inverses is not None else [(frames.white + frames.black) / 2]
    read, slope = noise.read_variance, noise.slope
    images: list[Images] = [frames.bits, against, (code.lowest,), (code.highest,), (asked & (code.refusal == 0),)]
    if down:
        images = [[image.T for image in each] for each in images]
    shape = images[0][0].shape
    fraction, sigma = (np.full(shape, np.nan, dtype=np.float32) for _ in range(2))
    position = np.full(shape, np.nan)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        # Columns of a transposed copy lie behind one another in memory; strided ones would be far slower to walk.
        shown, other = (rows_of(each, rows) for each in images[:2])
        low, high, wanted = (np.ascontiguousarray(each[0][rows]) for each in images[2:])
        _crossing_kernel(
            0, last - first, shown, other, low, high, wanted, paired, np.float32(read), np.float32(slope),
            np.asarray(edge_position, np.float64), least_sigma, fraction[rows], sigma[rows], position[rows],
        )  # fmt: skip

    in_bands(band, shape[0], rows_at_most=band_rows(frames.bits, 2 * shape[1]))
    along, across = np.nonzero(np.isfinite(position))
    row, column = (across, along) if down else (along, across)
    return EdgeCrossings(
        row=row.astype(np.int32),
        column=column.astype(np.int32),
        fraction=fraction[along, across].astype(np.float64),
        sigma_px=sigma[along, across].astype(np.float64),
        position_px=position[along, across],
        down=down,
    )


@kernel(in_every_scan=False)
def _crossing_kernel(
    first: int, last: int, bits: Any, against: Any, lowest: Any, highest: Any, asked: Any, paired: bool, read: Any,
    slope: Any,
    edge_position: Any, least_sigma: float, fraction: Any, sigma: Any, position: Any,
) -> None:  # fmt: skip
    """Fill in fraction, deviation and edge position at the pixel before each crossing, (H, W) each, NaN so far."""
    count, _, columns = bits.shape
    for y in range(first, last):
        swing = np.zeros(columns)
        for b in range(count):
            shown, other = bits[b, y], against[b if paired else 0, y]
            for x in range(columns):
                swing[x] = shown[x] - other[x]
            for x in range(1, columns - 2):
                if (swing[x] > 0) == (swing[x + 1] > 0) or not (asked[y, x] and asked[y, x + 1]):
                    continue
                if (swing[x - 1] > 0) != (swing[x] > 0) or (swing[x + 2] > 0) != (swing[x + 1] > 0):
                    continue
                where = edge_position[b, lowest[y, x]]
                if (
                    np.isnan(where)
                    or where != edge_position[b, highest[y, x]]
                    or where != edge_position[b, lowest[y, x + 1]]
                    or where != edge_position[b, highest[y, x + 1]]
                ):
                    continue
                at = _root(swing[x - 1], swing[x], swing[x + 1], swing[x + 2])
                steep = _slope(swing[x - 1], swing[x], swing[x + 1], swing[x + 2], at)
                spread = 0.0
                noisiest = 0.0
                for k in range(4):
                    # Without inverses the other side is a mean of white and black, of half a frame's variance.
                    added = read + slope * max(shown[x - 1 + k], np.float32(0))
                    subtracted = read + slope * max(other[x - 1 + k], np.float32(0))
                    variance = added + subtracted * (1.0 if paired else 0.5)
                    weight = _weight(k, at)
                    spread += weight * weight * variance
                    noisiest = max(noisiest, variance)
                if abs(swing[x + 2] - swing[x - 1]) < least_sigma * np.sqrt(2 * noisiest) or steep == 0:
                    continue
                if not np.isnan(position[y, x]):
                    # Two bits cross in one gap: cells are finer than pixels here, and neither edge stands alone.
                    position[y, x] = np.inf
                    continue
                fraction[y, x] = at
                straight = swing[x] / (swing[x] - swing[x + 1])
                sigma[y, x] = np.sqrt(spread / (steep * steep) + (at - straight) ** 2)
                position[y, x] = where


@kernel_part
def _weight(k: int, at: float) -> float:
    """Lagrange's weight of sample k of those at -1, 0, 1, 2, for the value at `at`."""
    if k == 0:
        return -at * (at - 1) * (at - 2) / 6
    if k == 1:
        return (at + 1) * (at - 1) * (at - 2) / 2
    if k == 2:
        return -(at + 1) * at * (at - 2) / 2
    return (at + 1) * at * (at - 1) / 6


@kernel_part
def _value(a: float, b: float, c: float, d: float, at: float) -> Any:
    return a * _weight(0, at) + b * _weight(1, at) + c * _weight(2, at) + d * _weight(3, at)


@kernel_part
def _slope(a: float, b: float, c: float, d: float, at: float) -> float:
    """Slope at `at` of the cubic through a, b, c, d at -1, 0, 1, 2."""
    return (
        -a * (3 * at * at - 6 * at + 2) / 6
        + b * (3 * at * at - 4 * at - 1) / 2
        - c * (3 * at * at - 2 * at - 2) / 2
        + d * (3 * at * at - 1) / 6
    )


@kernel_part
def _root(a: float, b: float, c: float, d: float) -> float:
    """Where the cubic through a, b, c, d at -1, 0, 1, 2 passes zero between b and c, which differ in sign."""
    low, high = 0.0, 1.0
    rising = c > b
    at = b / (b - c)
    for _ in range(20):
        value = _value(a, b, c, d, at)
        if (value > 0) == rising:
            high = at
        else:
            low = at
        steep = _slope(a, b, c, d, at)
        step = at - value / steep if steep != 0 else low
        # Newton's step, or a bisection where it leaves the bracket.
        after = step if low < step < high else 0.5 * (low + high)
        if abs(after - at) < 1e-6:
            return after
        at = after
    return at


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
    left out: see `slrig.patterns.codes`.
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
