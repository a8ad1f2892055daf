"""Verdict on a solved calibration: good, usable or not usable, with figures, limits and remedies."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.accuracy import OddEven
from slrig.calibration.board import PRINT_SIGMA, Board
from slrig.calibration.poses import Coverage, describe_place
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    DeviceResiduals,
    ExpectedError,
    Solution,
    device_covariance,
    device_title,
    devices_by_name,
    scale_mode,
)
from slrig.errors import setting
from slrig.model import Calibration, FloatArray, Pinhole


class Grade(StrEnum):
    """Verdict on the use of a calibration."""

    GOOD = "good"
    USABLE = "usable"
    DO_NOT_USE = "do_not_use"

    @property
    def label(self) -> str:
        """Name of the grade for use in a sentence."""
        return "do not use" if self is Grade.DO_NOT_USE else str(self.value)

    @property
    def severity(self) -> int:
        """Rank of the grade, 0 for good."""
        return list(Grade).index(self)


@dataclass(frozen=True, slots=True)
class Limit:
    """Limits of a figure: above `good` it gets a remark, above `usable` the calibration must not be used.

    usable is infinite for a figure whose whole effect is included in the stated error in millimetres. source : origin
    of the numbers.
    """

    good: float
    usable: float
    source: str

    def grade(self, value: float) -> Grade:
        """Grade of the calibration by this figure; NaN, not measured, is usable."""
        if np.isnan(value):
            return Grade.USABLE
        return Grade.GOOD if value <= self.usable else Grade.DO_NOT_USE


@dataclass(frozen=True, slots=True)
class GradedFigure:
    """Grade of a calibration by one figure.

    figure : its name in `slrig.calibration.judgement.LIMITS`, "error", "poses", "scale", "stretch" or "odd_even";
    device : None for all together. message : the value found, the usual one, and the remedy. is_remark : True if the
    message is of interest although the grade is good.
    """

    grade: Grade
    figure: str
    device: str | None
    value: float
    message: str
    is_remark: bool = False


MIN_SCALE_ERROR = 0.001
"""Relative change of a distance that storage of the board, temperature and handling of the rig may cause."""
SCALE_SIGMAS = 5.0
"""Standard deviations of a relative change of scale from which it is reported."""
_MAX_TURN_DEG = 1.0
_FIRST_TURN = PARAMETERS.index("turn_x")
_PARAMETER_COUNT = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class ScaleCheck:
    """Scale of a solve relative to an earlier calibration.

    checked : True if they have two devices in common. change : relative change of all distances, NaN if not checked or
    if distances changed differently; sigma : its deviation by both solves, without the board's size. messages : faults
    and remedies.
    """

    checked: bool
    change: float
    sigma: float
    messages: tuple[str, ...]


def check_scale(solution: Solution, earlier: Calibration, board: Board) -> ScaleCheck:
    """Compare the distances between the devices with those of an earlier calibration.

    Changes are reported from 0.1 % and from five standard deviations. If all distances changed by one ratio and no
    device turned, the board's squares do not have the stated size. Otherwise the rig was rebuilt.
    """
    now, before = devices_by_name(solution.calibration), devices_by_name(earlier)
    common = [name for name in now if name in before]
    pairs = [pair for pair in combinations(common, 2) if _distance_mm(before, *pair) > 0 < _distance_mm(now, *pair)]
    if not pairs:
        shared = ", ".join(device_title(name) for name in common) or "no device"
        message = (
            "the scale is not checked: expected two devices in common with the earlier calibration, found "
            f"{shared}; measure both rulers of the board"
        )
        return ScaleCheck(False, float("nan"), float("nan"), (message,))
    mode = solution.size.scale_sigma * scale_mode(solution.calibration)
    own = solution.covariance - np.outer(mode, mode)
    changes, sigmas, descriptions = [], [], []
    for first, second in pairs:
        new_mm, old_mm = _distance_mm(now, first, second), _distance_mm(before, first, second)
        variance = _variance_mm2(now, own, first, second)
        variance += _variance_mm2(before, device_covariance(earlier, board=False), first, second)
        changes.append(new_mm / old_mm - 1)
        sigmas.append(float(np.sqrt(variance)) / old_mm)
        descriptions.append(f"{device_title(first)} to {device_title(second)}: {new_mm:.2f} mm, before {old_mm:.2f} mm")
    change, sigma = float(np.mean(changes)), max(sigmas)
    off = [
        abs(each) > max(MIN_SCALE_ERROR, SCALE_SIGMAS * own_sigma)
        for each, own_sigma in zip(changes, sigmas, strict=True)
    ]
    if not any(off):
        return ScaleCheck(True, change, sigma, ())
    changed = "; ".join(description for description, is_off in zip(descriptions, off, strict=True) if is_off)
    has_turned = any(_turn_deg(now, before, *pair) > _MAX_TURN_DEG for pair in pairs)
    uniform = max(changes) - min(changes) <= max(MIN_SCALE_ERROR, SCALE_SIGMAS * sigma)
    if all(off) and uniform and not has_turned:
        message = (
            f"everything is {abs(change):.2%} {'larger' if change > 0 else 'smaller'} than in the earlier calibration "
            f"({changed}): the board's squares measure {board.square_mm / (1 + change):.5g} mm instead of "
            f"{board.square_mm:.5g} mm, or those of the earlier board were wrong, or the rig was rebuilt; measure both "
            f"rulers of the board, give {setting('measured_mm')}, and calibrate again if they are off"
        )
        return ScaleCheck(True, change, sigma, (message,))
    message = (
        f"the devices have moved since the earlier calibration ({changed}): the rig was rebuilt, or a device was "
        "bumped. If neither is true, measure both rulers of the board, and calibrate again"
    )
    return ScaleCheck(True, float("nan"), sigma, (message,))


def grade_board_size(solution: Solution, scale: ScaleCheck | None) -> Iterator[GradedFigure]:
    """Grade the print's stretch, and the scale if it was compared with an earlier calibration."""
    size = solution.size
    if abs(size.stretch) > max(MIN_SCALE_ERROR, SCALE_SIGMAS * size.stretch_sigma):
        longer, shorter = ("wider", "high") if size.stretch > 0 else ("higher", "wide")
        message = (
            f"the print is {abs(size.stretch):.2%} ± {size.stretch_sigma:.2%} {longer} than it is {shorter}, compared "
            "with its nominal size; the poses do not determine which of the two is wrong, and everything may be off by "
            f"half of that: measure both rulers, and give their lengths: {setting('measured_mm')}"
        )
        yield GradedFigure(Grade.USABLE, "stretch", None, size.stretch, message)
    if scale is not None and scale.messages:
        yield GradedFigure(Grade.USABLE, "scale", None, scale.change, scale.messages[0])


