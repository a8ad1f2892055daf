"""Verdict on a solved calibration: good, usable, or not usable, with figure, limit and cure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.accuracy import OddEven
from slrig.calibration.board import PRINT_SIGMA, Board
from slrig.calibration.poses.coverage import Coverage, place_words
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    DeviceResiduals,
    ExpectedError,
    Solution,
    covariance_of,
    device_title,
    devices_of,
    scale_mode,
)
from slrig.errors import setting
from slrig.model import Calibration, FloatArray, Pinhole


class Grade(StrEnum):
    """What to do with a calibration."""

    GOOD = "good"
    USABLE = "usable"
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """As a sentence has it."""
        return "do not use" if self is Grade.DO_NOT_USE else str(self.value)

    @property
    def badness(self) -> int:
        """For sorting: the worst has the most."""
        return list(Grade).index(self)


@dataclass(frozen=True, slots=True)
class Limit:
    """Up to `good` nothing is said of a figure, beyond it a remark is made. Beyond `most` the calibration is not to be
    used: the figure says that what is stated in millimetres cannot be believed. most is infinite where all that the
    figure does is in the millimetres already. source : where the numbers come from.
    """

    good: float
    most: float
    source: str

    def grade(self, value: float) -> Grade:
        """Return what a figure makes of the calibration. One that is NaN, not measured, leaves it usable."""
        if np.isnan(value):
            return Grade.USABLE
        return Grade.GOOD if value <= self.most else Grade.DO_NOT_USE


@dataclass(frozen=True, slots=True)
class Judgement:
    """One thing that was judged. figure : its name in `slrig.calibration.judgement.LIMITS`, "error", "poses",
    "scale", "stretch" or "odd_even"; device : which one, None for all together. words : what was found, what is usual,
    and what to do. remarkable : worth a person's look, though the grade is good.
    """

    grade: Grade
    figure: str
    device: str | None
    value: float
    words: str
    remarkable: bool = False


LEAST_OFF = 0.001
"""What a board in a box, a warm day and a rig that was touched may do to a distance, over itself."""
SURE = 5.0
"""Standard deviations of a share from which it is told."""
_TURNED_DEG = 1.0
_POSE = PARAMETERS.index("turn_x")
_EACH = len(PARAMETERS)


@dataclass(frozen=True, slots=True)
class ScaleCheck:
    """The scale of a solve against that of an earlier calibration.

    checked : whether they have two devices in common, whose distance tells it. share : by how much more everything
    measures than before, NaN where it was not checked, or distances differ in no one way; sigma : of that, by both
    solves, the board's size left out. words : what is wrong, and what to do; none where nothing is.
    """

    checked: bool
    share: float
    sigma: float
    words: tuple[str, ...]


def check_scale(solution: Solution, earlier: Calibration, board: Board) -> ScaleCheck:
    """Hold the distances of the devices against those of an earlier calibration.

    They are told apart from 0.1 % on, and from five of their own standard deviations. All of them off by one ratio,
    while the devices look in the same directions: the board's squares are not as large as they were said to be. Off
    otherwise: the rig was rebuilt.
    """
    now, before = devices_of(solution.calibration), devices_of(earlier)
    common = [name for name in now if name in before]
    pairs = [pair for pair in combinations(common, 2) if _distance_mm(before, *pair) > 0 < _distance_mm(now, *pair)]
    if not pairs:
        shared = ", ".join(device_title(name) for name in common) or "no device"
        unchecked = (
            f"the scale is not checked: that takes two devices which the earlier calibration has too, found {shared}; "
            "measure both rulers of the board"
        )
        return ScaleCheck(False, float("nan"), float("nan"), (unchecked,))
    mode = solution.size.scale_sigma * scale_mode(solution.calibration)
    own = solution.covariance - np.outer(mode, mode)
    shares, sigmas, told = [], [], []
    for first, second in pairs:
        new_mm, old_mm = _distance_mm(now, first, second), _distance_mm(before, first, second)
        variance = _variance_mm2(now, own, first, second)
        variance += _variance_mm2(before, covariance_of(earlier, board=False), first, second)
        shares.append(new_mm / old_mm - 1)
        sigmas.append(float(np.sqrt(variance)) / old_mm)
        told.append(f"{device_title(first)} to {device_title(second)}: {new_mm:.2f} mm, before {old_mm:.2f} mm")
    share, sigma = float(np.mean(shares)), max(sigmas)
    off = [abs(each) > max(LEAST_OFF, SURE * own_sigma) for each, own_sigma in zip(shares, sigmas, strict=True)]
    if not any(off):
        return ScaleCheck(True, share, sigma, ())
    changed = "; ".join(words for words, wrong in zip(told, off, strict=True) if wrong)
    turned = any(_turned_deg(now, before, *pair) > _TURNED_DEG for pair in pairs)
    alike = max(shares) - min(shares) <= max(LEAST_OFF, SURE * sigma)
    if all(off) and alike and not turned:
        words = (
            f"everything is {abs(share):.2%} {'larger' if share > 0 else 'smaller'} than in the earlier calibration "
            f"({changed}): the board's squares measure {board.square_mm / (1 + share):.5g} mm instead of "
            f"{board.square_mm:.5g} mm, or those of the earlier board were wrong, or the rig was rebuilt; measure both "
            f"rulers of the board, give {setting('measured_mm')}, and calibrate again if they are off"
        )
        return ScaleCheck(True, share, sigma, (words,))
    words = (
        f"the devices do not stand as in the earlier calibration ({changed}): the rig was rebuilt, or a device was "
        "bumped. If neither is so, measure both rulers of the board, and calibrate again"
    )
    return ScaleCheck(True, float("nan"), sigma, (words,))


def judged_size(solution: Solution, scale: ScaleCheck | None) -> Iterator[Judgement]:
    """What is to be said of a print's stretch, and of the scale where it was held against another one."""
    size = solution.size
    if abs(size.stretch) > max(LEAST_OFF, SURE * size.stretch_sigma):
        longer, shorter = ("wider", "high") if size.stretch > 0 else ("higher", "wide")
        words = (
            f"the print is {abs(size.stretch):.2%} ± {size.stretch_sigma:.2%} {longer} than it is {shorter}, against "
            "what it says; no pose tells which of the two is wrong, and everything may be off by half of that: measure "
            f"both rulers, and give what they read: {setting('measured_mm')}"
        )
        yield Judgement(Grade.USABLE, "stretch", None, size.stretch, words)
    if scale is not None and scale.words:
        yield Judgement(Grade.USABLE, "scale", None, scale.share, scale.words[0])


