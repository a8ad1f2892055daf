"""Light of the second axis: a redundant equation at each pixel.

Where columns and rows were played, one axis and the camera ray determine a point. The other axis then measures a
coordinate that the calibration predicts: the point's position along its light sheet. Their difference contains errors
of the calibration, of the code, and light that took another path (mirror images).

`SecondAxis.positions` gives that coordinate at each pixel, to half a code cell without lines; `SecondAxis.edges` gives
it exactly where stripes cross code edges, for `slrig.reconstruction.calibration_check`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slrig.model import FloatArray, NoiseModel, Pinhole
from slrig.reconstruction.decoded_image import CodeTables
from slrig.reconstruction.decoding import DecodingLimits, decode, decode_edges
from slrig.reconstruction.frames import AxisFrames
from slrig.reconstruction.phase import has_phase, position_map
from slrig.reconstruction.sinusoids import decode_sinusoids
from slrig.reconstruction.stripes import sample_image
from slrig.reconstruction.triangulation import SheetCurves, project

_UNIFORM = 12**-0.5  # standard deviation of a uniform distribution of width 1
_MAX_STEP_CELLS = 3.0  # between neighbouring pixels of one surface
_MIN_LIMIT_PX = 1.0  # smaller differences are errors of the calibration, not light from elsewhere
_MAX_SIGMA = 6.0  # beyond this many standard deviations light comes from elsewhere
_MAX_UNREAD = 1  # bits: blur that hides more displaces the edges of the others
_MAX_SPACING_PX = 2.0  # of neighbouring points of a stripe


@dataclass(frozen=True, slots=True)
class AxisPositions:
    """Projector position of each camera pixel along one axis.

    position_px : (H, W) float32, projector pixels, NaN where the code is not read; sigma_px : (H, W) float32, its
    standard deviation: by phase where lines were played, otherwise that of a uniform distribution over the code cell.
    """

    position_px: NDArray[np.float32]
    sigma_px: NDArray[np.float32]

    def sample(self, points_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) float64 each: position and standard deviation at (x, y) points, NaN where the code is not read.

        Interpolated between the four pixels around a point where all of them see one surface, otherwise that of the
        nearest pixel.
        """
        limit = np.array(self.position_px.shape[::-1]) - 1
        columns, rows = np.clip(np.rint(points_px), 0, limit).astype(np.intp).T
        nearest, sigma = (each[rows, columns].astype(np.float64) for each in (self.position_px, self.sigma_px))
        between = sample_image(self.position_px, points_px)
        smooth = np.abs(between - nearest) <= _MAX_STEP_CELLS * np.maximum(1.0, sigma / _UNIFORM)  # False for NaN
        return np.where(smooth, between, nearest), sigma


class AxisEdges(NamedTuple):
    """Crossings of stripes of the first axis with code edges of the second one: exact in both coordinates.

    point : (n,) int64, index of the stripe point before the crossing; fraction : (n,) float64, 0 to 1, of the way to
    the next point; position_px : (n,) float64, position of the edge along the second axis.
    """

    point: NDArray[np.int64]
    fraction: FloatArray
    position_px: FloatArray


@dataclass(frozen=True, slots=True)
class SecondAxis:
    """Frames of the second axis of one camera, decoded.

    frames : in proportion to light; edges_px : for each bit of their code, the sorted positions of its edges.
    """

    frames: AxisFrames
    positions: AxisPositions
    edges_px: tuple[FloatArray, ...]

    def edges(self, points_px: FloatArray, ends: NDArray[np.bool_]) -> AxisEdges:
        """Find where stripes cross code edges of this axis.

        points_px : (n, 2) float64, points of stripes in order; ends : (n,) bool, True where the next point is not a
        neighbour. A crossing belongs to the edge nearest to the value of `positions` there.
        """
        frames = self.frames
        approximate, _ = self.positions.sample(points_px)
        reference = [frames.middle] * len(frames.bits) if frames.inverses is None else frames.inverses
        found = [AxisEdges(np.zeros(0, np.int64), np.zeros(0), np.zeros(0))]
        for bit, other, positions in zip(frames.bits, reference, self.edges_px, strict=True):
            if len(positions) == 0:
                continue
            value = sample_image(bit, points_px) - sample_image(other, points_px)
            index, share = find_crossings(points_px, ends, value)
            expected = approximate[index] + share * (approximate[index + 1] - approximate[index])
            known = np.isfinite(expected)
            index, share, expected = index[known], share[known], expected[known]
            above = np.clip(np.searchsorted(positions, expected), 1, max(len(positions) - 1, 1))
            low, high = positions[above - 1], positions[np.minimum(above, len(positions) - 1)]
            nearest = np.where(np.abs(low - expected) <= np.abs(high - expected), low, high)
            found.append(AxisEdges(index, share, nearest))
        return AxisEdges(*(np.concatenate(each) for each in zip(*found, strict=True)))