def unattended_faults(solution: Solution, board: Board, scale: ScaleCheck | None) -> tuple[str, ...]:
    """Faults of the board's size that keep a schedule from activating a calibration; empty if it may."""
    faults = [graded.message for graded in grade_board_size(solution, scale)]
    if (scale is None or not scale.checked) and board.square_sigma >= PRINT_SIGMA:
        faults.append(
            "the scale is not verified: no earlier calibration is in use to compare it with, and the board's squares "
            f"of {board.square_mm:g} mm are neither certified nor measured. Activate the first calibration manually, "
            f"or give the accuracy of the size: {setting('square_sigma')} of a certificate, or "
            f"{setting('measured_mm')} by the rulers"
        )
    return tuple(faults)


def _distance_mm(devices: Mapping[str, Pinhole], first: str, second: str) -> float:
    return float(np.linalg.norm(devices[second].centre_mm - devices[first].centre_mm))


def _variance_mm2(devices: Mapping[str, Pinhole], covariance: FloatArray, first: str, second: str) -> float:
    """Variance of the distance of two devices. A turn w and a shift dt move a centre -Rᵀt by -Rᵀ(dt + t x w)."""
    direction = devices[second].centre_mm - devices[first].centre_mm
    direction /= np.linalg.norm(direction)
    order = list(devices)
    row = np.zeros(_PARAMETER_COUNT * len(order))
    for name, sign in ((first, -1.0), (second, 1.0)):
        device = devices[name]
        in_device = device.rotation @ direction
        start = _PARAMETER_COUNT * order.index(name) + _FIRST_TURN
        row[start : start + 3] = -sign * np.cross(in_device, device.translation_mm)
        row[start + 3 : start + 6] = -sign * in_device
    return max(float(row @ covariance @ row), 0.0)