def unattended_faults(solution: Solution, board: Board, scale: ScaleCheck | None) -> tuple[str, ...]:
    """Why nobody but a person is to put a calibration in use, as far as the board's size goes; none if a clock may."""
    faults = [judgement.words for judgement in judged_size(solution, scale)]
    if (scale is None or not scale.checked) and board.square_sigma >= PRINT_SIGMA:
        faults.append(
            "nothing vouches for the scale: there is no earlier calibration in use to hold it against, and of the "
            f"board only that its squares are said to be {board.square_mm:g} mm. Activate the first calibration "
            f"yourself, or say how sure the size is: {setting('square_sigma')} of a certificate, or "
            f"{setting('measured_mm')} by the rulers"
        )
    return tuple(faults)


def _distance_mm(devices: Mapping[str, Pinhole], first: str, second: str) -> float:
    return float(np.linalg.norm(devices[second].centre_mm - devices[first].centre_mm))


def _variance_mm2(devices: Mapping[str, Pinhole], covariance: FloatArray, first: str, second: str) -> float:
    """Of the distance of two devices. A turn w and a shift dt move a centre -Rᵀt by -Rᵀ(dt + t x w)."""
    way = devices[second].centre_mm - devices[first].centre_mm
    way /= np.linalg.norm(way)
    order = list(devices)
    row = np.zeros(_EACH * len(order))
    for name, sign in ((first, -1.0), (second, 1.0)):
        device = devices[name]
        seen = device.rotation @ way
        start = _EACH * order.index(name) + _POSE
        row[start : start + 3] = -sign * np.cross(seen, device.translation_mm)
        row[start + 3 : start + 6] = -sign * seen
    return max(float(row @ covariance @ row), 0.0)


