"""One camera's frames to linked curves: noise, code, stripes, identity, links."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, IntArray, Refusal
from slrig.reconstruction.decoding import CodeMap, DecodingLimits, decode
from slrig.reconstruction.edges import EdgeLimits, dense_position, has_phase, near_edges
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.identification import identify
from slrig.reconstruction.linking import StripeEnsemble, link
from slrig.reconstruction.noise import NoiseModel, estimate_noise
from slrig.reconstruction.stripes import (
    StripeLimits,
    Stripes,
    joined,
    locate_edges,
    locate_stripes,
    measured_sigma_px,
    normalised,
)

_FINEST_SCALE_PX = 1.0
_COARSEST_SCALE_PX = 2.5
_LEAST_SMOOTHED_PX = 1.4


@dataclass(frozen=True, slots=True)
class CodeTables:
    """What the patterns mean. index_of_word : (2^bits,) int32; cell_position : (cells,) float64, px;
    position_of : (frames, cells) float64, px, of lines or of code edges.
    """

    index_of_word: IntArray
    cell_position: FloatArray
    position_of: FloatArray


@dataclass(frozen=True, slots=True)
class Limits:
    """All thresholds of a camera's reconstruction."""

    decoding: DecodingLimits = field(default_factory=DecodingLimits)
    stripes: StripeLimits = field(default_factory=StripeLimits)
    edges: EdgeLimits = field(default_factory=EdgeLimits)


@dataclass(frozen=True, slots=True)
class CameraCurves:
    """What one camera gives. refusal : (H, W) uint8, `Refusal`; stripe_points, stripe_count : before linking."""

    ensemble: StripeEnsemble
    refusal: NDArray[np.uint8]
    noise: NoiseModel
    scale_px: float
    decoded_pixels: int
    stripe_points: int
    stripe_count: int


def camera_curves(
    frames: AxisFrames, tables: CodeTables, limits: Limits, /, *, entered: Callable[[str], None]
) -> CameraCurves:
    """Reconstruct the curves of one camera. `entered` is told the name of each stage as it begins."""
    entered("decode")
    noise = estimate_noise(frames)
    code = decode(frames, noise, tables.index_of_word, len(tables.cell_position), limits.decoding)
    entered("locate stripes")
    lit = code.refusal != Refusal.NOT_LIT
    stripes, scale_px, blur_px = (
        _line_stripes(frames, noise, lit, limits.stripes)
        if len(frames.lines)
        else _edge_stripes(frames, noise, lit, limits.stripes)
    )
    entered("identify stripes")
    near_shadow, near_step = _borders(frames, code, tables, limits.edges, blur_px)
    coded, refusal = identify(
        stripes, code, tables.position_of, near_shadow, near_step, shortest_points=limits.stripes.shortest_points
    )
    entered("link stripes")
    return CameraCurves(
        ensemble=link(coded),
        refusal=refusal,
        noise=noise,
        scale_px=scale_px,
        decoded_pixels=int((code.refusal == Refusal.NONE).sum()),
        stripe_points=len(stripes.points_px),
        stripe_count=len(coded.stripes),
    )


def _borders(
    frames: AxisFrames, code: CodeMap, tables: CodeTables, limits: EdgeLimits, blur_px: float
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    position = dense_position(frames, code, tables.cell_position)
    resolution_px = 0.0 if has_phase(frames) else float(frames.gray.cell_px)
    return near_edges(position, code.refusal == Refusal.NOT_LIT, resolution_px, limits, blur_px=blur_px)


def _line_stripes(
    frames: AxisFrames, noise: NoiseModel, lit: NDArray[np.bool_], limits: StripeLimits
) -> tuple[Stripes, float, float]:
    """Stripes, the scale that they were found at, and the blur that their width tells."""
    contrast = frames.contrast
    white_variance, black_variance = (noise.variance(end) / frames.ends_repeats for end in (frames.white, frames.black))
    scale_px = blur_px = 0.0
    parts = []
    for index, line in enumerate(frames.lines):
        # (I - black)/(white - black) takes 1 - light of black's noise and light of white's.
        light = np.clip((line - frames.black) / np.maximum(contrast, 1), 0, 1)
        variance = noise.variance(line) + (1 - light) ** 2 * black_variance + light**2 * white_variance
        image, deviation = normalised(line, frames.black, contrast, np.sqrt(variance))
        if index == 0:
            blur_px = measured_sigma_px(image, deviation, lit)
            scale_px = limits.sigma_px or _matched_scale_px(blur_px)
        parts.append(locate_stripes(image, deviation, lit, index, limits, sigma_px=scale_px))
    return joined(parts), scale_px, blur_px


def _matched_scale_px(stripe_sigma_px: float) -> float:
    """Scale of the Gaussian for stripes of this width, px.

    The stripe's own width is the best scale against noise (reconstruction at the physical limit). Stripes sharper than
    the pixels sample well are smoothed more: below a total of 1.4 px the sampling itself displaces the centre.
    """
    more = np.sqrt(max(_LEAST_SMOOTHED_PX**2 - stripe_sigma_px**2, 0.0))
    return float(np.clip(max(stripe_sigma_px, more), _FINEST_SCALE_PX, _COARSEST_SCALE_PX))


def _edge_stripes(
    frames: AxisFrames, noise: NoiseModel, lit: NDArray[np.bool_], limits: StripeLimits
) -> tuple[Stripes, float, float]:
    """Code edges, the scale that they were found at, and no more blur than that."""
    scale_px = limits.sigma_px or _FINEST_SCALE_PX
    contrast = frames.contrast
    none = np.zeros_like(contrast)
    ends_variance = (noise.variance(frames.white) + noise.variance(frames.black)) / frames.ends_repeats
    parts = []
    for index, bit in enumerate(frames.bits):
        if frames.inverses is not None:
            inverse = frames.inverses[index]
            swing = bit - inverse
            variance = noise.variance(bit) + noise.variance(inverse)
        else:
            swing = 2 * bit - frames.white - frames.black
            variance = 4 * noise.variance(bit) + ends_variance
        image, deviation = normalised(swing, none, contrast, np.sqrt(variance))
        parts.append(locate_edges(image, deviation, lit, index, limits, sigma_px=scale_px))
    return joined(parts), scale_px, _FINEST_SCALE_PX