def _turn_deg(now: Mapping[str, Pinhole], before: Mapping[str, Pinhole], first: str, second: str) -> float:
    """Turn of the second device relative to the first, or of the direction to it: the larger, degrees."""
    new = now[second].rotation @ now[first].rotation.T
    old = before[second].rotation @ before[first].rotation.T
    turn = np.arccos(np.clip((np.trace(new @ old.T) - 1) / 2, -1, 1))
    directions = []
    for devices in (now, before):
        direction = devices[first].rotation @ (devices[second].centre_mm - devices[first].centre_mm)
        directions.append(direction / np.linalg.norm(direction))
    return float(np.degrees(max(turn, np.arccos(np.clip(directions[0] @ directions[1], -1, 1)))))


_RMS = "careful calibrations in practice; the upper bound is ours"
_OURS = "ours"

LIMITS: Mapping[str, Limit] = {
    "camera_rms_px": Limit(0.2, 0.6, _RMS),
    "projector_rms_px": Limit(0.3, 0.8, _RMS),
    "held_out": Limit(1.3, 2.0, "practice: held out at most 1.3 × training; the upper bound is ours"),
    "outlying_share": Limit(0.02, 0.15, _OURS),
    "outlier_poses": Limit(0.0, 0.25, _OURS),
    "principal_sigma_px": Limit(3.0, np.inf, _OURS),
    "focal_sigma_share": Limit(0.001, np.inf, _OURS),
    "stated_ratio": Limit(2.0, np.inf, _OURS),
    "bias_ratio": Limit(1.0, np.inf, _OURS),
    "bend_mm": Limit(0.2, np.inf, _OURS),
    "border": Limit(0.5, np.inf, _OURS),
}
"""By figure. border : fraction of the cells along the image's border without any corner. bias_ratio : mean residual of
a cell over the device's rms. bend_mm : flatness of the board, if solved for. outlier_poses : fraction of all poses.
stated_ratio : rms over the rms predicted by the observations' own noise."""

POSES = (10, 4)
"""Number of poses from which no more are requested, and minimum for holding some out (20 to 30 are usual)."""

DEFAULT_ERROR_RATIO = 1 / 2000
"""Default of the wanted error, over the volume's diagonal. Scanners for robots have standard deviations of 1 : 3 000 to
1 : 10 000; this is twice one of 1 : 4 000."""

_SIGMAS = 2.0
"""Coverage factor k of the wanted error, 95 % (ISO/IEC Guide 98-3)."""
_USABLE_RATIO = 2.0
"""A calibration is usable up to this multiple of the wanted error; ours."""

_POSE_OUTLIER_RATIO = 1.7
_MIN_BIAS_PX = 0.05
_MIN_CELL_COUNT = 40


@dataclass(frozen=True, slots=True)
class Verdict:
    """Verdict on a calibration.

    grade : the worst of all figures. summary : one sentence. reasons : messages of all figures that are not good, the
    worst first. remarks : possible improvements whose effect the stated error includes. unattended : reasons why a
    schedule must not activate the calibration. figures : all, the worst first. tolerance_mm : wanted error of a point
    in 95 of 100 places.
    """

    grade: Grade
    summary: str
    reasons: tuple[str, ...]
    figures: tuple[GradedFigure, ...]
    remarks: tuple[str, ...] = ()
    unattended: tuple[str, ...] = ()
    tolerance_mm: float = float("nan")