def _turned_deg(now: Mapping[str, Pinhole], before: Mapping[str, Pinhole], first: str, second: str) -> float:
    """By how much the second device turned as the first sees it, or the direction to it: the larger, degrees."""
    new = now[second].rotation @ now[first].rotation.T
    old = before[second].rotation @ before[first].rotation.T
    turn = np.arccos(np.clip((np.trace(new @ old.T) - 1) / 2, -1, 1))
    ways = []
    for devices in (now, before):
        way = devices[first].rotation @ (devices[second].centre_mm - devices[first].centre_mm)
        ways.append(way / np.linalg.norm(way))
    return float(np.degrees(max(turn, np.arccos(np.clip(ways[0] @ ways[1], -1, 1)))))


_RMS = "what careful calibrations reach in practice; the upper bound is ours"
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
"""By figure. border : share of the cells along the image's border without any corner. bias_ratio : mean residual of a
cell over the device's rms. bend_mm : how far the board is out of flat, where that was solved for. outlier_poses : share
of all poses. stated_ratio : rms over what the observations' own noise predicts."""

POSES = (10, 4)
"""From so many poses on none are asked for; fewer leave none to hold out (20 to 30 are usual)."""

USUAL_SHARE = 1 / 2000
"""What a point may be wrong by over the volume's diagonal, where nobody said what the rig is for. Scanners for robots
have standard deviations of 1 : 3 000 to 1 : 10 000; this is twice one of 1 : 4 000."""

_SIGMAS = 2.0
"""A point that is wrong by no more than what is wanted in 95 of 100 places is as wanted (ISO/IEC Guide 98-3, k = 2)."""
_USABLE = 2.0
"""Up to so many times what is wanted a calibration is usable; ours."""

_POSE_STANDS_OUT = 1.7
_LEAST_BIAS_PX = 0.05
_LEAST_SEEN = 40


@dataclass(frozen=True, slots=True)
class Verdict:
    """grade : the worst of all that was judged. summary : one sentence. reasons : the words of whatever keeps it from
    being good, the worst first; none when it is good. remarks : what could be better, though its effect is in the
    stated millimetres already. unattended : why a schedule leaves it to a person to put it in use; none if it does not.
    judged : everything, the worst first. wanted_mm : what a point may be wrong by in 95 of 100 places.
    """

    grade: Grade
    summary: str
    reasons: tuple[str, ...]
    judged: tuple[Judgement, ...]
    remarks: tuple[str, ...] = ()
    unattended: tuple[str, ...] = ()
    wanted_mm: float = float("nan")


def verdict(
    solution: Solution,
    expected: ExpectedError | None,
    covered: Coverage | None = None,
    checked: OddEven | None = None,
    *,
    board: Board,
    scale: ScaleCheck | None = None,
    wanted_mm: float | None = None,
) -> Verdict:
    """Return what a solved calibration is good for: by what a point may be wrong by against what is wanted, and by
    whether that can be believed.

    expected : None where it could not be found; covered : of the poses that it was solved from, checked : by halves of
    them, both None where not known. scale : against an earlier calibration, None without one. wanted_mm : what a point
    may be wrong by in 95 of 100 places; None takes 1/2000 of the diagonal of the volume in which the board was held.
    """
    if wanted_mm is None:
        wanted_mm = USUAL_SHARE * _diagonal_mm(expected) if expected is not None else float("nan")
    judged = [*_expected_error(expected, wanted_mm), *judged_size(solution, scale), *_poses(solution)]
    for name, residuals in solution.residuals.items():
        judged += [*_rms(name, residuals), *_residual_shape(name, residuals)]
    judged += [*_knowledge(solution), *_bend(solution)]
    if covered is not None:
        judged += _border(covered)
    if checked is not None:
        grade = Grade.GOOD if checked.fits else Grade.USABLE
        judged.append(Judgement(grade, "odd_even", None, checked.ratio, checked.words))
    judged.sort(key=lambda each: (-each.grade.badness, not each.remarkable))
    grade = judged[0].grade
    reasons = tuple(each.words for each in judged if each.grade is not Grade.GOOD)
    unusable = ("its verdict is not to use it",) if grade is Grade.DO_NOT_USE else ()
    apart = () if checked is None or checked.fits else ("its odd and even poses differ by more than it states",)
    return Verdict(
        grade=grade,
        summary=_summary(grade, expected, wanted_mm, len(reasons)),
        reasons=reasons,
        judged=tuple(judged),
        remarks=tuple(each.words for each in judged if each.grade is Grade.GOOD and each.remarkable),
        unattended=(*unusable, *apart, *unattended_faults(solution, board, scale)),
        wanted_mm=wanted_mm,
    )


