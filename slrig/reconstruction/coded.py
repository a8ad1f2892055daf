"""Decoded image of one camera, the limits of its reconstruction, and the images in which points are located."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands
from slrig.model import FloatArray, IntArray, Refusal
from slrig.reconstruction.camera_response import PixelSum, gain, loss_variance, shared_noise
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, lit_pixels
from slrig.reconstruction.frames import AxisFrames, Images, at_rows, band_rows, rows_of
from slrig.reconstruction.noise import NoiseModel
from slrig.reconstruction.phase import EdgeLimits, near_shadows
from slrig.reconstruction.stripes import (
    LinePoints,
    StripeLimits,
    edge_points,
    normalised,
    normalised_kernel,
    normalised_line,
)


@dataclass(frozen=True, slots=True)
class CodeTables:
    """What the patterns mean. index_of_word : (2^bits,) int32; cell_position : (cells,) float64, px;
    position_of : (frames, cells) float64, px, of lines or of code edges; edges_of : (bits, cells) float64, px, of the
    code edges that stand for lines where those are not resolved, None where nothing does.
    """

    index_of_word: IntArray
    cell_position: FloatArray
    position_of: FloatArray
    edges_of: FloatArray | None = None


@dataclass(frozen=True, slots=True)
class Limits:
    """All thresholds of a camera's reconstruction.

    largest_disagreement_px : where the stripes of one frame lie further than this from where all frames together put
    them, the light changed from frame to frame, and each stripe stands as its own frame shows it.
    camera_blur_px : its own, where neither lines nor a print tell it: a lens in focus, 0.58 px, and its pixel, 1/12 px²
    """

    decoding: DecodingLimits = field(default_factory=DecodingLimits)
    stripes: StripeLimits = field(default_factory=StripeLimits)
    edges: EdgeLimits = field(default_factory=EdgeLimits)
    largest_disagreement_px: float = 0.03
    camera_blur_px: float = 0.65


_WHOLE = slice(None)


@dataclass(frozen=True, slots=True)
class Coded:
    """Per-pixel result of white, black and code frames.

    near_shadow : (H, W) bool, pixels too close to a shadow for a fit; contrast_deviation : (H, W) float32, standard
    deviation of white minus black by noise; unresolved : as in `CameraCurves`; loss_variance : extra variance of each
    sample caused by compression, camera units squared. It counts for positions only: it bends stripes and edges, but
    turns no bit over. shared : factor by which noise shared by neighbours increases the variance of sums of pixels, see
    `camera_response.shared_noise`. gamma : as in `CameraCurves`. asked : (H, W) bool, the scan region; None for all.
    """

    frames: AxisFrames
    noise: NoiseModel
    code: CodeMap
    near_shadow: NDArray[np.bool_]
    contrast_deviation: NDArray[np.float32]
    unresolved: NDArray[np.uint8] | None
    loss_variance: float = 0.0
    shared: float = 1.0
    gamma: float = 1.0
    asked: NDArray[np.bool_] | None = None

    def rows(self, rows: slice) -> Coded:
        """Some rows of all of it."""
        return replace(
            self,
            frames=self.frames.rows(rows),
            noise=self.noise.rows(rows),
            code=self.code.rows(rows),
            near_shadow=self.near_shadow[rows],
            contrast_deviation=self.contrast_deviation[rows],
            unresolved=at_rows(self.unresolved, rows),
            asked=at_rows(self.asked, rows),
        )

    @property
    def position_noise(self) -> NoiseModel:
        """Noise as positions have it."""
        return self.noise.times(self.shared).with_more(self.loss_variance)

    def summed(self, images: Images, pixels: PixelSum) -> Coded:
        """The same with what noise and compression of these images do to positions that sum pixels so."""
        loss = loss_variance(self.frames, self.noise, self.code, images, pixels)
        if loss:
            loss *= gain((image[~self.unlit] for image in images), self.gamma, self.frames.full_scale)
        return replace(self, loss_variance=loss, shared=shared_noise(self.frames, self.noise, ~self.unlit, pixels))

    @property
    def unlit(self) -> NDArray[np.bool_]:
        """(H, W) bool: the pixels that the projector does not light."""
        return np.asarray(self.code.refusal == Refusal.NOT_LIT)

    @property
    def searched(self) -> NDArray[np.bool_]:
        """(H, W) bool: the lit pixels in which points are looked for."""
        return ~self.unlit if self.asked is None else ~self.unlit & (self.code.refusal != Refusal.OUTSIDE_REGION)


def not_yet_coded(frames: AxisFrames, noise: NoiseModel, gamma: float, limits: Limits) -> Coded:
    """What is known before the code is read: which pixels are lit, and no cell of any."""
    lit = lit_pixels(frames, noise, limits.decoding)
    ends = noise.variance(frames.white) + noise.variance(frames.black)
    nowhere = np.broadcast_to(np.int32(-1), lit.shape)
    return Coded(
        frames, noise,
        CodeMap(nowhere, nowhere, np.where(lit, np.uint8(Refusal.NONE), np.uint8(Refusal.NOT_LIT))),
        near_shadow=near_shadows(~lit, limits.edges),
        contrast_deviation=np.sqrt(ends / np.float32(frames.ends_repeats)),
        unresolved=None,
        gamma=gamma,
    )  # fmt: skip


def cell_width_px(coded: Coded) -> float | NDArray[np.float32]:
    """Width of a decoded cell, px: for all pixels, or (H, W)."""
    cell_px = coded.frames.gray.cell_px
    return float(cell_px) if coded.unresolved is None else cell_px * np.exp2(coded.unresolved, dtype=np.float32)


def line_image(
    coded: Coded, index: int, rows: IntArray | slice = _WHOLE
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Some rows of line frame `index` relative to white, and its noise."""
    alone = replace(coded.frames, lines=coded.frames.lines[index : index + 1], bits=(), inverses=None)
    frames, noise = alone.rows(rows), coded.position_noise.rows(rows)
    line = frames.lines[0].astype(np.float32, copy=False)
    if noise.read_share is None:
        return normalised_line(
            line, frames.white, frames.black, noise.read_variance, noise.slope, frames.ends_repeats
        )  # fmt: skip
    above = line - frames.black
    light = np.clip(above / np.maximum(frames.contrast, np.float32(1)), 0, 1)
    # As there: (I - black)/(white - black) takes 1 - light of black's noise and light of white's.
    ends = (1 - light) ** 2 * noise.variance(frames.black) + light**2 * noise.variance(frames.white)
    deviation = np.sqrt(noise.variance(line) + ends / np.float32(frames.ends_repeats))
    return normalised(line, frames.black, frames.contrast, deviation)


