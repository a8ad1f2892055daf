"""Dense sub-pixel correspondences: the projector position at each camera pixel of a smooth surface.

With every shift of a line pattern, the phase of their light gives the position at each pixel. With a Gray code alone,
it is exact where the camera sees a code edge; the middles of code cells, with an error of 1/√12 of a cell, are not
used.

Either is valid at the centroid of a pixel's light, which is σ² ∇ ln L away from the pixel's centre where brightness is
uneven (`slrig.reconstruction.phase`). On an even slope of ln L this is exact, and corrected here; near edges of a print
it is not, and pixels there are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import Axis, FloatArray, NoiseModel, Refusal
from slrig.reconstruction.camera_response import compression_loss, linearisation_gain
from slrig.reconstruction.decoded_image import CodeTables, linearise_frames
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.frames import AxisFrames, FrameStacks, Images, rows_per_band, stack_rows
from slrig.reconstruction.phase import has_phase, position_map, resample_to_pixel_centres

Mask = NDArray[np.bool_]

_WINDOW_PX = 15
_MIN_IN_WINDOW = 20
_SMOOTHED_PX = 1.0
_GRADIENT_GAIN = (8 * np.pi * _SMOOTHED_PX**4) ** -0.5  # deviation of the derivative of a Gaussian for unit noise


@dataclass(frozen=True, slots=True)
class EdgeCrossings:
    """Crossings of code edges with the rows of an image (its columns, if `down`).

    row, column : (n,) int32, last pixel before the crossing; fraction : (n,) float64, 0 to 1, distance of the crossing
    from that pixel along the row (or column), px; sigma_px : (n,) float64, its standard deviation from noise;
    position_px : (n,) float64, projector position of the edge.
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
    region: NDArray[np.bool_],
    /,
    *,
    down: bool,
    least_sigma: float,
) -> EdgeCrossings:
    """Every crossing of a code edge between two decoded pixels of the region.

    edge_position : (bits, cells) float64, px, edge of a crossing of each bit at a pixel of each cell, NaN for none;
    region : (H, W) bool; down : search along columns instead of rows; least_sigma : least swing of a bit across the
    edge over its noise.

    The crossing is the root of the cubic through the two pixels on either side. Only pixels where the sign does not
    change again are used, so that an edge lost in noise gives no crossing rather than several. Its variance is Σ w² v /
    s² + (x - x₁)²: w the weights of the cubic there, v the variances of the four differences, s the slope of the cubic,
    and x - x₁ the distance of its root from that of the straight line. That is about the error of the cubic itself on
    an edge with a Gaussian blur; its sign alternates with the place of the crossing between the pixels.
    """
    paired = frames.inverses is not None
    reference = frames.inverses if frames.inverses is not None else [(frames.white + frames.black) / 2]
    read, slope = noise.read_variance, noise.slope
    images: list[Images] = [frames.bits, reference, (code.lowest,), (code.highest,), (region & (code.refusal == 0),)]
    if down:
        images = [[image.T for image in each] for each in images]
    shape = images[0][0].shape
    fraction, sigma = (np.full(shape, np.nan, dtype=np.float32) for _ in range(2))
    position = np.full(shape, np.nan)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        # Columns of a transposed copy are contiguous in memory, which is far faster.
        bit_images, inverse_images = (stack_rows(each, rows) for each in images[:2])
        lowest, highest, mask = (np.ascontiguousarray(each[0][rows]) for each in images[2:])
        _crossing_kernel(
            0, last - first, bit_images, inverse_images, lowest, highest, mask, paired, np.float32(read),
            np.float32(slope), np.asarray(edge_position, np.float64), least_sigma, fraction[rows], sigma[rows],
            position[rows],
        )  # fmt: skip

    in_bands(band, shape[0], rows_at_most=rows_per_band(frames.bits, 2 * shape[1]))
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
    first: int, last: int, bits: Any, reference: Any, lowest: Any, highest: Any, region: Any, paired: bool, read: Any,
    slope: Any,
    edge_position: Any, least_sigma: float, fraction: Any, sigma: Any, position: Any,
) -> None:  # fmt: skip
    """Fill in fraction, deviation and edge position at the pixel before each crossing, (H, W) each, NaN so far."""
    count, _, columns = bits.shape
    for y in range(first, last):
        swing = np.zeros(columns)
        for b in range(count):
            value, opposite = bits[b, y], reference[b if paired else 0, y]
            for x in range(columns):
                swing[x] = value[x] - opposite[x]
            for x in range(1, columns - 2):
                if (swing[x] > 0) == (swing[x + 1] > 0) or not (region[y, x] and region[y, x + 1]):
                    continue
                if (swing[x - 1] > 0) != (swing[x] > 0) or (swing[x + 2] > 0) != (swing[x + 1] > 0):
                    continue
                edge = edge_position[b, lowest[y, x]]
                if (
                    np.isnan(edge)
                    or edge != edge_position[b, highest[y, x]]
                    or edge != edge_position[b, lowest[y, x + 1]]
                    or edge != edge_position[b, highest[y, x + 1]]
                ):
                    continue
                root = _cubic_root(swing[x - 1], swing[x], swing[x + 1], swing[x + 2])
                steepness = _cubic_slope(swing[x - 1], swing[x], swing[x + 1], swing[x + 2], root)
                spread = 0.0
                noisiest = 0.0
                for k in range(4):
                    # Without inverses the reference is a mean of white and black, with half the variance of a frame.
                    added = read + slope * max(value[x - 1 + k], np.float32(0))
                    subtracted = read + slope * max(opposite[x - 1 + k], np.float32(0))
                    variance = added + subtracted * (1.0 if paired else 0.5)
                    weight = _lagrange_weight(k, root)
                    spread += weight * weight * variance
                    noisiest = max(noisiest, variance)
                if abs(swing[x + 2] - swing[x - 1]) < least_sigma * np.sqrt(2 * noisiest) or steepness == 0:
                    continue
                if not np.isnan(position[y, x]):
                    # Two bits cross in one gap: cells are finer than pixels, and neither edge counts.
                    position[y, x] = np.inf
                    continue
                fraction[y, x] = root
                straight = swing[x] / (swing[x] - swing[x + 1])
                sigma[y, x] = np.sqrt(spread / (steepness * steepness) + (root - straight) ** 2)
                position[y, x] = edge


