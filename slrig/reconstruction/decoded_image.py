"""Decoded image of one camera: its frames, response, code and region; and the images in which points are located."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import FloatArray, IntArray, NoiseModel, Refusal
from slrig.reconstruction.camera_response import (
    CameraResponse,
    PixelSum,
    estimate_gamma,
    estimate_noise,
    frame_compression_loss,
)
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, lit_pixels
from slrig.reconstruction.frames import AxisFrames, FrameStacks, Images, rows_per_band, select_rows, stack_rows
from slrig.reconstruction.phase import EdgeLimits, near_shadows
from slrig.reconstruction.stripes import (
    LinePoints,
    StripeLimits,
    edge_points,
    normalise,
    normalise_kernel,
    normalise_line,
    smoothing_shift_px,
)

_ALL_ROWS = slice(None)
_CLIPPED_SHIFT = 1.5  # over the shift by the smoothed second derivative, which is smaller than that of the light


@dataclass(frozen=True, slots=True)
class CodeTables:
    """Projector positions that the code words of a pattern sequence stand for.

    index_of_word : (2^bits,) int32; cell_position : (cells,) float64, px; position_table : (frames, cells) float64, px,
    of lines or of code edges; edge_table : (bits, cells) float64, px, of the code edges that replace unresolved lines,
    None to replace none.
    """

    index_of_word: IntArray
    cell_position: FloatArray
    position_table: FloatArray
    edge_table: FloatArray | None = None


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
    unresolved : as in `CameraCurves`; region : (H, W) bool, the scan region, None for all.
    """

    frames: AxisFrames
    response: CameraResponse
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    contrast_deviation: NDArray[np.float32]
    unresolved: NDArray[np.uint8] | None = None
    region: NDArray[np.bool_] | None = None

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
    no_cells = np.broadcast_to(np.int32(-1), lit.shape)
    return DecodedImage(
        frames, response,
        CodeMap(no_cells, no_cells, np.where(lit, np.uint8(Refusal.NONE), np.uint8(Refusal.NOT_LIT))),
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
    """Width of a decoded cell, px: one value, or (H, W)."""
    cell_px = decoded.frames.gray.cell_px
    return float(cell_px) if decoded.unresolved is None else cell_px * np.exp2(decoded.unresolved, dtype=np.float32)


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
    parts = []
    # A flank that is cut off at full scale is not like the other one.
    reach = 2 * int(np.ceil(3 * scale_px)) + 1
    near_clipped = cv2.dilate((frames.white >= frames.clipped_at).view(np.uint8), np.ones((reach, reach), np.uint8)) > 0
    for index in range(len(frames.bits)):
        read = lit if decoded.unresolved is None else lit & (index < len(frames.bits) - decoded.unresolved)
        if within is not None:
            read &= within
        light, deviation = _bit_difference(decoded, index)
        points = edge_points(light, deviation, read, limits, filter_px=scale_px)
        shift_px = _CLIPPED_SHIFT * smoothing_shift_px(light, points, near_clipped, scale_px)
        parts.append(points._replace(sigma_px=np.hypot(points.sigma_px, shift_px)))
    return parts


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