def _summary(grade: Grade, expected: ExpectedError | None, wanted_mm: float, count: int) -> str:
    error = ""
    if expected is not None and np.isfinite(expected.point_mm) and expected.point_mm > 0:
        fraction = _diagonal_mm(expected) / expected.point_mm
        error = (
            f": {expected.point_words} is expected within {expected.point_mm:.2g} mm{expected.way_words} "
            f"(1 in {fraction:,.0f}{', by the size of the board most of all' if _by_board(expected) else ''})"
        )
    lone = expected is not None and expected.across
    alone = "; it cannot scan alone: that takes a projector or a second camera, calibrated with it" if lone else ""
    if grade is Grade.GOOD:
        return f"good{error}; twice that is no more than the {wanted_mm:.2g} mm that are wanted{alone}"
    return f"{grade.words}{error}; {count} thing{'s' if count > 1 else ''} to look at{alone}"


def _diagonal_mm(expected: ExpectedError) -> float:
    return float(np.linalg.norm(expected.volume_mm[1] - expected.volume_mm[0]))


def _by_board(expected: ExpectedError) -> bool:
    """Whether more than half of the variance comes from the size of the board."""
    return bool(expected.board_mm**2 > expected.point_mm**2 / 2)


def _judged(
    figure: str, device: str | None, value: float, what: str, usual: str, cure: str, *, fine: bool | None = None
) -> Judgement:
    """By the limit of the figure. fine : whether it is worth no remark; else the limit says. usual : with {good} where
    the limit is to stand.
    """
    limit = LIMITS[figure]
    grade = limit.grade(value)
    fine = grade is Grade.GOOD and (value <= limit.good if fine is None else fine)
    usual = usual.format(good=limit.good)
    words = f"{what} ({usual})" if fine else f"{what}, {usual}: {cure}"
    return Judgement(grade, figure, device, value, words, remarkable=not fine)


def _expected_error(expected: ExpectedError | None, wanted_mm: float) -> Iterator[Judgement]:
    figure = "error"
    if expected is None or not np.isfinite(expected.point_mm):
        words = "the error of a scan could not be told: add poses that all devices see, at three distances"
        yield Judgement(Grade.USABLE, figure, None, float("nan"), words)
        return
    diagonal_mm, error_mm = _diagonal_mm(expected), _SIGMAS * expected.point_mm
    good, usable = error_mm <= wanted_mm, error_mm <= _USABLE * wanted_mm
    grade = Grade.GOOD if good else Grade.USABLE if usable else Grade.DO_NOT_USE
    noisy = f" ({expected.total_mm:.2g} mm with the noise of the light)" if np.isfinite(expected.total_mm) else ""
    length_mm = expected.length_share * diagonal_mm / 2
    lengths = f", and a length of {diagonal_mm / 2:.0f} mm {length_mm:.2g} mm wrong" if np.isfinite(length_mm) else ""
    what = (
        f"{expected.point_words} is expected {expected.point_mm:.2g} mm off{expected.way_words} by the calibration"
        f"{noisy}{lengths}; twice that of a point is {error_mm:.2g} mm, wanted are {wanted_mm:.2g} mm"
    )
    cure = "add poses where the map of the expected error is worst, tilted and at several distances"
    if _by_board(expected):
        cure = (
            f"limited by the board, whose size makes {expected.board_mm:.2g} mm of it: measure both rulers of the "
            f"sheet ({setting('measured_mm')}), or use a board with a certificate ({setting('square_sigma')})"
        )
    words = what if good and not _by_board(expected) else f"{what}: {cure}"
    yield Judgement(grade, figure, None, error_mm, words, remarkable=_by_board(expected))


def _poses(solution: Solution) -> Iterator[Judgement]:
    used, left_out = len(solution.poses), len(solution.outliers)
    good, least = POSES
    grade = Grade.GOOD if used >= least else Grade.DO_NOT_USE
    words = f"{used} pose{'s' if used != 1 else ''} used, 20 to 30 are usual"
    if used < good:
        words += ": add poses"
    yield Judgement(grade, "poses", None, used, words, remarkable=used < good)
    if left_out:
        share = left_out / (used + left_out)
        named = "; ".join(f"{name}: {why}" for name, why in solution.outliers.items())
        words = f"{left_out} of {used + left_out} poses left out ({named}): shoot them again, and let nothing move"
        yield Judgement(LIMITS["outlier_poses"].grade(share), "outlier_poses", None, share, words, remarkable=True)