def judge_calibration(
    solution: Solution,
    expected: ExpectedError | None,
    covered: Coverage | None = None,
    checked: OddEven | None = None,
    *,
    board: Board,
    scale: ScaleCheck | None = None,
    tolerance_mm: float | None = None,
) -> Verdict:
    """Grade a solved calibration by its expected error and by the credibility of that error.

    expected : None if unknown; covered : of the solved poses, checked : by halves of them, both None if unknown.
    scale : relative to an earlier calibration, None without one. tolerance_mm : wanted error of a point in 95 of 100
    places; None takes 1/2000 of the diagonal of the volume in which the board was held.
    """
    if tolerance_mm is None:
        tolerance_mm = DEFAULT_ERROR_RATIO * _diagonal_mm(expected) if expected is not None else float("nan")
    figures = [
        *_grade_expected_error(expected, tolerance_mm),
        *grade_board_size(solution, scale),
        *_grade_poses(solution),
    ]
    for name, residuals in solution.residuals.items():
        figures += [*_grade_residuals(name, residuals), *_grade_residual_map(name, residuals)]
    figures += [*_grade_parameters(solution), *_grade_bend(solution)]
    if covered is not None:
        figures += _grade_border(covered)
    if checked is not None:
        grade = Grade.GOOD if checked.fits else Grade.USABLE
        figures.append(GradedFigure(grade, "odd_even", None, checked.ratio, checked.words))
    figures.sort(key=lambda each: (-each.grade.severity, not each.is_remark))
    grade = figures[0].grade
    reasons = tuple(each.message for each in figures if each.grade is not Grade.GOOD)
    unusable = ("its verdict is not to use it",) if grade is Grade.DO_NOT_USE else ()
    inconsistent = () if checked is None or checked.fits else ("its odd and even poses differ by more than it states",)
    return Verdict(
        grade=grade,
        summary=_summary(grade, expected, tolerance_mm, len(reasons)),
        reasons=reasons,
        figures=tuple(figures),
        remarks=tuple(each.message for each in figures if each.grade is Grade.GOOD and each.is_remark),
        unattended=(*unusable, *inconsistent, *unattended_faults(solution, board, scale)),
        tolerance_mm=tolerance_mm,
    )


def _summary(grade: Grade, expected: ExpectedError | None, tolerance_mm: float, count: int) -> str:
    error = ""
    if expected is not None and np.isfinite(expected.point_mm) and expected.point_mm > 0:
        limit = ", mostly from the board's size" if _limited_by_board(expected) else ""
        error = (
            f": the expected error of {expected.point_description} is {expected.point_mm:.2g} mm"
            f"{expected.direction_description} (1 in {_diagonal_mm(expected) / expected.point_mm:,.0f}{limit})"
        )
    single = expected is not None and expected.across
    note = "; it cannot scan alone: that takes a projector or a second camera, calibrated with it" if single else ""
    if grade is Grade.GOOD:
        return f"good{error}, within the limit of {tolerance_mm / _SIGMAS:.2g} mm{note}"
    return f"{grade.label}{error}; {count} thing{'s' if count > 1 else ''} to check{note}"


def _diagonal_mm(expected: ExpectedError) -> float:
    return float(np.linalg.norm(expected.volume_mm[1] - expected.volume_mm[0]))


def _limited_by_board(expected: ExpectedError) -> bool:
    """True if more than half of the variance comes from the size of the board."""
    return bool(expected.board_mm**2 > expected.point_mm**2 / 2)


