"""Sub-pixel places at which one pixel row sees the projector change from one code cell to the next.

Between cells i - 1 and i exactly one bit changes. That bit less its inverse passes zero where the camera sees the edge,
whatever the surface's albedo and however wide the blur, as long as the blur is even; and the edge's own projector
position is known exactly. So a crossing tells a position far finer than the cell that a pixel is decoded to.

A bit that blur or a dark surface has taken makes no crossing that stands out of its noise, and the pixels at it are
decoded to an interval of cells, of which both ends have to name the same edge: the finest bits drop out by themselves,
edge by edge.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slrig.kernels import in_bands, kernel, kernel_part
from slrig.model import FloatArray
from slrig.reconstruction.decoding import CodeMap
from slrig.reconstruction.frames import AxisFrames, Images, band_rows, rows_of
from slrig.reconstruction.noise import NoiseModel


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