def _rms(name: str, residuals: DeviceResiduals) -> Iterator[Judgement]:
    projector, title = name == PROJECTOR, device_title(name)
    figure = "projector_rms_px" if projector else "camera_rms_px"
    worst, usual_px = _worst_pose(residuals), LIMITS[figure].good
    if worst:
        cure = f"look at {worst[0]} first ({worst[1]:.2g} px)"
    elif projector:
        cure = "all poses are alike: check that the exposure is a multiple of the refresh period, and the focus"
    else:
        cure = "all poses are alike: look at the focus"
    what, usual = f"{title} has {residuals.rms_px:.2g} px rms", f"usual is {'0.1–0.3' if projector else '0.05–0.2'}"
    yield (whole := _judged(figure, name, residuals.rms_px, what, usual, cure))
    if worst and not whole.remarkable:
        words = (
            f"{title}: {worst[0]} stands out, {worst[1]:.2g} px rms, {residuals.rms_px:.2g} px in all: shoot it again"
        )
        yield Judgement(Grade.GOOD, figure, name, worst[1], words, remarkable=True)
    ratio = residuals.held_out_rms_px / residuals.rms_px if residuals.rms_px > 0 else float("nan")
    if np.isnan(ratio):
        words = f"{title}: too few poses to keep some from the solve and test it with them: add poses"
        yield Judgement(Grade.USABLE, "held_out", name, ratio, words)
    else:
        what = f"{title} has {residuals.held_out_rms_px:.2g} px rms at poses kept from the solve, {ratio:.2f} × its own"
        cure = "the lens is fitted to too few poses: add poses"
        found = _judged("held_out", name, ratio, what, "at most {good:g} × is well", cure)
        if residuals.held_out_rms_px <= usual_px:
            found = replace(found, grade=Grade.GOOD)  # poor beside the rest, and still no more than is usual
        yield found
    ratio = residuals.rms_px / residuals.stated_rms_px if residuals.stated_rms_px > 0 else float("nan")
    if not np.isnan(ratio):
        # Corners are found to a few thousandths of a pixel; a board printed on paper is not as good as that.
        fine = ratio <= LIMITS["stated_ratio"].good or residuals.rms_px <= usual_px / 2
        what = f"{title} is {ratio:.1f} × as far off as the noise of its observations says"
        cure = (
            "look for light that the wall or the board's gloss throws back, a late frame, or a gamma that is not flat"
            if projector
            else "look for a bent board, a board or camera that moved, or a lens that the model does not fit"
        )
        yield _judged("stated_ratio", name, ratio, what, "up to {good:g} × is usual", cure, fine=fine)


