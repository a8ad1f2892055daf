"""Where the light of a pixel comes from: not its centre, where the surface is brighter on one side.

A pixel's light is a mean over its blur, weighted by how brightly each place shines. With a Gaussian blur of variance
σ² and brightness L as the camera sees it (white - black), the centroid of that light lies σ² ∇ ln L beside the pixel's
centre: exactly, since x g(x) = -σ² g'(x). Whatever is measured there (a phase, a stripe's height) is that of the
centroid. On a checkered or half-shadowed surface this moves a stripe's centre by a tenth of a pixel, the bias of an
asymmetric bar, and normalising by white and black does not take it away.

The phase is that of the blurred product of albedo and stripe. Where the position rises by s per pixel and the phase by
ω per position, it is the argument of L at an imaginary place, arg L(x + iσ²ωs): the position is off by
σ² s ∂ ln L - σ⁶ ω² s³ ∂³ ln L / 6 + ... The third order changes its sign within an edge, and a surface fitted to 5 x 5
pixels hardly sees it; what it does see is an error of σ². Where lines do not tell σ² (`blur`), the edges of a print do.
Shading also follows the surface, and tells a σ² of its own: of light that bends as flutes do some 6 px², at a crease
some 100, of either sign. A print's edges agree on one that a lens can have. Where lines do tell, prints are not asked:
of steep waves at a slant, light and shadow agreed on a lens without blur, and errors were twice what was stated.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel
from slrig.model import FloatArray
from slrig.reconstruction.phase import PositionMap

_FITTED_PX = 5  # by as many pixels a point is fitted
_FLAT_PX = 1.0  # projector px of second difference over six pixels: more is two surfaces with a step between
_APART_PX = 4.0  # projector px of second difference over two pixels: more than an edge of a print displaces them
_SIXTH_GAIN = 2 * (45**2 + 9**2 + 1) / 60**2  # variance of the sixth-order difference of unit noise
_DOUBT = 4.0  # squared: fine structure of two standard deviations counts by half
_TURNS = 2  # the second takes the surface's slope from positions that are no longer displaced
_REACH = 5  # px either way that tell the blur: an edge and the surface round it
_SMOOTHED_PX = 1.0  # about as the fit to the positions smooths them, so that the blur is the one that is best for it
_SURROUND_PX = 2.5
_EVERY = 4  # of rows and columns: edges are many, and each costs 121 neighbours
_GRADIENT_GAIN = (8 * np.pi * _SMOOTHED_PX**4) ** -0.5  # deviation of a smoothed derivative of unit noise
_LEAST_SIGMA = 2.0  # noise alone tells no blur: an edge must stand out of it, by its smoothed shift
_FARTHEST = 1.5  # px² from what is expected: more would be a blur of 1.4 px, or of none, and is told by shading
_LEAST_SHARE = 0.5  # of all edges: fewer than 0.12 are as near as that for shading, more than 0.8 for prints
_LEAST_EDGES = 30  # fewer may agree by chance
_PRIOR_SHARE = 0.5  # standard deviation of σ² over what is expected: of lenses more or less in focus


def at_pixel_centres(
    seen: PositionMap,
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    blur_px: float,
    /,
    *,
    clear: NDArray[np.bool_] | None = None,
) -> PositionMap:
    """The position map moved from the centroids of the pixels' light to their centres, to first order.

    contrast, deviation : (H, W) float32, white minus black and the standard deviation of its noise; blur_px : standard
    deviation of the camera's own blur, its pixel's area included, px. clear : (H, W) bool, pixels away from the borders
    of shadows: edges of a print there tell the blur, and blur_px is what is expected without any; None where it is
    known.

    The gradient of ln L is a difference of sixth order, that of the position one over six pixels; beside a border or a
    step both are plain central differences. What the sixth order tells beyond a difference over six pixels, and all of
    a plain difference, may be noise: such a d counts d⁴/(d⁴ + 16 σ⁴), σ its standard deviation by noise. A pixel that
    lacks a neighbour along an axis, or lies at a step, stays as it is along that axis.
    """
    brightness = np.full_like(contrast, np.nan)
    in_bands(_log_kernel, len(contrast), contrast, brightness)
    moved, shift = seen.position, np.zeros_like(seen.position)
    variance = blur_px**2
    for _ in range(_TURNS):
        in_bands(_shift_kernel, len(moved), moved, brightness, contrast, deviation, shift)
        if clear is not None:
            variance = _told_variance(seen, shift, contrast, deviation, clear, blur_px**2)
        moved = seen.position - np.float32(variance) * shift
    return PositionMap(moved, seen.sigma)


def third_order_px(
    measured: PositionMap, centred: PositionMap, usable: NDArray[np.bool_], blur_px: float, period_px: float, /
) -> NDArray[np.float32]:
    """(H, W): standard deviation, camera px, of what the first order leaves in points that are fitted to 5 x 5 pixels.

    It is the third order where brightness changes as sharply as the blur lets it, ∂³ ln L = ∂ ln L / σ²: the share
    σ²ω²s²/6 of what the first order displaced them by. It has either sign.
    """
    down, across = np.gradient(measured.position)
    share = (blur_px * 2 * np.pi / period_px) ** 2 / 6  # over s², and in projector px over s
    squared = share**2 * (down * down + across * across) * (centred.position - measured.position) ** 2
    squared[~(usable & np.isfinite(squared))] = 0
    mean = cv2.blur(squared, (_FITTED_PX, _FITTED_PX))
    return np.asarray(np.sqrt(np.maximum(mean, 0)), dtype=np.float32)  # running sums go a rounding below 0


def _told_variance(
    seen: PositionMap,
    shift: NDArray[np.float32],
    contrast: NDArray[np.float32],
    deviation: NDArray[np.float32],
    clear: NDArray[np.bool_],
    expected: float,
    /,
) -> float:
    """Variance of the blur, px², by which the shifts make the positions smoothest.

    shift : (H, W) float32, of a unit variance; the rest as for `at_pixel_centres`. Shifts r and positions p, both
    smoothed and freed of a quadratic surface, give the least Σ w (p - σ² r)² over strong edges, with the expected value
    as one more observation. Where edges are few, or most are of shading, it stands alone.
    """
    inner = (clear & np.isfinite(seen.position)).view(np.uint8)
    whole = cv2.erode(inner, np.ones((2 * _REACH + 1,) * 2, dtype=np.uint8), borderValue=0)
    # Sums by row: those of all rows are then the same to the bit, however many cores share them.
    sums = np.zeros((len(shift), 5))
    in_bands(
        _edges_kernel, len(shift), *seen, shift, contrast, deviation, whole, _beyond_quadratic(), expected, sums
    )  # fmt: skip
    both, squared, misfit, count, edges = sums.sum(axis=0)
    if count < max(_LEAST_EDGES, _LEAST_SHARE * edges):
        return expected
    # Residuals larger than their weights say are so for all.
    told = max(1.0, (misfit - both * both / squared) / count)
    prior = 1 / (_PRIOR_SHARE * expected) ** 2
    return max(0.0, float((both / told + expected * prior) / (squared / told + prior)))


def _beyond_quadratic() -> FloatArray:
    """(11, 11) float64: weights of a Gaussian of 1 px, less what it sees of a quadratic surface about it."""
    at = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    y, x = (a.ravel() for a in np.meshgrid(at, at, indexing="ij"))
    basis = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    near, about = (np.exp(-(x * x + y * y) / (2 * scale**2)) for scale in (_SMOOTHED_PX, _SURROUND_PX))
    near /= near.sum()
    seen = np.linalg.solve((basis * about) @ basis.T, basis @ near)
    return np.asarray((near - about * (seen @ basis)).reshape(len(at), len(at)))


@kernel
def _log_kernel(first: int, last: int, contrast: Any, out: Any) -> None:
    """Fill in the logarithm where there is light."""
    for y in range(first, last):
        for x in range(contrast.shape[1]):
            if contrast[y, x] > 0:
                out[y, x] = np.log(contrast[y, x])


@kernel
def _shift_kernel(
    first: int, last: int, position: Any, brightness: Any, contrast: Any, deviation: Any, out: Any
) -> None:
    """Fill in by how much a blur of unit variance displaces each position, 0 where nothing tells."""
    rows, columns = position.shape
    for y in range(max(first, 1), min(last, rows - 1)):
        for x in range(1, columns - 1):
            here = position[y, x]
            if np.isnan(here):
                continue
            shift = 0.0
            noise = deviation[y, x] / max(contrast[y, x], np.float32(1e-6))
            for dy, dx in ((0, 1), (1, 0)):
                before, after = position[y - dy, x - dx], position[y + dy, x + dx]
                if not abs(before - 2 * here + after) < _APART_PX:
                    continue
                slope = 0.5 * (after - before)
                # What may be noise: all of the plain difference, of the sixth order what the wide one does not tell.
                rise, gain = np.float32(0.0), 0.5
                fine = 0.5 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                if 3 * dy <= y < rows - 3 * dy and 3 * dx <= x < columns - 3 * dx:
                    before, after = position[y - 3 * dy, x - 3 * dx], position[y + 3 * dy, x + 3 * dx]
                    # Of one surface, and not of two with a step between them.
                    if abs(before - 2 * here + after) < _FLAT_PX:
                        slope = (after - before) / 6
                        far = brightness[y + 3 * dy, x + 3 * dx] - brightness[y - 3 * dy, x - 3 * dx]
                        sixth = (
                            45 * (brightness[y + dy, x + dx] - brightness[y - dy, x - dx])
                            - 9 * (brightness[y + 2 * dy, x + 2 * dx] - brightness[y - 2 * dy, x - 2 * dx])
                            + far
                        ) / 60  # fmt: skip
                        if np.isfinite(sixth):
                            rise, gain = far / 6, _SIXTH_GAIN
                            fine = sixth - rise
                fourth, doubt = fine**4, (_DOUBT * gain * noise * noise) ** 2
                if fourth > 0:
                    rise += fine * (fourth / (fourth + doubt))
                shift += slope * rise
            out[y, x] = shift


@kernel(in_every_scan=False)
def _edges_kernel(
    first: int, last: int, position: Any, sigma: Any, shift: Any, contrast: Any, deviation: Any, whole: Any,
    stencil: Any, expected: float, sums: Any,
) -> None:  # fmt: skip
    """Fill in by row Σ w r p, Σ w r², Σ w p² and the count of edges that a lens can make, and the count of all."""
    reach = len(stencil) // 2
    gain = 1 / (2 * np.sqrt(np.pi) * _SMOOTHED_PX)
    for y in range(first + -first % _EVERY, last, _EVERY):
        for x in range(0, shift.shape[1], _EVERY):
            if not whole[y, x]:
                continue
            # The shift's noise is that of ln L times the slope of the position.
            gx = 0.5 * (position[y, x + 1] - position[y, x - 1])
            gy = 0.5 * (position[y + 1, x] - position[y - 1, x])
            least = _LEAST_SIGMA * _GRADIENT_GAIN * np.sqrt(gx * gx + gy * gy) * deviation[y, x] / contrast[y, x]
            if not abs(shift[y, x]) > 0:
                continue
            r = p = 0.0
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    weight = stencil[dy + reach, dx + reach]
                    r += weight * shift[y + dy, x + dx]
                    p += weight * (position[y + dy, x + dx] - position[y, x])
            if not abs(r) > least:
                continue
            sums[y, 4] += 1
            if not abs(p - expected * r) < _FARTHEST * abs(r):
                continue
            weight = 1 / (gain * sigma[y, x]) ** 2
            sums[y, 0] += weight * r * p
            sums[y, 1] += weight * r * r
            sums[y, 2] += weight * p * p
            sums[y, 3] += 1
