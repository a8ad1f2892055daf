"""Sub-pixel points on light stripes and on code edges, linked along the curve that they lie on.

Stripes: Steger's curvilinear detector (PAMI 20(2) 1998, 113-125) with one further Newton step on kernels re-centred on
the sub-pixel point, which removes the S-shaped error of a single Taylor step. Code edges: the zero crossing of a bit
minus its inverse, found along its gradient by the same two steps. Both give points, normals and a standard deviation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray, IntArray
from slrig.reconstruction.chaining import chain_points
from slrig.reconstruction.steger import EDGE, RIDGE, kernels, newton_step, taylor_step


@dataclass(frozen=True, slots=True)
class StripeLimits:
    """What counts as a stripe.

    sigma_px : scale of the Gaussian; None measures the stripes and matches it, between 1 and 2.5 px.
    strong_sigma, weak_sigma : hysteresis, in standard deviations of the response to noise alone.
    weak_fraction : a point must reach this fraction of the image's typical response.
    shortest_points : a stripe of fewer points is refused.
    """

    sigma_px: float | None = None
    strong_sigma: float = 7.0
    weak_sigma: float = 3.5
    weak_fraction: float = 0.12
    shortest_points: int = 5


@dataclass(frozen=True, slots=True)
class Stripes:
    """Chains of sub-pixel points. Chain i holds the points offsets[i]:offsets[i + 1], in order along the curve.

    offsets : (s + 1,) int32; frame : (s,) int32, index of the line or bit frame the chain was found in.
    points_px : (n, 2) float64, (x, y) in the camera image; normals : (n, 2) float64, unit, across the curve.
    sigma_px : (n,) float64, standard deviation across the curve from noise.
    """

    offsets: IntArray
    frame: IntArray
    points_px: FloatArray
    normals: FloatArray
    sigma_px: FloatArray

    def __len__(self) -> int:
        return len(self.offsets) - 1


class LinePoints(NamedTuple):
    """Sub-pixel points of one line or bit frame, not yet linked.

    points_px, normals, sigma_px : as in `Stripes`; strength : (n,) float64, the filter's response;
    strong : (n,) bool, points at which a stripe may begin.
    """

    points_px: FloatArray
    normals: FloatArray
    strength: FloatArray
    strong: NDArray[np.bool_]
    sigma_px: FloatArray

    def first(self, count: int) -> LinePoints:
        """The first so many of them."""
        return LinePoints(
            self.points_px[:count], self.normals[:count], self.strength[:count], self.strong[:count],
            self.sigma_px[:count],
        )  # fmt: skip


def chained(frames: Sequence[LinePoints], shape: tuple[int, int], /) -> Stripes:
    """The points of each frame linked along their lines; all chains as one value, frame by frame.

    shape : (rows, columns) of the image.
    """

    def chain(first: int, last: int) -> list[tuple[IntArray, IntArray]]:
        return [chain_points(*each[:4], shape) for each in frames[first:last]]

    # What chaining makes on the way is large, and so are the points: these are moved once, when all places are known.
    chains = [each for band in in_bands(chain, len(frames)) for each in band]
    ends = np.cumsum([0, *(len(order) for order, _ in chains)])
    count = int(ends[-1])
    points_px, normals, sigma_px = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros(count)

    def gather(first: int, last: int) -> None:
        for index in range(first, last):
            given, order, part = frames[index], chains[index][0], slice(ends[index], ends[index + 1])
            np.take(given.points_px, order, axis=0, out=points_px[part], mode="clip")
            np.take(given.normals, order, axis=0, out=normals[part], mode="clip")
            np.take(given.sigma_px, order, out=sigma_px[part], mode="clip")

    in_bands(gather, len(frames))
    lengths = [np.diff(offsets) for _, offsets in chains]
    frame = np.repeat(np.arange(len(frames), dtype=np.int32), [len(each) for each in lengths])
    offsets = np.cumsum(np.concatenate([[0], *lengths]), dtype=np.int32)
    return Stripes(offsets, frame, points_px, normals, sigma_px)


def gathered(
    order: IntArray, points_px: FloatArray, normals: FloatArray, sigma_px: FloatArray, /
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points, normals and deviations at the indices `order`."""
    return np.take(points_px, order, axis=0), np.take(normals, order, axis=0), np.take(sigma_px, order)