def _residual_shape(name: str, residuals: DeviceResiduals) -> Iterator[Judgement]:
    title, count = device_title(name), residuals.count
    share = residuals.outlying / count if count else float("nan")
    if share > 0:
        what = f"{title}: {share:.1%} of {count} observations are outlying"
        cure = "look for reflections, shadows on the board, and wrongly decoded light"
        yield _judged("outlying_share", name, share, what, "up to {good:.0%} is usual", cure)
    length = np.linalg.norm(residuals.map_mean_px, axis=2)
    length = np.where(residuals.map_count >= _LEAST_SEEN, length, np.nan)
    if np.isfinite(length).any() and residuals.rms_px > 0:
        row, column = np.unravel_index(int(np.nanargmax(length)), length.shape)
        worst = float(length[row, column])
        ratio = worst / residuals.rms_px
        if ratio > LIMITS["bias_ratio"].good and worst > _LEAST_BIAS_PX:
            where = place_words((int(column) * 3 // CELLS - 1, int(row) * 3 // CELLS - 1))
            words = (
                f"{title}: in the {where} the residuals lean by {worst:.2g} px to one side, as much as their rms of "
                f"{residuals.rms_px:.2g} px: the lens model does not fit there, or the board is bent; add poses there"
            )
            yield Judgement(Grade.GOOD, "bias_ratio", name, ratio, words, remarkable=True)


def _knowledge(solution: Solution) -> Iterator[Judgement]:
    each = len(PARAMETERS)
    for index, (name, device) in enumerate(devices_of(solution.calibration).items()):
        block = solution.covariance[index * each : (index + 1) * each, index * each : (index + 1) * each]
        sigma = np.sqrt(np.clip(np.diag(block), 0, None))
        title, focal_px = device_title(name), float(device.matrix[0, 0])
        axis = int(np.argmax(sigma[2:4]))
        value, place = float(sigma[2 + axis]), float(device.matrix[axis, 2])
        what = f"{title}: the principal {('column', 'row')[axis]} is {place:.1f} ± {value:.2g} px"
        way = ("vertical", "horizontal")[axis]
        cure = f"add poses tilted by 30–45° about the {way} axis, and turned by 90°"
        yield _judged("principal_sigma_px", name, value, what, "±{good:g} px is well", cure)
        share = max(float(sigma[0] / device.matrix[0, 0]), float(sigma[1] / device.matrix[1, 1]))
        what = f"{title}: the focal length is {focal_px:.1f} ± {share * focal_px:.2g} px"
        cure = "add poses tilted by 30–45°, and at other distances"
        yield _judged("focal_sigma_share", name, share, what, "±{good:.1%} is well", cure)


def _bend(solution: Solution) -> Iterator[Judgement]:
    bow = solution.bow
    if bow is not None:
        # Where it was not solved for, the poses tell of no bow: what they leave open of it is in the covariance.
        fine = None if bow.solved else True
        cure = "that is taken into account, but glue the print to glass or aluminium"
        what, usual = board_words(solution), "up to {good:g} mm is well"
        yield _judged("bend_mm", None, bow.height_mm, what, usual, cure, fine=fine)


def board_words(solution: Solution) -> str:
    """What the solve took the board for, and how far out of flat it is."""
    bow, shape_mm = solution.bow, solution.board_shape_mm
    if bow is None:
        return "the board was taken for flat, as was asked for"
    height = f"{_figure(bow.height_mm, bow.sigma_mm)} mm from its lowest to its highest corner"
    if not bow.solved or shape_mm is None:
        return f"the board is flat as far as the poses tell: {height}"
    words = f"the board is bowed, {height}"
    off_mm = float(np.sqrt(np.mean(np.sum(shape_mm[:, :2] ** 2, axis=1))))
    return f"{words}, and its corners lie {off_mm:.2g} mm off their printed places" if off_mm > 0 else words


def _figure(value: float, sigma: float) -> str:
    """A number and its deviation, both with two digits of the deviation.

    >>> _figure(1.0715, 0.1042), _figure(0.0173, 0.0)
    ('1.07 ± 0.10', '0.017 ± 0')
    """
    if not sigma > 0:
        return f"{value:.2g} ± 0"
    digits = max(1 - int(np.floor(np.log10(sigma))), 0)
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def _border(covered: Coverage) -> Iterator[Judgement]:
    ring = np.ones((CELLS, CELLS), dtype=bool)
    ring[1:-1, 1:-1] = False
    for name, one in covered.devices.items():
        wanted = ring & one.reachable
        empty = wanted & (one.cells == 0)
        share = float(empty.sum() / max(int(wanted.sum()), 1))
        what = "along the image's border held no corner in any pose"
        if name == PROJECTOR:
            what = "along its border never lit the board"
        what = f"{device_title(name)}: {share:.0%} of the cells {what}"
        cure = f"the lens's distortion is not determined there; hold the board in the {_emptiest(empty)}"
        yield _judged("border", name, share, what, "at most {good:.0%} is well", cure)


def _emptiest(empty: NDArray[np.bool_]) -> str:
    """Return the corner or edge with the most empty cells."""
    third = CELLS // 3
    counts: FloatArray = empty.reshape(3, third, 3, third).sum(axis=(1, 3)).astype(np.float64)
    row, column = np.unravel_index(int(np.argmax(counts)), counts.shape)
    return place_words((int(column) - 1, int(row) - 1))


def _worst_pose(residuals: DeviceResiduals) -> tuple[str, float] | None:
    """Return the pose with the greatest rms, where it stands out from the median of all."""
    found = {name: value for name, value in residuals.pose_rms_px.items() if np.isfinite(value)}
    if not found:
        return None
    name = max(found, key=lambda each: found[each])
    return (name, found[name]) if found[name] > _POSE_STANDS_OUT * float(np.median(list(found.values()))) else None
