"""The least scatter with which anybody can locate the light of a rendered scene: its Cramér-Rao bound.

The light is moved across the stripe by a node of its table to either side, and the scene rendered each time without
noise. The images' difference is what a displaced stripe changes, and the sensor's own noise says how well that can be
told. No formula of any reconstruction enters: only the renderer, the sensor and the true projector coordinates.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from simulated_rig.light import NODES_PER_PX, Float32Array, LightTable, Response, light_table
from simulated_rig.rendering import CameraView, SensorModel
from slrig.model import FloatArray, IntArray, Pixels, Size

_STEP_PX = 1.0 / NODES_PER_PX
_LEAST_SIDE_PX = 2
_SINGULAR = 1e-9  # least eigenvalue of a Fisher matrix of unit diagonal that can be inverted
_QUANTISATION_VARIANCE = 1.0 / 12.0
_WHITE = np.full((1, 1), 255, np.uint8)
_BLACK = np.zeros((1, 1), np.uint8)


@dataclass(frozen=True)
class ExposedView:
    """One camera's view of a scene, the projector that lights it, and how the sensor is exposed."""

    view: CameraView
    projector: Size
    response: Response
    sensor: SensorModel
    exposure_s: float
    gain: float = 1.0

    def electrons(self, profile: Pixels, *, moved_nodes: int = 0) -> Float32Array:
        """(H, W) float32: expected electrons under a pattern, moved by whole nodes of its light table.

        profile : (1, Wp), (Hp, 1) or (1, 1) uint8. A node is 1 / NODES_PER_PX projector columns.
        """
        table = _moved(light_table(profile, self.projector, self.response), moved_nodes)
        return self.sensor.electrons(self.view.image([(1.0, table)]), self.exposure_s)

    def frame(self, profile: Pixels, rng: np.random.Generator) -> Pixels:
        """(H, W) uint8 or uint16: one noisy frame of a pattern."""
        return self.sensor.read_out(self.electrons(profile), gain=self.gain, rng=rng)

    def variance_e2(self, electrons: FloatArray) -> FloatArray:
        """Variance of a sample in electrons², same shape: shot, read, rounding. Infinite where the sample is clipped.

        s² = read² + I + (1/12) (electrons per digital number)².
        """
        per_dn = 1.0 / self.sensor.dn_per_electron(self.gain)
        highest = min(self.sensor.full_well_e, (self.sensor.full_scale - self.sensor.pedestal_dn) * per_dn)
        variance = electrons + self.sensor.read_noise_e**2 + _QUANTISATION_VARIANCE * per_dn**2
        return np.asarray(np.where(electrons < highest, variance, np.inf), np.float64)

    @cached_property
    def ends(self) -> tuple[FloatArray, FloatArray]:
        """Expected electrons under white and under black, (H, W) float64 each."""
        return self.electrons(_WHITE).astype(np.float64), self.electrons(_BLACK).astype(np.float64)


@dataclass(frozen=True, slots=True)
class StripeBound:
    """The bound at every crossing of a stripe with an image row, n of them.

    row : (n,) int32; column_px : (n,) float64, where the pixel row crosses the line's centre, by the true map.
    line_px : (n,) float64, the line's projector column; tilt_cosine : (n,) float64, 1 for a stripe along the columns.
    width_px : (n,) float64, standard deviation of the stripe's own cross-section, across it.
    snr : (n,) float64, height of the stripe's brightest pixel above black over the noise there.
    row_px : (n,) float64, least standard deviation across the stripe from this image row alone, with the stripe's
    height, background and width unknown; row_known_px : the same with all three known.
    """

    row: IntArray
    column_px: FloatArray
    line_px: FloatArray
    tilt_cosine: FloatArray
    width_px: FloatArray
    snr: FloatArray
    row_px: FloatArray
    row_known_px: FloatArray

    def averaged_px(self, smoothing_px: float) -> FloatArray:
        """(n,) float64: the bound over the stretch of stripe that a Gaussian of this standard deviation averages.

        White noise smoothed by a Gaussian has the variance of the mean over 2√π σ of its samples; a stripe that is
        tilted by θ meets cos θ rows per pixel of its length.
        """
        rows = 2.0 * np.sqrt(np.pi) * smoothing_px * self.tilt_cosine
        return np.asarray(self.row_px / np.sqrt(rows), np.float64)