@kernel_part
def _lagrange_weight(k: int, at: float) -> float:
    """Lagrange weight of sample k of those at -1, 0, 1, 2, for the value at `at`."""
    if k == 0:
        return -at * (at - 1) * (at - 2) / 6
    if k == 1:
        return (at + 1) * (at - 1) * (at - 2) / 2
    if k == 2:
        return -(at + 1) * at * (at - 2) / 2
    return (at + 1) * at * (at - 1) / 6


@kernel_part
def _cubic_value(a: float, b: float, c: float, d: float, at: float) -> Any:
    return (
        a * _lagrange_weight(0, at)
        + b * _lagrange_weight(1, at)
        + c * _lagrange_weight(2, at)
        + d * _lagrange_weight(3, at)
    )


@kernel_part
def _cubic_slope(a: float, b: float, c: float, d: float, at: float) -> float:
    """Slope at `at` of the cubic through a, b, c, d at -1, 0, 1, 2."""
    return (
        -a * (3 * at * at - 6 * at + 2) / 6
        + b * (3 * at * at - 4 * at - 1) / 2
        - c * (3 * at * at - 2 * at - 2) / 2
        + d * (3 * at * at - 1) / 6
    )


@kernel_part
def _cubic_root(a: float, b: float, c: float, d: float) -> float:
    """Root between b and c, which differ in sign, of the cubic through a, b, c, d at -1, 0, 1, 2."""
    low, high = 0.0, 1.0
    rising = c > b
    at = b / (b - c)
    for _ in range(20):
        value = _cubic_value(a, b, c, d, at)
        if (value > 0) == rising:
            high = at
        else:
            low = at
        steep = _cubic_slope(a, b, c, d, at)
        step = at - value / steep if steep != 0 else low
        # Newton's step, or a bisection if it leaves the bracket.
        after = step if low < step < high else 0.5 * (low + high)
        if abs(after - at) < 1e-6:
            return after
        at = after
    return at