def _grade_figure(
    figure: str, device: str | None, value: float, found: str, usual: str, remedy: str, *, fine: bool | None = None
) -> GradedFigure:
    """Grade a figure by its limit. usual : with {good} in place of the limit. fine : False adds the remedy as a remark;
    by default the limit decides.
    """
    limit = LIMITS[figure]
    grade = limit.grade(value)
    fine = grade is Grade.GOOD and (value <= limit.good if fine is None else fine)
    usual = usual.format(good=limit.good)
    message = f"{found} ({usual})" if fine else f"{found}, {usual}: {remedy}"
    return GradedFigure(grade, figure, device, value, message, is_remark=not fine)


def _grade_expected_error(expected: ExpectedError | None, tolerance_mm: float) -> Iterator[GradedFigure]:
    figure = "error"
    if expected is None or not np.isfinite(expected.point_mm):
        message = "the error of a scan is unknown: add poses that all devices see, at three distances"
        yield GradedFigure(Grade.USABLE, figure, None, float("nan"), message)
        return
    diagonal_mm, error_mm = _diagonal_mm(expected), _SIGMAS * expected.point_mm
    good, usable = error_mm <= tolerance_mm, error_mm <= _USABLE_RATIO * tolerance_mm
    grade = Grade.GOOD if good else Grade.USABLE if usable else Grade.DO_NOT_USE
    noisy = f" ({expected.total_mm:.2g} mm with the noise of the light)" if np.isfinite(expected.total_mm) else ""
    length_mm = expected.length_share * diagonal_mm / 2
    lengths = f", and a length of {diagonal_mm / 2:.0f} mm {length_mm:.2g} mm wrong" if np.isfinite(length_mm) else ""
    found = (
        f"{expected.point_description} is expected {expected.point_mm:.2g} mm off{expected.direction_description} by "
        f"the calibration{noisy}{lengths}; twice that of a point is {error_mm:.2g} mm, wanted are {tolerance_mm:.2g} mm"
    )
    remedy = "add poses where the map of the expected error is worst, tilted and at several distances"
    if _limited_by_board(expected):
        remedy = (
            f"limited by the board, whose size contributes {expected.board_mm:.2g} mm: measure both rulers of the "
            f"sheet ({setting('measured_mm')}), or use a board with a certificate ({setting('square_sigma')})"
        )
    message = found if good and not _limited_by_board(expected) else f"{found}: {remedy}"
    yield GradedFigure(grade, figure, None, error_mm, message, is_remark=_limited_by_board(expected))


def _grade_poses(solution: Solution) -> Iterator[GradedFigure]:
    used, left_out = len(solution.poses), len(solution.outliers)
    good, least = POSES
    grade = Grade.GOOD if used >= least else Grade.DO_NOT_USE
    message = f"{used} pose{'s' if used != 1 else ''} used, 20 to 30 are usual"
    if used < good:
        message += ": add poses"
    yield GradedFigure(grade, "poses", None, used, message, is_remark=used < good)
    if left_out:
        ratio = left_out / (used + left_out)
        listed = "; ".join(f"{name}: {why}" for name, why in solution.outliers.items())
        message = f"{left_out} of {used + left_out} poses left out ({listed}): shoot them again, and move nothing"
        yield GradedFigure(LIMITS["outlier_poses"].grade(ratio), "outlier_poses", None, ratio, message, is_remark=True)


