"""Stripe centres of rendered scenes against the Cramér-Rao bound: what the tests of the stripe limit measure.

Each scene is rendered once without noise. Many noisy captures of it walk through the same rooms as a scan's frames
(white and black twice, Gray code with inverses, line shift), and every point that comes out is compared with the line's
true projector column at the point's own sub-pixel position, traced by the renderer. Points that the reconstruction
refuses, beside shadows and borders, are left out as a scan leaves them out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from simulated_rig import transport
from simulated_rig.options import SimulatedCameraOptions, SimulatedProjectorOptions
from simulated_rig.rendering import CameraView, SceneState
from simulated_rig.scene import Scene, build_surface
from slrig.model import Axis, CameraFormat, Capture, FloatArray, Gray, LineShift, PatternSequence, Shot
from slrig.patterns.codes import cell_positions, index_of_word, line_positions
from slrig.patterns.sequence import encode, scan_patterns
from slrig.reconstruction.decoded_image import CodeTables, ReconstructionLimits
from slrig.reconstruction.frames import axis_frames
from slrig.reconstruction.pipeline import CameraCurves, camera_curves
from tests.light_bound import ExposedView, stripe_bound
from tests.unit.reconstruction.builders import rms

PLANE: Mapping[str, object] = {"shape": "plane", "size_mm": [240.0, 240.0], "rotation_deg": [8.0, -12.0, 0.0]}
SPHERE: Mapping[str, object] = {"shape": "sphere", "radius_mm": 60.0, "position_mm": [0.0, 0.0, 40.0]}
SHARP_PX, SOFT_PX = 0.6, 0.9

_WHITE_LEVEL = 0.8
_FINEST_SMOOTHING_PX = 1.0


@dataclass(frozen=True)
class Rig:
    """A rendered camera and projector before one scene, and what the projector shows."""

    camera: SimulatedCameraOptions
    projector: SimulatedProjectorOptions
    stage: SceneState
    view: CameraView
    sequence: PatternSequence

    def exposed(self, exposure_s: float, gain: float) -> ExposedView:
        """Return the view at an exposure."""
        projector = self.projector
        return ExposedView(self.view, projector.size, projector.response(), self.camera.sensor(), exposure_s, gain)

    def lines(self) -> list[tuple[int, FloatArray]]:
        """Index of each line pattern, and the centres of its lines, which are one column wide."""
        columns = self.projector.size.width_px
        return [
            (index, np.arange(pattern.centre_px, columns, pattern.period_px))
            for index, pattern in enumerate(self.sequence.patterns)
            if isinstance(pattern, LineShift)
        ]

    def columns_at(self, points_px: FloatArray) -> FloatArray:
        """(n,) float64: true projector columns at camera positions (x, y), (n, 2) float64."""
        stage, (u, v) = self.stage, points_px.T.copy()
        return transport.trace_rays(
            u, v, self.camera.pinhole(), stage.projector, stage.surface, stage.rays,
            working_distance_mm=stage.working_distance_mm,
        ).column_px  # fmt: skip


def rig(thing: Mapping[str, object], *, size_px: tuple[int, int], blur_px: float, columns: int = 512) -> Rig:
    """Return a rig like those in `slrig/examples/rigs`, whose projector lights all that the camera sees of `thing`.

    blur_px : of both lenses; columns : of the projector. The sensor reads 8 bits, 30 000 electrons deep, above a
    pedestal that keeps its noise.
    """
    lamp = SimulatedProjectorOptions.model_validate({
        "size_px": [columns, 384], "focal_px": [2200.0, 2202.2], "distortion": [0.03, -0.02, 0.0003, 0.0, 0.0],
        "position_mm": [105.0, -10.0, -590.0], "target_mm": [0.0, 0.0, 0.0], "blur_px": blur_px,
    })  # fmt: skip
    eye = SimulatedCameraOptions.model_validate({
        "name": "eye", "size_px": list(size_px), "focal_px": [1900.0, 1901.9], "saturation_s": 0.02,
        "distortion": [-0.11, 0.15, -0.0003, 0.0005, 0.0], "position_mm": [-150.0, -12.0, -560.0],
        "target_mm": [0.0, 0.0, 0.0], "blur_px": blur_px, "full_well_e": 30000.0, "pedestal_dn": 8.0,
    })  # fmt: skip
    scene = Scene.model_validate({"object": [{**thing, "albedo": 0.8}]})
    stage = SceneState(build_surface(scene, Path()), lamp.pinhole(), working_distance_mm=600.0)
    view = CameraView(
        eye.pinhole(), stage, blur_px=eye.blur_px, ambient=0.01, samples_per_axis=4, jitter=False, seed=1, workers=2
    )
    patterns = scan_patterns(
        lamp.size, line_shift=True, period_px=8, line_width_px=1, gray_cell_px=None, gray_offset_px=0, rows=False
    )
    return Rig(eye, lamp, stage, view, encode(patterns, lamp.size))


def exposed_at_snr(rig: Rig, snr: float) -> ExposedView:
    """Return the view exposed so that the median stripe stands `snr` times its own noise above black.

    The gain lifts white to four fifths of full scale at every exposure, as an operator sets it.
    """
    index, lines = rig.lines()[0]
    white_e = float(np.percentile(rig.exposed(1.0, 1.0).ends[0], 99.5))
    longest_s = _WHITE_LEVEL * rig.camera.full_well_e / white_e

    def exposed(exposure_s: float) -> ExposedView:
        return rig.exposed(exposure_s, longest_s / exposure_s)

    def excess(exposure_s: float) -> float:
        return float(np.median(stripe_bound(exposed(exposure_s), rig.sequence.profiles[index], lines).snr)) - snr

    return exposed(float(brentq(excess, 0.005 * longest_s, longest_s, rtol=1e-3)))


@dataclass(frozen=True)
class Points:
    """Every point of several captures that has a bound, n of them; a cell is one line in one image row.

    error_px : (n,) float64, from the true line, across it, towards rising columns; cell : (n,) its cell.
    stated_px : (n,) the deviation that the reconstruction states.
    snr, bound_px : (n,) of the stripe there: its signal to noise, and its bound averaged along the stripe.
    """

    error_px: FloatArray
    cell: NDArray[np.intp]
    stated_px: FloatArray
    snr: FloatArray
    bound_px: FloatArray

    @property
    def _mean_px(self) -> FloatArray:
        count = np.bincount(self.cell)
        return (np.bincount(self.cell, self.error_px) / np.maximum(count, 1))[self.cell]

    @property
    def _freedom(self) -> FloatArray:
        # A point's distance from its cell's mean has (count - 1)/count of the variance.
        count = np.bincount(self.cell)[self.cell]
        return np.asarray((count - 1) / count)

    @property
    def scatter_px(self) -> FloatArray:
        """(m,) float64: errors without the mean of their cell, of full variance; cells of one point are left out."""
        freedom = self._freedom
        several = freedom > 0
        return (self.error_px - self._mean_px)[several] / np.sqrt(freedom[several])

    @property
    def bias_rms_px(self) -> float:
        """What stays of the error when noise is averaged out, rms over the cells."""
        left = float(np.mean(self._mean_px**2) - np.mean(self.scatter_px**2) * np.mean(1.0 - self._freedom))
        return math.sqrt(max(left, 0.0))

    @property
    def ratio(self) -> float:
        """Rms of the error over its bound: of the line frame alone, averaged along the stripe."""
        return rms(self.error_px / self.bound_px)


def measured(rig: Rig, exposed: ExposedView, *, captures: int, seed: int = 1) -> Points:
    """Reconstruct noisy captures of one scene, and find the error and the bound of every point."""
    rows = rig.camera.size.height_px
    bounds = _bounds(rig, exposed)
    means = [exposed.electrons(profile) for profile in rig.sequence.profiles]
    rng = np.random.default_rng(seed)
    errors, stated, cells = [], [], []
    for _ in range(captures):
        curves = _curves(rig, exposed, means, rng)
        points = curves.ensemble.points_px
        line = np.repeat(curves.ensemble.position_px, np.diff(curves.ensemble.offsets))
        errors.append(_errors_px(rig, points, line))
        cells.append(np.rint(line).astype(np.intp) * rows + np.rint(points[:, 1]).astype(np.intp))
        stated.append(curves.ensemble.sigma_px)
    error, cell, deviation = np.concatenate(errors), np.concatenate(cells), np.concatenate(stated)
    known = np.isfinite(error) & np.isfinite(bounds["bound_px"][cell])
    error, cell, deviation = error[known], cell[known], deviation[known]
    return Points(error, cell, deviation, bounds["snr"][cell], bounds["bound_px"][cell])


def _errors_px(rig: Rig, points_px: FloatArray, line_px: FloatArray) -> FloatArray:
    """(n,) float64: distance of points from their true lines, px."""
    here, right, left, below, above = (
        rig.columns_at(points_px + np.array(step)) for step in ((0, 0), (0.25, 0), (-0.25, 0), (0, 0.25), (0, -0.25))
    )
    return np.asarray((here - line_px) / (2.0 * np.hypot(right - left, below - above)))


def _curves(rig: Rig, exposed: ExposedView, means: list[NDArray[np.float32]], rng: np.random.Generator) -> CameraCurves:
    """The camera's curves from one noisy capture of frames whose expected electrons are given."""
    sequence = rig.sequence
    shots = tuple(
        Shot(index, "eye", exposed.sensor.read_out(mean, gain=exposed.gain, rng=rng))
        for index, mean in enumerate(means)
    )
    camera = CameraFormat(rig.camera.size, rig.camera.bit_depth)
    frames = axis_frames(Capture(sequence.projector, sequence.patterns, {"eye": camera}, shots), "eye", Axis.COLUMN)
    gray = next(pattern for pattern in sequence.patterns if isinstance(pattern, Gray))
    tables = CodeTables(
        index_of_word(gray),
        cell_positions(gray, sequence.projector),
        line_positions(frames.line_patterns, gray, sequence.projector),
    )
    return camera_curves(frames, tables, ReconstructionLimits(), report_step=lambda _stage: None)


def _bounds(rig: Rig, exposed: ExposedView) -> dict[str, FloatArray]:
    """What is known of each cell, (lines * rows,) float64, by name; NaN where there is no stripe."""
    rows, columns = rig.camera.size.height_px, rig.projector.size.width_px
    known = {name: np.full(rows * columns, np.nan) for name in ("snr", "bound_px")}
    stripes = [stripe_bound(exposed, rig.sequence.profiles[index], lines) for index, lines in rig.lines()]
    width_px = float(np.median(np.concatenate([each.width_px for each in stripes])))
    for each in stripes:
        at = np.rint(each.line_px).astype(np.intp) * rows + each.row
        known["snr"][at] = each.snr
        known["bound_px"][at] = each.averaged_px(max(width_px, _FINEST_SMOOTHING_PX))
    return known