def stripe_bound(exposed: ExposedView, profile: Pixels, lines_px: FloatArray, /) -> StripeBound:
    """State the Cramér-Rao bound of the stripes of one line pattern, per image row; albedo and room light are known.

    The Fisher information of one row about the projector column c of a line is the sum of (∂I/∂c)² / s²(I) over the
    pixels that are nearer to this line than to its neighbours; Rao (1945), Kay, "Fundamentals of Statistical Signal
    Processing I", eq. 3.31. What the noise itself tells by growing with the light is left out: 1 part in 2 I.
    From columns to camera pixels across the stripe leads the gradient of the true map, |∇c|.

    Parameters
    ----------
    profile
        (1, Wp) uint8, the line pattern.
    lines_px
        (m,) float64, ascending: the centres of its lines. Bounds come for these; a line cut by the border is left out
        by not naming it.

    Returns
    -------
    StripeBound
        Crossings beside a shadow, a depth step or the image's border are left out. Clipped samples tell nothing.
    """
    mean, per_column = _light_and_change(exposed, profile)
    _, black = exposed.ends
    variance = exposed.variance_e2(mean)
    own = mean - black
    column = exposed.view.truth().projector_px[..., 0]
    pixels = _Own.of(column, np.asarray(lines_px, np.float64))
    noise = variance[pixels.rows, pixels.columns]
    # What displacement, the light of the stripe, a uniform background and a stretch about the centre change.
    changes = [each[pixels.rows, pixels.columns] for each in (per_column, own, np.ones_like(mean))]
    changes.append(changes[0] * pixels.off_centre)
    fisher = np.zeros((pixels.count, len(changes), len(changes)))
    for i, j in np.ndindex(fisher.shape[1:]):
        fisher[:, i, j] = pixels.summed(changes[i] * changes[j] / noise)
    along_c, known_c = _deviations(fisher)
    slope_x, slope_y = pixels.slopes(column)
    steepness = np.hypot(slope_x, slope_y)
    height = np.maximum(own[pixels.rows, pixels.columns], 0.0)
    snr = np.zeros(pixels.count)
    np.maximum.at(snr, pixels.run, height / np.sqrt(noise))
    total, first, second = (pixels.summed(height * pixels.off_centre**power) for power in range(3))
    with np.errstate(invalid="ignore", divide="ignore"):
        spread = np.sqrt(second / total - (first / total) ** 2)
    kept = np.isfinite(along_c) & np.isfinite(steepness) & pixels.whole
    return StripeBound(
        row=pixels.row[kept].astype(np.int32),
        column_px=pixels.column_px[kept],
        line_px=pixels.line_px[kept],
        tilt_cosine=(np.abs(slope_x) / steepness)[kept],
        width_px=(spread / steepness)[kept],
        snr=snr[kept],
        row_px=(along_c / steepness)[kept],
        row_known_px=(known_c / steepness)[kept],
    )


def _moved(table: LightTable, nodes: int) -> LightTable:
    """The pattern's light `nodes` nodes farther along the columns. What moves in has the light of the border."""
    if nodes == 0:
        return table
    fill = np.full(abs(nodes), table.columns[0 if nodes > 0 else -1], np.float32)
    columns = [fill, table.columns[:-nodes]] if nodes > 0 else [table.columns[-nodes:], fill]
    return replace(table, columns=np.concatenate(columns))


