"""Whether a solved calibration is good, usable, or not to be used, and why: figure, limit and cure in words."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slrig.calibration.poses.coverage import Coverage, place_words
from slrig.calibration.solution import (
    CELLS,
    PARAMETERS,
    PROJECTOR,
    DeviceResiduals,
    ExpectedError,
    Solution,
    device_title,
    devices_of,
)
from slrig.model import FloatArray


class Grade(StrEnum):
    """What to do with a calibration."""

    GOOD = "good"
    USABLE = "usable"
    DO_NOT_USE = "do_not_use"

    @property
    def words(self) -> str:
        """As a sentence has it."""
        return "do not use" if self is Grade.DO_NOT_USE else str(self.value)


_ORDER = (Grade.GOOD, Grade.USABLE, Grade.DO_NOT_USE)


@dataclass(frozen=True, slots=True)
class Limit:
    """Up to `good` a figure is good, up to `usable` usable. source : where the numbers come from."""

    good: float
    usable: float
    source: str

    def grade(self, value: float) -> Grade:
        """Return the grade of a figure. One that is NaN, not measured, is usable at best."""
        if np.isnan(value):
            return Grade.USABLE
        return Grade.GOOD if value <= self.good else Grade.USABLE if value <= self.usable else Grade.DO_NOT_USE


_RMS = "what careful calibrations reach in practice; the upper bound is ours"
_OURS = "ours"

LIMITS: Mapping[str, Limit] = {
    "camera_rms_px": Limit(0.2, 0.6, _RMS),
    "projector_rms_px": Limit(0.3, 0.8, _RMS),
    "held_out": Limit(1.3, 2.0, "practice: held out at most 1.3 × training; the upper bound is ours"),
    "error_share": Limit(
        1 / 10_000, 1 / 2_000, "classes of scanners: metrology from 1 : 20 000, robot vision 1 : 3 000 to 1 : 10 000"
    ),
    "principal_sigma_px": Limit(3.0, 20.0, _OURS),
    "focal_sigma_share": Limit(0.001, 0.01, _OURS),
    "stated_ratio": Limit(2.0, np.inf, _OURS),
    "outlying_share": Limit(0.02, 0.15, _OURS),
    "outlier_poses": Limit(0.0, 0.25, _OURS),
    "bias_ratio": Limit(1.0, np.inf, _OURS),
    "bend_mm": Limit(0.2, 2.0, _OURS),
    "border": Limit(0.5, 0.9, _OURS),
}
"""By figure. border : share of the cells along the image's border without any corner. bias_ratio : mean residual of a
cell over the device's rms. bend_mm : how far the board is out of flat, where that was solved for. outlier_poses : share
of all poses. stated_ratio : rms over what the observations' own noise predicts."""

POSES = (10, 4)
"""At least so many poses for a good, for a usable calibration (20 to 30 are usual)."""

_POSE_STANDS_OUT = 1.7
_LEAST_BIAS_PX = 0.05
_LEAST_SEEN = 40


@dataclass(frozen=True, slots=True)
class Judgement:
    """One thing that was judged. figure : its name in `LIMITS`, or "poses"; device : which one, None for all together.

    words : what was found, what is usual, and what to do.
    """

    grade: Grade
    figure: str
    device: str | None
    value: float
    words: str


@dataclass(frozen=True, slots=True)
class Verdict:
    """grade : the worst of all that was judged. summary : one sentence. reasons : the words of whatever keeps it from
    being good, the worst first; none when it is good. judged : everything, the worst first.
    """

    grade: Grade
    summary: str
    reasons: tuple[str, ...]
    judged: tuple[Judgement, ...]


def verdict(solution: Solution, expected: ExpectedError | None, covered: Coverage | None = None) -> Verdict:
    """Return what a solved calibration is good for.

    expected : None where it could not be found; covered : of the poses that it was solved from, None where not known.
    """
    judged = [*_expected_error(expected), *_poses(solution)]
    for name, residuals in solution.residuals.items():
        judged += [*_rms(name, residuals), *_residual_shape(name, residuals)]
    judged += [*_knowledge(solution), *_bend(solution)]
    if covered is not None:
        judged += _border(covered)
    judged.sort(key=lambda each: -_ORDER.index(each.grade))
    grade = judged[0].grade
    reasons = tuple(each.words for each in judged if each.grade is not Grade.GOOD)
    return Verdict(grade, _summary(grade, expected, len(reasons)), reasons, tuple(judged))


def _summary(grade: Grade, expected: ExpectedError | None, count: int) -> str:
    error = ""
    if expected is not None and np.isfinite(expected.point_mm) and expected.point_mm > 0:
        fraction = _diagonal_mm(expected) / expected.point_mm
        error = (
            f": {expected.point_words} is expected within {expected.point_mm:.2g} mm{expected.way_words} "
            f"(1 in {fraction:,.0f})"
        )
    lone = expected is not None and expected.across
    alone = "; it cannot scan alone: that takes a projector or a second camera, calibrated with it" if lone else ""
    if grade is Grade.GOOD:
        return f"good{error}; nothing speaks against it{alone}"
    return f"{grade.words}{error}; {count} thing{'s' if count > 1 else ''} to look at{alone}"


def _diagonal_mm(expected: ExpectedError) -> float:
    return float(np.linalg.norm(expected.volume_mm[1] - expected.volume_mm[0]))