@dataclass(frozen=True, slots=True)
class CorrespondenceLimits:
    """Thresholds for correspondences.

    largest_sigma_px : largest standard deviation of the projector position. edge_sigma : least swing of a bit across a
    code edge over its noise. print_share : slope of ln L per px from which a pixel is near an edge of a print,
    print_sigma : unless this many standard deviations of its noise are more; print_reach : radius of the pixels left
    out there, in standard deviations of the camera's blur.
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
    sigma_px : (n,) float64, its standard deviation from noise, projector px. lit, decoded : (H, W) bool, True for
    pixels that the projector lights, and whose code was read. by_phase : True if line frames gave the positions, False
    for code edges.
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
    region: Mask,
    limits: CorrespondenceLimits,
    /,
    *,
    camera_blur_px: float,
    noise: NoiseModel | None = None,
) -> ProjectorPositions:
    """Find the correspondences of the pixels of a region, which show one smooth surface.

    region : (H, W) bool; camera_blur_px : standard deviation of the camera's own blur, its pixel's area included; noise
    : if it is known. Positions outside those in `tables`, near the projector's border, are left out: see
    `slrig.patterns.codes`.
    """
    gamma = 1.0
    if noise is None:
        frames, response = linearise_frames(FrameStacks.from_frames(frames), limits.decoding)
        noise, gamma = response.noise, response.gamma
    code = decode(frames, noise, tables.index_of_word, len(tables.cell_position), limits.decoding)
    lit = np.asarray(code.refusal != Refusal.NOT_LIT)
    # Each pixel is used alone, so that the loss of all waves counts alike.
    images = frames.lines if has_phase(frames) else frames.bits
    loss = compression_loss(images, frames.bits, lit, frames.full_scale) if noise.loss is None else noise.loss
    noise = noise.add_variance(float(np.mean(loss)) * linearisation_gain(images, gamma, frames.full_scale))
    decoded = np.asarray(code.refusal == Refusal.NONE)
    contrast = frames.contrast
    variance = noise.variance(frames.white) + noise.variance(frames.black)
    deviation = np.sqrt(variance / np.float32(frames.reference_repeats))
    clear = region & ~near_print_edges(contrast, deviation, camera_blur_px, limits)
    if has_phase(frames):
        positions = position_map(frames, noise, code, tables.cell_position)
        positions = resample_to_pixel_centres(positions, contrast, deviation, camera_blur_px)
        row, column = np.nonzero(clear & np.isfinite(positions.position) & (positions.sigma < limits.largest_sigma_px))
        pixels = np.column_stack([column, row]).astype(np.float64)
        position, sigma = (
            positions.position[row, column].astype(np.float64),
            positions.sigma[row, column].astype(np.float64),
        )
    else:
        pixels, position, sigma = _code_edge_positions(
            frames, noise, code, tables, clear, contrast, camera_blur_px, limits
        )  # fmt: skip
    inside = (position >= np.nanmin(tables.position_table)) & (position <= np.nanmax(tables.position_table))
    return ProjectorPositions(
        frames.axis, pixels[inside], position[inside], sigma[inside], lit, decoded, by_phase=has_phase(frames)
    )


def near_print_edges(
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    camera_blur_px: float,
    limits: CorrespondenceLimits,
    /,
) -> Mask:
    """(H, W) bool: pixels so near an edge of a print that its slope there does not determine the centroid of their
    light.

    contrast, deviation : (H, W) float32, white minus black and its noise. Next to a black square the light of the white
    one reaches further than the other way round, and so does the slope of ln L.
    """
    smooth = cv2.GaussianBlur(contrast, (0, 0), _SMOOTHED_PX)
    right, down = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=1 / 8)
    slope = cv2.magnitude(right, down)
    steep = slope > np.maximum(limits.print_share * smooth, limits.print_sigma * _GRADIENT_GAIN * deviation)
    # The spread of an edge by Gaussian and difference is not part of the reach.
    reach_px = max(limits.print_reach * camera_blur_px - _SMOOTHED_PX, 0.0)
    if not steep.any() or reach_px == 0:
        return np.asarray(steep)
    distance = cv2.distanceTransform((~steep).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    return np.asarray(distance <= reach_px)


def _code_edge_positions(
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
    slopes = _position_slopes(code, tables.cell_position, clear)
    size = np.nanmedian(np.abs(slopes.reshape(2, -1)), axis=1) if np.isfinite(slopes).any() else np.zeros(2)
    crossings = edge_crossings(
        frames, noise, code, tables.position_table, clear, down=bool(size[1] > size[0]), least_sigma=limits.edge_sigma
    )
    slope = np.abs(slopes[int(crossings.down), crossings.row, crossings.column])
    sigma = crossings.sigma_px * slope
    accurate = sigma < limits.largest_sigma_px
    pixels = crossings.pixels_px + camera_blur_px**2 * _log_slopes(contrast, crossings)
    return pixels[accurate], crossings.position_px[accurate], sigma[accurate]


def _position_slopes(code: CodeMap, cell_position: FloatArray, clear: Mask) -> FloatArray:
    """(2, H, W) float64: rise of the projector position per camera pixel to the right, and per pixel down.

    A plane is fitted to the decoded pixels of a window, with its two axes treated as independent. The error of that at
    a border is small, for a slope that only scales a deviation. NaN where pixels are few.
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
    enough = share * _WINDOW_PX**2 >= _MIN_IN_WINDOW
    share = np.where(enough, share, np.nan)
    mean_position = mean(middle) / share
    slopes = []
    for coordinate in (column, row):
        along = coordinate * weight
        mean_coordinate = mean(along) / share
        covariance = mean(coordinate * middle) / share - mean_coordinate * mean_position
        variance = mean(coordinate * along) / share - mean_coordinate**2
        slopes.append(covariance / np.where(variance > 0.5, variance, np.nan))
    return np.stack(slopes)


def _log_slopes(contrast: NDArray[np.float32], crossings: EdgeCrossings) -> FloatArray:
    """(n, 2) float64: slope of ln L to the right and down, per px, at each crossing."""
    level = np.maximum(contrast[crossings.row, crossings.column], np.float32(1e-6))
    gradients = (
        cv2.Sobel(contrast, cv2.CV_32F, *step, scale=1 / 8)[crossings.row, crossings.column]
        for step in ((1, 0), (0, 1))
    )
    return np.column_stack([each / level for each in gradients]).astype(np.float64)