def normalised(
    image: NDArray[np.float32], black: NDArray[np.float32], contrast: NDArray[np.float32], noise: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Light relative to white, free of albedo, and its noise.

    (I - black)/(white - black), damped to zero where the contrast is not above the noise.
    noise : (H, W) float32, standard deviation of I - black, camera units.
    """
    light, deviation = np.zeros_like(image), np.zeros_like(image)
    in_bands(normalised_kernel, len(image), image, black, contrast, noise, light, deviation)
    return light, deviation


@kernel(in_every_scan=False)
def normalised_kernel(
    first: int, last: int, image: Any, black: Any, contrast: Any, noise: Any, light: Any, deviation: Any
) -> None:
    """Fill in light and deviation: see `normalised`."""
    for y in range(first, last):
        for x in range(image.shape[1]):
            weight = _weight(contrast[y, x], noise[y, x])
            light[y, x] = (image[y, x] - black[y, x]) * weight
            deviation[y, x] = noise[y, x] * abs(weight)


@kernel_part(inline="always")
def _weight(contrast: Any, noise: Any) -> Any:
    """1/contrast, damped to zero where the contrast is not above the noise."""
    damping = np.float32(3) * noise
    squared = contrast * contrast + damping * damping
    return contrast / squared if squared > 0 else np.float32(0)


def normalised_line(
    line: NDArray[np.float32],
    white: NDArray[np.float32],
    black: NDArray[np.float32],
    read_variance: float,
    slope: float,
    ends_repeats: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A line frame as `normalised` gives it, with the noise of line, white and black counted, as the light has it.

    read_variance, slope : of the camera's noise; ends_repeats : how many frames the mean white and black are of.
    """
    light, deviation = np.zeros_like(line), np.zeros_like(line)
    in_bands(
        _normalised_line_kernel, len(line), line, white, black, read_variance, slope, ends_repeats, light, deviation
    )
    return light, deviation


@kernel
def _normalised_line_kernel(
    first: int, last: int, line: Any, white: Any, black: Any, read: float, slope: float, ends_repeats: float,
    normal: Any, deviation: Any,
) -> None:  # fmt: skip
    for y in range(first, last):
        for x in range(line.shape[1]):
            contrast, above = white[y, x] - black[y, x], line[y, x] - black[y, x]
            # (I - black)/(white - black) takes 1 - light of black's noise and light of white's.
            light = min(max(above / max(contrast, np.float32(1)), np.float32(0)), np.float32(1))
            of_white = (read + slope * max(white[y, x], np.float32(0))) / ends_repeats
            of_black = (read + slope * max(black[y, x], np.float32(0))) / ends_repeats
            own = read + slope * max(line[y, x], np.float32(0))
            noise = np.float32(np.sqrt(own + (1 - light) ** 2 * of_black + light**2 * of_white))
            weight = _weight(contrast, noise)
            normal[y, x] = above * weight
            deviation[y, x] = noise * abs(weight)


def measured_sigma_px(image: NDArray[np.float32], noise: NDArray[np.float32], lit: NDArray[np.bool_]) -> float:
    """Standard deviation of the stripes' cross-section, px: the median over the clear points of one frame.

    For a Gaussian bar smoothed to scale S the response is -r/S² at the centre, so S² = -r/r_nn.
    """
    probe = 1.2
    found = line_points(RIDGE, image, noise, lit, StripeLimits(weak_sigma=12.0), sigma_px=probe)
    strength = found.strength
    if len(strength) < 50:
        return probe
    smooth = cv2.GaussianBlur(image, (0, 0), probe)
    x, y = np.rint(found.points_px).astype(int).T
    value = smooth[y, x]
    clear = strength > np.median(strength)
    squared = np.median(value[clear] / strength[clear]) - probe**2
    return float(np.sqrt(max(squared, 0.25)))


def line_points(
    kind: int,
    image: NDArray[np.float32],
    noise: NDArray[np.float32],
    lit: NDArray[np.bool_],
    limits: StripeLimits,
    /,
    *,
    sigma_px: float,
) -> LinePoints:
    """Points of one frame, and how sure they are.

    kind : `RIDGE` or `EDGE`; image, noise : (H, W) float32; lit : (H, W) bool, pixels that can hold a point;
    sigma_px : scale of the Gaussian.
    """
    # Standard deviation of the response to noise alone, over that of the noise: ∫ g_xx² = 3/(16 π σ⁶) for the ridge
    # response, ∫ g_x² = 1/(8 π σ⁴) for the gradient. Of the numerator of the last step: ∫ g_x², and ∫ g² = 1/(4 π σ²).
    gradient_noise = np.sqrt(1 / (8 * np.pi)) / sigma_px**2
    if kind == RIDGE:
        response_noise, gain = np.sqrt(3 / (16 * np.pi)) / sigma_px**3, gradient_noise
    else:
        response_noise, gain = gradient_noise, np.sqrt(1 / (4 * np.pi)) / sigma_px
    weakest = np.float32(limits.weak_sigma * response_noise)
    offset, strength = taylor_step(image, noise, lit, weakest, *kernels(sigma_px), kind)
    rows, columns, height = _responses_kernel(strength)
    if len(height):
        counts = height > limits.weak_fraction * np.percentile(height, 90)
        rows, columns = rows[counts], columns[counts]
    x, y, normals, response, kept = newton_step(image, offset, columns, rows, sigma_px, kind)
    strongest = np.float32(limits.strong_sigma * response_noise)
    return LinePoints(*_kept_kernel(kept, x, y, normals, response, noise, rows, columns, gain, strongest))


stripe_points = partial(line_points, RIDGE)
"""Centres of the bright stripes of a normalised line frame."""

edge_points = partial(line_points, EDGE)
"""Zero crossings of a bit minus its inverse."""


@kernel
def _responses_kernel(strength: Any) -> Any:
    """Row, column (int32) and value of every pixel that is not zero, in the order of the image."""
    count = 0
    for y in range(strength.shape[0]):
        for x in range(strength.shape[1]):
            count += strength[y, x] != 0
    rows = np.zeros(count, dtype=np.int32)
    columns = np.zeros(count, dtype=np.int32)
    height = np.zeros(count, dtype=np.float32)
    at = 0
    for y in range(strength.shape[0]):
        for x in range(strength.shape[1]):
            if strength[y, x] != 0:
                rows[at], columns[at], height[at] = y, x, strength[y, x]
                at += 1
    return rows, columns, height


@kernel
def _kept_kernel(
    kept: Any, x: Any, y: Any, normals: Any, response: Any, noise: Any, rows: Any, columns: Any, gain: float,
    weakest: float,
) -> Any:  # fmt: skip
    """What `LinePoints` holds, of the points that are kept: gain and weakest make noise a deviation and a threshold."""
    total = 0
    for i in range(len(kept)):
        total += kept[i]
    points, across = np.zeros((total, 2)), np.zeros((total, 2))
    strength, sigma = np.zeros(total), np.zeros(total)
    strong = np.zeros(total, dtype=np.bool_)
    at = 0
    for i in range(len(kept)):
        if kept[i]:
            points[at, 0], points[at, 1] = x[i], y[i]
            across[at, 0], across[at, 1] = normals[i, 0], normals[i, 1]
            strength[at] = response[i]
            sigma[at] = noise[rows[i], columns[i]] * gain / max(response[i], 1e-12)
            strong[at] = response[i] > noise[int(np.rint(y[i])), int(np.rint(x[i]))] * weakest
            at += 1
    return points, across, strength, strong, sigma
