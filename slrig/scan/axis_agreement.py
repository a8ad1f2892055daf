"""Test of a scan's calibration by the axis of light that it is not triangulated by.

Where both axes were played, each pixel has one equation more than its point needs. A calibration that these equations
refute gives no mesh, and the likeliest cause is named. Smaller errors are reported and added to the standard
deviations, and points whose light came from elsewhere are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.model import Axis, FloatArray, Pinhole, Refusal
from slrig.reconstruction import (
    CalibrationCheck,
    MergedCurves,
    SheetCurves,
    axis_residuals,
    check_calibration,
    select_points,
)
from slrig.scan.stream import CameraResult

_MAX_OVER_STATED = 3.0  # of the error found over the one stated, before it is said
_MIN_CONTRADICTED = 0.002  # share of the points, before it is said


@dataclass(frozen=True, slots=True)
class AxisAgreement:
    """What the second axis says of each camera: its check, or None where the axis was not played or shows too little.

    notes : of cameras that were left out.
    """

    axis: Axis
    checks: Mapping[str, CalibrationCheck | None]
    notes: tuple[str, ...] = ()


def check_cameras(
    folder: Path, cameras: Sequence[CameraResult], projector: Pinhole | None, axis: Axis
) -> tuple[list[CameraResult], AxisAgreement]:
    """Test the calibration of each camera by the other axis; leave out cameras that it refutes if others agree.

    axis : the one to triangulate by.

    Raises
    ------
    CalibrationError
        The second axis refutes the calibration of every camera.
    """
    checks: dict[str, CalibrationCheck | None] = {}
    for each in cameras:
        second = each.second
        checks[each.name] = (
            None
            if second is None or projector is None
            else check_calibration(each.device, projector, second.pairs, second.codes)
        )
    refuted = {name: check for name, check in checks.items() if check is not None and check.is_refuted}
    reasons = [_refutation(name, check, axis) for name, check in refuted.items()]
    remaining = [each for each in cameras if each.name not in refuted]
    if refuted and not remaining:
        raise CalibrationError(f"{folder}: " + "; ".join(reasons))
    notes = tuple(f"{reason}. The camera was left out" for reason in reasons)
    return remaining, AxisAgreement(axis, checks, notes)


def _refutation(name: str, check: CalibrationCheck, axis: Axis) -> str:
    """Say why a calibration is not that of the frames, and what to do."""
    other = axis.other
    where = f"{other}s are {check.median_px:.1f} px (median of {check.pairs} points) from where it puts them"
    if not np.isfinite(check.median_px):
        where = "most rays do not meet in front of the devices, or the lenses cannot have imaged them"
    implied = f", which means that {axis}s are off by {check.coded_error_px:.0f} px" if check.explained else ""
    cause = (
        f"Likeliest cause: {check.cause}. Correct that, or calibrate again"
        if check.cause
        else "No single mistake explains it: use the calibration of this rig, check that frames and patterns belong "
        "together, or calibrate again (slrig calibrate)"
    )
    return f"the calibration contradicts the frames of camera '{name}', which show both axes: {where}{implied}. {cause}"


def leave_out_contradicted(
    camera: CameraResult, curves: SheetCurves, projector: Pinhole, axis: Axis, check: CalibrationCheck | None
) -> tuple[CameraResult, SheetCurves]:
    """Leave out points whose light came from another place than their code says: mirror images, moved objects.

    The camera returned has the residual of each pixel.
    """
    if camera.second is None or camera.second.positions is None or check is None or len(curves.points_mm) == 0:
        return camera, curves
    residuals = axis_residuals(curves, camera.second.positions, projector, 1 if axis is Axis.COLUMN else 0)
    contradicted = residuals.contradicted(3 * check.median_px)
    columns, rows = np.rint(curves.pixels_px).astype(np.intp).T
    residual_px = np.full(camera.curves.refusal.shape, np.nan, dtype=np.float32)
    residual_px[rows, columns] = residuals.residual_px
    refusal = camera.curves.refusal.copy()
    refusal[rows[contradicted], columns[contradicted]] = Refusal.CONTRADICTED
    camera = replace(
        camera,
        curves=replace(camera.curves, refusal=refusal),
        second=replace(camera.second, residual_px=residual_px),
    )
    return camera, select_points(curves, ~contradicted)


@dataclass(frozen=True, slots=True)
class AxisTest:
    """Error of the calibration that the second axis shows, or would not show.

    sigma_mm : (n,) float64, to add to the standard deviation of each point, in squares; notes : for the report.
    result : for `report.sigma_words`, None where nothing was tested.
    """

    sigma_mm: FloatArray
    notes: tuple[str, ...]
    result: str | None


def axis_test(
    agreement: AxisAgreement,
    merged: MergedCurves,
    names: Sequence[str],
    normals: NDArray[np.float32],
    stated_mm: FloatArray,
) -> AxisTest:
    """Compare what the second axis shows with the stated errors; errors beyond three times these are added.

    names : cameras in the order of `merged.camera`; stated_mm : (n,) float64.
    """
    points, added, notes, results = merged.curves.points_mm, np.zeros(len(stated_mm)), [], []
    other = agreement.axis.other
    for index, name in enumerate(names):
        check, own = agreement.checks.get(name), merged.camera == index
        if check is None or not own.any():
            continue
        error = check.error_mm(points[own], normals[own], agreement.axis)
        known = error[np.isfinite(error)]
        typical, stated = float(np.median(known)) if len(known) else 0.0, float(np.nanmedian(stated_mm[own]))
        if not check.is_significant:
            hidden = f"; errors of it below {2 * typical:.2g} mm would not show" if len(known) else ""
            results.append(f"{other}s agree with the calibration to {check.median_px:.2g} px{hidden}")
            continue
        if typical <= _MAX_OVER_STATED * stated:
            results.append(f"{other}s are {check.median_px:.2g} px from where the calibration puts them")
            continue
        added[own] = np.where(np.isfinite(error), error, typical)
        results.append(f"the error of {typical:.2g} mm that {other}s show")
        notes.append(
            f"the {other}s contradict the calibration of camera '{name}': they are {check.median_px:.2f} px (median) "
            f"from where it puts them, so that points are {typical:.3g} mm off (median), {typical / stated:.0f} times "
            f"what is stated. This was added to the standard deviations, in squares; {_motion(check)}calibrate again"
        )
    return AxisTest(added, tuple(notes), "; ".join(results) or None)


def _motion(check: CalibrationCheck) -> str:
    """The motion of the projector that explains the residuals, for a note."""
    fit = check.explained
    if fit is None:
        return ""
    return (
        f"a projector turned by {fit.turned_deg:.2f}° and shifted by {fit.shifted_mm:.1f} mm relative to the camera "
        f"would agree to {fit.residual_px:.2f} px: "
    )


def agreement_report(agreement: AxisAgreement) -> dict[str, object]:
    """The report's section on the second axis, for each camera; null with a reason where it says nothing."""
    if all(each is None for each in agreement.checks.values()):
        return {"second_axis": None, "second_axis_absent": "one axis was played, or too few points show both"}
    return {
        "second_axis": {
            name: None
            if check is None
            else {
                "points": check.pairs,
                "median_px": check.median_px,
                "systematic_px": check.systematic_px,
                "implied_error_px": check.coded_error_px,
                "implied_error_sigma_px": None if check.explained is None else check.explained.coded_sigma_px,
            }
            for name, check in agreement.checks.items()
        }
    }