def code_edge_points(
    coded: Coded, limits: StripeLimits, scale_px: float, *, within: NDArray[np.bool_] | None = None
) -> list[LinePoints]:
    """Points of each code bit's edges, where the bit resolves. within : (H, W) bool, to look for them nowhere else."""
    frames, lit = coded.frames, coded.searched
    parts = []
    for index in range(len(frames.bits)):
        read = lit if coded.unresolved is None else lit & (index < len(frames.bits) - coded.unresolved)
        if within is not None:
            read &= within
        parts.append(edge_points(*_swing(coded, index), read, limits, sigma_px=scale_px))
    return parts


def _swing(coded: Coded, index: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Bit `index` less its inverse relative to white less black, and its noise, (H, W) each."""
    whole = replace(
        coded.frames,
        bits=coded.frames.bits[index : index + 1],
        inverses=None if coded.frames.inverses is None else coded.frames.inverses[index : index + 1],
        lines=(),
    )
    light, deviation = np.zeros_like(whole.white), np.zeros_like(whole.white)

    def band(first: int, last: int) -> None:
        rows = slice(first, last)
        frames, noise = whole.rows(rows), coded.position_noise.rows(rows)
        bit = rows_of(frames.bits)[0]
        if frames.inverses is not None:
            inverse = rows_of(frames.inverses)[0]
            swing = bit - inverse
            variance = noise.variance(bit) + noise.variance(inverse)
        else:
            swing = 2 * bit - frames.white - frames.black
            ends = (noise.variance(frames.white) + noise.variance(frames.black)) / frames.ends_repeats
            variance = 4 * noise.variance(bit) + ends
        normalised_kernel(
            0, last - first, swing, np.zeros_like(swing), frames.contrast, np.sqrt(variance), light[rows],
            deviation[rows],
        )  # fmt: skip

    rows, columns = light.shape
    in_bands(band, rows, rows_at_most=band_rows(whole.white, columns))
    return light, deviation