def _grade_residuals(name: str, residuals: DeviceResiduals) -> Iterator[GradedFigure]:
    projector, title = name == PROJECTOR, device_title(name)
    figure = "projector_rms_px" if projector else "camera_rms_px"
    worst, usual_px = _worst_pose(residuals), LIMITS[figure].good
    if worst:
        remedy = f"check {worst[0]} first ({worst[1]:.2g} px)"
    elif projector:
        remedy = "all poses are alike: check that the exposure is a multiple of the refresh period, and the focus"
    else:
        remedy = "all poses are alike: check the focus"
    found, usual = f"{title} has {residuals.rms_px:.2g} px rms", f"usual is {'0.1–0.3' if projector else '0.05–0.2'}"
    yield (whole := _grade_figure(figure, name, residuals.rms_px, found, usual, remedy))
    if worst and not whole.is_remark:
        message = (
            f"{title}: {worst[0]} stands out, {worst[1]:.2g} px rms, {residuals.rms_px:.2g} px in all: shoot it again"
        )
        yield GradedFigure(Grade.GOOD, figure, name, worst[1], message, is_remark=True)
    ratio = residuals.held_out_rms_px / residuals.rms_px if residuals.rms_px > 0 else float("nan")
    if np.isnan(ratio):
        message = f"{title}: too few poses to hold some out from the solve and test it with them: add poses"
        yield GradedFigure(Grade.USABLE, "held_out", name, ratio, message)
    else:
        found = f"{title} has {residuals.held_out_rms_px:.2g} px rms at held-out poses, {ratio:.2f} × its own"
        remedy = "the lens is fitted to too few poses: add poses"
        graded = _grade_figure("held_out", name, ratio, found, "at most {good:g} × is good", remedy)
        if residuals.held_out_rms_px <= usual_px:
            graded = replace(graded, grade=Grade.GOOD)  # a poor ratio, but a usual residual
        yield graded
    ratio = residuals.rms_px / residuals.stated_rms_px if residuals.stated_rms_px > 0 else float("nan")
    if not np.isnan(ratio):
        # Corners are detected more precisely than a board on paper is printed.
        fine = ratio <= LIMITS["stated_ratio"].good or residuals.rms_px <= usual_px / 2
        found = f"{title}: residuals are {ratio:.1f} × as large as the noise of the observations"
        remedy = (
            "check for reflections from walls or a glossy board, a late frame, or a gamma that is not linear"
            if projector
            else "check for a bent board, a board or camera that moved, or a lens that the model does not fit"
        )
        yield _grade_figure("stated_ratio", name, ratio, found, "up to {good:g} × is usual", remedy, fine=fine)


