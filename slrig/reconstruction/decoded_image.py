"""Decoded image of one camera: its frames, response, code and region; and the images in which points are located."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import FloatArray, IntArray, NoiseModel, Refusal, coarse_bit_count
from slrig.reconstruction.camera_response import (
    CameraResponse,
    PixelSum,
    estimate_gamma,
    estimate_noise,
    frame_compression_loss,
)
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, lit_pixels, unread_code
from slrig.reconstruction.frames import (
    AxisFrames,
    FrameStacks,
    Images,
    rows_per_band,
    select_rows,
    stack_rows,
    subsample,
)
from slrig.reconstruction.phase import EdgeLimits, near_shadows
from slrig.reconstruction.sinusoids import SinusoidMap
from slrig.reconstruction.stripes import (
    LinePoints,
    StripeLimits,
    edge_points,
    edge_skew_px,
    normalise,
    normalise_kernel,
    normalise_line,
    smoothing_shift_px,
)

_ALL_ROWS = slice(None)
_MAX_SAMPLES = 50_000  # whose median is known to a hundredth
_RANK = 3
_DARK_SHARE = 0.5  # of white less black: a bit with less leaves the pixel dark
_UNEQUAL_SIGMA = 3.0  # noise alone gives 1.2 to 1.7
_CROSS = np.array([(0, 1, 0), (1, 1, 1), (0, 1, 0)], np.uint8)
_SIDES_PX = 7  # both sides of an edge of the code, which blur and filter spread over some 3 px each way
_AROUND_PX = 17  # light from other surfaces is alike so far
_MIN_EDGE_SWING = 0.5  # of a contrast that is twice 1; with less, the levels are uncertain
_BLOCK_PX, _BLOCKS_AROUND = 32, 9  # of the image; along each side, over which skew is averaged
_MIN_POINTS = 100  # of edges there
_CORRELATED_POINTS = 5  # whose errors a filter correlates along the stripe
_SIGNIFICANT = 4.0  # standard deviations of a mean
_SKEW = 1.4  # over the first order, of light that falls off exponentially to one side
_MIN_SKEW_PX, _MAX_SKEW_PX = 0.01, 2.0  # less is within the stated deviation, more is an edge close to others
_CLIPPED_SHIFT = 1.5  # over the shift by the smoothed second derivative, which is smaller than that of the light


@dataclass(frozen=True, slots=True)
class CodeTables:
    """Projector positions of the code words of a pattern sequence.

    index_of_word : (2^bits,) int32; cell_position : (cells,) float64, px; position_table : (frames, cells) float64, px,
    of lines or of code edges; edge_table : (bits, cells) float64, px, of the code edges that replace unresolved lines,
    None to replace none.

    For sinusoids, cells are single projector positions, whichever cells the code has, and the position table is that
    of the levels of the position map, which are lines one projector px apart.
    """

    index_of_word: IntArray
    cell_position: FloatArray
    position_table: FloatArray
    edge_table: FloatArray | None = None

    @property
    def extent_px(self) -> int:
        """Extent of the projector where cells are single positions."""
        return len(self.cell_position)


@dataclass(frozen=True, slots=True)
class ReconstructionLimits:
    """All thresholds of the reconstruction of a camera.

    max_disagreement_px : if the stripes of a frame are further than this from where all frames together put them, the
    light changed between frames, and points stay where their own frame shows them. camera_blur_px : blur of the camera
    if neither lines nor a print determine it: a lens in focus, 0.58 px, and its pixel, 1/12 px².
    """

    decoding: DecodingLimits = field(default_factory=DecodingLimits)
    stripes: StripeLimits = field(default_factory=StripeLimits)
    edges: EdgeLimits = field(default_factory=EdgeLimits)
    max_disagreement_px: float = 0.03
    camera_blur_px: float = 0.65


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """Frames of one camera and axis (`AxisFrames`) with all that is known of each pixel.

    code : lit pixels and, once it is read, their interval of cells (`CodeMap`). near_shadow : (H, W) bool, pixels too
    close to a shadow for a fit; contrast_deviation : (H, W) float32, standard deviation of white minus black by noise;
    unresolved : as in `CameraCurves`; region : (H, W) bool, the scan region, None for all. sinusoids : positions by
    sinusoids, whose cells `code` has; None without.
    """

    frames: AxisFrames
    response: CameraResponse
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    contrast_deviation: NDArray[np.float32]
    unresolved: NDArray[np.uint8] | None = None
    region: NDArray[np.bool_] | None = None
    sinusoids: SinusoidMap | None = None

    def rows(self, rows: slice) -> DecodedImage:
        """Select rows of all images."""
        return replace(
            self,
            frames=self.frames.rows(rows),
            response=replace(self.response, noise=self.response.noise.rows(rows)),
            code=self.code.rows(rows),
            near_shadow=self.near_shadow[rows],
            contrast_deviation=self.contrast_deviation[rows],
            unresolved=select_rows(self.unresolved, rows),
            region=select_rows(self.region, rows),
        )

    def with_position_noise(self, images: Images, pixel_sum: PixelSum) -> DecodedImage:
        """Measure compression loss and noise correlation for positions that sum pixels of these images in this way."""
        return replace(self, response=self.response.for_positions(self.frames, ~self.unlit, images, pixel_sum))

    @property
    def position_noise(self) -> NoiseModel:
        """Noise of positions: see `CameraResponse.position_noise`."""
        return self.response.position_noise

    @property
    def unlit(self) -> NDArray[np.bool_]:
        """(H, W) bool: pixels that the projector does not light."""
        return np.asarray(self.code.refusal == Refusal.NOT_LIT)

    @property
    def search_mask(self) -> NDArray[np.bool_]:
        """(H, W) bool: lit pixels to search for points."""
        return ~self.unlit if self.region is None else ~self.unlit & (self.code.refusal != Refusal.OUTSIDE_REGION)


def undecoded_image(frames: AxisFrames, response: CameraResponse, limits: ReconstructionLimits) -> DecodedImage:
    """Return the image before its code is read: lit pixels without cells."""
    noise = response.noise
    lit = lit_pixels(frames, noise, limits.decoding)
    variance = noise.variance(frames.white) + noise.variance(frames.black)
    return DecodedImage(
        frames, response, unread_code(lit),
        near_shadow=near_shadows(~lit, limits.edges),
        contrast_deviation=np.sqrt(variance / np.float32(frames.reference_repeats)),
    )  # fmt: skip


def linearise_frames(stacks: FrameStacks, limits: DecodingLimits) -> tuple[AxisFrames, CameraResponse]:
    """Return the frames so far in proportion to light, and the response of the camera. `stacks` is linearised, too.

    For gamma other than 1 the noise has the compression loss of the camera's own values: linear ones do not show it.
    """
    frames = stacks.frames()
    noise, gamma = estimate_noise(frames), estimate_gamma(frames)
    if gamma == 1:
        return frames, CameraResponse(noise)
    loss = frame_compression_loss(frames, lit_pixels(frames, noise, limits))
    stacks.linearise(gamma)
    frames = stacks.frames()
    return frames, CameraResponse(replace(estimate_noise(frames), loss=loss), gamma)


def cell_width_px(decoded: DecodedImage) -> float | NDArray[np.float32]:
    """Width of the widest cell decoded at a pixel and its neighbours, px: one value, or (H, W)."""
    cell_px = decoded.frames.gray.cell_px
    if decoded.unresolved is None:
        return float(cell_px)
    widest = cv2.dilate(decoded.unresolved, np.ones((3, 3), dtype=np.uint8))
    return np.asarray(cell_px * np.exp2(widest, dtype=np.float32))


def line_image(
    decoded: DecodedImage, index: int, rows: IntArray | slice = _ALL_ROWS
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Rows of line frame `index` relative to white, and their noise."""
    one_line = replace(decoded.frames, lines=decoded.frames.lines[index : index + 1], bits=(), inverses=None)
    frames, noise = one_line.rows(rows), decoded.position_noise.rows(rows)
    line = frames.lines[0].astype(np.float32, copy=False)
    if noise.read_share is None:
        return normalise_line(
            line, frames.white, frames.black, noise.read_variance, noise.slope, frames.reference_repeats
        )  # fmt: skip
    above = line - frames.black
    light = np.clip(above / np.maximum(frames.contrast, np.float32(1)), 0, 1)
    # As in `normalise_line`: (I - black)/(white - black) contains 1 - light of black's noise and light of white's.
    reference = (1 - light) ** 2 * noise.variance(frames.black) + light**2 * noise.variance(frames.white)
    deviation = np.sqrt(noise.variance(line) + reference / np.float32(frames.reference_repeats))
    return normalise(line, frames.black, frames.contrast, deviation)


