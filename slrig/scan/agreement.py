"""Tests of a scan's calibration by equations that its points do not need: the second axis of light, further cameras.

A calibration that these equations refute gives no mesh, and the likeliest cause is named. Smaller errors are reported
and added to the standard deviations, and points whose light came from elsewhere are left out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slrig.errors import CalibrationError
from slrig.model import DEVICE_PARAMETERS, Axis, Calibration, FloatArray, Pinhole, Refusal, SolveRecord
from slrig.reconstruction import (
    MAX_SHIFT,
    MAX_TURN_DEG,
    OUTLIER_SIGMA,
    CalibrationCheck,
    DeviceNames,
    MergedCurves,
    PairRedundancy,
    PixelPairs,
    Redundancy,
    RefinedPose,
    SheetCurves,
    StripeEnsemble,
    axis_residuals,
    cell_medians,
    cell_numbers,
    check_calibration,
    evaluate_redundancy,
    find_camera_pairs,
    intersect_light_sheets,
    merge_curves,
    noise_px,
    read_pairs,
    refine_pose,
    select_points,
    sheet_coordinates,
    triangulate_camera_projector,
)
from slrig.scan.stream import CameraResult, SecondAxisResult

_MAX_OVER_STATED = 3.0  # of the error found over the one stated, before it is said
_MIN_CONTRADICTED = 0.002  # share of the points, before it is said


@dataclass(frozen=True, slots=True)
class AxisAgreement:
    """What the second axis says of each camera: its check, or None where the axis was not played or shows too little.

    partners : without a projector's calibration, the camera that each one was tested with. notes : of cameras that were
    left out.
    """

    axis: Axis
    checks: Mapping[str, CalibrationCheck | None]
    notes: tuple[str, ...] = ()
    partners: Mapping[str, str] = field(default_factory=dict)

    def tested(self, name: str) -> str:
        """The devices of a check, in a sentence."""
        partner = self.partners.get(name)
        return f"camera '{name}'" if partner is None else f"cameras '{name}' and '{partner}'"

    def compared(self, name: str) -> str:
        """What a check compares with the calibration."""
        return f"{self.axis.other}s" if name not in self.partners else "pixels that show the same column and row"


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
    if projector is None:
        return list(cameras), _check_pairs(folder, cameras, axis)
    checks: dict[str, CalibrationCheck | None] = {}
    for each in cameras:
        second = each.second
        checks[each.name] = (
            None if second is None else check_calibration(each.device, projector, second.pairs, second.codes)
        )
    refuted = {name: check for name, check in checks.items() if check is not None and check.is_refuted}
    reasons = [_refutation(AxisAgreement(axis, checks), name, check) for name, check in refuted.items()]
    remaining = [each for each in cameras if each.name not in refuted]
    if refuted and not remaining:
        raise CalibrationError(f"{folder}: " + "; ".join(reasons))
    notes = tuple(f"{reason}. The camera was left out" for reason in reasons)
    return remaining, AxisAgreement(axis, checks, notes)


def _check_pairs(folder: Path, cameras: Sequence[CameraResult], axis: Axis) -> AxisAgreement:
    """Test cameras by one another: pixels that show one projector pixel are on each other's epipolar lines.

    The projector needs no calibration for that. Raises CalibrationError if a pair is refuted.
    """
    checks: dict[str, CalibrationCheck | None] = {each.name: None for each in cameras}
    partners: dict[str, str] = {}
    coded = [(each, each.second) for each in cameras if each.second is not None]
    for (one, pixels), (other, looked_up) in combinations(coded, 2):
        pairs = find_camera_pairs(pixels.pairs, _all_pairs(other, looked_up), (one.device, other.device))
        names = DeviceNames.of_cameras(one.name, other.name)
        check = check_calibration(one.device, other.device, pairs, (), names=names)
        earlier = checks[one.name]
        if check is not None and (earlier is None or check.median_px > earlier.median_px):
            checks[one.name], partners[one.name] = check, other.name
    agreement = AxisAgreement(axis, checks, partners=partners)
    refuted = {name: check for name, check in checks.items() if check is not None and check.is_refuted}
    if refuted:
        reasons = [_refutation(agreement, name, check) for name, check in refuted.items()]
        raise CalibrationError(f"{folder}: " + "; ".join(reasons))
    return agreement


def _all_pairs(camera: CameraResult, second: SecondAxisResult) -> PixelPairs:
    """Camera and projector pixels at all points of the stripes, or where they cross code edges if all that is read."""
    if not second.is_dense or second.positions is None:
        return second.pairs
    return read_pairs(camera.curves.ensemble, second.positions, second.pairs.axis)


def _refutation(agreement: AxisAgreement, name: str, check: CalibrationCheck) -> str:
    """Say why a calibration is not that of the frames, and what to do."""
    axis = agreement.axis
    distance = f"{check.median_px:.1f} px (median of {check.pairs} points)"
    where = f"{agreement.compared(name)} are {distance} from where it puts them"
    if not np.isfinite(check.median_px):
        where = "most rays do not meet in front of the devices, or the lenses cannot have imaged them"
    coded = f"pixels of camera '{agreement.partners[name]}'" if name in agreement.partners else f"{axis}s"
    implied = f", which means that {coded} are off by {check.coded_error_px:.0f} px" if check.explained else ""
    cause = (
        f"Likeliest cause: {check.cause}. Correct that, or calibrate again"
        if check.cause
        else "No single mistake explains it: use the calibration of this rig, check that frames and patterns belong "
        "together, or calibrate again (slrig calibrate)"
    )
    whose = f"{agreement.tested(name)}, which show both axes"
    return f"the calibration contradicts the frames of {whose}: {where}{implied}. {cause}"


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
        error = check.error_mm(points[own], normals[own])
        compared, partner = agreement.compared(name), agreement.partners.get(name)
        known = error[np.isfinite(error)]
        typical, stated = float(np.median(known)) if len(known) else 0.0, float(np.nanmedian(stated_mm[own]))
        if not check.is_significant:
            hidden = f"; errors of it below {2 * typical:.2g} mm would not show" if len(known) else ""
            results.append(f"{compared} agree with the calibration to {check.median_px:.2g} px{hidden}")
            continue
        if typical <= _MAX_OVER_STATED * stated:
            results.append(f"{compared} are {check.median_px:.2g} px from where the calibration puts them")
            continue
        added[own] = np.where(np.isfinite(error), error, typical)
        results.append(f"the error of {typical:.2g} mm that {other}s show")
        notes.append(
            f"the {other}s contradict the calibration of {agreement.tested(name)}: "
            f"{compared if partner else 'they'} are {check.median_px:.2f} px (median) from where it puts them, so that "
            f"points are {typical:.3g} mm off (median), {typical / stated:.0f} times what is stated. This was added to "
            f"the standard deviations, in squares; {_motion(check, partner)}calibrate again"
        )
    return AxisTest(added, tuple(notes), "; ".join(results) or None)


def _motion(check: CalibrationCheck, partner: str | None) -> str:
    """The motion of the projector, or of the second camera, that explains the residuals, for a note."""
    fit = check.explained
    if fit is None:
        return ""
    device, other = ("a projector", "camera") if partner is None else (f"camera '{partner}'", "other camera")
    return (
        f"{device} turned by {fit.turned_deg:.2f}° and shifted by {fit.shifted_mm:.1f} mm relative to the {other} "
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


_REFUTED_PX = 5.0
_REFUTED_SIGMA, _LENS_PX = 20.0, 1.0  # a lens model may leave up to 1 px, however small the noise is
_MAX_MISFIT = 2.0  # of a pose that explains the contradiction: 1 is noise alone, 2 noise and 2 % of other surfaces
_NOISE_ALONE = 1.2
_SAME_FIT = 1.03  # misfits of two devices in this ratio do not show which of them moved
_SAMPLE = 5000
_ONE_DEVIATION = 68.3  # percent of a normal distribution
_AGREES_SIGMA = 3.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """Devices and cameras to make a surface of.

    calibration : with the pose of a device that was refined. usable : of each camera, whether its points are used.
    redundancy : of the calibration as stated. distance_mm : standard deviation to add to that of every point, in
    squares; pose_error : a calibration that states the covariance of the refined pose alone. notes : sentences for a
    person; report : the decision, for the report, None if the cameras agree.
    """

    calibration: Calibration
    usable: tuple[bool, ...]
    redundancy: Redundancy
    distance_mm: float = 0.0
    pose_error: Calibration | None = None
    notes: tuple[str, ...] = ()
    report: Mapping[str, object] | None = None


@dataclass(frozen=True, slots=True)
class _ScanData:
    """Stripes of every camera, by the devices that a calibration states. usable : cameras that measure depth."""

    names: tuple[str, ...]
    stripes: tuple[StripeEnsemble, ...]
    usable: tuple[bool, ...]
    calibration: Calibration
    projector: Pinhole
    axis: Axis
    gap_px: float

    @property
    def cameras(self) -> list[Pinhole]:
        return [self.calibration.cameras[name] for name in self.names]

    def parts(self) -> list[SheetCurves]:
        triangulated = (
            triangulate_camera_projector(stripes, camera, self.projector, self.axis)[0]
            for stripes, camera in zip(self.stripes, self.cameras, strict=True)
        )
        return [
            select_points(part, np.full(len(part.points_mm), usable))
            for part, usable in zip(triangulated, self.usable, strict=True)
        ]

    def pairs(self, parts: list[SheetCurves]) -> dict[tuple[int, int], PairRedundancy]:
        return _by_index(self.names, self.redundancy(parts))

    def redundancy(self, parts: list[SheetCurves]) -> Redundancy:
        devices = dict(zip(self.names, self.cameras, strict=True))
        return evaluate_redundancy(parts, devices, self.axis, widest_gap_px=self.gap_px, calibration=self.calibration)

    def distance_mm(self, parts: list[SheetCurves], pair: tuple[int, int]) -> float:
        """Distance of the points of two cameras on one projector ray, within which 68 % of them lie: one deviation."""
        merged = merge_curves([parts[k] for k in pair], self.projector.centre_mm, widest_gap_px=self.gap_px)
        return float(np.percentile(np.abs(merged.residual_mm), _ONE_DEVIATION)) if len(merged.residual_mm) else 0.0

    def with_pose(self, refined: RefinedPose) -> _ScanData:
        if refined.device == len(self.names):
            calibration = replace(self.calibration, projector=refined.pose)
            return replace(self, calibration=calibration, projector=refined.pose)
        cameras = {**self.calibration.cameras, self.names[refined.device]: refined.pose}
        return replace(self, calibration=replace(self.calibration, cameras=cameras))

    def device_name(self, index: int) -> str:
        return "the projector" if index == len(self.names) else f"camera '{self.names[index]}'"


@dataclass(frozen=True, slots=True)
class _Trial:
    """A refined pose, and what the cameras say of each other with it."""

    refined: RefinedPose
    scan: _ScanData
    parts: list[SheetCurves]
    pairs: Mapping[tuple[int, int], PairRedundancy]

    def misfit(self, count: int) -> float:
        """Root mean square of the equations over their noise, 12 at most; of `count` equations those that are missing
        count as 12.
        """
        squares = [_capped_squares(pair) for pair in self.pairs.values()]
        missing = max(count - self.count, 0)
        return float(np.sqrt((sum(float(each.sum()) for each in squares) + OUTLIER_SIGMA**2 * missing) / count))

    @property
    def count(self) -> int:
        return sum(len(pair.residuals.residual_px) for pair in self.pairs.values())

    @property
    def agrees(self) -> bool:
        return not any(pair.is_contradicted for pair in self.pairs.values())


def check_agreement(
    names: Sequence[str],
    stripes: Sequence[StripeEnsemble],
    parts: list[SheetCurves],
    calibration: Calibration,
    projector: Pinhole,
    axis: Axis,
    /,
    *,
    widest_gap_px: float,
    second_axis: Mapping[str, float] | None = None,
) -> Agreement:
    """Decide which devices and cameras a surface is made of, by the rule above.

    names, stripes, parts : of each camera, its stripes and its points; without points, a camera is not asked.
    second_axis : of each camera, the robust standard deviation of its residuals in patterns of the other axis as a
    multiple of what is stated; None if the other axis was not played.

    Raises
    ------
    CalibrationError
        The cameras refute the calibration, and nothing shows which one is right.
    """
    usable = tuple(len(part.points_mm) > 0 for part in parts)
    scan = _ScanData(tuple(names), tuple(stripes), usable, calibration, projector, axis, widest_gap_px)
    redundancy = scan.redundancy(parts)
    pairs = _by_index(scan.names, redundancy)
    contradicting = {pair: found for pair, found in pairs.items() if found.is_contradicted}
    if not contradicting:
        scattered = [pair for pair, found in pairs.items() if found.over_stated > _AGREES_SIGMA]
        notes = tuple(_scatter_note(pairs[pair]) for pair in scattered)
        distance_mm = max((_unexplained_mm(scan, parts, pair, pairs[pair]) for pair in scattered), default=0.0)
        return Agreement(calibration, usable, redundancy, distance_mm, notes=notes)
    worst = max(contradicting, key=lambda pair: contradicting[pair].contradiction)
    if (cause := _likely_cause(scan, worst)) is not None:
        raise CalibrationError(f"{_contradiction(pairs[worst])}. {cause}. There is no mesh")
    odd = _odd_camera(pairs, contradicting)
    agreeing = {name for name, ratio in (second_axis or {}).items() if ratio <= _AGREES_SIGMA}
    trials = [
        _Trial(found, moved, moved_parts, moved.pairs(moved_parts))
        for found in _refined_poses(scan, pairs, odd, agreeing)
        for moved in [scan.with_pose(found)]
        for moved_parts in [moved.parts()]
    ]
    count = max((each.count for each in trials), default=0)
    fitting = min(trials, key=lambda each: each.misfit(count), default=None)
    if fitting is not None and fitting.agrees and fitting.refined.is_small and fitting.misfit(count) <= _MAX_MISFIT:
        misfit = fitting.misfit(count)
        # Beside errors of a lens, small differences of the misfit show nothing.
        same = _SAME_FIT * misfit if misfit <= _NOISE_ALONE else _MAX_MISFIT
        rivals = [each for each in trials if each.agrees and each.refined.is_small and each.misfit(count) <= same]
        best = min(rivals, key=lambda each: each.refined.move)
        rivals.remove(best)
        return _with_refined_pose(scan, redundancy, worst, best, rivals)
    return _with_one_camera(scan, parts, redundancy, worst, odd, agreeing)


def _by_index(names: Sequence[str], redundancy: Redundancy) -> dict[tuple[int, int], PairRedundancy]:
    return {(names.index(each.reference), names.index(each.camera)): each for each in redundancy.pairs}


def _capped_squares(pair: PairRedundancy) -> FloatArray:
    """(m,) float64: square of each equation over its noise, 144 at most."""
    median, _ = cell_medians(pair.residuals)
    sigma_px = noise_px(pair.residuals, median, np.hypot(pair.residuals.sigma_px, pair.calibration_px))
    return np.asarray(np.minimum((pair.residuals.residual_px / sigma_px) ** 2, OUTLIER_SIGMA**2))


def _odd_camera(
    pairs: Mapping[tuple[int, int], PairRedundancy], contradicting: Mapping[tuple[int, int], PairRedundancy]
) -> int | None:
    """The camera that contradicts others, while two others at least agree; None if the pairs do not show one."""
    cameras = {index for pair in pairs for index in pair}
    if len(cameras) < 3:
        return None
    found = [
        camera
        for camera in cameras
        if all(camera in pair for pair in contradicting) and any(camera not in pair for pair in pairs)
    ]
    return found[0] if len(found) == 1 else None


def _refined_poses(
    scan: _ScanData,
    pairs: Mapping[tuple[int, int], PairRedundancy],
    odd: int | None,
    agreeing: set[str],
) -> list[RefinedPose]:
    """The refined pose of every device that can have moved."""
    if odd is not None:
        devices = [odd]
    else:
        devices = [k for k, name in enumerate(scan.names) if scan.usable[k] and name not in agreeing]
        # A camera that agrees with both axes of the projector shows that the projector is where it was.
        devices += [] if agreeing else [len(scan.names)]
    found = []
    for device in devices:
        used = [pair for pair in pairs if device in pair or device == len(scan.names)]
        refined = refine_pose(
            scan.stripes, scan.cameras, scan.projector, scan.axis, device, used, widest_gap_px=scan.gap_px
        )
        found += [] if refined is None else [refined]
    return found


def _with_refined_pose(
    scan: _ScanData,
    redundancy: Redundancy,
    worst: tuple[int, int],
    best: _Trial,
    rivals: list[_Trial],
) -> Agreement:
    refined, before, after = best.refined, _by_index(scan.names, redundancy)[worst], best.pairs[worst]
    left_mm = _unexplained_mm(best.scan, best.parts, worst, after)
    apart_mm, in_shape_mm = max((_surface_distance_mm(best, each, worst[0]) for each in rivals), default=(0.0, 0.0))
    name = scan.device_name(refined.device)
    note = (
        f"{name} was turned by {refined.turn_deg:.2f}° and shifted by {refined.shift_mm:.2f} mm since its "
        f"calibration: {_contradiction(before)}. Its pose was refined from {refined.equations} correspondences of the "
        f"cameras, which leaves {after.median_absolute_px:.3f} px, if no other device moved"
    )
    if rivals:
        others = " or ".join(scan.device_name(each.refined.device) for each in rivals)
        note += (
            f". Had {others} moved instead, the cameras would agree as well: the surface would be {apart_mm:.3f} mm "
            f"from this one (68 % of it nearer), {in_shape_mm:.3f} mm of it in shape. This distance was added to the "
            "standard deviations, in squares"
        )
    names = list(best.scan.calibration.cameras)
    covariance = np.zeros((DEVICE_PARAMETERS * (len(names) + 1),) * 2)
    place = DEVICE_PARAMETERS * (
        len(names) if refined.device == len(scan.names) else names.index(scan.names[refined.device])
    )
    covariance[place : place + DEVICE_PARAMETERS, place : place + DEVICE_PARAMETERS] = refined.covariance
    points = np.concatenate([part.points_mm for part in best.parts])
    solved = SolveRecord("refined", "", covariance, np.stack([points.min(axis=0), points.max(axis=0)]), 0.0)
    return Agreement(
        best.scan.calibration,
        scan.usable,
        redundancy,
        float(np.hypot(left_mm, apart_mm)),
        pose_error=replace(best.scan.calibration, solved=solved),
        notes=(f"{note}. Calibrate again",),
        report={
            "decision": "pose refined",
            "device": name,
            "turned_deg": refined.turn_deg,
            "shifted_mm": refined.shift_mm,
            "correspondences": refined.equations,
            "before_px": before.median_absolute_px,
            "after_px": after.median_absolute_px,
            "after_over_stated": after.over_stated,
            "could_be_instead": [scan.device_name(each.refined.device) for each in rivals],
            "apart_mm": apart_mm,
            "apart_in_shape_mm": in_shape_mm,
            "sigma_added_mm": float(np.hypot(left_mm, apart_mm)),
        },
    )


def _with_one_camera(
    scan: _ScanData,
    parts: list[SheetCurves],
    redundancy: Redundancy,
    worst: tuple[int, int],
    odd: int | None,
    agreeing: set[str],
) -> Agreement:
    pairs = _by_index(scan.names, redundancy)
    found = pairs[worst]
    shown = [k for k, name in enumerate(scan.names) if scan.usable[k] and name in agreeing]
    distance_mm = scan.distance_mm(parts, worst)
    if odd is not None:
        best = max(
            (k for k in range(len(parts)) if scan.usable[k] and k != odd), key=lambda k: _worth(parts[k].deviation_mm)
        )
        why, added_mm = "the others agree with each other", 0.0
    elif shown:
        best = max(shown, key=lambda k: _worth(parts[k].deviation_mm))
        why, added_mm = "it agrees with the second axis of patterns", 0.0
    else:
        far = found.over_stated > _REFUTED_SIGMA and found.median_absolute_px > _LENS_PX
        if far or found.median_absolute_px > _REFUTED_PX:
            raise CalibrationError(_refuted(found))
        best = max((k for k in range(len(parts)) if scan.usable[k]), key=lambda k: _worth(parts[k].deviation_mm))
        why = "it has more points for their standard deviation"
        added_mm = distance_mm
    against = {k for pair in pairs if best in pair and pairs[pair].is_contradicted for k in pair} - {best}
    left_out = [name for k, name in enumerate(scan.names) if k in against or k == odd]
    used = [name for k, name in enumerate(scan.names) if scan.usable[k] and name not in left_out]
    note = (
        f"{_contradiction(found)}, {distance_mm:.3f} mm on the surface (68 % of it nearer), and no small move of one "
        f"device explains it. The points of {_listed(left_out)} were left out, and those of {_listed(used)} used: {why}"
    )
    if added_mm:
        note += ". The other may be right: the distance was added to the standard deviations, in squares"
    return Agreement(
        scan.calibration,
        tuple(each and name not in left_out for each, name in zip(scan.usable, scan.names, strict=True)),
        redundancy,
        added_mm,
        notes=(f"{note}. Verify the calibration (slrig verify), and calibrate again",),
        report={
            "decision": "cameras left out",
            "left_out": left_out,
            "because": why,
            "before_px": found.median_absolute_px,
            "distance_mm": distance_mm,
            "sigma_added_mm": added_mm,
        },
    )


def drop_contradicting_areas(
    names: Sequence[str], parts: Sequence[SheetCurves], redundancy: Redundancy, usable: Sequence[bool], /
) -> tuple[list[NDArray[np.bool_]], list[str]]:
    """Where cameras that agree elsewhere see different surfaces, use one of them: that of more points over their
    standard deviation in the area.

    An area is made of neighbouring cells (`cell_medians`) whose median residual exceeds 12 times the noise:
    one camera sees a mirror image there, or a part of the object that moved. usable : of each camera, whether any of
    its points are used. Returns which points of each camera are used, (n,) bool, and sentences for a person.
    """
    used = [np.full(len(part.points_mm), each) for part, each in zip(parts, usable, strict=True)]
    notes = []
    for pair, found in _by_index(names, redundancy).items():
        median, size_px = cell_medians(found.residuals)
        stated_px = np.hypot(found.residuals.sigma_px, found.calibration_px)
        far = np.abs(median) > OUTLIER_SIGMA * noise_px(found.residuals, median, stated_px)
        if found.is_contradicted or not far.any() or not all(usable[k] for k in pair):
            continue
        cells = [cell_numbers(sheet_coordinates(parts[k]), size_px) for k in pair]
        lowest = np.min([each.min(axis=0) for each in cells], axis=0)
        grid = np.zeros(np.max([each.max(axis=0) for each in cells], axis=0) - lowest + 1, dtype=np.bool_)
        grid[tuple((cell_numbers(found.residuals.sheet_px[far], size_px) - lowest).T)] = True
        count, areas = cv2.connectedComponents(grid.astype(np.uint8), connectivity=8)
        area_of_point = [areas[tuple((each - lowest).T)] for each in cells]
        dropped = 0
        for area in range(1, count):
            inside = [each == area for each in area_of_point]
            worse = int(np.argmin([_worth(parts[k].deviation_mm[each]) for k, each in zip(pair, inside, strict=True)]))
            used[pair[worse]] &= ~inside[worse]
            dropped += int(np.count_nonzero(inside[worse]))
        notes.append(
            f"cameras '{found.reference}' and '{found.camera}' see different surfaces in {count} "
            f"{'area' if count == 1 else 'areas'}: {dropped} points of the camera that has fewer there were left out. "
            "It is a mirror image, or a part of the object that moved between the exposures of the two"
        )
    return used, notes


def _worth(deviation_mm: FloatArray) -> float:
    """Number of points, (n, 3), over their usual standard deviation."""
    return len(deviation_mm) / float(np.median(np.linalg.norm(deviation_mm, axis=1))) if len(deviation_mm) else 0.0


def _unexplained_mm(scan: _ScanData, parts: list[SheetCurves], pair: tuple[int, int], found: PairRedundancy) -> float:
    """Standard deviation of either camera's points beyond what is stated: each has half of the pair's variance."""
    if found.over_stated <= 1:
        return 0.0
    return scan.distance_mm(parts, pair) * float(np.sqrt((1 - found.over_stated**-2) / 2))


def _surface_distance_mm(trial: _Trial, other: _Trial, camera: int) -> tuple[float, float]:
    """Distance between the points of a camera in two trials that 68 % of them have at most; and the same less the rigid
    motion between them.
    """
    (a, _, _, refused), (b, _, _, refused_too) = (
        intersect_light_sheets(scan.stripes[camera], scan.cameras[camera], scan.projector, scan.axis)
        for scan in (trial.scan, other.scan)
    )
    both = np.flatnonzero((refused == Refusal.NONE) & (refused_too == Refusal.NONE))
    both = both[:: max(1, len(both) // _SAMPLE)]
    a, b = a[both], b[both]
    middle_a, middle_b = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((b - middle_b).T @ (a - middle_a))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    in_shape = (b - middle_b) @ turn - (a - middle_a)
    whole, shape = (float(np.percentile(np.linalg.norm(each, axis=1), _ONE_DEVIATION)) for each in (b - a, in_shape))
    return whole, shape


def _contradiction(found: PairRedundancy) -> str:
    return (
        f"cameras '{found.reference}' and '{found.camera}' contradict each other: points of one lie "
        f"{found.median_absolute_px:.2f} px (median) beside the stripes of the other, {found.over_stated:.0f} times "
        "what is stated"
    )


def _scatter_note(found: PairRedundancy) -> str:
    return (
        f"points of camera '{found.reference}' scatter about the stripes of camera '{found.camera}' "
        f"{found.over_stated:.1f} times as much as stated: what exceeds it was added to the standard deviations, in "
        "squares"
    )


def _refuted(found: PairRedundancy) -> str:
    return (
        f"{_contradiction(found)}, no move of one device by less than {MAX_TURN_DEG:g}° and {MAX_SHIFT:.0%} of its "
        f"baseline explains it, and nothing shows which of them is right: there is no mesh. A device moved too far, "
        "or the calibration is of another rig or focus. Verify the calibration (slrig verify), and calibrate again"
    )


def _likely_cause(scan: _ScanData, pair: tuple[int, int]) -> str | None:
    """The mistake without which the two cameras agree, None if no usual one."""
    a, b = (scan.names[k] for k in pair)
    devices = scan.calibration.cameras
    causes: list[tuple[str, _ScanData]] = []
    if devices[a].size == devices[b].size:
        exchanged = {**devices, a: devices[b], b: devices[a]}
        causes.append((f"cameras '{a}' and '{b}' are exchanged", replace(
            scan, calibration=replace(scan.calibration, cameras=exchanged, solved=None))))  # fmt: skip
    for which in ((pair[0],), (pair[1],), pair):
        mirrored = tuple(
            _mirrored(each, camera.size.width_px) if k in which else each
            for k, (each, camera) in enumerate(zip(scan.stripes, scan.cameras, strict=True))
        )
        names = _listed([scan.names[k] for k in which])
        causes.append((f"the picture of {names} is mirrored", replace(scan, stripes=mirrored)))
    for words, changed in causes:
        found = changed.pairs(changed.parts()).get(pair)
        if found is not None and found.contradiction > 0 and not found.is_contradicted:
            return f"The cause: {words}; otherwise they agree to {found.median_absolute_px:.3f} px"
    return None


def _mirrored(stripes: StripeEnsemble, width_px: int) -> StripeEnsemble:
    flip = np.array([-1.0, 1.0])
    return stripes._replace(
        points_px=stripes.points_px * flip + np.array([width_px - 1.0, 0.0]), normals=stripes.normals * flip
    )


def _listed(names: Sequence[str]) -> str:
    return " and ".join(f"camera '{name}'" for name in names)