def find_crossings(
    points_px: FloatArray, ends: NDArray[np.bool_], value: FloatArray
) -> tuple[NDArray[np.int64], FloatArray]:
    """Find where a value along stripes changes its sign: index of the point before, (n,), and share of the way to the
    next point, (n,) from 0 to 1.

    points_px : (N, 2); ends : (N,) bool, True where the next point is not a neighbour; value : (N,). Two points on
    either side have to agree. The root is that of the straight line between two points, corrected by the second
    differences around them.
    """
    ends = ends.copy()
    ends[:-1] |= np.linalg.norm(np.diff(points_px, axis=0), axis=1) > _MAX_SPACING_PX
    inner = ~(ends[:-3] | ends[1:-2] | ends[2:-1])
    before, a, b, after = value[:-3], value[1:-2], value[2:-1], value[3:]
    at = np.flatnonzero(inner & (a * b < 0) & (before * a > 0) & (b * after > 0))
    before, a, b, after = (each[at] for each in (before, a, b, after))
    share = a / (a - b)
    second = (before - 2 * a + b) * (1 - share) + (a - 2 * b + after) * share
    return at + 1, np.clip(share + second / 2 * share * (1 - share) / (b - a), 0, 1)


def decode_second_axis(
    frames: AxisFrames, noise: NoiseModel, tables: CodeTables, limits: DecodingLimits, /
) -> SecondAxis:
    """Decode the projector position of each pixel along the axis of `frames`, which are in proportion to light."""
    given = frames, noise, tables.index_of_word, len(tables.cell_position), limits
    if frames.sine_patterns:
        found = decode_sinusoids(frames, noise, tables.index_of_word, tables.extent_px, limits)
        positions = AxisPositions(*found.measured)
    elif has_phase(frames):
        positions = AxisPositions(*position_map(frames, noise, decode(*given), tables.cell_position))
    else:
        code, unread = decode_edges(*given)
        position, _ = position_map(frames, noise, code, tables.cell_position, by_phase=False)
        position[unread > _MAX_UNREAD] = np.nan
        cells = (code.highest - code.lowest + 1).astype(np.float32) * np.exp2(unread, dtype=np.float32)
        cells[np.isnan(position)] = np.nan
        positions = AxisPositions(position, np.float32(frames.gray.cell_px * _UNIFORM) * cells)
    table = tables.position_table if tables.edge_table is None else tables.edge_table
    return SecondAxis(frames, positions, tuple(np.unique(each[np.isfinite(each)]) for each in table))


@dataclass(frozen=True, slots=True)
class AxisResiduals:
    """Difference of the second axis from the calibration's prediction at each triangulated point of a camera.

    residual_px : (n,) float64, measured minus predicted position along the light sheet, projector px, NaN where the
    second code is not read; sigma_px : (n,) float64, its standard deviation by noise and resolution.
    """

    residual_px: FloatArray
    sigma_px: FloatArray

    def contradicted(self, systematic_px: float = 0.0) -> NDArray[np.bool_]:
        """(n,) bool: points whose light came from another place than that of their column.

        systematic_px : error of the calibration to allow for.
        """
        limit = systematic_px + np.maximum(_MIN_LIMIT_PX, _MAX_SIGMA * self.sigma_px)
        return np.asarray(np.abs(self.residual_px) > limit)


def axis_residuals(curves: SheetCurves, second: AxisPositions, projector: Pinhole, along: int) -> AxisResiduals:
    """Compare each point with the second axis. along : coordinate of that axis in the projector, 0 column, 1 row."""
    position, sigma = second.sample(curves.pixels_px)
    moved = project(projector, curves.points_mm + curves.deviation_mm)[:, along] - curves.along_px
    return AxisResiduals(position - curves.along_px, np.hypot(sigma, moved))