def _grade_residual_map(name: str, residuals: DeviceResiduals) -> Iterator[GradedFigure]:
    title, count = device_title(name), residuals.count
    fraction = residuals.outlying / count if count else float("nan")
    if fraction > 0:
        found = f"{title}: {fraction:.1%} of {count} observations are outliers"
        remedy = "check for reflections, shadows on the board, and wrongly decoded light"
        yield _grade_figure("outlying_share", name, fraction, found, "up to {good:.0%} is usual", remedy)
    length = np.linalg.norm(residuals.map_mean_px, axis=2)
    length = np.where(residuals.map_count >= _MIN_CELL_COUNT, length, np.nan)
    if np.isfinite(length).any() and residuals.rms_px > 0:
        row, column = np.unravel_index(int(np.nanargmax(length)), length.shape)
        worst = float(length[row, column])
        ratio = worst / residuals.rms_px
        if ratio > LIMITS["bias_ratio"].good and worst > _MIN_BIAS_PX:
            where = describe_place((int(column) * 3 // CELLS - 1, int(row) * 3 // CELLS - 1))
            message = (
                f"{title}: in the {where} the mean residual is {worst:.2g} px, as much as the rms of "
                f"{residuals.rms_px:.2g} px: the lens model does not fit there, or the board is bent; add poses there"
            )
            yield GradedFigure(Grade.GOOD, "bias_ratio", name, ratio, message, is_remark=True)


def _grade_parameters(solution: Solution) -> Iterator[GradedFigure]:
    each = len(PARAMETERS)
    for index, (name, device) in enumerate(devices_by_name(solution.calibration).items()):
        block = solution.covariance[index * each : (index + 1) * each, index * each : (index + 1) * each]
        sigma = np.sqrt(np.clip(np.diag(block), 0, None))
        title, focal_px = device_title(name), float(device.matrix[0, 0])
        axis = int(np.argmax(sigma[2:4]))
        value, position = float(sigma[2 + axis]), float(device.matrix[axis, 2])
        found = f"{title}: the principal {('column', 'row')[axis]} is {position:.1f} ± {value:.2g} px"
        tilt_axis = ("vertical", "horizontal")[axis]
        remedy = f"add poses tilted by 30–45° about the {tilt_axis} axis, and turned by 90°"
        yield _grade_figure("principal_sigma_px", name, value, found, "±{good:g} px is good", remedy)
        ratio = max(float(sigma[0] / device.matrix[0, 0]), float(sigma[1] / device.matrix[1, 1]))
        found = f"{title}: the focal length is {focal_px:.1f} ± {ratio * focal_px:.2g} px"
        remedy = "add poses tilted by 30–45°, and at other distances"
        yield _grade_figure("focal_sigma_share", name, ratio, found, "±{good:.1%} is good", remedy)


def _grade_bend(solution: Solution) -> Iterator[GradedFigure]:
    bow = solution.bow
    if bow is not None:
        # A bow that was not solved for is not significant, and its uncertainty is in the covariance.
        fine = None if bow.solved else True
        remedy = "that is taken into account, but glue the print to glass or aluminium"
        found, usual = describe_board(solution), "up to {good:g} mm is good"
        yield _grade_figure("bend_mm", None, bow.height_mm, found, usual, remedy, fine=fine)


def describe_board(solution: Solution) -> str:
    """Shape of the board in the solve, and its flatness."""
    bow, shape_mm = solution.bow, solution.board_shape_mm
    if bow is None:
        return "the board was solved as flat, as requested"
    height = f"{_format_figure(bow.height_mm, bow.sigma_mm)} mm from its lowest to its highest corner"
    if not bow.solved or shape_mm is None:
        return f"the board is flat as far as the poses determine: {height}"
    description = f"the board is bowed, {height}"
    off_mm = float(np.sqrt(np.mean(np.sum(shape_mm[:, :2] ** 2, axis=1))))
    if off_mm > 0:
        description += f", and its corners are {off_mm:.2g} mm off their nominal positions"
    return description


def _format_figure(value: float, sigma: float) -> str:
    """Format a number and its deviation, both with two digits of the deviation.

    >>> _format_figure(1.0715, 0.1042), _format_figure(0.0173, 0.0)
    ('1.07 ± 0.10', '0.017 ± 0')
    """
    if not sigma > 0:
        return f"{value:.2g} ± 0"
    digits = max(1 - int(np.floor(np.log10(sigma))), 0)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _grade_border(coverage: Coverage) -> Iterator[GradedFigure]:
    ring = np.ones((CELLS, CELLS), dtype=bool)
    ring[1:-1, 1:-1] = False
    for name, device in coverage.devices.items():
        wanted = ring & device.reachable
        empty = wanted & (device.cells == 0)
        fraction = float(empty.sum() / max(int(wanted.sum()), 1))
        found = "along the image's border held no corner in any pose"
        if name == PROJECTOR:
            found = "along its border never lit the board"
        found = f"{device_title(name)}: {fraction:.0%} of the cells {found}"
        remedy = f"the lens's distortion is not determined there; hold the board in the {_emptiest_region(empty)}"
        yield _grade_figure("border", name, fraction, found, "at most {good:.0%} is good", remedy)


def _emptiest_region(empty: NDArray[np.bool_]) -> str:
    """The corner or edge with the most empty cells."""
    third = CELLS // 3
    counts: FloatArray = empty.reshape(3, third, 3, third).sum(axis=(1, 3)).astype(np.float64)
    row, column = np.unravel_index(int(np.argmax(counts)), counts.shape)
    return describe_place((int(column) - 1, int(row) - 1))


def _worst_pose(residuals: DeviceResiduals) -> tuple[str, float] | None:
    """The pose with the largest rms and that rms, if it is an outlier among all."""
    rms_px = {name: value for name, value in residuals.pose_rms_px.items() if np.isfinite(value)}
    if not rms_px:
        return None
    name = max(rms_px, key=lambda each: rms_px[each])
    median = float(np.median(list(rms_px.values())))
    return (name, rms_px[name]) if rms_px[name] > _POSE_OUTLIER_RATIO * median else None