def code_edge_points(
    decoded: DecodedImage, limits: StripeLimits, scale_px: float, *, within: NDArray[np.bool_] | None = None
) -> list[LinePoints]:
    """Points of the edges of each code bit, where the bit resolves. within : (H, W) bool, pixels to search; None for
    all.
    """
    frames, lit = decoded.frames, decoded.search_mask
    surfaces_light_each_other = _surfaces_light_each_other(decoded)
    parts, skew = [], [np.zeros((0, 2))]
    # A flank that is cut off at full scale is not like the other one.
    reach = 2 * int(np.ceil(3 * scale_px)) + 1
    near_clipped = cv2.dilate((frames.white >= frames.clipped_at).view(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    for index in range(len(frames.bits)):
        read = lit if decoded.unresolved is None else lit & (index < len(frames.bits) - decoded.unresolved)
        if within is not None:
            read &= within
        light, deviation = _bit_difference(decoded, index)
        if surfaces_light_each_other:
            middle, scatter = _edge_middle(light, deviation, read, scale_px)
            light, deviation = light - middle, np.sqrt(deviation**2 + scatter**2)
        points = edge_points(light, deviation, read, limits, filter_px=scale_px)
        shift_px = _CLIPPED_SHIFT * smoothing_shift_px(light, points, near_clipped, scale_px)
        parts.append(points._replace(sigma_px=np.hypot(points.sigma_px, shift_px)))
        if index < coarse_bit_count(len(frames.bits)):
            skew.append(edge_skew_px(light, points, scale_px)[:, None] * points.normals)
    skewed_px = _block_skew(np.concatenate([each.points_px for each in parts[: len(skew) - 1]] or [np.zeros((0, 2))]),
                            np.concatenate(skew), lit.shape)  # fmt: skip
    for each in parts:
        column, row = np.rint(each.points_px).astype(np.intp).T // _BLOCK_PX
        across = np.einsum("ij,ij->i", skewed_px[row, column], each.normals)
        np.hypot(each.sigma_px, across, out=each.sigma_px)
    return parts


def _block_skew(points_px: FloatArray, skew_px: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """(rows, columns, 2) px: of each block of the image, the mean (n, 2) of what noise and prints do not explain.

    Light that spreads to one side (a translucent object, coma) displaces code edges and other patterns differently;
    which of them is right is not known.
    """
    rows, columns = (length // _BLOCK_PX + 1 for length in shape)
    known = (np.abs(skew_px) < _MAX_SKEW_PX).all(axis=1)  # False for NaN
    column, row = np.rint(points_px[known]).astype(np.intp).T // _BLOCK_PX
    block = row * columns + column

    def around(values: FloatArray | None) -> FloatArray:
        total = np.bincount(block, values, rows * columns).reshape(rows, columns).astype(np.float64)
        return np.asarray(
            cv2.boxFilter(total, -1, (_BLOCKS_AROUND, _BLOCKS_AROUND), normalize=False, borderType=cv2.BORDER_CONSTANT)
        )

    count = np.maximum(around(None), 1e-9)
    skewed = np.zeros((rows, columns, 2))
    for each in range(2):
        mean = around(skew_px[known, each]) / count
        variance = np.maximum(around(skew_px[known, each] ** 2) / count - mean**2, 0) * _CORRELATED_POINTS / count
        shown = (mean**2 > _SIGNIFICANT**2 * variance) & (np.abs(mean) > _MIN_SKEW_PX) & (count > _MIN_POINTS)
        skewed[..., each] = np.where(shown, _SKEW * mean, 0)
    return skewed


def light_from_surfaces(decoded: DecodedImage) -> tuple[float, float]:
    """Return the share of white's light that comes by way of other surfaces: median and 95 % of the lit pixels.

    Each bit, and its inverse, lights half of the scene. Where it leaves a pixel dark, half of that light remains on
    average (Nayar et al. 2006, DOI 10.1145/1141911.1141977): the share is twice the median of the dark values. Where
    other surfaces give more light than the projector, it is a lower limit.
    """
    frames, step = decoded.frames, math.ceil(math.sqrt(decoded.frames.white.size / _MAX_SAMPLES))
    lit = decoded.search_mask[::step, ::step]
    if not (lit.any() and len(frames.bits)):
        return 0.0, 0.0
    stacks = [frames.bits] if frames.inverses is None else [frames.bits, frames.inverses]
    values = np.concatenate([subsample(images, step, step) for images in stacks])
    black, contrast = (each[::step, ::step][lit] for each in (frames.black, frames.contrast))
    share = np.sort((values[:, lit] - black) / contrast, axis=0)
    middle = np.count_nonzero(share < _DARK_SHARE, axis=0) // 2
    of_surfaces = np.clip(2 * np.take_along_axis(share, middle[None], axis=0)[0], 0, 1)
    median, most = np.quantile(of_surfaces, (0.5, 0.95))
    return round(float(median), 3), round(float(most), 3)


def _surfaces_light_each_other(decoded: DecodedImage) -> bool:
    """True if, at most pixels, coarse bits that are clear of edges differ from their inverses by unequal light.

    The third largest difference of all is clear of edges: a pixel is rarely near edges of several coarse bits.
    """
    frames, noise = decoded.frames, decoded.response.noise
    count, step = coarse_bit_count(len(frames.bits)), math.ceil(math.sqrt(frames.white.size / _MAX_SAMPLES))
    if frames.inverses is None or count < _RANK:
        return False
    lit = decoded.search_mask[::step, ::step]
    direct, inverse = (subsample(images[:count], step, step)[:, lit] for images in (frames.bits, frames.inverses))
    swing = np.sort(np.abs(direct - inverse), axis=0)
    deviation = np.sqrt(noise.variance(frames.white) + noise.variance(frames.black))[::step, ::step][lit]
    return swing.size > 0 and bool(np.median((swing[-1] - swing[-_RANK]) / deviation) > _UNEQUAL_SIGMA)


def _edge_middle(
    difference: NDArray[np.float32], deviation: NDArray[np.float32], lit: NDArray[np.bool_], scale_px: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the value of a bit less its inverse at the middle of edges nearby, and its error, (H, W) float32 each.

    Light from other surfaces adds to a bit or to its inverse, smoothly, and moves the point where both are alike away
    from the edge. The middle is that of the levels on both sides of an edge, averaged over the edges around; 0 without.
    Its error is the scatter of these edges beyond noise, as noise of pixels that displaces points as much.
    """
    smooth = cv2.GaussianBlur(difference, (0, 0), scale_px)
    box = np.ones((_SIDES_PX, _SIDES_PX), np.uint8)
    high, low = cv2.dilate(smooth, box), cv2.erode(smooth, box)
    swing, middle = high - low, (high + low) / 2
    inside = cv2.erode(lit.view(np.uint8), box, borderValue=0) > 0
    # Pixels next to the point where the bit crosses the middle.
    crossing = cv2.morphologyEx((smooth > middle).view(np.uint8), cv2.MORPH_GRADIENT, _CROSS) > 0
    weight = (inside & crossing & (swing > _MIN_EDGE_SWING)).astype(np.float32)
    count = np.maximum(cv2.blur(weight, (_AROUND_PX, _AROUND_PX)), np.float32(1e-6))
    mean = cv2.blur(middle * weight, (_AROUND_PX, _AROUND_PX)) / count
    # Of the pixels on both sides together: the levels that each finds are a little different.
    both = cv2.blur(middle * weight, (3, 3)) / np.maximum(cv2.blur(weight, (3, 3)), np.float32(1e-6))
    scatter = cv2.blur((both - mean) ** 2 * weight, (_AROUND_PX, _AROUND_PX)) / count
    # A Gaussian filter has this share of the variance of a pixel.
    share = np.float32(1 / (4 * np.pi * scale_px**2))
    beyond = np.maximum(scatter / share - deviation**2, 0)
    return np.asarray(mean, np.float32), np.asarray(np.sqrt(beyond), np.float32)


def _bit_difference(decoded: DecodedImage, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Bit `index` less its inverse relative to white less black, and its noise, (H, W) each."""
    whole = replace(
        decoded.frames,
        bits=decoded.frames.bits[index : index + 1],
        inverses=None if decoded.frames.inverses is None else decoded.frames.inverses[index : index + 1],
        lines=(),
    )
    light, deviation = np.zeros_like(whole.white), np.zeros_like(whole.white)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        frames, noise = whole.rows(rows), decoded.position_noise.rows(rows)
        bit = stack_rows(frames.bits)[0]
        if frames.inverses is not None:
            inverse = stack_rows(frames.inverses)[0]
            swing = bit - inverse
            variance = noise.variance(bit) + noise.variance(inverse)
        else:
            swing = 2 * bit - frames.white - frames.black
            reference = (noise.variance(frames.white) + noise.variance(frames.black)) / frames.reference_repeats
            variance = 4 * noise.variance(bit) + reference
        normalise_kernel(
            0, last - first, swing, np.zeros_like(swing), frames.contrast, np.sqrt(variance), light[rows],
            deviation[rows],
        )  # fmt: skip

    rows, columns = light.shape
    in_bands(band, rows, rows_at_most=rows_per_band(whole.white, columns))
    return light, deviation