def _judged(
    figure: str, device: str | None, value: float, what: str, usual: str, cure: str, *, grade: Grade | None = None
) -> Judgement:
    """By the limit of the figure, unless a grade is given. usual : with {good} where the limit is to stand."""
    grade = LIMITS[figure].grade(value) if grade is None else grade
    usual = usual.format(good=LIMITS[figure].good) if figure in LIMITS else usual
    words = f"{what} ({usual})" if grade is Grade.GOOD else f"{what}, {usual}: {cure}"
    return Judgement(grade, figure, device, value, words)


def _expected_error(expected: ExpectedError | None) -> Iterator[Judgement]:
    figure = "error_share"
    if expected is None or not np.isfinite(expected.point_mm):
        words = "the error of a scan could not be told: add poses that all devices see, at three distances"
        yield Judgement(Grade.USABLE, figure, None, float("nan"), words)
        return
    diagonal_mm = _diagonal_mm(expected)
    usual = f"a good calibration has at most 1 in {1 / LIMITS[figure].good:,.0f}"
    cure = "add poses where the map of the expected error is worst, tilted and at several distances"
    length = expected.length_share / 2
    noisy = f" ({expected.total_mm:.2g} mm with the noise of the light)" if np.isfinite(expected.total_mm) else ""
    point = f"{expected.point_words} is expected {expected.point_mm:.2g} mm off{expected.way_words} by the calibration"
    for share, what in (
        (expected.point_mm / diagonal_mm, f"{point}{noisy}"),
        (length, f"a length of half the volume's diagonal is expected {length * diagonal_mm:.2g} mm wrong"),
    ):
        if np.isfinite(share):
            fraction = (
                f"1 in {1 / share:,.0f} of the volume's diagonal of {diagonal_mm:.0f} mm" if share > 0 else "none"
            )
            yield _judged(figure, None, share, f"{what}, {fraction}", usual, cure)


def _poses(solution: Solution) -> Iterator[Judgement]:
    used, left_out = len(solution.poses), len(solution.outliers)
    good, usable = POSES
    grade = Grade.GOOD if used >= good else Grade.USABLE if used >= usable else Grade.DO_NOT_USE
    what, usual = f"{used} pose{'s' if used != 1 else ''} used", f"20 to 30 are usual, {good} the least"
    yield _judged("poses", None, used, what, usual, "add poses", grade=grade)
    if left_out:
        share = left_out / (used + left_out)
        named = "; ".join(f"{name}: {why}" for name, why in solution.outliers.items())
        words = f"{left_out} of {used + left_out} poses left out ({named}): shoot them again, and let nothing move"
        yield Judgement(LIMITS["outlier_poses"].grade(share), "outlier_poses", None, share, words)


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
    if worst and whole.grade is Grade.GOOD:
        words = (
            f"{title}: {worst[0]} stands out, {worst[1]:.2g} px rms, {residuals.rms_px:.2g} px in all: shoot it again"
        )
        yield Judgement(Grade.GOOD, figure, name, worst[1], words)
    ratio = residuals.held_out_rms_px / residuals.rms_px if residuals.rms_px > 0 else float("nan")
    if np.isnan(ratio):
        words = f"{title}: too few poses to keep some from the solve and test it with them: add poses"
        yield Judgement(Grade.USABLE, "held_out", name, ratio, words)
    else:
        grade = LIMITS["held_out"].grade(ratio)
        if residuals.held_out_rms_px <= usual_px:
            grade = min(grade, Grade.USABLE, key=_ORDER.index)  # poor beside the rest, and still no more than is usual
        what = f"{title} has {residuals.held_out_rms_px:.2g} px rms at poses kept from the solve, {ratio:.2f} × its own"
        cure = "the lens is fitted to too few poses: add poses"
        yield _judged("held_out", name, ratio, what, "at most {good:g} × is well", cure, grade=grade)
    ratio = residuals.rms_px / residuals.stated_rms_px if residuals.stated_rms_px > 0 else float("nan")
    if not np.isnan(ratio):
        # Corners are found to a few thousandths of a pixel; a board printed on paper is not as good as that.
        grade = LIMITS["stated_ratio"].grade(ratio) if residuals.rms_px > usual_px / 2 else Grade.GOOD
        what = f"{title} is {ratio:.1f} × as far off as the noise of its observations says"
        cure = (
            "look for light that the wall or the board's gloss throws back, a late frame, or a gamma that is not flat"
            if projector
            else "look for a bent board, a board or camera that moved, or a lens that the model does not fit"
        )
        yield _judged("stated_ratio", name, ratio, what, "up to {good:g} × is usual", cure, grade=grade)


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
        grade = LIMITS["bias_ratio"].grade(ratio) if worst > _LEAST_BIAS_PX else Grade.GOOD
        if grade is not Grade.GOOD:
            where = place_words((int(column) * 3 // CELLS - 1, int(row) * 3 // CELLS - 1))
            words = (
                f"{title}: in the {where} the residuals lean by {worst:.2g} px to one side, as much as their rms of "
                f"{residuals.rms_px:.2g} px: the lens model does not fit there, or the board is bent; add poses there"
            )
            yield Judgement(grade, "bias_ratio", name, ratio, words)


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
        grade = None if bow.solved else Grade.GOOD
        cure = "that is taken into account, but glue the print to glass or aluminium"
        what, usual = board_words(solution), "up to {good:g} mm is well"
        yield _judged("bend_mm", None, bow.height_mm, what, usual, cure, grade=grade)


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
