"""What is left at each device, for people: figures, by pose, and maps over its image."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.solution import CELLS, DeviceResiduals
from slrig.calibration.solving.adjustment import kept_of
from slrig.calibration.solving.deviations import deviations_of
from slrig.calibration.solving.problem import Fit, Problem
from slrig.calibration.solving.projection import match_rows
from slrig.model import FloatArray, IntArray, Size


def residuals_of_devices(
    problem: Problem, fit: Fit, sizes: dict[str, Size], held_out_px: dict[str, float], /
) -> dict[str, DeviceResiduals]:
    """By device; see `slrig.calibration.solution.DeviceResiduals`."""
    m = problem.measurements
    sigma = deviations_of(m, fit.noise, problem.with_projector)
    kept = kept_of(fit.residuals, sigma)
    found = {}
    for device, name in enumerate(problem.devices):
        held = held_out_px.get(name, np.nan)
        if problem.with_projector and device == len(problem.devices) - 1:
            good = kept[1] > 0
            vectors = np.full((len(m.match_px), 2), np.nan)
            axis = m.match_where[:, 2]
            vectors[np.arange(len(axis)), axis] = fit.residuals.matches
            places = np.column_stack([_shown(problem, fit, 0), _shown(problem, fit, 1)])
            found[name] = _summed(
                problem, places, vectors, m.match_sigma**2, m.match_where[:, 1], good, sizes[name], held
            )
        else:
            mine = m.corner_where[:, 0] == device
            good = kept[0][mine] > 0
            found[name] = _summed(
                problem, m.corner_px[mine], fit.residuals.corners[mine], 2 * m.corner_sigma[mine] ** 2,
                m.corner_where[mine, 1], good, sizes[name], held,
            )  # fmt: skip
    return found


def _shown(problem: Problem, fit: Fit, axis: int) -> FloatArray:
    """(k,) float64: the projector coordinate that each lit pixel should show."""
    m, geometry = problem.measurements, fit.geometry
    where = m.match_where.copy()
    where[:, 2] = axis
    return match_rows(
        geometry.devices, geometry.poses, geometry.bend, geometry.frame, where, m.match_pixel,
        np.zeros_like(m.match_px), jacobian=False,
    )[0]  # fmt: skip


def _summed(
    problem: Problem, places: FloatArray, vectors: FloatArray, variance: FloatArray, pose: IntArray,
    good: NDArray[np.bool_], size: Size, held_out_px: float,
) -> DeviceResiduals:  # fmt: skip
    square = np.nansum(vectors**2, axis=1)
    by_pose = {
        problem.pose_names[number]: float(np.sqrt(np.mean(square[good & (pose == number)])))
        for number in np.unique(pose[good])
    }
    rms = np.full((CELLS, CELLS), np.nan)
    mean = np.full((CELLS, CELLS, 2), np.nan)
    count = np.zeros((CELLS, CELLS), dtype=np.int32)
    extent = np.array([size.width_px, size.height_px])
    cell = np.clip((np.nan_to_num(places) + 0.5) / extent * CELLS, 0, CELLS - 1).astype(np.int32)
    for y in range(CELLS):
        for x in range(CELLS):
            here = good & (cell[:, 0] == x) & (cell[:, 1] == y)
            count[y, x] = here.sum()
            if count[y, x]:
                rms[y, x] = np.sqrt(np.mean(square[here]))
                for axis in (0, 1):
                    values = vectors[here, axis]
                    if np.isfinite(values).any():
                        mean[y, x, axis] = np.nanmean(values)
    return DeviceResiduals(
        rms_px=float(np.sqrt(np.mean(square[good]))) if good.any() else np.nan,
        stated_rms_px=float(np.sqrt(np.mean(variance[good]))) if good.any() else np.nan,
        held_out_rms_px=held_out_px,
        count=int(good.sum()),
        outlying=int((~good).sum()),
        pose_rms_px=by_pose,
        map_rms_px=rms,
        map_mean_px=mean,
        map_count=count,
    )