@dataclass(frozen=True, slots=True)
class _Own:
    """The pixels that belong to stripes, in runs: one run is one image row's pixels of one line.

    rows, columns, run : (p,) of each pixel; off_centre : (p,) its true column minus the line's.
    row, line_px, column_px, whole : (count,) of each run; whole, whether its pixels reach far enough to both sides.
    """

    rows: NDArray[np.intp]
    columns: NDArray[np.intp]
    run: NDArray[np.intp]
    off_centre: FloatArray
    row: NDArray[np.intp]
    line_px: FloatArray
    column_px: FloatArray
    whole: NDArray[np.bool_]

    @property
    def count(self) -> int:
        return len(self.row)

    def summed(self, values: FloatArray) -> FloatArray:
        """(count,) float64: the sum of a value per pixel over each run."""
        return np.asarray(np.bincount(self.run, values, minlength=self.count), np.float64)

    def slopes(self, column: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Projector columns per pixel along x and along y at each run's crossing, (count,) float64 each."""
        at = np.clip(np.rint(self.column_px).astype(np.intp), 1, column.shape[1] - 2)
        row = np.clip(self.row, 1, column.shape[0] - 2)
        along = (column[row, at + 1] - column[row, at - 1]) / 2
        down = (column[row + 1, at] - column[row - 1, at]) / 2
        return along, down

    @classmethod
    def of(cls, column: FloatArray, lines_px: FloatArray) -> _Own:
        """Divide the pixels among the lines. column : (H, W) float64, NaN in shadow."""
        known = np.isfinite(column)
        nearest = np.searchsorted((lines_px[1:] + lines_px[:-1]) / 2, np.where(known, column, lines_px[0]))
        off = column - lines_px[nearest]
        label = np.where(known, nearest, -1)
        begins = np.ones(label.shape, np.bool_)
        begins[:, 1:] = label[:, 1:] != label[:, :-1]
        run_of = np.cumsum(begins).reshape(label.shape) - 1
        # The run's crossing: between the two neighbours of which one lies on either side of the line.
        crosses = np.zeros(label.shape, np.bool_)
        crosses[:, :-1] = ~begins[:, 1:] & known[:, :-1] & (off[:, :-1] * off[:, 1:] <= 0) & (off[:, :-1] != 0)
        at_row, at_column = np.nonzero(crosses)
        owner = run_of[at_row, at_column]
        # Where a run crosses its line twice the surface folds: neither crossing is a stripe of its own.
        once = np.bincount(owner, minlength=run_of.max() + 1) == 1
        single = once[owner]
        at_row, at_column, owner = at_row[single], at_column[single], owner[single]
        before, after = off[at_row, at_column], off[at_row, at_column + 1]
        number = np.full(len(once), -1, np.intp)
        number[owner] = np.arange(len(owner))
        rows, columns = np.nonzero(known & (number[run_of] >= 0))
        run = number[run_of[rows, columns]]
        crossing = at_column + before / (before - after)
        left, right = (
            np.bincount(run, side, minlength=len(owner))
            for side in (columns < crossing[run] - 0.5, columns > crossing[run] + 0.5)
        )
        return cls(
            rows=rows,
            columns=columns,
            run=run,
            off_centre=off[rows, columns],
            row=at_row,
            line_px=lines_px[nearest[at_row, at_column]],
            column_px=crossing,
            whole=(left >= _LEAST_SIDE_PX) & (right >= _LEAST_SIDE_PX),
        )


def _light_and_change(exposed: ExposedView, profile: Pixels) -> tuple[FloatArray, FloatArray]:
    """Expected electrons under a pattern, and what they change by per projector column that it moves."""
    behind, mean, ahead = (exposed.electrons(profile, moved_nodes=nodes).astype(np.float64) for nodes in (-1, 0, 1))
    return mean, (ahead - behind) / (2.0 * _STEP_PX)


def _deviations(fisher: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least deviations of the first of several unknowns, (n,) each: the others unknown, and known.

    fisher : (n, m, m) float64, scaled to a unit diagonal before it is inverted. NaN where it is singular.
    """
    both = np.full((2, len(fisher)), np.nan)
    diagonal = np.sqrt(np.einsum("nii->ni", fisher))
    usable = (diagonal > 0).all(axis=1)
    scale = diagonal[usable]
    scaled = fisher[usable] / (scale[:, :, None] * scale[:, None, :])
    told = np.linalg.eigvalsh(scaled)[:, 0] > _SINGULAR
    where = np.nonzero(usable)[0][told]
    both[0, where] = np.sqrt(np.linalg.inv(scaled[told])[:, 0, 0]) / scale[told, 0]
    both[1, where] = 1.0 / scale[told, 0]
    return both[0], both[1]
